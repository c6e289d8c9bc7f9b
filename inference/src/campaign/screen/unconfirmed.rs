//! Readings that surprised the model and that no repeat could confirm: in a campaign that takes each setting once, every one that surprises.
//!
//! While frames come in the model alone judges such a reading, by what is known so far, and it is put aside. When all frames are there, it is
//! asked once more what is at fault. Monitors fail one at a time, and seldom. A beam that is lost surprises monitors of both planes, and what fails
//! in one cycle, such as a corrector that trips, does not in other cycles with that corrector. What is left is none of these: a corrector that is
//! reversed surprises the monitors of its plane at both signs, two monitors that are exchanged surprise in nearly every frame, and monitors whose
//! gains scatter do where the orbit is large. Those readings count, since a fit has to explain them.

use std::collections::BTreeSet;

use estimator::MonitorState;

use super::{Excluded, MOST, Repeats, Screening};

/// Ordinary scatter of a reading's response, gains of 2 % of the monitor and of the corrector [1].
const SCATTER: f64 = 0.03;
/// Share of a monitor's settings in which it may fail; with more, the model is at fault. Monitors that jump do so in 2 to 3 % of their readings.
const MONITOR_FAILS: f64 = 0.1;
/// Settings in which any monitor may fail.
const FEW: usize = 2;
/// Share of all cycles that may fail; with more, the model is at fault.
const CYCLES_FAIL: f64 = 0.2;
/// Times that the model is fitted to what counts by the one before.
const PASSES: usize = 4;

/// A reading: frame and monitor.
type Reading = (usize, usize);

/// What becomes of the readings that nothing confirmed.
#[derive(Debug, Default, PartialEq)]
struct Judged {
    /// They count: no fault of a monitor or of a cycle can explain them.
    sound: BTreeSet<Reading>,
    /// Frames of cycles that failed. Nothing of them counts, not even what is by chance where the model expects it.
    failed: BTreeSet<usize>,
}

/// What the readings that nothing confirmed show to be at fault in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// Few monitors.
    Monitors,
    /// The model, in one plane: 0 for x, 1 for y.
    Model(usize),
    /// The cycle: its beam, or what drove it; or the model in both planes.
    Cycle,
}

impl Repeats {
    /// Readings that were put aside and that agree, if none of the setting counts; two of a monitor that jumps may be confirmed by no third.
    fn unconfirmed(&self) -> Option<&[usize]> {
        let all_agree = usize::from(self.waiting) == self.held.len();
        (self.frames.is_empty() && all_agree).then_some(&self.held)
    }
}

impl Screening<'_> {
    /// Take back the readings that nothing confirmed, but for those of a monitor or a cycle that failed.
    pub(super) fn take_back_unconfirmed(&mut self) {
        let unconfirmed = self.unconfirmed();
        if unconfirmed.is_empty() {
            return;
        }
        let (before, mut judged) = (self.excluded.clone(), Judged::default());
        for _ in 0..PASSES {
            let again = self.judged(&unconfirmed);
            if again == judged {
                break;
            }
            judged = again;
            self.excluded.clone_from(&before);
            judged.sound.iter().for_each(|&(frame, b)| self.excluded.lift(frame, b));
            judged.failed.iter().for_each(|frame| self.excluded.exclude_frame(*frame, Excluded::LostBeam));
            self.stale = true;
            self.linearise_if_due(self.screener.drives.len());
            self.linearise_if_due(self.screener.drives.len());
        }
        let is_no_fault = |reading: &&Reading| judged.sound.contains(reading) || judged.failed.contains(&reading.0);
        unconfirmed.iter().filter(is_no_fault).for_each(|&(_, b)| self.monitors[b].pardon(1));
        self.monitors.iter_mut().for_each(|monitor| _ = monitor.judge());
        self.rebuild(self.screener.drives.len());
    }

    /// Readings that nothing confirmed, of monitors that work.
    fn unconfirmed(&self) -> BTreeSet<Reading> {
        let of_monitor = |(b, repeats): (usize, &Repeats)| -> Vec<Reading> {
            repeats.unconfirmed().into_iter().flatten().map(|&frame| (frame, b)).collect()
        };
        let all = self.repeats.iter().flat_map(|setting| setting.iter().enumerate().flat_map(of_monitor));
        all.filter(|&(_, b)| self.monitors[b].state() != MonitorState::Dead).collect()
    }

    /// What becomes of them.
    fn judged(&self, unconfirmed: &BTreeSet<Reading>) -> Judged {
        let frames: BTreeSet<usize> = unconfirmed.iter().map(|&(frame, _)| frame).collect();
        let faults: Vec<(usize, Fault)> = frames.into_iter().map(|frame| (frame, self.fault(frame))).collect();
        let of_cycle = faults.iter().filter(|(_, fault)| *fault == Fault::Cycle);
        let mut failed: BTreeSet<usize> = of_cycle.map(|(frame, _)| *frame).collect();
        if failed.len() as f64 > CYCLES_FAIL * self.screener.drives.len() as f64 {
            failed.clear();
        }
        let (mut sound, mut doubtful) = (BTreeSet::new(), vec![Vec::new(); self.monitors.len()]);
        for (frame, fault) in faults.into_iter().filter(|(frame, _)| !failed.contains(frame)) {
            for reading in unconfirmed.range((frame, 0)..(frame + 1, 0)) {
                let is_at_fault = match fault {
                    Fault::Monitors => false,
                    Fault::Model(plane) => self.screener.plane(reading.1) == plane,
                    Fault::Cycle => true,
                };
                if is_at_fault || self.is_ordinary(*reading) {
                    sound.insert(*reading);
                } else {
                    doubtful[reading.1].push(*reading);
                }
            }
        }
        let settings = |b: usize| self.repeats.iter().filter(|setting| setting[b].last.is_some()).count();
        let is_often = |b: usize, n: usize| n > FEW && n as f64 > MONITOR_FAILS * settings(b) as f64;
        let often = doubtful.into_iter().enumerate().filter(|(b, readings)| is_often(*b, readings.len()));
        sound.extend(often.flat_map(|(_, readings)| readings));
        Judged { sound, failed }
    }

    /// What is at fault in a frame.
    fn fault(&self, frame: usize) -> Fault {
        if self.is_repeated(frame) {
            return Fault::Monitors;
        }
        match [0, 1].map(|plane| self.surprises(frame, plane)) {
            [Some(false) | None, Some(false) | None] => Fault::Monitors,
            [Some(true), Some(false)] if self.surprises_again(frame, 0) => Fault::Model(0),
            [Some(false), Some(true)] if self.surprises_again(frame, 1) => Fault::Model(1),
            // of a plane that nothing reads nobody knows
            _ => Fault::Cycle,
        }
    }

    /// True if other frames of its setting confirm what most monitors read.
    fn is_repeated(&self, frame: usize) -> bool {
        let Some(setting) = self.screener.settings.repeatable[frame] else { return false };
        let confirmed = self.repeats[setting].iter().filter(|repeats| repeats.frames.len() > 1).count();
        2 * confirmed > self.monitors.len()
    }

    /// True if more than a few monitors of a plane surprise; none if nothing reads it.
    fn surprises(&self, frame: usize, plane: usize) -> Option<bool> {
        let alive: Vec<usize> = self.alive(frame).filter(|&b| self.screener.plane(b) == plane).collect();
        let surprising = alive.iter().filter(|&&b| !self.is_ordinary((frame, b))).count();
        (!alive.is_empty()).then_some(MOST * surprising > alive.len())
    }

    /// True if another cycle with the corrector of this one surprises as well, or if there is none.
    fn surprises_again(&self, frame: usize, plane: usize) -> bool {
        let corrector = |frame: usize| self.screener.settings.setting(frame).only_corrector();
        let moved = corrector(frame);
        let is_another = |other: &usize| *other != frame && moved.is_some() && corrector(*other) == moved;
        let mut others = (0..self.screener.drives.len()).filter(is_another).peekable();
        others.peek().is_none() || others.any(|other| self.surprises(other, plane) == Some(true))
    }

    /// True if the model expects a reading, with the ordinary scatter of gains.
    fn is_ordinary(&self, (frame, b): Reading) -> bool {
        self.is_expected_within(frame, b, (SCATTER * self.model.orbit[(frame, b)]).powi(2))
    }
}
