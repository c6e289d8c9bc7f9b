//! Derivatives of an orbit response kept as factors: as matrices those of a ring with 400 magnets, 470 readings and 413 correctors fill 600 MB.
//!
//! What a source sends into a gradient, a column of six, is seen by all observers through six columns:
//!
//! `dG_ij/dk = [-a_i (W + step) Q] [(W + step) c_j]`,
//!
//! as in [`Optics::response_jacobian`], whose matrices these are.

use core::array;

use nalgebra::{DMatrix, DMatrixView, DVector, Matrix6, RowVector6, Vector6};

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

    /// Add so many times the derivatives of some orbits by a gradient, of all observers in turn for each orbit; an orbit may have several sources.
    pub fn add_orbits(&self, orbits: &[&[usize]], gradient: usize, times: f64, into: &mut [f64]) {
        let count = self.observers.len();
        let [a, b, c, d, e, f] = array::from_fn(|sixth| self.seen.column(6 * gradient + sixth).data.into_slice());
        for (orbit, sources) in into.chunks_exact_mut(count).zip(orbits) {
            let sent: [f64; 6] = (self.sent_by(sources, gradient) * times).into();
            let seen = a.iter().zip(b).zip(c).zip(d).zip(e).zip(f);
            for (orbit, (((((a, b), c), d), e), f)) in orbit.iter_mut().zip(seen) {
                *orbit += a * sent[0] + b * sent[1] + c * sent[2] + d * sent[3] + e * sent[4] + f * sent[5];
            }
            for within in sources.iter().filter_map(|&source| self.within(source, gradient)) {
                orbit.iter_mut().zip(within).for_each(|(orbit, within)| *orbit -= times * within);
            }
        }
    }

    /// `sum_i w_ij dG_ij/dk` of each orbit `j`, rows, and gradient `k`, columns, with weights of all observers, the rows, and orbits, the columns: one product,
    /// without a derivative.
    pub fn by_orbit(&self, orbits: &[&[usize]], weights: &DMatrixView<f64>) -> DMatrix<f64> {
        let through = weights.transpose() * &self.seen;
        DMatrix::from_fn(orbits.len(), self.count(), |orbit, gradient| {
            let weights = weights.column(orbit);
            let within = orbits[orbit].iter().filter_map(|&source| self.within(source, gradient));
            let within = within.flat_map(|within| within.zip(&weights)).map(|(within, weight)| within * weight);
            let within: f64 = within.sum();
            (through.fixed_view::<1, 6>(orbit, 6 * gradient) * self.sent_by(orbits[orbit], gradient))[0] - within
        })
    }

    /// `sum_j w_ij dG_ij/dk` of each observer `i`, rows, and gradient `k`, columns, likewise.
    pub fn by_observer(&self, orbits: &[&[usize]], weights: &DMatrixView<f64>) -> DMatrix<f64> {
        let through = weights * self.sent(orbits).transpose();
        let mut said = DMatrix::from_fn(self.observers.len(), self.count(), |observer, gradient| {
            let seen = self.seen.fixed_view::<1, 6>(observer, 6 * gradient);
            seen.dot(&through.fixed_view::<1, 6>(observer, 6 * gradient))
        });
        for (gradient, mut said) in said.column_iter_mut().enumerate() {
            for (weights, sources) in weights.column_iter().zip(orbits) {
                for within in sources.iter().filter_map(|&source| self.within(source, gradient)) {
                    said.iter_mut().zip(within).zip(&weights).for_each(|((said, one), weight)| *said -= one * weight);
                }
            }
        }
        said
    }

    /// `sum_k dG_ij/dk t_k` of all observers, the rows, and orbits, the columns, with a step of each gradient: one product, without a derivative.
    pub fn forward(&self, orbits: &[&[usize]], step: &DVector<f64>) -> DMatrix<f64> {
        let mut sent = self.sent(orbits);
        for (gradient, step) in step.iter().enumerate() {
            sent.rows_mut(6 * gradient, 6).scale_mut(*step);
        }
        let mut moved = &self.seen * sent;
        for (mut orbit, sources) in moved.column_iter_mut().zip(orbits) {
            for (gradient, step) in step.iter().enumerate() {
                for within in sources.iter().filter_map(|&source| self.within(source, gradient)) {
                    orbit.iter_mut().zip(within).for_each(|(orbit, within)| *orbit -= within * step);
                }
            }
        }
        moved
    }

    /// What each orbit's sources send to all gradients, six rows a gradient.
    fn sent(&self, orbits: &[&[usize]]) -> DMatrix<f64> {
        let mut sent = DMatrix::zeros(self.seen.ncols(), orbits.len());
        for (mut sent, sources) in sent.column_iter_mut().zip(orbits) {
            for gradient in 0..self.count() {
                sent.fixed_rows_mut::<6>(6 * gradient).copy_from(&self.sent_by(sources, gradient));
            }
        }
        sent
    }

    /// What some sources send to a gradient.
    fn sent_by(&self, sources: &[usize], gradient: usize) -> Vector6<f64> {
        let gradient = &self.gradients[gradient];
        let sent = |&source: &usize| {
            let (source, [near, far]) = &self.sources[source];
            let is_before = gradient.within(source).is_none() && source.place <= gradient.place;
            if is_before { far } else { near }
        };
        sources.iter().map(sent).sum()
    }

    /// What all observers see of a source in a gradient's own element, none if it is not there.
    fn within(&self, source: usize, gradient: usize) -> Option<impl Iterator<Item = f64>> {
        let gradient = &self.gradients[gradient];
        let within = gradient.within(&self.sources[source].0)?;
        Some(self.observers.iter().map(move |(place, rows)| (rows[usize::from(gradient.place < *place)] * within)[0]))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

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
                factors.add_orbits(&[&[source]], gradient, 1.0, &mut made);
                let off = made.iter().zip(&exact).map(|(made, exact)| (made - exact).abs()).fold(0.0, f64::max);
                assert!(off < 1e-12 * matrix.amax(), "{gradient} {source}: {off}");
            }
        }
        // an orbit of two sources
        let orbits: Vec<Vec<usize>> = (0..sources.len() - 1).map(|first| vec![first, first + 1]).collect();
        let orbits: Vec<&[usize]> = orbits.iter().map(Vec::as_slice).collect();
        let weights = DMatrix::from_fn(observers.len(), orbits.len(), |i, j| (1.0 + (3 * i + 7 * j) as f64).sin());
        let by_orbit = factors.by_orbit(&orbits, &weights.as_view());
        let by_observer = factors.by_observer(&orbits, &weights.as_view());
        let step = DVector::from_fn(gradients.len(), |i, _| (1.0 + i as f64).cos());
        let mut moved = factors.forward(&orbits, &step);
        for (gradient, matrix) in matrices.iter().enumerate() {
            let exact = matrix.columns_range(..orbits.len()) + matrix.columns_range(1..);
            let mut made = exact.clone();
            factors.add_orbits(&orbits, gradient, 2.0, made.as_mut_slice());
            assert!((made - 3.0 * &exact).amax() < 1e-12 * matrix.amax(), "{gradient}: rounding");
            let weighted = weights.component_mul(&exact);
            let off = (by_orbit.column(gradient) - weighted.row_sum_tr()).amax();
            assert!(off < 1e-12 * matrix.norm(), "{gradient}: rounding");
            let off = (by_observer.column(gradient) - weighted.column_sum()).amax();
            assert!(off < 1e-12 * matrix.norm(), "{gradient}: rounding");
            moved -= exact * step[gradient];
        }
        assert!(moved.amax() < 1e-11 * matrices.iter().map(|one| one.amax()).fold(0.0, f64::max), "rounding");
    }
}
