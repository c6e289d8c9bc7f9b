//! Physics that the library of effects does not hold, for campaigns whose right verdict is "unexplained".
//!
//! Sizes are drawn evenly in their logarithm, from well below the noise to far above it. `t` is the time within the campaign, from -1 to 1.
//!
//! | word | what happens, `a` the size | unit |
//! |---|---|---|
//! | `quad_jump` | one quadrupole is stronger by the share `a` from some moment on | 1 |
//! | `bpm_warm_up` | a monitor's gain is off by `a exp(-(t + 1)/0.5)` | 1 |
//! | `bpm_saturation` | a monitor reads `x/(1 + (a x)^8)^(1/8)`: linear for small x, and limited to `1/a` | 1/m |
//! | `orbit_drift` | the kick of an unlogged corrector varies slowly by ±`a` | rad |
//! | `bpm_wander` | a monitor's offset varies slowly by ±`a` | m |
//! | `dead_band` | a monitor shows its last position until that differs by more than `a`; its noise comes on top | m |
//! | `cable_pickup` | a monitor reads the current in the correctors' cable tray: `+ a (sum of all kicks)/0.2 mrad` | m |
//! | `bus_sag` | the load on the correctors' common bus shifts one corrector: its kick `+ a (sum of all abs(kick))/0.2 mrad` | rad |
//! | `alternate_cycle` | a corrector gives a kick `a` too much in every second machine cycle, which follows another user's | rad |
//! | `thermostat` | `ln` of a quadrupole's gradient follows its cooling water: `+ a sin(2 pi (5 t/2 + phase))` | 1 |
//! | `solenoid` | a drift is filled by a solenoid that turns the beam by `a`: `ks = 2 a/length` | rad |
//!
//! The last six are by somebody who had seen neither the library nor the diagnosis: they say what becomes of physics that the diagnosis was not made for.

use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use twin::{Cycle, Element, Kind, Ring, Site};

use inference::simulate::Beyond;

/// The kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnmodelledKind {
    /// A quadrupole changes at once in mid-campaign.
    QuadJump,
    /// A monitor's gain settles while its electronics warm up.
    WarmUp,
    /// A monitor saturates.
    Saturation,
    /// The orbit drifts.
    OrbitDrift,
    /// A monitor's offset drifts.
    BpmWander,
    /// A monitor is read out anew only when its value has changed enough.
    DeadBand,
    /// A monitor's cable picks up the current of all correctors.
    CablePickup,
    /// A corrector's supply changes with the load of all correctors, whatever their sign.
    BusSag,
    /// A corrector keeps a remanent field in every second machine cycle.
    AlternateCycle,
    /// A quadrupole's gradient swings with its cooling water, five times in the campaign.
    Thermostat,
    /// A solenoid, uncompensated, in a free drift.
    Solenoid,
}

/// One of them: where, and how large.
#[derive(Debug, Clone, PartialEq)]
pub struct Unmodelled {
    /// What happens.
    pub kind: UnmodelledKind,
    /// Where.
    pub site: Site,
    /// How much, with its sign; the unit is that of the kind.
    pub size: f64,
    /// Index of the place: read monitor, corrector, quadrupole or element.
    index: usize,
    /// Time of a jump, or phase of a variation, -0.5 to 0.5.
    when: f64,
}

/// What a corrector kicks at its nominal setting [rad].
const FULL_KICK: f64 = 2e-4;
/// Length from which on a drift takes a solenoid [m]: its focusing, of the order of a^2/length, is then weak.
const ROOM: f64 = 0.5;

impl UnmodelledKind {
    /// Those that have places in a ring.
    pub fn in_ring(ring: &Ring) -> Vec<Self> {
        Self::ALL.into_iter().filter(|kind| !kind.sites(ring).is_empty()).collect()
    }

    /// Every kind.
    pub const ALL: [Self; 11] = [
        Self::QuadJump,
        Self::WarmUp,
        Self::Saturation,
        Self::OrbitDrift,
        Self::BpmWander,
        Self::DeadBand,
        Self::CablePickup,
        Self::BusSag,
        Self::AlternateCycle,
        Self::Thermostat,
        Self::Solenoid,
    ];

    /// True for those that the diagnosis was not made for.
    pub fn is_frozen(self) -> bool {
        match self {
            Self::QuadJump | Self::WarmUp | Self::Saturation | Self::OrbitDrift | Self::BpmWander => false,
            Self::DeadBand
            | Self::CablePickup
            | Self::BusSag
            | Self::AlternateCycle
            | Self::Thermostat
            | Self::Solenoid => true,
        }
    }

    /// The word for it.
    pub fn word(self) -> &'static str {
        match self {
            Self::QuadJump => "quad_jump",
            Self::WarmUp => "bpm_warm_up",
            Self::Saturation => "bpm_saturation",
            Self::OrbitDrift => "orbit_drift",
            Self::BpmWander => "bpm_wander",
            Self::DeadBand => "dead_band",
            Self::CablePickup => "cable_pickup",
            Self::BusSag => "bus_sag",
            Self::AlternateCycle => "alternate_cycle",
            Self::Thermostat => "thermostat",
            Self::Solenoid => "solenoid",
        }
    }

    /// The kind of a word.
    pub fn named(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.word() == word)
    }

    /// Sizes from weak to strong.
    pub fn sizes(self) -> [f64; 2] {
        match self {
            Self::QuadJump => [2e-3, 2e-2],
            Self::WarmUp => [0.02, 0.3],
            Self::Saturation => [1.0 / 6e-3, 1.0 / 1.5e-3],
            Self::OrbitDrift => [3e-6, 1e-4],
            Self::BpmWander => [1e-4, 2e-3],
            Self::DeadBand => [1e-4, 1e-2],
            Self::CablePickup => [2e-5, 3e-3],
            Self::BusSag | Self::AlternateCycle => [5e-7, 1e-4],
            Self::Thermostat => [5e-4, 0.025],
            Self::Solenoid => [5e-4, 0.05],
        }
    }

    /// Where it may act in a campaign.
    fn sites(self, ring: &Ring) -> Vec<Site> {
        match self {
            Self::WarmUp | Self::Saturation | Self::BpmWander | Self::DeadBand | Self::CablePickup => {
                ring.read_monitors.iter().map(|&at| Site::Monitor(at)).collect()
            }
            Self::QuadJump | Self::Thermostat => (0..ring.quadrupoles.len()).map(Site::Quadrupole).collect(),
            Self::OrbitDrift | Self::BusSag | Self::AlternateCycle => {
                (0..ring.correctors.len()).map(Site::Corrector).collect()
            }
            Self::Solenoid => {
                let has_room = |element: &Element| element.kind == Kind::Drift && element.length > ROOM;
                (0..ring.elements.len()).filter(|&at| has_room(&ring.elements[at])).map(Site::Element).collect()
            }
        }
    }
}

impl Unmodelled {
    /// One of a kind, of random place, size and sign.
    ///
    /// # Panics
    /// If the ring has no place for it.
    pub fn of(kind: UnmodelledKind, ring: &Ring, seed: u64) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let sites = kind.sites(ring);
        let site = *sites.choose(&mut random).expect("a ring has places of every kind");
        let [weak, strong] = kind.sizes().map(f64::ln);
        let sign = if kind != UnmodelledKind::Saturation && random.random_bool(0.5) { -1.0 } else { 1.0 };
        let size = sign * random.random_range(weak..=strong).exp();
        Self { kind, site, size, index: index(ring, site), when: random.random_range(-0.5..=0.5) }
    }

    /// One of any kind.
    pub fn any(ring: &Ring, seed: u64) -> Self {
        let mut streams = inference::simulate::seeds(seed);
        let mut stream = || streams.next().expect("seeds do not end");
        let kind = UnmodelledKind::ALL.choose(&mut StdRng::seed_from_u64(stream())).expect("there are some");
        Self::of(*kind, ring, stream())
    }

    /// A slow variation between -1 and 1.
    fn slow_variation(&self, time: f64) -> f64 {
        (core::f64::consts::PI * (time + 2.0 * self.when)).sin()
    }
}

impl Beyond for Unmodelled {
    fn alter_ring(&self, ring: &mut Ring) {
        if self.kind == UnmodelledKind::Solenoid {
            let drift = &mut ring.elements[self.index];
            drift.kind = Kind::Solenoid { ks: 2.0 * self.size / drift.length };
        }
    }

    fn alter_cycles(&self, cycles: &mut [Cycle]) {
        for (count, cycle) in cycles.iter_mut().enumerate() {
            match self.kind {
                UnmodelledKind::QuadJump if cycle.time >= self.when => cycle.strength[self.index] += self.size.ln_1p(),
                UnmodelledKind::Thermostat => {
                    let phase = core::f64::consts::TAU * (2.5 * cycle.time + self.when);
                    cycle.strength[self.index] += self.size * phase.sin();
                }
                UnmodelledKind::OrbitDrift => cycle.kick[self.index] += self.size * self.slow_variation(cycle.time),
                UnmodelledKind::BusSag => {
                    let load: f64 = cycle.kick.iter().map(|kick| kick.abs()).sum();
                    cycle.kick[self.index] += self.size * load / FULL_KICK;
                }
                UnmodelledKind::AlternateCycle if count % 2 == 1 => cycle.kick[self.index] += self.size,
                _ => {}
            }
        }
    }

    fn alter_readings(&self, cycles: &[Cycle], readings: &mut DMatrix<f64>) {
        let mut shown = f64::INFINITY;
        let mut read = |cycle: &Cycle, x: f64| match self.kind {
            UnmodelledKind::WarmUp => x * (1.0 + self.size * (-(cycle.time + 1.0) / 0.5).exp()),
            UnmodelledKind::Saturation => x / (1.0 + (self.size * x).powi(8)).powf(0.125),
            UnmodelledKind::BpmWander => x + self.size * self.slow_variation(cycle.time),
            UnmodelledKind::CablePickup => x + self.size * cycle.kick.iter().sum::<f64>() / FULL_KICK,
            UnmodelledKind::DeadBand => {
                if (x - shown).abs() > self.size.abs() {
                    shown = x;
                }
                shown
            }
            _ => x,
        };
        if matches!(self.site, Site::Monitor(_)) {
            for (cycle, reading) in cycles.iter().zip(&mut readings.column_mut(self.index)) {
                *reading = read(cycle, *reading);
            }
        }
    }
}

/// Index of the place among the read monitors, correctors, quadrupoles or elements.
fn index(ring: &Ring, site: Site) -> usize {
    match site {
        Site::Monitor(at) => {
            ring.read_monitors.iter().position(|&read| read == at).expect("its sites are read monitors")
        }
        Site::Corrector(at) | Site::Quadrupole(at) | Site::Element(at) => at,
        Site::Ring | Site::MonitorPair(..) | Site::CorrectorPair(..) => unreachable!("no kind acts there"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{ideal, readings, template};
    use inference::recording::Recording;
    use inference::simulate::{Truth, campaign};

    /// Readings with the unknown less those without, rows frames.
    fn change(unknown: &Unmodelled, ring: &Ring, recording: &Recording) -> DMatrix<f64> {
        let beyond: &dyn Beyond = unknown;
        let made = |beyond: &[&dyn Beyond]| {
            let truth = Truth { vars: &[1.0; 48], beyond, ..Truth::default() };
            readings(&campaign(recording, ring, &truth, &ideal(ring), 5).unwrap())
        };
        made(&[beyond]) - made(&[])
    }

    #[test]
    fn every_kind_moves_readings_and_keeps_the_beam() {
        let (ring, recording) = template();
        for kind in UnmodelledKind::ALL {
            for seed in 0..2 {
                let unknown = Unmodelled::of(kind, &ring, seed);
                let change = change(&unknown, &ring, &recording);
                let moved = change.column_iter().filter(|column| column.abs().max() > 1e-9).count();
                println!(
                    "{} {} {:.3e}: {moved} monitors, {:.2e} m",
                    kind.word(),
                    unknown.site.name(&ring),
                    unknown.size,
                    change.abs().max()
                );
                let of_a_monitor = matches!(unknown.site, Site::Monitor(_));
                // a limit may be out of reach of the orbit
                let least = if kind == UnmodelledKind::Saturation { 0 } else { 1 };
                assert!(moved >= least && (moved <= 1) == of_a_monitor, "{unknown:?}: {moved} monitors");
            }
        }
    }

    #[test]
    fn a_draw_is_within_its_sizes_and_depends_on_its_seed() {
        let ring = Ring::booster();
        let drawn: Vec<Unmodelled> = (0..200).map(|seed| Unmodelled::any(&ring, seed)).collect();
        for unknown in &drawn {
            let [weak, strong] = unknown.kind.sizes();
            assert!((weak..=strong * 1.000_001).contains(&unknown.size.abs()), "{unknown:?}");
        }
        assert!(UnmodelledKind::ALL.iter().all(|kind| drawn.iter().any(|unknown| unknown.kind == *kind)));
        assert_eq!(drawn[4], Unmodelled::any(&ring, 4));
    }
}
