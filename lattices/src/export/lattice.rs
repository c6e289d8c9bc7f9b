//! A calibrated ring in the terms that lattice files share: named elements in beam order, thin monitors and correctors,
//! and what monitors and correctors make of positions and kicks.

use std::path::Path;

use twin::{
    Class, CorrectorEffect, Effect, EffectError, Element, Hold, Kind, Machine, Misalignment, MonitorEffect, Optics,
    Particle, Plane, Rf, Ring, Site,
};

use super::calibration::{Calibration, CalibrationError};
use super::names::Names;

/// A calibrated ring.
#[derive(Debug)]
pub struct Lattice {
    /// Name of the machine.
    pub machine: String,
    /// Reference particle.
    pub particle: Particle,
    /// Length of the reference orbit [m].
    pub circumference: f64,
    /// Elements in beam order without gaps, each with a name of its own that every format takes. Monitors and correctors
    /// are thin; what length they have is a drift behind them.
    pub elements: Vec<Element>,
    /// Planes of monitors: horizontal in beam order, then vertical.
    pub monitors: Vec<Channel>,
    /// Planes of correctors: horizontal in beam order, then vertical.
    pub correctors: Vec<Channel>,
    /// Tunes at the supplies' nominal currents, x and y; none without a stable ring.
    pub tunes: Option<[f64; 2]>,
    /// Where the strengths come from, what was found, and what of it no element carries; one sentence each.
    pub remarks: Vec<String>,
}

/// One plane of a monitor or corrector.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// Its name here, `x_E4` or `H_A2`.
    pub name: String,
    /// Name in the file of the variable that sets a corrector [rad].
    pub knob: String,
    /// Index of the element.
    pub element: usize,
    /// Plane.
    pub plane: Plane,
    /// Reading over position, or kick over setting [1].
    pub gain: f64,
    /// Rotation about the beam axis, positive from x to y [rad].
    pub roll: f64,
}

impl Channel {
    /// What a monitor reads of (x, y); the kick in (x, y) that a corrector set to one gives.
    pub fn axis(&self) -> [f64; 2] {
        let (s, c) = self.roll.sin_cos();
        match self.plane {
            Plane::X => [self.gain * c, self.gain * s],
            Plane::Y => [-self.gain * s, self.gain * c],
        }
    }

    /// True if it reads or kicks as it should.
    pub fn is_ideal(&self) -> bool {
        self.gain == 1.0 && self.roll == 0.0
    }

    /// What is not ideal, in words.
    pub fn words(&self) -> String {
        format!("{}, gain {:?}, roll {:?} rad", self.name, self.gain, self.roll)
    }
}

/// Why a result does not make a lattice.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The result is of another ring.
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    /// A finding that the ring has no place for.
    #[error(transparent)]
    Effect(#[from] EffectError),
}

impl Lattice {
    /// The ring with the strengths and findings of a result; `path` appears in errors.
    ///
    /// # Errors
    /// [`ExportError`] if the result is of another ring.
    pub fn of(ring: &Ring, result: &Calibration, path: &Path) -> Result<Self, ExportError> {
        let effects: Result<Vec<Effect>, _> = result.findings.iter().map(|(text, _)| text.resolve(ring)).collect();
        let effects = effects?;
        let machine = Machine::new(result.strengthened(ring, path)?, Rf::FixedMomentum, &effects)?;
        let mut lattice = Self::plain(machine.ring());
        let version = env!("CARGO_PKG_VERSION");
        lattice.remarks.insert(0, format!("{}: strengths from {}, by orbitcal {version}", ring.name, result.recording));
        lattice.remarks.extend(result.tunes.map(|measured| currents(lattice.tunes, measured)));
        for (effect, (_, sentence)) in effects.iter().zip(&result.findings) {
            let included = lattice.apply(effect);
            lattice.remarks.push(format!("{}: {sentence}", if included { "found" } else { "found, not in this file" }));
        }
        lattice.remarks.extend(result.open.iter().map(|open| format!("open, not in this file: {open}")));
        lattice.remarks.iter_mut().for_each(|remark| *remark = one_line(remark));
        Ok(lattice)
    }

    /// A ring as it is.
    pub fn plain(ring: &Ring) -> Self {
        let mut names = Names::new();
        let (mut elements, mut position, mut remarks, mut drifts) = (Vec::new(), Vec::new(), Vec::new(), 1..);
        for element in &ring.elements {
            position.push(elements.len());
            let wanted = match element.name.as_str() {
                "" => format!("drift_{}", drifts.next().expect("numbers do not end")),
                name => name.into(),
            };
            let name = names.take(&wanted);
            if name != wanted {
                remarks.push(format!("{wanted:?} is called {name}"));
            }
            elements.extend(pieces(Element { name, ..element.clone() }, &mut names));
        }
        let channel = |at: usize, plane, name: String| Channel {
            name,
            knob: String::new(),
            element: position[at],
            plane,
            gain: 1.0,
            roll: 0.0,
        };
        let monitors = ring.monitors.iter().enumerate();
        let monitors = monitors.map(|(i, m)| channel(m.element, m.plane, ring.monitor_name(i))).collect();
        let correctors = ring.correctors.iter().enumerate();
        let corrector = |(i, c): (usize, &twin::Corrector)| Channel {
            roll: ring.elements[c.element].misalignment.roll,
            ..channel(c.element, c.plane, ring.corrector_name(i))
        };
        let mut correctors: Vec<Channel> = correctors.map(corrector).collect();
        name_knobs(&mut correctors, &elements);
        Self {
            machine: ring.name.clone(),
            particle: ring.particle,
            circumference: ring.circumference,
            elements,
            monitors,
            correctors,
            tunes: tunes(ring),
            remarks,
        }
    }

    /// Planes of the monitor or corrector at an element.
    pub fn channels_of(channels: &[Channel], element: usize) -> impl Iterator<Item = &Channel> {
        channels.iter().filter(move |channel| channel.element == element)
    }

    /// The remarks, and one for each monitor or corrector that the format has no words for.
    pub fn remarks_of<'l>(&'l self, format: &str, without_words: impl Iterator<Item = &'l Channel>) -> Vec<String> {
        let without_words = without_words.map(|channel| format!("{format} does not act on {}", channel.words()));
        self.remarks.iter().cloned().chain(without_words).collect()
    }

    /// Monitors that are not ideal, and correctors with a gain or planes of different rolls: what a format without knobs
    /// cannot say.
    pub fn not_acted_on(&self) -> impl Iterator<Item = &Channel> {
        let monitors = self.monitors.iter().filter(|channel| !channel.is_ideal());
        let is_beyond =
            |channel: &&Channel| channel.gain != 1.0 || channel.roll != self.corrector_roll(channel.element);
        monitors.chain(self.correctors.iter().filter(is_beyond))
    }

    /// Roll of the corrector at an element, if its planes are rolled alike, else 0 [rad].
    pub fn corrector_roll(&self, element: usize) -> f64 {
        let mut rolls = Self::channels_of(&self.correctors, element).map(|channel| channel.roll);
        let first = rolls.next().unwrap_or(0.0);
        if rolls.all(|roll| roll == first) { first } else { 0.0 }
    }

    /// Let a monitor or corrector have an effect, if the ring does not have it yet; false if neither can.
    fn apply(&mut self, effect: &Effect) -> bool {
        match (effect.kind.class(), effect.site) {
            (Class::Field(_), _) => true,
            (Class::Monitor(how), Site::Monitor(at)) => self.distort(how, at, effect.amplitude),
            (Class::Corrector(how), Site::Corrector(at)) => self.misset(how, at, effect.amplitude),
            (Class::Monitor(_) | Class::Corrector(_) | Class::Hold(_) | Class::Drift(_), _) => false,
        }
    }

    fn distort(&mut self, how: MonitorEffect, monitor: usize, amplitude: f64) -> bool {
        match how {
            MonitorEffect::Gain => self.monitors[monitor].gain *= 1.0 + amplitude,
            MonitorEffect::Polarity => self.monitors[monitor].gain *= -1.0,
            MonitorEffect::Dead => self.monitors[monitor].gain = 0.0,
            MonitorEffect::Roll => {
                let element = self.monitors[monitor].element;
                let planes = self.monitors.iter_mut().filter(|channel| channel.element == element);
                planes.for_each(|channel| channel.roll += amplitude);
            }
            MonitorEffect::Coupling
            | MonitorEffect::Cubic
            | MonitorEffect::Swap
            | MonitorEffect::Crosstalk
            | MonitorEffect::Timing => return false,
        }
        true
    }

    fn misset(&mut self, how: CorrectorEffect, corrector: usize, amplitude: f64) -> bool {
        let channel = &mut self.correctors[corrector];
        match how {
            CorrectorEffect::Gain => channel.gain *= 1.0 + amplitude,
            CorrectorEffect::Polarity => channel.gain = -channel.gain,
            CorrectorEffect::Dead => channel.gain = 0.0,
            // the ring has it
            CorrectorEffect::Roll => {}
            CorrectorEffect::Coupling
            | CorrectorEffect::Swap
            | CorrectorEffect::Even
            | CorrectorEffect::Crosstalk
            | CorrectorEffect::Hysteresis
            | CorrectorEffect::Settling => return false,
        }
        true
    }
}

fn tunes(ring: &Ring) -> Option<[f64; 2]> {
    let tunes = Optics::of(ring, Hold::Momentum { delta: 0.0 }).ok()?.tunes().ok()?;
    Some([tunes.x, tunes.y])
}

/// At which currents the strengths hold, and what that makes of the tunes; `measured_at` are those at the recording's mean currents.
fn currents(tunes: Option<[f64; 2]>, measured_at: [f64; 2]) -> String {
    let words = |[x, y]: [f64; 2]| format!("{x:.4} {y:.4}");
    format!(
        "strengths are those at the supplies' nominal currents: tunes {}; at the recording's mean currents {}",
        tunes.map_or_else(|| "of no stable ring".into(), words),
        words(measured_at)
    )
}

/// A comment ends with its line, whatever the names in it hold.
fn one_line(text: &str) -> String {
    text.split(char::is_control).collect::<Vec<_>>().join(" ")
}

/// Monitors and correctors as thin elements with a drift behind them; markers and thin multipoles likewise.
fn pieces(element: Element, names: &mut Names) -> Vec<Element> {
    let misalignment = match element.kind {
        // free space has no orientation, a monitor's is passed over, and a corrector's is that of its kick
        Kind::Marker | Kind::Monitor | Kind::Corrector { .. } => Misalignment::default(),
        Kind::Multipole { .. } => element.misalignment,
        _ => return vec![element],
    };
    let (length, name) = (element.length, element.name.clone());
    let thin = Element { length: 0.0, misalignment, ..element };
    let behind = (length > 0.0).then(|| Element {
        name: names.take(&format!("{name}_drift")),
        kind: Kind::Drift,
        length,
        misalignment: Misalignment::default(),
        ..thin.clone()
    });
    core::iter::once(thin).chain(behind).collect()
}

/// `kick_DCH_A2`; of a corrector of both planes `kick_C1_h` and `kick_C1_v`.
fn name_knobs(correctors: &mut [Channel], elements: &[Element]) {
    let planes: Vec<usize> =
        correctors.iter().map(|one| correctors.iter().filter(|c| c.element == one.element).count()).collect();
    for (channel, planes) in correctors.iter_mut().zip(planes) {
        let plane = match channel.plane {
            _ if planes == 1 => "",
            Plane::X => "_h",
            Plane::Y => "_v",
        };
        channel.knob = format!("kick_{}{plane}", elements[channel.element].name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_in_a_long_straight_is_thin_with_a_drift_behind_that_is_not_rolled() {
        let misalignment = Misalignment { roll: 0.1, ..Misalignment::default() };
        let kind = Kind::Multipole { k1l: 0.01, k1sl: 0.0, k2l: 0.0, k3l: 0.0 };
        let straight = Element { kind: kind.clone(), misalignment, ..Element::drift(2.0, 0.5) };
        let pieces = pieces(straight, &mut Names::new());
        let [field, behind] = pieces.as_slice() else { panic!("{pieces:?}") };
        assert_eq!((&field.kind, field.length, field.misalignment), (&kind, 0.0, misalignment));
        assert_eq!((&behind.kind, behind.length, behind.misalignment), (&Kind::Drift, 0.5, Misalignment::default()));
    }
}
