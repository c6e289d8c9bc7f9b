//! The findings, each with its alternatives.

use crate::error::FitError;

use super::{signed, table};
use crate::{Diagnosis, Finding, Verdict};
use inference::recording::Recording;
use report::Section;

/// Alternatives listed below a finding.
const ALTERNATIVES: usize = 5;

/// Verdict, circumstances, findings.
pub fn section(diagnosis: &Diagnosis, recording: &Recording) -> Result<Section, FitError> {
    let found = &diagnosis.found;
    let next = &found.next;
    let percent = |p: f64| format!("{:.1} %", 100.0 * p);
    let chi2 = [&found.null, &found.best].map(|fitted| fitted.chi2_per_dof(&found.data));
    let [before, after] = [chi2[0].as_ref(), chi2[1].as_ref()].map(|chi2| chi2.map_or(f64::NAN, |chi2| *chi2));
    let minutes = recording.rows.last().map_or(0.0, |last| (last.time - recording.rows[0].time) / 60.0);
    let text = vec![
        format!("Verdict: {}. {}", diagnosis.verdict.word(), meaning(diagnosis.verdict)),
        format!(
            "Recording {}: {} frames in {minutes:.0} minutes, recorded with {}. Expected noise of a reading {:.0} µm. Chi-square per \
             degree of freedom {before:.3} without any effect, {after:.3} with the effects found.",
            recording.name,
            recording.rows.len(),
            recording.header.recorded_with,
            found.data.mean_noise() * 1e6,
        ),
        format!(
            "Probability that no{} effect is missing {}, that an effect of the library is missing {}, that physics outside the library is \
             missing {}.",
            if found.competitions.is_empty() { "" } else { " further" },
            percent(next.nothing),
            percent(next.library()),
            percent(next.unknown()),
        ),
    ];
    let mut rows = Vec::new();
    for (i, finding) in diagnosis.findings.iter().enumerate() {
        rows.push(row(&format!("{}.", i + 1), finding));
        let or = |other: &Finding| if other.inseparable { "or (inseparable)" } else { "or" };
        rows.extend(finding.alternatives.iter().take(ALTERNATIVES).map(|other| row(or(other), other)));
    }
    let header =
        ["", "effect", "at", "s [m]", "amplitude", "unit", "ln evidence gain", "probability", "held-out gain [nat]"];
    let caption = "Findings, strongest first, and below each the alternatives that explain the same readings. The evidence gain \
                   is over the fit without it; the probability is among these, corrected for the number of candidates; \
                   the held-out gain is that of log predictive density, all effects against all but this one, ± its standard error.";
    let tables = if rows.is_empty() { Vec::new() } else { vec![table(caption, header, rows)] };
    Ok(Section { heading: "Findings".into(), text, tables, ..Section::default() })
}

fn meaning(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Consistent => "Nothing was found at the noise level of the recording.",
        Verdict::Identified => {
            "The effects below are decided (probability at least 95 %) and predict frames that they were not fitted to better by more than two \
             standard errors."
        }
        Verdict::Ambiguous => {
            "Physics may be missing in the model; the data cannot separate the alternatives, or exclude chance."
        }
        Verdict::Unexplained => {
            "The readings contain a discrepancy that no effect of the library describes; its most likely location is given."
        }
    }
}

fn row(before: &str, finding: &Finding) -> [String; 9] {
    let (amplitude, sigma) = finding.amplitude;
    let unit = finding.unit();
    let (amplitude, sigma) = (amplitude * unit.factor, sigma * unit.factor);
    let decimals = if sigma > 0.0 { (1.0 - sigma.log10().floor()).clamp(0.0, 7.0) as usize } else { 2 };
    let amplitude = match finding.term() {
        Some(_) if sigma > 0.0 => format!("{} ± {sigma:.decimals$}", signed(amplitude, decimals)),
        Some(_) => "\u{2013}".into(),
        None => format!("{amplitude:.2} (rms)"),
    };
    let gain = finding.heldout.map_or_else(String::new, |(gain, error)| format!("{} ± {error:.1}", signed(gain, 1)));
    [
        before.into(),
        finding.word().into(),
        if finding.at.is_empty() { "whole ring".into() } else { finding.at.clone() },
        finding.s.map_or_else(|| "\u{2013}".into(), |s| format!("{s:.2}")),
        amplitude,
        unit.shown.into(),
        signed(finding.log_evidence_gain, 1),
        format!("{:.3}", finding.probability),
        gain,
    ]
}
