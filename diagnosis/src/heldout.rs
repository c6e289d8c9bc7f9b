//! Held-out frames: how well a hypothesis predicts frames that it was not fitted to.
//!
//! Frames are left out in folds, a frame never split: one repeat of every setting, or all frames of some correctors. The
//! hypothesis is fitted to the rest, by one Gauss-Newton step from its fit to all frames, and each left-out reading `z`, of a monitor or of
//! the tune meter, has a normal density: the mean is the prediction `h` plus the common terms of that instrument (baseline, calibration and the
//! like, `U`) as estimated from its kept readings with covariance `C`,
//!
//! `var = sigma^2 + u C u + d cov d`, `C = (1 + U^T U/sigma^2)^-1`, `d` the derivative of `h`, less its projection on the common terms.
//!
//! Where noise remembers the frames before, what the kept frames say of it in the left-out ones is taken off `z`, `u` and `d`, and `sigma^2` is
//! the variance that is left (`memory.rs`). What monitors have in common within a frame adds to that variance; that one
//! left-out reading tells of another in the same frame is not counted.
//!
//! The sum of the log densities is the expected log predictive density (elpd); a difference of two hypotheses has the
//! standard error of its mean over readings: given the model they are independent, also within a frame, and an effect of one corrector
//! has few frames and many readings.
//!
//! Source: A. Vehtari, A. Gelman and J. Gabry, Stat. Comput. 27 (2017) 1413, eq. 4 and 23.

use std::collections::BTreeMap;

use estimator::MonitorState;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use twin::Signature;

use super::data::Data;
use super::error::FitError;
use super::fit::Fitted;
use super::hypothesis::Hypothesis;
use super::memory::{Filter, Interpolation, Memory};
use inference::campaign::Settings;
use inference::campaign::TUNE_CALIBRATION;
use inference::recording::Recording;

/// Frames that are left out together.
pub type Fold = Vec<usize>;

/// Number of standard errors by which the prediction of held-out frames has to improve.
pub const VALIDATED: f64 = 2.0;
/// Folds at most.
const FOLDS: usize = 5;

/// One repeat of every setting in each fold.
pub fn by_repeat(settings: &Settings) -> Vec<Fold> {
    let mut seen: BTreeMap<_, (usize, usize)> = BTreeMap::new();
    let mut folds = vec![Fold::new(); FOLDS];
    for (i, setting) in settings.of_frame.iter().enumerate() {
        let known = seen.len();
        // a frame of no setting is one without repeats
        let (setting, repeat) = seen.entry(setting.ok_or(i)).or_insert((known, 0));
        // settings begin in different folds, so that those without repeats are spread over all folds
        folds[(*setting + *repeat) % FOLDS].push(i);
        *repeat += 1;
    }
    folds.retain(|fold| !fold.is_empty());
    folds
}

/// All frames of every fifth corrector in each fold; frames in which several are set go with the first of them. None of a
/// recording that names no correctors.
pub fn by_corrector(recording: &Recording) -> Vec<Fold> {
    let mut order: Vec<usize> = Vec::new();
    let mut folds = vec![Fold::new(); FOLDS];
    for (i, row) in recording.rows.iter().enumerate() {
        let Some(&(corrector, _)) = row.correctors.first() else { continue };
        let at = order.iter().position(|known| *known == corrector).unwrap_or_else(|| {
            order.push(corrector);
            order.len() - 1
        });
        folds[at % FOLDS].push(i);
    }
    folds.retain(|fold| !fold.is_empty());
    folds
}

/// The held-out predictions of a hypothesis, scored.
#[derive(Debug, Clone)]
pub struct Score {
    /// Log density of each reading, rows frames, columns monitors and the two tunes; 0 for one that does not count.
    pub log_density: DMatrix<f64>,
    /// Readings of monitors and of the tune meter.
    pub readings: usize,
    /// Rms of measured minus predicted, monitors in state ok [m].
    pub rms: f64,
    /// Fraction of readings within the central 68.3 % and 95.4 % of their density.
    pub inside: [f64; 2],
}

impl Score {
    /// Score a hypothesis that has been fitted to all frames.
    ///
    /// # Errors
    /// [`FitError`].
    pub fn of(data: &Data, fitted: &Fitted, folds: &[Fold]) -> Result<Self, FitError> {
        let monitors = data.readings.ncols();
        let log_density = DMatrix::zeros(data.readings.nrows(), monitors + 2);
        let mut score = Self { log_density, readings: 0, rms: 0.0, inside: [0.0; 2] };
        let (mut squares, mut plain) = (0.0, 0usize);
        let data = fitted.data(data);
        let linear = Linear::of(data, fitted)?;
        for fold in folds {
            for left in linear.predict(data, fold)? {
                let z = left.innovation / left.variance.sqrt();
                score.log_density[(left.frame, left.column)] -=
                    0.5 * (z * z + (core::f64::consts::TAU * left.variance).ln());
                score.readings += 1;
                score.inside[0] += f64::from(u8::from(z.abs() < 1.0));
                score.inside[1] += f64::from(u8::from(z.abs() < 2.0));
                if left.column < monitors && data.health()[left.column].state == MonitorState::Ok {
                    squares += left.innovation.powi(2);
                    plain += 1;
                }
            }
        }
        score.rms = (squares / plain.max(1) as f64).sqrt();
        score.inside = score.inside.map(|n| n / score.readings.max(1) as f64);
        Ok(score)
    }

    /// Expected log predictive density.
    pub fn elpd(&self) -> f64 {
        self.log_density.iter().sum()
    }

    /// Gain over another, and its standard error.
    pub fn gain_over(&self, other: &Self) -> (f64, f64) {
        let pairs = self.log_density.iter().zip(&other.log_density);
        let gains: Vec<f64> = pairs.filter(|(one, _)| **one != 0.0).map(|(one, other)| one - other).collect();
        let n = gains.len() as f64;
        let gain: f64 = gains.iter().sum();
        let spread: f64 = gains.iter().map(|g| (g - gain / n).powi(2)).sum();
        (gain, (spread * n / (n - 1.0).max(1.0)).sqrt())
    }
}

/// One reading that was left out.
struct Left {
    frame: usize,
    column: usize,
    innovation: f64,
    variance: f64,
}

/// One column of a frame, a monitor or a tune: kept frames, left-out ones, noise and what it remembers, and the common terms of their
/// readings, in standard deviations.
struct Column {
    index: usize,
    kept: Vec<usize>,
    out: Vec<usize>,
    sigma: f64,
    memory: Memory,
    shared: [DMatrix<f64>; 2],
}

/// What its noise is to be expected to be in the left-out frames.
struct Expectation {
    sigma: f64,
    known: Option<(Filter, Interpolation)>,
    /// Variance of each left-out frame's noise about that, in units of `sigma`'s.
    variances: Vec<f64>,
}

impl Expectation {
    fn of(column: &Column) -> Self {
        let Column { kept, out, sigma, memory, .. } = column;
        let origin = kept.iter().chain(out).copied().min().unwrap_or(0);
        let remembers = !memory.is_none();
        let known =
            remembers.then(|| (Filter::of(*memory, origin, kept), Interpolation::of(*memory, origin, kept, out)));
        let variances = known.as_ref().map_or_else(|| vec![1.0; out.len()], |(_, at)| at.variances(*memory));
        Self { sigma: *sigma, known, variances }
    }

    /// Rows of the kept and of the left-out frames, both in units of `sigma`: the first whitened, the others less what is to be
    /// expected of them.
    fn apart(&self, kept: DMatrix<f64>, out: DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
        let (mut kept, mut out) = (kept / self.sigma, out / self.sigma);
        if let Some((filter, interpolation)) = &self.known {
            out -= interpolation.expected(&kept);
            filter.whiten_columns(&mut kept);
        }
        (kept, out)
    }
}

/// All of them of which readings are left out.
fn columns(all: &Data, kept: &Data, fold: &Fold) -> Vec<Column> {
    let monitor = |b: usize| {
        let out: Vec<usize> = fold.iter().copied().filter(|&i| all.counts(i, b)).collect();
        let shared = [kept.shared(b, kept.frames(b)), kept.shared(b, &out)];
        let (own, memory, growth) = kept.noise_of(b);
        Column { index: b, kept: kept.frames(b).to_vec(), out, sigma: own * growth.sqrt(), memory, shared }
    };
    let tune = |plane: usize| {
        let noise = kept.tune_noise(plane)?;
        let out: Vec<usize> = all.tune_frames(plane).into_iter().filter(|i| fold.contains(i)).collect();
        let kept = kept.tune_frames(plane);
        let shared = [kept.len(), out.len()].map(|n| DMatrix::from_element(n, 1, TUNE_CALIBRATION));
        Some(Column { index: all.readings.ncols() + plane, kept, out, sigma: noise, memory: Memory::NONE, shared })
    };
    let monitors = all.active_monitors().into_iter().map(monitor);
    monitors.chain([0, 1].into_iter().filter_map(tune)).filter(|column| !column.out.is_empty()).collect()
}

/// A fit to all frames, linearised.
struct Linear<'f> {
    fitted: &'f Fitted,
    /// Derivatives of the predictions with respect to every u.
    slopes: Vec<Signature>,
    /// The same, columns monitors and tunes, rows frames.
    by_frame: Vec<DMatrix<f64>>,
    /// Readings and tunes less those predicted.
    miss: DMatrix<f64>,
}

impl<'f> Linear<'f> {
    fn of(data: &Data, fitted: &'f Fitted) -> Result<Self, FitError> {
        let slopes = fitted.slopes(data)?;
        let by_frame = slopes.iter().map(|slope| slope.clone().by_frame(&data.drives.time)).collect();
        Ok(Self { fitted, miss: data.miss(&fitted.predicted(data)?), slopes, by_frame })
    }

    /// The step from the fit to all frames to that to the kept ones, and the factor of the latter's precision.
    fn step(&self, kept: &Data) -> Result<(DVector<f64>, Cholesky<f64, Dyn>), FitError> {
        let columns: Vec<DVector<f64>> = self.slopes.iter().map(|slope| kept.signature(slope)).collect();
        let jacobian = DMatrix::from_columns(&columns);
        let back = jacobian.transpose();
        let normal = DMatrix::identity(columns.len(), columns.len()) + &back * jacobian;
        let factor = normal.cholesky().ok_or(FitError::Degenerate)?;
        let slope = back * self.fitted.residual_of(kept)? - &self.fitted.u;
        Ok((factor.solve(&slope), factor))
    }

    /// Predict the left-out readings by a fit to the kept ones.
    fn predict(&self, all: &Data, fold: &Fold) -> Result<Vec<Left>, FitError> {
        let kept = &all.without(fold);
        let (step, factor) = self.step(kept)?;
        let mut left = Vec::new();
        for column in columns(all, kept, fold) {
            let at = column.index;
            let expectation = Expectation::of(&column);
            let rows =
                |frames: &[usize]| DMatrix::from_fn(frames.len(), step.len(), |i, p| self.by_frame[p][(frames[i], at)]);
            let miss = |frames: &[usize]| DMatrix::from_fn(frames.len(), 1, |i, _| self.miss[(frames[i], at)]);
            let Column { kept, out, shared: [u_in, u_out], .. } = &column;
            let (u_in, u_out) = expectation.apart(u_in.clone(), u_out.clone());
            let (slopes_in, slopes_out) = expectation.apart(rows(kept), rows(out));
            let (known, left_out) = expectation.apart(miss(kept), miss(out));
            let (known, left_out) = (known - &slopes_in * &step, left_out - &slopes_out * &step);
            let mut normal = u_in.tr_mul(&u_in);
            (0..normal.ncols()).for_each(|i| normal[(i, i)] += 1.0);
            let Some(normal) = normal.cholesky() else { continue };
            // the factors of the common terms, fitted to the kept readings: of the residual and of each derivative
            let innovation = left_out - &u_out * normal.solve(&u_in.tr_mul(&known));
            let d = slopes_out - &u_out * normal.solve(&(u_in.transpose() * slopes_in));
            let lower = |factor: &Cholesky<f64, Dyn>, rows: &DMatrix<f64>| {
                factor.l_dirty().solve_lower_triangular(&rows.transpose()).unwrap_or_else(|| rows.transpose() * 0.0)
            };
            let (unknown, params) = (lower(&normal, &u_out), lower(&factor, &d));
            for (i, &frame) in out.iter().enumerate() {
                let noise = expectation.variances[i];
                let variance = noise + unknown.column(i).norm_squared() + params.column(i).norm_squared();
                let sigma = expectation.sigma;
                left.push(Left {
                    frame,
                    column: at,
                    innovation: innovation[i] * sigma,
                    variance: variance * sigma * sigma,
                });
            }
        }
        Ok(left)
    }
}

/// The same fit without its effects, what is ordinary being of the same size.
///
/// # Errors
/// [`FitError`].
pub fn bare(data: &Data, fitted: &Fitted) -> Result<Fitted, FitError> {
    from_near_or_far(data, fitted, Hypothesis { terms: Vec::new(), ..fitted.hypothesis.clone() })
}

/// The same fit without one of its terms.
///
/// # Errors
/// [`FitError`].
pub fn reduced(data: &Data, fitted: &Fitted, term: usize) -> Result<Fitted, FitError> {
    from_near_or_far(data, fitted, fitted.hypothesis.without(term))
}

/// The fit of another hypothesis: vars that are stable with an effect may be unstable without it, and so may ordinary imperfections that grow
/// in its place.
fn from_near_or_far(data: &Data, fitted: &Fitted, other: Hypothesis) -> Result<Fitted, FitError> {
    let far = DVector::zeros(fitted.params.len());
    let stable = |fitted: &Fitted| fitted.is_stable(data);
    let near = Fitted::of(data, &other, &fitted.guess(data, &other)).ok().filter(stable);
    let other_than_near = || Fitted::of(data, &other, &far).ok().filter(stable);
    let bare = Hypothesis { ordinary: Vec::new(), ..other.clone() };
    near.or_else(other_than_near).map_or_else(|| Fitted::of(data, &bare, &far), Ok)
}
