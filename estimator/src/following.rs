//! How the baseline of a monitor follows the supplies.
//!
//! Misaligned quadrupoles make a closed orbit, and the ripple of their supplies moves it, by 10 to 20 um a frame in the Booster; which
//! way, only the unknown misalignments could tell. Repeats of a setting tell it as they tell the noise, without the model: within
//! a setting, `reading - mean = u . (s - mean s) + noise`, `s` being `ln` of the supplies' factors. With a normal prior of mean 0 for
//! each `u_f`, the best `u` solves `(A + v/p) u = c`; `A` and `c` are sums over repeats of `s s^T` and `s reading` about their means,
//! `v` is the variance of a reading and `p_f` that of the prior.
//!
//! Each frame takes one Gauss-Seidel sweep of these equations. Ripples of different supplies are all but independent, so that a
//! sweep leaves a small part of an error which is itself a small part of the noise.

use crate::state::state;

/// What repeats have shown of one monitor: the scatter, and how its baseline follows `F` supplies.
#[derive(Debug, Clone, Copy)]
pub struct Following<const F: usize> {
    /// Repeats of settings, the first one of each not counted.
    pub repeats: u32,
    /// Sum of squared deviations of repeats from their means [m^2].
    scatter: f64,
    /// Sums of products of the deviations of `ln` of the supplies' factors, `A`.
    ripple: [[f64; F]; F],
    /// Sums of these deviations times those of the readings, `c` [m].
    along: [f64; F],
    /// Change of the baseline per `ln` of each supply's factor, `u` [m].
    slope: [f32; F],
}

state!([const F: usize] Following<F> { repeats, scatter, ripple, along, slope });

/// What is known beforehand: the standard deviation of each `u` [m], and the variance of a reading [m^2].
#[derive(Debug, Clone, Copy)]
pub struct Expected<const F: usize> {
    /// Standard deviations.
    pub sigma: [f32; F],
    /// Variance of a reading about its baseline.
    pub variance: f32,
}

impl<const F: usize> Expected<F> {
    /// Weight of the prior beside the sums: variance of a reading over that of the slope; infinite where nothing follows.
    fn weight(&self, f: usize) -> f64 {
        let sigma = f64::from(self.sigma.get(f).copied().unwrap_or(0.0));
        f64::from(self.variance) / (sigma * sigma)
    }
}

impl<const F: usize> Following<F> {
    /// No repeats so far: it does not follow.
    pub const NONE: Self = Self { repeats: 0, scatter: 0.0, ripple: [[0.0; F]; F], along: [0.0; F], slope: [0.0; F] };

    /// Count the `n`-th repeat in a setting. `off_mean`: `ln` of the supplies' factors, off their mean with this one; `deviation`: the
    /// reading, moved to that mean by what is known so far, off the mean of those before [m].
    ///
    /// Returns the growth of the sum of squared deviations, as known so far [m^2].
    ///
    /// A mean of those before is `n/(n - 1)` times as far as that with this one, and a deviation from it counts `(n - 1)/n` times.
    pub fn add_repeat(&mut self, deviation: f32, off_mean: &[f32; F], n: u32) -> f64 {
        if n < 2 {
            return 0.0;
        }
        let n = f64::from(n);
        let growth = (n - 1.0) / n * f64::from(deviation) * f64::from(deviation);
        let deviation = f64::from(deviation + self.shift(off_mean));
        self.repeats = self.repeats.saturating_add(1);
        self.scatter += (n - 1.0) / n * deviation * deviation;
        for ((row, along), s) in self.ripple.iter_mut().zip(&mut self.along).zip(off_mean) {
            *along += f64::from(*s) * deviation;
            let s = n / (n - 1.0) * f64::from(*s);
            row.iter_mut().zip(off_mean).for_each(|(sum, other)| *sum += s * f64::from(*other));
        }
        growth
    }

    /// Learn: one sweep towards the best slopes.
    pub fn learn(&mut self, expected: &Expected<F>) {
        for (f, (row, along)) in self.ripple.iter().zip(&self.along).enumerate() {
            let own = row.get(f).copied().unwrap_or(0.0);
            let others: f64 = row.iter().zip(&self.slope).map(|(sum, slope)| sum * f64::from(*slope)).sum();
            if let Some(slope) = self.slope.get_mut(f) {
                let pull = along - others + own * f64::from(*slope);
                *slope = (pull / (own + expected.weight(f))) as f32;
                if !slope.is_finite() {
                    *slope = 0.0; // neither repeats nor a prior
                }
            }
        }
    }

    /// By how much the baseline is off its mean at `ln` of the supplies' factors [m].
    pub fn shift(&self, strength: &[f32; F]) -> f32 {
        self.slope.iter().zip(strength).map(|(slope, s)| slope * s).sum()
    }

    /// Variance of that [m^2].
    pub fn variance(&self, strength: &[f32; F], expected: &Expected<F>) -> f32 {
        let term = |(f, (row, s)): (usize, (&[f64; F], &f32))| {
            let known = row.get(f).copied().unwrap_or(0.0) + expected.weight(f);
            if known > 0.0 { expected.variance * (f64::from(s * s) / known) as f32 } else { 0.0 }
        };
        self.ripple.iter().zip(strength).enumerate().map(term).sum()
    }

    /// Chi-square of the repeats about their settings' means, what the slopes cost included: on average one a repeat, less one
    /// a setting.
    pub fn chi_square(&self, expected: &Expected<F>) -> f64 {
        let slope = self.slope.map(f64::from);
        let mut sum = self.scatter;
        for (f, ((row, along), u)) in self.ripple.iter().zip(&self.along).zip(&slope).enumerate() {
            let image: f64 = row.iter().zip(&slope).map(|(sum, slope)| sum * slope).sum();
            let prior = if *u == 0.0 { 0.0 } else { expected.weight(f) * u };
            sum += u * (image + prior - 2.0 * along);
        }
        sum / f64::from(expected.variance)
    }

    /// `ln` of the product of prior over posterior variance of the slopes: what the evidence pays for them, twice.
    pub fn volume(&self, expected: &Expected<F>) -> f64 {
        let term = |(f, row): (usize, &[f64; F])| libm::log1p(row.get(f).copied().unwrap_or(0.0) / expected.weight(f));
        self.ripple.iter().enumerate().map(term).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Anything in ±1, by the bits of a sine.
    fn any(i: u32) -> f32 {
        let hashed = 43_758.547 * libm::sin(12.9898 * f64::from(i) + 0.1);
        (2.0 * (hashed - libm::floor(hashed)) - 1.0) as f32
    }

    const NOISE: f32 = 1.5e-4;
    const EXPECTED: Expected<2> = Expected { sigma: [0.08, 0.04], variance: NOISE * NOISE / 3.0 };
    const TRUE: [f32; 2] = [0.07, -0.03];

    /// So many repeats of one setting.
    fn following(repeats: u32) -> Following<2> {
        let mut following = Following::NONE;
        let (mut mean, mut at) = (0.0, [0.0; 2]);
        for i in 0..repeats {
            let strength = [3e-4 * any(3 * i), 3e-4 * any(3 * i + 1)];
            let reading = 2e-3 + TRUE[0] * strength[0] + TRUE[1] * strength[1] + NOISE * any(3 * i + 2);
            let n = i as f32 + 1.0;
            (0..2).for_each(|f| at[f] += (strength[f] - at[f]) / n);
            let off_mean = [strength[0] - at[0], strength[1] - at[1]];
            // as the core does: moved to the mean drive by what is known
            following.add_repeat(reading - following.shift(&off_mean) - mean, &off_mean, i + 1);
            mean += (reading - mean) / n;
            following.learn(&EXPECTED);
        }
        following
    }

    #[test]
    fn repeats_tell_how_it_follows() {
        let following = following(4000);
        for (slope, expected) in following.slope.iter().zip(TRUE) {
            // noise over ripple, of 4000 repeats: 0.0045 m; three of them
            assert!((slope - expected).abs() < 0.015, "{slope} {expected}");
        }
        // one a repeat: sqrt(2/4000) for normal noise, less for this
        let chi_square = following.chi_square(&EXPECTED) / 3999.0;
        assert!((chi_square - 1.0).abs() < 0.05, "{chi_square}");
        let without = following.scatter / f64::from(EXPECTED.variance) / 3999.0;
        assert!(without > 1.02, "{without}");
    }

    /// The sum of squares about the best slopes, and the determinant, by brute force.
    #[test]
    fn its_chi_square_is_the_smallest() {
        let mut following = following(50);
        (0..100).for_each(|_| following.learn(&EXPECTED));
        let best = following.chi_square(&EXPECTED);
        for f in 0..2 {
            for step in [-1e-3, 1e-3] {
                let mut other = following;
                other.slope[f] += step;
                assert!(other.chi_square(&EXPECTED) > best);
            }
        }
        let variance = following.variance(&[1e-4, 0.0], &EXPECTED);
        let shrunk = (variance / (1e-4 * EXPECTED.sigma[0]).powi(2)).ln();
        let only = Following { ripple: [[following.ripple[0][0], 0.0], [0.0; 2]], ..following };
        assert!((f64::from(shrunk) + only.volume(&EXPECTED)).abs() < 1e-3);
    }

    #[test]
    fn what_does_not_follow_stays() {
        let mut following = following(10);
        let none = Expected { sigma: [0.0; 2], ..EXPECTED };
        following.learn(&none);
        assert_eq!((following.slope, following.variance(&[1e-3; 2], &none)), ([0.0; 2], 0.0));
        assert_eq!(following.volume(&none), 0.0);
        assert_eq!(following.chi_square(&none), following.scatter / f64::from(none.variance));
    }
}
