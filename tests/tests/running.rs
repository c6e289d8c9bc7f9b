//! A core that runs for long: started while the machine stands still or while its correctors hold the orbit, and given another model. The
//! machine is the exact twin behind a tune meter, with effects that the first model lacks.

use estimator::Walk;
use inference::recording::Row;
use inference::stream::{self, Core, Estimate, Feedback};
use inference::{Drive, Recording, simulate, with_priors};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, Normal};
use system_tests::machine::nees;
use system_tests::repository;
use twin::{Cycle, Effect, Machine, Rf, Ring, Tracked};

/// Time between cycles [s].
const CYCLE: f64 = 0.2;
/// What the daemon expects by default.
const WALK: Walk = Walk { params: 1.5e-4, baselines: 2e-6 };
/// NEES over 48 of 48 correlated directions: the 99.9 % range of chi-square with 48 degrees. Vars that do not walk as the core expects
/// them to are better known than it says.
const HONEST: core::ops::Range<f64> = 0.1..1.65;

/// A machine, the core that hears it, and what is between them.
struct Running {
    ring: Ring,
    recording: Recording,
    campaign: Vec<Row>,
    machine: Tracked,
    vars: Vec<f64>,
    baseline: Vec<f64>,
    random: StdRng,
    core: Core,
    sequence: u32,
    last: Option<Estimate>,
    current: Vec<f32>,
}

impl Running {
    fn new(seed: u64, effects: &[Effect]) -> Self {
        let ring = Ring::booster();
        let mut recording = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
        let campaign = core::mem::take(&mut recording.rows);
        let machine = Machine::new(ring.clone(), Rf::FixedMomentum, effects).unwrap();
        let machine = Tracked::of(machine, recording.nominal_kick()).unwrap();
        let core = Core::try_new(&ring, stream::setup(&ring, &recording, WALK).unwrap()).unwrap();
        let current = vec![0.0; campaign[0].corrector_current.len()];
        let vars = simulate::vars(&with_priors(&ring, None, None), true, seed).unwrap();
        let random = StdRng::seed_from_u64(seed);
        let (baseline, sequence, last) = (vec![], 0, None);
        let mut running =
            Self { ring, recording, campaign, machine, vars, baseline, random, core, sequence, last, current };
        running.baseline = (0..33).map(|_| running.normal(1.5e-3)).collect();
        running
    }

    fn normal(&mut self, width: f64) -> f64 {
        Normal::new(0.0, width).unwrap().sample(&mut self.random)
    }

    /// One cycle with what a row says was set.
    fn cycle(&mut self, mut row: Row) {
        self.sequence += 1;
        (row.sequence, row.time) = (self.sequence, CYCLE * f64::from(self.sequence));
        let drive = Drive::from_row(&self.recording.header, &row);
        let params: Vec<f64> = self.vars.iter().map(|var| var.ln()).collect();
        let factors = self.ring.strengths(&params, drive.strength.as_slice());
        let strength = factors.iter().map(|factor| factor.ln()).collect();
        let cycle =
            Cycle { kick: drive.kick.as_slice().to_vec(), strength, rf_offset: drive.rf_offset, time: row.time };
        let (orbit, tunes) = self.machine.cycle(&cycle).unwrap();
        row.tune = [tunes.x, tunes.y].map(|tune| Some((tune + self.normal(1.2e-3)).rem_euclid(1.0)));
        for (b, orbit) in orbit.into_iter().enumerate() {
            let walked = self.normal(f64::from(WALK.baselines) * CYCLE.sqrt());
            self.baseline[b] += walked;
            row.reading[b] = Some(orbit + self.baseline[b] + self.normal(0.15e-3));
        }
        self.last = Some(self.core.ingest(&mut stream::wire(&self.recording, &row).unwrap()).unwrap());
        if let Some(correction) = self.core.correction() {
            self.current = correction.setpoint;
        }
        self.core.prepare();
    }

    /// Each corrector in turn.
    fn campaign(&mut self) {
        self.campaign.clone().into_iter().for_each(|row| self.cycle(row));
    }

    /// So many cycles, the correctors where they are set.
    fn cycles(&mut self, count: usize) {
        for _ in 0..count {
            let mut row = Row { correctors: vec![], rf_offset: 0.0, ..self.campaign[0].clone() };
            let set = self.current.clone();
            row.corrector_current = set.into_iter().map(|set| f64::from(set) + self.normal(0.02)).collect();
            self.cycle(row);
        }
    }

    fn steer(&mut self) {
        self.core.steer(Some(&Feedback {
            orbit: vec![0.0; 33],
            limit: vec![20.0; self.current.len()],
            walk: 5e-6,
            step_kick: 2e-5,
            total_kick: 1e-3,
            rate: 2.0,
            probe: 1.0,
            close: 0.3,
            patience_us: 2_000_000,
        }));
    }

    /// A core at its prior takes over.
    fn restart(&mut self) {
        self.core = Core::with_tables(self.core.tables.clone(), self.core.setup.clone()).unwrap();
    }

    /// The core goes over to a model with these effects.
    fn adopt(&mut self, effects: &[Effect]) {
        self.core.adopt(training::extended::tables(&self.ring, effects, &self.vars).unwrap().tables).unwrap();
    }

    /// Normalised estimation error squared over 48, and the rms error bar.
    fn nees(&self) -> (f64, f64) {
        let params = &self.last.as_ref().unwrap().map_params;
        let error = core::array::from_fn(|i| f64::from(params[i]) - self.vars[i].ln());
        let variances = (0..48).map(|i| f64::from(self.core.covariance(i, i)));
        let sigma = (variances.sum::<f64>() / 48.0).sqrt();
        (nees(&error, |i, j| self.core.covariance(i, j)) / 48.0, sigma)
    }

    fn assert_honest(&self, what: &str) -> f64 {
        let (nees, sigma) = self.nees();
        println!("{what}: NEES/48 {nees:.2}, error bars {:.2} %", 100.0 * sigma);
        assert!(HONEST.contains(&nees), "{what}: NEES/48 {nees:.2}, error bars {:.2} %", 100.0 * sigma);
        sigma
    }
}

fn effects(of: &[&str]) -> Vec<Effect> {
    of.iter().map(|effect| Effect::parse(effect, &Ring::booster()).unwrap()).collect()
}

/// Nothing moves for ten minutes: nothing is known of the vars but two tunes. Then a campaign.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_machine_that_stands_still_says_little_of_its_vars() {
    for seed in [21, 22] {
        let mut running = Running::new(seed, &[]);
        running.cycles(3000);
        assert!(running.assert_honest("at rest") > 0.02);
        running.campaign();
        assert!(running.assert_honest("after a campaign") < 0.01);
    }
}

/// A daemon that starts while a feedback holds the orbit by currents of some amperes in all correctors.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_core_that_starts_under_feedback_is_honest_from_the_first_frames_on() {
    for seed in [21, 22] {
        let mut running = Running::new(seed, &[]);
        running.campaign();
        running.steer();
        running.cycles(200);
        assert!(running.current.iter().any(|current| current.abs() > 1.0));
        running.restart();
        running.steer();
        for frames in [20, 80, 400, 1500] {
            running.cycles(frames);
            running.assert_honest(&format!("{frames} frames later"));
        }
    }
}

/// Four wrong gains, found and told: the settings so far are weighed anew, error bars are those of a campaign.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_better_model_weighs_the_settings_so_far() {
    let effects = effects(&[
        "corrector_gain@H_B8=0.08",
        "corrector_gain@V_C3=-0.1",
        "corrector_gain@H_D2=0.06",
        "corrector_gain@V_E5=0.12",
    ]);
    for seed in [21, 22] {
        let mut running = Running::new(seed, &effects);
        running.campaign();
        running.steer();
        running.cycles(200);
        let (before, _) = running.nees();
        assert!(before > HONEST.end, "the first model would do: NEES/48 {before:.2}");
        running.adopt(&effects);
        running.cycles(50);
        assert!(running.assert_honest("with the better model") < 5e-3);
        // readings against this model, not the former
        assert!(!running.core.fit_quality().is_mismatch());
    }
}

/// A reversed corrector: the first model took its frames for a beam that is lost or moved, so that what is stored of the settings is wrong. The
/// better model tells, by their chi-square, and the error bars become those of the prior.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn settings_that_a_better_model_contradicts_do_not_count() {
    let effects = effects(&["corrector_polarity@V_C3"]);
    for seed in [21, 22] {
        let mut running = Running::new(seed, &effects);
        running.campaign();
        running.steer();
        running.cycles(200);
        running.adopt(&effects);
        running.cycles(20);
        let (nees, sigma) = running.nees();
        assert!(nees < HONEST.end && sigma > 0.02, "NEES/48 {nees:.2}, error bars {:.2} %", 100.0 * sigma);
        running.campaign();
        assert!(running.assert_honest("after another campaign") < 0.01);
    }
}
