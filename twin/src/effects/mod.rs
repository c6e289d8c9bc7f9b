//! Physics that a ring may have beyond its design, in the words of the command line: `KIND[@PLACE][=AMPLITUDE]`.
//!
//! An effect changes the ring itself, what the machine holds constant, its readings or its kicks; a [`Machine`] is a ring with
//! effects applied, and gives the response that would then be measured. Each [`Class`] has a file that defines its kinds, each
//! by its [`Mechanism`].

#[cfg(test)]
mod agreement;
mod corrector;
mod drift;
mod drives;
mod field;
mod hold;
mod linear;
mod machine;
mod mechanism;
mod monitor;
mod signature;
mod track;

use core::fmt;
use core::str::FromStr;

use crate::lattice::{Plane, Ring};
use crate::limits::FINITE;
use crate::orbit::OrbitError;
use crate::site::Site;

pub use corrector::CorrectorEffect;
pub use drift::{DriftEffect, change_at};
pub use drives::Drives;
pub use field::{FieldEffect, Thin};
pub use hold::{Held, HoldEffect, Holding, Rf};
pub use machine::{Machine, MachineResponse};
pub use mechanism::{Measured, Mechanism, Unit};
pub use monitor::MonitorEffect;
pub use signature::{Signature, Signatures};
pub use track::{Cycle, Tracked};

/// The classes of effect, each with its kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Class {
    /// Errors of one monitor, or of two.
    Monitor(MonitorEffect),
    /// Errors of one corrector.
    Corrector(CorrectorEffect),
    /// Fields in the ring.
    Field(FieldEffect),
    /// What the machine holds constant.
    Hold(HoldEffect),
    /// What changes during a campaign.
    Drift(DriftEffect),
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident => $class:ident($mechanism:expr),)*) => {
        /// The kinds of effect.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum EffectKind { $($(#[$doc])* $kind,)* }
        impl EffectKind {
            /// Every kind, in the order of the list.
            pub const ALL: &[Self] = &[$(Self::$kind,)*];
            /// The class it belongs to.
            pub const fn class(self) -> Class {
                match self { $(Self::$kind => Class::$class($mechanism),)* }
            }
            /// How it works.
            pub fn mechanism(self) -> &'static dyn Mechanism {
                match self { $(Self::$kind => &$mechanism,)* }
            }
        }
    };
}

kinds! {
    /// A monitor reads too much by this fraction.
    BpmGain => Monitor(MonitorEffect::Gain),
    /// A corrector kicks too much by this fraction.
    CorrectorGain => Corrector(CorrectorEffect::Gain),
    /// A monitor is rotated [rad].
    BpmRoll => Monitor(MonitorEffect::Roll),
    /// A corrector is rotated [rad].
    CorrectorRoll => Corrector(CorrectorEffect::Roll),
    /// A quadrupole is rotated [rad].
    QuadRoll => Field(FieldEffect::QuadRoll),
    /// A monitor reads x (1 + a x^2), a in [1/mm^2]; a response, the limit of small kicks, shows it on a displaced orbit.
    BpmCubic => Monitor(MonitorEffect::Cubic),
    /// A monitor's sign is reversed.
    BpmPolarity => Monitor(MonitorEffect::Polarity),
    /// A monitor does not see the beam.
    BpmDead => Monitor(MonitorEffect::Dead),
    /// Two monitors' names are exchanged.
    BpmSwap => Monitor(MonitorEffect::Swap),
    /// A corrector's sign is reversed.
    CorrectorPolarity => Corrector(CorrectorEffect::Polarity),
    /// A corrector does not kick.
    CorrectorDead => Corrector(CorrectorEffect::Dead),
    /// Two correctors' cables are exchanged.
    CorrectorSwap => Corrector(CorrectorEffect::Swap),
    /// A corrector's strength differs between its signs; cancels in the difference that a response is.
    CorrectorEven => Corrector(CorrectorEffect::Even),
    /// A gradient where the model has none, K1L [1/m].
    StrayGradient => Field(FieldEffect::StrayGradient),
    /// A skew gradient where the model has none, K1sL [1/m].
    StraySkewGradient => Field(FieldEffect::StraySkewGradient),
    /// A gradient in a dipole's body, K1L [1/m].
    DipoleGradient => Field(FieldEffect::DipoleGradient),
    /// Edge angle of one dipole, or of all without a place [rad].
    DipoleEdge => Field(FieldEffect::DipoleEdge),
    /// A sextupole field, K2L [1/m^2]; a response shows it on a displaced orbit.
    SextupoleError => Field(FieldEffect::Sextupole),
    /// A sextupole in all dipoles, K2L of each [1/m^2], as eddy currents in their vacuum chambers make; a response shows it on a displaced orbit.
    DipoleSextupole => Field(FieldEffect::DipoleSextupole),
    /// An octupole where the model has none, K3L [1/m^3]; a response shows it on a displaced orbit.
    StrayOctupole => Field(FieldEffect::StrayOctupole),
    /// The beam is off momentum.
    MomentumOffset => Hold(HoldEffect::Momentum),
    /// The RF frequency is held instead of the momentum, as a fraction.
    FixedRfFrequency => Hold(HoldEffect::Frequency),
    /// The mean of two monitors is held instead of the momentum, as a fraction; `@x_D8,x_E6`.
    RadialLoop => Hold(HoldEffect::RadialLoop),
    /// Steps of the RF frequency are larger than recorded, as a fraction.
    RfStep => Hold(HoldEffect::Steps),
    /// A monitor reads this share of the next one of its plane as well.
    BpmCrosstalk => Monitor(MonitorEffect::Crosstalk),
    /// This share of a corrector's kick goes to the next one of its plane as well.
    CorrectorCrosstalk => Corrector(CorrectorEffect::Crosstalk),
    /// A corrector keeps this share of the kick that it had before its present setting; a response, whose settings have none before, does
    /// not show it.
    CorrectorHysteresis => Corrector(CorrectorEffect::Hysteresis),
    /// This share of each change of a corrector is missing in the frame after it; a response, whose settings last, does not show it.
    CorrectorSettling => Corrector(CorrectorEffect::Settling),
    /// A monitor reads this share of the frame before instead of its own; a response, whose settings last, does not show it.
    BpmTiming => Monitor(MonitorEffect::Timing),
    /// A monitor of both planes reads this share of the other plane as well in one of them.
    BpmCoupling => Monitor(MonitorEffect::Coupling),
    /// This share of the kick of a corrector of both planes in one of them goes to the other plane as well.
    CorrectorCoupling => Corrector(CorrectorEffect::Coupling),
    /// All quadrupoles drift from -a to +a during a run; its mean, which a response is, does not move.
    QuadDrift => Drift(DriftEffect::Quadrupoles),
}

impl EffectKind {
    /// The word for it.
    pub fn word(self) -> &'static str {
        self.mechanism().word()
    }

    /// Standard deviation of the amplitude among faults worth finding; see [`Mechanism::prior_scale`].
    pub fn prior_scale(self) -> Option<f64> {
        self.mechanism().prior_scale()
    }

    /// True for an effect that is there or not, without an amplitude.
    pub fn is_switch(self) -> bool {
        self.prior_scale().is_none()
    }

    /// Unit of the amplitude.
    pub fn unit(self) -> Unit {
        self.mechanism().unit()
    }

    /// Every site of a ring where it may act. A radial loop holds monitors that only the recording's header knows; its site is
    /// given there.
    pub fn sites(self, ring: &Ring) -> Vec<Site> {
        self.mechanism().sites(ring)
    }

    /// Coordinates of the orbit without kicks that decide how large it shows; see [`Mechanism::orbit`].
    pub fn orbit(self, ring: &Ring, site: Site) -> Vec<(usize, Plane)> {
        self.mechanism().orbit(ring, site)
    }

    /// What is said of it: place, amplitude and error bar in the words of a control room.
    pub fn phrase(self, ring: &Ring, site: Site, amplitude: Measured) -> String {
        self.mechanism().phrase(ring, site, amplitude)
    }

    /// True for what one corrector does, or two: a held-out corrector could not show it.
    pub fn is_of_a_corrector(self) -> bool {
        match self.class() {
            Class::Corrector(_) => true,
            Class::Monitor(_) | Class::Field(_) | Class::Hold(_) | Class::Drift(_) => false,
        }
    }

    /// True for what one monitor, or two, do: it acts after all that moves the orbit.
    pub fn is_of_a_monitor(self) -> bool {
        match self.class() {
            Class::Monitor(_) => true,
            Class::Corrector(_) | Class::Field(_) | Class::Hold(_) | Class::Drift(_) => false,
        }
    }

    /// True for what passes within a setting: it shows in the frames after a change alone.
    pub fn is_transient(self) -> bool {
        matches!(self, Self::BpmTiming | Self::CorrectorSettling)
    }

    /// True if the orbit without kicks, and with it the monitors' baselines, changes during the campaign.
    pub fn moves_baselines(self) -> bool {
        match self.class() {
            Class::Drift(_) => true,
            Class::Monitor(_) | Class::Corrector(_) | Class::Field(_) | Class::Hold(_) => false,
        }
    }

    /// The thin gradient that acts on the beam as it does, if any.
    pub fn thin(self) -> Option<Thin> {
        match self.class() {
            Class::Field(field) => field.thin(),
            Class::Monitor(_) | Class::Corrector(_) | Class::Hold(_) | Class::Drift(_) => None,
        }
    }

    /// True for a field that does not grow with the magnets.
    pub fn is_stray(self) -> bool {
        match self.class() {
            Class::Field(field) => field.is_stray(),
            Class::Monitor(_) | Class::Corrector(_) | Class::Hold(_) | Class::Drift(_) => false,
        }
    }
}

impl fmt::Display for EffectKind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.word())
    }
}

impl FromStr for EffectKind {
    type Err = EffectError;

    fn from_str(word: &str) -> Result<Self, EffectError> {
        let known = Self::ALL.iter().copied().find(|kind| kind.word() == word);
        known.ok_or_else(|| EffectError::Kind { found: word.into() })
    }
}

/// One effect: kind, site and amplitude.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Effect {
    /// What happens.
    pub kind: EffectKind,
    /// Where.
    pub site: Site,
    /// How much; the unit is that of the kind.
    pub amplitude: f64,
}

impl Effect {
    /// What its monitor reads beyond a position in its plane [m]; 0 of an effect that is none of a single monitor.
    pub fn misreads(&self, position: f64) -> f64 {
        match self.kind.class() {
            Class::Monitor(how) => how.misreads(self.amplitude, position),
            Class::Corrector(_) | Class::Field(_) | Class::Hold(_) | Class::Drift(_) => 0.0,
        }
    }

    /// Read one for a ring.
    ///
    /// # Errors
    /// [`EffectError`].
    ///
    /// ```
    /// # use twin::{Effect, EffectKind, Ring, Site};
    /// let ring = Ring::booster();
    /// let effect = Effect::parse("quad_roll@D8=0.01", &ring)?;
    /// assert_eq!(effect.kind, EffectKind::QuadRoll);
    /// assert_eq!(effect.site, Site::Quadrupole(ring.quadrupole("QH_D8")?));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn parse(text: &str, ring: &Ring) -> Result<Self, EffectError> {
        text.parse::<EffectText>()?.resolve(ring)
    }

    /// Of a kind at a place that is named.
    ///
    /// # Errors
    /// [`EffectError::Place`] if the ring has no such place, or the kind cannot act there.
    pub fn at(kind: EffectKind, place: &str, amplitude: f64, ring: &Ring) -> Result<Self, EffectError> {
        let site = kind.mechanism().site(ring, place);
        let site = site.ok_or_else(|| kind.mechanism().misplaced(ring, place.into()))?;
        Ok(Self { kind, site, amplitude })
    }

    /// In the words of the command line.
    pub fn text(&self, ring: &Ring) -> EffectText {
        EffectText { kind: self.kind, place: self.site.name(ring), amplitude: self.amplitude }
    }
}

/// An effect as it is written, its place not yet looked for.
#[derive(Debug, Clone, PartialEq)]
pub struct EffectText {
    /// What happens.
    pub kind: EffectKind,
    /// Name of the place; empty for the whole ring.
    pub place: String,
    /// How much, 1 if nothing is said.
    pub amplitude: f64,
}

impl EffectText {
    /// Look for its place.
    ///
    /// # Errors
    /// As [`Effect::at`].
    pub fn resolve(&self, ring: &Ring) -> Result<Effect, EffectError> {
        Effect::at(self.kind, &self.place, self.amplitude, ring)
    }
}

impl FromStr for EffectText {
    type Err = EffectError;

    fn from_str(text: &str) -> Result<Self, EffectError> {
        let (head, amplitude) = text.split_once('=').map_or((text, None), |(head, amplitude)| (head, Some(amplitude)));
        let (word, place) = head.split_once('@').unwrap_or((head, ""));
        let kind: EffectKind = word.parse()?;
        let amplitude = amplitude.map_or(Ok(1.0), |text| FINITE.parse(text));
        let amplitude = amplitude.map_err(|problem| EffectError::Amplitude { effect: word.into(), problem })?;
        Ok(Self { kind, place: place.into(), amplitude })
    }
}

impl fmt::Display for EffectText {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let at = if self.place.is_empty() { "" } else { "@" };
        write!(f, "{}{at}{}={}", self.kind, self.place, self.amplitude)
    }
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
    /// An amplitude that is no number of a measurement.
    #[error("effect {effect}: amplitude: {problem}")]
    Amplitude {
        /// The effect.
        effect: String,
        /// What was expected, what was written.
        problem: String,
    },
    /// A place that the ring lacks, or that the kind cannot act on.
    #[error("effect {kind}: expected {expected}, found {found:?}")]
    Place {
        /// The kind.
        kind: &'static str,
        /// What the kind acts on.
        expected: String,
        /// What was written.
        found: String,
    },
    /// No stable motion with it.
    #[error("effect {effect}: {error}")]
    Orbit {
        /// The kind.
        effect: &'static str,
        /// Why.
        error: OrbitError,
    },
    /// No stable motion of the machine.
    #[error("the machine: {0}")]
    Machine(#[from] OrbitError),
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;

    #[test]
    fn words_parse_and_unknown_ones_are_refused() {
        let ring = Ring::booster();
        let swap = Effect::parse("bpm_swap@x_E4,x_E6", &ring).unwrap();
        assert_eq!(swap.text(&ring).to_string(), "bpm_swap@x_E4,x_E6=1");
        let refused = |text: &str| Effect::parse(text, &ring).unwrap_err().to_string();
        assert!(refused("bpm_gian@x_E4").starts_with("unknown effect \"bpm_gian\"; known: bpm_gain,"));
        let cases = [
            ("bpm_gain@x_E4=nan", "effect bpm_gain: amplitude: expected a number from -1e15 to 1e15, found nan"),
            ("bpm_gain@x_E4=", "effect bpm_gain: amplitude: expected a number from -1e15 to 1e15, found \"\""),
            ("bpm_gain@x_C5", "effect bpm_gain: expected a monitor such as x_A6, found \"x_C5\""),
            (
                "bpm_swap@x_E4,y_C5",
                "effect bpm_swap: expected two monitors of one plane such as x_A6,x_A8, found \"x_E4,y_C5\"",
            ),
            (
                "corrector_swap@H_A4,V_A3",
                "effect corrector_swap: expected two correctors of one plane such as H_A2,H_A4, found \"H_A4,V_A3\"",
            ),
            ("corrector_gain@A4", "effect corrector_gain: expected a corrector such as H_A2, found \"A4\""),
            (
                "stray_gradient@QH_A2",
                "effect stray_gradient: expected a free straight such as SLOT_A3, found \"QH_A2\"",
            ),
            ("dipole_gradient", "effect dipole_gradient: expected a dipole such as B_A1, found \"\""),
            ("radial_loop@x_D8,y_C5", "effect radial_loop: expected two horizontal monitors, found \"x_D8,y_C5\""),
            ("quad_drift@D8=1e-3", "effect quad_drift: expected no place, found \"D8\""),
        ];
        cases.iter().for_each(|(text, message)| assert_eq!(refused(text), *message));
    }

    #[test]
    fn places_may_be_said_shortly_or_in_full() {
        let ring = Ring::booster();
        let same = [
            ["quad_roll@D8", "quad_roll@QH_D8"],
            ["bpm_roll@y_C5", "bpm_roll@x_C5"],
            ["bpm_gain@x_E4", "bpm_gain@x_PUH_E4"],
            ["bpm_swap@x_E4,x_E6", "bpm_swap@x_E6,x_E4"],
            ["corrector_swap@H_E4,H_E6", "corrector_swap@H_E6,H_E4"],
            ["corrector_gain@H_A4", "corrector_gain@H_DCH_A4"],
            ["stray_gradient@F6", "stray_gradient@SLOT_F6"],
            ["stray_octupole@F6", "stray_octupole@SLOT_F6"],
            ["dipole_gradient@C4", "dipole_gradient@B_C4"],
            ["sextupole_error@A1", "sextupole_error@SX_A1"],
            ["sextupole_error@SX_A2", "sextupole_error@SXH_A2"],
        ];
        let of = |text| Effect::parse(text, &ring).unwrap();
        same.iter().for_each(|[one, other]| assert_eq!(of(one), of(other)));
    }

    #[test]
    fn every_site_is_a_place_of_its_kind() {
        let ring = testing::dual();
        for &kind in EffectKind::ALL {
            let sites = kind.sites(&ring);
            assert_eq!(sites.is_empty(), kind == EffectKind::RadialLoop, "{kind}");
            for site in sites {
                let effect = Effect { kind, site, amplitude: 1e-6 };
                assert_eq!(effect.text(&ring).resolve(&ring).unwrap(), effect);
                assert!(Machine::new(ring.clone(), Rf::FixedMomentum, &[effect]).is_ok(), "{effect:?}");
            }
        }
    }

    #[test]
    fn no_kind_acts_at_a_site_of_another_sort() {
        let ring = Ring::booster();
        let marker = Site::Element(ring.element("QH_A2").unwrap());
        // correctors 0 and 1 are of one plane, as monitors 0 and 1 are
        let pairs = [Site::pair(0, 1), Site::corrector_pair(0, 1)];
        let sites = [Site::Ring, Site::Monitor(0), pairs[0], Site::Corrector(0), pairs[1], Site::Quadrupole(0), marker];
        for &kind in EffectKind::ALL {
            let acts = |&&site: &&Site| {
                Machine::new(ring.clone(), Rf::FixedMomentum, &[Effect { kind, site, amplitude: 1e-6 }]).is_ok()
            };
            let acting = sites.iter().filter(acts).count();
            let elsewhere = [
                EffectKind::StrayGradient,
                EffectKind::StraySkewGradient,
                EffectKind::StrayOctupole,
                EffectKind::DipoleGradient,
                EffectKind::SextupoleError,
                // these instruments are of one plane
                EffectKind::BpmCoupling,
                EffectKind::CorrectorCoupling,
            ];
            assert_eq!(acting, usize::from(!elsewhere.contains(&kind)), "{kind}");
        }
    }

    /// The Booster with instruments of both planes and free straights of a length.
    fn with_straights(length: f64) -> Ring {
        testing::dual_with(|file| {
            let elements = file["elements"].as_array_mut().unwrap();
            let straights = elements.iter_mut().filter(|element| element["type"] == "marker");
            straights.for_each(|element| element["length"] = length.into());
        })
    }

    /// Nor does a free straight lose its length when a field is put there.
    #[test]
    fn an_effect_of_no_size_changes_no_response() {
        let ring = with_straights(0.5);
        let respond =
            |effects: &[Effect]| Machine::new(ring.clone(), Rf::FixedMomentum, effects).unwrap().response().unwrap();
        let plain = respond(&[]);
        for &kind in EffectKind::ALL.iter().filter(|kind| !kind.is_switch()) {
            for site in kind.sites(&ring).into_iter().step_by(7) {
                let same = respond(&[Effect { kind, site, amplitude: 0.0 }]);
                let off = (&same.x - &plain.x).amax().max((&same.y - &plain.y).amax());
                assert!(off < 1e-9, "{kind} {site:?}: {off:e} m/rad");
            }
        }
    }

    /// A field in a free straight of some length is the same field in one without, and the drift behind it.
    #[test]
    fn a_stray_field_is_at_the_entrance_of_its_straight() {
        let [thin, long] = [0.0, 0.5].map(with_straights);
        for text in ["stray_gradient@SLOT_C3=0.02", "stray_skew_gradient@SLOT_D3=0.01"] {
            let [one, other] = [&thin, &long].map(|ring| {
                let effect = Effect::parse(text, ring).unwrap();
                Machine::new(ring.clone(), Rf::FixedMomentum, &[effect]).unwrap().response().unwrap()
            });
            assert!((&one.x - &other.x).amax() < 1e-9 && (&one.y - &other.y).amax() < 1e-9, "{text}");
        }
    }

    #[test]
    fn phrases_are_those_of_a_control_room() {
        let ring = testing::dual();
        let cases = [
            ("bpm_gain@x_E4=-0.0721", 0.0081, "BPM x_E4 reads 7.21 ± 0.81 % low"),
            ("corrector_gain@V_D3=0.05", 0.01, "corrector V_D3 kicks 5.0 ± 1.0 % too much"),
            ("bpm_roll@y_C5=-0.03", 0.004, "BPM y_C5 is rolled by -30.0 ± 4.0 mrad"),
            ("corrector_roll@H_A4=0.02", 0.003, "corrector H_A4 is rolled by +20.0 ± 3.0 mrad"),
            ("quad_roll@D8=0.01", 0.0005, "quadrupole D8 is rolled by +10.00 ± 0.50 mrad"),
            ("bpm_cubic@x_A6=1e-3", 1e-4, "BPM x_A6 is not linear: +2.50 ± 0.25 % of the position at 5 mm"),
            ("bpm_polarity@x_E4", 0.0, "BPM x_E4 reads with the wrong sign"),
            ("bpm_dead@x_E4", 0.0, "BPM x_E4 does not see the beam"),
            ("bpm_swap@x_E4,x_E6", 0.0, "BPMs x_E4 and x_E6 are exchanged"),
            ("corrector_swap@H_E4,H_E6", 0.0, "the cables of correctors H_E4 and H_E6 are exchanged"),
            ("corrector_polarity@H_A4", 0.0, "corrector H_A4 has the wrong polarity"),
            ("corrector_dead@H_A4", 0.0, "corrector H_A4 does not kick"),
            ("corrector_even@H_A4=0.04", 0.01, "corrector H_A4 kicks 8.0 ± 2.0 % more at + than at -"),
            ("stray_gradient@SLOT_F6=0.02", 0.001, "there is a gradient K1L = +0.0200 ± 0.0010 /m at SLOT_F6"),
            ("stray_skew_gradient@F6=-0.02", 0.001, "there is a skew gradient K1sL = -0.0200 ± 0.0010 /m at SLOT_F6"),
            ("dipole_gradient@B_C4=0.01", 0.002, "dipole B_C4 has a gradient K1L = +0.0100 ± 0.0020 /m"),
            ("dipole_edge=0.01", 0.001, "all dipoles have edge angles of +10.0 ± 1.0 mrad"),
            ("dipole_edge@B_C4=0.01", 0.001, "dipole B_C4 has edge angles of +10.0 ± 1.0 mrad"),
            ("sextupole_error@SX_A1=1.5", 0.2, "sextupole SX_A1 has a field K2L = +1.50 ± 0.20 /m2"),
            ("dipole_sextupole=0.1", 0.01, "all dipoles have a field K2L = +0.100 ± 0.010 /m2"),
            ("stray_octupole@SLOT_F6=-150", 20.0, "there is an octupole K3L = -150 ± 20 /m3 at SLOT_F6"),
            ("momentum_offset=-2e-3", 1e-4, "the beam is off momentum by -2.00 ± 0.10 per mille"),
            ("fixed_rf_frequency", 0.02, "the RF frequency was held instead of the momentum, by +100.0 ± 2.0 %"),
            (
                "radial_loop@x_D8,x_E6=0.8",
                0.01,
                "a radial loop held the mean of x_D8 and x_E6 instead of the momentum, by +80.0 ± 1.0 %",
            ),
            ("rf_step=-0.05", 0.01, "the RF frequency was stepped by +0.950 ± 0.010 times what is recorded"),
            ("bpm_coupling@x_E4=0.03", 0.002, "BPM x_E4 reads +3.00 ± 0.20 % of y_E4 as well"),
            ("corrector_coupling@V_A4=0.02", 0.01, "+2.0 ± 1.0 % of the kick of corrector V_A4 goes to H_A4 as well"),
            ("bpm_crosstalk@x_F8=-0.05", 0.01, "BPM x_F8 reads -5.0 ± 1.0 % of x_A6 as well"),
            ("corrector_crosstalk@H_A2=0.05", 0.01, "+5.0 ± 1.0 % of the kick of corrector H_A2 goes to H_A4 as well"),
            (
                "corrector_hysteresis@V_D3=0.03",
                0.002,
                "corrector V_D3 keeps +3.00 ± 0.20 % of the kick that it had before",
            ),
            (
                "corrector_settling@H_C4=0.12",
                0.01,
                "corrector H_C4 is late: the frame after a change lacks +12.0 ± 1.0 % of it",
            ),
            ("bpm_timing@y_C5=0.2", 0.03, "+20.0 ± 3.0 % of what BPM y_C5 reads is the frame before"),
            ("quad_drift=1e-3", 1e-4, "all quadrupoles drifted by +2.00 ± 0.20 per mille from start to end"),
        ];
        let of = |text: &str| Effect::parse(text, &ring).unwrap();
        assert!(EffectKind::ALL.iter().all(|kind| cases.iter().any(|case| of(case.0).kind == *kind)));
        for (text, sigma, words) in cases {
            let Effect { kind, site, amplitude } = of(text);
            assert_eq!(kind.phrase(&ring, site, Measured { value: amplitude, sigma }), words);
        }
    }
}
