//! What passes within a setting: a monitor that is late, a corrector that settles, a machine that keeps a share of its former orbit, a corrector that is
//! unsteady (`unsteady.rs`).
//!
//! All other physics is the same in every frame of a setting, and these show in the frames after a change, so that the two are found apart:
//! here from the differences within the runs of frames of one setting (`differences.rs`), by signals made of measured orbits
//! (`signals.rs`); afterwards, with the signals that were found taken out, from the means of the runs.
//!
//! With `d` the whitened differences and `s` the whitened derivative of a signal, of the prior standard deviation `w`,
//!
//! `ln Bayes factor = (d.s)^2 w^2/(1 + w^2 s.s)/2 - ln(1 + w^2 s.s)/2` ([`Evidence`]),
//!
//! the leaders' with the exact signal at the best amplitude. Probabilities follow as in [`super::search`]. What is found has to be rare
//! among the same frames with another one of each run as its first, which keeps all that monitors share within a frame, and each run has to be
//! predicted by the others.

mod differences;
mod signals;
mod unsteady;

use core::ops::Range;

use evidence::Evidence;
use nalgebra::{DMatrix, DMatrixView, DVector};
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use twin::{EffectKind, Hold, Optics, OrbitError, Ring, Signatures, Site};

use super::alternatives::{Alternative, Cause, Weighed};
use super::data::{drives_of, rippled};
use super::discrepancy::Discrepancy;
use super::heldout::VALIDATED;
use super::location::Location;
use super::odds::{ODDS, SUSPICIOUS, UNMODELLED, log_prior_unmodelled};
use super::term::Term;
use super::tested::Tested;
use differences::{Differences, median};
pub(super) use differences::{run_means, runs};
use inference::Campaign;
use inference::recording::Recording;
use signals::Signals;
use unsteady::Unsteady;

/// What passes within the settings of a recording.
#[derive(Debug, Clone)]
pub struct Transients {
    /// One for each cause, strongest first.
    pub found: Vec<Transient>,
    /// The campaign without them.
    pub campaign: Campaign,
}

/// Something that passes.
#[derive(Debug, Clone)]
pub struct Transient {
    /// Possible causes, most likely first.
    pub alternatives: Vec<Alternative>,
    /// How an effect stood its tests.
    pub tested: Option<Tested>,
    /// Readings of the frames after a change less the later ones of their run, against what the leading cause should make of them, per unit of its
    /// amplitude [m]; of an unsteady corrector those of every frame less the mean of their run.
    pub shown: Vec<Shown>,
}

/// A reading of a frame after a change, or of one with a corrector that is unsteady.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shown {
    /// Predicted difference [m], per unit of the amplitude of a cause that has one.
    pub predicted: f64,
    /// The difference [m].
    pub measured: f64,
    /// Its noise [m].
    pub sigma: f64,
}

/// Most causes.
const MOST: usize = 4;
/// Causes whose amplitude is fitted with the exact signal.
const LEADERS: usize = 4;
/// Steps of such a fit, and the step of its derivative.
const STEPS: usize = 5;
const DIFFERENCE: f64 = 1e-3;
/// Largest share that a corrector keeps: with 1 it would never move.
const LARGEST: f64 = 0.95;
/// Largest share of the frame before that a monitor reads: 1 where it is late by a whole frame, and somewhat more where the fit does not know the size well.
const LATEST: f64 = 1.25;
/// Standard deviations of a share of the former orbit that are tried.
const SHARES: [f64; 4] = [0.01, 0.03, 0.1, 0.3];
/// Median of a normal number's square.
const MEDIAN_SQUARE: f64 = 0.455;
/// Shuffles, and the probability by chance above which nothing is claimed.
const SHUFFLES: usize = 199;
const RARE: f64 = 0.01;
const SEED: u64 = 1;

impl Transient {
    /// True for the cause of the finding that states it.
    pub fn is_of(&self, cause: &Cause) -> bool {
        self.alternatives[0].cause.is(cause)
    }
}

impl Transients {
    /// Find them, one after the other.
    pub fn find(ring: &Ring, recording: &Recording) -> Result<Self, OrbitError> {
        let mut campaign = Campaign::of(ring, recording)?;
        let optics = Optics::of(campaign.held.ring(), Hold::Momentum { delta: 0.0 })?;
        let dispersion = optics.dispersion_of(&optics.read_monitors());
        let mut found: Vec<Transient> = Vec::new();
        while found.len() < MOST
            && let Some((transient, without)) = SettingDifferences::from_campaign(&campaign, &dispersion).strongest()
        {
            campaign = Campaign::of(ring, &without)?;
            let is_of_first_frames = matches!(
                &transient.alternatives[0].cause,
                Cause::Unmodelled(Discrepancy { at: Location::FirstFrames { .. }, .. })
            );
            found.push(transient);
            // first frames, which show what passes, are gone
            if is_of_first_frames {
                break;
            }
        }
        Ok(Self { found, campaign })
    }
}

/// Those of one more recording beside those of others: a cause of both is told by the one that shows it better.
pub fn join(known: &mut Vec<Transient>, more: Vec<Transient>, campaign: usize) {
    let before = known.len();
    for mut one in more {
        for alternative in &mut one.alternatives {
            if let Cause::Unmodelled(discrepancy) = &mut alternative.cause {
                discrepancy.campaign = campaign;
            }
        }
        let leading = &one.alternatives[0];
        match known[..before].iter().position(|other| other.alternatives[0].cause.is(&leading.cause)) {
            None => known.push(one),
            Some(at) if leading.log_gain > known[at].alternatives[0].log_gain => known[at] = one,
            Some(_) => {}
        }
    }
}

/// A campaign's differences within settings, and what may be in them.
struct SettingDifferences<'c> {
    campaign: &'c Campaign,
    differences: Differences,
    /// Readings at the mean supply currents and kicks [m].
    readings: DMatrix<f64>,
    /// The signals by these.
    signals: Signals<'c>,
    /// The readings whitened.
    white: DMatrix<f64>,
    /// The whole former orbit in first frames, whitened.
    former: DMatrix<f64>,
    /// Variance of the readings along orbits.
    spread: f64,
    terms: Vec<Term>,
}

/// An effect with its exact signal at its best amplitude.
struct Fit {
    /// Its index among the terms.
    at: usize,
    alternative: Alternative,
    /// Held-out gain, and its standard error.
    gain: (f64, f64),
    /// The signal [m].
    signal: DMatrix<f64>,
}

impl<'c> SettingDifferences<'c> {
    fn from_campaign(campaign: &'c Campaign, dispersion: &DVector<f64>) -> Self {
        let noise = &campaign.recording.header.noise;
        let readings = steady(campaign);
        let (settings, ripple) = (&campaign.settings.repeatable, &campaign.fluctuation);
        let differences = Differences::from_readings(&readings, settings, noise, dispersion, ripple);
        let white = differences.whiten(&readings);
        let monitors = (0..campaign.monitors()).filter(|&b| differences.sees(b));
        let late =
            monitors.map(|b| Term { kind: EffectKind::BpmTiming, site: Site::Monitor(campaign.ring.read_monitors[b]) });
        let settling = driven(campaign)
            .into_iter()
            .map(|c| Term { kind: EffectKind::CorrectorSettling, site: Site::Corrector(c) });
        let terms = late.chain(settling).collect();
        let signals = Signals::from_readings(campaign, &readings);
        let former = differences.whiten(&signals.of_former_orbit());
        let spread = spread(&differences, &former, &white);
        Self { campaign, differences, readings, signals, white, former, spread, terms }
    }

    /// The most likely cause, if there is one, and the recording without it.
    fn strongest(&self) -> Option<(Transient, Recording)> {
        if self.differences.runs.is_empty() {
            return None;
        }
        let slopes: Vec<DMatrix<f64>> = self.terms.iter().map(|&term| self.slope(&self.signals, term, 0.0)).collect();
        let first_order = self.weights(&slopes, &self.white);
        let (of_former, of_terms) = first_order.split_last()?;
        let (mut fits, mut former) = (self.leaders(of_terms), self.former_orbit());
        let of_former = former.as_ref().map_or(f64::NEG_INFINITY, |_| *of_former);
        let best = fits.iter().map(|fit| of_terms[fit.at]).fold(of_former, f64::max);
        let chance = if best > 0.0 { self.by_chance(&slopes, best) } else { 1.0 };
        if chance > RARE {
            fits.clear();
            former = None;
        }
        let weighed =
            |fit: &Fit| (fit.alternative.clone(), fit.alternative.log_gain + self.log_prior(self.terms[fit.at]));
        let mut weights: Vec<(Alternative, f64)> = fits.iter().map(weighed).collect();
        // of a corrector that is unsteady no frame is the first
        let mut unsteady = self.unsteady(&self.white);
        // and what settles is not unsteady
        if let Some((best, _)) =
            weights.iter().enumerate().max_by(|(_, (_, one)), (_, (_, other))| one.total_cmp(other))
        {
            let left = &self.white - self.differences.whiten(&fits[best].signal);
            let still = self.unsteady(&left);
            unsteady.retain(|one| still.iter().any(|other| other.at == one.at));
        }
        weights.extend(former.into_iter().chain(unsteady).map(|one| {
            let weight = one.log_bayes + log_prior_unmodelled(ODDS, 1) - (one.sites as f64).ln();
            (Alternative::unmodelled(one), weight)
        }));
        // what is too small to be seen is weighed with the search
        let Weighed { alternatives, nothing, .. } = Weighed::from_log_weights(weights, 0.0);
        if 1.0 - nothing < SUSPICIOUS {
            return None;
        }
        let leading = &alternatives.first()?.cause;
        let fit = fits.iter().find(|fit| leading.is(&fit.alternative.cause));
        let tested =
            fit.map(|fit| Tested { gain: fit.gain, of_choice: None, chance: Some(chance), is_of_family: false });
        let (shown, without) = match (fit, leading) {
            (Some(fit), _) => (self.shown(&(&fit.signal / fit.alternative.amplitude.0)), self.less(&fit.signal)),
            (None, Cause::Unmodelled(Discrepancy { at: Location::FirstFrames { from, to }, .. })) => {
                (self.shown(&self.signals.of_former_orbit()), self.without_first_frames(*from, *to))
            }
            (None, Cause::Unmodelled(Discrepancy { at: Location::UnsteadyCorrector(c), .. })) => {
                let unsteady = Unsteady::from_response(&self.differences, &self.white, self.signals.of_corrector(*c))?;
                (unsteady.shown(&self.readings, |frame| is_on(self.campaign, *c, frame)), self.without_corrector(*c))
            }
            (None, _) => return None,
        };
        Some((Transient { alternatives, tested, shown }, without))
    }

    /// The likeliest effects by first order of which each run is predicted by the others: one reading that jumps predicts none.
    fn leaders(&self, weights: &[f64]) -> Vec<Fit> {
        let mut order: Vec<usize> = (0..weights.len()).filter(|&i| weights[i] > 0.0).collect();
        order.sort_by(|&one, &other| weights[other].total_cmp(&weights[one]));
        let fits = order.into_iter().map(|at| self.fit(at));
        fits.filter(|fit| is_validated(fit.gain)).take(LEADERS).collect()
    }

    /// Whitened derivative of a signal.
    fn slope(&self, signals: &Signals, term: Term, amplitude: f64) -> DMatrix<f64> {
        let signal = |amplitude: f64| signals.of_effect(term, amplitude);
        self.differences
            .whiten(&((signal(amplitude + DIFFERENCE) - signal(amplitude - DIFFERENCE)) / (2.0 * DIFFERENCE)))
    }

    /// `ln` of prior times Bayes factor of each term to first order, then that of a share of the former orbit.
    fn weights(&self, slopes: &[DMatrix<f64>], white: &DMatrix<f64>) -> Vec<f64> {
        let of_term = |(slope, &term): (&DMatrix<f64>, &Term)| {
            let spread = self.spread_of(term);
            let evidence = Evidence::from_score(slope.dot(white) / spread, slope.norm_squared() / spread, width(term));
            evidence.log_bayes_factor + self.log_prior(term)
        };
        let of_unmodelled = self.stretch(white).0 + log_prior_unmodelled(ODDS, 1);
        slopes.iter().zip(&self.terms).map(of_term).chain([of_unmodelled]).collect()
    }

    /// `ln` Bayes factor of a share of the former orbit in a stretch of the campaign, averaged over its size and over all stretches of runs; first and last
    /// frame of the likeliest stretch, and its share.
    fn stretch(&self, white: &DMatrix<f64>) -> (f64, (usize, usize), f64) {
        let runs = &self.differences.runs;
        let mut sums = vec![(0.0, 0.0)];
        for run in runs {
            let (signal, data) = (self.former.rows_range(run.clone()), white.rows_range(run.clone()));
            let (pull, power) = sums[sums.len() - 1];
            sums.push((pull + signal.dot(&data) / self.spread, power + signal.norm_squared() / self.spread));
        }
        let each = (0..runs.len()).flat_map(|from| (from..runs.len()).map(move |to| (from, to)));
        let each = each.flat_map(|at| SHARES.map(|share| (at, share)));
        let weigh = |((from, to), share): ((usize, usize), f64)| {
            let ((pull, power), (more, powerful)) = (sums[from], sums[to + 1]);
            let evidence = Evidence::from_score(more - pull, powerful - power, share);
            (evidence.log_bayes_factor, (runs[from].start, runs[to].end - 1), share)
        };
        let all: Vec<(f64, (usize, usize), f64)> = each.map(weigh).collect();
        let best = all.iter().copied().fold((f64::NEG_INFINITY, (0, 0), 0.0), |a, b| if b.0 > a.0 { b } else { a });
        let mean = all.iter().map(|one| (one.0 - best.0).exp()).sum::<f64>() / all.len() as f64;
        (best.0 + mean.ln(), best.1, best.2)
    }

    /// The share of the former orbit, its size that in the readings; none where what some monitors show does not predict the others, as where
    /// one reading jumps.
    fn former_orbit(&self) -> Option<Discrepancy> {
        let (log_bayes, (from, to), share) = self.stretch(&self.white);
        let (signal, data) = (self.former.rows_range(from..=to), self.white.rows_range(from..=to));
        let monitors = (0..signal.ncols()).map(|b| (0..signal.nrows(), b..b + 1));
        if !is_validated(held_out(&signal, &data, share, monitors)) {
            return None;
        }
        let orbit = self.signals.of_former_orbit();
        let some: Vec<f64> = orbit.rows_range(from..=to).iter().copied().filter(|x| *x != 0.0).collect();
        let rms = (some.iter().map(|x| x * x).sum::<f64>() / some.len().max(1) as f64).sqrt();
        let at = Location::FirstFrames { from, to };
        Some(Discrepancy { at, campaign: 0, log_bayes, size: share * rms, sites: 1, adapted: None })
    }

    /// Each corrector as one that is unsteady, by whitened readings, where these confirm it.
    fn unsteady(&self, white: &DMatrix<f64>) -> Vec<Discrepancy> {
        let correctors = driven(self.campaign);
        let judged = |&c: &usize| {
            let unsteady = Unsteady::from_response(&self.differences, white, self.signals.of_corrector(c))?;
            unsteady.judge(c, |frame| is_on(self.campaign, c, frame), correctors.len())
        };
        correctors.iter().filter_map(judged).collect()
    }

    /// Variance of the readings along the signal of an effect.
    fn spread_of(&self, term: Term) -> f64 {
        if term.kind.is_of_a_corrector() { self.spread } else { 1.0 }
    }

    /// `ln` prior odds of an effect over none: all kinds and all places of a kind are equally likely.
    fn log_prior(&self, term: Term) -> f64 {
        let places = self.terms.iter().filter(|one| one.kind == term.kind).count();
        ((1.0 - UNMODELLED) * ODDS / (EffectKind::ALL.len() * places) as f64).ln()
    }

    /// The best amplitude of an effect, by the exact signal.
    fn fit(&self, at: usize) -> Fit {
        let term = self.terms[at];
        let (readings, width) = (&self.readings, width(term));
        let largest = if term.kind.is_of_a_corrector() { LARGEST } else { LATEST };
        let mut amplitude = 0.0_f64;
        let mut signal = DMatrix::zeros(readings.nrows(), readings.ncols());
        for _ in 0..STEPS {
            let signals = Signals::from_readings(self.campaign, &(readings - &signal));
            let slope = self.slope(&signals, term, amplitude);
            let left = self.differences.whiten(&(readings - signals.of_effect(term, amplitude)));
            let information = slope.norm_squared() + width.powi(-2);
            amplitude += (slope.dot(&left) - amplitude / width.powi(2)) / information;
            amplitude = amplitude.clamp(-largest, largest);
            signal = signals.of_effect(term, amplitude);
        }
        let without = readings - &signal;
        let slope = self.slope(&Signals::from_readings(self.campaign, &without), term, amplitude);
        let left = self.differences.whiten(&without);
        let spread = self.spread_of(term);
        let gained = (self.white.norm_squared() - left.norm_squared()) / spread;
        let evidence = Evidence::about(amplitude, gained, slope.norm_squared() / spread, width);
        let amplitude_and_error = (amplitude, evidence.sigma);
        let alternative = Alternative::unfitted(Cause::Effect(term), evidence.log_bayes_factor, amplitude_and_error);
        let runs = self.differences.runs.iter().map(|run| (run.clone(), 0..slope.ncols()));
        let gain = held_out(&slope.as_view(), &(&left + &slope * amplitude).as_view(), width, runs);
        Fit { at, alternative, gain, signal }
    }

    /// Probability that the best of all is as good where another frame of each run takes the place of the first.
    fn by_chance(&self, slopes: &[DMatrix<f64>], best: f64) -> f64 {
        let mut rng = StdRng::seed_from_u64(SEED);
        let mut exceeding = 0;
        for _ in 0..SHUFFLES {
            let mut frames: Vec<usize> = (0..self.white.nrows()).collect();
            for run in &self.differences.runs {
                frames[run.clone()].shuffle(&mut rng);
                if frames[run.start] == run.start {
                    frames.swap(run.start, rng.random_range(run.start + 1..run.end));
                }
            }
            let shuffled = self.white.select_rows(&frames);
            exceeding += usize::from(self.weights(slopes, &shuffled).iter().any(|weight| *weight >= best));
        }
        (1 + exceeding) as f64 / (1 + SHUFFLES) as f64
    }

    /// First frames less the later ones of their run, where a signal is, per unit of its amplitude [m].
    fn shown(&self, signal: &DMatrix<f64>) -> Vec<Shown> {
        let mut shown = Vec::new();
        for run in &self.differences.runs {
            for b in (0..self.campaign.monitors()).filter(|&b| self.differences.sees(b)) {
                let less_later = |values: &DMatrix<f64>| {
                    values[(run.start, b)] - values.view((run.start + 1, b), (run.len() - 1, 1)).mean()
                };
                let (predicted, measured) = (less_later(signal), less_later(&self.readings));
                if predicted != 0.0 && measured.is_finite() {
                    let noise = self.differences.noise(b);
                    let sigma = noise * (1.0 + ((run.len() - 1) as f64).recip()).sqrt();
                    shown.push(Shown { predicted, measured, sigma });
                }
            }
        }
        shown
    }

    /// The recording less a signal.
    fn less(&self, signal: &DMatrix<f64>) -> Recording {
        let mut recording = self.campaign.recording.clone();
        for (row, values) in recording.rows.iter_mut().zip(signal.row_iter()) {
            row.reading.iter_mut().zip(values.iter()).for_each(|(to, signal)| *to = to.map(|reading| reading - signal));
        }
        recording
    }

    /// The recording without the readings in which a corrector kicks the beam.
    fn without_corrector(&self, corrector: usize) -> Recording {
        let mut recording = self.campaign.recording.clone();
        let rows = recording.rows.iter_mut().enumerate().filter(|(frame, _)| is_on(self.campaign, corrector, *frame));
        rows.for_each(|(_, row)| row.reading.fill(None));
        recording
    }

    /// The recording without the readings in a stretch that a share of the former orbit moves by more than a third of a typical noise: the first of
    /// each run, and as many more as it lasts. A share that is kept falls by itself from frame to frame.
    fn without_first_frames(&self, from: usize, to: usize) -> Recording {
        let (signal, data) = (self.former.rows_range(from..=to), self.white.rows_range(from..=to));
        let share = (signal.dot(&data) / signal.norm_squared()).abs().clamp(f64::MIN_POSITIVE, LARGEST);
        let shown = signal.iter().filter(|x| **x != 0.0).count().max(1) as f64;
        let largest = (signal.norm_squared() / shown).sqrt().max(1.0);
        let frames = ((0.3 / largest).ln() / share.ln()).ceil() as usize;
        let mut recording = self.campaign.recording.clone();
        for run in self.differences.runs.iter().filter(|run| run.start <= to + 1 && run.end >= from) {
            let moved = run.start..run.end.min(run.start + frames);
            recording.rows[moved].iter_mut().for_each(|row| row.reading.fill(None));
        }
        recording
    }
}

/// True of a frame in which a corrector kicks the beam.
fn is_on(campaign: &Campaign, corrector: usize, frame: usize) -> bool {
    campaign.settings.setting(frame).moves(corrector)
}

/// Correctors that kick the beam in some frame.
fn driven(campaign: &Campaign) -> Vec<usize> {
    (0..campaign.ring.correctors.len()).filter(|&corrector| campaign.settings.moves(corrector)).collect()
}

/// Readings at the mean supply currents and kicks of each run, by the machine that the screening ends with: next to an integer tune every ripple
/// moves the orbit in one pattern, which resembles that of the run before [m]. As recorded where that machine keeps no beam.
fn steady(campaign: &Campaign) -> DMatrix<f64> {
    let strengths = campaign.ring.strengths(campaign.params.as_slice(), &campaign.supplies);
    let machine = campaign.held.with_strengths(&strengths);
    let drives = drives_of(campaign);
    let moved = || -> Result<DMatrix<f64>, OrbitError> {
        let of_kicks = machine.readings(&drives)?.0;
        let slopes = Signatures::of(&machine, &drives)?.of_quadrupoles();
        let of_supplies = rippled(&campaign.ring, &slopes, &campaign.fluctuation);
        let means = run_means(&of_kicks, &campaign.settings.repeatable);
        Ok(of_kicks - means + of_supplies.columns(0, campaign.monitors()))
    };
    let readings = campaign.readings_of_beam();
    match moved() {
        Ok(moved) => readings - moved,
        Err(_) => readings,
    }
}

/// Variance of whitened readings along the former orbits, where the frame after takes the place of each: 1 for white noise, more where monitors share
/// noise or a ripple. By the median over the runs, of which few hold an effect.
fn spread(differences: &Differences, former: &DMatrix<f64>, white: &DMatrix<f64>) -> f64 {
    let of_run = |run: &Range<usize>| {
        let next = |frame: usize| if frame + 1 < run.end { frame + 1 } else { run.start };
        let pull: f64 = run.clone().map(|frame| former.row(frame).dot(&white.row(next(frame)))).sum();
        let power = former.rows_range(run.clone()).norm_squared();
        (power > 0.0).then(|| pull * pull / power)
    };
    let mut squares: Vec<f64> = differences.runs.iter().filter_map(of_run).collect();
    (median(&mut squares) / MEDIAN_SQUARE).max(1.0)
}

/// Gain of log predictive density of each block of readings (frames, monitors) by the amplitude fitted to all others, and its standard error
/// over the readings: a corrector that settles has few runs and many readings. `whole`: whitened readings, the signal linear. The
/// amplitude's own error is left out, which is small where it matters.
fn held_out(
    slope: &DMatrixView<f64>,
    whole: &DMatrixView<f64>,
    width: f64,
    blocks: impl Iterator<Item = (Range<usize>, Range<usize>)>,
) -> (f64, f64) {
    let (pull, power) = (slope.dot(whole), slope.norm_squared());
    let of_block = |(frames, monitors): (Range<usize>, Range<usize>)| {
        let within = |all: &DMatrixView<f64>| all.view_range(frames.clone(), monitors.clone()).into_owned();
        let (slope, data) = (within(slope), within(whole));
        let information = power - slope.norm_squared() + width.powi(-2);
        let predicted = &slope * ((pull - slope.dot(&data)) / information);
        let gain = data.zip_map(&predicted, |data, predicted| predicted * (data - 0.5 * predicted));
        gain.iter().copied().collect::<Vec<f64>>()
    };
    let gains: Vec<f64> = blocks.flat_map(of_block).collect();
    let (n, sum) = (gains.len() as f64, gains.iter().sum::<f64>());
    let spread: f64 = gains.iter().map(|gain| (gain - sum / n).powi(2)).sum();
    (sum, (spread * n / (n - 1.0).max(1.0)).sqrt())
}

/// True for a gain of more than two standard errors.
fn is_validated((gain, sigma): (f64, f64)) -> bool {
    gain > VALIDATED * sigma
}

fn width(term: Term) -> f64 {
    term.kind.prior_scale().expect("a share")
}

#[cfg(test)]
mod tests {
    use inference::simulate::Beyond;
    use twin::{Cycle, Effect};

    use super::*;
    use crate::testing::{Coloured, simulated, template};

    fn found(effects: &[&str], seed: u64, change: impl Fn(&mut Coloured)) -> (Ring, Vec<Transient>) {
        let (ring, recording) = template();
        let effects: Vec<Effect> = effects.iter().map(|text| Effect::parse(text, &ring).unwrap()).collect();
        let mut noise = Coloured::white(&ring, &recording, seed);
        change(&mut noise);
        let made = noise.campaign(&ring, &recording, &effects);
        let found = Transients::find(&ring, &made).unwrap().found;
        (ring, found)
    }

    /// Small and large shares of either sign, by exact orbits frame by frame.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_late_monitor_and_a_slow_corrector_are_found_with_their_shares() {
        for (seed, text) in [
            (1, "bpm_timing@x_E4=0.08"),
            (2, "bpm_timing@y_C5=-0.3"),
            (3, "corrector_settling@H_C4=0.1"),
            (4, "corrector_settling@V_D3=0.4"),
            (5, "corrector_settling@H_E6=-0.15"),
        ] {
            let (ring, found) = found(&[text], seed, |_| ());
            let effect = Effect::parse(text, &ring).unwrap();
            assert_eq!(found.len(), 1, "{text}");
            let first = &found[0].alternatives[0];
            assert_eq!(first.term(), Some(&effect.into()), "{text}");
            assert!(first.probability > 0.95 && found[0].tested.unwrap().is_passed(), "{text}: {first:?}");
            let (amplitude, sigma) = first.amplitude;
            assert!((amplitude - effect.amplitude).abs() < 3.0 * sigma, "{text}: {amplitude} ± {sigma}");
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn two_of_them_are_found_one_after_the_other() {
        let (_, found) = found(&["bpm_timing@x_E4=0.1", "corrector_settling@V_D3=0.2"], 6, |_| ());
        let kinds: Vec<_> = found.iter().map(|one| one.alternatives[0].term().unwrap().kind).collect();
        assert_eq!(kinds.len(), 2);
        assert!(kinds.contains(&EffectKind::BpmTiming) && kinds.contains(&EffectKind::CorrectorSettling));
    }

    /// Neither white noise, nor slow noise, a walk, the momentum's jitter or a crate's noise passes for a transient: 2 of 60 by chance, where a
    /// hundredth of the shuffles is rare and the odds are even, were more than expected.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn noise_is_no_transient() {
        let noises: [fn(&mut Coloured); 5] = [
            |_| (),
            |noise| noise.slow = (0.25, 10.0),
            |noise| noise.walk = 4e-6,
            |noise| noise.momentum = 3e-4,
            |noise| noise.crate_share = 0.3,
        ];
        let runs = noises.iter().flat_map(|noise| (0..12).map(move |seed| (noise, seed)));
        let false_ones: Vec<_> = runs.flat_map(|(noise, seed)| found(&[], 40 + seed, noise).1).collect();
        assert!(false_ones.len() <= 2, "{false_ones:?}");
    }

    /// All correctors settle alike.
    struct Settling(f64);

    impl Beyond for Settling {
        fn alter_cycles(&self, cycles: &mut [Cycle]) {
            for i in 1..cycles.len() {
                for c in 0..cycles[i].kick.len() {
                    let lacking = cycles[i - 1].kick[c] - cycles[i].kick[c];
                    cycles[i].kick[c] += self.0 * lacking;
                }
            }
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn all_correctors_that_settle_are_one_cause_and_their_first_frames_are_left_out() {
        let made = simulated(&[1.0; 48], &[], &[&Settling(0.05)], 8);
        let Transients { found, campaign } = Transients::find(&template().0, &made).unwrap();
        assert_eq!(found.len(), 1);
        let Cause::Unmodelled(one) = &found[0].alternatives[0].cause else { panic!("{:?}", found[0].alternatives[0]) };
        let Location::FirstFrames { from, to } = one.at else { panic!("{:?}", one.at) };
        assert!(from < 20 && to > 320, "the whole campaign: {from} to {to}");
        let missing = campaign.recording.rows.iter().filter(|row| row.reading.iter().all(Option::is_none)).count();
        assert!(missing > 100, "{missing}");
    }
}
