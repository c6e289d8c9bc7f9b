//! Frames that were put aside because too many readings surprised at once: what they have in common.
//!
//! Monitors fail one at a time. When many readings surprise, the beam was lost, or the baselines have moved, or the model is at
//! fault. Moved baselines leave every reading off by the same amount whatever the correctors do; a beam that is not there
//! leaves the readings where they are.

use crate::state::state;

/// Frames that must agree before the baselines have moved.
const ENOUGH: u32 = 10;
/// Frames in a row after which the model is at fault, and not the beam.
const PERSISTS: u32 = 30;
/// Scatter over noise, in variance, up to which a monitor's surprises are one and the same: 99.9 % of those of ten frames.
const SAME: f32 = 3.0;
/// Factor by which the readings must scatter more than the surprises, in variance, to tell a moved baseline from a lost beam.
const FOLLOWS: f32 = 2.0;

/// Mean of some numbers, and the sum of their squared deviations from it.
#[derive(Debug, Clone, Copy)]
struct Spread {
    mean: f32,
    squares: f32,
}

state!([] Spread { mean, squares });

impl Spread {
    const NONE: Self = Self { mean: 0.0, squares: 0.0 };

    /// Count the `n`-th number. Source: B. P. Welford, Technometrics 4 (1962) 419.
    fn add(&mut self, value: f32, n: f32) {
        let step = value - self.mean;
        self.mean += step / n;
        self.squares += step * (value - self.mean);
    }
}

/// What a monitor has said in the frames put aside.
#[derive(Debug, Clone, Copy)]
struct Said {
    number: u32,
    /// Measured minus expected [m].
    surprise: Spread,
    reading: Spread,
}

state!([] Said { number, surprise, reading });

/// How far a baseline has moved.
#[derive(Debug, Clone, Copy)]
pub struct Shift {
    /// By so much [m].
    pub by: f32,
    /// What is not known of it [m^2].
    pub variance: f32,
}

impl Shift {
    /// Somewhere within the beam pipe.
    const UNKNOWN: Self = Self { by: 0.0, variance: 4e-4 };
}

/// The frames put aside in a row, of `B` monitors.
#[derive(Debug, Clone)]
pub struct Quarantine<const B: usize> {
    frames: u32,
    said: [Said; B],
}

state!([const B: usize] Quarantine<B> { frames, said });

impl<const B: usize> Quarantine<B> {
    /// None.
    pub const EMPTY: Self =
        Self { frames: 0, said: [Said { number: 0, surprise: Spread::NONE, reading: Spread::NONE }; B] };

    /// A good frame has come.
    pub fn clear(&mut self) {
        if self.frames > 0 {
            *self = Self::EMPTY;
        }
    }

    /// Put a frame aside.
    pub fn add(&mut self) {
        self.frames = self.frames.saturating_add(1);
    }

    /// What a monitor said in it: its surprise, and its reading [m].
    pub fn note(&mut self, b: usize, surprise: f32, reading: f32) {
        let Some(said) = self.said.get_mut(b) else { return };
        said.number = said.number.saturating_add(1);
        said.surprise.add(surprise, said.number as f32);
        said.reading.add(reading, said.number as f32);
    }

    /// So many in a row that the model is at fault.
    pub fn persists(&self) -> bool {
        self.frames > PERSISTS
    }

    /// How far each baseline has moved, if that explains all frames put aside; `variance` is that of a surprise.
    ///
    /// Three quarters of the monitors must be off by the same in all frames, while their readings have followed the
    /// correctors. Of the others nobody knows by how much.
    pub fn shift(&self, variance: impl Fn(usize) -> f32) -> Option<[Shift; B]> {
        if self.frames < ENOUGH {
            return None;
        }
        let (mut heard, mut steady, mut surprises, mut readings) = (0, 0, 0.0, 0.0);
        let mut shift = [Shift::UNKNOWN; B];
        let each = self.said.iter().zip(&mut shift).enumerate();
        for (b, (said, shift)) in each.filter(|(_, (said, _))| said.number >= ENOUGH) {
            heard += 1;
            let (allowed, variance) = (SAME * (said.number - 1) as f32, variance(b));
            if said.surprise.squares <= allowed * variance {
                steady += 1;
                surprises += said.surprise.squares / variance;
                readings += said.reading.squares / variance;
                *shift = Shift { by: said.surprise.mean, variance: variance / said.number as f32 };
            }
        }
        let explained = heard > 0 && 4 * steady >= 3 * heard && readings >= FOLLOWS * surprises;
        explained.then_some(shift)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOISE: f32 = 1e-4;

    /// So many frames of a machine whose correctors move the orbit by `orbit`; a monitor reads this of the orbit and of its noise.
    fn quarantine(frames: u32, orbit: f32, reads: impl Fn(usize, f32, f32) -> f32) -> Quarantine<8> {
        let mut quarantine = Quarantine::EMPTY;
        for i in 0..frames {
            quarantine.add();
            for b in 0..8 {
                let t = (8 * i) as f32 + b as f32;
                let (orbit, noise) = (orbit * libm::sinf(1.3 * t), 1.4 * NOISE * libm::sinf(12.9 * t * t));
                let reading = reads(b, orbit, noise);
                quarantine.note(b, reading - orbit, reading);
            }
        }
        quarantine
    }

    fn shift(quarantine: &Quarantine<8>) -> Option<[Shift; 8]> {
        quarantine.shift(|_| NOISE * NOISE)
    }

    #[test]
    fn baselines_that_moved_are_told_from_a_beam_that_is_lost() {
        let moved = |b: usize, orbit: f32, noise: f32| orbit + noise + 1e-3 * (b as f32 - 3.0);
        let found = shift(&quarantine(10, 1e-3, moved)).unwrap();
        for (b, shift) in found.iter().enumerate() {
            assert!((shift.by - 1e-3 * (b as f32 - 3.0)).abs() < NOISE);
            assert_eq!(shift.variance, NOISE * NOISE / 10.0);
        }
        assert!(shift(&quarantine(9, 1e-3, moved)).is_none());
        // one monitor jumps besides
        let jumps = |b: usize, orbit: f32, noise: f32| moved(b, orbit, if b == 2 { 50.0 * noise } else { noise });
        let found = shift(&quarantine(10, 1e-3, jumps)).unwrap();
        assert_eq!((found[2].by, found[2].variance), (0.0, Shift::UNKNOWN.variance));
        assert!(found[3].by.abs() < NOISE && (found[7].by - 4e-3).abs() < NOISE);
        // readings of no beam: their noise about 0, or nothing at all, or anything
        assert!(shift(&quarantine(20, 1e-3, |_, _, noise| noise)).is_none());
        assert!(shift(&quarantine(20, 1e-3, |_, _, _| 0.0)).is_none());
        assert!(shift(&quarantine(20, 1e-3, |_, _, noise| 50.0 * noise)).is_none());
        // correctors that stand still do not tell
        assert!(shift(&quarantine(20, 0.0, moved)).is_none());
    }

    #[test]
    fn a_good_frame_ends_it() {
        let mut quarantine = quarantine(31, 1e-3, |_, _, noise| noise);
        assert!(quarantine.persists());
        quarantine.clear();
        assert!(!quarantine.persists() && quarantine.said.iter().all(|said| said.number == 0));
    }
}
