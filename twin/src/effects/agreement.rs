//! The three descriptions of every effect against each other: exact closed orbits ([`Tracked`]), linear optics about the
//! orbit ([`Machine::readings`]) and derivatives ([`Signatures`]).

use nalgebra::{DMatrix, DVector, MatrixXx2};

use super::machine::MachineResponse;
use super::{Class, Cycle, Drives, Effect, EffectKind, Machine, Rf, Signature, Signatures, Tracked};
use crate::lattice::{Plane, Ring};
use crate::orbit::{ClosedOrbit, Hold};
use crate::site::Site;
use crate::testing::{booster_with, dual};
use crate::tune::Tunes;

const NOMINAL: f64 = 2e-4;

/// Correctors that are powered one after the other.
fn powered(ring: &Ring) -> [usize; 4] {
    let n = ring.correctors.len();
    [3, n / 2 + 5, 11, n / 2 + 17]
}

/// Frames that tell all effects apart: both planes, both signs, nothing but the RF frequency, everything at once.
fn drives(ring: &Ring, orbit: Vec<[f64; 2]>) -> Drives {
    let n = ring.correctors.len();
    let mut kick = DMatrix::zeros(8, n);
    let [a, b, c, d] = powered(ring);
    let set = [(0, a, 1.0), (1, a, -1.0), (2, b, 1.0), (3, b, -1.0), (4, c, 1.0), (4, d, 0.7)];
    set.iter().for_each(|&(frame, corrector, share)| kick[(frame, corrector)] = share * NOMINAL);
    kick.row_mut(5).iter_mut().enumerate().for_each(|(c, k)| *k = 0.1 * NOMINAL * (1.0 + c as f64).sin());
    let rf_offset = DVector::from_vec(vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-4, -1e-4]);
    let time = DVector::from_vec(vec![-1.0, -0.7, -0.2, 0.1, 0.5, 0.6, 0.8, 1.0]);
    Drives { kick, rf_offset, time, nominal_kick: NOMINAL, orbit }
}

/// The ring with one quadrupole of each family out of its place: an orbit of several mm in both planes.
fn displaced() -> Ring {
    let mut ring = Ring::booster();
    for (quadrupole, [dx, dy]) in [(5, [1.2e-3, 0.4e-3]), (30, [0.3e-3, 1.2e-3])] {
        let at = ring.quadrupoles[quadrupole].element;
        (ring.elements[at].misalignment.dx, ring.elements[at].misalignment.dy) = (dx, dy);
    }
    ring
}

fn orbit(ring: &Ring, delta: f64) -> Vec<[f64; 2]> {
    let orbit = ClosedOrbit::find(ring, Hold::Momentum { delta }).unwrap();
    orbit.at[..ring.elements.len()].iter().map(|z| [z[0], z[2]]).collect()
}

/// Every kind with some of its places: the first, the last and each seventh; hysteresis of what is powered.
fn effects(ring: &Ring) -> Vec<Effect> {
    let of = |&kind: &EffectKind| {
        let radial_loop = || Effect::parse("radial_loop@x_D8,x_E6", ring).unwrap().site;
        let (sites, step) = match kind {
            EffectKind::RadialLoop => (vec![radial_loop()], 1),
            EffectKind::CorrectorHysteresis | EffectKind::CorrectorSettling => {
                (powered(ring).map(Site::Corrector).to_vec(), 1)
            }
            EffectKind::BpmSwap => (kind.sites(ring), 41),
            EffectKind::CorrectorSwap => {
                let [a, b, c, d] = powered(ring);
                (vec![Site::corrector_pair(a, c), Site::corrector_pair(b, d), Site::corrector_pair(a, a + 1)], 1)
            }
            _ => (kind.sites(ring), 7),
        };
        let amplitude = kind.prior_scale().unwrap_or(1.0);
        let count = sites.len();
        let some = sites.into_iter().enumerate().filter(move |(i, _)| i % step == 0 || i + 1 == count);
        some.map(move |(_, site)| Effect { kind, site, amplitude }).collect::<Vec<_>>()
    };
    EffectKind::ALL.iter().flat_map(of).collect()
}

fn machine(ring: &Ring, effects: &[Effect]) -> Machine {
    Machine::new(ring.clone(), Rf::FixedMomentum, effects).unwrap()
}

/// Readings of all frames against those without kicks, by tracking.
fn tracked(machine: Machine, drives: &Drives) -> DMatrix<f64> {
    let quadrupoles = machine.ring().quadrupoles.len();
    let tracked = Tracked::of(machine, drives.nominal_kick).unwrap();
    let of = |i: usize, share: f64| {
        let kick = drives.kick.row(i).iter().map(|kick| share * kick).collect();
        Cycle { kick, strength: vec![0.0; quadrupoles], rf_offset: share * drives.rf_offset[i], time: drives.time[i] }
    };
    let read = |share: f64| {
        let cycles: Vec<Cycle> = (0..drives.kick.nrows()).map(|i| of(i, share)).collect();
        tracked.cycles(&cycles).unwrap().0
    };
    read(1.0) - read(0.0)
}

/// Central difference of readings, tunes and their changes about a machine; the whole change of what is there or not.
fn difference(ring: &Ring, about: &[Effect], effect: &Effect, drives: &Drives) -> Signature {
    let with = |amplitude: f64| {
        let all = [about, &[Effect { amplitude, ..*effect }]].concat();
        machine(ring, &all).readings(drives).unwrap()
    };
    let (up, down, width) = match effect.kind.prior_scale() {
        None => (with(1.0), machine(ring, about).readings(drives).unwrap(), 1.0),
        Some(scale) => (with(1e-2 * scale), with(-1e-2 * scale), 2e-2 * scale),
    };
    let tunes = [up.1.x - down.1.x, up.1.y - down.1.y].map(|change| change / width);
    Signature { readings: (up.0 - down.0) / width, tunes, tune_changes: (up.2 - down.2) / width }
}

fn assert_derivatives(ring: &Ring, about: &[Effect], which: &[Effect], tolerance: f64) {
    let drives = drives(ring, orbit(&displaced(), 0.0));
    let about_machine = machine(ring, about);
    let ends = about_machine.ends();
    let signatures = Signatures::of(&about_machine, &drives).unwrap().between(ends.as_ref()).unwrap();
    for effect in which {
        let signature = signatures.of_effect(effect.kind, effect.site).unwrap();
        let known = difference(ring, about, effect, &drives);
        let error = (&signature.readings - &known.readings).abs().max() / known.readings.abs().max();
        assert!(error < tolerance, "{effect:?}: {error:e}");
        let changes = signature.tune_changes.iter().zip(&known.tune_changes);
        for (ours, known) in signature.tunes.iter().zip(&known.tunes).chain(changes) {
            // a tune rounds at 1e-13, the smallest width is 2e-5
            assert!((ours - known).abs() < tolerance * known.abs() + 1e-7, "{effect:?}: {ours} of {known}");
        }
    }
}

#[test]
fn signatures_are_the_derivatives_of_the_readings() {
    // measured 8e-5 with the edges of all dipoles, 6e-6 otherwise: truncation of the differences
    let ring = Ring::booster();
    assert_derivatives(&ring, &[], &effects(&ring), 2e-4);
}

#[test]
fn signatures_hold_about_a_machine_with_effects() {
    let ring = Ring::booster();
    let assert = |about: &[Effect], which: &dyn Fn(EffectKind) -> bool, tolerance| {
        let some: Vec<Effect> = effects(&ring).into_iter().filter(|effect| which(effect.kind)).collect();
        assert_derivatives(&ring, about, &some, tolerance);
    };
    let about = |text: &str| text.split_whitespace().map(|e| Effect::parse(e, &ring).unwrap()).collect::<Vec<_>>();
    // but for effects of monitors, which stand in the order in which they were given
    let read = about("bpm_gain@x_E4=0.1 corrector_gain@H_A8=0.1 stray_gradient@SLOT_F6=0.02");
    assert(&read, &|kind| !kind.is_of_a_monitor(), 2e-4);
    // off momentum: what the ring holds is exact there, gradients feed down
    let held = |kind: EffectKind| matches!(kind.class(), Class::Hold(_));
    assert(&about("momentum_offset=0.002"), &held, 5e-5);
    // where not the momentum is held, but for the curvature of a field, which is taken at constant momentum
    // what is held beside it is held already: a full loop leaves nothing, of a step of the RF frequency neither
    let held = [EffectKind::FixedRfFrequency, EffectKind::RadialLoop, EffectKind::RfStep];
    let holds = |kind: EffectKind| held.contains(&kind);
    let is_curved = |kind: EffectKind| {
        matches!(kind, EffectKind::SextupoleError | EffectKind::DipoleSextupole | EffectKind::StrayOctupole)
    };
    let linear = |kind: EffectKind| !kind.is_switch() && !holds(kind) && !is_curved(kind);
    assert(&about("radial_loop@x_D8,x_E6"), &linear, 2e-4);
    assert(&about("fixed_rf_frequency"), &linear, 2e-4);
    // a drift as wide as its prior, whose own derivative differs by the drift and by what is of third order; what remembers the frame before meets another drift
    let drift = about("quad_drift=0.002");
    assert(&drift, &|kind| kind == EffectKind::QuadDrift, 1e-2);
    assert(&drift, &|kind| kind != EffectKind::QuadDrift && linear(kind) && !kind.is_transient(), 5e-4);
}

/// In every frame of a large drift, where those of mid-campaign are off by more than a tenth.
#[test]
fn derivatives_by_gradients_are_those_of_every_frame_of_a_drift() {
    let ring = Ring::booster();
    let drifting = machine(&ring, &[Effect { kind: EffectKind::QuadDrift, site: Site::Ring, amplitude: 5e-3 }]);
    let drives = drives(&ring, orbit(&ring, 0.0));
    let ends = drifting.ends();
    let of_quadrupoles = Signatures::of(&drifting, &drives).unwrap().between(ends.as_ref()).unwrap().of_quadrupoles();
    let still = machine(&ring, &[]);
    let of_middle = Signatures::of(&still, &drives).unwrap().of_quadrupoles();
    let count = ring.quadrupoles.len();
    for at in [0, 17, 30] {
        let with = |step: f64| {
            let factors: Vec<f64> = (0..count).map(|q| if q == at { step.exp() } else { 1.0 }).collect();
            let (readings, Tunes { x, y, .. }, changes) = drifting.with_strengths(&factors).readings(&drives).unwrap();
            (readings, changes.map_with_location(|_, plane, change| change + [x, y][plane]))
        };
        let (up, down) = (with(1e-5), with(-1e-5));
        let (readings, tunes) = ((up.0 - down.0) / 2e-5, (up.1 - down.1) / 2e-5);
        let own = &of_quadrupoles[at];
        let error = (&own.readings - &readings).amax() / readings.amax();
        assert!(error < 1e-4, "{at}: {error:e}");
        let error = tunes.map_with_location(|i, plane, known| own.tune(plane, i) - known).amax();
        assert!(error < 1e-6, "{at}: {error:e}");
        let error = (&of_middle[at].readings - &readings).amax() / readings.amax();
        assert!(error > 0.1, "{at}: {error:e}");
    }
}

/// Largest error of the linear change against the exact one, in frames with kicks and in those with an RF offset, the
/// largest change, and the error of the tunes.
fn compare(aligned: &Ring, real: &Ring, effect: &Effect) -> [f64; 4] {
    let moved = |effects: &[Effect]| {
        let real = machine(real, effects);
        drives(aligned, orbit(real.ring(), real.hold.delta))
    };
    let linear = |effects: &[Effect], drives: &Drives| machine(aligned, effects).readings(drives).unwrap();
    let exact = |effects: &[Effect]| tracked(machine(real, effects), &drives(aligned, Vec::new()));
    let one = core::slice::from_ref(effect);
    let change = exact(one) - exact(&[]);
    let error = &change - (linear(one, &moved(one)).0 - linear(&[], &moved(&[])).0);
    let still = Tracked::of(machine(real, one), NOMINAL).unwrap();
    let at =
        |time: f64| Cycle { kick: vec![0.0; real.correctors.len()], strength: vec![0.0; 48], rf_offset: 0.0, time };
    let [middle, end] = [0.0, 1.0].map(|time| still.cycle(&at(time)).unwrap().1);
    let (_, tunes, changes) = linear(one, &moved(one).still());
    let drift = changes.row(7); // the end of the campaign
    let missed = [middle.x - tunes.x, middle.y - tunes.y, end.x - middle.x - drift[0], end.y - middle.y - drift[1]];
    let tune = missed.map(f64::abs).into_iter().fold(0.0, f64::max);
    [error.rows(0, 6).abs().max(), error.rows(6, 2).abs().max(), change.abs().max(), tune]
}

/// As large as faults are, half a standard deviation of the prior; whole where there is no amplitude.
fn typical(effect: Effect) -> Effect {
    let share = if effect.kind.is_switch() { 1.0 } else { 0.5 };
    Effect { amplitude: share * effect.amplitude, ..effect }
}

fn depends_on_the_orbit(ring: &Ring, effect: &Effect) -> bool {
    effect.kind == EffectKind::DipoleSextupole || !effect.kind.orbit(ring, effect.site).is_empty()
}

#[test]
fn linear_readings_are_those_of_exact_orbits() {
    let ring = Ring::booster();
    for effect in effects(&ring).into_iter().filter(|e| !depends_on_the_orbit(&ring, e)).map(typical) {
        let [kicked, rf, change, tune] = compare(&Ring::booster(), &ring, &effect);
        // second order in the kicks: a path longer by half the square of slopes of 0.5 mrad moves the momentum by 1e-6
        // (1.8 um measured); a loop's momentum of 1.3e-4 changes the kick's own response (8.6 um)
        let second = match effect.kind {
            EffectKind::FixedRfFrequency => 2.5e-6,
            EffectKind::RadialLoop => 1e-5,
            // second order in the drift itself: 1e-3 of all gradients, times the slope's own relative change of 30
            EffectKind::QuadDrift => 2.5e-6,
            _ => 0.0,
        };
        // measured 2.5e-3: kinematic terms of slopes of 1 mrad, and sextupoles of the dipoles
        assert!(kicked < 4e-3 * change + second, "{effect:?}: {kicked:e} of {change:e}");
        // measured 0.051: second order of a momentum of 1e-3, which a gradient or an offset changes
        assert!(rf < 0.07 * change, "{effect:?}: {rf:e} of {change:e}");
        assert!(tune < 1e-4, "{effect:?}: {tune:e}");
    }
}

#[test]
fn what_depends_on_the_orbit_is_that_of_exact_orbits() {
    let ring = displaced();
    for effect in effects(&ring).into_iter().filter(|e| depends_on_the_orbit(&ring, e)).map(typical) {
        let [kicked, rf, change, tune] = compare(&Ring::booster(), &ring, &effect);
        // measured 0.036: the orbit is taken at the entrance of a sextupole, not in its middle
        assert!(kicked < 0.05 * change, "{effect:?}: {kicked:e} of {change:e}");
        // measured 0.11: the dispersion of the two displaced quadrupoles, and of the sextupoles of the dipoles on this orbit
        assert!(rf < 0.15 * change, "{effect:?}: {rf:e} of {change:e}");
        assert!(tune < 1e-3, "{effect:?}: {tune:e}");
    }
}

/// And one of no size adds nothing, whatever field the ring itself has there.
#[test]
fn effects_on_one_sextupole_add_up() {
    let (ring, orbit) = (Ring::booster(), orbit(&displaced(), 0.0));
    let seen = |amplitudes: &[f64]| {
        let sextupole = |amplitude: &f64| Effect::parse(&format!("sextupole_error@SX_A5={amplitude}"), &ring).unwrap();
        let with: Vec<Effect> = amplitudes.iter().map(sextupole).collect();
        machine(&ring, &with).on_orbit(&orbit).response().unwrap().x
    };
    let apart = |one: &[f64], other: &[f64]| (seen(one) - seen(other)).amax();
    let same = [apart(&[1.0, 2.0], &[3.0]), apart(&[0.0], &[])];
    assert!(same.iter().all(|apart| *apart < 1e-9) && apart(&[1.0], &[3.0]) > 1e-3, "{same:?}");
}

#[test]
fn what_crosses_curved_fields_moves_the_tunes() {
    let ring = Ring::booster();
    let drives = Drives { rf_offset: DVector::zeros(8), ..drives(&ring, orbit(&ring, 0.0)) };
    let exact = |effects: &[Effect]| {
        let tracked = Tracked::of(machine(&ring, effects), NOMINAL).unwrap();
        let cycle = |i: usize| Cycle {
            kick: drives.kick.row(i).iter().copied().collect(),
            strength: vec![0.0; 48],
            rf_offset: 0.0,
            time: 0.0,
        };
        let tunes: Vec<_> = (0..6).map(|i| tracked.cycle(&cycle(i)).unwrap().1).collect();
        MatrixXx2::from_fn(6, |i, plane| [tunes[i].x, tunes[i].y][plane])
    };
    // where a loop is on, the dispersion crosses them too; it moves the tunes of a ring without them as well
    let cases = [
        ("", "sextupole_error@SX_F4=2"),
        ("radial_loop@x_D8,x_E6", "dipole_sextupole=0.1"),
        ("stray_gradient@SLOT_F6=0.01", "stray_octupole@SLOT_F6=100"),
    ];
    for (held, text) in cases {
        let about: Vec<Effect> = held.split_whitespace().map(|text| Effect::parse(text, &ring).unwrap()).collect();
        let with = [about.as_slice(), &[Effect::parse(text, &ring).unwrap()]].concat();
        let change = exact(&with) - exact(&about);
        let error = &change - machine(&ring, &with).readings(&drives).unwrap().2.rows(0, 6);
        // second order in the kicks and the field
        assert!(error.amax() < 0.1 * change.amax(), "{text}: {:e} of {:e}", error.amax(), change.amax());
    }
}

/// The largest that is thought possible, 5 per mille of all gradients from mid-campaign to its end: what is of second order in it moves the tunes too.
#[test]
fn a_drift_moves_the_tunes_of_every_frame() {
    let ring = Ring::booster();
    let drives = drives(&ring, orbit(&ring, 0.0)).still();
    for amplitude in [5e-3, -5e-3] {
        let drifting = machine(&ring, &[Effect { kind: EffectKind::QuadDrift, site: Site::Ring, amplitude }]);
        let exact = tracked_tunes(&drifting, &drives);
        let (_, tunes, changes) = drifting.readings(&drives).unwrap();
        let errors = (0..drives.time.len()).flat_map(|i| {
            let of_frame = [tunes.x + changes[(i, 0)] - exact[i].x, tunes.y + changes[(i, 1)] - exact[i].y];
            of_frame.map(f64::abs)
        });
        // of third order; what is of second order is 4e-5
        let largest = errors.fold(0.0, f64::max);
        assert!(largest < 2e-7, "{largest:e}");
    }
}

/// Exact tunes of a machine without kicks at the times of some frames.
fn tracked_tunes(machine: &Machine, drives: &Drives) -> Vec<Tunes> {
    let (correctors, quadrupoles) = (machine.ring().correctors.len(), machine.ring().quadrupoles.len());
    let tracked = Tracked::of(machine.clone(), NOMINAL).unwrap();
    let at =
        |&time: &f64| Cycle { kick: vec![0.0; correctors], strength: vec![0.0; quadrupoles], rf_offset: 0.0, time };
    drives.time.iter().map(|time| tracked.cycle(&at(time)).unwrap().1).collect()
}

#[test]
fn what_reads_or_kicks_in_both_planes_is_rolled_in_both() {
    let ring = dual();
    let of = |text: &str| Effect::parse(text, &ring).unwrap();
    let (monitor, corrector) = (of("bpm_roll@y_E4=0.03"), of("corrector_roll@V_A4=0.03"));
    assert_eq!((monitor, corrector), (of("bpm_roll@x_E4=0.03"), of("corrector_roll@H_A4=0.03")));
    let sites = |kind: EffectKind| kind.sites(&ring).len();
    assert_eq!((sites(EffectKind::BpmGain), sites(EffectKind::BpmRoll)), (34, 33));
    assert_eq!((sites(EffectKind::CorrectorGain), sites(EffectKind::CorrectorRoll)), (49, 48));
    let (plain, rolled) = (machine(&ring, &[]).response().unwrap(), machine(&ring, &[monitor]).response().unwrap());
    let ((sin, cos), [x, y]) =
        (0.03_f64.sin_cos(), [Plane::X, Plane::Y].map(|plane| ring.monitor(plane, "E4").unwrap()));
    assert!((rolled.x.row(x) - plain.x.row(x) * cos - plain.y.row(x) * sin).abs().max() < 1e-12);
    assert!((rolled.y.row(y) - plain.y.row(y) * cos + plain.x.row(y) * sin).abs().max() < 1e-12);
    // all correctors kick in one of the frames
    assert_derivatives(&ring, &[], &[monitor, corrector], 2e-4);
    for effect in [monitor, corrector] {
        let [kicked, rf, change, _] = compare(&ring, &ring, &effect);
        assert!(kicked < 2e-3 * change && rf < 0.07 * change, "{effect:?}: {kicked:e} {rf:e} of {change:e}");
    }
}

/// What couples the planes in both alike is no roll: a roll by `a` reads `x + a y` and `y - a x`.
#[test]
fn an_instrument_of_both_planes_couples_each_by_itself() {
    let ring = dual();
    let of = |text: &str| Effect::parse(text, &ring).unwrap();
    let coupled = ["bpm_coupling@x_E4=0.03", "bpm_coupling@y_E4=-0.02", "corrector_coupling@V_A4=0.04"].map(of);
    let sites = |kind: EffectKind| kind.sites(&ring).len();
    assert_eq!([EffectKind::BpmCoupling, EffectKind::CorrectorCoupling].map(sites), [2, 2]);
    let respond = |effects: &[Effect]| machine(&ring, effects).response().unwrap();
    let [plain, x_alone, both] = [&[][..], &coupled[..1], &coupled[..2]].map(respond);
    let [x, y] = [Plane::X, Plane::Y].map(|plane| ring.monitor(plane, "E4").unwrap());
    assert!((x_alone.x.row(x) - plain.x.row(x) - plain.y.row(x) * 0.03).abs().max() < 1e-12);
    assert_eq!(x_alone.y, plain.y);
    assert!((both.y.row(y) - plain.y.row(y) + plain.x.row(y) * 0.02).abs().max() < 1e-12);
    let [h, v] = ["H_A4", "V_A4"].map(|name| ring.corrector_names().iter().position(|own| own == name).unwrap());
    let kicked = respond(&coupled[2..]);
    assert!((kicked.x.column(v) - plain.x.column(v) - plain.x.column(h) * 0.04).abs().max() < 1e-12);
    assert_eq!(kicked.y.column(h), plain.y.column(h));
    assert_derivatives(&ring, &[], &coupled, 2e-4);
    // what else happens is read in both planes too
    let others = ["stray_skew_gradient@SLOT_F6=0.01", "corrector_gain@V_A4=0.1", "stray_gradient@SLOT_C3=0.01"].map(of);
    assert_derivatives(&ring, &coupled[..1], &others, 2e-4);
    for effect in coupled {
        let [kicked, rf, change, _] = compare(&ring, &ring, &effect);
        assert!(kicked < 2e-3 * change && rf < 0.07 * change, "{effect:?}: {kicked:e} {rf:e} of {change:e}");
    }
}

/// The Booster with its sextupoles powered.
fn with_sextupoles(k2: f64) -> Ring {
    booster_with(|file| {
        let elements = file["elements"].as_array_mut().unwrap();
        let sextupoles = elements.iter_mut().filter(|element| element["type"] == "sextupole");
        sextupoles.for_each(|element| element["k2"] = k2.into());
    })
}

/// Off momentum the beam passes the sextupoles of the design beside their axes, which focuses it: about that orbit the frames of a campaign are those of the
/// response.
#[test]
fn sextupoles_of_the_design_focus_off_momentum() {
    let ring = with_sextupoles(-3.0);
    let off = |ring: &Ring| machine(ring, &[Effect::parse("momentum_offset=2e-3", ring).unwrap()]);
    let response = |machine: &Machine| {
        let MachineResponse { x, y, .. } = machine.response().unwrap();
        machine.ring().own_planes(&[x.transpose(), y.transpose()])
    };
    let correctors = ring.correctors.len();
    let frames = |machine: &Machine| {
        let drives = Drives {
            kick: DMatrix::identity(correctors, correctors),
            rf_offset: DVector::zeros(correctors),
            time: DVector::zeros(correctors),
            nominal_kick: 1.0,
            orbit: machine.orbit().unwrap(),
        };
        machine.readings(&drives).unwrap().0
    };
    let (exact, about_orbit, without) = (response(&off(&ring)), frames(&off(&ring)), response(&off(&Ring::booster())));
    let (change, error) = ((&exact - without).amax(), (exact - about_orbit).amax());
    assert!(change > 0.1 && error < 1e-9 * change, "{error:e} of {change:e} m/rad");
}
