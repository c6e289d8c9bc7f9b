//! The loops that everything else is made of, over plain slices: in single precision for the surrogate, in double for sums
//! that grow with every frame. Sums run in a fixed order, so that host and chip agree to the bit.

use core::iter::Sum;
use core::ops::{Add, AddAssign, Mul};

use crate::state::State;

use nalgebra::{ArrayStorage, SMatrix};

/// `f32` or `f64`.
pub trait Real: Copy + PartialEq + Add<Output = Self> + AddAssign + Mul<Output = Self> + Sum + State + 'static {
    /// 0.
    const ZERO: Self;

    /// The nearest to a number of double precision.
    fn nearest(value: f64) -> Self;

    /// In double precision.
    fn double(self) -> f64;
}

impl Real for f32 {
    const ZERO: Self = 0.0;

    fn nearest(value: f64) -> Self {
        value as Self
    }

    fn double(self) -> f64 {
        self.into()
    }
}

impl Real for f64 {
    const ZERO: Self = 0.0;

    fn nearest(value: f64) -> Self {
        value
    }

    fn double(self) -> f64 {
        self
    }
}

/// `to += factor * from`.
#[inline(never)] // inlined for one length it becomes a line of code for each entry
pub fn add<R: Real>(to: &mut [R], factor: R, from: &[R]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += factor * *from);
}

/// [`add`] to numbers of another precision: `to` is rounded once.
#[inline(never)]
pub fn add_rounded<R: Real>(to: &mut [R], factor: f64, from: &[f64]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to = R::nearest(to.double() + factor * from));
}

/// `to = a - b`.
#[inline(never)]
pub fn difference<R: Real>(a: &[f32], b: &[R], to: &mut [f64]) {
    to.iter_mut().zip(a.iter().zip(b)).for_each(|(to, (a, b))| *to = f64::from(*a) - b.double());
}

/// `to += sum of factor * row`, four rows at a time.
#[inline]
pub fn combine<'r, R: Real>(to: &mut [R], terms: impl Iterator<Item = (R, &'r [R])>) {
    let mut terms = terms.fuse();
    while let Some((factor, first)) = terms.next() {
        let (mut factors, mut rows) = ([factor, R::ZERO, R::ZERO, R::ZERO], [first; 4]);
        for ((factor, row), term) in factors.iter_mut().zip(&mut rows).skip(1).zip(&mut terms) {
            (*factor, *row) = term;
        }
        add_four(to, factors, rows);
    }
}

/// `to += sum of factor * row`, all four in one pass: the cost is in loads and stores of `to`. Rows are at least as long;
/// entries beyond the end of `to` are ignored.
#[inline(never)]
pub fn add_four<R: Real>(to: &mut [R], factors: [R; 4], rows: [&[R]; 4]) {
    // one length for all, so that the loop below has no bounds to check and becomes vector code
    let n = to.len();
    let [first, second, third, fourth] = rows.map(|row| row.get(..n));
    let (Some(first), Some(second), Some(third), Some(fourth)) = (first, second, third, fourth) else { return };
    let [a, b, c, d] = factors;
    for i in 0..n {
        to[i] = (((to[i] + a * first[i]) + b * second[i]) + c * third[i]) + d * fourth[i];
    }
}

/// [`add_four`] for two at a time: loads of the rows are shared. The few entries of the longer beyond the other's end are
/// added separately.
#[inline(never)]
fn add_four_twice<R: Real>(to: [&mut [R]; 2], factors: [[R; 4]; 2], rows: [&[R]; 4]) {
    let [one, other] = to;
    let n = one.len().min(other.len());
    for (to, factors) in [&mut *one, &mut *other].into_iter().zip(factors) {
        if let Some(rest) = to.get_mut(n..).filter(|rest| !rest.is_empty()) {
            add_four(rest, factors, rows.map(|row| row.get(n..).unwrap_or_default()));
        }
    }
    two_by_four(one.get_mut(..n).unwrap_or_default(), other.get_mut(..n).unwrap_or_default(), factors, rows);
}

/// [`add_four`] for many, two at a time: each with factors of its own.
#[inline]
pub fn add_four_to_each<'t, R: Real>(mut each: impl Iterator<Item = (&'t mut [R], [R; 4])>, rows: [&[R]; 4]) {
    while let Some((one, factors)) = each.next() {
        match each.next() {
            Some((other, others)) => add_four_twice([one, other], [factors, others], rows),
            None => add_four(one, factors, rows),
        }
    }
}

/// The part of [`add_four_twice`] that both share, on a chip eight entries at a time: within a block, addresses are fixed distances
/// from six pointers. The two are separate arguments, so that the compiler knows that they do not alias the rows, and keeps
/// loaded values.
#[inline(never)]
fn two_by_four<R: Real>(one: &mut [R], other: &mut [R], factors: [[R; 4]; 2], rows: [&[R]; 4]) {
    let n = one.len();
    let Some(other) = other.get_mut(..n) else { return };
    let [first, second, third, fourth] = rows.map(|row| row.get(..n));
    let (Some(first), Some(second), Some(third), Some(fourth)) = (first, second, third, fourth) else { return };
    let [[a, b, c, d], [e, f, g, h]] = factors;
    // registers of a chip hold one number: there, blocks save counting; elsewhere they keep a plain loop from becoming vector code
    if cfg!(not(target_arch = "arm")) {
        for i in 0..n {
            let (w, x, y, z) = (first[i], second[i], third[i], fourth[i]);
            one[i] = (((one[i] + a * w) + b * x) + c * y) + d * z;
            other[i] = (((other[i] + e * w) + f * x) + g * y) + h * z;
        }
        return;
    }
    let ((ones, one), (others, other)) = (one.as_chunks_mut::<8>(), other.as_chunks_mut::<8>());
    let ((firsts, first), (seconds, second)) = (first.as_chunks::<8>(), second.as_chunks::<8>());
    let ((thirds, third), (fourths, fourth)) = (third.as_chunks::<8>(), fourth.as_chunks::<8>());
    let each = firsts.iter().zip(seconds).zip(thirds.iter().zip(fourths));
    for ((one, other), ((first, second), (third, fourth))) in ones.iter_mut().zip(others).zip(each) {
        for i in 0..8 {
            let (w, x, y, z) = (first[i], second[i], third[i], fourth[i]);
            one[i] = (((one[i] + a * w) + b * x) + c * y) + d * z;
            other[i] = (((other[i] + e * w) + f * x) + g * y) + h * z;
        }
    }
    let each = first.iter().zip(second).zip(third.iter().zip(fourth));
    for ((one, other), ((w, x), (y, z))) in one.iter_mut().zip(other).zip(each) {
        *one = (((*one + a * *w) + b * *x) + c * *y) + d * *z;
        *other = (((*other + e * *w) + f * *x) + g * *y) + h * *z;
    }
}

/// Scalar product, summed in eight lanes; entries of one beyond the other's end are ignored.
#[inline(never)]
pub fn dot<R: Real>(a: &[R], b: &[R]) -> R {
    let shared = a.len().min(b.len());
    let (Some(a), Some(b)) = (a.get(..shared), b.get(..shared)) else { return R::ZERO };
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut lanes = [R::ZERO; 8];
    for (a, b) in a.iter().zip(b) {
        lanes.iter_mut().zip(a.iter().zip(b)).for_each(|(lane, (a, b))| *lane += *a * *b);
    }
    let rest: R = a_rest.iter().zip(b_rest).map(|(a, b)| *a * *b).sum();
    lanes.into_iter().sum::<R>() + rest
}

/// `(a - b) . x`, summed in eight lanes; all of one length.
#[inline(never)]
pub fn dot_difference(a: &[f32], b: &[f64], x: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest), (x, x_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>(), x.as_chunks::<8>());
    let mut lanes = [0.0; 8];
    for (a, (b, x)) in a.iter().zip(b.iter().zip(x)) {
        for i in 0..8 {
            lanes[i] += (f64::from(a[i]) - b[i]) * x[i];
        }
    }
    let rest = a_rest.iter().zip(b_rest.iter().zip(x_rest)).map(|(a, (b, x))| (f64::from(*a) - b) * x);
    lanes.into_iter().sum::<f64>() + rest.sum::<f64>()
}

/// A matrix of zeros, known to the compiler.
pub const fn zeros<T: Real, const R: usize, const C: usize>() -> SMatrix<T, R, C> {
    SMatrix::from_array_storage(ArrayStorage([[T::ZERO; R]; C]))
}

/// Column `index` of a matrix of `rows` rows stored by columns; empty beyond the last.
pub fn column<R: Real>(matrix: &[R], rows: usize, index: usize) -> &[R] {
    matrix.get(index * rows..(index + 1) * rows).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_entry_counts_once() {
        let a: [f32; 19] = core::array::from_fn(|i| i as f32);
        assert_eq!(dot(&a, &[1.0; 19]), 171.0);
        assert_eq!((dot(&a, &[1.0; 12]), dot(&[1.0; 12], &a)), (66.0, 66.0));
        let mut b = [1.0; 19];
        add(&mut b, 2.0, &a);
        assert!(b.iter().enumerate().all(|(i, b)| *b == 1.0 + 2.0 * i as f32));
        let rows = [[1.0; 3], [2.0; 3], [3.0; 3], [4.0; 3], [5.0; 3]];
        let mut sum = [0.5; 3];
        combine(&mut sum, rows.iter().map(|row| (2.0, row.as_slice())));
        assert_eq!(sum, [30.5; 3]);
        let mut sums = [[0.5; 3]; 3];
        let each = sums.iter_mut().zip(1_u8..).map(|(to, n)| (&mut to[..n.into()], [f32::from(n); 4]));
        add_four_to_each(each, rows.each_ref().map(<[f32; 3]>::as_slice)[..4].try_into().unwrap());
        assert_eq!(sums, [[10.5, 0.5, 0.5], [20.5, 20.5, 0.5], [30.5; 3]]);
        let (b, x): ([f64; 19], [f64; 19]) = ([1.0; 19], core::array::from_fn(|i| if i % 2 == 0 { 2.0 } else { 0.0 }));
        assert_eq!(dot_difference(&a, &b, &x), 2.0 * (90.0 - 10.0));
        let mut less = [0.0; 19];
        difference(&a, &b, &mut less);
        assert!(less.iter().enumerate().all(|(i, less)| *less == i as f64 - 1.0));
        assert_eq!(column(&a, 5, 2), [10.0, 11.0, 12.0, 13.0, 14.0]);
        assert!(column(&a, 5, 3).is_empty());
    }
}
