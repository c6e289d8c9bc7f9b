//! A quadrupole whose gradient changes: in time, or from one run of a setting to the next, as where it follows the correctors' currents or comes and goes.
//!
//! In each run of frames it has an amplitude of its own; in time, steps. A gradient also kicks the beam, which is off the quadrupole's axis already
//! without kicks: by as much as the estimated orbit is, and by free amplitudes of the size of that estimate's error. With `s` what a pattern does to a
//! channel (a monitor or a tune) in each run, and that channel's sums over runs, the Gram matrix of two patterns' amplitudes is the sum of
//! `diag(s) E^T S^-1 E diag(s')` over the channels.

use nalgebra::{DMatrix, DVector, MatrixXx2};
use twin::{Hold, Machine, Optics, OrbitError, Place, Signature, Signatures};

use super::{Adapted, Data, Discrepancy, Linearised, Seen, Sums};
use crate::location::Location;

/// Amplitudes of a gradient over those of other places: the tunes show one that moves the readings by far less than their noise.
const FINER: f64 = 1.0 / 16.0;
/// Standard deviation of a quadrupole's axis against the monitors' [m], typical of surveys.
const AXIS: f64 = 0.3e-3;
/// Quadrupoles so many nat, or such a share, behind the best may lead with kicks.
const BEHIND: f64 = 12.0;
const BEHIND_SHARE: f64 = 0.1;

/// The sums of each channel over the runs of settings.
pub(super) struct Runs {
    channels: Vec<(usize, Sums)>,
    /// Monitors that count.
    monitors: Vec<usize>,
}

/// What the change of a quadrupole's gradient does, and kicks as large as the error of the orbit makes them.
pub(super) struct Changing {
    /// Change of `ln` of the gradient per unit of the amplitudes [1/m].
    log_gradient: f64,
    gradient: Signature,
    kicks: [Signature; 2],
}

impl Changing {
    /// Of each quadrupole; `sigma`: standard deviation of the orbit at every element (x, y) [m].
    ///
    /// # Errors
    /// [`OrbitError`].
    pub fn all(
        machine: &Machine,
        signatures: &Signatures,
        orbit: &[[f64; 2]],
        sigma: &[[f64; 2]],
    ) -> Result<Vec<Self>, OrbitError> {
        let ring = machine.ring();
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
        let monitors = optics.read_monitors();
        let of = |((quadrupole, k1), mut gradient): ((&_, f64), Signature)| {
            let twin::Quadrupole { element, .. } = *quadrupole;
            let length = ring.elements[element].length;
            let place = Place { element, depth: 0.5 * length };
            // focusing in x
            let kick = |[x, y]: [f64; 2]| optics.kick(place, [-k1 * length * x, k1 * length * y]);
            let [x, y] = sigma[element].map(|sigma| sigma.hypot(AXIS));
            let response = optics.response(&monitors, &[kick(orbit[element]), kick([x, 0.0]), kick([0.0, y])]);
            gradient.readings.row_iter_mut().for_each(|mut row| row += response.column(0).transpose());
            let scale = FINER / gradient.rms();
            let kicks = [1, 2].map(|plane| {
                let rows = vec![response.column(plane).transpose(); gradient.readings.nrows()];
                let none = MatrixXx2::zeros(rows.len());
                Signature { readings: DMatrix::from_rows(&rows), tunes: [0.0; 2], tune_changes: none } * scale
            });
            Self { log_gradient: scale, gradient: gradient * scale, kicks }
        };
        Ok(ring.quadrupoles.iter().zip(ring.gradients()).zip(signatures.of_quadrupoles()).map(of).collect())
    }

    pub(super) fn patterns(&self) -> [&Signature; 3] {
        [&self.gradient, &self.kicks[0], &self.kicks[1]]
    }
}

impl Runs {
    /// Of some monitors and the tunes that are known.
    pub fn of(data: &Data, seen: &Seen, monitors: &[usize]) -> Self {
        let each = DMatrix::identity(data.pools.count, data.pools.count);
        let tunes = [0, 1].into_iter().filter(|&plane| data.tune_noise(plane).is_some());
        let channels = monitors.iter().copied().chain(tunes.map(|plane| data.monitors() + plane));
        Self { channels: channels.map(|c| (c, data.sums(c, seen, &each))).collect(), monitors: monitors.to_vec() }
    }

    /// One amplitude a run of each of some patterns.
    pub fn of_patterns(&self, data: &Data, patterns: &[&Signature]) -> Sums {
        let (runs, unknowns) = (data.pools.count, self.channels[0].1.cross.ncols());
        let mut all = Sums::none(patterns.len() * runs, unknowns);
        let left: Vec<DMatrix<f64>> =
            patterns.iter().map(|one| data.accompanied_in_runs(&self.monitors, &one.readings)).collect();
        for (c, own) in &self.channels {
            let does = |i: usize| DVector::from_fn(runs, |run, _| data.effect_on(patterns[i], *c, run));
            let does: Vec<DVector<f64>> = (0..patterns.len()).map(does).collect();
            let leaves =
                |i: usize| if *c < data.monitors() { left[i].column(*c).into_owned() } else { does[i].clone() };
            let leaves: Vec<DVector<f64>> = (0..patterns.len()).map(leaves).collect();
            for i in 0..patterns.len() {
                for j in i..patterns.len() {
                    let both = (&does[i] * leaves[j].transpose() + &leaves[i] * does[j].transpose()) * 0.5;
                    let mut block = all.gram.view_mut((i * runs, j * runs), (runs, runs));
                    block += own.gram.component_mul(&both);
                }
                let mut pull = all.pull.rows_mut(i * runs, runs);
                pull += own.pull.component_mul(&does[i]);
                for (from, mut to) in own.cross.column_iter().zip(all.cross.rows_mut(i * runs, runs).column_iter_mut())
                {
                    to += from.component_mul(&does[i]);
                }
            }
        }
        all.gram.fill_lower_triangle_with_upper_triangle();
        all
    }
}

impl Sums {
    /// Of amplitudes that are sums of some, block by block: `steps`, rows those of a block.
    pub(super) fn through(&self, steps: &DMatrix<f64>) -> Self {
        let (from, to) = steps.shape();
        let blocks = self.pull.len() / from;
        let mut all = Self::none(blocks * to, self.cross.ncols());
        for i in 0..blocks {
            for j in 0..blocks {
                let block = self.gram.view((i * from, j * from), (from, from));
                all.gram.view_mut((i * to, j * to), (to, to)).copy_from(&(steps.transpose() * block * steps));
            }
            all.cross.rows_mut(i * to, to).copy_from(&steps.tr_mul(&self.cross.rows(i * from, from)));
            all.pull.rows_mut(i * to, to).copy_from(&steps.tr_mul(&self.pull.rows(i * from, from)));
        }
        all
    }
}

impl Linearised<'_> {
    /// Each quadrupole, as one that changes in time and from run to run. Those near the best are judged again with kicks, which the orbit's error makes.
    pub(super) fn changing(
        &self,
        data: &Data,
        runs: &Runs,
        all: &[Changing],
        stretches: &DMatrix<f64>,
    ) -> Vec<Discrepancy> {
        let judged = |(quadrupole, one): (usize, &Changing), patterns: &[&Signature]| {
            let sums = runs.of_patterns(data, patterns);
            let in_time = self.judge(Location::QuadrupoleInTime(quadrupole), &sums.through(stretches), all.len());
            [in_time, self.judge(Location::QuadrupoleInRuns(quadrupole), &sums, all.len())].map(|found| {
                // steps in time are of one half up and down
                let is_in_time = found.at == Location::QuadrupoleInTime(quadrupole);
                let steps = if is_in_time { 0.25 * stretches.ncols() as f64 } else { 1.0 };
                let spread = steps.sqrt() * one.log_gradient * found.size;
                let adapted = found.adapted.map(|adapted| self.spread(data, quadrupole, adapted, spread));
                Discrepancy { size: FINER * found.size, adapted, ..found }
            })
        };
        let mut found: Vec<_> = all.iter().enumerate().map(|one| judged(one, &[&one.1.gradient])).collect();
        let log_bayes = |found: &[Discrepancy; 2]| found[0].log_bayes.max(found[1].log_bayes);
        let best = found.iter().map(log_bayes).fold(0.0, f64::max);
        let near = best - BEHIND.max(BEHIND_SHARE * best);
        for (one, found) in all.iter().enumerate().zip(&mut found) {
            if log_bayes(found) > near.max(0.0) {
                *found = judged(one, &one.1.patterns());
            }
        }
        found.into_iter().flatten().collect()
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
    use inference::Campaign;
    use inference::simulate::{self, Beyond, Hardware, Truth};
    use twin::Ring;

    use super::*;
    use crate::testing::template;
    use crate::validation::{Unmodelled, UnmodelledKind};
    use crate::{Diagnosis, Verdict};

    /// A gradient moves the orbit of misaligned quadrupoles by what it kicks where that passes its own axis.
    #[test]
    fn a_gradient_kicks_an_orbit_off_its_axis() {
        let mut ring = Ring::booster();
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
        let data = Data::of(&Campaign::of(&ring, &recording).unwrap()).unwrap();
        let design = machine(&vec![1.0; ring.parameters.len()]);
        let signatures = Signatures::of(&design, &data.drives).unwrap();
        let orbit = design.orbit().unwrap();
        let all = Changing::all(&design, &signatures, &orbit, &vec![[0.0; 2]; orbit.len()]).unwrap();
        let own = ring.parameters[changed].quadrupoles[0];
        let pattern = &all[own].gradient.readings * all[own].log_gradient.recip();
        let kicked = pattern.row(0) - signatures.of_quadrupoles()[own].readings.row(0);
        let off = (kicked.transpose() - &exact).amax() / exact.amax();
        // the orbit at the entrance of the magnet for that in its middle
        assert!(off < 0.1, "{off}");
    }

    /// A quadrupole whose gradient follows the correctors' currents: with these three seeds at its place. What moves the tunes by less than their noise in a
    /// single frame is found by all frames, and the vars are right.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_gradient_that_follows_the_kicks_is_found_at_its_quadrupole() {
        let (ring, template) = template();
        let hardware = Hardware::shipped(&ring, &template);
        for seed in [3, 4, 5] {
            let vars = simulate::vars(&ring, true, seed).unwrap();
            let mut one = Unmodelled::of(UnmodelledKind::LoopGradient, &ring, seed);
            one.size = 8e-3;
            let beyond: &[&dyn Beyond] = &[&one];
            let truth = Truth { vars: &vars, effects: &[], beyond };
            let recording = simulate::campaign(&template, &ring, &truth, &hardware, seed).unwrap();
            let found = Diagnosis::of(&ring, &recording, |_| ()).unwrap();
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
        let (ring, template) = template();
        let hardware = Hardware::shipped(&ring, &template);
        let mut vars = simulate::vars(&ring, true, 8).unwrap();
        let mut one = Unmodelled::of(UnmodelledKind::QuadJump, &ring, 8);
        one.size = 0.012;
        let beyond: &[&dyn Beyond] = &[&one];
        let truth = Truth { vars: &vars, effects: &[], beyond };
        let recording = simulate::campaign(&template, &ring, &truth, &hardware, 8).unwrap();
        let found = Diagnosis::of(&ring, &recording, |_| ()).unwrap();
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
