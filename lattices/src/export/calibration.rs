//! The JSON of `fit`, `replay` and `diagnose`, as far as a lattice needs it.

use std::path::Path;

use serde::Deserialize;
use twin::limits;
use twin::unreadable;
use twin::{EffectText, Kind, Ring};

/// Probability from which a finding is part of the machine; below, it is a remark. That of the verdict `identified`.
const DECISIVE: f64 = 0.95;

/// What a recording said of a ring.
#[derive(Debug)]
pub struct Calibration {
    /// The recording.
    pub recording: String,
    /// File name of the lattice of its machine, if the result states it.
    pub lattice: Option<String>,
    /// Names and factors of the params that were fitted, and of dipoles with a gradient.
    pub strengths: Vec<(String, f64)>,
    /// Gradients [1/m^2] that are added to magnets by their names.
    pub added: Vec<(String, f64)>,
    /// Tunes at the recording's mean supply currents, if they are known.
    pub tunes: Option<[f64; 2]>,
    /// What was found beyond them, with its sentence.
    pub findings: Vec<(EffectText, String)>,
    /// Findings that are not certain, or that no effect of the library describes.
    pub open: Vec<String>,
}

/// Why a file is no result of a fit to this ring.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// The file cannot be read.
    #[error("{path}: {}", unreadable(source))]
    Read {
        /// The file.
        path: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Not the JSON of a result.
    #[error("{path}: {source}")]
    Syntax {
        /// The file.
        path: String,
        /// Position and reason.
        source: serde_json::Error,
    },
    /// Neither `vars` nor `vars_after`.
    #[error("{path}: expected vars, as fit and replay write them, or vars_after of diagnose; found neither")]
    NoVars {
        /// The file.
        path: String,
    },
    /// A var that the ring does not have.
    #[error("{path}: no var {name:?} in {machine}; --machine names its file")]
    Name {
        /// The file.
        path: String,
        /// The name in the file.
        name: String,
        /// The machine.
        machine: String,
    },
    /// The result is of another machine, whose vars may have the same names.
    #[error("{path}, key lattice: expected {expected:?}, found {found:?}: the result is of another machine")]
    Lattice {
        /// The file.
        path: String,
        /// That of the machine.
        expected: String,
        /// That of the result.
        found: String,
    },
    /// A var without a result.
    #[error("{path}: expected a var {name} of {machine}, found none")]
    Missing {
        /// The file.
        path: String,
        /// The name in the machine.
        name: String,
        /// The machine.
        machine: String,
    },
    /// A factor that no magnet has.
    #[error("{path}: var {name}: expected a mean above 0, found {mean}")]
    Strength {
        /// The file.
        path: String,
        /// The var.
        name: String,
        /// Its factor.
        mean: f64,
    },
}

#[derive(Deserialize)]
struct ResultFile {
    #[serde(default)]
    recording: serde_json::Value,
    lattice: Option<String>,
    vars: Option<Vec<Var>>,
    vars_after: Option<Vec<Var>>,
    #[serde(default)]
    other: Vec<Other>,
    tunes: Option<Tunes>,
    #[serde(default)]
    findings: Vec<Finding>,
}

#[derive(Deserialize)]
struct Tunes {
    x: f64,
    y: f64,
}

#[derive(Deserialize)]
struct Var {
    name: String,
    mean: f64,
}

/// What a measured matrix said beside the strengths; a gradient that is added names its magnets.
#[derive(Deserialize)]
struct Other {
    #[serde(default)]
    elements: Vec<String>,
    mean: f64,
}

#[derive(Deserialize)]
struct Finding {
    kind: String,
    #[serde(default)]
    at: Option<String>,
    #[serde(default)]
    amplitude: Option<f64>,
    probability: f64,
    #[serde(default)]
    sentence: Option<String>,
}

impl Calibration {
    /// Read a result.
    ///
    /// # Errors
    /// [`CalibrationError`].
    pub fn read(path: &Path) -> Result<Self, CalibrationError> {
        let shown = path.display().to_string();
        let text = limits::FILE.text(path).map_err(|source| CalibrationError::Read { path: shown.clone(), source })?;
        Self::parse(&text, &shown)
    }

    /// Read the text of a result; `path` appears in errors.
    ///
    /// # Errors
    /// [`CalibrationError`].
    pub fn parse(text: &str, path: &str) -> Result<Self, CalibrationError> {
        let file: ResultFile =
            limits::json(text).map_err(|source| CalibrationError::Syntax { path: path.into(), source })?;
        let vars = file.vars.or(file.vars_after).ok_or_else(|| CalibrationError::NoVars { path: path.into() })?;
        if let Some(wrong) = vars.iter().find(|var| var.mean <= 0.0) {
            return Err(CalibrationError::Strength { path: path.into(), name: wrong.name.clone(), mean: wrong.mean });
        }
        let (mut findings, mut open) = (Vec::new(), Vec::new());
        for finding in &file.findings {
            match finding.effect() {
                Some(effect) if finding.probability >= DECISIVE => findings.push((effect, finding.words())),
                _ => open.push(format!("{} (probability {:.2})", finding.words(), finding.probability)),
            }
        }
        let strengths = vars.into_iter().map(|var| (var.name, var.mean)).collect();
        let of_magnets = |one: Other| one.elements.into_iter().map(move |name| (name, one.mean));
        let added = file.other.into_iter().flat_map(of_magnets).collect();
        let tunes = file.tunes.map(|tunes| [tunes.x, tunes.y]);
        let (recording, lattice) = (recordings(&file.recording), file.lattice);
        Ok(Self { recording, lattice, strengths, added, tunes, findings, open })
    }

    /// The ring with the strengths that were found.
    ///
    /// # Errors
    /// [`CalibrationError::Lattice`], [`CalibrationError::Name`], [`CalibrationError::Missing`]: the result of another ring.
    pub fn strengthened(&self, ring: &Ring, path: &Path) -> Result<Ring, CalibrationError> {
        if let Some(found) = self.lattice.clone().filter(|lattice| *lattice != ring.file) {
            let (path, expected) = (path.display().to_string(), ring.file.clone());
            return Err(CalibrationError::Lattice { path, expected, found });
        }
        let mut found = ring.with_vars(&self.vars(ring, path)?);
        for (name, factor) in &self.strengths {
            // that of a quadrupole is one of its param
            if let Some(gradient @ (_, true)) = gradient_of(&mut found, name) {
                *gradient.0 *= factor;
            }
        }
        for (name, added) in &self.added {
            match gradient_of(&mut found, name) {
                Some((gradient, _)) => *gradient += added,
                None => return Err(self.no_var(name, ring, path)),
            }
        }
        Ok(found)
    }

    fn no_var(&self, name: &str, ring: &Ring, path: &Path) -> CalibrationError {
        let (path, machine) = (path.display().to_string(), ring.name.clone());
        CalibrationError::Name { path, name: name.into(), machine }
    }

    /// The factors in the order of the ring's params.
    fn vars(&self, ring: &Ring, path: &Path) -> Result<Vec<f64>, CalibrationError> {
        let names = ring.var_names();
        let is_dipole = |name: &str| {
            let is_it = |one: &twin::Element| one.name == name && matches!(one.kind, Kind::Bend(_));
            ring.elements.iter().any(is_it)
        };
        let is_unknown = |name: &str| !names.iter().any(|own| own == name) && !is_dipole(name);
        if let Some((name, _)) = self.strengths.iter().find(|(name, _)| is_unknown(name)) {
            return Err(self.no_var(name, ring, path));
        }
        let (path, machine) = (path.display().to_string(), ring.name.clone());
        let mean = |name: &String| self.strengths.iter().find(|(own, _)| own == name).map(|(_, mean)| *mean);
        let missing = |name: &String| CalibrationError::Missing {
            path: path.clone(),
            name: name.clone(),
            machine: machine.clone(),
        };
        names.iter().map(|name| mean(name).ok_or_else(|| missing(name))).collect()
    }
}

/// Gradient [1/m^2] of a magnet of some name, and whether it is a dipole's.
fn gradient_of<'r>(ring: &'r mut Ring, name: &str) -> Option<(&'r mut f64, bool)> {
    let mut named = ring.elements.iter_mut().filter(|one| one.name == name);
    named.find_map(|one| {
        let is_dipole = matches!(one.kind, Kind::Bend(_));
        one.kind.gradient_mut().map(|gradient| (gradient, is_dipole))
    })
}

impl Finding {
    /// The effect in the library that it names, if it names one.
    fn effect(&self) -> Option<EffectText> {
        let (place, amplitude) = (self.at.clone().unwrap_or_default(), self.amplitude.unwrap_or(1.0));
        Some(EffectText { kind: self.kind.parse().ok()?, place, amplitude })
    }

    fn words(&self) -> String {
        self.sentence.clone().unwrap_or_else(|| {
            let amplitude = self.amplitude.map_or(String::new(), |a| format!(" = {a}"));
            format!("{} {}{amplitude}", self.kind, self.at.as_deref().unwrap_or_default())
        })
    }
}

/// One name, or those of several recordings of one machine.
fn recordings(value: &serde_json::Value) -> String {
    match value {
        serde_json::Value::String(name) => name.clone(),
        serde_json::Value::Array(names) => names.iter().map(recordings).collect::<Vec<_>>().join(", "),
        _ => "a recording without a name".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Calibration, CalibrationError> {
        Calibration::parse(text, "fit.json")
    }

    #[test]
    fn a_diagnosis_gives_strengths_findings_and_open_questions() {
        let text = r#"{"recording": ["a", "b"], "vars_before": [], "vars_after": [{"name": "A2", "mean": 1.01, "sigma": 0.1}],
            "findings": [{"kind": "quad_roll", "at": "D8", "amplitude": 0.01, "probability": 0.99, "sentence": "D8 is rolled"},
                         {"kind": "bpm_gain", "at": "x_E4", "amplitude": 0.1, "probability": 0.6},
                         {"kind": "unexplained", "at": "x_E4", "amplitude": 0.0, "probability": 0.99}]}"#;
        let result = parse(text).unwrap();
        assert_eq!((result.recording.as_str(), result.strengths), ("a, b", vec![("A2".into(), 1.01)]));
        assert_eq!(result.findings, [("quad_roll@D8=0.01".parse().unwrap(), "D8 is rolled".into())]);
        assert_eq!(result.open, ["bpm_gain x_E4 = 0.1 (probability 0.60)", "unexplained x_E4 = 0 (probability 0.99)"]);
    }

    #[test]
    fn what_is_no_result_of_this_ring_says_what_disagrees() {
        let message = |text: &str| {
            let result = parse(text).and_then(|r| r.strengthened(&Ring::booster(), Path::new("fit.json")));
            result.unwrap_err().to_string()
        };
        assert_eq!(
            message(r#"{"tunes": {"x": 4.83, "y": 4.68}}"#),
            "fit.json: expected vars, as fit and replay write them, or vars_after of diagnose; found neither"
        );
        assert_eq!(
            message(r#"{"vars": [{"name": "01F", "mean": 1.0}]}"#),
            "fit.json: no var \"01F\" in AGS Booster (BNL), deck; --machine names its file"
        );
        assert_eq!(
            message(r#"{"vars": [{"name": "A2", "mean": 1.0}]}"#),
            "fit.json: expected a var A4 of AGS Booster (BNL), deck, found none"
        );
        assert_eq!(
            message(r#"{"vars": [{"name": "A2", "mean": -1.0}]}"#),
            "fit.json: var A2: expected a mean above 0, found -1"
        );
        assert_eq!(
            message(r#"{"lattice": "booster.json", "vars": []}"#),
            "fit.json, key lattice: expected \"booster-deck.json\", found \"booster.json\": the result is of another machine"
        );
        assert!(message("{").starts_with("fit.json: EOF while parsing"));
    }

    /// A factor of a dipole's gradient, and gradients that are added to a dipole and to a magnet without one.
    #[test]
    fn gradients_of_dipoles_and_added_ones_are_those_of_the_ring() {
        let ring = r#"{"name": "ring", "circumference_m": 6, "k1": {}, "reference": {"particle": "proton", "kinetic_energy_GeV": 1},
            "elements": [{"name": "Q.0", "type": "quadrupole", "s_start": 0, "length": 1, "k1": 2},
                         {"name": "Q.1", "type": "quadrupole", "s_start": 1, "length": 1, "k1": 0, "fit": false},
                         {"name": "B.2", "type": "sbend", "s_start": 2, "length": 1, "angle": 0.1, "k1": -0.5},
                         {"name": "B.3", "type": "sbend", "s_start": 3, "length": 1, "angle": 0.1, "k1": 0}]}"#;
        let ring = Ring::parse(ring, "ring.json").unwrap();
        let result = parse(
            r#"{"vars": [{"name": "Q.0", "mean": 1.01}, {"name": "B.2", "mean": 0.98}],
                "other": [{"kind": "bpm_gain", "at": "x_M.0", "mean": 1.1, "sigma": 0.1},
                          {"kind": "added_gradient", "at": "Q.1", "elements": ["Q.1", "B.3"], "mean": 0.004, "sigma": 0.001}]}"#,
        );
        let mut found = result.unwrap().strengthened(&ring, Path::new("fit.json")).unwrap();
        let gradients = ["Q.0", "Q.1", "B.2", "B.3"].map(|name| *gradient_of(&mut found, name).unwrap().0);
        assert_eq!(gradients, [2.02, 0.004, -0.49, 0.004]);
    }
}
