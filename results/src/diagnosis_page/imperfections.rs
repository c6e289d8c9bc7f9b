//! The machine as it is.

use diagnosis::Diagnosis;
use inference::Imperfection;
use report::Section;

use super::table;

/// The ordinary imperfections that the recording shows.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let all = diagnosis.imperfections();
    let rows: Vec<[String; 4]> = all.iter().filter(|one| one.is_seen()).map(Imperfection::row).collect();
    let text = match rows.len() {
        0 => "Nothing beyond two standard deviations.",
        _ => {
            "Every machine has imperfections that are nobody's discovery: noise, scatter of strengths, gains and rolls, common factors. They are part of the \
             model, with these sizes. A kick constant and the gain of all monitors cannot be told apart by kicks alone: the kick constant gets most."
        }
    };
    let header = ["what", "size", "ordinary", ""];
    let tables =
        if rows.is_empty() { Vec::new() } else { vec![table("Ordinary imperfections of the machine.", header, rows)] };
    Section { heading: "The machine as it is".into(), text: vec![text.into()], tables, ..Section::default() }
}
