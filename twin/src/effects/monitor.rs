//! Errors of monitors: gain, roll, cubic term, reversed sign, exchanged names.
//!
//! The reading is one function of position and amplitude, [`MonitorEffect::read`]. The reading of a
//! cycle is its value, a frame's is a difference of two values, the response its slope in the position, the signature its slope in
//! the amplitude: the last two by dual numbers.

use nalgebra::{DMatrix, DVector, Matrix2, Vector2};
use num_dual::{first_derivative, jacobian};

use super::mechanism::{Measured, Mechanism, Unit};
use super::{EffectError, Machine, Signature, Signatures};
use crate::lattice::{Plane, Ring};
use crate::map::Scalar;
use crate::site::Site;

/// What is wrong with a monitor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MonitorEffect {
    /// It reads too much by a fraction.
    Gain,
    /// It is rotated [rad]; one that reads both planes is so in both.
    Roll,
    /// It reads `x (1 + a x^2)`, x the true position in mm, before its offset.
    Cubic,
    /// Its sign is reversed.
    Polarity,
    /// Its name and another one's are exchanged.
    Swap,
}

/// What a monitor, or two, do in a machine.
#[derive(Debug, Clone)]
pub(super) enum Reading {
    Distorted { how: MonitorEffect, monitors: Vec<usize>, amplitude: f64 },
    Exchanged { plane: Plane, monitors: [usize; 2] },
}

impl MonitorEffect {
    /// What is read of a position (x, y) [m] by a monitor of this plane.
    fn read<T: Scalar>(self, plane: Plane, amplitude: T, [x, y]: [T; 2]) -> [T; 2] {
        let own = |position: T| match self {
            Self::Gain => position * (amplitude + 1.0),
            Self::Cubic => position + amplitude * (position * 1e3).powi(2) * position,
            Self::Polarity => position * (amplitude * -2.0 + 1.0),
            Self::Roll | Self::Swap => position,
        };
        match (self, plane) {
            (Self::Roll, _) => {
                let (sin, cos) = amplitude.sin_cos();
                [x * cos + y * sin, y * cos - x * sin]
            }
            (_, Plane::X) => [own(x), y],
            (_, Plane::Y) => [x, own(y)],
        }
    }

    /// Slope of the own plane's reading in the amplitude, at amplitude 0.
    fn slope(self, plane: Plane, at: [f64; 2]) -> f64 {
        first_derivative(|amplitude| self.read(plane, amplitude, at.map(Into::into))[plane.index()], 0.0).1
    }

    /// The monitors that one at a site concerns: of a roll, all of the element.
    fn monitors(self, ring: &Ring, monitor: usize) -> Vec<usize> {
        match self {
            Self::Roll => of_element(ring, ring.monitors[monitor].element).collect(),
            Self::Gain | Self::Cubic | Self::Polarity | Self::Swap => vec![monitor],
        }
    }

    /// The factor on small changes in the own plane; those of a roll and of a cubic term are of second order.
    fn factor(self, amplitude: f64) -> f64 {
        match self {
            Self::Gain => 1.0 + amplitude,
            Self::Polarity => 1.0 - 2.0 * amplitude,
            Self::Roll | Self::Cubic | Self::Swap => 1.0,
        }
    }
}

impl Mechanism for MonitorEffect {
    fn word(&self) -> &'static str {
        match self {
            Self::Gain => "bpm_gain",
            Self::Roll => "bpm_roll",
            Self::Cubic => "bpm_cubic",
            Self::Polarity => "bpm_polarity",
            Self::Swap => "bpm_swap",
        }
    }

    /// Gains found by LOCO scatter by 2 to 5 %, faulty ones by 10 %; a bracket's play turns a monitor by 50 mrad; a button monitor is
    /// off by some per cent at 5 mm.
    ///
    /// Source: J. Safranek, NIM A 388 (1997) 27.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::Gain => Some(0.08),
            Self::Roll => Some(0.06),
            Self::Cubic => Some(1.5e-3),
            Self::Polarity | Self::Swap => None,
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::Gain => Unit::PERCENT,
            Self::Roll => Unit::ANGLE,
            Self::Cubic => Unit::PER_SQUARE_MILLIMETRE,
            Self::Polarity | Self::Swap => Unit::NONE,
        }
    }

    fn sites(&self, ring: &Ring) -> Vec<Site> {
        let read = &ring.read_monitors;
        match self {
            Self::Gain | Self::Cubic | Self::Polarity => read.iter().map(|&at| Site::Monitor(at)).collect(),
            Self::Roll => {
                let first = |&&at: &&usize| rolled(ring, at) == at;
                read.iter().filter(first).map(|&at| Site::Monitor(at)).collect()
            }
            Self::Swap => {
                let later = |i: usize| read[i + 1..].iter().map(move |&other| (read[i], other));
                let pairs = (0..read.len()).flat_map(later);
                let of_a_plane =
                    |(one, other): &(usize, usize)| ring.monitors[*one].plane == ring.monitors[*other].plane;
                pairs.filter(of_a_plane).map(|(one, other)| Site::pair(one, other)).collect()
            }
        }
    }

    fn expected(&self) -> &'static str {
        match self {
            Self::Gain | Self::Roll | Self::Cubic | Self::Polarity => "a monitor",
            Self::Swap => "two monitors of one plane",
        }
    }

    fn site(&self, ring: &Ring, name: &str) -> Option<Site> {
        match self {
            Self::Gain | Self::Cubic | Self::Polarity => Site::monitor(ring, name).map(Site::Monitor),
            Self::Roll => either_plane(ring, name).map(|at| Site::Monitor(rolled(ring, at))),
            Self::Swap => {
                let [one, other] = Site::monitors(ring, name)?;
                (ring.monitors[one].plane == ring.monitors[other].plane).then(|| Site::pair(one, other))
            }
        }
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        let ring = &machine.ring;
        machine.monitors.push(match (self, site) {
            (Self::Swap, Site::MonitorPair(one, other)) => {
                Reading::Exchanged { plane: ring.monitors[one].plane, monitors: [one, other] }
            }
            (Self::Gain | Self::Roll | Self::Cubic | Self::Polarity, Site::Monitor(at)) => {
                Reading::Distorted { how: *self, monitors: self.monitors(ring, at), amplitude }
            }
            _ => return Err(self.misplaced(ring, site.name(ring))),
        });
        Ok(())
    }

    fn signature(&self, about: &Signatures, site: Site) -> Result<Signature, EffectError> {
        let ring = &about.machine.ring;
        let silent = || EffectError::Place {
            kind: self.word(),
            expected: "a monitor that is read".into(),
            found: site.name(ring),
        };
        let mut signature = about.nothing();
        match (self, site) {
            (Self::Swap, Site::MonitorPair(one, other)) => {
                let (Some(i), Some(j)) = (about.read(one), about.read(other)) else { return Err(silent()) };
                let difference = about.position(other) - about.position(one);
                signature.readings.set_column(j, &-&difference);
                signature.readings.set_column(i, &difference);
            }
            (Self::Gain | Self::Roll | Self::Cubic | Self::Polarity, Site::Monitor(at)) => {
                let read =
                    self.monitors(ring, at).into_iter().filter_map(|monitor| Some((monitor, about.read(monitor)?)));
                let read: Vec<(usize, usize)> = read.collect();
                if read.is_empty() {
                    return Err(silent());
                }
                read.into_iter()
                    .for_each(|(monitor, b)| signature.readings.set_column(b, &self.distortion(about, monitor)));
            }
            _ => return Err(self.misplaced(ring, site.name(ring))),
        }
        Ok(signature)
    }

    fn orbit(&self, ring: &Ring, site: Site) -> Vec<(usize, Plane)> {
        match (self, site) {
            (Self::Cubic, Site::Monitor(at)) => vec![(ring.monitors[at].element, ring.monitors[at].plane)],
            _ => Vec::new(),
        }
    }

    fn phrase(&self, ring: &Ring, site: Site, amplitude: Measured) -> String {
        let name = site.name(ring);
        match self {
            Self::Gain => format!("BPM {name} reads {} % {}", amplitude.size(100.0), amplitude.by_sign("high", "low")),
            Self::Roll => format!("BPM {name} is rolled by {} mrad", amplitude.signed(1e3)),
            // at 5 mm, in percent
            Self::Cubic => {
                format!("BPM {name} is not linear: {} % of the position at 5 mm", amplitude.signed(25.0 * 100.0))
            }
            Self::Polarity => format!("BPM {name} reads with the wrong sign"),
            Self::Swap => format!("BPMs {} are exchanged", site.names(ring).join(" and ")),
        }
    }
}

impl MonitorEffect {
    /// Change of a monitor's readings per unit of the amplitude, rows frames [m].
    fn distortion(self, about: &Signatures, monitor: usize) -> DVector<f64> {
        let crate::Monitor { element, plane } = about.machine.ring.monitors[monitor];
        let base = about.drives.orbit[element];
        let still = self.slope(plane, base);
        let [x, y] = [0, 1].map(|plane| about.positions[plane].column(monitor));
        x.zip_map(&y, |x, y| self.slope(plane, [base[0] + x, base[1] + y]) - still)
    }
}

impl Reading {
    /// What is read of orbits (x, y) at all monitors [m].
    pub fn of_orbit(&self, ring: &Ring, at: &mut [[f64; 2]]) {
        match self {
            Self::Distorted { how, monitors, amplitude } => {
                monitors.iter().for_each(|&i| at[i] = how.read(ring.monitors[i].plane, *amplitude, at[i]));
            }
            Self::Exchanged { plane, monitors: [one, other] } => {
                let plane = plane.index();
                (at[*one][plane], at[*other][plane]) = (at[*other][plane], at[*one][plane]);
            }
        }
    }

    /// The same of changes of the orbit, x and y, rows frames, columns monitors [m], about one without kicks, which is read too.
    pub fn of_changes(&self, ring: &Ring, base: &mut [[f64; 2]], changes: &mut [DMatrix<f64>; 2]) {
        match self {
            Self::Distorted { how, monitors, amplitude } => {
                for &i in monitors {
                    let read = |at| how.read(ring.monitors[i].plane, *amplitude, at);
                    let ([x0, y0], still) = (base[i], read(base[i]));
                    let [x, y] = changes;
                    for (x, y) in x.column_mut(i).iter_mut().zip(y.column_mut(i).iter_mut()) {
                        let at = read([x0 + *x, y0 + *y]);
                        (*x, *y) = (at[0] - still[0], at[1] - still[1]);
                    }
                }
            }
            Self::Exchanged { plane, monitors: [one, other] } => changes[plane.index()].swap_columns(*one, *other),
        }
        self.of_orbit(ring, base);
    }

    /// The same of a response, rows monitors.
    pub fn of_response(&self, ring: &Ring, base: &mut [[f64; 2]], response: &mut [DMatrix<f64>; 2]) {
        match self {
            Self::Distorted { how, monitors, amplitude } => {
                for &i in monitors {
                    let slope = slope(*how, ring.monitors[i].plane, *amplitude, base[i]);
                    let [x, y] = response;
                    for (x, y) in x.row_mut(i).iter_mut().zip(y.row_mut(i).iter_mut()) {
                        let read = slope * Vector2::new(*x, *y);
                        (*x, *y) = (read.x, read.y);
                    }
                }
            }
            Self::Exchanged { plane, monitors: [one, other] } => response[plane.index()].swap_rows(*one, *other),
        }
        self.of_orbit(ring, base);
    }

    /// What is read of a change of the orbit, of the read monitors each in its plane, columns monitors, to first order in all amplitudes but
    /// a gain's.
    pub fn of_signature(&self, about: &Signatures, readings: &mut DMatrix<f64>) {
        match self {
            Self::Distorted { how, monitors, amplitude } => {
                let read = monitors.iter().filter_map(|&monitor| about.read(monitor));
                read.for_each(|b| readings.column_mut(b).apply(|r| *r *= how.factor(*amplitude)));
            }
            Self::Exchanged { monitors: [one, other], .. } => {
                if let (Some(i), Some(j)) = (about.read(*one), about.read(*other)) {
                    readings.swap_columns(i, j);
                }
            }
        }
    }
}

/// Derivative of what is read with respect to the position (x, y).
fn slope(how: MonitorEffect, plane: Plane, amplitude: f64, at: [f64; 2]) -> Matrix2<f64> {
    jacobian(|at: Vector2<_>| Vector2::from(how.read(plane, amplitude.into(), [at.x, at.y])), &Vector2::from(at)).1
}

/// The monitors of an element.
fn of_element(ring: &Ring, element: usize) -> impl Iterator<Item = usize> {
    (0..ring.monitors.len()).filter(move |&at| ring.monitors[at].element == element)
}

/// The monitor that a rolled one is named after: the first of its element that is read.
fn rolled(ring: &Ring, monitor: usize) -> usize {
    let mut of_it = of_element(ring, ring.monitors[monitor].element);
    of_it.find(|at| ring.read_monitors.contains(at)).unwrap_or(monitor)
}

/// The monitor of a name, or the one of the same name in the other plane, which a roll turns into this one.
fn either_plane(ring: &Ring, name: &str) -> Option<usize> {
    let crossed = || match name.split_once('_')? {
        ("x", rest) => ring.monitor(Plane::Y, rest).ok(),
        ("y", rest) => ring.monitor(Plane::X, rest).ok(),
        _ => None,
    };
    Site::monitor(ring, name).or_else(crossed)
}
