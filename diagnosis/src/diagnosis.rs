//! The diagnosis of a recording, from top to bottom.

use inference::recording::{Recording, at_energy};
use twin::{Effect, Ring};

use super::average::Vars;
use super::data::{Data, DataError};
use super::experiment::Proposal;
use super::fit::FitError;
use super::heldout::{self, Score};
use super::hypothesis::in_order;
use super::out_of_range::OutOfRange;
use super::readback::contradictions;
use super::scan;
use super::search::{Found, Search};
use super::term::Term;
use super::transients::{self, Transient, Transients};
use super::verdict::{self, Finding, Verdict};
use super::widths;
use super::wiring::Miswired;
use inference::Imperfection;

/// What is missing in the model of a recording.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// All that was found, with its fits.
    pub found: Found,
    /// What passes within settings, which is not in the data of `found`.
    pub transients: Vec<Transient>,
    /// The verdict.
    pub verdict: Verdict,
    /// The verdict as a sentence.
    pub sentence: String,
    /// One finding for each effect, strongest first.
    pub findings: Vec<Finding>,
    /// Held-out frames, predicted without any effect.
    pub before: Score,
    /// Held-out frames, predicted with all effects.
    pub after: Score,
    /// Held-out correctors without and with the effects, where none is a corrector's own.
    pub correctors: Option<(Score, Score)>,
    /// Strength factors of the quadrupoles (vars), fitted without any effect.
    pub vars_before: Vars,
    /// Vars, averaged over the competing causes.
    pub vars_after: Vars,
    /// Vars beyond the range of their prior.
    pub beyond: Vec<OutOfRange>,
    /// The measurement that would best separate the leading causes, for an ambiguous verdict.
    pub next_measurement: Option<String>,
}

impl Diagnosis {
    /// Diagnose a recording; `progress` is called with the name of each step.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn from_recording(ring: &Ring, recording: &Recording, progress: impl FnMut(&str)) -> Result<Self, DataError> {
        Self::jointly(ring, recording, &[], progress)
    }

    /// Diagnose several recordings of one machine together, at other tunes, energies or times in the cycle ([`joint`]).
    ///
    /// # Errors
    /// [`DataError`].
    pub fn jointly(
        ring: &Ring,
        first: &Recording,
        others: &[Recording],
        mut progress: impl FnMut(&str),
    ) -> Result<Self, DataError> {
        let recordings: Vec<&Recording> = core::iter::once(first).chain(others).collect();
        progress("reading");
        for recording in &recordings {
            if let Some(wiring) = Miswired::find(&at_energy(ring, recording.header.kinetic_energy), recording)? {
                return Err(DataError::Miswired { recording: recording.name.clone(), wiring });
            }
        }
        progress("what passes within settings");
        let (mut transients, mut joined) = (Vec::new(), Vec::new());
        for (index, recording) in recordings.iter().enumerate() {
            let ring = at_energy(ring, recording.header.kinetic_energy);
            let Transients { found, campaign } = Transients::find(&ring, recording)?;
            transients::join(&mut transients, found, index);
            joined.push(Data::from_campaign(&campaign)?);
        }
        let data = joined.remove(0).joined_with(joined)?;
        let candidates = scan::candidates(&data, first.header.radial_loop_monitors.as_ref());
        progress("searching");
        let found = Search::new(candidates.clone()).run(data)?;
        let data = &found.data;
        progress("held-out frames");
        let blocks = heldout::by_pool(data);
        let (best, all) = (&found.best, &found.best.hypothesis);
        let bare = match found.has_more() {
            true => heldout::without_terms(data, best, &all.terms, &all.without_element())?,
            false => found.null.clone(),
        };
        let before = Score::from_blocks(data, &bare, &blocks)?;
        let after = if found.has_more() { Score::from_blocks(data, &found.best, &blocks)? } else { before.clone() };
        let tests = verdict::tests(data, &found, &candidates, (&bare, &before), &after, &blocks)?;
        let of_means = Verdict::from_tests(&found, &tests);
        let verdict = of_means.with_transients(&transients).with_noise(data);
        let of_element = verdict::test_of_element(data, &found, &before, &after, &blocks)?;
        let findings = verdict::findings(data, &found, &transients, &tests, of_element, of_means)?;
        progress("held-out correctors");
        let whole = found.has_more() && !found.best.hypothesis.terms.iter().any(|t| t.kind.is_of_a_corrector());
        let blocks = heldout::by_corrector(data);
        let correctors = if whole && !blocks.is_empty() {
            let scored = |fitted| Score::from_blocks(data, fitted, &blocks).ok();
            scored(&bare).zip(scored(&found.best))
        } else {
            None
        };
        progress("what to measure next");
        // the proposal is no part of the verdict, so its failure is not one of the diagnosis
        let next_measurement = verdict::next_measurement(data, &found, verdict).unwrap_or_default();
        let (vars_before, vars_after) = (Vars::from_fit(&found.null), Vars::averaged(&found).widened(&found)?);
        // a poor fit says nothing of single vars
        let beyond = if found.best.is_poor() { Vec::new() } else { OutOfRange::all(&data.ring, &vars_after) };
        let names = ring.corrector_names();
        let contradicted = |recording: &&Recording| {
            let said = contradictions(recording, &names).into_iter();
            said.map(|said| verdict::in_recording(data, &recording.name, said)).collect::<Vec<_>>()
        };
        let contradicted = recordings.iter().flat_map(contradicted).collect();
        let sentence = verdict::sentence(data, &found, verdict, &findings, contradicted, &beyond);
        Ok(Self {
            found,
            transients,
            verdict,
            sentence,
            findings,
            before,
            after,
            correctors,
            vars_before,
            vars_after,
            beyond,
            next_measurement,
        })
    }

    /// The effects in the fitted model, at their most likely amplitudes, in the order in which a signal passes them. What passes within a setting was found by
    /// the names of correctors and monitors in the recording, so that it is farthest from the beam.
    pub fn effects(&self) -> Vec<Effect> {
        let best = &self.found.best;
        let effect = |(i, term): (usize, &Term)| term.effect(best.amplitude(&self.found.data, i).0);
        let lasting = in_order(best.hypothesis.terms.iter().enumerate().map(effect).collect(), []);
        let passing = self.transients.iter().filter_map(|one| {
            let leading = &one.alternatives[0];
            Some(leading.term()?.effect(leading.amplitude.0))
        });
        let (of_correctors, others): (Vec<Effect>, Vec<Effect>) =
            passing.partition(|effect| effect.kind.is_of_a_corrector());
        of_correctors.into_iter().chain(lasting).chain(others).collect()
    }

    /// The possible measurements for an ambiguous verdict, best first; none for another.
    ///
    /// # Errors
    /// [`FitError`].
    pub fn proposals(&self) -> Result<Vec<Proposal>, FitError> {
        let menu = verdict::menu(&self.found.data, &self.found, self.verdict)?;
        Ok(menu.map_or_else(Vec::new, |(menu, _)| menu.proposals))
    }

    /// What was learnt of the machine besides.
    pub fn imperfections(&self) -> Vec<Imperfection> {
        let Found { data, best, .. } = &self.found;
        let names = data.ring.monitor_names();
        let of_others = data.campaigns().skip(1).flat_map(|own| own.noise.of_parts(&own.name, &names));
        widths::rows(data, best).into_iter().chain(data.noise.rows(&names)).chain(of_others).collect()
    }

    /// Names of the monitors that wander by themselves.
    pub fn wandering(&self) -> Vec<String> {
        let names = self.found.data.ring.monitor_names();
        let of_one = |own: &Data| own.noise.wandering.iter().map(|(b, _)| names[*b].clone()).collect::<Vec<_>>();
        self.found.data.campaigns().flat_map(of_one).collect()
    }

    /// Least probability that all effects in the fitted model are there: each has its own, given the others, so that all of them hold with
    /// `1 - sum of (1 - P)` or more (Bonferroni). None where nothing is in it.
    pub fn joint_probability(&self) -> Option<f64> {
        let in_model = self.findings.iter().filter(|finding| finding.tested.is_some());
        let (count, doubt) = in_model.fold((0, 0.0), |(n, sum), finding| (n + 1, sum + 1.0 - finding.probability));
        (count > 0).then_some((1.0 - doubt).max(0.0))
    }

    /// Gain of held-out log predictive density by all effects, and its standard error.
    pub fn gain(&self) -> (f64, f64) {
        if self.found.has_more() { self.after.gain_over(&self.before) } else { (0.0, 0.0) }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::testing;

    /// 0.24 mm until the end, beside a gain and alone.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_monitor_that_wanders_is_said_and_hides_nothing() {
        let (ring, recording) = testing::template();
        let y_d5 = ring.monitor_names().iter().position(|name| name == "y_D5").unwrap();
        let white = testing::Coloured::white(&ring, &recording, 11);
        let noise = testing::Coloured { wandering: Some((y_d5, 13e-6)), ..white };
        let gain = Effect::parse("bpm_gain@x_E6=0.15", &ring).unwrap();
        for (effects, verdict) in [(vec![], Verdict::Consistent), (vec![gain], Verdict::Identified)] {
            let made = noise.campaign(&ring, &recording, &effects);
            let found = Diagnosis::from_recording(&ring, &made, |_| ()).unwrap();
            assert_eq!(found.verdict, verdict, "{}", found.sentence);
            assert_eq!(found.wandering(), ["y_D5"]);
            assert!(found.sentence.contains("monitor y_D5 wanders"), "{}", found.sentence);
            assert_eq!(found.findings.iter().filter_map(Finding::term).count(), effects.len());
            let rows = found.imperfections();
            let walk = rows.iter().find(|row| row.at == "y_D5").unwrap().measured;
            assert!((walk.value - 13e-6).abs() < 3.0 * walk.sigma, "{walk:?}");
        }
    }

    /// A recording of format 2 need not name the correctors that were set: held-out settings and correctors are those of the read-backs.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn correctors_are_held_out_without_their_names() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/ten-cells");
        let ring = Ring::read(&folder.join("ring.json")).unwrap();
        let mut recording = Recording::read(&folder.join("gain"), &ring).unwrap();
        let named = Diagnosis::from_recording(&ring, &recording, |_| ()).unwrap();
        recording.rows.iter_mut().for_each(|row| row.correctors.clear());
        let unnamed = Diagnosis::from_recording(&ring, &recording, |_| ()).unwrap();
        let of_correctors = |diagnosis: &Diagnosis| {
            let (before, after) = diagnosis.correctors.as_ref().unwrap();
            after.gain_over(before).0
        };
        assert_eq!(of_correctors(&unnamed), of_correctors(&named));
        assert!(named.gain().0 > 10.0);
        assert_eq!(named.joint_probability(), Some(named.findings[0].probability), "of one effect, its own");
        assert_eq!(unnamed.gain(), named.gain());
    }
}
