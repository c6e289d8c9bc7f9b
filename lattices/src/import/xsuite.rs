//! A line by Xsuite: `line.to_json("ring.json")`.
//!
//! Fields at their defaults are not in the file. The edge angles of an `RBend` are those against a rectangular dipole, of a `Bend` against a sector
//! dipole; `knl` and `ksl` are integrated and add to `k1` and `k1s`.
//!
//! Source: xtrack 0.118, `Line.to_dict` and the fields of its elements.

use serde_json::{Map, Value};

use super::element::{Element, Format, Lattice, Role};
use super::fields::{DISPLACED, Fields, NONE, Strengths, give};
use measured::MeasuredError;
use measured::folder::Particle;
use twin::limits::{DEPTH, Exceeded};

/// Classes without a field.
const FIELD_FREE: [&str; 6] = ["Drift", "DriftExact", "Marker", "Device", "BeamPositionMonitor", "ParticlesMonitor"];

/// Read it.
pub(super) fn read(file: &str, value: &Value) -> Result<Lattice, MeasuredError> {
    let mut lattice = Lattice::new(file, Format::Xsuite);
    reference(&mut lattice, value)?;
    let (Some(names), Some(elements)) =
        (value.get("element_names").and_then(Value::as_array), value.get("elements").and_then(Value::as_object))
    else {
        return lattice.refuse("expected element_names, a list, and elements, an object".into());
    };
    for name in names {
        let name = name.as_str().unwrap_or_default();
        let found = original(elements, name);
        let found = found.or_else(|exceeded| lattice.refuse(format!("element {name}, a replica: {exceeded}")))?;
        let Some(value) = found else {
            return lattice
                .refuse(format!("element {name} of element_names, or what it replicates, is not among the elements"));
        };
        let fields = Fields { file, name, value };
        match class(value) {
            "DriftSlice" | "DriftExactSlice" => lattice.push(slice(&fields, elements)?)?,
            _ => element(&mut lattice, &fields)?,
        }
    }
    Ok(lattice)
}

/// An element, or the one that a replica is of, which may be a replica again.
fn original<'v>(elements: &'v Map<String, Value>, name: &str) -> Result<Option<&'v Value>, Exceeded> {
    let mut found = elements.get(name);
    for level in 1.. {
        let Some(replica) = found.filter(|one| class(one) == "Replica") else { break };
        DEPTH.check(level)?;
        found = replica.get("parent_name").and_then(Value::as_str).and_then(|parent| elements.get(parent));
    }
    Ok(found)
}

fn class(value: &Value) -> &str {
    value.get("__class__").and_then(Value::as_str).unwrap_or_default()
}

/// Particle and energy; a line may have none.
fn reference(lattice: &mut Lattice, value: &Value) -> Result<(), MeasuredError> {
    let Some(value) = value.get("particle_ref").or_else(|| value.get("env_particles")?.get("particle_ref")) else {
        return Ok(());
    };
    let file = lattice.file.clone();
    let fields = Fields { file: &file, name: "particle_ref", value };
    let rest = fields.maybe("mass0")?.unwrap_or(0.0);
    lattice.particle = Particle::of_rest_energy(rest * 1e-9)
        .ok_or_else(|| fields.wrong(format!("mass0 {rest} eV, expected that of an electron or a proton")))?;
    let momentum =
        if value.get("p0c").is_some_and(Value::is_array) { fields.at("p0c", 0)? } else { fields.number("p0c")? };
    lattice.energy = Some(momentum.hypot(rest) * 1e-9);
    Ok(())
}

fn element(lattice: &mut Lattice, fields: &Fields) -> Result<(), MeasuredError> {
    let class = class(fields.value);
    if fields.any(&["shift_x", "shift_y", "shift_s", "rot_x_rad", "rot_y_rad"])? {
        lattice.leave_out(DISPLACED);
    }
    let mut one = Element {
        name: fields.name.into(),
        kind: class.into(),
        length: fields.number("length")?,
        ..Element::default()
    };
    match class {
        "BeamPositionMonitor" => one.role = Role::Monitor([true; 2]),
        "Cavity" => {
            lattice.rf = lattice.rf.or(fields.maybe("frequency")?.filter(|rf| *rf > 0.0));
            lattice.harmonic = lattice.harmonic.or(fields.maybe("harmonic")?.filter(|one| *one > 0.0));
        }
        "Bend" | "RBend" => return bend(lattice, one, fields),
        "Quadrupole" | "Sextupole" | "Octupole" => {
            let strengths = strengths(fields, one.length)?;
            return give(lattice, one, strengths);
        }
        "Multipole" => return multipole(lattice, one, fields),
        _ if FIELD_FREE.contains(&class) || class.starts_with("Limit") => {}
        _ if class.contains("Slice") => {
            let problem =
                format!("class {class}: expected a line that is not sliced; save it before `slice_thick_elements`");
            return Err(fields.wrong(problem));
        }
        _ => return Err(fields.wrong(format!("class {class} acts on the orbit and is not known here"))),
    }
    lattice.push(one)
}

fn bend(lattice: &mut Lattice, mut one: Element, fields: &Fields) -> Result<(), MeasuredError> {
    one.bend = match fields.maybe("angle")? {
        Some(angle) => angle,
        None => fields.number("h")? * one.length,
    };
    let field = fields.maybe("k0")?.filter(|_| fields.value.get("k0_from_h").and_then(Value::as_bool) != Some(true));
    if let Some(k0) = field.filter(|k0| (k0 * one.length - one.bend).abs() > 1e-9) {
        return Err(fields.wrong(format!(
            "field k0 {k0} /m bends by {} rad, the reference orbit by {} rad",
            k0 * one.length,
            one.bend
        )));
    }
    let (edge_in, soft_in) = edge(fields, "entry", one.bend)?;
    let (edge_out, soft_out) = edge(fields, "exit", one.bend)?;
    (one.edge_in, one.edge_out) = (edge_in, edge_out);
    one.set_fringe(soft_in, soft_out);
    let strengths = strengths(fields, one.length)?;
    if strengths.k1[0] != 0.0 && fields.value.get("rbend_model").and_then(Value::as_str) == Some("straight-body") {
        lattice.leave_out("the straight body of a dipole with a gradient (taken as curved)");
    }
    give(lattice, one, strengths)
}

/// Angle of an edge against a sector dipole's [rad], and fringe integral times full gap [m]; none of an edge that is switched off.
fn edge(fields: &Fields, side: &str, bend: f64) -> Result<(f64, f64), MeasuredError> {
    let key = |what: &str| format!("edge_{side}_{what}");
    let switch = fields.value.get(key("active"));
    let is_off = switch.is_some_and(|on| on.as_f64() == Some(0.0) || on.as_bool() == Some(false));
    let model = fields.value.get(key("model")).and_then(Value::as_str).unwrap_or("linear");
    match model {
        "linear" | "full" | "dipole-only" if !is_off => {
            let rectangular = if class(fields.value) == "RBend" { bend / 2.0 } else { 0.0 };
            let soft = 2.0 * fields.number(&key("fint"))? * fields.number(&key("hgap"))?;
            Ok((rectangular + fields.number(&key("angle"))?, soft))
        }
        "linear" | "full" | "dipole-only" | "suppressed" => Ok((0.0, 0.0)),
        _ => {
            Err(fields
                .wrong(format!("{}: expected linear, full, dipole-only or suppressed, found {model}", key("model"))))
        }
    }
}

/// What is left of a drift where something was inserted.
fn slice(fields: &Fields, elements: &Map<String, Value>) -> Result<Element, MeasuredError> {
    let whole = fields.value.get("parent_name").and_then(Value::as_str).unwrap_or_default();
    let Some(value) = elements.get(whole) else {
        return Err(fields.wrong(format!("expected its drift {whole:?} among the elements")));
    };
    let length = Fields { value, ..*fields }.number("length")? * fields.number("weight")?;
    Ok(Element { name: fields.name.into(), kind: class(fields.value).into(), length, ..Element::default() })
}

/// Thin, or thick and field-free where it has no strengths.
fn multipole(lattice: &mut Lattice, mut one: Element, fields: &Fields) -> Result<(), MeasuredError> {
    let is_thick = fields.value.get("isthick").and_then(Value::as_bool) == Some(true);
    if !is_thick {
        // the length of a thin one is that of the magnet it stands for, and no path
        one.length = 0.0;
    }
    if fields.number("hxl")?.abs() > NONE {
        return Err(fields.wrong("a thin dipole, expected a lattice of thick elements".into()));
    }
    let strengths = strengths(fields, one.length)?;
    give(lattice, one, strengths)
}

fn strengths(fields: &Fields, length: f64) -> Result<Strengths, MeasuredError> {
    let per = if length > 0.0 { length } else { 1.0 };
    let of = |order: usize| {
        let [normal, skew] =
            [fields.at("knl", order)?, fields.at("ksl", order)?].map(|one| if one == 0.0 { 0.0 } else { one / per });
        Ok::<_, MeasuredError>([
            normal + fields.number(&format!("k{order}"))?,
            skew + fields.number(&format!("k{order}s"))?,
        ])
    };
    let is_higher = fields.has_from("knl", 3) || fields.has_from("ksl", 3) || of(3)? != [0.0; 2];
    let dipole = [fields.at("knl", 0)?, fields.at("ksl", 0)?, fields.number("k0s")?];
    let is_dipole = dipole.iter().any(|field| field.abs() > NONE);
    Ok(Strengths {
        k1: of(1)?,
        k2: of(2)?,
        is_dipole,
        is_higher,
        tilt: fields.number("rot_s_rad")? + fields.number("rot_s_rad_no_frame")?,
    })
}
