//! A quadrupole whose gradient changes: in time, or from one run of a setting to the next, as where it follows the correctors' currents or comes and goes.
//!
//! In each run of frames it has an amplitude of its own; in time, steps. A gradient also kicks the beam, which is off the quadrupole's axis already
//! without kicks: by as much as the estimated orbit is. That estimate has an error, so that quadrupoles near the best are judged with free kicks of its size as well;
//! the error is one number for all runs, the kicks are free in each, which gives away some evidence. A quadrupole that only those kicks would show is not found here, but as a place
//! that kicks the beam.
//!
//! With `s` what a pattern does to a channel (a monitor or a tune) in each run, and that channel's sums over runs, the Gram matrix of two patterns' amplitudes is
//! the sum of `diag(s) E^T S^-1 E diag(s')` over the channels; where monitors have noise in common, the mean of that with `s` and with `s'` as they are
//! accompanied in the other monitors.

use nalgebra::{DMatrix, DVector};
use twin::{Place, Ring, Signature, Signatures};

use super::marginal::{Adapted, Discrepancy, Linearised};
use super::sums::{Seen, Sums, at_monitors};
use crate::data::Data;
use crate::location::Location;

/// Amplitudes of a gradient over those of other places, 2.5 um to 0.32 mm rms at the monitors: the tunes show one that moves the readings by far less than their noise.
const FINER: f64 = 1.0 / 8.0;
/// Standard deviation of a quadrupole's axis against the monitors' [m], typical of surveys.
const AXIS: f64 = 0.3e-3;
/// Quadrupoles within so many nat, or this share, of the best are judged with kicks as well.
const BEHIND: f64 = 12.0;
const BEHIND_SHARE: f64 = 0.1;
/// Runs of settings up to which each has an amplitude: the time that takes grows with their cube, to some seconds.
const MANY: usize = 200;

/// What the change of a quadrupole's gradient does.
pub(super) struct Changing {
    /// Change of `ln` of the gradient per unit of the amplitudes [1/m].
    log_gradient: f64,
    /// The gradient, and kicks in x and y as large as the error of the orbit makes them.
    pub(super) patterns: [Signature; 3],
}

/// What `ln` of each quadrupole's gradient does, with the kick that it gives to an orbit (x, y) at every element [m].
pub fn steering(signatures: &Signatures, ring: &Ring, orbit: &[[f64; 2]]) -> Vec<Signature> {
    let with_kick = |(q, mut gradient): (usize, Signature)| {
        gradient += kick(signatures, ring, q, orbit[ring.quadrupoles[q].element]);
        gradient
    };
    signatures.of_quadrupoles().into_iter().enumerate().map(with_kick).collect()
}

/// What the kick does that `ln` of a quadrupole's gradient gives to a beam off its axis [m]; it focuses in x.
fn kick(signatures: &Signatures, ring: &Ring, quadrupole: usize, [x, y]: [f64; 2]) -> Signature {
    let element = ring.quadrupoles[quadrupole].element;
    let (length, k1) = (ring.elements[element].length, ring.gradients()[quadrupole]);
    signatures.of_kick(Place { element, depth: 0.5 * length }, [-k1 * length * x, k1 * length * y])
}

impl Changing {
    /// Of each quadrupole; `sigma`: standard deviation of the orbit at every element (x, y) [m].
    pub fn all(signatures: &Signatures, ring: &Ring, orbit: &[[f64; 2]], sigma: &[[f64; 2]]) -> Vec<Self> {
        let changing = |(q, gradient): (usize, Signature)| {
            let log_gradient = FINER / gradient.rms().max(f64::MIN_POSITIVE);
            let [x, y] = sigma[ring.quadrupoles[q].element].map(|sigma| sigma.hypot(AXIS));
            let patterns = [gradient, kick(signatures, ring, q, [x, 0.0]), kick(signatures, ring, q, [0.0, y])];
            Self { log_gradient, patterns: patterns.map(|pattern| pattern * log_gradient) }
        };
        steering(signatures, ring, orbit).into_iter().enumerate().map(changing).collect()
    }
}

/// The sums of each channel over the runs of settings.
pub(super) struct Runs {
    channels: Vec<(usize, Sums)>,
    /// Monitors that count.
    monitors: Vec<usize>,
}

impl Runs {
    /// Of some monitors and the tunes that are known; none of too many runs.
    pub fn from_readings(data: &Data, seen: &Seen, monitors: &[usize]) -> Option<Self> {
        if data.pools.count > MANY {
            return None;
        }
        let each = DMatrix::identity(data.pools.count, data.pools.count);
        let tunes = [0, 1].into_iter().filter(|&plane| data.tune_noise(plane).is_some());
        let channels = monitors.iter().copied().chain(tunes.map(|plane| data.monitors() + plane));
        let channels = channels.map(|c| (c, data.sums(c, seen, &each))).collect();
        Some(Self { channels, monitors: monitors.to_vec() })
    }

    /// One amplitude a run of each of some patterns.
    pub(super) fn of_patterns(&self, data: &Data, patterns: &[Signature]) -> Sums {
        let (runs, unknowns) = (data.pools.count, self.channels[0].1.cross.ncols());
        let mut all = Sums::zero(patterns.len() * runs, unknowns);
        let left: Vec<DMatrix<f64>> =
            patterns.iter().map(|one| data.accompanied_in_runs(&self.monitors, &one.readings)).collect();
        for (c, own) in &self.channels {
            let does = |i: usize| DVector::from_fn(runs, |run, _| data.effect_on(&patterns[i], *c, run));
            let does: Vec<DVector<f64>> = (0..patterns.len()).map(does).collect();
            let leaves =
                |i: usize| if *c < data.monitors() { left[i].column(*c).into_owned() } else { does[i].clone() };
            let leaves: Vec<DVector<f64>> = (0..patterns.len()).map(leaves).collect();
            for i in 0..patterns.len() {
                for j in i..patterns.len() {
                    let mut block = all.gram.view_mut((i * runs, j * runs), (runs, runs));
                    // by slices, which takes a tenth of the time of matrix iterators
                    let (does_i, leaves_i) = (does[i].as_slice(), leaves[i].as_slice());
                    for (run, (from, mut to)) in own.gram.column_iter().zip(block.column_iter_mut()).enumerate() {
                        let [leaves_j, does_j] = [&leaves[j], &does[j]].map(|one| 0.5 * one[run]);
                        let both = does_i.iter().zip(leaves_i).map(|(does, leaves)| does * leaves_j + leaves * does_j);
                        // of a block on the diagonal half is enough
                        let gram = from.as_slice()[..if i == j { run + 1 } else { runs }].iter().zip(both);
                        to.as_mut_slice().iter_mut().zip(gram).for_each(|(to, (gram, both))| *to += gram * both);
                    }
                }
                let mut pull = all.pull.rows_mut(i * runs, runs);
                pull += own.pull.component_mul(&does[i]);
                let mut rows = all.cross.rows_mut(i * runs, runs);
                for (from, mut to) in own.cross.column_iter().zip(rows.column_iter_mut()) {
                    to += from.component_mul(&does[i]);
                }
            }
        }
        // the other half is its transpose
        all.gram.fill_lower_triangle_with_upper_triangle();
        all
    }
}

/// The readings in which quadrupoles are looked for.
pub(super) struct Where<'d> {
    pub data: &'d Data,
    pub own: &'d Seen,
    pub monitors: &'d [usize],
    pub runs: Option<Runs>,
    /// Steps in time, rows runs.
    pub stretches: DMatrix<f64>,
}

impl Where<'_> {
    /// Of patterns that step with time, by whole whitened frames.
    pub(crate) fn stepping(&self, patterns: &[Signature], steps: &DMatrix<f64>) -> Sums {
        let patterns: Vec<Signature> = patterns.iter().map(|one| at_monitors(one, self.monitors)).collect();
        Sums::from_columns(&self.data.stepping(&patterns, steps), self.own)
    }
}

impl Linearised<'_> {
    /// Each quadrupole, as one that changes in time and from run to run.
    pub(super) fn changing(&self, at: &Where, all: &[Changing]) -> Vec<Discrepancy> {
        let first: Vec<_> = all.iter().enumerate().map(|one| self.changes(at, one, 1, all.len())).collect();
        let log_bayes = |found: &[Discrepancy]| found.iter().map(|one| one.log_bayes).fold(0.0, f64::max);
        let best = first.iter().map(|found| log_bayes(found)).fold(0.0, f64::max);
        let near = (best - BEHIND.max(BEHIND_SHARE * best)).max(0.0);
        let with_kicks = |(one, first): ((usize, &Changing), Vec<Discrepancy>)| {
            if log_bayes(&first) <= near {
                return first;
            }
            let kicked = self.changes(at, one, 3, all.len());
            first.into_iter().zip(kicked).map(|(first, kicked)| first.averaged_with(kicked)).collect()
        };
        all.iter().enumerate().zip(first).flat_map(with_kicks).collect()
    }

    /// One quadrupole of several in time and, where there are not too many, in runs, by the first `patterns` of its own.
    fn changes(
        &self,
        at: &Where,
        (quadrupole, one): (usize, &Changing),
        patterns: usize,
        sites: usize,
    ) -> Vec<Discrepancy> {
        let (data, patterns) = (at.data, &one.patterns[..patterns]);
        let judged = |location: Location, sums: &Sums, spread: f64| {
            let found = self.judge(location, sums, sites);
            let spread = spread * one.log_gradient * found.size;
            let adapted = found.adapted.map(|adapted| self.spread(data, quadrupole, adapted, spread));
            Discrepancy { size: FINER * found.size, adapted, ..found }
        };
        let in_runs = at.runs.as_ref().map(|runs| runs.of_patterns(data, patterns));
        let in_time = in_runs
            .as_ref()
            .map_or_else(|| at.stepping(patterns, &at.stretches), |in_runs| in_runs.through(&at.stretches));
        // the steps add up
        let of_steps = at.stretches.row(0).norm();
        let mut found = vec![judged(Location::QuadrupoleInTime(quadrupole), &in_time, of_steps)];
        found.extend(in_runs.map(|sums| judged(Location::QuadrupoleInRuns(quadrupole), &sums, 1.0)));
        found
    }

    /// The factor of a quadrupole that changes is no single number: it is uncertain by as much as it changes, `spread` in `ln`.
    fn spread(&self, data: &Data, quadrupole: usize, mut adapted: Adapted, spread: f64) -> Adapted {
        let sigma = &self.fitted.units.sigma;
        for (i, parameter) in data.ring.parameters.iter().enumerate() {
            if parameter.quadrupoles.contains(&quadrupole) {
                adapted.covariance[(i, i)] += (spread / sigma[i]).powi(2);
            }
        }
        adapted
    }
}

#[cfg(test)]
mod tests {
    use inference::simulate;
    use twin::Machine;
    use validation::{Unmodelled, UnmodelledKind};

    use super::*;
    use crate::testing::{simulated, template, whitened};
    use crate::{Diagnosis, Verdict};

    /// A gradient moves the orbit of misaligned quadrupoles by what it kicks where that passes its own axis.
    #[test]
    fn a_gradient_kicks_an_orbit_off_its_axis() {
        let mut ring = Ring::paper_booster();
        let changed = 17;
        for (i, quadrupole) in ring.quadrupoles.clone().iter().enumerate().filter(|(i, _)| *i != changed) {
            let misalignment = &mut ring.elements[quadrupole.element].misalignment;
            (misalignment.dx, misalignment.dy) = (2e-4 * (i as f64).sin(), 2e-4 * (1.7 * i as f64).cos());
        }
        let machine = |vars: &[f64]| Machine::new(ring.with_vars(vars), twin::Rf::FixedMomentum, &[]).unwrap();
        let read = |vars: &[f64]| {
            let orbit = machine(vars).orbit().unwrap();
            let at = |monitor: twin::Monitor| orbit[monitor.element][usize::from(monitor.plane == twin::Plane::Y)];
            DVector::from_iterator(ring.read_monitors.len(), ring.monitors_read().map(at))
        };
        let with = |step: f64| {
            let mut vars = vec![1.0; ring.parameters.len()];
            vars[changed] += step;
            read(&vars)
        };
        let exact = (with(1e-4) - with(-1e-4)) / 2e-4;
        let (_, recording) = template();
        let data = whitened(&ring, &recording);
        let design = machine(&vec![1.0; ring.parameters.len()]);
        let signatures = Signatures::of(&design, &data.drives).unwrap();
        let orbit = design.orbit().unwrap();
        let own = ring.parameters[changed].quadrupoles[0];
        let all = steering(&signatures, &ring, &orbit).swap_remove(own);
        let kicked = all.readings.row(0) - signatures.of_quadrupoles()[own].readings.row(0);
        let off = (kicked.transpose() - &exact).amax() / exact.amax();
        // the orbit at the entrance of the magnet for that in its middle
        assert!(off < 0.1, "{off}");
    }

    /// A quadrupole whose gradient follows the correctors' currents: with these three seeds at its place. What moves the tunes by less than their noise in a
    /// single frame is found by all frames, and the vars are right.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_gradient_that_follows_the_kicks_is_found_at_its_quadrupole() {
        let ring = template().0;
        for seed in [3, 4, 5] {
            let vars = simulate::vars(&ring, true, seed).unwrap();
            let mut one = Unmodelled::of(UnmodelledKind::LoopGradient, &ring, seed);
            one.size = 8e-3;
            let recording = simulated(&vars, &[], &[&one], seed);
            let found = Diagnosis::from_recording(&ring, &recording, |_| ()).unwrap();
            assert_eq!(found.verdict, Verdict::Unexplained, "{}", found.sentence);
            let last = found.findings.last().unwrap();
            assert_eq!(last.at, one.site.name(&ring), "{}", found.sentence);
            assert!(last.phrase.contains("from setting to setting"), "{}", found.sentence);
        }
    }

    /// One that jumps in mid-campaign has no single factor: its error bar holds both.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn the_factor_of_a_quadrupole_that_changes_is_as_uncertain_as_it_changes() {
        let ring = template().0;
        let mut vars = simulate::vars(&ring, true, 8).unwrap();
        let mut one = Unmodelled::of(UnmodelledKind::QuadJump, &ring, 8);
        one.size = 0.012;
        let recording = simulated(&vars, &[], &[&one], 8);
        let found = Diagnosis::from_recording(&ring, &recording, |_| ()).unwrap();
        let names = ring.var_names();
        let at = names.iter().position(|name| *name == one.site.name(&ring)).unwrap();
        let (mean, sigma) = (found.vars_after.mean[at], found.vars_after.covariance[(at, at)].sqrt());
        for _ in 0..2 {
            assert!((mean - vars[at].ln()).abs() < 2.0 * sigma, "{mean} +- {sigma}, {}", vars[at].ln());
            vars[at] *= 1.012;
        }
        assert!(sigma < 0.024, "{sigma}");
    }
}
