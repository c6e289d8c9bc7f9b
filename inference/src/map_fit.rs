//! The batch fit: all frames at once in f64, predicted by the twin itself; the maximum a posteriori (MAP) of the params.
//!
//! Exact optics at every step, each frame with its own read-backs, baselines eliminated by the normal equations, measured tunes as
//! readings:
//!
//! `chi2 = sum of (reading - baseline_b - predicted)^2/variance + sum of (tune - predicted)^2/variance + sum of (theta - prior)^2/sigma^2`,
//!
//! minimised by damped Gauss-Newton within the range of the params. A baseline follows the supplies and the RF frequency
//! ([`Campaign::following`], spurious dispersion): `baseline_b + sum of u_bf following_bf`, with the squares of the unknown `u_bf` added
//! to chi-square; they are eliminated as the baselines are. A design that is not exact has a few amplitudes more ([`BaseModel`]).

use core::fmt;

use estimator::{FitQuality, Marginal};
use nalgebra::{DMatrix, DVector, Vector2};
use twin::{CalibratedOptics, Measured, OrbitError, Tunes, Twiss};

use crate::base_model::{BaseModel, BaseTerm, FittedTerm};
use crate::campaign::{AtTimes, Campaign, Normal, Terms, Weighed, chi_square};
use crate::imperfection::Imperfection;
use crate::optimise::{End, Limits, Objective, OptimiseError, Optimum, Quadratic, minimise};
use crate::prior::Prior;

/// The batch result for one campaign.
#[derive(Debug, Clone)]
pub struct BatchFit {
    /// MAP of each `theta = ln var`, within the prior's range.
    pub map_params: Vec<f64>,
    /// Covariance of theta, whatever the base model's terms are.
    pub covariance: DMatrix<f64>,
    /// Marginal of each theta.
    pub marginals: Vec<Marginal>,
    /// Sum of (residual / expected noise)^2 over readings of monitors in state ok, per degree of freedom (readings less baselines, less
    /// what readings tell of how these follow supplies and RF, less params); not a number without any.
    pub chi2_per_dof: f64,
    /// True if that is more than noise explains, by the rule of the core.
    pub mismatch: bool,
    /// Tunes x and y at the MAP, and as measured.
    pub tunes: [FittedTune; 2],
    /// Why the orbits do not constrain the params, if so: the result is then the prior, but for measured tunes.
    pub lack: Option<Lack>,
    /// What the design is off by, of the terms that were fitted.
    pub base: Vec<FittedTerm>,
    /// The base model that was fitted.
    pub base_model: BaseModel,
    /// Gauss-Newton steps taken.
    pub steps: usize,
}

/// One tune of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedTune {
    /// Of the ring at the MAP.
    pub model: f64,
    /// Mean of what was measured, with the model's integer part, and its standard deviation, the meter's calibration included.
    pub measured: Option<(f64, f64)>,
}

impl FittedTune {
    /// Measured less the model's, in standard deviations of the measured one.
    pub fn pull(&self) -> Option<f64> {
        self.measured.map(|(tune, sigma)| (tune - self.model) / sigma)
    }
}

/// Why the orbits of a campaign do not constrain the params.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lack {
    /// No monitor has a reading that counts.
    Readings,
    /// No kick and no RF offset moved the beam by more than its readings scatter.
    Kick,
}

impl fmt::Display for Lack {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Readings => "no monitor has a reading that counts",
            Self::Kick => "kicks and RF offsets move the beam by too little to tell anything",
        })
    }
}

/// What counts as a reading beside the monitors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TuneUse {
    /// Measured tunes are readings.
    #[default]
    Readings,
    /// They are left out, and only stand beside the model's.
    LeftOut,
}

/// Why there is no batch result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BatchError {
    /// The campaign cannot be assembled, or there is no stable ring where the fit begins.
    #[error("no stable ring: {0}")]
    Orbit(#[from] OrbitError),
    /// The steps did not settle.
    #[error("no minimum after {steps} steps; the last one moved the vars by {moved:.2e} standard deviations")]
    NotConverged {
        /// Steps taken.
        steps: usize,
        /// Length of the last step, in standard deviations.
        moved: f64,
    },
    /// The normal matrix is not positive.
    #[error("the readings and the prior do not determine the vars")]
    Degenerate,
}

impl From<OptimiseError<OrbitError>> for BatchError {
    fn from(error: OptimiseError<OrbitError>) -> Self {
        match error {
            OptimiseError::Start(error) => Self::Orbit(error),
            OptimiseError::Degenerate => Self::Degenerate,
        }
    }
}

const LIMITS: Limits = Limits { settled: 1e-5, steps: 30, halvings: 8 };
/// Squared length of the last step, in standard deviations, that is small beside the error bars: for readings that no ring explains,
/// whose steps shrink slowly.
const CLOSE: f64 = 0.01 * 0.01;
/// Share of a param's prior standard deviation that orbits have to take away from one of them, to say anything: the scatter of idle
/// correctors takes some percent.
const LEARNT: f64 = 0.1;

impl BatchFit {
    /// Fit a campaign; `progress` hears of each step.
    ///
    /// # Errors
    /// [`BatchError`].
    pub fn best(
        campaign: &Campaign,
        tunes: TuneUse,
        base: BaseModel,
        mut progress: impl FnMut(usize),
    ) -> Result<Self, BatchError> {
        let problem = Problem { campaign, tunes, base, prior: base.prior(&campaign.prior) };
        // not the screening's params: a kick constant that is off may have pulled them next to another tune
        let start = campaign.prior.mean.clone().resize_vertically(problem.prior.len(), 0.0);
        let watch = |steps, _| {
            progress(steps);
            true
        };
        let found = minimise(&problem, &start, &problem.prior.range, &LIMITS, watch)?;
        if found.end == End::Exhausted && found.expected > CLOSE {
            return Err(BatchError::NotConverged { steps: found.steps, moved: found.expected.max(0.0).sqrt() });
        }
        problem.result(&found)
    }
}

/// Optics functions of a fit, and their standard deviations.
pub type OpticsFunctions = (CalibratedOptics, (Vec<Twiss>, Tunes));

impl BatchFit {
    /// Theta and, after it, the amplitudes of the base model's terms.
    pub(crate) fn values(&self) -> Vec<f64> {
        let amplitudes = self.base.iter().map(|fitted| fitted.measured.value);
        self.map_params.iter().copied().chain(amplitudes).collect()
    }

    /// What the design is off by, as rows of the table of imperfections.
    pub fn imperfections(&self) -> Vec<Imperfection> {
        self.base.iter().map(FittedTerm::imperfection).collect()
    }

    /// The optics of the ring as fitted, at the campaign's mean supplies, `sigma^2 = J C J^T`.
    ///
    /// # Errors
    /// [`OrbitError`] of unstable motion.
    pub fn optics(&self, campaign: &Campaign) -> Result<OpticsFunctions, OrbitError> {
        let optics = CalibratedOptics::of(&campaign.ring, &self.map_params, &campaign.supplies)?;
        let sigma = optics.sigma(&self.covariance);
        Ok((optics, sigma))
    }
}

/// One campaign and how it is to be read.
struct Problem<'c> {
    campaign: &'c Campaign,
    tunes: TuneUse,
    base: BaseModel,
    /// Of the params and, after them, of the base model's terms.
    prior: Prior,
}

/// What a fit knows at given params.
struct Point {
    quadratic: Quadratic,
    /// Half the second derivative without the tunes.
    of_orbits: DMatrix<f64>,
    /// Chi-square of the monitors in state ok by their expected noise, and its degrees of freedom.
    chi2: (f64, f64),
    tunes: Tunes,
}

impl Objective for Problem<'_> {
    type Point = Point;
    type Slopes = ();
    type Error = OrbitError;

    fn evaluate(&self, params: &DVector<f64>) -> Result<(f64, Point), OrbitError> {
        let linearised = self.campaign.linearised(self.base, params)?;
        let (mut normal, chi2) = self.orbits(params, &linearised);
        let (_, of_orbits) = normal.eliminated();
        if self.tunes == TuneUse::Readings {
            self.add_tunes(&mut normal, &linearised);
        }
        let (cost, quadratic) = normal.eliminated();
        Ok((cost, Point { quadratic, of_orbits: of_orbits.matrix, chi2, tunes: linearised.at_mean.tunes }))
    }

    fn linearise(&self, _: &DVector<f64>, point: &Point) -> Result<(Quadratic, ()), OrbitError> {
        Ok((point.quadratic.clone(), ()))
    }
}

impl Problem<'_> {
    /// Add up all readings that count.
    fn orbits(&self, params: &DVector<f64>, linearised: &AtTimes) -> (Normal, (f64, f64)) {
        let campaign = self.campaign;
        let (orbits, slopes) = (linearised.orbits(&campaign.drives), linearised.slopes(&campaign.drives));
        let baselines = campaign.times.count();
        let common = Terms { count: baselines + 1 + campaign.supplies.len(), baselines, precision: 0.0 };
        let mut normal = Normal::new(&self.prior, params, campaign.monitors(), common);
        let (mut chi2, mut freedom) = (0.0, -(params.len() as f64));
        for (b, slopes) in slopes.iter().enumerate() {
            let terms = campaign.terms(b);
            let frames: Vec<usize> = (0..campaign.frames()).filter(|&i| campaign.counts(i, b)).collect();
            let residual = campaign.readings.column(b) - orbits.column(b);
            let mut readings = vec![(b, Weighed::none(common.count)); campaign.frames()];
            for &i in &frames {
                readings[i].1 = Weighed::one(terms.column(i).as_slice(), residual[i], campaign.noise(b).powi(-2));
            }
            normal.add(slopes, &readings);
            if campaign.is_ok(b) {
                let (residual, terms) = (residual.select_rows(&frames), terms.select_columns(&frames));
                let of_monitor = chi_square(&residual, &terms, baselines, campaign.recording.header.noise[b]);
                (chi2, freedom) = (chi2 + of_monitor.0, freedom + of_monitor.1);
            }
        }
        (normal, (chi2, freedom))
    }

    /// The two whitened numbers of each meter: the tune and its change, which no constant ring has.
    fn add_tunes(&self, normal: &mut Normal, linearised: &AtTimes) {
        let tunes = [linearised.at_mean.tunes.x, linearised.at_mean.tunes.y];
        for (plane, meter) in self.campaign.meters.iter().enumerate() {
            let Some(meter) = meter else { continue };
            let miss = meter.miss(Vector2::new(tunes[plane], 0.0));
            let slope = linearised.at_mean.tune_slopes.row(plane).transpose();
            for number in 0..2 {
                let slope = &slope * meter.whiten[(number, 0)];
                normal.add_plain(&slope, miss[number]);
            }
        }
    }

    fn result(&self, found: &Optimum<Self>) -> Result<BatchFit, BatchError> {
        let (prior, point, vars) = (&self.campaign.prior, &found.point, self.campaign.prior.len());
        let factor = point.quadratic.factor().ok_or(BatchError::Degenerate)?;
        let covariance = factor.inverse();
        let unbounded = &found.x + factor.solve(&point.quadratic.slope);
        let marginal = |i: usize| {
            let [lower, upper] = prior.range[i];
            let inside = found.x[i] > lower && found.x[i] < upper;
            prior.marginal(i, if inside { found.x[i] } else { unbounded[i] }, covariance[(i, i)].sqrt())
        };
        let tune = |plane: usize, model: f64| {
            let meter = self.campaign.meters[plane].as_ref();
            FittedTune { model, measured: meter.map(|meter| (meter.near(model), meter.sigma)) }
        };
        let fitted_term = |(at, &term): (usize, &BaseTerm)| {
            let measured = Measured { value: found.x[vars + at], sigma: covariance[(vars + at, vars + at)].sqrt() };
            FittedTerm { term, measured }
        };
        Ok(BatchFit {
            marginals: (0..vars).map(marginal).collect(),
            map_params: found.x.iter().take(vars).copied().collect(),
            base: self.base.terms().iter().enumerate().map(fitted_term).collect(),
            base_model: self.base,
            covariance: covariance.view_range(..vars, ..vars).into_owned(),
            chi2_per_dof: if point.chi2.1 > 0.0 { point.chi2.0 / point.chi2.1 } else { f64::NAN },
            mismatch: quality(point.chi2).is_mismatch(),
            tunes: [tune(0, point.tunes.x), tune(1, point.tunes.y)],
            lack: self.lack(&point.of_orbits),
            steps: found.steps,
        })
    }

    /// What the orbits lack, by what they leave of the prior.
    fn lack(&self, of_orbits: &DMatrix<f64>) -> Option<Lack> {
        if !self.campaign.has_readings() {
            return Some(Lack::Readings);
        }
        let left = of_orbits.clone().cholesky()?.inverse();
        let precision = &self.campaign.prior.precision;
        let learnt = |i: usize| (left[(i, i)] * precision[i]).sqrt() < 1.0 - LEARNT;
        (!precision.is_empty() && !(0..precision.len()).any(learnt)).then_some(Lack::Kick)
    }
}

/// Chi-square and its degrees of freedom as the core has them.
fn quality((chi_square, degrees_of_freedom): (f64, f64)) -> FitQuality {
    FitQuality { chi_square: chi_square as f32, degrees_of_freedom: degrees_of_freedom as f32 }
}
