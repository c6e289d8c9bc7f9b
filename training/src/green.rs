//! Green's function tables of a ring, from its twin.

use estimator::surrogate::{Block, Dispersion, Green, GreenPlane, LowRank, SymmetricBlock};
use twin::{ClosedOrbit, EffectError, Hold, Observer, Optics, OrbitError, Place, Plane, Ring, Source};

/// The Booster's Green's function surrogate.
pub type BoosterGreen = estimator::booster::Green;

/// Why no tables can be made for a ring.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainingError {
    /// The ring has other numbers of things than the tables.
    #[error("{ring} has {found} {what}; these tables are for {expected}")]
    Count {
        /// The machine.
        ring: String,
        /// What was counted.
        what: &'static str,
        /// How many the tables hold.
        expected: usize,
        /// How many the ring has.
        found: usize,
    },
    /// The design ring has no stable orbit.
    #[error(transparent)]
    Orbit(#[from] OrbitError),
    /// An effect that the ring cannot have.
    #[error(transparent)]
    Effect(#[from] EffectError),
    /// The ring would cross an integer resonance on its way from vars of 1 to those given.
    #[error("{ring}: no stable ring connects vars of 1 with those given")]
    Unstable {
        /// The machine.
        ring: String,
    },
}

/// What monitors and correctors make of the orbit of a beam. As it is taken into the tables, it acts on every derivative.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Instruments {
    /// Momentum deviation of the beam.
    pub delta: f64,
    /// Which monitor each one really is [B].
    pub monitor: Vec<usize>,
    /// What each one makes of a metre [B].
    pub monitor_gain: Vec<f64>,
    /// What each corrector makes of a radian [C].
    pub corrector_gain: Vec<f64>,
}

impl Instruments {
    /// All as they should be.
    pub fn sound(ring: &Ring) -> Self {
        let (monitors, correctors) = (ring.read_monitors.len(), ring.correctors.len());
        Self {
            delta: 0.0,
            monitor: (0..monitors).collect(),
            monitor_gain: vec![1.0; monitors],
            corrector_gain: vec![1.0; correctors],
        }
    }

    fn monitors(&self, optics: &Optics) -> Vec<Observer> {
        let read = optics.read_monitors();
        self.monitor.iter().zip(&self.monitor_gain).map(|(&b, &gain)| read[b].times(gain)).collect()
    }

    fn correctors(&self, optics: &Optics) -> Vec<Source> {
        optics.correctors().into_iter().zip(&self.corrector_gain).map(|(source, &gain)| source.times(gain)).collect()
    }
}

/// Nodes of two-point Gauss-Legendre quadrature on 0..1; each has weight 1/2.
const NODES: [f64; 2] = [0.211_324_865_405_187_1, 0.788_675_134_594_812_9];

/// RF offset at which the second order of the dispersion orbit is taken; it hardly depends on it.
const RF_STEP: f64 = 2e-4;

/// Rms error that the tables state, in x and y [m]: what `orbitcal surrogate check` measures, rounded up.
const STATED_ERROR: [f32; 2] = [1.5e-6, 0.5e-6];

/// Tables of the design ring.
///
/// # Errors
/// [`TrainingError`] if the ring's counts differ from the table's, or if it is unstable.
pub fn tables<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize, const T: usize>(
    ring: &Ring,
) -> Result<Green<BX, BY, CX, CY, Q, T>, TrainingError> {
    tables_with(ring, &Instruments::sound(ring))
}

/// Tables of a ring as its instruments show it.
pub(crate) fn tables_with<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const Q: usize,
    const T: usize,
>(
    ring: &Ring,
    instruments: &Instruments,
) -> Result<Green<BX, BY, CX, CY, Q, T>, TrainingError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: instruments.delta })?;
    let count = |what, expected, found| {
        if expected == found {
            Ok(())
        } else {
            Err(TrainingError::Count { ring: ring.name.clone(), what, expected, found })
        }
    };
    count("read monitors", BX + BY, ring.read_monitors.len())?;
    count("correctors", CX + CY, ring.correctors.len())?;
    count("quadrupoles", Q / 2, ring.quadrupoles.len())?;
    let (monitors, correctors) = (instruments.monitors(&optics), instruments.correctors(&optics));
    let (monitors_x, monitors_y) = monitors.split_at(BX);
    let (correctors_x, correctors_y) = correctors.split_at(CX);
    Ok(Green {
        x: plane(ring, &optics, Plane::X, monitors_x, correctors_x),
        y: plane(ring, &optics, Plane::Y, monitors_y, correctors_y),
        dispersion: dispersion(ring, &optics, instruments, monitors_x)?,
        low_rank: LowRank::BLANK,
        first_family: ring.gradients().iter().filter(|k| **k > 0.0).count() as u16,
        stated_error: STATED_ERROR,
    })
}

fn nodes(ring: &Ring) -> Vec<Place> {
    let at = |element: usize| NODES.map(|node| Place { element, depth: node * ring.elements[element].length });
    ring.quadrupoles.iter().flat_map(|q| at(q.element)).collect()
}

fn plane<const B: usize, const C: usize, const Q: usize, const T: usize>(
    ring: &Ring,
    optics: &Optics,
    plane: Plane,
    monitors: &[Observer],
    correctors: &[Source],
) -> GreenPlane<B, C, Q, T> {
    let (direction, sign) = match plane {
        Plane::X => ([1.0, 0.0], 1.0),
        Plane::Y => ([0.0, 1.0], -1.0),
    };
    let nodes = nodes(ring);
    let seen: Vec<Observer> = nodes.iter().map(|&n| optics.observe(n, plane)).collect();
    let kicks: Vec<Source> = nodes.iter().map(|&n| optics.kick(n, direction)).collect();
    let (direct, driven) = (optics.response(monitors, correctors), optics.response(&seen, correctors));
    // seen from the monitors: G is symmetric, so a kick at a node stands for a kick at a monitor
    let (reading, mutual) = (optics.response(monitors, &kicks), optics.response(&seen, &kicks));
    let strength = |n: usize| {
        let element = ring.quadrupoles[n / 2].element;
        0.5 * sign * ring.gradients()[n / 2] * ring.elements[element].length
    };
    GreenPlane {
        direct: Block::quantise(|b, c| direct[(b, c)]),
        seen: Block::quantise(|q, b| reading[(b, q)]),
        driven: Block::quantise(|q, c| driven[(q, c)]),
        // the average of both orders removes what rounding of the transfer maps leaves of an asymmetry
        mutual: SymmetricBlock::quantise(|i, j| 0.5 * (mutual[(i, j)] + mutual[(j, i)])),
        weight: core::array::from_fn(|n| strength(n) as f32),
    }
}

fn dispersion<const B: usize, const Q: usize>(
    ring: &Ring,
    optics: &Optics,
    instruments: &Instruments,
    monitors: &[Observer],
) -> Result<Dispersion<B, Q>, OrbitError> {
    let frequency = optics.frequency_offset();
    let up = ClosedOrbit::find(ring, Hold::Frequency { offset: frequency + RF_STEP })?;
    let down = ClosedOrbit::find(ring, Hold::Frequency { offset: frequency - RF_STEP })?;
    let second = |b: usize| {
        let at = ring.monitors[ring.read_monitors[instruments.monitor[b]]].element;
        let curved = up.at[at][0] + down.at[at][0] - 2.0 * optics.orbit(at)[0];
        instruments.monitor_gain[b] * curved / (2.0 * RF_STEP * RF_STEP)
    };
    let nodes = nodes(ring);
    Ok(Dispersion {
        monitor: core::array::from_fn(|b| optics.dispersion(&monitors[b]) as f32),
        node: core::array::from_fn(|q| optics.dispersion(&optics.observe(nodes[q], Plane::X)) as f32),
        second_order: core::array::from_fn(|b| second(b) as f32),
        spurious: spurious(ring)?,
        compaction: optics.momentum_compaction() as f32,
        inverse_gamma_squared: ring.particle.gamma(instruments.delta).powi(-2) as f32,
        circumference: ring.circumference as f32,
    })
}

/// Misaligned machines from which the spurious dispersion is taken, and the rms shift of their quadrupoles [m]; the ratio
/// to the orbit does not depend on the shift.
const MISALIGNED: u32 = 40;
const SHIFT: f64 = 0.2e-3;

/// Rms change of a misaligned ring's orbit per unit of RF offset and of rms orbit, beyond the design dispersion.
///
/// The orbit that shifted quadrupoles make changes with the momentum, as every orbit does; which way, only the unknown
/// shifts could tell.
fn spurious(ring: &Ring) -> Result<[f32; 2], OrbitError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
    let (mut change, mut orbit) = ([0.0; 2], [0.0; 2]);
    for machine in 0..MISALIGNED {
        let shifted = misaligned(ring, machine);
        let at = |offset| ClosedOrbit::find(&shifted, Hold::Frequency { offset });
        let (up, down, rest) = (at(RF_STEP)?, at(-RF_STEP)?, at(0.0)?);
        for monitor in ring.monitors_read().map(|monitor| monitor.element) {
            for (plane, coordinate, design) in
                [(0, 0, optics.dispersion(&optics.observe(monitor, Plane::X))), (1, 2, 0.0)]
            {
                let slope = (up.at[monitor][coordinate] - down.at[monitor][coordinate]) / (2.0 * RF_STEP);
                let momentum = (up.at[monitor][4] - down.at[monitor][4]) / (2.0 * RF_STEP);
                change[plane] += (slope - design * momentum).powi(2);
                orbit[plane] += rest.at[monitor][coordinate].powi(2);
            }
        }
    }
    // An offset and its opposite share the change with opposite signs; the core takes them for independent, so each is
    // given twice the variance.
    Ok([0, 1].map(|plane| f64::sqrt(2.0 * change[plane] / orbit[plane]) as f32))
}

/// The ring with its quadrupoles shifted at random, uniformly, seeded.
fn misaligned(ring: &Ring, machine: u32) -> Ring {
    let mut shifted = ring.clone();
    for (q, at) in ring.quadrupoles.iter().map(|q| q.element).enumerate() {
        let uniform = |plane: u32| f64::from(sobol_burley::sample(machine, 2 * q as u32 + plane, 1)) - 0.5;
        let shift = &mut shifted.elements[at].misalignment;
        (shift.dx, shift.dy) = (uniform(0) * SHIFT * 12f64.sqrt(), uniform(1) * SHIFT * 12f64.sqrt());
    }
    shifted
}
