//! The findings, each with its alternatives.

use diagnosis::{Diagnosis, Finding, FitError, Tested, Verdict};
use report::Section;

use super::{decisive, signed, slope, table};

/// Alternatives listed below a finding.
const ALTERNATIVES: usize = 5;

/// Verdict, decisive pictures, findings.
pub fn section(diagnosis: &Diagnosis) -> Result<Section, FitError> {
    let text = vec![format!("Verdict: {}. {}", diagnosis.verdict.word(), meaning(diagnosis))];
    let mut rows = Vec::new();
    for (i, finding) in diagnosis.findings.iter().enumerate() {
        rows.push(row(&format!("{}.", i + 1), finding));
        let or = |other: &Finding| if other.inseparable { "or (inseparable)" } else { "or" };
        rows.extend(finding.alternatives.iter().take(ALTERNATIVES).map(|other| row(or(other), other)));
        rows.extend(finding.parts.iter().map(|part| row("in part", part)));
    }
    let header = ["", "effect", "at", "s [m]", "amplitude", "gain [nat]", "P", "held-out", "of choice", "chance"];
    let caption = "Findings, strongest first, and below each the alternatives that explain the same readings, or the effects that describe a part of something unknown. Gain: of ln evidence over the fit without it; P: \
                   probability among these, corrected for the number of candidates; \
                   held-out, in nat: gain of log predictive density, all effects against all but this one, ± its standard error, and of choice with kind and place chosen without the held-out \
                   readings; chance is the share of searches with nothing missing that find as much.";
    let tables = if rows.is_empty() { Vec::new() } else { vec![table(caption, header, rows)] };
    let figures = decisive::figures(diagnosis)?;
    Ok(Section { heading: "What was found".into(), text, figures, tables })
}

fn meaning(diagnosis: &Diagnosis) -> &'static str {
    match diagnosis.verdict {
        Verdict::Consistent => "Nothing was found at the noise level of the recording.",
        Verdict::Identified => {
            "The effects below are decided: each has a probability of at least 95 %, and frames that it was not fitted to are predicted better with it, by more \
             than two standard errors; where chance is excluded by more than one, or of an instrument at all."
        }
        Verdict::Ambiguous => {
            "Physics may be missing in the model; the data cannot separate the alternatives, or exclude chance."
        }
        Verdict::Unexplained if diagnosis.found.best.is_poor() => {
            "The model does not describe the readings; what is listed is the nearest that was found, and may be wrong."
        }
        Verdict::Unexplained => {
            "The readings contain a discrepancy that no effect of the library describes; its most likely location is given."
        }
    }
}

fn row(before: &str, finding: &Finding) -> [String; 10] {
    let amplitude = match finding.term() {
        Some(_) if finding.amplitude.1 > 0.0 => slope::amplitude(finding),
        Some(_) => "\u{2013}".into(),
        None => format!("{} (rms)", finding.unit().rounded(finding.amplitude.0)),
    };
    let tested = |of: fn(Tested) -> Option<String>| finding.tested.and_then(of).unwrap_or_default();
    [
        before.into(),
        finding.word().into(),
        if finding.at.is_empty() { "whole ring".into() } else { finding.at.clone() },
        finding.s.map_or_else(|| "\u{2013}".into(), |s| format!("{s:.2}")),
        amplitude,
        signed(finding.log_evidence_gain, 1),
        format!("{:.3}", finding.probability),
        tested(|Tested { gain: (gain, error), .. }| Some(format!("{} ± {error:.1}", signed(gain, 1)))),
        tested(|tested| tested.of_choice.map(|gain| signed(gain, 1))),
        tested(|tested| tested.chance.map(|chance| format!("{chance:.3}"))),
    ]
}
