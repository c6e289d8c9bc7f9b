//! Machine files of the tests.

use serde_json::{Value, json};

use crate::Ring;

/// The Booster's machine file, changed.
pub fn booster_with(change: impl FnOnce(&mut Value)) -> Ring {
    let mut file = serde_json::from_str(include_str!("../../machines/booster.json")).expect("it is JSON");
    change(&mut file);
    parse(&file)
}

/// A ring of protons of 1 GeV, of these elements one behind the other; name and start are given to them.
pub fn ring_of(elements: &[Value]) -> Ring {
    let mut end = 0.0;
    let place = |(i, element): (usize, &Value)| {
        let mut element = element.clone();
        (element["name"], element["s_start"]) = (json!(format!("E_{i}")), json!(end));
        end += element["length"].as_f64().expect("a length");
        element
    };
    let elements: Vec<Value> = elements.iter().enumerate().map(place).collect();
    let reference = json!({"particle": "proton", "kinetic_energy_GeV": 1.0});
    parse(&json!({"name": "test", "circumference_m": end, "k1": {}, "reference": reference, "elements": elements}))
}

/// The Booster with a monitor, E4, that reads both planes, and a corrector, A4, that kicks in both.
pub fn dual() -> Ring {
    dual_with(|_| ())
}

/// The same, changed.
pub fn dual_with(change: impl FnOnce(&mut Value)) -> Ring {
    booster_with(|file| {
        for element in file["elements"].as_array_mut().expect("a list") {
            if element["name"] == "PUH_E4" || element["name"] == "DCH_A4" {
                element["plane"] = "HV".into();
            }
        }
        file["data"]["bpm_y"].as_array_mut().expect("a list").push("E4".into());
        change(file);
    })
}

pub fn parse(file: &Value) -> Ring {
    Ring::parse(&file.to_string(), "test.json").expect("a good machine file")
}

/// A ring with a family that is one factor, one in series with the dipoles, a quadrupole that is not fitted, and one that is
/// rolled so that the planes are coupled.
pub fn mixed() -> Ring {
    let mut ring = booster_with(|file| {
        file["families"] = json!({"QH": {"fit": "family", "range": [0.9, 1.1]}, "QV": {"supply": "dipole"}});
        let elements = file["elements"].as_array_mut().expect("a list");
        let quadrupoles = elements.iter_mut().filter(|element| element["type"] == "quadrupole");
        quadrupoles.step_by(10).for_each(|element| element["fit"] = json!(false));
    });
    let rolled = ring.quadrupoles[7].element;
    ring.elements[rolled].misalignment.roll = 0.03;
    ring
}
