//! A recording whitened: one vector of independent numbers of variance 1.
//!
//! The readings of a monitor have unknown terms in common: its baseline (orbit and offset), the change of that with the supplies and
//! with the RF frequency (caused by misalignments, which also lengthen the orbit and with it move the momentum that a frequency sets), and, where all
//! quadrupoles drift, with the time. Each is a vector `u` over the
//! frames with an unknown factor of known standard deviation, so that the readings' covariance is
//!
//! `S = sigma^2 (1 + U U^T)`, and with the thin decomposition `U = Q D V^T`,
//! `S^(-1/2) = (1 - Q (1 - (1 + D^2)^(-1/2)) Q^T)/sigma`.
//!
//! What is whitened are not single frames but the means of consecutive frames of one setting ([`super::pools`]), each reading less
//! what the supplies and the correctors' read-backs do to it within the pool. The noise itself is as learnt from the repeats ([`super::noise`]); the
//! covariance of the means follows from what it remembers (`channel.rs`). Where monitors have noise in common within a frame,
//! the pool is whitened before all that (`modes.rs`). The covariance is thereby defined as the product of the two: what
//! monitors have in common has the same memory as their own noise.
//!
//! For whitened data every fit is plain least squares. A tune is read as a monitor is, with a calibration error that all its readings share.

use core::ops::Range;

use estimator::{Health, MonitorState};
use nalgebra::{DMatrix, DMatrixViewMut, DVector, DVectorViewMut, MatrixXx2, RowVector2};
use twin::{
    Drives, EffectError, Hold, Holding, Kind, Machine, Measured, Optics, OrbitError, Rf, Ring, Signature, Signatures,
    change_at,
};

use super::baseline::Baseline;
use super::channel::Channel;
use super::close_tunes::CloseTunes;
use super::columns::beside;
use super::common_factors::common_factors;
use super::exact_orbits::Exact;
use super::fit::FitError;
use super::frame_pattern::Shape;
use super::levels::Levels;
use super::memory::{Filter, Memory};
use super::modes::Mixing;
use super::noise::{Noise, Source};
use super::pools::Pools;
use super::readmission::{JUMPS, left_aside, readmitted};
use super::units::Units;
use super::wiring::Miswired;
use inference::recording::Recording;
use inference::{Campaign, Excluded, Meter, Screened, Settings, TUNE_CALIBRATION, chi_square};

/// A recording, whitened.
#[derive(Debug, Clone)]
pub struct Data {
    /// Name of the recording.
    pub name: String,
    /// Further recordings of the same machine, each alone, which are fitted together with this one (`joint.rs`).
    pub(super) others: Vec<Self>,
    /// Momentum of the beam [GeV/c].
    pub momentum: f64,
    /// The ring as designed.
    pub ring: Ring,
    /// The params in units of their priors.
    pub units: Units,
    /// Mean kicks, RF offset and time of each pool, and the orbit without kicks.
    pub drives: Drives,
    /// The settings of the pools.
    pub settings: Settings,
    /// Size, changes and uncertainty of that orbit.
    pub baseline: Baseline,
    /// Shift of the tunes by the orbit without kicks, which [`Machine::readings`] leaves out, in the machine that the readings are linearised about.
    pub tune_shift_of_orbit: [f64; 2],
    /// Tunes that are left out.
    pub close_tunes: Option<CloseTunes>,
    /// Which readings count, and the state of the monitors.
    pub screened: Screened,
    /// `ln` of each supply's mean factor [F].
    pub supplies: Vec<f64>,
    /// Pooled readings at the mean supply currents, the orbit's terms above first order in kicks and RF offset subtracted, rows pools,
    /// columns monitors [m], then the two tunes; 0 where none counts.
    pub readings: DMatrix<f64>,
    /// The pools of the frames.
    pub pools: Pools,
    /// Frame by frame.
    frames: Frames,
    /// Noise of a reading by the recording's header, mean over the monitors [m].
    pub mean_noise: f64,
    /// The noise as learnt.
    pub noise: Noise,
    /// Of each monitor, then of the two tunes.
    pub(super) channels: Vec<Channel>,
    pub(super) mixing: Mixing,
    /// A constant taken off each monitor's readings before those of a pool are mixed, about their mean; 0 where none are [B] [m].
    centre: DVector<f64>,
    /// What the header states to be held.
    pub believed: Holding,
    /// Common terms of each monitor's readings, in standard deviations, without those of RF frequency and drift [frames][factors] [m].
    shared: Vec<DMatrix<f64>>,
    /// Relative change of all gradients, from mid-campaign to the end, with which the baselines drift.
    drift: f64,
    /// True if the readings are linearised about a machine with effects: a fit without one of these then has readings of its own.
    pub(super) is_about_effects: bool,
}

/// A recording, frame by frame.
#[derive(Debug, Clone)]
struct Frames {
    drives: Drives,
    /// As recorded, columns monitors [m] and the two tunes; NaN for what is missing.
    recorded: DMatrix<f64>,
    /// The same at the mean supply currents, at the drives of the pool and without the terms above first order.
    readings: DMatrix<f64>,
    /// `ln` of each supply's factor off its mean, columns supplies.
    fluctuation: DMatrix<f64>,
    /// Noise of one frame's tune, of a tune that was read.
    tune_noise: [Option<f64>; 2],
}

/// A machine whose settings do not follow each other in time, and the same with its quadrupoles displaced so that the orbit without kicks is the one
/// that the monitors' baselines tell.
struct Displaced {
    machine: Machine,
    displaced: Machine,
    orbit: Vec<[f64; 2]>,
}

impl Displaced {
    /// `off`: by how much the orbit at each element is off the estimated one (x, y) [m], where a fit moves it at a sextupole or an octupole. The field is
    /// displaced against the orbit instead.
    fn from_machine(machine: &Machine, baseline: &Baseline, off: &[[f64; 2]]) -> Result<Self, OrbitError> {
        let machine = machine.without_memory();
        let mut displaced = machine.clone();
        baseline.displace(&mut displaced)?;
        // what a monitor misreads depends on the orbit there too, and that is the exact one
        let fields: Vec<usize> =
            (0..off.len()).filter(|&at| !matches!(machine.ring().elements[at].kind, Kind::Monitor)).collect();
        for &at in &fields {
            let misalignment = &mut displaced.ring_mut().elements[at].misalignment;
            (misalignment.dx, misalignment.dy) = (misalignment.dx - off[at][0], misalignment.dy - off[at][1]);
        }
        let mut orbit = displaced.orbit()?;
        fields.iter().for_each(|&at| (0..2).for_each(|plane| orbit[at][plane] += off[at][plane]));
        Ok(Self { machine, displaced, orbit })
    }

    /// What exact orbits have beyond [`Machine::readings`] in frames at some times.
    fn higher_orders(&self, exact: &Exact, time: &DVector<f64>) -> Result<HigherOrders, EffectError> {
        let means = Drives { orbit: self.orbit.clone(), ..exact.means.clone() };
        let (readings, tunes, tune_changes) = self.machine.readings(&means)?;
        let of_orbit = [exact.without_kicks.x - tunes.x, exact.without_kicks.y - tunes.y];
        let by_frame = &exact.settings.of_frame;
        let mut of_tunes = &exact.tunes - tune_changes;
        of_tunes.column_iter_mut().zip([tunes.x, tunes.y]).for_each(|(mut column, tune)| column.add_scalar_mut(-tune));
        let drifted = self.drifted(exact, of_orbit, time)?;
        Ok(HigherOrders {
            readings: (&exact.readings - readings).select_rows(by_frame),
            tunes: of_tunes.select_rows(by_frame) + drifted,
            tune_shift_of_orbit: of_orbit,
        })
    }

    /// The orbit without kicks drifts with the gradients, by a tenth where these do by 4 per mille, and with it what it does to the tunes: the change of that
    /// from mid-campaign, rows frames, by exact tunes at both ends.
    fn drifted(&self, exact: &Exact, of_orbit: [f64; 2], time: &DVector<f64>) -> Result<MatrixXx2<f64>, EffectError> {
        let Some(ends) = &exact.ends else { return Ok(MatrixXx2::zeros(time.len())) };
        let still = Drives {
            kick: DMatrix::zeros(2, exact.means.kick.ncols()),
            rf_offset: DVector::zeros(2),
            time: DVector::from_vec(vec![-1.0, 1.0]),
            nominal_kick: exact.means.nominal_kick,
            orbit: self.orbit.clone(),
        };
        let (_, tunes, changes) = self.machine.readings(&still)?;
        let drifted =
            |end: usize| [ends[end].x - tunes.x - changes[(end, 0)], ends[end].y - tunes.y - changes[(end, 1)]];
        let [start, end] = [drifted(0), drifted(1)];
        let change = |i: usize, plane: usize| change_at(time[i], [start[plane], of_orbit[plane], end[plane]]);
        Ok(MatrixXx2::from_fn(time.len(), change))
    }
}

/// What exact orbits have beyond first order, the same for all repeats.
struct HigherOrders {
    /// Terms above first order in kicks and RF offset, and those of the orbit without kicks, in which the dipoles' ends couple the planes; rows frames [m].
    readings: DMatrix<f64>,
    /// Kicks move the orbit in dipoles and sextupole fields, and the momentum where that is not held; the orbit without kicks is off the axis of sextupole
    /// fields, and couples the planes; rows frames. What kicks do above first order is that of mid-campaign, some 10 um that change by a tenth in a drift of 4 per
    /// mille.
    tunes: MatrixXx2<f64>,
    /// The part of these that the orbit without kicks makes.
    tune_shift_of_orbit: [f64; 2],
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
    /// Recordings of two machines.
    #[error("{first} and {other} are analysed together: expected the same {what} in both")]
    Apart {
        /// One of them.
        first: String,
        /// The other.
        other: String,
        /// What differs.
        what: &'static str,
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

/// Prior standard deviations of a var up to which its range reaches here, where it ends before: at two, unless the machine file says something else. A
/// quadrupole beyond its range would otherwise be told as a gradient in the dipole beside it (`out_of_range.rs`).
const REACH: f64 = 5.0;
/// Prior standard deviation of a baseline [m].
const BASELINE: f64 = 20e-3;
/// Whitened residual above which a reading of a faulty monitor is dropped.
const FAULTY: f64 = 4.0;
/// Passes over noise and readings that count, where the level of the noise changes.
const PASSES: usize = 3;
/// Fewest monitors, and fewest correctors, for a diagnosis.
pub const LEAST: usize = 4;

impl Data {
    /// Whiten a campaign.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn from_campaign(campaign: &Campaign) -> Result<Self, DataError> {
        if campaign.times.count() > 1 {
            let (recording, found) = (campaign.recording.name.clone(), campaign.times.to_string());
            return Err(DataError::Times { recording, found });
        }
        let Campaign { ring, recording, drives: driven, supplies, screened, readings: recorded, .. } = campaign;
        let mut drives = drives_of(campaign);
        let believed = recording.header.believed(ring)?;
        let at_supplies = ring.with_strengths(&ring.strengths(&[], supplies));
        let design = Machine::new(at_supplies, believed, &[])?;
        let of_momentum = |i: usize, plane: usize| drives.rf_offset[i] == 0.0 && !campaign.tunes[(i, plane)].is_nan();
        let mut recorded_tunes = DMatrix::from_fn(driven.len(), 2, |i, plane| {
            if of_momentum(i, plane) { campaign.tunes[(i, plane)] } else { f64::NAN }
        });
        let kicked_off = recorded - design.readings(&drives)?.0;
        let (orbit, baseline) =
            Baseline::from_readings(design.ring(), &kicked_off, screened, &recorded_tunes, campaign.spurious)?;
        drives.orbit = orbit;
        let close_tunes =
            CloseTunes::find(&Displaced::from_machine(&design, &baseline, &[])?.displaced, &recorded_tunes)?;
        if close_tunes.is_some() {
            recorded_tunes.fill(f64::NAN);
        }
        let shared = |b: usize| campaign.following_with_field(b).insert_column(0, BASELINE);
        let (noise, mut screened) = noise_of(campaign, &design, &drives)?;
        for &b in &noise.sound {
            let jumps = !noise.levels.is_constant() && left_aside(&screened.excluded, b) > JUMPS;
            screened.health[b].state = if jumps { MonitorState::Jumps } else { MonitorState::Ok };
        }
        let sharing: Vec<usize> = (0..recorded.ncols()).filter(|&b| noise.modes.row(b).amax() > 0.0).collect();
        let excluded = &screened.excluded;
        let has_same_monitors = |i: usize| sharing.iter().all(|&b| excluded.counts(i, b) == excluded.counts(i - 1, b));
        let is_like_before = |i: usize| noise.levels.at(i) == noise.levels.at(i - 1) && has_same_monitors(i);
        let pools = Pools::from_settings(&campaign.settings.repeatable, is_like_before);
        let of_pools = pools.drives(&drives);
        let header_noise = &recording.header.noise;
        let ramped = recording.header.ramp.at(campaign.times.known[0], supplies.len());
        let mut data = Self {
            name: recording.name.clone(),
            others: Vec::new(),
            momentum: ring.particle.momentum() * ramped.map_or(1.0, |at| at.momentum),
            ring: ring.clone(),
            units: Units::from_prior(&campaign.prior.reaching(REACH)),
            screened,
            supplies: supplies.clone(),
            readings: DMatrix::zeros(pools.count, recorded.ncols() + 2),
            shared: (0..recorded.ncols()).map(shared).collect(),
            baseline,
            tune_shift_of_orbit: [0.0; 2],
            close_tunes,
            mean_noise: header_noise.iter().sum::<f64>() / header_noise.len().max(1) as f64,
            centre: DVector::zeros(recorded.ncols() + 2),
            noise,
            channels: Vec::new(),
            mixing: Mixing::default(),
            believed,
            drift: 0.0,
            is_about_effects: false,
            settings: Settings::from_drives(&of_pools),
            drives: of_pools,
            pools,
            frames: Frames {
                drives,
                recorded: beside(recorded.clone(), &recorded_tunes),
                readings: beside(recorded.clone(), &recorded_tunes),
                fluctuation: campaign.fluctuation.clone(),
                tune_noise: [None; 2],
            },
        };
        data.prepare();
        data.check(recording)?;
        let orbit = data.drives.orbit.clone();
        data.linearise_about(&design, &orbit)?;
        Ok(data)
    }

    /// Linearise the recorded readings and tunes about a machine and the orbit without kicks that it has in the fit, (x, y) at every element [m]: subtract the
    /// effect of the supplies' fluctuations on the kicked orbit, to first order, and what exact orbits have above first order. The curvature of the bends makes the
    /// latter up to some 10 um for kicks of 0.2 mrad, more near an integer tune. What moves the tunes beyond first order is subtracted too. Returns the
    /// chi-square of the change of all.
    ///
    /// # Errors
    /// [`EffectError`] if the machine keeps no beam in one of the settings; the readings are then as they were.
    pub(crate) fn linearise_about(&mut self, machine: &Machine, orbit: &[[f64; 2]]) -> Result<f64, EffectError> {
        let frames = Drives { orbit: orbit.to_vec(), ..self.frames.drives.clone() };
        let means = Drives { orbit: orbit.to_vec(), ..self.drives.clone() };
        let within = machine.readings(&frames)?.0 - machine.readings(&means)?.0.select_rows(&self.pools.of_frame);
        let off: Vec<[f64; 2]> =
            orbit.iter().zip(&self.drives.orbit).map(|(own, one)| [own[0] - one[0], own[1] - one[1]]).collect();
        let displaced = Displaced::from_machine(machine, &self.baseline, &off)?;
        let exact = Exact::from_machine(&displaced.displaced, &self.frames.drives)?;
        let higher = displaced.higher_orders(&exact, &self.frames.drives.time)?;
        let slopes = Signatures::of(&machine.on_orbit(&frames.orbit), &frames)?.of_quadrupoles();
        let monitors = self.monitors();
        let mut readings = &self.frames.recorded - rippled(&self.ring, &slopes, &self.frames.fluctuation);
        let mut of_monitors = readings.columns_mut(0, monitors);
        of_monitors -= within + higher.readings;
        let mut of_tunes = readings.columns_mut(monitors, 2);
        of_tunes -= higher.tunes;
        self.tune_shift_of_orbit = higher.tune_shift_of_orbit;
        self.frames.readings = readings;
        let before = core::mem::replace(&mut self.readings, DMatrix::zeros(0, 0));
        self.prepare();
        Ok(self.whiten(|c, pool| self.readings[(pool, c)] - before[(pool, c)]).norm_squared())
    }

    /// Drop jumps that the screening accepted as the first reading of a setting: readings of faulty monitors that lie far from a fit, and single ones of any
    /// monitor, further off than all others of it and of its pool together, as nothing makes them that the machine does. True if there are any.
    pub fn trim(&mut self, residual: &DVector<f64>) -> bool {
        let places = self.places();
        let (mut of_pools, mut of_columns) = (vec![0.0; self.pools.count], vec![0.0; self.monitors() + 2]);
        for ((pool, c), r) in places.iter().zip(residual.iter()) {
            of_pools[*pool] += r * r;
            of_columns[*c] += r * r;
        }
        let is_jump = |((pool, c), r): &((usize, usize), &f64)| {
            let is_faulty = self.health().get(*c).is_some_and(|one| one.state != MonitorState::Ok);
            let rest = of_pools[*pool] + of_columns[*c] - 2.0 * *r * *r;
            *c < self.monitors() && (is_faulty && r.abs() > FAULTY || *r * *r > rest)
        };
        let dropped: Vec<(usize, usize)> =
            places.into_iter().zip(residual.iter()).filter(is_jump).map(|(place, _)| place).collect();
        for (frame, pool) in self.pools.of_frame.iter().enumerate() {
            for &(_, b) in dropped.iter().filter(|(dropped, _)| dropped == pool) {
                self.screened.excluded.exclude(frame, b, Excluded::Poor);
            }
        }
        if !dropped.is_empty() {
            self.prepare();
        }
        !dropped.is_empty()
    }

    /// The same recording with a known signal taken out of its readings and tunes, rows frames.
    pub fn less(&self, readings: &DMatrix<f64>, tunes: &DMatrix<f64>) -> Self {
        let mut data = self.clone();
        let signal = beside(readings.clone(), tunes);
        data.frames.readings -= &signal;
        data.frames.recorded -= signal;
        data.prepare();
        data
    }

    /// The same recording where all quadrupoles drift by `-amplitude` to `amplitude`: every baseline drifts with them.
    pub(crate) fn drifting(&self, amplitude: f64) -> Self {
        let mut data = self.clone();
        data.drift = amplitude;
        data.prepare();
        data.others.iter_mut().for_each(|other| *other = other.drifting(amplitude));
        data
    }

    /// The same recordings where one monitor wanders in one of them, or all do in all.
    pub(crate) fn wandering(&self, one: Option<(usize, usize)>, walk: Measured) -> Self {
        let mut data = self.clone();
        for campaign in 0..data.count() {
            let own = data.campaign_mut(campaign);
            match one {
                Some((wandering, monitor)) if wandering == campaign => own.noise.wandering.push((monitor, walk)),
                Some(_) => continue,
                None => own.noise.slow.walk = walk,
            }
            own.prepare();
        }
        data
    }

    /// A hypothetical campaign with other drives, by itself; its readings are ignored.
    pub(crate) fn driven_by(&self, drives: &Drives) -> Self {
        let (drives, settings) = (drives.clone(), Settings::from_drives(drives));
        let mut data = Self { drives, settings, others: Vec::new(), ..self.clone() };
        data.noise.levels = Levels::CONSTANT;
        data.prepare();
        data
    }

    /// Prepare the whitening of the readings that count, and pool them.
    fn prepare(&mut self) {
        let (columns, monitors) = (self.monitors() + 2, self.monitors());
        let time = &self.frames.drives.time;
        self.frames.tune_noise = [0, 1].map(|plane| {
            let tunes = self.frames.readings.column(monitors + plane);
            Meter::from_tunes(tunes.iter().zip(time.iter())).map(|meter| meter.noise)
        });
        self.readings = self.pools.means(&self.frames.readings, |frame, c| self.counts(frame, c));
        let frames = self.pools.frames();
        self.channels.clear();
        for c in 0..columns {
            let channel = self.channel(c, &frames);
            self.channels.push(channel);
        }
        let count = self.pools.counts(monitors, |frame, b| self.counts(frame, b));
        self.mixing = Mixing::from_modes(&self.noise.modes, &self.levels_of_pools(), |pool, b| count[(pool, b)] > 0.0);
        if !self.mixing.is_none() {
            let mean = |c: usize| {
                let rows = &self.channels[c].rows;
                rows.iter().map(|&pool| self.readings[(pool, c)]).sum::<f64>() / rows.len().max(1) as f64
            };
            self.centre = DVector::from_fn(columns, |c, _| if c < monitors { mean(c) } else { 0.0 });
        }
    }

    /// Level of the noise in each pool.
    fn levels_of_pools(&self) -> Vec<f64> {
        let mut levels = vec![1.0; self.pools.count];
        self.pools.of_frame.iter().enumerate().for_each(|(frame, &pool)| levels[pool] = self.noise.levels.at(frame));
        levels
    }

    /// Prepare a channel, from the frames of each pool.
    fn channel(&mut self, c: usize, frames: &[Vec<usize>]) -> Channel {
        let counting = |of_pool: &Vec<usize>| -> Vec<usize> {
            of_pool.iter().copied().filter(|&frame| self.counts(frame, c)).collect()
        };
        let all = frames.iter().map(counting).enumerate().filter(|(_, frames)| !frames.is_empty());
        let (rows, frames): (Vec<usize>, Vec<Vec<usize>>) = all.unzip();
        match c.checked_sub(self.monitors()) {
            None => {
                let common = self.common(c, &rows, &frames);
                let Noise { own, levels, .. } = &self.noise;
                Channel::from_frames(rows, &frames, (own[c], self.noise.memory(c), levels), common)
            }
            Some(plane) => {
                let common = DMatrix::from_element(rows.len(), 1, TUNE_CALIBRATION);
                let noise = self.frames.tune_noise[plane].unwrap_or(TUNE_CALIBRATION);
                Channel::from_frames(rows, &frames, (noise, Memory::NONE, &Levels::CONSTANT), common)
            }
        }
    }

    /// Common terms of a monitor's pooled readings, in standard deviations [rows][factors] [m], as far as the differences within pools do not
    /// tell them; what these tell is taken off the readings. `frames` of each row.
    fn common(&mut self, b: usize, rows: &[usize], frames: &[Vec<usize>]) -> DMatrix<f64> {
        let (all, sigma) = (&self.shared[b], self.noise.own[b]);
        let mean = |row: usize, k: usize| {
            frames[row].iter().map(|&frame| all[(frame, k)]).sum::<f64>() / frames[row].len() as f64
        };
        let means = DMatrix::from_fn(rows.len(), all.ncols(), mean);
        let each: Vec<(usize, usize)> =
            frames.iter().enumerate().flat_map(|(row, frames)| frames.iter().map(move |&frame| (row, frame))).collect();
        let readings =
            each.iter().map(|&(row, frame)| self.frames.readings[(frame, b)] - self.readings[(rows[row], b)]);
        let noise = DVector::from_fn(each.len(), |i, _| sigma * self.noise.levels.at(each[i].1));
        let readings = DVector::from_iterator(each.len(), readings).component_div(&noise);
        let terms =
            DMatrix::from_fn(each.len(), all.ncols(), |i, k| (all[(each[i].1, k)] - means[(each[i].0, k)]) / noise[i]);
        let (factors, root) = common_factors(&readings, &terms);
        let told = &means * factors;
        rows.iter().zip(&told).for_each(|(&pool, told)| self.readings[(pool, b)] -= told);
        self.drifting_with(b, rows, &self.drives, means * root)
    }

    /// With those of the RF frequency and the drift, at some rows of the drives.
    fn drifting_with(&self, b: usize, rows: &[usize], drives: &Drives, shared: DMatrix<f64>) -> DMatrix<f64> {
        let (plane, drift) = (usize::from(b >= self.ring.horizontal_monitors()), self.drift);
        let rf = DVector::from_iterator(rows.len(), rows.iter().map(|&i| drives.rf_offset[i]));
        let mut shared = beside(shared, &(&rf * self.baseline.spurious[plane]));
        let lengthened = rf.map(|offset| if offset == 0.0 { 0.0 } else { self.baseline.lengthened[b] });
        if lengthened.amax() > 0.0 {
            shared = beside(shared, &lengthened);
        }
        if drift == 0.0 {
            return shared;
        }
        // to second order in time: near an integer tune the orbit grows faster than the gradients drift
        let time = |power: i32| {
            let relative = (drift * self.baseline.sensitivity[plane]).powi(power) * self.baseline.rms[plane];
            DVector::from_iterator(rows.len(), rows.iter().map(|&i| drives.time[i].powi(power) * relative))
        };
        beside(beside(shared, &time(1)), &time(2))
    }

    fn check(&self, recording: &Recording) -> Result<(), DataError> {
        let enough = |what, expected, found| {
            if found >= expected {
                return Ok(());
            }
            Err(DataError::TooLittle { recording: recording.name.clone(), what, expected, found })
        };
        enough("monitors with enough readings that count", LEAST, self.active_monitors().len())?;
        enough("correctors that were moved", LEAST, self.driven_correctors().len())
    }

    /// Correctors that were moved, by index.
    pub fn driven_correctors(&self) -> Vec<usize> {
        (0..self.drives.kick.ncols()).filter(|&c| self.settings.moves(c)).collect()
    }

    /// Monitors that have readings which count, by index.
    pub fn active_monitors(&self) -> Vec<usize> {
        (0..self.monitors()).filter(|&b| self.channels[b].rows.len() > self.channels[b].factors()).collect()
    }

    /// Number of monitors that are read.
    pub fn monitors(&self) -> usize {
        self.shared.len()
    }

    /// Number of whitened numbers.
    pub fn size(&self) -> usize {
        self.channels.iter().map(|c| c.rows.len()).sum()
    }

    /// `ln` of the determinant of the covariance.
    pub(crate) fn log_det(&self) -> f64 {
        // the tune meter's noise is not compared
        self.channels[..self.monitors()].iter().map(|c| c.log_det).sum::<f64>() + self.mixing.log_det()
    }

    /// Whitened residuals: readings and tunes less those predicted.
    pub fn residual(&self, predicted: &Signature) -> DVector<f64> {
        self.whiten(|c, pool| {
            self.nearest(c, self.readings[(pool, c)] - self.centre[c] - self.effect_on(predicted, c, pool))
        })
    }

    /// A difference of tunes up to an integer.
    fn nearest(&self, c: usize, miss: f64) -> f64 {
        if c < self.monitors() { miss } else { miss - miss.round() }
    }

    /// What a signature does to the reading of a monitor [m], or to a tune, in a pool.
    pub(super) fn effect_on(&self, signature: &Signature, c: usize, pool: usize) -> f64 {
        match c.checked_sub(self.monitors()) {
            None => signature.readings[(pool, c)],
            Some(plane) => signature.tune(plane, pool),
        }
    }

    /// Pooled readings [m] and tunes [1] as columns, less those predicted, for a tune modulo 1; not a number where none counts.
    pub fn miss(&self, predicted: &DMatrix<f64>) -> DMatrix<f64> {
        let mut miss = DMatrix::from_element(predicted.nrows(), predicted.ncols(), f64::NAN);
        for (c, channel) in self.channels.iter().enumerate() {
            for &pool in &channel.rows {
                miss[(pool, c)] = self.nearest(c, self.readings[(pool, c)] - predicted[(pool, c)]);
            }
        }
        miss
    }

    /// A signature, whitened.
    pub fn signature(&self, signature: &Signature) -> DVector<f64> {
        self.whiten(|c, pool| self.effect_on(signature, c, pool))
    }

    /// Several signatures, whitened, one a column; columns of none stay 0. All columns of a channel at once are several times as fast as one by one.
    pub(crate) fn signatures<E>(
        &self,
        mut into: DMatrixViewMut<f64>,
        signatures: impl Iterator<Item = Result<Option<Signature>, E>>,
    ) -> Result<(), E> {
        for (mut column, signature) in into.column_iter_mut().zip(signatures) {
            if let Some(signature) = signature? {
                self.stack(&mut column, |c, pool| self.effect_on(&signature, c, pool));
            }
        }
        self.whiten_stacked(into);
        Ok(())
    }

    /// Whiten stacked columns.
    fn whiten_stacked(&self, mut all: DMatrixViewMut<f64>) {
        for (channel, rows) in self.channels.iter().zip(self.rows_of_channels()) {
            channel.whiten_mut(all.rows_range_mut(rows));
        }
    }

    /// Numbers of the channels, one for each pool, whitened: channel by channel.
    fn whiten(&self, value: impl Fn(usize, usize) -> f64) -> DVector<f64> {
        let mut all = DMatrix::zeros(self.size(), 1);
        self.stack(&mut all.column_mut(0), value);
        self.whiten_stacked(all.as_view_mut());
        all.column(0).into_owned()
    }

    /// Numbers of the channels over the noise of each, channel by channel, without the noise in common.
    fn stack(&self, all: &mut DVectorViewMut<f64>, value: impl Fn(usize, usize) -> f64) {
        let monitors = self.monitors();
        let mut mixed = DMatrix::zeros(if self.mixing.is_none() { 0 } else { self.pools.count }, monitors);
        if !self.mixing.is_none() {
            for (b, channel) in self.channels[..monitors].iter().enumerate() {
                channel.rows.iter().for_each(|&pool| mixed[(pool, b)] = value(b, pool) / channel.sigma);
            }
            self.mixing.apply(&mut mixed);
        }
        let is_mixed = |c: usize| c < monitors && !self.mixing.is_none();
        for ((c, channel), rows) in self.channels.iter().enumerate().zip(self.rows_of_channels()) {
            let number = |pool: usize| if is_mixed(c) { mixed[(pool, c)] } else { value(c, pool) / channel.sigma };
            all.rows_range_mut(rows).iter_mut().zip(&channel.rows).for_each(|(to, &pool)| *to = number(pool));
        }
    }

    /// The whitened numbers of each channel.
    fn rows_of_channels(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        following(self.channels.iter().map(|channel| channel.rows.len())).into_iter()
    }

    /// Whitened numbers, one set a column, with the noise in common taken out once more: the product of what only one monitor would read
    /// with them is then that with all that it would leave in the others.
    pub(crate) fn taken_back(&self, whitened: &DMatrix<f64>) -> DMatrix<f64> {
        let mut back = whitened.clone();
        if self.mixing.is_none() {
            return back;
        }
        // the monitors' are the first
        let places: Vec<(usize, usize)> = self.places().into_iter().filter(|(_, c)| *c < self.monitors()).collect();
        for mut column in back.column_iter_mut() {
            let mut values = DMatrix::zeros(self.pools.count, self.monitors());
            places.iter().zip(column.iter()).for_each(|(place, number)| values[*place] = *number);
            self.mixing.apply(&mut values);
            places.iter().zip(column.iter_mut()).for_each(|(place, number)| *number = values[*place]);
        }
        back
    }

    /// Pool and channel (a monitor, or a tune after the last of them) of each whitened number.
    pub fn places(&self) -> Vec<(usize, usize)> {
        let places_of_channel =
            |(c, channel): (usize, &Channel)| channel.rows.iter().map(|&pool| (pool, c)).collect::<Vec<_>>();
        self.channels.iter().enumerate().flat_map(places_of_channel).collect()
    }

    /// Noise of each whitened number [m], of a tune [1]: that of the mean of its pool.
    pub fn noise_of_means(&self) -> Vec<f64> {
        let noise_of_channel =
            |channel: &Channel| (channel.noise_of_means() * channel.sigma).iter().copied().collect::<Vec<_>>();
        self.channels.iter().flat_map(noise_of_channel).collect()
    }

    /// Readings of a tune in each pool that has some.
    pub fn tune_pools(&self, plane: usize) -> Vec<(usize, f64)> {
        let channel = &self.channels[self.monitors() + plane];
        channel.rows.iter().copied().zip(channel.readings().iter().copied()).collect()
    }

    /// First of a channel's whitened numbers.
    pub fn start(&self, c: usize) -> usize {
        self.channels[..c].iter().map(|channel| channel.rows.len()).sum()
    }

    /// Sum of squares of measured less predicted readings, frame by frame, over the noise as learnt, about all that a monitor's readings have in
    /// common, and its degrees of freedom; of the monitors in state ok. `predicted`: rows pools.
    pub fn chi_square(&self, predicted: &DMatrix<f64>) -> (f64, f64) {
        let (monitors, frames) = (self.monitors(), self.pools.of_frame.len());
        let mut values = DMatrix::zeros(frames, monitors);
        for (frame, &pool) in self.pools.of_frame.iter().enumerate() {
            for b in (0..monitors).filter(|&b| self.counts(frame, b)) {
                let miss = self.frames.readings[(frame, b)] - predicted[(pool, b)];
                values[(frame, b)] = (miss - self.centre[b]) / self.channels[b].sigma;
            }
        }
        let levels: Vec<f64> = (0..frames).map(|frame| self.noise.levels.at(frame)).collect();
        Mixing::from_modes(&self.noise.modes, &levels, |frame, b| self.counts(frame, b)).apply(&mut values);
        let is_ok = |b: &usize| self.health()[*b].state == MonitorState::Ok;
        let mut sums = (0.0, 0.0);
        for b in self.active_monitors().into_iter().filter(is_ok) {
            let rows: Vec<usize> = (0..frames).filter(|&frame| self.counts(frame, b)).collect();
            let shared = self.shared[b].select_rows(&rows);
            let mut terms = self.drifting_with(b, &rows, &self.frames.drives, shared) / self.channels[b].sigma;
            terms.column_mut(0).fill(1.0);
            let mut residual = values.select_rows(&rows).columns(b, 1).into_owned();
            let each: Vec<&[usize]> = rows.chunks(1).collect();
            let filter = Filter::from_pools(self.noise.memory(b), &self.noise.levels, rows[0], &each);
            filter.whiten_columns(&mut terms);
            filter.whiten_columns(&mut residual);
            let (chi2, freedom) = chi_square(&residual.column(0).into_owned(), &terms.transpose(), 1, 1.0);
            sums = (sums.0 + chi2, sums.1 + freedom);
        }
        sums
    }

    /// Whiten columns over all pools as readings of one channel.
    pub(crate) fn whiten_columns(&self, c: usize, columns: &DMatrix<f64>) -> DMatrix<f64> {
        let channel = &self.channels[c];
        channel.whiten(columns.select_rows(&channel.rows) / channel.sigma)
    }

    /// What a monitor's readings tell beside those of the others in the same frames, as a share of what they tell alone, on average.
    pub(crate) fn own_share(&self, b: usize) -> f64 {
        let rows = &self.channels[b].rows;
        if self.mixing.is_none() || rows.is_empty() || b >= self.monitors() {
            return 1.0;
        }
        rows.iter().map(|&pool| self.mixing.own(pool, b)).sum::<f64>() / rows.len() as f64
    }

    /// What a pattern over some monitors [m] has to be multiplied by, monitor by monitor, with [`Data::own_share`]: itself with what it leaves
    /// in each by the noise in common.
    pub(crate) fn accompanied(&self, monitors: &[usize], pattern: &DVector<f64>) -> DVector<f64> {
        let row = DMatrix::from_rows(&[pattern.transpose()]);
        self.accompanied_at(&[1.0], monitors, &row).row(0).transpose()
    }

    /// The same in every run of a setting: rows pools.
    pub(crate) fn accompanied_in_runs(&self, monitors: &[usize], patterns: &DMatrix<f64>) -> DMatrix<f64> {
        self.accompanied_at(&self.levels_of_pools(), monitors, patterns)
    }

    /// The same at the level of the noise in each row.
    fn accompanied_at(&self, levels: &[f64], monitors: &[usize], patterns: &DMatrix<f64>) -> DMatrix<f64> {
        if self.mixing.is_none() {
            return patterns.clone();
        }
        let mixing = Mixing::from_modes(&self.noise.modes, levels, |_, b| monitors.contains(&b));
        let mut all = DMatrix::zeros(patterns.nrows(), patterns.ncols());
        monitors.iter().for_each(|&b| all.set_column(b, &(patterns.column(b) / self.channels[b].sigma)));
        mixing.apply(&mut all);
        mixing.apply(&mut all);
        DMatrix::from_fn(all.nrows(), all.ncols(), |run, b| all[(run, b)] * self.channels[b].sigma / mixing.own(run, b))
    }

    /// Signatures that step with time, whitened: of each signature all steps, rows pools, one a column.
    pub(crate) fn stepping(&self, signatures: &[Signature], steps: &DMatrix<f64>) -> DMatrix<f64> {
        let each = signatures.iter().flat_map(|signature| steps.column_iter().map(move |step| (signature, step)));
        let mut all = DMatrix::zeros(self.size(), signatures.len() * steps.ncols());
        for (mut column, (signature, step)) in all.column_iter_mut().zip(each) {
            self.stack(&mut column, |c, pool| self.effect_on(signature, c, pool) * step[pool]);
        }
        self.whiten_stacked(all.as_view_mut());
        all
    }

    /// `E^T S^-1 E` of a monitor's readings for groups of pools, of which `group` names that of each pool, as if the noise were white:
    /// `diag(alone) - common common^T`, the latter of their common terms. Returns both, [groups] and [groups][factors].
    pub(crate) fn information(&self, b: usize, group: &[usize], groups: usize) -> (DVector<f64>, DMatrix<f64>) {
        let channel = &self.channels[b];
        let (share, per) = (self.own_share(b), channel.sigma.powi(-2));
        let taken = channel.taken() * (share.sqrt() / channel.sigma);
        let (mut alone, mut common) = (DVector::zeros(groups), DMatrix::zeros(groups, taken.ncols()));
        for ((row, readings), &pool) in taken.row_iter().zip(&channel.readings()).zip(&channel.rows) {
            alone[group[pool]] += share * per * readings;
            let mut common = common.row_mut(group[pool]);
            common += row;
        }
        (alone, common)
    }

    /// A reading of a monitor as recorded [m], not a number where there is none.
    pub fn recorded(&self, frame: usize, b: usize) -> f64 {
        self.frames.recorded[(frame, b)]
    }

    /// True if a frame's reading of a monitor was put aside: it is there, and does not count.
    pub(crate) fn is_aside(&self, frame: usize, b: usize) -> bool {
        self.screened.excluded.is_aside(frame, b)
    }

    /// True if a frame's reading of a monitor, or of a tune after the last of them, counts.
    fn counts(&self, frame: usize, c: usize) -> bool {
        match c.checked_sub(self.monitors()) {
            None => self.screened.excluded.counts(frame, c),
            Some(plane) => !self.frames.readings[(frame, c)].is_nan() && self.frames.tune_noise[plane].is_some(),
        }
    }

    /// True if a monitor's noise remembers the frames before.
    pub(crate) fn remembers(&self, b: usize) -> bool {
        !self.noise.memory(b).is_none()
    }

    /// Noise of one reading of the tune meter [1], if there are enough readings.
    pub fn tune_noise(&self, plane: usize) -> Option<f64> {
        self.frames.tune_noise[plane]
    }

    /// State of the monitors.
    pub fn health(&self) -> &[Health] {
        &self.screened.health
    }
}

/// The noise, learnt from the readings about the machine that the screening ends with, or about the design where that keeps no beam; and which
/// readings count by that noise.
fn noise_of(campaign: &Campaign, design: &Machine, drives: &Drives) -> Result<(Noise, Screened), DataError> {
    let ring = &campaign.ring;
    let found = ring.with_strengths(&ring.strengths(campaign.params.as_slice(), &campaign.supplies));
    let found = Machine::new(found, Rf::FixedMomentum, &[]).ok();
    let predicted_by = |machine: &Machine| -> Result<_, OrbitError> {
        let optics = Optics::of(machine.ring(), Hold::Momentum { delta: 0.0 })?;
        let dispersion = optics.dispersion_of(&optics.read_monitors());
        Ok((machine.readings(drives)?.0, dispersion, Shape::all(&optics, machine.ring())?))
    };
    let known = found.as_ref().and_then(|machine| predicted_by(machine).ok());
    let (predicted, dispersion, shapes) = known.map_or_else(|| predicted_by(design), Ok)?;
    let residual = &campaign.readings - predicted;
    let source = Source { campaign, residual: &residual, dispersion: &dispersion, shapes: &shapes };
    let (mut noise, mut screened) = (Noise::learn(&source), campaign.screened.clone());
    // with the readings that were put aside for their size the noise is larger, and more of them are what it makes
    for _ in 0..PASSES {
        let again = if noise.levels.is_constant() { campaign.screened.clone() } else { readmitted(&source, &noise) };
        if again == screened {
            break;
        }
        let mut counting = campaign.clone();
        counting.screened.clone_from(&again);
        noise = Noise::learn(&Source { campaign: &counting, ..source });
        screened = again;
    }
    Ok((noise, screened))
}

/// What the supplies' fluctuations off their means do to the kicked orbits and the tunes, to first order, rows frames, columns monitors [m] and
/// the two tunes; `slopes`: by each quadrupole.
pub(super) fn rippled(ring: &Ring, slopes: &[Signature], fluctuation: &DMatrix<f64>) -> DMatrix<f64> {
    let monitors = ring.read_monitors.len();
    let mut moved = DMatrix::zeros(fluctuation.nrows(), monitors + 2);
    for (slope, quadrupole) in slopes.iter().zip(&ring.quadrupoles) {
        let Some(supply) = quadrupole.supply else { continue };
        let off = fluctuation.column(supply);
        for (b, column) in slope.readings.column_iter().enumerate() {
            let mut of_monitor = moved.column_mut(b);
            of_monitor += off.component_mul(&column);
        }
        let mut of_tunes = moved.columns_mut(monitors, 2);
        of_tunes += off * RowVector2::from(slope.tunes);
    }
    moved
}

/// What drove the beam, frame by frame, on a straight orbit.
pub(super) fn drives_of(campaign: &Campaign) -> Drives {
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
/// Ranges of some lengths, one after the other.
pub fn following(lengths: impl Iterator<Item = usize>) -> Vec<Range<usize>> {
    lengths
        .scan(0, |end, length| {
            let start = *end;
            *end += length;
            Some(start..*end)
        })
        .collect()
}
