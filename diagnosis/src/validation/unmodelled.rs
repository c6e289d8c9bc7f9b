//! Physics that the library of effects does not hold, for campaigns whose right verdict is "unexplained".
//!
//! Sizes are drawn evenly in their logarithm, from well below the noise to far above it.
//!
//! | word | what happens, `a` the size | unit |
//! |---|---|---|
//! | `quad_jump` | one quadrupole is stronger by the share `a` from some moment on | 1 |
//! | `bpm_warm_up` | a monitor's gain is off by `a exp(-(t + 1)/0.5)`, t from -1 to 1 | 1 |
//! | `bpm_saturation` | a monitor reads `x/(1 + (a x)^8)^(1/8)`: linear for small x, and limited to `1/a` | 1/m |
//! | `octupole` | a thin octupole of K3L `a` stands in a free straight | 1/m3 |
//! | `orbit_drift` | the kick of an unlogged corrector varies slowly by ±`a` | rad |
//! | `bpm_wander` | a monitor's offset varies slowly by ±`a` | m |

use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use twin::{Cycle, Kind, Ring, Site};

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
    /// An octupole.
    Octupole,
    /// The orbit drifts.
    OrbitDrift,
    /// A monitor's offset drifts.
    BpmWander,
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
    /// Time of a jump, or phase of a slow variation, -0.5 to 0.5.
    when: f64,
}

impl UnmodelledKind {
    /// Every kind.
    pub const ALL: [Self; 6] =
        [Self::QuadJump, Self::WarmUp, Self::Saturation, Self::Octupole, Self::OrbitDrift, Self::BpmWander];

    /// The word for it.
    pub fn word(self) -> &'static str {
        match self {
            Self::QuadJump => "quad_jump",
            Self::WarmUp => "bpm_warm_up",
            Self::Saturation => "bpm_saturation",
            Self::Octupole => "octupole",
            Self::OrbitDrift => "orbit_drift",
            Self::BpmWander => "bpm_wander",
        }
    }

    /// Sizes from weak to strong.
    pub fn sizes(self) -> [f64; 2] {
        match self {
            Self::QuadJump => [2e-3, 2e-2],
            Self::WarmUp => [0.02, 0.3],
            Self::Saturation => [1.0 / 6e-3, 1.0 / 1.5e-3],
            Self::Octupole => [50.0, 1000.0],
            Self::OrbitDrift => [3e-6, 1e-4],
            Self::BpmWander => [1e-4, 2e-3],
        }
    }

    /// Where it may act in a campaign.
    fn sites(self, ring: &Ring) -> Vec<Site> {
        match self {
            Self::WarmUp | Self::Saturation | Self::BpmWander => {
                ring.read_monitors.iter().map(|&at| Site::Monitor(at)).collect()
            }
            Self::QuadJump => (0..ring.quadrupoles.len()).map(Site::Quadrupole).collect(),
            Self::OrbitDrift => (0..ring.correctors.len()).map(Site::Corrector).collect(),
            Self::Octupole => {
                let straights = (0..ring.elements.len()).filter(|&at| ring.elements[at].kind == Kind::Marker);
                straights.map(Site::Element).collect()
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
        if self.kind == UnmodelledKind::Octupole {
            ring.elements[self.index].kind = Kind::Octupole { k3l: self.size };
        }
    }

    fn alter_cycles(&self, cycles: &mut [Cycle]) {
        let late = |cycle: &&mut Cycle| cycle.time >= self.when;
        match self.kind {
            UnmodelledKind::QuadJump => {
                cycles.iter_mut().filter(late).for_each(|c| c.strength[self.index] += self.size.ln_1p());
            }
            UnmodelledKind::OrbitDrift => {
                cycles.iter_mut().for_each(|c| c.kick[self.index] += self.size * self.slow_variation(c.time));
            }
            _ => {}
        }
    }

    fn alter_readings(&self, cycles: &[Cycle], readings: &mut DMatrix<f64>) {
        let read = |time: f64, x: f64| match self.kind {
            UnmodelledKind::WarmUp => x * (1.0 + self.size * (-(time + 1.0) / 0.5).exp()),
            UnmodelledKind::Saturation => x / (1.0 + (self.size * x).powi(8)).powf(0.125),
            UnmodelledKind::BpmWander => x + self.size * self.slow_variation(time),
            _ => x,
        };
        if self.index < readings.ncols() {
            for (cycle, reading) in cycles.iter().zip(&mut readings.column_mut(self.index)) {
                *reading = read(cycle.time, *reading);
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
