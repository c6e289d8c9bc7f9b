//! Which readings count, and the state of each monitor: the rules of the core (`estimator::Monitor`, `estimator::Cell`), in f64 and
//! for a ring of any size.
//!
//! Frames are taken in the order of time. A reading is judged by the repeats of its setting; the first one by the model with all
//! that is known of the params so far, in normal equations that are relinearised when the params have moved.

mod unconfirmed;

use std::collections::BTreeMap;

use estimator::{Beside, ByRepeats, Gate, Health, Monitor, MonitorState, PositionCode, Verdict};
use nalgebra::{DMatrix, DVector};
use twin::{Machine, OrbitError, Ring};

use super::common_terms::Weighed;
use super::exclusion::{Excluded, Exclusions};
use super::linearisation::Linearised;
use super::normal_equations::{Normal, Terms};
use super::setting::Settings;
use super::times::Times;
use crate::base_model::BaseModel;
use crate::prior::Prior;
use crate::recording::{self, Drive};
use evidence::Factor;

/// The monitors, and their readings that count.
#[derive(Debug, Clone, PartialEq)]
pub struct Screened {
    /// Which readings count, and why the others do not.
    pub excluded: Exclusions,
    /// State and noise of each monitor.
    pub health: Vec<Health>,
}

/// What a campaign is screened by.
pub(super) struct Screener<'c> {
    pub ring: &'c Ring,
    /// The ring with what is held constant.
    pub held: &'c Machine,
    pub prior: &'c Prior,
    pub drives: &'c [Drive],
    pub supplies: &'c [f64],
    pub times: &'c Times,
    pub settings: &'c Settings,
    pub groups: Groups,
    /// Rows frames, columns monitors, not a number where a monitor did not report [m].
    pub readings: &'c DMatrix<f64>,
    /// What is left out beforehand.
    pub excluded: Exclusions,
    /// Expected noise of each monitor [m].
    pub noise: &'c [f64],
    /// Number of frames with each frame's RF offset: they share the error of the spurious dispersion.
    pub sharing: &'c [f64],
    /// Change of a misaligned ring's orbit per RF offset and rms orbit, in x and y: the standard deviation for a reading by itself.
    pub spurious: [f64; 2],
}

/// Frames that share a derivative: those of a setting, or one by itself.
pub(super) struct Groups {
    of_frame: Vec<usize>,
    /// Mean drive of each.
    drives: Vec<Drive>,
    /// Time in the cycle of each.
    times: Vec<usize>,
}

/// What remains when all frames have been taken.
pub(super) struct Seen {
    pub screened: Screened,
    /// The best params, of a stable ring.
    pub params: DVector<f64>,
    /// The ring linearised at them.
    pub linearised: Linearised,
    /// Baselines [B] [m], for each time in the cycle.
    pub baselines: Vec<Option<f64>>,
}

/// Prior standard deviation of a monitor's baseline [m]: offsets reach 10 mm.
const BASELINE: f64 = 0.02;
/// The baseline is the only common term of a monitor's readings at one time in the cycle: how it follows the supplies is small beside
/// the gate.
const TERMS: [f64; 1] = [1.0];
const COMMON: Terms = Terms { count: 1, baselines: 1, precision: 1.0 / (BASELINE * BASELINE) };
/// A param that has moved by this many error bars calls for a new linearisation.
const MOVED: f64 = 1.0;
/// Growth of chi-square that counts as uphill.
const UPHILL: f64 = 1.0;
/// Halvings of a step that leads uphill or to an unstable ring.
const HALVINGS: i32 = 4;
/// Share of a prediction's variance by the params that their linearisation adds.
const UNDERWEIGHT: f64 = 0.2;
/// Consecutive frames without a setting that need most readings outside the gate before the model, and not the beam, is at fault.
const CONVINCED: usize = 3;
/// A frame is unexpected if more than one in this many of its readings lies outside the gate.
const MOST: usize = 8;

/// The repeats of one monitor in one setting.
#[derive(Debug, Clone, Default)]
struct Repeats {
    /// Frames whose reading counts.
    frames: Vec<usize>,
    /// Frames whose reading was put aside, confirmed since or not.
    held: Vec<usize>,
    /// The last frame with a reading, and how many in a row that agree, that one included, wait for one that confirms them.
    last: Option<usize>,
    waiting: u8,
}

/// The screening after some frames.
struct Screening<'c> {
    screener: &'c Screener<'c>,
    gate: Gate,
    monitors: Vec<Monitor>,
    /// By setting and monitor.
    repeats: Vec<Vec<Repeats>>,
    /// Frames to come are unconfirmed.
    excluded: Exclusions,
    model: Model,
    normal: Normal,
    best: Best,
    /// Accepted readings need re-weighting.
    stale: bool,
    /// Consecutive frames without a setting with most readings outside the gate.
    unexpected: usize,
}

/// The ring linearised at some params.
///
/// Frames of a setting differ by the scatter of idle correctors, a thousandth of its kick: their own orbits count, and the derivative of
/// their mean drive serves them all.
struct Model {
    params: DVector<f64>,
    /// Orbits of the frames, rows frames, columns monitors [m].
    orbit: DMatrix<f64>,
    /// Derivative of each monitor's orbit with respect to the params, columns groups of frames.
    slope: Vec<DMatrix<f64>>,
    /// What the mean drive of each frame's setting adds to the orbit of its own [frame][monitor] [m].
    to_mean_drive: DMatrix<f64>,
}

/// The best params of the normal equations.
struct Best {
    step: DVector<f64>,
    factor: Factor,
    /// Rms of the baselines in x and y [m].
    orbit: [f64; 2],
    cost: f64,
}

impl Groups {
    pub fn from_settings(drives: &[Drive], times: &Times, settings: &Settings) -> Self {
        let (mut known, mut members) = (BTreeMap::new(), Vec::<Vec<&Drive>>::new());
        let mut time_of = Vec::new();
        let mut group = |(frame, drive): (usize, _)| {
            let key = settings.repeatable[frame].ok_or(frame);
            let group = *known.entry(key).or_insert(members.len());
            members.resize(members.len().max(group + 1), Vec::new());
            members[group].push(drive);
            time_of.resize(members.len(), times.of_frame[frame]);
            group
        };
        let of_frame = drives.iter().enumerate().map(&mut group).collect();
        Self { of_frame, drives: members.iter().map(|members| recording::mean(members)).collect(), times: time_of }
    }
}

impl Screener<'_> {
    /// Take all frames.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring as designed has no stable orbit.
    pub fn run(&self) -> Result<Seen, OrbitError> {
        let mut screening = Screening::new(self)?;
        for frame in 0..self.drives.len() {
            screening.linearise_if_due(frame);
            screening.take(frame);
        }
        screening.take_back_unconfirmed();
        screening.drop_stuck();
        let Screening { mut excluded, monitors, model, best, normal, .. } = screening;
        let health: Vec<Health> = monitors.iter().map(Monitor::health).collect();
        let dead = health.iter().enumerate().filter(|(_, health)| health.state == MonitorState::Dead);
        dead.for_each(|(b, _)| excluded.set_dead(b));
        let screened = Screened { excluded, health };
        // the last step has not been tried: next to a resonance it may lead to no stable ring
        let shares = (0..HALVINGS).map(|halvings| 0.5_f64.powi(halvings)).chain([0.0]);
        let mut tried = shares.map(|share| {
            let step = &best.step * share;
            let (params, baselines) = (&model.params + &step, normal.baselines(&step));
            let linearised = Linearised::about((self.held, BaseModel::EXACT), &params, self.supplies, self.drives)?;
            Ok(Seen { screened: screened.clone(), params, linearised, baselines })
        });
        let first = tried.next().expect("there are shares");
        first.or_else(|error| tried.find_map(Result::ok).ok_or(error))
    }

    /// Number of baselines: one for each monitor and time in the cycle.
    fn channels(&self) -> usize {
        self.times.count() * self.noise.len()
    }

    /// Which of them a reading has.
    fn channel(&self, frame: usize, b: usize) -> usize {
        self.times.of_frame[frame] * self.noise.len() + b
    }

    /// 0 for a monitor that reads x, 1 for one that reads y.
    fn plane(&self, b: usize) -> usize {
        self.ring.monitors[self.ring.read_monitors[b]].plane.index()
    }

    fn model(&self, params: DVector<f64>) -> Result<Model, OrbitError> {
        let linearised = Linearised::about((self.held, BaseModel::EXACT), &params, self.supplies, self.drives)?;
        let (orbit, slope) = (linearised.orbits(self.drives), linearised.slopes(&self.groups.drives));
        let to_mean_drive = self.to_mean_drive(&orbit);
        Ok(Model { params, orbit, slope, to_mean_drive })
    }

    fn to_mean_drive(&self, orbit: &DMatrix<f64>) -> DMatrix<f64> {
        let mut sum = DMatrix::<f64>::zeros(self.settings.count(), orbit.ncols());
        let mut frames = vec![0.0; self.settings.count()];
        let settings = || self.settings.repeatable.iter().enumerate().filter_map(|(i, setting)| Some((i, (*setting)?)));
        for (i, setting) in settings() {
            frames[setting] += 1.0;
            let mut row = sum.row_mut(setting);
            row += orbit.row(i);
        }
        let mut shift = DMatrix::zeros(orbit.nrows(), orbit.ncols());
        settings().for_each(|(i, setting)| shift.set_row(i, &(sum.row(setting) / frames[setting] - orbit.row(i))));
        shift
    }
}

impl<'c> Screening<'c> {
    fn new(screener: &'c Screener<'c>) -> Result<Self, OrbitError> {
        let model = screener.model(screener.prior.clamp(&DVector::zeros(screener.prior.len())))?;
        let normal = Normal::new(screener.prior, &model.params, screener.channels(), COMMON);
        let expecting = |sigma: &f64| {
            let mut monitor = Monitor::BLANK;
            monitor.expect(*sigma as f32);
            monitor
        };
        let mut excluded = screener.excluded.clone();
        (0..screener.drives.len()).for_each(|frame| excluded.exclude_frame(frame, Excluded::Unconfirmed));
        Ok(Self {
            gate: Gate::default(),
            monitors: screener.noise.iter().map(expecting).collect(),
            repeats: vec![vec![Repeats::default(); screener.noise.len()]; screener.settings.count()],
            excluded,
            best: Best::solve(screener, &model, &normal).expect("a prior's precision is positive"),
            model,
            normal,
            stale: false,
            unexpected: 0,
            screener,
        })
    }

    /// Take one frame: judge its readings, then learn from those that pass.
    fn take(&mut self, frame: usize) {
        let setting = self.screener.settings.repeatable[frame];
        let reports = |b: usize| !self.screener.readings[(frame, b)].is_nan();
        let expected: Vec<bool> =
            (0..self.monitors.len()).map(|b| reports(b) && self.is_expected_within(frame, b, 0.0)).collect();
        let is_lone = self.is_expected_but_for_a_few(frame, &expected);
        let mut rejected = Vec::new();
        for (b, expected) in expected.into_iter().enumerate() {
            let reading = self.screener.readings[(frame, b)];
            if self.monitors[b].hear(code(reading)) {
                match setting {
                    Some(setting) => self.judge_repeat((frame, b, setting), expected, is_lone),
                    None if expected => self.excluded.lift(frame, b),
                    None => {
                        self.monitors[b].reject();
                        self.excluded.exclude(frame, b, Excluded::Jump);
                        rejected.push(b);
                    }
                }
            } else {
                self.excluded.exclude(frame, b, Excluded::Stuck);
            }
            self.stale |= self.monitors[b].judge();
        }
        if setting.is_none() {
            self.judge_frame(frame, &rejected);
        }
        self.learn(frame);
        self.solve();
    }

    /// Add the readings of a frame that count to the normal equations.
    fn learn(&mut self, frame: usize) {
        let group = self.screener.groups.of_frame[frame];
        let counting: Vec<usize> = (0..self.monitors.len()).filter(|&b| self.excluded.counts(frame, b)).collect();
        let mut slopes = DMatrix::zeros(self.model.params.len(), counting.len());
        for (mut to, &b) in slopes.column_iter_mut().zip(&counting) {
            to.copy_from(&self.model.slope[b].column(group));
        }
        let weighed = |&b: &usize| (self.screener.channel(frame, b), self.weighed(frame, b));
        let readings: Vec<(usize, Weighed)> = counting.iter().map(weighed).collect();
        self.normal.add(&slopes, &readings);
    }

    /// A reading in a setting is judged by its repeats, the first one by the model.
    fn judge_repeat(&mut self, (frame, b, setting): (usize, usize, usize), expected: bool, is_lone: bool) {
        let repeats = &self.repeats[setting][b];
        let moved = |i: usize| self.screener.readings[(i, b)] + self.model.to_mean_drive[(i, b)];
        let (here, last) = (moved(frame), repeats.last);
        if let Some(last) = last {
            self.monitors[b].noise.learn((here - moved(last)) as f32);
        }
        let mean = repeats.frames.iter().map(|&i| moved(i)).sum::<f64>() / repeats.frames.len() as f64;
        let monitor = &self.monitors[b];
        let agrees = |other: f64| self.gate.agree((here - other) as f32, 0.0, monitor.noise.sigma());
        let beside = Beside { expected, is_lone, jumps: monitor.jumps(), is_told: monitor.noise.is_told() };
        let verdict = beside.judge(ByRepeats {
            any: !repeats.frames.is_empty(),
            agrees_with_mean: agrees(mean),
            agrees_with_last: last.is_some_and(|last| agrees(moved(last))),
            waiting: repeats.waiting,
        });
        self.note(frame, b, setting, verdict);
    }

    fn note(&mut self, frame: usize, b: usize, setting: usize, verdict: Verdict) {
        let repeats = &mut self.repeats[setting][b];
        match verdict {
            Verdict::Accepted => {}
            Verdict::Held { .. } => {
                repeats.held.push(frame);
                self.monitors[b].reject();
            }
            Verdict::Confirms { outvotes } => {
                self.monitors[b].pardon(repeats.waiting);
                self.stale = true;
                if outvotes {
                    repeats.frames.drain(..).for_each(|i| self.excluded.exclude(i, b, Excluded::Jump));
                }
                repeats.frames.extend(repeats.last);
                repeats.last.into_iter().for_each(|last| self.excluded.lift(last, b));
            }
        }
        repeats.waiting = verdict.waiting();
        repeats.last = Some(frame);
        if repeats.waiting == 0 {
            repeats.frames.push(frame);
            self.excluded.lift(frame, b);
        }
        if !repeats.frames.is_empty() {
            let outvoted = repeats.held.iter().filter(|held| !repeats.frames.contains(held));
            outvoted.for_each(|&held| self.excluded.exclude(held, b, Excluded::Jump));
        }
    }

    /// Monitors fail one at a time: when most readings of a frame without a setting lie outside the gate, the beam was lost or the model is
    /// at fault. A lost beam is soon over: the third such frame in a row is used, all of it, the ones before are not.
    fn judge_frame(&mut self, frame: usize, rejected: &[usize]) {
        let accepted = (0..self.monitors.len()).filter(|&b| self.excluded.counts(frame, b)).count();
        if MOST * rejected.len() <= accepted + rejected.len() {
            self.unexpected = 0;
            return;
        }
        self.unexpected += 1;
        let convinced = self.unexpected >= CONVINCED;
        for &b in rejected {
            self.monitors[b].pardon(1);
            self.excluded.lift(frame, b);
        }
        if !convinced {
            self.excluded.exclude_frame(frame, Excluded::LostBeam);
        }
    }

    /// True if the model expects nearly all readings of a frame, those of dead monitors left out.
    fn is_expected_but_for_a_few(&self, frame: usize, expected: &[bool]) -> bool {
        let alive: Vec<usize> = self.alive(frame).collect();
        MOST * alive.iter().filter(|b| !expected[**b]).count() <= alive.len()
    }

    /// The monitors that report in a frame, without dead ones.
    fn alive(&self, frame: usize) -> impl Iterator<Item = usize> {
        let reports = move |b: &usize| !self.screener.readings[(frame, *b)].is_nan();
        (0..self.monitors.len()).filter(reports).filter(|b| self.monitors[*b].state() != MonitorState::Dead)
    }

    /// True if the model, with all its uncertainty, expects a reading that has a further variance [m^2].
    fn is_expected_within(&self, frame: usize, b: usize, further: f64) -> bool {
        let slope = self.model.slope[b].column(self.screener.groups.of_frame[frame]);
        let channel = self.screener.channel(frame, b);
        let expectation = self.normal.expect(channel, slope, &TERMS, &self.best.step, &self.best.factor);
        let (expected, of_baseline, of_params) = expectation.expect("a baseline's prior is known");
        let innovation = (self.residual(frame, b) - expected) as f32;
        let certain = self.variance(frame, b) + of_baseline + further;
        // the uncertainty of the params is only worked out for readings that need it
        self.gate.expects(innovation, certain as f32)
            || self.gate.expects(innovation, (certain + (1.0 + UNDERWEIGHT) * of_params()) as f32)
    }

    fn residual(&self, frame: usize, b: usize) -> f64 {
        self.screener.readings[(frame, b)] - self.model.orbit[(frame, b)]
    }

    /// Variance of one reading: the monitor's noise, and what all frames of its RF offset share [m^2].
    fn variance(&self, frame: usize, b: usize) -> f64 {
        let plane = self.screener.plane(b);
        let shared = self.screener.spurious[plane] * self.best.orbit[plane] * self.screener.drives[frame].rf_offset;
        // frames of one RF offset share it, and so do those of all times in the cycle
        let sharing = self.screener.sharing[frame] * self.screener.times.count() as f64;
        f64::from(self.monitors[b].variance()) + sharing * shared * shared
    }

    fn weighed(&self, frame: usize, b: usize) -> Weighed {
        Weighed::one(&TERMS, self.residual(frame, b), 1.0 / self.variance(frame, b))
    }

    /// Linearise at the best params if they have left those of the model, or if readings need re-weighting.
    fn linearise_if_due(&mut self, frames: usize) {
        let variance = self.best.factor.inverse_diagonal();
        let moved = |i: usize| self.best.step[i].abs() > MOVED * variance[i].sqrt();
        if !self.stale && !(0..self.best.step.len()).any(moved) {
            return;
        }
        // re-weighted readings have another chi-square; the step is then judged with the next one
        let highest = if self.stale { f64::INFINITY } else { self.best.cost + UPHILL };
        self.stale = false;
        let (from, step) = (self.model.params.clone(), self.best.step.clone());
        for halvings in 0..HALVINGS {
            let Ok(model) = self.screener.model(&from + &step * 0.5_f64.powi(halvings)) else { continue };
            self.model = model;
            if self.rebuild(frames) && self.best.cost <= highest {
                return;
            }
        }
        if let Ok(model) = self.screener.model(from) {
            self.model = model;
            if !self.rebuild(frames) {
                self.best.step.fill(0.0);
            }
        }
    }

    /// Take back every reading of a monitor that ends dead and does report: those before it was found to be stuck or flat are no better.
    /// One that went silent was sound as long as it spoke.
    fn drop_stuck(&mut self) {
        let frames = self.screener.drives.len();
        let reports = |b: usize| frames > 0 && !self.screener.readings[(frames - 1, b)].is_nan();
        let is_stuck = |b: usize| self.monitors[b].health().state == MonitorState::Dead && reports(b);
        let stuck: Vec<usize> = (0..self.monitors.len()).filter(|&b| is_stuck(b)).collect();
        if stuck.is_empty() {
            return;
        }
        stuck.into_iter().for_each(|b| self.excluded.exclude_monitor(b, Excluded::Stuck));
        self.rebuild(frames);
    }

    /// The normal equations of the accepted readings of the first frames; false if they have no best params.
    fn rebuild(&mut self, frames: usize) -> bool {
        let monitors = self.monitors.len();
        self.normal = Normal::new(self.screener.prior, &self.model.params, self.screener.channels(), COMMON);
        for b in 0..monitors {
            let none = |time: &usize| (time * monitors + b, Weighed::none(TERMS.len()));
            let mut sums: Vec<(usize, Weighed)> = self.screener.groups.times.iter().map(none).collect();
            for frame in (0..frames).filter(|&frame| self.excluded.counts(frame, b)) {
                sums[self.screener.groups.of_frame[frame]].1 += &self.weighed(frame, b);
            }
            self.normal.add(&self.model.slope[b], &sums);
        }
        self.solve()
    }

    /// The best params. At a resonance derivatives are so large that rounding leaves the normal equations without any: then those of
    /// before stay, and this is false.
    fn solve(&mut self) -> bool {
        let Some(best) = Best::solve(self.screener, &self.model, &self.normal) else { return false };
        self.best = best;
        true
    }
}

impl Best {
    /// None if the matrix of the normal equations is not positive.
    fn solve(screener: &Screener, model: &Model, normal: &Normal) -> Option<Self> {
        let (cost, quadratic) = normal.eliminated();
        let factor = quadratic.factor()?;
        let step = quadratic.within(&factor.solve(&quadratic.slope), &model.params, &screener.prior.range);
        let baselines = normal.baselines(&step);
        Some(Self { orbit: rms_by_plane(screener.ring, &baselines), step, factor, cost })
    }
}

/// Rms of the baselines that are known, in x and y [m].
pub(super) fn rms_by_plane(ring: &Ring, baselines: &[Option<f64>]) -> [f64; 2] {
    let (monitors, horizontal) = (ring.read_monitors.len(), ring.horizontal_monitors());
    [0, 1].map(|plane| {
        let is_of_plane = |channel: usize| usize::from(channel % monitors >= horizontal) == plane;
        let of_plane = baselines.iter().enumerate().filter(|(channel, _)| is_of_plane(*channel));
        let squares: Vec<f64> = of_plane.filter_map(|(_, baseline)| baseline.map(|x| x * x)).collect();
        (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
    })
}

/// A reading as the wire has it; none where it is missing.
fn code(reading: f64) -> Option<i32> {
    PositionCode::nearest(reading).map(PositionCode::steps)
}
