//! The page of a diagnosis for those who operate the machine, from the sentence to the readings that support it.
//!
//! [`page`] lists its sections in order; each is one file.

mod chi2;
mod decisive;
mod evidence;
mod experiment;
mod findings;
mod heldout;
mod imperfections;
mod lattice;
mod limits;
mod location;
mod method;
mod monitors;
mod optics;
mod partial;
mod place;
mod probabilities;
mod residuals;
mod ring;
mod slope;
mod tunes;
mod unmodelled;
mod vars;

use diagnosis::{Data, Diagnosis, FitError, Verdict};
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
    if found.has_more() {
        residuals.push(Residuals::of("after", data, &found.best));
    }
    let mut sections: Vec<Section> = vec![
        findings::section(diagnosis)?,
        ring::section(diagnosis),
        probabilities::section(diagnosis),
        experiment::section(diagnosis)?,
        residuals::section(diagnosis)?,
        optics::section(diagnosis)?,
        vars::section(diagnosis),
        imperfections::section(diagnosis),
        monitors::section(diagnosis),
    ];
    sections.extend(place::section(diagnosis)?);
    sections.extend([
        evidence::section(diagnosis)?,
        chi2::section(data, &residuals),
        heldout::section(diagnosis),
        method::section(diagnosis, recording)?,
    ]);
    Ok(Page {
        title: format!("{}: {}", data.names(" + "), headline(diagnosis.verdict)),
        lead: format!("{}.{}", diagnosis.sentence.trim_end_matches('.'), pictures(data)),
        sections,
    })
}

/// Which of several recordings the pictures show.
fn pictures(data: &Data) -> String {
    if !data.is_joint() {
        return String::new();
    }
    format!(" Pictures of readings, residuals, tunes, optics and noise are those of {}.", data.name)
}

/// The verdict in a few words.
fn headline(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Consistent => "consistent with the model",
        Verdict::Identified => "missing physics identified",
        Verdict::Ambiguous => "physics may be missing, and its cause is open",
        Verdict::Unexplained => "physics is missing that no effect of the library describes",
    }
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
    use std::path::Path;

    use diagnosis::{Discrepancy, Linear, Location};
    use inference::simulate::{self, Beyond, Hardware, Truth, campaign};
    use report::Figure;
    use twin::{Effect, Kind, Plane, Ring};

    use super::*;

    /// A campaign of the repository, on the ring as designed.
    fn template() -> (Ring, Recording) {
        let ring = Ring::paper_booster();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/former/paper-vars");
        let recording = Recording::read(&folder, &ring).unwrap();
        (ring, recording)
    }

    /// A simulated campaign with some effects, diagnosed.
    fn diagnosed(effects: &[&str], seed: u64) -> (Recording, Diagnosis) {
        let (ring, recording) = template();
        let effects: Vec<Effect> = effects.iter().map(|text| Effect::parse(text, &ring).unwrap()).collect();
        let truth = Truth { vars: &[1.0; 48], effects: &effects, ..Truth::default() };
        let made = campaign(&recording, &ring, &truth, &Hardware::shipped(&ring, &recording), seed).unwrap();
        let diagnosis = Diagnosis::from_recording(&ring, &made, |_| ()).unwrap();
        (made, diagnosis)
    }

    fn section<'p>(page: &'p Page, heading: &str) -> &'p Section {
        page.sections.iter().find(|section| section.heading == heading).unwrap()
    }

    /// Cells of a figure's numbers.
    fn numbers(figure: &Figure) -> Vec<Vec<&str>> {
        figure.csv.lines().skip(1).map(|line| line.split(',').collect()).collect()
    }

    /// Both drawings have a title, a unit (the ring's map has no axes) and only numbers.
    fn is_complete(figure: &Figure) {
        for svg in [Some(&figure.svg), figure.narrow.as_ref()].into_iter().flatten() {
            let first = svg.split("</text>").next().unwrap().lines().last().unwrap();
            assert!(first.len() > 10, "a title: {first}");
            assert!(svg.contains(']') || svg.contains("beam clockwise"), "a unit: {first}");
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "only numbers: {first}");
        }
    }

    fn all_are_complete(page: &Page) {
        page.sections.iter().flat_map(|section| &section.figures).for_each(|(_, figure)| is_complete(figure));
    }

    #[test]
    fn the_numbers_of_the_page_are_those_of_the_diagnosis() {
        let (recording, diagnosis) = diagnosed(&["bpm_gain@x_E4=-0.15"], 3);
        let page = page(&diagnosis, &recording).unwrap();
        assert!(page.lead.contains("x_E4"), "{}", page.lead);
        all_are_complete(&page);
        let finding = &diagnosis.findings[0];
        let (amplitude, gain) = (finding.amplitude, finding.tested.unwrap().gain);
        let found = section(&page, "What was found");
        let row = &found.tables[0].rows[0];
        assert_eq!(row[4], slope::amplitude(finding));
        assert_eq!(row[5], signed(finding.log_evidence_gain, 1));
        assert_eq!(row[7], format!("{} ± {:.1}", signed(gain.0, 1), gain.1));
        // the line of the decisive picture has the amplitude as its slope, in percent
        let (_, figure) = &found.figures[0];
        let lines: Vec<Vec<&str>> = numbers(figure).into_iter().filter(|cells| cells[0].starts_with("slope")).collect();
        let [x, y, high]: [f64; 3] = [1, 2, 4].map(|i| lines[2][i].parse().unwrap());
        assert!((y / x - 100.0 * amplitude.0).abs() < 1e-9 && ((high - y) / x - 100.0 * amplitude.1).abs() < 1e-9);
        // and its points follow that line: by the noise, the slope of the points is within the error bar
        let points: Vec<[f64; 3]> = (numbers(figure).iter())
            .filter(|cells| cells[0].starts_with("measured"))
            .map(|cells| [1, 2, 4].map(|i| cells[i].parse().unwrap()))
            .collect();
        let sums = points.iter().fold((0.0, 0.0), |(top, bottom), [x, y, high]| {
            let weight = (high - y).powi(-2);
            (top + weight * x * y, bottom + weight * x * x)
        });
        assert!((sums.0 / sums.1 - 100.0 * amplitude.0).abs() < 100.0 * amplitude.1, "{}", sums.0 / sums.1);
        // probabilities add up
        let shares = section(&page, "How probable each cause is");
        for (_, figure) in &shares.figures {
            // the value stands before the last column; a name may hold a comma
            let value = |cells: &Vec<&str>| cells[cells.len() - 2].parse::<f64>().unwrap();
            let sum: f64 = numbers(figure).iter().map(value).sum();
            assert!((sum - 100.0).abs() < 1e-9, "{sum}");
        }
        let first: f64 = numbers(&shares.figures[0].1)[0][2].parse().unwrap();
        assert!((first - 100.0 * finding.probability).abs() < 1e-9);
        // tunes are those that the fit predicts
        let data = diagnosis.found.best.data(&diagnosis.found.data);
        let (machine, drives) = diagnosis.found.best.machine(data, 0).unwrap();
        let (_, tunes, _) = machine.readings(&drives).unwrap();
        let [x, y] = data.tune_shift_of_orbit;
        let rows = &section(&page, "Optics of the fitted machine").tables[0].rows;
        for (row, tune) in rows.iter().zip([tunes.x + x, tunes.y + y]) {
            assert!(row[2].starts_with(&format!("{tune:.5} ±")), "{row:?}");
        }
        let ranked = &section(&page, "Evidence").figures[0].1.csv;
        assert!(ranked.lines().nth(1).is_some_and(|first| first.starts_with("bpm gain x_E4,")), "{ranked}");
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn where_nothing_was_found_the_page_begins_with_the_detection_limits() {
        let (recording, diagnosis) = diagnosed(&[], 5);
        assert_eq!(diagnosis.verdict, Verdict::Consistent);
        let page = page(&diagnosis, &recording).unwrap();
        all_are_complete(&page);
        let limits = &section(&page, "What was found").figures[0].1;
        let gain = numbers(limits).into_iter().find(|cells| cells[0] == "bpm gain").unwrap();
        // the one of the sentence
        assert!(diagnosis.sentence.contains(&format!("bpm_gain {}", gain[4])), "{} {gain:?}", diagnosis.sentence);
        for location in [
            Location::Monitor(3),
            Location::MonitorInTime(3),
            Location::GainInTime(3),
            Location::MonitorElsewhere(3),
            Location::MonitorCurve(3),
            Location::Corrector(2),
            Location::CorrectorElsewhere(2),
            Location::Ring(5, Plane::X),
            Location::RingInTime(5, Plane::Y),
            Location::Linear(5, Linear::Couples),
            Location::QuadrupoleInTime(5),
            Location::QuadrupoleInRuns(5),
            Location::Time,
            Location::Tunes,
        ] {
            let one =
                Discrepancy { at: location.clone(), campaign: 0, log_bayes: 1.0, size: 1e-5, sites: 1, adapted: None };
            let figures = unmodelled::figures(&diagnosis, &one).unwrap();
            assert!(!figures.is_empty(), "{location:?}");
            figures.iter().for_each(|(_, figure)| is_complete(figure));
        }
    }

    /// One that turns the beam by 40 mrad, in a drift of the ring as designed.
    struct Solenoid;

    impl Beyond for Solenoid {
        fn alter_ring(&self, ring: &mut Ring) {
            let mut drifts = ring.elements.iter_mut().filter(|one| one.kind == Kind::Drift && one.length > 1.0);
            let drift = drifts.nth(20).unwrap();
            drift.kind = Kind::Solenoid { ks: 2.0 * 0.04 / drift.length };
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn an_element_that_the_library_lacks_has_its_slope() {
        let (ring, template) = template();
        let vars = simulate::vars(&ring, true, 21).unwrap();
        let truth = Truth { vars: &vars, effects: &[], beyond: &[&Solenoid] };
        let made = campaign(&template, &ring, &truth, &Hardware::shipped(&ring, &template), 21).unwrap();
        let page = page(&Diagnosis::from_recording(&ring, &made, |_| ()).unwrap(), &made).unwrap();
        let figures = page.sections.iter().flat_map(|section| &section.figures);
        assert_eq!(figures.filter(|(_, figure)| figure.svg.contains("couples the planes: slope")).count(), 1);
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn where_tunes_decide_they_are_the_decisive_picture() {
        // a recording with a tune meter, of a drift
        let ring = twin::Ring::paper_booster();
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/concealed/open-09");
        let recording = Recording::read(&folder, &ring).unwrap();
        let diagnosis = Diagnosis::from_recording(&ring, &recording, |_| ()).unwrap();
        assert!(diagnosis.findings.first().is_some_and(|one| one.word() == "quad_drift"), "{}", diagnosis.sentence);
        let page = page(&diagnosis, &recording).unwrap();
        all_are_complete(&page);
        let (_, figure) = &section(&page, "What was found").figures[0];
        assert!(figure.svg.contains("Qx [1]"), "{}", figure.csv);
        // measured tunes follow the model with the drift: at both ends nearer to it than to the one without
        let of = |label: &str| -> Vec<f64> {
            let mine = numbers(figure).into_iter().filter(|cells| cells[0].starts_with(label));
            mine.map(|cells| cells[2].parse().unwrap()).collect()
        };
        let (measured, without, with) = (of("measured"), of("model without"), of("model with it"));
        for (at, end) in [(0, 0), (measured.len() - 1, 1)] {
            assert!((measured[at] - with[end]).abs() < (measured[at] - without[end]).abs());
        }
    }
}
