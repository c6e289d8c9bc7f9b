//! Closed forms, on a ring of three horizontal and one vertical monitors whose response is a table.

use super::*;
use crate::estimate::{Health, Remarks};
use crate::judged::{Expected, Screened};
use crate::mask::Mask;
use crate::sizes::{Layout, Sizes};
use crate::surrogate::{Prediction, Surrogate, Tables, Unstable};
use crate::wire::{MagnetCurrents, Parcel, ParcelError, RfCode};

const B: usize = 4;
const C: usize = 4;
type State = Steer<B, C, 3, 1, 6, 1>;

/// `R(theta) = at + theta uncertain`, one param; the orbit off momentum is `dispersion`.
#[derive(Debug, Clone)]
struct Table {
    at: [[f32; C]; B],
    uncertain: [[f32; C]; B],
    dispersion: [f32; B],
}

impl Tables for Table {
    const BLANK: Self = Self { at: [[0.0; C]; B], uncertain: [[0.0; C]; B], dispersion: [0.0; B] };
    const ROOM: Sizes = Sizes::new([3, 1], [3, 1], [1, 1, 1]);

    fn layout(&self) -> Layout {
        Layout { ring: Self::ROOM, room: Self::ROOM }
    }

    fn parts<const L: usize>(&self) -> impl Iterator<Item = Parcel<L>> + '_ {
        core::iter::empty()
    }

    fn take<const L: usize>(&mut self, _: &Parcel<L>) -> Result<(), ParcelError> {
        Ok(())
    }
}

impl Surrogate<B, C, 1, 1> for Table {
    type Linearised = ();
    const UNLINEARISED: () = ();

    type Progress = ();
    const BEGIN: () = ();

    fn advance(&self, _: &[f32; 1], _: &[f32; 1], (): &mut (), (): &mut ()) -> Result<bool, Unstable> {
        Ok(true)
    }

    fn orbit(&self, (): &(), drive: &Drive<C, 1>, into: &mut [f32; B]) {
        for ((to, row), dispersion) in into.iter_mut().zip(&self.at).zip(&self.dispersion) {
            *to = dot(row, &drive.kick) + dispersion * drive.rf_offset;
        }
    }

    fn predict(&self, (): &(), _: &Drive<C, 1>, _: &mut Prediction<B, 1, 1>) {}

    fn tune(&self, (): &(), _: usize, _: &[f32; 1]) -> (f32, [f32; 1]) {
        (0.0, [0.0])
    }

    fn prior_group(&self, _: usize) -> usize {
        0
    }

    fn error_variance(&self, _: usize, _: f32, _: f32) -> f32 {
        0.0
    }

    fn follow(&self, (): &(), _: usize) -> ([f32; 1], f32) {
        ([0.0], 0.0)
    }
}

impl Steerable<B, C, 1, 1> for Table {
    fn pull(&self, (): &(), orbit: &[f32; B], into: &mut [f32; C]) {
        *into = core::array::from_fn(|c| self.at.iter().zip(orbit).map(|(row, x)| row[c] * x).sum());
    }

    fn response_covariance(
        &self,
        (): &(),
        plane: usize,
        weight: &[f32; B],
        covariance: impl Fn(usize) -> [f32; 1],
        mut add: impl FnMut(&[f32], &[f32]),
    ) {
        let correctors = if plane == 0 { 0..3 } else { 3..4 };
        for (row, weight) in self.uncertain.iter().zip(weight) {
            let here = &row[correctors.clone()];
            let [variance] = covariance(0);
            let there: std::vec::Vec<f32> = here.iter().map(|h| variance * weight * h).collect();
            add(here, &there);
        }
    }
}

extern crate std;

/// Each corrector is seen by one monitor, 10 m/rad; no dispersion, nothing uncertain.
fn diagonal() -> Table {
    Table { at: core::array::from_fn(|b| core::array::from_fn(|c| if b == c { 10.0 } else { 0.0 })), ..Table::BLANK }
}

const KICK: Each<C> = Each::same(1e-5);

/// A walk beside which readings have no noise: 0.1 m a frame.
const FAST: f32 = 0.3;
/// The walk of 0.1 mm in the root of a second that in frames of 0.1 s and with noise of 0.1 mm makes a gain of
/// `(sqrt(q^2 + 4 q) - q)/2 = 0.270` in the long run, `q = 0.1` being its variance in a frame over that of the noise.
const SLOW: f32 = 1e-4;
const SLOW_GAIN: f32 = 0.270_156_2;

/// Steps and kicks cost nothing, and nothing is in the way.
fn free() -> Feedback<B, C> {
    Feedback {
        orbit: Each::same(0.0),
        walk: FAST,
        step_kick: 1.0,
        total_kick: 1.0,
        limit: Each::same(1e3),
        rate: 1e3,
        probe: 0.0,
        close: 0.1,
        patience_us: 1_000_000,
    }
}

/// A machine whose response is a table, its feedback, and what disturbs it.
struct Machine {
    table: Table,
    feedback: Feedback<B, C>,
    variance: f32,
    state: State,
    disturbance: [f32; B],
    current: [CurrentCode; C],
    time_us: u64,
    cycle_time_us: u32,
    /// Over the reference.
    momentum: f32,
    judged: Judged<B, C, 1, 1>,
    /// Slices of work for the feedback between two frames.
    slices: u8,
}

impl Machine {
    /// Ready to steer; the orbit has been 0 so far.
    fn new(table: Table, feedback: Feedback<B, C>, variance: f32) -> Self {
        let health = Health { noise: 1e-4, weighted_as: 1e-4, ..Health::default() };
        let mut machine = Self {
            table,
            feedback,
            variance,
            state: State::BLANK,
            disturbance: [0.0; B],
            current: [CurrentCode::default(); C],
            time_us: 0,
            cycle_time_us: 0,
            momentum: 1.0,
            judged: judged(health),
            slices: TURN,
        };
        assert_eq!(machine.cycle().hold, Some(Hold::Stale));
        machine
    }

    fn orbit(&self) -> [f32; B] {
        let kick = self.current.map(|current| 1e-5 / self.momentum * current.value());
        let mut orbit = [0.0; B];
        self.table.orbit(&(), &Drive { kick, strength: [0.0], rf_offset: 0.0 }, &mut orbit);
        core::array::from_fn(|b| orbit[b] + self.disturbance[b])
    }

    /// A frame of the orbit as it is; the setpoints it makes are not taken over yet.
    fn frame(&mut self) -> Steered {
        self.time_us += 100_000;
        let reading = self.orbit().map(|x| PositionCode::nearest(x.into()).unwrap());
        let frame = &mut self.judged.frame;
        (frame.time_us, frame.cycle_time_us, frame.corrector) = (self.time_us, self.cycle_time_us, self.current);
        frame.reading = reading;
        let response = Response { surrogate: &self.table, at: &(), kick_per_ampere: &KICK, momentum: self.momentum };
        let steered = self.state.steer(&self.feedback, &response, &self.judged);
        for _ in 0..self.slices {
            self.state.prepare(&self.feedback, &response, |_| [self.variance]);
        }
        steered
    }

    /// A frame, and the supplies at their new setpoints.
    fn cycle(&mut self) -> Steered {
        let steered = self.frame();
        self.current = *self.state.setpoints();
        steered
    }

    fn cycles(&mut self, count: usize) {
        for _ in 0..count {
            let _ = self.cycle();
        }
    }

    fn amperes(&self) -> [f32; C] {
        self.state.setpoints().map(CurrentCode::value)
    }
}

fn judged(health: Health) -> Judged<B, C, 1, 1> {
    let frame = Frame {
        epoch: 0,
        sequence: 0,
        time_us: 0,
        cycle_time_us: 0,
        corrector: [CurrentCode::default(); C],
        magnets: MagnetCurrents { dipole: CurrentCode::default(), supply: [CurrentCode::default()] },
        rf_offset: RfCode::default(),
        reading: [PositionCode::default(); B],
        tune: [None; 2],
        intensity: None,
        valid: Mask::from_words(&[15]),
    };
    let drive = Drive { kick: [0.0; C], strength: [0.0], rf_offset: 0.0 };
    let screened = Screened { accepted: Mask::from_words(&[15]), ..Screened::default() };
    let expected = Expected { surprise: [0.0; B], certain: [0.0; B], within: Mask::NONE };
    let (remarks, health) = (Remarks::default(), [health; B]);
    Judged { frame, nis: 4.0, linearised: false, remarks, health, drive, expected, cell: None, screened }
}

/// Where kicks have several ways, a step that costs something: 1 % of what an orbit costs.
const STEP: f32 = 1e-4;
/// Steps of readings, 0.1 um, and of setpoints, 0.1 mA or 0.01 um here.
const ROUNDING: f32 = 2e-7;

#[test]
fn a_known_response_removes_the_orbit_in_one_step() {
    let mut machine = Machine::new(diagonal(), free(), 0.0);
    machine.disturbance = [1e-3, -2e-3, 5e-4, 3e-3];
    assert_eq!(machine.cycle(), Steered { hold: None, left_out: 0, limited: 0 });
    assert!(machine.orbit().iter().all(|x| x.abs() < ROUNDING), "{:?}", machine.orbit());
    // to the wanted orbit, if that is another
    machine.feedback.orbit = Each::same(1e-3);
    machine.cycles(1);
    assert!(machine.orbit().iter().all(|x| (x - 1e-3).abs() < 2.0 * ROUNDING), "{:?}", machine.orbit());
}

/// The second corrector is another's, who sets it: the orbit that it makes is removed by the others as far as they can, and it stays.
#[test]
fn a_corrector_that_is_not_used_is_left_to_others() {
    let mut table = diagonal();
    table.at[0][1] = 10.0; // the first monitor sees it, too
    let limit = Each { all: 1e3, own: heapless::Vec::from_slice(&[1e3, 0.0, 1e3, 1e3]).unwrap() };
    let mut machine = Machine::new(table, Feedback { limit, probe: 1.0, step_kick: STEP, ..free() }, 0.0);
    machine.cycles(3);
    machine.current[1] = CurrentCode::nearest(7.0).unwrap();
    machine.cycles(1);
    assert_eq!(machine.state.steered(), Steered { hold: None, left_out: 0, limited: 0 });
    assert_eq!(machine.amperes()[1], 7.0);
    // 1 % of what an orbit costs, see STEP
    assert!(machine.orbit()[0].abs() < 0.02 * 7e-4, "{:?}", machine.orbit());
    assert!((machine.orbit()[1] - 7e-4).abs() < 2.0 * ROUNDING, "{:?}", machine.orbit());
    machine.judged.remarks.put_aside = true;
    machine.cycles(4); // the model is in doubt: the others are probed
    assert_eq!(machine.amperes()[1], 7.0);
    assert!(machine.amperes()[2].abs() > 0.5);
}

#[test]
fn at_half_the_momentum_half_the_current_removes_the_orbit() {
    let amperes = |momentum: f32| {
        let mut machine = Machine::new(diagonal(), free(), 0.0);
        machine.momentum = momentum;
        machine.disturbance = [1e-3, -2e-3, 5e-4, 3e-3];
        machine.cycles(1);
        assert!(machine.orbit().iter().all(|x| x.abs() < 2.0 * ROUNDING), "{:?}", machine.orbit());
        machine.amperes()
    };
    // one step of a setpoint, 0.1 mA, either way
    assert!(amperes(1.0).iter().zip(amperes(0.5)).all(|(whole, half)| (half - 0.5 * whole).abs() < 2e-4));
}

#[test]
fn the_slower_the_orbit_walks_the_longer_its_readings_are_averaged() {
    let mut machine = Machine::new(diagonal(), Feedback { walk: SLOW, ..free() }, 0.0);
    machine.cycles(60);
    // less than what calls for haste: that comes next
    machine.disturbance = [4e-5, -5e-5, 2e-5, 6e-5];
    for n in 1..10 {
        machine.cycles(1);
        let left = libm::powf(1.0 - SLOW_GAIN, n as f32);
        let each = machine.orbit().into_iter().zip(machine.disturbance);
        assert!(each.into_iter().all(|(x, d)| (x - left * d).abs() < 6.0 * ROUNDING), "{n}: {:?}", machine.orbit());
    }
}

/// A step of ten times the noise, which the core does not say; with a gain of 0.03 half of it would be left after 23 frames.
#[test]
fn an_orbit_that_moves_faster_is_followed() {
    let mut machine = Machine::new(diagonal(), Feedback { walk: 0.1 * SLOW, ..free() }, 0.0);
    machine.cycles(200);
    machine.disturbance = [1e-3; B];
    machine.cycles(10);
    assert!(machine.orbit().iter().all(|x| x.abs() < 1e-4), "{:?}", machine.orbit());
}

#[test]
fn a_moved_orbit_is_the_mean_of_its_frames() {
    let mut machine = Machine::new(diagonal(), Feedback { walk: 1e-3 * SLOW, ..free() }, 0.0);
    machine.cycles(20);
    machine.disturbance = [1e-3; B];
    machine.judged.remarks.baselines_moved = true;
    machine.cycles(1);
    machine.judged.remarks.baselines_moved = false;
    assert!(machine.orbit().iter().all(|x| x.abs() < 2.0 * ROUNDING), "{:?}", machine.orbit());
    // a second one that is off counts half, too little to move faster
    machine.disturbance = [1.05e-3; B];
    machine.cycles(1);
    assert!(machine.orbit().iter().all(|x| (x - 2.5e-5).abs() < 4.0 * ROUNDING), "{:?}", machine.orbit());
}

/// `d = -R r/(R^2 + var R)` for one monitor and one corrector.
#[test]
fn kicks_of_uncertain_effect_are_left_alone() {
    let mut table = diagonal();
    // the second corrector's response is 10 ± 30 m/rad, and the first one's is known
    table.uncertain[1][1] = 30.0;
    let mut machine = Machine::new(table, free(), 1.0);
    machine.disturbance = [1e-3; B];
    machine.cycles(1);
    let amperes = machine.amperes();
    for (c, share) in [(0, 1.0), (1, 0.1), (2, 1.0), (3, 1.0)] {
        assert!((amperes[c] + 10.0 * share).abs() < 2e-3, "{amperes:?}");
    }
}

/// `d = -R r/(R^2 + noise^2/step^2)`, and in the long run `k = -R d/(R^2 + noise^2/total^2)`.
#[test]
fn steps_and_kicks_have_their_cost() {
    let mut machine = Machine::new(diagonal(), Feedback { step_kick: 1e-5, ..free() }, 0.0);
    machine.disturbance = [1e-3; B];
    machine.cycles(1);
    assert!((machine.amperes()[0] + 5.0).abs() < 1e-3, "{:?}", machine.amperes()); // noise/step = R
    let mut machine = Machine::new(diagonal(), Feedback { step_kick: 1e-5, total_kick: 2e-5, ..free() }, 0.0);
    machine.disturbance = [1e-3; B];
    (0..60).for_each(|_| assert!(machine.cycle().hold.is_none()));
    assert!((machine.amperes()[0] + 8.0).abs() < 1e-2, "{:?}", machine.amperes()); // noise/total = R/2
}

#[test]
fn the_orbit_of_another_momentum_is_not_corrected() {
    let table = Table { dispersion: [2.0, 3.0, 1.0, 0.0], ..diagonal() };
    let mut machine = Machine::new(table, Feedback { step_kick: STEP, ..free() }, 0.0);
    machine.disturbance = [2e-3, 3e-3, 1e-3, 0.0];
    machine.cycles(1);
    assert!(machine.amperes().iter().all(|a| a.abs() < 2e-3), "{:?}", machine.amperes());
    // across it, all is corrected
    machine.disturbance = [3e-3, -2e-3, 0.0, 1e-3];
    machine.cycles(4);
    assert!(machine.orbit().iter().all(|x| x.abs() < 4.0 * ROUNDING), "{:?}", machine.orbit());
}

#[test]
fn limits_hold_and_the_others_make_up_for_them() {
    let mut table = diagonal();
    // the second monitor is seen by the first and the second corrector
    table.at[1] = [6.0, 10.0, 0.0, 0.0];
    table.at[0] = [0.0; C];
    let mut machine = Machine::new(table, Feedback { limit: Each::same(7.0), step_kick: STEP, ..free() }, 0.0);
    machine.disturbance = [0.0, 1e-3, 0.0, 0.0];
    let steered = machine.cycle();
    // the least kicks would be -4.4 A and -7.4 A; of what is left, 0.3 mm, the other does 6^2/(6^2 + 1)
    assert_eq!((steered.limited, machine.amperes()[1]), (1, -7.0));
    assert!((machine.amperes()[0] + 5.0 * 36.0 / 37.0).abs() < 2e-3, "{:?}", machine.amperes());
    machine.disturbance = [0.1; B];
    machine.cycles(20);
    assert!(machine.amperes().iter().all(|a| a.abs() <= 7.0), "{:?}", machine.amperes());
    // nothing has wound up: the first frame without the disturbance leaves the limits
    machine.disturbance = [0.0; B];
    machine.cycles(1);
    assert!(machine.amperes()[2].abs() < 0.1, "{:?}", machine.amperes());
}

#[test]
fn no_setpoint_moves_faster_than_its_rate_and_the_others_make_up_for_it() {
    let mut table = diagonal();
    // the second monitor is seen by the first and the second corrector
    table.at[1] = [6.0, 10.0, 0.0, 0.0];
    table.at[0] = [0.0; C];
    let mut machine = Machine::new(table, Feedback { rate: 7.0, step_kick: STEP, ..free() }, 0.0);
    machine.disturbance = [0.0, 1e-3, 2e-4, 0.0];
    let steered = machine.cycle();
    // of the 0.3 mm that the second one leaves, the first does 6^2/(6^2 + 1); the third is as if alone: 10^2/(10^2 + 1) of 2 A
    let expected = [-5.0 * 36.0 / 37.0, -7.0, -2.0 * 100.0 / 101.0];
    let amperes = machine.amperes();
    assert!(amperes.iter().zip(expected).all(|(is, expected)| (is - expected).abs() < 2e-3), "{amperes:?}");
    assert_eq!(steered.limited, 0);
}

#[test]
fn each_reason_holds() {
    type Change = fn(&mut Machine);
    let reasons: [(Change, Hold); 7] = [
        (|m| m.time_us += 2_000_000, Hold::Stale),
        (|m| m.time_us -= 150_000, Hold::Stale),
        (|m| m.cycle_time_us += 20_000, Hold::Stale),
        (|m| m.judged.remarks.put_aside = true, Hold::PutAside),
        (|m| m.judged.remarks.unsolved = true, Hold::Unsolved),
        (|m| m.judged.nis = 30.0, Hold::Surprising),
        (|m| m.judged.screened.accepted = Mask::from_words(&[1]), Hold::Blind),
    ];
    for (change, hold) in reasons {
        let mut machine = Machine::new(diagonal(), free(), 0.0);
        machine.cycles(1);
        machine.disturbance = [1e-3; B];
        let good = machine.judged.clone();
        change(&mut machine);
        assert_eq!(machine.cycle().hold, Some(hold));
        assert_eq!(machine.amperes(), [0.0; C], "{hold:?}");
        // and it goes on
        machine.judged = good;
        assert_eq!(machine.cycle().hold, None, "{hold:?}");
        machine.cycles(1);
        assert!(machine.orbit().iter().all(|x| x.abs() < 4.0 * ROUNDING), "{hold:?}: {:?}", machine.orbit());
    }
}

#[test]
fn a_lasting_mismatch_holds_until_it_is_over() {
    let mut machine = Machine::new(diagonal(), free(), 0.0);
    machine.judged.nis = 14.0; // 3.5 times what four readings make
    let holds: std::vec::Vec<_> = (0..300).map(|_| machine.cycle().hold).collect();
    assert_eq!((holds[0], holds[60], holds[150]), (None, None, Some(Hold::Mismatch)));
    machine.judged.nis = 4.0;
    assert!((0..100).map(|_| machine.cycle().hold).any(|hold| hold.is_none()));
}

#[test]
fn doubt_is_probed_within_the_limits_and_leaves_nothing_behind() {
    let mut machine = Machine::new(diagonal(), Feedback { probe: 1.0, limit: Each::same(7.0), ..free() }, 0.0);
    machine.disturbance = [1e-2, 1e-4, -1e-2, 0.0];
    machine.cycles(3);
    let before = machine.amperes();
    assert!(before[0] == -6.0 && before[2] == 6.0, "{before:?}");
    machine.judged.remarks.put_aside = true;
    let mut patterns = [[0.0; C]; 20];
    for pattern in &mut patterns {
        machine.cycles(1);
        *pattern = machine.amperes();
        let each = pattern.iter().zip(before);
        assert!(each.clone().all(|(a, b)| ((a - b).abs() - 1.0).abs() < 1e-3 && a.abs() <= 7.0), "{pattern:?}");
    }
    // each corrector is moved both ways, and no two alike
    let moved = |c: usize| patterns.iter().filter(|pattern| pattern[c] > before[c]).count();
    assert!((0..C).all(|c| (4..=16).contains(&moved(c))), "{patterns:?}");
    machine.judged.remarks.put_aside = false;
    (machine.judged.screened.accepted, machine.judged.nis) = (Mask::NONE, 0.0);
    machine.cycles(1);
    assert_eq!(machine.amperes(), before);
}

#[test]
fn without_gains_nothing_moves() {
    let mut machine = Machine::new(diagonal(), free(), 0.0);
    machine.disturbance = [1e-3; B];
    machine.state.x = Gain::BLANK;
    assert_eq!(machine.cycle().hold, Some(Hold::Unprepared));
    assert_eq!(machine.amperes(), [0.0; C]);
}

#[test]
fn a_corrector_that_sticks_is_left_out_and_comes_back() {
    // two correctors act alike on the first monitor
    let mut table = diagonal();
    table.at[0] = [10.0, 10.0, 0.0, 0.0];
    table.at[1] = [0.0; C];
    let mut machine = Machine::new(table, Feedback { step_kick: STEP, ..free() }, 0.0);
    let stick = |machine: &mut Machine, sticks: bool| {
        let before = machine.current[0];
        let steered = machine.cycle();
        if sticks {
            machine.current[0] = before;
        }
        steered.left_out
    };
    machine.disturbance = [4e-3, 0.0, 0.0, 0.0];
    let left_out: std::vec::Vec<_> = (0..8).map(|_| stick(&mut machine, true)).collect();
    assert_eq!((left_out[3], left_out[7]), (0, 1));
    assert!(!machine.state.follows(0) && machine.state.follows(1));
    assert!(machine.orbit()[0].abs() < 2e-5, "{:?}", machine.orbit());
    let mended: std::vec::Vec<_> = (0..20).map(|_| stick(&mut machine, false)).collect();
    assert_eq!((mended[0], mended[19]), (1, 0));
    assert!(machine.orbit()[0].abs() < 4.0 * ROUNDING, "{:?}", machine.orbit());
}

/// While it is silent its orbit may walk, so that it is believed the more when it comes back.
/// One slice a frame, as on a device: what was made with other correctors moves nothing.
#[test]
fn gains_of_other_correctors_are_not_used() {
    let mut machine = Machine::new(diagonal(), free(), 0.0);
    (machine.disturbance, machine.slices) = ([1e-3, 0.0, 0.0, 0.0], 1);
    let stuck = machine.current[0];
    let mut holds = std::vec::Vec::new();
    for frame in 0..30 {
        let steered = machine.cycle();
        holds.extend(steered.hold);
        if frame < 10 {
            machine.current[0] = stuck;
        }
    }
    // two frames once it is left out, and two when it is back
    assert_eq!(holds, [Hold::Unprepared; 4]);
    assert!(machine.orbit().iter().all(|x| x.abs() < ROUNDING), "{:?}", machine.orbit());
}

/// A feedback that takes over beyond its limit returns at its rate.
#[test]
fn a_setpoint_beyond_its_limit_returns_at_its_rate() {
    let feedback = Feedback { limit: Each::same(20.0), rate: 2.0, ..free() };
    let mut machine = Machine::new(diagonal(), feedback, 0.0);
    machine.current =
        [CurrentCode::nearest(25.0).unwrap(), CurrentCode::default(), CurrentCode::default(), CurrentCode::default()];
    machine.time_us += 10_000_000;
    assert_eq!(machine.cycle().hold, Some(Hold::Stale));
    let amperes: std::vec::Vec<f32> = (0..3)
        .map(|_| {
            machine.cycles(1);
            machine.amperes()[0]
        })
        .collect();
    assert!(amperes.iter().zip([23.0, 21.0, 19.0]).all(|(is, expected)| (is - expected).abs() < 1e-3), "{amperes:?}");
}

#[test]
fn a_monitor_that_does_not_report_keeps_its_orbit() {
    let mut machine = Machine::new(diagonal(), Feedback { walk: SLOW, ..free() }, 0.0);
    machine.cycles(60);
    machine.disturbance = [5e-5; B];
    machine.judged.screened.accepted = Mask::from_words(&[14]);
    machine.cycles(20);
    assert!((machine.orbit()[0] - 5e-5).abs() < 4.0 * ROUNDING, "{:?}", machine.orbit());
    machine.judged.screened.accepted = Mask::from_words(&[15]);
    machine.cycles(1);
    // 0.27 noise^2 and 20 frames' walks of 0.1 of it, with that of this frame
    let known = SLOW_GAIN + 20.0 * 0.1 + 0.1;
    let left = 5e-5 / (1.0 + known);
    assert!((machine.orbit()[0] - left).abs() < 6.0 * ROUNDING, "{left} {:?}", machine.orbit());
}

#[test]
fn setpoints_that_are_not_reached_yet_are_not_corrected_twice() {
    let mut machine = Machine::new(diagonal(), free(), 0.0);
    machine.disturbance = [1e-3; B];
    let _ = machine.frame();
    let first = machine.amperes();
    let _ = machine.frame(); // the supplies are slow
    let second = machine.amperes();
    assert!(first.iter().zip(second).all(|(a, b)| (a - b).abs() < 2e-3), "{first:?} {second:?}");
}
