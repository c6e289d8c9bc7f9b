//! `orbitcal compare`: what changed between two measurements of one machine.

use measured::Folder;
use results::{compare_matrices, compare_recordings, comparison_page};

use super::{CommandError, check_outputs, deliver, machine_with, matrix, recording};
use crate::cli::Compare;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Compare) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref(), options.report.as_deref()])?;
    let compared = match [&options.before, &options.after].map(|path| Folder::is_one(path)) {
        [true, true] => {
            let settings = matrix::settings(options.rf, &options.priors)?;
            let [before, after] = [&options.before, &options.after].map(|path| Folder::read(path));
            let spinner = matrix::spinner(&options.common);
            let compared =
                compare_matrices([&before?, &after?], &settings, &mut |what| spinner.set_message(what.to_owned()));
            spinner.finish_and_clear();
            compared?
        }
        [false, false] => {
            let ring = machine_with(&options.before, options.common.machine.as_deref(), &options.priors)?;
            let [before, after] = [&options.before, &options.after].map(|path| recording(path, &ring));
            compare_recordings(&ring, [&before?, &after?], |_| ())?
        }
        _ => {
            let (a, b) = (options.before.display(), options.after.display());
            return Err(CommandError::Input(format!(
                "of {a} and {b} one is a measured matrix, one a recording of frames"
            )));
        }
    };
    if let Some(path) = &options.report {
        let names = [&options.before, &options.after]
            .map(|path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned());
        matrix::write(path, &comparison_page(&compared, [&names[0], &names[1]]))?;
    }
    deliver(&options.common, &compared)
}
