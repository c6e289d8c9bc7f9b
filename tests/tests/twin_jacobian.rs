//! The twin's derivative of the orbit response by the 48 vars, against differences of the twin itself and against a
//! plain ring of 2x2 matrices in dual numbers that shares neither its Green's function nor its quadrature.

use nalgebra::{DMatrix, Matrix2, Vector2};
use num_dual::{DualNum, DualSVec64};
use system_tests::repository;
use twin::{Hold, Optics, Plane, Ring};

const VARS: usize = 48;
const ON_MOMENTUM: Hold = Hold::Momentum { delta: 0.0 };

/// Relative to the largest entry of a var's Jacobian: measured 5e-11 against the differences (their rounding) and 3e-11
/// against the dual numbers (four nodes of quadrature within a quadrupole); asked for 1e-6.
const TOLERANCE: f64 = 3e-10;

/// The design, and the paper's machine, whose vars break the symmetry of the six superperiods.
fn machines() -> [(&'static str, Vec<f64>); 2] {
    let text = std::fs::read_to_string(repository("tests/golden/reference-madx.json")).unwrap();
    let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
    let paper = &golden["machines"]["paper"]["vars"];
    let vars = Ring::paper_booster().var_names().iter().map(|n| paper[n].as_f64().unwrap()).collect();
    [("design", vec![1.0; VARS]), ("paper", vars)]
}

fn response(ring: &Ring, hold: Hold) -> DMatrix<f64> {
    let optics = Optics::of(ring, hold).unwrap();
    optics.response(&optics.read_monitors(), &optics.correctors())
}

/// Derivative by each var, `[33][48]` each [m/rad].
fn jacobian(vars: &[f64], hold: Hold) -> Vec<DMatrix<f64>> {
    let design = Ring::paper_booster();
    let ring = design.with_vars(vars);
    let optics = Optics::of(&ring, hold).unwrap();
    let by_gradient = optics.response_jacobian(&optics.read_monitors(), &optics.correctors(), &optics.quadrupoles());
    by_gradient.into_iter().zip(design.gradients()).map(|(derivative, k1)| derivative * k1).collect()
}

/// Assert that all 33 x 48 entries of every var agree, relative to the largest of that var.
fn assert_near(what: &str, ours: &[DMatrix<f64>], known: &[DMatrix<f64>]) {
    assert_eq!((ours.len(), known.len()), (VARS, VARS));
    for (var, (ours, known)) in Ring::paper_booster().var_names().iter().zip(ours.iter().zip(known)) {
        assert_eq!((ours.shape(), known.shape()), ((33, 48), (33, 48)));
        let error = (ours - known).abs().max() / known.abs().max();
        assert!(
            error < TOLERANCE,
            "{what}, var {var}: off by {error:.2e} of its largest entry, allowed {TOLERANCE:.0e}"
        );
    }
}

/// Five-point central differences of the response by each var.
fn differences(vars: &[f64], hold: Hold) -> Vec<DMatrix<f64>> {
    let (design, h) = (Ring::paper_booster(), 1e-4);
    let at = |n: usize, step: f64| {
        let mut vars = vars.to_vec();
        vars[n] += step;
        response(&design.with_vars(&vars), hold)
    };
    let by = |n| ((at(n, h) - at(n, -h)) * 8.0 - (at(n, 2.0 * h) - at(n, -2.0 * h))) / (12.0 * h);
    (0..VARS).map(by).collect()
}

#[test]
fn jacobian_equals_differences_of_the_twin_for_all_vars() {
    for (name, vars) in machines() {
        for hold in [ON_MOMENTUM, Hold::Frequency { offset: 0.0 }] {
            assert_near(&format!("{name}, {hold:?}"), &jacobian(&vars, hold), &differences(&vars, hold));
        }
    }
}

type Dual = DualSVec64<VARS>;

/// One plane of a ring: the matrix of every element, constant except in the quadrupoles.
struct PlainRing {
    ring: Ring,
    /// Matrices of the two planes.
    planes: [Vec<Matrix2<Dual>>; 2],
}

impl PlainRing {
    fn new(vars: &[f64]) -> Self {
        let ring = Ring::paper_booster().with_vars(vars);
        let design = Ring::paper_booster().gradients();
        let planes = [0, 1].map(|plane| {
            let constant = |i: usize| {
                let matrix = ring.elements[i].linearise(&mut twin::Phase::zeros());
                matrix.fixed_view::<2, 2>(2 * plane, 2 * plane).map(Dual::from_re)
            };
            let mut matrices: Vec<_> = (0..ring.elements.len()).map(constant).collect();
            for (n, at) in ring.quadrupoles.iter().map(|q| q.element).enumerate() {
                let var = Dual::from_re(vars[n]).derivative(n);
                let sign = if plane == 0 { 1.0 } else { -1.0 };
                matrices[at] = quadrupole(var * (sign * design[n]), ring.elements[at].length);
            }
            matrices
        });
        Self { ring, planes }
    }

    /// Orbit at every read monitor of one plane for 1 rad at a corrector.
    ///
    /// The ring is cut open right behind the kick, so that `z = M z + (0, 1)` there; `z` is then carried once around.
    fn orbit(&self, plane: Plane, corrector: usize) -> Vec<(usize, Dual)> {
        let matrices = &self.planes[usize::from(plane == Plane::Y)];
        let around = || (corrector..matrices.len()).chain(0..corrector);
        let turn = around().fold(Matrix2::identity(), |turn, i| matrices[i] * turn);
        let open = Matrix2::identity() - turn;
        let determinant = open[(0, 0)] * open[(1, 1)] - open[(0, 1)] * open[(1, 0)];
        let mut z = Vector2::new(-open[(0, 1)] / determinant, open[(0, 0)] / determinant);
        let mut seen = Vec::new();
        for i in around() {
            let read = self.ring.monitors_read().position(|m| m.element == i && m.plane == plane);
            seen.extend(read.map(|row| (row, z[0])));
            z = matrices[i] * z;
        }
        seen
    }

    /// Response and its derivative by each var.
    fn response(&self) -> (DMatrix<f64>, Vec<DMatrix<f64>>) {
        let mut response = DMatrix::zeros(33, 48);
        let mut jacobian = vec![response.clone(); VARS];
        for (column, corrector) in self.ring.correctors.iter().enumerate() {
            for (row, x) in self.orbit(corrector.plane, corrector.element) {
                response[(row, column)] = x.re;
                let slope = x.eps.unwrap_generic(nalgebra::Const::<VARS>, nalgebra::U1);
                jacobian.iter_mut().zip(&slope).for_each(|(j, s)| j[(row, column)] = *s);
            }
        }
        (response, jacobian)
    }
}

/// Thick quadrupole of focusing strength `k` [1/m^2], hyperbolic where it is negative.
fn quadrupole(k: Dual, length: f64) -> Matrix2<Dual> {
    let root = if k.re > 0.0 { k.sqrt() } else { (-k).sqrt() };
    let angle = root * length;
    if k.re > 0.0 {
        Matrix2::new(angle.cos(), angle.sin() / root, -angle.sin() * root, angle.cos())
    } else {
        Matrix2::new(angle.cosh(), angle.sinh() / root, angle.sinh() * root, angle.cosh())
    }
}

#[test]
fn response_equals_that_of_a_plain_ring() {
    for (name, vars) in machines() {
        let plain = PlainRing::new(&vars).response().0;
        let error = (response(&Ring::paper_booster().with_vars(&vars), ON_MOMENTUM) - plain).abs().max();
        assert!(error < 1e-12, "{name}: off by {error:.2e} m/rad"); // rounding; measured 1.3e-13
    }
}

#[test]
fn jacobian_equals_that_of_a_plain_ring_in_dual_numbers() {
    for (name, vars) in machines() {
        assert_near(name, &jacobian(&vars, ON_MOMENTUM), &PlainRing::new(&vars).response().1);
    }
}
