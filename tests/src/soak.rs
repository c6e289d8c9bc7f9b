//! Long streams: the core beside the same Gaussian in double precision and beside the truth, at checkpoints.

use core::error::Error;

use estimator::booster::{CORRECTORS, Estimate, Estimator, Frame, MONITORS, PARAMS};
use estimator::{CurrentCode, FitQuality, Model, Prepared, Walk};
use inference::Recording;
use inference::stream;
use nalgebra::{DMatrix, DVector, SMatrix, SVector};
use twin::Ring;

use crate::machine::{Machine, Random, amperes, nees, wire_of};
use crate::repository;

/// Prior standard deviation of a baseline [m], the core's.
const BASELINE: f64 = 0.02;

/// What drives the beam of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Row {
    /// 5 to 20 correctors of up to 10 A, other ones in every frame: a feedback.
    Several,
    /// Each corrector alone at ±22 A, and none, in turn: a campaign.
    Single,
    /// All correctors within 0.9 A: each moves the orbit by a few times the noise.
    Faint,
    /// Each corrector in turn at ±22 A about a steady ±3 A in all of them.
    Steady,
}

impl Row {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Several, Self::Single, Self::Faint, Self::Steady];

    /// Read-backs of the correctors in a frame.
    pub fn drive(self, frame: u32, random: &mut Random) -> [CurrentCode; CORRECTORS] {
        let scan = |at: usize| match (frame as usize % (2 * CORRECTORS + 1)).checked_sub(1) {
            Some(k) if k / 2 == at => 22.0 * if k % 2 == 0 { 1.0 } else { -1.0 },
            _ => 0.0,
        };
        match self {
            Self::Several => {
                let count = 5 + random.below(16);
                random.powered(count, 1.0, 10.0)
            }
            Self::Single => core::array::from_fn(|c| amperes(scan(c))),
            Self::Faint => core::array::from_fn(|_| amperes(0.9 * (2.0 * random.uniform() - 1.0))),
            Self::Steady => core::array::from_fn(|c| amperes(scan(c) + if c % 2 == 0 { 3.0 } else { -3.0 })),
        }
    }
}

/// Params and baselines in double precision, linearised at the truth: information on both, nothing eliminated.
///
/// `delta = theta - truth`, `innovation = h . delta + baseline + noise`; the evidence is that of all readings.
#[derive(Debug, Clone)]
pub struct Reference {
    params: Box<SMatrix<f64, PARAMS, PARAMS>>,
    cross: Box<SMatrix<f64, PARAMS, MONITORS>>,
    baselines: SVector<f64, MONITORS>,
    pull: (SVector<f64, PARAMS>, SVector<f64, MONITORS>),
    chi_square: f64,
    /// `ln` of the product of all variances, times `2 pi` for readings, those of the prior included.
    volume: f64,
}

impl Reference {
    /// The prior of a machine.
    fn of(machine: &Machine) -> Self {
        let prior = machine.setup.prior[0];
        let (precision, weight) = (f64::from(prior.sigma).powi(-2), BASELINE.powi(-2));
        let mean = SVector::from_fn(|i, _| f64::from(prior.mean - machine.params[i]));
        Self {
            params: Box::new(SMatrix::from_diagonal_element(precision)),
            cross: Box::new(SMatrix::zeros()),
            baselines: SVector::repeat(weight),
            pull: (mean * precision, SVector::zeros()),
            chi_square: precision * mean.norm_squared(),
            volume: -(PARAMS as f64) * precision.ln() - MONITORS as f64 * weight.ln(),
        }
    }

    /// Add the readings that the core has used.
    fn add(&mut self, machine: &Machine, frame: &Frame, estimate: &Estimate) {
        let h: SMatrix<f64, PARAMS, MONITORS> = machine.prediction.jacobian.map(f64::from);
        let mut weighted = h;
        for b in 0..MONITORS {
            let variance = f64::from(machine.setup.noise.of(b)).powi(2);
            let weight = if estimate.accepted.has(b) { 1.0 / variance } else { 0.0 };
            weighted.column_mut(b).scale_mut(weight);
            let residual = 1e-7 * f64::from(frame.reading[b].steps()) - f64::from(machine.prediction.reading[b]);
            self.baselines[b] += weight;
            self.pull.1[b] += weight * residual;
            self.pull.0.axpy(weight * residual, &h.column(b), 1.0);
            self.chi_square += weight * residual * residual;
            self.volume += if weight > 0.0 { (core::f64::consts::TAU * variance).ln() } else { 0.0 };
        }
        self.params.gemm(1.0, &weighted, &h.transpose(), 1.0);
        *self.cross += weighted;
    }

    /// Standard deviations of the params, and the evidence so far.
    fn solve(&self) -> ([f64; PARAMS], f64) {
        let n = PARAMS + MONITORS;
        let information = DMatrix::from_fn(n, n, |i, j| match (i.checked_sub(PARAMS), j.checked_sub(PARAMS)) {
            (None, None) => self.params[(i, j)],
            (None, Some(b)) => self.cross[(i, b)],
            (Some(b), None) => self.cross[(j, b)],
            (Some(b), Some(other)) => f64::from(u8::from(b == other)) * self.baselines[b],
        });
        let pull = DVector::from_iterator(n, self.pull.0.iter().chain(self.pull.1.iter()).copied());
        let factor = information.cholesky().expect("information is positive");
        let log_determinant = 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
        let chi_square = self.chi_square - pull.dot(&factor.solve(&pull));
        let covariance = factor.inverse();
        let sigma = core::array::from_fn(|i| covariance[(i, i)].sqrt());
        (sigma, -0.5 * (chi_square + self.volume + log_determinant))
    }
}

/// The state of a stream after so many frames; what is averaged is over the frames since the checkpoint before.
#[derive(Debug, Clone, Copy, serde::Serialize)]
pub struct Checkpoint {
    /// Frames so far.
    pub frames: u32,
    /// Normalised estimation error squared over the number of params.
    pub nees: f64,
    /// Smallest and largest ratio of a standard deviation to that in double precision.
    pub sigma_ratio: [f64; 2],
    /// Mean NIS of a frame.
    pub nis: f64,
    /// Its standard deviation.
    pub nis_scatter: f64,
    /// `ln` evidence of a frame, less that in double precision [nat].
    pub evidence: f64,
}

/// One stream, without end.
#[derive(Debug, Clone)]
pub struct Soak {
    /// The machine that it comes from.
    pub machine: Machine,
    row: Row,
    core: Box<Estimator>,
    reference: Reference,
    frames: u32,
    /// Epoch and number of the next frame.
    cycle: (u32, u32),
    evidence: f64,
}

impl Soak {
    /// A machine, its core at the prior, and nothing seen. The reference knows no process noise.
    ///
    /// # Errors
    /// If the recording whose setup is used cannot be read.
    pub fn new(row: Row, seed: u64, walk: Walk) -> Result<Self, Box<dyn Error>> {
        let ring = Ring::booster();
        let recording = Recording::read(&repository("recordings/paper-vars"), &ring)?;
        let mut machine = Machine::drawn(&stream::estimator(&ring, &recording, walk)?, seed);
        // the surrogate is the truth here
        machine.surrogate.stated_error = [0.0; 2];
        machine.setup.tune_calibration = None;
        let mut core = Box::new(Estimator::BLANK);
        core.restart(&Model { surrogate: &*machine.surrogate, setup: &machine.setup })
            .map_err(|_| "the design has no stable ring")?;
        let reference = Reference::of(&machine);
        Ok(Self { row, core, reference, frames: 0, cycle: (0, 0), evidence: 0.0, machine })
    }

    /// The next frame, as the machine sends it.
    pub fn cycle(&mut self) -> Frame {
        let corrector = self.row.drive(self.frames, &mut self.machine.random);
        self.cycle_with(corrector)
    }

    fn cycle_with(&mut self, corrector: [CurrentCode; CORRECTORS]) -> Frame {
        let (epoch, sequence) = self.cycle;
        self.cycle.1 = sequence.wrapping_add(1);
        Frame { epoch, ..self.machine.cycle_with(sequence, corrector) }
    }

    /// Lose so many cycles.
    pub fn skip(&mut self, cycles: u32) {
        self.cycle.1 = self.cycle.1.wrapping_add(cycles);
    }

    /// The front end counts from 0 again.
    pub fn restart_front_end(&mut self) {
        self.cycle = (self.cycle.0 + 1, 0);
    }

    /// Let the core take a frame in.
    ///
    /// # Panics
    /// If it refuses it.
    pub fn ingest(&mut self, frame: &Frame) -> Estimate {
        let model = Model { surrogate: &*self.machine.surrogate, setup: &self.machine.setup };
        while self.core.prepare(&model) != Prepared::Nothing {}
        let estimate = self.core.ingest(&model, &mut wire_of(frame)).expect("a good frame");
        self.frames += 1;
        estimate
    }

    /// The machine sends the correctors at these currents, and the core takes that in.
    pub fn powered(&mut self, corrector: [CurrentCode; CORRECTORS]) -> Estimate {
        let frame = self.cycle_with(corrector);
        self.ingest(&frame)
    }

    /// How well the core says that its model describes the frames so far.
    pub fn quality(&mut self) -> FitQuality {
        self.core.fit_quality(&Model { surrogate: &*self.machine.surrogate, setup: &self.machine.setup })
    }

    /// Estimated less true params over the error bars of an estimate, squared: NEES over the number of params.
    pub fn nees(&self, estimate: &Estimate) -> f64 {
        let error = core::array::from_fn(|i| f64::from(estimate.map_params[i]) - f64::from(self.machine.params[i]));
        nees(&error, |i, j| self.core.covariance(i, j)) / PARAMS as f64
    }

    /// So many frames, and how the core then stands.
    ///
    /// # Panics
    /// If the covariance is not positive.
    pub fn run(&mut self, frames: u32) -> Checkpoint {
        let (mut sum, mut squares, mut last) = (0.0, 0.0, None);
        for _ in 0..frames {
            let frame = self.cycle();
            let estimate = self.ingest(&frame);
            self.reference.add(&self.machine, &frame, &estimate);
            let nis = f64::from(estimate.nis);
            sum += nis;
            squares += nis * nis;
            last = Some(estimate);
        }
        let last = last.expect("at least one frame");
        let n = f64::from(frames);
        let (sigma, evidence) = self.reference.solve();
        let ratio = |i: usize| f64::from(last.params_sigma[i]) / sigma[i];
        let ratios = (0..PARAMS).map(ratio);
        let gap = f64::from(last.log_evidence) - evidence;
        Checkpoint {
            frames: self.frames,
            nees: self.nees(&last),
            sigma_ratio: [ratios.clone().fold(f64::MAX, f64::min), ratios.fold(0.0, f64::max)],
            nis: sum / n,
            nis_scatter: (squares / n - (sum / n).powi(2)).sqrt(),
            evidence: (gap - core::mem::replace(&mut self.evidence, gap)) / n,
        }
    }
}
