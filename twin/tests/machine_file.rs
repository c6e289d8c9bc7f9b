//! What docs/machine.md says, read from the page itself.

use serde_json::Value;
use twin::{Hold, Optics, Ring};

const PAGE: &str = include_str!("../../docs/machine.md");

/// The JSON blocks of the page, each with the text behind it.
fn blocks() -> Vec<(&'static str, &'static str)> {
    PAGE.split("```json\n").skip(1).map(|part| part.split_once("```").expect("a block ends")).collect()
}

/// The cells of the first table of a text, its head left out.
fn table(text: &'static str) -> Vec<Vec<&'static str>> {
    let lines = text.lines().skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    lines.skip(2).map(|line| line.trim_matches('|').split(" | ").map(str::trim).collect()).collect()
}

fn words(names: impl IntoIterator<Item = String>) -> String {
    names.into_iter().collect::<Vec<_>>().join(" ")
}

/// What the table beside an example says of its ring.
fn said(ring: &Ring, of: &str) -> String {
    match of {
        "params" => words(ring.var_names()),
        "supplies" => words(ring.supplies.iter().map(|supply| supply.name.clone())),
        "monitors that are read" => words(ring.monitor_names()),
        "correctors" => words(ring.corrector_names()),
        "tunes" => {
            let tunes = Optics::of(ring, Hold::Momentum { delta: 0.0 }).unwrap().tunes().unwrap();
            format!("{:.4} {:.4}", tunes.x, tunes.y)
        }
        other => panic!("unknown row {other}"),
    }
}

#[test]
fn the_examples_are_the_rings_that_the_page_describes() {
    for (file, behind) in &blocks()[..2] {
        let ring = Ring::parse(file, "toy.json").unwrap();
        let rows = table(behind);
        assert!(rows.len() >= 4, "{behind}");
        rows.iter().for_each(|row| assert_eq!(said(&ring, row[0]), row[1], "{}: {}", ring.name, row[0]));
    }
    assert_eq!(Ring::parse(blocks()[0].0, "toy.json").unwrap().elements.len(), 17);
}

#[test]
fn supplies_priors_and_sectors_are_those_of_the_example() {
    let ring = Ring::parse(blocks()[1].0, "toy.json").unwrap();
    let of = |name: &str| ring.quadrupoles[ring.quadrupole(name).unwrap()];
    assert_eq!((of("F1").supply, of("F2").supply, of("D1").supply, of("trim").supply), (Some(0), Some(0), None, None));
    assert_eq!((of("F1").parameter, of("F2").parameter, of("D1").parameter), (Some(0), Some(0), Some(1)));
    assert_eq!(of("trim").parameter, None);
    let priors: Vec<_> = ring.parameters.iter().map(|p| (p.prior.width, p.prior.range)).collect();
    assert_eq!(priors, [(0.01, [0.94, 1.06]), (0.03, [0.9, 1.1])]);
    assert_eq!(ring.parameters[0].quadrupoles, [0, 1]);
    let factors = ring.strengths(&[0.1, 0.2], &[0.4]);
    assert_eq!(factors, [0.5_f64.exp(), 0.5_f64.exp(), 0.2_f64.exp(), 1.0]);
    let sectors: Vec<_> = ring.elements.iter().filter_map(|e| e.sector.as_deref()).collect();
    assert_eq!(sectors, ["north", "south"]);
}

#[test]
fn the_ramp_of_the_page_is_one_of_the_booster() {
    let mut file: Value = serde_json::from_str(include_str!("../../machines/booster.json")).unwrap();
    merge(&mut file, &serde_json::from_str(blocks()[2].0).unwrap());
    let ring = Ring::parse(&file.to_string(), "booster.json").unwrap();
    let [first, .., last] = ring.ramp.as_slice() else { panic!("it has two points or more") };
    assert_eq!((first.time, first.dipole, first.supply["QV"], last.supply["QH"]), (0.05, Some(923.0), 692.2, 1800.0));
    // p = sqrt(T (T + 2 m)) of protons of 0.35 and 1.5 GeV: 0.8828 and 2.2505 GeV/c
    assert!((first.momentum(&ring.particle) - 0.3923).abs() < 5e-5 && last.momentum(&ring.particle) == 1.0);
    assert!(Ring::booster().ramp.is_empty());
}

/// The toy ring with the law of the page for its focusing quadrupoles, which state no strength of their own.
#[test]
fn the_currents_of_the_page_make_the_strengths_that_are_left_out() {
    let mut file: Value = serde_json::from_str(blocks()[0].0).unwrap();
    merge(&mut file, &serde_json::from_str(blocks()[3].0).unwrap());
    merge(&mut file, &serde_json::json!({"k1": {"QF": null}}));
    // 10 T m are 2.99792458 GeV/c
    let rest = 0.938_272_088_16;
    let energy = (2.997_924_58_f64.powi(2) + f64::powi(rest, 2)).sqrt() - rest;
    file["reference"]["kinetic_energy_GeV"] = energy.into();
    let ring = Ring::parse(&file.to_string(), "toy.json").unwrap();
    // 900 A of 2 T per 1000 A over 10 T m and 0.5 m
    assert!((ring.gradients()[0] - 0.36).abs() < 1e-12 && ring.gradients()[1] == -0.5);
    let refused = |patch: Value| {
        let mut file = file.clone();
        merge(&mut file, &patch);
        Ring::parse(&file.to_string(), "toy.json").unwrap_err().to_string()
    };
    let stated = refused(serde_json::json!({"k1": {"QF": 0.6}}));
    assert!(stated.starts_with("QH_A2: expected the k1 of currents, found 0.6 stated and 0.36"), "{stated}");
    let energy = refused(serde_json::json!({"reference": {"kinetic_energy_GeV": 2.0}}));
    assert!(energy.starts_with("reference: expected the momentum of currents [GeV/c], found 2.78"), "{energy}");
    let missing = refused(serde_json::json!({"currents": {"design_A": {"trim": null}}}));
    assert_eq!(missing, "currents: expected every read-back of a current in design_A, found no trim");
    let unused = serde_json::json!({"SX": {"current": {"dipole": 1}, "integrated": [0, 1e-3]}});
    let unused = refused(serde_json::json!({"currents": {"sextupoles": unused}}));
    assert_eq!(unused, "currents: expected a magnet for each name in them, found SX");
}

/// JSON merge patch (RFC 7386).
fn merge(onto: &mut Value, patch: &Value) {
    let (Value::Object(onto), Value::Object(patch)) = (&mut *onto, patch) else {
        *onto = patch.clone();
        return;
    };
    for (key, value) in patch {
        if value.is_null() {
            onto.remove(key);
        } else {
            merge(onto.entry(key.clone()).or_insert(Value::Null), value);
        }
    }
}

#[test]
fn what_is_refused_is_refused_in_these_words() {
    let (base, behind) = blocks()[4];
    let base: Value = serde_json::from_str(base).unwrap();
    assert!(Ring::parse(&base.to_string(), "toy.json").is_ok());
    let rows = table(behind);
    assert_eq!(rows.len(), 29);
    for row in rows {
        let [patch, message] = [row[1], row[2]].map(|cell| cell.trim_matches('`'));
        let mut file = base.clone();
        merge(&mut file, &serde_json::from_str(patch).unwrap());
        let error = Ring::parse(&file.to_string(), "toy.json").unwrap_err().to_string();
        match message.strip_suffix('…') {
            Some(start) => assert!(error.starts_with(start), "{error}\n{start}"),
            None => assert_eq!(error, message),
        }
    }
}
