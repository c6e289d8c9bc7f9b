//! Matrices in 16-bit codes with one scale.

use crate::state::state;
use crate::triangle::start;

/// A matrix `[R][C]` of codes, stored by columns; the value is `scale * code`, off by half a step, `max/65534`, at most.
#[derive(Debug, Clone, PartialEq)]
pub struct Block<const R: usize, const C: usize> {
    /// Size of one step.
    pub scale: f32,
    /// The codes, column by column.
    pub codes: [[i16; R]; C],
}

/// The lower triangle of a symmetric matrix `[N][N]`, row by row, in the same codes; `T = N (N + 1)/2`.
#[derive(Debug, Clone, PartialEq)]
pub struct SymmetricBlock<const N: usize, const T: usize> {
    /// Size of one step.
    pub scale: f32,
    /// The codes, `(0,0) (1,0) (1,1) (2,0) ..`.
    pub codes: [i16; T],
}

/// A column of a matrix in codes with a scale of its own: off by half a step, `max/65534` of this column, at most.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column<const R: usize> {
    /// Size of one step.
    pub scale: f32,
    /// The codes.
    pub codes: [i16; R],
}

state!([const R: usize] Column<R> { scale, codes });

impl<const R: usize> Column<R> {
    /// All zero.
    pub const ZERO: Self = Self { scale: 0.0, codes: [0; R] };

    /// Sum of the squared values of some rows.
    pub fn squares(&self, rows: impl Iterator<Item = usize>) -> f32 {
        let codes = rows.filter_map(|row| self.codes.get(row));
        let sum: f32 = codes.map(|code| f32::from(*code) * f32::from(*code)).sum();
        self.scale * self.scale * sum
    }

    /// Become these values, which must be finite.
    #[inline(never)]
    pub fn quantise(&mut self, values: &[f32; R]) {
        self.scale = step(values.iter().copied().map(f64::from));
        self.codes.iter_mut().zip(values).for_each(|(to, value)| *to = code((*value).into(), self.scale));
    }

    /// The scalar product with some values.
    pub fn dot(&self, values: &[f32; R]) -> f32 {
        self.scale * dot_codes(&self.codes, values)
    }

    /// `to += factor` times the column.
    pub fn add_to(&self, factor: f32, to: &mut [f32]) {
        add_codes(to, factor * self.scale, &self.codes);
    }
}

/// The scalar product of codes with some values.
#[inline(never)] // inlined for one length it becomes a line of code for each entry
pub fn dot_codes(codes: &[i16], values: &[f32]) -> f32 {
    codes.iter().zip(values).map(|(code, value)| f32::from(*code) * value).sum()
}

/// [`dot_codes`] of four at a time: four sums that do not wait for one another. All have as many codes as there are values.
#[inline(never)]
pub fn dot_four_codes(codes: [&[i16]; 4], values: &[f32]) -> [f32; 4] {
    let n = values.len();
    let [first, second, third, fourth] = codes.map(|codes| codes.get(..n));
    let (Some(first), Some(second), Some(third), Some(fourth)) = (first, second, third, fourth) else {
        return [0.0; 4];
    };
    let mut sums = [-0.0; 4];
    for i in 0..n {
        sums[0] += f32::from(first[i]) * values[i];
        sums[1] += f32::from(second[i]) * values[i];
        sums[2] += f32::from(third[i]) * values[i];
        sums[3] += f32::from(fourth[i]) * values[i];
    }
    sums
}

/// `to += factor` times codes.
#[inline(never)]
pub fn add_codes(to: &mut [f32], factor: f32, codes: &[i16]) {
    to.iter_mut().zip(codes).for_each(|(to, code)| *to += factor * f32::from(*code));
}

impl<const R: usize, const C: usize> Block<R, C> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { scale: 0.0, codes: [[0; R]; C] };
    /// Bytes of the codes and the scale.
    pub const BYTES: usize = 2 * R * C + 4;

    /// Quantise; `value(row, column)` must be finite.
    pub fn quantise(value: impl Fn(usize, usize) -> f64) -> Self {
        let all = || (0..C).flat_map(|c| (0..R).map(move |r| (r, c)));
        let scale = step(all().map(|(r, c)| value(r, c)));
        Self { scale, codes: core::array::from_fn(|c| core::array::from_fn(|r| code(value(r, c), scale))) }
    }

    /// The values of one column.
    pub fn column(&self, c: usize) -> impl Iterator<Item = f32> + '_ {
        let codes = self.codes.get(c).map_or([].as_slice(), |column| column);
        codes.iter().map(|&code| self.scale * f32::from(code))
    }
}

impl<const N: usize, const T: usize> SymmetricBlock<N, T> {
    const FITS: () = assert!(T == N * (N + 1) / 2, "T entries make a triangle of N");

    /// Memory for one, all zero.
    pub const BLANK: Self = Self { scale: 0.0, codes: [0; T] };
    /// Bytes of the codes and the scale.
    pub const BYTES: usize = 2 * T + 4;

    /// Quantise; `value(row, column)` must be finite, and is asked for the lower triangle only.
    pub fn quantise(value: impl Fn(usize, usize) -> f64) -> Self {
        let () = Self::FITS;
        let all = || (0..N).flat_map(|r| (0..=r).map(move |c| (r, c)));
        let scale = step(all().map(|(r, c)| value(r, c)));
        let mut codes = [0; T];
        codes.iter_mut().zip(all()).for_each(|(to, (r, c))| *to = code(value(r, c), scale));
        Self { scale, codes }
    }

    /// The codes of each row, up to its diagonal.
    pub fn rows(&self) -> impl Iterator<Item = &[i16]> {
        (0..N).map(|row| self.row(row).unwrap_or_default())
    }

    /// The codes of one row, up to its diagonal.
    pub fn row(&self, row: usize) -> Option<&[i16]> {
        self.codes.get(start(row)..start(row.saturating_add(1)))
    }

    /// The codes of one row, to be changed.
    pub fn row_mut(&mut self, row: usize) -> Option<&mut [i16]> {
        self.codes.get_mut(start(row)..start(row.saturating_add(1)))
    }

    /// The values, row by row.
    pub fn values(&self) -> impl Iterator<Item = f32> + '_ {
        self.codes.iter().map(|&code| self.scale * f32::from(code))
    }
}

/// The step with which the largest of some values just fits 16 bits.
pub fn step(values: impl Iterator<Item = f64>) -> f32 {
    let largest = values.fold(0.0_f64, |largest, v| largest.max(libm::fabs(v)));
    (largest / f64::from(i16::MAX)).max(f64::from(f32::MIN_POSITIVE)) as f32
}

/// The code nearest to a value.
pub fn code(value: f64, scale: f32) -> i16 {
    libm::round(value / f64::from(scale)) as i16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_within_half_a_step() {
        let value = |r: usize, c: usize| libm::sin((r * 7 + c) as f64) * 12.0;
        let block = Block::<20, 5>::quantise(value);
        // half a step, and the rounding of scale * code to f32
        let near = |v: f32, exact: f64, scale: f32| (f64::from(v) - exact).abs() <= f64::from(scale) * 0.51;
        for c in 0..5 {
            assert!(block.column(c).enumerate().all(|(r, v)| near(v, value(r, c), block.scale)));
        }
        let symmetric = SymmetricBlock::<4, 10>::quantise(value);
        let places = (0..4).flat_map(|r| (0..=r).map(move |c| (r, c)));
        assert!(symmetric.values().zip(places).all(|(v, (r, c))| near(v, value(r, c), symmetric.scale)));
        assert_eq!(symmetric.values().count(), 10);
    }

    #[test]
    fn a_column_has_the_scale_of_its_largest() {
        let values: [f32; 20] = core::array::from_fn(|r| 1e-3 * libm::sinf(r as f32));
        let mut column = Column::ZERO;
        column.quantise(&values);
        assert!(column.scale < 1.001e-3 / 32_767.0);
        let mut sum = values.map(|v| -2.0 * v);
        column.add_to(2.0, &mut sum);
        assert!(sum.iter().all(|left| left.abs() <= 1.02 * column.scale)); // twice half a step, and rounding
        let exact: f32 = values.iter().map(|v| v * v).sum();
        assert!((column.dot(&values) - exact).abs() <= 10.0 * column.scale * 1e-3);
        column.quantise(&[0.0; 20]);
        assert_eq!(column.dot(&values), 0.0);
    }

    #[test]
    fn a_block_of_zeros_stays_zero() {
        assert!(Block::<3, 2>::quantise(|_, _| 0.0).column(1).all(|v| v == 0.0));
        assert_eq!(Block::<3, 2>::BLANK.column(2).count(), 0);
    }
}
