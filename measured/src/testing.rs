//! A small storage ring that is measured in the tests: twelve cells of two quadrupoles and a dipole; tunes 4.25 and 3.26.

use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use twin::{Plane, Rf};

use crate::folder::{CorrectorRow, Flags, Folder, Group, Meta, MonitorRow, Particle, ReferenceFit, Row};
use crate::model::Model;
use crate::unknowns::{Kind, Unknown, Widths, groups, unknowns};

const CELLS: usize = 12;
/// Noise of an element of the matrix [mm].
pub const NOISE: f64 = 0.002;

/// The ring with a matrix of zeros.
pub fn ring() -> Folder {
    let mut lattice = Vec::new();
    let mut s = 0.0;
    let mut add = |name: &str, length: f64, bend: f64, k1: f64| {
        let edge = bend / 2.0;
        let row =
            Row { name: name.into(), s, length, bend, edge_in: edge, edge_out: edge, fringe: 0.0, k1, half_k2: 0.0 };
        s += length;
        lattice.push(row);
        lattice.len() - 1
    };
    let (mut monitors, mut correctors, mut skew) = (Vec::new(), Vec::new(), Vec::new());
    for cell in 0..CELLS {
        let at = add("BPM", 0.0, 0.0, 0.0);
        for plane in [Plane::X, Plane::Y] {
            monitors.push(MonitorRow { plane, at, sigma: NOISE, is_used: true });
        }
        add("L", 0.4, 0.0, 0.0);
        add("QF", 0.3, 0.0, 4.0);
        let at = add("COR", 0.2, 0.0, 0.0);
        for (plane, kick) in [(Plane::X, 0.2), (Plane::Y, 0.15)] {
            correctors.push(CorrectorRow { plane, at, kick, is_used: true });
        }
        add("B", 1.2, core::f64::consts::TAU / CELLS as f64, 0.0);
        if cell % 3 == 0 {
            skew.push(add("SD", 0.2, 0.0, 0.0));
        }
        add("QD", 0.3, 0.0, -3.0);
        add("L", 0.6 + 0.2 * f64::from(u8::from(cell % 3 != 0)), 0.0, 0.0);
    }
    // rows x then y, columns H then V, as in a measured matrix
    monitors.sort_by_key(|one| one.plane.index());
    correctors.sort_by_key(|one| one.plane.index());
    let group = |elements: Vec<usize>, field: &str| Group { elements, field: field.into() };
    let gradients = (0..lattice.len()).filter(|&row| lattice[row].k1 != 0.0).map(|row| group(vec![row, row], "K"));
    let skews = skew.iter().map(|&row| group(vec![row], "PolynomA"));
    let fit_parameters = gradients.chain(skews).collect();
    let flags = Flags { coupling: "Yes".into(), dispersion: "Yes".into(), rest: Default::default() };
    let meta = Meta {
        circumference: s,
        energy: Some(1.5),
        particle: Particle::Electron,
        rf: 5e8,
        delta_rf: 2e3,
        reference_fit: Some(ReferenceFit { fit_parameters, flags, rest: Default::default() }),
    };
    let matrix = DMatrix::zeros(monitors.len(), correctors.len());
    let dispersion = Some(DVector::zeros(monitors.len()));
    Folder { name: "ring".into(), meta, lattice, monitors, correctors, matrix, dispersion }
}

/// The ring with one corrector, of column 2, as a winding of the quadrupole before it, which is cut in its middle.
pub fn ring_with_winding() -> Folder {
    let mut ring = ring();
    let magnet = (0..ring.lattice.len()).find(|&row| ring.lattice[row].name == "QF" && row > 10).expect("it has QF");
    let half = Row { length: ring.lattice[magnet].length / 2.0, ..ring.lattice[magnet].clone() };
    let middle = Row { s: half.s + half.length, length: 0.0, k1: 0.0, ..half.clone() };
    ring.lattice.splice(magnet..=magnet, [half.clone(), middle.clone(), Row { s: middle.s, ..half }]);
    let behind = |row: usize| if row > magnet { row + 2 } else { row };
    ring.monitors.iter_mut().for_each(|one| one.at = behind(one.at));
    ring.correctors.iter_mut().for_each(|one| one.at = behind(one.at));
    for group in ring.meta.reference_fit.iter_mut().flat_map(|fit| &mut fit.fit_parameters) {
        let is_it = group.elements.contains(&magnet);
        group.elements =
            if is_it { vec![magnet, magnet + 2] } else { group.elements.iter().map(|&row| behind(row)).collect() };
    }
    ring.correctors[2].at = magnet + 1;
    ring
}

/// Normal numbers of unit width, fixed by a seed.
pub fn normal(seed: u64) -> impl FnMut() -> f64 {
    let mut random = StdRng::seed_from_u64(seed);
    move || StandardNormal.sample(&mut random)
}

/// The model of the ring, its unknowns, and values of an imperfect machine: strengths 1 %, skew gradients 0.002 /m, gains 3 %, couplings 1 %.
pub fn machine(folder: &Folder, seed: u64) -> (Model, Vec<Unknown>, DVector<f64>) {
    let groups = groups(folder);
    let model = Model::of(folder, &groups, Rf::FixedFrequency).unwrap();
    let all = unknowns(folder, &groups, true, &Widths::default());
    let mut normal = normal(seed);
    let size = |kind: Kind| match kind {
        Kind::Strength(_) => 0.01,
        Kind::Skew(_) => 0.002,
        Kind::MonitorGain(_) | Kind::CorrectorGain(_) => 0.03,
        Kind::MonitorCoupling(_) | Kind::CorrectorCoupling(_) => 0.01,
        Kind::Gradient(_)
        | Kind::Added(_)
        | Kind::Wiggler(_)
        | Kind::Moment(..)
        | Kind::RfScale
        | Kind::HeldFrequency => 0.0,
    };
    let values = all.iter().map(|one| one.mean + size(one.kind) * normal());
    let values = DVector::from_iterator(all.len(), values);
    (model, all, values)
}

/// The ring as it was measured, with noise `sigma` [mm].
pub fn measured(
    folder: &Folder,
    (model, unknowns, values): &(Model, Vec<Unknown>, DVector<f64>),
    sigma: f64,
    seed: u64,
) -> Folder {
    let mut normal = normal(seed);
    let seen = model.predict(unknowns, values).unwrap().matrix.map(|value| value + sigma * normal());
    let last = seen.ncols() - 1;
    Folder {
        matrix: seen.columns(0, last).into_owned(),
        dispersion: Some(seen.column(last).into_owned()),
        ..folder.clone()
    }
}
