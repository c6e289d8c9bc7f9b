//! A measurement written as the folder that [`Folder::read`] reads.

use std::path::Path;
use std::{fs, io};

use nalgebra::DMatrix;
use serde_json::{Value, json};
use twin::Plane;

use measured::lattice::machine;
use measured::{Folder, MeasuredError, Settings, expect_fit};

/// Write it to a folder that is made, with the ring as a machine file (`machine.json`) for `orbitcal export`. The folder appears as a whole, and only
/// where `fit` takes what was written.
///
/// # Errors
/// [`MeasuredError`]: the folder exists, cannot be written, or is none that can be fitted.
pub fn write(folder: &Folder, to: &Path, settings: &Settings) -> Result<(), MeasuredError> {
    let failed = |source| MeasuredError::Read { file: to.display().to_string(), source };
    if to.exists() {
        return Err(failed(io::ErrorKind::AlreadyExists.into()));
    }
    let beside = to.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // of the same file system, and gone with an error
    let made = tempfile::Builder::new().prefix(".orbitcal-").tempdir_in(beside).map_err(failed)?;
    let whole = made.path().join("ring");
    tables(folder, &whole)?;
    expect_fit(&Folder { name: folder.name.clone(), ..Folder::read(&whole)? }, settings)?;
    fs::rename(&whole, to).map_err(failed)
}

fn tables(folder: &Folder, to: &Path) -> Result<(), MeasuredError> {
    fs::create_dir(to).map_err(|source| MeasuredError::Read { file: to.display().to_string(), source })?;
    lattice(folder, &to.join("lattice.csv"))?;
    monitors(folder, &to.join("bpms.csv"))?;
    correctors(folder, &to.join("correctors.csv"))?;
    let columns: Vec<String> = (0..folder.correctors.len()).map(|column| folder.corrector(column)).collect();
    matrix(folder, &columns, &folder.matrix, &to.join("orm_measured_mm.csv"))?;
    if let Some(dispersion) = &folder.dispersion {
        let one = DMatrix::from_column_slice(dispersion.len(), 1, dispersion.as_slice());
        matrix(folder, &["dispersion".into()], &one, &to.join("dispersion_orbit_mm.csv"))?;
    }
    meta(folder, &to.join("meta.json"))?;
    json(&to.join("machine.json"), &machine(folder, &[], &[]))
}

fn lattice(folder: &Folder, file: &Path) -> Result<(), MeasuredError> {
    let head = "name,s_entrance_m,length_m,bend_rad,edge_in_rad,edge_out_rad,edge_fringe_m,k1_start_1_m2,k2_half_1_m3";
    let rows = folder.lattice.iter().map(|one| {
        let numbers = [one.s, one.length, one.bend, one.edge_in, one.edge_out, one.fringe, one.k1, one.half_k2]
            .map(|number| number.to_string());
        core::iter::once(one.name.clone()).chain(numbers).collect()
    });
    table(file, head.split(',').map(str::to_owned).collect(), rows)
}

fn monitors(folder: &Folder, file: &Path) -> Result<(), MeasuredError> {
    let head = ["plane", "lattice_index", "sigma_mm", "used_by_reference_fit"].map(str::to_owned).to_vec();
    let rows = folder.monitors.iter();
    let rows = rows
        .map(|one| vec![word(one.plane), one.at.to_string(), one.sigma.to_string(), u8::from(one.is_used).to_string()]);
    table(file, head, rows)
}

fn correctors(folder: &Folder, file: &Path) -> Result<(), MeasuredError> {
    let head = ["plane", "lattice_index", "nominal_kick_mrad", "used_by_reference_fit"].map(str::to_owned).to_vec();
    let rows = folder.correctors.iter();
    let rows = rows
        .map(|one| vec![word(one.plane), one.at.to_string(), one.kick.to_string(), u8::from(one.is_used).to_string()]);
    table(file, head, rows)
}

fn word(plane: Plane) -> String {
    if plane == Plane::X { "x".into() } else { "y".into() }
}

fn matrix(folder: &Folder, columns: &[String], numbers: &DMatrix<f64>, file: &Path) -> Result<(), MeasuredError> {
    let head = core::iter::once(String::new()).chain(columns.iter().cloned()).collect();
    let rows = numbers.row_iter().enumerate().map(|(line, row)| {
        let cells = row.iter().map(|one| if one.is_finite() { one.to_string() } else { String::new() });
        core::iter::once(folder.monitor(line)).chain(cells).collect()
    });
    table(file, head, rows)
}

fn meta(folder: &Folder, file: &Path) -> Result<(), MeasuredError> {
    let meta = &folder.meta;
    let mut value = json!({
        "circumference_m": meta.circumference,
        "energy_GeV": meta.energy,
        "particle": meta.particle,
        "rf_Hz": meta.rf,
        "delta_rf_Hz": meta.delta_rf,
    });
    if let Some(fit) = &meta.reference_fit {
        value["reference_fit"] = json!(fit);
    }
    json(file, &value)
}

fn json(file: &Path, value: &Value) -> Result<(), MeasuredError> {
    let failed = |source| MeasuredError::Read { file: file.display().to_string(), source };
    fs::write(file, format!("{value:#}\n")).map_err(failed)
}

fn table(file: &Path, head: Vec<String>, rows: impl Iterator<Item = Vec<String>>) -> Result<(), MeasuredError> {
    let failed =
        |error: csv::Error| MeasuredError::Table { file: file.display().to_string(), problem: error.to_string() };
    let mut writer = csv::Writer::from_path(file).map_err(failed)?;
    writer.write_record(head).map_err(failed)?;
    rows.into_iter().try_for_each(|row| writer.write_record(row).map_err(failed))?;
    writer.flush().map_err(|source| MeasuredError::Read { file: file.display().to_string(), source })
}
