//! One var by itself: its likelihood with all others held, and its posterior under every prior.

use super::{Bench, SINGLE, Sampled};
use inference::posterior::{Posterior, RANGE, Width};
use inference::readings::Readings;
use report::{Axes, Figure, Section, Series};

/// Points of the likelihood.
const POINTS: usize = 121;
const BINS: usize = 40;

/// D8 alone.
pub fn study(bench: &Bench, by_width: &[(&'static str, Sampled)]) -> Section {
    let names = bench.names();
    let var = names.iter().position(|name| name == SINGLE).unwrap_or(0);
    let density = |(word, sampled): &(&'static str, Sampled)| {
        let (x, y) = sampled.density(var, BINS);
        Series::line(&format!("prior {word}"), x, y)
    };
    let posteriors: Vec<Series> = by_width.iter().map(density).collect();
    let likelihood = likelihood(bench, var);
    let below: Vec<String> =
        by_width.iter().map(|(word, sampled)| format!("{} (prior {word})", share_below_one(sampled, var))).collect();
    let x_label = format!("var of {} [1]", names[var]);
    Section {
        heading: format!("{} alone", names[var]),
        text: vec![format!(
            "Likelihood: all frames, every other var at its MAP, scaled to an area of 1. Posteriors: marginals of one subset of -22 to \
             +22 A. Share of the draws below 1: {}.",
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
fn likelihood(bench: &Bench, var: usize) -> Series {
    let readings = Readings::of_frames(&bench.campaign, &bench.twin);
    let posterior = Posterior { model: bench.twin.clone(), readings, width: Width::Loguniform };
    let best = &bench.campaign.fit.map_params;
    let at = |v: f64| {
        let mut params = best.clone();
        params[var] = v.ln();
        posterior.of_params(&params).map_or(f64::NEG_INFINITY, |(value, _)| value)
    };
    // within five of its own widths, found from the curvature at the best point
    let (centre, step) = (best[var].exp().clamp(RANGE[0] + 1e-3, RANGE[1] - 1e-3), 1e-4);
    let curvature = (2.0 * at(centre) - at(centre + step) - at(centre - step)) / (step * step);
    let reach = (5.0 / curvature.max(1.0).sqrt()).min(RANGE[1] - RANGE[0]);
    let x: Vec<f64> = (0..POINTS)
        .map(|i| centre + reach * (2.0 * i as f64 / (POINTS as f64 - 1.0) - 1.0))
        .filter(|v| (RANGE[0]..=RANGE[1]).contains(v))
        .collect();
    let logs: Vec<f64> = x.iter().map(|v| at(*v)).collect();
    let top = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let heights: Vec<f64> = logs.iter().map(|l| (l - top).exp()).collect();
    let area = heights.iter().sum::<f64>() * (x[x.len() - 1] - x[0]) / (x.len() as f64 - 1.0);
    Series::line("likelihood", x, heights.into_iter().map(|h| h / area).collect())
}
