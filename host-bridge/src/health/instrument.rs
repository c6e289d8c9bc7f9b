//! The state of one monitor or corrector: it changes at one bound and changes back at a lower one, and filters decide.

use serde::{Deserialize, Serialize};
use shared_memory::State;

use super::filter::Filter;

/// Where a fault begins, and where it ends: lower, so that a ratio between the two changes nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Above it, the fault begins.
    pub begins: f32,
    /// Below it, it ends.
    pub ends: f32,
}

impl Bounds {
    fn decide(&self, was: bool, ratio: f32, is_settled: bool) -> bool {
        if is_settled { ratio > if was { self.ends } else { self.begins } } else { was }
    }
}

/// The bounds of all faults.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Of the scatter, relative to what is expected [1].
    pub scatter: Bounds,
    /// Of the share of samples that jump [1].
    pub jumps: Bounds,
    /// Of the share of samples that are missing [1].
    pub missing: Bounds,
    /// Samples without a fault until what is back is ok.
    pub probation: u32,
}

/// What one frame tells of an instrument.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sample {
    /// It does not report, or does nothing.
    Missing,
    /// It jumped.
    Jump,
    /// It jumped, or does nothing: how often tells which.
    Surprise,
    /// Its scatter relative to what is expected [1].
    Scatter(f32),
}

/// One monitor or corrector, with filters over about so many samples.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Instrument<const SAMPLES: u32> {
    state: State,
    scatter: Filter<SAMPLES>,
    jumps: Filter<SAMPLES>,
    missing: Filter<SAMPLES>,
    /// Samples since the last fault.
    faultless: u32,
    is_noisy: bool,
    has_jumps: bool,
    is_dead: bool,
}

impl<const SAMPLES: u32> Instrument<SAMPLES> {
    /// Take a sample; true if the state has changed.
    pub fn add(&mut self, sample: Sample, limits: &Limits) -> bool {
        self.missing.add(share(matches!(sample, Sample::Missing | Sample::Surprise)));
        if sample != Sample::Missing {
            self.jumps.add(share(matches!(sample, Sample::Jump | Sample::Surprise)));
        }
        if let Sample::Scatter(ratio) = sample {
            self.scatter.add(ratio);
        }
        let before = self.state;
        self.decide(limits);
        self.state != before
    }

    fn decide(&mut self, limits: &Limits) {
        let was_dead = self.is_dead;
        self.is_dead = limits.missing.decide(was_dead, self.missing.mean(), self.missing.is_settled());
        if was_dead && !self.is_dead {
            // what it did before says nothing of what it does now
            (self.scatter, self.jumps) = (Filter::default(), Filter::default());
            (self.is_noisy, self.has_jumps) = (false, false);
        }
        self.is_noisy = limits.scatter.decide(self.is_noisy, self.scatter.mean(), self.scatter.is_settled());
        self.has_jumps = limits.jumps.decide(self.has_jumps, self.jumps.mean(), self.jumps.is_settled());
        let fault = [(self.is_dead, State::Dead), (self.has_jumps, State::Jumps), (self.is_noisy, State::Noisy)];
        let fault = fault.into_iter().find_map(|(is_there, state)| is_there.then_some(state));
        self.faultless = if fault.is_some() { 0 } else { self.faultless.saturating_add(1) };
        let is_new = self.state == State::Ok || self.faultless >= limits.probation;
        self.state = fault.unwrap_or(if is_new { State::Ok } else { State::Back });
    }

    /// Its state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Filtered scatter, share of jumps and share of missing samples [1].
    pub fn ratios(&self) -> [f32; 3] {
        [self.scatter.mean(), self.jumps.mean(), self.missing.mean()]
    }
}

fn share(is_so: bool) -> f32 {
    f32::from(u8::from(is_so))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits {
        scatter: Bounds { begins: 1.5, ends: 1.2 },
        jumps: Bounds { begins: 0.1, ends: 0.02 },
        missing: Bounds { begins: 0.5, ends: 0.1 },
        probation: 32,
    };

    fn healthy() -> Instrument<64> {
        let mut instrument = Instrument::default();
        (0..200).for_each(|_| assert!(!instrument.add(Sample::Scatter(1.0), &LIMITS)));
        instrument
    }

    /// Samples until a state is there.
    fn until(instrument: &mut Instrument<64>, sample: Sample, state: State) -> u32 {
        (1..10_000)
            .find(|_| {
                instrument.add(sample, &LIMITS);
                instrument.state() == state
            })
            .unwrap()
    }

    /// Samples after which a step between two levels, of which a share `left` is to go, has passed: `(1 - 1/64)^k < left`.
    fn expected(left: f32) -> u32 {
        (left.ln() / (1.0 - 1.0 / 64.0_f32).ln()).ceil() as u32
    }

    #[test]
    fn a_state_changes_when_the_filter_passes_its_bound() {
        let mut monitor = healthy();
        assert_eq!(until(&mut monitor, Sample::Missing, State::Dead), expected(0.5));
        let missing = monitor.ratios()[2];
        assert_eq!(until(&mut monitor, Sample::Scatter(1.0), State::Back), expected(0.1 / missing));
        // the sample that ended the fault is the first of the probation
        assert_eq!(until(&mut monitor, Sample::Scatter(1.0), State::Ok), LIMITS.probation - 1);
        let mut monitor = healthy();
        assert_eq!(until(&mut monitor, Sample::Scatter(2.0), State::Noisy), expected(0.5));
        let scatter = monitor.ratios()[0];
        assert_eq!(until(&mut monitor, Sample::Scatter(1.0), State::Back), expected(0.2 / (scatter - 1.0)));
    }

    #[test]
    fn rare_surprises_are_jumps_and_steady_ones_are_a_dead_instrument() {
        let mut corrector = healthy();
        let every_fifth = |i: u32| if i.is_multiple_of(5) { Sample::Surprise } else { Sample::Scatter(1.0) };
        (0..1000).for_each(|i| _ = corrector.add(every_fifth(i), &LIMITS));
        assert_eq!(corrector.state(), State::Jumps);
        until(&mut corrector, Sample::Surprise, State::Dead);
    }

    #[test]
    fn no_sample_decides_alone() {
        for sample in [Sample::Missing, Sample::Jump, Sample::Scatter(1e3)] {
            let mut new = Instrument::<64>::default();
            assert!(!new.add(sample, &LIMITS), "{sample:?}");
        }
        let mut monitor = healthy();
        assert!(!monitor.add(Sample::Missing, &LIMITS) && !monitor.add(Sample::Jump, &LIMITS));
    }

    #[test]
    fn between_its_bounds_a_ratio_changes_nothing() {
        let (mut well, mut ill) = (healthy(), healthy());
        until(&mut ill, Sample::Scatter(2.0), State::Noisy);
        for _ in 0..10_000 {
            assert!(!well.add(Sample::Scatter(1.4), &LIMITS) && !ill.add(Sample::Scatter(1.4), &LIMITS));
        }
        assert_eq!([well.state(), ill.state()], [State::Ok, State::Noisy]);
    }

    #[test]
    fn what_is_back_from_the_dead_has_new_filters() {
        let mut monitor = healthy();
        until(&mut monitor, Sample::Jump, State::Jumps);
        until(&mut monitor, Sample::Missing, State::Dead);
        until(&mut monitor, Sample::Scatter(1.0), State::Back);
        assert_eq!(monitor.ratios()[..2], [0.0, 0.0]);
        until(&mut monitor, Sample::Scatter(1.0), State::Ok);
    }

    #[test]
    fn states_have_their_codes_and_words() {
        for (code, word) in (0..).zip(["ok", "noisy", "jumps", "dead", "back"]) {
            assert_eq!(State::from_code(code).map(|state| (state as u32, state.word())), Some((code, word)));
        }
        assert_eq!(State::from_code(5), None);
    }
}
