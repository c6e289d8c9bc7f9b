//! A diagnosis against the answer key, `truth.json`.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use crate::alternatives::DECISIVE;
use crate::average::Vars;
use crate::{Diagnosis, Finding, Verdict};

/// What a recording was made with.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Truth {
    /// The effects, none for an empty campaign.
    pub effects: Vec<TrueEffect>,
    /// The vars by name.
    pub vars: BTreeMap<String, f64>,
    /// Gain in `ln` posterior when kind, place and size are given.
    #[serde(default)]
    pub oracle_gain: Option<f64>,
}

/// One effect.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TrueEffect {
    /// Kind, in the words of the command line, or `unknown`.
    pub kind: String,
    /// Place.
    #[serde(default)]
    pub at: String,
    /// Amplitude, if the kind has one.
    #[serde(default)]
    pub amplitude: Option<f64>,
    /// What it is, where it is unknown to the library.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub what: Option<String>,
}

/// How right a verdict is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// All effects named at their places, and no other; or nothing, where there is nothing.
    Right,
    /// Some of several effects named, and no other.
    Partial,
    /// Not decided, with the truth among the alternatives.
    Listed,
    /// Not decided, without the truth; or said to be beyond the library.
    Open,
    /// Something is there and nothing was found.
    Missed,
    /// Something was named that is not there.
    Wrong,
}

/// What became of one effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// Named at its place, in a verdict that stands.
    Named,
    /// Not decided between causes that the recording cannot tell apart, this one among them, and proven on held-out frames.
    Together,
    /// Not decided, and listed.
    Listed,
    /// Not mentioned, where something else or nothing is said.
    Absent,
}

/// Why an answer key cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {what}")]
pub struct TruthError {
    path: String,
    what: String,
}

impl Truth {
    /// Read the key of a recording.
    ///
    /// # Errors
    /// [`TruthError`].
    pub fn read(folder: &Path) -> Result<Self, TruthError> {
        let path = folder.join("truth.json");
        let wrong = |what: String| TruthError { path: path.display().to_string(), what };
        let text = std::fs::read_to_string(&path).map_err(|error| wrong(error.to_string()))?;
        serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))
    }

    /// Grade a diagnosis.
    pub fn grade(&self, diagnosis: &Diagnosis) -> Grade {
        let effects: Vec<&Finding> = diagnosis.findings.iter().collect();
        let named = |truth: &TrueEffect| effects.iter().any(|finding| truth.is(finding));
        let listed = |truth: &TrueEffect| {
            effects.iter().any(|f| truth.is(f) || f.alternatives.iter().any(|other| truth.is(other)))
        };
        let library = self.effects.iter().all(|effect| effect.kind != "unknown");
        match diagnosis.verdict {
            Verdict::Consistent if self.effects.is_empty() => Grade::Right,
            Verdict::Consistent => Grade::Missed,
            Verdict::Identified
                if self.effects.len() == effects.len()
                    && !self.effects.is_empty()
                    && self.effects.iter().all(named) =>
            {
                Grade::Right
            }
            Verdict::Identified
                if effects.iter().all(|finding| self.effects.iter().any(|effect| effect.is(finding))) =>
            {
                Grade::Partial
            }
            Verdict::Identified => Grade::Wrong,
            _ if library && !self.effects.is_empty() && self.effects.iter().all(listed) => Grade::Listed,
            _ => Grade::Open,
        }
    }

    /// What became of each effect.
    pub fn fates(&self, diagnosis: &Diagnosis) -> Vec<Fate> {
        let findings = &diagnosis.findings;
        let listed = |truth: &TrueEffect, f: &Finding| truth.is(f) || f.alternatives.iter().any(|a| truth.is(a));
        let together = |truth: &TrueEffect, f: &Finding| {
            let is_one = truth.is(f) || f.alternatives.iter().any(|a| a.inseparable && truth.is(a));
            is_one && f.probability < DECISIVE && f.together() >= DECISIVE && f.is_proven()
        };
        let fate = |truth: &TrueEffect| match diagnosis.verdict {
            Verdict::Identified if findings.iter().any(|f| truth.is(f)) => Fate::Named,
            Verdict::Consistent | Verdict::Identified => Fate::Absent,
            _ if findings.iter().any(|f| together(truth, f)) => Fate::Together,
            _ if findings.iter().any(|f| listed(truth, f)) => Fate::Listed,
            _ => Fate::Absent,
        };
        self.effects.iter().map(fate).collect()
    }

    /// Pull of each named effect's amplitude, (found - true)/sigma.
    pub fn pulls(&self, diagnosis: &Diagnosis) -> Vec<f64> {
        let pull = |truth: &TrueEffect| {
            let finding = diagnosis.findings.iter().find(|finding| truth.is(finding))?;
            let (amplitude, sigma) = finding.amplitude;
            (sigma > 0.0).then_some((amplitude - truth.amplitude?) / sigma)
        };
        self.effects.iter().filter_map(pull).collect()
    }

    /// Normalised estimation error squared of the vars, per var; not a number if the key lacks one.
    pub fn nees(&self, names: &[String], vars: &Vars) -> f64 {
        let truth = |name: &String| self.vars.get(name).map_or(f64::NAN, |var| var.ln());
        let off = names.iter().zip(vars.mean.iter()).map(|(name, mean)| mean - truth(name));
        let off = DVector::from_iterator(names.len(), off);
        let solved = vars.covariance.clone().cholesky().map(|factor| factor.solve(&off));
        solved.map_or(f64::INFINITY, |solved| off.dot(&solved) / names.len() as f64)
    }
}

impl TrueEffect {
    /// True if a finding names this effect at its place.
    pub fn is(&self, finding: &Finding) -> bool {
        self.kind == finding.kind && same_place(&self.at, &finding.at)
    }

    /// `kind@place=amplitude`.
    pub fn label(&self) -> String {
        let at = if self.at.is_empty() { String::new() } else { format!("@{}", self.at) };
        let amplitude = self.amplitude.map_or(String::new(), |a| format!("={a:.4}"));
        format!("{}{at}{amplitude}", self.what.as_ref().unwrap_or(&self.kind))
    }
}

/// Two names of one place: pairs in either order, and the whole ring without a name.
fn same_place(one: &str, other: &str) -> bool {
    let parts = |text: &str| {
        let mut parts: Vec<String> = text.split(',').map(|part| part.trim().to_owned()).collect();
        parts.sort();
        parts
    };
    parts(one) == parts(other)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_the_same_in_either_order() {
        assert!(same_place("x_E4,x_E6", "x_E6, x_E4") && same_place("", ""));
        assert!(!same_place("x_E4", "x_E6") && !same_place("x_E4", ""));
    }
}
