//! `orbitcal conceal`: an effect put into measured data, its answer key beside the folder.

use std::fs;
use std::path::{Path, PathBuf};

use inference::{BaseModel, BatchFit, TuneUse, simulate};
use measured::Folder;
use results::output;
use serde_json::{Value, json};
use validation::{Cases, Class};

use super::{CommandError, campaign, machine_for, matrix, recording};
use crate::cli::Conceal;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Conceal) -> Result<(), CommandError> {
    let key = key_of(&options.out);
    if options.out.exists() || key.exists() {
        let (out, key) = (options.out.display(), key.display());
        return Err(CommandError::Input(format!("{out} or {key} exists; neither is overwritten")));
    }
    let effect = if Folder::is_one(&options.data) { into_matrix(options)? } else { into_recording(options)? };
    let text = serde_json::to_string_pretty(&effect).map_err(CommandError::other)?;
    fs::write(&key, text + "\n").map_err(|error| CommandError::Other(format!("{}: {error}", key.display())))?;
    match options.common.speaks() {
        true => Ok(output::say(format_args!("{}; its answer key is {}", options.out.display(), key.display()))?),
        false => Ok(()),
    }
}

/// `OUT.truth.json` beside `OUT`.
fn key_of(out: &Path) -> PathBuf {
    let mut name = out.file_name().unwrap_or_default().to_owned();
    name.push(".truth.json");
    out.with_file_name(name)
}

fn into_recording(options: &Conceal) -> Result<Value, CommandError> {
    let ring = machine_for(&options.data, options.common.machine.as_deref())?;
    let given = recording(&options.data, &ring)?;
    let campaign = campaign(&ring, &given)?;
    let cases = Cases::of(&campaign).map_err(|error| CommandError::Input(error.to_string()))?;
    let effects = cases.draw(Class::Single, options.seed as usize, options.seed).effects;
    let fit = BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ())?;
    let vars: Vec<f64> = fit.map_params.iter().map(|theta| theta.exp()).collect();
    let concealed = simulate::conceal(&given, &ring, &vars, &effects).map_err(CommandError::other)?;
    concealed.write(&options.out, &ring).map_err(CommandError::other)?;
    let effects: Vec<Value> = effects
        .iter()
        .map(|effect| json!({"kind": effect.kind.word(), "at": effect.site.name(&ring), "amplitude": effect.amplitude}))
        .collect();
    Ok(json!({"seed": options.seed, "effects": effects}))
}

fn into_matrix(options: &Conceal) -> Result<Value, CommandError> {
    let settings = measured::Settings::default();
    // what is put in is all that is wrong with its cables
    let measured::Straightened { folder, fit, .. } =
        matrix::fitted(&Folder::read(&options.data)?, &settings, &options.common)?;
    let (concealed, effect) = measured::conceal(&folder, &fit, &settings, options.seed)?;
    measured::conceal::write(&options.data, &concealed, &options.out)?;
    let effects = json!([{"kind": effect.kind, "at": effect.at, "amplitude": effect.amplitude, "gain": effect.gain}]);
    Ok(json!({"seed": options.seed, "effects": effects}))
}
