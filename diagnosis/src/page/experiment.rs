//! What is not settled, and the measurement that would settle it.

use crate::fit::FitError;

use super::table;
use crate::{Diagnosis, Verdict, verdict};
use report::Section;

/// Alternatives of the leading findings, and the menu.
pub fn section(diagnosis: &Diagnosis) -> Result<Section, FitError> {
    let mut section = Section { heading: "What to measure next".into(), ..Section::default() };
    section.text.push(match &diagnosis.next_measurement {
        Some(next) => format!("{}.", next.trim_end_matches('.')),
        None => settled(diagnosis.verdict).into(),
    });
    if let Some((menu, [one, other])) = verdict::menu(&diagnosis.found.data, &diagnosis.found, diagnosis.verdict)? {
        let row = |what: &str, separation: f64| [what.to_owned(), format!("{separation:.1}")];
        let mut rows = vec![row("none: what the present one can be expected to say", menu.present)];
        rows.extend(menu.proposals.iter().map(|proposal| row(&proposal.what, proposal.separation)));
        let caption = format!(
            "How far one more campaign of the same length would take {one} apart from {other}: ln Bayes factor expected of both campaigns together, \
             if the first is true."
        );
        section.tables.push(table(&caption, ["second campaign", "expected ln Bayes factor [nat]"], rows));
    }
    let mut rows = Vec::new();
    for finding in diagnosis.findings.iter().filter(|finding| finding.probability < crate::alternatives::DECISIVE) {
        for one in core::iter::once(finding).chain(&finding.alternatives) {
            rows.push([
                one.phrase.clone(),
                format!("{:.3}", one.probability),
                format!("{:+.1}", one.log_evidence_gain),
            ]);
        }
    }
    if !rows.is_empty() {
        let caption = "What is not decided: every cause of some weight, in words.";
        section.tables.push(table(caption, ["cause", "probability", "ln evidence gain"], rows));
    }
    Ok(section)
}

/// What is said where there is nothing to propose.
fn settled(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Consistent => "Nothing is missing, and nothing has to be told apart.",
        Verdict::Identified => {
            "What was found is decided; no further measurement is needed to tell it from anything else."
        }
        Verdict::Ambiguous | Verdict::Unexplained => {
            "The library has no second cause to tell the first one from, so no campaign can be computed that would. What is found at one              instrument is best looked for there: exchange it, or its electronics, and repeat the campaign."
        }
    }
}
