//! The correctors' supplies: where they are, where they are to be, and whether they follow.

use crate::drive::Each;
use crate::wire::CurrentCode;

/// Frames in which a supply has not moved half of the way before it is left out.
const MISSED: u8 = 5;
/// Frames in which it must be at its setpoint before it counts again.
const MENDED: u8 = 10;

/// The supplies of `C` correctors.
#[derive(Debug, Clone)]
pub struct Supplies<const C: usize> {
    setpoint: [CurrentCode; C],
    read_back: [CurrentCode; C],
    /// Frames missed in a row; above [`MISSED`] it is left out, until each frame at the setpoint has taken one off.
    missed: [u8; C],
}

impl<const C: usize> Supplies<C> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { setpoint: [ZERO; C], read_back: [ZERO; C], missed: [0; C] };

    /// Setpoints are where the supplies are; all of them count.
    pub fn take_over(&mut self, read_back: &[CurrentCode; C]) {
        *self = Self { setpoint: *read_back, read_back: *read_back, missed: [0; C] };
    }

    /// Where they are to be.
    pub fn setpoints(&self) -> &[CurrentCode; C] {
        &self.setpoint
    }

    /// True for one that counts.
    pub fn follows(&self, c: usize) -> bool {
        self.missed.get(c).is_some_and(|missed| *missed < MISSED)
    }

    /// Number of those that do not.
    pub fn left_out(&self) -> u16 {
        self.missed.iter().map(|missed| u16::from(*missed >= MISSED)).sum()
    }

    /// Take new read-backs; returns how far each has moved [A], and whether one is left out or counts again since.
    ///
    /// A supply is missed in a frame that finds it further than `close` from its setpoint, and less than half of the way nearer. One that
    /// is not used is moved by others: its setpoint is where it is.
    pub fn hear(&mut self, read_back: &[CurrentCode; C], close: f32, uses: impl Fn(usize) -> bool) -> ([f32; C], bool) {
        let (mut done, left_out) = ([0.0; C], self.left_out());
        let each = self.setpoint.iter_mut().zip(&mut self.read_back).zip(&mut self.missed).enumerate();
        for ((c, ((setpoint, before), missed)), (now, done)) in each.zip(read_back.iter().zip(&mut done)) {
            if !uses(c) {
                *setpoint = *now;
            }
            let [gap_before, gap] = [*before, *now].map(|at| (setpoint.value() - at.value()).abs());
            *missed = match gap > close {
                true if 2.0 * gap > gap_before => missed_once_more(*missed),
                true => *missed,
                false => missed.saturating_sub(1),
            };
            *done = now.value() - before.value();
            *before = *now;
        }
        (done, left_out != self.left_out())
    }

    /// How far each still has to go [A]: 0 for one that is close, or is left out.
    pub fn under_way(&self, close: f32) -> [f32; C] {
        let mut way = [0.0; C];
        let each = self.setpoint.iter().zip(&self.read_back).zip(&self.missed);
        for (way, ((setpoint, at), missed)) in way.iter_mut().zip(each) {
            let gap = setpoint.value() - at.value();
            *way = if gap.abs() > close && *missed < MISSED { gap } else { 0.0 };
        }
        way
    }

    /// Move each setpoint by so much one way or the other [A], as the `n`-th of a sequence of patterns; 0 is none. The same
    /// pattern takes it back; one that the limit has cut, because it began too far out, ends further in.
    #[inline(never)]
    pub fn probe(&mut self, size: f32, n: u32, limit: &Each<C>) {
        for (c, setpoint) in self.setpoint.iter_mut().enumerate().filter(|_| n != 0) {
            if limit.of(c) <= 0.0 {
                continue; // it is not used
            }
            let room = (limit.of(c) - setpoint.value().abs()).max(0.0);
            let by = size * sign(n, c as u32);
            let outward = by * setpoint.value() > 0.0;
            *setpoint = moved(*setpoint, if outward { by.min(room).max(-room) } else { by });
        }
    }

    /// Move the setpoints [A], none of them further out than its limit, or than it is already; returns how many are at their limit.
    pub fn change(&mut self, by: &[f32; C], limit: impl Fn(usize) -> f32) -> u16 {
        let mut limited = 0;
        for (c, (setpoint, by)) in self.setpoint.iter_mut().zip(by).enumerate() {
            let (limit, at) = (limit(c), setpoint.value());
            let edge = limit.max(at.abs());
            *setpoint = moved(*setpoint, by.min(edge - at).max(-edge - at));
            limited += u16::from(limit > 0.0 && setpoint.steps().abs() >= moved(ZERO, limit).steps());
        }
        limited
    }
}

const ZERO: CurrentCode = match CurrentCode::try_new(0) {
    Some(zero) => zero,
    None => panic!("0 A is a current"),
};

/// One frame more, and those that it takes to mend once it is left out.
fn missed_once_more(missed: u8) -> u8 {
    if missed + 1 < MISSED { missed + 1 } else { MISSED + MENDED }
}

/// A current moved by so much [A].
fn moved(current: CurrentCode, by: f32) -> CurrentCode {
    CurrentCode::nearest(f64::from(current.value() + by)).unwrap_or(current)
}

/// 1 or -1, as if at random: a bit of the `n`-th number of a sequence, for each of many correctors.
///
/// Source: G. Steele, D. Lea and C. Flood, Fast splittable pseudorandom number generators, OOPSLA 2014 (the mixing function).
fn sign(n: u32, c: u32) -> f32 {
    let mixed = (n.wrapping_mul(0x9e37_79b9) ^ c.wrapping_mul(0x85eb_ca6b)).wrapping_mul(0xc2b2_ae35);
    let mixed = (mixed ^ mixed >> 15).wrapping_mul(0x85eb_ca6b);
    if (mixed ^ mixed >> 13) & 1 == 0 { 1.0 } else { -1.0 }
}
