//! Response, its derivatives and optics of a ring with effects.

use nalgebra::DMatrix;
use twin::{Effect, Machine, Optics, OrbitError, Plane, Ring, Twiss};

/// Response of the monitors that are read, each in its own plane, to all correctors [B][C] [m/rad].
///
/// # Errors
/// [`OrbitError`] if the machine is unstable.
pub fn response(machine: &Machine, effects: &[Effect]) -> Result<DMatrix<f64>, OrbitError> {
    if act_on_instruments(effects) {
        let both = machine.response()?;
        return Ok(read(machine.ring(), &[both.x, both.y]));
    }
    let optics = stable(machine)?;
    let held = machine.held_of(machine.ring(), &optics)?;
    Ok(held.response(&optics, &optics.read_monitors(), &optics.correctors()))
}

/// Its derivative with respect to the gradient of each quadrupole [M][B][C] [m/rad per 1/m^2].
///
/// # Errors
/// As [`response`].
pub fn jacobian(machine: &Machine, effects: &[Effect]) -> Result<Vec<DMatrix<f64>>, OrbitError> {
    if act_on_instruments(effects) {
        let slopes = machine.response_jacobian()?;
        return Ok(slopes.iter().map(|both| read(machine.ring(), both)).collect());
    }
    let optics = stable(machine)?;
    let held = machine.held_of(machine.ring(), &optics)?;
    let (observers, sources) = (optics.read_monitors(), optics.correctors());
    Ok(optics.quadrupoles().iter().map(|one| held.jacobian(&optics, &observers, &sources, one)).collect())
}

/// The same with respect to `ln` of the factor of each param [N][B][C] [m/rad].
pub fn by_parameter(ring: &Ring, of_gradients: Vec<DMatrix<f64>>) -> Vec<DMatrix<f64>> {
    let of_factors: Vec<DMatrix<f64>> =
        of_gradients.into_iter().zip(ring.gradients()).map(|(slope, k1)| slope * k1).collect();
    ring.by_parameter(&of_factors)
}

/// Linear optics at the entrance of every element and at the end of the ring.
pub struct Table {
    /// Beta functions, phase advances, dispersion [E + 1].
    pub twiss: Vec<Twiss>,
    /// Closed orbit, x and y [E + 1] [m].
    pub orbit: Vec<[f64; 2]>,
    /// Tunes.
    pub tunes: [f64; 2],
    /// Momentum compaction, and transition energy over the rest energy [1].
    pub compaction: [f64; 2],
}

/// Optics of a machine at its momentum.
///
/// # Errors
/// As [`response`].
pub fn table(machine: &Machine) -> Result<Table, OrbitError> {
    let optics = machine.optics()?;
    let (twiss, tunes) = (optics.twiss()?, optics.tunes()?);
    let orbit = (0..twiss.len()).map(|element| optics.orbit(element)).map(|at| [at[0], at[2]]).collect();
    Ok(Table {
        twiss,
        orbit,
        tunes: [tunes.x, tunes.y],
        compaction: [optics.momentum_compaction(), optics.gamma_transition()],
    })
}

/// The optics of stable motion.
fn stable(machine: &Machine) -> Result<Optics<'_>, OrbitError> {
    let optics = machine.optics()?;
    // the normal modes alone: cheaper than the tunes, whose integer parts take the phase advance of every element
    optics.closest_tune_approach()?;
    Ok(optics)
}

/// True where what is read or set differs from what is there, which the machine adds to the response of both planes.
fn act_on_instruments(effects: &[Effect]) -> bool {
    effects.iter().any(|effect| effect.kind.is_of_a_monitor() || effect.kind.is_of_a_corrector())
}

/// Rows of the monitors that are read, each in its own plane, of x and y at all monitors.
fn read(ring: &Ring, both: &[DMatrix<f64>; 2]) -> DMatrix<f64> {
    let own = |monitor: usize| usize::from(ring.monitors[monitor].plane == Plane::Y);
    DMatrix::from_fn(ring.read_monitors.len(), both[0].ncols(), |row, column| {
        let monitor = ring.read_monitors[row];
        both[own(monitor)][(monitor, column)]
    })
}
