//! The published measurement on a simulated Booster within the process: what is recorded, what fails, what is put back.

use core::cell::Cell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use control::simulated::{Fault, Settings, SimulatedControl, SimulatedMachine};
use control::{
    Channel, Control, ControlError, Journal, MeasureError, Plan, Sample, SessionError, Step, measure, preflight,
    recording, restore,
};
use inference::{BaseModel, BatchFit, Campaign, Recording, TuneUse, simulate};
use nalgebra::DVector;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use tempfile::TempDir;
use twin::Ring;

/// Cycle of the Booster as the plan that is committed expects it [s].
const PERIOD: f64 = 4.0;

fn config(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config").join(file)
}

fn plan(ring: &Ring) -> Plan {
    Plan::read(&config("measure-booster.toml"), ring).unwrap()
}

/// The plan with a few settings only.
fn short(ring: &Ring) -> Plan {
    let mut plan = plan(ring);
    plan.steps.retain(|step| match step {
        Step::Corrector { corrector, .. } => ["A2", "A4", "D3"].contains(&corrector.as_str()),
        Step::Rf { .. } => true,
    });
    plan
}

fn machine(plan: &Plan, ring: &Ring, faults: &[&str], seed: u64) -> SimulatedControl {
    let faults = faults.iter().map(|fault| Fault::parse(fault, ring).unwrap()).collect();
    let vars = simulate::vars(ring, true, seed).unwrap();
    let settings = Settings { vars, effects: Vec::new(), faults, settling: 0.3, seed };
    SimulatedControl::new(SimulatedMachine::try_new(plan, ring, settings).unwrap(), PERIOD)
}

/// A machine that operators have steered, so that "as it was" is not 0.
fn steered(plan: &Plan, ring: &Ring, faults: &[&str], seed: u64) -> SimulatedControl {
    let mut control = machine(plan, ring, faults, seed);
    control.write("BOOSTER:A4:SET", 1.5).unwrap();
    control.write("BOOSTER:D3:SET", -0.75).unwrap();
    control
}

fn go_on() -> bool {
    false
}

/// A measurement to its end, as a recording that is read from the disk.
fn measured(control: &mut impl Control, plan: &Plan, ring: &Ring, folder: &TempDir) -> Recording {
    let mut journal = Journal::open(&folder.path().join("out.journal"), plan).unwrap();
    measure(control, plan, &mut journal, &go_on, |_| ()).unwrap();
    written(plan, ring, &journal, folder)
}

fn written(plan: &Plan, ring: &Ring, journal: &Journal, folder: &TempDir) -> Recording {
    let out = folder.path().join("out");
    recording(plan, journal, "out").write(&out, ring).unwrap();
    Recording::read(&out, ring).unwrap()
}

/// Normalised estimation error squared over the number of vars, 1 expected.
fn nees(recording: &Recording, ring: &Ring, seed: u64) -> f64 {
    let fit =
        BatchFit::best(&Campaign::of(ring, recording).unwrap(), TuneUse::Readings, BaseModel::EXACT, |_| ()).unwrap();
    let truth = simulate::vars(ring, true, seed).unwrap();
    let error = DVector::from_fn(truth.len(), |i, _| fit.map_params[i] - truth[i].ln());
    let solved = fit.covariance.cholesky().unwrap().solve(&error);
    error.dot(&solved) / truth.len() as f64
}

/// Which settings a recording has, and how many frames of each.
fn settings(recording: &Recording) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for row in &recording.rows {
        *counts.entry(format!("{:?} {}", row.correctors, row.rf_offset)).or_insert(0) += 1;
    }
    counts
}

/// NEES/48 of one campaign scatters by 0.2 about 1 (chi-square of 48 degrees of freedom); the bounds are about three of that.
#[test]
fn the_published_measurement_is_fitted_within_its_error_bars() {
    let (ring, folder) = (Ring::booster(), tempfile::tempdir().unwrap());
    let plan = plan(&ring);
    let mut control = steered(&plan, &ring, &["drop_out@x_E4=0.1"], 11);
    let before = control.set_points().clone();
    preflight(&mut control, &plan).unwrap();
    let recording = measured(&mut control, &plan, &ring, &folder);
    assert_eq!(control.set_points(), &before);
    assert_eq!(recording.rows.len(), (37 * 3 + 3) * 3);
    let nees = nees(&recording, &ring, 11);
    println!("NEES/48 {nees:.2}");
    assert!((0.5..1.6).contains(&nees), "NEES/48 {nees}");
    let e4 = ring.monitor_names().iter().position(|name| name == "x_E4").unwrap();
    let missing = recording.rows.iter().filter(|row| row.reading[e4].is_none()).count() as f64;
    let expected = 0.1 * recording.rows.len() as f64;
    assert!((missing - expected).abs() < 4.0 * expected.sqrt(), "{missing} readings missing, expected {expected}");
}

#[test]
fn an_interrupted_measurement_goes_on_and_equals_an_uninterrupted_one() {
    let (ring, folder) = (Ring::booster(), tempfile::tempdir().unwrap());
    let plan = plan(&ring);
    let mut control = steered(&plan, &ring, &[], 12);
    let before = control.set_points().clone();
    let mut random = StdRng::seed_from_u64(12);
    let path = folder.path().join("out.journal");
    let mut interruptions = 0;
    let recording = loop {
        let (looks, last) = (Cell::new(0), random.random_range(20_000..60_000));
        let stop = || looks.replace(looks.get() + 1) > last;
        let mut journal = Journal::open(&path, &plan).unwrap();
        match measure(&mut control, &plan, &mut journal, &stop, |_| ()) {
            Ok(()) => break written(&plan, &ring, &journal, &folder),
            Err(MeasureError::Ended(why)) if matches!(*why, SessionError::Interrupted) => interruptions += 1,
            Err(error) => panic!("{error}"),
        }
        assert_eq!(control.set_points(), &before);
        assert!(journal.pending().is_none());
    };
    assert!(interruptions > 3, "{interruptions} interruptions");
    let folder = tempfile::tempdir().unwrap();
    let whole = measured(&mut machine(&plan, &ring, &[], 12), &plan, &ring, &folder);
    assert_eq!(settings(&recording), settings(&whole));
    assert_eq!(recording.header, whole.header);
    let nees = nees(&recording, &ring, 12);
    println!("NEES/48 {nees:.2} after {interruptions} interruptions");
    assert!((0.5..1.6).contains(&nees), "NEES/48 {nees}");
}

/// A control system whose user is killed after some requests: from then on nothing is asked of it any more.
struct Killed<'c> {
    control: &'c mut SimulatedControl,
    left: usize,
}

impl Killed<'_> {
    fn ask(&mut self) -> Result<&mut SimulatedControl, ControlError> {
        self.left = self.left.checked_sub(1).ok_or_else(|| ControlError::Process("killed".into()))?;
        Ok(self.control)
    }
}

impl Control for Killed<'_> {
    fn describe(&mut self, names: &[&str]) -> Result<Vec<Channel>, ControlError> {
        self.ask()?.describe(names)
    }

    fn sample(&mut self, names: &[&str]) -> Result<Vec<Result<Sample, String>>, ControlError> {
        self.ask()?.sample(names)
    }

    fn write(&mut self, name: &str, value: f64) -> Result<(), ControlError> {
        self.ask()?.write(name, value)
    }

    fn now(&self) -> f64 {
        self.control.now()
    }

    fn pause(&mut self, seconds: f64) {
        self.control.pause(seconds);
    }
}

#[test]
fn the_journal_of_a_killed_measurement_puts_the_machine_back() {
    let (ring, folder) = (Ring::booster(), tempfile::tempdir().unwrap());
    let plan = short(&ring);
    let mut control = steered(&plan, &ring, &[], 13);
    control.write("BOOSTER:RF:SET", 1.377e6).unwrap();
    let before = control.set_points().clone();
    let mut random = StdRng::seed_from_u64(13);
    let mut left_moved = 0;
    for run in 0..20 {
        let path = folder.path().join(format!("{run}.journal"));
        let mut killed = Killed { control: &mut control, left: random.random_range(0..12_000) };
        let mut journal = Journal::open(&path, &plan).unwrap();
        let ended = measure(&mut killed, &plan, &mut journal, &go_on, |_| ());
        assert!(ended.is_err(), "run {run} was over before it was killed");
        drop(journal);
        left_moved += usize::from(control.set_points() != &before);
        let mut journal = Journal::existing(&path).unwrap();
        restore(&mut control, &mut journal, 10.0).unwrap();
        assert_eq!(control.set_points(), &before, "run {run}");
        assert_eq!(restore(&mut control, &mut journal, 10.0).unwrap(), 0, "a second time nothing is left to do");
    }
    assert!(left_moved > 10, "only {left_moved} of 20 were killed with a set point moved");
}

fn ends(faults: &[&str]) -> String {
    let (ring, folder) = (Ring::booster(), tempfile::tempdir().unwrap());
    let plan = short(&ring);
    let mut control = steered(&plan, &ring, faults, 14);
    let before = control.set_points().clone();
    let mut journal = Journal::open(&folder.path().join("out.journal"), &plan).unwrap();
    let error = measure(&mut control, &plan, &mut journal, &go_on, |_| ()).unwrap_err();
    assert_eq!(control.set_points(), &before);
    error.to_string()
}

#[test]
fn a_corrector_that_sticks_is_said_and_the_machine_put_back() {
    let said = ends(&["stick@A4=19"]);
    assert!(said.starts_with("A4 at +22 A: BOOSTER:A4:SET was set to 22, read-back BOOSTER:A4:READ is at "), "{said}");
    assert!(said.ends_with("after 60 s, expected within 0.5; the machine is back at its settings"), "{said}");
}

#[test]
fn monitors_that_are_not_updated_are_said_and_the_machine_put_back() {
    let said = ends(&["freeze@y=20"]);
    assert!(said.contains("no frame in 60 s: BOOSTER:BPM:Y was last updated -"), "{said}");
    assert!(said.ends_with("the machine is back at its settings"), "{said}");
}

#[test]
fn all_wrong_values_of_a_plan_are_said_at_once() {
    let (ring, folder) = (Ring::booster(), tempfile::tempdir().unwrap());
    std::fs::copy(config("booster-header.toml"), folder.path().join("booster-header.toml")).unwrap();
    let text = std::fs::read_to_string(config("measure-booster.toml")).unwrap();
    let changed = text
        .replace("amplitude_A = 22.0", "amplitude_A = 30.0")
        .replace("repeats = 3", "repeats = 0")
        .replace("settle_s = 4.0", "settle_s = -1.0")
        .replace("\"D6\"", "\"Z9\"")
        .replace("steps_relative = [2e-4,", "steps_relative = [0.2,");
    let file = folder.path().join("plan.toml");
    std::fs::write(&file, changed).unwrap();
    let said = Plan::read(&file, &ring).unwrap_err().to_string();
    for part in [
        "correctors.limits_A: expected -30.0 to 30.0 A within them, found -25.0 to 25.0 A",
        "frames.repeats: expected 1 or more, found 0",
        "timing.settle_s: expected a number from 0.001 to 86400 s, found -1",
        "correctors.skip: expected correctors of AGS Booster (BNL), deck, found \"Z9\"",
        "rf.steps_relative: expected numbers from -0.01 to 0.01 without 0, found 0.2",
    ] {
        assert!(said.contains(part), "{said}");
    }
    std::fs::write(&file, text.replace("settle_s", "settle_ms")).unwrap();
    let said = Plan::read(&file, &ring).unwrap_err().to_string();
    assert!(said.contains("plan.toml, line ") && said.contains("unknown field `settle_ms`"), "{said}");
}

#[test]
fn channels_are_checked_before_anything_is_written() {
    let ring = Ring::booster();
    let mut wrong = plan(&ring);
    let mut control = machine(&wrong, &ring, &[], 15);
    wrong.channels.corrector_set[0] = "BOOSTER:DIPOLE:READ".into();
    wrong.channels.corrector_read[1] = "BOOSTER:NONE".into();
    wrong.channels.monitors[0].monitors.pop();
    wrong.rf_limits = [1.0, 2e6];
    let said = preflight(&mut control, &wrong).unwrap_err().to_string();
    for part in [
        "BOOSTER:BPM:X: expected 14 numbers, found 15",
        "BOOSTER:DIPOLE:READ: may not be written",
        "BOOSTER:NONE: not connected",
        "BOOSTER:RF:SET: takes 1363032 to 1390568, the plan needs 1 to 2000000",
    ] {
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn a_journal_is_of_one_measurement_and_survives_a_line_without_its_end() {
    let (ring, folder) = (Ring::booster(), tempfile::tempdir().unwrap());
    let plan = short(&ring);
    let path = folder.path().join("out.journal");
    let mut control = machine(&plan, &ring, &[], 16);
    let mut journal = Journal::open(&path, &plan).unwrap();
    assert!(Journal::existing(&path).unwrap_err().to_string().ends_with("in use by another measurement"));
    measure(&mut control, &plan, &mut journal, &go_on, |_| ()).unwrap();
    let frames = journal.frames().count();
    drop(journal);
    let whole = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, format!("{whole}{{\"taken\":{{\"ste")).unwrap();
    assert_eq!(Journal::open(&path, &plan).unwrap().frames().count(), frames);
    assert_eq!(std::fs::read_to_string(&path).unwrap(), whole);
    let mut other = plan.clone();
    other.channels.cycle = "OTHER".into();
    let said = Journal::open(&path, &other).unwrap_err().to_string();
    assert!(said.contains("the journal of a measurement with another table of channels"), "{said}");
}
