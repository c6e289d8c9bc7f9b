//! What predicts the readings: the exact twin, or the surrogate's Green's function in f64.
//!
//! Both answer with the orbit response [m/rad] of the read monitors to the correctors and, as one more column, to the RF
//! frequency: `-D/eta`, the orbit of a unit of relative offset [m]. And both give the gradient of any function of it.

mod green;

use nalgebra::DMatrix;
use training::BoosterGreen;
use twin::{OrbitError, Ring, VariedRing};

pub use green::GreenModel;

/// A model of the ring in its vars.
#[derive(Debug, Clone)]
pub enum ResponseModel {
    /// The exact twin.
    Twin(Box<VariedRing>),
    /// The Green's function with the tables of the core, in f64.
    Green(Box<GreenModel>),
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
        let tables: BoosterGreen = training::green::tables(ring)?;
        Ok(Self::Green(Box::new(GreenModel::of(&tables))))
    }

    /// The word for it.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Twin(_) => "twin",
            Self::Green(_) => "green",
        }
    }

    /// Rms error of one predicted orbit at monitor `b` [m], the same at each repeat of a setting.
    pub fn stated_error(&self, b: usize) -> f64 {
        match self {
            Self::Twin(_) => 0.0,
            Self::Green(green) => green.stated_error(b),
        }
    }

    /// Response at `params`, `ln` of each gradient factor: rows monitors, columns correctors and the RF.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn response(&self, params: &[f64]) -> Result<DMatrix<f64>, OrbitError> {
        match self {
            Self::Twin(ring) => Ok(ring.at(params, &[])?.response()),
            Self::Green(green) => Ok(green.at(&exponential(params))?.response()),
        }
    }

    /// Evaluate a function of the response, which returns its value and its derivative with respect to each entry; returns
    /// the value and its gradient with respect to the params.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn differentiate<V>(
        &self,
        params: &[f64],
        function: impl FnOnce(&DMatrix<f64>) -> (V, DMatrix<f64>),
    ) -> Result<(V, Vec<f64>), OrbitError> {
        match self {
            Self::Twin(ring) => {
                let optics = ring.at(params, &[])?;
                let (value, weights) = function(&optics.response());
                Ok((value, optics.pull_back(&weights)))
            }
            Self::Green(green) => {
                let optics = green.at(&exponential(params))?;
                let (value, weights) = function(&optics.response());
                Ok((value, optics.pull_back(&weights)))
            }
        }
    }

    /// Derivative of the response at monitor `b`, rows as its columns, columns params.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn jacobian(&self, params: &[f64]) -> Result<Vec<DMatrix<f64>>, OrbitError> {
        match self {
            Self::Twin(ring) => {
                let optics = ring.at(params, &[])?;
                Ok(rows_of(&optics.response(), params.len(), |weights| optics.pull_back(weights)))
            }
            Self::Green(green) => {
                let optics = green.at(&exponential(params))?;
                Ok(rows_of(&optics.response(), params.len(), |weights| optics.pull_back(weights)))
            }
        }
    }
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
