//! The evidence of free amplitudes beside a fit whose unknowns adapt.

use evidence::{Evidence, Factor, gram, log_bayes_factor};
use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::sums::{Apart, Sums};
use crate::columns::beside;
use crate::fit::Fitted;
use crate::location::Location;

/// Free amplitudes at one place, and their evidence.
#[derive(Debug, Clone)]
pub struct Discrepancy {
    /// The place.
    pub at: Location,
    /// The recording that shows it.
    pub campaign: usize,
    /// `ln` Bayes factor over the fit.
    pub log_bayes: f64,
    /// Most likely standard deviation of the amplitudes [m at the monitors].
    pub size: f64,
    /// Places of the same sort.
    pub sites: usize,
    /// The fit's unknowns with these amplitudes, where the evidence for them is strong.
    pub adapted: Option<Adapted>,
}

/// The unknowns of a fit together with the free amplitudes, which are marginalised: step and covariance, to first order.
#[derive(Debug, Clone)]
pub struct Adapted {
    /// Step from the fit, in prior standard deviations.
    pub step: DVector<f64>,
    /// Covariance.
    pub covariance: DMatrix<f64>,
}

/// Standard deviations tried [m].
pub const SIZES: [f64; 8] = [20e-6, 40e-6, 80e-6, 160e-6, 320e-6, 640e-6, 1.28e-3, 2.56e-3];
/// `ln` Bayes factor above which the fit's unknowns are adapted.
const ASKED: f64 = 3.0;
/// Share of a Gram matrix' mean diagonal by which rounding may move its eigenvalues.
const SLACK: f64 = 1e-9;
/// A fit, linearised at its best point.
pub struct Linearised<'f> {
    pub fitted: &'f Fitted,
    /// `L^-1 (J^T r - u)`.
    pub slope: DVector<f64>,
    /// `ln` Bayes factor from which a place may count, so that the fit's unknowns are adapted.
    asked: f64,
}

impl<'f> Linearised<'f> {
    /// `least`: `ln` Bayes factor below which a place is of no account.
    pub fn from_fit(fitted: &'f Fitted, least: f64) -> Self {
        Self { fitted, slope: fitted.free.whiten(&fitted.slope), asked: least.max(ASKED) }
    }

    pub fn judge(&self, at: Location, sums: &Sums, sites: usize) -> Discrepancy {
        let (pull, gram) = (&sums.pull - &sums.cross * &self.slope, &sums.gram - gram(&sums.cross.transpose()));
        self.conclude(at, marginals(&pull, &gram), sites, &[sums])
    }

    /// The same of one amplitude for each monitor and each of some settings. As many as there are readings, they are taken monitor by
    /// monitor: with `D = 1 + omega^2 Z^T Z` of one, and `C = Z^T J L^-T`,
    ///
    /// `1 + omega^2 G = D - omega^2 C C^T`, whose determinant is `det D det B`, `B = 1 - omega^2 C^T D^-1 C`,
    ///
    /// and whose inverse `D^-1 + omega^2 D^-1 C B^-1 C^T D^-1`; `D`, `C^T D^-1 C` and the like are sums over the monitors.
    ///
    /// Where there are fewer amplitudes than unknowns of the fit, the one large matrix is the quicker way.
    pub fn judge_apart(&self, at: Location, each: &[Sums], apart: &[Apart], sites: usize) -> Discrepancy {
        if each.iter().map(|sums| sums.pull.len()).sum::<usize>() < self.fitted.u.len() {
            return self.judge(at, &Sums::stacked(each), sites);
        }
        self.taken_apart(at, each, apart, sites)
    }

    pub fn taken_apart(&self, at: Location, each: &[Sums], apart: &[Apart], sites: usize) -> Discrepancy {
        let sides: Vec<DMatrix<f64>> =
            each.iter().map(|sums| beside(sums.cross.clone(), &(&sums.pull - &sums.cross * &self.slope))).collect();
        let logs = SIZES.map(|size| self.marginal_apart(&sides, apart, size).unwrap_or(f64::NEG_INFINITY));
        self.conclude(at, logs, sites, &each.iter().collect::<Vec<_>>())
    }

    /// `ln` Bayes factor of one size; `sides` are `(C, g)` of each monitor.
    fn marginal_apart(&self, sides: &[DMatrix<f64>], apart: &[Apart], size: f64) -> Option<f64> {
        let (variance, p) = (size * size, self.slope.len());
        let (mut log_det, mut sum) = (0.0, DMatrix::zeros(p + 1, p + 1));
        for (sides, apart) in sides.iter().zip(apart) {
            let (of_one, inner) = apart.grown(variance, sides)?;
            log_det += of_one;
            sum += inner;
        }
        let after = Factor::of(DMatrix::identity(p, p) - sum.view((0, 0), (p, p)) * variance)?;
        log_det += after.log_determinant();
        let with_pull = sum.view((0, p), (p, 1));
        let pull = sum[(p, p)] + variance * with_pull.dot(&after.solve(&with_pull));
        Some(0.5 * (variance * pull - log_det))
    }

    /// Many monitors with one size, the fit's unknowns held: a lower limit of the evidence, as they would adapt.
    pub fn judge_held(&self, at: Location, each: &[&Sums]) -> Discrepancy {
        let mut logs = [0.0; SIZES.len()];
        for sums in each {
            logs.iter_mut().zip(SIZES).for_each(|(log, size)| *log += marginal(&sums.pull, &sums.gram, size));
        }
        self.conclude(at, logs, 1, each)
    }

    /// Of the `ln` Bayes factor of every size, with the adapted unknowns of the fit.
    fn conclude(&self, at: Location, logs: [f64; SIZES.len()], sites: usize, each: &[&Sums]) -> Discrepancy {
        // nothing gains more than all that the fit leaves
        let possible = |log: f64| if log <= 0.5 * self.fitted.cost { log } else { f64::NEG_INFINITY };
        let found = Discrepancy::averaged(at, logs.map(possible), sites);
        let adapted = (found.log_bayes > self.asked).then(|| self.adapted(each, found.size)).flatten();
        Discrepancy { adapted, ..found }
    }

    /// With `C = Z^T J` and `K = (Z^T Z + 1/omega^2)^-1`: covariance `(1 + J^T J - sum of C^T K C)^-1`, step `-cov sum of C^T K Z^T r`;
    /// the sums are taken with `J L^-T` for `J`.
    fn adapted(&self, each: &[&Sums], size: f64) -> Option<Adapted> {
        let unknowns = self.slope.len();
        let (mut taken, mut pull) = (DMatrix::zeros(unknowns, unknowns), DVector::zeros(unknowns));
        for sums in each {
            let mut gram = sums.gram.clone();
            (0..gram.ncols()).for_each(|i| gram[(i, i)] += 1.0 / (size * size));
            let factor = Factor::of(gram)?;
            let whitened = factor.whiten(&sums.cross);
            pull += whitened.tr_mul(&factor.whiten(&sums.pull));
            taken += whitened.transpose() * whitened;
        }
        let lower = self.fitted.free.lower();
        // all vars are free here, since one at a bound may leave it
        let slope = self.fitted.jacobian.tr_mul(&self.fitted.residual) - &self.fitted.u - &lower * pull;
        let factor = Factor::of(self.fitted.factor.matrix() - &lower * taken * lower.transpose())?;
        let step = factor.solve(&slope);
        // the cost of the best step holds the squares of the unknowns, and is no more than that of the fit; sums that are taken monitor by monitor can
        // be of no fit where monitors have nearly all noise in common
        let is_possible = (&self.fitted.u + &step).norm_squared() <= self.fitted.cost;
        is_possible.then(|| Adapted { step, covariance: factor.inverse() })
    }
}

impl Discrepancy {
    pub(crate) fn averaged(at: Location, logs: [f64; SIZES.len()], sites: usize) -> Self {
        let (best, largest) = logs
            .iter()
            .enumerate()
            .fold((0, f64::NEG_INFINITY), |best, (i, &log)| if log > best.1 { (i, log) } else { best });
        let mean = logs.iter().map(|log| (log - largest).exp()).sum::<f64>() / SIZES.len() as f64;
        Self { at, campaign: 0, log_bayes: largest + mean.ln(), size: SIZES[best], sites, adapted: None }
    }

    /// One of two forms of it, equally likely beforehand: the evidence is their mean, all else that of the better one.
    pub fn averaged_with(self, other: Self) -> Self {
        let (better, worse) = if other.log_bayes > self.log_bayes { (other, self) } else { (self, other) };
        let share = (worse.log_bayes - better.log_bayes).exp();
        Self { log_bayes: better.log_bayes + (0.5 * (1.0 + share)).ln(), ..better }
    }
}

/// [`marginal`] of every size. Where monitors have nearly all of their noise in common, sums that are taken monitor by monitor may make a Gram matrix with
/// negative eigenvalues: these directions are left out.
fn marginals(pull: &DVector<f64>, gram: &DMatrix<f64>) -> [f64; SIZES.len()] {
    let mut grown = gram.clone();
    let slack = SLACK * gram.trace() / gram.ncols().max(1) as f64;
    (0..grown.ncols()).for_each(|i| grown[(i, i)] += slack);
    if slack <= 0.0 || Factor::of(grown).is_some() {
        return SIZES.map(|size| marginal(pull, gram, size));
    }
    let SymmetricEigen { eigenvectors, eigenvalues } = gram.clone().symmetric_eigen();
    let along = eigenvectors.tr_mul(pull);
    SIZES.map(|size| {
        let along = along.iter().zip(&eigenvalues).filter(|(_, power)| **power > slack);
        along.map(|(pull, power)| Evidence::from_score(*pull, *power, size).log_bayes_factor).sum::<f64>()
    })
}

/// `ln` Bayes factor of free amplitudes of one standard deviation, given their projected pull and Gram matrix.
fn marginal(pull: &DVector<f64>, gram: &DMatrix<f64>, size: f64) -> f64 {
    log_bayes_factor(pull, gram, size).unwrap_or(f64::NEG_INFINITY)
}
