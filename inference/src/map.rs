//! The exact batch answer: all frames at once in f64, predicted by the twin itself.
//!
//! Which readings count and how much, the core decides: the recording is streamed through it once, and the batch fit
//! takes over its gate's choice and each monitor's noise. The rest is independent of the core: exact optics at every
//! step, each frame with its own read-backs, baselines eliminated by the normal equations.
//!
//! `chi2 = sum of (reading - baseline_b - predicted)^2/variance + sum of (theta - prior)^2/sigma^2`, minimised by damped
//! Gauss-Newton from vars = 1.

use estimator::{Health, Marginal, MonitorState, Prior};
use nalgebra::{DMatrix, DVector};
use training::BoosterGreen;
use twin::{ClosedOrbit, Hold, Optics, OrbitError, Plane, Ring, Tunes};

use crate::recording::{Recording, Row};
use crate::stream::{self, PRIOR_WIDTH, StreamError};

/// The batch answer for one recording.
#[derive(Debug, Clone)]
pub struct BatchFit {
    /// MAP of each `theta = ln var`, within the prior's range.
    pub map_params: Vec<f64>,
    /// Covariance of theta.
    pub covariance: DMatrix<f64>,
    /// Marginal of each theta.
    pub marginals: Vec<Marginal>,
    /// Sum of (residual / expected noise)^2 over readings of monitors in state ok, per degree of freedom.
    pub chi2_per_dof: f64,
    /// Tunes at the MAP.
    pub tunes: Tunes,
    /// State of the monitors, and which readings count.
    pub screened: Screened,
    /// Rms of the baselines in x and y [m].
    pub orbit: [f64; 2],
    /// Gauss-Newton steps taken.
    pub steps: usize,
}

/// Why there is no batch answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BatchError {
    /// The recording does not stream.
    #[error(transparent)]
    Stream(#[from] StreamError),
    /// A step led to an unstable ring even after halvings.
    #[error("no stable ring on the way down: {0}")]
    Orbit(#[from] OrbitError),
    /// The steps did not settle.
    #[error("no minimum after {steps} steps; the last one moved a var by {moved:.2e} standard deviations")]
    NotConverged {
        /// Steps taken.
        steps: usize,
        /// Largest move of the last step, in standard deviations.
        moved: f64,
    },
    /// The normal matrix is not positive.
    #[error("the readings and the prior do not determine the vars")]
    Degenerate,
}

/// What the core makes of the instruments.
#[derive(Debug, Clone)]
pub struct Screened {
    /// For each row, bit `b` is 1 if the reading of monitor `b` counts.
    pub accepted: Vec<u64>,
    /// State and noise of each monitor.
    pub health: Vec<Health>,
}

/// Stream a recording through the core for its choice of readings.
///
/// # Errors
/// [`StreamError`].
pub fn screen(ring: &Ring, recording: &Recording) -> Result<Screened, StreamError> {
    let mut core = stream::estimator(ring, recording, 0.0)?;
    let mut accepted = vec![0; recording.rows.len()];
    let mut health = Vec::new();
    // rows of each setting, last one last, so that a late confirmation or a restart finds its readings
    let mut history: Vec<Vec<usize>> = Vec::new();
    let mut at = 0;
    stream::replay(&mut core, recording, |_, estimate| {
        accepted[at] = estimate.accepted;
        if let Some(setting) = estimate.setting {
            history.resize(history.len().max(usize::from(setting) + 1), Vec::new());
            let rows = &mut history[usize::from(setting)];
            rows.iter().for_each(|&row| accepted[row] &= !estimate.restarted);
            if let Some(&last) = rows.last() {
                accepted[last] |= estimate.confirmed;
            }
            rows.push(at);
        }
        health = estimate.health.to_vec();
        at += 1;
    })?;
    Ok(Screened { accepted, health })
}

/// Largest move of a param, in standard deviations, at which the steps have settled.
const SETTLED: f64 = 1e-3;
const STEPS: usize = 30;
const HALVINGS: usize = 8;

impl BatchFit {
    /// Fit a recording; `progress` hears of each step.
    ///
    /// # Errors
    /// [`BatchError`].
    pub fn of(ring: &Ring, recording: &Recording, mut progress: impl FnMut(usize)) -> Result<Self, BatchError> {
        let problem = Problem::new(ring, recording)?;
        let n = ring.quadrupoles.len();
        let mut here = problem.normal(&DVector::zeros(n), [0.0; 2])?;
        for steps in 1..=STEPS {
            progress(steps);
            let minimum = here.solve(&problem.prior)?;
            let (next, moved) = problem.descend(&here, &minimum)?;
            here = next;
            if moved < SETTLED {
                return problem.answer(&here, steps);
            }
            if steps == STEPS {
                return Err(BatchError::NotConverged { steps, moved });
            }
        }
        unreachable!("the loop returns at its last step")
    }
}

/// One recording and how it is to be read.
struct Problem<'r> {
    ring: &'r Ring,
    recording: &'r Recording,
    drives: Vec<Drive>,
    /// Mean of `ln` of the supplies' factors, at which the ring is linearised.
    supplies: [f64; 2],
    screened: Screened,
    prior: Prior,
    /// Change of a misaligned ring's orbit per RF offset and rms orbit, see [`estimator::surrogate::Dispersion`].
    spurious: [f64; 2],
}

/// What drove the beam in one frame.
#[derive(Debug, Clone)]
pub struct Drive {
    /// Kick of each corrector [rad].
    pub kick: DVector<f64>,
    /// `ln` of the supplies' factors.
    pub strength: [f64; 2],
    /// Relative RF offset [1].
    pub rf_offset: f64,
    /// Frames with this RF offset: they share the error of the spurious dispersion.
    sharing: f64,
}

/// The exact ring at given params: what predictions are made of.
struct Linearised {
    response: DMatrix<f64>,
    /// Derivative of the response with respect to each theta.
    jacobian: Vec<DMatrix<f64>>,
    /// Orbit that each RF offset makes, and its derivative, rows monitors.
    rf: Vec<(f64, DVector<f64>, DMatrix<f64>)>,
    tunes: Tunes,
}

/// The normal equations at given params, baselines eliminated.
struct Normal {
    params: DVector<f64>,
    matrix: DMatrix<f64>,
    vector: DVector<f64>,
    /// Chi-square with the prior, to be made small.
    cost: f64,
    /// Chi-square of the monitors in state ok by their expected noise, and its degrees of freedom.
    chi2: (f64, f64),
    /// Rms of the baselines in x and y [m].
    orbit: [f64; 2],
    tunes: Tunes,
}

/// Where the quadratic of the normal equations has its minimum.
struct Minimum {
    /// Within the prior's range.
    params: DVector<f64>,
    unbounded: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl<'r> Problem<'r> {
    fn new(ring: &'r Ring, recording: &'r Recording) -> Result<Self, BatchError> {
        let screened = screen(ring, recording)?;
        let mut drives: Vec<Drive> = recording.rows.iter().map(|row| Drive::of(recording, row)).collect();
        let offsets: Vec<f64> = drives.iter().map(|d| d.rf_offset).collect();
        for drive in &mut drives {
            drive.sharing = offsets.iter().filter(|&&offset| offset == drive.rf_offset).count() as f64;
        }
        let mean = |family: usize| drives.iter().map(|d| d.strength[family]).sum::<f64>() / drives.len() as f64;
        let green: BoosterGreen = training::green::tables(ring).map_err(StreamError::from)?;
        Ok(Self {
            ring,
            recording,
            supplies: [mean(0), mean(1)],
            drives,
            screened,
            prior: Prior::lognormal(PRIOR_WIDTH),
            spurious: green.dispersion.spurious.map(f64::from),
        })
    }

    /// Half the way as long as the full step leads uphill or to an unstable ring; returns the largest move in sigmas.
    fn descend(&self, here: &Normal, minimum: &Minimum) -> Result<(Normal, f64), BatchError> {
        let mut step = &minimum.params - &here.params;
        let mut last = Ok(());
        for _ in 0..HALVINGS {
            match self.normal(&(&here.params + &step), here.orbit) {
                Ok(next) if next.cost <= here.cost + 1e-6 * here.cost.abs() => {
                    let moved = |i: usize| step[i].abs() / minimum.covariance[(i, i)].sqrt();
                    return Ok((next, (0..step.len()).map(moved).fold(0.0, f64::max)));
                }
                Ok(_) => last = Ok(()),
                Err(error) => last = Err(error),
            }
            step *= 0.5;
        }
        last?;
        Ok((self.normal(&here.params, here.orbit)?, 0.0)) // downhill nowhere: this is the minimum to rounding
    }

    /// Linearise the ring and add up all frames.
    fn normal(&self, params: &DVector<f64>, orbit: [f64; 2]) -> Result<Normal, BatchError> {
        let linearised = self.linearise(params)?;
        let (monitors, n) = (self.ring.read_monitors.len(), params.len());
        let split = self.split();
        let mut normal = Normal::prior(params, &self.prior, linearised.tunes);
        let expected = self.recording.header.bpm_sigma.powi(2);
        let mut baselines = [(0.0, 0.0); 2];
        for b in 0..monitors {
            let plane = usize::from(b >= split);
            let health = &self.screened.health[b];
            let noise = f64::from(health.weighted_as).powi(2);
            let (mut weight, mut sum, mut slope) = (0.0, 0.0, DVector::zeros(n));
            let (mut square, mut count, mut plain, mut plain_square) = (0.0, 0.0, 0.0, 0.0);
            for (i, drive) in self.drives.iter().enumerate() {
                let Some(reading) = self.recording.rows[i].reading[b].filter(|_| self.counts(i, b)) else { continue };
                let (predicted, h) = linearised.predict(b, drive, self.supplies, self.families());
                let residual = reading - predicted;
                let shared = self.spurious[plane] * orbit[plane] * drive.rf_offset;
                let w = 1.0 / (noise + drive.sharing * shared * shared);
                weight += w;
                sum += w * residual;
                square += w * residual * residual;
                normal.matrix.ger(w, &h, &h, 1.0);
                normal.vector.axpy(w * residual, &h, 1.0);
                slope.axpy(w, &h, 1.0);
                (count, plain, plain_square) = (count + 1.0, plain + residual, plain_square + residual * residual);
            }
            if count == 0.0 {
                continue;
            }
            // the baseline at its best: the Schur complement of its row
            normal.matrix.ger(-1.0 / weight, &slope, &slope, 1.0);
            normal.vector.axpy(-sum / weight, &slope, 1.0);
            normal.cost += square - sum * sum / weight;
            if health.state == MonitorState::Ok {
                normal.chi2.0 += (plain_square - plain * plain / count) / expected;
                normal.chi2.1 += count - 1.0;
            }
            baselines[plane].0 += (sum / weight).powi(2);
            baselines[plane].1 += 1.0;
        }
        normal.chi2.1 -= n as f64;
        normal.orbit = baselines.map(|(squares, count): (f64, f64)| (squares / count.max(1.0)).sqrt());
        Ok(normal)
    }

    fn counts(&self, row: usize, b: usize) -> bool {
        self.screened.accepted[row] >> b & 1 == 1
    }

    /// Number of horizontal monitors.
    fn split(&self) -> usize {
        self.ring.horizontal_monitors()
    }

    fn families(&self) -> usize {
        first_family(self.ring)
    }

    fn linearise(&self, params: &DVector<f64>) -> Result<Linearised, BatchError> {
        let families = self.families();
        let factor = |i: usize| (params[i] + self.supplies[usize::from(i >= families)]).exp();
        let strength: Vec<f64> = (0..params.len()).map(factor).collect();
        let ring = self.ring.with_vars(&strength);
        let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 })?;
        let (observers, sources, gradients) = (optics.read_monitors(), optics.correctors(), optics.quadrupoles());
        // d/dtheta = k1 d/dk1
        let mut jacobian = optics.response_jacobian(&observers, &sources, &gradients);
        jacobian.iter_mut().zip(ring.gradients()).for_each(|(j, k1)| *j *= k1);
        let mut offsets: Vec<f64> = self.drives.iter().map(|d| d.rf_offset).filter(|&offset| offset != 0.0).collect();
        offsets.sort_by(f64::total_cmp);
        offsets.dedup();
        let mut slope = optics.rf_jacobian(&observers, &gradients);
        slope.column_iter_mut().zip(ring.gradients()).for_each(|(mut column, k1)| column *= k1);
        let rf = offsets.into_iter().map(|offset| Ok((offset, rf_orbit(&ring, offset)?, &slope * offset)));
        Ok(Linearised {
            response: optics.response(&observers, &sources),
            jacobian,
            rf: rf.collect::<Result<_, OrbitError>>()?,
            tunes: optics.tunes()?,
        })
    }

    fn answer(self, normal: &Normal, steps: usize) -> Result<BatchFit, BatchError> {
        let minimum = normal.solve(&self.prior)?;
        let (lower, upper) = (self.prior.lower, self.prior.upper);
        let marginal = |i: usize| {
            let inside = minimum.params[i] > f64::from(lower) && minimum.params[i] < f64::from(upper);
            let mean = if inside { minimum.params[i] } else { minimum.unbounded[i] };
            Marginal { mean: mean as f32, sigma: minimum.covariance[(i, i)].sqrt() as f32, lower, upper }
        };
        Ok(BatchFit {
            marginals: (0..minimum.params.len()).map(marginal).collect(),
            map_params: minimum.params.iter().copied().collect(),
            covariance: minimum.covariance,
            chi2_per_dof: normal.chi2.0 / normal.chi2.1,
            tunes: normal.tunes,
            screened: self.screened,
            orbit: normal.orbit,
            steps,
        })
    }
}

impl Drive {
    /// The header's formulas, in f64: `k1 = var * k1_design * p(I/I_nominal)/p(1)/(I_dipole/I_dipole_nominal)`.
    pub fn of(recording: &Recording, row: &Row) -> Self {
        let header = &recording.header;
        let rigidity = row.currents.dipole / header.nominal.dipole;
        let transfer = |r: f64| header.quad_transfer.iter().rev().fold(0.0, |sum, c| sum * r + c);
        let strength = |current: f64, nominal: f64| (transfer(current / nominal) / transfer(1.0) / rigidity).ln();
        let kick = row.corrector_current.iter().map(|current| current * header.kick_per_ampere / rigidity);
        Self {
            kick: DVector::from_iterator(row.corrector_current.len(), kick),
            strength: [strength(row.currents.qh, header.nominal.qh), strength(row.currents.qv, header.nominal.qv)],
            rf_offset: row.rf_offset,
            sharing: 1.0,
        }
    }
}

impl Linearised {
    /// Orbit at monitor `b` and its derivative.
    fn predict(&self, b: usize, drive: &Drive, supplies: [f64; 2], first_family: usize) -> (f64, DVector<f64>) {
        let mut orbit = self.response.row(b).tr_dot(&drive.kick);
        let mut h =
            DVector::from_iterator(self.jacobian.len(), self.jacobian.iter().map(|j| j.row(b).tr_dot(&drive.kick)));
        if let Some((_, shift, slope)) = self.rf.iter().find(|(offset, ..)| *offset == drive.rf_offset) {
            orbit += shift[b];
            h += slope.row(b).transpose();
        }
        // supplies off their mean: a known change of ln strength, to first order
        for (i, slope) in h.iter().enumerate() {
            let family = usize::from(i >= first_family);
            orbit += slope * (drive.strength[family] - supplies[family]);
        }
        (orbit, h)
    }
}

/// Number of quadrupoles on the first (QH) supply; they come first.
pub fn first_family(ring: &Ring) -> usize {
    ring.gradients().iter().filter(|k| **k > 0.0).count()
}

/// Orbit that an RF offset makes at the read monitors, exactly [m].
///
/// # Errors
/// [`OrbitError`] if there is none.
pub fn rf_orbit(ring: &Ring, offset: f64) -> Result<DVector<f64>, OrbitError> {
    let orbit = ClosedOrbit::find(ring, Hold::Frequency { offset })?;
    let seen = ring.monitors_read().map(|m| orbit.at[m.element][if m.plane == Plane::Y { 2 } else { 0 }]);
    Ok(DVector::from_iterator(ring.read_monitors.len(), seen))
}

impl Normal {
    fn prior(params: &DVector<f64>, prior: &Prior, tunes: Tunes) -> Self {
        let (mean, precision) = (f64::from(prior.mean), f64::from(prior.sigma).powi(-2));
        let pull = params.map(|theta| mean - theta);
        Self {
            params: params.clone(),
            matrix: DMatrix::from_diagonal_element(params.len(), params.len(), precision),
            cost: pull.norm_squared() * precision,
            vector: pull * precision,
            chi2: (0.0, 0.0),
            orbit: [0.0; 2],
            tunes,
        }
    }

    /// The minimum, within the prior's range by projected Gauss-Seidel sweeps.
    fn solve(&self, prior: &Prior) -> Result<Minimum, BatchError> {
        let covariance = self.matrix.clone().cholesky().ok_or(BatchError::Degenerate)?.inverse();
        let unbounded = &self.params + &covariance * &self.vector;
        let bounded = |theta: f64| theta.clamp(f64::from(prior.lower), f64::from(prior.upper));
        let mut params = unbounded.map(bounded);
        if params != unbounded {
            for _ in 0..200 {
                for i in 0..params.len() {
                    let pull = self.vector[i] - self.matrix.column(i).dot(&(&params - &self.params));
                    params[i] = bounded(params[i] + pull / self.matrix[(i, i)]);
                }
            }
        }
        Ok(Minimum { params, unbounded, covariance })
    }
}
