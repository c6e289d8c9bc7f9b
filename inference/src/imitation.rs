//! What vars make of magnets that are off throughout the ring, where the design is taken for exact: in core, batch fit and draws.
//!
//! Such a fit finds `theta + P b` instead of theta, with `b` the amplitudes of the base model's terms that change the magnets, whose prior is normal
//! with covariance W, and
//!
//! `P = (J^T A J + D^-1)^-1 J^T A S`
//!
//! the change of theta that imitates S, the derivative of the readings by `b`; J is that by theta, A the precision of the readings, D the prior covariance of
//! theta. Given what was found, `b` is normal with covariance `G = (W^-1 + P^T D^-1 P)^-1` and mean `G P^T D^-1 (found - prior mean)`, so that
//!
//! `theta = found - P mean`, covariance `M C M^T + P G P^T`, `M = 1 - P G P^T D^-1`.
//!
//! To first order about the design, readings that P leaves unexplained not used: of two decks of one machine each fitted with the other's ring the NEES per var is
//! 0.8 to 1.5, where without it is 2.4 to 3.4 (`tests/deck.rs`).

use nalgebra::{DMatrix, DVector};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use twin::{Machine, Measured, OrbitError, Ring};

use crate::base_model::{BaseModel, BaseTerm, FittedTerm};
use crate::campaign::{Linearised, TUNE_CALIBRATION};
use crate::draws::Draws;
use crate::prior::Prior;
use crate::recording::Recording;

/// How vars imitate the terms of a base model in one recording.
#[derive(Debug, Clone)]
pub struct Imitation {
    prior: Prior,
    /// P [N][K].
    pattern: DMatrix<f64>,
    /// G [K][K], and its root.
    covariance: DMatrix<f64>,
    root: DMatrix<f64>,
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
        let pattern = factor.solve(&information.view_range(..vars, vars..).into_owned());
        Ok(Self::new(prior, pattern, base))
    }

    fn new(prior: Prior, pattern: DMatrix<f64>, base: BaseModel) -> Self {
        let widths = base.terms().iter().map(|term| term.width().powi(-2));
        let of_terms = DMatrix::from_diagonal(&DVector::from_iterator(pattern.ncols(), widths));
        let normal = of_terms + pattern.tr_mul(&(DMatrix::from_diagonal(&prior.precision) * &pattern));
        let covariance = normal.cholesky().expect("a width is positive").inverse();
        let root = covariance.clone().cholesky().expect("an inverse of a positive matrix is positive").unpack();
        Self { prior, pattern, covariance, root }
    }

    /// Mean and covariance of theta, given those that were found.
    pub fn corrected(&self, found: &DVector<f64>, covariance: &DMatrix<f64>) -> (DVector<f64>, DMatrix<f64>) {
        let spread = &self.pattern * &self.covariance;
        let of_terms = &spread * self.pattern.transpose();
        let kept =
            DMatrix::identity(found.len(), found.len()) - &of_terms * DMatrix::from_diagonal(&self.prior.precision);
        (found - &self.pattern * self.mean(found), &kept * covariance * kept.transpose() + of_terms)
    }

    /// The amplitudes of the terms, given mean and covariance of theta that were found.
    pub fn amplitudes(&self, found: &DVector<f64>, covariance: &DMatrix<f64>) -> Vec<FittedTerm> {
        let weighed = DMatrix::from_diagonal(&self.prior.precision) * &self.pattern * &self.covariance;
        let variance = &self.covariance + weighed.tr_mul(&(covariance * &weighed));
        let fitted = |(k, (&term, &value)): (usize, (&BaseTerm, &f64))| FittedTerm {
            term,
            measured: Measured { value, sigma: variance[(k, k)].sqrt() },
        };
        BaseModel::MAGNETS.terms().iter().zip(&self.mean(found)).enumerate().map(fitted).collect()
    }

    /// Draws of the vars, given those that take the design for exact.
    pub fn redrawn(&self, draws: &Draws, seed: u64) -> Draws {
        let (mut redrawn, mut random) = (draws.clone(), StdRng::seed_from_u64(seed));
        for draw in redrawn.chains.iter_mut().flat_map(|chain| &mut chain.draws) {
            let found = DVector::from_iterator(draw.len(), draw.iter().map(|var| var.ln()));
            *draw = self.draw(&found, &mut random).iter().map(|theta| theta.exp()).collect();
        }
        redrawn
    }

    fn draw(&self, found: &DVector<f64>, random: &mut StdRng) -> DVector<f64> {
        let normal = DVector::from_fn(self.root.ncols(), |_, _| random.sample::<f64, _>(StandardNormal));
        found - &self.pattern * (self.mean(found) + &self.root * normal)
    }

    /// Mean of the amplitudes.
    fn mean(&self, found: &DVector<f64>) -> DVector<f64> {
        let off = (found - &self.prior.mean).component_mul(&self.prior.precision);
        &self.covariance * self.pattern.tr_mul(&off)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn imitation() -> Imitation {
        let prior = Prior::from_ring(&Ring::booster());
        let pattern = DMatrix::from_fn(48, 3, |i, k| (1.3 * (i * (k + 1)) as f64).sin() * [3.0, 0.5, 1.0][k]);
        Imitation::new(prior, pattern, BaseModel::MAGNETS)
    }

    /// The posterior of theta and amplitudes together, from `found = theta + P b + error`, for an error that is small beside the prior.
    #[test]
    fn what_is_corrected_is_the_joint_posterior() {
        let Imitation { prior, pattern, .. } = imitation();
        let found = DVector::from_fn(48, |i, _| 0.02 * (0.7 * i as f64).cos());
        let precision = DMatrix::from_diagonal_element(48, 48, 1e4_f64.powi(2));
        let mut design: DMatrix<f64> = DMatrix::identity(48, 51);
        design.columns_mut(48, 3).copy_from(&pattern);
        let widths = BaseModel::MAGNETS.terms().iter().map(|term| term.width().powi(-2));
        let mut normal = design.tr_mul(&(&precision * &design));
        let mut pull = design.tr_mul(&(&precision * &found));
        for (i, own) in prior.precision.iter().copied().chain(widths).enumerate() {
            normal[(i, i)] += own;
            pull[i] += if i < 48 { own * prior.mean[i] } else { 0.0 };
        }
        let covariance = normal.cholesky().unwrap().inverse();
        let joint = (&covariance * pull, covariance);
        let (mean, covariance) = imitation().corrected(&found, &precision.try_inverse().unwrap());
        // the error's variance over the prior's: 1e-5
        assert!((mean - joint.0.rows(0, 48)).amax() < 1e-5 * 0.03);
        assert!((covariance - joint.1.view_range(..48, ..48)).amax() < 1e-4 * 0.03_f64.powi(2));
    }

    #[test]
    fn draws_have_the_mean_and_covariance_that_are_stated() {
        let (imitation, mut random) = (imitation(), StdRng::seed_from_u64(5));
        let found = DVector::from_fn(48, |i, _| 0.02 * (0.7 * i as f64).cos());
        let (mean, covariance) = imitation.corrected(&found, &DMatrix::zeros(48, 48));
        let draws: Vec<DVector<f64>> = (0..4000).map(|_| imitation.draw(&found, &mut random)).collect();
        for i in [0, 5, 31] {
            let values: Vec<f64> = draws.iter().map(|draw| draw[i] - mean[i]).collect();
            let (sum, square) = (values.iter().sum::<f64>(), values.iter().map(|v| v * v).sum::<f64>());
            let sigma = covariance[(i, i)].sqrt();
            // four standard errors of 4000 draws
            assert!((sum / 4000.0).abs() < 4.0 * sigma / 4000f64.sqrt());
            assert!((square / 4000.0 / sigma.powi(2) - 1.0).abs() < 4.0 * (2.0 / 4000.0f64).sqrt());
        }
    }
}
