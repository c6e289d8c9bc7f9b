//! `orbitcal fit` and `orbitcal diagnose` of a measured response matrix.

use std::path::Path;

use indicatif::ProgressBar;
use measured::{Believed, Folder, Settings, Straightened};
use report::Page;
use results::{DiagnosedMatrix, FittedMatrix, StatedModel, output};
use twin::Rf;
use twin::limits::{self, FILE};

use super::{CommandError, check_outputs, deliver};
use crate::cli::{self, Common, Method, Priors};

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

/// Write a report.
pub(super) fn write(path: &Path, page: &Page) -> Result<(), CommandError> {
    Ok(output::bytes(path, page.render().as_bytes())?)
}

/// The model that is believed, less what is taken out of it.
fn believed(options: &cli::Diagnose) -> Result<Option<Believed>, CommandError> {
    let Some(path) = &options.model_file else { return Ok(None) };
    let wrong = |why: String| CommandError::Input(format!("{}: {why}", path.display()));
    let text = FILE.text(path).map_err(|error| wrong(twin::unreadable(&error)))?;
    let stated: StatedModel = limits::json(&text).map_err(|error| wrong(error.to_string()))?;
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
