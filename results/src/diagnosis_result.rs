//! The result of `orbitcal diagnose` on recordings: as JSON and as tables.

use core::fmt;

use comfy_table::ColumnConstraint;
use diagnosis::{Diagnosis, Finding, Fitted, OutOfRange, Score, Vars};
use inference::Recording;
use report::Page;
use schemars::JsonSchema;
use serde::Serialize;
use twin::{Measured, Ring};

use crate::diagnosis_page::page;
use crate::error::CommandError;
use crate::fit_result::{Monitor, Tunes, TunesMeasured, Var, monitors, vars_of};
use crate::imperfection::ImperfectionResult;
use crate::output::{fill, table};

/// What is missing. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
pub struct DiagnosisResult {
    recording: String,
    /// File name of the machine's lattice.
    lattice: String,
    /// Those that were analysed together, if several.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    recordings: Vec<String>,
    verdict: &'static str,
    sentence: String,
    findings: Vec<FindingResult>,
    /// Least probability that all effects in the model are there.
    #[serde(skip_serializing_if = "Option::is_none")]
    joint_probability: Option<f64>,
    monitors: Vec<Monitor>,
    fit: Fits,
    vars_before: Vec<Var>,
    vars_after: Vec<Var>,
    /// Vars beyond the range of their prior.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    beyond_range: Vec<BeyondResult>,
    /// Of the machine that was found.
    #[serde(skip_serializing_if = "Option::is_none")]
    tunes: Option<Tunes>,
    tunes_measured: TunesMeasured,
    next_measurement: Option<String>,
    /// Probability that nothing (more) is missing, that an effect of the library is, and that something else is.
    probabilities: Probabilities,
    /// Ordinary imperfections of the machine.
    imperfections: Vec<ImperfectionResult>,
}

/// A var beyond its range.
#[derive(Debug, Serialize, JsonSchema)]
struct BeyondResult {
    name: String,
    mean: f64,
    sigma: f64,
    range: [f64; 2],
}

impl From<&OutOfRange> for BeyondResult {
    fn from(one: &OutOfRange) -> Self {
        Self { name: one.name.clone(), mean: one.var.value, sigma: one.var.sigma, range: one.range }
    }
}

#[derive(Debug, Serialize, JsonSchema)]
struct FindingResult {
    kind: &'static str,
    at: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    s_m: Option<f64>,
    /// 95 % credible stretches of the place of a gradient.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    s_interval_m: Vec<[f64; 2]>,
    amplitude: f64,
    sigma: f64,
    unit: &'static str,
    /// Of a field that does not grow with the magnets, in several recordings: the energy at which `amplitude` is given, and the same in tesla.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    fixed: Option<FixedResult>,
    /// Amplitude and error bar as people read them.
    #[serde(skip)]
    measured: String,
    log_evidence_gain: f64,
    probability: f64,
    sentence: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    heldout_gain: Option<[f64; 2]>,
    /// The same where kind and place are chosen without the held-out readings too.
    #[serde(skip_serializing_if = "Option::is_none")]
    heldout_gain_of_choice: Option<f64>,
    /// Probability that chance alone gives the search as good a candidate.
    #[serde(skip_serializing_if = "Option::is_none")]
    chance: Option<f64>,
    /// Of an alternative: such a recording is not expected to tell it from the finding.
    #[serde(skip_serializing_if = "core::ops::Not::not")]
    inseparable: bool,
    alternatives: Vec<FindingResult>,
    /// Effects in the model that describe a part of something unknown.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    parts: Vec<FindingResult>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct FixedResult {
    #[serde(rename = "kinetic_energy_GeV")]
    kinetic_energy: f64,
    #[serde(rename = "integrated_gradient_T")]
    gradient: [f64; 2],
}

#[derive(Debug, Serialize, JsonSchema)]
struct Fits {
    before: FitResult,
    after: FitResult,
    elpd_gain: f64,
    elpd_gain_se: f64,
    /// The same with whole correctors held out, where no effect is a corrector's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    corrector_elpd_gain: Option<[f64; 2]>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct FitResult {
    chi2_per_dof: f64,
    heldout_rms_mm: f64,
    heldout_elpd: f64,
    heldout_inside_68: f64,
    heldout_inside_95: f64,
}

#[derive(Debug, Serialize, JsonSchema)]
struct Probabilities {
    nothing_more: f64,
    library: f64,
    unknown: f64,
}

/// The page of a diagnosis.
///
/// # Errors
/// [`CommandError::Other`] where the machine that was found is not stable.
pub fn diagnosis_page(diagnosis: &Diagnosis, recording: &Recording) -> Result<Page, CommandError> {
    let made = page(diagnosis, recording);
    made.map_err(|error| CommandError::Other(format!("{}: {error}", recording.name)))
}

impl DiagnosisResult {
    /// Of a diagnosis whose first recording this is.
    ///
    /// # Errors
    /// [`CommandError::Other`].
    pub fn of(ring: &Ring, recording: &Recording, diagnosis: &Diagnosis) -> Result<Self, CommandError> {
        let failed = |error: twin::EffectError| CommandError::Other(format!("{}: {error}", recording.name));
        let Diagnosis { found, before, after, .. } = diagnosis;
        let data = &found.data;
        let (gain, error) = diagnosis.gain();
        let fit = |fitted: &Fitted, score: &Score| -> Result<FitResult, CommandError> {
            Ok(FitResult {
                chi2_per_dof: fitted.chi2_per_dof(data).map_err(failed)?,
                heldout_rms_mm: score.rms * 1e3,
                heldout_elpd: score.elpd(),
                heldout_inside_68: score.inside[0],
                heldout_inside_95: score.inside[1],
            })
        };
        let (next, tunes) = (&found.next, tunes_of(diagnosis));
        Ok(Self {
            recording: data.names(" + "),
            lattice: ring.file.clone(),
            recordings: if data.is_joint() {
                data.campaigns().map(|own| own.name.clone()).collect()
            } else {
                Vec::new()
            },
            verdict: diagnosis.verdict.word(),
            sentence: diagnosis.sentence.clone(),
            findings: diagnosis.findings.iter().map(FindingResult::of).collect(),
            joint_probability: diagnosis.joint_probability(),
            monitors: monitors(ring, &data.health_in_any(), &data.excluded_in_any()),
            fit: Fits {
                before: fit(&found.null, before)?,
                after: fit(&found.best, after)?,
                elpd_gain: gain,
                elpd_gain_se: error,
                corrector_elpd_gain: diagnosis
                    .correctors
                    .as_ref()
                    .map(|(before, after)| after.gain_over(before).into()),
            },
            vars_before: vars(ring, &diagnosis.vars_before),
            vars_after: vars(ring, &diagnosis.vars_after),
            beyond_range: diagnosis.beyond.iter().map(Into::into).collect(),
            tunes_measured: TunesMeasured::of_recording(recording, tunes.map(|tunes| [tunes.x, tunes.y])),
            tunes,
            next_measurement: diagnosis.next_measurement.clone(),
            probabilities: Probabilities {
                nothing_more: next.nothing,
                library: next.library(),
                unknown: next.unknown(),
            },
            imperfections: diagnosis.imperfections().iter().map(Into::into).collect(),
        })
    }
}

/// What the columns of the table hold.
const COLUMNS: &str = "gain: of ln evidence over the fit without it [nat]; P: probability among all causes that compete with it; \
                       held-out: gain of log predictive density [nat].";

impl fmt::Display for DiagnosisResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {}\n\n{}\n", self.recording, self.verdict, fill(&self.sentence))?;
        let mut table = table(["effect", "at", "s/m", "amplitude", "gain", "P", "held-out"]);
        for finding in &self.findings {
            table.add_row(finding.row(""));
            finding.alternatives.iter().take(5).for_each(|other| {
                table.add_row(other.row("or "));
            });
            finding.parts.iter().for_each(|part| {
                table.add_row(part.row("part "));
            });
        }
        // a word of the library is looked for elsewhere, so that it is not broken
        if let Some(words) = table.column_mut(0) {
            words.set_constraint(ColumnConstraint::ContentWidth);
        }
        if !self.findings.is_empty() {
            let energy =
                self.findings.iter().find_map(|finding| finding.fixed.as_ref()).map(|fixed| fixed.kinetic_energy);
            let at =
                energy.map_or_else(String::new, |energy| format!(" Stray gradients: amplitudes at {energy:.3} GeV."));
            let all = match (self.joint_probability, self.findings.len()) {
                (Some(least), 2..) => format!(" All effects in the model: P at least {least:.3}."),
                _ => String::new(),
            };
            writeln!(f, "{table}\n{}\n", fill(&format!("{COLUMNS}{all}{at}")))?;
        }
        let Fits { before, after, elpd_gain, elpd_gain_se, .. } = &self.fit;
        let summary = format!(
            "chi2/dof {:.4} -> {:.4}, held-out rms {:.2} -> {:.2} um, log predictive density {elpd_gain:+.1} ± {elpd_gain_se:.1}",
            before.chi2_per_dof,
            after.chi2_per_dof,
            before.heldout_rms_mm * 1e3,
            after.heldout_rms_mm * 1e3,
        );
        write!(f, "{}", fill(&summary))?;
        if let Some(tunes) = &self.tunes {
            let of = self.recordings.first().map_or_else(String::new, |first| format!(" of {first}"));
            write!(f, "\ntunes{of} {:.4} {:.4}, {}", tunes.x, tunes.y, self.tunes_measured)?;
        }
        self.write_imperfections(f)?;
        self.next_measurement.as_ref().map_or(Ok(()), |next| write!(f, "\n\n{}", fill(next)))
    }
}

impl DiagnosisResult {
    /// The ordinary imperfections that the recording shows.
    fn write_imperfections(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut rows = self.imperfections.iter().filter_map(|one| one.row.as_ref()).peekable();
        if rows.peek().is_none() {
            return Ok(());
        }
        let mut table = table(["of the machine as it is", "size", "ordinary", ""]);
        table.add_rows(rows);
        write!(f, "\n\n{table}")
    }
}

impl FindingResult {
    fn of(finding: &Finding) -> Self {
        let (unit, (value, sigma)) = (finding.unit(), finding.amplitude);
        let measured = format!("{} {}", Measured { value, sigma }.signed(unit.factor), unit.shown);
        Self {
            kind: finding.word(),
            at: finding.at.clone(),
            s_m: finding.s,
            s_interval_m: finding.interval.iter().map(|one| [one.from_m, one.to_m]).collect(),
            amplitude: value,
            sigma,
            unit: unit.symbol,
            fixed: finding.fixed.map(|fixed| FixedResult {
                kinetic_energy: fixed.kinetic_energy,
                gradient: [fixed.gradient.value, fixed.gradient.sigma],
            }),
            measured: if sigma > 0.0 { measured } else { String::new() },
            log_evidence_gain: finding.log_evidence_gain,
            probability: finding.probability,
            sentence: finding.phrase.clone(),
            heldout_gain: finding.tested.map(|tested| tested.gain.into()),
            heldout_gain_of_choice: finding.tested.and_then(|tested| tested.of_choice),
            chance: finding.tested.and_then(|tested| tested.chance),
            inseparable: finding.inseparable,
            alternatives: finding.alternatives.iter().map(Self::of).collect(),
            parts: finding.parts.iter().map(Self::of).collect(),
        }
    }

    fn row(&self, before: &str) -> [String; 7] {
        let gain = self.heldout_gain.map_or_else(String::new, |[gain, error]| format!("{gain:.1} ± {error:.1}"));
        [
            format!("{before}{}", self.kind),
            self.at.clone(),
            self.s_m.map_or_else(String::new, |s| format!("{s:.2}")),
            self.measured.clone(),
            format!("{:.1}", self.log_evidence_gain),
            format!("{:.3}", self.probability),
            gain,
        ]
    }
}

/// Tunes of the machine that was found, what is ordinary included, at the recording's mean supply currents; none if it is unstable.
fn tunes_of(diagnosis: &Diagnosis) -> Option<Tunes> {
    let (best, data) = (&diagnosis.found.best, &diagnosis.found.data);
    let (machine, drives) = best.machine(data, 0).ok()?;
    // on its orbit, where sextupoles focus
    let tunes = machine.on_orbit(&drives.orbit).optics().and_then(|optics| optics.tunes()).ok()?;
    let [x, y] = best.tunes_of_element(data).ok()?;
    let [of_x, of_y] = best.data(data).tune_shift_of_orbit;
    Some(Tunes { x: tunes.x + x + of_x, y: tunes.y + y + of_y, sigma: None })
}

fn vars(ring: &Ring, vars: &Vars) -> Vec<Var> {
    let sigma = vars.covariance.diagonal().map(f64::sqrt);
    vars_of(ring, vars.mean.as_slice(), sigma.as_slice())
}
