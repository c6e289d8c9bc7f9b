//! A file of LOCO, the program of the Matlab Middle Layer: lattice, instruments, matrix, dispersion and noise as one measurement.
//!
//! | field | holds |
//! |---|---|
//! | `RINGData.Lattice` | AT's cell array; `CavityFrequency` [Hz], `Energy` [GeV] |
//! | `BPMData.BPMIndex` | elements that are monitors; `HBPMIndex`, `VBPMIndex`: which of these read x, which y, in the order of the rows |
//! | `CMData.HCMIndex`, `VCMIndex` | elements that are correctors, in the order of the columns; `HCMKicks`, `VCMKicks`: change of the kick from one orbit to the other [mrad] |
//! | `LocoMeasData.M` | change of the orbit with that kick [mm], rows x then y, columns H then V |
//! | `LocoMeasData.BPMSTD` | noise of an element of `M` [mm] |
//! | `LocoMeasData.Eta`, `DeltaRF`, `RF` | change of the orbit [mm] when the RF frequency rises by that step [Hz], and the frequency [Hz] |
//! | `FitParameters` | groups of magnets and their strengths, one element an iteration |
//!
//! `RINGData.Lattice` is the fitted lattice: the lattice before the fit has the strengths of `FitParameters(1).Values`. Kicks and lattice are those of
//! the first iteration; the monitors and correctors that count are those of the last (`HBPMGoodDataIndex` and so on), without the ones of no noise.
//! Whether an orbit was measured at plus and minus half the kick or at 0 and the kick is the same to first order.
//!
//! Source: G. Portmann, J. Safranek and X. Huang, Matlab based LOCO, SLAC-PUB-14640; `locofilecheck.m`, `buildlocoinput.m` and
//! `locoresponsematrix.m` of the Matlab Middle Layer.

mod fit;
mod instruments;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};

use self::fit::{LocoFit, start};
use self::instruments::{columns, correctors, joined, lines, monitors};
use super::assemble::{empty, places};
use super::at_mat;
use super::conventions::PerInstrument;
use super::element::{Format, Lattice};
use super::instruments::Instruments;
use super::mat::{MatFile, Place};
use measured::Folder;
use measured::MeasuredError;

/// Frequencies of cavity and measurement differ by less, unless one is in another unit.
const ALIKE: f64 = 0.01;
/// Energies of rings [GeV]; in eV they are beyond any of these.
const ENERGIES: core::ops::Range<f64> = 0.01..1e4;

/// What a LOCO file holds.
#[derive(Debug, Clone)]
pub struct Loco {
    /// The lattice before the fit.
    pub lattice: Lattice,
    /// Its monitors and correctors.
    pub instruments: Instruments,
    /// All of it as a measurement.
    pub folder: Folder,
}

/// What a file may lack.
#[derive(Debug, Clone, Default)]
pub struct Lacking {
    /// Kicks [mrad], where `CMData` has none.
    pub kick: Option<PerInstrument>,
    /// RF frequency [Hz], where neither `LocoMeasData` nor `RINGData` has it nor a cavity.
    pub rf: Option<f64>,
}

/// The structs of a file.
struct Structs<'a> {
    ring: Place<'a>,
    monitors: Place<'a>,
    correctors: Place<'a>,
    measured: Place<'a>,
}

/// True of a file with the measurement of a LOCO file.
pub(in crate::import) fn is_one(file: &MatFile) -> bool {
    file.variable("LocoMeasData").is_some()
}

/// Read it.
pub(in crate::import) fn read(file: &MatFile, lacking: &Lacking) -> Result<Loco, MeasuredError> {
    let variable = |name: &'static str| {
        let problem = || format!("no variable {name}, which a LOCO file has; found {}", file.words());
        file.variable(name).ok_or_else(|| MeasuredError::Table { file: file.file.clone(), problem: problem() })
    };
    let structs = Structs {
        ring: variable("RINGData")?,
        monitors: variable("BPMData")?,
        correctors: variable("CMData")?,
        measured: variable("LocoMeasData")?,
    };
    let mut document = at_mat::document(&structs.ring.need("Lattice")?)?;
    let fit = LocoFit::of(file, &document)?;
    start(&fit, &mut document);
    let mut lattice = at_mat::lattice(&file.file, &document, Format::Loco)?;
    fit.left_out.iter().for_each(|what| lattice.leave_out(what));
    if lattice.elements.len() != fit.length {
        return lattice.refuse(format!(
            "RINGData.Lattice: {} elements make {} in a turn (Periodicity); LOCO's numbers of elements are for one",
            fit.length,
            lattice.elements.len()
        ));
    }
    lattice.energy = energy(&structs.ring)?.or(lattice.energy);
    let lines = lines(&structs.monitors, lattice.elements.len())?;
    let columns = columns(&structs.correctors, lattice.elements.len())?;
    let instruments = Instruments { monitors: joined(&lines), correctors: joined(&columns), called: BTreeMap::new() };
    starting_gains(&structs, &mut lattice)?;
    let rf = frequency(&structs, lacking, &mut lattice)?;
    // a monitor of LOCO reads at the entrance of its element, where a row of the folder is read; a magnet that gets a gradient is cut as one that has it
    let mut cut = Instruments { monitors: instruments.correctors.clone(), ..instruments.clone() };
    cut.monitors.retain(|one| fit.has_gradient(one.element));
    let mut folder = empty(&lattice, &cut, rf)?;
    let places = places(&lattice, &cut);
    folder.matrix = matrix(&structs.measured.need("M")?, lines.len(), columns.len())?;
    monitors(&mut folder, &structs, &lines, &places)?;
    correctors(&mut folder, &structs, &columns, &places, lacking, &mut lattice)?;
    dispersion(&mut folder, &structs.measured, &mut lattice)?;
    folder.meta.reference_fit = fit.reference([&structs.monitors, &structs.correctors], &folder, &lattice, &places);
    Ok(Loco { lattice, instruments, folder })
}

fn matrix(place: &Place, lines: usize, columns: usize) -> Result<DMatrix<f64>, MeasuredError> {
    match place.shape() {
        Some(found) if found == [lines, columns] => Ok(DMatrix::from_column_slice(lines, columns, place.numbers()?)),
        _ => Err(place.expected(&format!("{lines}x{columns} numbers, monitors of BPMData by correctors of CMData"))),
    }
}

/// The dispersion, if it was measured with a step that the file states.
fn dispersion(folder: &mut Folder, measured: &Place, lattice: &mut Lattice) -> Result<(), MeasuredError> {
    let Some(eta) = measured.field("Eta") else { return Ok(()) };
    let eta = eta.many(folder.monitors.len(), "one a row of M")?;
    let Some(step) = measured.field("DeltaRF") else {
        lattice.leave_out("the dispersion, whose step of the RF frequency (LocoMeasData.DeltaRF) is not stated");
        return Ok(());
    };
    folder.meta.delta_rf = step.number()?;
    if folder.meta.delta_rf == 0.0 {
        return Err(step.wrong("0 Hz, but Eta states the change of the orbit with it"));
    }
    folder.dispersion = Some(DVector::from_column_slice(eta));
    Ok(())
}

/// [GeV], if the file states it.
fn energy(ring: &Place) -> Result<Option<f64>, MeasuredError> {
    let Some(energy) = ring.field("Energy") else { return Ok(None) };
    match energy.number()? {
        found if ENERGIES.contains(&found) => Ok(Some(found)),
        found if ENERGIES.contains(&(found * 1e-9)) => Ok(Some(found * 1e-9)),
        found => Err(energy.wrong(&format!("expected GeV, {ENERGIES:?}, found {found}"))),
    }
}

/// RF frequency [Hz] of the measurement, else of the model.
fn frequency(structs: &Structs, lacking: &Lacking, lattice: &mut Lattice) -> Result<Option<f64>, MeasuredError> {
    let [measured, model] = [structs.measured.field("RF"), structs.ring.field("CavityFrequency")];
    let number = |place: &Option<Place>| place.as_ref().map(Place::number).transpose();
    let (stated, of_model) = (number(&measured)?, number(&model)?);
    if let (Some(stated), Some(of_model), Some(place)) = (stated, of_model, &measured)
        && (stated / of_model - 1.0).abs() > ALIKE
    {
        return Err(place.wrong(&format!("{stated} Hz, but RINGData.CavityFrequency is {of_model} Hz")));
    }
    let found = stated.or(of_model).or(lattice.rf);
    if let (Some(found), Some(_)) = (found, lacking.rf) {
        return Err(structs
            .measured
            .wrong(&format!("the file states the RF frequency, {found} Hz; leave --rf-frequency out")));
    }
    lattice.rf = found.or(lacking.rf);
    Ok(lattice.rf)
}

/// Gains and couplings that LOCO starts at are counted: a fit here starts at 1 and 0; and those that it holds.
fn starting_gains(structs: &Structs, lattice: &mut Lattice) -> Result<(), MeasuredError> {
    for (place, names, nominal, what) in [
        (&structs.monitors, ["HBPMGain", "VBPMGain"], 1.0, "a gain of a monitor that LOCO starts at (1 here)"),
        (
            &structs.monitors,
            ["HBPMCoupling", "VBPMCoupling"],
            0.0,
            "a coupling of a monitor that LOCO starts at (0 here)",
        ),
        (
            &structs.correctors,
            ["HCMCoupling", "VCMCoupling"],
            0.0,
            "a coupling of a corrector that LOCO starts at (0 here)",
        ),
    ] {
        for list in names.into_iter().filter_map(|name| place.field(name)) {
            let other =
                list.numbers().unwrap_or_default().iter().filter(|one| one.is_finite() && **one != nominal).count();
            (0..other).for_each(|_| lattice.leave_out(what));
        }
    }
    for (place, name, what) in [
        (&structs.monitors, "FitGains", "gains of monitors that LOCO held (they are fitted here)"),
        (&structs.correctors, "FitKicks", "kicks of correctors that LOCO held (they are fitted here)"),
    ] {
        let is_held = |one: &Place| one.text().is_some_and(|text| text.eq_ignore_ascii_case("no"));
        if place.last(name).as_ref().is_some_and(is_held) {
            lattice.leave_out(what);
        }
    }
    Ok(())
}
