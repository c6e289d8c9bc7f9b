//! A machine with physics that its design lacks, estimated by the core with the design's tables and with a model file that holds it.

use estimator::Walk;
use inference::stream::{self, Core};
use inference::{Recording, simulate, with_priors};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, Normal};
use results::model_file;
use system_tests::machine::nees;
use system_tests::repository;
use twin::{Cycle, Effect, Machine, Rf, Ring, Tracked};

/// The frames of `paper-vars`, with the exact orbits of a machine, each cycle by itself, baselines and 0.15 mm of noise.
fn recorded(ring: &Ring, vars: &[f64], effects: &[Effect]) -> Recording {
    let mut recording = Recording::read(&repository("recordings/former/paper-vars"), ring).unwrap();
    let machine = Machine::new(ring.clone(), Rf::FixedMomentum, effects).unwrap();
    let machine = Tracked::of(machine, recording.nominal_kick()).unwrap();
    let mut random = StdRng::seed_from_u64(1);
    let mut normal = |width: f64| Normal::new(0.0, width).unwrap().sample(&mut random);
    let baseline: Vec<f64> = ring.read_monitors.iter().map(|_| normal(2e-3)).collect();
    let drives = recording.drives();
    for (row, drive) in recording.rows.iter_mut().zip(drives) {
        let params: Vec<f64> = vars.iter().map(|var| var.ln()).collect();
        let factors = ring.strengths(&params, drive.strength.as_slice());
        let cycle = Cycle {
            kick: drive.kick.as_slice().to_vec(),
            strength: factors.iter().map(|factor| factor.ln()).collect(),
            rf_offset: drive.rf_offset,
            time: 0.0,
        };
        let (orbit, tunes) = machine.cycle(&cycle).unwrap();
        row.tune = [tunes.x, tunes.y].map(|tune| Some((tune + normal(5e-4)).rem_euclid(1.0)));
        for ((reading, orbit), baseline) in row.reading.iter_mut().zip(orbit).zip(&baseline) {
            *reading = Some(orbit + baseline + normal(0.15e-3));
        }
    }
    recording
}

/// The core's result for a recording: chi-square per degree of freedom, NEES per var, and the vars.
struct CoreResult {
    chi_square: f32,
    nees: f64,
    vars: Vec<f64>,
}

fn replay(mut core: Core, recording: &Recording, truth: &[f64]) -> CoreResult {
    let mut last = None;
    stream::replay(&mut core, recording, |_, estimate| last = Some(estimate.clone())).unwrap();
    let last = last.unwrap();
    let error = core::array::from_fn(|i| f64::from(last.map_params[i]) - truth[i].ln());
    let nees = nees(&error, |i, j| core.covariance(i, j)) / 48.0;
    let quality = core.fit_quality();
    let vars = last.map_params.iter().map(|theta| f64::from(theta.exp())).collect();
    CoreResult { chi_square: quality.chi_square / quality.degrees_of_freedom, nees, vars }
}

/// By the design's tables, and by a model file of the effects, made at the vars of a first pass with them.
fn both(ring: &Ring, recording: &Recording, truth: &[f64], effects: &[Effect]) -> [CoreResult; 2] {
    let setup = stream::setup(ring, recording, Walk::NONE).unwrap();
    let design = replay(Core::try_new(ring, setup.clone()).unwrap(), recording, truth);
    let path = tempfile::NamedTempFile::new().unwrap();
    let by_file = |vars: &[f64]| {
        let extended = training::extended::tables(ring, effects, vars).unwrap();
        model_file::write(path.path(), &ring.name, &extended.tables).unwrap();
        let core = Core::with_tables(model_file::read(path.path(), ring).unwrap(), setup.clone()).unwrap();
        replay(core, recording, truth)
    };
    let first = by_file(&design.vars);
    [design, by_file(&first.vars)]
}

#[test]
fn a_model_with_the_missing_physics_describes_the_machine() {
    let ring = Ring::paper_booster();
    let vars = simulate::vars(&with_priors(&ring, Some(0.02), None), true, 3).unwrap();
    for effect in ["quad_roll@F2=-0.018", "fixed_rf_frequency", "bpm_gain@x_E6=-0.076", "stray_gradient@SLOT_A3=-0.026"]
    {
        let effects = [Effect::parse(effect, &ring).unwrap()];
        let recording = recorded(&ring, &vars, &effects);
        let [design, extended] = both(&ring, &recording, &vars, &effects);
        // chi-square falls by 50 at least, of some 10,000; the core estimates the noise itself, and counts part of what the
        // model lacks as noise
        let fall = design.chi_square - extended.chi_square;
        assert!(fall > 5e-3 || design.nees > 10.0, "{effect}: chi2/dof falls by {fall:.4}");
        assert!(extended.nees < design.nees, "{effect}: NEES/48 {:.2} {:.2}", design.nees, extended.nees);
        // sqrt(2/10000) = 0.014
        assert!((0.95..1.05).contains(&extended.chi_square), "{effect}: chi2/dof {:.4}", extended.chi_square);
        // 48 correlated directions: 0.5..1.65 is the 99.9 % range of chi-square with 48 degrees over 48
        assert!((0.5..1.65).contains(&extended.nees), "{effect}: NEES/48 {:.2}", extended.nees);
    }
}
