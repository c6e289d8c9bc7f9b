//! The stored settings, in fixed size: for every setting of the machine the mean drive and the mean reading of each
//! monitor. With constant params these means are sufficient statistics, however the model is linearised, so that every
//! frame so far counts again when the MAP moves.
//!
//! Means are kept in fixed point and move by `round((value - mean)/n)`: a year of frames loses less than a tenth of a
//! micrometre (test `means_hold_for_a_year`).

use heapless::Vec;

use crate::drive::Drive;
use crate::monitor::Gate;
use crate::ramp::is_same_time;
use crate::state::{Blank, Bytes, State, StateError, state};
use crate::wire::{PositionCode, RfCode};

/// The setting that a frame repeats: at most one corrector moved from a reference drive, or the RF moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setting {
    /// From which reference drive; 0 is none, all correctors at 0 A.
    pub reference: u16,
    /// The corrector that is moved from it.
    pub corrector: Option<u16>,
    /// By how much, in steps of a mean kick.
    pub kick: i32,
    /// By how much other kicks of it make the same orbit within the noise, in these steps.
    pub tolerance: i32,
    /// RF offset, in steps.
    pub rf_offset: i32,
    /// Time in the cycle [us].
    pub cycle_time: u32,
}

state!([] Setting { reference, corrector, kick, tolerance, rf_offset, cycle_time });

/// Kicks this close belong to the same setting, as a share of the kick: 1/16.
pub const SAME_KICK: i32 = 16;
/// RF offsets this close belong to the same setting, in steps of the wire: 1e-6. That moves an orbit by a few micrometres, below the noise of a
/// reading, and is more than the read-back scatters; measurements move the RF by 1e-4 and more.
pub const SAME_OFFSET: i32 = 1_000;

impl Setting {
    /// True if a corrector is powered or the RF frequency moved.
    pub fn is_driven(&self) -> bool {
        self.corrector.is_some() || self.rf_offset.abs() > SAME_OFFSET
    }

    /// A frame in which no corrector is moved.
    pub fn at_rest(reference: u16, rf_offset: RfCode, cycle_time: u32) -> Self {
        Self { reference, corrector: None, kick: 0, tolerance: 0, rf_offset: rf_offset.steps(), cycle_time }
    }

    /// The same with one corrector moved by a kick [rad], of which others by `tolerance` cannot be told.
    pub fn with(self, corrector: u16, kick: f32, tolerance: f32) -> Self {
        Self { corrector: Some(corrector), kick: kick_steps(kick), tolerance: kick_steps(tolerance), ..self }
    }

    /// True if two frames repeat one setting.
    pub fn repeats(&self, other: &Self) -> bool {
        let apart = self.kick.saturating_sub(other.kick).saturating_abs();
        let share = self.kick.saturating_abs().max(other.kick.saturating_abs()) / SAME_KICK;
        self.reference == other.reference
            && self.corrector == other.corrector
            && apart <= share.max(other.tolerance)
            && self.same_but_for_the_correctors(other)
    }

    fn same_but_for_the_correctors(&self, other: &Self) -> bool {
        self.rf_offset.saturating_sub(other.rf_offset).saturating_abs() <= SAME_OFFSET
            && is_same_time(self.cycle_time, other.cycle_time)
    }
}

/// True if the RF is moved.
pub fn is_moved(rf_offset: RfCode) -> bool {
    rf_offset.steps().abs() > SAME_OFFSET
}

/// Bits behind the binary point of a mean.
const FRACTION: u32 = 10;
/// Steps of a mean in a metre.
const READING: f32 = 1024.0 / PositionCode::METRES_PER_LSB;
/// Steps of a mean kick in a radian; ±21 mrad fit.
const KICK: f32 = 1e11;
/// A kick [rad] in its steps.
fn kick_steps(kick: f32) -> i32 {
    (kick * KICK) as i32
}

/// Steps of a mean in a unit of strength or of RF offset; ±2 fit.
const RATIO: f32 = 1e9;

/// A mean of ratios, and of strengths, in its steps.
pub const fn ratio_steps(ratio: f32) -> i32 {
    (ratio * RATIO) as i32
}

/// The mean of so many steps.
pub const fn ratio(steps: i32) -> f32 {
    steps as f32 / RATIO
}

/// Move a mean of `n` values, the last of which is `value`.
pub fn move_mean(mean: &mut i32, value: i32, n: u32) {
    let n = i64::from(n.max(1));
    let step = i64::from(value) - i64::from(*mean);
    let half = if step < 0 { -n / 2 } else { n / 2 };
    *mean = mean.saturating_add(((step + half) / n) as i32);
}

/// A reading moved to the mean drive of its setting: that of the frames before it, in which it is compared, and that with its own, in which the
/// next one is.
#[derive(Debug, Clone, Copy)]
pub struct Moved {
    /// To the mean drive before the frame, in steps.
    pub before: i32,
    /// To that with the frame, in steps.
    pub after: i32,
}

/// Distance of a drive from the mean of those before it, over that from the mean with it, the `n`-th.
pub fn before_last(n: u32) -> f32 {
    let n = n.max(2) as f32;
    n / (n - 1.0)
}

/// The last reading of a monitor in a setting, moved to the mean drive, and how many in a row that agree, this one included, wait for a
/// repeat that confirms them: four times its code, and that number, at most 3.
#[derive(Debug, Clone, Copy)]
struct Last(i32);

impl State for Last {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        self.0.pass(bytes)
    }
}

impl Last {
    /// None so far.
    const NONE: Self = Self(i32::MIN);

    fn new(code: i32, waiting: u8) -> Self {
        Self(code << 2 | i32::from(waiting.min(3)))
    }

    fn code(self) -> Option<i32> {
        (self.0 != Self::NONE.0).then_some(self.0 >> 2)
    }

    fn waiting(self) -> u8 {
        (self.0 & 3) as u8
    }

    /// The same reading of a monitor that has moved by so many steps.
    fn moved(self, by: i32) -> Self {
        self.code().map_or(Self::NONE, |code| {
            let moved = code.saturating_add(by);
            Self::new(moved.clamp(-PositionCode::LIMIT, PositionCode::LIMIT), self.waiting())
        })
    }
}

/// One setting.
#[derive(Debug, Clone)]
pub struct Cell<const B: usize, const C: usize, const F: usize> {
    setting: Setting,
    frames: u32,
    kick: [i32; C],
    strength: [i32; F],
    rf_offset: i32,
    reading: [i32; B],
    /// Readings in each mean; beyond the largest number, later ones count as much as that one.
    count: [u16; B],
    last: [Last; B],
}

state!([const B: usize, const C: usize, const F: usize] Cell<B, C, F> { setting, frames, kick, strength, rf_offset, reading, count, last });

impl<const B: usize, const C: usize, const F: usize> Blank for Cell<B, C, F> {
    const BLANK: Self =
        Self::open(Setting { reference: 0, corrector: None, kick: 0, tolerance: 0, rf_offset: 0, cycle_time: 0 });
}

impl<const B: usize, const C: usize, const F: usize> Cell<B, C, F> {
    const fn open(setting: Setting) -> Self {
        Self {
            setting,
            frames: 0,
            kick: [0; C],
            strength: [0; F],
            rf_offset: 0,
            reading: [0; B],
            count: [0; B],
            last: [Last::NONE; B],
        }
    }

    /// Its time in the cycle [us].
    pub fn cycle_time(&self) -> u32 {
        self.setting.cycle_time
    }

    /// How many frames it has.
    pub fn frames(&self) -> u32 {
        self.frames
    }

    /// What drove the beam, on average.
    pub fn drive(&self) -> Drive<C, F> {
        Drive {
            kick: self.kick.map(|k| k as f32 / KICK),
            strength: self.strength.map(ratio),
            rf_offset: ratio(self.rf_offset),
        }
    }

    /// True if two settings are at shares of one drive: without a reference drive, and of the same corrector.
    pub fn is_kind_of(&self, other: &Self) -> bool {
        let (one, two) = (&self.setting, &other.setting);
        one == two
            || ([one.reference, two.reference] == [0; 2]
                && one.corrector == two.corrector
                && one.same_but_for_the_correctors(two))
    }

    /// The drive without the idle correctors, those of a reference drive apart.
    pub fn alone(&self) -> Drive<C, F> {
        let mut drive = self.drive();
        if self.setting.reference != 0 {
            return drive;
        }
        let powered = self.setting.corrector.map(usize::from);
        drive.kick.iter_mut().enumerate().filter(|(c, _)| Some(*c) != powered).for_each(|(_, kick)| *kick = 0.0);
        drive
    }

    /// Kick of the moved corrector over that at another setting of the kind; 1 where none is moved, or from a reference drive.
    pub fn share(&self, of: &Self) -> f32 {
        if self.setting.reference != 0 {
            return 1.0;
        }
        let kick = |cell: &Self| cell.kick.get(usize::from(cell.setting.corrector?)).copied();
        match (kick(self), kick(of)) {
            (Some(kick), Some(of)) if of != 0 => kick as f32 / of as f32,
            _ => 1.0,
        }
    }

    /// Count a frame's drive into the mean.
    pub fn add_drive(&mut self, drive: &Drive<C, F>) {
        self.frames = self.frames.saturating_add(1);
        let n = self.frames;
        self.kick.iter_mut().zip(&drive.kick).for_each(|(mean, k)| move_mean(mean, kick_steps(*k), n));
        self.strength.iter_mut().zip(&drive.strength).for_each(|(mean, s)| move_mean(mean, ratio_steps(*s), n));
        move_mean(&mut self.rf_offset, ratio_steps(drive.rf_offset), n);
    }

    /// Mean reading of a monitor [m] and the number of readings in it.
    pub fn mean(&self, b: usize) -> (f32, u32) {
        match (self.reading.get(b), self.count.get(b)) {
            (Some(&mean), Some(&count)) => (mean as f32 / READING, count.into()),
            _ => (0.0, 0),
        }
    }

    /// Distance of the last reading, moved to the mean drive, from the mean [m].
    pub fn distance(&self, b: usize) -> f32 {
        let last = self.last_code(b).map_or(0.0, |last| last as f32 * PositionCode::METRES_PER_LSB);
        last - self.mean(b).0
    }

    /// Difference of a reading, moved to the mean drive, from the last one [m].
    pub fn difference(&self, b: usize, moved: i32) -> Option<f32> {
        Some(moved.saturating_sub(self.last_code(b)?) as f32 * PositionCode::METRES_PER_LSB)
    }

    fn last_code(&self, b: usize) -> Option<i32> {
        self.last.get(b).and_then(|last| last.code())
    }

    /// So many readings of a monitor in a row wait for one that confirms them.
    pub fn waiting(&self, b: usize) -> u8 {
        self.last.get(b).map_or(0, |last| last.waiting())
    }

    /// Judge a reading, moved to the mean drive, by its repeats and what is known beside them; `sigma` is the monitor's noise [m].
    pub fn judge(&self, b: usize, moved: i32, sigma: f32, gate: Gate, beside: Beside) -> Verdict {
        let (mean, count) = self.mean(b);
        let reading = moved as f32 * PositionCode::METRES_PER_LSB;
        beside.judge(ByRepeats {
            any: count > 0,
            agrees_with_mean: gate.agree(reading, mean, sigma),
            agrees_with_last: self.difference(b, moved).is_some_and(|d| gate.agree(d, 0.0, sigma)),
            waiting: self.waiting(b),
        })
    }

    /// Take a reading in as judged; `scatter` hears of each that is counted how far it is from the mean of those before [m], and
    /// how many there are now.
    pub fn take(&mut self, b: usize, code: i32, moved: Moved, verdict: Verdict, mut scatter: impl FnMut(f32, u32)) {
        let before = self.last_code(b).unwrap_or(0);
        self.last.get_mut(b).into_iter().for_each(|last| *last = Last::new(moved.after, verdict.waiting()));
        let moved = moved.before;
        match verdict {
            Verdict::Held { .. } => {}
            Verdict::Accepted => self.add(b, code, moved, &mut scatter),
            Verdict::Confirms { outvotes } => {
                if let (true, Some(mean), Some(count)) = (outvotes, self.reading.get_mut(b), self.count.get_mut(b)) {
                    (*mean, *count) = (0, 0);
                }
                self.add(b, before, before, &mut scatter);
                self.add(b, code, moved, &mut scatter);
            }
        }
    }

    /// Count a reading into the mean.
    fn add(&mut self, b: usize, code: i32, moved: i32, scatter: &mut impl FnMut(f32, u32)) {
        let (Some(mean), Some(count)) = (self.reading.get_mut(b), self.count.get_mut(b)) else { return };
        *count = count.saturating_add(1);
        scatter(moved.saturating_sub(*mean >> FRACTION) as f32 * PositionCode::METRES_PER_LSB, (*count).into());
        move_mean(mean, code << FRACTION, (*count).into());
    }
}

/// What its repeats say of a reading.
#[derive(Debug, Clone, Copy)]
pub struct ByRepeats {
    /// There are any that count.
    pub any: bool,
    /// It agrees with their mean.
    pub agrees_with_mean: bool,
    /// It agrees with the last reading of the setting, whether that counts or waits.
    pub agrees_with_last: bool,
    /// So many in a row wait for one that confirms them, and agree with one another.
    pub waiting: u8,
}

/// What is known of a reading beside its repeats.
#[derive(Debug, Clone, Copy)]
pub struct Beside {
    /// The model, with all its uncertainty, expects it.
    pub expected: bool,
    /// It expects nearly all other readings of the frame: what is off is the monitor, and not the machine or the model.
    pub is_lone: bool,
    /// The monitor is known to jump.
    pub jumps: bool,
    /// The noise of the monitor, and so the gate, is that of enough repeats, see [`crate::Noise::is_told`].
    pub is_told: bool,
}

impl Beside {
    /// What becomes of a reading. It passes if it agrees with the mean or the last of its repeats, or, if it is the first, with the model.
    /// Otherwise it waits until [`Beside::needed`] in a row agree: they outvote the model and all earlier readings, and the last two of them
    /// count.
    pub const fn judge(self, repeats: ByRepeats) -> Verdict {
        let ByRepeats { any, agrees_with_mean, agrees_with_last, waiting } = repeats;
        let agreeing = if agrees_with_last { waiting + 1 } else { 1 };
        if (any && agrees_with_mean) || (agrees_with_last && waiting == 0) {
            Verdict::Accepted
        } else if agreeing >= self.needed(any) {
            Verdict::Confirms { outvotes: any }
        } else if !any && self.expected {
            Verdict::Accepted
        } else {
            Verdict::Held { agreeing }
        }
    }

    /// How many readings in a row that agree outvote the model, and earlier readings.
    ///
    /// Three, since two jumps of a monitor may agree by chance: of one that jumps by 1 to 9 mm in 2.5 % of its readings, two in a hundred
    /// campaigns of three repeats have such a pair. Two are enough
    /// - if the model expects them, or much of the frame is not as it expects: then the monitor is not at fault;
    /// - if only the model speaks against them, and the monitor is not known to jump;
    /// - as long as the noise of the monitor is a guess: repeats of a noisier one would hardly ever agree.
    pub const fn needed(self, against_others: bool) -> u8 {
        let is_doubtful = against_others || self.jumps;
        if !self.expected && self.is_lone && self.is_told && is_doubtful { 3 } else { 2 }
    }
}

/// What becomes of a reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It is used.
    Accepted,
    /// It is used, and so is the one that waited for it.
    Confirms {
        /// Earlier readings of the setting are dropped.
        outvotes: bool,
    },
    /// It waits for a repeat that confirms it.
    Held {
        /// So many in a row, this one included, wait and agree.
        agreeing: u8,
    },
}

impl Verdict {
    /// Consecutive readings that wait and agree.
    pub const fn waiting(self) -> u8 {
        match self {
            Self::Held { agreeing } => agreeing,
            Self::Accepted | Self::Confirms { .. } => 0,
        }
    }
}

/// All settings, at most `S`.
#[derive(Debug, Clone)]
pub struct Campaign<const B: usize, const C: usize, const F: usize, const S: usize> {
    cells: Vec<Cell<B, C, F>, S>,
}

state!([const B: usize, const C: usize, const F: usize, const S: usize] Campaign<B, C, F, S> { cells });

impl<const B: usize, const C: usize, const F: usize, const S: usize> Campaign<B, C, F, S> {
    /// Nothing so far.
    pub const BLANK: Self = Self { cells: Vec::new() };

    /// Forget all settings.
    pub fn clear(&mut self) {
        self.cells.clear();
    }

    /// The settings so far.
    pub fn cells(&self) -> &[Cell<B, C, F>] {
        &self.cells
    }

    /// One setting.
    pub fn cell_mut(&mut self, index: u16) -> Option<&mut Cell<B, C, F>> {
        self.cells.get_mut(usize::from(index))
    }

    /// Take out a setting of another reference drive than this, if there is no room for a new one.
    pub fn retire(&mut self, reference: u16) -> Option<Cell<B, C, F>> {
        let former = self.cells.iter().position(|cell| cell.setting.reference != reference);
        let at = former.filter(|_| self.cells.is_full())?;
        let last = self.cells.pop()?;
        Some(match self.cells.get_mut(at) {
            Some(cell) => core::mem::replace(cell, last),
            None => last,
        })
    }

    /// Index of a setting, which is stored if it is new; none if there is no room.
    pub fn find(&mut self, setting: &Setting) -> Option<u16> {
        let known = self.cells.iter().position(|cell| cell.setting.repeats(setting));
        let index = known.or_else(|| {
            self.cells.push(Cell::open(*setting)).ok()?;
            Some(self.cells.len() - 1)
        })?;
        u16::try_from(index).ok()
    }

    /// The monitors have moved by so much [m]: their readings so far move with them.
    pub fn move_readings(&mut self, shift: &[f32; B]) {
        const LIMIT: i32 = PositionCode::LIMIT << FRACTION;
        for cell in &mut self.cells {
            for (b, by) in shift.iter().enumerate() {
                let steps = libm::roundf(by / PositionCode::METRES_PER_LSB) as i32;
                if let (Some(mean), Some(last)) = (cell.reading.get_mut(b), cell.last.get_mut(b)) {
                    *mean = mean.saturating_add(steps.saturating_mul(1 << FRACTION)).clamp(-LIMIT, LIMIT);
                    *last = last.moved(steps);
                }
            }
        }
    }

    /// Mean strength over all frames: where the supplies really stand.
    pub fn mean_strength(&self) -> [f32; F] {
        let (mut sum, mut frames) = ([0.0; F], 0.0);
        for cell in &self.cells {
            let n = cell.frames as f32;
            sum.iter_mut().zip(&cell.strength).for_each(|(sum, s)| *sum += n * ratio(*s));
            frames += n;
        }
        if frames > 0.0 { sum.map(|s| s / frames) } else { sum }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REST: Setting =
        Setting { reference: 0, corrector: None, kick: 0, tolerance: 0, rf_offset: 0, cycle_time: 92_000 };

    fn kicked(corrector: u16, kick: f32) -> Setting {
        REST.with(corrector, kick, 2e-6)
    }

    #[test]
    fn settings_are_told_apart_by_reference_corrector_kick_rf_and_time() {
        let up = kicked(3, 2e-4);
        assert!(up.repeats(&kicked(3, 1.9e-4)) && kicked(3, 3e-6).repeats(&kicked(3, 1.5e-6)));
        for other in [
            kicked(4, 2e-4),
            kicked(3, -2e-4),
            kicked(3, 1e-4),
            REST,
            Setting { reference: 1, ..up },
            Setting { rf_offset: 200_000, ..up },
            Setting { cycle_time: 60_000, ..up },
        ] {
            assert!(!up.repeats(&other), "{other:?}");
        }
        assert!(!kicked(3, 3e-6).repeats(&kicked(3, -1e-6)));
    }

    #[test]
    fn a_full_table_says_so() {
        let mut campaign = Campaign::<1, 1, 1, 2>::BLANK;
        assert_eq!(campaign.find(&REST), Some(0));
        assert_eq!(campaign.find(&kicked(0, 5e-5)), Some(1));
        assert_eq!(campaign.find(&kicked(0, -5e-5)), None);
        assert_eq!(campaign.find(&kicked(0, 5.01e-5)), Some(1));
    }

    #[test]
    fn means_and_scatter_are_those_of_the_readings() {
        let mut cell = Cell::<1, 1, 1>::open(REST);
        let codes = [1000, -2000, 4000, 500, 900];
        let mut scatter = 0.0;
        for code in codes {
            // the squared distance from the mean grows the sum of squared deviations by (n - 1)/n
            cell.take(0, code, Moved { before: code, after: code }, Verdict::Accepted, |d, n| {
                scatter += d * d * (n as f32 - 1.0) / n as f32
            });
        }
        let mean = codes.iter().sum::<i32>() as f32 / 5.0;
        assert_eq!(cell.mean(0).1, 5);
        assert!((cell.mean(0).0 / 1e-7 - mean).abs() < 0.01);
        let direct: f32 = codes.iter().map(|&c| (c as f32 - mean) * (c as f32 - mean)).sum();
        assert!((scatter / 1e-14 / direct - 1.0).abs() < 1e-3, "{scatter} {direct}"); // whole steps
    }

    const WAITS: Verdict = Verdict::Held { agreeing: 1 };
    const WAITS_TOO: Verdict = Verdict::Held { agreeing: 2 };
    /// A monitor in a frame that the model expects but for it, of which nothing bad is known.
    const SOUND: Beside = Beside { expected: false, is_lone: true, jumps: false, is_told: true };
    const JUMPS: Beside = Beside { jumps: true, ..SOUND };

    /// What readings of 0.15 mm noise become beside the repeats of their setting, the model expecting each of them or not.
    fn assert_story(beside: Beside, story: &[(i32, bool, Verdict)]) {
        let mut cell = Cell::<1, 1, 1>::open(REST);
        for &(code, expected, verdict) in story {
            let judged = cell.judge(0, code, 1.5e-4, Gate::default(), Beside { expected, ..beside });
            assert_eq!(judged, verdict, "{code} in {story:?}");
            cell.take(0, code, Moved { before: code, after: code }, judged, |_, _| ());
        }
    }

    #[test]
    fn repeats_outvote_the_model_and_single_jumps() {
        use Verdict::{Accepted, Confirms};
        let stories: [&[(i32, bool, Verdict)]; 5] = [
            // repeats of what the model expects; a jump; back again
            &[(0, true, Accepted), (900, true, Accepted), (40_000, true, WAITS), (-700, true, Accepted)],
            // the model is wrong: the repeat confirms
            &[(40_000, false, WAITS), (40_900, false, Confirms { outvotes: false }), (40_100, false, Accepted)],
            // a jump comes first, when the model still expects anything
            &[
                (40_000, true, Accepted),
                (0, true, WAITS),
                (500, true, Confirms { outvotes: true }),
                (40_000, true, WAITS),
            ],
            // an unconfirmed reading outside the gate gives way to an expected one
            &[(40_000, false, WAITS), (0, true, Accepted), (500, true, Accepted)],
            // the monitor's place has changed: the third reading tells
            &[
                (0, true, Accepted),
                (500, true, Accepted),
                (40_000, false, WAITS),
                (40_500, false, WAITS_TOO),
                (40_200, false, Confirms { outvotes: true }),
                (40_100, false, Accepted),
            ],
        ];
        stories.into_iter().for_each(|story| assert_story(SOUND, story));
    }

    /// Where much of the frame is unexpected, the machine has changed, and where the noise is a guess, nobody knows what agrees.
    #[test]
    fn two_readings_are_enough_where_the_monitor_is_not_at_fault() {
        use Verdict::{Accepted, Confirms};
        for beside in [Beside { is_lone: false, ..JUMPS }, Beside { is_told: false, ..JUMPS }] {
            let outvotes = Confirms { outvotes: true };
            assert_story(beside, &[(0, true, Accepted), (40_000, false, WAITS), (40_500, false, outvotes)]);
            assert_story(beside, &[(40_000, false, WAITS), (40_500, false, Confirms { outvotes: false })]);
        }
    }

    #[test]
    fn two_jumps_that_agree_outvote_no_good_reading() {
        use Verdict::{Accepted, Confirms};
        let jumps = [(0, true, Accepted), (-72_000, false, WAITS), (-78_000, false, WAITS_TOO), (300, true, Accepted)];
        assert_story(SOUND, &jumps);
        // nor what the model expects of a monitor that is known to jump
        let first = [(-72_000, false, WAITS), (-78_000, false, WAITS_TOO), (0, true, Accepted), (300, true, Accepted)];
        assert_story(JUMPS, &first);
        // three are believed
        let third = Confirms { outvotes: false };
        assert_story(JUMPS, &[(-72_000, false, WAITS), (-78_000, false, WAITS_TOO), (-75_000, false, third)]);
        // those that wait and do not agree count anew
        let anew = [(-72_000, false, WAITS), (50_000, false, WAITS), (51_000, false, WAITS_TOO), (0, true, Accepted)];
        assert_story(JUMPS, &anew);
    }

    #[test]
    fn means_hold_for_a_year() {
        // a setting of a 10 Hz machine with 100 settings gets 3 million frames a year
        let (mut mean, mut exact) = (0, 0_i64);
        let mut state = 1_u32;
        let n = 3_000_000;
        for i in 1..=n {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let code = 50_000 + (state >> 20) as i32 - 2_048; // noise of 1200 steps
            exact += i64::from(code);
            move_mean(&mut mean, code << FRACTION, i);
        }
        let error = mean as f64 / 1024.0 - exact as f64 / f64::from(n);
        assert!(error.abs() < 1.0, "{error} steps of 0.1 um");
    }
}
