//! Functions of the fitted ring with the error bars that the fit leaves them: beta, phase advance, dispersion, tunes.
//!
//! A function `f` of the magnets has the variance of the combination `df/dp` of them ([`crate::uncertainty`]), to first order in their errors.
//! Instruments and the step of the RF frequency change no optics.

use nalgebra::DVector;
use twin::{CalibratedOptics, Kind as Field, OrbitError, Ring, Tunes, Twiss, differentiate};

use crate::error::MeasuredError;
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::lattice::parts;
use crate::model::Model;
use crate::uncertainty::Marginal;
use crate::unknowns::Kind;

/// The ring of a fit as a function of its magnets.
#[derive(Debug, Clone)]
pub struct FittedRing<'f> {
    model: Model,
    fit: &'f Fit,
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
    pub fn of(folder: &Folder, fit: &'f Fit, settings: &Settings) -> Result<Self, MeasuredError> {
        let is_magnet = |kind: Kind| {
            matches!(kind, Kind::Strength(_) | Kind::Added(_) | Kind::Skew(_) | Kind::Gradient(_) | Kind::Wiggler(_))
        };
        let magnets: Vec<usize> = (0..fit.unknowns.len()).filter(|&at| is_magnet(fit.unknowns[at].kind)).collect();
        let uncertainty = fit.uncertainty.among(&magnets);
        Ok(Self { model: Model::of(folder, &fit.groups, settings.rf)?, fit, magnets, uncertainty })
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
        self.model.at(&self.fit.unknowns, &all)
    }
}
