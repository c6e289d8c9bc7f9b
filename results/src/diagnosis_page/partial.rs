//! What effects do to the readings, and what is measured of it: a fit with the effects taken out, everything else as fitted.

use core::ops::RangeInclusive;

use diagnosis::{Data, FitError, Fitted, Hypothesis, Term, predicted};
use nalgebra::{DMatrix, DVector};
use twin::{Drives, EffectError, Machine};

/// Some effects of a fit.
pub struct Partial<'f> {
    /// The fit with them.
    pub fitted: &'f Fitted,
    /// The data as it whitens them.
    pub data: &'f Data,
    /// Whitened readings less those predicted without the effects.
    pub measured: DVector<f64>,
    /// Whitened change of the readings that the effects make, as predicted.
    pub predicted: DVector<f64>,
    /// Tunes on the orbit without kicks, predicted without the effects, from the start of the campaign to its end.
    pub tunes: [RangeInclusive<f64>; 2],
}

impl<'f> Partial<'f> {
    /// Some terms of a fit.
    ///
    /// # Errors
    /// [`FitError`] where the machine without the effects keeps no beam.
    pub fn of(data: &'f Data, fitted: &'f Fitted, is_of: impl Fn(&Term) -> bool) -> Result<Self, FitError> {
        Self::beyond(data, fitted, &fitted.hypothesis.without_terms(is_of))
    }

    /// What a fit has beyond a hypothesis.
    ///
    /// # Errors
    /// [`FitError`] where the machine without that keeps no beam.
    pub fn beyond(data: &'f Data, fitted: &'f Fitted, less: &Hypothesis) -> Result<Self, FitError> {
        let data = fitted.data(data);
        let (vars, u) = (fitted.params.len(), fitted.guess(data, less));
        let (machine, drives) = less.machine(data, 0, &fitted.params, &u.as_slice()[vars..])?;
        let measured = data.residual(&diagnosis::predicted_by(data, less, 0, &u)?);
        let predicted = &measured - fitted.residual_of(data)?.rows(0, data.size());
        let of_element =
            diagnosis::of_element(data, less, 0, (&machine, &drives), &u)?.map_or([0.0; 2], |own| own.tunes);
        let ends = ends(&machine, &drives)?;
        let tunes = [0, 1].map(|plane| {
            let (ends, moved) = (&ends[plane], of_element[plane]);
            ends.start() + moved..=ends.end() + moved
        });
        Ok(Self { fitted, data, measured, predicted, tunes })
    }

    /// What the fit leaves with the effects.
    pub fn left(&self) -> DVector<f64> {
        &self.measured - &self.predicted
    }

    /// Share of the tune meter in what tells of the effects, their change `d` less all that the other unknowns can absorb:
    /// `|P d|^2` of the tunes over that of all numbers.
    ///
    /// # Errors
    /// [`FitError::Degenerate`].
    pub fn share_of_tunes(&self, index: usize) -> Result<f64, FitError> {
        let jacobian = self.fitted.jacobian.rows(0, self.data.size()).into_owned();
        let jacobian = match self.fitted.unknown(self.data, index) {
            Some((at, _)) => jacobian.remove_column(at),
            None => jacobian,
        };
        let back = jacobian.transpose();
        let normal = &back * &jacobian + DMatrix::identity(jacobian.ncols(), jacobian.ncols());
        let taken = normal.cholesky().ok_or(FitError::Degenerate)?.solve(&(&back * &self.predicted));
        let seen = &self.predicted - jacobian * taken;
        let tunes: f64 = self
            .data
            .places()
            .iter()
            .zip(seen.iter())
            .filter(|((_, c), _)| *c >= self.data.monitors())
            .map(|(_, d)| d * d)
            .sum();
        Ok(tunes / seen.norm_squared().max(f64::MIN_POSITIVE))
    }
}

/// Tunes of a machine on the orbit without kicks at the start of the campaign and at its end.
///
/// # Errors
/// [`EffectError`].
pub fn ends(machine: &Machine, drives: &Drives) -> Result<[RangeInclusive<f64>; 2], EffectError> {
    let still = predicted(machine, &drives.still())?;
    let (first, last) = (drives.time.imin(), drives.time.imax());
    Ok([0, 1].map(|plane| still.tune(plane, first)..=still.tune(plane, last)))
}
