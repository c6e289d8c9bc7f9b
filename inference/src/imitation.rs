//! What vars make of magnets that are off throughout the ring, where the design is taken for exact: in core, batch fit and draws.
//!
//! Such a fit finds `theta + P b` instead of theta, with `b` the amplitudes of the base model's terms that change the magnets, whose prior is normal
//! with covariance W, and
//!
//! `P = (J^T A J + D^-1)^-1 J^T A S`
//!
//! the change of theta that imitates S, the derivative of the readings by `b`; J is that by theta, A the precision of the readings, D the prior covariance of
//! theta. The vars as found belong to the design's magnets: that ring has the orbits and tunes of the machine. As strengths of its quadrupoles they have
//! the covariance
//!
//! `M C M^T + P G P^T`,      `G = (W^-1 + P^T D^-1 P)^-1`,      `M = 1 - P G P^T D^-1`,
//!
//! C that of the fit: never wider than the prior. J and S have to be of one machine: with C for the inverse, which is that of another, the stiffest directions leak into the others.
//!
//! To first order about the design, with the header's noise and one baseline a monitor; what the readings tell of `b` is not used, nor is the shift of the vars that their prior tells of it. Of two decks of one
//! machine, each fitted with the other's ring, the NEES per var is 0.7 to 1.3, where without it is up to 3.4 (`deck.rs` among the tests of `diagnosis`).

use nalgebra::{DMatrix, DVector};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use twin::{Machine, OrbitError, Ring};

use crate::base_model::BaseModel;
use crate::campaign::{Linearised, Meter};
use crate::draws::Draws;
use crate::prior::Prior;
use crate::recording::{Drive, Recording};

/// How vars imitate a base model in one recording.
#[derive(Debug, Clone)]
pub struct Imitation {
    /// P times a root of G: a standard deviation of theta for each of as many independent amplitudes [N][K].
    pattern: DMatrix<f64>,
    /// One over the prior variance of each theta.
    precision: DVector<f64>,
    /// Of each theta.
    range: Vec<[f64; 2]>,
}

impl Imitation {
    /// In the frames of a recording.
    ///
    /// # Errors
    /// [`OrbitError`] if the design, or one beside it, has no stable orbit.
    ///
    /// # Panics
    /// If the recording is of another ring.
    pub fn new(ring: &Ring, recording: &Recording) -> Result<Self, OrbitError> {
        let (ring, base) = (recording.powered(ring).into_owned(), BaseModel::MAGNETS);
        let prior = Prior::from_ring(&ring);
        let (vars, terms) = (prior.len(), base.terms().len());
        let believed = recording.header.believed(&ring).expect("the header is checked against its ring");
        let machine = Machine::new(ring, believed, &[]).expect("there is no effect");
        let (drives, supplies) = (recording.drives(), recording.mean_supplies());
        let linearised = Linearised::about((&machine, base), &DVector::zeros(vars + terms), &supplies, &drives)?;
        let scatter = scatter(recording, &drives);
        let mut information = DMatrix::zeros(vars + terms, vars + terms);
        for (b, weight) in weights(recording).into_iter().enumerate() {
            let slopes = linearised.slopes_at(b);
            information.gemm(weight, &(&slopes * &scatter), &slopes.transpose(), 1.0);
        }
        for (slopes, weight) in linearised.tune_slopes.row_iter().zip(tune_information(recording)) {
            information.gemm(weight, &slopes.transpose(), &slopes, 1.0);
        }
        let normal = information.view_range(..vars, ..vars) + DMatrix::from_diagonal(&prior.precision);
        let factor = normal.cholesky().expect("a prior's precision is positive");
        let mut pattern = factor.solve(&information.view_range(..vars, vars..).into_owned());
        pattern.column_iter_mut().zip(base.terms()).for_each(|(mut column, term)| column *= term.width());
        let weighed = DMatrix::from_diagonal(&prior.precision) * &pattern;
        let amplitudes = DMatrix::identity(terms, terms) + pattern.tr_mul(&weighed);
        let root = amplitudes.cholesky().expect("a sum with the identity is positive").inverse().cholesky();
        let root = root.expect("an inverse of a positive matrix is positive").unpack();
        Ok(Self { pattern: pattern * root, precision: prior.precision, range: prior.range })
    }

    /// Covariance of theta, given that with an exact design.
    pub fn widened(&self, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        let imitated = &self.pattern * self.pattern.transpose();
        let kept = DMatrix::identity(covariance.nrows(), covariance.ncols())
            - &imitated * DMatrix::from_diagonal(&self.precision);
        &kept * covariance * kept.transpose() + imitated
    }

    /// Draws of the vars, given those with an exact design, whose log-densities they keep; within the range of the prior.
    pub fn redrawn(&self, draws: &Draws, seed: u64) -> Draws {
        let (mut redrawn, mut random) = (draws.clone(), StdRng::seed_from_u64(seed));
        for draw in redrawn.chains.iter_mut().flat_map(|chain| &mut chain.draws) {
            let amplitudes = DVector::from_fn(self.pattern.ncols(), |_, _| random.sample::<f64, _>(StandardNormal));
            let imitated = &self.pattern * amplitudes;
            for ((var, imitated), [lower, upper]) in draw.iter_mut().zip(&imitated).zip(&self.range) {
                *var = (var.ln() + imitated).clamp(*lower, *upper).exp();
            }
        }
        redrawn
    }
}

/// Scatter of the drives of the frames with beam about their mean, which the baselines take: kicks and RF offset [C + 1][C + 1].
fn scatter(recording: &Recording, drives: &[Drive]) -> DMatrix<f64> {
    let with_beam = drives.iter().zip(&recording.rows).filter(|(_, row)| !row.is_without_beam());
    let columns: Vec<DVector<f64>> = with_beam.map(|(drive, _)| drive.kick.push(drive.rf_offset)).collect();
    let size = drives.first().map_or(0, |drive| drive.kick.len() + 1);
    let sum = columns.iter().fold(DVector::zeros(size), |sum: DVector<f64>, drive| sum + drive);
    let mean = sum / columns.len().max(1) as f64;
    let mut scatter = DMatrix::zeros(size, size);
    columns.iter().map(|drive| drive - &mean).for_each(|off| scatter.ger(1.0, &off, &off, 1.0));
    scatter
}

/// Precision of one reading of each monitor, times the share of frames in which it reports [1/m^2].
fn weights(recording: &Recording) -> Vec<f64> {
    let share = |b: usize| {
        let reported = recording.rows.iter().filter(|row| row.reading[b].is_some()).count();
        reported as f64 / recording.rows.len().max(1) as f64
    };
    recording.header.noise.iter().enumerate().map(|(b, noise)| share(b) / (noise * noise)).collect()
}

/// What a meter tells of the tune in x and in y, 0 without one.
fn tune_information(recording: &Recording) -> [f64; 2] {
    [0, 1]
        .map(|plane| Meter::from_recording(recording, plane).map_or(0.0, |meter| meter.whiten.column(0).norm_squared()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draws::Chain;
    use crate::testing::recorded;
    use crate::{BatchFit, Campaign, TuneUse};

    fn fitted(ring: &Ring, recording: &Recording) -> BatchFit {
        let campaign = Campaign::of(ring, recording).unwrap();
        BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ()).unwrap()
    }

    /// A recording fitted with the design, and with one whose dipoles have a gradient of a tenth of the width: the vars differ by the pattern.
    #[test]
    fn vars_imitate_a_gradient_in_all_dipoles() {
        let ring = Ring::booster();
        let recording = recorded(&ring, "paper-vars");
        let fit = fitted(&ring, &recording);
        let imitation = Imitation::new(&ring, &recording).unwrap();
        let width = BaseModel::MAGNETS.terms()[0].width();
        let other = fitted(&BaseModel::MAGNETS.ring(&ring, &[0.1 * width, 0.0, 0.0]), &recording);
        let moved: Vec<f64> = fit.map_params.iter().zip(&other.map_params).map(|(here, there)| here - there).collect();
        let moved = DVector::from_vec(moved);
        let normal = imitation.pattern.tr_mul(&imitation.pattern);
        let left = &moved - &imitation.pattern * normal.cholesky().unwrap().solve(&imitation.pattern.tr_mul(&moved));
        // the derivatives are those of the design, whose vars are off by some per cent
        assert!(left.norm() < 0.15 * moved.norm(), "{} {}", left.norm(), moved.norm());
    }

    #[test]
    fn error_bars_are_never_wider_than_the_prior() {
        let ring = Ring::booster();
        let recording = recorded(&ring, "paper-vars");
        let ring = crate::with_priors(&ring, Some(1e-4), None);
        let widened = Imitation::new(&ring, &recording).unwrap().widened(&fitted(&ring, &recording).covariance);
        assert!((0..48).all(|i| widened[(i, i)].sqrt() < 1.001e-4));
    }

    #[test]
    fn draws_are_widened_as_the_covariance_is() {
        let ring = Ring::booster();
        let recording = recorded(&ring, "paper-vars");
        let imitation = Imitation::new(&ring, &recording).unwrap();
        let chain = Chain { draws: vec![vec![1.0; 48]; 4000], ..Chain::default() };
        let draws = imitation.redrawn(&Draws { names: ring.var_names(), chains: vec![chain] }, 5);
        let covariance = &imitation.pattern * imitation.pattern.transpose();
        for i in [0, 5, 31] {
            let square = draws.chains[0].draws.iter().map(|draw| draw[i].ln().powi(2)).sum::<f64>() / 4000.0;
            // four standard errors of 4000 draws
            assert!((square / covariance[(i, i)] - 1.0).abs() < 4.0 * (2.0_f64 / 4000.0).sqrt(), "{i}");
        }
    }
}
