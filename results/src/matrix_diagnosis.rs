//! The diagnosis of a measured response matrix: as JSON, in words and as tables.

use core::fmt;

use inference::THROUGHOUT;
use measured::believed::Departure;
use measured::diagnose::{Alternative, Diagnosis, Finding, Imperfection, What};
use measured::held_out::HeldOut;
use measured::{Against, Fit, Folder, Kind, Wiring};
use schemars::JsonSchema;
use serde::Serialize;
use twin::Rf;

use crate::fit_result::Monitor;
use crate::matrix_result::{DOUBT, MatrixFit, MatrixVar, Other, fitted_rows, others, overstated};
use crate::output::{fill, table};

/// Findings that the sentence says.
const SAID: usize = 6;
/// Instruments that are listed as worse than the others.
const LISTED: usize = 12;

/// What a matrix's model lacks. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct MatrixDiagnosis {
    pub recording: String,
    pub verdict: &'static str,
    pub sentence: String,
    pub findings: Vec<MatrixFinding>,
    /// What an ordinary ring has, family by family.
    pub imperfections: Vec<ImperfectionResult>,
    /// What would be named anywhere else.
    pub limits: Vec<LimitResult>,
    pub unexplained: Vec<UnexplainedResult>,
    pub monitors: Vec<Monitor>,
    pub fit: Predictions,
    pub vars_before: Vec<MatrixVar>,
    pub vars_after: Vec<MatrixVar>,
    /// Gradients that are added, beside `vars_after`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub other: Vec<Other>,
    /// The fit as LOCO has it.
    pub loco: MatrixFit,
}

/// Something that was found.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct MatrixFinding {
    pub kind: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub s_m: Option<f64>,
    pub amplitude: f64,
    pub sigma: f64,
    pub unit: &'static str,
    pub log_evidence_gain: f64,
    pub probability: f64,
    pub alternatives: Vec<AlternativeResult>,
    pub sentence: String,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct AlternativeResult {
    pub kind: &'static str,
    pub at: String,
    pub amplitude: f64,
    pub sigma: f64,
    pub log_evidence_gain: f64,
    pub probability: f64,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct ImperfectionResult {
    pub kind: &'static str,
    pub at: String,
    pub members: usize,
    pub mean: f64,
    pub scatter: f64,
    /// Of one member, median.
    pub sigma: f64,
    pub unit: &'static str,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct LimitResult {
    pub kind: &'static str,
    pub at: String,
    pub amplitude: f64,
    pub sigma: f64,
    pub unit: &'static str,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct UnexplainedResult {
    pub at: String,
    pub rms_um: f64,
    pub ratio: f64,
}

/// Elements predicted without themselves, by the fit as LOCO has it and with what was found.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Predictions {
    pub before: PredictionResult,
    pub after: PredictionResult,
    pub elpd_gain: f64,
    pub elpd_gain_se: f64,
}

#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct PredictionResult {
    /// By the stated noise.
    pub chi2_per_dof: f64,
    pub heldout_rms_mm: f64,
    pub heldout_elpd: f64,
}

impl MatrixDiagnosis {
    /// Of a diagnosis, with the fit that it began from, and of what the matrix says against a model that is believed, if one is.
    pub fn of(
        folder: &Folder,
        fitted: &Fit,
        diagnosis: &Diagnosis,
        against: Option<&Against>,
        loco: MatrixFit,
    ) -> Self {
        let findings: Vec<MatrixFinding> = match against {
            Some(against) => {
                let cables = against.wiring.iter().map(|cable| MatrixFinding::of_cable(folder, cable));
                cables.chain(against.departures.iter().map(MatrixFinding::of_departure)).collect()
            }
            None => diagnosis.findings.iter().map(MatrixFinding::of_finding).collect(),
        };
        let verdict = match against {
            Some(_) if !fitted.has_ended => "unexplained",
            Some(_) if findings.is_empty() => "consistent",
            Some(_) => "identified",
            None => diagnosis.verdict.word(),
        };
        let hierarchy = &diagnosis.hierarchy;
        let strengths = hierarchy.strengths();
        let var = |&(row, group): &(usize, usize)| MatrixVar::of_row(folder, row, strengths[group]);
        let value = |unknown: usize| [hierarchy.values[unknown], hierarchy.uncertainty.sigma[unknown]];
        let mut other = others(folder, (&hierarchy.groups, &hierarchy.unknowns), value);
        other.retain(|one| !one.elements.is_empty());
        let unexplained = diagnosis.unexplained.iter();
        let unexplained =
            unexplained.map(|one| UnexplainedResult { at: one.at.clone(), rms_um: 1e3 * one.rms, ratio: one.ratio });
        Self {
            recording: folder.name.clone(),
            verdict,
            sentence: sentence(fitted, &findings, diagnosis),
            findings,
            imperfections: diagnosis.imperfections.iter().map(ImperfectionResult::from).collect(),
            limits: diagnosis.limits.iter().map(LimitResult::from).collect(),
            unexplained: unexplained.collect(),
            monitors: loco.monitors.clone(),
            fit: Predictions::from(&diagnosis.held_out),
            vars_before: loco.vars.clone(),
            vars_after: fitted_rows(fitted).iter().map(var).collect(),
            other,
            loco,
        }
    }
}

/// What matters most first.
fn sentence(fitted: &Fit, findings: &[MatrixFinding], diagnosis: &Diagnosis) -> String {
    // what was found of a fit that did not end is of no ring
    let doubt = (!fitted.has_ended).then(|| DOUBT.to_owned());
    let more = findings.len().saturating_sub(SAID);
    let worst: Vec<&str> = diagnosis.unexplained.iter().take(SAID).map(|one| one.at.as_str()).collect();
    let worse = (!worst.is_empty())
        .then(|| format!("readings of {} are explained worse than those of others", worst.join(", ")));
    let nothing = findings.is_empty() && fitted.has_ended;
    let large = diagnosis.imperfections.iter().filter(|one| one.is_large()).map(|one| {
        let [scatter, ordinary] = [one.scatter, one.ordinary].map(|value| number(value, unit(one.word)));
        format!("{} scatter by {scatter}, in an ordinary ring by {ordinary}", members(one.word, &one.class))
    });
    let large: Vec<String> = if fitted.has_ended { large.collect() } else { Vec::new() };
    let constant = |one: &Imperfection| format!("kick constant, {} {:+.1} %", one.class, 1e2 * one.mean);
    let constants: Vec<String> =
        diagnosis.imperfections.iter().filter(|one| one.is_kick_constant()).map(constant).collect();
    let off = (!constants.is_empty()).then(|| format!("{THROUGHOUT}: {}", constants.join(", ")));
    let parts: Vec<String> = (doubt.into_iter())
        .chain(off)
        .chain(nothing.then(|| "nothing stands out of what its kind does everywhere".to_owned()))
        .chain(findings.iter().take(SAID).map(|finding| finding.sentence.clone()))
        .chain((more > 0).then(|| format!("{more} more are listed")))
        .chain(large)
        .chain(worse)
        .chain(fitted.overstated_noise().map(overstated))
        .collect();
    parts.join("; ")
}

/// Members of a family.
pub(crate) fn members(kind: &str, class: &str) -> String {
    match (kind, class) {
        ("bpm_gain", plane) => format!("gains of {plane} monitors"),
        ("bpm_coupling", plane) => format!("couplings of {plane} monitors"),
        ("corrector_gain", plane) => format!("kicks of {plane} correctors"),
        ("corrector_coupling", plane) => format!("couplings of {plane} correctors"),
        ("quadrupole_gradient", "families") => "strengths of supplies".to_owned(),
        ("quadrupole_gradient", sort) => format!("strengths of {sort}"),
        ("skew_gradient", sort) => format!("skew gradients in {sort}"),
        ("wiggler_focusing", sort) => format!("vertical focusing strengths of {sort}"),
        (_, sort) => format!("further gradients in {sort}"),
    }
}

/// Unit of an amplitude.
fn unit(kind: &str) -> &'static str {
    match kind {
        "skew_gradient" | "stray_gradient" | "dipole_gradient" | "wiggler_focusing" => "1/m",
        "added_gradient" => "1/m^2",
        _ => "1",
    }
}

/// A relative distance as people read it.
fn beside(amplitude: f64, sigma: f64) -> String {
    let word = if amplitude < 0.0 { "less" } else { "more" };
    format!("{:.1} ± {:.1} % {word}", 1e2 * amplitude.abs(), 1e2 * sigma)
}

/// A number as people read it.
pub(crate) fn number(value: f64, unit: &str) -> String {
    match unit {
        "1/m" | "1/m^2" => format!("{value:.5} {}", &unit[1..]),
        _ => format!("{:.2} %", 1e2 * value),
    }
}

/// An amplitude as people read it.
fn size(amplitude: f64, sigma: f64, unit: &str) -> String {
    match unit {
        "1/m" | "1/m^2" => format!("{amplitude:+.5} ± {sigma:.5} {}", &unit[1..]),
        _ => format!("{:+.2} ± {:.2} %", 1e2 * amplitude, 1e2 * sigma),
    }
}

impl MatrixFinding {
    fn of_finding(finding: &Finding) -> Self {
        let Finding { what, word, at, s, amplitude, sigma, gain, probability, alternatives } = finding;
        Self {
            kind: word,
            at: (!at.is_empty()).then(|| at.clone()),
            s_m: *s,
            amplitude: *amplitude,
            sigma: *sigma,
            unit: unit(word),
            log_evidence_gain: *gain,
            probability: *probability,
            alternatives: alternatives.iter().map(AlternativeResult::from).collect(),
            sentence: match what {
                What::Cable(cable) => cable_sentence(cable, at),
                What::Hold(held) => hold_sentence(*held, *amplitude, *sigma),
                What::Member(kind) => member_sentence(*kind, finding),
            },
        }
    }

    fn of_cable(folder: &Folder, cable: &Wiring) -> Self {
        let (kind, at) = cable.named(folder);
        let sentence = cable_sentence(cable, &at);
        Self { at: Some(at), amplitude: 1.0, probability: 1.0, ..Self::bare(kind, sentence) }
    }

    fn of_departure(one: &Departure) -> Self {
        let (kind, amplitude, sigma) = (one.kind.word(), one.amplitude, one.sigma);
        let sentence = format!("{kind} at {} is off the model by {}", one.at, size(amplitude, sigma, unit(kind)));
        let gain = one.log_evidence_gain;
        let bare = Self::bare(kind, sentence);
        Self {
            at: Some(one.at.clone()),
            amplitude,
            sigma,
            log_evidence_gain: gain,
            probability: 1.0 / (1.0 + (-gain).exp()),
            ..bare
        }
    }

    fn bare(kind: &'static str, sentence: String) -> Self {
        let (at, s_m, alternatives) = (None, None, Vec::new());
        Self {
            kind,
            at,
            s_m,
            amplitude: 0.0,
            sigma: 0.0,
            unit: unit(kind),
            log_evidence_gain: 0.0,
            probability: 0.0,
            alternatives,
            sentence,
        }
    }
}

fn member_sentence(kind: Kind, finding: &Finding) -> String {
    let Finding { word, at, amplitude, sigma, probability, .. } = finding;
    let size = size(*amplitude, *sigma, unit(word));
    let said = match kind {
        Kind::MonitorGain(_) => {
            format!("{at} reads {} than the other monitors of its plane", beside(*amplitude, *sigma))
        }
        Kind::CorrectorGain(_) => {
            format!("{at} kicks {} than the other correctors of its plane", beside(*amplitude, *sigma))
        }
        Kind::MonitorCoupling(_) => format!("{at} reads {size} of the other plane"),
        Kind::CorrectorCoupling(_) => format!("{at} kicks {size} of its kick in the other plane"),
        Kind::Strength(_) => format!("{at} is {size} off the strengths of its kind"),
        Kind::Skew(_) => format!("{at} has a skew gradient of {size}"),
        Kind::Wiggler(_) => format!("{at} focuses vertically by {size}, as a wiggler does"),
        _ => format!("{at} has a gradient of {size} that the lattice has not"),
    };
    if finding.is_named() { said } else { format!("perhaps {said} (P {probability:.2})") }
}

fn hold_sentence(held: Rf, amplitude: f64, sigma: f64) -> String {
    let what = match held {
        Rf::FixedFrequency => "the RF frequency is held, not the momentum",
        Rf::FixedMomentum => "the momentum is held, not the RF frequency",
    };
    format!("{what}: the term of the path length has {amplitude:.3} ± {sigma:.3} of its size")
}

fn cable_sentence(cable: &Wiring, at: &str) -> String {
    let places = match at.rsplit_once(',') {
        Some((first, last)) => format!("{} and {last}", first.replace(',', ", ")),
        None => at.to_owned(),
    };
    match cable {
        Wiring::MonitorsExchanged(_) | Wiring::CorrectorsExchanged(_) => format!("{places} are exchanged"),
        Wiring::MonitorReversed(_) => format!("{places} reads with the other sign"),
        Wiring::CorrectorReversed(_) => format!("{places} kicks with the other sign"),
        Wiring::MonitorsDead(_) => format!("{places}: dead, and left out"),
        Wiring::CorrectorsDead(_) => format!("{places}: without a kick, and left out"),
        Wiring::PlaneReversed(_) => format!("all kicks of plane {places} have the other sign, or all its readings"),
    }
}

impl From<&Alternative> for AlternativeResult {
    fn from(one: &Alternative) -> Self {
        let [amplitude, sigma] = one.amplitude;
        Self {
            kind: one.word,
            at: one.at.clone(),
            amplitude,
            sigma,
            log_evidence_gain: one.gain,
            probability: one.probability,
        }
    }
}

impl From<&Imperfection> for ImperfectionResult {
    fn from(one: &Imperfection) -> Self {
        Self {
            kind: one.word,
            at: one.class.clone(),
            members: one.count,
            mean: one.mean,
            scatter: one.scatter,
            sigma: one.sigma,
            unit: unit(one.word),
        }
    }
}

impl From<&measured::diagnose::Limit> for LimitResult {
    fn from(one: &measured::diagnose::Limit) -> Self {
        Self { kind: one.word, at: one.at.clone(), amplitude: one.amplitude, sigma: one.sigma, unit: unit(one.word) }
    }
}

impl From<&[HeldOut; 2]> for Predictions {
    fn from([before, after]: &[HeldOut; 2]) -> Self {
        let (elpd_gain, elpd_gain_se) = after.gain_over(before);
        let result = |one: &HeldOut| PredictionResult {
            chi2_per_dof: one.chi2,
            heldout_rms_mm: one.rms,
            heldout_elpd: one.log_density.iter().sum(),
        };
        Self { before: result(before), after: result(after), elpd_gain, elpd_gain_se }
    }
}

impl fmt::Display for MatrixDiagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {}\n\n{}\n", self.recording, self.verdict, fill(&self.sentence))?;
        let mut rows = table(["missing", "at", "amplitude", "gain / nat", "P"]);
        for one in &self.findings {
            let amplitude = if one.sigma > 0.0 { size(one.amplitude, one.sigma, one.unit) } else { String::new() };
            let (gain, probability) = (format!("{:.1}", one.log_evidence_gain), format!("{:.3}", one.probability));
            rows.add_row([one.kind.into(), one.at.clone().unwrap_or_default(), amplitude, gain, probability]);
            for other in one.alternatives.iter().take(3) {
                let amplitude = size(other.amplitude, other.sigma, unit(other.kind));
                let (gain, probability) =
                    (format!("{:.1}", other.log_evidence_gain), format!("{:.3}", other.probability));
                rows.add_row([format!("  or {}", other.kind), other.at.clone(), amplitude, gain, probability]);
            }
        }
        if !self.findings.is_empty() {
            writeln!(f, "{rows}\n")?;
        }
        let Predictions { before, after, elpd_gain, elpd_gain_se } = &self.fit;
        let predicted = format!(
            "Elements held out are predicted within {:.2} um rms by the fit as LOCO has it, within {:.2} um with what an ordinary ring has and what \
             was found: a gain of {elpd_gain:.0} ± {elpd_gain_se:.0} nat.",
            1e3 * before.heldout_rms_mm,
            1e3 * after.heldout_rms_mm
        );
        writeln!(f, "{}\n", fill(&predicted))?;
        let mut rows = table(["ordinary", "members", "mean", "scatter", "sigma of one"]);
        for one in &self.imperfections {
            let numbers = [one.mean, one.scatter, one.sigma].map(|value| number(value, one.unit));
            rows.add_row([members(one.kind, &one.at), one.members.to_string()].into_iter().chain(numbers));
        }
        write!(f, "{rows}")?;
        if self.unexplained.is_empty() {
            return Ok(());
        }
        let mut rows = table(["instrument", "residuals / um", "mean square over the others'"]);
        for one in self.unexplained.iter().take(LISTED) {
            rows.add_row([one.at.clone(), format!("{:.1}", one.rms_um), format!("{:.1}", one.ratio)]);
        }
        write!(f, "\n\n{rows}")
    }
}
