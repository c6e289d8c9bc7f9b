//! The leading candidates of the first search, and the correction for their number.

use diagnosis::{Diagnosis, FitError, correction_of, corrections, scan, scan_discrepancies};
use report::{Axes, Figure, Ranked, Section};

use super::location::short;

/// Causes shown.
const LEADING: usize = 15;

/// The leading causes, compared with the model without any effect.
pub fn section(diagnosis: &Diagnosis) -> Result<Section, FitError> {
    let found = &diagnosis.found;
    let (null, data) = (&found.null, &found.data);
    let terms: Vec<_> = found.next.scanned.iter().map(|candidate| candidate.term).collect();
    let scanned = match found.competitions.len() {
        0 => found.next.scanned.clone(),
        1 if found.best.hypothesis.element.is_none() => found.competitions[0].scanned.clone(),
        _ => scan(null.data(data), null, &terms)?,
    };
    let count = scanned.len();
    let library = scanned.into_iter().zip(corrections(&terms)).map(|(candidate, correction)| {
        let (kind, names) = (candidate.term.kind.word().replace('_', " "), candidate.term.site.names(&data.ring));
        let place = names.join(", ");
        Ranked { label: format!("{kind} {place}"), group: 0, value: candidate.log_bayes, threshold: Some(correction) }
    });
    let discrepancies = scan_discrepancies(data, null, f64::INFINITY)?;
    let sites = discrepancies.len();
    let unmodelled = discrepancies.iter().map(|one| {
        let label = format!("unmodelled: {}", short(&one.at, data));
        Ranked { label, group: 1, value: one.log_bayes, threshold: Some(correction_of(one)) }
    });
    let mut all: Vec<Ranked> = library.chain(unmodelled).collect();
    all.sort_by(|one, other| other.value.total_cmp(&one.value));
    all.truncate(LEADING);
    let title = match all.first() {
        Some(first) => format!("First search: {} leads with {:.1} nat", first.label, first.value),
        None => "First search".into(),
    };
    let axes = Axes::new(
        &title,
        "ln Bayes factor over the model without any effect [nat]",
        "correction for the number of candidates: even odds against chance",
    );
    Ok(Section {
        heading: "Evidence".into(),
        text: vec![format!(
            "{count} candidates, every effect of the library at every place, and {sites} locations of an unmodelled discrepancy, each alone \
             with the vars and to first order. Among so many, some stand out by chance: the correction for the number of candidates is \
             the logarithm of the prior odds against a candidate, where the evidence gives even odds against chance. When one effect is \
             large, others imitate it and rank close behind; the exact fits in the table of findings separate them."
        )],
        figures: vec![(
            format!(
                "The {LEADING} causes with the largest evidence; the tick of each is its correction, which is larger where a kind has more places."
            ),
            Figure::ranking(&axes, &["effects of the library", "unmodelled discrepancy"], &all),
        )],
        ..Section::default()
    })
}
