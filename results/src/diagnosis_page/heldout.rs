//! Predictions of frames that the model was not fitted to.

use diagnosis::{Diagnosis, Score};
use report::{Section, Table};

use super::{signed, table};

/// What is expected within one and two standard deviations.
const INSIDE: [f64; 2] = [0.6827, 0.9545];

/// By repeat, and by corrector.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let mut tables =
        vec![scores("One run of frames of one setting left out at a time.", &diagnosis.before, &diagnosis.after)];
    let note = match &diagnosis.correctors {
        Some((before, after)) => {
            tables.push(scores("All frames of one corrector left out at a time.", before, after));
            ""
        }
        None if !diagnosis.found.has_more() => "",
        None => {
            " Whole correctors were not held out: an effect of one corrector does not appear in the frames of the others."
        }
    };
    Section {
        heading: "Held-out frames".into(),
        text: vec![format!(
            "Frames are left out in folds, the model is fitted to the rest and predicts them, with the uncertainty of vars, amplitudes and \
             baselines. A real effect improves the prediction; one that fits only noise does not. Too few readings within \
             one or two standard deviations would mean that the error bars are too small, too many that they are too large.{note}"
        )],
        tables,
        ..Section::default()
    }
}

fn scores(caption: &str, before: &Score, after: &Score) -> Table {
    let (gain, error) = after.gain_over(before);
    let band = |p: f64, n: usize| {
        let half = 1.96 * (p * (1.0 - p) / n.max(1) as f64).sqrt();
        format!("{:.3} to {:.3}", p - half, p + half)
    };
    let row = |name: &str, one: &Score, gain: String| {
        [
            name.to_owned(),
            one.log_density.len().to_string(),
            format!("{:.1}", one.rms * 1e6),
            format!("{:.1}", one.elpd()),
            gain,
            format!("{:.3}", one.inside[0]),
            format!("{:.3}", one.inside[1]),
        ]
    };
    let same = before.log_density == after.log_density;
    let mut rows = vec![row(if same { "the model" } else { "without any effect" }, before, "0".into())];
    if !same {
        rows.push(row("with the effects found", after, format!("{} ± {error:.1}", signed(gain, 1))));
    }
    let n = before.log_density.len();
    let empty = String::new();
    rows.push([
        "expected of correct error bars".into(),
        n.to_string(),
        empty.clone(),
        empty.clone(),
        empty,
        band(INSIDE[0], n),
        band(INSIDE[1], n),
    ]);
    let header =
        ["model", "readings", "rms [µm]", "log predictive density [nat]", "gain [nat]", "within 1 σ", "within 2 σ"];
    let caption = format!(
        "{caption} Rms of monitors in state ok; the gain has its standard error over readings; the last row is the 95 % band of the \
         binomial distribution for independent readings."
    );
    table(&caption, header, rows)
}
