//! What predicts the readings: the exact twin, the surrogate's Green's function in f64, the network, or the first order about the design.
//!
//! Each gives the orbit response [m/rad] of the read monitors to the correctors and, as one more column, to the RF
//! frequency: `-D/eta`, the orbit of a unit of relative offset [m]; and with the tunes. And each gives the gradient of any function of
//! these.

mod green;
mod linear;
mod resnet;

use nalgebra::DMatrix;
use twin::{OrbitError, Ring, VariedOptics, VariedRing};

use crate::stream::StreamError;

pub use green::GreenModel;
pub use linear::LinearModel;
pub use resnet::ResnetModel;

/// A model of the ring in its vars.
#[derive(Debug, Clone)]
pub enum ResponseModel {
    /// The exact twin.
    Twin(Box<VariedRing>),
    /// The Green's function with the tables of the core, in f64.
    Green(Box<GreenModel>),
    /// The network with the weights of the core, in f32.
    Resnet(Box<ResnetModel>),
    /// The first order about the design.
    Linear(Box<LinearModel>),
}

impl ResponseModel {
    /// The exact twin of a ring.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring has no closed orbit.
    pub fn twin(ring: &Ring) -> Result<Self, OrbitError> {
        Ok(Self::Twin(Box::new(VariedRing::of(ring)?)))
    }

    /// The Green's function of a ring.
    ///
    /// # Errors
    /// [`training::TrainingError`] if it cannot be tabulated.
    pub fn green(ring: &Ring) -> Result<Self, training::TrainingError> {
        Ok(Self::Green(Box::new(GreenModel::from_tables(&training::green::tables(ring)?))))
    }

    /// The network, of the ring that it was trained on.
    ///
    /// # Errors
    /// [`StreamError`] for another ring.
    pub fn resnet(ring: &Ring) -> Result<Self, StreamError> {
        training::network::expect_known(ring)?;
        let green = GreenModel::from_tables(&training::green::tables(ring)?);
        Ok(Self::Resnet(Box::new(ResnetModel::from_green(green))))
    }

    /// The first order about a ring's design.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring has no closed orbit.
    pub fn linear(ring: &Ring) -> Result<Self, OrbitError> {
        Ok(Self::Linear(Box::new(LinearModel::from_ring(ring)?)))
    }

    /// False if a prediction at `ln` of the factor on each quadrupole's gradient [M] is beyond the range that the model was made for.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn is_within(&self, strength: &[f64]) -> Result<bool, OrbitError> {
        match self {
            Self::Twin(_) | Self::Green(_) | Self::Linear(_) => Ok(true),
            Self::Resnet(resnet) => resnet.is_within(&exponential(strength)),
        }
    }

    /// The word for it.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Twin(_) => "twin",
            Self::Green(_) => "green",
            Self::Resnet(_) => "resnet",
            Self::Linear(_) => "linear",
        }
    }

    /// Rms error of one predicted orbit at monitor `b` [m], the same at each repeat of a setting.
    pub fn stated_error(&self, b: usize) -> f64 {
        match self {
            Self::Twin(_) => 0.0,
            Self::Green(green) => green.stated_error(b),
            Self::Resnet(resnet) => resnet.stated_error(b),
            Self::Linear(linear) => linear.stated_error(b),
        }
    }

    /// What it predicts at `ln` of the factor on each quadrupole's gradient [M].
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn predict(&self, strength: &[f64]) -> Result<Prediction, OrbitError> {
        let factors = exponential(strength);
        match self {
            Self::Twin(ring) => Ok(ring.at(&factors)?.prediction()),
            Self::Green(green) => Ok(green.at(&factors)?.prediction()),
            Self::Resnet(resnet) => Ok(resnet.at(&factors)?.prediction()),
            Self::Linear(linear) => Ok(linear.at(&factors).prediction()),
        }
    }

    /// Evaluate a function of the prediction, which returns its value and its derivative with respect to each number of it; returns
    /// the value and its gradient with respect to `ln` of each quadrupole's gradient [M].
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn differentiate<V>(
        &self,
        strength: &[f64],
        function: impl FnOnce(&Prediction) -> (V, Prediction),
    ) -> Result<(V, Vec<f64>), OrbitError> {
        let factors = exponential(strength);
        match self {
            Self::Twin(ring) => Ok(pull_back(&ring.at(&factors)?, function)),
            Self::Green(green) => Ok(pull_back(&green.at(&factors)?, function)),
            Self::Resnet(resnet) => Ok(pull_back(&resnet.at(&factors)?, function)),
            Self::Linear(linear) => Ok(pull_back(&linear.at(&factors), function)),
        }
    }

    /// Derivative of the response at each monitor, rows as its columns, columns quadrupoles, and of both tunes.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn jacobian(&self, strength: &[f64]) -> Result<(Vec<DMatrix<f64>>, DMatrix<f64>), OrbitError> {
        let factors = exponential(strength);
        match self {
            Self::Twin(ring) => Ok(slopes(&ring.at(&factors)?, strength.len())),
            Self::Green(green) => Ok(slopes(&green.at(&factors)?, strength.len())),
            Self::Resnet(resnet) => {
                let optics = resnet.at(&factors)?;
                Ok((optics.rows(), tune_rows(&optics, strength.len())))
            }
            Self::Linear(linear) => Ok(slopes(&linear.at(&factors), strength.len())),
        }
    }
}

/// What a model predicts, or the derivative of a function of it.
#[derive(Debug, Clone)]
pub struct Prediction {
    /// Rows monitors, columns correctors and the RF.
    pub response: DMatrix<f64>,
    /// Fractional tunes x and y [1].
    pub tunes: [f64; 2],
}

/// A model at given strengths.
trait Optics {
    /// Response [m/rad], rows monitors, columns correctors and the RF [m].
    fn response(&self) -> DMatrix<f64>;

    /// Fractional tunes.
    fn tunes(&self) -> [f64; 2];

    /// Gradient with respect to `ln` of each quadrupole's gradient of a function of the response, from its derivative `weights`.
    fn pull_back(&self, weights: &DMatrix<f64>) -> Vec<f64>;

    /// Derivative of both tunes with respect to `ln` of each quadrupole's gradient.
    fn tune_slopes(&self) -> Vec<[f64; 2]>;

    fn prediction(&self) -> Prediction {
        Prediction { response: self.response(), tunes: self.tunes() }
    }
}

impl Optics for VariedOptics<'_> {
    fn response(&self) -> DMatrix<f64> {
        self.response()
    }

    fn tunes(&self) -> [f64; 2] {
        self.tunes()
    }

    fn pull_back(&self, weights: &DMatrix<f64>) -> Vec<f64> {
        self.pull_back(weights)
    }

    fn tune_slopes(&self) -> Vec<[f64; 2]> {
        self.tune_slopes()
    }
}

fn pull_back<V>(optics: &impl Optics, function: impl FnOnce(&Prediction) -> (V, Prediction)) -> (V, Vec<f64>) {
    let (value, weights) = function(&optics.prediction());
    let mut gradient = optics.pull_back(&weights.response);
    if weights.tunes != [0.0; 2] {
        for (slope, [x, y]) in gradient.iter_mut().zip(optics.tune_slopes()) {
            *slope += weights.tunes[0] * x + weights.tunes[1] * y;
        }
    }
    (value, gradient)
}

fn slopes(optics: &impl Optics, quadrupoles: usize) -> (Vec<DMatrix<f64>>, DMatrix<f64>) {
    let rows = rows_of(&optics.response(), quadrupoles, |weights| optics.pull_back(weights));
    (rows, tune_rows(optics, quadrupoles))
}

/// Derivatives of both tunes.
fn tune_rows(optics: &impl Optics, quadrupoles: usize) -> DMatrix<f64> {
    let tunes = optics.tune_slopes();
    DMatrix::from_fn(2, quadrupoles, |plane, m| tunes[m][plane])
}

fn exponential(params: &[f64]) -> Vec<f64> {
    params.iter().map(|theta| theta.exp()).collect()
}

/// The Jacobian, one entry of the response pulled back at a time.
fn rows_of(response: &DMatrix<f64>, params: usize, pull_back: impl Fn(&DMatrix<f64>) -> Vec<f64>) -> Vec<DMatrix<f64>> {
    let mut unit = DMatrix::zeros(response.nrows(), response.ncols());
    let mut one = |b: usize, c: usize| {
        unit[(b, c)] = 1.0;
        let row = pull_back(&unit);
        unit[(b, c)] = 0.0;
        row
    };
    let mut of_monitor = |b: usize| {
        let rows: Vec<f64> = (0..response.ncols()).flat_map(|c| one(b, c)).collect();
        DMatrix::from_row_slice(response.ncols(), params, &rows)
    };
    (0..response.nrows()).map(&mut of_monitor).collect()
}
