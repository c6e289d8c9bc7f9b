//! The level of the noise in time: parts of the recording in which all monitors are noisier by one factor than in the rest.
//!
//! With `n` whitened differences (`repeats.rs`) and `q` the sum of their squares, and `in` and `out` for sums over a part and over
//! the rest, the noise is larger by `f = sqrt((q_in/n_in)/(q_out/n_out))`, and the `ln` likelihood by
//!
//! `(n ln(q/n) - n_in ln(q_in/n_in) - n_out ln(q_out/n_out))/(2 D)`.
//!
//! `D` is the dispersion of the frames' sums: 1 for independent normal noise, more for tails and for what monitors have in common. It is learnt from how
//! much the sums of neighbouring frames differ in the median, which the two ends of a part hardly change. A part costs the choice of its ends and of
//! its factor (Laplace), and the odds of having one. It has to be the noise of three monitors in four, and not in a few patterns: some monitors that are
//! noisy for a time, and whatever moves the beam for a time, are other causes. Parts are found one after the other: of two that touch or lie within each
//! other the ends may be those of both together.

use core::ops::Range;

use nalgebra::DMatrix;
use twin::{Measured, Unit, median};

use inference::{Imperfection, Measure};

/// Frames in which the noise of all monitors is larger.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// The frames.
    pub frames: Range<usize>,
    /// Their noise over that of the rest [1].
    pub factor: Measured,
}

/// The level of the noise in every frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Levels {
    /// In rising order, apart from each other; none where the level is the same in all frames.
    pub parts: Vec<Part>,
}

/// Odds of a recording that has another part.
const ODDS: f64 = 0.1;
/// Width of the half-normal prior of `ln` of the factor: noise that doubles is usual where it changes at all.
const WIDTH: f64 = core::f64::consts::LN_2;
/// Parts that are tried at most.
const MOST: usize = 8;
/// Fewest frames with differences in a part, since in fewer its patterns cannot be told from noise; and about how many ends are tried at first: in longer
/// recordings those near the best follow.
const SHORTEST: usize = 8;
const ENDS: usize = 400;
/// Patterns in which a beam moves, at most: two phases of betatron motion in x and two in y.
const PATTERNS: usize = 4;
/// Median of chi-square of one degree of freedom.
const MEDIAN: f64 = 0.455;
/// The lower quartile of a normal distribution, in standard deviations from its mean.
const QUARTILE: f64 = 0.674;
/// Factors that agree within so many standard deviations are one.
const ALIKE: f64 = 3.0;

/// Sums over some frames: how many have differences, how many there are, and their squares.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Sums {
    frames: usize,
    count: f64,
    square: f64,
}

impl Sums {
    fn from_values(values: impl Iterator<Item = f64>) -> Self {
        let known = values.filter(|z| !z.is_nan());
        let (count, square) = known.fold((0.0, 0.0), |(count, square), z| (count + 1.0, square + z * z));
        Self { frames: usize::from(count > 0.0), count, square }
    }

    fn plus(self, other: Self) -> Self {
        Self { frames: self.frames + other.frames, count: self.count + other.count, square: self.square + other.square }
    }

    fn less(self, other: Self) -> Self {
        Self {
            frames: self.frames - other.frames,
            count: self.count - other.count,
            square: (self.square - other.square).max(0.0),
        }
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
        let relative_variance = |sums: Self| 0.5 * dispersion / sums.count.max(1.0);
        Measured { value, sigma: value * (relative_variance(self) + relative_variance(others)).sqrt() }
    }
}

impl Part {
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
    pub const CONSTANT: Self = Self { parts: Vec::new() };

    /// Learn from whitened differences, rows frames, columns monitors; not a number where there is none.
    pub fn learn(differences: &DMatrix<f64>) -> Self {
        let squares = Squares::from_differences(differences);
        let tried = squares.parts();
        let rest = squares.rest(&tried);
        let part = |frames: Range<usize>| {
            let factor = squares.sums(&frames).over(rest, squares.dispersion);
            Part { frames, factor }
        };
        let found = tried.into_iter().filter(|frames| squares.is_noise(frames, rest));
        let mut parts: Vec<Part> = Vec::new();
        for next in found.map(part) {
            match parts.last_mut().filter(|last| squares.continues(last, &next)) {
                Some(last) => *last = part(last.frames.start..next.frames.end),
                None => parts.push(next),
            }
        }
        Self { parts }
    }

    /// Noise of a frame over that of most.
    pub fn at(&self, frame: usize) -> f64 {
        self.parts.iter().find(|one| one.frames.contains(&frame)).map_or(1.0, |one| one.factor.value)
    }

    #[cfg(test)]
    pub(super) fn some(frames: Range<usize>, factor: f64) -> Self {
        Self { parts: vec![Part { frames, factor: Measured { value: factor, sigma: 0.0 } }] }
    }

    /// True if it is the same in all frames.
    pub(crate) fn is_constant(&self) -> bool {
        self.parts.is_empty()
    }
}

/// The squares of the differences along the recording.
struct Squares<'d> {
    differences: &'d DMatrix<f64>,
    /// Sums over all frames before each, and before the end.
    before: Vec<Sums>,
    dispersion: f64,
}

impl<'d> Squares<'d> {
    fn from_differences(differences: &'d DMatrix<f64>) -> Self {
        let of_frame: Vec<Sums> = differences.row_iter().map(|row| Sums::from_values(row.iter().copied())).collect();
        let mut before = vec![Sums::default()];
        for one in &of_frame {
            before.push(before[before.len() - 1].plus(*one));
        }
        Self { differences, before, dispersion: dispersion(&of_frame) }
    }

    fn frames(&self) -> usize {
        self.differences.nrows()
    }

    fn sums(&self, frames: &Range<usize>) -> Sums {
        self.before[frames.end].less(self.before[frames.start])
    }

    /// What is in none of some parts.
    fn rest(&self, parts: &[Range<usize>]) -> Sums {
        parts.iter().fold(self.sums(&(0..self.frames())), |rest, one| rest.less(self.sums(one)))
    }

    /// All parts with larger squares, in rising order.
    fn parts(&self) -> Vec<Range<usize>> {
        let mut parts = Vec::new();
        while parts.len() < MOST
            && let Some(frames) = self.best(&parts)
        {
            parts.push(frames);
        }
        // the first ones were found without the others
        for i in 0..parts.len() {
            let others: Vec<Range<usize>> =
                parts.iter().enumerate().filter(|(k, _)| *k != i).map(|(_, one)| one.clone()).collect();
            parts[i] = self.best(&others).unwrap_or_else(|| parts[i].clone());
        }
        parts.sort_by_key(|frames| frames.start);
        parts
    }

    /// True for a part that follows another without a difference in between, with the same factor.
    fn continues(&self, one: &Part, next: &Part) -> bool {
        let between = self.sums(&(one.frames.end..next.frames.start));
        let sigma = one.factor.sigma.hypot(next.factor.sigma);
        between.frames == 0 && (one.factor.value - next.factor.value).abs() < ALIKE * sigma
    }

    /// The most likely part beside others, if it is more likely than none.
    fn best(&self, tried: &[Range<usize>]) -> Option<Range<usize>> {
        let (frames, block) = (self.frames(), self.frames().div_ceil(ENDS).max(1));
        let ends: Vec<usize> = (0..frames).step_by(block).chain([frames]).collect();
        let coarse = self.most_likely(&ends, &ends, tried)?;
        let near = |end: usize| -> Vec<usize> { (end.saturating_sub(block)..=(end + block).min(frames)).collect() };
        let choice = (0.5 * (frames * (frames + 1)) as f64).ln();
        let (log_bayes, best) = self.most_likely(&near(coarse.1.start), &near(coarse.1.end), tried)?;
        (log_bayes - choice + ODDS.ln() > 0.0).then_some(best)
    }

    /// The most likely part with given ends that none of some others overlaps, with its `ln` Bayes factor.
    fn most_likely(&self, starts: &[usize], ends: &[usize], tried: &[Range<usize>]) -> Option<(f64, Range<usize>)> {
        let rest = self.rest(tried);
        let is_free = |frames: &Range<usize>| {
            tried.iter().all(|one| one.end <= frames.start || frames.end <= one.start)
                && self.sums(frames).frames >= SHORTEST
        };
        let all =
            starts.iter().flat_map(|&start| ends.iter().filter(move |&&end| end > start).map(move |&end| start..end));
        let weighed = all.filter(is_free).map(|frames| (self.log_bayes(&frames, rest), frames));
        weighed.max_by(|(one, _), (other, _)| one.total_cmp(other))
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

    /// True for the noise of three monitors in four that is in no few patterns.
    fn is_noise(&self, frames: &Range<usize>, rest: Sums) -> bool {
        let outside = rest.variance();
        let ratio = self.sums(frames).variance() / outside;
        let values = self.differences.rows_range(frames.clone());
        let each = values.column_iter().map(|column| Sums::from_values(column.iter().copied()));
        let mut each: Vec<Sums> = each.filter(|sums| sums.count > 0.0).collect();
        each.sort_by(|one, other| one.variance().total_cmp(&other.variance()));
        let quarter = each[each.len() / 4];
        // the quartile of the squares' means is below their expectation, by chance
        let by_chance = (1.0 - QUARTILE * (2.0 / quarter.count).sqrt()).max(0.2);
        let halfway = 0.5 * (1.0 + ratio);
        quarter.variance() / outside > by_chance * halfway && left_by_patterns(&values.into_owned()) > halfway / ratio
    }
}

/// Sum of squares beside the leading patterns of monitors, over that where each monitor has its values in other frames: 1 for noise, and the ratio of the
/// noise to all for what moves in patterns.
fn left_by_patterns(values: &DMatrix<f64>) -> f64 {
    let known = values
        .row_iter()
        .filter(|row| row.iter().any(|z| !z.is_nan()))
        .map(|row| row.map(|z| if z.is_nan() { 0.0 } else { z }));
    let known = DMatrix::from_rows(&known.collect::<Vec<_>>());
    let rows = known.nrows();
    let moved = DMatrix::from_fn(rows, known.ncols(), |i, b| known[((i + b) % rows, b)]);
    let patterns = PATTERNS.min(rows.min(known.ncols()) / 2);
    let left = |values: DMatrix<f64>| values.singular_values().iter().skip(patterns).map(|one| one * one).sum::<f64>();
    left(known) / left(moved).max(f64::MIN_POSITIVE)
}

/// From how much `ln` of the mean squares of neighbouring frames differ, over that of independent normal noise, in the median; at least 1.
fn dispersion(of_frame: &[Sums]) -> f64 {
    let known: Vec<&Sums> = of_frame.iter().filter(|sums| sums.count > 1.0).collect();
    let differ = known.windows(2).map(|pair| {
        let expected = 2.0 / pair[0].count + 2.0 / pair[1].count;
        (pair[0].variance() / pair[1].variance()).ln().powi(2) / expected
    });
    median(differ).map_or(1.0, |median| (median / MEDIAN).max(1.0))
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use rand_distr::{Distribution, StudentT};

    use super::*;
    use crate::testing::normal;

    const FRAMES: usize = 346;
    const MONITORS: usize = 30;
    const PART: Range<usize> = 120..180;

    /// Differences of runs of three frames, of which the first has none.
    fn differences(seed: u64, noise: impl Fn(&mut StdRng) -> f64, scale: impl Fn(usize, usize) -> f64) -> DMatrix<f64> {
        let mut random = StdRng::seed_from_u64(seed);
        let of = |frame: usize, b: usize| {
            if frame.is_multiple_of(3) { f64::NAN } else { noise(&mut random) * scale(frame, b) }
        };
        DMatrix::from_fn(FRAMES, MONITORS, of)
    }

    #[test]
    fn a_part_with_more_noise_is_found_with_its_factor() {
        for (seed, factor) in [1.3, 1.3, 2.0, 5.0].into_iter().enumerate() {
            let scale = |frame: usize, _: usize| if PART.contains(&frame) { factor } else { 1.0 };
            let found = Levels::learn(&differences(seed as u64, normal, scale)).parts;
            let [Part { frames, factor: measured }] = &found[..] else { panic!("{found:?}") };
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
        assert_eq!(found.parts.len(), 2, "{found:?}");
        assert!((found.at(30) - 2.0).abs() < 0.15 && (found.at(215) - 3.0).abs() < 0.3 && found.at(100) == 1.0);
    }

    #[test]
    fn the_rest_may_be_the_smaller_part_and_a_recording_long_or_empty() {
        let quiet = |frame: usize, _: usize| if (150..200).contains(&frame) { 1.0 } else { 3.0 };
        let found = Levels::learn(&differences(6, normal, quiet));
        assert!(found.parts.len() <= 3 && found.at(170) == 1.0, "{found:?}");
        for frame in [50, 100, 250, 300] {
            assert!((found.at(frame) - 3.0).abs() < 0.3, "{frame}: {found:?}");
        }
        let mut random = StdRng::seed_from_u64(8);
        let long = DMatrix::from_fn(5000, 4, |frame, _| {
            normal(&mut random) * if (2003..2041).contains(&frame) { 3.0 } else { 1.0 }
        });
        let found = Levels::learn(&long).parts;
        assert_eq!(found.len(), 1, "{found:?}");
        // 38 frames of four differences tell the ends to a frame or two, in blocks of 13
        assert!(found[0].frames.start.abs_diff(2003) <= 4 && found[0].frames.end.abs_diff(2041) <= 4, "{found:?}");
        for (rows, columns) in [(0, 0), (0, 3), (3, 0), (1, 1), (50, 1)] {
            assert!(Levels::learn(&DMatrix::from_element(rows, columns, f64::NAN)).is_constant());
            assert!(Levels::learn(&DMatrix::zeros(rows, columns)).is_constant());
        }
    }

    /// What is added to noise of one level in a part of the recording: patterns of all monitors, each with amplitudes of its own.
    fn moved(seed: u64, patterns: usize, size: f64, part: &Range<usize>) -> DMatrix<f64> {
        let mut values = differences(seed, normal, |_, _| 1.0);
        let mut random = StdRng::seed_from_u64(seed + 1000);
        for k in 0..patterns {
            let shape = DVector::from_fn(MONITORS, |b, _| (1.7 * (k + 1) as f64 * b as f64 + k as f64).sin());
            let shape = shape.normalize() * (MONITORS as f64 / patterns as f64).sqrt();
            for frame in part.clone() {
                let mut row = values.row_mut(frame);
                row += shape.transpose() * (size * normal(&mut random));
            }
        }
        values
    }

    /// Noise of one level, tails, what monitors have in common, some noisy monitors, and a beam that moves in one to four patterns in a part: none is a level
    /// of the noise.
    #[test]
    fn anything_else_is_no_level() {
        let tails = |random: &mut StdRng| StudentT::new(4.0).unwrap().sample(random);
        let constant = |_: usize, _: usize| 1.0;
        let of_some = |some: usize, size: f64| {
            move |frame: usize, b: usize| if b < some && PART.contains(&frame) { size } else { 1.0 }
        };
        for seed in 0..20 {
            let mut cases = vec![
                differences(seed, normal, constant),
                differences(seed, tails, constant),
                differences(seed, normal, of_some(1, 12.0)),
                differences(seed, normal, of_some(MONITORS / 2, 3.0)),
                moved(seed, 1, 0.5, &(0..FRAMES)),
            ];
            cases.extend((1..=4).map(|patterns| moved(seed, patterns, 3.0, &PART)));
            for (k, case) in cases.iter().enumerate() {
                let found = Levels::learn(case);
                assert!(found.is_constant(), "case {k}, seed {seed}: {found:?}");
            }
        }
    }

    #[test]
    fn a_part_is_found_beside_what_is_none_and_beside_copied_frames() {
        let level = |frame: usize| if (240..300).contains(&frame) { 2.0 } else { 1.0 };
        let mut values = moved(9, 1, 4.0, &(60..120));
        for (frame, mut row) in values.row_iter_mut().enumerate() {
            row *= level(frame);
        }
        // the second frame of a run is the first once more
        values.row_mut(31).fill(1e-9);
        let found = Levels::learn(&values);
        assert!((found.at(270) - 2.0).abs() < 0.2 && found.at(90) == 1.0, "{found:?}");
    }
}
