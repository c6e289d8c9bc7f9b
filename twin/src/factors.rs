//! Derivatives of an orbit response kept as factors: as matrices those of a ring with 400 magnets, 470 readings and 413 correctors fill 600 MB.
//!
//! What a source sends into a gradient, a column of six, is seen by all observers through six columns:
//!
//! `dG_ij/dk = [-a_i (W + step) Q] [(W + step) c_j]`,
//!
//! as in [`Optics::response_jacobian`], whose matrices these are.

use nalgebra::{DMatrix, DVector, Matrix6, RowVector6, Vector6};

use crate::response::{Gradient, Observer, Optics, Place, Source, seen_rows};

/// Derivatives of [`Optics::response`] by gradients, made column by column.
#[derive(Debug, Clone)]
pub struct ResponseFactors {
    /// `a W` and `a (W + 1)` of each observer, with its place.
    observers: Vec<(Place, [RowVector6<f64>; 2])>,
    /// Each source with what it sends to places before and behind it.
    sources: Vec<(Source, [Vector6<f64>; 2])>,
    gradients: Vec<Gradient>,
    /// `-a (W + step) Q`, rows observers, six columns a gradient.
    seen: DMatrix<f64>,
}

impl Optics<'_> {
    /// Factors of [`Optics::response_jacobian`], `48 O` bytes a gradient for `O` observers.
    pub fn response_factors(
        &self,
        observers: &[Observer],
        sources: &[Source],
        gradients: Vec<Gradient>,
    ) -> ResponseFactors {
        let seen = observers.iter().map(|one| one.place).zip(seen_rows(observers, &self.closed)).collect::<Vec<_>>();
        let far = self.closed + Matrix6::identity();
        let mut through = DMatrix::zeros(seen.len(), 6 * gradients.len());
        for (number, gradient) in gradients.iter().enumerate() {
            for (row, (place, rows)) in seen.iter().enumerate() {
                let seen = -(rows[usize::from(gradient.place < *place)] * gradient.kernel);
                through.fixed_view_mut::<1, 6>(row, 6 * number).copy_from(&seen);
            }
        }
        ResponseFactors {
            sources: sources.iter().map(|one| (*one, [self.closed * one.column, far * one.column])).collect(),
            gradients,
            seen: through,
            observers: seen,
        }
    }
}

impl ResponseFactors {
    /// Gradients.
    pub fn count(&self) -> usize {
        self.gradients.len()
    }

    /// Add the derivative of a source's orbit at all observers by a gradient.
    pub fn add(&self, source: usize, gradient: usize, into: &mut [f64]) {
        let (sent, within) = self.sent(source, gradient);
        // slices of one length: the loop is over four or eight observers at once
        let rows = into.len();
        let column = |number: usize| &self.seen.as_slice()[(6 * gradient + number) * self.seen.nrows()..][..rows];
        let [x, px, y, py, delta, path] = core::array::from_fn(column);
        let [to_x, to_px, to_y, to_py, to_delta, to_path] = (*sent).into();
        for i in 0..rows {
            let [a, b] = [x[i] * to_x + px[i] * to_px, y[i] * to_y + py[i] * to_py];
            into[i] += a + b + (delta[i] * to_delta + path[i] * to_path);
        }
        if let Some(within) = within {
            let within = self.seen_of_within(gradient, within);
            into.iter_mut().zip(within).for_each(|(into, within)| *into -= within);
        }
    }

    /// `sum_ij w_ij dG_ij/dk` of each gradient `k`, with weights of all observers, the rows, and sources, the columns: one product, without a derivative.
    pub fn back(&self, weights: &DMatrix<f64>) -> DVector<f64> {
        let through = weights.transpose() * &self.seen;
        DVector::from_fn(self.count(), |gradient, _| {
            let said = |source: usize| {
                let (sent, within) = self.sent(source, gradient);
                let left = within.map_or(0.0, |within| {
                    let weights = weights.column(source);
                    self.seen_of_within(gradient, within).zip(&weights).map(|(within, weight)| within * weight).sum()
                });
                (through.fixed_view::<1, 6>(source, 6 * gradient) * sent)[0] - left
            };
            (0..self.sources.len()).map(said).sum()
        })
    }

    /// What a source sends to a gradient, and what of it is counted within the gradient's element if the source is there.
    fn sent(&self, source: usize, gradient: usize) -> (&Vector6<f64>, Option<Vector6<f64>>) {
        let (source, [near, far]) = &self.sources[source];
        let gradient = &self.gradients[gradient];
        let within = gradient.within(source);
        (if within.is_none() && source.place <= gradient.place { far } else { near }, within)
    }

    fn seen_of_within(&self, gradient: usize, within: Vector6<f64>) -> impl Iterator<Item = f64> {
        let before = self.gradients[gradient].place;
        self.observers.iter().map(move |(place, rows)| (rows[usize::from(before < *place)] * within)[0])
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use crate::{Hold, Optics, Plane, Ring};

    #[test]
    fn factors_make_the_jacobian() {
        let ring = Ring::booster();
        let optics = Optics::of(&ring, Hold::Frequency { offset: 0.0 }).unwrap();
        let observers = [Plane::X, Plane::Y].map(|plane| optics.monitor_places(plane)).concat();
        let magnet = ring.quadrupoles[7].element;
        // a winding of a quadrupole among the correctors
        let sources = [optics.correctors(), vec![optics.winding(magnet, [0.6, 0.8])]].concat();
        let gradients = [optics.quadrupoles(), vec![optics.skew_gradient(magnet)]].concat();
        let factors = optics.response_factors(&observers, &sources, gradients.clone());
        let matrices = optics.response_jacobian(&observers, &sources, &gradients);
        for (gradient, matrix) in matrices.iter().enumerate() {
            for (source, exact) in matrix.column_iter().enumerate() {
                let mut made = vec![0.0; observers.len()];
                factors.add(source, gradient, &mut made);
                let off = made.iter().zip(&exact).map(|(made, exact)| (made - exact).abs()).fold(0.0, f64::max);
                assert!(off < 1e-12 * matrix.amax(), "{gradient} {source}: {off}");
            }
        }
        let weights = DMatrix::from_fn(observers.len(), sources.len(), |i, j| (1.0 + (3 * i + 7 * j) as f64).sin());
        for (back, matrix) in factors.back(&weights).iter().zip(&matrices) {
            assert!((back - weights.dot(matrix)).abs() < 1e-12 * matrix.norm(), "rounding");
        }
    }
}
