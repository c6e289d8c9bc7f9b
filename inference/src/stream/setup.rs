//! Priors, noise and calibration of a core, for a ring of any size.

use estimator::{Calibration, Each, GROUPS, Gate, Layout, Prior, Ramp, RampPoint, SupplyCalibration, Walk};
use training::rooms::largest;
use twin::{Ring, median};

use super::StreamError;
use crate::campaign::TUNE_CALIBRATION;
use crate::recording::{At, Recording, Row};

/// The walk of a machine that is followed for hours, and of what the daemon expects.
///
/// A supply or a magnet that warms up drifts by 1 % in minutes: 1.5e-4 in the root of a second is 1.2 % in the root of an hour and a
/// half, and forgets in some minutes what contradicts it. Faster, vars that stay would be known worse than 0.3 %; slower, one that
/// drifts by 3 % in ten minutes leaves its band, as it does in some streams as it is (`docs/drift.md`). Orbits drift by 0.1 mm an hour: 2e-6 m in the root of a second.
pub const FOLLOW: Walk = Walk { params: 1.5e-4, baselines: 2e-6 };

/// Priors, noise and calibration: [`estimator::Setup`] for a ring of any size.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// Priors of `theta = ln var`; which of them a param has stands in the tables. Those that no param has repeat the first.
    pub priors: [Prior; GROUPS],
    /// Kick of each corrector at nominal momentum [rad/A] [C].
    pub kick_per_ampere: Vec<f32>,
    /// Nominal current of the dipoles [A]; without one their read-back does not count.
    pub dipole: Option<f32>,
    /// The supplies of quadrupoles [F].
    pub supplies: Vec<SupplyCalibration>,
    /// What changes along the ramp; none of a machine without one.
    pub ramp: Vec<At>,
    /// Expected noise of a reading of each monitor [m] [B].
    pub noise: Vec<f32>,
    /// When readings agree.
    pub gate: Gate,
    /// How params and baselines walk.
    pub walk: Walk,
    /// Calibration error of the tune meter [1]; none, and tunes do not count.
    pub tune_calibration: Option<f32>,
}

/// A random walk of the params, and of the baselines [m], by so much per square root of a cycle of a recording, lost ones counted.
pub fn walk_per_cycle(recording: &Recording, params: f32, baselines: f32) -> Walk {
    let cycles = |rows: &[Row]| f64::from(rows[1].sequence - rows[0].sequence);
    let periods = recording.rows.windows(2).map(|rows| (rows[1].time - rows[0].time) / cycles(rows));
    let period = median(periods).unwrap_or(1.0);
    let per_second = 1.0 / period.sqrt() as f32;
    Walk { params: params * per_second, baselines: baselines * per_second }
}

/// What is known beforehand of a recording of a ring, from its header.
///
/// # Errors
/// [`StreamError::Transfer`], or [`StreamError::Training`] for more priors than a core tells apart.
pub fn setup(ring: &Ring, recording: &Recording, walk: Walk) -> Result<Setup, StreamError> {
    let header = &recording.header;
    let single = |values: &[f64]| values.iter().map(|v| *v as f32).collect();
    let supply = |(nominal, coefficients): (&f64, &Vec<f64>)| {
        let mut transfer = [0.0; 6];
        if coefficients.len() > transfer.len() {
            return Err(StreamError::Transfer { recording: recording.name.clone(), found: coefficients.len() });
        }
        transfer.iter_mut().zip(coefficients).for_each(|(to, from)| *to = *from as f32);
        Ok(SupplyCalibration { nominal: *nominal as f32, transfer })
    };
    Ok(Setup {
        priors: priors(ring)?,
        kick_per_ampere: single(&header.kick_per_ampere),
        dipole: header.nominal_dipole.map(|a| a as f32),
        supplies: header.nominal.iter().zip(&header.transfer).map(supply).collect::<Result<_, _>>()?,
        ramp: header.ramp.points.clone(),
        noise: single(&header.noise),
        gate: Gate::default(),
        walk,
        tune_calibration: Some(TUNE_CALIBRATION as f32),
    })
}

/// The priors that a ring's params have, each once, in the order in which tables count them.
fn priors(ring: &Ring) -> Result<[Prior; GROUPS], StreamError> {
    let (groups, _) = training::green::prior_groups(ring)?;
    // of a ring without params nobody asks for one
    let mut all = [groups.first().copied().unwrap_or_default(); GROUPS];
    all[..groups.len()].copy_from_slice(&groups);
    Ok(all.map(|prior| Prior::lognormal(prior.width as f32, prior.range.map(|v| v as f32))))
}

impl Setup {
    /// As it travels to a device of exactly the ring's sizes.
    pub fn on_wire(&self) -> largest::Setup {
        let mut setup = self.sized(|b| b, |c| c);
        setup.calibration.supplies.truncate(self.supplies.len());
        setup.calibration.ramp.points.iter_mut().for_each(|point| point.gradient.truncate(self.supplies.len()));
        setup.noise.own.truncate(self.noise.len());
        setup.calibration.kick_per_ampere.own.truncate(self.kick_per_ampere.len());
        setup
    }

    /// For a core that has room for the ring.
    pub fn in_room<const B: usize, const C: usize, const F: usize>(
        &self,
        layout: &Layout,
    ) -> estimator::Setup<B, C, F> {
        self.sized(|b| layout.monitor(b), |c| layout.corrector(c))
    }

    fn sized<const B: usize, const C: usize, const F: usize>(
        &self,
        monitor: impl Fn(usize) -> usize,
        corrector: impl Fn(usize) -> usize,
    ) -> estimator::Setup<B, C, F> {
        let supplies = self.supplies.iter().copied().chain(core::iter::repeat(SupplyCalibration::IDLE));
        estimator::Setup {
            prior: self.priors,
            calibration: Calibration {
                kick_per_ampere: each(&self.kick_per_ampere, corrector),
                dipole: self.dipole,
                supplies: supplies.take(F).collect(),
                ramp: Ramp { points: self.ramp.iter().map(point).collect() },
            },
            noise: each(&self.noise, monitor),
            gate: self.gate,
            walk: self.walk,
            tune_calibration: self.tune_calibration,
        }
    }
}

/// A point of the ramp; a spare supply has no quadrupoles.
fn point<const F: usize>(at: &At) -> RampPoint<F> {
    let gradient = at.gradient.iter().map(|gradient| *gradient as f32).chain(core::iter::repeat(1.0));
    RampPoint {
        time_us: (at.time * 1e6).round() as u32,
        momentum: at.momentum as f32,
        dipole: at.dipole as f32,
        slip: at.slip as f32,
        gradient: gradient.take(F).collect(),
    }
}

/// One number if all are the same, else each in its slot, a spare slot with the first.
fn each<const L: usize>(values: &[f32], slot: impl Fn(usize) -> usize) -> Each<L> {
    let first = values.first().copied().unwrap_or(1.0);
    let mut each = Each::same(first);
    if values.iter().any(|v| *v != first) {
        each.own.resize(L, first).expect("as many as there is room for");
        values.iter().enumerate().for_each(|(i, v)| each.own[slot(i)] = *v);
    }
    each
}
