//! A simulated Booster whose vars are known: its readings are the surrogate's prediction at them, and noise. Fast enough for
//! millions of frames.

use estimator::booster::{self, CORRECTORS, Frame, Green, MONITORS, PARAMS, Prediction, SUPPLIES, Setup};
use estimator::{CurrentCode, Layout, MagnetCurrents, Mask, PositionCode, RfCode, Surrogate, Walk};
use inference::stream::Core;
use nalgebra::{DMatrix, DVector};

/// A Booster in a core of its size.
pub const LAYOUT: Layout = Layout { ring: booster::SIZES, room: booster::SIZES };

/// All monitors are valid.
pub const ALL: [u32; 2] = [u32::MAX, 1];

/// A frame as bytes.
///
/// # Panics
/// Never: the buffer holds any frame.
pub fn wire_of(frame: &Frame) -> Vec<u8> {
    let mut wire = vec![0; Frame::MAX_WIRE_BYTES];
    let n = frame.encode(&LAYOUT, &mut wire).expect("the buffer holds any frame");
    wire.truncate(n);
    wire
}

/// Time from one of its cycles to the next [us].
const PERIOD: u64 = 100_000;

/// A walk of the params by so much in each of its cycles.
pub fn walk_per_cycle(sigma: f32) -> Walk {
    Walk { params: sigma / (1e-6 * PERIOD as f32).sqrt(), ..Walk::NONE }
}

/// Random numbers, seeded. Source: G. Marsaglia, Xorshift RNGs, J. Stat. Softw. 8 (2003) 14.
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// The sequence of a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    fn bits(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// A whole number below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        (self.bits() >> 16) as usize % n
    }

    /// Any byte.
    pub fn byte(&mut self) -> u8 {
        (self.bits() >> 24) as u8
    }

    /// A number from 0 to 1.
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A standard normal number, by Box and Muller.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (core::f64::consts::TAU * self.uniform()).cos()
    }

    /// So many correctors at ± the currents from `least` to `most` [A].
    pub fn powered(&mut self, count: usize, least: f64, most: f64) -> [CurrentCode; CORRECTORS] {
        let mut corrector = [CurrentCode::default(); CORRECTORS];
        let mut powered = 0;
        while powered < count {
            let c = self.below(CORRECTORS);
            if corrector[c] == CurrentCode::default() {
                let sign = if self.below(2) == 0 { 1.0 } else { -1.0 };
                corrector[c] = amperes(sign * (least + (most - least) * self.uniform()));
                powered += 1;
            }
        }
        corrector
    }
}

/// A current.
///
/// # Panics
/// Beyond 10 kA.
pub fn amperes(current: f64) -> CurrentCode {
    CurrentCode::nearest(current).expect("a current within the range of a frame")
}

/// A machine of known vars.
#[derive(Debug, Clone)]
pub struct Machine {
    /// Its ring; what it predicts at the true params is the truth.
    pub surrogate: Box<Green>,
    /// What its core knows beforehand.
    pub setup: Setup,
    /// True `theta = ln var`.
    pub params: [f32; PARAMS],
    /// The true derivative of the last frame's readings, and its orbit without baselines.
    pub prediction: Box<Prediction>,
    /// True noise of each monitor [m].
    pub noise: [f64; MONITORS],
    /// Random numbers of the machine and of whoever runs it.
    pub random: Random,
    at: Box<<Green as Surrogate<MONITORS, CORRECTORS, SUPPLIES, PARAMS>>::Linearised>,
    /// The linearisation is that of the params.
    is_linearised: bool,
    /// Baselines [m].
    offset: [f64; MONITORS],
}

impl Machine {
    /// Vars drawn from the prior.
    ///
    /// # Panics
    /// If the core is not the Booster's.
    pub fn drawn(core: &Core, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let prior = core.setup.priors[core.tables.prior_group(0)];
        let mut surrogate = Box::new(Green::BLANK);
        core.tables.fill(&mut *surrogate).expect("tables of the Booster");
        let setup = core.setup.in_room(&LAYOUT);
        let mut theta = || loop {
            let theta = prior.mean + prior.sigma * random.normal() as f32;
            if (prior.lower..=prior.upper).contains(&theta) {
                return theta;
            }
        };
        Self {
            surrogate,
            noise: core::array::from_fn(|b| setup.noise.of(b).into()),
            setup,
            at: Box::new(<Green as Surrogate<MONITORS, CORRECTORS, SUPPLIES, PARAMS>>::UNLINEARISED),
            is_linearised: false,
            prediction: Box::new(Prediction::BLANK),
            params: core::array::from_fn(|_| theta()),
            offset: core::array::from_fn(|_| 2e-3 * random.normal()),
            random,
        }
    }

    /// Let every param walk.
    pub fn walk(&mut self, sigma: f32) {
        self.params.iter_mut().for_each(|theta| *theta += sigma * self.random.normal() as f32);
        self.is_linearised = false;
    }

    /// Let every baseline move [m].
    pub fn move_baselines(&mut self, sigma: f64) {
        self.offset.iter_mut().for_each(|offset| *offset += sigma * self.random.normal());
    }

    /// A cycle with five correctors of 5 to 22 A.
    pub fn cycle(&mut self, sequence: u32) -> Frame {
        let corrector = self.random.powered(5, 5.0, 22.0);
        self.cycle_with(sequence, corrector)
    }

    /// A cycle; its readings are the surrogate's, and noise.
    ///
    /// # Panics
    /// If the drive is beyond what the model describes.
    pub fn cycle_with(&mut self, sequence: u32, corrector: [CurrentCode; CORRECTORS]) -> Frame {
        let calibration = &self.setup.calibration;
        let supply = core::array::from_fn(|f| amperes(calibration.supplies[f].nominal.into()));
        let dipole = amperes(calibration.dipole.map_or(0.0, f64::from));
        let mut frame = Frame {
            epoch: 0,
            sequence,
            time_us: PERIOD * u64::from(sequence),
            cycle_time_us: 92_000,
            corrector,
            magnets: MagnetCurrents { dipole, supply },
            rf_offset: RfCode::default(),
            reading: [PositionCode::default(); MONITORS],
            tune: [None; 2],
            intensity: None,
            valid: Mask::from_words(&ALL),
        };
        if !self.is_linearised {
            let linearise = Surrogate::<MONITORS, CORRECTORS, SUPPLIES, PARAMS>::linearise;
            let surrogate: &Green = &self.surrogate;
            linearise(surrogate, &self.params, &[0.0; SUPPLIES], &mut self.at).expect("a stable ring");
            self.is_linearised = true;
        }
        let drive = calibration.drive(&frame).expect("a drive within the model");
        self.surrogate.predict(&self.at, &drive, &mut self.prediction);
        for b in 0..MONITORS {
            let noise = self.noise[b] * self.random.normal();
            let position = f64::from(self.prediction.reading[b]) + self.offset[b] + noise;
            frame.reading[b] = PositionCode::nearest(position).expect("an orbit within ±100 mm");
        }
        frame
    }
}

/// Normalised estimation error squared: `error^T P^-1 error`.
///
/// # Panics
/// If the covariance is not positive.
pub fn nees(error: &[f64; PARAMS], covariance: impl Fn(usize, usize) -> f32) -> f64 {
    let error = DVector::from_row_slice(error);
    let covariance = DMatrix::from_fn(PARAMS, PARAMS, |i, j| f64::from(covariance(i, j)));
    let whitened = covariance.cholesky().expect("a positive covariance").solve(&error);
    error.dot(&whitened)
}
