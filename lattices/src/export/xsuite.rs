//! An Xsuite line as JSON, which `xtrack.Line.from_json` opens; a knob for each corrector, gains and rolls in its expression.
//!
//! Source: xtrack 0.118, `Line.to_dict` and the fields of its elements.

use serde_json::{Map, Value, json};
use twin::{Element, Kind, Misalignment};

use super::at::{charge, vertical_lens};
use super::lattice::Lattice;

/// The file.
pub(super) fn value(lattice: &Lattice) -> Value {
    let elements: Map<String, Value> = lattice.elements.iter().map(|e| (e.name.clone(), element(e))).collect();
    let names: Vec<&str> = lattice.elements.iter().map(|element| element.name.as_str()).collect();
    let knobs: Map<String, Value> = lattice.correctors.iter().map(|c| (c.knob.clone(), json!(0.0))).collect();
    let monitors = lattice.monitors.iter().filter(|channel| !channel.is_ideal());
    json!({
        "__class__": "Line",
        "elements": elements,
        "element_names": names,
        "particle_ref": particle(lattice),
        "_var_management_data": {"var_values": knobs},
        "_var_manager": expressions(lattice),
        "metadata": {"orbitcal": {"machine": lattice.machine, "remarks": lattice.remarks_of("Xsuite", monitors)}},
    })
}

fn particle(lattice: &Lattice) -> Value {
    let (rest, kinetic) = (lattice.particle.rest_energy, lattice.particle.kinetic_energy);
    let momentum = (kinetic * (kinetic + 2.0 * rest)).sqrt() * 1e9;
    json!({"mass0": rest * 1e9, "q0": charge(lattice.particle.name()), "p0c": [momentum]})
}

/// The models that follow the same Hamiltonian as the twin: exact drifts and dipoles with full edges, quadrupoles as
/// matrices.
fn element(element: &Element) -> Value {
    let mut value = match &element.kind {
        Kind::Drift => json!({"__class__": "Drift", "length": element.length, "model": "exact"}),
        Kind::Marker | Kind::Monitor => json!({"__class__": "Marker"}),
        Kind::Corrector { .. } => multipole(&[0.0], &[0.0]),
        Kind::Quadrupole { k1 } => json!({"__class__": "Quadrupole", "length": element.length, "k1": k1}),
        Kind::Sextupole { k2 } => json!({"__class__": "Sextupole", "length": element.length, "k2": k2}),
        Kind::Wiggler { focusing } => json!({"__class__": "FirstOrderTaylorMap", "m1": vertical_lens(*focusing)}),
        Kind::Solenoid { ks } => json!({"__class__": "UniformSolenoid", "length": element.length, "ks": ks}),
        Kind::Multipole { k1l, k1sl, k2l, k3l } => multipole(&[0.0, *k1l, *k2l, *k3l], &[0.0, *k1sl, 0.0, 0.0]),
        Kind::Bend(bend) => {
            let mut value = json!({
            "__class__": "Bend", "length": element.length, "angle": bend.curvature * element.length, "k1": bend.k1,
            "model": "rot-kick-rot", "edge_entry_model": "full", "edge_exit_model": "full",
            "edge_entry_angle": bend.e1, "edge_exit_angle": bend.e2,
            "edge_entry_fint": 0.5, "edge_exit_fint": 0.5, "edge_entry_hgap": bend.fringe, "edge_exit_hgap": bend.fringe,
            });
            if bend.k2 != 0.0 {
                value["knl"] = json!([0.0, 0.0, bend.k2 * element.length]);
            }
            value
        }
    };
    let Misalignment { dx, dy, roll } = element.misalignment;
    for (word, amount) in [("shift_x", dx), ("shift_y", dy), ("rot_s_rad", roll)] {
        if amount != 0.0 {
            value[word] = json!(amount);
        }
    }
    value
}

/// Thin, with integrated strengths.
fn multipole(knl: &[f64], ksl: &[f64]) -> Value {
    json!({"__class__": "Multipole", "order": knl.len() - 1, "knl": knl, "ksl": ksl})
}

/// Kicks of correctors by their knobs: `px -= knl[0]`, `py += ksl[0]`.
fn expressions(lattice: &Lattice) -> Vec<[String; 2]> {
    let of_element = |(at, element): (usize, &Element)| {
        let kick = |plane: usize, sign: f64| {
            let terms = Lattice::channels_of(&lattice.correctors, at)
                .filter(|channel| channel.axis()[plane] != 0.0)
                .map(|channel| format!("({:?} * vars['{}'])", sign * channel.axis()[plane], channel.knob));
            let sum = terms.collect::<Vec<_>>().join(" + ");
            let field = if plane == 0 { "knl" } else { "ksl" };
            (!sum.is_empty()).then(|| [format!("element_refs['{}'].{field}[0]", element.name), sum])
        };
        [kick(0, -1.0), kick(1, 1.0)]
    };
    lattice.elements.iter().enumerate().flat_map(of_element).flatten().collect()
}
