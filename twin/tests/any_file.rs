//! Nothing that may stand in a machine file makes the twin panic.

use nalgebra::{DMatrix, DVector};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::TestRunner;
use serde_json::{Map, Value, json};
use twin::{
    CalibratedOptics, Drives, Effect, EffectKind, Hold, Machine, Optics, Plane, Rf, Ring, Signatures, VariedRing,
    spurious_dispersion,
};

const TYPES: [&str; 8] = ["marker", "bpm", "corrector", "quadrupole", "sbend", "sextupole", "multipole", "solenoid"];
const NAMES: [&str; 8] = ["A", "Q_A", "P_A", "ß_Δ 1", "_", "a_", "x_A", ","];
const NEEDED: [&str; 2] = ["ks", "angle"];
const OPTIONAL: [&str; 11] = ["k1", "k2", "k1l", "k1sl", "k2l", "k3l", "e1", "e2", "hgap", "fint", "roll"];

/// Mostly what magnets have, sometimes what no magnet has.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![12 => -1.0..1.0, 3 => Just(0.0), 1 => -30.0..30.0, 1 => prop::sample::select(vec![1e-300, 1e6, -1e9, 1e300])]
}

fn element() -> impl Strategy<Value = Map<String, Value>> {
    let texts = (
        prop_oneof![50 => prop::sample::select(&TYPES[..]), 1 => Just("undulator")],
        option::weighted(0.1, prop::sample::select(&NAMES[..])),
        option::weighted(0.05, prop::sample::select(&NAMES[..])),
        option::weighted(0.97, prop::sample::select(vec!["H", "V", "HV"])),
        option::weighted(0.9, prop::sample::select(vec!["QF", "QD", "dipole"])),
        option::weighted(0.1, any::<bool>()),
    );
    let numbers = (
        prop_oneof![4 => 0.0..2.0, 1 => Just(0.0), 1 => number()],
        vec(option::weighted(0.97, number()), 2),
        vec(option::weighted(0.3, number()), 10),
    );
    (texts, numbers).prop_map(|((kind, name, label, plane, family, fit), (length, needed, optional))| {
        let thin = matches!(kind, "multipole" | "bpm");
        let stated = |key: &str, value: Option<Value>| value.map(|value| (key.to_owned(), value));
        let texts = [("name", name), ("label", label), ("plane", plane), ("family", family), ("type", Some(kind))];
        let mut all: Map<_, _> =
            texts.into_iter().filter_map(|(key, text)| stated(key, text.map(Value::from))).collect();
        let strengths = NEEDED.iter().chain(&OPTIONAL).zip(needed.into_iter().chain(optional));
        all.extend(strengths.filter_map(|(key, value)| stated(key, value.map(Value::from))));
        all.extend(stated("fit", fit.map(Value::from)));
        all.insert("length".into(), json!(if thin { 0.0 } else { length }));
        all
    })
}

fn families() -> impl Strategy<Value = Value> {
    let fit = prop::sample::select(vec!["single", "family", "none"]);
    let family =
        (fit, option::of(prop::sample::select(vec!["dipole", "QF", "other"])), option::weighted(0.2, number()))
            .prop_map(|(fit, supply, width)| json!({"fit": fit, "supply": supply, "prior_width": width}));
    option::of(family).prop_map(|family| family.map_or(json!({}), |family| json!({"QF": family})))
}

/// A machine file: elements one behind the other, with gaps.
fn file() -> impl Strategy<Value = Value> {
    let elements = vec((element(), prop_oneof![4 => 0.0..1.0, 1 => Just(0.0)]), 0..8);
    (elements, families(), 0.0..2.0, option::weighted(0.2, vec(prop::sample::select(&NAMES[..]), 0..3))).prop_map(
        |(elements, families, gap, read)| {
            let (mut end, mut line) = (0.0, Vec::new());
            for (i, (mut element, gap)) in elements.into_iter().enumerate() {
                element.entry("name").or_insert_with(|| json!(format!("E_{i}")));
                element.insert("s_start".into(), json!(end + gap));
                end += gap + element["length"].as_f64().unwrap();
                line.push(Value::from(element));
            }
            json!({
                "name": "odd", "circumference_m": end + gap, "k1": {"QF": 0.5, "QD": -0.5, "dipole": 0.1},
                "reference": {"particle": "proton", "kinetic_energy_GeV": 1.0},
                "data": {"bpm_x": read}, "families": families, "elements": line,
            })
        },
    )
}

/// Ask for everything; true if the ring has stable motion.
fn ask(ring: &Ring) -> bool {
    let (n, f) = (ring.parameters.len(), ring.supplies.len());
    let names = [ring.var_names(), ring.monitor_names(), ring.corrector_names()];
    names.iter().for_each(|names| (1..names.len()).for_each(|i| assert!(!names[..i].contains(&names[i]), "{names:?}")));
    assert_eq!(names[1].len(), ring.read_monitors.len());
    let _ = spurious_dispersion(ring);
    ask_effects(ring);
    for hold in [Hold::Momentum { delta: 1e-3 }, Hold::Frequency { offset: 1e-4 }] {
        let Ok(optics) = Optics::of(ring, hold) else { continue };
        let (observers, sources, gradients) = (optics.read_monitors(), optics.correctors(), optics.quadrupoles());
        let _ = (optics.tunes(), optics.twiss(), optics.gamma_transition(), optics.frequency_offset());
        let _ = (optics.response(&observers, &sources), optics.response_jacobian(&observers, &sources, &gradients));
        let _ = (optics.rf_jacobian(&observers, &gradients), optics.monitor_places(Plane::Y));
        gradients.iter().for_each(|gradient| assert_eq!(optics.tune_slope(gradient).len(), 2));
    }
    let _ = CalibratedOptics::of(ring, &vec![0.0; n], &vec![0.0; f]).map(|o| o.sigma(&DMatrix::identity(n, n)));
    let Ok(varied) = VariedRing::of(ring) else { return false };
    let Ok(optics) = varied.at(&ring.strengths(&vec![0.01; n], &vec![-0.01; f])) else { return false };
    let weights = optics.response();
    assert_eq!(ring.by_parameter(&optics.pull_back(&weights)).len(), n);
    assert_eq!(optics.tune_slopes().len(), ring.quadrupoles.len());
    true
}

/// Readings with every effect at its first place, and their derivatives.
fn ask_effects(ring: &Ring) {
    let drives = Drives {
        kick: DMatrix::from_element(2, ring.correctors.len(), 1e-4),
        rf_offset: DVector::zeros(2),
        time: DVector::from_vec(vec![-1.0, 1.0]),
        nominal_kick: 1e-4,
        orbit: vec![[1e-3; 2]; ring.elements.len()],
    };
    let site = |&kind: &EffectKind| kind.sites(ring).first().map(|&site| Effect { kind, site, amplitude: 1e-3 });
    for effect in EffectKind::ALL.iter().filter_map(site).map(Some).chain([None]) {
        let effects: Vec<Effect> = effect.into_iter().collect();
        let Ok(machine) = Machine::new(ring.clone(), Rf::FixedFrequency, &effects) else { continue };
        let _ = (machine.response(), machine.readings(&drives));
        let Ok(signatures) = Signatures::of(&machine, &drives) else { continue };
        assert_eq!(signatures.of_vars().len(), ring.parameters.len());
    }
}

/// Good files and bad, stable rings and unstable ones: all three are met often.
#[test]
fn any_machine_file_is_read_or_refused() {
    let mut runner = TestRunner::deterministic();
    let (mut good, mut stable) = (0, 0);
    for _ in 0..1500 {
        let file = file().new_tree(&mut runner).unwrap().current();
        let text = file.to_string();
        if let Ok(ring) = Ring::parse(&text, "odd.json") {
            good += 1;
            stable += usize::from(ask(&ring));
        }
    }
    assert!(good > 300 && good < 1200 && stable > 30, "{good} of 1500 are good, {stable} stable");
}

#[test]
fn the_booster_without_one_sort_of_element_is_a_ring() {
    let file: Value = serde_json::from_str(include_str!("../../machines/booster.json")).unwrap();
    for sort in ["quadrupole", "bpm", "corrector", "sbend"] {
        let mut file = file.clone();
        file["elements"].as_array_mut().unwrap().retain(|element| element["type"] != sort);
        file.as_object_mut().unwrap().remove("data");
        let ring = Ring::parse(&file.to_string(), "booster.json").unwrap();
        assert_eq!(ask(&ring), sort != "quadrupole", "without {sort}");
    }
}
