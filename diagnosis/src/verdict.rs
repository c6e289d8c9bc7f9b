//! The verdict, as a word and as a sentence.

use serde::{Deserialize, Serialize};
use twin::{EffectKind, Measured, Unit};

use super::alternatives::{Alternative, Cause, Competition, DECISIVE, SUSPICIOUS};
use super::data::Data;
use super::error::FitError;
use super::experiment::Menu;
use super::heldout::{Fold, Score, VALIDATED};
use super::hypothesis::Term;
use super::place_scan::{Interval, PlaceScan};
use super::scan::separations;
use super::search::Found;

/// The result of a diagnosis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing was found at the noise level.
    Consistent,
    /// The effects are named, and the model with them predicts held-out frames better.
    Identified,
    /// Physics may be missing, and the data cannot separate the alternatives, or exclude chance.
    Ambiguous,
    /// Physics is missing that no effect of the library describes.
    Unexplained,
}

/// Unit of an unmodelled discrepancy [m], shown in mm.
const UNMODELLED: Unit = Unit { symbol: "m", shown: "mm", factor: 1e3 };
/// Alternatives are listed down to this probability.
const LISTED: f64 = 0.005;
/// Alternatives that the sentence names.
const SAID: usize = 3;
/// Share of the posterior that an interval of the place holds.
const CREDIBLE: f64 = 0.95;

impl Verdict {
    /// The word for it.
    pub fn word(self) -> &'static str {
        match self {
            Self::Consistent => "consistent",
            Self::Identified => "identified",
            Self::Ambiguous => "ambiguous",
            Self::Unexplained => "unexplained",
        }
    }

    /// From the competition of each effect, and its held-out gain.
    pub fn of(found: &Found, gains: &[(f64, f64)]) -> Self {
        let next = &found.next;
        if next.unknown() > SUSPICIOUS {
            return Self::Unexplained;
        }
        if found.competitions.is_empty() {
            return match (next.is_suspicious(), next.unknown() > next.library()) {
                (false, _) => Self::Consistent,
                (true, true) => Self::Unexplained,
                (true, false) => Self::Ambiguous,
            };
        }
        let decided = |(competition, term): (&Competition, &Term)| {
            let is_it = |a: &&Alternative| a.term() == Some(term);
            competition.alternatives.iter().find(is_it).is_some_and(|a| a.probability >= DECISIVE)
        };
        let validated = gains.iter().all(|(gain, error)| *gain > VALIDATED * error);
        let whole = !next.is_suspicious();
        if found.competitions.iter().zip(&found.best.hypothesis.terms).all(decided) && validated && whole {
            Self::Identified
        } else {
            Self::Ambiguous
        }
    }
}

/// One cause, with its alternatives.
#[derive(Debug, Clone)]
pub struct Finding {
    /// The cause.
    pub cause: Cause,
    /// Name of its place, empty for the whole ring.
    pub at: String,
    /// Position along the beam [m].
    pub s: Option<f64>,
    /// Shortest stretches of the ring that hold 95 % of the posterior of its place, for a gradient.
    pub interval: Vec<Interval>,
    /// Amplitude and its standard deviation, in the unit of the cause.
    pub amplitude: (f64, f64),
    /// As a clause of the sentence.
    pub phrase: String,
    /// `ln` evidence over the fit without it.
    pub log_evidence_gain: f64,
    /// Posterior probability among its alternatives.
    pub probability: f64,
    /// Gain of held-out log predictive density, and its standard error; none if it is not in the model.
    pub heldout: Option<(f64, f64)>,
    /// True for an alternative that a recording like this one is not expected to separate from the finding.
    pub inseparable: bool,
    /// Its alternatives, most likely first.
    pub alternatives: Vec<Finding>,
}

impl Finding {
    fn of(data: &Data, alternative: &Alternative) -> Self {
        let (amplitude, sigma) = alternative.amplitude;
        let ring = &data.ring;
        let (at, s, phrase) = match &alternative.cause {
            Cause::Effect(term) => (
                term.site.name(ring),
                term.position(ring),
                term.kind.phrase(ring, term.site, Measured { value: amplitude, sigma }),
            ),
            Cause::Unmodelled(one) => (one.at.label(data), one.at.position(data), one.at.phrase(data)),
        };
        Self {
            cause: alternative.cause.clone(),
            at,
            s,
            interval: Vec::new(),
            amplitude: alternative.amplitude,
            phrase,
            log_evidence_gain: alternative.log_gain,
            probability: alternative.probability,
            heldout: None,
            inseparable: false,
            alternatives: Vec::new(),
        }
    }

    /// The first of a competition, with the others below it.
    fn of_competition(data: &Data, competition: &Competition, first: usize) -> Result<Self, FitError> {
        let listed = |(i, a): &(usize, &Alternative)| *i != first && a.probability > LISTED;
        let others: Vec<&Alternative> =
            competition.alternatives.iter().enumerate().filter(listed).map(|(_, a)| a).collect();
        let finding = Self::of(data, &competition.alternatives[first]);
        let mut alternatives: Vec<Self> = others.iter().map(|a| Self::of(data, a)).collect();
        if let Cause::Effect(term) = &competition.alternatives[first].cause {
            let effects: Vec<(usize, &Term)> =
                others.iter().enumerate().filter_map(|(i, a)| Some((i, a.term()?))).collect();
            let terms: Vec<&Term> = effects.iter().map(|(_, term)| *term).collect();
            let separations = separations(data, &competition.without, (term, finding.amplitude.0), &terms)?;
            for ((i, _), separation) in effects.iter().zip(separations) {
                alternatives[*i].inseparable = separation < (DECISIVE / (1.0 - DECISIVE)).ln();
            }
        }
        Ok(Self { alternatives, ..finding })
    }

    /// The effect of the library that it is, if any.
    pub fn term(&self) -> Option<&Term> {
        self.cause.term()
    }

    /// The word for its kind, or `unknown`.
    pub fn word(&self) -> &'static str {
        self.term().map_or("unknown", |term| term.kind.word())
    }

    /// `kind@place`.
    pub fn label(&self) -> String {
        format!("{}@{}", self.word(), self.at)
    }

    /// Unit of the amplitude; for an unmodelled discrepancy that of its rms in the readings.
    pub fn unit(&self) -> Unit {
        self.term().map_or(UNMODELLED, |term| term.kind.unit())
    }

    /// True if held-out frames are predicted better by more than the standard errors asked for.
    pub fn is_validated(&self) -> bool {
        self.heldout.is_some_and(|(gain, error)| gain > VALIDATED * error)
    }

    /// Probability of this cause together with all that the recording cannot separate from it.
    pub fn together(&self) -> f64 {
        self.probability + self.alternatives.iter().filter(|a| a.inseparable).map(|a| a.probability).sum::<f64>()
    }
}

/// Held-out gain of each effect: all effects against all but this one.
///
/// # Errors
/// [`FitError`].
pub fn gains(
    data: &Data,
    found: &Found,
    before: &Score,
    after: &Score,
    folds: &[Fold],
) -> Result<Vec<(f64, f64)>, FitError> {
    if found.competitions.len() == 1 {
        return Ok(vec![after.gain_over(before)]);
    }
    (0..found.competitions.len())
        .map(|i| Ok(after.gain_over(&Score::of(data, &super::heldout::reduced(data, &found.best, i)?, folds)?)))
        .collect()
}

/// One finding for each effect, strongest first; then the most likely cause that is not in the model.
///
/// # Errors
/// [`FitError`].
pub fn findings(data: &Data, found: &Found, gains: &[(f64, f64)], verdict: Verdict) -> Result<Vec<Finding>, FitError> {
    let mut all: Vec<Finding> = Vec::new();
    for (index, ((competition, term), &gain)) in
        found.competitions.iter().zip(&found.best.hypothesis.terms).zip(gains).enumerate()
    {
        let is_it = |a: &Alternative| a.term() == Some(term);
        let Some(first) = competition.alternatives.iter().position(is_it) else { continue };
        let interval = match term.kind.thin() {
            // if the scan fails there is no interval, but the finding stands
            Some(kind) => PlaceScan::of(data, &found.best, Some(index), kind)
                .map_or_else(|_| Vec::new(), |s| s.credible(CREDIBLE)),
            None => Vec::new(),
        };
        all.push(Finding { heldout: Some(gain), interval, ..Finding::of_competition(data, competition, first)? });
    }
    all.sort_by(|one, other| other.log_evidence_gain.total_cmp(&one.log_evidence_gain));
    let open = match verdict {
        Verdict::Unexplained => found.next.alternatives.iter().position(|a| !a.is_of_library()),
        Verdict::Ambiguous if all.is_empty() || found.next.is_suspicious() => {
            (!found.next.alternatives.is_empty()).then_some(0)
        }
        _ => None,
    };
    if let Some(first) = open {
        all.push(Finding::of_competition(data, &found.next, first)?);
    }
    Ok(all)
}

/// In one sentence.
pub fn sentence(data: &Data, found: &Found, verdict: Verdict, findings: &[Finding]) -> String {
    let phrases =
        |separator: &str| findings.iter().map(|finding| finding.phrase.as_str()).collect::<Vec<_>>().join(separator);
    let text = match verdict {
        Verdict::Consistent => format!("nothing was found at the noise level; {}", power(found)),
        Verdict::Identified => {
            let gain: Vec<String> = findings
                .iter()
                .filter_map(|f| f.heldout)
                .map(|(gain, error)| format!("{gain:.0} ± {error:.0}"))
                .collect();
            format!("{}; held-out frames gain {} nat", phrases("; "), gain.join(" and "))
        }
        Verdict::Ambiguous => ambiguous(findings),
        Verdict::Unexplained => {
            let last = findings.last().map_or("", |finding| finding.phrase.as_str());
            // what is less than certain stands in the table, with its probability
            let named = findings.iter().take(findings.len().saturating_sub(1)).filter(|f| f.probability >= DECISIVE);
            let named: Vec<&str> = named.map(|finding| finding.phrase.as_str()).collect();
            let named = if named.is_empty() { String::new() } else { format!("{}; besides, ", named.join("; ")) };
            format!("{named}{last}, which no effect of the library describes")
        }
    };
    let faulty: Vec<String> = (data.health().iter().zip(data.ring.monitor_names()))
        .filter(|(health, _)| health.state != estimator::MonitorState::Ok)
        .map(|(_, name)| name)
        .collect();
    let faulty = if faulty.is_empty() { String::new() } else { format!("; faulty monitors: {}", faulty.join(", ")) };
    capitalised(&format!("{text}{faulty}"))
}

/// The alternatives that share most of the probability.
fn ambiguous(findings: &[Finding]) -> String {
    let mut parts = Vec::new();
    for finding in findings {
        if finding.probability >= DECISIVE {
            parts.push(finding.phrase.clone());
            continue;
        }
        let of = |f: &Finding| format!("{} ({:.0} %)", f.phrase, 100.0 * f.probability);
        let others = finding.alternatives.iter().take(SAID).map(of);
        let said = core::iter::once(of(finding)).chain(others).collect::<Vec<_>>().join(", or ");
        let alike = finding.alternatives.iter().take(SAID).all(|other| other.inseparable);
        let apart = if alike && finding.together() >= DECISIVE { ", which this recording cannot separate" } else { "" };
        parts.push(format!("{said}{apart}"));
    }
    format!("physics may be missing: {}", parts.join("; and "))
}

/// Median detection limits: the amplitudes that give a `ln` Bayes factor of 12 at half of the places.
fn power(found: &Found) -> String {
    const SEEN: f64 = 12.0;
    let shown = [EffectKind::BpmGain, EffectKind::CorrectorGain, EffectKind::QuadRoll, EffectKind::StrayGradient];
    let of_kind = |kind: EffectKind| {
        let mut powers: Vec<f64> = found.next.scanned.iter().filter(|c| c.term.kind == kind).map(|c| c.power).collect();
        powers.sort_by(f64::total_cmp);
        let median = powers.get(powers.len() / 2).copied()?;
        let amplitude = kind.prior_scale()? * (2.0 * SEEN / median.max(f64::MIN_POSITIVE)).sqrt();
        Some(format!("{kind} {}", kind.unit().rounded(amplitude)))
    };
    let list: Vec<String> = shown.into_iter().filter_map(of_kind).collect();
    format!("median detection limits: {}", list.join(", "))
}

fn capitalised(text: &str) -> String {
    let mut characters = text.chars();
    characters.next().map_or_else(String::new, |first| first.to_uppercase().chain(characters).collect())
}

/// The possible measurements for an ambiguous verdict, and the labels of the two causes that they would separate.
///
/// # Errors
/// [`FitError`].
pub fn menu(data: &Data, found: &Found, verdict: Verdict) -> Result<Option<(Menu, [String; 2])>, FitError> {
    if verdict != Verdict::Ambiguous {
        return Ok(None);
    }
    let undecided =
        |competition: &&Competition| competition.alternatives.first().is_none_or(|a| a.probability < DECISIVE);
    let open = Some(&found.next).filter(|next| next.is_suspicious());
    let competition =
        open.or(found.competitions.iter().find(undecided)).or(found.competitions.first()).unwrap_or(&found.next);
    let effects = competition.alternatives.iter().filter_map(|a| Some((a, a.term()?)));
    let leaders: Vec<(&Alternative, &Term)> = effects.take(2).collect();
    let Some((first, one)) = leaders.first() else { return Ok(None) };
    let rival = leaders.get(1).filter(|(a, _)| a.probability > competition.nothing);
    let menu = Menu::of(data, &competition.without, (one, first.amplitude.0), rival.map(|(_, term)| *term))?;
    let against = rival.map_or_else(|| "nothing".to_owned(), |(_, term)| term.label(&data.ring));
    Ok(Some((menu, [one.label(&data.ring), against])))
}

/// The measurement that would best separate the two most likely causes, for an ambiguous verdict.
///
/// # Errors
/// [`FitError`].
pub fn next_measurement(data: &Data, found: &Found, verdict: Verdict) -> Result<Option<String>, FitError> {
    let Some((menu, [one, against])) = menu(data, found, verdict)? else { return Ok(None) };
    Ok(menu.proposals.first().map(|best| {
        format!(
            "A second campaign {} would separate {one} from {against}: expected ln Bayes factor {:.1} with both campaigns, {:.1} now",
            best.what, best.separation, menu.present
        )
    }))
}
