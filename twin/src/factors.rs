//! Derivatives of an orbit response kept as factors: as matrices those of a ring with 400 magnets, 470 readings and 413 correctors fill 600 MB.
//!
//! What a source sends into a gradient, a column of six, is seen by all observers through six columns:
//!
//! `dG_ij/dk = [-a_i (W + step) Q] [(W + step) c_j]`,
//!
//! as in [`Optics::response_jacobian`], whose matrices these are.

use nalgebra::{Matrix6, RowVector6, Vector6};

use crate::response::{Gradient, Observer, Optics, Place, Source, seen_rows};

/// Derivatives of [`Optics::response`] by gradients, made column by column.
#[derive(Debug, Clone)]
pub struct ResponseFactors {
    /// `a W` and `a (W + 1)` of each observer, with its place.
    observers: Vec<(Place, [RowVector6<f64>; 2])>,
    /// Each source with what it sends to places before and behind it.
    sources: Vec<(Source, [Vector6<f64>; 2])>,
    /// Each gradient with `-a (W + step) Q`, rows observers.
    gradients: Vec<(Gradient, [Vec<f64>; 6])>,
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
        let through = |gradient: Gradient| {
            let rows: Vec<_> = seen
                .iter()
                .map(|(place, rows)| -(rows[usize::from(gradient.place < *place)] * gradient.kernel))
                .collect();
            (gradient, core::array::from_fn(|column| rows.iter().map(|row| row[column]).collect()))
        };
        ResponseFactors {
            sources: sources.iter().map(|one| (*one, [self.closed * one.column, far * one.column])).collect(),
            gradients: gradients.into_iter().map(through).collect(),
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
        let (source, [near, far]) = &self.sources[source];
        let (gradient, seen) = &self.gradients[gradient];
        let within = gradient.within(source);
        let sent = if within.is_none() && source.place <= gradient.place { far } else { near };
        // slices of one length: the loop is over four or eight observers at once
        let rows = into.len();
        let [x, px, y, py, delta, path] = seen.each_ref().map(|column| &column[..rows]);
        let [to_x, to_px, to_y, to_py, to_delta, to_path] = (*sent).into();
        for i in 0..rows {
            let [a, b] = [x[i] * to_x + px[i] * to_px, y[i] * to_y + py[i] * to_py];
            into[i] += a + b + (delta[i] * to_delta + path[i] * to_path);
        }
        if let Some(within) = within {
            for (into, (place, rows)) in into.iter_mut().zip(&self.observers) {
                *into -= (rows[usize::from(gradient.place < *place)] * within)[0];
            }
        }
    }
}

#[cfg(test)]
mod tests {
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
    }
}
