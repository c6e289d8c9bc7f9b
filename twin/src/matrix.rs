//! Linear maps about the design orbit, in closed form.
//!
//! A ray on the axis of an element that neither kicks nor is displaced stays there, and its linear map is the text book's; about any other ray
//! it is the derivative of the exact map ([`super::map`]). The two agree to rounding, and to 2e-6 where the exact map is integrated in slices.
//!
//! Source: K. L. Brown, SLAC-75 (1982), eq. 2.1 and table I; edges with their first soft-edge correction, SLAC-75, eq. 4.20.

use nalgebra::Matrix6;

use crate::lattice::{Bend, Element, Kind, Misalignment};
use crate::map::{DELTA, PATH, PX, PY, Phase, X, Y, focus};

impl Element {
    /// The map of the axis from the entrance to `depth` [m] inside, in the element's own axes, and out at the end of the element; none if the axis is no orbit.
    pub(crate) fn matrix(&self, z: &Phase<f64>, depth: f64, leaves: bool) -> Option<Matrix6<f64>> {
        let Misalignment { dx, dy, roll } = self.misalignment;
        let is_on_axis = [X, PX, Y, PY, DELTA].iter().all(|&at| z[at] == 0.0) && dx == 0.0 && dy == 0.0;
        if !is_on_axis {
            return None;
        }
        let own = self.own_matrix(depth, leaves)?;
        if roll == 0.0 {
            return Some(own);
        }
        let rotation = self.misalignment.rotation();
        Some(if leaves { rotation.transpose() * own * rotation } else { own * rotation })
    }

    /// The same from its own axes.
    fn own_matrix(&self, depth: f64, leaves: bool) -> Option<Matrix6<f64>> {
        match &self.kind {
            Kind::Drift | Kind::Marker | Kind::Monitor | Kind::Sextupole { .. } => Some(body(0.0, 0.0, depth)),
            Kind::Corrector { kick } => (*kick == [0.0; 2]).then(|| body(0.0, 0.0, depth)),
            Kind::Quadrupole { k1 } => Some(body(0.0, *k1, depth)),
            Kind::Multipole { k1l, k1sl, .. } => Some(body(0.0, 0.0, depth) * thin(*k1l, *k1sl)),
            Kind::Wiggler { focusing } => {
                let mut map = body(0.0, 0.0, depth);
                map[(Y, Y)] -= depth * focusing;
                map[(PY, Y)] = -focusing;
                Some(map)
            }
            Kind::Solenoid { .. } => None,
            Kind::Bend(bend) => {
                let inside = body(bend.curvature, bend.k1, depth) * bend.edge(bend.e1);
                Some(if leaves { bend.edge(bend.e2) * inside } else { inside })
            }
        }
    }
}

impl Bend {
    /// An edge of angle `e` [rad]: `px += h tan(e) x`, `py -= h tan(e - h F (1 + sin^2 e)/cos e) y`, `F` the fringe integral [m].
    fn edge(&self, e: f64) -> Matrix6<f64> {
        let h = self.curvature;
        let mut map = Matrix6::identity();
        let soft = h * self.fringe * (1.0 + e.sin().powi(2)) / e.cos();
        map[(PX, X)] = h * e.tan();
        map[(PY, Y)] = -h * (e - soft).tan();
        map
    }
}

/// A body of curvature `h` and gradient `k1`: `x'' = -(h^2 + k1) x + h delta`, `y'' = k1 y`, `path' = h x`.
fn body(h: f64, k1: f64, length: f64) -> Matrix6<f64> {
    let mut map = Matrix6::identity();
    let k = h * h + k1;
    let (c, s) = focus(k, length);
    (map[(X, X)], map[(X, PX)], map[(PX, X)], map[(PX, PX)]) = (c, s, -k * s, c);
    let (c_y, s_y) = focus(-k1, length);
    (map[(Y, Y)], map[(Y, PY)], map[(PY, Y)], map[(PY, PY)]) = (c_y, s_y, k1 * s_y, c_y);
    if h != 0.0 {
        // (1 - c)/k and (length - s)/k, to fourth order in the length without focusing
        let is_weak = (k * length * length).abs() < 1e-8;
        let dispersion = if is_weak { 0.5 * length * length } else { (1.0 - c) / k };
        let path = if is_weak { length.powi(3) / 6.0 } else { (length - s) / k };
        (map[(X, DELTA)], map[(PX, DELTA)]) = (h * dispersion, h * s);
        (map[(PATH, X)], map[(PATH, PX)], map[(PATH, DELTA)]) = (h * s, h * dispersion, h * h * path);
    }
    map
}

fn thin(k1l: f64, k1sl: f64) -> Matrix6<f64> {
    let mut map = Matrix6::identity();
    (map[(PX, X)], map[(PX, Y)], map[(PY, X)], map[(PY, Y)]) = (-k1l, k1sl, k1sl, k1l);
    map
}

#[cfg(test)]
mod tests {
    use super::*;

    fn element(kind: Kind, length: f64) -> Element {
        Element { kind, ..Element::drift(0.0, length) }
    }

    #[test]
    fn closed_forms_are_the_derivatives_of_the_exact_maps() {
        let bend = |curvature: f64, k1: f64, e1: f64, e2: f64, fringe: f64| {
            element(Kind::Bend(Bend { curvature, k1, k2: 0.3, e1, e2, fringe }), 2.4)
        };
        // rounding; with a gradient the error of the slices
        let all = [
            (element(Kind::Drift, 1.3), 1e-13),
            (element(Kind::Quadrupole { k1: 0.57 }, 0.5), 1e-13),
            (element(Kind::Quadrupole { k1: -0.57 }, 0.5), 1e-13),
            (element(Kind::Corrector { kick: [0.0; 2] }, 0.2), 1e-13),
            (element(Kind::Sextupole { k2: 3.0 }, 0.3), 1e-13),
            (element(Kind::Wiggler { focusing: 0.2 }, 0.5), 1e-13),
            (element(Kind::Multipole { k1l: 0.1, k1sl: 0.2, k2l: 2.0, k3l: 50.0 }, 0.5), 1e-13),
            (bend(0.072, 0.0, 0.0, 0.0, 0.0), 1e-13),
            (bend(0.072, 0.0, 0.1, -0.05, 0.02), 1e-13),
            (bend(0.072, 1e-3, 0.1, 0.0, 0.02), 1e-6),
            (bend(0.072, -0.1, 0.0, 0.1, 0.0), 2e-6),
            (bend(0.0, 0.1, 0.0, 0.0, 0.0), 2e-6),
        ];
        let rolled = |(element, tolerance): &(Element, f64)| {
            (
                Element { misalignment: Misalignment { roll: 0.3, ..Misalignment::default() }, ..element.clone() },
                *tolerance,
            )
        };
        let all = all.iter().cloned().chain(all.iter().map(rolled));
        for (element, tolerance) in all {
            let axis = Phase::<f64>::zeros();
            for depth in [0.4 * element.length, element.length] {
                let exact = crate::map::derivative(&mut axis.clone_owned(), |z| element.track_into(z, depth));
                let off = (element.matrix(&axis, depth, false).unwrap() - exact).abs().max();
                assert!(off < tolerance, "{:?} to {depth} m: {off:e}", element.kind);
            }
            let exact = crate::map::derivative(&mut axis.clone_owned(), |z| element.track(z));
            let off = (element.matrix(&axis, element.length, true).unwrap() - exact).abs().max();
            assert!(off < tolerance, "{:?}: {off:e}", element.kind);
        }
    }
}
