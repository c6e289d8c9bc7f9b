//! Exact maps of single elements, generic over the scalar so that one formula gives both orbit and derivative.
//!
//! Coordinates: `x [m]`, `px`, `y [m]`, `py` (momenta over the reference momentum), `delta = p/p0 - 1`, and `path [m]`,
//! the length travelled beyond the reference orbit. `delta` never changes: the ring is coasting.
//!
//! Source: E. Forest, Beam Dynamics (1998), ch. 10-13: drift 10.25, rotation 10.26, sector bend 12.18, wedge 12.41,
//! hard-edge fringe 13.13. Signs as in MAD.

use nalgebra::{Matrix6, SVector};
use num_dual::{DualNum, jacobian};

use crate::lattice::{Bend, Element, Kind, Misalignment};

/// A real number or a dual number over the reals.
pub trait Scalar: DualNum<Primitive = f64> + Copy {}
impl<T: DualNum<Primitive = f64> + Copy> Scalar for T {}

/// Phase-space vector `(x, px, y, py, delta, path)`.
pub type Phase<T> = SVector<T, 6>;

/// Index of the horizontal position in a [`Phase`].
pub const X: usize = 0;
/// Index of the horizontal momentum.
pub const PX: usize = 1;
/// Index of the vertical position.
pub const Y: usize = 2;
/// Index of the vertical momentum.
pub const PY: usize = 3;
/// Index of the relative momentum deviation.
pub const DELTA: usize = 4;
/// Index of the path length beyond the reference.
pub const PATH: usize = 5;

/// Slices of a body that has both curvature (or length) and a gradient K1 with `K1 L^2` = 0.65, as strong as combined-function dipoles come.
/// They are of fourth order in their length, and weaker bodies have fewer, so that the error stays alike: the matrix is off by less
/// than 1e-6 (test `slices_suffice`).
const SLICES: f64 = 12.0;
const STRONG: f64 = 0.65;
/// Distance from the axis of a sextupole at which its gradient is taken [m].
const OFF_AXIS: f64 = 0.01;

/// Slices of a body of some gradient [1/m^2] and sextupole [1/m^3] over a length.
fn slices(k1: f64, k2: f64, length: f64) -> usize {
    let strength = (k1.abs() + k2.abs() * OFF_AXIS) * length * length;
    (SLICES * (strength / STRONG).powf(0.25)).ceil().max(1.0) as usize
}

impl Element {
    /// Carry a particle from entrance to exit.
    pub fn track<T: Scalar>(&self, z: &mut Phase<T>) {
        self.track_into(z, self.length);
        if let Kind::Bend(bend) = &self.kind {
            bend.exit(z);
        }
        self.misalignment.leave(z);
    }

    /// Carry a particle from the entrance to `depth` [m] inside, into the element's own (shifted, rolled) frame.
    pub fn track_into<T: Scalar>(&self, z: &mut Phase<T>, depth: f64) {
        self.misalignment.enter(z);
        match &self.kind {
            Kind::Drift | Kind::Marker | Kind::Monitor => drift(z, depth),
            Kind::Corrector { kick } => {
                z[PX] += kick[0];
                z[PY] += kick[1];
                drift(z, depth);
            }
            Kind::Quadrupole { k1 } => quadrupole(z, *k1, depth),
            Kind::Sextupole { k2 } if *k2 == 0.0 => drift(z, depth),
            Kind::Sextupole { k2 } => {
                integrate(z, depth, slices(0.0, *k2, depth), drift, |z, length| thin(z, 0.0, 0.0, k2 * length));
            }
            Kind::Multipole { k1l, k1sl, k2l, k3l } => {
                // both act at the position at which the beam enters, which neither changes
                thin(z, *k1l, *k1sl, *k2l);
                octupole(z, *k3l);
                drift(z, depth);
            }
            Kind::Wiggler { focusing } => {
                let y = z[Y];
                z[PY] -= y * *focusing;
                drift(z, depth);
            }
            Kind::Solenoid { ks } => solenoid(z, *ks, depth),
            Kind::Bend(bend) => {
                bend.enter(z);
                bend.body(z, depth);
            }
        }
    }

    /// Linear map about the ray that enters as `z`, which is moved to the exit.
    pub fn linearise(&self, z: &mut Phase<f64>) -> Matrix6<f64> {
        let exact = self.matrix(z, self.length, true).or_else(|| self.pass_free(z, self.length));
        exact.unwrap_or_else(|| derivative(z, |z| self.track(z)))
    }

    /// Linear map from the entrance to `depth` [m] inside, about the ray that enters as `z`.
    pub fn linearise_into(&self, z: &Phase<f64>, depth: f64) -> Matrix6<f64> {
        let mut z = *z;
        let exact = self.matrix(&z, depth, false).or_else(|| self.pass_free(&mut z, depth));
        exact.unwrap_or_else(|| derivative(&mut z, |z| self.track_into(z, depth)))
    }

    /// Linear map of an element without a field, but for a kick at its entrance, about the ray that enters as `z`, which is moved to `depth` [m]; none of others.
    fn pass_free(&self, z: &mut Phase<f64>, depth: f64) -> Option<Matrix6<f64>> {
        let kick = match self.kind {
            Kind::Drift | Kind::Marker | Kind::Monitor => [0.0; 2],
            Kind::Corrector { kick } => kick,
            _ => return None,
        };
        if !self.misalignment.is_none() {
            return None;
        }
        (z[PX], z[PY]) = (z[PX] + kick[0], z[PY] + kick[1]);
        let map = about_drift(z, depth);
        drift(z, depth);
        Some(map)
    }
}

/// Derivative of a map about the ray that enters as `z`, which is moved to the exit.
pub(crate) fn derivative(z: &mut Phase<f64>, map: impl Fn(&mut Phase<num_dual::DualSVec64<6>>)) -> Matrix6<f64> {
    let (end, matrix) = jacobian(
        |mut z: Phase<num_dual::DualSVec64<6>>| {
            map(&mut z);
            z
        },
        z,
    );
    *z = end;
    matrix
}

/// Inverse of a transfer map, its symplectic conjugate: `(x, px)`, `(y, py)` and `(delta, path)` are canonical pairs, so
/// that `M^-1 = -J M^T J`.
pub(crate) fn inverse(map: &Matrix6<f64>) -> Matrix6<f64> {
    Matrix6::from_fn(|i, j| if (i + j) % 2 == 0 { map[(j ^ 1, i ^ 1)] } else { -map[(j ^ 1, i ^ 1)] })
}

impl Misalignment {
    /// From the ring's axes to the element's own.
    pub(crate) fn rotation(&self) -> Matrix6<f64> {
        let (sin, cos) = self.roll.sin_cos();
        let mut roll = Matrix6::identity();
        for (h, v) in [(X, Y), (PX, PY)] {
            (roll[(h, h)], roll[(h, v)], roll[(v, h)], roll[(v, v)]) = (cos, sin, -sin, cos);
        }
        roll
    }

    fn enter<T: Scalar>(&self, z: &mut Phase<T>) {
        if self.is_none() {
            return;
        }
        z[X] -= self.dx;
        z[Y] -= self.dy;
        rotate(z, self.roll);
    }

    fn leave<T: Scalar>(&self, z: &mut Phase<T>) {
        if self.is_none() {
            return;
        }
        rotate(z, -self.roll);
        z[X] += self.dx;
        z[Y] += self.dy;
    }
}

/// Rotation of the axes by `roll` [rad] about the beam, positive from x to y.
fn rotate<T: Scalar>(z: &mut Phase<T>, roll: f64) {
    let (s, c) = roll.sin_cos();
    for (h, v) in [(X, Y), (PX, PY)] {
        let (a, b) = (z[h], z[v]);
        z[h] = a * c + b * s;
        z[v] = b * c - a * s;
    }
}

/// Longitudinal momentum `sqrt((1 + delta)^2 - px^2 - py^2)`.
fn longitudinal<T: Scalar>(z: &Phase<T>, px: T, py: T) -> T {
    let p = z[DELTA] + 1.0;
    (p * p - px * px - py * py).sqrt()
}

/// Exact drift.
fn drift<T: Scalar>(z: &mut Phase<T>, length: f64) {
    if length == 0.0 {
        return;
    }
    let (px, py, p) = (z[PX], z[PY], z[DELTA] + 1.0);
    let per_pz = longitudinal(z, px, py).recip() * length;
    z[X] += px * per_pz;
    z[Y] += py * per_pz;
    z[PATH] += p * per_pz - length;
}

/// Linear map of a drift about the ray that enters as `z`: with `l = L/pz`, `d(l)/d(px) = px L/pz^3` and `d(l)/d(delta) = -p L/pz^3`.
fn about_drift(z: &Phase<f64>, length: f64) -> Matrix6<f64> {
    let (px, py, p) = (z[PX], z[PY], z[DELTA] + 1.0);
    let per_pz = longitudinal(z, px, py).recip();
    let (l, cube) = (length * per_pz, length * per_pz.powi(3));
    let mut map = Matrix6::identity();
    for (row, slope, own) in [(X, px, PX), (Y, py, PY), (PATH, p, DELTA)] {
        (map[(row, PX)], map[(row, PY)], map[(row, DELTA)]) = (slope * px * cube, slope * py * cube, -slope * p * cube);
        map[(row, own)] += l;
    }
    map
}

/// Thin normal quadrupole, skew quadrupole and sextupole: `px -= K1L x`, `px += K1sL y`, `px -= K2L (x^2 - y^2)/2`.
fn thin<T: Scalar>(z: &mut Phase<T>, k1l: f64, k1sl: f64, k2l: f64) {
    let (x, y) = (z[X], z[Y]);
    z[PX] += y * k1sl - x * k1l - (x * x - y * y) * (0.5 * k2l);
    z[PY] += x * k1sl + y * k1l + x * y * k2l;
}

/// Thin octupole: the real and imaginary part of `-K3L (x + i y)^3/6`, the latter reversed.
fn octupole<T: Scalar>(z: &mut Phase<T>, k3l: f64) {
    let (x, y) = (z[X], z[Y]);
    z[PX] -= x * (x * x - y * y * 3.0) * (k3l / 6.0);
    z[PY] -= y * (y * y - x * x * 3.0) * (k3l / 6.0);
}

/// Focusing functions `C = cos(sqrt(k) L)` and `S = sin(sqrt(k) L)/sqrt(k)`, hyperbolic for k < 0.
pub(crate) fn focus<T: Scalar>(k: T, length: f64) -> (T, T) {
    let phase = k.re() * length * length;
    if phase.abs() < 1e-10 {
        return (k * (-0.5 * length * length) + 1.0, (k * (-length * length / 6.0) + 1.0) * length);
    }
    if phase > 0.0 {
        let root = k.sqrt();
        let (s, c) = (root * length).sin_cos();
        (c, s / root)
    } else {
        let root = (-k).sqrt();
        ((root * length).cosh(), (root * length).sinh() / root)
    }
}

/// Quadrupole with `x'' = -K/(1 + delta) x`, `y'' = +K/(1 + delta) y`, path to second order in the slopes.
///
/// The square root of the exact Hamiltonian is expanded; for slopes below 3 mrad the response differs from the exact
/// integral by less than 3e-5 m/rad (system test against pyAT's exact maps).
fn quadrupole<T: Scalar>(z: &mut Phase<T>, k1: f64, length: f64) {
    let p = z[DELTA] + 1.0;
    for (at, slope_at, sign) in [(X, PX, 1.0), (Y, PY, -1.0)] {
        let k = p.recip() * (sign * k1);
        let (c, s) = focus(k, length);
        let (x, slope) = (z[at], z[slope_at] / p);
        z[at] = c * x + s * slope;
        z[slope_at] = (c * slope - k * s * x) * p;
        // half the integral of x'^2
        let cs = c * s;
        z[PATH] +=
            (k * x * x * (cs * -1.0 + length) - k * x * slope * s * s * 2.0 + slope * slope * (cs + length)) * 0.25;
    }
}

/// Exact hard-edge solenoid: a helix, in canonical momenta. `ks` is the field over the rigidity [1/m].
fn solenoid<T: Scalar>(z: &mut Phase<T>, ks: f64, length: f64) {
    let half = 0.5 * ks;
    let p = z[DELTA] + 1.0;
    // kinetic momenta inside the field; their size, and so pz, stays constant
    let (kx, ky) = (z[PX] + z[Y] * half, z[PY] - z[X] * half);
    let pz = longitudinal(z, kx, ky);
    let k = pz.recip() * half;
    let (c, s) = focus(k * k, length);
    for (at, slope_at) in [(X, PX), (Y, PY)] {
        let (x, slope) = (z[at], z[slope_at] / pz);
        z[at] = c * x + s * slope;
        z[slope_at] = (c * slope - k * k * s * x) * pz;
    }
    let (sin, cos) = (k * length).sin_cos();
    for (h, v) in [(X, Y), (PX, PY)] {
        let (a, b) = (z[h], z[v]);
        z[h] = cos * a + sin * b;
        z[v] = cos * b - sin * a;
    }
    z[PATH] += (p / pz - 1.0) * length;
}

/// Fourth-order symmetric composition of a solvable body and a kick.
///
/// Source: H. Yoshida, Construction of higher order symplectic integrators, Phys. Lett. A 150 (1990), eq. 2.11.
fn integrate<T: Scalar>(
    z: &mut Phase<T>,
    length: f64,
    slices: usize,
    body: impl Fn(&mut Phase<T>, f64),
    kick: impl Fn(&mut Phase<T>, f64),
) {
    let outer = 1.0 / (2.0 - f64::cbrt(2.0));
    // halves of bodies that follow each other are one
    let mut before = 0.0;
    for part in core::iter::repeat_n([outer, 1.0 - 2.0 * outer, outer], slices).flatten() {
        let step = part * length / slices as f64;
        body(z, 0.5 * (before + step));
        kick(z, step);
        before = step;
    }
    body(z, 0.5 * before);
}

impl Bend {
    fn enter<T: Scalar>(&self, z: &mut Phase<T>) {
        turn(z, self.e1);
        self.edge_field(z, self.curvature);
        self.wedge(z, -self.e1);
    }

    fn exit<T: Scalar>(&self, z: &mut Phase<T>) {
        self.wedge(z, -self.e2);
        self.edge_field(z, -self.curvature);
        turn(z, self.e2);
    }

    /// Sector body; gradient and sextupole are integrated in slices, their curvature correction `h x` (6e-4 at 8 mm) left out.
    fn body<T: Scalar>(&self, z: &mut Phase<T>, length: f64) {
        if self.k1 == 0.0 && self.k2 == 0.0 {
            self.sector(z, length);
        } else {
            let slices = slices(self.k1, self.k2, length);
            integrate(z, length, slices, |z, l| self.sector(z, l), |z, l| thin(z, self.k1 * l, 0.0, self.k2 * l));
        }
    }

    /// Exact uniform-field sector.
    fn sector<T: Scalar>(&self, z: &mut Phase<T>, length: f64) {
        let h = self.curvature;
        if h == 0.0 {
            return drift(z, length);
        }
        let angle = h * length;
        let (s, c) = angle.sin_cos();
        let (px, py, p) = (z[PX], z[PY], z[DELTA] + 1.0);
        let pz = longitudinal(z, px, py);
        let inside = pz - z[X] * h - 1.0; // pz - (h x + 1): zero on the reference orbit
        let px_end = px * c + inside * s;
        let pz_end = longitudinal(z, px_end, py);
        let transverse = (p * p - py * py).sqrt();
        let swept = (px / transverse).asin() - (px_end / transverse).asin() + angle;
        z[X] = (pz_end - (inside * c - px * s) - 1.0) / h;
        z[PX] = px_end;
        z[Y] += py * swept / h;
        z[PATH] += p * swept / h - length;
    }

    /// Field of a hard edge, with the first soft-edge correction; `field` is negative at an exit.
    fn edge_field<T: Scalar>(&self, z: &mut Phase<T>, field: f64) {
        if field == 0.0 {
            return;
        }
        // The map follows from the generating function x px + y py - y^2 phi(px, py, delta)/2, so the three partial
        // derivatives of phi are needed.
        let (phi, slope) = if self.fringe == 0.0 { hard_edge(z, field) } else { self.soft_edge(z, field) };
        let y = z[Y] * 2.0 / ((-slope[1] * z[Y] * 2.0 + 1.0).sqrt() + 1.0);
        let half_square = y * y * 0.5;
        z[X] += slope[0] * half_square;
        z[PY] -= phi * y;
        z[Y] = y;
        z[PATH] -= slope[2] * half_square;
    }

    /// `phi` of an edge with its first soft-edge correction, and its derivatives with respect to `px`, `py` and `delta`, by a nested dual
    /// number.
    fn soft_edge<T: Scalar>(&self, z: &Phase<T>, field: f64) -> (T, SVector<T, 3>) {
        let at = SVector::<T, 3>::new(z[PX], z[PY], z[DELTA]);
        num_dual::gradient(
            |p: SVector<num_dual::DualSVec<T, 3>, 3>| {
                let total = p[2] + 1.0;
                let pz = (total * total - p[0] * p[0] - p[1] * p[1]).sqrt();
                let (xp, yp) = (p[0] / pz, p[1] / pz);
                let bent = (xp / (yp * yp + 1.0)).atan();
                let soft = pz * (xp * xp * (yp * yp + 2.0) + 1.0) * (field * self.fringe);
                (bent - soft).tan() * field
            },
            &at,
        )
    }

    /// Ideal wedge of field of opening `angle` [rad].
    fn wedge<T: Scalar>(&self, z: &mut Phase<T>, angle: f64) {
        if angle == 0.0 {
            return;
        }
        let h = self.curvature;
        if h == 0.0 {
            return turn(z, angle);
        }
        let (s, c) = angle.sin_cos();
        let (x, px, py, p) = (z[X], z[PX], z[PY], z[DELTA] + 1.0);
        let pz = longitudinal(z, px, py);
        let px_end = px * c + (pz - x * h) * s;
        let transverse = (p * p - py * py).sqrt();
        let swept = (px / transverse).asin() - (px_end / transverse).asin() + angle;
        let above = x * (px * (2.0 * angle).sin() + (pz * 2.0 - x * h) * (s * s));
        let below = longitudinal(z, px_end, py) + pz * c - px * s;
        z[X] = x * c + above / below;
        z[PX] = px_end;
        z[Y] += py * swept / h;
        z[PATH] += p * swept / h;
    }
}

/// The same of a hard edge: `phi = field px pz/q`, `q = (1 + delta)^2 - px^2`.
fn hard_edge<T: Scalar>(z: &Phase<T>, field: f64) -> (T, SVector<T, 3>) {
    let (px, py, p) = (z[PX], z[PY], z[DELTA] + 1.0);
    let pz = longitudinal(z, px, py);
    let per_q = (p * p - px * px).recip() * field;
    let phi = px * pz * per_q;
    let twice = phi * per_q * (2.0 / field);
    let by_px = (pz - px * px / pz) * per_q + twice * px;
    let by_delta = px * p / pz * per_q - twice * p;
    (phi, SVector::<T, 3>::new(by_px, -px * py / pz * per_q, by_delta))
}

/// Rotation of the transverse plane about the vertical axis by `angle` [rad], in free space.
fn turn<T: Scalar>(z: &mut Phase<T>, angle: f64) {
    if angle == 0.0 {
        return;
    }
    let (s, c) = angle.sin_cos();
    let (x, px, py, p) = (z[X], z[PX], z[PY], z[DELTA] + 1.0);
    let pz = longitudinal(z, px, py);
    let ahead = pz * c - px * s;
    z[X] = x * pz / ahead;
    z[PX] = pz * s + px * c;
    z[Y] += x * py * s / ahead;
    z[PATH] += p * x * s / ahead;
}

#[cfg(test)]
mod tests {
    use super::*;

    fn element(kind: Kind, length: f64) -> Element {
        Element { kind, ..Element::drift(0.0, length) }
    }

    fn bend(k1: f64, e: f64) -> Element {
        element(Kind::Bend(Bend { curvature: 0.1, k1, k2: 0.0, e1: e, e2: e, fringe: 0.0 }), 0.9)
    }

    #[test]
    fn the_map_of_what_is_free_is_the_derivative_of_its_track() {
        let corrector = element(Kind::Corrector { kick: [2e-3, -1e-3] }, 0.4);
        for free in [element(Kind::Drift, 1.3), element(Kind::Monitor, 0.0), corrector] {
            let ray = Phase::from([3e-3, 4e-3, -2e-3, 7e-3, 5e-3, 1e-3]);
            let (mut one, mut other) = (ray, ray);
            let off = free.linearise(&mut one) - derivative(&mut other, |z| free.track(z));
            assert!(off.amax() < 1e-14 && (one - other).amax() < 1e-15, "{:?}: rounding", free.kind);
        }
    }

    #[test]
    fn maps_are_symplectic_about_any_ray() {
        let rolled = Element {
            misalignment: Misalignment { dx: 1e-3, dy: -2e-3, roll: 0.1 },
            ..element(Kind::Quadrupole { k1: 0.57 }, 0.5)
        };
        let all = [
            element(Kind::Drift, 1.3),
            rolled,
            element(Kind::Solenoid { ks: 0.3 }, 0.7),
            element(Kind::Wiggler { focusing: 0.2 }, 0.5),
            element(Kind::Sextupole { k2: 3.0 }, 0.3),
            element(Kind::Multipole { k1l: 0.1, k1sl: 0.2, k2l: 2.0, k3l: 50.0 }, 0.5),
            bend(0.0, 0.0),
            bend(0.4, 0.1),
        ];
        for e in all {
            let mut z = Phase::<f64>::new(4e-3, 2e-3, -3e-3, 1e-3, 3e-3, 0.0);
            let map = e.linearise(&mut z);
            let defect = (inverse(&map) * map - Matrix6::identity()).abs().max();
            assert!(defect < 1e-12, "{:?}: {defect:e}", e.kind); // rounding of a few hundred operations
        }
    }

    /// Closed form for a thin edge: S. Y. Lee, Accelerator Physics, eq. 2.41.
    #[test]
    fn edge_focuses_as_its_tangent() {
        let b = Bend { curvature: 0.1, k1: 0.0, k2: 0.0, e1: 0.2, e2: 0.0, fringe: 0.0 };
        let m = derivative(&mut Phase::<f64>::zeros(), |z| b.enter(z));
        let power = 0.1 * 0.2_f64.tan();
        assert!((m[(PX, X)] - power).abs() < 1e-14 && (m[(PY, Y)] + power).abs() < 1e-14);
    }

    #[test]
    fn a_hard_edge_is_a_soft_one_without_extent() {
        let hard = Bend { curvature: 0.1, k1: 0.0, k2: 0.0, e1: 0.2, e2: 0.0, fringe: 0.0 };
        let z = Phase::<f64>::new(4e-3, 0.2, -3e-3, 1e-2, 3e-3, 0.0);
        let ((one, slope), (other, known)) = (hard_edge(&z, 0.1), hard.soft_edge(&z, 0.1));
        assert!((one - other).abs() < 1e-15 && (slope - known).abs().max() < 1e-15, "{slope} {known}");
    }

    #[test]
    fn sector_has_the_text_book_matrix() {
        let m = derivative(&mut Phase::<f64>::zeros(), |z| bend(0.0, 0.0).track(z));
        let (s, c) = 0.09_f64.sin_cos();
        let rho = 10.0;
        let known = [
            ((X, X), c),
            ((X, PX), rho * s),
            ((X, DELTA), rho * (1.0 - c)),
            ((PX, DELTA), s),
            ((Y, PY), 0.9),
            ((PATH, X), s),
        ];
        for (at, value) in known {
            assert!((m[at] - value).abs() < 1e-13, "{at:?}: {} of {value}", m[at]);
        }
    }

    #[test]
    fn slices_suffice() {
        for k1 in [0.8, 0.1, 1e-2, 1e-3, 1e-4] {
            let m = derivative(&mut Phase::<f64>::zeros(), |z| bend(k1, 0.0).track(z));
            let (x, y) = ((k1 + 0.01).sqrt(), k1.sqrt()); // K1 + h^2
            let known = [
                ((X, X), (x * 0.9).cos()),
                ((X, PX), (x * 0.9).sin() / x),
                ((X, DELTA), 0.1 * (1.0 - (x * 0.9).cos()) / (x * x)),
                ((Y, Y), (y * 0.9).cosh()),
                ((Y, PY), (y * 0.9).sinh() / y),
            ];
            for (at, value) in known {
                assert!((m[at] - value).abs() < 1e-6, "{k1}: {at:?}: {:e}", m[at] - value);
            }
        }
    }

    /// On a ray off the axis, against a hundred times as many slices.
    #[test]
    fn slices_suffice_for_a_sextupole() {
        for k2 in [10.0, 0.04] {
            let start = Phase::<f64>::new(8e-3, 1e-3, 5e-3, -1e-3, 1e-3, 0.0);
            let track = |slices: usize| {
                let mut z = start;
                integrate(&mut z, 0.9, slices, drift, |z, l| thin(z, 0.0, 0.0, k2 * l));
                z
            };
            let few = slices(0.0, k2, 0.9);
            assert!((track(few) - track(100 * few)).abs().max() < 1e-8, "{k2}: {few} slices");
        }
    }

    /// The quadrupole's path against the sum over many short exact pieces.
    #[test]
    fn quadrupole_path_is_the_arc_length() {
        let start = Phase::<f64>::new(5e-3, 1e-3, 4e-3, -2e-3, 0.0, 0.0);
        let mut whole = start;
        quadrupole(&mut whole, 0.57, 0.5);
        let (mut z, n) = (start, 20_000);
        for _ in 0..n {
            drift(&mut z, 0.25 / n as f64);
            thin(&mut z, 0.57 * 0.5 / n as f64, 0.0, 0.0);
            drift(&mut z, 0.25 / n as f64);
        }
        assert!((whole[PATH] - z[PATH]).abs() < 1e-11, "{} {}", whole[PATH], z[PATH]);
        assert!((whole[X] - z[X]).abs() < 1e-8);
    }

    #[test]
    fn solenoid_of_no_field_is_a_drift() {
        let mut a = Phase::<f64>::new(1e-3, 2e-3, 3e-3, -1e-3, 1e-3, 0.0);
        let mut b = a;
        solenoid(&mut a, 0.0, 0.8);
        drift(&mut b, 0.8);
        assert!((a - b).abs().max() < 1e-15);
    }
}
