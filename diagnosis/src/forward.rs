//! The fit's machine against exact closed orbits of a misaligned one: what its error makes of an amplitude, in standard deviations.

use std::sync::Mutex;

use nalgebra::DVector;
use twin::{ClosedOrbit, Effect, EffectError, EffectKind, Hold, Machine, Rf, Ring};

use crate::data::Data;
use crate::fit::Fitted;
use crate::hypothesis::{Hypothesis, Term};
use crate::scan::{Candidate, candidates, scan};
use crate::testing::template;
use inference::Campaign;
use inference::recording::Recording;
use inference::simulate::{self, Beyond, Hardware, Truth};

/// Hears of the misaligned ring.
#[derive(Default)]
struct Misaligned(Mutex<Option<Ring>>);

impl Beyond for Misaligned {
    fn alter_ring(&self, ring: &mut Ring) {
        *self.0.lock().unwrap() = Some(ring.clone());
    }
}

/// A standard campaign of a misaligned machine, and the noise of it.
struct Standard {
    ring: Ring,
    template: Recording,
    hardware: Hardware,
    seed: u64,
    noisy: Recording,
    clean: Recording,
}

impl Standard {
    fn of(seed: u64) -> Self {
        let (ring, template) = template();
        let hardware = Hardware { jumps: Vec::new(), ..Hardware::shipped(&ring, &template) };
        let mut standard = Self { noisy: template.clone(), clean: template.clone(), ring, template, hardware, seed };
        let quiet = standard.quiet();
        standard.noisy = standard.made(&[], &standard.hardware).unwrap().0;
        standard.clean = standard.made(&[], &quiet).unwrap().0;
        standard
    }

    fn quiet(&self) -> Hardware {
        Hardware { noise: vec![0.0; self.hardware.noise.len()], tune_noise: 0.0, ..self.hardware.clone() }
    }

    fn made(&self, effects: &[Effect], hardware: &Hardware) -> Result<(Recording, Ring), EffectError> {
        let misaligned = Misaligned::default();
        let vars = vec![1.0; self.ring.parameters.len()];
        let truth = Truth { vars: &vars, effects, beyond: &[&misaligned] };
        let made = simulate::campaign(&self.template, &self.ring, &truth, hardware, self.seed)?;
        Ok((made, misaligned.0.into_inner().unwrap().unwrap()))
    }

    /// The readings of a machine with an effect, noise known and taken out, on the orbit that it really has.
    fn data(&self, effect: Effect) -> Option<Data> {
        let (mut recording, ring) = self.made(&[effect], &self.quiet()).ok()?;
        let noise = |i: usize, b: usize| {
            self.noisy.rows[i].reading[b].zip(self.clean.rows[i].reading[b]).map_or(0.0, |(a, b)| a - b)
        };
        let tune_noise = |i: usize, plane: usize| {
            self.noisy.rows[i].tune[plane].zip(self.clean.rows[i].tune[plane]).map_or(0.0, |(a, b)| a - b)
        };
        for (i, row) in recording.rows.iter_mut().enumerate() {
            row.reading.iter_mut().enumerate().for_each(|(b, r)| *r = r.map(|r| r + noise(i, b)));
            row.tune.iter_mut().enumerate().for_each(|(plane, t)| *t = t.map(|t| t + tune_noise(i, plane)));
        }
        let data = Data::of(&Campaign::of(&self.ring, &recording).ok()?).ok()?;
        let n = recording.rows.len();
        let readings = nalgebra::DMatrix::from_fn(n, self.hardware.noise.len(), noise);
        let tunes = nalgebra::DMatrix::from_fn(n, 2, tune_noise);
        let mut data = data.less(&readings, &tunes);
        let real = Machine::new(ring, Rf::FixedMomentum, &[effect]).ok()?;
        let delta = if effect.kind == EffectKind::MomentumOffset { effect.amplitude } else { 0.0 };
        let orbit = ClosedOrbit::find(real.ring(), Hold::Momentum { delta }).ok()?;
        for (to, at) in data.drives.orbit.iter_mut().zip(&orbit.at) {
            *to = [at[0], at[2]];
        }
        Some(data)
    }

    /// Error of the fitted amplitude, and of the chi-square.
    fn bias(&self, effect: Effect) -> Option<[f64; 4]> {
        let mut data = self.data(effect)?;
        let hypothesis = Hypothesis::default().with(Term::from(effect));
        let scale = effect.kind.prior_scale()?;
        let mut guess = DVector::zeros(data.units.len() + 1);
        guess[data.units.len()] = effect.amplitude / scale;
        let mut fitted = Fitted::of(&data, &hypothesis, &guess).ok()?;
        for _ in 0..3 {
            data.linearise_about(&fitted.machine(&data).ok()?.0).ok()?;
            fitted = Fitted::of(&data, &hypothesis, &fitted.u).ok()?;
        }
        let (amplitude, sigma) = fitted.amplitude(&data, 0);
        let expected = effect.amplitude * (1.0 - (sigma / scale).powi(2));
        Some([(amplitude - expected) / sigma, amplitude, sigma, fitted.residual.norm_squared()])
    }
}

fn best_seen(data: &Data) -> Vec<Candidate> {
    let pair = ["x_D8".to_owned(), "x_E6".to_owned()];
    let null = Fitted::of(data, &Hypothesis::default(), &DVector::zeros(data.units.len())).unwrap();
    scan(data, &null, &candidates(data, Some(&pair))).unwrap()
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn explore() {
    let standard = Standard::of(5);
    let data = Data::of(&Campaign::of(&standard.ring, &standard.noisy).unwrap()).unwrap();
    let scanned = best_seen(&data);
    let only = std::env::var("KIND").ok();
    for &kind in EffectKind::ALL {
        if only.as_deref().is_some_and(|only| only != kind.word()) {
            continue;
        }
        let Some(scale) = kind.prior_scale() else { continue };
        let mut of_kind: Vec<&Candidate> = scanned.iter().filter(|c| c.term.kind == kind).collect();
        of_kind.sort_by(|a, b| b.power.total_cmp(&a.power));
        for candidate in [of_kind[0], of_kind[of_kind.len() / 3]].iter().take(of_kind.len().min(2)) {
            print!("{:32}", candidate.term.label(&standard.ring));
            std::thread::scope(|scope| {
                let runs: Vec<_> = [-2.5, -1.0, -0.5, 0.5, 1.0, 2.5]
                    .map(|size| {
                        scope.spawn({
                            let s = &standard;
                            move || s.bias(candidate.term.effect(size * scale))
                        })
                    })
                    .into_iter()
                    .collect();
                for run in runs {
                    match run.join().unwrap() {
                        Some([bias, _, _, chi]) => print!(" {bias:7.2} ({chi:6.1})"),
                        None => print!("    -            "),
                    }
                }
            });
            println!();
        }
    }
}

#[test]
fn folders() {
    let ring = Ring::booster();
    let Ok(all) = std::env::var("FOLDERS") else { return };
    for folder in all.split_whitespace() {
        let started = std::time::Instant::now();
        let Ok(recording) = Recording::read(std::path::Path::new(folder), &ring) else {
            println!("{folder}: unreadable");
            continue;
        };
        match crate::Diagnosis::of(&ring, &recording, |_| ()) {
            Ok(made) => {
                let truth = crate::score::Truth::read(std::path::Path::new(folder), &ring).ok();
                let nees = truth.as_ref().map(|t| t.nees(&ring.var_names(), &made.vars_after));
                let pulls = truth.map(|t| t.pulls(&made));
                println!(
                    "{folder}: {} {} {pulls:?} nees {nees:?} {:.1} s",
                    made.verdict.word(),
                    made.sentence,
                    started.elapsed().as_secs_f64()
                );
                for f in &made.findings {
                    println!("     {} {:?} P {:.3}", f.label(), f.amplitude, f.probability);
                }
            }
            Err(error) => println!("{folder}: ERROR {error}"),
        }
    }
}
