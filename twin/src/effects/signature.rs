//! Derivative of the readings with respect to the amplitude of an effect: what a small one looks like.
//!
//! Gradients of any kind (stray, skew, of a dipole, of its edges, of a rolled quadrupole, of a sextupole through the orbit)
//! are one formula, `dR = -a (W + step) Q (W + step) c` of [`crate::response`]; instruments act on rows and columns; what
//! the ring holds constant is a difference of two exact responses. An effect without an amplitude (a reversed corrector,
//! exchanged monitors, a held frequency) has its whole change instead.

use nalgebra::{DMatrix, DVector, RowDVector};

use super::drives::{Drives, Seen, curved};
use super::held::Held;
use super::machine::{Instrument, Machine};
use super::{Effect, EffectError, EffectKind};
use crate::lattice::{Kind, Parameter, Plane, Quadrupole};
use crate::orbit::{Hold, OrbitError};
use crate::response::{Gradient, Observer, Optics, Place, Source};

/// A machine linearised for the signatures of further effects.
#[derive(Debug)]
pub struct Signatures<'m> {
    machine: &'m Machine,
    drives: &'m Drives,
    optics: Optics<'m>,
    held: Held<'m>,
    /// Read monitors, each in its plane.
    observers: Vec<Observer>,
    sources: Vec<Source>,
    /// Kicks that the frames really had.
    kick: DMatrix<f64>,
    /// Positions at all monitor places, rows frames [m].
    x: DMatrix<f64>,
    y: DMatrix<f64>,
    /// Response of the read monitors, the RF frequency last.
    response: DMatrix<f64>,
    monitors: Vec<(Plane, usize)>,
}

/// What a small effect does per unit of its amplitude.
#[derive(Debug, Clone)]
pub struct Signature {
    /// To the readings, rows frames, columns read monitors [m].
    pub readings: DMatrix<f64>,
    /// To the tunes.
    pub tunes: [f64; 2],
    /// To the tunes at the end of the campaign against its middle.
    pub tune_drift: [f64; 2],
}

impl Signature {
    fn add(&mut self, other: Self) {
        self.readings += other.readings;
        (0..2).for_each(|plane| {
            self.tunes[plane] += other.tunes[plane];
            self.tune_drift[plane] += other.tune_drift[plane];
        });
    }

    /// Readings and, as two more columns, the tunes of every frame.
    pub fn by_frame(self, time: &DVector<f64>) -> DMatrix<f64> {
        let monitors = self.readings.ncols();
        let mut all = self.readings.insert_columns(monitors, 2, 0.0);
        for plane in 0..2 {
            let tune = time.map(|t| self.tunes[plane] + self.tune_drift[plane] * t);
            all.set_column(monitors + plane, &tune);
        }
        all
    }
}

/// Momentum step for a numerical derivative [1].
const STEP: f64 = 1e-4;

impl<'m> Signatures<'m> {
    /// Linearise.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn of(machine: &'m Machine, drives: &'m Drives) -> Result<Self, OrbitError> {
        let optics = Optics::of(&machine.ring, Hold::Momentum { delta: machine.delta })?;
        let held = Held::of(&machine.ring, &optics, machine.frequency_share, machine.radial_loop)?;
        let seen = machine.seen(&machine.ring)?;
        let kick = machine.kicks(drives);
        let (x, y) = drives.positions(&seen, &kick);
        let monitors: Vec<(Plane, usize)> =
            machine.ring.read_monitors.iter().map(|&place| (machine.ring.monitors[place].plane, place)).collect();
        let rows: Vec<RowDVector<f64>> = monitors
            .iter()
            .map(|&(plane, place)| if plane == Plane::X { seen.x.row(place) } else { seen.y.row(place) }.into_owned())
            .collect();
        let (observers, sources) = (optics.read_monitors(), optics.correctors());
        let response = DMatrix::from_rows(&rows);
        Ok(Self { machine, drives, optics, held, observers, sources, kick, x, y, response, monitors })
    }

    /// Derivative of readings and tunes with respect to each param, the `ln` of a factor.
    pub fn of_vars(&self) -> Vec<Signature> {
        let of_quadrupoles: Vec<_> = self.of_quadrupoles().map(|signature| self.as_read(signature)).collect();
        let sum = |parameter: &Parameter| {
            let mut sum = self.nothing();
            parameter.quadrupoles.iter().for_each(|&q| sum.add(of_quadrupoles[q].clone()));
            sum
        };
        self.machine.ring.parameters.iter().map(sum).collect()
    }

    /// Derivative of the orbit itself with respect to `ln` of each quadrupole's gradient.
    fn of_quadrupoles(&self) -> impl Iterator<Item = Signature> {
        let ring = &self.machine.ring;
        let one = |(q, k1): (&Quadrupole, f64)| self.of_gradient(&self.optics.gradient(q.element), k1);
        ring.quadrupoles.iter().zip(ring.gradients()).map(one)
    }

    /// Derivative with respect to a gradient (normal, or skew) [1/m] at any place of the ring.
    pub fn of_thin(&self, place: Place, kind: EffectKind) -> Signature {
        self.as_read(self.unread_thin(place, kind))
    }

    /// The same, of the orbit itself.
    fn unread_thin(&self, place: Place, kind: EffectKind) -> Signature {
        let gradient = match kind {
            EffectKind::StraySkewGradient => self.optics.thin_skew_gradient(place),
            _ => self.optics.thin_gradient(place),
        };
        self.of_gradient(&gradient, 1.0)
    }

    /// What kicks and RF offset do to the orbit at the place of a read monitor: its position and slope in the monitor's plane,
    /// then in the other, rows frames [m, rad]. But for dispersion, the orbit anywhere near is a sum of these where no kick is in
    /// between.
    pub fn around(&self, b: usize) -> DMatrix<f64> {
        let (plane, place) = self.monitors[b];
        let at = self.machine.ring.monitors[place].element;
        let (own, other) = match plane {
            Plane::X => (&self.x, &self.y),
            Plane::Y => (&self.y, &self.x),
        };
        let crossed = if plane == Plane::X { Plane::Y } else { Plane::X };
        let slope = |plane| {
            let observer = self.optics.observe_slope(at, plane);
            let response = self.held.response(&self.optics, &[observer], &self.sources);
            let rf = -self.optics.dispersion(&observer) / self.optics.slip_factor();
            (&self.kick * response.transpose() + &self.drives.rf_offset * rf).column(0).into_owned()
        };
        DMatrix::from_columns(&[
            own.column(place).into_owned(),
            slope(plane),
            other.column(place).into_owned(),
            slope(crossed),
        ])
    }

    /// What the read monitors see of a step of the beam in x, x', y and y' at a corrector, columns the four [1, m/rad]. A kick
    /// anywhere near is a sum of these, but for monitors in between.
    pub fn beside(&self, corrector: usize) -> DMatrix<f64> {
        let at = self.machine.ring.correctors[corrector].element;
        let step = |i: usize| self.optics.step(at, core::array::from_fn(|j| f64::from(u8::from(i == j))));
        self.held.response(&self.optics, &self.observers, &[0, 1, 2, 3].map(step))
    }

    /// What gains and exchanged names, already in the machine, make of a change of the orbit.
    fn as_read(&self, mut signature: Signature) -> Signature {
        let of = |plane, place| self.monitors.iter().position(|m| *m == (plane, place));
        for instrument in &self.machine.instruments {
            match *instrument {
                Instrument::Gain { plane, place, error } => {
                    if let Some(b) = of(plane, place) {
                        signature.readings.column_mut(b).apply(|r| *r *= 1.0 + error);
                    }
                }
                Instrument::Swap { plane, places: [one, other] } => {
                    if let (Some(i), Some(j)) = (of(plane, one), of(plane, other)) {
                        signature.readings.swap_columns(i, j);
                    }
                }
                _ => {}
            }
        }
        signature
    }

    /// The signature of an effect of unit amplitude.
    ///
    /// # Errors
    /// [`EffectError`] if the ring has no such place; [`OrbitError`], as its text, where it makes the ring unstable.
    pub fn of_effect(&self, kind: EffectKind, place: &str) -> Result<Signature, EffectError> {
        self.unread(kind, place).map(|signature| self.as_read(signature))
    }

    fn unread(&self, kind: EffectKind, place: &str) -> Result<Signature, EffectError> {
        let effect = Effect { kind, place: place.into(), amplitude: 1.0 };
        let machine = self.machine;
        let ring = &machine.ring;
        let element = |name: &str| ring.element(name).map_err(EffectError::from);
        Ok(match kind {
            EffectKind::BpmGain => {
                let (b, ..) = self.monitor(&effect, place)?;
                self.of_monitor(b, self.position(b))
            }
            EffectKind::BpmRoll => {
                let (b, plane, at) = self.monitor(&effect, place)?;
                let other = if plane == Plane::X { self.y.column(at).into_owned() } else { -self.x.column(at) };
                self.of_monitor(b, other)
            }
            EffectKind::BpmCubic => {
                let (b, plane, at) = self.monitor(&effect, place)?;
                let base = self.drives.orbit[ring.monitors[at].element][usize::from(plane == Plane::Y)];
                let cube = |p: f64| p * (p * 1e3).powi(2);
                self.of_monitor(b, self.position(b).map(|p| cube(base + p) - cube(base)))
            }
            EffectKind::BpmSwap => {
                let (one, other) = place.split_once(',').ok_or_else(|| effect.wrong("two monitors"))?;
                let (i, j) = (self.monitor(&effect, one)?.0, self.monitor(&effect, other)?.0);
                let difference = self.position(j) - self.position(i);
                let mut signature = self.of_monitor(i, difference.clone());
                signature.readings.set_column(j, &-difference);
                signature
            }
            EffectKind::CorrectorGain => self.of_corrector(machine.corrector(&effect)?, |k| k),
            EffectKind::CorrectorPolarity => self.of_corrector(machine.corrector(&effect)?, |k| -2.0 * k),
            EffectKind::CorrectorEven => {
                let nominal = self.drives.nominal_kick;
                self.of_corrector(machine.corrector(&effect)?, |k| k * k / nominal)
            }
            EffectKind::CorrectorRoll => {
                let c = machine.corrector(&effect)?;
                let turned = if ring.correctors[c].plane == Plane::X { [0.0, 1.0] } else { [-1.0, 0.0] };
                let source = self.optics.kick(ring.correctors[c].element, turned);
                self.of_kick(
                    c,
                    self.held.response(&self.optics, &self.observers, &[source]).column(0).into_owned(),
                    |k| k,
                )
            }
            EffectKind::QuadRoll => {
                let at = ring.quadrupoles[ring.quadrupole(place)?].element;
                let Kind::Quadrupole { k1 } = ring.elements[at].kind else { return Err(effect.wrong("a quadrupole")) };
                // x'' = -k1 (x cos 2a + y sin 2a)
                self.of_gradient(&self.optics.skew_gradient(at), -2.0 * k1)
            }
            EffectKind::StrayGradient | EffectKind::StraySkewGradient => self.unread_thin(element(place)?.into(), kind),
            EffectKind::DipoleGradient => {
                let at = element(place)?;
                self.of_gradient(&self.optics.gradient(at), 1.0 / ring.elements[at].length)
            }
            EffectKind::DipoleEdge => self.of_edges(&effect)?,
            EffectKind::MomentumOffset => self.of_slope(&effect)?,
            EffectKind::FixedRfFrequency | EffectKind::RadialLoop => self.of_change(&effect)?,
            EffectKind::SextupoleError => self.of_sextupole(&effect)?,
            EffectKind::QuadDrift => self.of_drift(),
        })
    }

    /// Index among the read monitors, plane and place.
    fn monitor(&self, effect: &Effect, name: &str) -> Result<(usize, Plane, usize), EffectError> {
        let at = self.machine.monitor(effect, name)?;
        let read = self.monitors.iter().position(|m| *m == at);
        Ok((read.ok_or_else(|| effect.wrong("a monitor that is read"))?, at.0, at.1))
    }

    fn position(&self, b: usize) -> DVector<f64> {
        let (plane, place) = self.monitors[b];
        if plane == Plane::X { self.x.column(place).into_owned() } else { self.y.column(place).into_owned() }
    }

    fn of_monitor(&self, b: usize, change: DVector<f64>) -> Signature {
        let mut signature = self.nothing();
        signature.readings.set_column(b, &change);
        signature
    }

    fn of_corrector(&self, corrector: usize, change: impl Fn(f64) -> f64) -> Signature {
        self.of_kick(corrector, self.response.column(corrector).into_owned(), change)
    }

    fn of_kick(&self, corrector: usize, response: DVector<f64>, change: impl Fn(f64) -> f64) -> Signature {
        let kick = self.kick.column(corrector).map(change);
        Signature { readings: kick * response.transpose(), tunes: [0.0; 2], tune_drift: [0.0; 2] }
    }

    /// A change of gradient by `scale`.
    fn of_gradient(&self, gradient: &Gradient, scale: f64) -> Signature {
        let gradients = core::slice::from_ref(gradient);
        let response = self.held.jacobian(&self.optics, &self.observers, &self.sources, gradient);
        let mut readings = &self.kick * response.transpose() * scale;
        let rf = self.optics.rf_jacobian(&self.observers, gradients) * scale;
        readings.ger(1.0, &self.drives.rf_offset, &rf.column(0), 1.0);
        Signature { readings, tunes: self.optics.tune_slope(gradient).map(|t| t * scale), tune_drift: [0.0; 2] }
    }

    /// Pole faces of one dipole, or of all: to first order an edge of angle e is a thin gradient of `-h tan e`, h the bend's
    /// curvature. That a soft fringe focuses y a little less is left out.
    fn of_edges(&self, effect: &Effect) -> Result<Signature, EffectError> {
        let mut sum = self.nothing();
        for at in self.machine.bends(effect)? {
            let element = &self.machine.ring.elements[at];
            let Kind::Bend(bend) = &element.kind else { continue };
            for (depth, angle) in [(0.0, bend.e1), (element.length, bend.e2)] {
                let gradient = self.optics.thin_gradient(Place { element: at, depth });
                sum.add(self.of_gradient(&gradient, -bend.curvature / angle.cos().powi(2)));
            }
        }
        Ok(sum)
    }

    fn nothing(&self) -> Signature {
        let readings = DMatrix::zeros(self.kick.nrows(), self.monitors.len());
        Signature { readings, tunes: [0.0; 2], tune_drift: [0.0; 2] }
    }

    /// Central difference of two exact responses.
    fn of_slope(&self, effect: &Effect) -> Result<Signature, EffectError> {
        self.between(&self.with(effect, STEP)?, &self.with(effect, -STEP)?, 2.0 * STEP, effect)
    }

    /// Whole change of the exact response.
    fn of_change(&self, effect: &Effect) -> Result<Signature, EffectError> {
        self.between(&self.with(effect, 1.0)?, self.machine, 1.0, effect)
    }

    /// The machine with one more effect.
    fn with(&self, effect: &Effect, amplitude: f64) -> Result<Machine, EffectError> {
        let mut changed = self.machine.clone();
        changed.apply(&Effect { amplitude, ..effect.clone() })?;
        Ok(changed)
    }

    fn between(&self, up: &Machine, down: &Machine, width: f64, effect: &Effect) -> Result<Signature, EffectError> {
        let unstable = |error| EffectError::Orbit { effect: effect.kind.word(), error };
        let seen = |machine: &Machine| machine.seen(&machine.ring).map_err(unstable);
        let (up, down) = (seen(up)?, seen(down)?);
        let positions = |seen: &Seen| {
            let (x, y) = self.drives.positions(seen, &self.kick);
            self.machine.own_planes(&x, &y)
        };
        let tunes = [(up.tunes.x - down.tunes.x) / width, (up.tunes.y - down.tunes.y) / width];
        Ok(Signature { readings: (positions(&up) - positions(&down)) / width, tunes, tune_drift: [0.0; 2] })
    }

    /// Feed-down of the orbit that passes a sextupole, and the quadratic kick of the orbit that the correctors add.
    fn of_sextupole(&self, effect: &Effect) -> Result<Signature, EffectError> {
        let ring = &self.machine.ring;
        let changed = self.with(effect, 1.0)?;
        let Some(&(at, k2l)) = changed.sextupoles.last() else { return Err(effect.wrong("a sextupole")) };
        let [x, y] = self.drives.orbit[at];
        let per_length = 1.0 / ring.elements[at].length;
        let mut signature = self.of_gradient(&self.optics.gradient(at), k2l * x * per_length);
        signature.readings += self.of_gradient(&self.optics.skew_gradient(at), k2l * y * per_length).readings;
        let curved = curved(ring, at, k2l, self.drives, &self.kick);
        let [x, y] = curved.map_err(|error| EffectError::Orbit { effect: effect.kind.word(), error })?;
        signature.readings += self.machine.own_planes(&x, &y);
        Ok(signature)
    }

    /// All gradients in proportion to the time.
    fn of_drift(&self) -> Signature {
        let mut sum = self.nothing();
        for one in self.of_quadrupoles() {
            sum.readings += one.readings;
            sum.tune_drift = [sum.tune_drift[0] + one.tunes[0], sum.tune_drift[1] + one.tunes[1]];
        }
        sum.readings.row_iter_mut().zip(self.drives.time.iter()).for_each(|(mut row, time)| row *= *time);
        sum
    }
}

impl From<OrbitError> for EffectError {
    fn from(error: OrbitError) -> Self {
        Self::Orbit { effect: "machine", error }
    }
}
