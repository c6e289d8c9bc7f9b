//! A matrix in 16-bit codes with one scale.

use nalgebra::SMatrix;

/// A matrix `[R][C]` of codes; the value is `scale * code`, off by half a step, `max/65534`, at most.
#[derive(Debug, Clone, PartialEq)]
pub struct Block<const R: usize, const C: usize> {
    /// Size of one step.
    pub scale: f32,
    /// The codes.
    pub codes: SMatrix<i16, R, C>,
}

impl<const R: usize, const C: usize> Block<R, C> {
    /// Quantise; `value(row, column)` must be finite.
    pub fn quantise(value: impl Fn(usize, usize) -> f64) -> Self {
        let mut largest = 0.0_f64;
        for c in 0..C {
            for r in 0..R {
                largest = largest.max(value(r, c).abs());
            }
        }
        let scale = (largest / f64::from(i16::MAX)).max(f64::from(f32::MIN_POSITIVE)) as f32;
        Self { scale, codes: SMatrix::from_fn(|r, c| libm::round(value(r, c) / f64::from(scale)) as i16) }
    }

    /// The values of one column.
    pub fn column(&self, c: usize) -> impl Iterator<Item = f32> + '_ {
        let scale = self.scale;
        let codes = self.codes.as_slice().get(c * R..(c + 1) * R).unwrap_or_default();
        codes.iter().map(move |&code| scale * f32::from(code))
    }

    /// Bytes of the codes and the scale.
    pub const BYTES: usize = 2 * R * C + 4;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_within_half_a_step() {
        let value = |r: usize, c: usize| libm::sin((r * 7 + c) as f64) * 12.0;
        let block = Block::<20, 5>::quantise(value);
        for c in 0..5 {
            for (r, v) in block.column(c).enumerate() {
                // half a step, and the rounding of scale * code to f32
                assert!((f64::from(v) - value(r, c)).abs() <= f64::from(block.scale) * 0.51);
            }
        }
    }

    #[test]
    fn a_block_of_zeros_stays_zero() {
        assert!(Block::<3, 2>::quantise(|_, _| 0.0).column(1).all(|v| v == 0.0));
    }
}
