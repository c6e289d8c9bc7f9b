//! Batch fit, posterior and NUTS of rings that are not the Booster: ten cells from another code, and Boosters edited in their two files.

use core::ops::ControlFlow::Continue;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use inference::nuts::{self, NutsSettings};
use inference::recording::BelievedRf;
use inference::simulate::{self, Instruments};
use inference::{
    BaseModel, BatchFit, Campaign, Drive, Lack, Posterior, Readings, Recording, Reduced, ResponseModel, TuneUse,
};
use nalgebra::DVector;
use serde_json::{Value, json};
use twin::{Effect, Machine, Rf, Ring};

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// The Booster's machine file, changed.
fn booster(edit: impl FnOnce(&mut Value)) -> Ring {
    let mut machine: Value =
        serde_json::from_str(&std::fs::read_to_string(repository("machines/booster.json")).unwrap()).unwrap();
    edit(&mut machine);
    Ring::parse(&machine.to_string(), "booster.json").unwrap()
}

/// The paper's campaign without some columns, read for a ring; frames in which `corrector` is set are left out.
fn without(ring: &Ring, columns: &[&str], corrector: Option<&str>) -> Recording {
    let folder = repository("recordings/former/paper-vars");
    let frames = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    let names: Vec<&str> = frames.lines().next().unwrap().split(',').collect();
    let set = names.iter().position(|name| *name == "corrector").unwrap();
    let keep = |line: &&str| corrector.is_none_or(|corrector| line.split(',').nth(set) != Some(corrector));
    let cut = |line: &str| -> String {
        let kept = line.split(',').zip(&names).filter(|(_, name)| !columns.contains(name));
        kept.map(|(cell, _)| cell).collect::<Vec<_>>().join(",") + "\n"
    };
    let home = tempfile::tempdir().unwrap();
    std::fs::copy(folder.join("header.toml"), home.path().join("header.toml")).unwrap();
    std::fs::write(home.path().join("frames.csv"), frames.lines().filter(keep).map(cut).collect::<String>()).unwrap();
    Recording::read(home.path(), ring).unwrap_or_else(|error| panic!("{error}"))
}

fn fit(ring: &Ring, recording: &Recording, tunes: TuneUse) -> (Campaign, BatchFit) {
    let campaign = Campaign::of(ring, recording).unwrap();
    let fit = BatchFit::best(&campaign, tunes, BaseModel::EXACT, |_| ()).unwrap();
    (campaign, fit)
}

/// Mean square of (fitted - true)/sigma.
fn pull(fit: &BatchFit, truth: &[f64]) -> f64 {
    let square = |i: usize| (fit.map_params[i] - truth[i].ln()).powi(2) / fit.covariance[(i, i)];
    (0..truth.len()).map(square).sum::<f64>() / truth.len() as f64
}

/// Chi-square and pulls as they have to be: of 300 or more readings a standard deviation is 8 %, of 20 squared pulls 30 %.
fn assert_right(what: &str, fit: &BatchFit, truth: &[f64]) {
    let pull = pull(fit, truth);
    println!(
        "{what}: chi2/dof {:.4}, mean square pull {pull:.2}, {} steps, {:?}",
        fit.chi2_per_dof, fit.steps, fit.tunes
    );
    assert!((0.9..1.1).contains(&fit.chi2_per_dof), "{what}: chi2/dof {}", fit.chi2_per_dof);
    assert!((0.4..1.8).contains(&pull), "{what}: mean square pull {pull}");
}

fn truth(folder: &Path, ring: &Ring) -> Vec<f64> {
    let truth: Value = serde_json::from_str(&std::fs::read_to_string(folder.join("truth.json")).unwrap()).unwrap();
    ring.var_names().iter().map(|name| truth["vars"][name].as_f64().unwrap()).collect()
}

fn ten_cells(name: &str) -> (Ring, Recording, Vec<f64>) {
    let ring = Ring::read(&repository("recordings/ten-cells/ring.json")).unwrap();
    let folder = repository("recordings/ten-cells").join(name);
    let recording = Recording::read(&folder, &ring).unwrap();
    let truth = truth(&folder, &ring);
    (ring, recording, truth)
}

#[test]
fn ten_cells_of_another_code_are_fitted_with_tunes_and_without() {
    let (ring, recording, truth) = ten_cells("plain");
    let (_, with) = fit(&ring, &recording, TuneUse::Readings);
    let (_, without) = fit(&ring, &recording, TuneUse::LeftOut);
    assert_right("plain", &with, &truth);
    assert_right("plain, tunes left out", &without, &truth);
    for (with, without) in with.tunes.iter().zip(&without.tunes) {
        assert!(with.pull().unwrap().abs() < 3.0, "{with:?}");
        assert_eq!(with.measured, without.measured);
    }
    assert!(with.covariance.trace() < without.covariance.trace());
}

/// What a radial loop, or a held frequency, adds to every orbit is that of the true ring; the fit is told by the header.
#[test]
fn what_is_held_instead_of_the_momentum_is_part_of_the_fit() {
    let (ring, plain, truth) = ten_cells("plain");
    let pair = ["x_03F", "x_08F"].map(str::to_owned);
    for (believed_rf, effect) in
        [(BelievedRf::RadialLoop, "radial_loop@x_03F,x_08F"), (BelievedRf::FixedFrequency, "fixed_rf_frequency")]
    {
        let response = |effects: &[Effect]| {
            let machine = Machine::new(ring.with_vars(&truth), Rf::FixedMomentum, effects).unwrap();
            machine.response().unwrap().x
        };
        let held = response(&[Effect::parse(effect, &ring).unwrap()]) - response(&[]);
        let mut recording = plain.clone();
        for row in recording.rows.iter_mut().filter(|row| row.rf_offset == 0.0) {
            let kick = DVector::from_vec(Drive::from_row(&plain.header, row).kick.as_slice().to_vec());
            let moved = &held * kick;
            let monitors = ring.horizontal_monitors();
            row.reading[..monitors].iter_mut().zip(moved.iter()).for_each(|(to, x)| *to = to.map(|to| to + x));
        }
        let (_, untold) = fit(&ring, &recording, TuneUse::Readings);
        assert!(untold.mismatch && untold.chi2_per_dof > 1.5, "{effect}: chi2/dof {}", untold.chi2_per_dof);
        recording.header.believed_rf = believed_rf;
        recording.header.radial_loop_monitors = Some(pair.clone());
        let (_, told) = fit(&ring, &recording, TuneUse::Readings);
        assert_right(effect, &told, &truth);
        assert!(!told.mismatch);
    }
}

/// A monitor that reads 5 % too little cannot be fitted: what is said of the vars must still be within reach.
#[test]
fn a_monitor_that_reads_too_little_shows_in_chi_square_alone() {
    let (ring, recording, truth) = ten_cells("gain");
    let (_, fit) = fit(&ring, &recording, TuneUse::Readings);
    println!("gain: chi2/dof {}, mean square pull {}", fit.chi2_per_dof, pull(&fit, &truth));
    assert!(fit.chi2_per_dof > 1.1, "{}", fit.chi2_per_dof);
}

/// Vars of a simulation of a ring, and what is fitted to it.
fn simulated(ring: &Ring, template: &Recording, seed: u64) -> (Vec<f64>, Recording) {
    let vars = simulate::vars(ring, true, seed).unwrap();
    let instruments = Instruments::healthy(ring, template).unwrap();
    let made = simulate::like(template, ring, &vars, &instruments, seed).unwrap();
    (vars, made)
}

#[test]
fn a_booster_with_a_monitor_less_is_fitted() {
    let ring = booster(|machine| {
        let read = machine["data"]["bpm_x"].as_array_mut().unwrap();
        read.retain(|name| name != "D8");
    });
    let recording = without(&ring, &["x_D8_mm"], None);
    assert_eq!(recording.rows[0].reading.len(), 32);
    let (_, fit) = fit(&ring, &recording, TuneUse::LeftOut);
    assert_right("a monitor less", &fit, &truth(&repository("recordings/former/paper-vars"), &ring));
}

#[test]
fn a_booster_with_a_monitor_more_is_fitted() {
    let ring = booster(|machine| machine["data"]["bpm_x"].as_array_mut().unwrap().push(json!("F6")));
    let mut template = without(&Ring::paper_booster(), &[], None);
    let at = ring.horizontal_monitors() - 1;
    template.header.noise.insert(at, template.header.noise[0]);
    template.rows.iter_mut().for_each(|row| row.reading.insert(at, Some(0.0)));
    let (vars, made) = simulated(&ring, &template, 3);
    let (_, fit) = fit(&ring, &made, TuneUse::Readings);
    assert_right("a monitor more", &fit, &vars);
}

#[test]
fn a_quadrupole_that_is_not_fitted_stays_at_its_design() {
    let ring = booster(|machine| {
        let elements = machine["elements"].as_array_mut().unwrap();
        let quadrupole = elements.iter_mut().find(|element| element["name"] == "QH_D8").unwrap();
        quadrupole["fit"] = json!(false);
    });
    assert_eq!((ring.parameters.len(), ring.quadrupoles.len()), (47, 48));
    let (vars, made) = simulated(&ring, &without(&ring, &[], None), 5);
    let (_, fit) = fit(&ring, &made, TuneUse::Readings);
    assert_right("a quadrupole not fitted", &fit, &vars);
}

#[test]
fn a_booster_without_one_of_its_correctors_is_fitted() {
    let ring = booster(|machine| {
        let elements = machine["elements"].as_array_mut().unwrap();
        elements.retain(|element| element["name"] != "DCH_C4");
    });
    assert_eq!(ring.correctors.len(), 47);
    let recording = without(&ring, &["ic_C4_A"], Some("C4"));
    let (_, fit) = fit(&ring, &recording, TuneUse::LeftOut);
    assert_right("a corrector missing", &fit, &truth(&repository("recordings/former/paper-vars"), &ring));
}

/// One factor on all vertically focusing quadrupoles; the others one by one, on their supply as before.
#[test]
fn a_family_is_fitted_as_one_factor_beside_single_magnets() {
    let ring = booster(|machine| machine["families"] = json!({"QV": {"fit": "family", "prior_width": 0.01}}));
    assert_eq!((ring.parameters.len(), ring.parameters[24].name.as_str()), (25, "QV"));
    let (vars, made) = simulated(&ring, &without(&ring, &[], None), 7);
    let (campaign, fit) = fit(&ring, &made, TuneUse::LeftOut);
    assert_right("a family", &fit, &vars);
    assert!(campaign.screened.excluded.counting().iter().filter(|counts| **counts).count() > 11_000);
}

/// The twin, every magnet of a family by one factor: the sampler's Gaussian is the batch fit's, and its draws are those of it.
#[test]
fn the_posterior_of_family_factors_is_that_of_the_batch_fit() {
    let families = json!({"QH": {"fit": "family"}, "QV": {"fit": "family"}});
    let ring = booster(|machine| machine["families"] = families);
    let (_, made) = simulated(&ring, &without(&ring, &[], None), 9);
    let (campaign, fit) = fit(&ring, &made, TuneUse::LeftOut);
    let model = ResponseModel::twin(&ring).unwrap();
    let (prior, map) = (campaign.prior.clone(), fit.map_params.clone());
    let sigma = [0, 1].map(|i| fit.covariance[(i, i)].sqrt());
    let reduced = Reduced::from_fit(campaign, fit).unwrap();
    let posterior = Posterior::new(model.clone(), Readings::of_frames(&reduced, &model, TuneUse::LeftOut), prior);
    let laplace = posterior.laplace(&map).unwrap();
    let settings = NutsSettings { chains: 2, warm_up: 200, draws: 1500, seed: 1 };
    let run =
        nuts::sample(Arc::new(posterior), Arc::new(laplace), &ring.var_names(), settings, |_| Continue(())).unwrap();
    for (i, summary) in run.draws.summary().iter().enumerate() {
        // 3000 draws, 300 independent ones at least: 6 % of a mean's sigma, 4 % of a sigma
        let shift = (summary.mean.ln() - map[i]) / sigma[i];
        assert!(shift.abs() < 0.25, "{}: {shift}", summary.name);
        assert!((summary.sd / summary.mean / sigma[i] - 1.0).abs() < 0.2, "{summary:?} {sigma:?}");
        assert!(summary.r_hat <= nuts::UNMIXED, "{summary:?}");
    }
}

#[test]
fn without_a_kick_or_a_reading_the_result_is_the_prior_and_says_so() {
    let ring = Ring::paper_booster();
    let recording = without(&ring, &[], None);
    let still =
        |row: &&inference::recording::Row| row.rf_offset == 0.0 && row.correctors.iter().all(|(_, a)| *a == 0.0);
    let no_kick = Recording { rows: recording.rows.iter().filter(still).cloned().collect(), ..recording.clone() };
    let mut no_readings = recording.clone();
    no_readings.rows.iter_mut().for_each(|row| row.reading.fill(None));
    for (recording, lack) in [(no_kick, Lack::Kick), (no_readings, Lack::Readings)] {
        let (campaign, fit) = fit(&ring, &recording, TuneUse::LeftOut);
        assert_eq!(fit.lack, Some(lack));
        let away = |i: usize| (fit.map_params[i] - campaign.prior.mean[i]).abs() * campaign.prior.precision[i].sqrt();
        let furthest = (0..48).map(away).fold(0.0, f64::max);
        println!("{lack}: furthest param {furthest:.3} prior sigma from its mean");
        // orbits that take less than a tenth of a width away move its mean by 0.44 of it: sqrt(1 - 0.9^2)
        assert!(furthest < 0.44, "{lack}: {furthest}");
        let tuned = BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ()).unwrap();
        assert_eq!(tuned.lack, Some(lack));
        assert!(tuned.tunes.iter().all(|tune| tune.pull().unwrap().abs() < 3.0), "{:?}", tuned.tunes);
    }
    let (_, whole) = fit(&ring, &recording, TuneUse::Readings);
    assert_eq!(whole.lack, None);
}

/// Vars of the prior bring a ring near a resonance, where derivatives are so large that rounding leaves the screening without best params
/// for a while: it goes on with those of before, and the fit is right.
#[test]
fn a_ring_near_a_resonance_does_not_stop_the_screening() {
    let (ring, template, _) = ten_cells("plain");
    let mut seeds = simulate::seeds(7);
    let mut next = || seeds.next().unwrap();
    let vars = simulate::vars(&ring, false, next()).unwrap();
    let instruments = Instruments::healthy(&ring, &template).unwrap();
    let recording = simulate::like(&template, &ring, &vars, &instruments, next()).unwrap();
    let (_, fit) = fit(&ring, &recording, TuneUse::Readings);
    assert_right("near a resonance", &fit, &vars);
}
