//! A lattice by pyAT: `at.save_lattice(ring, "ring.json")`.
//!
//! `PolynomB` is `(-, K1, K2/2, ...)`, `PolynomA` the same of skew fields; edge angles are those against a sector dipole. `R1` rolls an element, by
//! the angle whose cosine and sine begin its first row.
//!
//! Source: pyAT 0.9, modules `at.load.json` and `at.lattice.elements`.

use serde_json::Value;

use super::element::{Element, Format, Lattice, Role, UNBENT};
use super::fields::{DISPLACED, Fields, KICKS, NONE, ROLLED, Strengths, give};
use measured::MeasuredError;
use measured::folder::Particle;
use twin::limits::ELEMENTS;

/// More periods than any ring has.
const MOST_PERIODS: f64 = 1_000.0;
/// Classes without a field that matters here.
const FIELD_FREE: [&str; 14] = [
    "Drift",
    "Marker",
    "Monitor",
    "BeamMoments",
    "SliceMoments",
    "Aperture",
    "LongtAperture",
    "Collimator",
    "Corrector",
    "QuantumDiffusion",
    "SimpleQuantDiff",
    "SimpleRadiation",
    "EnergyLoss",
    "RingParam",
];
/// Classes of magnets.
const MAGNETS: [&str; 8] =
    ["Dipole", "Bend", "Quadrupole", "Sextupole", "Octupole", "Multipole", "ThinMultipole", "VariableThinMultipole"];

/// What the names of pass methods contain that track a magnet's field.
const FIELDS: [&str; 4] = ["Pole", "Bend", "Bnd", "Quad"];
/// Pass methods that track no field, whatever the element has.
const FIELD_FREE_PASSES: [&str; 6] =
    ["IdentityPass", "DriftPass", "ExactDriftPass", "CorrectorPass", "AperturePass", "EAperturePass"];

/// Read it.
pub(super) fn read(file: &str, value: &Value) -> Result<Lattice, MeasuredError> {
    let mut lattice = Lattice::new(file, Format::At);
    let properties = Fields { file, name: "properties", value: value.get("properties").unwrap_or(&Value::Null) };
    lattice.energy = properties.maybe("energy")?.map(|energy| energy * 1e-9);
    lattice.particle = particle(&properties)?;
    let periods = properties.maybe("periodicity")?.unwrap_or(1.0);
    let Some(elements) = value.get("elements").and_then(Value::as_array) else {
        return lattice.refuse("elements: expected a list".into());
    };
    if !(1.0..=MOST_PERIODS).contains(&periods) {
        return lattice.refuse(format!("periodicity: expected 1 to {MOST_PERIODS}, found {periods}"));
    }
    if let Err(exceeded) = ELEMENTS.check(elements.len() as u64 * periods as u64) {
        return lattice.refuse(format!("{} elements x periodicity {periods}: {exceeded}", elements.len()));
    }
    for _ in 0..periods as usize {
        for (index, value) in elements.iter().enumerate() {
            let name = value.get("FamName").and_then(Value::as_str).map_or(format!("#{index}"), str::to_owned);
            element(&mut lattice, &Fields { file, name: &name, value })?;
        }
    }
    Ok(lattice)
}

fn particle(properties: &Fields) -> Result<Particle, MeasuredError> {
    match properties.value.get("particle").and_then(|particle| particle.get("name")).and_then(Value::as_str) {
        None | Some("electron" | "positron" | "relativistic") => Ok(Particle::Electron),
        Some("proton" | "antiproton") => Ok(Particle::Proton),
        Some(other) => Err(properties.wrong(format!("particle: expected electron or proton, found {other}"))),
    }
}

fn element(lattice: &mut Lattice, fields: &Fields) -> Result<(), MeasuredError> {
    let class = fields.value.get("Class").and_then(Value::as_str).unwrap_or("Element");
    let mut one = Element {
        name: fields.name.into(),
        kind: class.into(),
        length: fields.number("Length")?,
        words: fields.words(),
        ..Element::default()
    };
    one.role = match class {
        "Monitor" => Role::Monitor([true; 2]),
        "Corrector" => Role::Corrector([true; 2]),
        "RingParam" => Role::Ring,
        _ => Role::Other,
    };
    if class == "RFCavity" {
        lattice.rf = lattice.rf.or(fields.maybe("Frequency")?);
        return lattice.push(one);
    }
    displaced(lattice, &one, fields);
    let pass = fields.value.get("PassMethod").and_then(Value::as_str).unwrap_or_default();
    let is_off = is_off(fields.value);
    if MAGNETS.contains(&class) && !is_off {
        if !pass.is_empty() && !FIELDS.iter().any(|part| pass.contains(part)) {
            return Err(fields.wrong(format!("pass method {pass} of a {class} is not known here")));
        }
        dipole(&mut one, fields)?;
        return give(lattice, one, strengths(fields)?);
    }
    if FIELD_FREE.contains(&class) || is_off {
        if fields.number("BendingAngle")? != 0.0 {
            lattice.leave_out(UNBENT);
        }
        return lattice.push(one);
    }
    Err(fields.wrong(format!("class {class} acts on the orbit and is not known here")))
}

/// True of an element that is tracked without a field.
pub(super) fn is_off(element: &Value) -> bool {
    let pass = element.get("PassMethod").and_then(Value::as_str).unwrap_or_default();
    FIELD_FREE_PASSES.contains(&pass)
}

/// What moves the orbit that the twin begins with is said.
fn displaced(lattice: &mut Lattice, one: &Element, fields: &Fields) {
    if fields.has_from("KickAngle", 0) {
        lattice.leave_out(KICKS);
    }
    if fields.has_from("T1", 0) || fields.has_from("T2", 0) {
        lattice.leave_out(DISPLACED);
    }
    if one.role != Role::Other && tilt(fields).abs() > NONE {
        lattice.leave_out(ROLLED);
    }
}

fn dipole(one: &mut Element, fields: &Fields) -> Result<(), MeasuredError> {
    one.bend = fields.number("BendingAngle")?;
    one.edge_in = fields.number("EntranceAngle")?;
    one.edge_out = fields.number("ExitAngle")?;
    // method 0 of a side leaves the soft edge out, and keeps the angle
    let soft = |side: &str, integral: &str| {
        let is_on = fields.maybe(&format!("FringeBend{side}"))? != Some(0.0);
        Ok::<_, MeasuredError>(if is_on { fields.number("FullGap")? * fields.number(integral)? } else { 0.0 })
    };
    one.set_fringe(soft("Entrance", "FringeInt1")?, soft("Exit", "FringeInt2")?);
    Ok(())
}

fn strengths(fields: &Fields) -> Result<Strengths, MeasuredError> {
    let of = |index| Ok::<_, MeasuredError>([fields.at("PolynomB", index)?, fields.at("PolynomA", index)?]);
    // the linear maps of AT go by K, the others by PolynomB
    let pass = fields.value.get("PassMethod").and_then(Value::as_str).unwrap_or_default();
    let k1 = match (fields.value.get("PolynomB"), fields.value.get("K")) {
        (None, Some(_)) => [fields.number("K")?, 0.0],
        (Some(_), Some(_)) if pass.ends_with("LinearPass") => [fields.number("K")?, of(1)?[1]],
        _ => of(1)?,
    };
    Ok(Strengths {
        k1,
        k2: of(2)?.map(|one| 2.0 * one),
        is_dipole: of(0)?.iter().any(|field| field.abs() > NONE),
        is_higher: fields.has_from("PolynomB", 3) || fields.has_from("PolynomA", 3),
        tilt: tilt(fields),
    })
}

fn tilt(fields: &Fields) -> f64 {
    let first_row = fields.value.get("R1").and_then(|matrix| matrix.get(0));
    let of = |column: usize| first_row.and_then(|row| row.get(column)).and_then(Value::as_f64);
    of(2).zip(of(0)).map_or(0.0, |(sin, cos)| sin.atan2(cos))
}
