//! A measured response matrix fitted and diagnosed: the results of `orbitcal fit` and `orbitcal diagnose`, and their pages.

use measured::{Believed, Diagnosis, FittedOptics, FittedRing, Folder, Model, Settings, Straightened};
use nalgebra::DVector;
use report::Page;

use crate::error::CommandError;
use crate::fit_result::Tunes;
use crate::matrix_diagnosis::MatrixDiagnosis;
use crate::matrix_page::Measured;
use crate::matrix_result::MatrixFit;
use crate::optics::optics_at;

/// A measured matrix with its cables put right, fitted.
pub struct FittedMatrix {
    straightened: Straightened,
    settings: Settings,
    /// What is said of it.
    pub result: MatrixFit,
}

impl FittedMatrix {
    /// Of a measurement as it was made; `say` hears what is done.
    ///
    /// # Errors
    /// [`CommandError`].
    pub fn of(as_measured: &Folder, settings: Settings, say: &mut dyn FnMut(&str)) -> Result<Self, CommandError> {
        let straightened = Straightened::of(as_measured, &settings, say)?;
        let result = result(&straightened, &settings)?;
        Ok(Self { straightened, settings, result })
    }

    /// Its page.
    ///
    /// # Errors
    /// [`CommandError`] where the lattice or the fitted ring has no stable motion.
    pub fn page(&self) -> Result<Page, CommandError> {
        Ok(measured_of(&self.straightened, &self.result, &self.settings)?.page()?)
    }
}

/// A measured matrix with its cables put right, fitted and diagnosed.
pub struct DiagnosedMatrix {
    straightened: Straightened,
    settings: Settings,
    /// What is said of it.
    pub result: MatrixDiagnosis,
}

impl DiagnosedMatrix {
    /// Of a measurement as it was made, against a model that is believed if there is one; `say` hears what is done.
    ///
    /// # Errors
    /// [`CommandError`].
    pub fn of(
        as_measured: &Folder,
        believed: Option<&Believed>,
        settings: Settings,
        say: &mut dyn FnMut(&str),
    ) -> Result<Self, CommandError> {
        let straightened = Straightened::of(as_measured, &settings, say)?;
        let Straightened { folder, cables, fit: fitted } = &straightened;
        let diagnosis = Diagnosis::of_fit((folder, cables), fitted, &settings, say)?;
        let against = believed.map(|model| measured::against(as_measured, fitted, model, &settings, say));
        let against = against.transpose()?;
        let fit = result(&straightened, &settings)?;
        let result = MatrixDiagnosis::of(folder, fitted, &diagnosis, against.as_ref(), fit);
        Ok(Self { straightened, settings, result })
    }

    /// Its page.
    ///
    /// # Errors
    /// As [`FittedMatrix::page`].
    pub fn page(&self) -> Result<Page, CommandError> {
        Ok(measured_of(&self.straightened, &self.result.loco, &self.settings)?.page_of(&self.result)?)
    }
}

/// A fit with its ring and that of the lattice.
fn measured_of<'r>(
    Straightened { folder, fit, .. }: &'r Straightened,
    result: &'r MatrixFit,
    settings: &Settings,
) -> Result<Measured<'r>, CommandError> {
    let model = Model::of(folder, &fit.groups, settings.rf)?;
    let rings = [model.at(&[], &DVector::zeros(0)), model.at(&fit.unknowns, &fit.values)];
    let optics = FittedRing::of(folder, fit, settings)?.optics()?;
    Ok(Measured { folder, fit, result, rings, optics })
}

fn result(Straightened { folder, cables, fit }: &Straightened, settings: &Settings) -> Result<MatrixFit, CommandError> {
    let ring = FittedRing::of(folder, fit, settings)?;
    let optics = ring.optics().map(|FittedOptics { twiss, sigma, tunes }| {
        (
            Some(Tunes::of_fit([tunes[0].x, tunes[0].y], Some(tunes[1]))),
            optics_at(&ring.best(), &ring.places(folder), &twiss, &sigma),
        )
    });
    Ok(MatrixFit::of(folder, cables, fit, optics.unwrap_or_default()))
}
