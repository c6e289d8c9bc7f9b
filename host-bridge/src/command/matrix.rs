//! `orbitcal fit` and `orbitcal diagnose` of a measured response matrix.

use std::path::Path;

use indicatif::ProgressBar;
use measured::{Believed, Fit, Folder, MeasuredError, Model, Settings, Straightened, Wiring};
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
    let Straightened { folder, cables, fit: fitted } =
        fitted(&Folder::read(&options.recording)?, &settings, &options.common)?;
    let result = result(&folder, &cables, &fitted, &settings)?;
    if let Some(path) = &options.report {
        write(path, &measured_of(&folder, &fitted, &result, &settings)?.page()?)?;
    }
    deliver(&options.common, &result)
}

/// A fit of a measured matrix as a result, and its page; `say` hears what is done.
///
/// # Errors
/// [`CommandError`].
pub fn fitted_of(
    folder: &Folder,
    settings: &Settings,
    say: &mut dyn FnMut(&str),
) -> Result<(MatrixFit, Page), CommandError> {
    let Straightened { folder, cables, fit } = Straightened::of(folder, settings, say)?;
    let result = result(&folder, &cables, &fit, settings)?;
    let page = measured_of(&folder, &fit, &result, settings)?.page()?;
    Ok((result, page))
}

/// The same of a diagnosis.
///
/// # Errors
/// [`CommandError`].
pub fn diagnosed_of(
    folder: &Folder,
    settings: &Settings,
    say: &mut dyn FnMut(&str),
) -> Result<(MatrixDiagnosis, Page), CommandError> {
    let Straightened { folder, cables, fit: fitted } = Straightened::of(folder, settings, say)?;
    let diagnosis = measured::diagnose(&folder, &fitted, settings, say)?;
    let fit = result(&folder, &cables, &fitted, settings)?;
    let found = Found { cables: &cables, fitted: &fitted, diagnosis: &diagnosis, against: None };
    let result = MatrixDiagnosis::of(&folder, settings.rf, &found, fit);
    let page = measured_of(&folder, &fitted, &result.fit, settings)?.page_of(&result)?;
    Ok((result, page))
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
    let as_measured = Folder::read(path)?;
    let Straightened { folder, cables, fit: fitted } = fitted(&as_measured, &settings, &options.common)?;
    let spinner = spinner(&options.common);
    let mut say = |what: &str| spinner.set_message(what.to_owned());
    let found = measured::diagnose(&folder, &fitted, &settings, &mut say);
    let against = believed.map(|model| measured::against(&as_measured, &fitted, &model, &settings, &mut say));
    spinner.finish_and_clear();
    let (diagnosis, against) = (found?, against.transpose()?);
    let fit = result(&folder, &cables, &fitted, &settings)?;
    let found = Found { cables: &cables, fitted: &fitted, diagnosis: &diagnosis, against: against.as_ref() };
    let result = MatrixDiagnosis::of(&folder, settings.rf, &found, fit);
    if let Some(path) = &options.report {
        write(path, &measured_of(&folder, &fitted, &result.fit, &settings)?.page_of(&result)?)?;
    }
    deliver(&options.common, &result)
}

/// A fit with its ring and that of the lattice.
fn measured_of<'r>(
    folder: &'r Folder,
    fit: &'r Fit,
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
    let spinner = spinner(common);
    let mut say = |what: &str| spinner.set_message(format!("{}: {what}", folder.name));
    let fitted = Straightened::of(folder, settings, &mut say);
    spinner.finish_and_clear();
    Ok(fitted?)
}

pub(super) fn spinner(common: &Common) -> ProgressBar {
    let spinner = if common.quiet { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
    spinner.enable_steady_tick(core::time::Duration::from_millis(100));
    spinner
}

fn result(folder: &Folder, cables: &[Wiring], fitted: &Fit, settings: &Settings) -> Result<MatrixFit, CommandError> {
    let ring = Model::of(folder, &fitted.groups, settings.rf)?.at(&fitted.unknowns, &fitted.values);
    let tunes = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).ok().and_then(|optics| optics.tunes().ok());
    Ok(MatrixFit::of(folder, cables, fitted, tunes.map(|tunes| [tunes.x, tunes.y])))
}
