//! The ring of the twin from the rows of a lattice.
//!
//! Rows are written as a machine file (docs/machine.md), with one name each: `QF.5`. A corrector kicks in its middle, which is what a kick
//! spread along a field-free length does; of a winding of a magnet, whose kick is spread along a field, the model knows more ([`winding`]). A magnet with a skew gradient or a further gradient to be fitted is cut in two, with a
//! thin one between its halves.
//! Sextupoles are left out: on the reference orbit they do nothing to first order in the kicks.

use std::collections::BTreeSet;

use serde_json::{Value, json};
use twin::{Plane, Ring};

use crate::error::MeasuredError;
use crate::folder::{Folder, Row};
use crate::unknowns::{Magnets, groups, length};

/// `1/gamma` where no energy is stated: its square is below a thousandth of any ring's momentum compaction.
const ULTRA_RELATIVISTIC: f64 = 1e-4;

/// Thin lenses along a straight, each a pair: a gradient and one that focuses vertically.
const LENSES: usize = 5;
/// Types of the two, as in a machine file.
const PAIR: [&str; 2] = ["multipole", "wiggler"];

/// The ring, with a thin element, a gradient of either kind, in the middle of some rows, and lenses along straights.
///
/// # Errors
/// [`MeasuredError::Lattice`].
pub fn ring(folder: &Folder, cut: &[usize], straights: &[Magnets]) -> Result<Ring, MeasuredError> {
    Ok(Ring::parse(&machine(folder, cut, straights).to_string(), &folder.name)?)
}

/// The same as a machine file, docs/machine.md.
pub fn machine(folder: &Folder, cut: &[usize], straights: &[Magnets]) -> Value {
    let mut elements = Vec::new();
    let fitted: BTreeSet<usize> = groups(folder)[0].iter().flatten().copied().collect();
    for (row, one) in folder.lattice.iter().enumerate() {
        let name = folder.element(row);
        elements.extend(magnet(one, &name, (cut.contains(&row), fitted.contains(&row))));
        let planes = |of: &mut dyn Iterator<Item = (usize, Plane)>| {
            let planes: Vec<Plane> = of.filter(|(at, _)| *at == row).map(|(_, plane)| plane).collect();
            match (planes.contains(&Plane::X), planes.contains(&Plane::Y)) {
                (true, true) => Some("HV"),
                (true, false) => Some("H"),
                (false, true) => Some("V"),
                (false, false) => None,
            }
        };
        let kicks = planes(&mut folder.correctors.iter().map(|one| (one.at, one.plane)));
        let reads = planes(&mut folder.monitors.iter().map(|one| (one.at, one.plane)));
        for (kind, plane, s) in [("corrector", kicks, one.s + one.length / 2.0), ("bpm", reads, one.s)] {
            let Some(plane) = plane else { continue };
            let own = format!("{kind} {name}");
            elements.push(json!({"name": own, "type": kind, "plane": plane, "label": name, "s_start": s, "length": 0}));
        }
    }
    elements.extend(straights.iter().flat_map(|rows| lenses(folder, rows)));
    let s = |one: &Value| one["s_start"].as_f64().unwrap_or(0.0);
    elements.sort_by(|a, b| s(a).total_cmp(&s(b)));
    let rest = folder.meta.particle.rest_energy();
    let energy = folder.meta.energy.unwrap_or(rest / ULTRA_RELATIVISTIC);
    json!({
        "name": folder.name,
        "circumference_m": folder.meta.circumference,
        "k1": {},
        "reference": {"particle": folder.meta.particle.word(), "kinetic_energy_GeV": energy - rest},
        "elements": elements,
    })
}

/// Rows along which a corrector acts that is a winding of a magnet with a field: the halves of its name on both sides of its row, which has no length.
pub fn winding(folder: &Folder, at: usize) -> Option<[usize; 2]> {
    let halves = [at.checked_sub(1)?, at + 1];
    let has_field = |row: &Row| row.length > 0.0 && (row.k1 != 0.0 || row.bend != 0.0);
    let is_half = |&row: &usize| {
        let half = folder.lattice.get(row);
        half.is_some_and(|half| half.name == folder.lattice[at].name && has_field(half))
    };
    (folder.lattice[at].length == 0.0 && halves.iter().all(is_half)).then_some(halves)
}

/// Names of the elements that make a row's magnet: those with a gradient, and the thin skew gradient.
pub fn parts(name: &str, has_skew: bool) -> (Vec<String>, Option<String>) {
    match has_skew {
        true => (vec![format!("{name} first"), format!("{name} second")], Some(format!("{name} skew"))),
        false => (vec![name.into()], None),
    }
}

/// Thin lenses along rows that follow each other: names of a pair, and its distance from the middle [m].
pub fn lens_pairs(folder: &Folder, rows: &[usize]) -> Vec<([String; 2], f64)> {
    let name = folder.element(rows[0]);
    let length = length(folder, rows);
    let pair = |lens: usize| {
        let off = ((lens as f64 + 0.5) / LENSES as f64 - 0.5) * length;
        (PAIR.map(|one| format!("{name} {one} {lens}")), off)
    };
    (0..LENSES).map(pair).collect()
}

/// The same as elements; they may go on at the start of the ring.
fn lenses(folder: &Folder, rows: &[usize]) -> impl Iterator<Item = Value> {
    let (middle, circumference) = (folder.lattice[rows[0]].s + 0.5 * length(folder, rows), folder.meta.circumference);
    lens_pairs(folder, rows).into_iter().flat_map(move |(names, off)| {
        let s = (middle + off) % circumference;
        let lens = |(name, kind)| json!({"name": name, "label": name, "type": kind, "s_start": s, "length": 0});
        names.into_iter().zip(PAIR).map(lens).collect::<Vec<_>>()
    })
}

/// With a thin gradient in its middle, and with a gradient of its own that is fitted: a factor, or one that is added where there is none.
fn magnet(row: &Row, name: &str, (has_skew, is_fitted): (bool, bool)) -> Vec<Value> {
    let (names, thin) = parts(name, has_skew);
    let pieces = names.len();
    let length = row.length / pieces as f64;
    let mut all = Vec::new();
    for (piece, name) in names.iter().enumerate() {
        let s = row.s + piece as f64 * length;
        let mut one = json!({"name": name, "label": name, "s_start": s, "length": length});
        if row.bend != 0.0 {
            let (first, last) = (piece == 0, piece + 1 == pieces);
            one["type"] = json!("sbend");
            one["angle"] = json!(row.bend / pieces as f64);
            one["e1"] = json!(if first { row.edge_in } else { 0.0 });
            one["e2"] = json!(if last { row.edge_out } else { 0.0 });
            one["k1"] = json!(row.k1);
            if row.fringe != 0.0 {
                // of the integral and the half gap twice the product acts, at both ends of every piece
                (one["fint"], one["hgap"]) = (json!(0.5), json!(row.fringe / pieces as f64));
            }
        } else if row.k1 != 0.0 || is_fitted {
            one["type"] = json!("quadrupole");
            one["k1"] = json!(row.k1);
            // a factor of nothing is none
            if row.k1 == 0.0 || !is_fitted {
                one["fit"] = json!(false);
            }
        } else {
            continue;
        }
        all.push(one);
    }
    if let Some(name) = thin {
        let at = row.s + row.length / 2.0;
        let skew = json!({"name": name, "label": name, "type": "multipole", "s_start": at, "length": 0});
        all.insert(all.len().min(1), skew);
    }
    all
}
