//! One recording of one ring, assembled once: drives, accepted readings, measured tunes.
//!
//! Everything that fits, samples or diagnoses a recording starts from here. Sizes come from the ring; none is the core's.

mod common_terms;
mod exclusion;
mod idle;
mod linearisation;
mod meter;
mod normal_equations;
mod read_back;
mod screen;
mod setting;
mod times;

use core::f64::consts::SQRT_2;

use estimator::MonitorState;
use nalgebra::{DMatrix, DVector};
use twin::{Hold, Machine, Optics, OrbitError, Ring, SHARED, ripple_of_misaligned, spurious_dispersion};

use crate::base_model::BaseModel;
use crate::prior::Prior;
use crate::recording::{self, Drive, Recording};

pub use common_terms::chi_square;
pub(crate) use common_terms::{Common, Eliminated, Weighed};
pub use exclusion::{Excluded, Exclusions};
pub use linearisation::rf_orbit;
pub(crate) use linearisation::{AtTimes, Linearised};
pub use meter::{Meter, TUNE_CALIBRATION};
pub(crate) use normal_equations::{Normal, Terms};
use read_back::Repeats;
pub use screen::Screened;
use screen::{Groups, Screener, Seen, rms_by_plane};
pub use setting::{Setting, Settings};
pub use times::{Stray, Times, furthest_stray};

/// A recording and what follows from it before any fit.
#[derive(Debug, Clone)]
pub struct Campaign {
    /// The ring as designed, powered as the recording has it.
    pub ring: Ring,
    /// The same, with what the header believes to be held.
    pub held: Machine,
    /// The recording.
    pub recording: Recording,
    /// What is known of the params beforehand.
    pub prior: Prior,
    /// What drove the beam in each frame.
    pub drives: Vec<Drive>,
    /// Time of each frame, from -1 to 1.
    pub time: Vec<f64>,
    /// Mean `ln` of each supply's factor [F].
    pub supplies: Vec<f64>,
    /// `ln` of each supply's factor off its mean, rows frames, columns supplies.
    pub fluctuation: DMatrix<f64>,
    /// Frames grouped by their time in the cycle.
    pub times: Times,
    /// Frames grouped by setting.
    pub settings: Settings,
    /// Readings as recorded, rows frames, columns monitors; not a number where a monitor did not report [m].
    pub readings: DMatrix<f64>,
    /// Fractional tunes as recorded, rows frames, columns x and y; not a number where the meter did not report [1].
    pub tunes: DMatrix<f64>,
    /// Measured tunes, at the mean supply currents and without an RF offset.
    pub meters: [Option<Meter>; 2],
    /// Which readings count, and the state of the monitors.
    pub screened: Screened,
    /// The params that the screening ends with: a first guess.
    pub params: DVector<f64>,
    /// Rms of the baselines at these, in x and y [m].
    pub orbit: [f64; 2],
    /// Rms change of a misaligned ring's orbit per unit of RF offset and of rms orbit, in x and y, at `params`: towards an integer tune
    /// it grows, to twice that of the Booster's design at 4.87.
    pub spurious: [f64; 2],
    /// Standard deviation of a baseline's change per `ln` of each supply, in x and y: of a misaligned ring with the orbit and the tunes
    /// of this one [F] [m].
    pub ripple: Vec<[f64; 2]>,
    /// `ln` of the dipoles' field off its mean, frame by frame; none where their current is not read.
    field: Option<Vec<f64>>,
    /// What the read monitors see per `ln` of it while the RF frequency is held [B] [m].
    of_field: Vec<f64>,
}

/// Times that a recording is screened anew with another share of the read-backs' scatter, and the change of it below which that is not worth it.
const PASSES: usize = 3;
const SAME: f64 = 0.02;

impl Campaign {
    /// Assemble and screen a recording of a ring, with the priors of its params.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring as designed, or displaced by a fraction of a millimetre, has no stable orbit.
    ///
    /// # Panics
    /// If the recording is of another ring.
    pub fn of(ring: &Ring, recording: &Recording) -> Result<Self, OrbitError> {
        let ring = recording.powered(ring).into_owned();
        let believed = recording.header.believed(&ring).expect("the header is checked against its ring");
        let held = Machine::new(ring.clone(), believed, &[]).expect("there is no effect");
        let as_read = recording.drives();
        let supplies = recording::mean_supplies(&as_read);
        let times = Times::in_recording(recording);
        let settings = Settings::from_frames(&as_read, &times.of_frame, recording.nominal_kick());
        let (readings, tunes) = (readings(recording), tunes(recording));
        let (prior, of_design) = (Prior::from_ring(&ring), spurious_dispersion(&ring)?);
        let (of_beam, sharing) = (of_beam(recording, &readings), setting::sharing(&as_read));
        let screen = |drives: &[Drive]| {
            let screener = Screener {
                held: &held,
                ring: &ring,
                prior: &prior,
                drives,
                supplies: &supplies,
                times: &times,
                settings: &settings,
                groups: Groups::from_settings(drives, &times, &settings),
                readings: &of_beam,
                excluded: excluded(recording, &readings),
                noise: &recording.header.noise,
                sharing: &sharing,
                // each of two opposite offsets is given one of its own
                spurious: of_design.map(|rms| SHARED * SQRT_2 * rms),
            };
            screener.run()
        };
        let steady = read_back::followed(&as_read, &settings, 0.0);
        let (mut drives, mut followed, mut seen) = (as_read.clone(), 1.0, screen(&as_read)?);
        for _ in 0..PASSES {
            let noise: Vec<f64> = seen.screened.health.iter().map(|health| f64::from(health.weighted_as)).collect();
            let orbits = [&as_read, &steady].map(|drives| seen.linearised.orbits(drives));
            let repeats = Repeats::learn(&settings, &of_beam, orbits.each_ref(), &noise);
            let share = repeats.share();
            if (share - followed).abs() < SAME {
                break;
            }
            drives = read_back::followed(&as_read, &settings, share);
            (followed, seen) = (share, screen(&drives)?);
        }
        let Seen { screened, params, linearised, baselines } = seen;
        let orbit = rms_by_plane(&ring, &baselines);
        let found = ring.with_strengths(&ring.strengths(params.as_slice(), &supplies));
        let ripple = ripple_of_misaligned(&found)?;
        let optics = Optics::of(&found, Hold::Momentum { delta: 0.0 })?;
        let per_field = optics.momentum_per_field();
        let of_field = optics.dispersion_of(&optics.read_monitors()).iter().map(|d| d * per_field).collect();
        // next to a resonance a misaligned ring may have no orbit
        let spurious = spurious_dispersion(&found).unwrap_or(of_design);
        let mut campaign = Self {
            meters: [None, None],
            ripple: ripple.iter().map(|ratio| [0, 1].map(|plane| ratio[plane] * orbit[plane])).collect(),
            fluctuation: DMatrix::from_fn(drives.len(), supplies.len(), |i, f| drives[i].strength[f] - supplies[f]),
            orbit,
            time: recording.times(),
            recording: recording.clone(),
            ring,
            held,
            prior,
            drives,
            supplies,
            times,
            settings,
            readings,
            tunes,
            screened,
            params,
            spurious,
            field: fields(recording),
            of_field,
        };
        campaign.meters = campaign.read_meters(&linearised);
        Ok(campaign)
    }

    /// The readings without those of frames that had no beam, rows frames, columns monitors [m].
    pub fn readings_of_beam(&self) -> DMatrix<f64> {
        of_beam(&self.recording, &self.readings)
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.drives.len()
    }

    /// Number of monitors.
    pub fn monitors(&self) -> usize {
        self.readings.ncols()
    }

    /// True if a reading counts.
    pub fn counts(&self, frame: usize, b: usize) -> bool {
        self.screened.excluded.counts(frame, b)
    }

    /// Noise as which a reading of a monitor is weighted [m].
    pub fn noise(&self, b: usize) -> f64 {
        f64::from(self.screened.health[b].weighted_as)
    }

    /// True for a monitor in state ok.
    pub fn is_ok(&self, b: usize) -> bool {
        self.screened.health[b].state == MonitorState::Ok
    }

    /// 0 for a monitor that reads x, 1 for one that reads y.
    pub fn plane(&self, b: usize) -> usize {
        usize::from(b >= self.ring.horizontal_monitors())
    }

    /// How the baseline of a monitor follows the supplies: its change in each frame by each of them, in standard deviations. Misaligned
    /// quadrupoles make the orbit without kicks, and their supplies' ripple moves it, which way only the unknown misalignments
    /// could tell, rows frames, columns supplies [m].
    pub fn following(&self, b: usize) -> DMatrix<f64> {
        let mut following = self.fluctuation.clone();
        let sigma = self.ripple.iter().map(|sigma| sigma[self.plane(b)]);
        following.column_iter_mut().zip(sigma).for_each(|(mut column, sigma)| column *= sigma);
        following
    }

    /// The same, and in one more column how it follows the dipoles' field if the RF frequency is held instead of the momentum.
    pub fn following_with_field(&self, b: usize) -> DMatrix<f64> {
        let following = self.following(b);
        let Some(field) = &self.field else { return following };
        let last = following.ncols();
        let mut all = following.insert_column(last, 0.0);
        all.column_mut(last).iter_mut().zip(field).for_each(|(to, field)| *to = self.of_field[b] * field);
        all
    }

    /// Coefficients of what a monitor's readings have in common, a column for each frame: 1 for the baseline at its time in the cycle and
    /// 0 for those at others, then how it follows each supply, and the dispersion of the unknown misalignments at the frame's RF offset;
    /// these in standard deviations [m].
    pub(crate) fn terms(&self, b: usize) -> DMatrix<f64> {
        let plane = self.plane(b);
        let spurious = SHARED * self.spurious[plane] * self.orbit[plane];
        let following = self.following(b).transpose();
        let times = self.times.count();
        let mut terms = DMatrix::zeros(times + following.nrows() + 1, self.frames());
        self.times.of_frame.iter().enumerate().for_each(|(i, time)| terms[(*time, i)] = 1.0);
        terms.rows_mut(times, following.nrows()).copy_from(&following);
        let offsets = self.drives.iter().map(|drive| spurious * drive.rf_offset);
        terms.row_mut(times + following.nrows()).iter_mut().zip(offsets).for_each(|(to, offset)| *to = offset);
        terms
    }

    /// Linearised about params and, after them, amplitudes of a base model, at the supplies of each time in the cycle.
    ///
    /// # Errors
    /// [`OrbitError`] if there is no stable ring.
    pub(crate) fn linearised(&self, base: BaseModel, params: &DVector<f64>) -> Result<AtTimes, OrbitError> {
        AtTimes::new((&self.held, base), params, &self.supplies, &self.drives, &self.times)
    }

    /// True if any reading counts.
    pub fn has_readings(&self) -> bool {
        self.screened.excluded.counting().iter().any(|counts| *counts)
    }

    /// The meter's tunes of the frames without an RF offset, the supplies' fluctuations taken out to first order.
    fn read_meters(&self, linearised: &Linearised) -> [Option<Meter>; 2] {
        let at_mean = |plane: usize| -> Vec<f64> {
            let slopes = linearised.tune_supply_slopes.row(plane).transpose();
            let supplies = DVector::from_column_slice(&self.supplies);
            let frame = |(i, drive): (usize, &Drive)| {
                let moved = slopes.dot(&(&drive.strength - &supplies));
                if drive.rf_offset == 0.0 { self.tunes[(i, plane)] - moved } else { f64::NAN }
            };
            self.drives.iter().enumerate().map(frame).collect()
        };
        [0, 1].map(|plane| Meter::from_tunes(at_mean(plane).iter().zip(&self.time)))
    }
}

fn readings(recording: &Recording) -> DMatrix<f64> {
    let rows = &recording.rows;
    let monitors = rows.first().map_or(0, |row| row.reading.len());
    DMatrix::from_fn(rows.len(), monitors, |i, b| rows[i].reading[b].unwrap_or(f64::NAN))
}

/// Readings without those of frames that had no beam.
fn of_beam(recording: &Recording, readings: &DMatrix<f64>) -> DMatrix<f64> {
    let mut readings = readings.clone();
    without_beam(recording).for_each(|frame| readings.row_mut(frame).fill(f64::NAN));
    readings
}

/// What is known before the screening: readings that are missing, and those of frames that had no beam.
fn excluded(recording: &Recording, readings: &DMatrix<f64>) -> Exclusions {
    let mut excluded = Exclusions::from_readings(readings);
    without_beam(recording).for_each(|frame| excluded.exclude_frame(frame, Excluded::LostBeam));
    excluded
}

fn without_beam(recording: &Recording) -> impl Iterator<Item = usize> {
    recording.rows.iter().enumerate().filter(|(_, row)| row.is_without_beam()).map(|(frame, _)| frame)
}

fn tunes(recording: &Recording) -> DMatrix<f64> {
    let rows = &recording.rows;
    DMatrix::from_fn(rows.len(), 2, |i, plane| rows[i].tune[plane].unwrap_or(f64::NAN))
}

/// `ln` of the dipoles' field off its mean in each frame; none where their current is not read.
fn fields(recording: &Recording) -> Option<Vec<f64>> {
    let logs = recording.rows.iter().map(|row| recording::field(&recording.header, row).map(f64::ln));
    let logs = logs.collect::<Option<Vec<f64>>>()?;
    let mean = logs.iter().sum::<f64>() / logs.len() as f64;
    Some(logs.into_iter().map(|log| log - mean).collect())
}
