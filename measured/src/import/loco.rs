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

use nalgebra::{DMatrix, DVector};
use twin::Plane;

use super::assemble::{empty, places};
use super::at_mat;
use super::conventions::PerInstrument;
use super::element::{Format, Lattice};
use super::instruments::{Channel, Instrument, Instruments, names};
use super::loco_fit::{LocoFit, start};
use super::mat::{MatFile, Place};
use crate::error::MeasuredError;
use crate::folder::{CorrectorRow, Folder, MonitorRow};

/// Frequencies of cavity and measurement differ by less, unless one is in another unit.
const ALIKE: f64 = 0.01;
/// Energies of rings [GeV].
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
pub(super) fn is_one(file: &MatFile) -> bool {
    file.variable("LocoMeasData").is_some()
}

/// Read it.
pub(super) fn read(file: &MatFile, lacking: &Lacking) -> Result<Loco, MeasuredError> {
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
    let not_applied = start(&fit, &mut document)?;
    let mut lattice = at_mat::lattice(&file.file, &document, Format::Loco)?;
    (0..not_applied).for_each(|_| {
        lattice
            .leave_out("a parameter of LOCO's fit that is neither a gradient nor a skew gradient (it stays as fitted)")
    });
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
    let instruments = Instruments { monitors: joined(&lines), correctors: joined(&columns) };
    starting_gains(&structs, &mut lattice)?;
    let rf = frequency(&structs, lacking, &mut lattice)?;
    // a monitor of LOCO reads at the entrance of its element, where a row of the folder is read
    let cut = Instruments { monitors: Vec::new(), correctors: instruments.correctors.clone() };
    let mut folder = empty(&lattice, &cut, rf)?;
    let places = places(&lattice, &cut);
    folder.matrix = matrix(&structs.measured.need("M")?, lines.len(), columns.len())?;
    monitors(&mut folder, &structs, &lines, &places)?;
    correctors(&mut folder, &structs, &columns, &places, lacking, &lattice)?;
    dispersion(&mut folder, &structs.measured)?;
    folder.meta.reference_fit = fit.reference(&structs.monitors, &structs.correctors, &folder, &places)?;
    Ok(Loco { lattice, instruments, folder })
}

/// Rows of the matrix: those that read x, then those that read y.
fn lines(monitors: &Place, elements: usize) -> Result<Vec<Channel>, MeasuredError> {
    let all = monitors.need("BPMIndex")?.places(elements, "an element of RINGData.Lattice")?;
    let of = |plane, name| {
        let which = monitors.need(name)?.places(all.len(), "a place in BPMIndex")?;
        Ok::<Vec<Channel>, MeasuredError>(which.into_iter().map(|one| (all[one], plane)).collect())
    };
    unlike(monitors, [of(Plane::X, "HBPMIndex")?, of(Plane::Y, "VBPMIndex")?].concat())
}

/// Columns of the matrix: those that kick in x, then those that kick in y.
fn columns(correctors: &Place, elements: usize) -> Result<Vec<Channel>, MeasuredError> {
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
fn joined(channels: &[Channel]) -> Vec<Instrument> {
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

fn matrix(place: &Place, lines: usize, columns: usize) -> Result<DMatrix<f64>, MeasuredError> {
    match place.shape() {
        Some(found) if found == [lines, columns] => Ok(DMatrix::from_column_slice(lines, columns, place.numbers()?)),
        _ => Err(place.expected(&format!("{lines}x{columns} numbers, monitors of BPMData by correctors of CMData"))),
    }
}

fn monitors(folder: &mut Folder, structs: &Structs, lines: &[Channel], places: &[usize]) -> Result<(), MeasuredError> {
    let noise = structs.measured.need("BPMSTD")?.many(lines.len(), "one a row of M")?;
    let good = good(&structs.monitors, ["HBPMGoodDataIndex", "VBPMGoodDataIndex"], lines)?;
    for ((&(element, plane), &sigma), is_good) in lines.iter().zip(noise).zip(good) {
        let is_used = is_good && sigma > 0.0 && sigma.is_finite();
        folder.monitors.push(MonitorRow { plane, at: places[element], sigma, is_used });
    }
    match folder.monitors.iter().any(|one| one.is_used) {
        true => Ok(()),
        false => Err(structs.measured.wrong("BPMSTD: no monitor that counts has a noise above 0")),
    }
}

fn correctors(
    folder: &mut Folder,
    structs: &Structs,
    columns: &[Channel],
    places: &[usize],
    lacking: &Lacking,
    lattice: &Lattice,
) -> Result<(), MeasuredError> {
    let kicks = kicks(&structs.correctors, columns, lacking, lattice)?;
    let good = good(&structs.correctors, ["HCMGoodDataIndex", "VCMGoodDataIndex"], columns)?;
    for ((&(element, plane), kick), is_used) in columns.iter().zip(kicks).zip(good) {
        folder.correctors.push(CorrectorRow { plane, at: places[element], kick, is_used });
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
            (None, Some(kick)) => all.extend(kick.of("--kick", columns, &joined(columns), &names(lattice))?),
            (None, None) => {
                return Err(correctors.wrong(
                    "no HCMKicks or no VCMKicks (LOCO would take 1 mrad); state with --kick MRAD by how much the kick of each corrector differs between the two orbits",
                ));
            }
        }
    }
    match all.iter().position(|kick| !kick.is_finite() || *kick == 0.0) {
        Some(at) => Err(correctors.wrong(&format!("kick of column {}: {} mrad", at + 1, all[at]))),
        None => Ok(all),
    }
}

/// Whether each channel counts, by the last iteration; all do without lists.
fn good(place: &Place, names: [&str; 2], channels: &[Channel]) -> Result<Vec<bool>, MeasuredError> {
    let last = place.elements()?.len().saturating_sub(1);
    let (x, all) = (of_x(channels), channels.len());
    let mut is_good = vec![true; all];
    for (name, range) in names.into_iter().zip([0..x, x..all]) {
        let Some(list) = place.field_of(last, name) else { continue };
        let list = list.places(range.len(), "a number of a row or column of its plane")?;
        range.clone().for_each(|at| is_good[at] = list.contains(&(at - range.start)));
    }
    Ok(is_good)
}

fn dispersion(folder: &mut Folder, measured: &Place) -> Result<(), MeasuredError> {
    let Some(eta) = measured.field("Eta") else { return Ok(()) };
    let eta = eta.many(folder.monitors.len(), "one a row of M")?;
    let step = measured.need("DeltaRF")?;
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

/// Gains and couplings that LOCO starts at are counted: a fit here starts at 1 and 0.
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
            let other = list.numbers()?.iter().filter(|one| one.is_finite() && **one != nominal).count();
            (0..other).for_each(|_| lattice.leave_out(what));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};
    use serde_json::json;
    use twin::Rf;

    use super::*;
    use crate::import::mat::Mat;
    use crate::import::{Agreement, agreement};

    /// The measurement of `recordings/measured/twelve-cells/before` by tests/peers/loco.py and Octave.
    const FILE: &[u8] = include_bytes!("../../../recordings/measured/imports/twelve-cells.loco.mat");

    fn file() -> MatFile {
        MatFile::of("loco.mat", FILE.to_vec()).unwrap()
    }

    fn read(file: &MatFile) -> Result<Loco, MeasuredError> {
        super::read(file, &Lacking::default())
    }

    /// A field of one struct of a variable.
    fn field<'a>(file: &'a mut MatFile, variable: &str, element: usize, name: &str) -> &'a mut Mat {
        let (_, value) = file.variables.iter_mut().find(|(own, _)| own == variable).unwrap();
        let Mat::Structs(_, names, values) = value else { panic!("{value:?}") };
        let at = names.iter().position(|own| own == name).unwrap();
        &mut values[element][at]
    }

    fn numbers<'a>(file: &'a mut MatFile, variable: &str, element: usize, name: &str) -> &'a mut Vec<f64> {
        let Mat::Numbers(_, values) = field(file, variable, element, name) else { panic!("{variable}.{name}") };
        values
    }

    /// What is said of the file with a change.
    fn refused(change: impl FnOnce(&mut MatFile)) -> String {
        let mut file = file();
        change(&mut file);
        let problem = read(&file).unwrap_err().to_string();
        problem.strip_prefix("loco.mat: ").expect("the file is named").to_owned()
    }

    fn agreements(change: impl FnOnce(&mut MatFile)) -> Vec<Agreement> {
        let mut file = file();
        change(&mut file);
        agreement(&read(&file).unwrap().folder, Rf::FixedFrequency).unwrap()
    }

    #[test]
    fn the_folder_is_the_one_that_was_measured_field_for_field() {
        let own = read(&file()).unwrap().folder;
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/measured/twelve-cells/before");
        let other = Folder::read(&path).unwrap();
        assert_eq!((&own.matrix, &own.dispersion), (&other.matrix, &other.dispersion));
        assert_eq!(own.lattice.len(), other.lattice.len());
        for (own, other) in own.lattice.iter().zip(&other.lattice) {
            let of = |row: &crate::folder::Row| {
                (row.name.clone(), [row.length, row.bend, row.edge_in, row.edge_out, row.fringe, row.k1, row.half_k2])
            };
            assert_eq!(of(own), of(other));
            assert!((own.s - other.s).abs() < 1e-9); // a sum of lengths with one decimal
        }
        for (own, other) in own.monitors.iter().zip(&other.monitors) {
            assert_eq!(
                (own.plane, own.at, own.sigma, own.is_used),
                (other.plane, other.at, other.sigma, other.is_used)
            );
        }
        for (own, other) in own.correctors.iter().zip(&other.correctors) {
            assert_eq!((own.plane, own.at, own.kick, own.is_used), (other.plane, other.at, other.kick, other.is_used));
        }
        assert!((own.meta.circumference - other.meta.circumference).abs() < 1e-9);
        assert_eq!(
            (own.meta.energy, own.meta.rf, own.meta.delta_rf),
            (other.meta.energy, other.meta.rf, other.meta.delta_rf)
        );
        let [own, other] = [own, other].map(|one| json!(one.meta.reference_fit.unwrap()));
        assert_eq!((&own["fit_parameters"], &own["flags"]), (&other["fit_parameters"], &other["flags"]));
        assert_eq!(own["values_start"][0], 4.0);
    }

    #[test]
    fn the_lattice_is_that_before_the_fit() {
        let mut file = file();
        let loco = read(&file).unwrap();
        assert_eq!((loco.lattice.elements[2].name.as_str(), loco.lattice.elements[2].k1), ("QF", 4.0));
        field(&mut file, "FitParameters", 0, "Params").clone_from(&Mat::Cells(vec![0, 0], Vec::new()));
        let fitted = read(&file).unwrap();
        assert_eq!(fitted.lattice.elements[2].k1, 4.01); // what loco.py takes for fitted
        assert!(fitted.folder.meta.reference_fit.is_none());
    }

    #[test]
    fn a_wrong_sign_or_unit_is_seen_beside_the_lattice() {
        let [x, y] = agreements(|_| ())[..] else { panic!("both planes") };
        assert!(x.correlation > 0.5 && y.correlation > 0.99 && (0.5..2.0).contains(&y.factor));
        let signs =
            agreements(|file| numbers(file, "CMData", 0, "VCMKicks").iter_mut().for_each(|kick| *kick = -*kick));
        assert!((signs[1].correlation + y.correlation).abs() < 1e-9 && signs[0].correlation == x.correlation);
        let metres = agreements(|file| numbers(file, "LocoMeasData", 0, "M").iter_mut().for_each(|one| *one /= 1e3));
        assert!((metres[1].factor / y.factor - 1e-3).abs() < 1e-9);
        let halves = agreements(|file| numbers(file, "CMData", 0, "VCMKicks").iter_mut().for_each(|kick| *kick /= 2.0));
        assert!((halves[1].factor / y.factor - 2.0).abs() < 1e-9);
        let order = agreements(|file| numbers(file, "CMData", 0, "VCMIndex").rotate_left(5));
        assert!(order[1].correlation < 0.5);
    }

    #[test]
    fn what_does_not_fit_is_refused_with_its_field() {
        assert_eq!(
            refused(|file| numbers(file, "BPMData", 0, "VBPMIndex").truncate(11)),
            "LocoMeasData.M: expected 23x24 numbers, monitors of BPMData by correctors of CMData, found 24x24 numbers"
        );
        assert_eq!(
            refused(|file| numbers(file, "BPMData", 0, "HBPMIndex")[2] = 13.0),
            "BPMData(1).HBPMIndex: number 3: expected a place in BPMIndex, 1 to 12, found 13"
        );
        assert_eq!(
            refused(|file| numbers(file, "CMData", 0, "HCMIndex")[0] = 1.5),
            "CMData(1).HCMIndex: number 1: expected an element of RINGData.Lattice, 1 to 88, found 1.5"
        );
        assert!(
            refused(|file| numbers(file, "CMData", 0, "HCMIndex")[1] = 4.0)
                .contains("CMData: number 2 of all, element 4, stands there twice")
        );
        assert_eq!(
            refused(|file| numbers(file, "LocoMeasData", 0, "BPMSTD").truncate(23)),
            "LocoMeasData.BPMSTD: expected 24 numbers, one a row of M, found 24x1 numbers"
        );
        assert!(
            refused(|file| numbers(file, "LocoMeasData", 0, "BPMSTD").fill(0.0))
                .contains("no monitor that counts has a noise above 0")
        );
        assert!(
            refused(|file| numbers(file, "LocoMeasData", 0, "RF")[0] = 499.65)
                .contains("RF: 499.65 Hz, but RINGData.CavityFrequency is 499654")
        );
        assert!(refused(|file| numbers(file, "LocoMeasData", 0, "DeltaRF")[0] = 0.0).contains("DeltaRF: 0 Hz"));
        assert!(
            refused(|file| numbers(file, "RINGData", 0, "Energy")[0] = 1.5e9).contains("RINGData.Energy: expected GeV")
        );
        assert!(
            refused(|file| numbers(file, "CMData", 0, "HCMKicks")[3] = 0.0)
                .contains("CMData: kick of column 4: 0 mrad")
        );
        assert_eq!(
            refused(|file| *field(file, "LocoMeasData", 0, "M") = Mat::Text("none".into())),
            "LocoMeasData.M: expected 24x24 numbers, monitors of BPMData by correctors of CMData, found the text \"none\""
        );
        assert!(
            refused(|file| file.variables.retain(|(name, _)| name != "CMData"))
                .contains("no variable CMData, which a LOCO file has; found BPMData (a 1x2 struct)")
        );
        assert!(
            refused(|file| *field(file, "BPMData", 0, "BPMIndex") = Mat::Numbers(vec![0, 0], Vec::new()))
                .contains("BPMData: no field BPMIndex, or nothing in it")
        );
    }

    #[test]
    fn kicks_that_the_file_lacks_are_asked_for() {
        let mut file = file();
        let stated = Lacking { kick: Some(PerInstrument::Planes([0.2, 0.15])), rf: None };
        assert!(super::read(&file, &stated).unwrap_err().to_string().contains("leave --kick out"));
        let whole = read(&file).unwrap().folder;
        *field(&mut file, "CMData", 0, "HCMKicks") = Mat::Numbers(vec![0, 0], Vec::new());
        assert!(read(&file).unwrap_err().to_string().contains("state with --kick MRAD"));
        let own = super::read(&file, &stated).unwrap().folder;
        assert!(own.correctors.iter().zip(&whole.correctors).all(|(own, whole)| own.kick == whole.kick));
    }

    #[test]
    fn an_rf_frequency_that_the_file_lacks_is_asked_for() {
        let mut file = file();
        let stated = Lacking { rf: Some(5e8), kick: None };
        assert!(super::read(&file, &stated).unwrap_err().to_string().contains("leave --rf-frequency out"));
        for (variable, name) in [("LocoMeasData", "RF"), ("RINGData", "CavityFrequency")] {
            *field(&mut file, variable, 0, name) = Mat::Numbers(vec![0, 0], Vec::new());
        }
        assert!(read(&file).unwrap_err().to_string().contains("state the RF frequency with --rf-frequency HZ"));
        assert_eq!(super::read(&file, &stated).unwrap().folder.meta.rf, 5e8);
    }

    #[test]
    fn what_counts_is_that_of_the_last_iteration() {
        let mut file = file();
        numbers(&mut file, "BPMData", 1, "HBPMGoodDataIndex").retain(|one| *one != 2.0);
        numbers(&mut file, "BPMData", 0, "VBPMGoodDataIndex").clear();
        numbers(&mut file, "CMData", 1, "VCMGoodDataIndex").retain(|one| *one != 12.0);
        numbers(&mut file, "LocoMeasData", 0, "BPMSTD")[23] = 0.0;
        let folder = read(&file).unwrap().folder;
        let idle = |used: Vec<bool>| (0..used.len()).filter(|at| !used[*at]).collect::<Vec<_>>();
        assert_eq!(idle(folder.monitors.iter().map(|one| one.is_used).collect()), [1, 23]);
        assert_eq!(idle(folder.correctors.iter().map(|one| one.is_used).collect()), [23]);
    }

    #[test]
    fn a_corrector_in_a_magnet_acts_in_its_middle_and_its_groups_follow() {
        let mut file = file();
        numbers(&mut file, "CMData", 0, "HCMIndex")[0] = 3.0;
        let folder = read(&file).unwrap().folder;
        assert_eq!((folder.lattice.len(), folder.correctors[0].at), (90, 3));
        let rows: Vec<_> = [2, 3, 4].map(|row| (folder.lattice[row].length, folder.lattice[row].k1)).into();
        assert_eq!(rows, [(0.15, 4.0), (0.0, 0.0), (0.15, 4.0)]);
        let groups = &folder.meta.reference_fit.as_ref().unwrap().fit_parameters;
        assert_eq!((&groups[0].elements[..], &groups[1].elements[..]), (&[2, 4][..], &[12][..]));
    }

    #[test]
    fn a_parameter_that_is_no_gradient_is_left_out_and_said() {
        let mut file = file();
        let Mat::Cells(_, groups) = field(&mut file, "FitParameters", 0, "Params") else { panic!("cells") };
        let Mat::Structs(_, names, values) = &mut groups[0] else { panic!("a struct") };
        let at = names.iter().position(|own| own == "Function").unwrap();
        values[0][at] = Mat::Other("function handle");
        let loco = read(&file).unwrap();
        assert_eq!(loco.folder.meta.reference_fit.unwrap().fit_parameters.len(), 27);
        assert_eq!((loco.lattice.elements[2].k1, loco.lattice.left_out.len()), (4.01, 1));
    }

    #[test]
    fn no_byte_makes_it_panic() {
        let mut random = StdRng::seed_from_u64(6);
        let mut file = file();
        // values of every kind in every place of the structs
        for _ in 0..2000 {
            let (variable, value) = {
                let at = random.random_range(0..file.variables.len());
                &mut file.variables[at]
            };
            let name = variable.clone();
            let Mat::Structs(_, _, values) = value else { continue };
            let at = random.random_range(0..values.len());
            let field = random.random_range(0..values[at].len());
            let others = [
                Mat::Numbers(vec![0, 0], Vec::new()),
                Mat::Numbers(vec![2, 1], vec![f64::NAN, -1.0]),
                Mat::Numbers(vec![1, 1], vec![1e300]),
                Mat::Text("K".into()),
                Mat::Cells(vec![1, 1], vec![Mat::Other("object")]),
                Mat::Structs(vec![1, 0], vec!["FamName".into()], Vec::new()),
            ];
            let own = core::mem::replace(&mut values[at][field], others[random.random_range(0..others.len())].clone());
            drop(read(&file));
            let (_, value) = file.variables.iter_mut().find(|(own, _)| *own == name).unwrap();
            let Mat::Structs(_, _, values) = value else { continue };
            values[at][field] = own;
        }
        assert!(read(&file).is_ok());
    }
}
