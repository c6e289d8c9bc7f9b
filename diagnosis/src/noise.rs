//! The noise of a recording as it is: learnt from its repeats, with the header's noise as a prior.
//!
//! Of each monitor the scale of its noise; of all together its level in time ([`super::levels`]), what the noise remembers ([`super::slow_noise`]), the jitter of the momentum and
//! what crates of monitors have in common (`jitter.rs`), and any other pattern that they share ([`super::frame_pattern`]). Everything comes from differences between readings of the same setting
//! (`repeats.rs`), so that physics that the model lacks does not enter, with two exceptions: what changes with time alone, such as
//! an orbit that drifts, moves all settings alike and counts as a walk of the monitors as long as that has an ordinary size; and the walk of one
//! monitor is learnt from what a fit leaves ([`super::search`]).
//!
//! Scales are root mean squares of the readings that count. Tails are those of the readings that the screening accepts: it drops
//! what is far from its repeats. Weighting the rest by how far each lies from its repeats would gain up to a third of the information for
//! tails of Student's t with four degrees of freedom, but their chi-square would no longer be their number, and two repeats cannot tell which
//! is the outlier.

use core::ops::Range;

use estimator::MonitorState;
use nalgebra::{DMatrix, DVector};
use twin::{Measured, Unit, median};

use super::columns::beside;
use super::frame_pattern::{self, Found, FrameToFrame, Known, Like, Shape};
use super::jitter::{CRATE, Crate, Differences, groups, with_crates};
use super::levels::{Levels, Part};
use super::memory::Memory;
use super::odds::{SUSPICIOUS, correction_of_sort};
use super::period::Period;
use super::repeats::{Repeats, Run};
use super::scale::{ALIKE, QUOTED, Scales};
use super::slow_noise::{SHARE, Slow, steps};
use super::transients::runs;
use inference::{Campaign, Imperfection, Measure, POSITION};

/// What was learnt of the noise. A value is 0 (a scale 1) where there is no sign of it; its error is then the root mean square that the
/// recording allows.
#[derive(Debug, Clone, PartialEq)]
pub struct Noise {
    /// Scale that all have in common [1].
    pub common_scale: Measured,
    /// Scatter of the scales between monitors, relative [1].
    pub scatter: Measured,
    /// Its level in time; scales are those of the frames outside of these parts.
    pub levels: Levels,
    /// Slow noise and walk.
    pub slow: Slow,
    /// Rms jitter of the momentum from frame to frame [1].
    pub momentum: Measured,
    /// Share of the noise's variance that the monitors of a crate have in common, the largest [1].
    pub crate_share: Measured,
    /// What else moves all monitors from frame to frame, or a momentum that does so beyond what is ordinary.
    pub frame_to_frame: Option<FrameToFrame>,
    /// Monitors that the screening calls noisy only for what moves all of them, by index.
    pub sound: Vec<usize>,
    /// Noise of each monitor's readings that is its own [B] [m].
    pub own: Vec<f64>,
    /// Monitors that wander by themselves, by index, with the walk of each [m per root frame].
    pub wandering: Vec<(usize, Measured)>,
    /// Ordinary walk of a monitor: as far as it is noisy, over the campaign [m per root frame].
    pub ordinary_walk: f64,
    /// Ordinary jitter of the momentum: the orbit's is that of the noise where the dispersion is largest [1].
    pub ordinary_momentum: f64,
    /// Noise in common, in units of the monitors' own: rows monitors, columns modes.
    pub(super) modes: DMatrix<f64>,
}

/// What noise is learnt from.
pub struct Source<'c> {
    /// The recording.
    pub campaign: &'c Campaign,
    /// Readings less their prediction, rows frames, columns monitors [m].
    pub residual: &'c DMatrix<f64>,
    /// Dispersion at the read monitors, in the plane they read [m].
    pub dispersion: &'c DVector<f64>,
    /// Patterns that are looked for.
    pub shapes: &'c [Shape],
}

/// Unit of a walk.
const LENGTH: Unit = Unit { symbol: "m", shown: "um", factor: 1e6 };
/// Fewest differences from which a monitor's noise is learnt: its scale is then known to 29 %, and that of thirty monitors together to 5 %.
const FEWEST: f64 = 6.0;
/// Ratio to the common noise above which the screening calls a monitor noisy.
const NOISY: f64 = 1.5;
/// Noisy monitors from which on it is likely that something moves all of them.
const MANY: usize = 3;
/// Least share of a reading's variance that is not the momentum's.
const OWN: f64 = 0.01;

/// A monitor in state ok with its repeats, those of one run alone, and their noise [m].
struct Learner {
    b: usize,
    repeats: Repeats,
    near: Repeats,
    sigma: f64,
}

impl Learner {
    fn at_levels(self, levels: &Levels) -> Self {
        if levels.is_constant() {
            return self;
        }
        let repeats = self.repeats.at_levels(levels);
        let sigma = repeats.weigh(Memory::NONE).sigma().unwrap_or(self.sigma);
        Self { repeats, near: self.near.at_levels(levels), sigma, ..self }
    }
}

/// Noise in common: the momentum's jitter, in the units of what it is learnt from, and crates.
struct Shared {
    momentum: Measured,
    jitter: DVector<f64>,
    crates: Vec<Crate>,
    one_more: Measured,
}

impl Shared {
    /// Beside known patterns; `per_momentum`: the momentum's.
    fn from_differences(
        differences: &Differences,
        known: &DMatrix<f64>,
        per_momentum: &DVector<f64>,
        orders: &[Vec<usize>],
    ) -> Self {
        let momentum = differences.momentum(per_momentum, ordinary(per_momentum), known);
        let jitter = per_momentum * momentum.value;
        let (crates, one_more) = differences.crates(&beside(known.clone(), &jitter), orders);
        Self { momentum, jitter, crates, one_more }
    }

    /// Nothing, the jitter, and this with the crates: what a free pattern is looked for beside. Each number that is learnt costs half of the
    /// `ln` of the number of frames, a crate the choice of its monitors too.
    fn known(&self, frames: usize, orders: &[Vec<usize>]) -> Vec<Known> {
        let none = DMatrix::zeros(self.jitter.len(), 0);
        let (each, choice) = (0.5 * (frames as f64).ln(), (groups(orders).len() as f64).ln());
        let mut all = vec![Known { modes: none.clone(), cost: 0.0 }];
        let jitter = if self.momentum.value > 0.0 { beside(none, &self.jitter) } else { none };
        if self.momentum.value > 0.0 {
            all.push(Known { modes: jitter.clone(), cost: each });
        }
        if !self.crates.is_empty() {
            let cost = each * jitter.ncols() as f64 + self.crates.len() as f64 * (each + choice);
            all.push(Known { modes: with_crates(&jitter, &self.crates), cost });
        }
        all
    }
}

/// Ordinary jitter of the momentum, from its pattern over the noise.
fn ordinary(per_momentum: &DVector<f64>) -> f64 {
    per_momentum.amax().max(f64::MIN_POSITIVE).recip()
}

impl Noise {
    /// The noise as the screening weights it.
    pub fn screened(campaign: &Campaign) -> Self {
        let monitors = campaign.monitors();
        let nothing = Measured { value: 0.0, sigma: 0.0 };
        Self {
            common_scale: Measured { value: 1.0, sigma: 0.0 },
            scatter: nothing,
            levels: Levels::CONSTANT,
            slow: Slow::NONE,
            momentum: nothing,
            crate_share: nothing,
            frame_to_frame: None,
            sound: Vec::new(),
            own: (0..monitors).map(|b| campaign.noise(b)).collect(),
            wandering: Vec::new(),
            ordinary_walk: 0.0,
            ordinary_momentum: 0.0,
            modes: DMatrix::zeros(monitors, 0),
        }
    }

    /// With the common scale as the screening weights the monitors, their median: where it calls all of them noisy nothing else is known.
    fn at_weights(self, campaign: &Campaign) -> Self {
        let header = &campaign.recording.header.noise;
        let scales = self.own.iter().zip(header).map(|(own, header)| own / header);
        let value = median(scales).unwrap_or(1.0);
        Self { common_scale: Measured { value, sigma: 0.0 }, ..self }
    }

    /// Learn.
    pub fn learn(source: &Source) -> Self {
        let first = Self::learn_from(source, &[]);
        let noisy = |b: &usize| source.campaign.screened.health[*b].state == MonitorState::Noisy;
        let noisy: Vec<usize> = (0..source.campaign.monitors()).filter(noisy).collect();
        let moves = |one: &Self| one.frame_to_frame.as_ref().is_some_and(|one| one.patterns.ncols() > 0);
        // where many are called noisy, what moves all of them is seen by these alone; and it may be the dipoles, whose ripple their repeats are free of, or
        // a part of the recording
        let is_noisier = !first.levels.is_constant() && !noisy.is_empty();
        let all = (moves(&first) || is_noisier || noisy.len() >= MANY).then(|| Self::learn_from(source, &noisy));
        let header = &source.campaign.recording.header.noise;
        let is_sound = |b: &usize| match &all {
            Some(all) => all.own[*b] < NOISY * all.common_scale.value * header[*b],
            None => first.is_sound(source, *b),
        };
        let sound: Vec<usize> = noisy.into_iter().filter(is_sound).collect();
        if sound.is_empty() { first } else { Self::learn_from(source, &sound) }
    }

    /// Learn from the monitors in state ok and some others.
    fn learn_from(source: &Source, sound: &[usize]) -> Self {
        let campaign = source.campaign;
        let mut learners = learners(source, sound);
        if learners.is_empty() {
            return Self::screened(campaign).at_weights(campaign);
        }
        let size = (campaign.frames(), campaign.monitors());
        let levels = Levels::learn(&differences(&learners, |one| &one.near, &Slow::NONE, size));
        learners = learners.into_iter().map(|one| one.at_levels(&levels)).collect();
        let (repeats, sigma): (Vec<Repeats>, Vec<f64>) =
            learners.iter().map(|one| (one.repeats.clone(), one.sigma)).unzip();
        let slow = Slow::learn(&repeats, &sigma, campaign.frames());
        for one in &mut learners {
            one.sigma = one.repeats.weigh(slow.memory(one.sigma)).sigma().unwrap_or(one.sigma);
        }
        // what monitors have in common is learnt where the level is ordinary
        let differences_of = |repeats: fn(&Learner) -> &Repeats| {
            let mut all = differences(&learners, repeats, &slow, size);
            let larger = (0..size.0).filter(|&frame| levels.at(frame) > 1.0);
            larger.for_each(|frame| all.row_mut(frame).fill(f64::NAN));
            Differences::from_frames(all)
        };
        let (differences, near) = (differences_of(|one| &one.repeats), differences_of(|one| &one.near));
        let kurtosis = kurtosis(&differences.all);
        // per momentum, in units of the noise of whole readings
        let mut pattern = DVector::zeros(campaign.monitors());
        learners.iter().for_each(|one| pattern[one.b] = source.dispersion[one.b] / one.sigma);
        let orders = orders(campaign, &learners);
        let none = DMatrix::zeros(campaign.monitors(), 0);
        let mut shared = Shared::from_differences(&differences, &none, &pattern, &orders);
        let mut noises = vec![None; campaign.monitors()];
        learners.iter().for_each(|one| noises[one.b] = Some(one.sigma));
        let known = shared.known(campaign.frames(), &orders);
        let found = Found::strongest(&near, &known, source.shapes, &noises);
        let found = found.filter(|found| found.log_bayes > correction_of_sort());
        let patterns = found.as_ref().map_or(none, |found| found.patterns.clone());
        if found.is_some() {
            shared = Shared::from_differences(&differences, &patterns, &pattern, &orders);
        }
        let Shared { momentum, jitter, crates, one_more } = shared;
        let measured = |one: &Learner| {
            let share_of_own = (1.0 - jitter[one.b].powi(2) - patterns.row(one.b).norm_squared()).max(OWN);
            let count = one.repeats.weigh(Memory::NONE).count;
            let value = (share_of_own.sqrt() * one.sigma / campaign.recording.header.noise[one.b]).ln();
            // the mean of `ln` of a sample's rms is below the true one by the variance of that
            let variance = (kurtosis - 1.0) / (4.0 * count);
            Measured { value: value + variance, sigma: variance.sqrt() / share_of_own }
        };
        let mut scales = vec![None; campaign.monitors()];
        learners.iter().for_each(|one| scales[one.b] = Some(measured(one)));
        let Scales { common, scatter, each } = Scales::from_measured(&scales);
        let scale = common.value.exp();
        let largest = |a: &&Crate, b: &&Crate| a.share.value.total_cmp(&b.share.value);
        let noise = Self {
            common_scale: Measured { value: scale, sigma: scale * common.sigma },
            scatter,
            levels,
            slow,
            momentum,
            crate_share: crates.iter().max_by(largest).map_or(one_more, |found| found.share),
            sound: sound.to_vec(),
            ordinary_walk: steps(campaign.frames() as f64) * sigma.iter().sum::<f64>() / sigma.len() as f64,
            ..Self::screened(campaign)
        };
        let mut noise = noise.with_scales(source, each);
        let mut own = DVector::zeros(campaign.monitors());
        learners.iter().for_each(|one| own[one.b] = source.dispersion[one.b] / noise.own[one.b]);
        noise.ordinary_momentum = ordinary(&own);
        noise.frame_to_frame = noise.varying(source, found, &noises);
        noise.with_modes(source, crates)
    }

    /// What moves all monitors from frame to frame: a pattern that was found, in units of their noise in `noises`, or an unordinary momentum.
    fn varying(&self, source: &Source, found: Option<Found>, noises: &[Option<f64>]) -> Option<FrameToFrame> {
        let campaign = source.campaign;
        let mut patterns = found.as_ref().map_or(DMatrix::zeros(noises.len(), 0), |found| found.patterns.clone());
        patterns.row_iter_mut().zip(noises).for_each(|(mut row, noise)| row *= noise.unwrap_or(0.0));
        let of_momentum = DMatrix::from_columns(&[source.dispersion * self.momentum.value]);
        let moving = if found.is_some() { &patterns } else { &of_momentum };
        let like = found.as_ref().map_or(Like::Momentum, |found| found.like);
        let own: Vec<Option<f64>> = noises.iter().zip(&self.own).map(|(noise, own)| noise.map(|_| *own)).collect();
        let known: Vec<usize> = (0..own.len()).filter(|&b| own[b].is_some()).collect();
        let square = known.iter().map(|&b| moving.row(b).norm_squared()).sum::<f64>() / known.len() as f64;
        if square == 0.0 {
            return None;
        }
        let settings = &campaign.settings.repeatable;
        let mut residual = source.residual.clone();
        for (frame, mut row) in residual.row_iter_mut().enumerate() {
            let missing = (0..own.len()).filter(|&b| !campaign.counts(frame, b));
            missing.for_each(|b| row[b] = f64::NAN);
        }
        let period = Period::find(&frame_pattern::amplitudes(moving, &residual, &own, settings), &runs(settings));
        let of_period = period.map_or(f64::NEG_INFINITY, |one| frame_pattern::beyond_chance(one.log_chance));
        let log_bayes = match (like, &found) {
            (Like::Momentum, _) | (_, None) => {
                // the momentum's size over its ordinary one is that of the orbit over the noise, where that is largest
                let size =
                    known.iter().map(|&b| moving.row(b).norm() / own[b].unwrap_or(f64::INFINITY)).fold(0.0, f64::max);
                frame_pattern::beyond_ordinary(size).max(of_period)
            }
            (_, Some(found)) => {
                let ripple = known.iter().map(|&b| campaign.following(b).norm_squared()).sum::<f64>();
                let ordinary = (ripple / (known.len() * campaign.frames()) as f64).sqrt();
                let size = square.sqrt() / ordinary.max(f64::MIN_POSITIVE);
                found.log_bayes.min(frame_pattern::beyond_ordinary(size)).max(of_period)
            }
        };
        let frames = (0..campaign.frames()).filter(|&frame| known.iter().any(|&b| campaign.counts(frame, b))).count();
        let value = square.sqrt();
        let rms = Measured { value, sigma: value / (2.0 * frames.max(1) as f64).sqrt() };
        Some(FrameToFrame { patterns, like, rms, log_bayes, period })
    }

    /// What varies from frame to frame and is not ordinary, with its probability.
    pub(crate) fn unordinary(&self) -> Option<(&FrameToFrame, f64)> {
        let varying = self.frame_to_frame.as_ref()?;
        let odds = varying.log_bayes - correction_of_sort();
        let probability = 1.0 / (1.0 + (-odds).exp());
        (probability > SUSPICIOUS).then_some((varying, probability))
    }

    /// What the sentence says of noise that is far from the header's, or in a part of the recording from that of the rest.
    pub fn remarks(&self) -> Vec<String> {
        let scale = self.common_scale.value;
        let far = frame_pattern::beyond_ordinary(scale.ln().abs() / QUOTED) > correction_of_sort();
        let of_all = far.then(|| format!("the noise is {scale:.1} times the header's"));
        let of_parts = self.levels.parts.iter().filter(|one| one.factor.value > NOISY).map(Part::said);
        of_all.into_iter().chain(of_parts).collect()
    }

    /// True for a monitor that is noisy only because its reading has the momentum's jitter too.
    fn is_sound(&self, source: &Source, b: usize) -> bool {
        let campaign = source.campaign;
        let jitter = self.momentum.value * source.dispersion[b];
        let variance = campaign.noise(b).powi(2) - jitter * jitter;
        campaign.screened.health[b].state == MonitorState::Noisy
            && jitter > 0.0
            && variance < (NOISY * self.common_scale.value * campaign.recording.header.noise[b]).powi(2)
    }

    /// Scales of all monitors that are known by their repeats; of the others the screening's noise stays, less the momentum's jitter.
    fn with_scales(mut self, source: &Source, scale: Vec<f64>) -> Self {
        let header = &source.campaign.recording.header.noise;
        for (b, &scale) in scale.iter().enumerate() {
            if source.campaign.is_ok(b) || self.sound.contains(&b) {
                // as the screening holds it, whose numbers have single precision
                self.own[b] = f64::from(header[b] as f32) * scale;
            } else if self.momentum.value > 0.0 {
                let jitter = self.momentum.value * source.dispersion[b];
                let least = header[b].min(self.own[b]);
                self.own[b] = (self.own[b].powi(2) - jitter * jitter).max(least * least).sqrt();
            }
        }
        self
    }

    /// Noise in common; what a crate shares is no longer its monitors' own.
    fn with_modes(mut self, source: &Source, crates: Vec<Crate>) -> Self {
        let mut columns = Vec::new();
        for Crate { monitors, share } in &crates {
            let mut column = DVector::zeros(self.own.len());
            for &b in monitors {
                self.own[b] *= (1.0 - share.value).sqrt();
                column[b] = (share.value / (1.0 - share.value)).sqrt();
            }
            columns.push(column);
        }
        if self.momentum.value > 0.0 {
            let pattern = DVector::from_fn(self.own.len(), |b, _| source.dispersion[b] / self.own[b]);
            columns.push(pattern * self.momentum.value);
        }
        if let Some(one) = &self.frame_to_frame {
            let over =
                |column: nalgebra::DVectorView<f64>| DVector::from_fn(self.own.len(), |b, _| column[b] / self.own[b]);
            columns.extend(one.patterns.column_iter().map(over));
        }
        if !columns.is_empty() {
            self.modes = DMatrix::from_columns(&columns);
        }
        self
    }

    /// What the noise of a monitor remembers.
    pub(super) fn memory(&self, b: usize) -> Memory {
        let of_monitor = self.wandering.iter().find(|(at, _)| *at == b);
        let walk = of_monitor.map_or(self.slow.walk, |(_, walk)| *walk);
        Slow { walk, ..self.slow }.memory(self.own[b])
    }

    /// The rows of a table; `names` of the monitors.
    pub fn rows(&self, names: &[String]) -> Vec<Imperfection> {
        let off = Measured { value: self.common_scale.value - 1.0, ..self.common_scale };
        let row = |(name, kind), measured, unit, ordinary| Imperfection {
            name,
            kind,
            at: "all".into(),
            measure: Measure::Scatter,
            measured,
            unit,
            ordinary,
        };
        let mean = |what, measured, unit, ordinary| Imperfection {
            measure: Measure::Mean,
            ..row(what, measured, unit, ordinary)
        };
        let varying = self.frame_to_frame.iter().filter(|one| one.patterns.ncols() > 0);
        let varying = varying.map(|one| row((one.name(), "frame_to_frame"), one.rms, POSITION, 0.0));
        let mut rows = vec![
            mean(("noise over the header's, less 1", "noise"), off, Unit::PERCENT, QUOTED),
            row(("noise of single monitors", "noise"), self.scatter, Unit::PERCENT, ALIKE),
            mean(("slow share of the noise's variance", "slow_noise"), self.slow.share, Unit::PERCENT, SHARE),
            row(("walk per root frame", "walk"), self.slow.walk, LENGTH, self.ordinary_walk),
            row(
                ("momentum from frame to frame", "momentum_jitter"),
                self.momentum,
                Unit::PER_MILLE,
                self.ordinary_momentum,
            ),
            mean(("noise that a crate has in common", "crate_noise"), self.crate_share, Unit::PERCENT, CRATE),
        ];
        rows.extend(varying);
        rows.extend(self.levels.parts.iter().map(Part::row));
        rows.extend(self.of_wandering(names));
        rows
    }

    /// Those of parts of one of several recordings and of its monitors that wander by themselves.
    pub(crate) fn of_parts(&self, recording: &str, names: &[String]) -> Vec<Imperfection> {
        let row = |part: &Part| {
            let row = part.row();
            Imperfection { at: format!("{} of {recording}", row.at), ..row }
        };
        self.levels.parts.iter().map(row).chain(self.of_wandering(names)).collect()
    }

    /// Those of the monitors that wander by themselves.
    fn of_wandering(&self, names: &[String]) -> Vec<Imperfection> {
        let row = |&(b, measured): &(usize, Measured)| Imperfection {
            name: "walk of one monitor per root frame",
            kind: "walk",
            at: names[b].clone(),
            measure: Measure::Scatter,
            measured,
            unit: LENGTH,
            ordinary: self.ordinary_walk,
        };
        self.wandering.iter().map(row).collect()
    }
}

/// Neighbours: the order of reading, and that along the ring.
fn orders(campaign: &Campaign, learners: &[Learner]) -> [Vec<usize>; 2] {
    let read: Vec<usize> = learners.iter().map(|one| one.b).collect();
    let places: Vec<usize> = campaign.ring.monitors_read().map(|monitor| monitor.element).collect();
    let mut along = read.clone();
    along.sort_by_key(|&b| places[b]);
    [read, along]
}

/// The monitors in state ok, and some others, that have enough repeats.
fn learners(source: &Source, sound: &[usize]) -> Vec<Learner> {
    let campaign = source.campaign;
    let settings = &campaign.settings.repeatable;
    let number = |(i, run): (usize, Range<usize>)| run.map(move |_| Some(i));
    let apart: Vec<Option<usize>> = runs(settings).into_iter().enumerate().flat_map(number).collect();
    let (runs, apart) = (Run::from_settings(settings), Run::from_settings(&apart));
    let learner = |b: usize| {
        let frames: Vec<usize> = (0..campaign.frames()).filter(|&frame| campaign.counts(frame, b)).collect();
        let values: Vec<f64> = frames.iter().map(|&frame| source.residual[(frame, b)]).collect();
        let repeats = Repeats::from_frames(&frames, &values, &runs);
        // in a campaign that seldom stays at a setting all its repeats say more than the few that follow each other
        let of_all = || repeats.weigh(Memory::NONE).sigma();
        let sigma = repeats.of_neighbours().or_else(of_all).filter(|sigma| *sigma > 0.0)?;
        let following = campaign.following_with_field(b).select_rows(&frames);
        let near = Repeats::from_frames(&frames, &values, &apart).without(&following, sigma);
        let repeats = repeats.without(&following, sigma);
        (repeats.weigh(Memory::NONE).count >= FEWEST).then_some(Learner { b, repeats, near, sigma })
    };
    let counts = |b: &usize| campaign.is_ok(*b) || sound.contains(b);
    (0..campaign.monitors()).filter(counts).filter_map(learner).collect()
}

/// Whitened differences, rows frames, columns monitors; not a number where there is none.
fn differences(
    learners: &[Learner],
    repeats: fn(&Learner) -> &Repeats,
    slow: &Slow,
    (frames, monitors): (usize, usize),
) -> DMatrix<f64> {
    let mut all = DMatrix::from_element(frames, monitors, f64::NAN);
    for one in learners {
        for (frame, innovation, variance) in repeats(one).differences(slow.memory(one.sigma)) {
            all[(frame, one.b)] = innovation / (one.sigma * variance.sqrt());
        }
    }
    all
}

/// Kurtosis of differences, 3 for normal noise [1].
fn kurtosis(differences: &DMatrix<f64>) -> f64 {
    let known: Vec<f64> = differences.iter().copied().filter(|z| !z.is_nan()).collect();
    let n = known.len().max(1) as f64;
    let moment = |power: i32| known.iter().map(|z| z.powi(power)).sum::<f64>() / n;
    (moment(4) / moment(2).powi(2)).max(1.0 + 1.0 / n)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use rand_distr::{Distribution, Normal};
    use twin::{Effect, Hold, Optics};

    use super::*;
    use crate::Diagnosis;
    use crate::data::Data;
    use crate::testing::{Coloured, template, whitened};
    use crate::verdict::Verdict;

    /// What is learnt of a campaign, and what is true of it: scale, slow share, its time, walk, jitter, crate's share.
    fn learnt(noise: &Noise, truth: &Coloured, header: f64) -> [(&'static str, Measured, f64); 6] {
        let (share, time) = truth.slow;
        let time = if share > 0.0 { time } else { 0.0 };
        [
            ("scale", noise.common_scale, truth.noise / header),
            ("slow", noise.slow.share, share),
            ("time", noise.slow.time, time),
            ("walk", noise.slow.walk, truth.walk),
            ("momentum", noise.momentum, truth.momentum),
            ("crate", noise.crate_share, truth.crate_share),
        ]
    }

    /// Noise of several kinds and sizes.
    fn kinds(white: impl Fn() -> Coloured) -> [Coloured; 7] {
        let sigma = white().noise;
        [
            Coloured { noise: 1.2 * sigma, ..white() },
            Coloured { noise: 0.85 * sigma, ..white() },
            Coloured { slow: (0.12, 12.0), ..white() },
            Coloured { slow: (0.3, 4.0), ..white() },
            Coloured { walk: 6e-6, ..white() },
            Coloured { crate_share: 0.2, ..white() },
            Coloured { momentum: 3e-5, ..white() },
        ]
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn what_the_noise_is_like_is_learnt_within_three_errors() {
        let (ring, recording) = template();
        for seed in 0..2 {
            for truth in kinds(|| Coloured::white(&ring, &recording, 100 + seed)) {
                let made = truth.campaign(&ring, &recording, &[]);
                let data = whitened(&ring, &made);
                for (name, found, truth) in learnt(&data.noise, &truth, recording.header.noise[0]) {
                    println!("{seed} {name}: {:.3e} ± {:.1e}, true {truth:.3e}", found.value, found.sigma);
                    assert!((found.value - truth).abs() <= 3.0 * found.sigma + 1e-12, "{name}");
                }
            }
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn nothing_is_learnt_where_the_noise_is_as_the_header_says() {
        let (ring, recording) = template();
        for seed in 0..4 {
            let made = Coloured::white(&ring, &recording, 40 + seed).campaign(&ring, &recording, &[]);
            let campaign = Campaign::of(&ring, &made).unwrap();
            let data = Data::from_campaign(&campaign).unwrap();
            let Noise { levels, slow, wandering, modes, .. } = &data.noise;
            let is_ordinary = slow.is_none() && wandering.is_empty() && modes.is_empty();
            assert!(is_ordinary && levels.is_constant(), "{:?}", data.noise);
            (0..campaign.monitors()).for_each(|b| assert_eq!(data.noise.own[b], campaign.noise(b), "monitor {b}"));
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn noise_of_any_kind_is_no_missing_physics() {
        let (ring, recording) = template();
        for truth in kinds(|| Coloured::white(&ring, &recording, 7)).into_iter().step_by(2) {
            let made = truth.campaign(&ring, &recording, &[]);
            let diagnosis = Diagnosis::from_recording(&ring, &made, |_| ()).unwrap();
            assert_eq!(diagnosis.verdict, Verdict::Consistent, "{}", diagnosis.sentence);
        }
    }

    /// Five times the noise, in frames of which some readings are missing: means over frames of other momenta were said to be a quadrupole that changes.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_momentum_that_jitters_beside_missing_readings_is_nothing_at_a_place() {
        let (ring, recording) = template();
        let white = Coloured::white(&ring, &recording, 9);
        let momentum = 5.0 * white.noise / white.dispersion.amax();
        let mut made = Coloured { momentum, ..white }.campaign(&ring, &recording, &[]);
        let partial = || (1..recording.rows.len()).step_by(9);
        for frame in partial() {
            let horizontal = made.rows[frame].reading.iter_mut().take(ring.horizontal_monitors());
            horizontal.step_by(2).for_each(|reading| *reading = None);
        }
        let campaign = Campaign::of(&ring, &made).unwrap();
        let (settings, pools) = (&campaign.settings.repeatable, Data::from_campaign(&campaign).unwrap().pools.of_frame);
        let within: Vec<usize> = partial().filter(|&frame| settings[frame] == settings[frame - 1]).collect();
        assert!(within.len() > 10 && within.iter().all(|&frame| pools[frame] != pools[frame - 1]), "{within:?}");
        let found = Diagnosis::from_recording(&ring, &made, |_| ()).unwrap();
        assert!(found.findings.iter().all(|one| one.s.is_none()), "{}", found.sentence);
        // a kick's pattern takes a part of it where the dispersion is not known well: measured 16 % with this seed, 10 and 2 % with two others
        let learnt = found.found.data.noise.momentum.value;
        assert!(learnt > 0.75 * momentum && learnt < 1.1 * momentum, "{learnt}, true {momentum}");
    }

    /// Without its level the corrector that is in use then was said to act otherwise than by a single kick, at P 0.97 to 1, and up to 15 sound monitors
    /// to be faulty. A monitor that jumps or repeats one value then is still faulty, or said, and a frame without a beam no matter.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn noise_that_is_larger_for_a_time_is_said_and_is_no_missing_physics() {
        let (ring, recording) = template();
        let (part, factor) = (150..220, 4.0_f64);
        let white = Coloured::white(&ring, &recording, 71);
        let sound = whitened(&ring, &white.campaign(&ring, &recording, &[]));
        let mut random = StdRng::seed_from_u64(72);
        let more = Normal::new(0.0, white.noise * (factor * factor - 1.0).sqrt()).unwrap();
        let in_part = |frame: usize, _| if part.contains(&frame) { more.sample(&mut random) } else { 0.0 };
        let common = DMatrix::from_fn(recording.rows.len(), ring.read_monitors.len(), in_part);
        let noise = Coloured { common, ..white };
        let mut made = noise.campaign(&ring, &recording, &[]);
        let lost = made.rows[20..26].iter_mut().flat_map(|row| &mut row.reading);
        lost.for_each(|reading| *reading = Some(0.0));
        let found = Diagnosis::from_recording(&ring, &made, |_| ()).unwrap();
        assert_eq!(found.verdict, Verdict::Consistent, "{}", found.sentence);
        assert!(found.sentence.contains("; the noise in frames 1"), "{}", found.sentence);
        let data = &found.found.data;
        let [Part { frames, factor: learnt }] = &data.noise.levels.parts[..] else { panic!("{:?}", data.noise.levels) };
        // the run of frames in which it ends is counted whole
        assert!(frames.start.abs_diff(part.start) <= 3 && frames.end.abs_diff(part.end) <= 3, "{frames:?}");
        // three quiet frames among 73 make 2 % less, sampling 2 %
        assert!((learnt.value / factor - 1.0).abs() < 0.08, "{learnt:?}");
        // readings that jump stay out; their monitor is no longer called faulty, which a few of them do not show beside so much noise
        let states = |data: &Data| data.health().iter().map(|one| one.state == MonitorState::Noisy).collect::<Vec<_>>();
        assert_eq!(states(data), states(&sound));
        let jumps = |b: usize| (0..150).filter(|&frame| sound.is_aside(frame, b)).collect::<Vec<_>>();
        let jumping = (0..sound.monitors()).max_by_key(|b| jumps(*b).len()).unwrap();
        assert!(jumps(jumping).len() >= 3 && jumps(jumping).iter().all(|frame| data.is_aside(*frame, jumping)));

        let (jumping, stuck) = (4, 9);
        made.rows[part.clone()]
            .iter_mut()
            .step_by(4)
            .for_each(|row| row.reading[jumping] = row.reading[jumping].map(|x| x + 8e-3));
        let value = made.rows[180].reading[stuck];
        made.rows[181..200].iter_mut().for_each(|row| row.reading[stuck] = value);
        let data = whitened(&ring, &made);
        assert_eq!(data.health()[jumping].state, MonitorState::Jumps);
        assert!((184..200).all(|frame| data.is_aside(frame, stuck)), "a value that repeats is no reading");
    }

    /// With the RF frequency held the momentum follows the ripple of the dipoles, whose read-backs tell it. Taken for noise, it hid that the frequency is held.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_held_frequency_is_found_beside_the_ripple_of_the_dipoles() {
        let (ring, recording) = template();
        let white = Coloured::white(&ring, &recording, 61);
        let made = recording.powered(&ring).with_vars(&white.vars);
        let per_field = Optics::of(&made, Hold::Momentum { delta: 0.0 }).unwrap().momentum_per_field();
        let logs: Vec<f64> = recording.rows.iter().map(|row| row.dipole.unwrap().ln()).collect();
        let mean = logs.iter().sum::<f64>() / logs.len() as f64;
        let moved = DVector::from_iterator(logs.len(), logs.iter().map(|log| per_field * (log - mean)));
        let noise = Coloured { common: moved * white.dispersion.transpose(), ..white };
        let held = Effect::parse("fixed_rf_frequency=1", &ring).unwrap();
        let found = Diagnosis::from_recording(&ring, &noise.campaign(&ring, &recording, &[held]), |_| ()).unwrap();
        assert_eq!(found.verdict, Verdict::Identified, "{}", found.sentence);
        assert_eq!(found.findings[0].word(), "fixed_rf_frequency", "{}", found.sentence);
        let (share, sigma) = found.findings[0].amplitude;
        assert!((share - 1.0).abs() < 3.0 * sigma, "{share} +- {sigma}");
        let learnt = &found.found.data.noise;
        // the ripple moves the beam by 1 mm rms at the largest dispersion, of noise of 0.1 mm
        assert!(learnt.momentum.value < 5e-6, "{:?}", learnt.momentum);
        assert!((learnt.common_scale.value - 1.0).abs() < 0.05, "{:?}", learnt.common_scale);
    }
}
