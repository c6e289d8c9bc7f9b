//! A lattice in the Particle Accelerator Lattice Standard (PALS), as JSON: YAML reads it as well.
//!
//! Written so that `pals-schema` 0.3 validates it, which calls a sector dipole `SBend` and its fringe integrals `edge_int1`
//! and `edge_int2`. Signs are MAD's: `px -= Kn1L x`, `px += Ks1L y`. Findings stand in the description of the line, gains and
//! rolls of monitors and correctors in those of their elements.
//!
//! Source: pals-project.readthedocs.io, Lattice Element Kinds and Parameter Groups.

use serde_json::{Map, Value, json};
use twin::{Kind, Misalignment};

use super::lattice::Lattice;

/// The file.
pub(super) fn value(lattice: &Lattice) -> Value {
    let particle = lattice.particle;
    let begin = json!({"begin": {"kind": "BeginningEle", "ReferenceP": {
        "species_ref": particle.name(), "E_tot_ref": (particle.rest_energy + particle.kinetic_energy) * 1e9,
        "location": "UPSTREAM_END",
    }}});
    let names = lattice.elements.iter().map(|element| json!(element.name));
    let line: Vec<Value> = core::iter::once(begin).chain(names).collect();
    let mut remarks = lattice.remarks_of("PALS", lattice.not_acted_on());
    remarks.extend(lattice.elements.iter().filter_map(|element| match element.kind {
        Kind::Wiggler { focusing } => {
            Some(format!("PALS does not act on the vertical focusing of {}, {focusing} /m", element.name))
        }
        _ => None,
    }));
    let about = json!({"label": lattice.machine, "description": remarks.join("\n")});
    let ring = json!({"ring": {"kind": "BeamLine", "periodic": true, "line": line, "MetaP": about}});
    let whole = json!({"lattice": {"kind": "Lattice", "branches": ["ring"]}});
    let elements = (0..lattice.elements.len()).map(|at| element(lattice, at));
    let facility: Vec<Value> = elements.chain([ring, whole, json!({"use": "lattice"})]).collect();
    json!({"PALS": {"facility": facility}})
}

/// `{name: {kind, length, ...}}`
fn element(lattice: &Lattice, at: usize) -> Value {
    let element = &lattice.elements[at];
    let (kind, groups) = match &element.kind {
        Kind::Drift => ("Drift", json!({})),
        // a format without a lens that focuses in one plane has its place
        Kind::Marker | Kind::Wiggler { .. } => ("Marker", json!({})),
        Kind::Monitor => ("Instrument", json!({})),
        Kind::Corrector { .. } => ("Kicker", magnet(json!({"Kn0L": 0.0, "Ks0L": 0.0}))),
        Kind::Quadrupole { k1 } => ("Quadrupole", magnet(json!({"Kn1": k1}))),
        Kind::Sextupole { k2 } => ("Sextupole", magnet(json!({"Kn2": k2}))),
        Kind::Multipole { k1l, k1sl, k2l, k3l } => {
            ("Multipole", magnet(json!({"Kn1L": k1l, "Ks1L": k1sl, "Kn2L": k2l, "Kn3L": k3l})))
        }
        Kind::Solenoid { ks } => ("Solenoid", json!({"SolenoidP": {"Ksol": ks}})),
        Kind::Bend(bend) => {
            let field = if bend.k2 == 0.0 { json!({"Kn1": bend.k1}) } else { json!({"Kn1": bend.k1, "Kn2": bend.k2}) };
            let mut groups = magnet(field);
            // fint times half the gap
            let edge = bend.fringe / 2.0;
            groups["BendP"] = json!({
                "g_ref": bend.curvature, "e1": bend.e1, "e2": bend.e2, "edge_int1": edge, "edge_int2": edge,
                "tilt_ref": element.misalignment.roll,
            });
            ("SBend", groups)
        }
    };
    let Value::Object(mut fields) = groups else { unreachable!("made as one above") };
    fields.insert("kind".into(), json!(kind));
    fields.insert("length".into(), json!(element.length));
    shift(lattice, at, &mut fields);
    describe(lattice, at, &mut fields);
    json!({&element.name: fields})
}

fn magnet(multipoles: Value) -> Value {
    json!({"MagneticMultipoleP": multipoles})
}

/// A dipole's reference orbit rolls along with it, which `tilt_ref` says; all else is a shift of the body.
fn shift(lattice: &Lattice, at: usize, fields: &mut Map<String, Value>) {
    let element = &lattice.elements[at];
    let Misalignment { dx, dy, roll } = element.misalignment;
    let roll = match element.kind {
        Kind::Bend(_) => 0.0,
        Kind::Corrector { .. } => lattice.corrector_roll(at),
        _ => roll,
    };
    if [dx, dy, roll] != [0.0; 3] {
        fields.insert("BodyShiftP".into(), json!({"x_offset": dx, "y_offset": dy, "z_rot": roll}));
    }
}

fn describe(lattice: &Lattice, at: usize, fields: &mut Map<String, Value>) {
    let channels = Lattice::channels_of(&lattice.monitors, at).chain(Lattice::channels_of(&lattice.correctors, at));
    let words: Vec<String> = channels.filter(|channel| !channel.is_ideal()).map(|channel| channel.words()).collect();
    if !words.is_empty() {
        fields.insert("MetaP".into(), json!({"description": words.join("; ")}));
    }
}
