//! A recording as the core sees it: wire frames, and a model made of its header.

mod estimate;
mod held;
mod setup;
mod spread;
mod steering;

use core::fmt;

use estimator::surrogate::Unstable;
use estimator::{
    CurrentCode, FitQuality, FrameError, IngestError, IntensityCode, Layout, MagnetCurrents, Mask, PositionCode,
    Prepared, RfCode, Sizes, StateError, TuneCode,
};
use training::rooms::{largest, ramped};
use training::{Tables, in_room, in_spare_room};
use twin::Ring;

use crate::recording::{Recording, Row};

pub use estimate::Estimate;
pub use estimator::Walk;
use held::{Held, Stream};
pub use setup::{FOLLOW, Setup, setup, walk_per_cycle};
pub use spread::Spread;
pub use steering::{Correction, Feedback, Role};

/// Why a recording cannot be put on the wire.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StreamError {
    /// A value that no frame can carry.
    #[error("{recording}, frame {sequence}: {what} {value} is beyond what a frame can carry")]
    Range {
        /// The recording.
        recording: String,
        /// The frame.
        sequence: u32,
        /// Which value.
        what: &'static str,
        /// The value, SI.
        value: f64,
    },
    /// The header's transfer polynomial is longer than the core's.
    #[error("{recording}: quad_transfer has {found} coefficients, at most 6 are used")]
    Transfer {
        /// The recording.
        recording: String,
        /// How many it has.
        found: usize,
    },
    /// Encoding failed.
    #[error("{recording}, frame {sequence}: {source}")]
    Encode {
        /// The recording.
        recording: String,
        /// The frame.
        sequence: u32,
        /// Why.
        source: FrameError,
    },
    /// The core refused a frame.
    #[error("{recording}, frame {sequence}: {source}")]
    Ingest {
        /// The recording.
        recording: String,
        /// The frame.
        sequence: u32,
        /// Why.
        source: IngestError,
    },
    /// The network is that of another ring.
    #[error(transparent)]
    Network(#[from] training::network::OtherRing),
    /// No tables for this ring.
    #[error(transparent)]
    Training(#[from] training::TrainingError),
    /// Tables of a ring that keeps no beam at vars of 1.
    #[error("the model's tables have no stable ring at vars of 1")]
    Unstable,
}

/// A core on the host for a ring of any size, with the model that it uses: the core of exactly the ring's sizes if there is one,
/// else the smallest with room for it, see [`training::rooms`]. With a ramp it has baselines for four times in the cycle, if the ring
/// is not larger than that room; else for one, and frames of others are refused.
#[derive(Clone)]
pub struct Core {
    /// The ring.
    pub tables: Tables,
    /// What else is known beforehand.
    pub setup: Setup,
    stream: Box<dyn Stream>,
}

impl Core {
    /// The core at its prior.
    ///
    /// # Errors
    /// [`StreamError`] if there is no core for the ring.
    pub fn try_new(ring: &Ring, setup: Setup) -> Result<Self, StreamError> {
        Self::with_tables(training::green::tables(ring)?, setup)
    }

    /// The core at its prior, with other tables than a design's: those of [`training::extended`], or from a file.
    ///
    /// # Errors
    /// [`StreamError::Unstable`].
    pub fn with_tables(tables: Tables, setup: Setup) -> Result<Self, StreamError> {
        let stream = if setup.ramp.is_empty() || !ramped::SIZES.hold(&tables.sizes()) {
            in_room!(tables.sizes(), |room| Held::<room::Estimator, room::Steer>::boxed(&tables, &setup))
        } else {
            Some(Held::<ramped::Estimator, ramped::Steer>::boxed(&tables, &setup))
        };
        Self::holding(tables, setup, stream)
    }

    /// The core at its prior, whose orbits of kicks and their derivatives are those of the trained network; the rest is the tables'.
    ///
    /// # Errors
    /// [`StreamError::Network`] for a ring that it was not trained on, [`StreamError::Unstable`].
    pub fn with_network(ring: &Ring, tables: Tables, setup: Setup) -> Result<Self, StreamError> {
        training::network::expect_known(ring)?;
        let stream = Held::<training::network::Estimator, training::network::Steer>::boxed(&tables, &setup);
        Self::holding(tables, setup, Some(stream))
    }

    /// False if the model was linearised outside the range that it was made for. See [`estimator::Estimator::is_within`].
    pub fn is_within(&self) -> bool {
        self.stream.is_within()
    }

    /// The same in a core that is larger than the ring: its result differs by rounding.
    ///
    /// # Errors
    /// [`StreamError::Unstable`].
    pub fn with_spare_room(tables: Tables, setup: Setup) -> Result<Self, StreamError> {
        let stream =
            in_spare_room!(tables.sizes(), |room| Held::<room::Estimator, room::Steer>::boxed(&tables, &setup));
        Self::holding(tables, setup, stream)
    }

    /// The same in the largest core of all.
    ///
    /// # Errors
    /// [`StreamError::Unstable`].
    pub fn in_largest_room(tables: Tables, setup: Setup) -> Result<Self, StreamError> {
        let stream = Held::<largest::Estimator, largest::Steer>::boxed(&tables, &setup);
        Self::holding(tables, setup, Some(stream))
    }

    fn holding(
        tables: Tables,
        setup: Setup,
        stream: Option<Result<Box<dyn Stream>, Unstable>>,
    ) -> Result<Self, StreamError> {
        let stream = stream.expect("tables are made for rings that there is a core for");
        Ok(Self { stream: stream.map_err(|Unstable| StreamError::Unstable)?, tables, setup })
    }

    /// One machine cycle: bytes to estimate. See [`estimator::Estimator::ingest`].
    ///
    /// # Errors
    /// [`IngestError`].
    pub fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate, IngestError> {
        self.stream.ingest(bytes)
    }

    /// All that is done between frames; true if the model was linearised anew.
    pub fn prepare(&mut self) -> bool {
        let mut linearised = false;
        loop {
            match self.slice() {
                Prepared::Nothing => return linearised,
                Prepared::Slice => {}
                Prepared::Linearised => linearised = true,
            }
        }
    }

    /// One slice of it. See [`estimator::Estimator::prepare`].
    pub fn slice(&mut self) -> Prepared {
        self.stream.prepare()
    }

    /// Switch to other tables of the same machine. See [`estimator::Estimator::adopt`].
    ///
    /// # Errors
    /// [`Unstable`] if they have no ring at the vars at hand, or are of another machine; nothing has changed then.
    pub fn adopt(&mut self, tables: Tables) -> Result<(), Unstable> {
        if tables.sizes() != self.tables.sizes() {
            return Err(Unstable);
        }
        let before = self.stream.clone();
        let adopted = self.stream.adopt(&tables);
        match adopted {
            Ok(()) => self.tables = tables,
            Err(Unstable) => self.stream = before,
        }
        adopted
    }

    /// Steer from the next frame on, as if it were the first, or no more. Set points are not saved: a core that is loaded begins anew.
    ///
    /// # Panics
    /// If there is not one number for each monitor and corrector.
    pub fn steer(&mut self, feedback: Option<&Feedback>) {
        let (sizes, total) = (self.tables.sizes(), |[x, y]: [u16; 2]| usize::from(x) + usize::from(y));
        if let Some(feedback) = feedback {
            assert_eq!(feedback.orbit.len(), total(sizes.monitors), "a wanted reading for each monitor");
            assert_eq!(feedback.limit.len(), total(sizes.correctors), "a limit for each corrector");
        }
        self.stream.steer(feedback);
    }

    /// What the feedback made of the last frame that was taken; nothing without a feedback.
    pub fn correction(&self) -> Option<Correction> {
        self.stream.correction()
    }

    /// How well the model describes the frames so far. See [`estimator::Estimator::fit_quality`].
    pub fn fit_quality(&mut self) -> FitQuality {
        self.stream.fit_quality()
    }

    /// Write all that frames have made of the posterior; no work between frames is under way, see [`Core::prepare`].
    ///
    /// # Errors
    /// [`StateError::UnderWay`].
    pub fn save(&mut self, to: &mut Vec<u8>) -> Result<(), StateError> {
        self.stream.save(to)
    }

    /// Go on where a core with the same tables and setup was saved, to the bit.
    ///
    /// # Errors
    /// [`StateError`]; the core is then at its prior.
    pub fn load(&mut self, from: &[u8]) -> Result<(), StateError> {
        self.stream.load(from)
    }

    /// CRC-32 of the names and lengths of what is saved: a program that saves other things has another one.
    pub fn state_layout(&mut self) -> u32 {
        self.stream.state_layout()
    }

    /// Covariance of two params `theta = ln var`.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        self.stream.covariance(i, j)
    }

    /// How far the params are spread now: their covariance, to be worked out elsewhere while this core takes the next frame.
    pub fn spread(&self) -> Spread {
        Spread(self.stream.inverse_factor())
    }

    /// What the posterior expects of the readings of the last frame [B] [m]; before the next [`Core::slice`].
    pub fn fitted(&self) -> Vec<f32> {
        self.stream.fitted()
    }
}

impl fmt::Debug for Core {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Core")
            .field("sizes", &self.tables.sizes())
            .field("stream", &self.stream)
            .finish_non_exhaustive()
    }
}

/// The core at its prior, for a recording of a ring.
///
/// # Errors
/// [`StreamError`] if the ring or the recording do not fit any core.
pub fn estimator(ring: &Ring, recording: &Recording, walk: Walk) -> Result<Core, StreamError> {
    let ring = recording.powered(ring);
    Core::try_new(&ring, setup(&ring, recording, walk)?)
}

/// A row as wire bytes.
///
/// # Errors
/// [`StreamError::Range`] or [`StreamError::Encode`].
pub fn wire(recording: &Recording, row: &Row) -> Result<Vec<u8>, StreamError> {
    let encoding = |source| StreamError::Encode { recording: recording.name.clone(), sequence: row.sequence, source };
    let counts = [row.reading.len(), row.corrector_current.len(), row.supply.len()];
    let ring = Sizes::new([counts[0], 0], [counts[1], 0], [0, 0, counts[2]]);
    let mut bytes = vec![0; largest::Frame::MAX_WIRE_BYTES];
    let n = frame(recording, row)?.encode(&Layout { ring, room: largest::SIZES }, &mut bytes).map_err(encoding)?;
    bytes.truncate(n);
    Ok(bytes)
}

/// Current at which dipoles whose field goes with it have the field of a row [A]: what a frame carries. 0 where it is not read.
fn proportional_dipole(recording: &Recording, row: &Row) -> f64 {
    let header = &recording.header;
    let field = row.dipole.and_then(|current| header.dipole_field(current));
    field.zip(header.nominal_dipole).map_or(row.dipole.unwrap_or(0.0), |(field, nominal)| field * nominal)
}

/// A row in the first slots of the largest frame.
fn frame(recording: &Recording, row: &Row) -> Result<largest::Frame, StreamError> {
    let beyond =
        |what, value| StreamError::Range { recording: recording.name.clone(), sequence: row.sequence, what, value };
    let current = |value| CurrentCode::nearest(value).ok_or_else(|| beyond("current", value));
    let time = |what, seconds: f64, most| {
        let steps = (seconds * 1e6).round();
        if (0.0..=most).contains(&steps) { Ok(steps) } else { Err(beyond(what, seconds)) }
    };
    // what is less than a step would be no beam
    let intensity = |particles: f64| {
        let code = IntensityCode::nearest(particles).filter(|code| code.steps() > 0 || particles == 0.0);
        code.ok_or_else(|| beyond("intensity", particles))
    };
    let mut frame = largest::Frame {
        epoch: 0,
        sequence: row.sequence,
        time_us: time("time", row.time, u64::MAX as f64)? as u64,
        cycle_time_us: time("time in the cycle", row.cycle_time, f64::from(u32::MAX))? as u32,
        corrector: [CurrentCode::default(); largest::CORRECTORS],
        magnets: MagnetCurrents {
            dipole: current(proportional_dipole(recording, row))?,
            supply: [CurrentCode::default(); largest::SUPPLIES],
        },
        rf_offset: RfCode::nearest(row.rf_offset).ok_or_else(|| beyond("rf offset", row.rf_offset))?,
        reading: [PositionCode::default(); largest::MONITORS],
        tune: row.tune.map(|t| t.and_then(TuneCode::nearest)),
        intensity: row.intensity.map(intensity).transpose()?,
        valid: Mask::NONE,
    };
    for (to, &from) in frame.corrector.iter_mut().zip(&row.corrector_current) {
        *to = current(from)?;
    }
    for (to, &from) in frame.magnets.supply.iter_mut().zip(&row.supply) {
        *to = current(from)?;
    }
    for (b, (to, from)) in frame.reading.iter_mut().zip(&row.reading).enumerate() {
        if let Some(position) = *from {
            *to = PositionCode::nearest(position).ok_or_else(|| beyond("reading", position))?;
            frame.valid.put(b, true);
        }
    }
    Ok(frame)
}

/// Stream a whole recording through a core; `hear` gets every row and its estimate.
///
/// # Errors
/// [`StreamError`]; a recording that was read without error holds no frame that a core refuses.
pub fn replay(
    core: &mut Core,
    recording: &Recording,
    mut hear: impl FnMut(&Row, &Estimate),
) -> Result<(), StreamError> {
    for row in &recording.rows {
        core.prepare();
        let estimate = core.ingest(&mut wire(recording, row)?).map_err(|source| StreamError::Ingest {
            recording: recording.name.clone(),
            sequence: row.sequence,
            source,
        })?;
        hear(row, &estimate);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{recorded, ten_cells};

    /// What is said of the first row of a recording with one of its values changed; nothing if a frame carries it.
    fn refused(change: impl Fn(&mut Row)) -> Option<String> {
        let (_, recording) = ten_cells();
        let mut row = recording.rows[0].clone();
        change(&mut row);
        wire(&recording, &row).err().map(|error| error.to_string())
    }

    #[test]
    fn a_core_that_was_loaded_goes_on_to_the_bit() {
        let ring = Ring::booster();
        let recording = recorded(&ring, "paper-vars");
        for walk in [Walk::NONE, FOLLOW] {
            let mut whole = estimator(&ring, &recording, walk).unwrap();
            let mut core = whole.clone();
            let mut state = Vec::new();
            for (i, row) in recording.rows.iter().enumerate() {
                // from a core that has seen others, and from one at its prior
                if i % 40 == 7 {
                    whole.prepare();
                    core.prepare();
                    whole.save(&mut state).unwrap();
                    core = if i % 80 == 7 { estimator(&ring, &recording, walk).unwrap() } else { core };
                    core.load(&state).unwrap();
                }
                let (mut wire, slices) = (wire(&recording, row).unwrap(), i % 4);
                for core in [&mut whole, &mut core] {
                    (0..slices).for_each(|_| _ = core.slice());
                }
                let (one, two) = (whole.ingest(&mut wire.clone()), core.ingest(&mut wire));
                assert_eq!(format!("{one:?}"), format!("{two:?}"), "frame {i}");
                assert_eq!(whole.covariance(30, 7).to_bits(), core.covariance(30, 7).to_bits(), "frame {i}");
                let triangle = whole.spread().covariance();
                assert_eq!(triangle[30 * 31 / 2 + 7].to_bits(), core.covariance(30, 7).to_bits(), "frame {i}");
            }
            let quality = [whole.fit_quality(), core.fit_quality()];
            assert_eq!(quality[0], quality[1]);
        }
    }

    /// The frames of a campaign, whose correctors others move: what is learnt is the same, and set points of correctors that are not
    /// used are their read-backs. In a core with spare room, too.
    #[test]
    fn a_feedback_changes_no_estimate() {
        let ring = Ring::booster();
        let recording = recorded(&ring, "paper-vars");
        let (powered, mut limit) = (recording.powered(&ring), vec![20.0; 48]);
        limit[5] = 0.0;
        let wanted = Feedback {
            orbit: vec![0.0; 33],
            limit,
            walk: 5e-6,
            step_kick: 2e-5,
            total_kick: 1e-3,
            rate: 2.0,
            probe: 1.0,
            close: 0.3,
            patience_us: 60_000_000,
        };
        let setup = setup(&powered, &recording, FOLLOW).unwrap();
        let tables = training::green::tables(&powered).unwrap();
        for mut steering in
            [Core::with_tables, Core::with_spare_room].map(|of| of(tables.clone(), setup.clone()).unwrap())
        {
            let mut plain = steering.clone();
            steering.steer(Some(&wanted));
            for row in &recording.rows[..60] {
                let [one, two] = [&mut plain, &mut steering].map(|core| {
                    core.prepare();
                    core.ingest(&mut wire(&recording, row).unwrap()).unwrap()
                });
                assert_eq!(format!("{one:?}"), format!("{two:?}"), "frame {}", row.sequence);
                let correction = steering.correction().unwrap();
                assert_eq!((correction.setpoint.len(), correction.role[5]), (48, Role::Unused));
                let read_back = CurrentCode::nearest(row.corrector_current[5]).unwrap().value();
                assert_eq!(correction.setpoint[5], read_back);
            }
            let correction = steering.correction().unwrap();
            assert!(correction.role.iter().enumerate().all(|(c, role)| (c == 5) == (*role == Role::Unused)));
            assert!(correction.setpoint.iter().any(|current| current.abs() > 1.0), "{correction:?}");
            assert_eq!(plain.correction(), None);
        }
    }

    #[test]
    fn a_core_that_cannot_be_loaded_is_at_its_prior() {
        let ring = Ring::booster();
        let recording = recorded(&ring, "paper-vars");
        let (fresh, mut state) = (estimator(&ring, &recording, FOLLOW).unwrap(), Vec::new());
        let mut core = fresh.clone();
        core.ingest(&mut wire(&recording, &recording.rows[0]).unwrap()).unwrap();
        core.prepare();
        core.save(&mut state).unwrap();
        assert_eq!(core.state_layout(), fresh.clone().state_layout());
        let got = core.load(&state[..state.len() - 1]).unwrap_err();
        assert_eq!(got, StateError::Truncated { bytes: state.len() - 1 });
        let next = |core: &mut Core| core.ingest(&mut wire(&recording, &recording.rows[1]).unwrap()).unwrap();
        assert_eq!(format!("{:?}", next(&mut core)), format!("{:?}", next(&mut fresh.clone())));
    }

    #[test]
    fn what_a_frame_cannot_carry_is_said_and_not_changed() {
        let said = |what: &str| Some(format!("plain, frame 0: {what} is beyond what a frame can carry"));
        for carried in [None, Some(0.0), Some(5e5), Some(2e15)] {
            assert_eq!(refused(|row| row.intensity = carried), None);
        }
        assert_eq!(refused(|row| row.intensity = Some(1.5)), said("intensity 1.5"));
        assert_eq!(refused(|row| row.intensity = Some(3e15)), said("intensity 3000000000000000"));
        assert_eq!(refused(|row| row.time = -0.5), said("time -0.5"));
        assert_eq!(refused(|row| row.cycle_time = -1e-3), said("time in the cycle -0.001"));
        assert_eq!(refused(|row| row.cycle_time = 4295.0), said("time in the cycle 4295"));
        assert_eq!(refused(|row| row.corrector_current[0] = 2e4), said("current 20000"));
    }
}
