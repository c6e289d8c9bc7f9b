//! Monitors and correctors of a LOCO file, in the order of the rows and columns of its matrix.

use std::collections::BTreeMap;

use twin::Plane;

use super::{Lacking, Structs};
use crate::import::element::Lattice;
use crate::import::instruments::{Channel, Instrument, names};
use crate::import::mat::Place;
use measured::MeasuredError;
use measured::folder::{CorrectorRow, Folder, MonitorRow};

/// Rows of the matrix: those that read x, then those that read y.
pub(super) fn lines(monitors: &Place, elements: usize) -> Result<Vec<Channel>, MeasuredError> {
    let all = monitors.need("BPMIndex")?.places(elements, "an element of RINGData.Lattice")?;
    let of = |plane, name| {
        let which = monitors.need(name)?.places(all.len(), "a place in BPMIndex")?;
        Ok::<Vec<Channel>, MeasuredError>(which.into_iter().map(|one| (all[one], plane)).collect())
    };
    unlike(monitors, [of(Plane::X, "HBPMIndex")?, of(Plane::Y, "VBPMIndex")?].concat())
}

/// Columns of the matrix: those that kick in x, then those that kick in y.
pub(super) fn columns(correctors: &Place, elements: usize) -> Result<Vec<Channel>, MeasuredError> {
    let of = |plane, name| {
        let all = correctors.need(name)?.places(elements, "an element of RINGData.Lattice")?;
        Ok::<Vec<Channel>, MeasuredError>(all.into_iter().map(|one| (one, plane)).collect())
    };
    unlike(correctors, [of(Plane::X, "HCMIndex")?, of(Plane::Y, "VCMIndex")?].concat())
}

fn unlike(place: &Place, all: Vec<Channel>) -> Result<Vec<Channel>, MeasuredError> {
    let twice = all.iter().enumerate().find(|(at, one)| all[..*at].contains(one));
    match twice {
        Some((at, (element, _))) => {
            Err(place.wrong(&format!("number {} of all, element {}, stands there twice", at + 1, element + 1)))
        }
        None => Ok(all),
    }
}

/// Elements with the planes that they have, in beam order.
pub(super) fn joined(channels: &[Channel]) -> Vec<Instrument> {
    let mut all: Vec<Instrument> = Vec::new();
    for &(element, plane) in channels {
        let at = match all.iter().position(|one| one.element == element) {
            Some(at) => at,
            None => {
                all.push(Instrument { element, planes: [false; 2] });
                all.len() - 1
            }
        };
        all[at].planes[plane.index()] = true;
    }
    all.sort_by_key(|one| one.element);
    all
}

/// The number of x's channels comes first in every list.
fn of_x(channels: &[Channel]) -> usize {
    channels.iter().filter(|(_, plane)| *plane == Plane::X).count()
}

/// The rows of the folder.
pub(super) fn monitors(
    folder: &mut Folder,
    structs: &Structs,
    lines: &[Channel],
    places: &[usize],
) -> Result<(), MeasuredError> {
    let stated = structs.measured.need("BPMSTD")?;
    let noise = match stated.numbers()? {
        &[all] => vec![all; lines.len()],
        _ => stated.many(lines.len(), "one a row of M")?.to_vec(),
    };
    let good = good(&structs.monitors, ["HBPMGoodDataIndex", "VBPMGoodDataIndex"], lines)?;
    for ((&(element, plane), sigma), is_good) in lines.iter().zip(noise).zip(good) {
        let is_used = is_good && sigma > 0.0 && sigma.is_finite();
        let sigma = if is_used { sigma } else { 0.0 };
        folder.monitors.push(MonitorRow { plane, at: places[element], sigma, is_used });
    }
    match folder.monitors.iter().any(|one| one.is_used) {
        true => Ok(()),
        false => Err(structs.measured.wrong("BPMSTD: no monitor that counts has a noise above 0")),
    }
}

/// The same of its columns.
pub(super) fn correctors(
    folder: &mut Folder,
    structs: &Structs,
    columns: &[Channel],
    places: &[usize],
    lacking: &Lacking,
    lattice: &mut Lattice,
) -> Result<(), MeasuredError> {
    let kicks = kicks(&structs.correctors, columns, lacking, lattice)?;
    let good = good(&structs.correctors, ["HCMGoodDataIndex", "VCMGoodDataIndex"], columns)?;
    for ((&(element, plane), kick), is_good) in columns.iter().zip(kicks).zip(good) {
        let kicks = kick.is_finite() && kick != 0.0;
        if is_good && !kicks {
            lattice.leave_out("a corrector whose kick is stated as none");
        }
        let kick = if kicks { kick } else { 0.0 };
        folder.correctors.push(CorrectorRow { plane, at: places[element], kick, is_used: is_good && kicks });
    }
    Ok(())
}

/// Of each column [mrad]; LOCO takes 1 mrad where there are none, and nothing is guessed here.
fn kicks(
    correctors: &Place,
    columns: &[Channel],
    lacking: &Lacking,
    lattice: &Lattice,
) -> Result<Vec<f64>, MeasuredError> {
    let stated = [correctors.field("HCMKicks"), correctors.field("VCMKicks")];
    if stated.iter().all(Option::is_some) && lacking.kick.is_some() {
        return Err(correctors.wrong("HCMKicks and VCMKicks state the kicks; leave --kick out"));
    }
    let x = of_x(columns);
    let mut all = Vec::new();
    for (stated, columns) in stated.into_iter().zip([&columns[..x], &columns[x..]]) {
        match (stated, &lacking.kick) {
            (Some(stated), _) => all.extend(stated.many(columns.len(), "one a corrector of its plane")?),
            (None, Some(kick)) => {
                all.extend(kick.of("--kick", columns, &joined(columns), &names(lattice, &BTreeMap::new()))?)
            }
            (None, None) => {
                return Err(correctors.wrong(
                    "no HCMKicks or no VCMKicks (LOCO would take 1 mrad); state with --kick MRAD by how much the kick of each corrector differs between the two orbits",
                ));
            }
        }
    }
    Ok(all)
}

/// Whether each channel counts, by the last iteration that says so: all do where no list was made, none where it is empty.
fn good(place: &Place, names: [&str; 2], channels: &[Channel]) -> Result<Vec<bool>, MeasuredError> {
    let (x, all) = (of_x(channels), channels.len());
    let mut is_good = vec![true; all];
    for (name, range) in names.into_iter().zip([0..x, x..all]) {
        if !place.names().iter().any(|own| own == name) {
            continue;
        }
        let list = place.last(name).map(|list| list.places(range.len(), "a number of a row or column of its plane"));
        let list = list.transpose()?.unwrap_or_default();
        range.clone().for_each(|at| is_good[at] = list.contains(&(at - range.start)));
    }
    Ok(is_good)
}
