//! What physics outside the library does to the ring, to the cycles and to the readings.

use inference::simulate::Beyond;
use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use twin::{Cycle, Element, Kind, Ring, Site};

use super::{Unmodelled, UnmodelledKind, girder_end};

/// What a corrector kicks at its nominal setting [rad].
const FULL_KICK: f64 = 2e-4;
/// Correctors of a crate.
const CRATE: usize = 8;
/// Change of position over which the ripple of a logarithmic amplifier repeats [m].
const RIPPLE: f64 = 1.5e-3;
/// Share of the charge of a spark that a ceramic break collects in a cycle without kicks.
const CATCH: f64 = 0.04;

impl Beyond for Unmodelled {
    fn alter_ring(&self, ring: &mut Ring) {
        let Site::Element(at) = self.site else { return };
        let drift = &mut ring.elements[at];
        match self.kind {
            UnmodelledKind::Solenoid => drift.kind = Kind::Solenoid { ks: 2.0 * self.size / drift.length },
            UnmodelledKind::BuckedSolenoids => {
                let ks = 2.0 * (self.size / drift.length).sqrt();
                drift.length *= 0.5;
                drift.kind = Kind::Solenoid { ks };
                let second = Element { kind: Kind::Solenoid { ks: -ks }, s: drift.s + drift.length, ..drift.clone() };
                insert(ring, at + 1, second);
            }
            UnmodelledKind::ShiftedGirder => {
                let Some(end) = girder_end(ring, at) else { return };
                ring.elements[at].length += self.size;
                ring.elements[at + 1..=end].iter_mut().for_each(|element| element.s += self.size);
                ring.elements[end].length -= self.size;
            }
            _ => {}
        }
    }

    fn alter_cycles(&self, cycles: &mut [Cycle]) {
        let mut past = Past::of(self.when);
        for cycle in cycles {
            past.next();
            match self.site {
                Site::Corrector(_) => self.kick(cycle, &mut past),
                Site::Quadrupole(_) => self.focus(cycle, &mut past),
                _ => {}
            }
        }
    }

    fn alter_readings(&self, cycles: &[Cycle], readings: &mut DMatrix<f64>) {
        if !matches!(self.site, Site::Monitor(_)) {
            return;
        }
        let lost = lost(readings);
        let (centre, rms) = (readings.column(self.index).mean(), readings.column(self.index).variance().sqrt());
        let (mut shown, mut is_coarse) = (f64::INFINITY, false);
        let (mut baseline, mut turn) = (None::<f64>, ((self.when + 0.5) * 3.0) as usize);
        let mut read = |cycle: &Cycle, x: f64, lost: f64| match self.kind {
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
            UnmodelledKind::StuckBit => {
                let is_set = (x / self.size + 2.0 * self.when).floor().rem_euclid(2.0) > 0.5;
                if is_set { x - self.size } else { x }
            }
            UnmodelledKind::RangeSwitch => {
                is_coarse = (x - centre).abs() > if is_coarse { 0.7 * rms } else { 1.3 * rms };
                if is_coarse { x + self.size * (x - centre) } else { x }
            }
            UnmodelledKind::LossOffset => x + self.size * lost.min(4.0),
            UnmodelledKind::LogRipple => x + self.size * (core::f64::consts::TAU * (x / RIPPLE + self.when)).sin(),
            UnmodelledKind::BaselineRestorer => {
                let base = baseline.unwrap_or(x);
                baseline = Some(base + 0.1 * (x - base));
                x - self.size * base
            }
            UnmodelledKind::ThirdIntegrator => {
                turn = (turn + 1) % 3;
                if turn == 0 { x * (1.0 + self.size) } else { x }
            }
            _ => x,
        };
        for ((cycle, reading), lost) in cycles.iter().zip(&mut readings.column_mut(self.index)).zip(lost) {
            *reading = read(cycle, *reading, lost);
        }
    }
}

impl Unmodelled {
    /// What its corrector does in a cycle.
    fn kick(&self, cycle: &mut Cycle, past: &mut Past) {
        let kicks = &mut cycle.kick;
        let change = match self.kind {
            UnmodelledKind::OrbitDrift => self.size * self.slow_variation(cycle.time),
            UnmodelledKind::BusSag => self.size * kicks.iter().map(|kick| kick.abs()).sum::<f64>() / FULL_KICK,
            UnmodelledKind::AlternateCycle if past.count % 2 == 1 => self.size,
            UnmodelledKind::CrateSag => {
                let is_beside = |c: usize| c != self.index && c / CRATE == self.index / CRATE;
                let of_crate = kicks.iter().enumerate().filter(|(c, _)| is_beside(*c));
                self.size * of_crate.map(|(_, kick)| kick.abs()).sum::<f64>() / FULL_KICK
            }
            UnmodelledKind::CoilHeat => {
                let warmth = past.warmth;
                past.warmth = 0.5 * (warmth + (kicks[self.index] / FULL_KICK).powi(2));
                -kicks[self.index] * self.size * warmth
            }
            // as if the first cycle were one of several
            UnmodelledKind::NeighbourPulse => match past.since(7, self.when) {
                since @ 0..3 => self.size / 3.0_f64.powi(since as i32),
                _ => 0.0,
            },
            UnmodelledKind::HuntingSupply => kicks[self.index] * self.size * past.draw,
            UnmodelledKind::ForgottenFeedback => {
                let seen = |c: usize| (core::f64::consts::TAU * (c as f64 - self.index as f64) / 5.0).cos();
                let orbit: f64 = kicks.iter().enumerate().map(|(c, kick)| kick * seen(c)).sum();
                let trim = past.trim;
                past.trim = 0.7 * trim - self.size * orbit;
                trim
            }
            UnmodelledKind::InducedKick => {
                let others = kicks.iter().sum::<f64>() - kicks[self.index];
                let before = past.others.replace(others).unwrap_or(others);
                self.size * (others - before) / FULL_KICK
            }
            UnmodelledKind::ChargedCeramic => {
                let charge = past.charge;
                let halo = 1.0 + kicks.iter().map(|kick| kick.abs()).sum::<f64>() / FULL_KICK;
                let caught = CATCH * halo * (1.0 + 0.5 * past.draw);
                past.charge = if charge > 1.0 { 0.0 } else { charge + caught };
                self.size * charge
            }
            _ => 0.0,
        };
        kicks[self.index] += change;
    }

    /// What its quadrupole does in a cycle.
    fn focus(&self, cycle: &mut Cycle, past: &mut Past) {
        let change = match self.kind {
            UnmodelledKind::QuadJump if cycle.time >= self.when => self.size.ln_1p(),
            UnmodelledKind::Thermostat => {
                let phase = core::f64::consts::TAU * (2.5 * cycle.time + self.when);
                self.size * phase.sin()
            }
            UnmodelledKind::LoopGradient => self.size * cycle.kick.iter().sum::<f64>() / FULL_KICK,
            UnmodelledKind::FlickeringTurn if past.short.is_closed => (-self.size).ln_1p(),
            UnmodelledKind::FirstPulse => {
                let is_other = |(now, then): (&f64, &f64)| (now - then).abs() > 0.25 * FULL_KICK;
                let is_changed = past.kick.is_empty() || cycle.kick.iter().zip(&past.kick).any(is_other);
                past.rest = if is_changed { 1.0 } else { 0.4 * past.rest };
                past.kick.clone_from(&cycle.kick);
                self.size * past.rest
            }
            UnmodelledKind::CurrentSharing => {
                past.creep = (past.creep + 0.3 * past.draw).clamp(-1.0, 1.0);
                let partner = (self.index + 2) % cycle.strength.len();
                cycle.strength[partner] -= self.size * past.creep;
                self.size * past.creep
            }
            _ => 0.0,
        };
        cycle.strength[self.index] += change;
    }

    /// A slow variation between -1 and 1.
    fn slow_variation(&self, time: f64) -> f64 {
        (core::f64::consts::PI * (time + 2.0 * self.when)).sin()
    }
}

/// What the cycles before leave behind.
struct Past {
    /// Number of the cycle.
    count: usize,
    random: StdRng,
    /// A draw from -1 to 1 in each cycle.
    draw: f64,
    short: Flicker,
    /// Of a coil, in units of what a full kick makes.
    warmth: f64,
    /// Sum of the other kicks in the cycle before.
    others: Option<f64>,
    /// The kicks of the cycle before [rad].
    kick: Vec<f64>,
    /// What a feedback has come to [rad].
    trim: f64,
    /// What is left of a rest, 1 in the first cycle after one.
    rest: f64,
    /// How unevenly a current is shared, -1 to 1.
    creep: f64,
    /// Of a ceramic break, in units of that at which it sparks.
    charge: f64,
}

impl Past {
    fn of(seed: f64) -> Self {
        Self {
            // the first cycle is number 0
            count: usize::MAX,
            random: StdRng::seed_from_u64(seed.to_bits()),
            draw: 0.0,
            short: Flicker::of(seed),
            warmth: 0.0,
            others: None,
            kick: Vec::new(),
            trim: 0.0,
            rest: 0.0,
            creep: 0.0,
            // somewhere between two sparks
            charge: seed + 0.5,
        }
    }

    fn next(&mut self) {
        self.count = self.count.wrapping_add(1);
        self.draw = self.random.random_range(-1.0..=1.0);
        self.short.next();
    }

    /// Cycles since the last one of every `period`, of which `when`, from -0.5 to 0.5, says the first.
    fn since(&self, period: usize, when: f64) -> usize {
        (self.count + ((when + 0.5) * period as f64) as usize) % period
    }
}

/// A short that closes with a chance of 1 in 16 and opens with 1 in 4.
struct Flicker {
    state: u64,
    is_closed: bool,
}

impl Flicker {
    fn of(seed: f64) -> Self {
        Self { state: seed.to_bits(), is_closed: false }
    }

    fn next(&mut self) {
        self.state = self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.is_closed ^= self.state >> 60 < if self.is_closed { 4 } else { 1 };
    }
}

/// Squared orbit at all monitors in each cycle, about the mean orbit, over its mean.
fn lost(readings: &DMatrix<f64>) -> Vec<f64> {
    let means = readings.row_mean();
    let squares: Vec<f64> = readings.row_iter().map(|row| (row - &means).norm_squared()).collect();
    let usual = squares.iter().sum::<f64>() / squares.len() as f64;
    squares.into_iter().map(|square| square / usual.max(f64::MIN_POSITIVE)).collect()
}

/// Put an element into a ring.
fn insert(ring: &mut Ring, at: usize, element: Element) {
    ring.elements.insert(at, element);
    let quadrupoles = ring.quadrupoles.iter_mut().map(|one| &mut one.element);
    let monitors = ring.monitors.iter_mut().map(|one| &mut one.element);
    let correctors = ring.correctors.iter_mut().map(|one| &mut one.element);
    quadrupoles.chain(monitors).chain(correctors).filter(|own| **own >= at).for_each(|own| *own += 1);
}
