//! Errors of a matrix's elements: what the model misses in each block, and how far each monitor errs beside the others.
//!
//! An element of monitor `i` in block `b` has an error of scale `f_i s_b`, `s_b` that of its block ([`Missed`]). Most monitors err as their block does, `f_i = 1`;
//! a monitor has a scale of its own where that gains more `ln` likelihood than one of so many monitors does by chance. Elements of a faulty monitor then
//! count little, and do not make errors of all others look as if they had heavy tails; a stated noise that is too large is found too.

use nalgebra::DMatrix;

use crate::chance::deviations;
use crate::data::{BLOCKS, Data};
use crate::missed::{Missed, variance};
use crate::model::Prediction;
use crate::normal::Places;

/// Matrices of normal errors in which any monitor has a scale of its own: one in so many.
const FALSE: f64 = 1000.0;
/// Scales are within these, as logarithms.
const SCALES: [f64; 2] = [-5.0, 10.0];
/// Of scales that gain, those with this share of the largest gain are taken at once: others may be explained then.
const AT_ONCE: f64 = 0.5;
/// Gain that is worth a turn [nat], and turns of blocks and monitors at most.
const ENOUGH: f64 = 1.0;
const TURNS: usize = 20;
/// Of an element that the unknowns follow further than this, what is left tells nothing of its error.
const LEAST_LEFT: f64 = 0.1;

/// Errors of all elements.
#[derive(Debug, Clone, PartialEq)]
pub struct Noise {
    /// What the model misses in each of [`BLOCKS`].
    pub blocks: [Missed; BLOCKS.len()],
    /// Scale of each monitor's errors over that of its blocks.
    pub monitors: Vec<f64>,
}

impl Noise {
    /// The stated noise of so many monitors.
    pub fn stated(monitors: usize) -> Self {
        Self { blocks: [Missed::NOTHING; BLOCKS.len()], monitors: vec![1.0; monitors] }
    }

    /// The same with monitors that all err alike.
    pub fn with_equal_monitors(&self) -> Self {
        Self { monitors: vec![1.0; self.monitors.len()], ..self.clone() }
    }

    /// The same with normal errors.
    pub fn without_tails(mut self) -> Self {
        self.blocks.iter_mut().for_each(|block| block.freedom = f64::INFINITY);
        self
    }

    /// Share `h` of each element's error that unknowns of some covariance follow: its weight times the variance that their covariance gives it.
    ///
    /// Source: D. A. Belsley, E. Kuh and R. E. Welsch, Regression Diagnostics (1980), eq. 2.15.
    pub fn followed(
        &self,
        data: &Data,
        places: &Places,
        prediction: &Prediction,
        (residual, covariance): (&DMatrix<f64>, &DMatrix<f64>),
    ) -> DMatrix<f64> {
        places.variance(prediction, covariance).component_mul(&data.weight(self, residual))
    }

    /// From residuals [mm] of which unknowns have followed a share `h`: `1 - h` of the variance is left. Also how much more probable they are with it [nat].
    pub fn learnt(&self, data: &Data, residual: &DMatrix<f64>, followed: &DMatrix<f64>) -> (Self, f64) {
        let errors = residual.zip_map(followed, |left, followed| left / (1.0 - followed).max(LEAST_LEFT).sqrt());
        let learnt = self.clone().with_errors(data, &errors);
        let [now, before] = [&learnt, self].map(|noise| data.log_likelihood(noise, &errors));
        (learnt, now - before)
    }

    /// Blocks and monitors in turn, until no monitor changes.
    fn with_errors(mut self, data: &Data, errors: &DMatrix<f64>) -> Self {
        let chance = by_chance(self.monitors.len());
        for _ in 0..TURNS {
            self.blocks = self.blocks_with(data, errors);
            let scales: Vec<Own> = (0..self.monitors.len()).map(|row| self.own(data, errors, row, chance)).collect();
            let best = scales.iter().map(|own| own.gain).fold(0.0, f64::max);
            if best <= ENOUGH {
                break;
            }
            let taken =
                scales.iter().zip(&mut self.monitors).filter(|(own, _)| own.gain > (AT_ONCE * best).max(ENOUGH));
            taken.for_each(|(own, monitor)| *monitor = own.scale);
        }
        self
    }

    /// What the model misses in each block, with the monitors' scales.
    fn blocks_with(&self, data: &Data, errors: &DMatrix<f64>) -> [Missed; BLOCKS.len()] {
        let mut of_blocks: [Vec<(f64, f64)>; BLOCKS.len()] = Default::default();
        for (row, scale) in self.monitors.iter().enumerate() {
            for (block, sigma, error) in elements(data, errors, row) {
                of_blocks[block].push((error / scale, sigma));
            }
        }
        let mut former = self.blocks.iter();
        of_blocks.map(|elements| former.next().expect("a block each").most_probable(&elements))
    }

    /// The scale of a monitor, 1 where another one gains no more than chance does.
    fn own(&self, data: &Data, errors: &DMatrix<f64>, row: usize, chance: f64) -> Own {
        let all: Vec<(Missed, f64, f64)> =
            elements(data, errors, row).map(|(block, sigma, error)| (self.blocks[block], sigma, error)).collect();
        let told = |log: f64| {
            let scale = log.exp();
            all.iter().map(|(block, sigma, error)| block.log_shape(*sigma, error / scale) - log).sum::<f64>()
        };
        // the mean of squares times weight is 1 where the likelihood is largest
        let square = |(block, sigma, error): &(Missed, f64, f64)| {
            let (tails, square) = (block.freedom.recip(), error * error);
            [(1.0 + tails) * square, block.spread(*sigma).powi(2), tails * square]
        };
        let [least, most] = SCALES;
        let log = (0.5 * variance((2.0 * least).exp(), all.iter().map(square)).ln()).min(most);
        let (alike, own) = (told(0.0), told(log) - chance);
        let present = self.monitors[row];
        let now = if present == 1.0 { alike } else { told(present.ln()) - chance };
        Own { scale: if own > alike { log.exp() } else { 1.0 }, gain: own.max(alike) - now }
    }
}

/// What a scale of its own gains in `ln` likelihood where a monitor errs like the others, at most in one of [`FALSE`] matrices of so many monitors: half a
/// quantile of chi-square with one degree of freedom.
fn by_chance(monitors: usize) -> f64 {
    0.5 * deviations(FALSE * monitors.max(1) as f64).powi(2)
}

/// A scale that a monitor may take.
struct Own {
    scale: f64,
    /// What it gains over the present one [nat].
    gain: f64,
}

impl Data {
    /// One over the square of the error of each element [1/mm^2].
    pub fn precision(&self, noise: &Noise) -> DMatrix<f64> {
        self.each(noise, |block, sigma, _| block.spread(sigma).powi(-2), None)
    }

    /// What each element counts [1/mm^2], the less the further it is off.
    pub fn weight(&self, noise: &Noise, residual: &DMatrix<f64>) -> DMatrix<f64> {
        self.each(noise, Missed::weight, Some(residual))
    }

    /// What each element says on average [1/mm^2].
    pub fn information(&self, noise: &Noise) -> DMatrix<f64> {
        self.each(noise, |block, sigma, _| block.information(sigma), None)
    }

    /// `ln` of the likelihood of residuals [mm].
    pub fn log_likelihood(&self, noise: &Noise, residual: &DMatrix<f64>) -> f64 {
        let elements = (0..residual.ncols()).flat_map(|column| (0..residual.nrows()).map(move |row| (row, column)));
        let counted = elements.filter(|&at| self.sigma[at].is_finite());
        counted.map(|at| self.log_density(noise, at, residual[at])).sum()
    }

    /// The same of the residual [mm] of one element.
    pub fn log_density(&self, noise: &Noise, at: (usize, usize), residual: f64) -> f64 {
        let scale = noise.monitors[at.0];
        noise.blocks[self.block[at]].log_likelihood(self.sigma[at], residual / scale) - scale.ln()
    }

    /// A precision of each element, from one of its block at the residual in units of its monitor's scale.
    fn each(
        &self,
        noise: &Noise,
        precision: impl Fn(&Missed, f64, f64) -> f64,
        residual: Option<&DMatrix<f64>>,
    ) -> DMatrix<f64> {
        let (rows, columns) = self.sigma.shape();
        DMatrix::from_fn(rows, columns, |row, column| {
            let (at, scale) = ((row, column), noise.monitors[row]);
            let residual = residual.map_or(0.0, |residual| residual[at] / scale);
            precision(&noise.blocks[self.block[at]], self.sigma[at], residual) / (scale * scale)
        })
    }
}

/// Block, stated noise [mm] and error [mm] of a monitor's elements that count.
fn elements<'d>(data: &'d Data, errors: &'d DMatrix<f64>, row: usize) -> impl Iterator<Item = (usize, f64, f64)> + 'd {
    let columns = (0..errors.ncols()).filter(move |&column| data.sigma[(row, column)].is_finite());
    columns.map(move |column| (data.block[(row, column)], data.sigma[(row, column)], errors[(row, column)]))
}

#[cfg(test)]
mod tests {
    use crate::fit::{Settings, fit};
    use crate::testing::{NOISE, machine, measured, normal, ring};

    /// Error scales of the monitors of a fit whose measured rows have further errors, in units of the stated noise.
    fn scales(seed: u64, further: &[(usize, f64)], stated: f64) -> Vec<f64> {
        let ring = ring();
        let mut folder = measured(&ring, &machine(&ring, seed), NOISE, 40 + seed);
        let mut normal = normal(60 + seed);
        for &(row, size) in further {
            folder.matrix.row_mut(row).iter_mut().for_each(|one| *one += size * NOISE * normal());
        }
        folder.monitors.iter_mut().for_each(|monitor| monitor.sigma *= stated);
        fit(&folder, &Settings::default(), &mut |_| ()).unwrap().noise.monitors
    }

    #[test]
    fn monitors_err_alike_but_for_a_faulty_one() {
        for seed in 0..6 {
            assert!(scales(seed, &[], 1.0).iter().all(|&scale| scale == 1.0), "{seed}");
            let found = scales(seed, &[(5, 20.0)], 1.0);
            // twenty times the stated noise, of which a block of 144 elements errs by up to twice as much; 24 elements tell a scale to 15 %, twice that
            assert!((7.0..26.0).contains(&found[5]), "{seed}: {found:?}");
            assert!(found.iter().enumerate().all(|(row, &scale)| row == 5 || scale == 1.0), "{seed}: {found:?}");
        }
    }

    #[test]
    fn a_stated_noise_that_is_ten_times_too_large_is_found() {
        let found = scales(3, &[], 10.0);
        let mean = found.iter().sum::<f64>() / found.len() as f64;
        // 24 monitors of 24 elements: 3 %; a quarter of the elements is what the unknowns follow
        assert!((mean - 0.1).abs() < 0.015, "{found:?}");
    }
}
