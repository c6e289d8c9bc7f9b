//! Functions of the fitted ring with the error bars that the fit leaves them: beta, phase advance, dispersion, tunes.
//!
//! A function `f` of the magnets has the variance of the combination `df/dp` of them ([`crate::uncertainty`]), to first order in their errors.
//! Instruments and the step of the RF frequency change no optics.

use nalgebra::DVector;
use twin::{CalibratedOptics, Kind as Field, OrbitError, Ring, Tunes, Twiss, differentiate};

use crate::error::MeasuredError;
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::hierarchy::Hierarchy;
use crate::lattice::parts;
use crate::model::Model;
use crate::uncertainty::{Marginal, Uncertainty};
use crate::unknowns::{Groups, Unknown};

/// What was fitted: groups of magnets, unknowns, values, and how well they are known.
#[derive(Debug, Clone, Copy)]
pub struct Fitted<'f> {
    groups: &'f Groups,
    unknowns: &'f [Unknown],
    values: &'f DVector<f64>,
    uncertainty: &'f Uncertainty,
}

impl<'f> From<&'f Fit> for Fitted<'f> {
    fn from(Fit { groups, unknowns, values, uncertainty, .. }: &'f Fit) -> Self {
        Self { groups, unknowns, values, uncertainty }
    }
}

impl<'f> From<&'f Hierarchy> for Fitted<'f> {
    fn from(Hierarchy { groups, unknowns, values, uncertainty, .. }: &'f Hierarchy) -> Self {
        Self { groups, unknowns, values, uncertainty }
    }
}

/// The ring of a fit, as LOCO has it or with what an ordinary ring has besides, as a function of its magnets.
#[derive(Debug, Clone)]
pub struct FittedRing<'f> {
    model: Model,
    fit: Fitted<'f>,
    /// Unknowns that are magnets.
    magnets: Vec<usize>,
    uncertainty: Marginal,
}

/// Optics of a fitted ring, on momentum.
#[derive(Debug, Clone)]
pub struct FittedOptics {
    /// At the entrance of every element of the ring, and once more at its end.
    pub twiss: Vec<Twiss>,
    /// Standard deviations of the same.
    pub sigma: Vec<Twiss>,
    /// Tunes with their integer part, and their standard deviations.
    pub tunes: [Tunes; 2],
}

impl<'f> FittedRing<'f> {
    /// Of a fitted measurement.
    ///
    /// # Errors
    /// [`MeasuredError::Lattice`].
    pub fn of(folder: &Folder, fit: impl Into<Fitted<'f>>, settings: &Settings) -> Result<Self, MeasuredError> {
        let fit = fit.into();
        let is_magnet = |at: &usize| fit.unknowns[*at].kind.is_of_machine();
        let magnets: Vec<usize> = (0..fit.unknowns.len()).filter(is_magnet).collect();
        let uncertainty = fit.uncertainty.among(&magnets);
        Ok(Self { model: Model::of(folder, fit.groups, settings.rf)?, fit, magnets, uncertainty })
    }

    /// Its optics.
    ///
    /// # Errors
    /// [`OrbitError`] of unstable motion.
    pub fn optics(&self) -> Result<FittedOptics, OrbitError> {
        let optics = CalibratedOptics::at(&self.values(), |values| self.ring(values))?;
        let (sigma, of_tunes) = optics.sigma_by(|slopes| self.uncertainty.variances(slopes));
        Ok(FittedOptics { tunes: [optics.tunes, of_tunes], twiss: optics.twiss, sigma })
    }

    /// Functions `[M]` of the ring, and their standard deviations.
    ///
    /// # Errors
    /// Those of the functions.
    pub fn functions<E>(&self, of_ring: impl Fn(&Ring) -> Result<DVector<f64>, E>) -> Result<[DVector<f64>; 2], E> {
        let (here, slopes) = differentiate(&self.values(), |values| of_ring(&self.ring(values)))?;
        Ok([here, self.uncertainty.variances(&slopes).map(|variance| variance.max(0.0).sqrt())])
    }

    /// The ring as fitted.
    pub fn best(&self) -> Ring {
        self.ring(&self.values())
    }

    /// Names of the rows of the lattice with a monitor or a quadrupole, in beam order, and their elements of the ring.
    pub fn places(&self, folder: &Folder) -> Vec<(String, usize)> {
        let (ring, cut) = (self.best(), self.fit.groups[1..3].concat().concat());
        let monitors =
            folder.monitors.iter().map(|one| folder.element(one.at)).map(|name| (format!("bpm {name}"), name));
        let magnets = (0..folder.lattice.len()).map(|row| (folder.element(row), cut.contains(&row)));
        let magnets = magnets.map(|(name, is_cut)| (parts(&name, is_cut).0.swap_remove(0), name));
        let is_place =
            |element: usize| matches!(ring.elements[element].kind, Field::Monitor | Field::Quadrupole { .. });
        let place = |(element, name): (String, String)| Some((name, ring.element(&element).ok()?));
        let mut places: Vec<_> = monitors.chain(magnets).filter_map(place).filter(|&(_, at)| is_place(at)).collect();
        places.sort_by_key(|&(_, element)| element);
        places.dedup();
        places
    }

    fn values(&self) -> Vec<f64> {
        self.magnets.iter().map(|&at| self.fit.values[at]).collect()
    }

    fn ring(&self, values: &[f64]) -> Ring {
        let mut all = self.fit.values.clone();
        self.magnets.iter().zip(values).for_each(|(&at, &value)| all[at] = value);
        self.model.at(self.fit.unknowns, &all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::fit;
    use crate::testing::{NOISE, machine, measured, ring};
    use crate::unknowns::Kind;
    use twin::{Hold, Optics};

    /// Mean square error over the variance of both tunes, and of beta at all places, of six imperfect rings.
    #[test]
    fn optics_are_found_within_their_error_bars() {
        let (folder, settings) = (ring(), Settings::default());
        let (mut of_tunes, mut of_beta, mut betas) = (0.0, 0.0, 0.0);
        for seed in 0..6 {
            let truth = machine(&folder, seed);
            let known = truth.0.at(&truth.1, &truth.2);
            let known = Optics::of(&known, Hold::Momentum { delta: 0.0 }).unwrap();
            let (tunes, twiss) = (known.tunes().unwrap(), known.twiss().unwrap());
            let fit = fit(&measured(&folder, &truth, NOISE, 100 + seed), &settings, &mut |_| ()).unwrap();
            let fitted = FittedRing::of(&folder, &fit, &settings).unwrap();
            let found = fitted.optics().unwrap();
            let [best, sigma] = found.tunes;
            of_tunes += (((best.x - tunes.x) / sigma.x).powi(2) + ((best.y - tunes.y) / sigma.y).powi(2)) / 12.0;
            let places = fitted.places(&folder);
            assert_eq!(places.len(), 36); // 12 monitors, 24 quadrupoles
            for (plane, &(_, at)) in [0, 1].into_iter().flat_map(|plane| places.iter().map(move |place| (plane, place)))
            {
                let off = found.twiss[at].beta[plane] - twiss[at].beta[plane];
                of_beta += (off / found.sigma[at].beta[plane]).powi(2);
                betas += 1.0;
            }
        }
        // twelve squares scatter by 0.41; beta of one ring beats in two phases of each plane, so that 24 of all count
        assert!((0.1..2.3).contains(&of_tunes), "{of_tunes}");
        assert!((0.3..1.9).contains(&(of_beta / betas)), "{}", of_beta / betas);
    }

    /// Of each strength of a fit with skew gradients, against the derivative of the coupled modes.
    #[test]
    fn slopes_of_the_tunes_are_the_exact_ones() {
        let (folder, settings) = (ring(), Settings::default());
        let fit = fit(&measured(&folder, &machine(&folder, 3), NOISE, 4), &settings, &mut |_| ()).unwrap();
        let fitted = FittedRing::of(&folder, &fit, &settings).unwrap();
        let tunes = |values: &[f64]| {
            let ring = fitted.ring(values);
            let tunes = Optics::of(&ring, Hold::Momentum { delta: 0.0 })?.tunes()?;
            Ok::<_, OrbitError>(DVector::from_vec(vec![tunes.x, tunes.y]))
        };
        let (_, slopes) = differentiate(&fitted.values(), tunes).unwrap();
        let best = fitted.best();
        let optics = Optics::of(&best, Hold::Momentum { delta: 0.0 }).unwrap();
        for (column, &at) in fitted.magnets.iter().enumerate() {
            let Kind::Strength(group) = fit.unknowns[at].kind else { continue };
            let element = best.element(&folder.element(fit.groups[0][group][0])).unwrap();
            let per_unit = best.elements[element].kind.gradient().unwrap() / fit.values[at];
            let exact = optics.tune_slope(&optics.gradient(element)).map(|slope| slope * per_unit);
            for plane in 0..2 {
                let error = (slopes[(plane, column)] / exact[plane] - 1.0).abs();
                assert!(error < 1e-6, "{error}");
            }
        }
    }
}
