//! A pyAT lattice as JSON, which `at.load_lattice` opens (pyAT 0.7 and newer).
//!
//! Pass methods are those that follow the exact Hamiltonian where the twin does: drifts and dipoles; quadrupoles by pyAT's
//! fourth-order integrator. `PolynomB` is (0, K1, K2/2, K3/6), `PolynomA` the same of skew fields.
//!
//! Source: pyAT 0.9, modules `at.load.json` and `at.lattice.elements`.

use serde_json::{Map, Value, json};
use twin::{Element, Kind, Misalignment};

use super::lattice::Lattice;

/// Steps of the integrator per unit of focusing phase `sqrt(|K1|) L`, and at least.
///
/// The error of a tune goes with the fourth power of the phase of a step: at 1/60 it is 4e-8 for the Booster's 48
/// quadrupoles.
const STEPS: (f64, f64) = (60.0, 10.0);

/// The file.
pub(super) fn value(lattice: &Lattice) -> Value {
    let particle = lattice.particle;
    let properties = json!({
        "name": lattice.machine,
        "energy": (particle.rest_energy + particle.kinetic_energy) * 1e9,
        "periodicity": 1,
        "particle": {"name": particle.name(), "rest_energy": particle.rest_energy * 1e9, "charge": charge(particle.name())},
        "remarks": lattice.remarks_of("pyAT", lattice.not_acted_on()),
    });
    let elements: Vec<Value> = (0..lattice.elements.len()).map(|at| element(lattice, at)).collect();
    json!({"atjson": 1, "elements": elements, "properties": properties})
}

/// Matrix of a thin lens that focuses vertically.
pub(super) fn vertical_lens(focusing: f64) -> Vec<Vec<f64>> {
    let mut matrix: Vec<Vec<f64>> = (0..6).map(|i| (0..6).map(|j| f64::from(u8::from(i == j))).collect()).collect();
    matrix[3][2] = -focusing;
    matrix
}

/// In units of the elementary charge.
pub(super) fn charge(particle: &str) -> f64 {
    if particle == "electron" { -1.0 } else { 1.0 }
}

fn element(lattice: &Lattice, at: usize) -> Value {
    let element = &lattice.elements[at];
    let mut value = match &element.kind {
        Kind::Drift => json!({"Class": "Drift", "PassMethod": "ExactDriftPass"}),
        Kind::Marker => json!({"Class": "Marker", "PassMethod": "IdentityPass"}),
        Kind::Monitor => json!({"Class": "Monitor", "PassMethod": "IdentityPass"}),
        Kind::Corrector { .. } => corrector(lattice, at),
        Kind::Quadrupole { k1 } => body("Quadrupole", "StrMPoleSymplectic4Pass", &[0.0, *k1], element.length),
        Kind::Sextupole { k2 } => body("Sextupole", "StrMPoleSymplectic4Pass", &[0.0, 0.0, k2 / 2.0], element.length),
        Kind::Multipole { k1l, k1sl, k2l, k3l } => thin(&[0.0, *k1sl, 0.0, 0.0], &[0.0, *k1l, k2l / 2.0, k3l / 6.0]),
        Kind::Wiggler { focusing } => {
            json!({"Class": "M66", "PassMethod": "Matrix66Pass", "M66": vertical_lens(*focusing)})
        }
        Kind::Solenoid { ks } => json!({"Class": "Element", "PassMethod": "SolenoidLinearPass", "K": ks}),
        Kind::Bend(bend) => {
            let field = [0.0, bend.k1, bend.k2 / 2.0];
            let orders = if bend.k2 == 0.0 { 2 } else { 3 };
            let mut value = body("Dipole", "ExactSectorBendPass", &field[..orders], element.length);
            value["BendingAngle"] = json!(bend.curvature * element.length);
            (value["EntranceAngle"], value["ExitAngle"]) = (json!(bend.e1), json!(bend.e2));
            if bend.fringe != 0.0 {
                // the exact pass reads the product, others the integral and the full gap
                value["gK"] = json!(bend.fringe);
                (value["FringeInt1"], value["FringeInt2"]) = (json!(0.5), json!(0.5));
                value["FullGap"] = json!(2.0 * bend.fringe);
            }
            value
        }
    };
    let fields = value.as_object_mut().expect("made as one above");
    fields.insert("FamName".into(), json!(element.name));
    fields.insert("Length".into(), json!(element.length));
    align(element, fields);
    calibrate(lattice, at, fields);
    value
}

fn body(class: &str, pass: &str, normal: &[f64], length: f64) -> Value {
    let steps = (STEPS.0 * normal[1].abs().sqrt() * length).max(STEPS.1).ceil();
    json!({
        "Class": class, "PassMethod": pass, "PolynomA": vec![0.0; normal.len()], "PolynomB": normal,
        "MaxOrder": normal.len() - 1, "NumIntSteps": steps as usize,
    })
}

fn thin(skew: &[f64], normal: &[f64]) -> Value {
    json!({
        "Class": "ThinMultipole", "PassMethod": "ThinMPolePass", "PolynomA": skew, "PolynomB": normal,
        "MaxOrder": normal.len() - 1,
    })
}

/// A kick, along its own axes where it is rolled: `CorrectorPass` knows no rotation, `ThinMPolePass` does.
fn corrector(lattice: &Lattice, at: usize) -> Value {
    let roll = lattice.corrector_roll(at);
    if roll == 0.0 {
        return json!({"Class": "Corrector", "PassMethod": "CorrectorPass", "KickAngle": [0.0, 0.0]});
    }
    json!({
        "Class": "Corrector", "PassMethod": "ThinMPolePass", "KickAngle": [0.0, 0.0], "PolynomA": [0.0], "PolynomB": [0.0],
        "MaxOrder": 0, "R1": rotation(roll), "R2": rotation(-roll),
    })
}

/// Into the element's own frame and back: a shift and a rotation, as the twin does.
fn align(element: &Element, fields: &mut Map<String, Value>) {
    let Misalignment { dx, dy, roll } = element.misalignment;
    if dx != 0.0 || dy != 0.0 {
        fields.insert("T1".into(), json!([-dx, 0.0, -dy, 0.0, 0.0, 0.0]));
        fields.insert("T2".into(), json!([dx, 0.0, dy, 0.0, 0.0, 0.0]));
    }
    if roll != 0.0 {
        fields.insert("R1".into(), rotation(roll));
        fields.insert("R2".into(), rotation(-roll));
    }
}

/// Rotation of (x, px, y, py) by an angle from x to y.
fn rotation(angle: f64) -> Value {
    let (s, c) = angle.sin_cos();
    json!([
        [c, 0.0, s, 0.0, 0.0, 0.0],
        [0.0, c, 0.0, s, 0.0, 0.0],
        [-s, 0.0, c, 0.0, 0.0, 0.0],
        [0.0, -s, 0.0, c, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    ])
}

/// Monitors and correctors that are not ideal: attributes of our own, which pyAT keeps and does not use.
fn calibrate(lattice: &Lattice, at: usize, fields: &mut Map<String, Value>) {
    let channels = Lattice::channels_of(&lattice.monitors, at).chain(Lattice::channels_of(&lattice.correctors, at));
    let words: Vec<String> = channels.filter(|channel| !channel.is_ideal()).map(|channel| channel.words()).collect();
    if !words.is_empty() {
        fields.insert("Calibration".into(), json!(words.join("; ")));
    }
}
