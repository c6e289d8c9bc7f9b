//! The covariance of the baselines, params given: independent while the params are constant, else correlated.

use core::marker::PhantomData;

use crate::linear::{Real, add, add_four_to_each, dot};
use crate::state::{State, state};
use crate::triangle::Triangle;

/// Covariance of the baselines, params given [m^2].
pub trait Covariance<const B: usize>: Copy + State {
    /// Precision of the slopes by which baselines follow the params.
    type Slope: Real;

    /// All zero.
    const ZERO: Self;

    /// Independent baselines.
    fn set(&mut self, variances: &[f64; B]);

    /// Variance of each.
    fn variances(&self) -> [f64; B];

    /// Variance of a monitor's.
    fn variance(&self, b: usize) -> f64;

    /// Add to the variance of a monitor's.
    fn spread(&mut self, b: usize, variance: f64);

    /// Take a reading of monitor `b` off, of innovation variance `s`.
    fn condition(&mut self, b: usize, s: f64) -> Gain<B>;

    /// Move slopes by what readings of these rows have made wait; nothing, where each has moved its own.
    fn settle<const N: usize>(_: &mut Moves<B>, _: &mut [[Self::Slope; N]; B], _: &[[f64; N]; 4]) {}
}

/// What a reading moves baselines by, per unit of innovation.
#[derive(Debug, Clone, Copy)]
pub enum Gain<const B: usize> {
    /// That of its own monitor.
    Own(f64),
    /// Each.
    All([f64; B]),
}

/// Gains of all baselines by as many readings as are staged; zero for those that have moved their own at once.
#[derive(Debug, Clone)]
pub struct Moves<const B: usize> {
    gain: [[f64; B]; 4],
    any: bool,
}

impl<const B: usize> Moves<B> {
    /// None wait.
    pub const NONE: Self = Self { gain: [[0.0; B]; 4], any: false };

    /// Those of the reading at a place.
    pub fn push(&mut self, at: usize, gain: &[f64; B]) {
        self.gain.get_mut(at).into_iter().for_each(|to| *to = *gain);
        self.any = true;
    }

    /// By how much the readings at the first `count` places move the slope of a baseline; `rows` are theirs.
    pub fn wait_for<const N: usize>(
        &self,
        b: usize,
        rows: &[[f64; N]; 4],
        count: usize,
        mut each: impl FnMut(f64, &[f64; N]),
    ) {
        if self.any {
            let gains = self.gain.iter().map(|gain| gain.get(b).copied().unwrap_or(0.0));
            gains.zip(rows).take(count).for_each(|(gain, row)| each(gain, row));
        }
    }

    /// Move the slopes of all baselines by what waits.
    fn settle<const N: usize>(&mut self, slopes: &mut [[f64; N]; B], rows: &[[f64; N]; 4]) {
        if !core::mem::take(&mut self.any) {
            return;
        }
        let rows = rows.each_ref().map(<[f64; N]>::as_slice);
        let of = |b: usize| self.gain.each_ref().map(|gain| gain.get(b).copied().unwrap_or(0.0));
        add_four_to_each(slopes.iter_mut().enumerate().map(|(b, slope)| (slope.as_mut_slice(), of(b))), rows);
        self.gain = [[0.0; B]; 4];
    }
}

/// That of baselines which nothing correlates, as long as the params are constant; `R` is the precision of their slopes.
///
/// Slopes are means of what the surrogate gives in single precision. A mean that is kept so is off by 3e-5 of itself after a
/// million frames: enough where frames come one by one, each by its difference from that mean, but not where sums of many are
/// subtracted from one another.
#[derive(Debug, Clone, Copy)]
pub struct Independent<const B: usize, R> {
    variance: [f64; B],
    slope: PhantomData<R>,
}

state!([const B: usize, R] Independent<B, R> { variance, slope });

/// That of baselines which a walk of the params has correlated; `U` entries make a triangle of `B`.
#[derive(Debug, Clone, Copy)]
pub struct Correlated<const B: usize, const U: usize> {
    matrix: Triangle<B, U, f64>,
    walked: bool,
}

state!([const B: usize, const U: usize] Correlated<B, U> { matrix, walked });

impl<const B: usize, R: Real> Covariance<B> for Independent<B, R> {
    type Slope = R;
    const ZERO: Self = Self { variance: [0.0; B], slope: PhantomData };

    fn set(&mut self, variances: &[f64; B]) {
        self.variance = *variances;
    }

    fn variances(&self) -> [f64; B] {
        self.variance
    }

    fn variance(&self, b: usize) -> f64 {
        self.variance.get(b).copied().unwrap_or(0.0)
    }

    fn spread(&mut self, b: usize, variance: f64) {
        self.variance.get_mut(b).into_iter().for_each(|own| *own += variance);
    }

    fn condition(&mut self, b: usize, s: f64) -> Gain<B> {
        let Some(variance) = self.variance.get_mut(b) else { return Gain::Own(0.0) };
        let gain = *variance / s;
        *variance -= gain * *variance;
        Gain::Own(gain)
    }
}

impl<const B: usize, const U: usize> Covariance<B> for Correlated<B, U> {
    type Slope = f64;
    const ZERO: Self = Self { matrix: Triangle::ZERO, walked: false };

    fn set(&mut self, variances: &[f64; B]) {
        self.matrix.fill_diagonal(0.0);
        let diagonal = self.matrix.rows_mut().filter_map(<[f64]>::last_mut);
        diagonal.zip(variances).for_each(|(own, variance)| *own = *variance);
        self.walked = false;
    }

    fn variances(&self) -> [f64; B] {
        core::array::from_fn(|b| self.variance(b))
    }

    fn variance(&self, b: usize) -> f64 {
        self.matrix.get(b, b)
    }

    fn spread(&mut self, b: usize, variance: f64) {
        self.matrix.row_mut(b).last_mut().into_iter().for_each(|own| *own += variance);
    }

    fn condition(&mut self, b: usize, s: f64) -> Gain<B> {
        if !self.walked {
            let Some(variance) = self.matrix.row_mut(b).last_mut() else { return Gain::Own(0.0) };
            let gain = *variance / s;
            *variance -= gain * *variance;
            return Gain::Own(gain);
        }
        let mut gain = [0.0; B];
        self.matrix.copy_row(b, &mut gain);
        gain.iter_mut().for_each(|gain| *gain /= s);
        for (row, g) in self.matrix.rows_mut().zip(&gain) {
            add(row, -g * s, &gain);
        }
        Gain::All(gain)
    }

    fn settle<const N: usize>(moves: &mut Moves<B>, slopes: &mut [[f64; N]; B], rows: &[[f64; N]; 4]) {
        moves.settle(slopes, rows);
    }
}

impl<const B: usize, const U: usize> Correlated<B, U> {
    /// Add the products of columns `h`, one of each baseline: what they share of a walk.
    pub fn correlate<const N: usize>(&mut self, h: &[[f64; N]; B]) {
        for (row, one) in self.matrix.rows_mut().zip(h) {
            row.iter_mut().zip(h).for_each(|(c, other)| *c += dot(one, other));
        }
        self.walked = true;
    }
}
