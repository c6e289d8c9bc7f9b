//! Derivative of the readings with respect to the amplitude of an effect: what a small one looks like.
//!
//! Each class has its formula for it in its own file; one without a formula is a difference of two machines. An effect without an
//! amplitude (a reversed corrector, exchanged monitors, a held frequency) has its whole change instead.

use core::convert::Infallible;

use nalgebra::{DMatrix, DVector, MatrixXx2};

use super::drift;
use super::drives::{Drives, Seen};
use super::field::{self, Thin};
use super::hold::Held;
use super::machine::Machine;
use super::mechanism::Mechanism;
use super::{EffectError, EffectKind};
use crate::lattice::{Monitor, Parameter, Plane};
use crate::orbit::{Hold, OrbitError};
use crate::response::{Gradient, Observer, Optics, Place, Source};
use crate::site::Site;

/// A machine linearised for the signatures of further effects.
#[derive(Debug)]
pub struct Signatures<'m> {
    pub(super) machine: &'m Machine,
    pub(super) drives: &'m Drives,
    pub(super) optics: Optics<'m>,
    pub(super) held: Held<'m>,
    /// Read monitors, each in its plane.
    pub(super) observers: Vec<Observer>,
    sources: Vec<Source>,
    /// Kicks that the frames really had.
    pub(super) kick: DMatrix<f64>,
    /// Positions x and y at all monitors, rows frames [m].
    pub(super) positions: [DMatrix<f64>; 2],
    /// Response of the read monitors, the RF frequency last.
    pub(super) response: DMatrix<f64>,
    /// Signatures about the machines at the start and at the end of a drift.
    ends: Option<Box<[Self; 2]>>,
}

/// What a small effect does per unit of its amplitude.
#[derive(Debug, Clone)]
pub struct Signature {
    /// To the readings, rows frames, columns read monitors [m].
    pub readings: DMatrix<f64>,
    /// To the tunes.
    pub tunes: [f64; 2],
    /// To the tunes of each frame besides, rows frames.
    pub tune_changes: MatrixXx2<f64>,
}

impl core::ops::AddAssign for Signature {
    fn add_assign(&mut self, other: Self) {
        self.readings += other.readings;
        (0..2).for_each(|plane| self.tunes[plane] += other.tunes[plane]);
        self.tune_changes += other.tune_changes;
    }
}

impl core::ops::Sub for Signature {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        Self {
            readings: self.readings - other.readings,
            tunes: [0, 1].map(|plane| self.tunes[plane] - other.tunes[plane]),
            tune_changes: self.tune_changes - other.tune_changes,
        }
    }
}

impl core::ops::Mul<f64> for Signature {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        let Self { readings, tunes, tune_changes } = self;
        Self {
            readings: readings * factor,
            tunes: tunes.map(|tune| tune * factor),
            tune_changes: tune_changes * factor,
        }
    }
}

impl Signature {
    /// Rms over all readings [m].
    pub fn rms(&self) -> f64 {
        (self.readings.norm_squared() / self.readings.len() as f64).sqrt()
    }

    /// Readings and, as two more columns, the tunes of every frame.
    pub fn by_frame(self) -> DMatrix<f64> {
        let monitors = self.readings.ncols();
        let mut all = self.readings.insert_columns(monitors, 2, 0.0);
        for plane in 0..2 {
            all.set_column(monitors + plane, &self.tune_changes.column(plane).add_scalar(self.tunes[plane]));
        }
        all
    }

    /// Change of a tune in a frame.
    pub fn tune(&self, plane: usize, frame: usize) -> f64 {
        self.tunes[plane] + self.tune_changes[(frame, plane)]
    }
}

/// Steps for a numerical derivative in a prior standard deviation; a momentum's is 1e-4.
const STEPS: f64 = 30.0;

impl<'m> Signatures<'m> {
    /// Linearise.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn of(machine: &'m Machine, drives: &'m Drives) -> Result<Self, OrbitError> {
        let ring = &machine.ring;
        let optics = Optics::of(ring, Hold::Momentum { delta: machine.hold.delta })?;
        let held = Held::of(ring, &optics, machine.hold)?;
        let seen = machine.seen_by(ring, &optics)?;
        let kick = machine.kicks(drives);
        let positions = drives.positions(&seen, &kick);
        let (observers, sources) = (optics.read_monitors(), optics.correctors());
        let response = DMatrix::from_fn(observers.len(), sources.len() + 1, |b, c| {
            let at = ring.read_monitors[b];
            seen.response[ring.monitors[at].plane.index()][(at, c)]
        });
        Ok(Self { machine, drives, optics, held, observers, sources, kick, positions, response, ends: None })
    }

    /// With what effects and vars do at the [ends](Machine::ends) of a drift, so that their signatures are those of every frame; without, they are those of
    /// mid-campaign, as those of kicks and of single fields at any place remain.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable at one of them.
    pub fn between(self, ends: Option<&'m [Machine; 2]>) -> Result<Self, OrbitError> {
        let Some([start, end]) = ends else { return Ok(self) };
        let ends = [Self::of(start, self.drives)?, Self::of(end, self.drives)?];
        Ok(Self { ends: Some(Box::new(ends)), ..self })
    }

    /// The signature of an effect of a kind at a site.
    ///
    /// # Errors
    /// [`EffectError`] if the kind cannot act there, or makes the ring unstable.
    pub fn of_effect(&self, kind: EffectKind, site: Site) -> Result<Signature, EffectError> {
        self.of_mechanism(kind.mechanism(), site)
    }

    /// The same of any mechanism.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn of_mechanism(&self, mechanism: &dyn Mechanism, site: Site) -> Result<Signature, EffectError> {
        self.in_frames(|about| mechanism.signature(about, site)).map(|signature| self.as_read(signature))
    }

    /// Derivative of readings and tunes with respect to each param, the `ln` of a factor.
    pub fn of_vars(&self) -> Vec<Signature> {
        let of_quadrupoles = self.of_quadrupoles();
        let sum = |parameter: &Parameter| {
            let mut sum = self.nothing();
            parameter.quadrupoles.iter().for_each(|&at| sum += of_quadrupoles[at].clone());
            sum
        };
        self.machine.ring.parameters.iter().map(sum).collect()
    }

    /// The same with respect to `ln` of each quadrupole's gradient `[M]`.
    pub fn of_quadrupoles(&self) -> Vec<Signature> {
        let of = |at: usize| {
            let Ok(signature) = self.in_frames(|about| Ok::<_, Infallible>(about.of_quadrupole(at)));
            self.as_read(signature)
        };
        (0..self.machine.ring.quadrupoles.len()).map(of).collect()
    }

    /// The same of the orbit itself, for one quadrupole, about this machine alone.
    pub(super) fn of_quadrupole(&self, at: usize) -> Signature {
        let ring = &self.machine.ring;
        self.of_gradient(&self.optics.gradient(ring.quadrupoles[at].element), ring.gradients()[at])
    }

    /// Derivative with respect to a gradient [1/m] at any place of the ring.
    pub fn of_thin(&self, place: Place, kind: Thin) -> Signature {
        self.as_read(field::thin(self, place, kind))
    }

    /// Derivative with respect to the strength of a thin linear element of Hamiltonian `strength z_i z_j` at a place, z = (x, x', y, y'). Whatever
    /// focuses, couples or turns the beam between two instruments is, to first order, a sum of ten such.
    pub fn of_thin_linear(&self, place: Place, form: [usize; 2]) -> Signature {
        self.as_read(self.of_gradient(&self.optics.thin_linear(place, form), 1.0))
    }

    /// Derivative with respect to a kick in (x, y) [1] at a place, the same in every frame.
    pub fn of_kick(&self, place: Place, direction: [f64; 2]) -> Signature {
        let response = self.held.response(&self.optics, &self.observers, &[self.optics.kick(place, direction)]);
        let rows = vec![response.column(0).transpose(); self.kick.nrows()];
        self.as_read(Signature { readings: DMatrix::from_rows(&rows), ..self.nothing() })
    }

    /// What kicks and RF offset do to the orbit at a read monitor: its position and slope in the monitor's plane,
    /// then in the other, rows frames [m, rad]. But for dispersion, the orbit anywhere near is a sum of these where no kick is in
    /// between.
    pub fn around(&self, b: usize) -> DMatrix<f64> {
        let monitor = self.machine.ring.read_monitors[b];
        let Monitor { element, plane } = self.machine.ring.monitors[monitor];
        let crossed = if plane == Plane::X { Plane::Y } else { Plane::X };
        let position = |plane: Plane| self.positions[plane.index()].column(monitor).into_owned();
        let slope = |plane| {
            let observer = self.optics.observe_slope(element, plane);
            let response = self.held.response(&self.optics, &[observer], &self.sources);
            let rf = self.held.rf_response(&self.optics, &[observer])[0];
            (&self.kick * response.transpose() + &self.drives.rf_offset * rf).column(0).into_owned()
        };
        DMatrix::from_columns(&[position(plane), slope(plane), position(crossed), slope(crossed)])
    }

    /// What the read monitors see of a step of the beam in x, x', y and y' at a corrector, columns the four [1, m/rad]. A kick
    /// anywhere near is a sum of these, but for monitors in between.
    pub fn beside(&self, corrector: usize) -> DMatrix<f64> {
        let at = self.machine.ring.correctors[corrector].element;
        let step = |i: usize| self.optics.step(at, core::array::from_fn(|j| f64::from(u8::from(i == j))));
        self.held.response(&self.optics, &self.observers, &[0, 1, 2, 3].map(step))
    }

    /// A signature in every frame, from those about machines that do not drift.
    fn in_frames<E>(&self, of: impl Fn(&Self) -> Result<Signature, E>) -> Result<Signature, E> {
        let middle = of(self)?;
        let Some(ends) = self.ends.as_deref() else { return Ok(middle) };
        Ok(drift::signature([of(&ends[0])?, of(&ends[1])?], middle, self.drives))
    }

    /// What monitors with effects that are in the machine already make of a change of the orbit.
    fn as_read(&self, mut signature: Signature) -> Signature {
        self.machine.monitors.iter().for_each(|reading| reading.of_signature(self, &mut signature.readings));
        signature
    }

    /// Index of a monitor among those that are read.
    pub(super) fn read(&self, monitor: usize) -> Option<usize> {
        self.machine.ring.read_monitors.iter().position(|&at| at == monitor)
    }

    /// Positions at a monitor in its plane, of each frame [m].
    pub(super) fn position(&self, monitor: usize) -> DVector<f64> {
        self.positions[self.machine.ring.monitors[monitor].plane.index()].column(monitor).into_owned()
    }

    /// No change.
    pub(super) fn nothing(&self) -> Signature {
        let readings = DMatrix::zeros(self.kick.nrows(), self.observers.len());
        Signature { readings, tunes: [0.0; 2], tune_changes: self.no_tune_changes() }
    }

    fn no_tune_changes(&self) -> MatrixXx2<f64> {
        MatrixXx2::zeros(self.kick.nrows())
    }

    /// A change of gradient by `scale`.
    pub(super) fn of_gradient(&self, gradient: &Gradient, scale: f64) -> Signature {
        self.of_gradients([(*gradient, scale)])
    }

    /// The same of several at once.
    pub(super) fn of_gradients(&self, gradients: impl IntoIterator<Item = (Gradient, f64)>) -> Signature {
        let monitors = self.observers.len();
        let (mut response, mut rf) = (DMatrix::zeros(monitors, self.sources.len()), DVector::zeros(monitors));
        let mut tunes = [0.0; 2];
        for (gradient, scale) in gradients {
            response += self.held.jacobian(&self.optics, &self.observers, &self.sources, &gradient) * scale;
            rf += self.held.rf_jacobian(&self.optics, &self.observers, &gradient) * scale;
            let slope = self.optics.tune_slope(&gradient);
            tunes.iter_mut().zip(slope).for_each(|(to, slope)| *to += slope * scale);
        }
        let mut readings = &self.kick * response.transpose();
        readings.ger(1.0, &self.drives.rf_offset, &rf, 1.0);
        Signature { readings, tunes, tune_changes: self.no_tune_changes() }
    }

    /// Difference of the linear optics of two machines, per unit of the amplitude: central, or against none without one.
    ///
    /// # Errors
    /// [`EffectError`] if one of them is unstable, or the site none where it can act.
    pub fn difference<M: Mechanism + ?Sized>(&self, mechanism: &M, site: Site) -> Result<Signature, EffectError> {
        let with = |amplitude: f64| {
            let mut changed = self.machine.clone();
            changed.add(mechanism, site, amplitude)?;
            Ok::<_, EffectError>(changed)
        };
        let (up, down, width) = match mechanism.prior_scale().map(|scale| scale / STEPS) {
            Some(step) => (with(step)?, &with(-step)?, 2.0 * step),
            None => (with(1.0)?, self.machine, 1.0),
        };
        let unstable = |error| EffectError::Orbit { effect: mechanism.word(), error };
        let seen = |machine: &Machine| machine.seen(&machine.ring).map_err(unstable);
        let (up, down) = (seen(&up)?, seen(down)?);
        let readings = |seen: &Seen| self.machine.ring.own_planes(&self.drives.positions(seen, &self.kick));
        let tunes = [up.tunes.x - down.tunes.x, up.tunes.y - down.tunes.y].map(|change| change / width);
        let readings = (readings(&up) - readings(&down)) / width;
        Ok(Signature { readings, tunes, tune_changes: self.no_tune_changes() })
    }
}
