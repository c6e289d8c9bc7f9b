//! Summary of all outcomes, as numbers and as Markdown.

use core::fmt::Write;
use std::collections::BTreeMap;

use diagnosis::Verdict;
use schemars::JsonSchema;
use serde::Serialize;
use twin::median;

use crate::case::Class;
use crate::mixes::{Calibration, Reliability};
use crate::outcome::Outcome;
use crate::score::{Fate, Grade};
use crate::share::Share;
use crate::unmodelled::UnmodelledKind;

/// Fates of the effects of one row.
#[derive(Debug, Clone, Default, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after the fates
pub struct Fates {
    pub named: usize,
    pub together: usize,
    pub listed: usize,
    pub absent: usize,
}

/// What became of physics outside the library.
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
pub struct Unknown {
    /// Called unexplained or ambiguous, or a monitor said to wander.
    pub undecided: Share,
    /// With its place.
    pub near: Share,
    /// Named as something else.
    pub named: usize,
    /// Of these, names that the means of settings refute: they are more likely by over 25 nat with the true signal than with the name.
    pub refuted: usize,
}

/// What became of campaigns on ideal machines, or on machines with ordinary imperfections.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct OfMachines {
    /// Number of campaigns.
    pub campaigns: usize,
    /// Empty campaigns that were called consistent.
    pub consistent: Share,
    /// Campaigns with a false identification, of all but those with unmodelled physics.
    pub wrong: Share,
    /// Effects of an oracle gain above 25 nat that were named, or undecided among inseparable causes.
    pub named: Share,
    /// Physics outside the library above 25 nat that was called unexplained or ambiguous.
    pub open: Share,
    /// Amplitudes of named effects: number and mean square pull.
    pub amplitudes: (usize, f64),
    /// NEES per var after, mean of the campaigns whose effects are in the library.
    pub nees: f64,
    /// Of these, NEES from 0.5 to 1.6.
    pub nees_within: Share,
}

/// All tables.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Tables {
    /// On ideal machines, and on machines with ordinary imperfections.
    pub machines: [OfMachines; 2],
    /// Empty campaigns that were called consistent, and that had something named.
    pub empty_consistent: Share,
    /// See above.
    pub empty_identified: Share,
    /// What became of the effects of the library, by their own oracle gain.
    pub by_gain: Vec<([f64; 2], Fates)>,
    /// Campaigns with a false identification, of all but those with unmodelled physics.
    pub wrong: Share,
    /// Campaigns with physics outside the library, of kinds that the diagnosis was not made for, by oracle gain.
    pub frozen: Vec<([f64; 2], Unknown)>,
    /// The same of kinds that it has met before.
    pub unknown: Vec<([f64; 2], Unknown)>,
    /// Single effects named right, by kind and size (weak, medium, strong thirds of the logarithm).
    pub power: BTreeMap<String, [Share; 3]>,
    /// Wrong names: what it was, what was said.
    pub confused: Vec<(String, String)>,
    /// Stated probabilities, in several mixes.
    pub calibration: Vec<Calibration>,
    /// Pulls of the amplitudes of named effects: number, mean square, and share within 1 and 2 standard deviations.
    pub amplitudes: (usize, f64, [Share; 2]),
    /// 95 % stretches of a gradient's place that hold it.
    pub places: Share,
    /// NEES per var before and after, medians where all effects were named right.
    pub nees: [f64; 2],
    /// Held-out gain in its standard errors, median of effects named right.
    pub heldout: f64,
    /// Median and longest time of a diagnosis [s].
    pub seconds: [f64; 2],
}

/// Oracle gains that make a row.
const GAINS: [[f64; 2]; 5] = [[f64::NEG_INFINITY, 4.0], [4.0, 9.0], [9.0, 25.0], [25.0, 100.0], [100.0, f64::INFINITY]];
/// Oracle gain from which an effect should be found.
const VISIBLE: f64 = 25.0;
/// NEES per var of right error bars: for the Booster's 48 vars in 99.4 of 100 campaigns.
const NEES: core::ops::Range<f64> = 0.5..1.6;
/// Thirds of the logarithm of the sizes that are drawn.
const THIRDS: [f64; 2] = [0.464, 1.077];
impl Fates {
    fn of<'o>(fates: impl Iterator<Item = &'o Fate>) -> Self {
        let mut all = Self::default();
        for fate in fates {
            *match fate {
                Fate::Named => &mut all.named,
                Fate::Together => &mut all.together,
                Fate::Listed => &mut all.listed,
                Fate::Absent => &mut all.absent,
            } += 1;
        }
        all
    }

    /// Named, or undecided among inseparable causes.
    fn found(&self) -> Share {
        Share::new(self.named + self.together, self.total())
    }

    fn total(&self) -> usize {
        self.named + self.together + self.listed + self.absent
    }
}

impl OfMachines {
    fn of(outcomes: &[Outcome], is_imperfect: bool) -> Self {
        let all: Vec<&Outcome> = outcomes.iter().filter(|outcome| outcome.is_imperfect == is_imperfect).collect();
        let some = |is: fn(&Outcome) -> bool| all.iter().copied().filter(move |outcome| is(outcome));
        let library = || some(|outcome| outcome.class != Class::Unknown);
        let visible = library().flat_map(|outcome| &outcome.fates).filter(|(gain, _)| *gain > VISIBLE);
        let fates = Fates::of(visible.map(|(_, fate)| fate));
        let unknown = some(|outcome| outcome.class == Class::Unknown && outcome.oracle_gain > VISIBLE);
        let pulls: Vec<f64> = all.iter().flat_map(|outcome| outcome.pulls.iter().copied()).collect();
        Self {
            campaigns: all.len(),
            consistent: Share::of(some(|outcome| outcome.class == Class::Empty), |o| o.verdict == Verdict::Consistent),
            wrong: Share::of(library(), |outcome| outcome.grade == Grade::Wrong),
            named: fates.found(),
            open: Share::of(unknown, |outcome| outcome.grade == Grade::Open),
            amplitudes: (pulls.len(), mean(pulls.iter().map(|pull| pull * pull))),
            nees: mean(library().map(|outcome| outcome.nees[1])),
            nees_within: Share::of(library(), |outcome| NEES.contains(&outcome.nees[1])),
        }
    }
}

impl Tables {
    /// Count.
    pub fn of(outcomes: &[Outcome]) -> Self {
        let class = |class: Class| outcomes.iter().filter(move |outcome| outcome.class == class);
        let library = || outcomes.iter().filter(|o| matches!(o.class, Class::Single | Class::Pair));
        let with_gain = |[from, to]: [f64; 2]| {
            let effects = library().flat_map(|outcome| &outcome.fates);
            effects.filter(move |(gain, _)| (from..to).contains(gain)).map(|(_, fate)| fate)
        };
        let right = || outcomes.iter().filter(|o| o.grade == Grade::Right && o.class != Class::Empty);
        let pulls: Vec<f64> = outcomes.iter().flat_map(|o| o.pulls.iter().copied()).collect();
        let inside = |limit: f64| Share::new(pulls.iter().filter(|p| p.abs() < limit).count(), pulls.len());
        let covered: Vec<bool> = outcomes.iter().flat_map(|o| o.covered.iter().copied()).collect();
        let seconds: Vec<f64> = outcomes.iter().map(|o| o.seconds).collect();
        Self {
            machines: [false, true].map(|is_imperfect| OfMachines::of(outcomes, is_imperfect)),
            empty_consistent: Share::of(class(Class::Empty), |o| o.verdict == Verdict::Consistent),
            empty_identified: Share::of(class(Class::Empty), is_named),
            by_gain: GAINS.map(|bin| (bin, Fates::of(with_gain(bin)))).into(),
            wrong: Share::of(outcomes.iter().filter(|o| o.class != Class::Unknown), |o| o.grade == Grade::Wrong),
            frozen: unknown(outcomes, true),
            unknown: unknown(outcomes, false),
            power: power(class(Class::Single)),
            confused: outcomes.iter().filter(|o| o.grade == Grade::Wrong).map(confusion).collect(),
            calibration: Calibration::all(outcomes),
            amplitudes: (pulls.len(), mean(pulls.iter().map(|p| p * p)), [inside(1.0), inside(2.0)]),
            places: Share::new(covered.iter().filter(|covered| **covered).count(), covered.len()),
            nees: [0, 1].map(|i| median(right().map(|o| o.nees[i])).unwrap_or(0.0)),
            heldout: median(right().map(|o| o.heldout.0 / o.heldout.1)).unwrap_or(0.0),
            seconds: [median(seconds.iter().copied()).unwrap_or(0.0), seconds.iter().copied().fold(0.0, f64::max)],
        }
    }

    /// As Markdown.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        self.write(&mut text).expect("a string takes everything");
        text
    }

    fn write(&self, text: &mut String) -> core::fmt::Result {
        writeln!(text, "All campaigns below are simulated by the exact twin.\n")?;
        writeln!(text, "| empty campaigns | of all, 95 % limits |\n|---|---|")?;
        writeln!(text, "| called consistent | {} |", self.empty_consistent.text())?;
        writeln!(text, "| something named | {} |\n", self.empty_identified.text())?;
        self.write_machines(text)?;
        writeln!(
            text,
            "Effects of the library, one or two a campaign, by the gain in ln posterior when kind, place and size are given (of one of \
             two: beside the other):\n"
        )?;
        writeln!(
            text,
            "| oracle gain | effects | named | undecided among inseparable causes | undecided, listed | not mentioned | named or such a set |"
        )?;
        writeln!(text, "|---|---|---|---|---|---|---|")?;
        for (bin, fates) in &self.by_gain {
            let Fates { named, together, listed, absent } = fates;
            let found = fates.found();
            let counts = format!("{} | {named} | {together} | {listed} | {absent}", fates.total());
            writeln!(text, "| {} | {counts} | {} |", range(bin), found.text())?;
        }
        writeln!(text, "\nCampaigns with a false identification: {}.", self.wrong.text())?;
        self.write_unknown(text)?;
        writeln!(
            text,
            "\nA place is right within the mean distance of two quadrupoles. A name is refuted where the means of settings are more likely with the \
             exact signal than with that name by over 25 nat, in ln posterior; by less the name describes them nearly as well as the truth."
        )?;
        writeln!(
            text,
            "\nPower: single effects named right, by size (in prior standard deviations; kinds without one: all):\n"
        )?;
        writeln!(text, "| kind | 0.2 to 0.46 | 0.46 to 1.08 | 1.08 to 2.5 |\n|---|---|---|---|")?;
        for (kind, shares) in &self.power {
            let [weak, medium, strong] = shares.map(|s| format!("{} of {}", s.of, s.trials));
            writeln!(text, "| `{kind}` | {weak} | {medium} | {strong} |")?;
        }
        writeln!(text, "\nWrong names: {}\n", if self.confused.is_empty() { "none." } else { "" })?;
        for (truth, said) in &self.confused {
            writeln!(text, "- {truth}, called {said}")?;
        }
        self.write_calibration(text)?;
        let (number, square, [one, two]) = &self.amplitudes;
        writeln!(text, "| what | measured |\n|---|---|")?;
        writeln!(text, "| amplitudes of named effects: mean square pull | {square:.2} of {number} |")?;
        writeln!(text, "| within one standard deviation | {} |", one.text())?;
        writeln!(text, "| within two | {} |", two.text())?;
        writeln!(text, "| 95 % stretch of a gradient's place holds it | {} |", self.places.text())?;
        writeln!(
            text,
            "| NEES per var where named right, median, before and after | {:.2}, {:.2} |",
            self.nees[0], self.nees[1]
        )?;
        writeln!(text, "| held-out gain where named right, median, in standard errors | {:.1} |", self.heldout)?;
        writeln!(
            text,
            "| time of one diagnosis beside another, median and longest | {:.1} s, {:.1} s |",
            self.seconds[0], self.seconds[1]
        )
    }

    fn write_machines(&self, text: &mut String) -> core::fmt::Result {
        writeln!(
            text,
            "Half of the machines are ideal but for their vars, misaligned quadrupoles and two faulty monitors. The others have ordinary \
             imperfections, as large as the base model takes for granted: gains, rolls and couplings of all monitors and correctors, rolls of \
             quadrupoles, gradients in dipoles and straights, edge angles and sextupoles of dipoles, hysteresis, a momentum, and noise that \
             differs from the header's (standard deviation of its logarithm 0.25). Oracle gains are those of the ideal machine:\n"
        )?;
        let [ideal, imperfect] = self.machines.each_ref().map(|one| one.campaigns);
        writeln!(text, "| | ideal machines ({ideal}) | with ordinary imperfections ({imperfect}) |\n|---|---|---|")?;
        let mut row = |what: &str, of: &dyn Fn(&OfMachines) -> String| {
            let [ideal, imperfect] = self.machines.each_ref().map(of);
            writeln!(text, "| {what} | {ideal} | {imperfect} |")
        };
        row("empty campaigns called consistent", &|one| one.consistent.text())?;
        row("false identifications", &|one| one.wrong.text())?;
        row("effects above 25 nat named, or undecided among inseparable causes", &|one| one.named.text())?;
        row("physics outside the library above 25 nat called open", &|one| one.open.text())?;
        row("mean square pull of named amplitudes", &|one| format!("{:.2} of {}", one.amplitudes.1, one.amplitudes.0))?;
        row("NEES per var, mean, without physics outside the library", &|one| format!("{:.2}", one.nees))?;
        row("NEES from 0.5 to 1.6", &|one| one.nees_within.text())?;
        writeln!(text)
    }

    fn write_unknown(&self, text: &mut String) -> core::fmt::Result {
        let groups = [
            ("of kinds that the diagnosis was not made for", &self.frozen),
            ("of kinds that it has met before", &self.unknown),
        ];
        for (group, rows) in groups {
            writeln!(text, "\nPhysics outside the library, {group}:\n")?;
            writeln!(
                text,
                "| oracle gain | called unexplained or ambiguous, or a monitor said to wander | its place is | named as something else | \
                 of these, refuted by the means of settings |"
            )?;
            writeln!(text, "|---|---|---|---|---|")?;
            for (bin, Unknown { undecided, near, named, refuted }) in rows {
                writeln!(text, "| {} | {} | {} | {named} | {refuted} |", range(bin), undecided.text(), near.text())?;
            }
        }
        Ok(())
    }

    fn write_calibration(&self, text: &mut String) -> core::fmt::Result {
        writeln!(
            text,
            "\nProbability of the most likely cause of the least certain finding, and how often it is true, in three mixes of campaigns: \
             shares of empty ones, effects of the library and other physics in per cent. The first is what the diagnosis takes for granted; in \
             the others its probabilities follow from Bayes' rule. All are made of the same campaigns by weights; a share is of effectively as \
             many campaigns as stand there.\n"
        )?;
        writeln!(text, "| mix | stated | mean | true, 95 % limits | effectively |\n|---|---|---|---|---|")?;
        for Calibration { mix, bins, .. } in &self.calibration {
            for Reliability { bin, effectively, stated, is_true, limits, .. } in bins {
                let ([from, to], [lower, upper]) = (bin, limits.map(|limit| 100.0 * limit));
                writeln!(
                    text,
                    "| {} | {from:.2} to {:.2} | {stated:.3} | {:.1} % ({lower:.1} to {upper:.1} %) | {effectively:.0} |",
                    mix.text(),
                    to.min(1.0),
                    100.0 * is_true
                )?;
            }
        }
        let (bins, outside) = self.calibration.iter().fold((0, 0), |(n, o), c| (n + c.bins.len(), o + c.outside()));
        let brier: Vec<String> = self.calibration.iter().map(|one| format!("{:.3}", one.brier)).collect();
        writeln!(text, "\nOutside the limits: {outside} of {bins}. Brier scores {}.\n", brier.join(", "))
    }
}

fn is_named(outcome: &Outcome) -> bool {
    outcome.verdict == Verdict::Identified
}

/// What became of physics outside the library, of kinds that are frozen or not, by oracle gain.
fn unknown(outcomes: &[Outcome], is_frozen: bool) -> Vec<([f64; 2], Unknown)> {
    let kind = |outcome: &Outcome| outcome.truth.first().and_then(|made| UnmodelledKind::named(&made.kind));
    let is_one = |outcome: &&Outcome| {
        outcome.class == Class::Unknown && kind(outcome).is_some_and(|kind| kind.is_frozen() == is_frozen)
    };
    let of = |bin: [f64; 2]| {
        let within = move |outcome: &&Outcome| (bin[0]..bin[1]).contains(&outcome.oracle_gain);
        let all: Vec<&Outcome> = outcomes.iter().filter(is_one).filter(within).collect();
        let share = |is: fn(&Outcome) -> bool| Share::of(all.iter().copied(), is);
        let undecided = share(|outcome| outcome.grade == Grade::Open);
        let is_refuted = |outcome: &Outcome| outcome.beyond_name.is_some_and(|gain| gain > VISIBLE);
        let (named, refuted) = (share(is_named).of, share(is_refuted).of);
        (bin, Unknown { undecided, near: share(|outcome| outcome.near), named, refuted })
    };
    GAINS.map(of).into()
}

/// Named right, by kind and third of the logarithm of the size.
fn power<'o>(outcomes: impl Iterator<Item = &'o Outcome>) -> BTreeMap<String, [Share; 3]> {
    let mut counts: BTreeMap<String, [(usize, usize); 3]> = BTreeMap::new();
    for outcome in outcomes {
        let Some(effect) = outcome.truth.first() else { continue };
        let third = effect.size.map_or(2, |size| usize::from(size > THIRDS[0]) + usize::from(size > THIRDS[1]));
        let (of, trials) = &mut counts.entry(effect.kind.clone()).or_default()[third];
        *of += usize::from(outcome.grade == Grade::Right);
        *trials += 1;
    }
    counts.into_iter().map(|(kind, thirds)| (kind, thirds.map(|(of, trials)| Share::new(of, trials)))).collect()
}

fn confusion(outcome: &Outcome) -> (String, String) {
    let truth: Vec<&str> = outcome.truth.iter().map(|made| made.label.as_str()).collect();
    let truth = if truth.is_empty() { "nothing".into() } else { truth.join(" + ") };
    let said = outcome.found.join(" + ");
    let beyond = outcome.beyond_name.map_or(String::new(), |gain| format!("; {gain:.1} nat tell it from that"));
    (format!("{truth} (oracle gain {:.1})", outcome.oracle_gain), said + &beyond)
}

fn range([from, to]: &[f64; 2]) -> String {
    match (from.is_finite(), to.is_finite()) {
        (false, _) => format!("below {to:.0}"),
        (_, false) => format!("above {from:.0}"),
        _ => format!("{from:.0} to {to:.0}"),
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    if count > 0.0 { sum / count } else { 0.0 }
}
