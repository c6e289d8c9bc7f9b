//! Errors of monitors: gain, roll, coupling, cubic term, reversed sign, none of the beam, exchanged names, a share of another monitor or of the frame before.
//!
//! Of the first six the reading is one function of position and amplitude, [`MonitorEffect::read`]. The reading of a
//! cycle is its value, a frame's is a difference of two values, the response its slope in the position, the signature its slope in
//! the amplitude: the last two by dual numbers. The others are linear in the positions: a monitor with crosstalk reads `x + a x_next`,
//! one that is late `(1 - a) x_k + a x_(k-1)` in frame k, and the signature is what `a` multiplies.

use nalgebra::{DMatrix, DVector, DVectorView, Matrix2, Vector2};
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
    /// One of both planes reads a share of the other plane as well, `x + a y` or `y + a x`, as where buttons differ.
    Coupling,
    /// It reads `x (1 + a x^2)`, x the true position in mm, before its offset.
    Cubic,
    /// Its sign is reversed.
    Polarity,
    /// It does not see the beam.
    Dead,
    /// Its name and another one's are exchanged.
    Swap,
    /// It reads a share of the next one of its plane as well, in the order of reading, the last one of the first.
    Crosstalk,
    /// It reads a share of the frame before instead of its own; of the first frame nothing else.
    Timing,
}

/// What a monitor, or two, do in a machine.
#[derive(Debug, Clone)]
pub(super) enum Reading {
    Distorted { how: MonitorEffect, monitors: Vec<usize>, amplitude: f64 },
    Exchanged { plane: Plane, monitors: [usize; 2] },
    Mixed { plane: Plane, monitor: usize, from: usize, share: f64 },
    Late { plane: Plane, monitor: usize, share: f64 },
}

impl MonitorEffect {
    /// What is read of a position (x, y) [m] by a monitor of this plane.
    fn read<T: Scalar>(self, plane: Plane, amplitude: T, [x, y]: [T; 2]) -> [T; 2] {
        let own = |position: T| match self {
            Self::Gain => position * (amplitude + 1.0),
            Self::Cubic => position + amplitude * (position * 1e3).powi(2) * position,
            Self::Polarity => position * (amplitude * -2.0 + 1.0),
            Self::Dead => position * (-amplitude + 1.0),
            Self::Roll | Self::Coupling | Self::Swap | Self::Crosstalk | Self::Timing => position,
        };
        match (self, plane) {
            (Self::Roll, _) => {
                let (sin, cos) = amplitude.sin_cos();
                [x * cos + y * sin, y * cos - x * sin]
            }
            (Self::Coupling, Plane::X) => [x + amplitude * y, y],
            (Self::Coupling, Plane::Y) => [x, y + amplitude * x],
            (_, Plane::X) => [own(x), y],
            (_, Plane::Y) => [x, own(y)],
        }
    }

    /// What is read beyond a position in its own plane [m].
    pub(super) fn misreads(self, amplitude: f64, position: f64) -> f64 {
        self.read(Plane::X, amplitude, [position, 0.0])[0] - position
    }

    /// Slope of the own plane's reading in the amplitude, at amplitude 0.
    fn slope(self, plane: Plane, at: [f64; 2]) -> f64 {
        first_derivative(|amplitude| self.read(plane, amplitude, at.map(Into::into))[plane.index()], 0.0).1
    }

    /// The monitors that one at a site concerns: of a roll, all of the element.
    fn monitors(self, ring: &Ring, monitor: usize) -> Vec<usize> {
        match self {
            Self::Roll => of_element(ring, ring.monitors[monitor].element).collect(),
            Self::Gain
            | Self::Coupling
            | Self::Cubic
            | Self::Polarity
            | Self::Dead
            | Self::Swap
            | Self::Crosstalk
            | Self::Timing => vec![monitor],
        }
    }

    /// The factor on small changes in the own plane; those of a roll and of a cubic term are of second order.
    fn factor(self, amplitude: f64) -> f64 {
        match self {
            Self::Gain => 1.0 + amplitude,
            Self::Polarity => 1.0 - 2.0 * amplitude,
            Self::Dead => 1.0 - amplitude,
            Self::Roll | Self::Coupling | Self::Cubic | Self::Swap | Self::Crosstalk | Self::Timing => 1.0,
        }
    }
}

impl Mechanism for MonitorEffect {
    fn word(&self) -> &'static str {
        match self {
            Self::Gain => "bpm_gain",
            Self::Roll => "bpm_roll",
            Self::Coupling => "bpm_coupling",
            Self::Cubic => "bpm_cubic",
            Self::Polarity => "bpm_polarity",
            Self::Dead => "bpm_dead",
            Self::Swap => "bpm_swap",
            Self::Crosstalk => "bpm_crosstalk",
            Self::Timing => "bpm_timing",
        }
    }

    /// Gains found by LOCO scatter by 2 to 5 %, faulty ones by 10 %; a bracket's play turns a monitor by 50 mrad; buttons of unlike gains, or cables of
    /// unlike loss, give each plane some per cent of the other; a button monitor is
    /// off by some per cent at 5 mm; channels of one crate are 40 dB apart, and a lost screen leaves 26 dB, 5 %; a gate that is set to the
    /// wrong turn takes a fifth of its time from the frame before.
    ///
    /// Source: J. Safranek, NIM A 388 (1997) 27.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::Gain => Some(0.08),
            Self::Roll => Some(0.06),
            Self::Cubic => Some(1.5e-3),
            Self::Coupling | Self::Crosstalk => Some(0.05),
            Self::Timing => Some(0.2),
            Self::Polarity | Self::Dead | Self::Swap => None,
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::Gain | Self::Coupling | Self::Crosstalk | Self::Timing => Unit::PERCENT,
            Self::Roll => Unit::ANGLE,
            Self::Cubic => Unit::PER_SQUARE_MILLIMETRE,
            Self::Polarity | Self::Dead | Self::Swap => Unit::NONE,
        }
    }

    fn sites(&self, ring: &Ring) -> Vec<Site> {
        let read = &ring.read_monitors;
        match self {
            Self::Gain | Self::Cubic | Self::Polarity | Self::Dead | Self::Timing => {
                read.iter().map(|&at| Site::Monitor(at)).collect()
            }
            Self::Coupling => {
                let of_both = |&&at: &&usize| other_plane(ring, at).is_some();
                read.iter().filter(of_both).map(|&at| Site::Monitor(at)).collect()
            }
            Self::Crosstalk => {
                let has_next = |&&at: &&usize| next(ring, at).is_some();
                read.iter().filter(has_next).map(|&at| Site::Monitor(at)).collect()
            }
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
            Self::Gain | Self::Roll | Self::Cubic | Self::Polarity | Self::Dead | Self::Timing => "a monitor",
            Self::Coupling => "a monitor that reads both planes",
            Self::Crosstalk => "a monitor with another one in its plane",
            Self::Swap => "two monitors of one plane",
        }
    }

    fn site(&self, ring: &Ring, name: &str) -> Option<Site> {
        match self {
            Self::Gain | Self::Cubic | Self::Polarity | Self::Dead | Self::Timing => {
                Site::monitor(ring, name).map(Site::Monitor)
            }
            Self::Coupling => {
                Site::monitor(ring, name).filter(|&at| other_plane(ring, at).is_some()).map(Site::Monitor)
            }
            Self::Crosstalk => Site::monitor(ring, name).filter(|&at| next(ring, at).is_some()).map(Site::Monitor),
            Self::Roll => either_plane(ring, name).map(|at| Site::Monitor(rolled(ring, at))),
            Self::Swap => {
                let [one, other] = Site::monitors(ring, name)?;
                (ring.monitors[one].plane == ring.monitors[other].plane).then(|| Site::pair(one, other))
            }
        }
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        let ring = &machine.ring;
        let misplaced = || self.misplaced(ring, site.name(ring));
        machine.monitors.push(match (self, site) {
            (Self::Coupling, Site::Monitor(at)) if other_plane(ring, at).is_none() => return Err(misplaced()),
            (Self::Swap, Site::MonitorPair(one, other)) => {
                Reading::Exchanged { plane: ring.monitors[one].plane, monitors: [one, other] }
            }
            (
                Self::Gain | Self::Roll | Self::Coupling | Self::Cubic | Self::Polarity | Self::Dead,
                Site::Monitor(at),
            ) => Reading::Distorted { how: *self, monitors: self.monitors(ring, at), amplitude },
            (Self::Crosstalk, Site::Monitor(monitor)) => {
                let (plane, from) = (ring.monitors[monitor].plane, next(ring, monitor).ok_or_else(misplaced)?);
                Reading::Mixed { plane, monitor, from, share: amplitude }
            }
            (Self::Timing, Site::Monitor(monitor)) => {
                Reading::Late { plane: ring.monitors[monitor].plane, monitor, share: amplitude }
            }
            _ => return Err(misplaced()),
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
            (
                Self::Gain | Self::Roll | Self::Coupling | Self::Cubic | Self::Polarity | Self::Dead,
                Site::Monitor(at),
            ) => {
                let read =
                    self.monitors(ring, at).into_iter().filter_map(|monitor| Some((monitor, about.read(monitor)?)));
                let read: Vec<(usize, usize)> = read.collect();
                if read.is_empty() {
                    return Err(silent());
                }
                read.into_iter()
                    .for_each(|(monitor, b)| signature.readings.set_column(b, &self.distortion(about, monitor)));
            }
            (Self::Crosstalk | Self::Timing, Site::Monitor(at)) => {
                let b = about.read(at).ok_or_else(silent)?;
                let change = match self {
                    Self::Crosstalk => about.position(next(ring, at).ok_or_else(silent)?),
                    _ => coming(&about.position(at).as_view()),
                };
                signature.readings.set_column(b, &change);
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
            Self::Dead => format!("BPM {name} does not see the beam"),
            Self::Swap => format!("BPMs {} are exchanged", site.names(ring).join(" and ")),
            Self::Coupling | Self::Crosstalk => {
                let Site::Monitor(at) = site else { unreachable!("it acts on monitors") };
                let other = if *self == Self::Coupling { other_plane(ring, at) } else { next(ring, at) };
                let other = other.map_or_else(String::new, |other| ring.monitor_name(other));
                format!("BPM {name} reads {} % of {other} as well", amplitude.signed(100.0))
            }
            Self::Timing => format!("{} % of what BPM {name} reads is the frame before", amplitude.signed(100.0)),
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
    /// What is read of an orbit (x, y) at all monitors that stays [m].
    pub fn of_orbit(&self, ring: &Ring, at: &mut [[f64; 2]]) {
        match self {
            Self::Distorted { how, monitors, amplitude } => {
                monitors.iter().for_each(|&i| at[i] = how.read(ring.monitors[i].plane, *amplitude, at[i]));
            }
            Self::Exchanged { plane, monitors: [one, other] } => {
                let plane = plane.index();
                (at[*one][plane], at[*other][plane]) = (at[*other][plane], at[*one][plane]);
            }
            Self::Mixed { plane, monitor, from, share } => {
                at[*monitor][plane.index()] += share * at[*from][plane.index()];
            }
            Self::Late { .. } => {}
        }
    }

    /// The same of changes of the orbit, x and y, rows frames in the order of time, columns monitors [m], about one without kicks, which is
    /// read too.
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
            Self::Mixed { plane, monitor, from, share } => mix(&mut changes[plane.index()], *monitor, *from, *share),
            Self::Late { plane, monitor, share } => delay(&mut changes[plane.index()], *monitor, *share),
        }
        self.of_orbit(ring, base);
    }

    /// The same of a response, rows monitors, every kick held until no monitor reads the one before.
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
            Self::Mixed { plane, monitor, from, share } => {
                let response = &mut response[plane.index()];
                let more = response.row(*from) * *share;
                let mut row = response.row_mut(*monitor);
                row += more;
            }
            Self::Late { .. } => {}
        }
        self.of_orbit(ring, base);
    }

    /// What is read of a change of the orbit, of the read monitors each in its plane, columns monitors, to first order in all amplitudes but
    /// a gain's and a share's.
    pub fn of_signature(&self, about: &Signatures, readings: &mut DMatrix<f64>) {
        match self {
            Self::Distorted { how: MonitorEffect::Coupling, monitors, amplitude } => {
                for &monitor in monitors {
                    let other = other_plane(&about.machine.ring, monitor).and_then(|other| about.read(other));
                    if let (Some(i), Some(j)) = (about.read(monitor), other) {
                        mix(readings, i, j, *amplitude);
                    }
                }
            }
            Self::Distorted { how, monitors, amplitude } => {
                let read = monitors.iter().filter_map(|&monitor| about.read(monitor));
                read.for_each(|b| readings.column_mut(b).apply(|r| *r *= how.factor(*amplitude)));
            }
            Self::Exchanged { monitors: [one, other], .. } => {
                if let (Some(i), Some(j)) = (about.read(*one), about.read(*other)) {
                    readings.swap_columns(i, j);
                }
            }
            Self::Mixed { monitor, from, share, .. } => {
                if let (Some(i), Some(j)) = (about.read(*monitor), about.read(*from)) {
                    mix(readings, i, j, *share);
                }
            }
            Self::Late { monitor, share, .. } => {
                about.read(*monitor).into_iter().for_each(|b| delay(readings, b, *share));
            }
        }
    }

    /// True for one that depends on the frame before.
    pub fn remembers(&self) -> bool {
        matches!(self, Self::Late { .. })
    }
}

/// Add a share of one column to another.
pub(super) fn mix(columns: &mut DMatrix<f64>, to: usize, from: usize, share: f64) {
    let more = columns.column(from) * share;
    let mut column = columns.column_mut(to);
    column += more;
}

/// A column of which each frame holds a share of the one before.
fn delay(columns: &mut DMatrix<f64>, at: usize, share: f64) {
    let more = coming(&columns.column(at)) * share;
    let mut column = columns.column_mut(at);
    column += more;
}

/// What the frame before has beyond each frame, none before the first.
pub(super) fn coming(values: &DVectorView<f64>) -> DVector<f64> {
    DVector::from_fn(values.len(), |frame, _| values[frame.saturating_sub(1)] - values[frame])
}

/// The monitor that is read next in the plane of one; after the last the first.
fn next(ring: &Ring, monitor: usize) -> Option<usize> {
    let others = || {
        let read = ring.read_monitors.iter().copied();
        read.filter(move |&other| other != monitor && ring.monitors[other].plane == ring.monitors[monitor].plane)
    };
    others().find(|&other| other > monitor).or_else(|| others().next())
}

/// The monitor at the same element that reads the other plane, if it is read.
fn other_plane(ring: &Ring, monitor: usize) -> Option<usize> {
    let crate::Monitor { element, plane } = ring.monitors[monitor];
    of_element(ring, element).find(|&other| ring.monitors[other].plane != plane && ring.read_monitors.contains(&other))
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

#[cfg(test)]
mod tests {
    use super::*;

    /// In the first frame there is none before; another monitor reads its own frames.
    #[test]
    fn a_late_monitor_reads_a_share_of_the_frame_before() {
        let ring = Ring::booster();
        let x = DMatrix::from_fn(3, ring.monitors.len(), |frame, _| [1.0, 2.0, -1.0][frame]);
        let (mut read, mut base) = ([x.clone(), x], vec![[0.0; 2]; ring.monitors.len()]);
        let late = Reading::Late { plane: Plane::X, monitor: 4, share: 0.25 };
        late.of_changes(&ring, &mut base, &mut read);
        assert_eq!(read[0].column(4).as_slice(), [1.0, 1.75, -0.25]);
        assert_eq!(read[0].column(5).as_slice(), [1.0, 2.0, -1.0]);
    }

    #[test]
    fn the_last_monitor_of_a_plane_reads_the_first_as_well() {
        let ring = Ring::booster();
        let name = |name: &str| ring.monitor_name(next(&ring, Site::monitor(&ring, name).unwrap()).unwrap());
        assert_eq!([name("x_A6"), name("x_F8"), name("y_F7")], ["x_A8", "x_A6", "y_A1"]);
    }
}
