//! The verdict, as a word and as a sentence.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use twin::{EffectKind, Measured, Unit};

use super::alternatives::{Alternative, Cause, Competition};
use super::chance;
use super::choice::Choice;
use super::data::Data;
use super::experiment::Menu;
use super::family::family_of;
use super::fit::{FitError, Fitted};
use super::heldout::{Block, Score, gain_of_choice, lessened, without_terms};
use super::limits::Limits;
use super::location::Location;
use super::lost_frames::lost_frames;
use super::odds::{DECISIVE, SUSPICIOUS, corrections};
use super::out_of_range::OutOfRange;
use super::place_scan::{Interval, PlaceScan};
use super::scan::separations;
use super::search::Found;
use super::stuck_monitor::stuck_monitors;
use super::term::Term;
use super::tested::Tested;
use super::transients::Transient;
use super::widths;
use inference::{Imperfection, Measure, POSITION, THROUGHOUT};

/// The result of a diagnosis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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

/// Alternatives are listed down to this probability.
const LISTED: f64 = 0.005;
/// An effect in the model that something else explains better is no finding below this probability.
const STATED: f64 = 0.05;
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

    /// The same with what passes within settings.
    #[must_use]
    pub fn with_transients(self, transients: &[Transient]) -> Self {
        let decided = |one: &Transient| {
            one.alternatives[0].probability >= DECISIVE && one.tested.is_some_and(|tested| tested.is_passed())
        };
        match self {
            _ if transients.is_empty() => self,
            Self::Unexplained => self,
            _ if transients.iter().any(|one| !one.alternatives[0].is_of_library()) => Self::Unexplained,
            Self::Consistent | Self::Identified if transients.iter().all(decided) => Self::Identified,
            _ => Self::Ambiguous,
        }
    }

    /// The same beside noise that is not ordinary.
    #[must_use]
    pub(crate) fn with_noise(self, data: &Data) -> Self {
        if data.campaigns().any(|one| one.noise.unordinary().is_some()) { Self::Unexplained } else { self }
    }

    /// From the competition of each effect, and how it stood its tests.
    pub fn from_tests(found: &Found, tests: &[Tested]) -> Self {
        let next = &found.next;
        if next.unknown_seen() > SUSPICIOUS || found.best.is_poor() {
            return Self::Unexplained;
        }
        if found.competitions.is_empty() {
            return match (next.is_suspicious(), next.unknown_seen() > next.library()) {
                (false, _) => Self::Consistent,
                (true, true) => Self::Unexplained,
                (true, false) => Self::Ambiguous,
            };
        }
        let decided = |(competition, term): (&Competition, &Term)| {
            let is_it = |a: &&Alternative| a.term() == Some(term);
            competition.alternatives.iter().find(is_it).is_some_and(|a| a.probability >= DECISIVE)
        };
        let validated = tests.iter().all(Tested::is_passed);
        let whole = !next.is_suspicious();
        if found.competitions.iter().zip(&found.best.hypothesis.terms).all(decided) && validated && whole {
            Self::Identified
        } else {
            Self::Ambiguous
        }
    }
}

/// The integrated gradient of a field that does not grow with the magnets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fixed {
    /// Kinetic energy at which the amplitude over the rigidity is given, that of the first recording [GeV].
    pub kinetic_energy: f64,
    /// The gradient [T].
    pub gradient: Measured,
}

impl Fixed {
    fn from_alternative(data: &Data, alternative: &Alternative) -> Option<Self> {
        let kind = alternative.term()?.kind;
        let is_fixed = data.is_joint() && kind.is_stray() && kind.thin().is_some();
        let (value, sigma) = alternative.amplitude;
        let gradient = Measured { value: value * data.rigidity(), sigma: sigma * data.rigidity() };
        is_fixed.then(|| Self { kinetic_energy: data.kinetic_energy(), gradient })
    }

    /// To follow the amplitude.
    fn phrase(self) -> String {
        format!(" at {:.3} GeV, {} T at all energies", self.kinetic_energy, self.gradient.signed(1.0))
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
    /// Of a field that is not a magnet of the ring, in several recordings: the same in tesla.
    pub fixed: Option<Fixed>,
    /// As a clause of the sentence.
    pub phrase: String,
    /// `ln` evidence over the fit without it.
    pub log_evidence_gain: f64,
    /// Posterior probability among its alternatives.
    pub probability: f64,
    /// Its tests; none if it is not in the model.
    pub tested: Option<Tested>,
    /// True for an alternative that a recording like this one is not expected to separate from the finding.
    pub inseparable: bool,
    /// Its alternatives, most likely first.
    pub alternatives: Vec<Finding>,
    /// Effects of the library in the model that describe a part of it, where it is something unknown.
    pub parts: Vec<Finding>,
}

impl Finding {
    fn from_alternative(data: &Data, alternative: &Alternative) -> Self {
        let (amplitude, sigma) = alternative.amplitude;
        let ring = &data.ring;
        let (at, s, phrase) = match &alternative.cause {
            Cause::Effect(term) => (
                term.site.name(ring),
                term.position(ring),
                term.kind.phrase(ring, term.site, Measured { value: amplitude, sigma }),
            ),
            Cause::Unmodelled(one) => {
                let recording = data.campaign(one.campaign);
                let phrase = one.at.phrase(recording);
                let phrase = if data.is_joint() { format!("in {} {phrase}", recording.name) } else { phrase };
                (one.at.label(recording), one.at.position(recording), phrase)
            }
        };
        let fixed = Fixed::from_alternative(data, alternative);
        let phrase = fixed.map_or_else(|| phrase.clone(), |fixed| phrase.clone() + &fixed.phrase());
        Self {
            fixed,
            cause: alternative.cause.clone(),
            at,
            s,
            interval: Vec::new(),
            amplitude: alternative.amplitude,
            phrase,
            log_evidence_gain: alternative.log_gain,
            probability: alternative.probability,
            tested: None,
            inseparable: false,
            alternatives: Vec::new(),
            parts: Vec::new(),
        }
    }

    /// What passes within settings.
    fn of_transient(data: &Data, transient: &Transient) -> Self {
        let listed = |one: &&Alternative| one.probability > LISTED;
        let others = transient.alternatives[1..].iter().filter(listed);
        Self {
            tested: transient.tested,
            alternatives: others.map(|one| Self::from_alternative(data, one)).collect(),
            ..Self::from_alternative(data, &transient.alternatives[0])
        }
    }

    /// The first of a competition, with the others below it.
    fn of_competition(data: &Data, competition: &Competition, first: usize) -> Result<Self, FitError> {
        let listed = |(i, a): &(usize, &Alternative)| *i != first && a.probability > LISTED;
        let others: Vec<&Alternative> =
            competition.alternatives.iter().enumerate().filter(listed).map(|(_, a)| a).collect();
        let finding = Self::from_alternative(data, &competition.alternatives[first]);
        let mut alternatives: Vec<Self> = others.iter().map(|a| Self::from_alternative(data, a)).collect();
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

    /// True if another one is a part of what an instrument certainly does that no effect describes.
    fn holds(&self, other: &Self, data: &Data) -> bool {
        match (&self.cause, other.term()) {
            (Cause::Unmodelled(one), Some(term)) if self.probability >= DECISIVE => {
                one.at.holds(term, &data.campaign(one.campaign).ring)
            }
            _ => false,
        }
    }

    /// The effect of the library that it is, if any.
    pub fn term(&self) -> Option<&Term> {
        self.cause.term()
    }

    /// True for something unknown that the means of settings do not show: what passes within them, and what varies from frame to frame.
    pub fn is_within_settings(&self) -> bool {
        let is_within = |at: &Location| {
            matches!(at, Location::FrameToFrame | Location::FirstFrames { .. } | Location::UnsteadyCorrector(_))
        };
        matches!(&self.cause, Cause::Unmodelled(one) if is_within(&one.at))
    }

    /// True for the unknown element in the model.
    fn is_of_element(&self, found: &Found) -> bool {
        let place = found.best.hypothesis.element.as_ref().map(|one| Location::Linear(one.quadrupole, one.does));
        matches!(&self.cause, Cause::Unmodelled(one) if Some(&one.at) == place.as_ref())
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
        self.term().map_or(POSITION, |term| term.kind.unit())
    }

    /// True if held-out frames are predicted better by more than the standard errors asked for.
    pub fn is_validated(&self) -> bool {
        self.tested.is_some_and(|tested| tested.is_passed())
    }

    /// Its alternatives and its parts.
    pub fn others(&self) -> impl Iterator<Item = &Self> {
        self.alternatives.iter().chain(&self.parts)
    }

    /// Probability of this cause together with all that the recording cannot separate from it.
    pub fn together(&self) -> f64 {
        self.probability + self.alternatives.iter().filter(|a| a.inseparable).map(|a| a.probability).sum::<f64>()
    }
}

/// Tests of each effect: all effects against all but this one, and the candidates against that.
pub fn tests(
    data: &Data,
    found: &Found,
    candidates: &[Term],
    (bare, before): (&Fitted, &Score),
    after: &Score,
    blocks: &[Block],
) -> Result<Vec<Tested>, FitError> {
    // chance exchanges no cables: of such a pair the whole response changes, so that only those that were found are tested
    let is_tested = |term: &Term| term.kind != EffectKind::CorrectorSwap || found.best.hypothesis.terms.contains(term);
    let all = candidates.iter().copied().zip(corrections(candidates));
    let (candidates, penalty): (Vec<Term>, Vec<f64>) = all.filter(|(term, _)| is_tested(term)).unzip();
    let (candidates, penalty) = (&candidates, &penalty);
    let test = |i: usize| -> Result<Tested, FitError> {
        // what is ordinary keeps the size that it has beside the effect: without it, it may grow in its place
        let is_all = found.competitions.len() == 1 && found.best.hypothesis.element.is_none();
        let hypothesis = &found.best.hypothesis;
        let without = &match is_all {
            true => bare.clone(),
            false => without_terms(data, &found.best, &hypothesis.terms[i..=i], hypothesis)?,
        };
        let rival = if is_all { before } else { &Score::from_blocks(data, without, blocks)? };
        let gain = after.gain_over(rival);
        if without.is_poor() {
            return Ok(Tested { gain, of_choice: None, chance: None, is_of_family: false });
        }
        let kind = hypothesis.terms[i].kind;
        let is_of_an_instrument = kind.is_of_a_monitor() || kind.is_of_a_corrector();
        let kind_of_family = family_of(kind);
        let is_learnt =
            without.hypothesis.ordinary.iter().any(|family| family.is_learnt() && family.kind == kind_of_family);
        let choice = Choice::from_terms(data, without, candidates, penalty)?;
        let is_of_family = is_of_an_instrument && is_learnt;
        let (of_choice, chance) = (Some(gain_of_choice(&choice)?), Some(chance::of_search(&choice)?));
        Ok(Tested { gain, of_choice, chance, is_of_family })
    };
    (0..found.competitions.len()).map(test).collect()
}

/// Test of the unknown element in the model, all effects against all but this; none where there is no such element.
pub fn test_of_element(
    data: &Data,
    found: &Found,
    before: &Score,
    after: &Score,
    blocks: &[Block],
) -> Result<Option<Tested>, FitError> {
    if found.best.hypothesis.element.is_none() {
        return Ok(None);
    }
    let without = || lessened(data, &found.best, found.best.hypothesis.without_element());
    let rival = if found.competitions.is_empty() { before } else { &Score::from_blocks(data, &without()?, blocks)? };
    Ok(Some(Tested { gain: after.gain_over(rival), of_choice: None, chance: None, is_of_family: false }))
}

/// One finding for each effect, strongest first, then the most likely cause that is not in the model; `of_means`: the verdict on the means of
/// settings.
pub fn findings(
    data: &Data,
    found: &Found,
    transients: &[Transient],
    tests: &[Tested],
    of_element: Option<Tested>,
    of_means: Verdict,
) -> Result<Vec<Finding>, FitError> {
    let (named, unmodelled): (Vec<Finding>, Vec<Finding>) =
        transients.iter().map(|one| Finding::of_transient(data, one)).partition(|one| one.term().is_some());
    let mut findings = Vec::new();
    for (index, ((competition, term), &tested)) in
        found.competitions.iter().zip(&found.best.hypothesis.terms).zip(tests).enumerate()
    {
        let is_it = |a: &Alternative| a.term() == Some(term);
        let Some(first) = competition.alternatives.iter().position(is_it) else { continue };
        let interval = match term.kind.thin() {
            // if the scan fails there is no interval, but the finding stands
            Some(kind) => PlaceScan::from_fit(data, &found.best, Some(index), kind)
                .map_or_else(|_| Vec::new(), |s| s.credible(CREDIBLE)),
            None => Vec::new(),
        };
        findings.push(Finding { tested: Some(tested), interval, ..Finding::of_competition(data, competition, first)? });
    }
    let is_stated = |finding: &Finding| finding.probability > STATED;
    let is_explained_better = !findings.iter().any(is_stated);
    let mut all: Vec<Finding> = named.into_iter().chain(findings).filter(is_stated).collect();
    all.sort_by(|one, other| other.log_evidence_gain.total_cmp(&one.log_evidence_gain));
    let open = match of_means {
        Verdict::Unexplained => found.next.alternatives.iter().position(|a| !a.is_of_library()),
        Verdict::Ambiguous if found.competitions.is_empty() || found.next.is_suspicious() => {
            (!found.next.alternatives.is_empty()).then_some(0)
        }
        _ => None,
    };
    if is_explained_better && open.is_none() {
        // what explains the effects in the model better than these do
        for competition in &found.competitions {
            let Some(leading) = competition.alternatives.first() else { continue };
            if !all.iter().any(|finding| finding.cause.is(&leading.cause)) {
                all.push(Finding::of_competition(data, competition, 0)?);
            }
        }
    }
    if let Some(first) = open {
        let open = Finding { tested: of_element, ..Finding::of_competition(data, &found.next, first)? };
        let open = match found.best.turned(data).filter(|_| open.is_of_element(found) && !data.is_joint()) {
            Some(angle) => Finding { phrase: format!("{}, by {} mrad", open.phrase, angle.size(1e3)), ..open },
            None => open,
        };
        // what passes within settings was found without it
        let is_part = |finding: &Finding| {
            let in_model = finding.term().is_some_and(|term| found.best.hypothesis.terms.contains(term));
            in_model && open.holds(finding, data)
        };
        let (parts, others) = all.into_iter().partition(is_part);
        all = others;
        all.push(Finding { parts, ..open });
    }
    all.extend(unmodelled);
    for (index, campaign) in data.campaigns().enumerate() {
        all.extend(
            Alternative::from_frame_to_frame(&campaign.noise, index).map(|one| Finding::from_alternative(data, &one)),
        );
    }
    Ok(all)
}

/// In one sentence.
pub fn sentence(
    data: &Data,
    found: &Found,
    verdict: Verdict,
    findings: &[Finding],
    contradictions: Vec<String>,
    beyond: &[OutOfRange],
) -> String {
    let phrases =
        |separator: &str| findings.iter().map(|finding| finding.phrase.as_str()).collect::<Vec<_>>().join(separator);
    let text = match verdict {
        Verdict::Consistent => format!("nothing was found at the noise level; {}", power(found)),
        Verdict::Identified => {
            let gain: Vec<String> = findings
                .iter()
                .filter_map(|f| f.tested)
                .map(|Tested { gain: (gain, error), .. }| format!("{gain:.0} ± {error:.0}"))
                .collect();
            format!("{}; held-out frames gain {} nat", phrases("; "), gain.join(" and "))
        }
        Verdict::Ambiguous => ambiguous(findings),
        Verdict::Unexplained => unexplained(found, findings),
    };
    let mut said: Vec<String> = contradictions.into_iter().chain(beyond.iter().map(OutOfRange::to_string)).collect();
    let rows = widths::rows(data, &found.best).into_iter();
    let (common, scatters): (Vec<Imperfection>, Vec<Imperfection>) = rows.partition(|row| row.measure == Measure::Mean);
    let off = Imperfection::told(&common).map(|told| format!("{THROUGHOUT}: {told}"));
    // these are no missing physics, and a consistent recording's sentence begins with them
    if verdict == Verdict::Consistent && !(said.is_empty() && off.is_none()) {
        said.push(format!("besides, {text}"));
    } else {
        said.insert(0, text);
    }
    said.splice(0..0, off);
    said.extend(Imperfection::told(&scatters).map(|large| format!("larger than ordinary: {large}")));
    said.extend(remarks(data));
    capitalised(&said.join("; "))
}

/// What is said of one of several recordings.
pub(super) fn in_recording(data: &Data, recording: &str, said: String) -> String {
    if data.is_joint() { format!("in {recording} {said}") } else { said }
}

/// What is said besides: of noise, frames and monitors.
fn remarks(data: &Data) -> Vec<String> {
    let mut remarks = Vec::new();
    for own in data.campaigns() {
        remarks.extend(own.close_tunes.iter().map(|one| in_recording(data, &own.name, one.to_string())));
        remarks.extend(own.noise.remarks().into_iter().map(|said| in_recording(data, &own.name, said)));
        remarks.extend(wandering(own).into_iter().map(|said| in_recording(data, &own.name, said)));
    }
    for own in data.campaigns() {
        remarks.extend(stuck_monitors(own).into_iter().map(|said| in_recording(data, &own.name, said)));
    }
    remarks.extend(data.campaigns().filter_map(|own| Some(in_recording(data, &own.name, lost_frames(own)?))));
    let faulty: Vec<String> = (data.health_in_any().iter().zip(data.ring.monitor_names()))
        .filter(|(health, _)| health.state != estimator::MonitorState::Ok)
        .map(|(_, name)| name)
        .collect();
    if !faulty.is_empty() {
        remarks.push(format!("faulty monitors: {}", faulty.join(", ")));
    }
    if data.is_joint() {
        remarks.push(format!("{} recordings analysed together: {}", data.count(), data.names(", ")));
    }
    remarks
}

/// Monitors of a recording that wander by themselves, and how far until its end.
fn wandering(own: &Data) -> Vec<String> {
    let names = own.ring.monitor_names();
    let root_frames = (own.pools.of_frame.len() as f64).sqrt();
    let far = |walk: &Measured| Measured { value: walk.value * root_frames, sigma: walk.sigma * root_frames }.size(1e3);
    let said =
        |(b, walk): &(usize, Measured)| format!("monitor {} wanders, by {} mm until the end", names[*b], far(walk));
    own.noise.wandering.iter().map(said).collect()
}

/// What is certain, and what no effect describes.
fn unexplained(found: &Found, findings: &[Finding]) -> String {
    let last = findings.len() - usize::from(findings.last().is_some_and(|f| f.term().is_none()));
    // what is less than certain stands in the table, with its probability
    let named = findings[..last].iter().filter(|f| f.probability >= DECISIVE);
    let named: Vec<&str> = named.map(|finding| finding.phrase.as_str()).collect();
    let undescribed: Vec<String> = findings[last..].iter().map(undescribed).collect();
    if !found.best.is_poor() {
        let named = if named.is_empty() { String::new() } else { format!("{}; besides, ", named.join("; ")) };
        return format!("{named}{}", undescribed.join("; "));
    }
    let chi2 = found.best.chi2_per_number();
    let poor = format!("the model does not describe the readings, chi2 of each is {chi2:.1}");
    // what is named beside so much that is not described may be wrong
    let nearest = named.into_iter().map(str::to_owned).chain(undescribed).collect::<Vec<_>>().join("; ");
    if nearest.is_empty() { poor } else { format!("{poor}; the nearest that was found: {nearest}") }
}

/// What is missing and not in the library.
fn undescribed(finding: &Finding) -> String {
    let what = match finding.probability >= DECISIVE {
        true => format!("{}, which no effect of the library describes", finding.phrase),
        false => format!("something that no effect of the library describes: {}", likely(finding)),
    };
    let gain = finding.tested.map(|Tested { gain: (gain, error), .. }| {
        format!("; with it in the model held-out frames gain {gain:.0} ± {error:.0} nat")
    });
    let parts: Vec<&str> = finding.parts.iter().map(|part| part.phrase.as_str()).collect();
    let parts =
        if parts.is_empty() { String::new() } else { format!("; in part it looks like this: {}", parts.join(" and ")) };
    what + &gain.unwrap_or_default() + &parts
}

/// A cause, with its probability and the alternatives where it is less than certain.
fn likely(finding: &Finding) -> String {
    if finding.probability >= DECISIVE {
        return finding.phrase.clone();
    }
    let said_with_probability = |f: &Finding| format!("{} ({:.0} %)", f.phrase, 100.0 * f.probability);
    let others =
        finding.alternatives.iter().filter(|other| other.probability > STATED).take(SAID).map(said_with_probability);
    core::iter::once(said_with_probability(finding)).chain(others).collect::<Vec<_>>().join(", or ")
}

/// The alternatives that share most of the probability.
fn ambiguous(findings: &[Finding]) -> String {
    let mut parts = Vec::new();
    for finding in findings {
        if finding.probability >= DECISIVE {
            parts.push(finding.phrase.clone());
            continue;
        }
        let said = likely(finding);
        let alike = finding.alternatives.iter().take(SAID).all(|other| other.inseparable);
        let apart = if alike && finding.together() >= DECISIVE { ", which this recording cannot separate" } else { "" };
        parts.push(format!("{said}{apart}"));
    }
    format!("physics may be missing: {}", parts.join("; and "))
}

/// Median detection limits of some kinds.
fn power(found: &Found) -> String {
    let shown = [EffectKind::BpmGain, EffectKind::CorrectorGain, EffectKind::QuadRoll, EffectKind::StrayGradient];
    let of_kind = |kind: EffectKind| {
        let limits = Limits::from_scan(kind, &found.next.scanned)?;
        Some(format!("{kind} {}", kind.unit().rounded(limits.median)))
    };
    let list: Vec<String> = shown.into_iter().filter_map(of_kind).collect();
    format!("median detection limits: {}", list.join(", "))
}

/// A clause as the beginning of a sentence.
pub fn capitalised(text: &str) -> String {
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
    let menu = Menu::from_causes(data, &competition.without, (one, first.amplitude.0), rival.map(|(_, term)| *term))?;
    let against = rival.map_or_else(|| "nothing".to_owned(), |(_, term)| term.label(&data.ring));
    Ok(Some((menu, [one.label(&data.ring), against])))
}

/// The measurement that would best separate the two most likely causes, for an ambiguous verdict.
pub fn next_measurement(data: &Data, found: &Found, verdict: Verdict) -> Result<Option<String>, FitError> {
    let Some((menu, [one, against])) = menu(data, found, verdict)? else { return Ok(None) };
    Ok(menu.proposals.first().map(|best| {
        format!(
            "A second campaign {} would separate {one} from {against}: expected ln Bayes factor {:.1} with both campaigns, {:.1} now",
            best.what, best.separation, menu.present
        )
    }))
}

#[cfg(test)]
mod tests {
    use twin::Site;

    use super::*;
    use crate::discrepancy::Discrepancy;
    use crate::testing::{template, whitened};

    /// At 1.5 standard errors chance decides, and without a choice that predicts nothing does.
    #[test]
    fn what_chance_does_not_give_needs_less_of_what_is_held_out() {
        let of = |gain: f64, of_choice, chance| Tested { gain: (gain, 1.0), of_choice, chance, is_of_family: false };
        let passed = |gain: f64, of_choice, chance| of(gain, of_choice, chance).is_passed();
        assert!(passed(2.1, Some(0.1), Some(0.3)) && !passed(1.5, Some(0.1), Some(0.02)));
        assert!(passed(1.5, Some(0.1), Some(0.002)) && !passed(0.9, Some(0.1), Some(0.002)));
        assert!(!passed(5.0, Some(-0.1), Some(0.002)));
        assert!(passed(2.1, None, None) && !passed(1.5, None, Some(0.002)));
        let outlier =
            |gain: f64, chance| Tested { is_of_family: true, ..of(gain, Some(-3.0), Some(chance)) }.is_passed();
        assert!(outlier(0.1, 0.002) && !outlier(-0.1, 0.002) && !outlier(5.0, 0.02));
    }

    /// What one monitor does that no effect describes, with a gain of that monitor in the model.
    #[test]
    fn an_effect_at_an_instrument_that_does_something_unknown_is_a_part_of_that() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let alternative = |cause: Cause, probability: f64| Alternative {
            probability,
            ..Alternative::unfitted(cause, 50.0, (-0.2, 0.01))
        };
        let unknown = |at: Location, probability: f64| {
            let one = Discrepancy { at, campaign: 0, log_bayes: 50.0, size: 1e-4, sites: 33, adapted: None };
            Finding::from_alternative(&data, &alternative(Cause::Unmodelled(one), probability))
        };
        let of = |kind: EffectKind, site: Site| {
            Finding::from_alternative(&data, &alternative(Cause::Effect(Term { kind, site }), 0.99))
        };
        let gain = of(EffectKind::BpmGain, Site::Monitor(ring.read_monitors[3]));
        let curve = unknown(Location::MonitorCurve(3), 0.99);
        assert!(curve.holds(&gain, &data));
        assert!(!unknown(Location::MonitorCurve(3), 0.7).holds(&gain, &data), "less than certain");
        assert!(
            !unknown(Location::MonitorInTime(3), 0.99).holds(&gain, &data),
            "what changes with time is no part of it"
        );
        assert!(!unknown(Location::Monitor(4), 0.99).holds(&gain, &data), "another monitor");
        let kick = of(EffectKind::CorrectorEven, Site::Corrector(2));
        assert!(unknown(Location::Corrector(2), 0.99).holds(&kick, &data) && !curve.holds(&kick, &data));
        let name = &ring.monitor_names()[3];
        let said = undescribed(&Finding { parts: vec![gain], ..curve });
        assert_eq!(
            said,
            format!(
                "monitor {name} reads a nonlinear function of the position, which no effect of the library describes; in part it looks like this: \
                 BPM {name} reads 20.0 ± 1.0 % low"
            )
        );
    }
}
