//! One var by itself: its likelihood with all others held, and its posterior under every prior.

use inference::{Posterior, Readings, TuneUse, Width};
use report::{Axes, Figure, Section, Series};

use super::Sampled;
use super::prior::{ByWidth, data};
use super::sampling::Sampling;
use super::subsets::Subsets;

/// Points of the likelihood.
const POINTS: usize = 121;
const BINS: usize = 40;

/// One var alone.
pub fn study(sampling: &Sampling, subsets: &Subsets, by_width: &ByWidth, var: usize) -> Section {
    let names = sampling.names();
    let density = |(word, sampled): &(&'static str, Sampled)| {
        let (x, y) = sampled.density(var, BINS);
        Series::line(&format!("prior {word}"), x, y)
    };
    let posteriors: Vec<Series> = by_width.iter().map(density).collect();
    let likelihood = likelihood(sampling, var);
    let below: Vec<String> =
        by_width.iter().map(|(word, sampled)| format!("{} (prior {word})", share_below_one(sampled, var))).collect();
    let x_label = format!("var of {} [1]", names[var]);
    Section {
        heading: format!("{} alone", names[var]),
        text: vec![format!(
            "{} is the var that is farthest from its design, in its error bars. Likelihood: all frames, every other var at its MAP, \
             scaled to an area of 1. Posteriors: marginals from {}. Share of the draws below 1: {}.",
            names[var],
            data(subsets),
            below.join(", ")
        )],
        figures: vec![
            (
                format!("Likelihood of {} with the other vars at the MAP.", names[var]),
                Figure::densities(
                    &Axes::new("Likelihood with all other vars held", &x_label, "density [1]"),
                    &[likelihood],
                ),
            ),
            (
                format!("Marginal posterior of {} under every prior.", names[var]),
                Figure::densities(&Axes::new("Marginal posteriors", &x_label, "density [1]"), &posteriors),
            ),
        ],
        ..Section::default()
    }
}

fn share_below_one(sampled: &Sampled, var: usize) -> String {
    let below = sampled.vars.column(var).iter().filter(|v| **v < 1.0).count();
    format!("{:.1} %", 100.0 * below as f64 / sampled.vars.nrows() as f64)
}

/// The likelihood of all frames along one var, where there is a ring.
fn likelihood(sampling: &Sampling, var: usize) -> Series {
    let readings = Readings::of_frames(&sampling.reduced, &sampling.twin, TuneUse::LeftOut);
    let prior = sampling.prior(Some(Width::Loguniform));
    let [lower, upper] = prior.range[var].map(f64::exp);
    let posterior = Posterior::new(sampling.twin.clone(), readings, prior);
    let best = &sampling.reduced.fit.map_params;
    let at = |v: f64| {
        let mut params = best.clone();
        params[var] = v.ln();
        posterior.of_params(&params).map_or(f64::NEG_INFINITY, |(value, _)| value)
    };
    // within five of its own widths, found from the curvature at the best point
    let (centre, step) = (best[var].exp().clamp(lower + 1e-3, upper - 1e-3), 1e-4);
    let curvature = (2.0 * at(centre) - at(centre + step) - at(centre - step)) / (step * step);
    let reach = (5.0 / curvature.max(1.0).sqrt()).min(upper - lower);
    let x: Vec<f64> = (0..POINTS)
        .map(|i| centre + reach * (2.0 * i as f64 / (POINTS as f64 - 1.0) - 1.0))
        .filter(|v| (lower..=upper).contains(v))
        .collect();
    let logs: Vec<f64> = x.iter().map(|v| at(*v)).collect();
    let top = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let heights: Vec<f64> = logs.iter().map(|l| (l - top).exp()).collect();
    let area = heights.iter().sum::<f64>() * (x[x.len() - 1] - x[0]) / (x.len() as f64 - 1.0);
    Series::line("likelihood", x, heights.into_iter().map(|h| h / area).collect())
}
