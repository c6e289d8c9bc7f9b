//! What changes along the ramp: momentum and nominal currents at a few times in the cycle, all over those at the reference
//! momentum, and linear in between.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::beyond::Beyond;

/// Most times that a ramp is given at.
pub const RAMP_POINTS: usize = 8;
/// Most times in the cycle at which one core keeps baselines.
pub(crate) const TIMES: usize = 4;
/// Times this close are one [us].
pub const SAME_TIME: u32 = 1_000;

/// True for times in the cycle that count as one [us].
pub(crate) fn is_same_time(one: u32, other: u32) -> bool {
    one.abs_diff(other) <= SAME_TIME
}

/// The machine at one time in the cycle: what it would have at the reference momentum is 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RampPoint<const F: usize> {
    /// Time in the cycle [us].
    pub time_us: u32,
    /// Momentum.
    pub momentum: f32,
    /// Nominal current of the dipoles.
    pub dipole: f32,
    /// Slip factor `alpha_c - 1/gamma^2`.
    pub slip: f32,
    /// Gradients of each supply's quadrupoles at which they have their design strengths.
    pub gradient: Vec<f32, F>,
}

/// A ramp, its times rising; one of no points is a machine that is only looked at where it has its reference momentum.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Ramp<const F: usize> {
    /// At least two, or none.
    pub points: Vec<RampPoint<F>, RAMP_POINTS>,
}

/// The machine at the time of a frame, over that at the reference momentum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct At<const F: usize> {
    /// Momentum.
    pub momentum: f32,
    /// Nominal current of the dipoles.
    pub dipole: f32,
    /// Slip factor.
    pub slip: f32,
    /// Gradients of each supply's quadrupoles.
    pub gradient: [f32; F],
}

impl<const F: usize> RampPoint<F> {
    fn is_sound(&self) -> bool {
        let is_positive = |v: &f32| v.is_finite() && *v > 0.0;
        [self.momentum, self.dipole].iter().all(is_positive)
            && self.slip.is_finite()
            && self.gradient.is_full()
            && self.gradient.iter().all(is_positive)
    }

    /// The machine a share of the way to the next point.
    fn towards(&self, next: &Self, share: f32) -> At<F> {
        let between = |from: f32, to: f32| from + share * (to - from);
        let mut gradient = [1.0; F];
        for (to, (from, next)) in gradient.iter_mut().zip(self.gradient.iter().zip(&next.gradient)) {
            *to = between(*from, *next);
        }
        At {
            momentum: between(self.momentum, next.momentum),
            dipole: between(self.dipole, next.dipole),
            slip: between(self.slip, next.slip),
            gradient,
        }
    }
}

impl<const F: usize> Ramp<F> {
    /// None: the machine has its reference momentum whenever it is looked at.
    pub const NONE: Self = Self { points: Vec::new() };

    /// True if there is one.
    pub fn is_given(&self) -> bool {
        !self.points.is_empty()
    }

    /// True if its times rise, its numbers are positive, and there are at least two points or none.
    pub fn is_sound(&self) -> bool {
        let rises = |pair: &[RampPoint<F>]| matches!(pair, [one, next] if one.time_us < next.time_us);
        self.points.len() != 1 && self.points.iter().all(RampPoint::is_sound) && self.points.windows(2).all(rises)
    }

    /// The machine at a time in the cycle [us].
    ///
    /// # Errors
    /// [`Beyond`] before the first point and after the last.
    pub fn at(&self, time_us: u32) -> Result<At<F>, Beyond> {
        let (Some(first), Some(last)) = (self.points.first(), self.points.last()) else { return Ok(At::REFERENCE) };
        for pair in self.points.windows(2) {
            let [one, next] = pair else { continue };
            if (one.time_us..=next.time_us).contains(&time_us) {
                let share = (time_us - one.time_us) as f32 / (next.time_us - one.time_us) as f32;
                return Ok(one.towards(next, share));
            }
        }
        let end = if time_us < first.time_us { first } else { last };
        Err(Beyond { what: "time in the cycle in ms", limit: milliseconds(end.time_us), got: milliseconds(time_us) })
    }
}

impl<const F: usize> At<F> {
    /// At the reference momentum.
    pub const REFERENCE: Self = Self { momentum: 1.0, dipole: 1.0, slip: 1.0, gradient: [1.0; F] };
}

/// A time in ms, of so many us.
pub(crate) fn milliseconds(time_us: u32) -> f32 {
    time_us as f32 / 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(time_us: u32, momentum: f32) -> RampPoint<2> {
        let gradient = Vec::from_slice(&[momentum, 1.1 * momentum]).unwrap();
        RampPoint { time_us, momentum, dipole: 0.9 * momentum, slip: 2.0 - momentum, gradient }
    }

    fn ramp(points: &[RampPoint<2>]) -> Ramp<2> {
        Ramp { points: Vec::from_slice(points).unwrap() }
    }

    #[test]
    fn between_two_times_all_is_linear() {
        let ramp = ramp(&[point(50_000, 0.4), point(70_000, 0.8), point(110_000, 1.0)]);
        assert!(ramp.is_sound() && ramp.is_given());
        let at = ramp.at(60_000).unwrap();
        let expected = [0.6, 0.54, 1.4, 0.6, 0.66];
        let found = [at.momentum, at.dipole, at.slip, at.gradient[0], at.gradient[1]];
        assert!(found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-6), "{at:?}");
        assert_eq!(ramp.at(70_000).unwrap().momentum, 0.8);
        assert_eq!(ramp.at(110_000).unwrap().momentum, 1.0);
    }

    #[test]
    fn it_ends_where_its_times_do() {
        let ramp = ramp(&[point(50_000, 0.4), point(110_000, 1.0)]);
        let beyond = |limit, got| Err(Beyond { what: "time in the cycle in ms", limit, got });
        assert_eq!((ramp.at(49_999), ramp.at(110_500)), (beyond(50.0, 49.999), beyond(110.0, 110.5)));
        assert_eq!(Ramp::<2>::NONE.at(49_999), Ok(At::REFERENCE));
    }

    #[test]
    fn what_does_not_rise_or_is_not_positive_is_not_sound() {
        let (one, next) = (point(50_000, 0.4), point(60_000, 0.5));
        assert!(ramp(&[]).is_sound() && ramp(&[one.clone(), next.clone()]).is_sound());
        let bad = [
            ramp(core::slice::from_ref(&one)),
            ramp(&[next.clone(), one.clone()]),
            ramp(&[one.clone(), one.clone()]),
            ramp(&[one.clone(), RampPoint { momentum: 0.0, ..next.clone() }]),
            ramp(&[one.clone(), RampPoint { dipole: f32::NAN, ..next.clone() }]),
            ramp(&[one.clone(), RampPoint { slip: f32::INFINITY, ..next.clone() }]),
            ramp(&[one, RampPoint { gradient: Vec::new(), ..next }]),
        ];
        assert!(bad.iter().all(|ramp| !ramp.is_sound()));
    }
}
