//! Results of measured response matrices: as JSON and as tables.

use core::fmt;
use std::collections::BTreeMap;

use comfy_table::CellAlignment;
use diagnosis::capitalised;
use measured::believed::{Believed, Value};
use measured::straight::DEAD;
use measured::unknowns::{Groups, Unknown, name};
use measured::{Fit, Folder, Kind, Wiring};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::fit_result::{Monitor, Tunes};
use crate::optics::OpticsAt;
use crate::output::{fill, table};

/// Strength factors and instruments of a measured matrix. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct MatrixFit {
    pub recording: String,
    pub method: &'static str,
    pub model: &'static str,
    /// Elements of the matrix that count.
    pub elements: usize,
    pub rejected_elements: usize,
    /// One for each row of the lattice that is fitted.
    pub vars: Vec<MatrixVar>,
    pub covariance: Vec<Vec<f64>>,
    /// With what the model misses counted as an error.
    pub chi2_per_dof: f64,
    /// With the stated noise alone, at the values that make it least.
    pub chi2_loco: f64,
    pub chi2_loco_start: f64,
    /// The stated noise over what the fit leaves over, where it is stated too large.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub overstated_noise: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tunes: Option<Tunes>,
    /// At monitors and quadrupoles, where the fitted ring is stable.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub optics: Vec<OpticsAt>,
    pub monitors: Vec<Monitor>,
    pub other: Vec<Other>,
    pub degenerate: Vec<Vec<String>>,
    /// What the model misses in each block of the matrix.
    pub model_error: Vec<BlockError>,
    /// Cables that were put right before the fit.
    pub wiring: Vec<Cable>,
    /// False where the fit was still moving when its steps were used up.
    pub has_ended: bool,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Cable {
    pub kind: &'static str,
    pub at: String,
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct MatrixVar {
    pub name: String,
    pub index: usize,
    pub mean: f64,
    pub sigma: f64,
    pub q025: f64,
    pub q16: f64,
    pub q84: f64,
    pub q975: f64,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Other {
    pub kind: &'static str,
    pub at: String,
    /// All magnets of a gradient that is added.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub elements: Vec<String>,
    pub mean: f64,
    pub sigma: f64,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct BlockError {
    pub block: &'static str,
    /// 68 % of the residuals are smaller.
    pub residual_um: f64,
    /// What the model misses, beside the stated noise: scale of Student's distribution.
    pub scale_um: f64,
    /// Its degrees of freedom, none where it is normal.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub freedom: Option<f64>,
}

/// The values of a fit as its JSON states them.
#[derive(Debug, Deserialize)]
pub struct StatedModel {
    vars: Vec<StatedVar>,
    other: Vec<StatedOther>,
    wiring: Vec<StatedCable>,
}

#[derive(Debug, Deserialize)]
struct StatedVar {
    name: String,
    mean: f64,
    sigma: f64,
}

#[derive(Debug, Deserialize)]
struct StatedOther {
    kind: String,
    at: String,
    mean: f64,
    sigma: f64,
}

#[derive(Debug, Deserialize)]
struct StatedCable {
    kind: String,
    at: String,
}

impl From<StatedModel> for Believed {
    fn from(stated: StatedModel) -> Self {
        let vars = stated.vars.into_iter().map(|one| ("quadrupole_gradient".to_owned(), one.name, one.mean, one.sigma));
        let others = stated.other.into_iter().map(|one| (one.kind, one.at, one.mean, one.sigma));
        let values = vars.chain(others).map(|(kind, at, value, sigma)| Value { kind, at, value, sigma });
        let cables = stated.wiring.into_iter().map(|one| [one.kind, one.at]);
        Self { values: values.collect(), cables: cables.collect() }
    }
}

impl MatrixFit {
    /// Of a fit, with the optics of its ring where it is stable.
    pub fn of(folder: &Folder, cables: &[Wiring], fit: &Fit, (tunes, optics): (Option<Tunes>, Vec<OpticsAt>)) -> Self {
        let rows = fitted_rows(fit);
        // correlations of independent errors
        let independent = &fit.uncertainty.independent;
        let scale = |at: usize| fit.sigma(at) / independent[(at, at)].sqrt();
        let between =
            |&(_, i): &(usize, usize)| rows.iter().map(|&(_, j)| scale(i) * scale(j) * independent[(i, j)]).collect();
        let called = |at: usize| name(folder, &fit.groups, fit.unknowns[at].kind);
        let value = |at: usize| [fit.values[at], fit.sigma(at)];
        let weight = fit.data.weight(&fit.noise, &fit.residual);
        let chi2 = fit.residual.component_mul(&fit.residual).dot(&weight);
        Self {
            recording: folder.name.clone(),
            method: "map",
            model: "twin",
            elements: fit.elements,
            rejected_elements: fit.outliers.len(),
            vars: rows.iter().map(|&(row, at)| MatrixVar::of_row(folder, row, value(at))).collect(),
            covariance: rows.iter().map(between).collect(),
            chi2_per_dof: chi2 / (fit.elements as f64 - fit.unknowns.len() as f64).max(1.0),
            chi2_loco: fit.chi2_loco,
            chi2_loco_start: fit.chi2_start,
            overstated_noise: fit.overstated_noise(),
            tunes,
            optics,
            monitors: monitors(folder, fit),
            other: others(folder, (&fit.groups, &fit.unknowns), value),
            degenerate: fit.degenerate().iter().map(|set| set.iter().map(|&at| called(at)).collect()).collect(),
            model_error: model_error(fit),
            wiring: cables.iter().map(|one| one.named(folder)).map(|(kind, at)| Cable { kind, at }).collect(),
            has_ended: fit.has_ended,
        }
    }
}

/// Everything that is no strength factor, with its mean and its standard deviation.
pub(crate) fn others(
    folder: &Folder,
    (groups, unknowns): (&Groups, &[Unknown]),
    value: impl Fn(usize) -> [f64; 2],
) -> Vec<Other> {
    let other = |(at, unknown): (usize, &Unknown)| {
        let kind = unknown.kind;
        let elements = match kind {
            Kind::Added(group) => groups[0][group].iter().map(|&row| folder.element(row)).collect(),
            _ => Vec::new(),
        };
        let [mean, sigma] = value(at);
        Other { kind: kind.word(), at: name(folder, groups, kind), elements, mean, sigma }
    };
    let others = unknowns.iter().enumerate().filter(|(_, unknown)| !matches!(unknown.kind, Kind::Strength(_)));
    others.map(other).collect()
}

/// Rows of the lattice whose strengths have a factor, in beam order, with the number of their group, which is that of their unknown.
pub(crate) fn fitted_rows(fit: &Fit) -> Vec<(usize, usize)> {
    let mut rows: Vec<(usize, usize)> = Vec::new();
    for unknown in &fit.unknowns {
        if let Kind::Strength(group) = unknown.kind {
            rows.extend(fit.groups[0][group].iter().map(|&row| (row, group)));
        }
    }
    rows.sort_unstable();
    rows
}

impl MatrixVar {
    /// Strength factor of a row, mean and standard deviation.
    pub(crate) fn of_row(folder: &Folder, row: usize, [mean, sigma]: [f64; 2]) -> Self {
        let quantile = |deviations: f64| mean + deviations * sigma;
        let [q025, q16, q84, q975] = [-1.959_964, -0.994_458, 0.994_458, 1.959_964].map(quantile);
        Self { name: folder.element(row), index: row, mean, sigma, q025, q16, q84, q975 }
    }
}

/// The blocks of which something was measured.
fn model_error(fit: &Fit) -> Vec<BlockError> {
    let of_block = |block: usize| {
        let elements = fit.data.block.iter().zip(&fit.data.sigma).zip(&fit.residual);
        let counted = elements.filter(|((of, sigma), _)| **of == block && sigma.is_finite());
        let mut residuals: Vec<f64> = counted.map(|(_, residual)| residual.abs()).collect();
        residuals.sort_by(f64::total_cmp);
        let missed = fit.noise.blocks[block];
        Some(BlockError {
            block: measured::data::BLOCKS[block],
            residual_um: 1e3 * residuals.get((0.68 * residuals.len() as f64) as usize)?,
            scale_um: 1e3 * missed.scale,
            freedom: missed.freedom.is_finite().then_some(missed.freedom),
        })
    };
    (0..measured::data::BLOCKS.len()).filter_map(of_block).collect()
}

/// State of each monitor: dead where it is not used or reads nothing, noisy where its rows are explained worse than others.
fn monitors(folder: &Folder, fit: &Fit) -> Vec<Monitor> {
    let squares = fit.squares();
    let state = |row: usize| {
        let counted = fit.data.sigma.row(row).iter().filter(|sigma| sigma.is_finite()).count();
        let squares = squares.row(row).sum();
        let gain = fit.unknowns.iter().position(|one| one.kind == Kind::MonitorGain(row)).map(|at| fit.values[at]);
        let word = match (gain, squares > 4.0 * counted as f64) {
            (Some(gain), false) if gain.abs() > DEAD => "ok",
            (Some(gain), true) if gain.abs() > DEAD => "noisy",
            _ => "dead",
        };
        let rejected = fit.outliers.iter().filter(|[at, _]| *at == row).count();
        let rms = (fit.residual.row(row).norm_squared() / counted.max(1) as f64).sqrt();
        Monitor {
            name: folder.monitor(row),
            state: word,
            sigma_mm: rms,
            rejected: rejected as u32,
            excluded: BTreeMap::new(),
        }
    };
    (0..folder.monitors.len()).map(state).collect()
}

pub(crate) const DOUBT: &str =
    "The fit did not end: no ring of this lattice is near the measurement. Check the lattice, signs and units";

/// Words for noise that is stated too large by a factor.
pub(crate) fn overstated(factor: f64) -> String {
    format!("the stated noise is {factor:.1} times as large as what the fit leaves over")
}

impl MatrixFit {
    /// What a reader must know before the numbers, in sentences.
    pub(crate) fn remarks(&self) -> Vec<String> {
        let doubt = (!self.has_ended).then(|| DOUBT.to_owned());
        let noise = self.overstated_noise.map(|factor| capitalised(&overstated(factor)));
        doubt.into_iter().chain(noise).map(|remark| format!("{remark}.")).collect()
    }
}

impl fmt::Display for MatrixFit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { recording, elements, rejected_elements, chi2_loco, chi2_loco_start, .. } = self;
        writeln!(f, "{recording}: {elements} elements of the response matrix, {rejected_elements} set aside\n")?;
        for Cable { kind, at } in &self.wiring {
            let done = if kind.ends_with("dead") { "left out of" } else { "put right before" };
            writeln!(f, "{}\n", fill(&format!("{done} the fit: {kind} at {}", at.replace(',', ", "))))?;
        }
        for remark in self.remarks() {
            writeln!(f, "{}\n", fill(&remark))?;
        }
        let line = format!(
            "chi2 per element with the stated noise {chi2_loco_start:.4} -> {chi2_loco:.4}; 68 % of the residuals are within: {}",
            self.model_error
                .iter()
                .map(|one| format!("{} {:.1} um", one.block, one.residual_um))
                .collect::<Vec<_>>()
                .join(", ")
        );
        writeln!(f, "{}\n", fill(&line))?;
        let mut vars = table(["var", "mean", "sigma / %", "var", "mean", "sigma / %"]);
        for pair in self.vars.chunks(2) {
            vars.add_row(
                pair.iter().flat_map(|var| {
                    [var.name.clone(), format!("{:.4}", var.mean), format!("{:.2}", 100.0 * var.sigma)]
                }),
            );
        }
        for column in vars.column_iter_mut().filter(|column| column.index % 3 != 0) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        writeln!(f, "{vars}")?;
        for Other { elements, mean, sigma, .. } in self.other.iter().filter(|one| !one.elements.is_empty()) {
            let line = format!("gradient added to {}: {mean:+.5} ± {sigma:.5} 1/m^2", elements.join(", "));
            writeln!(f, "{}", fill(&line))?;
        }
        if let Some(tunes) = &self.tunes {
            writeln!(f, "tunes {tunes}")?;
        }
        let doubtful =
            self.monitors.iter().filter(|one| one.state != "ok").map(|one| format!("{} {}", one.name, one.state));
        let doubtful: Vec<String> = doubtful.collect();
        if !doubtful.is_empty() {
            writeln!(f, "{}", fill(&format!("monitors: {}", doubtful.join(", "))))?;
        }
        for set in &self.degenerate {
            writeln!(f, "{}", fill(&format!("cannot be told apart: {}", set.join(", "))))?;
        }
        Ok(())
    }
}

/// What changed. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Comparison {
    pub changes: Vec<ChangeOfOne>,
    /// Cables, gains, couplings and skew gradients that changed.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<OtherChange>,
    pub sentence: String,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct ChangeOfOne {
    pub name: String,
    /// Magnets of one family, as of one supply.
    #[serde(skip)]
    pub family: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub index: Option<usize>,
    pub relative: f64,
    pub sigma: f64,
    /// Too large for chance.
    pub changed: bool,
    pub identifiable: bool,
}

/// A change of something else. A cable has no size.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct OtherChange {
    pub kind: &'static str,
    pub at: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma: Option<f64>,
    /// Empty of a share.
    pub unit: &'static str,
}

impl OtherChange {
    /// Of anything that is no cable.
    pub fn of(one: &measured::compare::Other) -> Self {
        Self { kind: one.word, at: one.at.clone(), change: Some(one.change), sigma: Some(one.sigma), unit: one.unit }
    }

    /// Of a cable.
    pub fn of_cable(folder: &Folder, one: &Wiring) -> Self {
        let (kind, at) = one.named(folder);
        Self { kind, at, change: None, sigma: None, unit: "" }
    }
}

impl fmt::Display for OtherChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, at, unit, .. } = self;
        match (self.change, self.sigma, *unit) {
            (Some(change), Some(sigma), "") => write!(f, "{kind} at {at} {:+.2} ± {:.2} %", 1e2 * change, 1e2 * sigma),
            (Some(change), Some(sigma), unit) => write!(f, "{kind} at {at} {change:+.5} ± {sigma:.5} {unit}"),
            _ => write!(f, "{kind} at {at}"),
        }
    }
}

/// What is said of changes, at most.
const SAID: usize = 4;

/// Magnets of one family that changed alike, or one that did not.
pub(crate) struct Row<'c> {
    pub(crate) name: &'c str,
    pub(crate) magnets: &'c [&'c ChangeOfOne],
}

impl Row<'_> {
    /// The mean of the magnets, whose errors are those of their family.
    pub(crate) fn change(&self) -> [f64; 2] {
        let mean = |of: fn(&ChangeOfOne) -> f64| {
            self.magnets.iter().map(|one| of(one)).sum::<f64>() / self.magnets.len() as f64
        };
        [mean(|one| one.relative), mean(|one| one.sigma)]
    }

    fn is_alike(magnets: &[&ChangeOfOne]) -> bool {
        let first = magnets[0];
        magnets.iter().all(|one| {
            one.changed == first.changed && (one.relative - first.relative).abs() < ALIKE * one.sigma.hypot(first.sigma)
        })
    }

    fn words(&self) -> String {
        let [change, sigma] = self.change();
        format!("{} by {:+.3} ± {:.3} %", self.name, 1e2 * change, 1e2 * sigma)
    }
}

/// Magnets of one family are told together where they differ by less than so many standard deviations.
const ALIKE: f64 = 3.0;

impl Comparison {
    /// Of changes, in the order of the ring, and of those of other things, the clearest first.
    pub fn of(changes: Vec<ChangeOfOne>, others: Vec<OtherChange>) -> Self {
        let mut compared = Self { sentence: String::new(), changes, others };
        compared.sentence = compared.words();
        compared
    }

    /// What changed, the clearest first.
    fn words(&self) -> String {
        let magnets = self.families();
        let rows = magnets.iter().flat_map(|family| rows(family)).collect::<Vec<_>>();
        let mut found: Vec<(f64, String)> = Vec::new();
        let changed = rows.iter().filter(|row| row.magnets.iter().any(|one| one.changed));
        found.extend(changed.map(|row| (row.change()[0] / row.change()[1], row.words())));
        let clear =
            |one: &OtherChange| one.change.zip(one.sigma).map_or(f64::INFINITY, |(change, sigma)| change / sigma);
        found.extend(self.others.iter().map(|one| (clear(one), one.to_string())));
        found.sort_by(|a, b| b.0.abs().total_cmp(&a.0.abs()));
        let more = found.len().saturating_sub(SAID);
        let said: Vec<String> = found.into_iter().take(SAID).map(|(_, words)| words).collect();
        let first = match said.is_empty() {
            true => "Nothing changed by more than chance.".to_owned(),
            false => format!(
                "Changed: {}{}.",
                said.join("; "),
                if more > 0 { format!("; {more} more") } else { String::new() }
            ),
        };
        let open = self.changes.iter().filter(|one| !one.identifiable && !one.changed).count();
        let second = if open > 0 { format!(" Of {open} magnets the measurements cannot tell.") } else { String::new() };
        first + &second
    }

    /// Magnets family by family, in the order of the ring.
    pub(crate) fn families(&self) -> Vec<Vec<&ChangeOfOne>> {
        let mut families: Vec<Vec<&ChangeOfOne>> = Vec::new();
        for one in &self.changes {
            match families.iter_mut().find(|family| family[0].family == one.family) {
                Some(family) => family.push(one),
                None => families.push(vec![one]),
            }
        }
        families
    }
}

/// One row of a family whose magnets changed alike, else one a magnet.
pub(crate) fn rows<'c>(family: &'c [&'c ChangeOfOne]) -> Vec<Row<'c>> {
    match Row::is_alike(family) && family.len() > 1 {
        true => vec![Row { name: &family[0].family, magnets: family }],
        false => family.chunks(1).map(|one| Row { name: &one[0].name, magnets: one }).collect(),
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}\n", fill(&self.sentence))?;
        let mut table = table(["quadrupole", "change / %", "sigma / %", "can be told"]);
        for row in self.families().iter().flat_map(|family| rows(family)) {
            let [change, sigma] = row.change();
            let can_be_told = if row.magnets[0].identifiable { "yes" } else { "no" };
            table.add_row([
                row.name.to_owned(),
                format!("{:+.3}", 1e2 * change),
                format!("{:.3}", 1e2 * sigma),
                can_be_told.into(),
            ]);
        }
        for column in table.column_iter_mut().filter(|column| [1, 2].contains(&column.index)) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        write!(f, "{table}")?;
        for (number, one) in self.others.iter().enumerate() {
            write!(f, "{}{one}", if number == 0 { "\n\n" } else { "\n" })?;
        }
        Ok(())
    }
}
