//! A lattice in the Particle Accelerator Lattice Standard, as YAML or JSON.
//!
//! Elements stand by name among the facility, or whole in a line; lines may hold lines and `repeat` them. Signs are MAD's. The words of
//! `pals-schema` 0.3 (`SBend`, `edge_int1`) and those of the standard since then (`Bend`, `edge1_int`) are read, and what Tao's `write pals` has of its own: `L`,
//! `pc_ref`, `rf_frequency`, and a dipole's numbers among `ParticleP`.
//!
//! Source: pals-project.readthedocs.io, Lattice Element Kinds and Parameter Groups.

use std::collections::HashMap;

use serde_json::Value;

use super::element::{Element, Format, Lattice, Role};
use super::fields::{DISPLACED, Fields, NONE, Strengths, give};
use measured::MeasuredError;
use measured::folder::Particle;
use twin::limits::{Budget, DEPTH, ELEMENTS};

/// Kinds without a field that matters here.
const FIELD_FREE: [&str; 10] = [
    "Drift",
    "Marker",
    "Instrument",
    "Kicker",
    "ACKicker",
    "Mask",
    "Fiducial",
    "Placeholder",
    "RFCavity",
    "CrabCavity",
];

/// Read it.
pub(super) fn read(file: &str, value: &Value) -> Result<Lattice, MeasuredError> {
    let mut lattice = Lattice::new(file, Format::Pals);
    let Some(facility) = value["PALS"].get("facility").and_then(Value::as_array) else {
        return lattice.refuse("PALS.facility: expected a list".into());
    };
    let named: HashMap<&str, &Value> = facility.iter().filter_map(entry).collect();
    let used = facility.iter().filter_map(|one| one.get("use")?.as_str()).next_back();
    let first = named.iter().find(|(_, one)| kind(one) == "Lattice").map(|(name, _)| *name);
    let Some(start) = used.or(first) else {
        return lattice.refuse("expected `use: NAME` or a Lattice, found neither".into());
    };
    Facility { named, entered: Budget::new(ELEMENTS) }.walk(&mut lattice, start, None, 0)?;
    Ok(lattice)
}

/// What a facility has by name, and how many lines and elements were entered: a line may repeat many of nothing.
struct Facility<'v> {
    named: HashMap<&'v str, &'v Value>,
    entered: Budget,
}

/// `{name: {kind, ...}}`
fn entry(value: &Value) -> Option<(&str, &Value)> {
    let (name, value) = value.as_object()?.iter().next()?;
    Some((name.as_str(), value))
}

fn kind(value: &Value) -> &str {
    value.get("kind").and_then(Value::as_str).unwrap_or_default()
}

impl Facility<'_> {
    /// Elements of a lattice's first branch, of a line, or one element.
    fn walk(&self, lattice: &mut Lattice, name: &str, whole: Option<&Value>, depth: u64) -> Result<(), MeasuredError> {
        let Some(value) = whole.filter(|one| !kind(one).is_empty()).or_else(|| self.named.get(name).copied()) else {
            return lattice.refuse(format!("{name} stands in a line and not in the facility"));
        };
        if let Err(exceeded) = DEPTH.check(depth).and_then(|()| self.entered.take(1)) {
            return lattice.refuse(format!("{name}: {exceeded}"));
        }
        let (key, count) = match kind(value) {
            "Lattice" => ("branches", Some(1)),
            "BeamLine" => ("line", None),
            _ => {
                let file = lattice.file.clone();
                return element(lattice, &Fields { file: &file, name, value });
            }
        };
        let parts = value.get(key).and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
        for part in parts.iter().take(count.unwrap_or(parts.len())) {
            let (name, whole) = match (part.as_str(), entry(part)) {
                (Some(name), _) => (name, None),
                (_, Some((name, whole))) => (name, Some(whole)),
                _ => return lattice.refuse(format!("{name}: expected names and elements in its {key}, found {part}")),
            };
            let times = whole.and_then(|one| one.get("repeat")).map_or(Some(1), Value::as_u64);
            let Some(times) = times else {
                return lattice.refuse(format!("{name}: expected to repeat a whole number of times, found {part}"));
            };
            for _ in 0..times {
                self.walk(lattice, name, whole, depth + 1)?;
            }
        }
        Ok(())
    }
}

fn element(lattice: &mut Lattice, fields: &Fields) -> Result<(), MeasuredError> {
    let kind = kind(fields.value);
    if fields.value.get("inherit").is_some() {
        return Err(fields.wrong("`inherit` is not read; expected a lattice whose elements are written out".into()));
    }
    if let Some(reference) = fields.value.get("ReferenceP") {
        self::reference(lattice, &Fields { value: reference, ..*fields })?;
    }
    let mut one = Element {
        name: fields.name.into(),
        kind: kind.into(),
        length: either(fields, ["length", "L"])?.unwrap_or(0.0),
        ..Element::default()
    };
    match kind {
        "BeginningEle" => return Ok(()),
        "Instrument" => one.role = Role::Monitor([true; 2]),
        "Kicker" => one.role = Role::Corrector([true; 2]),
        "RFCavity" => {
            let group = fields.group("RFP");
            lattice.rf = lattice.rf.or(either(&group, ["frequency", "rf_frequency"])?.filter(|rf| *rf > 0.0));
            lattice.harmonic = lattice.harmonic.or(group.maybe("harmon")?.filter(|one| *one > 0.0));
        }
        "Bend" | "SBend" | "RBend" => bend(&mut one, fields)?,
        "Quadrupole" | "Sextupole" | "Octupole" | "Multipole" => {}
        "Solenoid" if fields.group("SolenoidP").number("Ksol")? == 0.0 => {}
        _ if FIELD_FREE.contains(&kind) => {}
        _ => return Err(fields.wrong(format!("kind {kind} acts on the orbit and is not known here"))),
    }
    if fields.group("BodyShiftP").any(&["x_offset", "y_offset", "z_offset", "x_rot", "y_rot"])? {
        lattice.leave_out(DISPLACED);
    }
    let strengths = strengths(fields, one.length)?;
    give(lattice, one, strengths)
}

fn reference(lattice: &mut Lattice, fields: &Fields) -> Result<(), MeasuredError> {
    lattice.particle = match fields.value.get("species_ref").and_then(Value::as_str) {
        None | Some("electron" | "positron" | "#e-" | "#e+") => Particle::Electron,
        Some("proton" | "antiproton") => Particle::Proton,
        Some(other) => return Err(fields.wrong(format!("species_ref: expected electron or proton, found {other}"))),
    };
    let by_momentum = fields.maybe("pc_ref")?.map(|momentum| (momentum * 1e-9).hypot(lattice.particle.rest_energy()));
    lattice.energy = lattice.energy.or(fields.maybe("E_tot_ref")?.map(|energy| energy * 1e-9)).or(by_momentum);
    Ok(())
}

fn bend(one: &mut Element, fields: &Fields) -> Result<(), MeasuredError> {
    let group = fields.group(if fields.value.get("BendP").is_some() { "BendP" } else { "ParticleP" });
    one.bend = match (group.maybe("g_ref")?, group.maybe("angle_ref")?) {
        (Some(curvature), _) => curvature * one.length,
        (None, Some(angle)) => angle,
        (None, None) => return Err(fields.wrong("a dipole without g_ref or angle_ref".into())),
    };
    let field = fields.group("MagneticMultipoleP").number("Kn0")? * one.length;
    if field.abs() > NONE && (field - one.bend).abs() > 1e-9 {
        return Err(fields.wrong(format!("field Kn0 bends by {field} rad, the reference orbit by {} rad", one.bend)));
    }
    let half = one.bend / 2.0;
    // where neither angle is stated, the faces are those of its kind
    let unstated = if kind(fields.value) == "RBend" { half } else { 0.0 };
    let face = |sector: &str, rectangular: &str| {
        let rectangular = group.maybe(rectangular)?.map(|angle| angle + half);
        Ok::<_, MeasuredError>(group.maybe(sector)?.or(rectangular).unwrap_or(unstated))
    };
    (one.edge_in, one.edge_out) = (face("e1", "e1_rect")?, face("e2", "e2_rect")?);
    // fint times half the gap
    let soft = |words| Ok::<_, MeasuredError>(2.0 * either(&group, words)?.unwrap_or(0.0));
    one.set_fringe(soft(["edge1_int", "edge_int1"])?, soft(["edge2_int", "edge_int2"])?);
    Ok(())
}

/// A number that goes by one of two words.
fn either(fields: &Fields, words: [&str; 2]) -> Result<Option<f64>, MeasuredError> {
    Ok(fields.maybe(words[0])?.or(fields.maybe(words[1])?))
}

fn strengths(fields: &Fields, length: f64) -> Result<Strengths, MeasuredError> {
    let group = fields.group("MagneticMultipoleP");
    if let Some(field) = group.value.as_object().and_then(|map| map.keys().find(|key| key.starts_with('B'))) {
        return Err(fields.wrong(format!("{field}: a field in tesla, expected strengths over the rigidity (Kn, Ks)")));
    }
    let per = if length > 0.0 { length } else { 1.0 };
    let of = |order: usize, sort: &str| {
        let integrated = group.number(&format!("K{sort}{order}L"))? / per;
        Ok::<_, MeasuredError>(integrated + group.number(&format!("K{sort}{order}"))?)
    };
    let both = |order| Ok::<_, MeasuredError>([of(order, "n")?, of(order, "s")?]);
    let tilt = fields.group("BodyShiftP").number("z_rot")? + fields.group("BendP").number("tilt_ref")?;
    Ok(Strengths { k1: both(1)?, k2: both(2)?, is_dipole: both(0)? != [0.0; 2], is_higher: both(3)? != [0.0; 2], tilt })
}
