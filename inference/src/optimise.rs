//! The smallest sum of squares within bounds: damped Gauss-Newton.
//!
//! About a point, `cost(x + s) = cost(x) - 2 g s + s A s`; the step is the minimum of that within the bounds, halved as long as it
//! leads uphill or to a point that has no cost (an unstable ring). A trial may fail; the best point so far never does.
//!
//! Source: J. Nocedal and S. Wright, Numerical Optimization (2006), ch. 10.3; a bounded step by the sets that are held, M. Hintermuller, K. Ito and
//! K. Kunisch, SIAM J. Optim. 13 (2003) 865, and by projected Gauss-Seidel sweeps, R. Cottle, J.-S. Pang and R. Stone, The Linear
//! Complementarity Problem (1992), ch. 5.

use nalgebra::{DMatrix, DVector};

use evidence::Factor;

/// A cost that is (nearly) a sum of squares.
pub trait Objective {
    /// What is known at a point beside its cost.
    type Point;
    /// What is known of the slopes there, beside the quadratic.
    type Slopes;
    /// Why a point has no cost.
    type Error;

    /// The cost at a point.
    ///
    /// # Errors
    /// Where there is none.
    fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, Self::Point), Self::Error>;

    /// The quadratic about a point.
    ///
    /// # Errors
    /// Where there is none.
    fn linearise(&self, x: &DVector<f64>, point: &Self::Point) -> Result<(Quadratic, Self::Slopes), Self::Error>;
}

/// A cost about a point: `cost(s) = cost - 2 slope s + s matrix s`.
#[derive(Debug, Clone)]
pub struct Quadratic {
    /// Half its second derivative.
    pub matrix: DMatrix<f64>,
    /// Minus half its gradient.
    pub slope: DVector<f64>,
}

/// When to stop.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Expected decrease of the cost by a step at which the steps have settled: its square root is a move in standard deviations.
    pub settled: f64,
    /// Most steps.
    pub steps: usize,
    /// Most halvings of a step.
    pub halvings: usize,
}

/// The best point found.
#[derive(Debug)]
pub struct Optimum<O: Objective> {
    /// Where.
    pub x: DVector<f64>,
    /// Its cost.
    pub cost: f64,
    /// What is known there.
    pub point: O::Point,
    /// The quadratic about the last point that a full step was taken from, at most `settled` away.
    pub quadratic: Quadratic,
    /// Its slopes.
    pub slopes: O::Slopes,
    /// Why the steps ended.
    pub end: End,
    /// Steps taken.
    pub steps: usize,
    /// Expected decrease of the cost by the last step.
    pub expected: f64,
}

/// Why the steps ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The last step was as small as asked for.
    Settled,
    /// No part of a step led downhill.
    Stalled,
    /// There were as many steps as allowed.
    Exhausted,
    /// The caller stopped it.
    GivenUp,
}

/// Why there is no optimum.
#[derive(Debug, thiserror::Error)]
pub enum OptimiseError<E> {
    /// The first point has no cost.
    #[error(transparent)]
    Start(E),
    /// The matrix of the quadratic is not positive.
    #[error("the curvature is not positive")]
    Degenerate,
}

/// Relative growth of a cost that counts as rounding.
const ROUNDING: f64 = 1e-9;
/// Sets that are tried for a bounded step; mostly one or two are needed.
const SETS: usize = 20;
/// Sweeps of a bounded step at most, and the move in standard deviations at which they have settled.
const SWEEPS: usize = 1000;
const SWEPT: f64 = 1e-6;

/// Minimise from a point within bounds; unbounded where these are infinite. `watch` hears of each step and the cost after it, and gives up
/// by false.
///
/// # Errors
/// [`OptimiseError`].
pub fn minimise<O: Objective>(
    objective: &O,
    start: &DVector<f64>,
    bounds: &[[f64; 2]],
    limits: &Limits,
    mut watch: impl FnMut(usize, f64) -> bool,
) -> Result<Optimum<O>, OptimiseError<O::Error>> {
    let mut x = start.map_with_location(|i, _, x| x.clamp(bounds[i][0], bounds[i][1]));
    let (mut cost, mut point) = objective.evaluate(&x).map_err(OptimiseError::Start)?;
    let (mut quadratic, mut slopes) = objective.linearise(&x, &point).map_err(OptimiseError::Start)?;
    let (mut expected, mut steps) = (f64::INFINITY, 0);
    let end = loop {
        if steps == limits.steps {
            break End::Exhausted;
        }
        steps += 1;
        let full = quadratic.step(&x, bounds).ok_or(OptimiseError::Degenerate)?;
        let Some((share, next)) = descend(objective, &x, &full, cost, limits.halvings) else { break End::Stalled };
        let step = full * share;
        expected = step.dot(&quadratic.slope);
        x += step;
        (cost, point) = next;
        if expected < limits.settled {
            break End::Settled;
        }
        if !watch(steps, cost) {
            break End::GivenUp;
        }
        match objective.linearise(&x, &point) {
            Ok(next) => (quadratic, slopes) = next,
            Err(_) => break End::Stalled,
        }
    };
    Ok(Optimum { x, cost, point, quadratic, slopes, end, steps, expected })
}

/// A share of a step, with the cost and what else is known where it leads.
type Share<P> = (f64, (f64, P));

/// Half the way as long as the step leads uphill or to no cost at all.
fn descend<O: Objective>(
    objective: &O,
    x: &DVector<f64>,
    step: &DVector<f64>,
    cost: f64,
    halvings: usize,
) -> Option<Share<O::Point>> {
    let shares = (0..halvings as i32).map(|k| 0.5_f64.powi(k));
    let mut downhill = shares.filter_map(|share| {
        let next = objective.evaluate(&(x + step * share)).ok()?;
        (next.0 <= cost + ROUNDING * cost.abs()).then_some((share, next))
    });
    downhill.next()
}

impl Quadratic {
    /// The best step within the bounds; none if the matrix is not positive.
    pub fn step(&self, x: &DVector<f64>, bounds: &[[f64; 2]]) -> Option<DVector<f64>> {
        self.factor().map(|factor| self.within(&factor.solve(&self.slope), x, bounds))
    }

    /// Factor of the matrix.
    pub fn factor(&self) -> Option<Factor> {
        Factor::of(self.matrix.clone())
    }

    /// The best step within the bounds, given that without: by the set of those that are held at a bound, or by sweeps where no set settles in as many trials.
    pub fn within(&self, full: &DVector<f64>, x: &DVector<f64>, bounds: &[[f64; 2]]) -> DVector<f64> {
        let range = |i: usize| bounds[i].map(|bound| bound - x[i]);
        let clamp = |i: usize, step: f64| step.clamp(range(i)[0], range(i)[1]);
        let mut step = full.map_with_location(|i, _, step| clamp(i, step));
        if step == *full {
            return step;
        }
        let mut held: Vec<usize> = (0..step.len()).filter(|&i| step[i] != full[i]).collect();
        for _ in 0..SETS {
            let Some(best) = self.holding(&held, &step) else { break };
            let pull = &self.slope - &self.matrix * &best;
            // what is held stays as long as it is pulled against its bound
            let stays = |i: usize| {
                let [lower, upper] = range(i);
                lower == upper || if best[i] <= lower { pull[i] < 0.0 } else { pull[i] > 0.0 }
            };
            let is_held =
                |i: usize| if held.binary_search(&i).is_ok() { stays(i) } else { clamp(i, best[i]) != best[i] };
            let next: Vec<usize> = (0..best.len()).filter(|&i| is_held(i)).collect();
            step = best.map_with_location(|i, _, step| clamp(i, step));
            if next == held {
                return step;
            }
            held = next;
        }
        for _ in 0..SWEEPS {
            let mut moved = 0.0_f64;
            for i in 0..step.len() {
                let curvature = self.matrix[(i, i)];
                let pull = self.slope[i] - self.matrix.column(i).dot(&step);
                let next = clamp(i, step[i] + pull / curvature);
                moved = moved.max((next - step[i]).abs() * curvature.sqrt());
                step[i] = next;
            }
            if moved < SWEPT {
                break;
            }
        }
        step
    }

    /// The best step with some of its parts as they are.
    fn holding(&self, held: &[usize], step: &DVector<f64>) -> Option<DVector<f64>> {
        let free: Vec<usize> = (0..step.len()).filter(|i| held.binary_search(i).is_err()).collect();
        let mut best = DVector::zeros(step.len());
        held.iter().for_each(|&i| best[i] = step[i]);
        let pull = (&self.slope - &self.matrix * &best).select_rows(&free);
        let factor = Factor::of(self.matrix.select_rows(&free).select_columns(&free))?;
        free.iter().zip(&factor.solve(&pull)).for_each(|(&i, own)| best[i] = *own);
        Some(best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley as a sum of squares; beyond x = 1.5 there is nothing.
    #[derive(Debug)]
    struct Valley;

    impl Objective for Valley {
        type Point = [f64; 2];
        type Slopes = ();
        type Error = &'static str;

        fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, [f64; 2]), &'static str> {
            let residual = [10.0 * (x[1] - x[0] * x[0]), 1.0 - x[0]];
            let cost = residual.iter().map(|r| r * r).sum();
            if x[0] > 1.5 { Err("beyond the edge") } else { Ok((cost, residual)) }
        }

        fn linearise(&self, x: &DVector<f64>, residual: &[f64; 2]) -> Result<(Quadratic, ()), &'static str> {
            let jacobian = DMatrix::from_row_slice(2, 2, &[20.0 * x[0], -10.0, 1.0, 0.0]);
            let slope = jacobian.tr_mul(&DVector::from_column_slice(residual));
            Ok((Quadratic { matrix: jacobian.tr_mul(&jacobian), slope }, ()))
        }
    }

    const LIMITS: Limits = Limits { settled: 1e-20, steps: 100, halvings: 10 };
    const FREE: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

    fn from(start: [f64; 2], bounds: [[f64; 2]; 2]) -> Result<Optimum<Valley>, OptimiseError<&'static str>> {
        minimise(&Valley, &DVector::from_column_slice(&start), &bounds, &LIMITS, |_, _| true)
    }

    #[test]
    fn steps_that_lead_uphill_or_nowhere_are_halved() {
        for start in [[-1.2, 1.0], [-1.4, -3.0], [1.4, 9.0]] {
            let found = from(start, [FREE; 2]).unwrap();
            assert!((found.x[0] - 1.0).abs() < 1e-8 && (found.x[1] - 1.0).abs() < 1e-8, "{start:?}: {found:?}");
        }
        assert!(matches!(from([2.0, 0.0], [FREE; 2]), Err(OptimiseError::Start("beyond the edge"))));
    }

    #[test]
    fn bounds_hold_what_is_pulled_against_them() {
        // with x at 0.5 the other is best at its square
        let found = from([0.0, 3.0], [[-1.0, 0.5], FREE]).unwrap();
        assert!(found.x[0] == 0.5 && (found.x[1] - 0.25).abs() < 1e-8, "{found:?}");
        // x with y at most 0: derivative of 100 x^4 + (1 - x)^2
        let found = from([-0.5, -1.0], [FREE, [-1.0, 0.0]]).unwrap();
        let (x, y) = (found.x[0], found.x[1]);
        assert!(y == 0.0 && (200.0 * x.powi(3) - (1.0 - x)).abs() < 1e-6, "{x} {y}");
    }

    /// At the best step nothing that is free is pulled, and what is held is pulled against its bound.
    #[test]
    fn a_bounded_step_is_the_best_of_its_quadratic() {
        let wave = |i: usize, j: usize| (1.0 + (3 * i + 7 * j) as f64).sin();
        for n in [2, 7, 48, 130] {
            let root = DMatrix::from_fn(n, n, wave);
            let matrix = &root * root.transpose() / n as f64 + DMatrix::identity(n, n) * 0.05;
            let quadratic = Quadratic { matrix, slope: DVector::from_fn(n, |i, _| 3.0 * wave(i, i + 1)) };
            let (x, bounds) = (DVector::from_fn(n, |i, _| 0.5 * wave(i, 2)), vec![[-1.0, 1.0]; n]);
            let step = quadratic.step(&x, &bounds).unwrap();
            let pull = &quadratic.slope - &quadratic.matrix * &step;
            for i in 0..n {
                // x and step add up to a bound but for rounding
                let (lower, upper) = (step[i] <= -1.0 - x[i], step[i] >= 1.0 - x[i]);
                let is_right = if lower {
                    pull[i] < SWEPT
                } else if upper {
                    pull[i] > -SWEPT
                } else {
                    pull[i].abs() < SWEPT
                };
                assert!((x[i] + step[i]).abs() < 1.0 + 1e-12 && is_right, "{i} of {n} is pulled by {}", pull[i]);
            }
        }
    }
}
