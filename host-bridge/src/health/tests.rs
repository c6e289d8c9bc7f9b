//! Faults put into the frames of a recording, and what is said of them.

use std::path::Path;

use inference::Recording;
use inference::recording::Row;
use inference::stream::{self, Core};
use results::Names;
use twin::Ring;

use super::*;

/// Rounds of the recording's 346 frames: each corrector is on in six of them.
const ROUNDS: u32 = 8;

struct Machine {
    ring: Ring,
    recording: Recording,
    core: Core,
    health: Health,
}

impl Machine {
    fn new() -> Self {
        let ring = Ring::booster();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
        let recording = Recording::read(&folder, &ring).unwrap();
        let core = stream::estimator(&ring, &recording, stream::FOLLOW).unwrap();
        let health = Health::new(&core.setup.noise, ring.correctors.len());
        Self { ring, recording, core, health }
    }

    /// Rounds of the recording with a fault, by the number of the frame and its row.
    fn run(&mut self, rounds: core::ops::Range<u32>, fault: impl Fn(u32, &mut Row)) {
        let names = Names::of(&self.ring);
        let length = self.recording.rows.len() as u32;
        for number in rounds.start * length..rounds.end * length {
            let mut row = self.recording.rows[(number % length) as usize].clone();
            (row.sequence, row.time) = (number, f64::from(number));
            fault(number, &mut row);
            let mut wire = stream::wire(&self.recording, &row).unwrap();
            let currents = measured(&self.core.tables.sizes(), &wire).unwrap().currents;
            assert_eq!(currents.len(), 48);
            let estimate = self.core.ingest(&mut wire).unwrap();
            self.core.prepare();
            let record = EstimateRecord::of(&names, estimate, &self.core.spread().covariance(), None);
            self.health.learn(&record, &currents);
        }
    }

    /// Everything that is not ok, by name.
    fn ill(&self) -> Vec<(String, State)> {
        let monitors = self.ring.monitor_names().into_iter().zip(self.health.monitors.iter().map(Instrument::state));
        let correctors = self.health.correctors.iter().map(|corrector| corrector.instrument.state());
        let all = monitors.chain(self.ring.corrector_names().into_iter().zip(correctors));
        all.filter(|(_, state)| *state != State::Ok).collect()
    }
}

#[test]
fn a_monitor_that_goes_silent_is_dead_then_back_then_ok() {
    let mut machine = Machine::new();
    machine.run(0..1, |_, _| ());
    let before = machine.ill(); // the recording has monitors that are noisy or jump
    let names = machine.ring.monitor_names();
    let well = names.iter().position(|name| before.iter().all(|(ill, _)| ill != name)).unwrap();
    machine.run(1..2, |_, row| row.reading[well] = None);
    let state = |machine: &Machine| machine.health.monitors[well].state();
    assert_eq!(state(&machine), State::Dead);
    let during = machine.ill();
    assert!(during.iter().all(|(name, state)| *name == names[well] || *state != State::Dead), "{during:?}");
    machine.run(2..5, |_, _| ());
    assert_eq!(state(&machine), State::Ok);
}

/// From the third round on, the current of corrector 7 is read back, and its supply gives none. Frames after such a one may be put aside,
/// so that the corrector measured next may be said to jump; dead is one alone.
#[test]
fn a_corrector_that_does_not_kick_is_dead_and_no_other() {
    let mut machine = Machine::new();
    let off = machine.recording.rows.iter().position(|row| row.correctors.iter().all(|(_, setting)| *setting == 0.0));
    let without = machine.recording.rows[off.unwrap()].reading.clone();
    machine.run(0..2, |_, _| ());
    let correctors = |machine: &Machine| {
        let names = machine.ring.corrector_names();
        machine.ill().into_iter().filter(|(name, _)| names.contains(name)).collect::<Vec<_>>()
    };
    assert_eq!(correctors(&machine), []);
    machine.run(2..ROUNDS, |_, row| {
        if row.setting(7).is_some_and(|setting| setting != 0.0) {
            row.reading.clone_from(&without);
        }
    });
    let ill = correctors(&machine);
    let dead: Vec<_> = ill.iter().filter(|(_, state)| *state == State::Dead).map(|(name, _)| name).collect();
    assert_eq!(dead, [&machine.ring.corrector_names()[7]], "{ill:?}");
    assert!(ill.len() <= 2, "{ill:?}");
}

#[test]
fn after_a_reset_nothing_is_known() {
    let mut machine = Machine::new();
    machine.run(0..1, |_, row| row.reading[5] = None);
    assert_ne!(machine.ill(), []);
    machine.health.restart();
    assert_eq!((machine.ill(), machine.health.is_of(33, 48)), (vec![], true));
}
