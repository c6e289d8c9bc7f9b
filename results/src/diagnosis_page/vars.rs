//! The quadrupoles' strength factors without and with the effects.

use diagnosis::{Diagnosis, Vars};
use nalgebra::DVector;
use report::{Axes, Band, Figure, Reference, Section};

/// Standard deviations of the 95 % interval.
const OUTER: f64 = 1.96;

/// All vars, before and after.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let (before, after) = (&diagnosis.vars_before, &diagnosis.vars_after);
    let names = diagnosis.found.data.ring.var_names();
    let moved: DVector<f64> = (&after.mean - &before.mean).component_div(&before.covariance.diagonal().map(f64::sqrt));
    let most = moved.iamax();
    let change = moved[most].abs();
    let title = format!("{} changes most, by {change:.1} of its standard deviations", names[most]);
    let axes = Axes::new(&title, "quadrupole", "var [1]").named(&names).compared(Reference::Level(1.0));
    let mean = |vars: &Vars| 100.0 * vars.covariance.diagonal().map(f64::sqrt).mean();
    Section {
        heading: "Quadrupoles before and after".into(),
        text: vec![format!(
            "The strength factor (var) of a quadrupole multiplies its gradient. Missing physics biases the vars, which absorb as much of it as they can. \
             Mean standard deviation {:.2} % before, {:.2} % after; {} changes most, by {:.1} of its standard deviations. After is \
             model-averaged over the competing causes.",
            mean(before),
            mean(after),
            names[most],
            change
        )],
        figures: vec![(
            "Each quadrupole's strength over its design, focusing ones above, defocusing ones below, without any effect (before) and averaged over \
             the competing causes (after). Bars 68 %, lines 95 %."
                .into(),
            Figure::bands(&axes, &[band("before", before), band("after", after)]),
        )],
        ..Section::default()
    }
}

fn band(label: &str, vars: &Vars) -> Band {
    let sigma = vars.covariance.diagonal().map(f64::sqrt);
    let within = |factor: f64| {
        let ends = |(mean, sigma): (&f64, &f64)| ((mean - factor * sigma).exp(), (mean + factor * sigma).exp());
        vars.mean.iter().zip(sigma.iter()).map(ends).collect()
    };
    Band {
        label: label.into(),
        centre: vars.mean.iter().map(|mean| mean.exp()).collect(),
        inner: within(1.0),
        outer: within(OUTER),
    }
}
