//! What is known of each kind of effect before any data: where it may act, how large it is, and how to say it.

use super::EffectKind;
use crate::lattice::{Kind, Ring};

impl EffectKind {
    /// Every place of a ring where the kind may act, by the names of the command line; one empty name for the whole ring.
    ///
    /// A radial loop holds monitors that only the recording's header knows; its place is given there.
    pub fn sites(self, ring: &Ring) -> Vec<String> {
        let named = |is: fn(&Kind) -> bool| -> Vec<String> {
            ring.elements.iter().filter(|e| is(&e.kind)).map(|e| e.name.clone()).collect()
        };
        match self {
            Self::BpmGain | Self::BpmRoll | Self::BpmCubic => ring.monitor_names(),
            Self::BpmSwap => pairs(&ring.monitor_names()),
            Self::CorrectorGain | Self::CorrectorRoll | Self::CorrectorPolarity | Self::CorrectorEven => {
                ring.corrector_names()
            }
            Self::QuadRoll => ring.quadrupoles.iter().map(|q| ring.label(q.element).to_owned()).collect(),
            Self::StrayGradient | Self::StraySkewGradient => named(|kind| matches!(kind, Kind::Marker)),
            Self::DipoleGradient => named(|kind| matches!(kind, Kind::Bend(_))),
            Self::DipoleEdge => {
                named(|kind| matches!(kind, Kind::Bend(_))).into_iter().chain([String::new()]).collect()
            }
            Self::SextupoleError => {
                let sextupoles = ring.elements.iter().filter(|e| matches!(e.kind, Kind::Sextupole { .. }));
                sextupoles.map(|e| format!("SX_{}", e.label)).collect()
            }
            Self::MomentumOffset | Self::FixedRfFrequency | Self::QuadDrift => vec![String::new()],
            Self::RadialLoop => Vec::new(),
        }
    }

    /// Standard deviation of the amplitude among faults worth finding, mean 0, in the unit of the kind; `None` where the
    /// effect is there or not, without an amplitude.
    ///
    /// | kind | source |
    /// |---|---|
    /// | gains | calibrations of monitors and correctors found by LOCO scatter by 2 to 5 %, faulty ones by 10 % (J. Safranek, NIM A 388 (1997) 27) |
    /// | rolls | a monitor or corrector turned by a bracket's play, 50 mrad; a quadrupole by its supports, 10 mrad: ten times the survey's 1 to 5 mrad |
    /// | cubic | a button monitor is off by some per cent at 5 mm: 1e-3/mm2 |
    /// | stray gradients | a tenth of a quadrupole, whose K1L is 0.28/m; skew and in a dipole: half of that |
    /// | edges | a tenth of the angle over which a rectangular magnet would differ, several mrad to 50 mrad |
    /// | sextupole | that of a chromaticity sextupole at full current, some 1/m2 |
    /// | momentum, drift | a radial position known to some mm at a dispersion of 2 m; supplies that warm up by per mille |
    pub fn prior_scale(self) -> Option<f64> {
        match self {
            Self::BpmGain | Self::CorrectorGain => Some(0.08),
            Self::BpmRoll | Self::CorrectorRoll => Some(0.06),
            Self::QuadRoll => Some(0.015),
            Self::BpmCubic => Some(1.5e-3),
            Self::CorrectorEven => Some(0.05),
            Self::StrayGradient => Some(0.025),
            Self::StraySkewGradient | Self::DipoleGradient => Some(0.012),
            Self::DipoleEdge => Some(0.05),
            Self::SextupoleError => Some(2.0),
            Self::MomentumOffset => Some(3e-3),
            Self::QuadDrift => Some(2e-3),
            Self::FixedRfFrequency | Self::RadialLoop | Self::BpmSwap | Self::CorrectorPolarity => None,
        }
    }

    /// Unit of the amplitude.
    pub fn unit(self) -> &'static str {
        match self {
            Self::BpmRoll | Self::CorrectorRoll | Self::QuadRoll | Self::DipoleEdge => "rad",
            Self::BpmCubic => "1/mm2",
            Self::StrayGradient | Self::StraySkewGradient | Self::DipoleGradient => "1/m",
            Self::SextupoleError => "1/m2",
            _ => "1",
        }
    }

    /// True for what one corrector does: a held-out corrector could not show it.
    pub fn is_of_a_corrector(self) -> bool {
        matches!(self, Self::CorrectorGain | Self::CorrectorRoll | Self::CorrectorEven | Self::CorrectorPolarity)
    }

    /// What is said of it: place, amplitude and error bar in the words of a control room.
    pub fn phrase(self, place: &str, amplitude: f64, sigma: f64) -> String {
        let of = |scale: f64| format!("{} ± {}", short((amplitude * scale).abs(), sigma * scale), error(sigma * scale));
        let signed = |scale: f64| format!("{}{}", if amplitude < 0.0 { "-" } else { "+" }, of(scale));
        let more = |up: &'static str, down: &'static str| if amplitude < 0.0 { down } else { up };
        match self {
            Self::BpmGain => format!("BPM {place} reads {} % {}", of(100.0), more("high", "low")),
            Self::BpmRoll => format!("BPM {place} is rolled by {} mrad", signed(1e3)),
            Self::BpmCubic => format!("BPM {place} is not linear: {} % of the position at 5 mm", signed(2500.0)),
            Self::BpmSwap => format!("BPMs {} are exchanged", place.replace(',', " and ")),
            Self::CorrectorGain => format!("corrector {place} kicks {} % too {}", of(100.0), more("much", "little")),
            Self::CorrectorRoll => format!("corrector {place} is rolled by {} mrad", signed(1e3)),
            Self::CorrectorPolarity => format!("corrector {place} has the wrong polarity"),
            Self::CorrectorEven => {
                format!("corrector {place} kicks {} % {} at + than at -", of(200.0), more("more", "less"))
            }
            Self::QuadRoll => format!("quadrupole {place} is rolled by {} mrad", signed(1e3)),
            Self::StrayGradient => format!("there is a gradient K1L = {} /m at {place}", signed(1.0)),
            Self::StraySkewGradient => format!("there is a skew gradient K1sL = {} /m at {place}", signed(1.0)),
            Self::DipoleGradient => format!("dipole {place} has a gradient K1L = {} /m", signed(1.0)),
            Self::DipoleEdge if place.is_empty() => format!("all dipoles have edge angles of {} mrad", signed(1e3)),
            Self::DipoleEdge => format!("dipole {place} has edge angles of {} mrad", signed(1e3)),
            Self::SextupoleError => format!("sextupole {place} has a field K2L = {} /m2", signed(1.0)),
            Self::MomentumOffset => format!("the beam is off momentum by {} per mille", signed(1e3)),
            Self::FixedRfFrequency => "the RF frequency was held, not the momentum".into(),
            Self::RadialLoop => {
                format!("a radial loop held the mean of {}, not the momentum", place.replace(',', " and "))
            }
            Self::QuadDrift => {
                format!("all quadrupoles drifted by {} per mille from start to end", signed(2e3))
            }
        }
    }
}

/// All pairs of one plane.
fn pairs(names: &[String]) -> Vec<String> {
    let pair = |(i, one): (usize, &String)| {
        let others = names[i + 1..].iter().filter(|other| other[..1] == one[..1]);
        others.map(|other| format!("{one},{other}")).collect::<Vec<_>>()
    };
    names.iter().enumerate().flat_map(pair).collect()
}

/// Digits down to the second of the error bar.
fn short(value: f64, sigma: f64) -> String {
    format!("{value:.*}", digits(sigma))
}

fn error(sigma: f64) -> String {
    format!("{sigma:.*}", digits(sigma))
}

fn digits(sigma: f64) -> usize {
    if sigma > 0.0 { (1.0 - sigma.log10().floor()).clamp(0.0, 6.0) as usize } else { 3 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Effect, Machine, Rf};

    #[test]
    fn every_site_is_a_place_of_its_kind() {
        let ring = Ring::booster();
        for &kind in EffectKind::ALL {
            let sites = kind.sites(&ring);
            assert_eq!(sites.is_empty(), kind == EffectKind::RadialLoop, "{}", kind.word());
            for place in sites {
                let effect = Effect { kind, place, amplitude: 1e-6 };
                assert!(
                    Machine::new(ring.clone(), Rf::FixedMomentum, core::slice::from_ref(&effect)).is_ok(),
                    "{effect:?}"
                );
            }
        }
    }

    #[test]
    fn phrases_are_those_of_a_control_room() {
        let cases = [
            (EffectKind::BpmGain, "x_E4", -0.0721, 0.0081, "BPM x_E4 reads 7.21 ± 0.81 % low"),
            (EffectKind::CorrectorGain, "V_D3", 0.05, 0.01, "corrector V_D3 kicks 5.0 ± 1.0 % too much"),
            (EffectKind::BpmRoll, "y_C5", -0.03, 0.004, "BPM y_C5 is rolled by -30.0 ± 4.0 mrad"),
            (EffectKind::CorrectorRoll, "H_A4", 0.02, 0.003, "corrector H_A4 is rolled by +20.0 ± 3.0 mrad"),
            (EffectKind::QuadRoll, "D8", 0.01, 0.0005, "quadrupole D8 is rolled by +10.00 ± 0.50 mrad"),
            (
                EffectKind::BpmCubic,
                "x_A6",
                1e-3,
                1e-4,
                "BPM x_A6 is not linear: +2.50 ± 0.25 % of the position at 5 mm",
            ),
            (EffectKind::BpmSwap, "x_E4,x_E6", 1.0, 0.0, "BPMs x_E4 and x_E6 are exchanged"),
            (EffectKind::CorrectorPolarity, "H_A4", 1.0, 0.0, "corrector H_A4 has the wrong polarity"),
            (EffectKind::CorrectorEven, "H_A4", 0.04, 0.01, "corrector H_A4 kicks 8.0 ± 2.0 % more at + than at -"),
            (
                EffectKind::StrayGradient,
                "SLOT_F6",
                0.02,
                0.001,
                "there is a gradient K1L = +0.0200 ± 0.0010 /m at SLOT_F6",
            ),
            (
                EffectKind::StraySkewGradient,
                "SLOT_F6",
                -0.02,
                0.001,
                "there is a skew gradient K1sL = -0.0200 ± 0.0010 /m at SLOT_F6",
            ),
            (EffectKind::DipoleGradient, "B_C4", 0.01, 0.002, "dipole B_C4 has a gradient K1L = +0.0100 ± 0.0020 /m"),
            (EffectKind::DipoleEdge, "", 0.01, 0.001, "all dipoles have edge angles of +10.0 ± 1.0 mrad"),
            (EffectKind::SextupoleError, "SX_A1", 1.5, 0.2, "sextupole SX_A1 has a field K2L = +1.50 ± 0.20 /m2"),
            (EffectKind::MomentumOffset, "", -2e-3, 1e-4, "the beam is off momentum by -2.00 ± 0.10 per mille"),
            (EffectKind::FixedRfFrequency, "", 1.0, 0.0, "the RF frequency was held, not the momentum"),
            (
                EffectKind::RadialLoop,
                "x_D8,x_E6",
                1.0,
                0.0,
                "a radial loop held the mean of x_D8 and x_E6, not the momentum",
            ),
            (
                EffectKind::QuadDrift,
                "",
                1e-3,
                1e-4,
                "all quadrupoles drifted by +2.00 ± 0.20 per mille from start to end",
            ),
        ];
        assert!(EffectKind::ALL.iter().all(|kind| cases.iter().any(|case| case.0 == *kind)));
        for (kind, place, amplitude, sigma, words) in cases {
            assert_eq!(kind.phrase(place, amplitude, sigma), words);
        }
    }
}
