//! One blind campaign: simulated, diagnosed, and scored beside an oracle.

use std::time::Instant;

use diagnosis::{
    Competition, Data, DataError, Diagnosis, Finding, Fitted, Found, Hypothesis, Term, Verdict, imitating,
};
use inference::Campaign;
use inference::recording::Recording;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use twin::{Effect, EffectKind, Ring};

use crate::case::{Case, Class};
use crate::score::{Fate, Grade, TrueCause, TrueEffect, Truth};
use crate::stated::{Sort, Stated};
use crate::unmodelled::Unmodelled;

/// The result of one case.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Outcome {
    /// Number of the case.
    pub index: usize,
    /// Its class.
    pub class: Class,
    /// Whether its machine has ordinary imperfections.
    pub is_imperfect: bool,
    /// The effects it was made with.
    pub truth: Vec<Made>,
    /// Gain in `ln` posterior when kind, place and size are given, on the ideal machine.
    pub oracle_gain: f64,
    /// Of each effect, the same beside the others, and its fate.
    pub fates: Vec<(f64, Fate)>,
    /// The verdict.
    pub verdict: Verdict,
    /// How right it is.
    pub grade: Grade,
    /// Kinds and places of the findings, strongest first.
    pub found: Vec<String>,
    /// Most likely cause (or `nothing`) of the least certain finding.
    pub stated: Stated,
    /// Probability that the model without effects is complete.
    pub nothing: f64,
    /// Held-out gain and its standard error.
    pub heldout: (f64, f64),
    /// Pulls of the named amplitudes.
    pub pulls: Vec<f64>,
    /// Whether the 95 % stretches of the place of an identified gradient hold (or touch the magnet of) the true one.
    pub covered: Vec<bool>,
    /// Whether a finding is within the distance of two quadrupoles of the place of physics that the library does not hold.
    pub near: bool,
    /// Of such physics that is named as something else: gain in `ln` posterior of its exact signal over that name, by the means of settings.
    pub beyond_name: Option<f64>,
    /// NEES per var before and after.
    pub nees: [f64; 2],
    /// Time of the diagnosis [s].
    pub seconds: f64,
}

/// One effect of a case.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Made {
    /// The word for its kind, of the library or not.
    pub kind: String,
    /// Amplitude in prior standard deviations, if the kind has one.
    pub size: Option<f64>,
    /// Kind, place and amplitude in words.
    pub label: String,
}

impl Made {
    fn of(effect: &TrueEffect, ring: &Ring) -> Self {
        let kind = match &effect.cause {
            TrueCause::Effect(Term { kind, .. }) | TrueCause::Kind(kind) => kind.word().into(),
            TrueCause::Unmodelled { what, .. } => what.clone(),
        };
        let scale = effect.kind().and_then(EffectKind::prior_scale);
        let size = scale.zip(effect.amplitude).map(|(scale, amplitude)| (amplitude / scale).abs());
        Self { kind, size, label: effect.label(ring) }
    }
}

/// Simulate, diagnose and score one case; `None` if its machine, or the ideal one, keeps no beam.
///
/// # Errors
/// [`DataError`] if the simulated campaign cannot be diagnosed.
pub fn run(ring: &Ring, template: &Recording, case: &Case) -> Result<Option<Outcome>, DataError> {
    let Some((oracle_gain, own)) = oracle(ring, template, case)? else { return Ok(None) };
    let Ok(recording) = case.recording(ring, template) else { return Ok(None) };
    let started = Instant::now();
    let diagnosis = Diagnosis::from_recording(ring, &recording, |_| {})?;
    let seconds = started.elapsed().as_secs_f64();
    // what passes within settings is not in the means, which are compared
    let of_means = diagnosis.transients.is_empty() && diagnosis.verdict == Verdict::Identified;
    let is_named = !case.unmodelled.is_empty() && of_means;
    let beyond_name = if is_named { beyond_name(ring, template, case, &recording, &diagnosis.found)? } else { None };
    let key = case.key(ring);
    let names = ring.var_names();
    Ok(Some(Outcome {
        index: case.index,
        class: case.class,
        is_imperfect: case.imperfections.is_some(),
        oracle_gain,
        fates: own.into_iter().zip(key.fates(&diagnosis)).collect(),
        verdict: diagnosis.verdict,
        grade: key.grade(&diagnosis),
        found: diagnosis.findings.iter().map(Finding::label).collect(),
        stated: stated(&diagnosis, &key),
        nothing: diagnosis.found.nothing(),
        heldout: diagnosis.gain(),
        pulls: if diagnosis.verdict == Verdict::Identified { key.pulls(&diagnosis) } else { Vec::new() },
        covered: covered(ring, &diagnosis, &key),
        near: case.unmodelled.iter().any(|one| is_near(ring, &diagnosis, one))
            || key.effects.iter().any(|effect| effect.is_told(&diagnosis)),
        nees: [key.nees(&names, &diagnosis.vars_before), key.nees(&names, &diagnosis.vars_after)],
        beyond_name,
        truth: key.effects.iter().map(|effect| Made::of(effect, ring)).collect(),
        seconds,
    }))
}

/// The most likely cause of the least certain finding.
fn stated(diagnosis: &Diagnosis, key: &Truth) -> Stated {
    let found = &diagnosis.found;
    let of_library = diagnosis.findings.iter().filter(|f| f.term().is_some());
    let least = of_library.min_by(|a, b| a.probability.total_cmp(&b.probability));
    match least {
        _ if diagnosis.verdict == Verdict::Consistent => {
            let all = found.competitions.iter().chain([&found.next]);
            let is_true = key.effects.iter().all(|effect| effect.is_told(diagnosis));
            let own = all.min_by(|a, b| a.nothing.total_cmp(&b.nothing)).expect("there is a next one");
            Stated::of("nothing".into(), Sort::Nothing, own.nothing, of_sorts(own), is_true)
        }
        Some(finding) => {
            let is_true = key.effects.iter().any(|effect| effect.is(finding));
            let term = found.best.hypothesis.terms.iter().position(|term| Some(term) == finding.term());
            let of_sorts = term.map_or_else(|| of_sorts_of(finding), |term| of_sorts(&found.competitions[term]));
            Stated::of(finding.label(), Sort::Library, finding.probability, of_sorts, is_true)
        }
        None => {
            let is_true = key.effects.iter().any(TrueEffect::is_unmodelled);
            let within = diagnosis.findings.iter().filter(|finding| finding.is_within_settings());
            let of_sorts = within.map(of_sorts_of).fold(of_sorts(&found.next), |most, one| {
                if one[Sort::Unknown as usize] > most[Sort::Unknown as usize] { one } else { most }
            });
            Stated::of("unknown".into(), Sort::Unknown, of_sorts[Sort::Unknown as usize], of_sorts, is_true)
        }
    }
}

/// Probability of nothing, of the library and of other physics in a competition.
fn of_sorts(own: &Competition) -> [f64; 3] {
    [own.nothing, own.library(), own.unknown()]
}

/// The same of a finding that passes within settings, from the alternatives that it lists.
fn of_sorts_of(finding: &Finding) -> [f64; 3] {
    let all = || core::iter::once(finding).chain(&finding.alternatives);
    let sum = |is_of_library: bool| -> f64 {
        all().filter(|one| one.term().is_some() == is_of_library).map(|one| one.probability).sum()
    };
    let library = sum(true);
    let unknown = sum(false) + imitating(library);
    [(1.0 - library - unknown).max(0.0), library, unknown]
}

/// Whether the stretches of identified gradients hold the true places.
fn covered(ring: &Ring, diagnosis: &Diagnosis, key: &Truth) -> Vec<bool> {
    let named = |finding: &&Finding| {
        diagnosis.verdict == Verdict::Identified
            && !finding.interval.is_empty()
            && key.effects.iter().any(|effect| effect.is(finding))
    };
    let touches = |finding: &Finding| -> Option<bool> {
        let element = &ring.elements[*finding.term()?.site.elements(ring).first()?];
        let (from, to) = (element.s, element.s + element.length);
        Some(finding.interval.iter().any(|one| {
            if one.from_m <= one.to_m {
                one.from_m <= to && one.to_m >= from
            } else {
                one.from_m <= to || one.to_m >= from
            }
        }))
    };
    diagnosis.findings.iter().filter(named).filter_map(touches).collect()
}

/// Whether a finding is nearer to a place than two quadrupoles are to each other, on average.
fn is_near(ring: &Ring, diagnosis: &Diagnosis, one: &Unmodelled) -> bool {
    let at = one.site.elements(ring).first().map_or(f64::NAN, |&element| ring.elements[element].s);
    let spacing = ring.circumference / ring.quadrupoles.len() as f64;
    diagnosis.findings.iter().filter_map(|finding| finding.s).any(|s| ring.distance(s, at) < spacing)
}

/// Gain in `ln` posterior of vars and baselines when kind, place and size are given, of all effects and of each beside the
/// others; for physics that the library does not hold, when its signal is subtracted. On the ideal machine; `None` if that keeps no beam.
fn oracle(ring: &Ring, template: &Recording, case: &Case) -> Result<Option<(f64, Vec<f64>)>, DataError> {
    if case.class == Class::Empty {
        return Ok(Some((0.0, Vec::new())));
    }
    let case = &Case { imperfections: None, ..case.clone() };
    let Ok(recording) = case.recording(ring, template) else { return Ok(None) };
    let data = Data::from_campaign(&Campaign::of(ring, &recording)?)?;
    let zero = DVector::zeros(data.units.len());
    let best = |data: &Data, given: &[Effect]| -> Result<f64, DataError> {
        let hypothesis = Hypothesis { given: given.to_vec(), ..Hypothesis::default() };
        Ok(Fitted::from_guess(data, &hypothesis, &zero)?.log_posterior(data))
    };
    let nothing = best(&data, &[])?;
    if !case.unmodelled.is_empty() {
        let Some(cleaned) = without_signal(ring, template, case, &recording, &data) else { return Ok(None) };
        let gain = best(&cleaned, &[])? - nothing;
        return Ok(Some((gain, vec![gain])));
    }
    let all = best(&data, &case.effects)?;
    let own = |i: usize| -> Result<f64, DataError> {
        let mut others = case.effects.clone();
        others.remove(i);
        Ok(all - if others.is_empty() { nothing } else { best(&data, &others)? })
    };
    Ok(Some((all - nothing, (0..case.effects.len()).map(own).collect::<Result<_, _>>()?)))
}

/// What the means of settings say of physics that the library does not hold and that is named as something else: how much more likely they are with its exact
/// signal than with that name, all that is ordinary fitted beside both; in `ln` posterior.
fn beyond_name(
    ring: &Ring,
    template: &Recording,
    case: &Case,
    recording: &Recording,
    found: &Found,
) -> Result<Option<f64>, DataError> {
    let Found { data, best, .. } = found;
    let Some(cleaned) = without_signal(ring, template, case, recording, data) else { return Ok(None) };
    let nothing = best.hypothesis.without_terms(|_| true);
    let fitted = Fitted::from_guess(&cleaned, &nothing, &best.guess(data, &nothing))?;
    Ok(Some(fitted.log_posterior(&cleaned) - best.log_posterior(data)))
}

/// The readings of a case less what its physics outside the library adds; none if the machine keeps no beam without that.
fn without_signal(ring: &Ring, template: &Recording, case: &Case, recording: &Recording, data: &Data) -> Option<Data> {
    let plain = Case { unmodelled: Vec::new(), ..case.clone() };
    let without = plain.recording(ring, template).ok()?;
    Some(data.less(&signal(recording, &without), &tunes(recording, &without)))
}

/// What the effect adds to each reading [m].
fn signal(with: &Recording, without: &Recording) -> DMatrix<f64> {
    DMatrix::from_fn(with.rows.len(), with.rows[0].reading.len(), |i, b| {
        with.rows[i].reading[b].zip(without.rows[i].reading[b]).map_or(0.0, |(with, without)| with - without)
    })
}

/// What it adds to each tune.
fn tunes(with: &Recording, without: &Recording) -> DMatrix<f64> {
    DMatrix::from_fn(with.rows.len(), 2, |i, plane| {
        with.rows[i].tune[plane].zip(without.rows[i].tune[plane]).map_or(0.0, |(with, without)| with - without)
    })
}
