//! Every surrogate of the Booster beside the twin: `docs/surrogates.md`.

mod errors;
mod posterior;

use core::error::Error;
use std::path::Path;

use inference::{GreenModel, ResnetModel, ResponseModel};
use nalgebra::DMatrix;
use training::network::fit::{Plan, Trainee};
use training::network::samples::Source;
use training::network::settings::response_of_core;
use training::network::{PLANES, checkpoint};
use twin::Ring;

pub use errors::{BANDS, Machine, bands, beyond, errors, even, map, prior};
pub use posterior::{Effect, effects};

/// Correctors of a plane, and monitors of x.
const CORRECTORS: usize = 24;
const FIRST: usize = 15;

/// All responses at given vars [m/rad].
type Predict = dyn Fn(&[f64]) -> DMatrix<f64>;

/// What predicts them.
pub struct Surrogate {
    /// Its name in the tables.
    pub name: &'static str,
    predict: Box<Predict>,
    /// Rms error that it states of the orbit of one setting, in x and y [m].
    pub stated: Option<[f64; 2]>,
    /// The same as a model of the host, where there is one.
    pub model: Option<ResponseModel>,
}

impl Surrogate {
    /// Rows monitors, columns correctors, and the RF where it knows that [m/rad].
    pub fn predict(&self, vars: &[f64]) -> DMatrix<f64> {
        (self.predict)(vars)
    }

    fn of(name: &'static str, model: ResponseModel) -> Self {
        let own = model.clone();
        let predict = move |vars: &[f64]| {
            let strength: Vec<f64> = vars.iter().map(|var| var.ln()).collect();
            own.predict(&strength).expect("stable, as the twin is").response
        };
        let rms = |from: usize, to: usize| {
            let squares: f64 = (from..to).map(|b| model.stated_error(b).powi(2)).sum();
            (squares / (to - from) as f64).sqrt()
        };
        let stated = [rms(0, FIRST), rms(FIRST, FIRST + PLANES[1].shape().1)];
        Self { name, predict: Box::new(predict), stated: (stated[0] > 0.0).then_some(stated), model: Some(model) }
    }
}

/// All of them, the twin first; the network in f32 if there is a checkpoint of its training.
///
/// # Errors
/// If a table cannot be made or the checkpoint not be read.
pub fn surrogates(ring: &Ring, checkpoint: Option<&Path>) -> Result<Vec<Surrogate>, Box<dyn Error>> {
    let mut all = vec![
        Surrogate::of("twin", ResponseModel::twin(ring)?),
        Surrogate::of("linear", ResponseModel::linear(ring)?),
        Surrogate::of("green f64", ResponseModel::Green(Box::new(GreenModel::unrounded(ring)?))),
        Surrogate::of("green i16", ResponseModel::green(ring)?),
        Surrogate {
            name: "resnet int8",
            predict: Box::new(response_of_core),
            stated: Some(PLANES.map(|plane| plane.stated_error().into())),
            model: Some(ResponseModel::resnet(ring)?),
        },
    ];
    if let Some(path) = checkpoint {
        let source = Source::of(ring);
        let mut planes = [0, 1].map(|plane| Trainee::new(&source, plane, &Plan::FULL));
        checkpoint::load(path, &mut planes)?;
        let green = GreenModel::from_tables(&training::green::tables(ring)?);
        let free = ResnetModel::with_networks(green, planes.map(|plane| plane.free));
        all.push(Surrogate::of("resnet f32", ResponseModel::Resnet(Box::new(free))));
    }
    Ok(all)
}
