//! Whether an amplitude from frame to frame has a period.
//!
//! Each frame has an amplitude less the mean of its run of frames of one setting. Two sorts of signal are tried, less the means of the runs too:
//! every n-th frame differs, for each n and each phase, and a sine of each frequency. With R^2 the share of the sum of squares that one takes
//! away and nu degrees of freedom, white noise gives as much with a probability of
//!
//! `P = (1 - R^2)^((nu - 2)/2)`
//!
//! for the two numbers of a sine, and less for the one number of every n-th frame. A period counts where P times the number of signals tried is
//! below one per cent.
//!
//! Source: M. Zechmeister and M. Kürster, Astron. Astrophys. 496 (2009) 577, the generalised Lomb-Scargle periodogram.

use core::f64::consts::TAU;
use core::ops::Range;

use nalgebra::DVector;

use super::data::following;

/// What recurs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Recurs {
    /// One of so many frames differs from the others.
    Every(usize),
    /// A sine of this period [frames].
    Sine(f64),
}

/// A period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Period {
    /// What recurs.
    pub recurs: Recurs,
    /// `ln` of the probability that any of the signals tried would be as strong by chance.
    pub log_chance: f64,
}

/// Longest cycle of which one frame differs [frames]: accelerators serve no more users in turn.
const LONGEST: usize = 20;
/// Probability of a period found by chance.
const CHANCE: f64 = 0.01;
/// Frequencies tried for each independent one: the best is then missed by an eighth of a line's width at most.
const OVERSAMPLING: usize = 4;
/// Fewest degrees of freedom.
const FEWEST: f64 = 20.0;
/// Smallest norm of a column, over that of what it comes from, that is not rounding.
const ROUNDING: f64 = 1e-6;

/// Frames that have an amplitude, in groups with a mean of their own.
struct Grouped {
    frames: Vec<usize>,
    groups: Vec<Range<usize>>,
}

impl Period {
    /// Of amplitudes, not a number where there is none, of frames in some runs.
    pub fn find(amplitudes: &[f64], runs: &[Range<usize>]) -> Option<Self> {
        let grouped = Grouped::by_run(amplitudes, runs);
        let freedom = grouped.frames.len() as f64 - grouped.groups.len() as f64;
        if freedom < FEWEST {
            return None;
        }
        let values = grouped.column(|frame| amplitudes[frame]);
        let signals = signals(amplitudes.len());
        let tried = signals.len() as f64;
        let share = |(recurs, phase): (Recurs, usize)| (recurs, explained(&values, grouped.columns(recurs, phase)));
        let (recurs, share) = signals.into_iter().map(share).max_by(|a, b| a.1.total_cmp(&b.1))?;
        let log_chance = 0.5 * (freedom - 2.0) * (1.0 - share).max(f64::MIN_POSITIVE).ln() + tried.ln();
        (log_chance < CHANCE.ln()).then_some(Self { recurs, log_chance })
    }

    /// As a clause.
    pub fn phrase(&self) -> String {
        match self.recurs {
            Recurs::Every(2) => "in every second frame".into(),
            Recurs::Every(3) => "in every third frame".into(),
            Recurs::Every(n) => format!("in every {n}th frame"),
            Recurs::Sine(period) => format!("with a period of {period:.1} frames"),
        }
    }
}

impl Grouped {
    fn by_run(amplitudes: &[f64], runs: &[Range<usize>]) -> Self {
        let known = |run: &Range<usize>| run.clone().filter(|&frame| !amplitudes[frame].is_nan()).collect();
        let known: Vec<Vec<usize>> = runs.iter().map(known).filter(|frames: &Vec<usize>| !frames.is_empty()).collect();
        Self { groups: following(known.iter().map(Vec::len)), frames: known.concat() }
    }

    /// Values less the means of their groups.
    fn column(&self, value: impl Fn(usize) -> f64) -> DVector<f64> {
        let mut column = DVector::from_iterator(self.frames.len(), self.frames.iter().map(|&frame| value(frame)));
        for group in &self.groups {
            let mean = group.clone().map(|i| column[i]).sum::<f64>() / group.len() as f64;
            group.clone().for_each(|i| column[i] -= mean);
        }
        column
    }

    /// The one or two columns of a signal.
    fn columns(&self, recurs: Recurs, phase: usize) -> Vec<DVector<f64>> {
        match recurs {
            Recurs::Every(n) => vec![self.column(|frame| f64::from(u8::from(frame % n == phase)))],
            Recurs::Sine(period) => {
                let angle = |frame: usize| TAU * frame as f64 / period;
                vec![self.column(|frame| angle(frame).cos()), self.column(|frame| angle(frame).sin())]
            }
        }
    }
}

/// Every signal that is tried, with its phase, of so many frames.
fn signals(frames: usize) -> Vec<(Recurs, usize)> {
    let cycles = (2..=LONGEST.min(frames / 4)).flat_map(|n| (0..n).map(move |phase| (Recurs::Every(n), phase)));
    let steps = OVERSAMPLING * frames / 2;
    let sines = (OVERSAMPLING..=steps).map(|i| (Recurs::Sine((OVERSAMPLING * frames) as f64 / i as f64), 0));
    cycles.chain(sines).collect()
}

/// Share of the sum of squares of some values in the span of some columns.
fn explained(values: &DVector<f64>, columns: Vec<DVector<f64>>) -> f64 {
    let mut share = 0.0;
    let mut before: Vec<DVector<f64>> = Vec::new();
    for mut column in columns {
        let least = ROUNDING * (column.len() as f64).sqrt();
        before.iter().for_each(|one| column -= one * one.dot(&column));
        if column.norm() > least {
            column /= column.norm();
            share += column.dot(values).powi(2);
            before.push(column);
        }
    }
    share / values.norm_squared().max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::StdRng;

    use super::*;
    use crate::testing::normal;

    const FRAMES: usize = 346;

    /// Runs of three frames, and noise of variance 1 with a mean of its own in each run.
    fn noise(seed: u64) -> (Vec<f64>, Vec<Range<usize>>) {
        let mut random = StdRng::seed_from_u64(seed);
        let runs = (0..FRAMES).step_by(3).map(|start| start..FRAMES.min(start + 3)).collect();
        let mean: Vec<f64> = (0..=FRAMES / 3).map(|_| 5.0 * normal(&mut random)).collect();
        ((0..FRAMES).map(|frame| mean[frame / 3] + normal(&mut random)).collect(), runs)
    }

    #[test]
    fn every_seventh_frame_and_a_sine_are_told_apart() {
        let (mut values, runs) = noise(1);
        values.iter_mut().skip(4).step_by(7).for_each(|value| *value += 2.0);
        values[50] = f64::NAN;
        assert_eq!(Period::find(&values, &runs).unwrap().recurs, Recurs::Every(7));
        let (mut values, runs) = noise(2);
        values.iter_mut().enumerate().for_each(|(i, value)| *value += 1.5 * (TAU * i as f64 / 5.3).sin());
        let Recurs::Sine(period) = Period::find(&values, &runs).unwrap().recurs else { panic!("no sine") };
        // a line's width in 346 frames is 5.3^2/346 = 0.08 frames
        assert!((period - 5.3).abs() < 0.05, "{period}");
    }

    #[test]
    fn noise_has_no_period() {
        // with a chance of less than one per cent each, two of forty have a probability of 6 %
        let found = (0..40).map(|seed| noise(10 + seed)).filter(|(values, runs)| Period::find(values, runs).is_some());
        assert!(found.count() < 2);
    }
}
