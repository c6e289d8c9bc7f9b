//! `orbitcal fit` and `orbitcal diagnose` of a measured response matrix.

use std::path::Path;

use indicatif::ProgressBar;
use measured::{Believed, Folder, MeasuredError, Model, Settings, Straightened};
use nalgebra::DVector;
use report::Page;
use twin::{Hold, Optics, Rf};

use super::{CommandError, check_outputs, deliver};
use crate::cli::{self, Common, Method, Priors};
use crate::matrix_page::Measured;
use crate::matrix_result::{Found, MatrixDiagnosis, MatrixFit, StatedModel};
use crate::output;

impl From<MeasuredError> for CommandError {
    fn from(error: MeasuredError) -> Self {
        match error {
            MeasuredError::Orbit(_) | MeasuredError::Singular(_) => Self::Other(error.to_string()),
            _ => Self::Input(error.to_string()),
        }
    }
}

/// Fit it.
///
/// # Errors
/// [`CommandError`].
pub fn fit(options: &cli::Fit) -> Result<(), CommandError> {
    let refused = |what: &str| {
        Err(CommandError::Input(format!(
            "{what} is for a recording; {} is a measured matrix",
            options.recording.display()
        )))
    };
    if options.method == Method::Nuts {
        return refused("--method nuts");
    }
    if options.common.machine.is_some() {
        return refused("--machine");
    }
    check_outputs([options.common.json.as_deref(), options.report.as_deref()])?;
    let settings = settings(options.rf, &options.priors)?;
    let folder = Folder::read(&options.recording)?;
    let fitted = with_spinner(&options.common, &folder, |say| FittedMatrix::of(&folder, settings, say))?;
    if let Some(path) = &options.report {
        write(path, &fitted.page()?)?;
    }
    deliver(&options.common, &fitted.result)
}

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
        let diagnosis = measured::diagnose(folder, fitted, &settings, say)?;
        let against = believed.map(|model| measured::against(as_measured, fitted, model, &settings, say));
        let against = against.transpose()?;
        let fit = result(&straightened, &settings)?;
        let found = Found { cables, fitted, diagnosis: &diagnosis, against: against.as_ref() };
        let result = MatrixDiagnosis::of(folder, settings.rf, &found, fit);
        Ok(Self { straightened, settings, result })
    }

    /// Its page.
    ///
    /// # Errors
    /// As [`FittedMatrix::page`].
    pub fn page(&self) -> Result<Page, CommandError> {
        Ok(measured_of(&self.straightened, &self.result.fit, &self.settings)?.page_of(&self.result)?)
    }
}

/// Diagnose it.
///
/// # Errors
/// [`CommandError`].
pub fn diagnose(options: &cli::Diagnose) -> Result<(), CommandError> {
    let [path] = options.recordings.as_slice() else {
        return Err(CommandError::Input("one measured matrix at a time; `orbitcal compare A B` compares two".into()));
    };
    if options.model_out.is_some() {
        let problem = format!("--model-out is for recordings; {} is a measured matrix", path.display());
        return Err(CommandError::Input(problem));
    }
    check_outputs([options.common.json.as_deref(), options.report.as_deref()])?;
    let settings = settings(options.rf, &options.priors)?;
    let believed = believed(options)?;
    let folder = Folder::read(path)?;
    let diagnose = |say: &mut dyn FnMut(&str)| DiagnosedMatrix::of(&folder, believed.as_ref(), settings, say);
    let diagnosed = with_spinner(&options.common, &folder, diagnose)?;
    if let Some(path) = &options.report {
        write(path, &diagnosed.page()?)?;
    }
    deliver(&options.common, &diagnosed.result)
}

/// A fit with its ring and that of the lattice.
fn measured_of<'r>(
    Straightened { folder, fit, .. }: &'r Straightened,
    result: &'r MatrixFit,
    settings: &Settings,
) -> Result<Measured<'r>, CommandError> {
    let model = Model::of(folder, &fit.groups, settings.rf)?;
    let rings = [model.at(&[], &DVector::zeros(0)), model.at(&fit.unknowns, &fit.values)];
    Ok(Measured { folder, fit, result, rings })
}

/// Write a report.
pub(super) fn write(path: &Path, page: &Page) -> Result<(), CommandError> {
    Ok(output::bytes(path, page.render().as_bytes())?)
}

/// The model that is believed, less what is taken out of it.
fn believed(options: &cli::Diagnose) -> Result<Option<Believed>, CommandError> {
    let Some(path) = &options.model_file else { return Ok(None) };
    let wrong = |why: String| CommandError::Input(format!("{}: {why}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let stated: StatedModel = serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?;
    let mut model = stated.into();
    for named in &options.without {
        Believed::take_out(&mut model, named)?;
    }
    Ok(Some(model))
}

/// How a matrix is fitted.
pub(super) fn settings(rf: Option<cli::Rf>, priors: &Priors) -> Result<Settings, CommandError> {
    if priors.range.is_some() {
        return Err(CommandError::Input("--range is for a recording; vars of a measured matrix have no bounds".into()));
    }
    let mut settings = Settings { rf: rf.map_or(Rf::FixedFrequency, Into::into), ..Settings::default() };
    settings.widths.strength = priors.prior_width.unwrap_or(settings.widths.strength);
    Ok(settings)
}

/// A matrix with its cables put right, and its fit, with what is done on a terminal.
pub(super) fn fitted(folder: &Folder, settings: &Settings, common: &Common) -> Result<Straightened, CommandError> {
    with_spinner(common, folder, |say| Ok(Straightened::of(folder, settings, say)?))
}

/// Work on a folder, with what is done on a terminal.
fn with_spinner<T>(
    common: &Common,
    folder: &Folder,
    work: impl FnOnce(&mut dyn FnMut(&str)) -> Result<T, CommandError>,
) -> Result<T, CommandError> {
    let spinner = spinner(common);
    let done = work(&mut |what| spinner.set_message(format!("{}: {what}", folder.name)));
    spinner.finish_and_clear();
    done
}

pub(super) fn spinner(common: &Common) -> ProgressBar {
    let spinner = if common.quiet { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
    spinner.enable_steady_tick(core::time::Duration::from_millis(100));
    spinner
}

fn result(Straightened { folder, cables, fit }: &Straightened, settings: &Settings) -> Result<MatrixFit, CommandError> {
    let ring = Model::of(folder, &fit.groups, settings.rf)?.at(&fit.unknowns, &fit.values);
    let tunes = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).ok().and_then(|optics| optics.tunes().ok());
    Ok(MatrixFit::of(folder, cables, fit, tunes.map(|tunes| [tunes.x, tunes.y])))
}
