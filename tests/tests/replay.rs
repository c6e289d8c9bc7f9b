//! The main job on the recordings that ship with the repository: readings in, vars out, against the truth, against the
//! exact batch fit, and in another order.

use estimator::Walk;
use inference::stream::{self, Core, Estimate, Setup};
use inference::{BaseModel, BatchFit, Campaign, Recording, TuneUse};
use system_tests::machine::nees;
use system_tests::{recording, repository, truth};
use twin::Ring;

struct Replayed {
    ring: Ring,
    recording: Recording,
    core: Core,
    last: Estimate,
}

fn replay((ring, recording): (Ring, Recording)) -> Replayed {
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    replay_through(core, (ring, recording))
}

fn replay_through(mut core: Core, (ring, recording): (Ring, Recording)) -> Replayed {
    let mut last = None;
    stream::replay(&mut core, &recording, |_, estimate| last = Some(estimate.clone())).unwrap();
    Replayed { ring, recording, core, last: last.unwrap() }
}

/// Without the tunes: orbits alone.
fn without_tunes((ring, recording): (Ring, Recording)) -> Replayed {
    let setup = Setup { tune_calibration: None, ..stream::setup(&ring, &recording, Walk::NONE).unwrap() };
    replay_through(Core::try_new(&ring, setup).unwrap(), (ring, recording))
}

impl Replayed {
    /// Rms error of the vars of QH and QV.
    fn rms_error(&self, truth: &[f64]) -> [f64; 2] {
        let square = |i: usize| (f64::from(self.last.mean[i]) - truth[i]).powi(2);
        [0, 24].map(|from| ((from..from + 24).map(square).sum::<f64>() / 24.0).sqrt())
    }

    /// Mean standard deviation of the vars of QH and QV.
    fn mean_sigma(&self) -> [f64; 2] {
        [0, 24].map(|from| self.last.sigma[from..from + 24].iter().map(|s| f64::from(*s)).sum::<f64>() / 24.0)
    }

    /// Normalised estimation error squared of the params, per param.
    fn nees(&self, truth: &[f64]) -> f64 {
        let error = core::array::from_fn(|i| f64::from(self.last.map_params[i]) - truth[i].ln());
        nees(&error, |i, j| self.core.covariance(i, j)) / 48.0
    }

    fn state(&self, monitor: &str) -> estimator::Health {
        let at = self.ring.monitor_names().iter().position(|name| name == monitor).unwrap();
        self.last.health[at]
    }
}

#[test]
fn paper_vars_are_found_as_well_as_their_error_bars_say() {
    let mut run = replay(recording("paper-vars"));
    let truth = truth("recordings/paper-vars", &run.ring);
    let [h, v] = run.rms_error(&truth);
    assert!(h < 0.0038 && v < 0.0068, "rms error {h:.5} {v:.5}");
    let nees = run.nees(&truth);
    // 48 correlated directions: 0.6..1.5 is the 99 % range of chi-square with 48 degrees over 48
    assert!((0.6..1.5).contains(&nees), "NEES/48 {nees:.2}");
    // numpy with derivatives by pyAT, noise and prior as here: 0.242 % and 0.374 %; the frames with an RF offset narrow the first
    let [h, v] = run.mean_sigma();
    assert!((h / 0.00242 - 1.0).abs() < 0.1 && (v / 0.00374 - 1.0).abs() < 0.1, "mean sigma {h:.5} {v:.5}");
    let quality = run.core.fit_quality();
    let chi2 = quality.chi_square / quality.degrees_of_freedom;
    assert!((0.95..1.05).contains(&chi2), "chi2/dof {chi2:.4}"); // sqrt(2/10000) = 0.014
}

#[test]
fn random_vars_are_found_from_ones() {
    let run = replay(recording("random-vars"));
    let nees = run.nees(&truth("recordings/random-vars", &run.ring));
    assert!((0.6..1.6).contains(&nees), "NEES/48 {nees:.2}");
}

#[test]
fn faulty_monitors_are_found_and_the_others_left_alone() {
    for name in ["paper-vars", "random-vars"] {
        let run = replay(recording(name));
        assert_eq!(run.state("x_C6").state, estimator::MonitorState::Noisy, "{name}");
        assert!(run.state("x_C6").noise > 4.0e-4, "{name}: several times the 0.15 mm of the others");
        assert_eq!(run.state("y_B5").state, estimator::MonitorState::Jumps, "{name}");
        let faulty = run.last.health.iter().filter(|h| h.state != estimator::MonitorState::Ok).count();
        assert_eq!(faulty, 2, "{name}");
    }
}

/// Same noise model and gate, different physics code, precision and algebra.
#[test]
fn the_core_agrees_with_the_exact_batch_fit() {
    for name in ["paper-vars", "random-vars"] {
        let mut run = replay(recording(name));
        let fit = BatchFit::best(
            &Campaign::of(&run.ring, &run.recording).unwrap(),
            TuneUse::Readings,
            BaseModel::EXACT,
            |_| (),
        )
        .unwrap();
        for i in 0..48 {
            let sigma = fit.covariance[(i, i)].sqrt();
            let shift = (f64::from(run.last.map_params[i]) - fit.map_params[i]) / sigma;
            let ratio = f64::from(run.last.params_sigma[i]) / sigma;
            // measured 0.09 and 0.02: the RF dispersion of unknown misalignments, the surrogate, means per setting, and a linearisation up to half
            // a sigma away
            assert!(shift.abs() < 0.1, "{name} {}: {shift:.3} sigma", run.ring.var_names()[i]);
            assert!((ratio - 1.0).abs() < 0.03, "{name} {}: sigma ratio {ratio:.4}", run.ring.var_names()[i]);
        }
        let quality = run.core.fit_quality();
        let chi2 = f64::from(quality.chi_square / quality.degrees_of_freedom);
        assert!((chi2 / fit.chi2_per_dof - 1.0).abs() < 5e-3, "{name}: chi2/dof {chi2:.4} {:.4}", fit.chi2_per_dof);
    }
}

/// Frames in another order, renumbered: only the moments at which the model was linearised differ, and a few readings
/// of the noisy monitor that were judged before its noise was known. Measured: 0.06 sigma at most.
#[test]
fn the_order_of_frames_does_not_matter() {
    let ordered = replay(recording("paper-vars"));
    for seed in 1..=5_u32 {
        let shuffled = replay(shuffled("paper-vars", seed));
        for i in 0..48 {
            let shift = (shuffled.last.map_params[i] - ordered.last.map_params[i]) / ordered.last.params_sigma[i];
            assert!(shift.abs() < 0.1, "seed {seed}, {}: {shift:.3} sigma", shuffled.ring.var_names()[i]);
        }
    }
}

/// A recording with its rows in another order, under the sequence numbers and times of the first one.
fn shuffled(name: &str, seed: u32) -> (Ring, Recording) {
    let (ring, mut recording) = recording(name);
    let clock: Vec<(u32, f64)> = recording.rows.iter().map(|row| (row.sequence, row.time)).collect();
    // Knuth's multiplicative hash of the number
    recording.rows.sort_by_key(|row| row.sequence.wrapping_add(seed).wrapping_mul(2_654_435_761));
    for (row, (sequence, time)) in recording.rows.iter_mut().zip(clock) {
        (row.sequence, row.time) = (sequence, time);
    }
    (ring, recording)
}

/// Has any number changed? `BLESS=1` rewrites the files; their diff is then reviewed. `NAME-orbits.csv` is the result without
/// tunes.
#[test]
fn the_final_table_is_the_committed_one() {
    for name in ["paper-vars", "random-vars"] {
        check_table(name, &replay(recording(name)));
        check_table(&format!("{name}-orbits"), &without_tunes(recording(name)));
    }
}

fn check_table(name: &str, run: &Replayed) {
    let mut table = String::from("var,mean,sigma\n");
    for (i, var) in run.ring.var_names().iter().enumerate() {
        // five decimals: a hundredth of an error bar
        table += &format!("{var},{:.5},{:.5}\n", run.last.mean[i], run.last.sigma[i]);
    }
    let path = repository("tests/golden").join(format!("{name}.csv"));
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, &table).unwrap();
    }
    let golden = std::fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(table, golden, "{}: BLESS=1 rewrites it", path.display());
}

/// Tunes are known to their calibration error, 3e-4, of which a tune depends on all vars together: they narrow that one direction.
#[test]
fn tunes_narrow_what_orbits_leave_open() {
    let [with, without] = [replay(recording("paper-vars")), without_tunes(recording("paper-vars"))];
    let vars: Vec<f64> = with.last.mean.iter().map(|var| f64::from(*var)).collect();
    let ring = with.ring.with_vars(&vars);
    let optics = twin::Optics::of(&ring, twin::Hold::Momentum { delta: 0.0 }).unwrap();
    let slope = |(gradient, k1): (&twin::Gradient, f64)| optics.tune_slope(gradient).map(|slope| slope * k1);
    let slopes: Vec<[f64; 2]> = optics.quadrupoles().iter().zip(ring.gradients()).map(slope).collect();
    for plane in [0, 1] {
        let sigma = |run: &Replayed| {
            let entry = |i: usize, j: usize| f64::from(run.core.covariance(i, j)) * slopes[i][plane] * slopes[j][plane];
            (0..48).flat_map(|i| (0..48).map(move |j| (i, j))).map(|(i, j)| entry(i, j)).sum::<f64>().sqrt()
        };
        let [with, without] = [sigma(&with), sigma(&without)];
        assert!(with < 3.3e-4 && with < without, "tune {plane}: {with:.2e}, by orbits alone {without:.2e}");
    }
}

#[test]
fn a_core_with_spare_room_gives_the_same_result() {
    for name in ["paper-vars", "random-vars"] {
        let exact = replay(recording(name));
        let setup = exact.core.setup.clone();
        let roomy = Core::with_spare_room(exact.core.tables.clone(), setup).unwrap();
        let mut roomy = replay_through(roomy, recording(name));
        for i in 0..48 {
            let shift = (roomy.last.mean[i] - exact.last.mean[i]) / exact.last.sigma[i];
            assert!(shift.abs() < 0.01, "{name}, {}: {shift:.4} sigma", exact.ring.var_names()[i]);
        }
        let mut core = exact.core.clone();
        let (quality, expected) = (roomy.core.fit_quality(), core.fit_quality());
        assert_eq!(quality.degrees_of_freedom, expected.degrees_of_freedom);
        assert_eq!(roomy.last.health, exact.last.health);
    }
}

/// The largest core, on the threads that it needs: as large as the design of a light source.
#[test]
fn the_largest_core_takes_a_campaign() {
    let (ring, mut recording) = recording("paper-vars");
    recording.rows.truncate(40);
    let exact = replay((ring.clone(), recording.clone()));
    let (tables, setup) = (exact.core.tables.clone(), exact.core.setup.clone());
    let mut largest = replay_through(Core::in_largest_room(tables.clone(), setup).unwrap(), (ring, recording));
    for i in 0..48 {
        let shift = (largest.last.mean[i] - exact.last.mean[i]) / exact.last.sigma[i];
        assert!(shift.abs() < 0.01, "{i}: {shift:.4} sigma");
    }
    largest.core.adopt(tables).unwrap();
}
