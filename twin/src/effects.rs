//! Physics that a ring may have beyond its design, in the words of the command line: `KIND[@PLACE][=AMPLITUDE]`.
//!
//! An effect changes the ring itself, what the machine holds constant, or what its monitors and correctors say; a
//! [`Machine`] is a ring with effects applied, and answers with the response that would then be measured.

use core::str::FromStr;

use nalgebra::{DMatrix, Rotation2, Vector2};

use crate::lattice::{Kind, LatticeError, Plane, Ring};
use crate::orbit::{Hold, OrbitError};
use crate::response::{Optics, Tunes};

/// One effect: kind, place and amplitude.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// What happens.
    pub kind: EffectKind,
    /// Where, by half-cell or element name; empty where the kind acts on the whole ring.
    pub place: String,
    /// How much; the unit is that of the kind.
    pub amplitude: f64,
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $variant:ident = $word:literal,)*) => {
        /// The kinds of effect.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum EffectKind { $($(#[$doc])* $variant,)* }
        impl EffectKind {
            /// Every kind, in the order of the list.
            pub const ALL: &[Self] = &[$(Self::$variant,)*];
            /// The word for it.
            pub fn word(self) -> &'static str {
                match self { $(Self::$variant => $word,)* }
            }
        }
    };
}

kinds! {
    /// A monitor reads too much by this fraction.
    BpmGain = "bpm_gain",
    /// A corrector kicks too much by this fraction.
    CorrectorGain = "corrector_gain",
    /// A monitor is rotated [rad].
    BpmRoll = "bpm_roll",
    /// A corrector is rotated [rad].
    CorrectorRoll = "corrector_roll",
    /// A quadrupole is rotated [rad].
    QuadRoll = "quad_roll",
    /// A monitor reads x (1 + a x^2), a in [1/mm^2]; a response, the limit of small kicks, shows it on a displaced orbit.
    BpmCubic = "bpm_cubic",
    /// Two monitors' names are exchanged.
    BpmSwap = "bpm_swap",
    /// A corrector's sign is reversed.
    CorrectorPolarity = "corrector_polarity",
    /// A corrector's strength differs between its signs; cancels in the difference that a response is.
    CorrectorEven = "corrector_even",
    /// A gradient where the model has none, K1L [1/m].
    StrayGradient = "stray_gradient",
    /// A skew gradient where the model has none, K1sL [1/m].
    StraySkewGradient = "stray_skew_gradient",
    /// A gradient in a dipole's body, K1L [1/m].
    DipoleGradient = "dipole_gradient",
    /// Edge angle of one dipole, or of all without a place [rad].
    DipoleEdge = "dipole_edge",
    /// A sextupole field, K2L [1/m^2]; a response shows it on a displaced orbit.
    SextupoleError = "sextupole_error",
    /// The beam is off momentum.
    MomentumOffset = "momentum_offset",
    /// The RF frequency is held instead of the momentum, as a fraction.
    FixedRfFrequency = "fixed_rf_frequency",
    /// The mean of two monitors is held instead of the momentum, as a fraction; `@x_D8,x_E6`.
    RadialLoop = "radial_loop",
    /// All quadrupoles drift from -a to +a during a run; its mean, which a response is, does not move.
    QuadDrift = "quad_drift",
}

/// Why an effect cannot be applied.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EffectError {
    /// An unknown kind.
    #[error("unknown effect {found:?}; known: {}", EffectKind::ALL.iter().map(|k| k.word()).collect::<Vec<_>>().join(", "))]
    Kind {
        /// What was written.
        found: String,
    },
    /// An amplitude that is not a finite number.
    #[error("effect {effect}: expected a finite amplitude, found {found:?}")]
    Amplitude {
        /// The effect.
        effect: String,
        /// What was written.
        found: String,
    },
    /// A place that the kind cannot act on.
    #[error("effect {kind}: expected {expected}, found {found:?}")]
    Place {
        /// The kind.
        kind: &'static str,
        /// What the kind acts on.
        expected: &'static str,
        /// What was written.
        found: String,
    },
    /// A place that the ring lacks.
    #[error(transparent)]
    Lattice(#[from] LatticeError),
}

impl FromStr for Effect {
    type Err = EffectError;

    fn from_str(text: &str) -> Result<Self, EffectError> {
        let (head, amplitude) = text.split_once('=').unwrap_or((text, "1"));
        let (word, place) = head.split_once('@').unwrap_or((head, ""));
        let kind = EffectKind::ALL.iter().copied().find(|k| k.word() == word);
        let kind = kind.ok_or_else(|| EffectError::Kind { found: word.into() })?;
        let amplitude: Option<f64> = amplitude.parse().ok().filter(|a: &f64| a.is_finite());
        let amplitude = amplitude.ok_or_else(|| EffectError::Amplitude {
            effect: word.into(),
            found: text.split_once('=').map_or("", |p| p.1).into(),
        })?;
        Ok(Self { kind, place: place.into(), amplitude })
    }
}

/// What the RF system holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rf {
    /// The momentum.
    FixedMomentum,
    /// The frequency; the momentum follows the path length.
    FixedFrequency,
}

/// A ring with effects applied.
#[derive(Debug, Clone)]
pub struct Machine {
    ring: Ring,
    /// Momentum of the beam.
    delta: f64,
    /// Share of the answer that is given at fixed RF frequency.
    frequency_share: f64,
    /// Monitors (indices among the places) whose mean is held, and the share.
    radial_loop: Option<([usize; 2], f64)>,
    /// What monitors and correctors do to the response, in the order given.
    instruments: Vec<Instrument>,
}

#[derive(Debug, Clone)]
enum Instrument {
    Gain { plane: Plane, place: usize, error: f64 },
    Cubic { plane: Plane, place: usize, per_square_mm: f64 },
    Roll { place: usize, angle: f64 },
    Swap { plane: Plane, places: [usize; 2] },
    Kick { corrector: usize, factor: f64 },
}

/// What a machine answers: response of x and y at every monitor place to every corrector, and its linear optics.
#[derive(Debug, Clone)]
pub struct MachineResponse {
    /// x at the places to the correctors [m/rad].
    pub x: DMatrix<f64>,
    /// y at the places to the correctors [m/rad].
    pub y: DMatrix<f64>,
    /// Dispersion at the places [m].
    pub dispersion: Vec<f64>,
    /// Tunes.
    pub tunes: Tunes,
    /// Transition energy over the rest energy.
    pub gamma_transition: f64,
}

impl Machine {
    /// Apply effects to a ring whose momentum (on average) is the reference's, and is held, or the frequency.
    ///
    /// # Errors
    /// [`EffectError`] if an effect names a place that the ring lacks or that its kind cannot act on.
    pub fn new(ring: Ring, rf: Rf, effects: &[Effect]) -> Result<Self, EffectError> {
        let frequency_share = if rf == Rf::FixedFrequency { 1.0 } else { 0.0 };
        let mut machine = Self { ring, delta: 0.0, frequency_share, radial_loop: None, instruments: Vec::new() };
        effects.iter().try_for_each(|effect| machine.apply(effect))?;
        Ok(machine)
    }

    fn apply(&mut self, effect: &Effect) -> Result<(), EffectError> {
        let (place, a) = (effect.place.as_str(), effect.amplitude);
        match effect.kind {
            EffectKind::BpmGain => {
                self.instrument(effect, |plane, place| Instrument::Gain { plane, place, error: a })?
            }
            EffectKind::BpmCubic => {
                self.instrument(effect, |plane, place| Instrument::Cubic { plane, place, per_square_mm: a })?;
            }
            EffectKind::BpmRoll => self.instrument(effect, |_, place| Instrument::Roll { place, angle: a })?,
            EffectKind::BpmSwap => {
                let [(plane, one), (_, other)] = self.monitor_pair(effect)?;
                self.instruments.push(Instrument::Swap { plane, places: [one, other] });
            }
            EffectKind::CorrectorGain => self.kick(effect, 1.0 + a)?,
            EffectKind::CorrectorPolarity => self.kick(effect, -1.0)?,
            EffectKind::CorrectorRoll => {
                let corrector = self.ring.correctors[self.corrector(effect)?];
                self.ring.elements[corrector].misalignment.roll += a;
            }
            EffectKind::QuadRoll => {
                let at = self.ring.quadrupole(cell(place))?;
                self.ring.elements[at].misalignment.roll += a;
            }
            EffectKind::StrayGradient => self.stray(effect, a, 0.0)?,
            EffectKind::StraySkewGradient => self.stray(effect, 0.0, a)?,
            EffectKind::DipoleGradient => self.bends(effect, |bend, length| bend.k1 += a / length)?,
            EffectKind::DipoleEdge => self.bends(effect, |bend, _| {
                bend.e1 += a;
                bend.e2 += a;
            })?,
            EffectKind::SextupoleError => self.sextupole(effect)?,
            EffectKind::MomentumOffset => {
                effect.everywhere()?;
                self.delta += a;
            }
            EffectKind::FixedRfFrequency => {
                effect.everywhere()?;
                self.frequency_share = a;
            }
            EffectKind::RadialLoop => {
                let [(plane, one), (_, other)] = self.monitor_pair(effect)?;
                if plane != Plane::X {
                    return Err(effect.wrong("two horizontal monitors such as x_D8,x_E6"));
                }
                self.radial_loop = Some(([one, other], a));
            }
            // Neither moves the half difference of two signs, averaged over a run.
            EffectKind::CorrectorEven | EffectKind::QuadDrift => {}
        }
        Ok(())
    }

    /// Orbit response as it would be measured, places `[48]` (H monitors then V) by correctors `[48]` (H then V).
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn response(&self) -> Result<MachineResponse, OrbitError> {
        let optics = Optics::of(&self.ring, Hold::Momentum { delta: self.delta })?;
        let (mut x, mut y) = planes(&optics);
        if self.frequency_share != 0.0 {
            let offset = optics.frequency_offset();
            let (fixed_x, fixed_y) = planes(&Optics::of(&self.ring, Hold::Frequency { offset })?);
            x += (fixed_x - &x) * self.frequency_share;
            y += (fixed_y - &y) * self.frequency_share;
        }
        let seen = |plane| optics.monitor_places(plane).iter().map(|o| optics.dispersion(o)).collect::<Vec<_>>();
        let (dispersion, dispersion_y) = (seen(Plane::X), seen(Plane::Y));
        if let Some(([i, j], share)) = self.radial_loop {
            // the momentum that brings the pair's mean back
            let momentum = (x.row(i) + x.row(j)) * (share / (dispersion[i] + dispersion[j]));
            x -= nalgebra::DVector::from_column_slice(&dispersion) * &momentum;
            y -= nalgebra::DVector::from_column_slice(&dispersion_y) * &momentum;
        }
        self.instruments.iter().for_each(|i| self.read(&optics, i, &mut x, &mut y));
        Ok(MachineResponse { x, y, dispersion, tunes: optics.tunes()?, gamma_transition: optics.gamma_transition() })
    }

    fn read(&self, optics: &Optics, instrument: &Instrument, x: &mut DMatrix<f64>, y: &mut DMatrix<f64>) {
        match *instrument {
            Instrument::Gain { plane, place, error } => scale(rows(plane, x, y).row_mut(place).iter_mut(), 1.0 + error),
            Instrument::Cubic { plane, place, per_square_mm } => {
                let orbit = optics.orbit(self.ring.monitors[place])[if plane == Plane::X { 0 } else { 2 }] * 1e3;
                // derivative of x (1 + a x^2)
                let slope = 1.0 + 3.0 * per_square_mm * orbit * orbit;
                scale(rows(plane, x, y).row_mut(place).iter_mut(), slope);
            }
            Instrument::Roll { place, angle } => {
                for (x, y) in x.row_mut(place).iter_mut().zip(y.row_mut(place).iter_mut()) {
                    let read = Rotation2::new(-angle) * Vector2::new(*x, *y);
                    (*x, *y) = (read.x, read.y);
                }
            }
            Instrument::Swap { plane, places } => rows(plane, x, y).swap_rows(places[0], places[1]),
            Instrument::Kick { corrector, factor } => {
                scale(x.column_mut(corrector).iter_mut(), factor);
                scale(y.column_mut(corrector).iter_mut(), factor);
            }
        }
    }

    fn instrument(&mut self, effect: &Effect, make: impl Fn(Plane, usize) -> Instrument) -> Result<(), EffectError> {
        let (plane, place) = self.monitor(effect, &effect.place)?;
        self.instruments.push(make(plane, place));
        Ok(())
    }

    fn kick(&mut self, effect: &Effect, factor: f64) -> Result<(), EffectError> {
        let corrector = self.corrector(effect)?;
        self.instruments.push(Instrument::Kick { corrector, factor });
        Ok(())
    }

    /// Plane and index among the places of `x_E4`.
    fn monitor(&self, effect: &Effect, name: &str) -> Result<(Plane, usize), EffectError> {
        let wrong = || effect.wrong("a monitor such as x_E4 or y_C5");
        let (plane, cell) = name.split_once('_').ok_or_else(wrong)?;
        let plane = match plane {
            "x" => Plane::X,
            "y" => Plane::Y,
            _ => return Err(wrong()),
        };
        // the monitor of that plane, or the other one of the half-cell, whose roll shows in that plane
        let of = |own: bool| {
            let is = |e: &crate::Element| e.cell() == cell && (!own || e.kind == Kind::Monitor { plane });
            self.ring.monitors.iter().position(|&i| is(&self.ring.elements[i]))
        };
        let place = of(true).or_else(|| of(false)).ok_or_else(wrong)?;
        Ok((plane, place))
    }

    fn monitor_pair(&self, effect: &Effect) -> Result<[(Plane, usize); 2], EffectError> {
        let (one, other) =
            effect.place.split_once(',').ok_or_else(|| effect.wrong("two monitors such as x_D8,x_E6"))?;
        let pair = [self.monitor(effect, one)?, self.monitor(effect, other)?];
        if pair[0].0 != pair[1].0 {
            return Err(effect.wrong("two monitors of one plane"));
        }
        Ok(pair)
    }

    /// Index among the correctors of `H_A4` or `V_D3`.
    fn corrector(&self, effect: &Effect) -> Result<usize, EffectError> {
        let at = match effect.place.split_once('_') {
            Some(("H", cell)) => self.ring.corrector(Plane::X, cell)?,
            Some(("V", cell)) => self.ring.corrector(Plane::Y, cell)?,
            _ => return Err(effect.wrong("a corrector such as H_A4 or V_D3")),
        };
        let listed = self.ring.correctors.iter().position(|&i| i == at);
        listed.ok_or_else(|| effect.wrong("a corrector of the machine"))
    }

    fn stray(&mut self, effect: &Effect, k1l: f64, k1sl: f64) -> Result<(), EffectError> {
        let straight = |e: &crate::Element| matches!(e.kind, Kind::Marker | Kind::Multipole { .. });
        let named = |e: &crate::Element| e.name == effect.place || e.cell() == effect.place;
        let at = self.ring.elements.iter().position(|e| straight(e) && named(e));
        let at = at.ok_or_else(|| effect.wrong("a free straight such as SLOT_F6"))?;
        match &mut self.ring.elements[at].kind {
            Kind::Multipole { k1l: normal, k1sl: skew, .. } => {
                *normal += k1l;
                *skew += k1sl;
            }
            kind => *kind = Kind::Multipole { k1l, k1sl, k2l: 0.0 },
        }
        Ok(())
    }

    fn bends(&mut self, effect: &Effect, change: impl Fn(&mut crate::lattice::Bend, f64)) -> Result<(), EffectError> {
        let everywhere = effect.place.is_empty() && effect.kind == EffectKind::DipoleEdge;
        let mut found = false;
        for element in &mut self.ring.elements {
            if let Kind::Bend(bend) = &mut element.kind
                && (everywhere || element.name == effect.place || element.name.ends_with(&format!("_{}", effect.place)))
            {
                change(bend, element.length);
                found = true;
            }
        }
        if found { Ok(()) } else { Err(effect.wrong("a dipole such as B_C4")) }
    }

    fn sextupole(&mut self, effect: &Effect) -> Result<(), EffectError> {
        let wanted = cell(&effect.place);
        let is = |e: &&mut crate::Element| matches!(e.kind, Kind::Sextupole { .. }) && e.cell() == wanted;
        let element =
            self.ring.elements.iter_mut().find(is).ok_or_else(|| effect.wrong("a sextupole such as SX_A1"))?;
        if let Kind::Sextupole { k2 } = &mut element.kind {
            *k2 += effect.amplitude / element.length;
        }
        Ok(())
    }
}

impl Effect {
    /// An effect on the whole ring takes no place.
    fn everywhere(&self) -> Result<(), EffectError> {
        if self.place.is_empty() { Ok(()) } else { Err(self.wrong("no place")) }
    }

    fn wrong(&self, expected: &'static str) -> EffectError {
        EffectError::Place { kind: self.kind.word(), expected, found: self.place.clone() }
    }
}

/// The half-cell of a place that may carry a prefix: `D8` of `QH_D8`.
fn cell(place: &str) -> &str {
    place.split_once('_').map_or(place, |(_, cell)| cell)
}

fn planes(optics: &Optics) -> (DMatrix<f64>, DMatrix<f64>) {
    let correctors = optics.correctors();
    (
        optics.response(&optics.monitor_places(Plane::X), &correctors),
        optics.response(&optics.monitor_places(Plane::Y), &correctors),
    )
}

fn rows<'m>(plane: Plane, x: &'m mut DMatrix<f64>, y: &'m mut DMatrix<f64>) -> &'m mut DMatrix<f64> {
    if plane == Plane::X { x } else { y }
}

fn scale<'m>(values: impl Iterator<Item = &'m mut f64>, factor: f64) {
    values.for_each(|v| *v *= factor);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn respond(effects: &[&str]) -> MachineResponse {
        let effects: Vec<Effect> = effects.iter().map(|e| e.parse().unwrap()).collect();
        Machine::new(Ring::booster(), Rf::FixedMomentum, &effects).unwrap().response().unwrap()
    }

    #[test]
    fn words_parse_and_unknown_ones_are_refused() {
        let effect: Effect = "bpm_swap@x_E4,x_E6".parse().unwrap();
        assert_eq!((effect.kind, effect.place.as_str(), effect.amplitude), (EffectKind::BpmSwap, "x_E4,x_E6", 1.0));
        assert!(
            "bpm_gian@x_E4"
                .parse::<Effect>()
                .unwrap_err()
                .to_string()
                .starts_with("unknown effect \"bpm_gian\"; known: bpm_gain,")
        );
        assert_eq!(
            "bpm_gain@x_E4=nan".parse::<Effect>().unwrap_err().to_string(),
            "effect bpm_gain: expected a finite amplitude, found \"nan\""
        );
        let astray = Machine::new(Ring::booster(), Rf::FixedMomentum, &["stray_gradient@QH_A2".parse().unwrap()]);
        assert_eq!(
            astray.unwrap_err().to_string(),
            "effect stray_gradient: expected a free straight such as SLOT_F6, found \"QH_A2\""
        );
    }

    #[test]
    fn instruments_act_on_their_rows_and_columns() {
        let plain = respond(&[]);
        let places = Ring::booster().monitors.len();
        let e4 = (0..places).find(|&i| Ring::booster().elements[Ring::booster().monitors[i]].cell() == "E4").unwrap();
        assert!((respond(&["bpm_gain@x_E4=0.1"]).x.row(e4) - plain.x.row(e4) * 1.1).abs().max() < 1e-12);
        assert!((respond(&["corrector_polarity@H_A2"]).x.column(0) + plain.x.column(0)).abs().max() < 1e-12);
        // x_read = x cos + y sin: a pure y orbit shows in x by the sine of the roll
        let rolled = respond(&["bpm_roll@x_E4=0.1"]);
        assert!((rolled.x.row(e4)[30] - plain.y.row(e4)[30] * 0.1_f64.sin()).abs() < 1e-12);
        // an H corrector rolled by 90 degrees kicks (0, 1)
        let turned = respond(&["corrector_roll@H_A2=1.5707963267948966"]);
        assert!(turned.x.column(0).abs().max() < 1e-9 && turned.y.column(0).abs().max() > 1.0);
    }

    #[test]
    fn a_held_frequency_stays_with_the_momentum_offset() {
        let both = respond(&["momentum_offset=0.003", "fixed_rf_frequency"]);
        let (offset, held) = (respond(&["momentum_offset=0.003"]), respond(&["fixed_rf_frequency"]));
        assert!((&both.x - &offset.x).abs().max() > 0.01 && (&both.x - &held.x).abs().max() > 0.01);
        assert!(
            (&both.y - &offset.y).abs().max() < 1e-9,
            "no vertical dispersion, so the frequency does not matter in y"
        );
        let far =
            Machine::new(Ring::booster(), Rf::FixedFrequency, &["momentum_offset=0.003".parse().unwrap()]).unwrap();
        assert_eq!(far.response().unwrap().x, both.x);
    }

    #[test]
    fn a_full_radial_loop_holds_the_mean_of_its_pair() {
        let held = respond(&["radial_loop@x_D8,x_E6"]);
        let of = |cell: &str| {
            Ring::booster().monitors.iter().position(|&i| Ring::booster().elements[i].cell() == cell).unwrap()
        };
        let mean = held.x.row(of("D8")) + held.x.row(of("E6"));
        assert!(mean.abs().max() < 1e-9);
    }
}
