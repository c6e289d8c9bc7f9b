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
            Self::Resnet(resnet) => resnet.is_within(&strength.iter().map(|log| log.exp()).collect::<Vec<f64>>()),
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
        Ok(self.at(strength)?.prediction())
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
        let optics = self.at(strength)?;
        let (value, weights) = function(&optics.prediction());
        let mut gradient = optics.pull_back(&weights.response);
        if weights.tunes != [0.0; 2] {
            for (slope, [x, y]) in gradient.iter_mut().zip(optics.tune_slopes()) {
                *slope += weights.tunes[0] * x + weights.tunes[1] * y;
            }
        }
        Ok((value, gradient))
    }

    /// Derivative of the response at each monitor, rows as its columns, columns quadrupoles, and of both tunes.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn jacobian(&self, strength: &[f64]) -> Result<(Vec<DMatrix<f64>>, DMatrix<f64>), OrbitError> {
        Ok(self.at(strength)?.slopes())
    }

    fn at(&self, strength: &[f64]) -> Result<Box<dyn Optics + '_>, OrbitError> {
        let factors = exponential(strength);
        Ok(match self {
            Self::Twin(ring) => Box::new(ring.at(&factors)?),
            Self::Green(green) => Box::new(green.at(&factors)?),
            Self::Resnet(resnet) => Box::new(resnet.at(&factors)?),
            Self::Linear(linear) => Box::new(linear.at(&factors)),
        })
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

    /// Derivative of the response at each monitor, rows correctors and the RF, columns quadrupoles: one entry is pulled back at a time.
    fn rows(&self) -> Vec<DMatrix<f64>> {
        let (monitors, columns) = self.response().shape();
        let mut unit = DMatrix::zeros(monitors, columns);
        let mut pulled = |b: usize, c: usize| {
            unit[(b, c)] = 1.0;
            let row = self.pull_back(&unit);
            unit[(b, c)] = 0.0;
            row
        };
        let mut of_monitor = |b: usize| {
            let rows: Vec<f64> = (0..columns).flat_map(|c| pulled(b, c)).collect();
            DMatrix::from_row_slice(columns, rows.len() / columns, &rows)
        };
        (0..monitors).map(&mut of_monitor).collect()
    }

    /// The same, and the derivative of both tunes.
    fn slopes(&self) -> (Vec<DMatrix<f64>>, DMatrix<f64>) {
        let tunes = self.tune_slopes();
        (self.rows(), DMatrix::from_fn(2, tunes.len(), |plane, m| tunes[m][plane]))
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

fn exponential(params: &[f64]) -> Vec<f64> {
    params.iter().map(|theta| theta.exp()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// To what rounds a difference: sums of 800 responses of 10 m/rad in f32 for the network.
    #[test]
    fn the_gradient_is_that_of_the_response() {
        let ring = Ring::booster();
        let strength: Vec<f64> = (0..48).map(|i| (1.0 + 0.03 * f64::sin(3.0 * f64::from(i))).ln()).collect();
        let weights = DMatrix::from_fn(33, 49, |b, c| f64::sin(7.1 * b as f64 + 2.3 * c as f64));
        for (model, precision) in [
            (ResponseModel::twin(&ring).unwrap(), 1e-6),
            (ResponseModel::green(&ring).unwrap(), 1e-6),
            (ResponseModel::resnet(&ring).unwrap(), 1e-2),
            (ResponseModel::linear(&ring).unwrap(), 1e-6),
        ] {
            let of_response = |at: &Prediction| {
                (at.response.dot(&weights), Prediction { response: weights.clone(), tunes: [0.0; 2] })
            };
            let (_, gradient) = model.differentiate(&strength, of_response).unwrap();
            let (rows, _) = model.jacobian(&strength).unwrap();
            let largest = gradient.iter().fold(0.0, |largest: f64, slope| largest.max(slope.abs()));
            for (q, slope) in gradient.iter().enumerate() {
                let value = |step: f64| {
                    let mut strength = strength.clone();
                    strength[q] += step;
                    model.predict(&strength).unwrap().response.dot(&weights)
                };
                let h = 1e-3; // of which the error is of fourth order
                let difference = (8.0 * (value(h) - value(-h)) - value(2.0 * h) + value(-2.0 * h)) / (12.0 * h);
                let by_rows: f64 = rows.iter().enumerate().map(|(b, row)| (weights.row(b) * row)[q]).sum();
                let word = model.word();
                assert!((slope - difference).abs() < precision * largest, "{word} {q}: {slope} {difference}");
                assert!((slope - by_rows).abs() < 1e-4 * largest, "{word} {q}: {slope} {by_rows}");
            }
        }
    }
}
