//! Whether the orbit moves faster than it is expected to walk.
//!
//! The filter's innovations, squared over their variances, have a mean of 1 over the monitors, and `sqrt(2/monitors)` of scatter. An
//! orbit that moves faster raises it, in one frame after the other.

/// Share of a frame in the running mean.
const SHARE: f32 = 1.0 / 8.0;
/// Standard deviations of the running mean above which the orbit has moved: by chance once in 30,000 frames.
const BEYOND: f32 = 4.0;

/// The running mean of squared innovations over their variances, less 1.
#[derive(Debug, Clone, Copy)]
pub struct Pace(f32);

impl Pace {
    /// As expected.
    pub const STEADY: Self = Self(0.0);

    /// Take note of a frame's squares, over their variances; returns by how many times the noise's variance the orbit has moved.
    pub fn hear(&mut self, squares: impl Iterator<Item = f32>) -> f32 {
        let (mut sum, mut number) = (0.0, 0.0);
        squares.for_each(|square| (sum, number) = (sum + square, number + 1.0_f32));
        if number == 0.0 {
            return 0.0;
        }
        let edge = BEYOND * libm::sqrtf(2.0 / number * SHARE / (2.0 - SHARE));
        // no single frame takes it beyond
        let excess = (sum / number - 1.0).min(edge / SHARE);
        self.0 += SHARE * (excess - self.0);
        if self.0 > edge { self.0 } else { 0.0 }
    }
}
