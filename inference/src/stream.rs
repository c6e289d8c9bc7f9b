//! A recording as the core sees it: wire frames, and a model made of its header.

use estimator::surrogate::Unstable;
use estimator::{
    Calibration, CurrentCode, FitQuality, FrameError, Gate, IngestError, MagnetCurrents, Model, PositionCode, Prior,
    RfCode, Setup, TuneCode,
};
use training::BoosterGreen;
use twin::Ring;

use crate::recording::{Header, Layout, Recording, Row};

pub use estimator::booster::{Estimate as BoosterEstimate, Estimator as Booster, Frame as BoosterFrame};

/// Width of the prior of a var, the paper's.
pub const PRIOR_WIDTH: f32 = 0.03;
/// Read-back above which a corrector counts as powered [A]: 50 times its scatter, a twentieth of its setting.
const POWERED: f32 = 1.0;

/// Why a recording cannot be put on the wire.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StreamError {
    /// The recording is of another machine than the frames.
    #[error("{recording} has {found} {what}; a frame of this machine has {expected}")]
    Count {
        /// The recording.
        recording: String,
        /// What was counted.
        what: &'static str,
        /// How many a frame holds.
        expected: usize,
        /// How many the recording has.
        found: usize,
    },
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
    /// No tables for this ring.
    #[error(transparent)]
    Training(#[from] training::TrainingError),
    /// Tables of a ring that keeps no beam at vars of 1.
    #[error("the model's tables have no stable ring at vars of 1")]
    Unstable,
}

/// The columns that a ring's recordings have.
pub fn layout(ring: &Ring) -> Layout {
    Layout { monitors: ring.monitor_names(), correctors: ring.labels(ring.correctors.iter().map(|c| c.element)) }
}

/// What a header says of currents, for the core.
///
/// # Errors
/// [`StreamError::Transfer`].
pub fn calibration(recording: &Recording) -> Result<Calibration, StreamError> {
    let Header { kick_per_ampere, nominal, quad_transfer, .. } = &recording.header;
    let mut transfer = [0.0; 6];
    if quad_transfer.len() > transfer.len() {
        return Err(StreamError::Transfer { recording: recording.name.clone(), found: quad_transfer.len() });
    }
    transfer.iter_mut().zip(quad_transfer).for_each(|(to, from)| *to = *from as f32);
    Ok(Calibration {
        kick_per_ampere: *kick_per_ampere as f32,
        nominal: [nominal.dipole, nominal.qh, nominal.qv].map(|a| a as f32),
        transfer,
        powered: POWERED,
    })
}

/// A core on the host, with the model that it goes by. Boxed: its state is some 150 kB.
#[derive(Debug, Clone)]
pub struct Core {
    /// The ring.
    pub tables: Box<BoosterGreen>,
    /// What else is known beforehand.
    pub setup: Setup,
    state: Box<Booster>,
}

impl Core {
    /// The core at its prior.
    ///
    /// # Errors
    /// [`StreamError`] if the ring does not fit the core.
    pub fn try_new(ring: &Ring, setup: Setup) -> Result<Self, StreamError> {
        Self::with_tables(Box::new(training::green::tables(ring)?), setup)
    }

    /// The core at its prior, going by other tables than a design's: those of [`training::extended`], or from a file.
    ///
    /// # Errors
    /// [`StreamError::Unstable`].
    pub fn with_tables(tables: Box<BoosterGreen>, setup: Setup) -> Result<Self, StreamError> {
        let mut core = Self { tables, setup, state: Box::new(Booster::BLANK) };
        let (model, state) = core.parts();
        state.restart(&model).map_err(|Unstable| StreamError::Unstable)?;
        Ok(core)
    }

    fn parts(&mut self) -> (Model<'_, BoosterGreen>, &mut Booster) {
        (Model { surrogate: &self.tables, setup: &self.setup }, &mut self.state)
    }

    /// One machine cycle: bytes to estimate. See [`estimator::Estimator::ingest`].
    ///
    /// # Errors
    /// [`IngestError`].
    pub fn ingest(&mut self, bytes: &mut [u8]) -> Result<BoosterEstimate, IngestError> {
        let (model, state) = self.parts();
        state.ingest(&model, bytes)
    }

    /// What is done between frames. See [`estimator::Estimator::prepare`].
    pub fn prepare(&mut self) -> bool {
        let (model, state) = self.parts();
        state.prepare(&model)
    }

    /// Go over to other tables of the same machine. See [`estimator::Estimator::adopt`].
    ///
    /// # Errors
    /// [`Unstable`] if they have no ring at the vars at hand; the former tables are then in use again.
    pub fn adopt(&mut self, tables: BoosterGreen) -> Result<(), Unstable> {
        let former = core::mem::replace(&mut *self.tables, tables);
        let (model, state) = self.parts();
        state.adopt(&model).inspect_err(|_| {
            *self.tables = former;
            let (model, state) = self.parts();
            let _ = state.adopt(&model); // they have described all frames so far, so they can again
        })
    }

    /// How well the model describes the frames so far. See [`estimator::Estimator::fit_quality`].
    pub fn fit_quality(&mut self) -> FitQuality {
        let (model, state) = self.parts();
        state.fit_quality(&model)
    }

    /// Covariance of two params `theta = ln var`.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        self.state.covariance(i, j)
    }
}

/// What is known beforehand of a recording, from its header.
///
/// # Errors
/// [`StreamError::Transfer`].
pub fn setup(recording: &Recording, process_noise: f32) -> Result<Setup, StreamError> {
    Ok(Setup {
        prior: Prior::lognormal(PRIOR_WIDTH),
        calibration: calibration(recording)?,
        noise: recording.header.bpm_sigma as f32,
        gate: Gate::default(),
        process_noise,
    })
}

/// The core at its prior, for a recording of a ring.
///
/// # Errors
/// [`StreamError`] if the ring or the recording do not fit the core.
pub fn estimator(ring: &Ring, recording: &Recording, process_noise: f32) -> Result<Core, StreamError> {
    Core::try_new(ring, setup(recording, process_noise)?)
}

/// A row as a frame.
///
/// # Errors
/// [`StreamError::Count`] or [`StreamError::Range`].
pub fn frame(recording: &Recording, row: &Row) -> Result<BoosterFrame, StreamError> {
    let beyond =
        |what, value| StreamError::Range { recording: recording.name.clone(), sequence: row.sequence, what, value };
    let count = |what, expected, found| {
        let wrong = StreamError::Count { recording: recording.name.clone(), what, expected, found };
        if found == expected { Ok(()) } else { Err(wrong) }
    };
    let current = |value| CurrentCode::nearest(value).ok_or_else(|| beyond("current", value));
    count("monitors", 33, row.reading.len())?;
    count("correctors", 48, row.corrector_current.len())?;
    let mut frame = BoosterFrame {
        sequence: row.sequence,
        time_us: (row.time * 1e6).round() as u64,
        cycle_time_us: (row.cycle_time * 1e6).round() as u32,
        corrector: [CurrentCode::default(); 48],
        magnets: MagnetCurrents {
            dipole: current(row.currents.dipole)?,
            qh: current(row.currents.qh)?,
            qv: current(row.currents.qv)?,
            sh: current(row.currents.sh)?,
            sv: current(row.currents.sv)?,
        },
        rf_offset: RfCode::nearest(row.rf_offset).ok_or_else(|| beyond("rf offset", row.rf_offset))?,
        reading: [PositionCode::default(); 33],
        tune: row.tune.map(|t| t.and_then(TuneCode::nearest)),
        valid: 0,
    };
    for (to, &from) in frame.corrector.iter_mut().zip(&row.corrector_current) {
        *to = current(from)?;
    }
    for (b, (to, from)) in frame.reading.iter_mut().zip(&row.reading).enumerate() {
        if let Some(position) = *from {
            *to = PositionCode::nearest(position).ok_or_else(|| beyond("reading", position))?;
            frame.valid |= 1 << b;
        }
    }
    Ok(frame)
}

/// A row as wire bytes.
///
/// # Errors
/// As [`frame`], and [`StreamError::Encode`].
pub fn wire(recording: &Recording, row: &Row) -> Result<Vec<u8>, StreamError> {
    let mut bytes = vec![0; BoosterFrame::MAX_WIRE_BYTES];
    let n = frame(recording, row)?.encode(&mut bytes).map_err(|source| StreamError::Encode {
        recording: recording.name.clone(),
        sequence: row.sequence,
        source,
    })?;
    bytes.truncate(n);
    Ok(bytes)
}

/// Stream a whole recording through a core; `hear` gets every row and its estimate.
///
/// # Errors
/// [`StreamError`]; a recording that was read without error holds no frame that a core refuses.
pub fn replay(
    core: &mut Core,
    recording: &Recording,
    mut hear: impl FnMut(&Row, &BoosterEstimate),
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
