//! An effect put into a measured matrix, sized by a seed: what the fit or the diagnosis should find again on real noise.

use std::fs;
use std::path::Path;

use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::seq::{IndexedRandom, IteratorRandom};
use rand::{RngExt, SeedableRng};

use crate::error::MeasuredError;
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::model::Model;
use crate::unknowns::{Kind, Unknown, name};
use crate::wiring::Wiring;

/// What was put in.
#[derive(Debug, Clone, PartialEq)]
pub struct Concealed {
    /// Its kind.
    pub kind: &'static str,
    /// Where.
    pub at: String,
    /// Relative change of a gain or a strength; integrated gradient [1/m]; none of a cable.
    pub amplitude: Option<f64>,
    /// What it could gain at most in `ln` likelihood, with the learnt error of the model, if kind and place were known: of a cable half the sum
    /// of squares of its change to the matrix, of anything else with all other unknowns adapting, half the square over its error bar.
    pub gain: f64,
}

/// Smallest and largest relative change of a gain, of a strength, and skew gradient [1/m]; the logarithm is uniform in between.
const GAIN: [f64; 2] = [0.02, 0.4];
const STRENGTH: [f64; 2] = [0.001, 0.02];
const SKEW: [f64; 2] = [0.0005, 0.01];

/// Put one effect into a measurement; its magnets change at the values that were found.
///
/// # Errors
/// [`MeasuredError`].
pub fn conceal(
    folder: &Folder,
    fitted: &Fit,
    settings: &Settings,
    seed: u64,
) -> Result<(Folder, Concealed), MeasuredError> {
    let mut random = StdRng::seed_from_u64(seed);
    let mut changed = folder.clone();
    let used =
        |uses: &mut dyn Iterator<Item = bool>| uses.enumerate().filter(|(_, used)| *used).map(|(i, _)| i).collect();
    let rows: Vec<usize> = used(&mut folder.monitors.iter().map(|one| one.is_used));
    let columns: Vec<usize> = used(&mut folder.correctors.iter().map(|one| one.is_used));
    let sort = random.random_range(0..6);
    let sign = if random.random_bool(0.5) { -1.0 } else { 1.0 };
    let mut sized = |[least, most]: [f64; 2]| sign * random.random_range(least.ln()..most.ln()).exp();
    let (gain, strength, skew) = (sized(GAIN), sized(STRENGTH), sized(SKEW));
    let (kind, at, amplitude) = match sort {
        0 => {
            let row = rows.choose(&mut random).copied().expect("a measurement has monitors");
            changed.matrix.row_mut(row).scale_mut(1.0 + gain);
            if let Some(dispersion) = &mut changed.dispersion {
                dispersion[row] *= 1.0 + gain;
            }
            ("bpm_gain", folder.monitor(row), Some(gain))
        }
        1 => {
            let column = columns.choose(&mut random).copied().expect("a measurement has correctors");
            changed.matrix.column_mut(column).scale_mut(1.0 + gain);
            ("corrector_gain", folder.corrector(column), Some(gain))
        }
        2 | 3 => {
            let plane = |row: usize| folder.monitors[row].plane;
            let row = rows.choose(&mut random).copied().expect("a measurement has monitors");
            let other = rows.iter().filter(|&&other| other != row && plane(other) == plane(row)).choose(&mut random);
            let wiring = match (sort, other) {
                (2, Some(&other)) => Wiring::MonitorsExchanged(vec![row.min(other), row.max(other)]),
                _ => Wiring::MonitorReversed(row),
            };
            wiring.put_right(&mut changed);
            let (kind, at) = wiring.named(folder);
            (kind, at, None)
        }
        _ => {
            let is_it =
                |kind: Kind| if sort == 4 { matches!(kind, Kind::Strength(_)) } else { matches!(kind, Kind::Skew(_)) };
            let magnets: Vec<usize> = (0..fitted.unknowns.len()).filter(|&i| is_it(fitted.unknowns[i].kind)).collect();
            let at = magnets.choose(&mut random).copied().unwrap_or(0);
            let is_skew = matches!(fitted.unknowns[at].kind, Kind::Skew(_));
            let mut values = fitted.values.clone();
            if is_skew {
                values[at] += skew
            } else {
                values[at] *= 1.0 + strength
            }
            let model = Model::of(folder, &fitted.groups, settings.rf)?;
            let change = model.predict(&fitted.unknowns, &values)?.matrix
                - model.predict(&fitted.unknowns, &fitted.values)?.matrix;
            changed.matrix += change.columns(0, folder.matrix.ncols());
            if let Some(dispersion) = &mut changed.dispersion {
                *dispersion += change.column(folder.matrix.ncols());
            }
            let place = name(folder, &fitted.groups, fitted.unknowns[at].kind);
            if is_skew { ("skew_gradient", place, Some(skew)) } else { ("quadrupole_gradient", place, Some(strength)) }
        }
    };
    let is_it = |one: &Unknown| one.kind.word() == kind && name(folder, &fitted.groups, one.kind) == at;
    let gain = match (amplitude, fitted.unknowns.iter().position(is_it)) {
        (Some(amplitude), Some(one)) => {
            let unit = if kind == "skew_gradient" { 1.0 } else { fitted.values[one] };
            0.5 * (amplitude * unit / fitted.sigma(one)).powi(2)
        }
        _ => gain_of_cable(folder, &changed, fitted),
    };
    Ok((changed, Concealed { kind, at, amplitude, gain }))
}

fn gain_of_cable(folder: &Folder, changed: &Folder, fitted: &Fit) -> f64 {
    let change = (&changed.matrix - &folder.matrix).map(|x| if x.is_finite() { x } else { 0.0 });
    let information = fitted.data.information(&fitted.noise);
    0.5 * change.component_mul(&change).dot(&information.columns(0, change.ncols()))
}

/// Write a folder like another, with a matrix and a dispersion of its own [mm].
///
/// # Errors
/// [`MeasuredError`].
pub fn write(like: &Path, folder: &Folder, to: &Path) -> Result<(), MeasuredError> {
    let failed = |file: &Path| {
        let file = file.display().to_string();
        move |source| MeasuredError::Read { file, source }
    };
    fs::create_dir_all(to).map_err(failed(to))?;
    for name in ["lattice.csv", "bpms.csv", "correctors.csv", "meta.json"] {
        fs::copy(like.join(name), to.join(name)).map_err(failed(&to.join(name)))?;
    }
    table(&like.join("orm_measured_mm.csv"), &folder.matrix, &to.join("orm_measured_mm.csv"))?;
    if let Some(dispersion) = &folder.dispersion {
        let dispersion = DMatrix::from_column_slice(dispersion.len(), 1, dispersion.as_slice());
        table(&like.join("dispersion_orbit_mm.csv"), &dispersion, &to.join("dispersion_orbit_mm.csv"))?;
    }
    Ok(())
}

/// The names of one table with other numbers; what was not measured stays empty.
fn table(like: &Path, numbers: &DMatrix<f64>, to: &Path) -> Result<(), MeasuredError> {
    let wrong =
        |error: csv::Error| MeasuredError::Table { file: like.display().to_string(), problem: error.to_string() };
    let mut reader = csv::Reader::from_path(like).map_err(wrong)?;
    let mut writer = csv::Writer::from_path(to).map_err(wrong)?;
    writer.write_record(reader.headers().map_err(wrong)?).map_err(wrong)?;
    for (record, row) in reader.records().zip(numbers.row_iter()) {
        let record = record.map_err(wrong)?;
        let cells = row.iter().map(|x| if x.is_finite() { format!("{x:.9}") } else { String::new() });
        let label = record.get(0).unwrap_or_default().to_owned();
        writer.write_record(core::iter::once(label).chain(cells)).map_err(wrong)?;
    }
    writer.flush().map_err(|source| MeasuredError::Read { file: to.display().to_string(), source })
}
