//! The page of a diagnosis for those who operate the machine, from the sentence to the readings that support it.
//!
//! [`page`] lists its sections in order; each is one file.

mod chi2;
mod evidence;
mod experiment;
mod findings;
mod heldout;
mod imperfections;
mod monitors;
mod place;
mod residuals;
mod ring;
mod vars;

use crate::error::FitError;

use super::Diagnosis;
use inference::recording::Recording;
use report::{Page, Section};
use residuals::Residuals;

/// The page of a diagnosis.
///
/// # Errors
/// [`FitError`].
pub fn page(diagnosis: &Diagnosis, recording: &Recording) -> Result<Page, FitError> {
    let found = &diagnosis.found;
    let data = &found.data;
    let mut residuals = vec![Residuals::of("before", data, &found.null)];
    if !found.competitions.is_empty() {
        residuals.push(Residuals::of("after", data, &found.best));
    }
    let sections: Vec<Section> = vec![
        findings::section(diagnosis, recording)?,
        ring::section(diagnosis),
        residuals::section(data, &residuals),
        chi2::section(data, &residuals),
        evidence::section(diagnosis)?,
        place::section(diagnosis)?,
        heldout::section(diagnosis),
        vars::section(diagnosis),
        experiment::section(diagnosis)?,
        imperfections::section(diagnosis),
        monitors::section(diagnosis),
    ];
    Ok(Page {
        title: format!("Missing physics in the model of {}", recording.name),
        lead: format!("{}.", diagnosis.sentence.trim_end_matches('.')),
        sections,
    })
}

/// A table, from texts.
fn table<const N: usize>(caption: &str, header: [&str; N], rows: Vec<[String; N]>) -> report::Table {
    report::Table {
        caption: caption.into(),
        header: header.map(str::to_owned).to_vec(),
        rows: rows.into_iter().map(Vec::from).collect(),
    }
}

/// A number with a true minus sign.
fn signed(value: f64, decimals: usize) -> String {
    format!("{value:+.decimals$}").replace('-', "\u{2212}")
}

#[cfg(test)]
mod tests {
    use twin::Effect;

    use super::*;
    use crate::testing::template;
    use inference::simulate::{Hardware, Truth, campaign};

    #[test]
    fn the_page_leads_from_the_sentence_to_the_readings() {
        let (ring, recording) = template();
        let effects = [Effect::parse("bpm_gain@x_E4=-0.15", &ring).unwrap()];
        let truth = Truth { vars: &[1.0; 48], effects: &effects, ..Truth::default() };
        let made = campaign(&recording, &ring, &truth, &Hardware::shipped(&ring, &recording), 3).unwrap();
        let diagnosis = Diagnosis::of(&ring, &made, |_| ()).unwrap();
        let page = page(&diagnosis, &made).unwrap();
        assert!(page.lead.contains("x_E4"), "{}", page.lead);
        assert_eq!(page.sections.len(), 11);
        let figures: usize = page.sections.iter().map(|section| section.figures.len()).sum();
        // ring, maps, two of chi-square, evidence, two scans, vars
        assert_eq!(figures, 8);
        let ranked = &page.sections[4].figures[0].1.csv;
        assert!(ranked.lines().nth(1).is_some_and(|first| first.starts_with("bpm gain x_E4,")), "{ranked}");
    }
}
