//! The loop closed in software: the twin, its frames as bytes, the core, its setpoints, the twin. Rings, places and noise are those
//! of seeds that nothing was tuned on; `make loop` shows one such run.

use estimator::Hold;
use estimator::booster::Feedback;
use system_tests::feedback::{Control, Event, Known, Loop, Sample, Scenario, WALK, held, recommended, rms, settled};

/// Orbit that noise of 0.15 mm and a walk of 2.2 um a frame leave in a filter, `sqrt(walk noise)` [m].
const LEFT: f64 = 18e-6;

/// Frames put aside in a row after which the core lets the readings count again (`quarantine.rs`).
const PERSISTS: usize = 30;
/// Frames that the core takes to tell that baselines have moved (`quarantine.rs`).
const ENOUGH: usize = 10;
/// Frames held in a run: 18 machines (seeds 101 to 106, 401 to 406, 701 to 706) give 51 to 59, 54.6 ± 2.2; four standard deviations.
const HELD: usize = 63;
/// Orbit that probes of 1 A add while the beam is lost from the first frame on [m]: 0.22, 0.32 and 0.26 mm in three machines (seeds
/// 204, 214, 224), 0.27 ± 0.05 mm; four standard deviations. Other faults give 0.22 mm at most.
const PROBE: f64 = 4.7e-4;
/// Share of the orbit without correction that is asked for.
const SHARE: f64 = 0.2;

fn run(known: &Known, feedback: &Feedback, control: Control, scenario: &Scenario) -> Vec<Sample> {
    Loop::new(known, feedback.clone(), control, scenario.clone()).unwrap().run().unwrap()
}

/// After every disturbance at most a fifth of what it is without correction; on average below what it is with the design's response,
/// and nowhere above it by more than the noise that the filter leaves: a ring may be as its design where it matters.
fn holds_the_orbit(seed: u64) {
    let (known, scenario) = (Known::read().unwrap(), Scenario::of_everything(seed));
    let [off, design, estimated] = [Control::Off, Control::Design, Control::Estimated]
        .map(|control| run(&known, &recommended(), control, &scenario));
    let mut logarithms = Vec::new();
    for (name, frames) in scenario.stretches() {
        let [off, design, estimated] = [&off, &design, &estimated].map(|samples| &samples[frames.clone()]);
        assert!(rms(estimated) <= SHARE * rms(off), "seed {seed}, {name}: {} of {} m", rms(estimated), rms(off));
        let [by_estimate, by_design] = [rms(estimated), rms(design)];
        assert!(by_estimate < by_design + LEFT, "seed {seed}, {name}: {by_estimate}, by the design {by_design} m");
        let ratio = rms(settled(estimated)) / rms(settled(design));
        logarithms.push(ratio.ln());
    }
    let mean = (logarithms.iter().sum::<f64>() / logarithms.len() as f64).exp();
    assert!(mean < 1.0, "seed {seed}: {mean} of the design's on average");
    // after 30 frames put aside the model would be taken to be at fault (`quarantine.rs`): no hold is to last as long
    for (name, frames) in scenario.stretches() {
        assert!(held(&estimated[frames.clone()]) < PERSISTS, "seed {seed}, {name}");
    }
    let of = |hold| estimated.iter().filter(|s| s.steered.is_some_and(|s| s.hold == Some(hold))).count();
    assert_eq!((of(Hold::Mismatch), of(Hold::Unsolved), of(Hold::Blind)), (0, 0, 0), "seed {seed}");
    assert!(held(&estimated) <= HELD, "seed {seed}: {} frames held", held(&estimated));
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn the_orbit_is_held_whatever_happens() {
    holds_the_orbit(101);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn the_orbit_of_another_ring_is_held_whatever_happens() {
    holds_the_orbit(102);
}

/// A fault at any time, from the first frame with feedback on, without a campaign before it: the orbit never becomes worse
/// than it would be without correction by more than a probe, and ends at the share that is asked for: 54
/// runs (seeds 201 to 206, 211 to 216, 221 to 226) end at 0.008 to 0.048 of it.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn no_fault_at_any_time_makes_it_unstable() {
    let known = Known::read().unwrap();
    let faults = [
        Event::Moves(11, [4e-4, -4e-4]),
        Event::Steps(20, 0.97),
        Event::Sticks(30, 400),
        Event::Lost(20),
        Event::Silent(vec![2, 25], 400),
        Event::Gap(1000),
    ];
    for (seed, fault) in (201..).zip(faults) {
        for (at, walk) in [(1, WALK), (7, 5.0 * WALK), (60, WALK)] {
            let scenario = Scenario { events: vec![(at, fault.clone())], campaign: 0, ..Scenario::quiet(seed, 150) };
            let feedback = Feedback { walk, ..recommended() };
            let samples = run(&known, &feedback, Control::Estimated, &scenario);
            let off = run(&known, &feedback, Control::Off, &scenario);
            for (frame, (sample, off)) in samples.iter().zip(&off).enumerate() {
                let largest = off.rms + PROBE;
                assert!(sample.rms < largest, "{fault} at {at}, walk {walk}, frame {frame}: {} m", sample.rms);
            }
            let (last, off) = (rms(&samples[130..]), rms(&off[130..]));
            assert!(last <= SHARE * off, "{fault} at {at}, walk {walk}: {last} of {off} m");
        }
    }
}

/// Without probes the frames that are put aside after a step of the orbit look like any lost beam, and go on.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn probes_end_a_hold() {
    let known = Known::read().unwrap();
    let scenario = Scenario { events: vec![(120, Event::Moves(10, [4e-4, 4e-4]))], ..Scenario::quiet(301, 200) };
    let [with, without] = [1.0, 0.0].map(|probe| {
        let feedback = Feedback { probe, ..recommended() };
        held(&run(&known, &feedback, Control::Estimated, &scenario)[120..])
    });
    // of 12 machines all hold 9 frames with probes, and 32 to 72 without
    assert!(with <= ENOUGH && without >= PERSISTS, "{with} and {without} frames held");
}
