//! `orbitcal diagnose`: what is missing in the model of a recording.

use std::path::{Path, PathBuf};

use diagnosis::Diagnosis;
use inference::Recording;
use measured::Folder;
use results::{DiagnosisResult, diagnosis_page, model_file, output};
use twin::Ring;

use super::{CommandError, check_outputs, deliver, machine_with, matrix, progress, recording};
use crate::cli::Diagnose;
use crate::next_plan::{self, NextPlanError};

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Diagnose) -> Result<(), CommandError> {
    if options.recordings.iter().any(|path| Folder::is_one(path)) {
        return matrix::diagnose(options);
    }
    if options.rf.is_some() {
        return Err(CommandError::Input(
            "--rf is for a measured matrix; a recording's header says what the RF held".into(),
        ));
    }
    if options.model_file.is_some() {
        return Err(CommandError::Input(
            "--model-file is for a measured matrix; the model of a recording is its machine file".into(),
        ));
    }
    let outputs = [&options.common.json, &options.report, &options.model_out, &options.plan_out];
    check_outputs(outputs.map(Option::as_deref))?;
    let Some(first) = options.recordings.first() else { return Ok(()) };
    let ring = machine_with(first, options.common.machine.as_deref(), &options.priors)?;
    let recordings = recordings(&options.recordings, &ring)?;
    let Some((recording, others)) = recordings.split_first() else { return Ok(()) };
    let bar = progress(5, "", options.common.quiet);
    let made = Diagnosis::jointly(&ring, recording, others, |what| {
        bar.set_message(what.to_owned());
        bar.inc(1);
    });
    bar.finish_and_clear();
    let diagnosis = made?;
    let result = DiagnosisResult::of(&ring, recording, &diagnosis)?;
    if let Some(path) = &options.report {
        output::bytes(path, diagnosis_page(&diagnosis, recording)?.render().as_bytes())?;
    }
    deliver(&options.common, &result)?;
    if let Some(path) = options.report.as_ref().filter(|_| options.common.speaks()) {
        output::say(format_args!("\n{}", path.display()))?;
    }
    if let (Some(plan), Some(out)) = (&options.plan, &options.plan_out) {
        write_plan(options, &ring, &diagnosis, [plan, out])?;
    }
    options.model_out.as_deref().map_or(Ok(()), |path| write_model(&diagnosis, path))
}

/// One recording, or several at whichever energies they were taken.
fn recordings(folders: &[PathBuf], ring: &Ring) -> Result<Vec<Recording>, CommandError> {
    if let [folder] = folders {
        return Ok(vec![recording(folder, ring)?]);
    }
    let whole = |folder: &PathBuf| folder.canonicalize().unwrap_or_else(|_| folder.clone());
    for (i, folder) in folders.iter().enumerate() {
        if folders[..i].iter().any(|other| whole(other) == whole(folder)) {
            return Err(CommandError::Input(format!("{}: given twice", folder.display())));
        }
    }
    Ok(folders.iter().map(|folder| Recording::read_at_its_energy(folder, ring)).collect::<Result<_, _>>()?)
}

/// Write the measurement that would decide; without anything to decide that is said.
fn write_plan(
    options: &Diagnose,
    ring: &Ring,
    diagnosis: &Diagnosis,
    [plan, out]: [&Path; 2],
) -> Result<(), CommandError> {
    let proposals = diagnosis.proposals().map_err(CommandError::other)?;
    if proposals.is_empty() {
        output::warn(format_args!("{}: not written: no two causes are left to tell apart", out.display()));
        return Ok(());
    }
    let what = next_plan::write(plan, out, ring, &proposals).map_err(|error| match error {
        NextPlanError::Plan(..) => CommandError::Input(error.to_string()),
        error => CommandError::other(error),
    })?;
    if options.common.speaks() {
        Ok(output::say(format_args!("\n{}: a campaign {what}", out.display()))?)
    } else {
        Ok(())
    }
}

/// Write the core's tables of the machine that was found, if they can hold all of it.
fn write_model(diagnosis: &Diagnosis, path: &Path) -> Result<(), CommandError> {
    // with the supplies that the recording has
    let ring = &diagnosis.found.data.ring;
    let failed = |why: String| CommandError::Other(format!("{}: not written: {why}", path.display()));
    if diagnosis.found.best.hypothesis.element.is_some() {
        return Err(failed("the core's tables cannot hold an unknown element".into()));
    }
    let effects = diagnosis.effects();
    if effects.is_empty() {
        return Err(failed("nothing was identified beyond the ring as designed".into()));
    }
    let vars: Vec<f64> = diagnosis.found.best.params.iter().map(|theta| theta.exp()).collect();
    let extended = training::extended::tables(ring, &effects, &vars).map_err(|error| failed(error.to_string()))?;
    let left_out: Vec<&str> = extended.left_out.iter().map(|effect| effect.kind.word()).collect();
    if !left_out.is_empty() {
        return Err(failed(format!("the core's tables cannot hold {}", left_out.join(", "))));
    }
    Ok(model_file::write(path, &ring.name, &extended.tables)?)
}
