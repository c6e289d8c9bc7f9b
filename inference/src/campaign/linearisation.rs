//! The exact ring at given params and mean supplies, and to first order about them: what predictions of frames are made of.
//!
//! The params are the vars, and after them the amplitudes of the base model's terms ([`BaseModel`]), if it has any.

use nalgebra::{DMatrix, DVector, Vector2};
use twin::{ClosedOrbit, Held, Hold, Machine, Optics, OrbitError, Plane, Ring, Tunes};

use super::times::Times;
use crate::base_model::BaseModel;
use crate::recording::{Drive, mean_supplies};

/// The ring at given params.
#[derive(Debug, Clone)]
pub(crate) struct Linearised {
    /// Response of the read monitors to the correctors [B][C] [m/rad].
    response: DMatrix<f64>,
    /// Its derivative with respect to each param, of each monitor [N + K][C].
    slopes: Vec<DMatrix<f64>>,
    /// The same with respect to `ln` of each supply's strength, a matrix [B][C] for each supply.
    supply_slopes: Vec<DMatrix<f64>>,
    rf: Vec<RfOrbit>,
    /// Tunes.
    pub tunes: Tunes,
    /// Derivative of both tunes with respect to each param [2][N].
    pub tune_slopes: DMatrix<f64>,
    /// The same with respect to `ln` of each supply's strength [2][F].
    pub tune_supply_slopes: DMatrix<f64>,
    /// Supplies about which it is linearised [F].
    supplies: DVector<f64>,
}

/// The ring at given params, at the mean supplies of the frames of each time in the cycle.
#[derive(Debug, Clone)]
pub(crate) struct AtTimes {
    /// At the mean supplies of all frames.
    pub at_mean: Linearised,
    /// For each of several times, its frames and the ring; none where there is one time.
    each: Vec<(Vec<usize>, Linearised)>,
}

impl AtTimes {
    /// About params, at the mean supplies of all frames and of those of each time.
    pub fn new(
        (machine, base): (&Machine, BaseModel),
        params: &DVector<f64>,
        supplies: &[f64],
        drives: &[Drive],
        times: &Times,
    ) -> Result<Self, OrbitError> {
        let at_time = |time: usize| {
            let frames: Vec<usize> = (0..drives.len()).filter(|&i| times.of_frame[i] == time).collect();
            let drives = drives_of(drives, &frames);
            let linearised = Linearised::about((machine, base), params, &mean_supplies(&drives), &drives)?;
            Ok((frames, linearised))
        };
        let several = if times.count() > 1 { times.count() } else { 0 };
        let each = (0..several).map(at_time).collect::<Result<_, OrbitError>>()?;
        Ok(Self { at_mean: Linearised::about((machine, base), params, supplies, drives)?, each })
    }

    /// As [`Linearised::orbits`].
    pub fn orbits(&self, drives: &[Drive]) -> DMatrix<f64> {
        let mut orbits = self.at_mean.orbits(drives);
        for (frames, linearised) in &self.each {
            let at_time = linearised.orbits(&drives_of(drives, frames));
            frames.iter().zip(at_time.row_iter()).for_each(|(&frame, orbit)| orbits.set_row(frame, &orbit));
        }
        orbits
    }

    /// As [`Linearised::slopes`].
    pub fn slopes(&self, drives: &[Drive]) -> Vec<DMatrix<f64>> {
        let mut slopes = self.at_mean.slopes(drives);
        for (frames, linearised) in &self.each {
            for (to, at_time) in slopes.iter_mut().zip(linearised.slopes(&drives_of(drives, frames))) {
                frames.iter().zip(at_time.column_iter()).for_each(|(&frame, slope)| to.set_column(frame, &slope));
            }
        }
        slopes
    }
}

fn drives_of(drives: &[Drive], frames: &[usize]) -> Vec<Drive> {
    frames.iter().map(|&frame| drives[frame].clone()).collect()
}

/// Orbit that an RF offset makes, exactly, and its derivatives.
#[derive(Debug, Clone)]
struct RfOrbit {
    offset: f64,
    /// [B] [m].
    orbit: DVector<f64>,
    /// [N][B] and [B][F].
    slopes: DMatrix<f64>,
    supply_slopes: DMatrix<f64>,
}

impl Linearised {
    /// About params and supplies, for the RF offsets of some frames. Kicks move the beam with what the machine holds constant; an RF
    /// offset overrides that.
    pub fn about(
        (machine, base): (&Machine, BaseModel),
        params: &DVector<f64>,
        supplies: &[f64],
        drives: &[Drive],
    ) -> Result<Self, OrbitError> {
        let vars = machine.ring().parameters.len();
        let amplitudes = &params.as_slice()[vars..];
        let design = machine.ring().with_strengths(&machine.ring().strengths(params.as_slice(), supplies));
        let ring = &base.ring(&design, amplitudes);
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
        let held = machine.held_of(ring, &optics)?;
        let (observers, sources, gradients) = (optics.read_monitors(), optics.correctors(), optics.quadrupoles());
        let (kicks, rf_factor) = (base.kick_factors(ring, amplitudes), base.rf_factor(amplitudes));
        let k1 = ring.gradients();
        let by_param = |m: usize| ring.quadrupoles[m].parameter;
        let by_supply = |m: usize| ring.quadrupoles[m].supply;
        let supply_count = ring.supplies.len();
        let (monitors, correctors) = (observers.len(), sources.len());
        let mut slopes = vec![DMatrix::zeros(params.len(), correctors); monitors];
        let mut supply_slopes = vec![DMatrix::zeros(monitors, correctors); supply_count];
        // d/d ln k = k1 d/dk1
        for (m, gradient) in gradients.iter().enumerate() {
            let slope = scaled(held.jacobian(&optics, &observers, &sources, gradient) * k1[m], &kicks);
            if let Some(param) = by_param(m) {
                for (of_monitor, slope) in slopes.iter_mut().zip(slope.row_iter()) {
                    let mut row = of_monitor.row_mut(param);
                    row += slope;
                }
            }
            if let Some(supply) = by_supply(m) {
                supply_slopes[supply] += slope;
            }
        }
        let rf_slope = optics.rf_jacobian(&observers, &gradients) * rf_factor;
        let tune_slope: Vec<[f64; 2]> = gradients.iter().map(|gradient| optics.tune_slope(gradient)).collect();
        let tune_slope = DMatrix::from_fn(2, gradients.len(), |plane, m| tune_slope[m][plane]);
        let summed = |slope: &DMatrix<f64>, count: usize, index: &dyn Fn(usize) -> Option<usize>| {
            let mut sum = DMatrix::zeros(slope.nrows(), count);
            for (m, column) in slope.column_iter().enumerate() {
                if let Some(index) = index(m) {
                    sum.column_mut(index).axpy(k1[m], &column, 1.0);
                }
            }
            sum
        };
        let (rf_params, rf_supplies) =
            (summed(&rf_slope, params.len(), &by_param), summed(&rf_slope, supply_count, &by_supply));
        let offsets = offsets(drives);
        let bare = Observed::new(&held, (ring, &optics), &offsets)?;
        let here = bare.scaled(base, ring, amplitudes);
        let rf = |(&offset, orbit): (&f64, &DVector<f64>)| RfOrbit {
            offset,
            orbit: orbit.clone(),
            slopes: rf_params.transpose() * offset,
            supply_slopes: &rf_supplies * offset,
        };
        let mut linearised = Self {
            rf: offsets.iter().zip(&here.rf).map(rf).collect(),
            response: here.response.clone(),
            slopes,
            supply_slopes,
            tunes: here.tunes,
            tune_slopes: summed(&tune_slope, params.len(), &by_param),
            tune_supply_slopes: summed(&tune_slope, supply_count, &by_supply),
            supplies: DVector::from_column_slice(supplies),
        };
        for (at, term) in base.terms().iter().enumerate() {
            let mut amplitudes = amplitudes.to_vec();
            amplitudes[at] += term.step();
            let there = if term.is_of_magnets() {
                let ring = base.ring(&design, &amplitudes);
                let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 })?;
                Observed::new(&machine.held_of(&ring, &optics)?, (&ring, &optics), &offsets)?
            } else {
                bare.clone()
            };
            let there = there.scaled(base, ring, &amplitudes);
            linearised.set_slope(vars + at, &there.slope_from(&here, term.step()));
        }
        Ok(linearised)
    }

    /// Derivatives of the response of one monitor [N + K][C + 1], that to the RF offset in the last column [m]; 0 there without offsets.
    pub fn slopes_at(&self, b: usize) -> DMatrix<f64> {
        let mut slopes = self.slopes[b].clone().insert_column(self.response.ncols(), 0.0);
        if let Some(rf) = self.rf.first() {
            slopes.column_mut(self.response.ncols()).copy_from(&(rf.slopes.column(b) / rf.offset));
        }
        slopes
    }

    /// The derivatives with respect to one param.
    fn set_slope(&mut self, param: usize, slope: &Observed) {
        self.slopes.iter_mut().zip(slope.response.row_iter()).for_each(|(to, row)| to.set_row(param, &row));
        self.rf.iter_mut().zip(&slope.rf).for_each(|(to, orbit)| to.slopes.set_row(param, &orbit.transpose()));
        self.tune_slopes.set_column(param, &Vector2::new(slope.tunes.x, slope.tunes.y));
    }

    /// Orbits of frames without baselines, the supplies off their mean to first order: rows frames, columns monitors [m].
    pub fn orbits(&self, drives: &[Drive]) -> DMatrix<f64> {
        let kicks = self.kicks(drives);
        let off = columns(self.supplies.len(), drives, |drive| &drive.strength - &self.supplies);
        let mut orbits = &self.response * &kicks;
        for (slope, off) in self.supply_slopes.iter().zip(off.row_iter()) {
            let moved = slope * &kicks;
            for ((mut orbit, moved), off) in orbits.column_iter_mut().zip(moved.column_iter()).zip(off.iter()) {
                orbit.axpy(*off, &moved, 1.0);
            }
        }
        for (i, mut orbit) in orbits.column_iter_mut().enumerate() {
            let Some(rf) = self.rf(&drives[i]) else { continue };
            orbit += &rf.orbit + &rf.supply_slopes * off.column(i);
        }
        orbits.transpose()
    }

    /// Derivative of the orbits with respect to the params, of each monitor: rows params, columns frames.
    pub fn slopes(&self, drives: &[Drive]) -> Vec<DMatrix<f64>> {
        let kicks = self.kicks(drives);
        let slopes = self.slopes.iter().enumerate();
        let along = |(b, slope): (usize, &DMatrix<f64>)| {
            let mut along = slope * &kicks;
            for (mut column, drive) in along.column_iter_mut().zip(drives) {
                self.rf(drive).into_iter().for_each(|rf| column += rf.slopes.column(b));
            }
            along
        };
        slopes.map(along).collect()
    }

    fn rf(&self, drive: &Drive) -> Option<&RfOrbit> {
        self.rf.iter().find(|rf| rf.offset == drive.rf_offset)
    }

    fn kicks(&self, drives: &[Drive]) -> DMatrix<f64> {
        columns(self.response.ncols(), drives, |drive| drive.kick.clone())
    }
}

/// What frames see of a ring, or its derivative with respect to a term of the base model.
#[derive(Debug, Clone)]
struct Observed {
    /// Response of the read monitors to the correctors [B][C] [m/rad].
    response: DMatrix<f64>,
    /// Orbit of each RF offset [B] [m].
    rf: Vec<DVector<f64>>,
    tunes: Tunes,
}

impl Observed {
    /// Of a ring whose kicks and RF offsets are as recorded.
    fn new(held: &Held, (ring, optics): (&Ring, &Optics), offsets: &[f64]) -> Result<Self, OrbitError> {
        Ok(Self {
            response: held.response(optics, &optics.read_monitors(), &optics.correctors()),
            rf: offsets.iter().map(|offset| rf_orbit(ring, *offset)).collect::<Result<_, OrbitError>>()?,
            tunes: optics.tunes()?,
        })
    }

    /// The same with the factors of a base model's terms.
    fn scaled(&self, base: BaseModel, ring: &Ring, amplitudes: &[f64]) -> Self {
        let factor = base.rf_factor(amplitudes);
        Self {
            response: scaled(self.response.clone(), &base.kick_factors(ring, amplitudes)),
            rf: self.rf.iter().map(|orbit| orbit * factor).collect(),
            tunes: self.tunes,
        }
    }

    /// The derivative, from what is seen a step away.
    fn slope_from(self, here: &Self, step: f64) -> Self {
        Self {
            response: (self.response - &here.response) / step,
            rf: self.rf.iter().zip(&here.rf).map(|(there, here)| (there - here) / step).collect(),
            tunes: Tunes { x: (self.tunes.x - here.tunes.x) / step, y: (self.tunes.y - here.tunes.y) / step },
        }
    }
}

/// A response [B][C] with a factor on each corrector.
fn scaled(mut response: DMatrix<f64>, factors: &DVector<f64>) -> DMatrix<f64> {
    response.column_iter_mut().zip(factors.iter()).for_each(|(mut column, factor)| column *= *factor);
    response
}

/// Columns of all frames.
fn columns(rows: usize, drives: &[Drive], of: impl Fn(&Drive) -> DVector<f64>) -> DMatrix<f64> {
    let mut columns = DMatrix::zeros(rows, drives.len());
    drives.iter().enumerate().for_each(|(i, drive)| columns.set_column(i, &of(drive)));
    columns
}

/// RF offsets other than 0, each once.
fn offsets(drives: &[Drive]) -> Vec<f64> {
    let mut offsets: Vec<f64> = drives.iter().map(|d| d.rf_offset).filter(|&offset| offset != 0.0).collect();
    offsets.sort_by(f64::total_cmp);
    offsets.dedup();
    offsets
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
