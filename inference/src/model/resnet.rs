//! The core's network in f32: its 8-bit weights, without the core's rounding of what they multiply.
//!
//! Responses to correctors are the network's, all 24 of a plane evaluated at once; tunes and dispersion, which it does not know, are
//! those of the Green's function. A function of the response is differentiated backwards through both.

use estimator::surrogate::{CURRENTS, LAST_VAR, ORBIT, SETTING_KICK, SPAN, TUNE_SPAN};
use nalgebra::DMatrix;
use training::network::fit::columns;
use training::network::layers::{Network, Pass};
use training::network::settings::{self, settings};
use training::network::{PLANES, tables};
use twin::OrbitError;

use super::Optics;
use super::green::{GreenModel, GreenOptics};

/// The trained networks, and the Green's function for what they do not know.
#[derive(Debug, Clone)]
pub struct ResnetModel {
    green: GreenModel,
    planes: [Network; 2],
    /// Tunes of the design.
    tunes: [f64; 2],
}

/// The network at given vars.
#[derive(Debug)]
pub struct ResnetOptics<'m> {
    model: &'m ResnetModel,
    green: GreenOptics<'m>,
    passes: [Pass; 2],
    vars: Vec<f64>,
}

/// Correctors of a plane.
const CORRECTORS: usize = 24;
/// Derivative of a response with respect to an output of the network [m/rad].
const SCALE: f32 = ORBIT / SETTING_KICK;

impl ResnetModel {
    /// With the Green's function of the same ring.
    pub fn from_green(green: GreenModel) -> Self {
        Self::with_networks(green, PLANES.map(|core| tables::network(&core)))
    }

    /// The same with other weights: those that were not rounded.
    pub fn with_networks(green: GreenModel, planes: [Network; 2]) -> Self {
        let tunes = green.tunes().map(|tune| tune.rem_euclid(1.0));
        Self { green, planes, tunes }
    }

    /// Stated rms error at monitor `b` [m].
    pub fn stated_error(&self, b: usize) -> f64 {
        PLANES[usize::from(b >= PLANES[0].shape().1)].stated_error().into()
    }

    /// False outside the vars and the tunes that it was trained on.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn is_within(&self, vars: &[f64]) -> Result<bool, OrbitError> {
        let tunes = self.green.at(vars)?.tunes();
        let is_near = |(tune, design): (f64, &f64)| (tune - design).abs() <= f64::from(TUNE_SPAN);
        let has_vars = vars.iter().all(|var| (var - 1.0).abs() <= f64::from(SPAN));
        Ok(has_vars && tunes.into_iter().zip(&self.tunes).all(is_near))
    }

    /// The ring at given vars, times what their currents make of them.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn at(&self, vars: &[f64]) -> Result<ResnetOptics<'_>, OrbitError> {
        let inputs = settings(vars);
        let passes = self.planes.each_ref().map(|network| {
            let mut pass = Pass::new(network, CORRECTORS);
            pass.forward(network, &columns(&inputs, 0, CORRECTORS));
            pass
        });
        Ok(ResnetOptics { model: self, green: self.green.at(vars)?, passes, vars: vars.to_vec() })
    }
}

impl ResnetOptics<'_> {
    /// First monitor and first corrector of a plane, and its number of monitors.
    fn place(plane: usize) -> (usize, usize, usize) {
        let across = PLANES[0].shape().1;
        if plane == 0 { (0, 0, across) } else { (across, CORRECTORS, PLANES[1].shape().1) }
    }

    /// Derivative with respect to `ln` of each var, a column a corrector, of a function of a plane's response from its derivative.
    fn slopes(&self, plane: usize, weights: &DMatrix<f64>) -> DMatrix<f64> {
        let by_output = weights.map(|weight| weight as f32 * SCALE);
        let slopes = self.passes[plane].input_slopes(&self.model.planes[plane], &by_output);
        DMatrix::from_fn(self.vars.len(), CORRECTORS, |var, c| {
            self.vars[var] * f64::from(slopes[(CORRECTORS + CURRENTS + var, c)] * (LAST_VAR / SPAN))
        })
    }
}

impl Optics for ResnetOptics<'_> {
    fn response(&self) -> DMatrix<f64> {
        let mut response = self.green.response();
        let own = settings::response(self.passes.each_ref().map(Pass::outputs));
        for plane in [0, 1] {
            let (first, across, monitors) = Self::place(plane);
            let block = ((first, across), (monitors, CORRECTORS));
            response.view_mut(block.0, block.1).copy_from(&own.view(block.0, block.1));
        }
        response
    }

    fn pull_back(&self, weights: &DMatrix<f64>) -> Vec<f64> {
        let mut rf = weights.clone();
        rf.columns_mut(0, 2 * CORRECTORS).fill(0.0);
        let mut gradient = self.green.pull_back(&rf);
        for plane in [0, 1] {
            let (first, across, monitors) = Self::place(plane);
            let slopes = self.slopes(plane, &weights.view((first, across), (monitors, CORRECTORS)).into_owned());
            gradient.iter_mut().zip(slopes.row_iter()).for_each(|(gradient, slopes)| *gradient += slopes.sum());
        }
        gradient
    }

    /// All entries of a monitor's row at once, as no corrector's depends on another one.
    fn rows(&self) -> Vec<DMatrix<f64>> {
        let mut rows = Vec::new();
        for plane in [0, 1] {
            let (_, across, monitors) = Self::place(plane);
            for b in 0..monitors {
                let mut unit = DMatrix::zeros(monitors, CORRECTORS);
                unit.row_mut(b).fill(1.0);
                let mut row = DMatrix::zeros(2 * CORRECTORS + 1, self.vars.len());
                row.view_mut((across, 0), (CORRECTORS, self.vars.len()))
                    .copy_from(&self.slopes(plane, &unit).transpose());
                let mut rf = DMatrix::zeros(PLANES[0].shape().1 + PLANES[1].shape().1, 2 * CORRECTORS + 1);
                rf[(rows.len(), 2 * CORRECTORS)] = 1.0;
                row.row_mut(2 * CORRECTORS).copy_from_slice(&self.green.pull_back(&rf));
                rows.push(row);
            }
        }
        rows
    }

    fn tunes(&self) -> [f64; 2] {
        self.green.tunes()
    }

    fn tune_slopes(&self) -> Vec<[f64; 2]> {
        self.green.tune_slopes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use twin::{Ring, VariedRing};

    fn example() -> (ResnetModel, Vec<f64>) {
        let tables = training::green::tables(&Ring::booster()).unwrap();
        let vars = (0..48).map(|i| 1.0 + 0.03 * f64::sin(3.0 * f64::from(i))).collect();
        (ResnetModel::from_green(GreenModel::from_tables(&tables)), vars)
    }

    /// For kicks of 0.278 mrad, to four times the error that the tables state.
    #[test]
    fn it_predicts_as_the_twin() {
        let (model, vars) = example();
        let exact = VariedRing::of(&Ring::booster()).unwrap().at(&vars).unwrap().response();
        let error = (model.at(&vars).unwrap().response() - &exact) * f64::from(SETTING_KICK);
        for (first, monitors, plane) in [(0, 15, 0), (15, 18, 1)] {
            let error = error.view((first, 24 * plane), (monitors, 24));
            let rms = error.norm() / f64::sqrt(error.len() as f64);
            assert!(rms < 4.0 * model.stated_error(first), "{rms} m, stated {} m", model.stated_error(first));
        }
    }

    #[test]
    fn a_ring_beyond_the_training_is_told() {
        let (model, vars) = example();
        assert!(model.is_within(&vars).unwrap());
        let far: Vec<f64> = vars.iter().enumerate().map(|(i, var)| if i == 7 { 1.07 } else { *var }).collect();
        assert!(!model.is_within(&far).unwrap());
    }
}
