//! The core's Green's function in f64: its 16-bit tables, without the core's rounding.
//!
//! Equations and symbols as in [`estimator::surrogate::Green`]; here `Z` comes from one factorisation of `1 + G_qq D` a
//! plane, and a function of the response is differentiated backwards: with `w = df/dR`,
//!
//! `df/d(ln strength of node n) = -k L w_n strength (Z_qb w Z_qc^T)_nn`.

use core::f64::consts::{PI, TAU};

use estimator::surrogate::{List, Table};
use nalgebra::{DMatrix, DVector, Dyn, LU};
use serde::Serialize;
use training::Tables;
use training::green::{PlaneResponses, TrainingError};
use twin::{OrbitError, Ring};

use super::Optics;

/// Green's function tables in f64; serialised, they are all that another code needs to predict the same orbits.
#[derive(Debug, Clone, Serialize)]
pub struct GreenModel {
    planes: [Plane; 2],
    dispersion: Dispersion,
    stated_error: [f64; 2],
}

#[derive(Debug, Clone, Serialize)]
struct Plane {
    /// `x` or `y`.
    mode: char,
    /// Tune of the design.
    tune: f64,
    direct: DMatrix<f64>,
    seen: DMatrix<f64>,
    driven: DMatrix<f64>,
    mutual: DMatrix<f64>,
    weight: Vec<f64>,
}

#[derive(Debug, Clone, Serialize)]
struct Dispersion {
    monitor: DVector<f64>,
    node: DVector<f64>,
    compaction: f64,
    inverse_gamma_squared: f64,
    circumference: f64,
}

/// The Green's function at given vars.
#[derive(Debug)]
pub struct GreenOptics<'m> {
    model: &'m GreenModel,
    planes: [PlaneOptics; 2],
    monitor_dispersion: DVector<f64>,
    node_dispersion: DVector<f64>,
    slip: f64,
}

/// One plane at given vars.
#[derive(Debug)]
struct PlaneOptics {
    seen: DMatrix<f64>,
    driven: DMatrix<f64>,
    response: DMatrix<f64>,
    /// `k L w strength` of each node.
    slope: Vec<f64>,
    /// Fractional tune.
    tune: f64,
    /// Factors of `1 + G_qq D`.
    closure: LU<f64, Dyn, Dyn>,
}

impl GreenModel {
    /// From the core's tables; terms of low rank, which a design has none of, are left out.
    pub fn from_tables(tables: &Tables) -> Self {
        let list = |list| tables.list(list).iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
        let ring = list(List::Ring);
        Self {
            planes: [Plane::of_x(tables, ring[5]), Plane::of_y(tables, ring[6])],
            dispersion: Dispersion {
                monitor: DVector::from_vec(list(List::MonitorDispersion)),
                node: DVector::from_vec(list(List::NodeDispersion)),
                compaction: ring[2],
                inverse_gamma_squared: ring[3],
                circumference: ring[4],
            },
            stated_error: tables.stated_error().map(f64::from),
        }
    }

    /// From the twin, without the rounding to 16 bits; what is left of an error is that of two nodes a quadrupole.
    ///
    /// # Errors
    /// [`TrainingError`] if a ring has no tables.
    pub fn unrounded(ring: &Ring) -> Result<Self, TrainingError> {
        let mut model = Self::from_tables(&training::green::tables(ring)?);
        for (plane, exact) in model.planes.iter_mut().zip(training::green::planes(ring)?) {
            let PlaneResponses { direct, seen, driven, mutual } = exact;
            (plane.direct, plane.seen, plane.driven, plane.mutual) = (direct, seen, driven, mutual);
        }
        Ok(model)
    }

    /// Stated rms error at monitor `b` [m].
    pub fn stated_error(&self, b: usize) -> f64 {
        self.stated_error[usize::from(b >= self.planes[0].direct.nrows())]
    }

    /// Tunes of the design.
    pub fn tunes(&self) -> [f64; 2] {
        self.planes.each_ref().map(|plane| plane.tune)
    }

    /// The ring at given vars.
    ///
    /// # Errors
    /// [`OrbitError::Integer`] on an integer resonance.
    pub fn at(&self, vars: &[f64]) -> Result<GreenOptics<'_>, OrbitError> {
        let [x, y] = &self.planes;
        let d = &self.dispersion;
        let (x, nodes) = x.at(vars, Some(&d.node))?;
        let (y, _) = y.at(vars, None)?;
        let kick = nodes.component_mul(&self.planes[0].excess(vars));
        // D' = D - Z_qb D_q D, and Z_qb D_q D = G_bq D_q D'
        let monitor_dispersion = &d.monitor - self.planes[0].seen.tr_mul(&kick);
        let compaction =
            d.compaction - self.planes[0].excess(vars).component_mul(&d.node).dot(&nodes) / d.circumference;
        Ok(GreenOptics {
            model: self,
            planes: [x, y],
            monitor_dispersion,
            node_dispersion: nodes,
            slip: compaction - d.inverse_gamma_squared,
        })
    }
}

impl Plane {
    fn of_x(tables: &Tables, tune: f64) -> Self {
        Self {
            mode: 'x',
            tune,
            direct: tables.matrix(Table::DirectX),
            seen: tables.matrix(Table::SeenX),
            driven: tables.matrix(Table::DrivenX),
            mutual: tables.matrix(Table::MutualX),
            weight: weights(tables, 1.0),
        }
    }

    fn of_y(tables: &Tables, tune: f64) -> Self {
        Self {
            mode: 'y',
            tune,
            direct: tables.matrix(Table::DirectY),
            seen: tables.matrix(Table::SeenY),
            driven: tables.matrix(Table::DrivenY),
            mutual: tables.matrix(Table::MutualY),
            weight: weights(tables, -1.0),
        }
    }

    /// `k L w (strength - 1)` of each node.
    fn excess(&self, vars: &[f64]) -> DVector<f64> {
        DVector::from_fn(self.weight.len(), |n, _| self.weight[n] * (vars[n / 2] - 1.0))
    }

    /// The plane at given vars, and what becomes of one more column at the nodes.
    fn at(&self, vars: &[f64], more: Option<&DVector<f64>>) -> Result<(PlaneOptics, DVector<f64>), OrbitError> {
        let (nodes, monitors, correctors) = (self.weight.len(), self.seen.ncols(), self.driven.ncols());
        let excess = self.excess(vars);
        let mut closure = self.mutual.clone();
        closure.column_iter_mut().zip(&excess).for_each(|(mut column, e)| column *= *e);
        (0..nodes).for_each(|n| closure[(n, n)] += 1.0);
        let mut sides = DMatrix::zeros(nodes, monitors + correctors + 1);
        sides.columns_mut(0, monitors).copy_from(&self.seen);
        sides.columns_mut(monitors, correctors).copy_from(&self.driven);
        more.into_iter().for_each(|more| sides.set_column(monitors + correctors, more));
        let lu = closure.lu();
        if !lu.solve_mut(&mut sides) {
            return Err(OrbitError::Integer { determinant: lu.determinant(), half_traces: [1.0; 2] });
        }
        let seen = sides.columns(0, monitors).into_owned();
        let mut kicks = self.driven.clone();
        kicks.row_iter_mut().zip(&excess).for_each(|(mut row, e)| row *= *e);
        let optics = PlaneOptics {
            tune: self.tune(lu.determinant())?,
            response: &self.direct - seen.tr_mul(&kicks),
            seen,
            driven: sides.columns(monitors, correctors).into_owned(),
            slope: self.weight.iter().enumerate().map(|(n, w)| w * vars[n / 2]).collect(),
            closure: lu,
        };
        Ok((optics, sides.column(monitors + correctors).into_owned()))
    }
}

impl Plane {
    /// Fractional tune between the same half integers as the design's: `sin^2(pi Q) = sin^2(pi Q0) det(1 + G_qq D)`.
    fn tune(&self, determinant: f64) -> Result<f64, OrbitError> {
        let square = (PI * self.tune).sin().powi(2) * determinant;
        if !(0.0..=1.0).contains(&square) {
            return Err(OrbitError::Unstable { mode: self.mode, half_trace: 1.0 - 2.0 * square });
        }
        let tune = square.sqrt().asin() / PI;
        Ok(if self.tune.rem_euclid(1.0) > 0.5 { 1.0 - tune } else { tune })
    }
}

/// `k L w` of each node, two alike a quadrupole.
fn weights(tables: &Tables, sign: f64) -> Vec<f64> {
    tables.list(List::Weight).iter().flat_map(|weight| [sign * f64::from(*weight); 2]).collect()
}

impl Optics for GreenOptics<'_> {
    /// The planes are independent.
    fn response(&self) -> DMatrix<f64> {
        let [x, y] = &self.planes;
        let ((bx, cx), (by, cy)) = (x.response.shape(), y.response.shape());
        let mut response = DMatrix::zeros(bx + by, cx + cy + 1);
        response.view_mut((0, 0), (bx, cx)).copy_from(&x.response);
        response.view_mut((bx, cx), (by, cy)).copy_from(&y.response);
        response.view_mut((0, cx + cy), (bx, 1)).copy_from(&(&self.monitor_dispersion * (-1.0 / self.slip)));
        response
    }

    fn pull_back(&self, weights: &DMatrix<f64>) -> Vec<f64> {
        let [x, y] = &self.planes;
        let ((bx, cx), (by, cy)) = (x.response.shape(), y.response.shape());
        let rf = weights.view((0, cx + cy), (bx, 1)).into_owned();
        let mut along_x = x.contract(&weights.view((0, 0), (bx, cx)).into_owned());
        let along_y = y.contract(&weights.view((bx, cx), (by, cy)).into_owned());
        // the RF is one more corrector, seen at the nodes as the dispersion; and it moves with the slip factor
        let seen = &x.seen * &rf;
        let by_slip =
            rf.column(0).dot(&self.monitor_dispersion) / (self.slip * self.slip * self.model.dispersion.circumference);
        for (n, along) in along_x.iter_mut().enumerate() {
            let d = self.node_dispersion[n];
            *along += d * (by_slip * d - seen[n] / self.slip);
        }
        let of_node = |n: usize| -x.slope[n] * along_x[n] - y.slope[n] * along_y[n];
        (0..along_x.len() / 2).map(|q| of_node(2 * q) + of_node(2 * q + 1)).collect()
    }

    fn tunes(&self) -> [f64; 2] {
        self.planes.each_ref().map(|plane| plane.tune)
    }

    fn tune_slopes(&self) -> Vec<[f64; 2]> {
        let [x, y] = [0, 1].map(|plane| self.planes[plane].tune_slopes(&self.model.planes[plane].mutual));
        x.into_iter().zip(y).map(|(x, y)| [x, y]).collect()
    }
}

impl PlaneOptics {
    /// `dQ/d(ln k) = tan(pi Q)/(2 pi) sum of k L w strength Z_nn` over a quadrupole's nodes, `Z = (1 + G D)^-1 G`.
    fn tune_slopes(&self, mutual: &DMatrix<f64>) -> Vec<f64> {
        let mut closed = mutual.clone();
        self.closure.solve_mut(&mut closed); // regular: it was solved before
        let scale = (PI * self.tune).tan() / TAU;
        let of_node = |n: usize| scale * self.slope[n] * closed[(n, n)];
        (0..self.slope.len() / 2).map(|q| of_node(2 * q) + of_node(2 * q + 1)).collect()
    }

    /// Diagonal of `Z_qb w Z_qc^T`.
    fn contract(&self, weights: &DMatrix<f64>) -> Vec<f64> {
        let sent = &self.driven * weights.transpose();
        (0..self.slope.len()).map(|n| sent.row(n).dot(&self.seen.row(n))).collect()
    }
}

#[cfg(test)]
mod tests {
    use twin::VariedRing;

    use super::*;

    fn example() -> (GreenModel, Ring, Vec<f64>) {
        let ring = Ring::booster();
        let tables = training::green::tables(&ring).unwrap();
        (GreenModel::from_tables(&tables), ring, (0..48).map(|i| 1.0 + 0.03 * f64::sin(3.0 * f64::from(i))).collect())
    }

    /// For kicks of 0.278 mrad and RF offsets of 2e-4, to the error that the tables state (2 um of largest error measured).
    #[test]
    fn it_predicts_as_the_twin() {
        let (model, ring, vars) = example();
        let exact = VariedRing::of(&ring).unwrap().at(&vars).unwrap().response();
        let error = (model.at(&vars).unwrap().response() - &exact) * 2e-4;
        assert!(error.amax() < 1e-5, "{}", error.amax());
    }

    /// Rounding is worth less than the two nodes: 16 bits are enough.
    #[test]
    fn without_rounding_it_is_hardly_better() {
        let (model, ring, vars) = example();
        let exact = VariedRing::of(&ring).unwrap().at(&vars).unwrap().response();
        let error = |model: &GreenModel| (model.at(&vars).unwrap().response() - &exact).norm();
        let unrounded = GreenModel::unrounded(&ring).unwrap();
        let ratio = error(&model) / error(&unrounded);
        assert!((0.8..1.5).contains(&ratio), "{ratio}");
    }

    #[test]
    fn tunes_and_their_slopes_are_those_of_the_twin() {
        let (model, ring, vars) = example();
        let varied = VariedRing::of(&ring).unwrap();
        let (exact, own) = (varied.at(&vars).unwrap(), model.at(&vars).unwrap());
        for plane in [0, 1] {
            // two nodes a quadrupole: the tune is some 1e-5 off
            assert!((exact.tunes()[plane] - own.tunes()[plane]).abs() < 1e-4, "{:?} {:?}", exact.tunes(), own.tunes());
            for (q, (exact, own)) in exact.tune_slopes().iter().zip(own.tune_slopes()).enumerate() {
                assert!(
                    (exact[plane] - own[plane]).abs() < 1e-3 * exact[plane].abs().max(0.01),
                    "{q}: {exact:?} {own:?}"
                );
            }
        }
    }
}
