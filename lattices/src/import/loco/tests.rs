//! The measurement of twelve cells as a LOCO file, with changes.

use std::path::Path;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;
use twin::Rf;

use super::*;
use crate::import::mat::Mat;
use crate::import::{Agreement, agreement};

/// The measurement of `recordings/measured/twelve-cells/before` by tests/peers/loco.py and Octave.
const FILE: &[u8] = include_bytes!("../../../../recordings/measured/imports/twelve-cells.loco.mat");

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
        let of = |row: &measured::folder::Row| {
            (row.name.clone(), [row.length, row.bend, row.edge_in, row.edge_out, row.fringe, row.k1, row.half_k2])
        };
        assert_eq!(of(own), of(other));
        assert!((own.s - other.s).abs() < 1e-9); // a sum of lengths with one decimal
    }
    for (own, other) in own.monitors.iter().zip(&other.monitors) {
        assert_eq!((own.plane, own.at, own.sigma, own.is_used), (other.plane, other.at, other.sigma, other.is_used));
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
    for iteration in [0, 1] {
        *field(&mut file, "FitParameters", iteration, "Params") = Mat::Cells(vec![0, 0], Vec::new());
    }
    let fitted = read(&file).unwrap();
    assert_eq!(fitted.lattice.elements[2].k1, 4.01); // what loco.py takes for fitted
    assert!(fitted.folder.meta.reference_fit.is_none());
}

#[test]
fn a_wrong_sign_or_unit_is_seen_beside_the_lattice() {
    let [x, y] = agreements(|_| ())[..] else { panic!("both planes") };
    assert!(x.correlation > 0.5 && y.correlation > 0.99 && (0.5..2.0).contains(&y.factor));
    let signs = agreements(|file| numbers(file, "CMData", 0, "VCMKicks").iter_mut().for_each(|kick| *kick = -*kick));
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
        refused(|file| numbers(file, "RINGData", 0, "Energy")[0] = 1.5e5).contains("RINGData.Energy: expected GeV")
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
    numbers(&mut file, "CMData", 0, "HCMKicks")[3] = 0.0;
    let folder = read(&file).unwrap().folder;
    let idle = |used: Vec<bool>| (0..used.len()).filter(|at| !used[*at]).collect::<Vec<_>>();
    assert_eq!(idle(folder.monitors.iter().map(|one| one.is_used).collect()), [1, 23]);
    assert_eq!(idle(folder.correctors.iter().map(|one| one.is_used).collect()), [3, 23]);
    // an empty list is of none, and no list of all
    numbers(&mut file, "CMData", 0, "VCMGoodDataIndex").clear();
    numbers(&mut file, "CMData", 1, "VCMGoodDataIndex").clear();
    assert_eq!(read(&file).unwrap().folder.correctors.iter().filter(|one| one.is_used).count(), 11);
    let (_, value) = file.variables.iter_mut().find(|(name, _)| name == "CMData").unwrap();
    let Mat::Structs(_, names, _) = value else { panic!("{value:?}") };
    names.iter_mut().filter(|name| *name == "VCMGoodDataIndex").for_each(|name| *name = "Other".into());
    assert_eq!(read(&file).unwrap().folder.correctors.iter().filter(|one| one.is_used).count(), 23);
}

/// What a fit that was only prepared, or went astray, has left in its last iteration.
#[test]
fn the_last_iteration_may_be_empty_or_have_no_numbers() {
    let whole = json!(read(&file()).unwrap().folder.meta.reference_fit.unwrap());
    let mut emptied = file();
    for variable in ["FitParameters", "BPMData", "CMData", "LocoModel", "LocoFlags"] {
        let (_, value) = emptied.variables.iter_mut().find(|(name, _)| name == variable).unwrap();
        let Mat::Structs(shape, names, values) = value else { panic!("{variable}") };
        values.push(vec![Mat::Numbers(vec![0, 0], Vec::new()); names.len()]);
        *shape = vec![1, values.len()];
    }
    let loco = read(&emptied).unwrap();
    assert_eq!(json!(loco.folder.meta.reference_fit.unwrap()), whole);
    assert!(
        loco.folder.monitors.iter().zip(&read(&file()).unwrap().folder.monitors).all(|(a, b)| a.is_used == b.is_used)
    );
    let mut astray = file();
    numbers(&mut astray, "FitParameters", 1, "Values")[0] = f64::NAN;
    *field(&mut astray, "BPMData", 1, "HBPMGain") = Mat::Other("complex matrix");
    let fit = read(&astray).unwrap().folder.meta.reference_fit.unwrap();
    assert_eq!(fit.fit_parameters.len(), 28);
    assert!(!fit.rest.contains_key("values_final") && !fit.rest.contains_key("bpm_gain_x"));
    let prepared = refused(|file| numbers(file, "FitParameters", 0, "Values")[0] = f64::NAN);
    assert_eq!(prepared, "FitParameters(1).Params{1}: starts at NaN");
}

/// LOCO sets its parameters in their order: what a later one sets is its own.
#[test]
fn a_parameter_that_a_later_one_sets_is_left_out() {
    let mut file = file();
    for iteration in [0, 1] {
        // all of QF's first two by one parameter in front, the second again behind
        let Mat::Cells(shape, groups) = field(&mut file, "FitParameters", iteration, "Params") else { panic!("cells") };
        let both = match (&groups[0], &groups[1]) {
            (Mat::Structs(_, names, first), Mat::Structs(_, _, second)) => {
                Mat::Structs(vec![1, 2], names.clone(), [first.clone(), second.clone()].concat())
            }
            _ => panic!("structs"),
        };
        groups[0] = both;
        groups.push(groups[2].clone());
        *shape = vec![1, groups.len()];
        let values = numbers(&mut file, "FitParameters", iteration, "Values");
        values.push(values[2]);
        let Mat::Numbers(shape, _) = field(&mut file, "FitParameters", iteration, "Values") else { panic!("numbers") };
        *shape = vec![29, 1];
    }
    let loco = read(&file).unwrap();
    let groups = loco.folder.meta.reference_fit.as_ref().unwrap();
    assert_eq!(groups.fit_parameters.len(), 28);
    assert_eq!(groups.fit_parameters[0].elements, [2]);
    assert_eq!(loco.lattice.left_out.iter().collect::<Vec<_>>().len(), 1);
    let folder = tempfile::tempdir().unwrap();
    crate::import::write(&loco.folder, &folder.path().join("ring"), &Default::default()).unwrap();
}

#[test]
fn flags_count_whatever_their_case_and_loco_has_its_own() {
    let flags = |change: &dyn Fn(&mut MatFile)| {
        let mut file = file();
        change(&mut file);
        let fit = read(&file).unwrap().folder.meta.reference_fit.unwrap();
        [fit.flags.coupling, fit.flags.dispersion]
    };
    let said = |word: &'static str| {
        move |file: &mut MatFile| {
            let (_, value) = file.variables.iter_mut().find(|(name, _)| name == "LocoFlags").unwrap();
            let Mat::Structs(_, names, values) = value else { panic!("{value:?}") };
            let at = names.iter().position(|name| name == "Coupling").unwrap();
            values.iter_mut().for_each(|one| one[at] = Mat::Text(word.into()));
        }
    };
    assert_eq!(flags(&said("YES")), ["Yes", "Yes"]);
    assert_eq!(flags(&said("no")), ["No", "Yes"]);
    assert_eq!(flags(&|file| file.variables.retain(|(name, _)| name != "LocoFlags")), ["No", "Yes"]);
}

#[test]
fn a_lattice_may_be_a_struct_array_and_noise_one_number() {
    let mut file = file();
    let plain = read(&file).unwrap();
    let Mat::Cells(_, cells) = field(&mut file, "RINGData", 0, "Lattice") else { panic!("cells") };
    let mut names: Vec<String> = Vec::new();
    let struct_of = |cell: &Mat| match cell {
        Mat::Structs(_, names, values) => names.iter().cloned().zip(values[0].clone()).collect::<BTreeMap<_, _>>(),
        other => panic!("{other:?}"),
    };
    let all: Vec<BTreeMap<String, Mat>> = cells.iter().map(struct_of).collect();
    all.iter().flat_map(BTreeMap::keys).for_each(|name| {
        if !names.contains(name) {
            names.push(name.clone());
        }
    });
    let empty = || Mat::Numbers(vec![0, 0], Vec::new());
    let one = |fields: &BTreeMap<String, Mat>| {
        names.iter().map(|name| fields.get(name).cloned().unwrap_or_else(empty)).collect()
    };
    let values: Vec<Vec<Mat>> = all.iter().map(one).collect();
    *field(&mut file, "RINGData", 0, "Lattice") = Mat::Structs(vec![1, values.len()], names, values);
    *field(&mut file, "LocoMeasData", 0, "BPMSTD") = Mat::Numbers(vec![1, 1], vec![0.003]);
    let loco = read(&file).unwrap();
    assert_eq!(loco.lattice.elements, plain.lattice.elements);
    assert!(loco.folder.monitors.iter().all(|one| one.sigma == 0.003));
}

/// Parameters of one struct each stand in a cell array, or are a struct array.
#[test]
fn parameters_of_a_struct_array_are_each_its_own() {
    let [mut cells, mut array] = [file(), file()];
    let Mat::Cells(shape, groups) = field(&mut cells, "FitParameters", 0, "Params").clone() else { panic!("cells") };
    let first = |group: &Mat| match group {
        Mat::Structs(_, names, values) => (names.clone(), values[0].clone()),
        _ => panic!("a struct"),
    };
    let (names, values): (Vec<_>, Vec<_>) = groups.iter().map(first).unzip();
    let alone = values.iter().map(|one| Mat::Structs(vec![1, 1], names[0].clone(), vec![one.clone()]));
    *field(&mut cells, "FitParameters", 0, "Params") = Mat::Cells(shape.clone(), alone.collect());
    *field(&mut array, "FitParameters", 0, "Params") = Mat::Structs(shape, names[0].clone(), values);
    let [cells, array] = [cells, array].map(|file| read(&file).unwrap());
    let parameters = [&cells, &array].map(|one| json!(one.folder.meta.reference_fit.as_ref().unwrap()));
    assert_eq!(parameters[0], parameters[1]);
    assert_eq!(cells.lattice.elements, array.lattice.elements);
}

/// `{1,2}` of a line and `{2,1}` of a column are the gradient; a trim of an insertion device that is tracked as a drift is nothing.
#[test]
fn fields_of_parameters_are_found_in_any_form() {
    let change = |file: &mut MatFile, name: &str, value: Mat| {
        let Mat::Cells(_, groups) = field(file, "FitParameters", 0, "Params") else { panic!("cells") };
        let Mat::Structs(_, names, values) = &mut groups[0] else { panic!("a struct") };
        let at = names.iter().position(|own| own == name).unwrap();
        values[0][at] = value;
    };
    let count = |changes: &[(&str, Mat)]| {
        let mut file = file();
        changes.iter().for_each(|(name, value)| change(&mut file, name, value.clone()));
        read(&file).unwrap().folder.meta.reference_fit.unwrap().fit_parameters.len()
    };
    let number = |value: f64| Mat::Numbers(vec![1, 1], vec![value]);
    let polynomial = ("FieldName", Mat::Text("PolynomB".into()));
    for [row, column] in [[1.0, 2.0], [2.0, 1.0]] {
        let cells = Mat::Cells(vec![1, 2], vec![number(row), number(column)]);
        let list = Mat::Numbers(vec![1, 2], vec![row, column]);
        for index in [cells, list] {
            assert_eq!(count(&[polynomial.clone(), ("FieldIndex", index)]), 28);
        }
    }
    for expression in ["x", "@(x)x", "1.0 .* x", "x*1"] {
        assert_eq!(count(&[("Function", Mat::Text(expression.into()))]), 28, "{expression}");
    }
    assert_eq!(count(&[("Function", Mat::Text("sin(x)".into()))]), 27);
    // element 2 is a drift, and a family that is not in the lattice has no element
    assert_eq!(count(&[("ElemIndex", number(2.0))]), 27);
    assert_eq!(count(&[("ElemIndex", Mat::Numbers(vec![0, 0], Vec::new()))]), 27);
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

/// LOCO adds to its values: one that starts at 0 is a gradient of its own, in a magnet with a corrector too.
#[test]
fn a_gradient_that_starts_at_nothing_keeps_its_magnets() {
    let mut file = file();
    numbers(&mut file, "FitParameters", 0, "Values")[0] = 0.0;
    numbers(&mut file, "CMData", 0, "HCMIndex")[0] = 3.0;
    let loco = read(&file).unwrap();
    let (folder, groups) = (&loco.folder, loco.folder.meta.reference_fit.as_ref().unwrap());
    assert_eq!((loco.lattice.elements[2].k1, &groups.fit_parameters[0].elements[..]), (0.0, &[2, 4][..]));
    let all = measured::unknowns::groups(folder);
    let unknowns = measured::unknowns::unknowns(folder, &all, true, &Default::default());
    assert_eq!((unknowns[0].kind, unknowns[0].mean), (measured::Kind::Added(0), 0.0));
    // 0.01 /m over half a magnet
    assert!((unknowns[0].width - 0.01 / 0.15).abs() < 1e-12);
    assert!(measured::lattice::ring(folder, &[], &[]).is_ok());
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
fn no_value_in_a_wrong_place_makes_it_panic() {
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
