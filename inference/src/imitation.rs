//! What vars make of magnets that are off throughout the ring, where the design is taken for exact: in core, batch fit and draws.
//!
//! Such a fit finds `theta + P b` instead of theta, with `b` the amplitudes of the base model's terms that change the magnets, whose prior is normal
//! with covariance W, and
//!
//! `P = (J^T A J + D^-1)^-1 J^T A S`
//!
//! the change of theta that imitates S, the derivative of the readings by `b`; J is that by theta, A the precision of the readings, D the prior covariance of
//! theta. The vars as found belong to the design's magnets: that ring has the orbits and tunes of the machine. As strengths of its quadrupoles they have the covariance
//!
//! `C + P W P^T`.
//!
//! To first order about the design; what the readings or the prior of theta tell of `b` is not used. Of two decks of one machine, each fitted with the other's ring, the NEES per
//! var is 0.75 to 1.25, where without it is 1.1 to 3.4 (`tests/deck.rs`).

use nalgebra::{DMatrix, DVector};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use twin::{Machine, OrbitError, Ring};

use crate::base_model::BaseModel;
use crate::campaign::{Linearised, TUNE_CALIBRATION};
use crate::draws::Draws;
use crate::prior::Prior;
use crate::recording::Recording;

/// How vars imitate a base model in one recording.
#[derive(Debug, Clone)]
pub struct Imitation {
    /// `P W^(1/2)`: change of theta for one width of each term [N][K].
    pattern: DMatrix<f64>,
}

impl Imitation {
    /// In the frames of a recording, about the design.
    ///
    /// # Errors
    /// [`OrbitError`] if that is not stable.
    ///
    /// # Panics
    /// If the recording is of another ring.
    pub fn from_recording(ring: &Ring, recording: &Recording) -> Result<Self, OrbitError> {
        let (ring, base) = (recording.powered(ring).into_owned(), BaseModel::MAGNETS);
        let prior = Prior::from_ring(&ring);
        let (vars, terms) = (prior.len(), base.terms().len());
        let believed = recording.header.believed(&ring).expect("the header is checked against its ring");
        let machine = Machine::new(ring, believed, &[]).expect("there is no effect");
        let (drives, supplies) = (recording.drives(), recording.mean_supplies());
        let linearised = Linearised::about((&machine, base), &DVector::zeros(vars + terms), &supplies, &drives)?;
        let mut information = DMatrix::zeros(vars + terms, vars + terms);
        for (mut slopes, noise) in linearised.slopes(&drives).into_iter().zip(&recording.header.noise) {
            // a baseline takes the mean
            let mean = slopes.column_mean();
            slopes.column_iter_mut().for_each(|mut column| column -= &mean);
            information.gemm(noise.powi(-2), &slopes, &slopes.transpose(), 1.0);
        }
        if recording.rows.iter().any(|row| row.tune.iter().any(Option::is_some)) {
            information.gemm(
                TUNE_CALIBRATION.powi(-2),
                &linearised.tune_slopes.transpose(),
                &linearised.tune_slopes,
                1.0,
            );
        }
        let normal = information.view_range(..vars, ..vars) + DMatrix::from_diagonal(&prior.precision);
        let factor = normal.cholesky().expect("a prior's precision is positive");
        let mut pattern = factor.solve(&information.view_range(..vars, vars..).into_owned());
        pattern.column_iter_mut().zip(base.terms()).for_each(|(mut column, term)| column *= term.width());
        Ok(Self { pattern })
    }

    /// Covariance of theta, given that with an exact design.
    pub fn widened(&self, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        covariance + &self.pattern * self.pattern.transpose()
    }

    /// Draws of the vars, given those with an exact design.
    pub fn redrawn(&self, draws: &Draws, seed: u64) -> Draws {
        let (mut redrawn, mut random) = (draws.clone(), StdRng::seed_from_u64(seed));
        for draw in redrawn.chains.iter_mut().flat_map(|chain| &mut chain.draws) {
            let amplitudes = DVector::from_fn(self.pattern.ncols(), |_, _| random.sample::<f64, _>(StandardNormal));
            let imitated = &self.pattern * amplitudes;
            draw.iter_mut().zip(&imitated).for_each(|(var, imitated)| *var *= imitated.exp());
        }
        redrawn
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::draws::Chain;
    use crate::{BatchFit, Campaign, TuneUse};

    fn recorded() -> (Ring, Recording) {
        let (ring, folder) = (Ring::booster(), Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars"));
        let recording = Recording::read(&folder, &ring).unwrap();
        (ring, recording)
    }

    /// A recording fitted with the design, and with a design whose dipoles have a gradient of a tenth of the width: the vars differ by the pattern.
    #[test]
    fn vars_imitate_a_gradient_in_all_dipoles() {
        let (ring, recording) = recorded();
        let imitation = Imitation::from_recording(&ring, &recording).unwrap();
        let fitted = |ring: &Ring| {
            let campaign = Campaign::of(ring, &recording).unwrap();
            BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ()).unwrap().map_params
        };
        let width = BaseModel::MAGNETS.terms()[0].width();
        let other = BaseModel::MAGNETS.ring(&ring, &[0.1 * width, 0.0, 0.0]);
        let moved: Vec<f64> = fitted(&ring).iter().zip(fitted(&other)).map(|(here, there)| here - there).collect();
        let largest = imitation.pattern.column(0).amax();
        for (moved, pattern) in moved.iter().zip(&imitation.pattern.column(0)) {
            // the derivatives are those of the design, whose vars are off by some per cent
            assert!((10.0 * moved - pattern).abs() < 0.15 * largest, "{moved} {pattern}");
        }
    }

    #[test]
    fn draws_are_widened_as_the_covariance_is() {
        let (ring, recording) = recorded();
        let imitation = Imitation::from_recording(&ring, &recording).unwrap();
        let chain = Chain { draws: vec![vec![1.0; 48]; 4000], ..Chain::default() };
        let draws = imitation.redrawn(&Draws { names: ring.var_names(), chains: vec![chain] }, 5);
        let covariance = imitation.widened(&DMatrix::zeros(48, 48));
        for i in [0, 5, 31] {
            let square = draws.chains[0].draws.iter().map(|draw| draw[i].ln().powi(2)).sum::<f64>() / 4000.0;
            // four standard errors of 4000 draws
            assert!((square / covariance[(i, i)] - 1.0).abs() < 4.0 * (2.0_f64 / 4000.0).sqrt(), "{i}");
        }
    }
}
