//! The instruments and couplings that a fit has found, taken into a machine file and into the orbits, so that a core which knows the strengths
//! alone can follow them.
//!
//! What a monitor with gain `g` and coupling `c` reads of the orbit in both planes is solved for the orbit:
//!
//! `x = (g_y r_x - c_x r_y)/(g_x g_y - c_x c_y)`, and with x and y exchanged,
//!
//! or `x = r_x/g_x` where it reads one plane only. A corrector's kick is `k sqrt(g^2 + c^2)` along an axis rolled by `atan(c/g)`; a winding of a magnet is the
//! thin kick in its middle that does the same beyond. Skew gradients,
//! and strengths of dipoles, stand in the machine file as fitted; strengths of quadrupoles stand there as in the lattice, to be estimated.

use nalgebra::DMatrix;
use serde_json::{Value, json};
use twin::Plane;

use crate::fit::Fit;
use crate::folder::{CorrectorRow, Folder};
use crate::lattice;
use crate::straight::DEAD;
use crate::unknowns::{Kind, gains};

/// A monitor's plane.
#[derive(Debug, Clone, PartialEq)]
pub struct Monitor {
    /// Its plane and its label in the machine file.
    pub plane: Plane,
    /// The same.
    pub label: String,
    /// Standard deviation of one orbit, with what the model misses [mm].
    pub sigma: f64,
    /// Its row.
    pub row: usize,
    gain: f64,
    /// Its coupling, and row, gain and coupling of the same monitor in the other plane.
    other: Option<(f64, usize, f64, f64)>,
}

/// A corrector.
#[derive(Debug, Clone, PartialEq)]
pub struct Corrector {
    /// Its plane and its label in the machine file.
    pub plane: Plane,
    /// The same.
    pub label: String,
    /// Its column.
    pub column: usize,
    /// Kick from minus to plus half, along its rolled axis [mrad].
    pub kick: f64,
    roll: f64,
}

/// A ring with calibrated instruments.
#[derive(Debug, Clone)]
pub struct Calibrated {
    /// Machine file, docs/machine.md.
    pub machine: Value,
    /// Monitors that are alive, by plane.
    pub monitors: Vec<Monitor>,
    /// Correctors that are used.
    pub correctors: Vec<Corrector>,
}

/// Strengths are estimated within this range: wider than any error that the fit's prior of 3 % leaves likely.
const RANGE: [f64; 2] = [0.85, 1.15];

impl Calibrated {
    /// Of a fitted measurement.
    pub fn of(folder: &Folder, fitted: &Fit) -> Self {
        let monitors = monitors(folder, fitted);
        let correctors = correctors(folder, fitted);
        Self { machine: machine(folder, fitted, &monitors, &correctors), monitors, correctors }
    }

    /// Orbits [mm] at the monitors, rows, from what was read [mm], rows those of the folder.
    pub fn orbits(&self, read: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(self.monitors.len(), read.ncols(), |b, j| self.monitors[b].orbit(|row| read[(row, j)]))
    }
}

impl Monitor {
    fn orbit(&self, read: impl Fn(usize) -> f64) -> f64 {
        let own = read(self.row);
        match self.other {
            Some((coupling, row, gain, back)) if read(row).is_finite() => {
                (gain * own - coupling * read(row)) / (self.gain * gain - coupling * back)
            }
            _ => own / self.gain,
        }
    }
}

fn monitors(folder: &Folder, fitted: &Fit) -> Vec<Monitor> {
    let found = gains((&fitted.unknowns, &fitted.values), folder.monitors.len(), Kind::of_monitor);
    let is_alive = |row: &usize| folder.monitors[*row].is_used && found[*row][0].abs() > DEAD;
    let rows = (0..folder.monitors.len()).filter(is_alive);
    let one = |row: usize| {
        let at = folder.monitors[row].at;
        let other = (0..folder.monitors.len()).filter(is_alive);
        let other = other.filter(|&other| folder.monitors[other].at == at).find(|&other| other != row);
        let [gain, coupling] = found[row];
        Monitor {
            plane: folder.monitors[row].plane,
            label: folder.element(at),
            sigma: sigma(folder, fitted, row) / gain.abs(),
            row,
            gain,
            other: other.map(|other| (coupling, other, found[other][0], found[other][1])),
        }
    };
    rows.map(one).collect()
}

/// Rms of what the fit leaves of a row [mm], of one orbit where it is that of a difference of two; the stated noise at least.
fn sigma(folder: &Folder, fitted: &Fit, row: usize) -> f64 {
    let counted = fitted.data.sigma.row(row).iter().filter(|sigma| sigma.is_finite()).count().max(1);
    let left = (fitted.residual.row(row).norm_squared() / counted as f64).sqrt();
    left.max(folder.monitors[row].sigma) / 2f64.sqrt()
}

fn correctors(folder: &Folder, fitted: &Fit) -> Vec<Corrector> {
    let found = gains((&fitted.unknowns, &fitted.values), folder.correctors.len(), Kind::of_corrector);
    let used = folder.correctors.iter().enumerate().filter(|(_, one)| one.is_used);
    let one = |(column, one): (usize, &CorrectorRow)| {
        let thin = as_thin(folder, fitted, one);
        let own = one.plane.index();
        let [gain, coupling] = [found[column][0] * thin[own], found[column][1] * thin[1 - own]];
        let roll = (coupling / gain).atan();
        Corrector {
            plane: one.plane,
            label: folder.element(one.at),
            column,
            kick: one.kick * gain.signum() * gain.hypot(coupling),
            // an H corrector rolled by a kicks (cos a, sin a), a V corrector (-sin a, cos a)
            roll: if one.plane == Plane::X { roll } else { -roll },
        }
    };
    used.map(one).collect()
}

/// Thin kick in the middle of a magnet over that of a winding along it, in both planes, by the orbit beyond: `sin(f)/f`, or `sinh(f)/f` where the magnet
/// defocuses, `f = sqrt|k| L/2`; 1 of other correctors.
fn as_thin(folder: &Folder, fitted: &Fit, corrector: &CorrectorRow) -> [f64; 2] {
    let Some([row, _]) = lattice::winding(folder, corrector.at) else { return [1.0; 2] };
    let half = &folder.lattice[row];
    let group = fitted.groups[0].iter().position(|group| group.contains(&row));
    let k1 = group.map_or(half.k1, |group| fitted.unknowns[group].kind.gradient(half.k1, fitted.values[group]));
    [(half.bend / half.length).powi(2) + k1, -k1].map(|k| {
        let f = k.abs().sqrt() * half.length;
        if f == 0.0 {
            1.0
        } else if k > 0.0 {
            f.sin() / f
        } else {
            f.sinh() / f
        }
    })
}

/// The lattice of the folder with what the fit has found of dipoles, skew gradients and instruments.
fn machine(folder: &Folder, fitted: &Fit, monitors: &[Monitor], correctors: &[Corrector]) -> Value {
    let skewed: Vec<usize> = fitted.groups[1].iter().flatten().copied().collect();
    let mut file = lattice::machine(folder, &skewed, &[]);
    let named = |group: &[usize]| -> Vec<String> {
        group.iter().flat_map(|&row| lattice::parts(&folder.element(row), skewed.contains(&row)).0).collect()
    };
    let strengths: Vec<Vec<String>> = fitted.groups[0].iter().map(|group| named(group)).collect();
    let skew_of = |name: &str| {
        let group = fitted.groups[1].iter().position(|group| {
            group.iter().any(|&row| lattice::parts(&folder.element(row), true).1.as_deref() == Some(name))
        })?;
        Some(fitted.values[strengths.len() + group])
    };
    let gradient = |group: usize, magnet: &Value| {
        fitted.unknowns[group].kind.gradient(magnet["k1"].as_f64().unwrap_or(0.0), fitted.values[group])
    };
    let width = fitted.unknowns.iter().find(|one| matches!(one.kind, Kind::Strength(_))).map(|one| one.width);
    let mut families = serde_json::Map::new();
    let mut elements = Vec::new();
    for mut one in file["elements"].as_array().cloned().unwrap_or_default() {
        let name = one["name"].as_str().unwrap_or_default().to_owned();
        let group = strengths.iter().position(|group| group.contains(&name));
        match (one["type"].as_str().unwrap_or_default(), group) {
            ("bpm" | "corrector", _) => continue,
            ("quadrupole", None) => one["fit"] = json!(false),
            ("quadrupole", Some(group)) if one["fit"] == false => one["k1"] = json!(gradient(group, &one)),
            ("quadrupole", Some(group)) if strengths[group].len() > 1 => {
                let family = param(folder, &fitted.groups[0][group]);
                one["family"] = json!(family);
                families.insert(family, json!({"supply": "dipole", "fit": "family"}));
            }
            ("sbend", Some(group)) => one["k1"] = json!(gradient(group, &one)),
            ("multipole", _) => one["k1sl"] = json!(skew_of(&name).unwrap_or(0.0)),
            _ => {}
        }
        elements.push(one);
    }
    elements.extend(monitors.iter().map(|one| {
        let s = folder.lattice[folder.monitors[one.row].at].s;
        thin("bpm", one.plane, &one.label, s, 0.0)
    }));
    elements.extend(correctors.iter().map(|one| {
        let row = &folder.lattice[folder.correctors[one.column].at];
        thin("corrector", one.plane, &one.label, row.s + row.length / 2.0, one.roll)
    }));
    // in beam order; what is thin stands before what begins at the same place, and so between the halves of a magnet
    elements.sort_by(|a, b| [s(a), length(a)].partial_cmp(&[s(b), length(b)]).unwrap_or(core::cmp::Ordering::Equal));
    file["families"] = Value::Object(families);
    file["data"] = json!({"prior_width": width, "range": RANGE});
    file["elements"] = json!(elements);
    file
}

/// Name of the param of a group of magnets in the machine file: that of its only magnet, or of its first with the number of others, `QFA.226+1`.
pub fn param(folder: &Folder, group: &[usize]) -> String {
    let first = folder.element(group[0]);
    if group.len() == 1 { first } else { format!("{first}+{}", group.len() - 1) }
}

fn s(element: &Value) -> f64 {
    element["s_start"].as_f64().unwrap_or(0.0)
}

fn length(element: &Value) -> f64 {
    element["length"].as_f64().unwrap_or(0.0)
}

fn thin(kind: &str, plane: Plane, label: &str, s: f64, roll: f64) -> Value {
    let plane = if plane == Plane::X { "H" } else { "V" };
    let mut one = json!({
        "name": format!("{kind} {plane} {label}"), "label": label, "type": kind, "plane": plane, "s_start": s, "length": 0
    });
    if roll != 0.0 {
        one["roll"] = json!(roll);
    }
    one
}

#[cfg(test)]
mod tests {
    use twin::{Hold, Optics, Ring};

    use super::*;
    use crate::fit::{Settings, fit};
    use crate::model::Model;
    use crate::testing::{NOISE, machine as truth, measured, ring_with_winding};

    /// The response of the machine file with the strengths that were fitted, in orbits, is the fitted matrix without its gains.
    #[test]
    fn the_machine_file_has_what_the_fit_has_found() {
        let lattice = ring_with_winding();
        let folder = measured(&lattice, &truth(&lattice, 9), NOISE, 4);
        let fitted = fit(&folder, &Settings::default(), &mut |_| ()).unwrap();
        let calibrated = Calibrated::of(&folder, &fitted);
        let ring = Ring::parse(&calibrated.machine.to_string(), "calibrated").unwrap();
        assert_eq!((ring.parameters.len(), ring.monitors.len(), ring.correctors.len()), (24, 24, 24));
        let group = |name: &str| fitted.groups[0].iter().position(|group| param(&folder, group) == name).unwrap();
        let vars: Vec<f64> = ring.parameters.iter().map(|one| fitted.values[group(&one.name)]).collect();
        let ring = ring.with_vars(&vars);

        let optics = Optics::of(&ring, Hold::Frequency { offset: 0.0 }).unwrap();
        let observers: Vec<_> = calibrated
            .monitors
            .iter()
            .map(|one| {
                let monitor = ring.monitors[ring.monitor(one.plane, &one.label).unwrap()];
                optics.observe(monitor.element, monitor.plane)
            })
            .collect();
        let sources: Vec<_> = calibrated
            .correctors
            .iter()
            .map(|one| {
                let corrector = ring.correctors[ring.corrector(one.plane, &one.label).unwrap()];
                let roll = ring.elements[corrector.element].misalignment.roll;
                let axis = match one.plane {
                    Plane::X => [roll.cos(), roll.sin()],
                    Plane::Y => [-roll.sin(), roll.cos()],
                };
                optics.kick(corrector.element, axis).times(one.kick)
            })
            .collect();
        let response = optics.response(&observers, &sources);

        let model = Model::of(&folder, &fitted.groups, twin::Rf::FixedFrequency).unwrap();
        let predicted = model.predict(&fitted.unknowns, &fitted.values).unwrap().matrix;
        let orbits = calibrated.orbits(&predicted.columns(0, 24).into_owned());
        assert!((&response - &orbits).amax() < 1e-9 * orbits.amax(), "{}", (&response - &orbits).amax());
        // noise of one orbit; 576 elements and 140 unknowns leave 0.87 of it
        assert!(calibrated.monitors.iter().all(|one| (0.6..1.4).contains(&(one.sigma / (NOISE / 2f64.sqrt())))));
    }
}
