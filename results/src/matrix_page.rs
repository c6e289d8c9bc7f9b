//! The report of a measured response matrix: what was found, what is left over, the calibrated ring beside its lattice, and the instruments.

use std::collections::BTreeSet;

use measured::{Fit, FittedOptics, Folder, Kind, unknowns};
use report::{Axes, Band, Figure, Look, Magnet, Map, Page, Reference, Section, Series, Spotted, Strip, Symbol, Table};
use twin::{Hold, Optics, OrbitError, Plane, Ring, Twiss};

use crate::matrix_diagnosis::{ImperfectionResult, MatrixDiagnosis, MatrixFinding, members, number};
use crate::matrix_result::{Comparison, MatrixFit, Row, rows};

/// Elements of a matrix up to which each is drawn: more are too small to be seen.
const DRAWN: usize = 2500;
/// Places that are marked of what was found, and of the instruments with the largest residuals.
const MARKED: usize = 6;
/// Standard deviations at which the colours of a map end.
const COLOURS: f64 = 4.0;
/// 95 % of a normal distribution are within so many standard deviations.
const WITHIN_95: f64 = 1.96;

/// A fitted matrix, and the ring as the lattice has it and as fitted.
pub struct Measured<'r> {
    /// What was measured.
    pub folder: &'r Folder,
    /// Its fit.
    pub fit: &'r Fit,
    /// The same as a result.
    pub result: &'r MatrixFit,
    /// The ring of the lattice, and that of the fit.
    pub rings: [Ring; 2],
    /// Optics of the fitted ring.
    pub optics: FittedOptics,
}

impl Measured<'_> {
    /// The report of the fit.
    ///
    /// # Errors
    /// [`OrbitError`] where the lattice or the fitted ring has no stable motion.
    pub fn page(&self) -> Result<Page, OrbitError> {
        let sections = [self.left_over(&[])].into_iter().chain(self.ring()?).chain(self.instruments());
        Ok(Page {
            title: format!("{}: fit of the response matrix", self.folder.name),
            lead: self.result.remarks().into_iter().chain([self.numbers()]).collect::<Vec<_>>().join(" "),
            sections: sections.collect(),
        })
    }

    /// What was fitted, and how well.
    fn numbers(&self) -> String {
        let result = self.result;
        let tunes = result.tunes.as_ref().map_or(String::new(), |tunes| format!(" Tunes {tunes}."));
        format!(
            "{} elements of the response matrix, {} set aside. Chi-square per element with the stated noise: {:.4} as the lattice has it, {:.4} \
             fitted.{tunes}",
            result.elements, result.rejected_elements, result.chi2_loco_start, result.chi2_loco
        )
    }

    /// The report of a diagnosis.
    ///
    /// # Errors
    /// As [`Measured::page`].
    pub fn page_of(&self, found: &MatrixDiagnosis) -> Result<Page, OrbitError> {
        let page = self.page()?;
        let worst = found.unexplained.iter().take(MARKED).map(|one| one.at.clone());
        let found_at = found.findings.iter().filter_map(|one| one.at.as_deref()).flat_map(|at| at.split(','));
        let mut places: Vec<String> = Vec::new();
        for place in found_at.map(str::to_owned).take(MARKED).chain(worst) {
            if !places.contains(&place) {
                places.push(place);
            }
        }
        let first = [findings(found), self.left_over(&places)];
        // what is left over was its first section
        let sections = first.into_iter().chain(page.sections.into_iter().skip(1));
        let lead = format!("{}. {}", found.sentence, self.numbers());
        Ok(Page { title: format!("{}: {}", self.folder.name, found.verdict), lead, sections: sections.collect() })
    }

    /// Residuals by instrument and, of a small matrix, element by element.
    fn left_over(&self, marked: &[String]) -> Section {
        let of_plane = |plane: Plane, name: &str, of: &dyn Fn(usize) -> f64| {
            let rows = (0..self.folder.monitors.len())
                .filter(|&row| self.folder.monitors[row].plane == plane && self.folder.monitors[row].is_used);
            let (s, values): (Vec<f64>, Vec<f64>) =
                rows.map(|row| (self.folder.lattice[self.folder.monitors[row].at].s, of(row))).unzip();
            Series::points(name, s, values)
        };
        let rms = |row: usize| {
            let counted = self.fit.data.sigma.row(row).iter().filter(|sigma| sigma.is_finite()).count();
            1e3 * (self.fit.residual.row(row).norm_squared() / counted.max(1) as f64).sqrt()
        };
        let axes = Axes::new("What is left over at each monitor", "path length [m]", "rms of the residuals [um]");
        let figure = Figure::lines(
            &axes.along(self.strip(marked)),
            &[of_plane(Plane::X, "x", &rms), of_plane(Plane::Y, "y", &rms)],
        );
        let caption = "Measured less predicted over all correctors, by the fit as LOCO has it. Below: the lattice, to scale in s.".to_owned();
        let mut figures = vec![(caption, figure)];
        figures.extend(self.map());
        let row = |one: &crate::matrix_result::BlockError| {
            let freedom = one.freedom.map_or("normal".to_owned(), |freedom| format!("{freedom:.1}"));
            vec![one.block.to_owned(), format!("{:.1}", one.residual_um), format!("{:.1}", one.scale_um), freedom]
        };
        let header = [
            "block",
            "68 % of the residuals are within [um]",
            "error of the model, scale [um]",
            "its degrees of freedom",
        ];
        let table = Table {
            caption:
                "What the model misses in each block of the matrix, beside the stated noise: Student's distribution."
                    .into(),
            header: header.map(str::to_owned).to_vec(),
            rows: self.result.model_error.iter().map(row).collect(),
        };
        Section { heading: "What is left over".into(), figures, tables: vec![table], ..Section::default() }
    }

    /// Residuals over the learnt error, element by element.
    fn map(&self) -> Option<(String, Figure)> {
        let (rows, columns) = (self.folder.monitors.len(), self.folder.correctors.len());
        if rows * columns > DRAWN {
            return None;
        }
        let squares = self.fit.squares();
        let values = nalgebra::DMatrix::from_fn(rows, columns, |i, j| match self.fit.data.sigma[(i, j)].is_finite() {
            true => squares[(i, j)].sqrt().copysign(self.fit.residual[(i, j)]),
            false => f64::NAN,
        });
        let monitors: Vec<String> = (0..rows).map(|row| self.folder.monitor(row)).collect();
        let correctors: Vec<String> = (0..columns).map(|column| self.folder.corrector(column)).collect();
        let axes = Axes::new("Residuals, element by element", "corrector", "monitor").named(&correctors);
        let map = Map { name: "measured less predicted".into(), values };
        let figure = Figure::maps(&axes, "over the learnt error [1]", COLOURS, &monitors, &[map]);
        Some((
            "A row or a column that stands out is an instrument's; a wave across both is the lattice's.".into(),
            figure,
        ))
    }

    /// Strengths, optics and dispersion of the fitted ring.
    fn ring(&self) -> Result<Vec<Section>, OrbitError> {
        let lattice = Optics::of(&self.rings[0], Hold::Momentum { delta: 0.0 })?.twiss()?;
        let FittedOptics { twiss: fitted, sigma, .. } = &self.optics;
        let ring = &self.rings[1];
        let s: Vec<f64> = ring.elements.iter().map(|element| element.s).chain([ring.circumference]).collect();
        let along = |name: &str, of: &dyn Fn(&Twiss, &Twiss) -> f64| {
            Series::line(
                name,
                s.clone(),
                fitted.iter().zip(&lattice).map(|(fitted, lattice)| of(fitted, lattice)).collect(),
            )
        };
        let beats = |name: &str, plane: usize| {
            let all = fitted.iter().zip(&lattice).zip(sigma);
            let within = all.map(|((fitted, lattice), sigma)| {
                let (beat, sigma) = (fitted.beta_beat(lattice)[plane], sigma.beta[plane] / lattice.beta[plane]);
                (100.0 * (beat - sigma), 100.0 * (beat + sigma))
            });
            along(name, &|fitted, lattice| 100.0 * fitted.beta_beat(lattice)[plane]).within(within.collect())
        };
        let axes = Axes::new("Beta-beat", "path length [m]", "beta/beta of the lattice - 1 [%]");
        let figure = Figure::lines(
            &axes.compared(Reference::Level(0.0)).along(self.strip(&[])),
            &[beats("x", 0), beats("y", 1)],
        );
        let mut optics = vec![(
            "Relative change of the beta functions from the lattice as written to the fitted ring. Bands are standard deviations.".into(),
            figure,
        )];
        let mut series = vec![
            along("fitted", &|fitted, _| fitted.dispersion[0]),
            along("lattice", &|_, lattice| lattice.dispersion[0]),
        ];
        series.extend(self.measured_dispersion());
        let figure = Figure::lines(&Axes::new("Horizontal dispersion", "path length [m]", "dispersion [m]"), &series);
        optics.push((
            "Measured: the orbit's change with the RF frequency, over the momentum's, gains of the monitors taken out."
                .into(),
            figure,
        ));
        let optics = Section { heading: "Optics".into(), figures: optics, ..Section::default() };
        Ok(vec![self.strengths(), optics])
    }

    /// The measured dispersion at the monitors in x, where it was measured [m].
    fn measured_dispersion(&self) -> Option<Series> {
        let dispersion = self.folder.dispersion.as_ref()?;
        let optics = Optics::of(&self.rings[1], Hold::Momentum { delta: 0.0 }).ok()?;
        let step = self.folder.meta.delta_rf / self.folder.meta.rf;
        let scale = self.value(Kind::RfScale).map_or(1.0, |(scale, _)| scale);
        let momentum = -scale * step / optics.slip_factor();
        let rows = (0..dispersion.len())
            .filter(|&row| self.folder.monitors[row].plane == Plane::X && self.folder.monitors[row].is_used);
        let point = |row: usize| {
            let gain = self.value(Kind::MonitorGain(row)).map_or(1.0, |(gain, _)| gain);
            (self.folder.lattice[self.folder.monitors[row].at].s, 1e-3 * dispersion[row] / gain / momentum)
        };
        let (s, values) = rows.map(point).filter(|(_, value)| value.is_finite()).unzip();
        Some(Series::points("measured", s, values))
    }

    /// The strength of each group of magnets.
    fn strengths(&self) -> Section {
        let (names, values): (Vec<String>, Vec<(f64, f64)>) = self.of(|kind| matches!(kind, Kind::Strength(_))).unzip();
        let interval = |widths: f64| move |&(mean, sigma): &(f64, f64)| (mean - widths * sigma, mean + widths * sigma);
        let band = Band {
            label: "fitted".into(),
            centre: values.iter().map(|(mean, _)| *mean).collect(),
            inner: values.iter().map(interval(1.0)).collect(),
            outer: values.iter().map(interval(WITHIN_95)).collect(),
        };
        let axes =
            Axes::new("Strength factors", "magnet, or the first of its group", "factor on the lattice's gradient [1]");
        let figure = Figure::bands(&axes.named(&names).compared(Reference::Level(1.0)), &[band]);
        let caption = "Most probable factors with 68 % and 95 % intervals.".into();
        Section { heading: "Strengths".into(), figures: vec![(caption, figure)], ..Section::default() }
    }

    /// Gains and couplings of monitors and correctors along the ring, skew gradients.
    fn instruments(&self) -> Vec<Section> {
        let mut figures = Vec::new();
        let at_monitors = |row: usize| self.folder.lattice[self.folder.monitors[row].at].s;
        let at_correctors = |column: usize| self.folder.lattice[self.folder.correctors[column].at].s;
        let gains = |kind: &Kind| match *kind {
            Kind::MonitorGain(row) => Some((self.folder.monitors[row].plane, at_monitors(row))),
            _ => None,
        };
        let kicks = |kind: &Kind| match *kind {
            Kind::CorrectorGain(column) => Some((self.folder.correctors[column].plane, at_correctors(column))),
            _ => None,
        };
        let couplings = |kind: &Kind| match *kind {
            Kind::MonitorCoupling(row) => Some((self.folder.monitors[row].plane, at_monitors(row))),
            _ => None,
        };
        let cross = |kind: &Kind| match *kind {
            Kind::CorrectorCoupling(column) => Some((self.folder.correctors[column].plane, at_correctors(column))),
            _ => None,
        };
        type At<'a> = &'a dyn Fn(&Kind) -> Option<(Plane, f64)>;
        let all: [(&str, &str, f64, At); 4] = [
            ("Gains of the monitors", "reading over orbit [1]", 1.0, &gains),
            ("Gains of the correctors", "kick over the believed one [1]", 1.0, &kicks),
            ("Couplings of the monitors", "share of the other plane's orbit [1]", 0.0, &couplings),
            ("Couplings of the correctors", "kick in the other plane over the believed one [1]", 0.0, &cross),
        ];
        for (title, label, usual, at) in all {
            let series = [(Plane::X, "x"), (Plane::Y, "y")].map(|(plane, name)| self.points(plane, name, at));
            if series.iter().any(|one| !one.x.is_empty()) {
                let axes = Axes::new(title, "path length [m]", label).compared(Reference::Level(usual));
                figures.push(("Error bars are standard deviations.".to_owned(), Figure::lines(&axes, &series)));
            }
        }
        let mut sections = vec![Section { heading: "Instruments".into(), figures, ..Section::default() }];
        let skews: Vec<(String, (f64, f64))> = self.of(|kind| matches!(kind, Kind::Skew(_))).collect();
        if !skews.is_empty() {
            let row =
                |(name, (value, sigma)): &(String, (f64, f64))| vec![name.clone(), format!("{value:+.5} ± {sigma:.5}")];
            let table = Table {
                caption: "Integrated skew gradients of the fit.".into(),
                header: ["magnet", "skew gradient [1/m]"].map(str::to_owned).to_vec(),
                rows: skews.iter().map(row).collect(),
            };
            sections.push(Section { heading: "Skew gradients".into(), tables: vec![table], ..Section::default() });
        }
        sections
    }

    fn points(&self, plane: Plane, name: &str, at: &dyn Fn(&Kind) -> Option<(Plane, f64)>) -> Series {
        let fitted = self.fit.unknowns.iter().enumerate();
        let here =
            fitted.filter_map(|(unknown, one)| at(&one.kind).filter(|(of, _)| *of == plane).map(|(_, s)| (unknown, s)));
        let (mut s, mut values, mut bars) = (Vec::new(), Vec::new(), Vec::new());
        for (unknown, place) in here {
            let (value, sigma) = (self.fit.values[unknown], self.fit.sigma(unknown));
            s.push(place);
            values.push(value);
            bars.push((value - sigma, value + sigma));
        }
        Series::points(name, s, values).within(bars)
    }

    /// Name, value and standard deviation of the unknowns of a kind.
    fn of(&self, is_one: impl Fn(&Kind) -> bool) -> impl Iterator<Item = (String, (f64, f64))> {
        let all = self.fit.unknowns.iter().enumerate().filter(move |(_, one)| is_one(&one.kind));
        all.map(|(at, one)| {
            (unknowns::name(self.folder, &self.fit.groups, one.kind), (self.fit.values[at], self.fit.sigma(at)))
        })
    }

    fn value(&self, kind: Kind) -> Option<(f64, f64)> {
        let at = self.fit.unknowns.iter().position(|one| one.kind == kind)?;
        Some((self.fit.values[at], self.fit.sigma(at)))
    }

    /// The lattice below a figure, with the places of findings: names of instruments and of magnets.
    fn strip(&self, marked: &[String]) -> Strip {
        let rows = &self.folder.lattice;
        let has = |of: &mut dyn Iterator<Item = usize>| of.collect::<BTreeSet<usize>>();
        let monitors = has(&mut self.folder.monitors.iter().map(|one| one.at));
        let correctors = has(&mut self.folder.correctors.iter().map(|one| one.at));
        let symbol = |row: usize| match &rows[row] {
            one if one.bend != 0.0 => Some(Symbol::Bend),
            one if one.k1 > 0.0 => Some(Symbol::Focusing),
            one if one.k1 < 0.0 => Some(Symbol::Defocusing),
            one if one.half_k2 != 0.0 => Some(Symbol::Sextupole),
            _ if monitors.contains(&row) => Some(Symbol::Monitor),
            _ if correctors.contains(&row) => Some(Symbol::Corrector),
            _ => None,
        };
        let magnets = (0..rows.len())
            .filter_map(|row| Some(Magnet { symbol: symbol(row)?, s: rows[row].s, length: rows[row].length }));
        let is_at = |row: usize, place: &str| {
            let at = self.folder.element(row);
            place == at || place.split_once('_').is_some_and(|(_, of)| of == at)
        };
        let marks = marked.iter().flat_map(|place| {
            let here = (0..rows.len()).filter(move |&row| is_at(row, place));
            here.map(|row| Spotted { label: place.clone(), s: rows[row].s, look: Look::Finding })
        });
        Strip { marks: marks.collect(), magnets: magnets.collect() }
    }
}

/// What was found, and what an ordinary ring has.
fn findings(found: &MatrixDiagnosis) -> Section {
    let size = |amplitude: f64, sigma: f64, unit: &str| match (sigma > 0.0, unit) {
        (false, _) => String::new(),
        (true, "1/m" | "1/m^2") => format!("{amplitude:+.5} ± {sigma:.5} {}", &unit[1..]),
        (true, _) => format!("{amplitude:+.4} ± {sigma:.4}"),
    };
    let row = |one: &MatrixFinding| {
        let at = one.at.as_deref().unwrap_or_default().replace(',', ", ");
        let (gain, probability) = (format!("{:.1}", one.log_evidence_gain), format!("{:.3}", one.probability));
        vec![one.kind.to_owned(), at, size(one.amplitude, one.sigma, one.unit), gain, probability, one.sentence.clone()]
    };
    let table = Table {
        caption: "What stands out of what its kind does everywhere. Gain: ln Bayes factor [nat]; P: probability beside its alternatives.".into(),
        header: ["missing", "at", "amplitude", "gain [nat]", "P", "in words"].map(str::to_owned).to_vec(),
        rows: found.findings.iter().map(row).collect(),
    };
    let ordinary = |one: &ImperfectionResult| {
        let numbers = [one.mean, one.scatter, one.sigma].map(|value| number(value, one.unit));
        [members(one.kind, &one.at), one.members.to_string()].into_iter().chain(numbers).collect()
    };
    let families = Table {
        caption: "What an ordinary ring has, family by family: mean and scatter of the members, and the error bar of one (median).".into(),
        header: ["what", "members", "mean", "scatter", "error bar"].map(str::to_owned).to_vec(),
        rows: found.imperfections.iter().map(ordinary).collect(),
    };
    let unexplained = Table {
        caption: "Instruments whose residuals are larger than those of the others.".into(),
        header: ["instrument", "rms of the residuals [um]", "mean square over the others'"].map(str::to_owned).to_vec(),
        rows: found
            .unexplained
            .iter()
            .map(|one| vec![one.at.clone(), format!("{:.1}", one.rms_um), format!("{:.1}", one.ratio)])
            .collect(),
    };
    let predicted = format!(
        "Elements held out are predicted within {:.2} um rms by the fit as LOCO has it, within {:.2} um with families and findings: {:.0} ± {:.0} nat.",
        1e3 * found.fit.before.heldout_rms_mm,
        1e3 * found.fit.after.heldout_rms_mm,
        found.fit.elpd_gain,
        found.fit.elpd_gain_se
    );
    let tables = [table, families, unexplained].into_iter().filter(|table| !table.rows.is_empty());
    Section { heading: "What was found".into(), text: vec![predicted], tables: tables.collect(), ..Section::default() }
}

/// The report of a comparison.
pub fn page_of(compared: &Comparison, [before, after]: [&str; 2]) -> Page {
    let families = compared.families();
    let told: Vec<Row> = families.iter().flat_map(|family| rows(family)).collect();
    let names: Vec<String> = told.iter().map(|row| row.name.to_owned()).collect();
    let percent: Vec<[f64; 2]> = told.iter().map(|row| row.change().map(|share| 1e2 * share)).collect();
    let interval = |widths: f64| {
        percent.iter().map(|[change, sigma]| (change - widths * sigma, change + widths * sigma)).collect()
    };
    let band = Band {
        label: "change".into(),
        centre: percent.iter().map(|[change, _]| *change).collect(),
        inner: interval(1.0),
        outer: interval(WITHIN_95),
    };
    let axes = Axes::new("What changed", "quadrupole", "relative change [%]").named(&names);
    let figure = Figure::bands(&axes.compared(Reference::Level(0.0)), &[band]);
    let word = |is: bool| if is { "yes" } else { "no" }.to_owned();
    let row = |(row, [change, sigma]): (&Row, &[f64; 2])| {
        let first = row.magnets[0];
        let change = format!("{change:+.3} ± {sigma:.3}");
        vec![row.name.to_owned(), change, word(first.changed), word(first.identifiable)]
    };
    let table = Table {
        caption:
            "Magnets of one name that changed alike are one row. Changed: by more than chance. Can be told: the measurements decide, and not what was expected beforehand."
                .into(),
        header: ["quadrupole", "change [%]", "changed", "can be told"].map(str::to_owned).to_vec(),
        rows: told.iter().zip(&percent).map(row).collect(),
    };
    let others = Table {
        caption: "What changed beside them: cables, instruments, and fields of other elements; of a whole family the rms of its members.".into(),
        header: vec!["what".into()],
        rows: compared.others.iter().map(|one| vec![one.to_string()]).collect(),
    };
    let tables = [others, table].into_iter().filter(|table| !table.rows.is_empty()).collect();
    let caption = "Relative changes with 68 % and 95 % intervals.".into();
    let section = Section { heading: "Changes".into(), figures: vec![(caption, figure)], tables, ..Section::default() };
    Page { title: format!("{before} to {after}"), lead: compared.sentence.clone(), sections: vec![section] }
}
