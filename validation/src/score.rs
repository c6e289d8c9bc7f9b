//! The score of a diagnosis against the truth of its recording, `truth.json`.

use std::collections::BTreeMap;
use std::path::Path;

use diagnosis::{DECISIVE, Diagnosis, Finding, Term, Vars, Verdict};
use nalgebra::DVector;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use twin::limits::{self, FILE};
use twin::{EffectError, EffectKind, Ring};

/// What a recording was made with.
#[derive(Debug, Clone)]
pub struct Truth {
    /// The effects, none for an empty campaign.
    pub effects: Vec<TrueEffect>,
    /// The vars by name.
    pub vars: BTreeMap<String, f64>,
    /// Gain in `ln` posterior when kind, place and size are given.
    pub oracle_gain: Option<f64>,
}

/// One effect.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueEffect {
    /// What it is, and where.
    pub cause: TrueCause,
    /// Amplitude, if it has one.
    pub amplitude: Option<f64>,
}

/// What an effect is.
#[derive(Debug, Clone, PartialEq)]
pub enum TrueCause {
    /// One of the library.
    Effect(Term),
    /// One of the library whose place is given by the recording's header and not by the key, as for a radial loop.
    Kind(EffectKind),
    /// Physics that the library does not hold.
    Unmodelled {
        /// What it is.
        what: String,
        /// The name of its place.
        at: String,
    },
}

/// The file.
#[derive(Deserialize)]
struct Key {
    effects: Vec<Entry>,
    vars: BTreeMap<String, f64>,
    #[serde(default)]
    oracle_gain: Option<f64>,
}

/// One effect in the file: a kind of the library in the words of the command line, or any other word.
#[derive(Deserialize)]
struct Entry {
    kind: String,
    #[serde(default)]
    at: String,
    #[serde(default)]
    amplitude: Option<f64>,
    #[serde(default)]
    what: Option<String>,
}

/// How right a verdict is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// All effects named at their places, and no other; or nothing, where there is nothing.
    Right,
    /// Some of several effects named, and no other.
    Partial,
    /// Not decided, with the truth among the alternatives.
    Listed,
    /// Not decided, without the truth; or called unexplained.
    Open,
    /// An effect is present and nothing was found.
    Missed,
    /// A false identification.
    Wrong,
}

/// What became of one effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// Named at its place, in a verdict that stands.
    Named,
    /// Not decided between causes that the recording cannot tell apart, this one among them, and validated on held-out frames.
    Together,
    /// Not decided, and listed.
    Listed,
    /// Not mentioned.
    Absent,
}

/// Why a key cannot be read.
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
    /// A file that cannot be read, or a key that is none.
    pub fn read(folder: &Path, ring: &Ring) -> Result<Self, TruthError> {
        let path = folder.join("truth.json");
        let wrong = |what: String| TruthError { path: path.display().to_string(), what };
        let text = FILE.text(&path).map_err(|error| wrong(error.to_string()))?;
        let Key { effects, vars, oracle_gain } = limits::json(&text).map_err(|error| wrong(error.to_string()))?;
        let effects = effects.into_iter().map(|entry| entry.resolve(ring)).collect::<Result<_, _>>();
        Ok(Self { effects: effects.map_err(|error| wrong(error.to_string()))?, vars, oracle_gain })
    }

    /// Grade a diagnosis.
    pub fn grade(&self, diagnosis: &Diagnosis) -> Grade {
        let effects: Vec<&Finding> = diagnosis.findings.iter().collect();
        let named = |truth: &TrueEffect| effects.iter().any(|finding| truth.is(finding));
        let listed =
            |truth: &TrueEffect| effects.iter().any(|f| truth.is(f) || f.others().any(|other| truth.is(other)));
        let library = self.effects.iter().all(|effect| !effect.is_unmodelled());
        match diagnosis.verdict {
            Verdict::Consistent if self.effects.is_empty() => Grade::Right,
            Verdict::Consistent if self.effects.iter().all(|effect| effect.is_told(diagnosis)) => Grade::Open,
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
        let listed = |truth: &TrueEffect, f: &Finding| truth.is(f) || f.others().any(|other| truth.is(other));
        let together = |truth: &TrueEffect, f: &Finding| {
            let is_one = truth.is(f) || f.alternatives.iter().any(|a| a.inseparable && truth.is(a));
            is_one && f.probability < DECISIVE && f.together() >= DECISIVE && f.is_validated()
        };
        let fate = |truth: &TrueEffect| match diagnosis.verdict {
            Verdict::Identified if findings.iter().any(|f| truth.is(f)) => Fate::Named,
            _ if truth.is_told(diagnosis) => Fate::Listed,
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

    /// Normalised estimation error squared of the vars, per var; NaN if the key lacks one.
    pub fn nees(&self, names: &[String], vars: &Vars) -> f64 {
        let truth = names.iter().map(|name| self.vars.get(name).map_or(f64::NAN, |var| var.ln()));
        vars.nees(&DVector::from_iterator(names.len(), truth))
    }
}

impl Entry {
    fn resolve(self, ring: &Ring) -> Result<TrueEffect, EffectError> {
        let Self { kind, at, amplitude, what } = self;
        let cause = match kind.parse::<EffectKind>() {
            Err(_) => TrueCause::Unmodelled { what: what.unwrap_or(kind), at },
            Ok(kind) => match Term::at(kind, &at, ring) {
                Ok(term) => TrueCause::Effect(term),
                Err(_) if at.is_empty() => TrueCause::Kind(kind),
                Err(error) => return Err(error),
            },
        };
        Ok(TrueEffect { cause, amplitude })
    }
}

impl TrueEffect {
    /// True if a finding names this effect at its place.
    pub fn is(&self, finding: &Finding) -> bool {
        match (&self.cause, finding.term()) {
            (TrueCause::Effect(term), Some(found)) => term == found,
            (TrueCause::Kind(kind), Some(found)) => *kind == found.kind,
            (TrueCause::Unmodelled { at, .. }, None) => *at == finding.at,
            (TrueCause::Effect(_) | TrueCause::Kind(_), None) | (TrueCause::Unmodelled { .. }, Some(_)) => false,
        }
    }

    /// True for physics that the library does not hold, of a monitor that is said to wander.
    pub fn is_told(&self, diagnosis: &Diagnosis) -> bool {
        matches!(&self.cause, TrueCause::Unmodelled { at, .. } if diagnosis.wandering().contains(at))
    }

    /// True for physics that the library does not hold.
    pub fn is_unmodelled(&self) -> bool {
        matches!(self.cause, TrueCause::Unmodelled { .. })
    }

    /// Its kind in the library.
    pub fn kind(&self) -> Option<EffectKind> {
        match self.cause {
            TrueCause::Effect(term) => Some(term.kind),
            TrueCause::Kind(kind) => Some(kind),
            TrueCause::Unmodelled { .. } => None,
        }
    }

    /// `kind@place=amplitude`.
    pub fn label(&self, ring: &Ring) -> String {
        let what = match &self.cause {
            TrueCause::Effect(term) => term.label(ring),
            TrueCause::Kind(kind) => kind.word().into(),
            TrueCause::Unmodelled { what, at } if at.is_empty() => what.clone(),
            TrueCause::Unmodelled { what, at } => format!("{what}@{at}"),
        };
        format!("{what}{}", self.amplitude.map_or(String::new(), |a| format!("={a:.4}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolved(entry: &str) -> Result<TrueEffect, EffectError> {
        serde_json::from_str::<Entry>(entry).unwrap().resolve(&Ring::booster())
    }

    #[test]
    fn a_key_names_effects_and_what_is_none() {
        let of = |entry: &str| resolved(entry).unwrap();
        let pair = |at: &str| of(&format!(r#"{{"kind":"bpm_swap","at":"{at}"}}"#));
        assert_eq!(pair("x_E4,x_E6"), pair("x_E6, x_E4"));
        assert_ne!(pair("x_E4,x_E6"), pair("x_E4,x_E8"));
        assert_eq!(of(r#"{"kind":"radial_loop","amplitude":0.8}"#).cause, TrueCause::Kind(EffectKind::RadialLoop));
        let crosstalk = of(r#"{"kind":"unknown","at":"x_D2","amplitude":0.1,"what":"bpm_crosstalk"}"#);
        assert_eq!(
            (crosstalk.is_unmodelled(), crosstalk.label(&Ring::booster()).as_str()),
            (true, "bpm_crosstalk@x_D2=0.1000")
        );
        assert!(of(r#"{"kind":"var_step","at":"C3"}"#).is_unmodelled());
        assert!(resolved(r#"{"kind":"bpm_gain","at":"x_E99"}"#).is_err());
    }
}
