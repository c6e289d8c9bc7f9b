//! The undecided causes, and the measurement that would separate them.

use diagnosis::{Diagnosis, FitError, Verdict};
use report::Section;

use super::table;

/// Alternatives of the leading findings, and the possible measurements.
pub fn section(diagnosis: &Diagnosis) -> Result<Section, FitError> {
    let mut section = Section { heading: "What to measure next".into(), ..Section::default() };
    section.text.push(match &diagnosis.next_measurement {
        Some(next) => format!("{}.", next.trim_end_matches('.')),
        None => settled(diagnosis.verdict).into(),
    });
    if let Some((menu, [one, other])) = diagnosis::menu(&diagnosis.found.data, &diagnosis.found, diagnosis.verdict)? {
        let row = |what: &str, separation: f64| [what.to_owned(), format!("{separation:.1}")];
        let mut rows = vec![row("none: the present campaign alone", menu.present)];
        rows.extend(menu.proposals.iter().map(|proposal| row(&proposal.what, proposal.separation)));
        let caption = format!(
            "How well one more campaign of the same length would separate {one} from {other}: expected ln Bayes factor of both campaigns \
             together, if the first is true."
        );
        section.tables.push(table(&caption, ["second campaign", "expected ln Bayes factor [nat]"], rows));
    }
    let mut rows = Vec::new();
    for finding in diagnosis.findings.iter().filter(|finding| finding.probability < diagnosis::DECISIVE) {
        for one in core::iter::once(finding).chain(&finding.alternatives) {
            rows.push([
                one.phrase.clone(),
                format!("{:.3}", one.probability),
                format!("{:+.1}", one.log_evidence_gain),
            ]);
        }
    }
    if !rows.is_empty() {
        let caption = "Undecided causes, with their probabilities.";
        section.tables.push(table(caption, ["cause", "probability", "ln evidence gain"], rows));
    }
    Ok(section)
}

/// The text where no measurement is proposed.
fn settled(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Consistent => "Nothing was found, so that there are no causes to separate.",
        Verdict::Identified => {
            "The effects found are decided; no further measurement is needed to separate them from others."
        }
        Verdict::Ambiguous | Verdict::Unexplained => {
            "The library holds no second cause, so that no campaign can be computed that separates two. If the location is one \
             instrument, exchange it, or its electronics, and repeat the campaign."
        }
    }
}
