//! The reference: is the density the recording's, is NUTS converged on it, and is the core's Laplace approximation the posterior?

use core::ops::ControlFlow::Continue;
use std::sync::Arc;

use estimator::{Marginal, Walk};
use inference::nuts::{self, NutsRun, NutsSettings};
use inference::simulate::{self, Instruments};
use inference::stream::{self, Core};
use inference::{
    BaseModel, BatchFit, Campaign, Posterior, Prior, Readings, Recording, Reduced, ResponseModel, TuneUse, Width,
};
use nalgebra::DMatrix;
use studies::{self, Kind, Options, Sampled, Subset};
use system_tests::recording;
use twin::Ring;

fn reduced(ring: &Ring, recording: &Recording) -> Reduced {
    let campaign = Campaign::of(ring, recording).unwrap();
    let fit = BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ()).unwrap();
    Reduced::from_fit(campaign, fit).unwrap()
}

fn posterior(reduced: &Reduced, model: ResponseModel) -> Posterior {
    let readings = Readings::of_frames(reduced, &model, TuneUse::Readings);
    Posterior::new(model, readings, reduced.campaign.prior.clone())
}

fn sample(reduced: &Reduced, posterior: Posterior, settings: NutsSettings) -> NutsRun {
    let laplace = posterior.laplace(&reduced.fit.map_params).unwrap();
    let names = reduced.campaign.ring.var_names();
    nuts::sample(Arc::new(posterior), Arc::new(laplace), &names, settings, |_| Continue(())).unwrap()
}

/// Twin and surrogate, all frames and the paper's pairs, both priors: in the coordinates that the sampler's are made of, a
/// third of an error bar from the MAP.
#[test]
fn the_gradient_is_that_of_the_density() {
    let (ring, recording) = recording("paper-vars");
    let reduced = reduced(&ring, &recording);
    let pairs = Subset::draw(&reduced.campaign, Kind::MinusToPlus, 1).pairs;
    for model in [ResponseModel::twin(&ring).unwrap(), ResponseModel::green(&ring).unwrap()] {
        let frames = Readings::of_frames(&reduced, &model, TuneUse::Readings);
        let modes = [frames, Readings::of_pairs(&reduced, |b| model.stated_error(b), &pairs)];
        for (readings, width) in modes.into_iter().zip([Width::Lognormal(0.03), Width::Loguniform]) {
            let posterior = Posterior::new(model.clone(), readings, Prior::of_width(&ring, width));
            let laplace = posterior.laplace(&reduced.fit.map_params).unwrap();
            let z: Vec<f64> = (0..48).map(|i| 0.33 * f64::sin(1.7 * f64::from(i))).collect();
            let u = laplace.unbounded(&z);
            let (_, gradient) = posterior.of_unbounded(u.as_slice()).unwrap();
            let typical = gradient.iter().map(|g| g.abs()).sum::<f64>() / 48.0;
            for (i, slope) in gradient.iter().enumerate() {
                let value = |step: f64| {
                    let mut u = u.clone();
                    u[i] += step;
                    posterior.of_unbounded(u.as_slice()).unwrap().0
                };
                // fourth order in a step of a tenth of an error bar; values of 6e3 round at 1e-12 of themselves
                let h = 2e-4;
                let difference = (8.0 * (value(h) - value(-h)) - value(2.0 * h) + value(-2.0 * h)) / (12.0 * h);
                let error = (slope - difference).abs() / slope.abs().max(typical);
                assert!(error < 1e-6, "{} {:?}, {i}: {slope} {difference}", model.word(), width);
            }
        }
    }
}

/// The density's best point is the batch fit's, which sums over frames with their own read-backs: what the reduction to
/// quadratic forms leaves out is small. Measured: 0.009 of an error bar at most (both stop short of the last step).
#[test]
fn the_reduced_density_has_the_batch_fits_maximum() {
    for name in ["paper-vars", "random-vars"] {
        let (ring, recording) = recording(name);
        let reduced = reduced(&ring, &recording);
        let (posterior, fit) = (posterior(&reduced, ResponseModel::twin(&ring).unwrap()), &reduced.fit);
        let (value, gradient) = posterior.of_params(&fit.map_params).unwrap();
        // a Newton step from the batch fit's MAP, in its own error bars
        let step = &fit.covariance * nalgebra::DVector::from_vec(gradient);
        let moved = (0..48).map(|i| step[i].abs() / fit.covariance[(i, i)].sqrt()).fold(0.0, f64::max);
        assert!(moved < 0.02, "{name}: {moved:.4} at {value}");
    }
}

/// R-hat, effective sample sizes and divergences of the reference, and the core's Laplace approximation beside it.
#[test]
#[cfg_attr(debug_assertions, ignore = "a minute unoptimised; the release tests run it")]
fn the_core_is_the_posterior_that_nuts_finds() {
    let (ring, recording) = recording("paper-vars");
    let reduced = reduced(&ring, &recording);
    let run = sample(&reduced, posterior(&reduced, ResponseModel::twin(&ring).unwrap()), NutsSettings::default());
    let reference = Sampled::of(&run.draws);
    assert_eq!(run.draws.divergences(), 0, "{:?}", run.divergences);
    for s in &reference.summary {
        assert!(s.r_hat <= 1.01 && s.ess_bulk >= 4000.0 && s.ess_tail >= 4000.0, "{s:?}");
    }
    let mut core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let mut last = None;
    stream::replay(&mut core, &recording, |_, estimate| last = Some(estimate.clone())).unwrap();
    let last = last.unwrap();
    for (i, s) in reference.summary.iter().enumerate() {
        // each plus three Monte Carlo errors; that of a standard deviation from n normal draws is 1/sqrt(2 n) of it
        let (shift, ratio) = ((f64::from(last.mean[i]) - s.mean) / s.sd, f64::from(last.sigma[i]) / s.sd);
        let error = 3.0 * (0.5 / s.ess_tail).sqrt();
        assert!(shift.abs() < 0.15 + 3.0 * s.mcse_mean / s.sd, "{}: mean off by {shift:.3} sigma", s.name);
        assert!((0.95 - error..1.05 + error).contains(&ratio), "{}: sigma ratio {ratio:.3}", s.name);
    }
    let sigma: Vec<f64> = (0..48).map(|i| f64::from(core.covariance(i, i)).sqrt()).collect();
    let own = DMatrix::from_fn(48, 48, |i, j| f64::from(core.covariance(i, j)) / (sigma[i] * sigma[j]));
    let correlation = reference.correlation();
    let n = reference.summary.iter().map(|s| s.ess_tail).fold(f64::INFINITY, f64::min);
    for i in 0..48 {
        for j in 0..i {
            // a correlation from n normal draws is known to (1 - r^2)/sqrt(n)
            let error = 3.0 * (1.0 - correlation[(i, j)].powi(2)) / n.sqrt();
            let difference = (own[(i, j)] - correlation[(i, j)]).abs();
            assert!(difference < 0.05 + error, "{i} {j}: correlations differ by {difference:.3}");
        }
    }
}

/// Share of vars inside a band, campaign by campaign: its mean, and the 99 % limits that the spread between campaigns gives
/// it. The vars of one campaign are correlated, so that campaigns are what is counted.
fn assert_covered(what: &str, nominal: f64, inside: &[f64]) {
    let n = inside.len() as f64;
    let mean = inside.iter().sum::<f64>() / n;
    let spread = (inside.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / (n - 1.0) / n).sqrt();
    // two-sided 99 % of Student's distribution with 99 or 9 degrees of freedom
    let limit = if n > 50.0 { 2.63 } else { 3.25 } * spread;
    assert!((mean - nominal).abs() < limit, "{what}: {mean:.4} +- {spread:.4} inside the {nominal} band");
}

/// Simulated campaigns with vars from the truncated prior, their ring within the tune cut or not.
fn simulated(count: usize, tune_cut: bool, seed: u64) -> impl Iterator<Item = (Ring, Recording, Vec<f64>)> {
    let (ring, recording) = recording("paper-vars");
    let instruments = Instruments::healthy(&ring, &recording).unwrap();
    simulate::seeds(seed).take(count).map(move |seed| {
        let vars = simulate::vars(&ring, tune_cut, seed).unwrap();
        let made = simulate::like(&recording, &ring, &vars, &instruments, seed).unwrap();
        (ring.clone(), made, vars)
    })
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes unoptimised; the release tests run it")]
fn error_bars_of_the_core_cover_a_hundred_simulated_truths() {
    let (ring, recording) = recording("paper-vars");
    let fresh: Core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    for tune_cut in [false, true] {
        let mut inside = [Vec::new(), Vec::new()];
        for (_, made, vars) in simulated(100, tune_cut, 7) {
            let (mut core, mut last) = (fresh.clone(), None);
            stream::replay(&mut core, &made, |_, estimate| last = Some(estimate.clone())).unwrap();
            let last = last.unwrap();
            let marginal = |i: usize| {
                let estimator::Prior { lower, upper, .. } = core.setup.priors[core.tables.prior_group(i)];
                Marginal { mean: last.centre[i], sigma: last.params_sigma[i], lower, upper }
            };
            let marginals: Vec<Marginal> = (0..48).map(marginal).collect();
            for (inside, tail) in inside.iter_mut().zip([0.16, 0.025]) {
                let covers = |(m, var): &(&Marginal, &f64)| {
                    (f64::from(m.quantile(tail))..f64::from(m.quantile(1.0 - tail))).contains(*var)
                };
                inside.push(marginals.iter().zip(&vars).filter(covers).count() as f64 / 48.0);
            }
        }
        let what = format!("Laplace, tune cut {tune_cut}");
        assert_covered(&what, 0.68, &inside[0]);
        assert_covered(&what, 0.95, &inside[1]);
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes unoptimised; the release tests run it")]
fn error_bars_of_nuts_cover_ten_simulated_truths() {
    let settings = NutsSettings { warm_up: 400, draws: 500, ..NutsSettings::default() };
    for tune_cut in [false, true] {
        let mut inside = [Vec::new(), Vec::new()];
        for (ring, made, vars) in simulated(10, tune_cut, 11) {
            let reduced = reduced(&ring, &made);
            let run = sample(&reduced, posterior(&reduced, ResponseModel::twin(&ring).unwrap()), settings);
            let summary = run.draws.summary();
            let count = |low: fn(&inference::Summary) -> f64, high: fn(&inference::Summary) -> f64| {
                summary.iter().zip(&vars).filter(|(s, var)| (low(s)..high(s)).contains(*var)).count() as f64 / 48.0
            };
            inside[0].push(count(|s| s.q16, |s| s.q84));
            inside[1].push(count(|s| s.q025, |s| s.q975));
        }
        let what = format!("NUTS, tune cut {tune_cut}");
        assert_covered(&what, 0.68, &inside[0]);
        assert_covered(&what, 0.95, &inside[1]);
    }
}

/// The studies on the recording that has the paper's vars, each posterior with a few hundred draws.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes unoptimised; the release tests run it")]
fn the_studies_make_a_report_and_find_d8_below_unity() {
    let (ring, recording) = recording("paper-vars");
    let nuts = NutsSettings { chains: 2, warm_up: 200, draws: 300, seed: 3 };
    let made = studies::run(&ring, &recording, Options { nuts }, &mut |_, _, _| ()).unwrap();
    let d8 = ring.var_names().iter().position(|name| name == "D8").unwrap();
    assert_eq!(made.numbers.subsets.len(), 20);
    for subset in &made.numbers.subsets {
        // one difference between 0 and 22 A has half the kick: D8 is then within two of its own error bars of 1
        let bound = if subset.kind == "-22 A to +22 A" { subset.vars[d8].q84 } else { subset.vars[d8].mean };
        assert!(bound < 1.0, "{}: {:?}", subset.kind, subset.vars[d8]);
    }
    // jumps of B5 by millimetres, and C6 where it leaves even its own noise
    assert!(
        !made.numbers.faults.is_empty()
            && made.numbers.faults.iter().all(|f| ["y_B5", "x_C6"].contains(&f.monitor.as_str()))
    );
    let html = made.page.render();
    assert!(made.page.sections.iter().all(|s| !s.figures.is_empty() || !s.tables.is_empty()));
    for name in ring.var_names() {
        assert!(html.contains(&name), "{name}");
    }
}
