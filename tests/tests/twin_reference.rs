//! The twin against other codes' numbers: MAD-X TWISS, Bmad and pyAT (`tests/golden/reference-*.json`).
//!
//! Every tolerance states the largest error measured and what it comes from. The codes kick by ±0.2 mrad and halve the
//! difference; [`Optics::response`] is the limit of small kicks, and [`kicked`] does what the codes do.

use nalgebra::DMatrix;
use serde_json::Value;
use system_tests::repository;
use twin::{Effect, Hold, Kind, Machine, Optics, Plane, Ring};

const ON_MOMENTUM: Hold = Hold::Momentum { delta: 0.0 };

/// Rounding of a product of a few hundred maps; the largest measured is 5e-13 (a beta of 16 m).
const ROUNDING: f64 = 5e-12;

/// The kick that the codes used [rad].
const KICK: f64 = 0.2e-3;

fn golden(code: &str) -> Value {
    let path = repository(&format!("tests/golden/reference-{code}.json"));
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number, found {value}"))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(number).collect()
}

fn words(value: &Value) -> Vec<&str> {
    value.as_array().unwrap().iter().map(|v| v.as_str().unwrap()).collect()
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<_> = value.as_array().unwrap().iter().map(|r| nalgebra::RowDVector::from_vec(numbers(r))).collect();
    DMatrix::from_rows(&rows)
}

/// The four machines of a code: name, its numbers, and the ring with its vars.
fn machines(code: &str) -> Vec<(String, Value, Ring)> {
    let design = Ring::paper_booster();
    let names = design.var_names();
    let of = |(name, reference): (&String, &Value)| {
        let vars: Vec<f64> = names.iter().map(|n| number(&reference["vars"][n])).collect();
        assert_eq!(
            words(&reference["bpm"]),
            design.labels(design.monitors.iter().map(|m| m.element)),
            "order of the monitors"
        );
        (format!("{code} {name}"), reference.clone(), design.with_vars(&vars))
    };
    let all: Vec<_> = golden(code)["machines"].as_object().unwrap().iter().map(of).collect();
    assert_eq!(all.len(), 4);
    all
}

fn both_codes() -> Vec<(String, Value, Ring)> {
    [machines("madx"), machines("bmad")].concat()
}

fn assert_near(what: &str, ours: &[f64], theirs: &[f64], tolerance: f64) {
    assert_eq!(ours.len(), theirs.len(), "{what}");
    let error = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(error < tolerance, "{what}: off by {error:.2e}, allowed {tolerance:.0e}");
}

/// The four planes of a response `[48][48]`: rows H monitors then V, columns H correctors then V.
fn block(response: &DMatrix<f64>, monitors: Plane, correctors: Plane) -> DMatrix<f64> {
    let start = |plane| if plane == Plane::X { 0 } else { 24 };
    response.view((start(monitors), start(correctors)), (24, 24)).into_owned()
}

/// Response of x and y at all monitor places for small kicks.
fn small(ring: &Ring, hold: Hold) -> [DMatrix<f64>; 2] {
    let optics = Optics::of(ring, hold).unwrap();
    [Plane::X, Plane::Y].map(|plane| optics.response(&optics.monitor_places(plane), &optics.correctors()))
}

/// Closed orbits `(x, y, delta)` with one corrector set to `kick` [rad]; x and y at all monitor places.
fn orbit(ring: &Ring, corrector: usize, kick: f64, hold: Hold) -> (Vec<f64>, Vec<f64>, f64) {
    let mut ring = ring.clone();
    ring.set_kick(corrector, kick);
    let optics = Optics::of(&ring, hold).unwrap();
    let at = |coordinate: usize| ring.monitors.iter().map(|m| optics.orbit(m.element)[coordinate]).collect();
    (at(0), at(2), optics.orbit(0)[4])
}

/// Half the difference of the orbits at ±0.2 mrad over the kick: response of x and y, and of the momentum [1/rad].
fn kicked(ring: &Ring, hold: Hold) -> ([DMatrix<f64>; 2], Vec<f64>) {
    let mut x = DMatrix::zeros(ring.monitors.len(), ring.correctors.len());
    let (mut y, mut momentum) = (x.clone(), Vec::new());
    for j in 0..ring.correctors.len() {
        let [up, down] = [KICK, -KICK].map(|kick| orbit(ring, j, kick, hold));
        for i in 0..ring.monitors.len() {
            x[(i, j)] = (up.0[i] - down.0[i]) / (2.0 * KICK);
            y[(i, j)] = (up.1[i] - down.1[i]) / (2.0 * KICK);
        }
        momentum.push((up.2 - down.2) / (2.0 * KICK));
    }
    ([x, y], momentum)
}

#[test]
fn tunes_equal_those_of_madx_and_bmad() {
    for (what, reference, ring) in both_codes() {
        let tunes = Optics::of(&ring, ON_MOMENTUM).unwrap().tunes().unwrap();
        // measured 2e-14; asked for 1e-6
        assert_near(&what, &[tunes.x, tunes.y], &[number(&reference["qx"]), number(&reference["qy"])], ROUNDING);
    }
}

#[test]
fn beta_functions_equal_those_of_madx_and_bmad() {
    for (what, reference, ring) in both_codes() {
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        for (plane, key) in [(Plane::X, "beta_x"), (Plane::Y, "beta_y")] {
            let beta: Vec<f64> = ring.monitors.iter().map(|m| optics.beta(m.element, plane)).collect();
            assert_near(&format!("{what} {key}"), &beta, &numbers(&reference[key]), ROUNDING); // measured 5e-13 m
        }
    }
}

#[test]
fn dispersion_equals_that_of_madx_and_bmad() {
    for (what, reference, ring) in both_codes() {
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let ours: Vec<f64> = optics.monitor_places(Plane::X).iter().map(|o| optics.dispersion(o)).collect();
        assert_near(&what, &ours, &numbers(&reference["dispersion_x"]), ROUNDING); // measured 2e-13 m; asked for 1e-3 m
    }
}

#[test]
fn transition_energy_equals_that_of_madx_and_bmad() {
    for (what, reference, ring) in both_codes() {
        let ours = Optics::of(&ring, ON_MOMENTUM).unwrap().gamma_transition();
        assert_near(&what, &[ours], &[number(&reference["gamma_tr"])], ROUNDING); // measured 7e-15
    }
}

#[test]
fn chromaticity_equals_that_of_bmad() {
    for (what, reference, ring) in machines("bmad") {
        let at = |delta| Optics::of(&ring, Hold::Momentum { delta }).unwrap().tunes().unwrap();
        let h = 1e-4;
        let (up, down, far_up, far_down) = (at(h), at(-h), at(2.0 * h), at(-2.0 * h));
        let slope = |q: fn(&twin::Tunes) -> f64| (8.0 * (q(&up) - q(&down)) - (q(&far_up) - q(&far_down))) / (12.0 * h);
        let theirs = [number(&reference["chrom_x"]), number(&reference["chrom_y"])];
        // Bmad's own differencing: measured 1.4e-8.
        assert_near(&what, &[slope(|t| t.x), slope(|t| t.y)], &theirs, 5e-8);
    }
}

#[test]
fn every_response_element_equals_that_of_madx() {
    for (what, reference, ring) in machines("madx") {
        let [x, y] = small(&ring, ON_MOMENTUM);
        let (h, v) = (matrix(&reference["response_H_m_per_rad"]), matrix(&reference["response_V_m_per_rad"]));
        // The kick's size, of which TWISS keeps little: measured 5.8e-6 in x, 5.0e-7 in y; asked for 2e-4.
        assert_near(&what, block(&x, Plane::X, Plane::X).as_slice(), h.as_slice(), 2e-5);
        assert_near(&what, block(&y, Plane::Y, Plane::Y).as_slice(), v.as_slice(), 2e-6);
    }
}

/// Blocks of Bmad's response, by plane of the monitors and of the correctors.
fn assert_equals_bmad(what: &str, reference: &Value, [x, y]: &[DMatrix<f64>; 2], tolerance: [f64; 2]) {
    for (response, monitors, correctors, key) in [
        (x, Plane::X, Plane::X, "response_H_m_per_rad"),
        (x, Plane::Y, Plane::X, "response_x_at_V_places_m_per_rad"),
        (y, Plane::Y, Plane::Y, "response_V_m_per_rad"),
        (y, Plane::X, Plane::Y, "response_y_at_H_places_m_per_rad"),
    ] {
        let tolerance = tolerance[usize::from(correctors == Plane::Y)];
        let ours = block(response, monitors, correctors);
        assert_near(&format!("{what} {key}"), ours.as_slice(), matrix(&reference[key]).as_slice(), tolerance);
    }
}

#[test]
fn every_response_element_equals_that_of_bmad() {
    for (what, reference, ring) in machines("bmad") {
        // The kick's size, and nothing else (see the next test): measured 1.03e-4 in x, 2.8e-6 in y; asked for 2e-4.
        assert_equals_bmad(&what, &reference, &small(&ring, ON_MOMENTUM), [2e-4, 1e-5]);
    }
}

#[test]
fn kicks_of_the_same_size_give_the_response_of_bmad() {
    for (what, reference, ring) in machines("bmad") {
        let (response, _) = kicked(&ring, ON_MOMENTUM);
        // Nine decimals in the file and Newton's 1e-12 m over twice the kick: measured 7e-10.
        assert_equals_bmad(&what, &reference, &response, [3e-9; 2]);
    }
}

#[test]
fn planes_of_an_upright_ring_do_not_mix() {
    for (what, _, ring) in machines("bmad") {
        let [x, y] = small(&ring, ON_MOMENTUM);
        let across = [x.columns(24, 24).abs().max(), y.columns(0, 24).abs().max()];
        assert_eq!(across, [0.0, 0.0], "{what}: no arithmetic joins the planes, in Bmad as here");
    }
}

/// An effect of the golden files in the words of the command line.
fn effect(entry: &Value) -> Effect {
    let kind = entry["kind"].as_str().unwrap();
    let place = entry["at"].as_str().map_or(String::new(), |at| format!("@{at}"));
    let amplitude = entry["amplitude"].as_f64().map_or(String::new(), |a| format!("={a}"));
    Effect::parse(&format!("{kind}{place}{amplitude}"), &Ring::paper_booster()).unwrap()
}

/// The seven cases of a code, both planes, through the words of the command line; tolerance in x and y.
fn assert_cases_equal(code: &str, tolerance: impl Fn(&str) -> [f64; 2]) {
    let golden = golden(code);
    let cases = golden["cases"].as_object().unwrap();
    assert_eq!(cases.len(), 7);
    for (name, reference) in cases {
        let effects: Vec<Effect> = reference["effects"].as_array().unwrap().iter().map(effect).collect();
        let ours = Machine::new(Ring::paper_booster(), twin::Rf::FixedMomentum, &effects).unwrap().response().unwrap();
        let (x, y) = (matrix(&reference["response_x_m_per_rad"]), matrix(&reference["response_y_m_per_rad"]));
        let tolerance = tolerance(name);
        assert_near(&format!("{code} {name} x"), ours.x.as_slice(), x.as_slice(), tolerance[0]);
        assert_near(&format!("{code} {name} y"), ours.y.as_slice(), y.as_slice(), tolerance[1]);
    }
}

// Asked for: 5e-4 m/rad, off momentum 5e-3.

#[test]
fn every_effect_acts_as_in_pyat() {
    assert_cases_equal("effects", |case| match case {
        // The kick's size once more, through the momentum: measured 1.2e-4 and 1.5e-5.
        "fixed_rf_frequency" => [4e-4, 5e-5],
        // The kick's size: measured 2.9e-5 and 2.9e-6. Kicks of the same size leave 4e-6, pyAT's slices in quadrupoles,
        // and off momentum 1.3e-5, its exact square root there.
        _ => [1e-4, 1e-5],
    });
}

#[test]
fn every_effect_acts_as_in_bmad() {
    assert_cases_equal("bmad", |case| match case {
        // Measured 9.4e-5 and 1.4e-5; none of it remains for kicks of the same size (next test).
        "fixed_rf_frequency" => [3e-4, 5e-5],
        // Measured 2.9e-5 and 2.7e-6.
        _ => [1e-4, 1e-5],
    });
}

/// The ring of a case, changed by hand, and what it holds.
fn by_hand(case: &str) -> (Ring, Hold) {
    let (mut ring, mut hold) = (Ring::paper_booster(), ON_MOMENTUM);
    let at = |name: &str| ring.element(name).unwrap();
    let (quadrupole, slot, dipole) = (at("QH_D8"), at("SLOT_F6"), at("B_C4"));
    match case {
        "nominal" => {}
        "quad_roll" => ring.elements[quadrupole].misalignment.roll = 0.01,
        "stray_gradient" => ring.elements[slot].kind = Kind::Multipole { k1l: 0.01, k1sl: 0.0, k2l: 0.0, k3l: 0.0 },
        "stray_skew_gradient" => {
            ring.elements[slot].kind = Kind::Multipole { k1l: 0.0, k1sl: 0.01, k2l: 0.0, k3l: 0.0 }
        }
        "dipole_gradient" => {
            let length = ring.elements[dipole].length;
            let Kind::Bend(bend) = &mut ring.elements[dipole].kind else { unreachable!() };
            bend.k1 = 0.01 / length;
        }
        "momentum_offset" => hold = Hold::Momentum { delta: 0.003 },
        "fixed_rf_frequency" => hold = Hold::Frequency { offset: 0.0 },
        _ => panic!("unknown case {case}"),
    }
    (ring, hold)
}

#[test]
fn kicks_of_the_same_size_give_every_effect_of_bmad() {
    for (name, reference) in golden("bmad")["cases"].as_object().unwrap() {
        let (ring, hold) = by_hand(name);
        let ([x, y], momentum) = kicked(&ring, hold);
        // Nine decimals in the file, and in the dipole the curvature of its gradient, which the twin leaves out:
        // measured 4.9e-9 and 1.5e-6.
        let tolerance = if name == "dipole_gradient" { 5e-6 } else { 1.5e-8 };
        let known = [matrix(&reference["response_x_m_per_rad"]), matrix(&reference["response_y_m_per_rad"])];
        assert_near(&format!("{name} x"), x.as_slice(), known[0].as_slice(), tolerance);
        assert_near(&format!("{name} y"), y.as_slice(), known[1].as_slice(), tolerance);
        if name == "fixed_rf_frequency" {
            assert_near("dp_per_rad", &momentum, &numbers(&reference["dp_per_rad"]), 3e-9); // measured 7.7e-10
        }
    }
}

/// Tunes and the response within a plane at all monitor places, of the laboratory's deck: with its body gradients and sextupoles, powered by read-backs.
///
/// Measured: off by 5.0e-7 m/rad from MAD-X, half of the last digit of the file, and by 7.4e-7 from pyAT; tunes by 5e-10 and 5e-9.
#[test]
fn the_deck_is_that_of_madx_and_pyat() {
    let ring = Ring::booster();
    let paper = system_tests::truth("recordings/paper-vars", &ring);
    for code in ["madx", "pyat"] {
        for (machine, vars) in [("design", vec![1.0; 48]), ("paper", paper.clone())] {
            let known = &golden("deck")[code][machine];
            let ring = ring.with_vars(&vars);
            let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
            let tunes = optics.tunes().unwrap();
            assert_near(&format!("tunes, {code} {machine}"), &[tunes.x, tunes.y], &numbers(&known["tunes"]), 1e-8);
            for (plane, word) in [(Plane::X, "x"), (Plane::Y, "y")] {
                let response = optics.response(&optics.monitor_places(plane), &optics.correctors());
                let ours = block(&response, plane, plane);
                let off = (ours - matrix(&known[word])).amax();
                assert!(off < 2e-6, "{code} {machine} {word}: {off:.2e} m/rad");
            }
        }
    }
}
