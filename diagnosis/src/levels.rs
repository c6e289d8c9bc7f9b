//! The level of the noise in time: stretches of frames in which all monitors are noisier by one factor than in the rest of the recording.
//!
//! With `n` whitened differences of a frame ([`super::repeats`]) and `q` the sum of their squares, and `in` and `out` for sums over a stretch and over
//! the rest, the noise is larger by `f = sqrt((q_in/n_in)/(q_out/n_out))`, and the `ln` likelihood by
//!
//! `(n ln(q/n) - n_in ln(q_in/n_in) - n_out ln(q_out/n_out))/(2 D)`.
//!
//! `D` is the dispersion of the frames' sums: 1 for independent normal noise, more for tails and for what monitors have in common. It is learnt from how
//! much the sums of neighbouring frames differ, which a stretch does not change. A stretch costs the choice of its ends and of its factor (Laplace),
//! and the odds of having one. It has to be the noise of most monitors, in no pattern: one monitor that is noisy for a time, and whatever moves the
//! beam for a time, are other causes.

use core::ops::Range;

use nalgebra::DMatrix;
use twin::{Measured, Unit};

use super::imperfection::{Imperfection, Measure};

/// Frames in which the noise of all monitors is larger.
#[derive(Debug, Clone, PartialEq)]
pub struct Stretch {
    /// The frames.
    pub frames: Range<usize>,
    /// Their noise over that of the rest [1].
    pub factor: Measured,
}

/// The level of the noise in every frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Levels {
    /// In rising order, apart from each other; none where the level is the same in all frames.
    pub stretches: Vec<Stretch>,
}

/// Odds of a recording that has another stretch.
const ODDS: f64 = 0.1;
/// Width of the half-normal prior of `ln` of the factor: noise that doubles is usual where it changes at all.
const WIDTH: f64 = core::f64::consts::LN_2;
/// Stretches at most.
const MOST: usize = 8;
/// Fewest frames of a stretch, and most ends of stretches that are tried: a longer recording is cut into blocks of several frames.
const SHORTEST: usize = 4;
const ENDS: usize = 400;
/// Largest part of a stretch's squares in one pattern of monitors or less: of independent noise in 4 frames of 33 monitors the first pattern has 0.4.
const IN_A_PATTERN: f64 = 0.6;

/// Sums over some frames: how many differences there are, and their squares.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Sums {
    count: f64,
    square: f64,
}

impl Sums {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let known = values.filter(|z| !z.is_nan());
        known.fold(Self::default(), |sums, z| Self { count: sums.count + 1.0, square: sums.square + z * z })
    }

    fn plus(self, other: Self) -> Self {
        Self { count: self.count + other.count, square: self.square + other.square }
    }

    fn less(self, other: Self) -> Self {
        Self { count: self.count - other.count, square: (self.square - other.square).max(0.0) }
    }

    /// Mean square.
    fn variance(self) -> f64 {
        (self.square / self.count.max(1.0)).max(f64::MIN_POSITIVE)
    }

    fn log_likelihood(self) -> f64 {
        -0.5 * self.count * self.variance().ln()
    }

    /// Noise over that of others, for a dispersion.
    fn over(self, others: Self, dispersion: f64) -> Measured {
        let value = (self.variance() / others.variance()).sqrt();
        let of = |sums: Self| 0.5 * dispersion / sums.count.max(1.0);
        Measured { value, sigma: value * (of(self) + of(others)).sqrt() }
    }
}

impl Stretch {
    /// In a sentence.
    pub fn said(&self) -> String {
        format!("the noise in {} is {:.1} times that in the rest", self.when(), self.factor.value)
    }

    fn when(&self) -> String {
        format!("frames {} to {}", self.frames.start, self.frames.end - 1)
    }

    /// The row of a table.
    pub(super) fn row(&self) -> Imperfection {
        Imperfection {
            name: "noise over that of the rest, less 1",
            kind: "noise_level",
            at: self.when(),
            measure: Measure::Mean,
            measured: Measured { value: self.factor.value - 1.0, ..self.factor },
            unit: Unit::PERCENT,
            ordinary: 0.0,
        }
    }
}

impl Levels {
    /// The same level in all frames.
    pub const EVEN: Self = Self { stretches: Vec::new() };

    /// Learn from whitened differences, rows frames, columns monitors; not a number where there is none.
    pub fn learn(differences: &DMatrix<f64>) -> Self {
        let learner = Learner::of(differences);
        let mut found: Vec<Range<usize>> = Vec::new();
        while let Some(one) = learner.best(&found).filter(|_| found.len() < MOST) {
            found.push(one);
        }
        found.sort_by_key(|frames| frames.start);
        let rest = learner.rest(&found);
        let of = |frames: Range<usize>| {
            let factor = learner.sums(&frames).over(rest, learner.dispersion);
            Stretch { frames, factor }
        };
        Self { stretches: found.into_iter().map(of).collect() }
    }

    /// Noise of a frame over that of most.
    pub fn at(&self, frame: usize) -> f64 {
        self.stretches.iter().find(|one| one.frames.contains(&frame)).map_or(1.0, |one| one.factor.value)
    }

    #[cfg(test)]
    pub(super) fn some(frames: Range<usize>, factor: f64) -> Self {
        Self { stretches: vec![Stretch { frames, factor: Measured { value: factor, sigma: 0.0 } }] }
    }

    /// True if it is the same in all frames.
    pub fn is_even(&self) -> bool {
        self.stretches.is_empty()
    }
}

struct Learner<'d> {
    differences: &'d DMatrix<f64>,
    /// Frames of a block, and the sums up to the start of each.
    block: usize,
    before: Vec<Sums>,
    dispersion: f64,
}

impl<'d> Learner<'d> {
    fn of(differences: &'d DMatrix<f64>) -> Self {
        let frames = differences.nrows();
        let of_frame: Vec<Sums> = differences.row_iter().map(|row| Sums::of(row.iter().copied())).collect();
        let block = frames.div_ceil(ENDS).max(1);
        let mut before = vec![Sums::default()];
        for of_block in of_frame.chunks(block) {
            let last = before[before.len() - 1];
            before.push(of_block.iter().fold(last, |sums, one| sums.plus(*one)));
        }
        Self { differences, block, before, dispersion: dispersion(&of_frame) }
    }

    fn frames(&self, blocks: &Range<usize>) -> Range<usize> {
        blocks.start * self.block..(blocks.end * self.block).min(self.differences.nrows())
    }

    fn sums(&self, frames: &Range<usize>) -> Sums {
        self.before[frames.end.div_ceil(self.block)].less(self.before[frames.start / self.block])
    }

    /// What is in none of some stretches.
    fn rest(&self, found: &[Range<usize>]) -> Sums {
        found.iter().fold(self.sums(&(0..self.differences.nrows())), |rest, one| rest.less(self.sums(one)))
    }

    /// The most likely stretch beside others, if it is more likely than none.
    fn best(&self, found: &[Range<usize>]) -> Option<Range<usize>> {
        let (blocks, rest) = (self.before.len() - 1, self.rest(found));
        let ends = (0..blocks).flat_map(|start| (start + 1..=blocks).map(move |end| start..end));
        let stretches = ends.map(|blocks| self.frames(&blocks)).filter(|frames| {
            frames.len() >= SHORTEST && found.iter().all(|one| one.end <= frames.start || frames.end <= one.start)
        });
        let choice = (0.5 * (blocks * (blocks + 1)) as f64).ln();
        let gained = stretches.map(|frames| (self.log_bayes(&frames, rest) - choice, frames));
        let (log_bayes, frames) = gained.max_by(|(one, _), (other, _)| one.total_cmp(other))?;
        (log_bayes + ODDS.ln() > 0.0 && self.is_noise(&frames, rest)).then_some(frames)
    }

    /// `ln` Bayes factor of larger noise in given frames.
    fn log_bayes(&self, frames: &Range<usize>, rest: Sums) -> f64 {
        let inside = self.sums(frames);
        let outside = rest.less(inside);
        let factor = inside.over(outside, self.dispersion);
        if inside.count == 0.0 || outside.count == 0.0 || factor.value <= 1.0 {
            return f64::NEG_INFINITY;
        }
        let gain = inside.log_likelihood() + outside.log_likelihood() - rest.log_likelihood();
        let (log, sigma) = (factor.value.ln(), factor.sigma / factor.value);
        gain / self.dispersion + (2.0 * sigma / WIDTH).ln() - 0.5 * (log / WIDTH).powi(2)
    }

    /// True where most monitors have at least half of the excess, and no pattern of them has most of it.
    fn is_noise(&self, frames: &Range<usize>, rest: Sums) -> bool {
        let inside = self.differences.rows_range(frames.clone());
        let outside = rest.less(self.sums(frames)).variance();
        let mut each: Vec<f64> = inside
            .column_iter()
            .map(|column| Sums::of(column.iter().copied()))
            .filter(|sums| sums.count > 0.0)
            .map(|sums| sums.variance() / outside)
            .collect();
        each.sort_by(f64::total_cmp);
        let excess = self.sums(frames).variance() / outside - 1.0;
        let typical = each.get(each.len() / 2).map_or(0.0, |ratio| ratio - 1.0);
        let known = inside.map(|z| if z.is_nan() { 0.0 } else { z });
        let patterns = known.singular_values();
        typical > 0.5 * excess && patterns[0].powi(2) < IN_A_PATTERN * patterns.norm_squared()
    }
}

/// Half of the mean square of what `ln` of the mean squares of neighbouring frames differ by, over that of independent normal noise, at least 1.
fn dispersion(of_frame: &[Sums]) -> f64 {
    let known: Vec<&Sums> = of_frame.iter().filter(|sums| sums.count > 1.0).collect();
    let differ = known.windows(2).map(|pair| {
        let expected = 2.0 / pair[0].count + 2.0 / pair[1].count;
        (pair[0].variance() / pair[1].variance()).ln().powi(2) / expected
    });
    let (sum, count) = differ.fold((0.0, 0.0), |(sum, count), one| (sum + one, count + 1.0));
    if count > 0.0 { (sum / f64::max(count, 1.0)).max(1.0) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use rand_distr::{Distribution, StandardNormal, StudentT};

    use super::*;

    const FRAMES: usize = 346;
    const MONITORS: usize = 30;
    const PART: Range<usize> = 120..180;

    /// Differences of runs of three frames, of which the first has none.
    fn differences(seed: u64, noise: impl Fn(&mut StdRng) -> f64, scale: impl Fn(usize, usize) -> f64) -> DMatrix<f64> {
        let mut random = StdRng::seed_from_u64(seed);
        let mut of = |frame: usize, b: usize| {
            if frame.is_multiple_of(3) { f64::NAN } else { noise(&mut random) * scale(frame, b) }
        };
        DMatrix::from_fn(FRAMES, MONITORS, |frame, b| of(frame, b))
    }

    fn normal(random: &mut StdRng) -> f64 {
        StandardNormal.sample(random)
    }

    #[test]
    fn a_part_with_more_noise_is_found_with_its_factor() {
        for (seed, factor) in [1.3, 1.3, 2.0, 5.0].into_iter().enumerate() {
            let scale = |frame: usize, _: usize| if PART.contains(&frame) { factor } else { 1.0 };
            let found = Levels::learn(&differences(seed as u64, normal, scale)).stretches;
            let [Stretch { frames, factor: measured }] = &found[..] else { panic!("{found:?}") };
            println!("{frames:?} {measured:?}");
            assert!((measured.value - factor).abs() < 3.0 * measured.sigma, "{measured:?}");
            // a frame of 30 differences tells a factor of 1.3 from none by 2.5 ± 2.7 nat, so that the eight of 12 frames tell it by 20 ± 8
            assert!(frames.start.abs_diff(PART.start) <= 12 && frames.end.abs_diff(PART.end) <= 12, "{frames:?}");
        }
    }

    #[test]
    fn several_parts_have_factors_of_their_own() {
        let scale = |frame: usize, _: usize| match frame {
            0..60 => 2.0,
            200..230 => 3.0,
            _ => 1.0,
        };
        let found = Levels::learn(&differences(5, normal, scale));
        assert_eq!(found.stretches.len(), 2, "{found:?}");
        assert!((found.at(30) - 2.0).abs() < 0.15 && (found.at(215) - 3.0).abs() < 0.3 && found.at(100) == 1.0);
    }

    /// Noise of one level, tails, what monitors have in common, one noisy monitor, and one pattern in a part: none is a level of the noise.
    #[test]
    fn anything_else_is_no_level() {
        let tails = |random: &mut StdRng| StudentT::new(4.0).unwrap().sample(random);
        let one = |frame: usize, b: usize| if b == 7 && PART.contains(&frame) { 12.0 } else { 1.0 };
        for seed in 0..20 {
            let mut common = differences(seed, normal, |_, _| 1.0);
            let mut patterned = common.clone();
            let mut random = StdRng::seed_from_u64(seed + 1000);
            for frame in 0..FRAMES {
                let [of_all, of_part] = [0.5, 3.0].map(|size| size * normal(&mut random));
                let of_part = if PART.contains(&frame) { of_part } else { 0.0 };
                common.row_mut(frame).add_scalar_mut(of_all);
                patterned.row_mut(frame).iter_mut().enumerate().for_each(|(b, z)| *z += of_part * (b as f64).sin());
            }
            let even = |_: usize, _: usize| 1.0;
            let cases =
                [differences(seed, normal, even), differences(seed, tails, even), differences(seed, normal, one)];
            for (k, case) in cases.iter().chain([&common, &patterned]).enumerate() {
                let found = Levels::learn(case);
                assert!(found.is_even(), "case {k}, seed {seed}: {found:?}");
            }
        }
    }
}
