//! A recording whitened: one vector of independent numbers of variance 1.
//!
//! The readings of a monitor have unknown terms in common: its baseline (orbit and offset), the change of that with the supplies and
//! with the RF frequency (caused by misalignments), and, where all quadrupoles drift, with the time. Each is a vector `u` over the
//! frames with an unknown factor of known standard deviation, so that the readings' covariance is
//!
//! `S = sigma^2 (1 + U U^T)`, and with the thin decomposition `U = Q D V^T`,
//! `S^(-1/2) = (1 - Q (1 - (1 + D^2)^(-1/2)) Q^T)/sigma`.
//!
//! The noise itself is as learnt from the repeats ([`super::noise`]). Where it remembers the frames before, the numbers of a monitor are
//! replaced by its innovations before the common terms are taken out (`memory.rs`); where monitors have noise in common within a frame,
//! the frame is whitened before all that (`modes.rs`). The covariance is thereby defined as the product of the two: what
//! monitors have in common has the same memory as their own noise.
//!
//! For whitened data every fit is plain least squares. The tune meter adds four numbers: the mean of each tune and
//! its change from start to end.

use estimator::{Health, MonitorState};
use nalgebra::{DMatrix, DVector, DVectorView, RowVector2, Vector2};
use twin::{
    Cycle, Drives, Effect, EffectError, Hold, Machine, Optics, OrbitError, Rf, Ring, Signature, Signatures, Tracked,
    Tunes,
};

use super::baseline::Baseline;
use super::error::FitError;
use super::evidence::Units;
use super::memory::{Filter, Memory};
use super::modes::Mixing;
use super::noise::{Noise, Source};
use super::settings::Settings;
use super::wiring::Miswired;
use inference::campaign::chi_square;
use inference::recording::Recording;
use inference::{Campaign, Meter, Screened};

/// A recording, whitened.
#[derive(Debug, Clone)]
pub struct Data {
    /// The ring as designed.
    pub ring: Ring,
    /// The params in units of their priors.
    pub units: Units,
    /// Kicks, RF offset and time of each frame, and the orbit without kicks.
    pub drives: Drives,
    /// Size, changes and uncertainty of that orbit.
    pub baseline: Baseline,
    /// Which readings count, and the state of the monitors.
    pub screened: Screened,
    /// `ln` of each supply's mean factor [F].
    pub supplies: Vec<f64>,
    /// Readings at the mean supply currents, the orbit's terms above first order in kicks and RF offset subtracted, rows frames,
    /// columns monitors [m].
    pub readings: DMatrix<f64>,
    /// Readings as recorded [m]; NaN for one that is missing.
    recorded: DMatrix<f64>,
    /// `ln` of each supply's factor off its mean, rows frames, columns supplies.
    fluctuation: DMatrix<f64>,
    /// Noise of a reading of each monitor by the recording's header [B] [m].
    pub expected_noise: Vec<f64>,
    /// The noise as learnt.
    pub noise: Noise,
    channels: Vec<Channel>,
    mixing: Mixing,
    /// A constant taken off each monitor's readings before those of a frame are mixed, about their mean; 0 where none are [B] [m].
    centre: DVector<f64>,
    /// Tunes at the mean supply currents, rows frames; NaN where they do not count.
    tunes: DMatrix<f64>,
    recorded_tunes: DMatrix<f64>,
    meter: [Option<Meter>; 2],
    /// The constraint that the header states instead of a fixed momentum.
    pub believed: Vec<Effect>,
    /// Common terms of each monitor's readings, in standard deviations, without those of RF frequency and drift [frames][factors] [m].
    shared: Vec<DMatrix<f64>>,
    /// Relative change of all gradients, from mid-campaign to the end, with which the baselines drift.
    drift: f64,
}

/// The readings of one monitor that count.
#[derive(Debug, Clone)]
struct Channel {
    frames: Vec<usize>,
    sigma: f64,
    /// Where the noise remembers.
    filter: Option<Filter>,
    /// `Q` [frames][factors].
    basis: DMatrix<f64>,
    /// `1 - (1 + D^2)^(-1/2)` of each.
    shrink: DVector<f64>,
    log_det: f64,
}

/// Why a recording cannot be diagnosed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// The design has no orbit.
    #[error("the ring as designed: {0}")]
    Orbit(#[from] OrbitError),
    /// Too few data for a diagnosis.
    #[error("{recording}: {what}: expected at least {expected}, found {found}")]
    TooLittle {
        /// The recording.
        recording: String,
        /// Name of what there is too little of.
        what: &'static str,
        /// How many are needed.
        expected: usize,
        /// How many there are.
        found: usize,
    },
    /// Frames at several times in the cycle: their baselines differ, and a diagnosis knows one of each monitor.
    #[error("{recording}: expected frames at one time in the cycle, found {found}")]
    Times {
        /// The recording.
        recording: String,
        /// The times.
        found: String,
    },
    /// Columns that are not what the header says.
    #[error("{recording}: frames.csv: {wiring}")]
    Miswired {
        /// The recording.
        recording: String,
        /// What they look like.
        wiring: Miswired,
    },
    /// An effect that is not defined for this ring.
    #[error(transparent)]
    Effect(#[from] EffectError),
    /// No hypothesis can be fitted.
    #[error(transparent)]
    Fit(#[from] FitError),
}

/// Prior standard deviation of a baseline [m].
const BASELINE: f64 = 20e-3;
/// Whitened residual above which a reading of a faulty monitor is dropped.
const FAULTY: f64 = 4.0;
/// Fewest monitors, and fewest correctors, for a diagnosis.
pub const LEAST: usize = 4;

impl Data {
    /// Whiten a campaign.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn of(campaign: &Campaign) -> Result<Self, DataError> {
        if campaign.times.count() > 1 {
            let (recording, found) = (campaign.recording.name.clone(), campaign.times.to_string());
            return Err(DataError::Times { recording, found });
        }
        let Campaign { ring, recording, drives: driven, supplies, screened, readings: recorded, .. } = campaign;
        let mut drives = drives_of(campaign);
        let believed = recording.header.believed(ring)?;
        let at_supplies = ring.with_strengths(&ring.strengths(&[], supplies));
        let design = Machine::new(at_supplies, Rf::FixedMomentum, &believed)?;
        let of_momentum = |i: usize, plane: usize| drives.rf_offset[i] == 0.0 && !campaign.tunes[(i, plane)].is_nan();
        let recorded_tunes = DMatrix::from_fn(driven.len(), 2, |i, plane| {
            if of_momentum(i, plane) { campaign.tunes[(i, plane)] } else { f64::NAN }
        });
        let kicked_off = recorded - design.readings(&drives)?.0;
        let (orbit, baseline) = Baseline::of(design.ring(), &kicked_off, screened, &recorded_tunes, campaign.spurious)?;
        drives.orbit = orbit;
        let shared = |b: usize| campaign.following(b).insert_column(0, BASELINE);
        let noise = noise_of(campaign, &design, &drives)?;
        let mut screened = screened.clone();
        noise.sound.iter().for_each(|&b| screened.health[b].state = MonitorState::Ok);
        let mut data = Self {
            ring: ring.clone(),
            units: Units::of(&campaign.prior),
            screened,
            supplies: supplies.clone(),
            readings: recorded.clone(),
            shared: (0..recorded.ncols()).map(shared).collect(),
            baseline,
            recorded: recorded.clone(),
            fluctuation: campaign.fluctuation.clone(),
            expected_noise: recording.header.noise.clone(),
            centre: DVector::zeros(recorded.ncols()),
            noise,
            channels: Vec::new(),
            mixing: Mixing::default(),
            meter: [None, None],
            tunes: recorded_tunes.clone(),
            recorded_tunes,
            believed,
            drift: 0.0,
            drives,
        };
        data.prepare();
        data.check(recording)?;
        data.linearise_about(&design)?;
        Ok(data)
    }

    /// Linearise the recorded readings and tunes about a machine: subtract the effect of the supplies' fluctuations on the kicked orbit,
    /// to first order, and the terms of the exact orbits above first order. The curvature of the bends makes the latter up to some
    /// 10 um for kicks of 0.2 mrad, more near an integer tune. Both depend little on the details of the model. Returns the
    /// chi-square of the change of the readings.
    ///
    /// # Errors
    /// [`EffectError`] if the machine keeps no beam in one of the settings; the readings are then as they were.
    pub fn linearise_about(&mut self, machine: &Machine) -> Result<f64, EffectError> {
        let higher = self.higher_orders(machine)?;
        let slopes = Signatures::of(&machine.on_orbit(&self.drives.orbit), &self.drives)?.of_quadrupoles();
        let (mut readings, mut tunes) = (&self.recorded - higher, self.recorded_tunes.clone());
        for (slope, quadrupole) in slopes.iter().zip(&self.ring.quadrupoles) {
            let Some(supply) = quadrupole.supply else { continue };
            let off = self.fluctuation.column(supply);
            for (b, mut column) in readings.column_iter_mut().enumerate() {
                column -= off.component_mul(&slope.readings.column(b));
            }
            tunes -= off * RowVector2::from(slope.tunes);
        }
        let moved = self.whiten(|b, frame| readings[(frame, b)] - self.readings[(frame, b)], [Vector2::zeros(); 2]);
        (self.readings, self.tunes) = (readings, tunes);
        self.meter = self.meters();
        Ok(moved.norm_squared())
    }

    /// Drop readings of faulty monitors that lie far from a fit: jumps that the screening accepted as the first reading of a setting. True if
    /// there are any.
    pub fn trim(&mut self, residual: &DVector<f64>) -> bool {
        let places = self.places().into_iter().zip(residual.iter()).filter(|(_, r)| r.abs() > FAULTY);
        let is_faulty = |(_, b): &(usize, usize)| self.health()[*b].state != MonitorState::Ok;
        let dropped: Vec<(usize, usize)> = places.filter_map(|(place, _)| place).filter(is_faulty).collect();
        dropped.iter().for_each(|&place| self.screened.accepted[place] = false);
        if !dropped.is_empty() {
            self.prepare();
        }
        !dropped.is_empty()
    }

    /// What the exact orbits of a machine have beyond [`Machine::readings`], rows frames, the same for all repeats [m]: terms above first
    /// order in kicks and RF offset, and those of the orbit without kicks, in which the dipoles' ends couple the planes.
    fn higher_orders(&self, machine: &Machine) -> Result<DMatrix<f64>, EffectError> {
        let mut displaced = machine.clone();
        self.baseline.displace(&mut displaced)?;
        let settings = Settings::of(&self.drives);
        let drives = Drives { orbit: displaced.orbit()?, ..settings.means(&self.drives) };
        let tracked = Tracked::of(displaced, self.drives.nominal_kick)?;
        let cycle = |kick: Vec<f64>, rf_offset: f64| {
            let strength = vec![0.0; self.ring.quadrupoles.len()];
            tracked.readings(&Cycle { kick, strength, rf_offset, time: 0.0 })
        };
        let plain = cycle(vec![0.0; drives.kick.ncols()], 0.0)?;
        let mut higher = -machine.readings(&drives)?.0;
        for (i, mut row) in higher.row_iter_mut().enumerate() {
            let exact = cycle(drives.kick.row(i).iter().copied().collect(), drives.rf_offset[i])?;
            row.iter_mut().zip(exact.iter().zip(&plain)).for_each(|(to, (exact, plain))| *to += exact - plain);
        }
        Ok(higher.select_rows(&settings.of_frame))
    }

    /// The same recording with a known signal taken out of its readings and tunes, rows frames.
    pub fn less(&self, readings: &DMatrix<f64>, tunes: &DMatrix<f64>) -> Self {
        let mut data = self.clone();
        data.readings -= readings;
        data.recorded -= readings;
        data.tunes -= tunes;
        data.recorded_tunes -= tunes;
        data.meter = data.meters();
        data
    }

    fn meters(&self) -> [Option<Meter>; 2] {
        [0, 1].map(|plane| Meter::of(self.tunes.column(plane).iter().zip(self.drives.time.iter())))
    }

    /// The same recording where all quadrupoles drift by `-amplitude` to `amplitude`: every baseline drifts with them.
    pub fn drifting(&self, amplitude: f64) -> Self {
        let mut data = self.clone();
        data.drift = amplitude;
        data.prepare();
        data
    }

    /// A hypothetical campaign with other drives; its readings are ignored.
    pub fn driven_by(&self, drives: &Drives) -> Self {
        let mut data = Self { drives: drives.clone(), ..self.clone() };
        data.prepare();
        data
    }

    /// The same recording without some frames.
    pub fn without(&self, frames: &[usize]) -> Self {
        let mut data = self.clone();
        for &frame in frames {
            data.screened.accepted.row_mut(frame).fill(false);
            data.tunes.row_mut(frame).fill(f64::NAN);
        }
        data.meter = data.meters();
        data.prepare();
        data
    }

    /// Prepare the whitening of the readings that count.
    fn prepare(&mut self) {
        self.channels = (0..self.readings.ncols()).map(|b| self.channel(b)).collect();
        self.mixing = Mixing::of(&self.noise.modes, self.readings.nrows(), |frame, b| self.counts(frame, b));
        if !self.mixing.is_none() {
            let mean = |b: usize| {
                let frames = self.frames(b);
                frames.iter().map(|&frame| self.readings[(frame, b)]).sum::<f64>() / frames.len().max(1) as f64
            };
            self.centre = DVector::from_fn(self.readings.ncols(), |b, _| mean(b));
        }
    }

    fn channel(&self, b: usize) -> Channel {
        let frames: Vec<usize> = (0..self.readings.nrows()).filter(|&frame| self.counts(frame, b)).collect();
        let shared = self.shared(b, &frames);
        Channel::of(frames, self.noise.own[b], self.noise.memory(b), shared)
    }

    /// Common terms of a monitor's readings in some frames, in standard deviations [frames][factors] [m].
    pub fn shared(&self, b: usize, frames: &[usize]) -> DMatrix<f64> {
        let (plane, drift) = (usize::from(b >= self.ring.horizontal_monitors()), self.drift);
        let rf = DVector::from_iterator(frames.len(), frames.iter().map(|&i| self.drives.rf_offset[i]));
        let shared = self.shared[b].select_rows(frames);
        let at = shared.ncols();
        let mut shared = shared.insert_column(at, 0.0);
        shared.set_column(at, &(rf * self.baseline.spurious[plane]));
        if drift == 0.0 {
            return shared;
        }
        // to second order in time: near an integer tune the orbit grows faster than the gradients drift
        let time = |power: i32| {
            let relative = (drift * self.baseline.sensitivity[plane]).powi(power) * self.baseline.rms[plane];
            DVector::from_iterator(frames.len(), frames.iter().map(|&i| self.drives.time[i].powi(power) * relative))
        };
        let at = shared.ncols();
        let mut shared = shared.insert_columns(at, 2, 0.0);
        shared.set_column(at, &time(1));
        shared.set_column(at + 1, &time(2));
        shared
    }

    fn check(&self, recording: &Recording) -> Result<(), DataError> {
        let enough = |what, expected, found| {
            if found >= expected {
                return Ok(());
            }
            Err(DataError::TooLittle { recording: recording.name.clone(), what, expected, found })
        };
        let active = |channel: &&Channel| channel.frames.len() > channel.basis.ncols();
        enough("monitors with enough readings that count", LEAST, self.channels.iter().filter(active).count())?;
        enough("correctors that were moved", LEAST, self.driven_correctors().len())
    }

    /// Correctors that were powered, by index.
    pub fn driven_correctors(&self) -> Vec<usize> {
        let moved = |&c: &usize| self.drives.kick.column(c).amax() > 0.05 * self.drives.nominal_kick;
        (0..self.drives.kick.ncols()).filter(moved).collect()
    }

    /// Monitors that have readings which count, by index.
    pub fn active_monitors(&self) -> Vec<usize> {
        (0..self.channels.len()).filter(|&b| self.channels[b].frames.len() > self.channels[b].basis.ncols()).collect()
    }

    /// Number of whitened numbers.
    pub fn size(&self) -> usize {
        self.channels.iter().map(|c| c.frames.len()).sum::<usize>() + 4
    }

    /// `ln` of the determinant of the covariance.
    pub fn log_det(&self) -> f64 {
        self.channels.iter().map(|c| c.log_det).sum::<f64>() + self.mixing.log_det()
    }

    /// Whitened residuals: readings and tunes less those predicted.
    pub fn residual(&self, predicted: &DMatrix<f64>, tunes: Tunes, tune_drift: [f64; 2]) -> DVector<f64> {
        let miss = [0, 1].map(|plane| {
            let predicted = Vector2::new([tunes.x, tunes.y][plane], tune_drift[plane]);
            self.meter[plane].as_ref().map_or(Vector2::zeros(), |meter| meter.miss(predicted))
        });
        self.whiten(|b, frame| self.readings[(frame, b)] - self.centre[b] - predicted[(frame, b)], miss)
    }

    /// Readings [m] and tunes [1] as columns, less those predicted, for a tune modulo 1.
    pub fn miss(&self, predicted: &DMatrix<f64>) -> DMatrix<f64> {
        let monitors = self.readings.ncols();
        let mut miss = -predicted;
        let mut part = miss.columns_mut(0, monitors);
        part += &self.readings;
        let mut part = miss.columns_mut(monitors, 2);
        part += &self.tunes;
        part.apply(|tune| *tune -= tune.round());
        miss
    }

    /// A signature, whitened.
    pub fn signature(&self, signature: &Signature) -> DVector<f64> {
        let tunes = [0, 1].map(|plane| {
            let change = Vector2::new(signature.tunes[plane], signature.tune_drift[plane]);
            self.meter[plane].as_ref().map_or(Vector2::zeros(), |meter| meter.whiten * change)
        });
        self.whiten(|b, frame| signature.readings[(frame, b)], tunes)
    }

    fn whiten(&self, value: impl Fn(usize, usize) -> f64, tunes: [Vector2<f64>; 2]) -> DVector<f64> {
        if self.mixing.is_none() {
            return self.stack(|b, frame| value(b, frame) / self.channels[b].sigma, tunes);
        }
        let mut values = DMatrix::zeros(self.readings.nrows(), self.channels.len());
        for (b, channel) in self.channels.iter().enumerate() {
            channel.frames.iter().for_each(|&frame| values[(frame, b)] = value(b, frame) / channel.sigma);
        }
        self.mixing.apply(&mut values);
        self.stack(|b, frame| values[(frame, b)], tunes)
    }

    /// All numbers, monitor by monitor, whitened in time, then those of the tunes.
    fn stack(&self, value: impl Fn(usize, usize) -> f64, tunes: [Vector2<f64>; 2]) -> DVector<f64> {
        let mut all = DVector::zeros(self.size());
        let mut at = 0;
        for (b, channel) in self.channels.iter().enumerate() {
            let n = channel.frames.len();
            let mut part = all.rows_mut(at, n);
            for (to, &frame) in part.iter_mut().zip(&channel.frames) {
                *to = value(b, frame);
            }
            if let Some(filter) = &channel.filter {
                filter.whiten(part.iter_mut());
            }
            let common = channel.basis.tr_mul(&part).component_mul(&channel.shrink);
            part.gemv(-1.0, &channel.basis, &common, 1.0);
            at += n;
        }
        for tune in tunes {
            all.fixed_rows_mut::<2>(at).copy_from(&tune);
            at += 2;
        }
        all
    }

    /// Whitened numbers, one set a column, with the noise in common taken out once more: the product of what only one monitor would read
    /// with them is then that with all that it would leave in the others.
    pub fn taken_back(&self, whitened: &DMatrix<f64>) -> DMatrix<f64> {
        let mut back = whitened.clone();
        if self.mixing.is_none() {
            return back;
        }
        let starts: Vec<usize> = (0..self.channels.len()).map(|b| self.start(b)).collect();
        let places = || {
            let of = |(b, channel): (usize, &Channel)| {
                channel.frames.iter().enumerate().map(move |(i, &frame)| (i, frame, b)).collect::<Vec<_>>()
            };
            self.channels.iter().enumerate().flat_map(of)
        };
        for mut column in back.column_iter_mut() {
            let mut values = DMatrix::zeros(self.readings.nrows(), self.channels.len());
            places().for_each(|(i, frame, b)| values[(frame, b)] = column[starts[b] + i]);
            self.mixing.apply(&mut values);
            places().for_each(|(i, frame, b)| column[starts[b] + i] = values[(frame, b)]);
        }
        back
    }

    /// Frame and monitor of each whitened number; none for those of the tune meter.
    pub fn places(&self) -> Vec<Option<(usize, usize)>> {
        let of = |(b, channel): (usize, &Channel)| channel.frames.iter().map(|&i| Some((i, b))).collect::<Vec<_>>();
        self.channels.iter().enumerate().flat_map(of).chain([None; 4]).collect()
    }

    /// First of a monitor's whitened numbers.
    pub fn start(&self, b: usize) -> usize {
        self.channels[..b].iter().map(|channel| channel.frames.len()).sum()
    }

    /// Sum of squares of measured less predicted readings over the noise as learnt, about all that a monitor's readings have in common, and
    /// its degrees of freedom; of the monitors in state ok. `miss`: rows frames, columns monitors.
    pub fn chi_square(&self, miss: &DMatrix<f64>) -> (f64, f64) {
        let mut values = DMatrix::zeros(self.readings.nrows(), self.channels.len());
        for (b, channel) in self.channels.iter().enumerate() {
            let value = |frame: usize| (miss[(frame, b)] - self.centre[b]) / channel.sigma;
            channel.frames.iter().for_each(|&frame| values[(frame, b)] = value(frame));
        }
        self.mixing.apply(&mut values);
        let is_ok = |b: &usize| self.health()[*b].state == MonitorState::Ok;
        let mut sums = (0.0, 0.0);
        for b in self.active_monitors().into_iter().filter(is_ok) {
            let channel = &self.channels[b];
            let mut terms = self.shared(b, &channel.frames) / channel.sigma;
            terms.column_mut(0).fill(1.0);
            let mut residual = values.select_rows(&channel.frames).columns(b, 1).into_owned();
            if let Some(filter) = &channel.filter {
                filter.whiten_columns(&mut terms);
                filter.whiten_columns(&mut residual);
            }
            let (chi2, freedom) = chi_square(&residual.column(0).into_owned(), &terms.transpose(), 1, 1.0);
            sums = (sums.0 + chi2, sums.1 + freedom);
        }
        sums
    }

    /// Whiten columns over all frames as readings of one monitor.
    pub fn whiten_columns(&self, b: usize, columns: &DMatrix<f64>) -> DMatrix<f64> {
        let channel = &self.channels[b];
        let mut part = columns.select_rows(&channel.frames) / channel.sigma;
        if let Some(filter) = &channel.filter {
            filter.whiten_columns(&mut part);
        }
        let mut common = channel.basis.transpose() * &part;
        common.row_iter_mut().zip(channel.shrink.iter()).for_each(|(mut row, shrink)| row *= *shrink);
        part -= &channel.basis * common;
        part
    }

    /// What a monitor's readings tell beside those of the others in the same frames, as a share of what they tell alone, on average.
    pub fn own_share(&self, b: usize) -> f64 {
        let frames = self.frames(b);
        if self.mixing.is_none() || frames.is_empty() {
            return 1.0;
        }
        frames.iter().map(|&frame| self.mixing.own(frame, b)).sum::<f64>() / frames.len() as f64
    }

    /// What a pattern over some monitors [m] has to be multiplied by, monitor by monitor, with [`Data::own_share`]: itself with what it leaves
    /// in each by the noise in common.
    pub fn accompanied(&self, monitors: &[usize], pattern: &DVector<f64>) -> DVector<f64> {
        if self.mixing.is_none() {
            return pattern.clone();
        }
        let mixing = Mixing::of(&self.noise.modes, 1, |_, b| monitors.contains(&b));
        let mut values = DMatrix::zeros(1, pattern.len());
        monitors.iter().for_each(|&b| values[(0, b)] = pattern[b] / self.channels[b].sigma);
        mixing.apply(&mut values);
        mixing.apply(&mut values);
        DVector::from_fn(pattern.len(), |b, _| values[(0, b)] * self.channels[b].sigma / mixing.own(0, b))
    }

    /// Readings that step with time, whitened: rows frames, columns monitors.
    pub fn stepping(&self, readings: &DMatrix<f64>, step: &DVectorView<f64>) -> DVector<f64> {
        self.whiten(|b, frame| readings[(frame, b)] * step[frame], [Vector2::zeros(); 2])
    }

    /// `E^T S^-1 E` of a monitor's readings for groups of frames, of which `group` names that of each frame, as if the noise were white:
    /// `diag(alone) - common common^T`, the latter of their common terms. Returns both, [groups] and [groups][factors].
    pub fn information(&self, b: usize, group: &[usize], groups: usize) -> (DVector<f64>, DMatrix<f64>) {
        let channel = &self.channels[b];
        let share = self.own_share(b);
        let taken = channel.shrink.map(|shrink| (share * shrink * (2.0 - shrink)).sqrt() / channel.sigma).transpose();
        let (mut alone, mut common) = (DVector::zeros(groups), DMatrix::zeros(groups, taken.len()));
        for (row, &frame) in channel.basis.row_iter().zip(&channel.frames) {
            alone[group[frame]] += share * channel.sigma.powi(-2);
            let mut common = common.row_mut(group[frame]);
            common += row.component_mul(&taken);
        }
        (alone, common)
    }

    /// True if a reading counts.
    pub fn counts(&self, frame: usize, b: usize) -> bool {
        self.screened.accepted[(frame, b)] && !self.readings[(frame, b)].is_nan()
    }

    /// Frames in which a monitor's reading counts.
    pub fn frames(&self, b: usize) -> &[usize] {
        &self.channels[b].frames
    }

    /// Noise of a reading by the recording's header, mean over the monitors [m].
    pub fn mean_noise(&self) -> f64 {
        self.expected_noise.iter().sum::<f64>() / self.expected_noise.len().max(1) as f64
    }

    /// Noise of one reading of a monitor that is its own [m], what it remembers, and the variance of a whole reading over that of its own.
    pub fn noise_of(&self, b: usize) -> (f64, Memory, f64) {
        (self.noise.own[b], self.noise.memory(b), self.noise.modes.growth(b))
    }

    /// Frames in which a tune counts.
    pub fn tune_frames(&self, plane: usize) -> Vec<usize> {
        let counts = |&frame: &usize| self.meter[plane].is_some() && !self.tunes[(frame, plane)].is_nan();
        (0..self.tunes.nrows()).filter(counts).collect()
    }

    /// Noise of one reading of the tune meter [1], if there are enough readings.
    pub fn tune_noise(&self, plane: usize) -> Option<f64> {
        self.meter[plane].as_ref().map(|meter| meter.noise)
    }

    /// State of the monitors.
    pub fn health(&self) -> &[Health] {
        &self.screened.health
    }
}

impl Channel {
    fn of(frames: Vec<usize>, sigma: f64, memory: Memory, shared: DMatrix<f64>) -> Self {
        let Some(&first) = frames.first() else {
            let (basis, shrink) = (DMatrix::zeros(0, 0), DVector::zeros(0));
            return Self { frames, sigma, filter: None, basis, shrink, log_det: 0.0 };
        };
        let filter = (!memory.is_none()).then(|| Filter::of(memory, first, &frames));
        let mut shared = shared / sigma;
        filter.iter().for_each(|filter| filter.whiten_columns(&mut shared));
        let svd = shared.svd(true, false);
        let basis = svd.u.expect("asked for");
        let grown = svd.singular_values.map(|d| 1.0 + d * d);
        let log_det = 2.0 * frames.len() as f64 * sigma.ln() + grown.iter().map(|g| g.ln()).sum::<f64>();
        let log_det = log_det + filter.as_ref().map_or(0.0, Filter::log_det);
        Self { frames, sigma, filter, basis, shrink: grown.map(|g| 1.0 - g.sqrt().recip()), log_det }
    }
}

/// The noise, learnt from the readings about the machine that the screening ends with, or about the design where that keeps no beam.
fn noise_of(campaign: &Campaign, design: &Machine, drives: &Drives) -> Result<Noise, DataError> {
    let ring = &campaign.ring;
    let found = ring.with_strengths(&ring.strengths(campaign.params.as_slice(), &campaign.supplies));
    let found = Machine::new(found, Rf::FixedMomentum, &[]).ok();
    let of = |machine: &Machine| -> Result<(DMatrix<f64>, DVector<f64>), OrbitError> {
        let optics = Optics::of(machine.ring(), Hold::Momentum { delta: 0.0 })?;
        Ok((machine.readings(drives)?.0, optics.dispersion_of(&optics.read_monitors())))
    };
    let known = found.as_ref().and_then(|machine| of(machine).ok());
    let (predicted, dispersion) = known.map_or_else(|| of(design), Ok)?;
    let residual = &campaign.readings - predicted;
    Ok(Noise::learn(&Source { campaign, residual: &residual, dispersion: &dispersion }))
}

fn drives_of(campaign: &Campaign) -> Drives {
    let driven = &campaign.drives;
    let rows: Vec<_> = driven.iter().map(|d| d.kick.transpose()).collect();
    Drives {
        kick: DMatrix::from_rows(&rows),
        rf_offset: DVector::from_iterator(driven.len(), driven.iter().map(|d| d.rf_offset)),
        time: DVector::from_vec(campaign.time.clone()),
        nominal_kick: campaign.recording.nominal_kick(),
        orbit: vec![[0.0; 2]; campaign.ring.elements.len()],
    }
}
