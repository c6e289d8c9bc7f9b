//! Coordinates without bounds for params within a range, for samplers.
//!
//! `theta = lower + t softplus((u - lower)/t) - t softplus((u - upper)/t)`
//!
//! Where a bound is more than a few `t` away, `u` is `theta` itself, so that a posterior that is normal in theta is normal in u. A
//! logistic map of the whole range bends everywhere: on a var at 0.958 it cost half of the effective draws.

use nalgebra::DVector;

use crate::prior::Prior;

/// The map of every param [N].
#[derive(Debug, Clone, PartialEq)]
pub struct Coordinates(Vec<Coordinate>);

/// The map of one param.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coordinate {
    lower: f64,
    upper: f64,
    /// Distance from a bound within which the map bends, `t` [ln var].
    bend: f64,
}

/// One param as a function of its coordinate without bounds.
#[derive(Debug, Clone, Copy)]
pub struct Bounded {
    /// `d theta/du`.
    pub slope: f64,
    /// `d2 theta/du2`.
    pub bend: f64,
    /// `d ln(slope)/du`.
    pub log_slope_slope: f64,
    /// `-d2 ln(slope)/du2`.
    pub log_curvature: f64,
}

/// Largest distance from a bound within which the map bends [ln var], and the largest share of the range.
const BEND: f64 = 0.003;
const BENT: f64 = 0.025;

impl Coordinates {
    /// For the ranges of a prior.
    pub fn from_prior(prior: &Prior) -> Self {
        Self(prior.range.iter().map(|&range| Coordinate::between(range)).collect())
    }

    /// The map of each param.
    pub fn each(&self) -> &[Coordinate] {
        &self.0
    }

    /// Params of coordinates without bounds.
    pub fn params(&self, u: &[f64]) -> Vec<f64> {
        self.0.iter().zip(u).map(|(one, u)| one.theta(*u)).collect()
    }

    /// Coordinates without bounds of params; a param at a bound is taken a thousandth of the range inside.
    pub fn unbounded(&self, params: &[f64]) -> DVector<f64> {
        DVector::from_iterator(params.len(), self.0.iter().zip(params).map(|(one, theta)| one.unbounded(*theta)))
    }
}

impl Coordinate {
    fn between([lower, upper]: [f64; 2]) -> Self {
        Self { lower, upper, bend: BEND.min(BENT * (upper - lower)) }
    }

    /// Distance from a bound within which the map bends [ln var].
    pub fn bend(&self) -> f64 {
        self.bend
    }

    /// The param at a coordinate.
    pub fn theta(&self, u: f64) -> f64 {
        let softplus = |bound: f64| softplus((u - bound) / self.bend);
        self.lower + self.bend * (softplus(self.lower) - softplus(self.upper))
    }

    fn unbounded(&self, theta: f64) -> f64 {
        let room = 1e-3 * (self.upper - self.lower);
        let theta = theta.clamp(self.lower + room, self.upper - room);
        // of `e = (1 + a)/(1 + a q)` for `a`, `e` and `q` the exponentials of the distances from lower of theta and upper
        let e = ((theta - self.lower) / self.bend).exp_m1();
        self.lower + self.bend * (e / -((theta - self.upper) / self.bend).exp_m1()).ln()
    }

    /// `slope = s_l (1 - s_u) (1 - e^(-(upper - lower)/t))`, `s` the logistic functions of the distances from both bounds.
    pub fn at(&self, u: f64) -> Bounded {
        let Self { lower, upper, bend } = *self;
        let [above_lower, above_upper] = [logistic((u - lower) / bend), logistic((u - upper) / bend)];
        let [below_lower, below_upper] = [logistic((lower - u) / bend), logistic((upper - u) / bend)];
        let log_slope_slope = (below_lower - above_upper) / bend;
        let slope = above_lower * below_upper * -(-(upper - lower) / bend).exp_m1();
        Bounded {
            slope,
            bend: slope * log_slope_slope,
            log_slope_slope,
            log_curvature: (above_lower * below_lower + above_upper * below_upper) / (bend * bend),
        }
    }
}

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// `ln(1 + e^x)`.
pub fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_without_bounds_are_those_of_the_params() {
        for range in [[0.94_f64, 1.06], [0.99, 1.02]] {
            let one = Coordinate::between(range.map(f64::ln));
            for share in [0.01, 0.1, 0.4, 0.5, 0.8, 0.97] {
                let theta = one.lower + share * (one.upper - one.lower);
                let (u, h) = (one.unbounded(theta), 1e-4 * one.bend);
                assert!((theta - one.theta(u)).abs() < 1e-14);
                let (here, above, below) = (one.at(u), one.at(u + h), one.at(u - h));
                let central = |up: f64, down: f64| (up - down) / (2.0 * h);
                assert!((central(one.theta(u + h), one.theta(u - h)) / here.slope - 1.0).abs() < 1e-6);
                assert!((central(above.slope, below.slope) - here.bend).abs() < 1e-6 / one.bend);
                let log_slope = central(above.slope.ln(), below.slope.ln());
                assert!((log_slope - here.log_slope_slope).abs() < 1e-6 / one.bend);
                let curvature = -central(above.log_slope_slope, below.log_slope_slope);
                assert!((curvature - here.log_curvature).abs() < 1e-6 / one.bend.powi(2));
            }
        }
    }
}
