//! Skew gradients of an orbit in the sextupole fields of the design that is not the one that the monitors' baselines tell.
//!
//! The readings are linearised about that orbit ([`super::data`]), so that what it is off by remains: in a field `K2L` an orbit that is `y` higher is a skew
//! gradient `K2L y`. It acts on the beam as a roll `K2L y/(2 K1L)` of the nearest quadrupole; of a sextupole in the Booster 16 % of it are no such roll, by
//! the phase between the two. The normal gradient `K2L x` is part of the quadrupole's var, of whose scatter it is a small share. Errors at different places
//! are taken to be independent, though one orbit makes them, so that those of neighbouring sextupoles resemble each other.

use twin::{Kind, Ring};

use super::baseline::Baseline;

/// Standard deviation of the roll of each quadrupole `[M]` that stands for the fields nearest to it [rad]; 0 where there is none.
pub fn rolls(ring: &Ring, baseline: &Baseline) -> Vec<f64> {
    let middle = |element: usize| ring.elements[element].s + 0.5 * ring.elements[element].length;
    let strength = ring.integrated_gradients();
    let mut squares = vec![0.0; strength.len()];
    for (element, k2l) in sextupoles(ring) {
        let apart = |q: &usize| ring.distance(middle(ring.quadrupoles[*q].element), middle(element));
        let powered = (0..strength.len()).filter(|&q| strength[q] != 0.0);
        if let Some(q) = powered.min_by(|one, other| apart(one).total_cmp(&apart(other))) {
            squares[q] += (0.5 * k2l * baseline.sigma[element][1] / strength[q]).powi(2);
        }
    }
    squares.into_iter().map(f64::sqrt).collect()
}

/// Elements with a sextupole field, and its K2L [1/m^2].
fn sextupoles(ring: &Ring) -> impl Iterator<Item = (usize, f64)> {
    let strength = |(at, element): (usize, &twin::Element)| {
        let k2l = match &element.kind {
            Kind::Sextupole { k2 } => k2 * element.length,
            Kind::Bend(bend) => bend.k2 * element.length,
            Kind::Multipole { k2l, .. } => *k2l,
            _ => 0.0,
        };
        (k2l != 0.0).then_some((at, k2l))
    };
    ring.elements.iter().enumerate().filter_map(strength)
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;
    use twin::{EffectKind, Machine, Rf, Signatures, Site};

    use super::*;
    use crate::testing::{template, whitened};

    /// A sextupole of K2L = 2 /m^2 between two quadrupoles, which the orbit passes 1 mm higher: what the fit's machine sees of it is a roll of the nearest one.
    #[test]
    fn an_orbit_in_a_sextupole_is_a_roll_of_the_nearest_quadrupole() {
        let (mut ring, recording) = template();
        let data = whitened(&ring, &recording);
        let baseline = |y: f64| {
            let mut baseline = data.baseline.clone();
            baseline.sigma.iter_mut().for_each(|sigma| sigma[1] = y);
            baseline
        };
        assert!(
            rolls(&ring, &baseline(1e-3)).iter().all(|roll| *roll == 0.0),
            "the Booster's design has no sextupole field"
        );
        let at = ring.elements.iter().position(|one| matches!(one.kind, Kind::Sextupole { .. })).unwrap();
        let k2 = 2.0 / ring.elements[at].length;
        ring.elements[at].kind = Kind::Sextupole { k2 };
        let rolls = rolls(&ring, &baseline(1e-3));
        let quadrupole = rolls.iter().position(|roll| *roll > 0.0).unwrap();
        assert_eq!(rolls.iter().filter(|roll| **roll > 0.0).count(), 1);
        let k1l = ring.integrated_gradients()[quadrupole];
        assert!((rolls[quadrupole] - 1e-3 / k1l.abs()).abs() < 1e-12);
        let machine = Machine::new(ring.clone(), Rf::FixedMomentum, &[]).unwrap();
        let signatures = Signatures::of(&machine, &data.drives).unwrap();
        let rolled = signatures.of_effect(EffectKind::QuadRoll, Site::Quadrupole(quadrupole)).unwrap().readings;
        let skew = signatures
            .of_thin(twin::Place { element: at, depth: 0.5 * ring.elements[at].length }, twin::Thin::Skew)
            .readings;
        let flat = |one: &nalgebra::DMatrix<f64>| DVector::from_column_slice(one.as_slice());
        let (rolled, skew) = (flat(&rolled) * (rolls[quadrupole] * k1l.signum()), flat(&skew) * 2e-3);
        let left = (&skew - &rolled * (skew.dot(&rolled) / rolled.norm_squared())).norm() / skew.norm();
        assert!(left < 0.2, "{left}");
    }
}
