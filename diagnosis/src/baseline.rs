//! The orbit without kicks, as estimated from the monitors' baselines, and its change with gradients and RF frequency.
//!
//! Misaligned quadrupoles make a closed orbit, which the monitors read with their own offsets. It changes with all gradients and with
//! the RF frequency, and this change is common to the readings of a monitor, as the baseline is.

use core::f64::consts::SQRT_2;

use nalgebra::{DMatrix, DVector};
use twin::{Hold, Machine, Monitor, Optics, OrbitError, Place, Plane, Ring, Tunes};

use evidence::Factor;
use inference::Screened;

/// The orbit without kicks: its size, its changes and its uncertainty.
#[derive(Debug, Clone)]
pub struct Baseline {
    /// Rms of the monitors' baselines in x and y [m].
    pub rms: [f64; 2],
    /// Relative change per `ln` of all gradients, in x and y [1].
    pub sensitivity: [f64; 2],
    /// Standard deviation of its change per RF offset beyond the design dispersion, in x and y [m].
    pub spurious: [f64; 2],
    /// Standard deviation of the orbit in frames with an RF offset, at each read monitor: the frequency sets the momentum at which the length of the
    /// orbit suits it, and the displaced quadrupoles lengthen that by an unknown amount [m].
    pub lengthened: Vec<f64>,
    /// Standard deviation of the orbit at each element (x, y) [m].
    pub sigma: Vec<[f64; 2]>,
    /// Share of each monitor's own mean reading in the estimated orbit at its place [1].
    pub(super) share: Vec<f64>,
    /// Mean reading of each monitor less the response to the kicks [m]; none for a monitor without readings.
    read: Vec<Option<f64>>,
}

/// Standard deviation of a monitor's offset [m], typical of surveys of such monitors.
const OFFSET: f64 = 0.7e-3;
/// Standard deviation of the spurious dispersion over its rms, somewhat on the safe side. Vars need more, since monitors share a wave of it
/// ([`twin::SHARED`]); what one place does to the orbit is no such wave, and would lose up to a quarter of its evidence to that.
const SPURIOUS: f64 = SQRT_2;
/// Largest `|cot(pi Q)|`: a machine nearer to the integer resonance keeps no beam.
const STEEPEST: f64 = 20.0;
/// Newton steps towards the orbit at a monitor that misreads it.
const STEPS: usize = 12;
/// Distance for the slope of its reading [m].
const NEAR: f64 = 1e-6;
/// Slope below which a reading no longer tells the position.
const FLATTEST: f64 = 0.2;

impl Baseline {
    /// The orbit (x, y) at every element [m] and its properties, from the readings less the response to the kicks (rows frames, columns
    /// monitors) and the recorded tunes. `per_rms`: change per RF offset beyond the design dispersion, per rms of the baselines.
    pub fn from_readings(
        ring: &Ring,
        readings: &DMatrix<f64>,
        screened: &Screened,
        recorded_tunes: &DMatrix<f64>,
        per_rms: [f64; 2],
    ) -> Result<(Vec<[f64; 2]>, Self), OrbitError> {
        let baselines = means(readings, screened);
        let split = ring.horizontal_monitors();
        let rms = [rms(&baselines[..split]), rms(&baselines[split..])];
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
        let sensitivity = sensitivity(recorded_tunes, &optics.tunes()?);
        let spurious = [0, 1].map(|plane| SPURIOUS * per_rms[plane] * rms[plane]);
        let Kriged { orbit, sigma, share, kick, .. } = Kriged::from_baselines(ring, &baselines, rms)?;
        let lengthened = lengthened(ring, &optics, kick);
        Ok((orbit, Self { rms, sensitivity, spurious, lengthened, sigma, share, read: baselines }))
    }

    /// The orbit at a monitor that misreads a position x by `m(x)` [m], given the one that was estimated as if it did not: as that one holds the share `w` of
    /// the monitor's own reading, the solution of `x + w m(x) = estimated`, by Newton steps, which end where the reading hardly grows with the position: what
    /// there is no longer told by it.
    pub fn corrected(&self, b: usize, estimated: f64, misreads: impl Fn(f64) -> f64) -> f64 {
        let step = |x: f64, _| {
            let slope = 1.0 + self.share[b] * (misreads(x + NEAR) - misreads(x - NEAR)) / (2.0 * NEAR);
            if slope < FLATTEST { x } else { x - (x + self.share[b] * misreads(x) - estimated) / slope }
        };
        (0..STEPS).fold(estimated, step)
    }

    /// Displace a machine's quadrupoles so that its orbit without kicks is the estimated one; what it has by itself, off momentum, is not
    /// theirs.
    pub(crate) fn displace(&self, machine: &mut Machine) -> Result<(), OrbitError> {
        let own = machine.orbit()?;
        let ring = machine.ring_mut();
        let less = |(read, monitor): (&Option<f64>, Monitor)| {
            read.map(|read| read - own[monitor.element][usize::from(monitor.plane == Plane::Y)])
        };
        let read: Vec<Option<f64>> = self.read.iter().zip(ring.monitors_read()).map(less).collect();
        let kicks = Kriged::from_baselines(ring, &read, self.rms)?.kicks;
        let strengths = ring.integrated_gradients();
        for ((quadrupole, strength), [x, y]) in ring.quadrupoles.iter().zip(strengths).zip(kicks) {
            if strength != 0.0 {
                let misalignment = &mut ring.elements[quadrupole.element].misalignment;
                misalignment.dx += x / strength;
                misalignment.dy -= y / strength;
            }
        }
        Ok(())
    }
}

/// Relative change of the orbit of random misalignments per `ln` of all gradients, which is that of `1/sin(pi Q)` with
/// the tune: `1 + pi |cot(pi Q) dQ/dln k|`, where the 1 is the growth of the kicks themselves and `dQ/dln k`, the
/// natural chromaticity, is about the tune itself. The recorded tune gives the distance to the integer resonance.
///
/// Source: S. Y. Lee, Accelerator Physics, ch. 2, closed orbits of dipole errors.
fn sensitivity(recorded: &DMatrix<f64>, design: &Tunes) -> [f64; 2] {
    let pi = core::f64::consts::PI;
    [(0, design.x), (1, design.y)].map(|(plane, design)| {
        let known: Vec<f64> = recorded.column(plane).iter().copied().filter(|tune| *tune > 0.0).collect();
        let tune = if known.is_empty() { design } else { known.iter().sum::<f64>() / known.len() as f64 };
        1.0 + pi * design * (pi * tune).tan().recip().abs().min(STEEPEST)
    })
}

/// Standard deviation of the orbit at each read monitor [m] in frames in which the RF frequency sets the momentum, less that in others, from that of the
/// quadrupoles' kicks [rad]: a kick lengthens the orbit by itself times the dispersion there, and a longer orbit acts as a frequency that is larger by the
/// same fraction. Exact orbits agree to a tenth of the deviation.
fn lengthened(ring: &Ring, optics: &Optics, kick: f64) -> Vec<f64> {
    let at_quadrupoles = ring.quadrupoles.iter().map(|q| optics.dispersion(&optics.observe(q.element, Plane::X)));
    let longer = kick * at_quadrupoles.map(|d| d * d).sum::<f64>().sqrt() / ring.circumference;
    let per_frequency = optics.dispersion_of(&optics.read_monitors()) / optics.slip_factor();
    per_frequency.iter().map(|orbit| orbit.abs() * longer).collect()
}

/// Mean of each monitor's readings [m]; none for a monitor without readings.
fn means(readings: &DMatrix<f64>, screened: &Screened) -> Vec<Option<f64>> {
    let of = |b: usize| {
        let frames = (0..readings.nrows()).filter(|&frame| screened.excluded.counts(frame, b));
        let counting: Vec<f64> = frames.map(|frame| readings[(frame, b)]).collect();
        (!counting.is_empty()).then(|| counting.iter().sum::<f64>() / counting.len() as f64)
    };
    (0..readings.ncols()).map(of).collect()
}

fn rms(values: &[Option<f64>]) -> f64 {
    let squares: Vec<f64> = values.iter().flatten().map(|v| v * v).collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

/// The orbit that random kicks at all quadrupoles make, as the monitors' baselines tell it.
struct Kriged {
    /// Orbit (x, y) at every element [m].
    orbit: Vec<[f64; 2]>,
    /// Its standard deviation [m].
    sigma: Vec<[f64; 2]>,
    /// Mean kick of each quadrupole [M] [rad].
    kicks: Vec<[f64; 2]>,
    /// Standard deviation of a horizontal kick before the baselines are looked at [rad].
    kick: f64,
    /// Share of each monitor's own reading in the orbit at its place: the change of the one with the other.
    share: Vec<f64>,
}

impl Kriged {
    /// From the baselines of the monitors, whose offsets are unknown; the kicks are of the size that explains the baselines' rms.
    ///
    /// Source: D. G. Krige's interpolation; C. E. Rasmussen and C. Williams, Gaussian Processes (2006), eq. 2.25.
    fn from_baselines(ring: &Ring, baselines: &[Option<f64>], rms: [f64; 2]) -> Result<Self, OrbitError> {
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
        let zero = |count: usize| vec![[0.0; 2]; count];
        let monitors: Vec<_> = ring.monitors_read().collect();
        let mut kriged = Self {
            orbit: zero(ring.elements.len()),
            sigma: zero(ring.elements.len()),
            kicks: zero(ring.quadrupoles.len()),
            kick: 0.0,
            share: vec![0.0; monitors.len()],
        };
        for (index, plane) in [Plane::X, Plane::Y].into_iter().enumerate() {
            let direction = [[1.0, 0.0], [0.0, 1.0]][index];
            let middle = |element: usize| Place { element, depth: 0.5 * ring.elements[element].length };
            let sources: Vec<_> = ring.quadrupoles.iter().map(|q| optics.kick(middle(q.element), direction)).collect();
            let read: Vec<usize> =
                (0..monitors.len()).filter(|&b| monitors[b].plane == plane && baselines[b].is_some()).collect();
            let seen: Vec<_> = read.iter().map(|&b| optics.observe(monitors[b].element, plane)).collect();
            let everywhere: Vec<_> = (0..ring.elements.len()).map(|i| optics.observe(i, plane)).collect();
            let (at, all) = (optics.response(&seen, &sources), optics.response(&everywhere, &sources));
            let mean_square = at.norm_squared() / (read.len().max(1)) as f64;
            let variance = if mean_square > 0.0 { rms[index].powi(2) / mean_square } else { 0.0 };
            if plane == Plane::X {
                kriged.kick = variance.sqrt();
            }
            let noise = DMatrix::from_diagonal_element(read.len(), read.len(), OFFSET.powi(2));
            let Some(factor) = Factor::of(&at * at.transpose() * variance + noise) else { continue };
            let values = DVector::from_iterator(read.len(), read.iter().filter_map(|&b| baselines[b]));
            let kicks = at.tr_mul(&factor.solve(&values)) * variance;
            let (mean, cross) = (&all * &kicks, &all * at.transpose() * variance);
            for (&b, precision) in read.iter().zip(factor.inverse_diagonal()) {
                kriged.share[b] = 1.0 - OFFSET.powi(2) * precision;
            }
            kriged.kicks.iter_mut().zip(kicks.iter()).for_each(|(to, kick)| to[index] = *kick);
            for i in 0..ring.elements.len() {
                let row = cross.row(i).transpose();
                let left = all.row(i).norm_squared() * variance - row.dot(&factor.solve(&row));
                kriged.orbit[i][index] = mean[i];
                kriged.sigma[i][index] = left.max(0.0).sqrt();
            }
        }
        Ok(kriged)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use twin::ClosedOrbit;

    use super::*;
    use crate::testing::normal;

    /// The orbit at a monitor moves by that share of what its own reading does.
    #[test]
    fn the_share_of_a_monitor_is_how_far_its_reading_moves_the_orbit_there() {
        let ring = Ring::paper_booster();
        let read = |moved: Option<usize>| -> Vec<Option<f64>> {
            let of = |b: usize| 3e-3 * (b as f64).sin() + if moved == Some(b) { 1e-3 } else { 0.0 };
            (0..ring.read_monitors.len()).map(|b| (b != 5).then(|| of(b))).collect()
        };
        let of = |moved| Kriged::from_baselines(&ring, &read(moved), [2e-3; 2]).unwrap();
        let plain = of(None);
        for (b, monitor) in ring.monitors_read().enumerate().step_by(4).filter(|(b, _)| *b != 5) {
            let plane = usize::from(monitor.plane == Plane::Y);
            let moved = of(Some(b)).orbit[monitor.element][plane] - plain.orbit[monitor.element][plane];
            assert!((moved / 1e-3 - plain.share[b]).abs() < 1e-9, "{moved} {}", plain.share[b]);
            assert!((0.3..1.0).contains(&plain.share[b]), "{}", plain.share[b]);
        }
        assert_eq!(plain.share[5], 0.0, "it does not read");
    }

    /// Exact orbits with an RF offset of both signs, less those at constant momentum, of twenty rings whose quadrupoles kick the beam: along the dispersion they
    /// are off by what the kicks lengthen the orbit, with its sign, and the predicted width is that of random kicks.
    #[test]
    fn displaced_quadrupoles_move_the_momentum_that_a_frequency_sets() {
        const RINGS: u64 = 20;
        let (ring, kick) = (Ring::paper_booster(), 3e-5);
        let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
        let per_frequency = optics.dispersion_of(&optics.read_monitors()) / optics.slip_factor();
        let width = DVector::from_vec(lengthened(&ring, &optics, kick)).norm() / per_frequency.norm();
        let at = |ring: &Ring, hold: Hold| {
            let orbit = ClosedOrbit::find(ring, hold).unwrap();
            DVector::from_iterator(per_frequency.len(), ring.monitors_read().map(|one| orbit.at[one.element][0]))
        };
        let moved = |ring: &Ring| {
            let [above, below] = [1e-4, -1e-4].map(|offset| at(ring, Hold::Frequency { offset }));
            0.5 * (above + below) - at(ring, Hold::Momentum { delta: 0.0 })
        };
        let (straight, mut square) = (moved(&ring), 0.0);
        for seed in 0..RINGS {
            let (mut displaced, mut random) = (ring.clone(), StdRng::seed_from_u64(seed));
            let mut longer = 0.0;
            for (quadrupole, k1l) in ring.quadrupoles.iter().zip(ring.integrated_gradients()) {
                let draw = normal(&mut random);
                displaced.elements[quadrupole.element].misalignment.dx = kick * draw / k1l;
                longer += kick * draw * optics.dispersion(&optics.observe(quadrupole.element, Plane::X));
            }
            let mut off = moved(&displaced) - &straight;
            (ring.horizontal_monitors()..off.len()).for_each(|b| off[b] = 0.0);
            let found = off.dot(&per_frequency) / per_frequency.norm_squared();
            let expected = -longer / ring.circumference;
            assert!((found - expected).abs() < 0.1 * width, "{found} {expected} of {width}");
            square += (expected / width).powi(2) / RINGS as f64;
        }
        // a normal number a ring: the mean square of twenty scatters by 0.32
        assert!((square - 1.0).abs() < 3.0 * 0.32, "{square}");
    }

    /// A monitor that reads 10 mm as 13, and of whose reading the estimated orbit holds nine tenths.
    #[test]
    fn the_orbit_at_a_monitor_that_misreads_it_solves_its_equation() {
        let baseline = Baseline {
            rms: [0.0; 2],
            sensitivity: [1.0; 2],
            spurious: [0.0; 2],
            lengthened: Vec::new(),
            sigma: Vec::new(),
            share: vec![0.9],
            read: Vec::new(),
        };
        for cubic in [3e3, -1e3, 0.0] {
            let misreads = |x: f64| cubic * x.powi(3);
            for x in [-10e-3, 2e-3, 10e-3] {
                let found = baseline.corrected(0, x + 0.9 * misreads(x), misreads);
                assert!((found - x).abs() < 1e-9, "{cubic} {x}: {found}");
            }
        }
        // beyond the largest reading there is no solution, and no step goes far
        for cubic in [-1e3, -1.5e3, -3e3, -1e4] {
            let found = baseline.corrected(0, 13e-3, |x| cubic * x.powi(3));
            assert!((13e-3..40e-3).contains(&found), "{cubic}: {found}");
        }
    }
}
