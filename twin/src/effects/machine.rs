//! A ring with effects applied, and the response that would then be measured.

use nalgebra::{DMatrix, Rotation2, Vector2};

use super::held::Held;
use super::{Effect, EffectError, EffectKind};
use crate::lattice::{Kind, Plane, Ring};
use crate::orbit::{Hold, OrbitError};
use crate::response::{Optics, Source, Tunes};

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
    pub(super) ring: Ring,
    /// Momentum of the beam.
    pub(super) delta: f64,
    /// Share of the answer that is given at fixed RF frequency.
    pub(super) frequency_share: f64,
    /// Monitors (indices among the places) whose mean is held, and the share.
    pub(super) radial_loop: Option<([usize; 2], f64)>,
    /// What monitors and correctors do to the response, in the order given.
    pub(super) instruments: Vec<Instrument>,
    /// Sextupole fields beyond the ring's: element, K2L [1/m^2].
    pub(super) sextupoles: Vec<(usize, f64)>,
    /// Relative change of all quadrupoles from the first frame (-) to the last (+).
    pub(super) drift: f64,
}

#[derive(Debug, Clone)]
pub(super) enum Instrument {
    Gain { plane: Plane, place: usize, error: f64 },
    Cubic { plane: Plane, place: usize, per_square_mm: f64 },
    Roll { place: usize, angle: f64 },
    Swap { plane: Plane, places: [usize; 2] },
    Kick { corrector: usize, factor: f64 },
    Even { corrector: usize, share: f64 },
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
        let mut machine = Self {
            ring,
            delta: 0.0,
            frequency_share,
            radial_loop: None,
            instruments: Vec::new(),
            sextupoles: Vec::new(),
            drift: 0.0,
        };
        effects.iter().try_for_each(|effect| machine.apply(effect))?;
        Ok(machine)
    }

    /// The ring, with the effects that sit in it.
    pub fn ring(&self) -> &Ring {
        &self.ring
    }

    /// Relative change of all gradients from mid-campaign to its end.
    pub fn drift(&self) -> f64 {
        self.drift
    }

    pub(super) fn apply(&mut self, effect: &Effect) -> Result<(), EffectError> {
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
                let corrector = self.ring.correctors[self.corrector(effect)?].element;
                self.ring.elements[corrector].misalignment.roll += a;
            }
            EffectKind::QuadRoll => {
                let at = self.ring.quadrupoles[self.ring.quadrupole(cell(place))?].element;
                self.ring.elements[at].misalignment.roll += a;
            }
            EffectKind::StrayGradient => self.stray(effect, a, 0.0)?,
            EffectKind::StraySkewGradient => self.stray(effect, 0.0, a)?,
            EffectKind::DipoleGradient => self.bend(effect, |bend, length| bend.k1 += a / length)?,
            EffectKind::DipoleEdge => self.bend(effect, |bend, _| {
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
            EffectKind::CorrectorEven => {
                let corrector = self.corrector(effect)?;
                self.instruments.push(Instrument::Even { corrector, share: a });
            }
            EffectKind::QuadDrift => {
                effect.everywhere()?;
                self.drift += a;
            }
        }
        Ok(())
    }

    /// The same machine with factors on the quadrupoles' gradients.
    pub fn with_vars(&self, vars: &[f64]) -> Self {
        Self { ring: self.ring.with_vars(vars), ..self.clone() }
    }

    /// Orbit response as it would be measured, places `[48]` (H monitors then V) by correctors `[48]` (H then V).
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn response(&self) -> Result<MachineResponse, OrbitError> {
        let optics = Optics::of(&self.ring, Hold::Momentum { delta: self.delta })?;
        let (mut x, mut y) = self.held(&self.ring, &optics)?;
        self.instruments.iter().for_each(|i| self.read(&optics, i, &mut x, &mut y));
        let dispersion = optics.monitor_places(Plane::X).iter().map(|o| optics.dispersion(o)).collect();
        Ok(MachineResponse { x, y, dispersion, tunes: optics.tunes()?, gamma_transition: optics.gamma_transition() })
    }

    /// Response (x, y) at the monitor places with what this machine holds constant.
    pub(super) fn held(&self, ring: &Ring, optics: &Optics) -> Result<(DMatrix<f64>, DMatrix<f64>), OrbitError> {
        let held = Held::of(ring, optics, self.frequency_share, self.radial_loop)?;
        let of = |plane| held.response(optics, &optics.monitor_places(plane), &optics.correctors());
        Ok((of(Plane::X), of(Plane::Y)))
    }

    fn read(&self, optics: &Optics, instrument: &Instrument, x: &mut DMatrix<f64>, y: &mut DMatrix<f64>) {
        match *instrument {
            Instrument::Gain { plane, place, error } => scale(rows(plane, x, y).row_mut(place).iter_mut(), 1.0 + error),
            Instrument::Cubic { plane, place, per_square_mm } => {
                let orbit =
                    optics.orbit(self.ring.monitors[place].element)[if plane == Plane::X { 0 } else { 2 }] * 1e3;
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
            // moves both signs alike: not their half difference, which a response is
            Instrument::Even { .. } => {}
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
    pub(super) fn monitor(&self, effect: &Effect, name: &str) -> Result<(Plane, usize), EffectError> {
        let wrong = || effect.wrong("a monitor such as x_E4 or y_C5");
        let (plane, cell) = name.split_once('_').ok_or_else(wrong)?;
        let plane = match plane {
            "x" => Plane::X,
            "y" => Plane::Y,
            _ => return Err(wrong()),
        };
        // the monitor of that plane, or the other one of the half-cell, whose roll shows in that plane
        let of = |own: bool| {
            let is = |m: &crate::Monitor| self.ring.elements[m.element].is_called(cell) && (!own || m.plane == plane);
            self.ring.monitors.iter().position(is)
        };
        let place = of(true).or_else(|| of(false)).ok_or_else(wrong)?;
        Ok((plane, place))
    }

    pub(super) fn monitor_pair(&self, effect: &Effect) -> Result<[(Plane, usize); 2], EffectError> {
        let (one, other) =
            effect.place.split_once(',').ok_or_else(|| effect.wrong("two monitors such as x_D8,x_E6"))?;
        let pair = [self.monitor(effect, one)?, self.monitor(effect, other)?];
        if pair[0].0 != pair[1].0 {
            return Err(effect.wrong("two monitors of one plane"));
        }
        Ok(pair)
    }

    /// Index among the correctors of `H_A4` or `V_D3`.
    pub(super) fn corrector(&self, effect: &Effect) -> Result<usize, EffectError> {
        match effect.place.split_once('_') {
            Some(("H", cell)) => Ok(self.ring.corrector(Plane::X, cell)?),
            Some(("V", cell)) => Ok(self.ring.corrector(Plane::Y, cell)?),
            _ => Err(effect.wrong("a corrector such as H_A4 or V_D3")),
        }
    }

    fn stray(&mut self, effect: &Effect, k1l: f64, k1sl: f64) -> Result<(), EffectError> {
        let straight = |e: &crate::Element| matches!(e.kind, Kind::Marker | Kind::Multipole { .. });
        let named = |e: &crate::Element| e.is_called(&effect.place);
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

    /// The dipole of an effect, or all where edges are meant and no place is given.
    pub(super) fn bends(&self, effect: &Effect) -> Result<Vec<usize>, EffectError> {
        let everywhere = effect.place.is_empty() && effect.kind == EffectKind::DipoleEdge;
        let named = |name: &str| everywhere || name == effect.place || name.ends_with(&format!("_{}", effect.place));
        let is = |(_, e): &(usize, &crate::Element)| matches!(e.kind, Kind::Bend(_)) && named(&e.name);
        let found: Vec<usize> = self.ring.elements.iter().enumerate().filter(is).map(|(at, _)| at).collect();
        if found.is_empty() { Err(effect.wrong("a dipole such as B_C4")) } else { Ok(found) }
    }

    fn bend(&mut self, effect: &Effect, change: impl Fn(&mut crate::lattice::Bend, f64)) -> Result<(), EffectError> {
        for at in self.bends(effect)? {
            let element = &mut self.ring.elements[at];
            if let Kind::Bend(bend) = &mut element.kind {
                change(bend, element.length);
            }
        }
        Ok(())
    }

    fn sextupole(&mut self, effect: &Effect) -> Result<(), EffectError> {
        let wanted = cell(&effect.place);
        let is = |e: &crate::Element| matches!(e.kind, Kind::Sextupole { .. }) && e.is_called(wanted);
        let found = self.ring.elements.iter_mut().enumerate().find(|(_, e)| is(e));
        let (at, element) = found.ok_or_else(|| effect.wrong("a sextupole such as SX_A1"))?;
        if let Kind::Sextupole { k2 } = &mut element.kind {
            *k2 += effect.amplitude / element.length;
        }
        self.sextupoles.push((at, effect.amplitude));
        Ok(())
    }
}

/// The half-cell of a place that may carry a prefix: `D8` of `QH_D8`.
fn cell(place: &str) -> &str {
    place.split_once('_').map_or(place, |(_, cell)| cell)
}

/// Response (x, y) at the monitor places to kicks.
pub(super) fn planes(optics: &Optics, sources: &[Source]) -> (DMatrix<f64>, DMatrix<f64>) {
    let respond = |plane| optics.response(&optics.monitor_places(plane), sources);
    (respond(Plane::X), respond(Plane::Y))
}

pub(super) fn rows<'m>(plane: Plane, x: &'m mut DMatrix<f64>, y: &'m mut DMatrix<f64>) -> &'m mut DMatrix<f64> {
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
    fn instruments_act_on_their_rows_and_columns() {
        let plain = respond(&[]);
        let places = Ring::booster().monitors.len();
        let e4 = (0..places).find(|&i| Ring::booster().monitor_name(i) == "x_E4").unwrap();
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
        let of = |label: &str| Ring::booster().monitor(Plane::X, label).unwrap();
        let mean = held.x.row(of("D8")) + held.x.row(of("E6"));
        assert!(mean.abs().max() < 1e-9);
    }
}
