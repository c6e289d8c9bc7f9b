//! Patterns that monitors share within a frame and that nothing is known of: factor analysis, and its evidence.
//!
//! Whitened differences of a frame are `z = F y + G x + e`, with known patterns F, unknown ones G, amplitudes y and x standard normal in each
//! frame, and noise e of each monitor by itself, of an unknown variance. With the prior `G ~ N(0, omega^2)` of every element, and
//! posteriors of amplitudes and patterns that are taken as independent of each other, a lower limit of `ln` evidence has a closed form:
//!
//! `L = sum over readings of <ln p(z|x, G)> - KL(x) - KL(G) - KL(e)`.
//!
//! The variance of a monitor's own noise counts as known by a few differences of variance 1, of which the inverse gamma prior makes its part of L, with `n`
//! differences and their mean square `<|z - F y - G x|^2>` summed to q, `-(OWN + n)/2 ln((OWN + q)/(OWN + n))` up to a constant. Estimated as a point,
//! it would shrink to nothing where chance makes all of a monitor's few differences small, and a pattern would gain by that. Each step of the fit (the amplitudes of each frame, the pattern at each monitor, its own noise) raises L. Readings that are missing are left
//! out of the sums. As a lower limit it never overstates a pattern; a pattern that is not needed shrinks to zero.
//!
//! Source: C. M. Bishop, Variational principal components, ICANN (1999) 509; Z. Ghahramani and M. J. Beal, Variational inference for Bayesian
//! mixtures of factor analysers, NIPS 12 (2000) 449.

use nalgebra::{DMatrix, DVector};

use super::columns::beside;

/// A fit of unknown patterns beside known ones.
#[derive(Debug, Clone)]
pub struct Factors {
    /// The unknown patterns: rows monitors, in units of the differences.
    pub patterns: DMatrix<f64>,
    /// Lower limit of `ln` evidence, up to a constant.
    pub log_evidence: f64,
}

/// Prior standard deviations of a pattern's elements that are tried, in units of the noise.
const WIDTHS: [f64; 4] = [0.1, 0.2, 0.4, 0.8];
/// Most steps, and the gain by one that ends them.
const STEPS: usize = 150;
const SETTLED: f64 = 3e-3;
/// Differences of variance 1 that the prior of a monitor's own noise counts as, and the least variance with which the fit begins.
const OWN: f64 = 2.0;
const LEAST: f64 = 0.1;

/// What is fitted.
struct Fit<'s> {
    seen: &'s Seen,
    /// How many of the columns are known.
    known: usize,
    /// Prior variance of the others.
    variance: f64,
    /// Means of all patterns, the known ones first.
    mean: DMatrix<f64>,
    /// Covariance of the unknown ones at each monitor.
    covariance: Vec<DMatrix<f64>>,
    /// Variance of each monitor's own noise.
    own: Vec<f64>,
}

/// Differences of the frames that have some.
pub struct Seen {
    /// 0 where there is none, rows frames.
    differences: DMatrix<f64>,
    /// The monitors without a difference in each frame.
    missing: Vec<Vec<usize>>,
    /// Number of differences of each monitor, and the sum of their squares.
    count: Vec<f64>,
    square: Vec<f64>,
}

/// Sums over the frames of a monitor: its differences times the amplitudes, and products of the amplitudes.
struct Sums {
    cross: DVector<f64>,
    amplitudes: DMatrix<f64>,
}

impl Seen {
    /// From differences, rows frames, columns monitors, not a number where there is none.
    pub fn from_differences(differences: &DMatrix<f64>) -> Self {
        let monitors = differences.ncols();
        let is_seen = |frame: &usize| differences.row(*frame).iter().any(|z| !z.is_nan());
        let frames: Vec<usize> = (0..differences.nrows()).filter(is_seen).collect();
        let mut seen = differences.select_rows(&frames);
        let is_missing = |row: usize| (0..monitors).filter(|&b| seen[(row, b)].is_nan()).collect::<Vec<usize>>();
        let missing: Vec<Vec<usize>> = (0..frames.len()).map(is_missing).collect();
        seen.iter_mut().filter(|z| z.is_nan()).for_each(|z| *z = 0.0);
        let mut count = vec![frames.len() as f64; monitors];
        missing.iter().flatten().for_each(|&b| count[b] -= 1.0);
        let square = seen.column_iter().map(|column| column.norm_squared()).collect();
        Self { differences: seen, missing, count, square }
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.missing.len()
    }
}

impl Factors {
    /// Fit unknown patterns near some `start` beside known ones; the evidence is the mean over the widths of the prior.
    pub fn learn(seen: &Seen, known: &DMatrix<f64>, start: &DMatrix<f64>) -> Self {
        let widths = if start.ncols() == 0 { &WIDTHS[..1] } else { &WIDTHS[..] };
        let fits: Vec<Self> = widths.iter().map(|width| Fit::new(seen, known, start, *width).run()).collect();
        let largest = fits.iter().map(|fit| fit.log_evidence).fold(f64::NEG_INFINITY, f64::max);
        let mean = fits.iter().map(|fit| (fit.log_evidence - largest).exp()).sum::<f64>() / fits.len() as f64;
        let best = fits.into_iter().max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence)).expect("there are widths");
        Self { log_evidence: largest + mean.ln(), ..best }
    }
}

impl<'s> Fit<'s> {
    fn new(seen: &'s Seen, known: &DMatrix<f64>, start: &DMatrix<f64>, width: f64) -> Self {
        let (monitors, unknown) = (known.nrows(), start.ncols());
        let mean = beside(known.clone(), start);
        let own = mean.row_iter().map(|row| (1.0 - row.norm_squared()).max(LEAST)).collect();
        let covariance = vec![DMatrix::zeros(unknown, unknown); monitors];
        Self { seen, known: known.ncols(), variance: width * width, mean, covariance, own }
    }

    fn run(mut self) -> Factors {
        let mut log_evidence = f64::NEG_INFINITY;
        for _ in 0..STEPS {
            let before = log_evidence;
            log_evidence = self.step();
            if log_evidence < before + SETTLED {
                break;
            }
        }
        Factors { patterns: self.mean.columns_range(self.known..).into_owned(), log_evidence }
    }

    /// `<g g^T>` of a monitor.
    fn square(&self, b: usize) -> DMatrix<f64> {
        let row = self.mean.row(b);
        let mut square = row.transpose() * row;
        let mut unknown = square.view_range_mut(self.known.., self.known..);
        unknown += &self.covariance[b];
        square
    }

    /// One step of everything; returns the limit after it.
    fn step(&mut self) -> f64 {
        let (sums, of_amplitudes) = self.amplitudes();
        let of_monitors: f64 = sums.iter().enumerate().map(|(b, sums)| self.take(b, sums)).sum();
        of_amplitudes + of_monitors
    }

    /// Amplitudes of all frames: sums for the monitors, and minus their divergence from the prior.
    fn amplitudes(&self) -> (Vec<Sums>, f64) {
        let (monitors, all) = self.mean.shape();
        let weights: Vec<DMatrix<f64>> = (0..monitors).map(|b| self.square(b) / self.own[b]).collect();
        let of_all = weights.iter().fold(DMatrix::identity(all, all), |sum: DMatrix<f64>, one| sum + one);
        let mut weighted = self.mean.clone();
        weighted.row_iter_mut().zip(&self.own).for_each(|(mut row, own)| row /= *own);
        let pull = &self.seen.differences * weighted;
        let mut means = DMatrix::zeros(pull.nrows(), all);
        let (mut total, mut missed) = (DMatrix::zeros(all, all), vec![DMatrix::zeros(all, all); monitors]);
        let mut log = 0.0;
        for (frame, missing) in self.seen.missing.iter().enumerate() {
            let mut normal = of_all.clone();
            missing.iter().for_each(|&b| normal -= &weights[b]);
            let Some(factor) = normal.cholesky() else { continue };
            let mean = factor.solve(&pull.row(frame).transpose());
            let square = factor.inverse() + &mean * mean.transpose();
            log +=
                0.5 * (all as f64 - square.trace()) - factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
            missing.iter().for_each(|&b| missed[b] += &square);
            means.set_row(frame, &mean.transpose());
            total += square;
        }
        let cross = self.seen.differences.tr_mul(&means);
        let sums = |(b, missed)| Sums { cross: cross.row(b).transpose(), amplitudes: &total - missed };
        (missed.into_iter().enumerate().map(sums).collect(), log)
    }

    /// Pattern and own noise of a monitor; its part of the limit.
    fn take(&mut self, b: usize, sums: &Sums) -> f64 {
        let (count, squares) = (self.seen.count[b], self.seen.square[b]);
        if count == 0.0 {
            return 0.0;
        }
        let (known, unknown) = (self.known, self.covariance[b].nrows());
        let inner = sums.amplitudes.view_range(known.., known..) / self.own[b];
        let normal = DMatrix::identity(unknown, unknown) / self.variance + inner;
        let Some(factor) = normal.cholesky() else { return f64::NEG_INFINITY };
        let of_known = self.mean.row(b).columns_range(..known).transpose();
        let off = sums.amplitudes.view_range(known.., ..known) * of_known;
        let mean = factor.solve(&((sums.cross.rows_range(known..) - off) / self.own[b]));
        self.mean.row_mut(b).columns_range_mut(known..).copy_from(&mean.transpose());
        self.covariance[b] = factor.inverse();
        let (square, row) = (self.square(b), self.mean.row(b));
        let left = squares - 2.0 * (row * &sums.cross)[0] + square.component_mul(&sums.amplitudes).sum();
        self.own[b] = (OWN + left) / (OWN + count);
        let log_det = -2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let prior = square.view_range(known.., known..).trace() / self.variance;
        let of_pattern = 0.5 * (log_det + unknown as f64 * (1.0 - self.variance.ln()) - prior);
        of_pattern - 0.5 * (OWN + count) * self.own[b].ln()
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::StdRng;

    use super::*;
    use crate::testing::normal;

    const FRAMES: usize = 240;
    const MONITORS: usize = 30;

    /// Differences with some patterns in common, a tenth of them missing.
    fn differences(frames: usize, patterns: &DMatrix<f64>, random: &mut StdRng) -> Seen {
        let mut all = DMatrix::zeros(frames, patterns.nrows());
        for mut row in all.row_iter_mut() {
            let x = DVector::from_fn(patterns.ncols(), |_, _| normal(random));
            let common = patterns * x;
            row.iter_mut().zip(common.iter()).for_each(|(z, common)| *z = common + normal(random));
        }
        all.iter_mut().skip(3).step_by(10).for_each(|z| *z = f64::NAN);
        Seen::from_differences(&all)
    }

    fn start(random: &mut StdRng, columns: usize) -> DMatrix<f64> {
        DMatrix::from_fn(MONITORS, columns, |_, _| 0.3 * normal(random))
    }

    /// A campaign that goes back to 0 A after every setting has few neighbours of one setting. Were each monitor's own noise the most likely one, some of
    /// these would gain up to 6 nat.
    #[test]
    fn few_frames_of_many_monitors_have_no_pattern() {
        let mut random = StdRng::seed_from_u64(3);
        let none = DMatrix::zeros(48, 0);
        for frames in [2, 3].repeat(12) {
            let z = differences(frames, &none, &mut random);
            let nothing = Factors::learn(&z, &none, &none).log_evidence;
            let svd = z.differences.clone().svd(false, true);
            let begun = svd.v_t.unwrap().transpose() * DMatrix::from_diagonal(&(svd.singular_values / frames as f64));
            for columns in 1..=2 {
                let start = begun.columns(0, columns).into_owned();
                let gain = Factors::learn(&z, &none, &start).log_evidence - nothing;
                assert!(gain < 0.0, "{frames} {columns}: {gain}");
            }
        }
    }

    #[test]
    fn a_pattern_is_found_with_readings_missing() {
        let mut random = StdRng::seed_from_u64(1);
        let truth = DMatrix::from_fn(MONITORS, 1, |b, _| 0.7 * (1.3 * b as f64).cos());
        let z = differences(FRAMES, &truth, &mut random);
        let none = DMatrix::zeros(MONITORS, 0);
        let found = Factors::learn(&z, &none, &start(&mut random, 1));
        let nothing = Factors::learn(&z, &none, &none);
        assert!(found.log_evidence > nothing.log_evidence + 50.0);
        let (one, other) = (found.patterns.column(0), truth.column(0));
        let cosine = one.dot(&other).abs() / (one.norm() * other.norm());
        // each element has an error of 1/sqrt(216) or a little more: sin^2 = 30/216/7.3 or so
        assert!(cosine > 0.985, "{cosine}");
        // known, it is not found again
        let beside = Factors::learn(&z, &truth, &start(&mut random, 1)).log_evidence;
        assert!(beside < Factors::learn(&z, &truth, &none).log_evidence + 1.0);
    }

    #[test]
    fn noise_alone_has_no_pattern() {
        let mut random = StdRng::seed_from_u64(2);
        let none = DMatrix::zeros(MONITORS, 0);
        for _ in 0..20 {
            let z = differences(FRAMES, &none, &mut random);
            let nothing = Factors::learn(&z, &none, &none).log_evidence;
            for columns in 1..3 {
                let gain = Factors::learn(&z, &none, &start(&mut random, columns)).log_evidence - nothing;
                assert!(gain < 1.0, "{gain}");
            }
        }
    }
}
