//! What users of other rings have reported, each with its right value, and the LOCO files of a ring of 1.37 GeV.
//!
//! None of these files is part of the repository. They are looked for in `../shared` beside the checkout; a test that finds none says so and passes.

use std::path::{Path, PathBuf};

use lattices::import::{
    Conventions, Input, Instruments, KickIs, Lacking, Lattice, Measurement, OrbitUnit, PerInstrument, Signs, Table,
    agreement, assemble, write,
};
use measured::hold::Share;
use measured::{Fit, Folder, Kind, MeasuredError, Settings, Straightened, Wiring};
use twin::{Hold, Optics, Rf};

fn shared(name: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared").join(name);
    if !folder.is_dir() {
        println!("no {}: nothing is tested", folder.display());
    }
    folder.is_dir().then_some(folder)
}

const HELD: Settings = Settings {
    rf: Rf::FixedMomentum,
    widths: measured::unknowns::Widths { strength: 0.03, skew: 0.01, wiggler: 0.1, gain: 0.2, coupling: 0.05 },
    coupling: None,
};

/// A lattice and a matrix, as `import` makes the folder, written and read back.
fn imported(lattice: &Path, matrix: &Path, conventions: Conventions, rf: Option<f64>, correctors: &[&str]) -> Folder {
    let lattice = Lattice::read(lattice).unwrap();
    let patterns: Vec<_> = correctors.iter().map(|one| one.parse().unwrap()).collect();
    let instruments = Instruments::choose(&lattice, &[], &patterns).unwrap();
    let matrix = Table::read(matrix).unwrap();
    let measured = Measurement { matrix: &matrix, dispersion: None, order: None, conventions: &conventions };
    written(&assemble(&lattice, &instruments, rf, &measured).unwrap(), &HELD).unwrap()
}

fn written(folder: &Folder, settings: &Settings) -> Result<Folder, MeasuredError> {
    let made = tempfile::tempdir().unwrap();
    write(folder, &made.path().join("ring"), settings)?;
    Folder::read(&made.path().join("ring"))
}

fn conventions(kick: f64, noise: f64) -> Conventions {
    let (kick, noise) = (PerInstrument::All(kick), PerInstrument::All(noise));
    Conventions { unit: OrbitUnit::Metres, kick, kick_is: KickIs::Full, signs: Signs([true; 2]), noise }
}

fn fitted(folder: &Folder, settings: &Settings) -> Straightened {
    Straightened::of(folder, settings, &mut |_| ()).unwrap()
}

/// Value and standard deviation of the strength of a magnet, by its row.
fn strength(fit: &Fit, row: usize) -> [f64; 2] {
    let group = fit.groups[0].iter().position(|group| group.contains(&row)).unwrap();
    let at = fit.unknowns.iter().position(|one| one.kind == Kind::Strength(group)).unwrap();
    [fit.values[at], fit.sigma(at)]
}

fn loco(path: &Path) -> Folder {
    let Input::Loco(loco) = Input::read(path, &Lacking::default()).unwrap() else { panic!("a LOCO file") };
    written(&loco.folder, &Settings::default()).unwrap()
}

/// 96 dipoles with gradients, scattered by 0.5 %, and 24 of them: each has a factor.
#[test]
fn rings_whose_focusing_is_in_dipoles_are_fitted() {
    let Some(folder) = shared("reports/combined-function-ring") else { return };
    let file = |name: &str| folder.join(name);
    let cells = imported(&file("cf.json"), &file("cf.csv"), conventions(0.2, 1e-6), None, &[]);
    let fit = fitted(&cells, &HELD).fit;
    assert!(fit.groups[0].len() == 24 && fit.chi2_loco < 1.0, "{}", fit.chi2_loco);
    let lattice = Lattice::read(&file("booster-like.tfs")).unwrap();
    let instruments = Instruments::choose(&lattice, &[], &[]).unwrap();
    let bare = lattices::import::bare(&lattice, &instruments).unwrap();
    let ring = measured::lattice::ring(&bare, &[], &[]).unwrap();
    let tunes = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap().tunes().unwrap();
    assert!((tunes.x - 6.70328).abs() < 1e-5 && (tunes.y - 6.74566).abs() < 1e-5, "{tunes:?}");
    let like = Conventions { unit: OrbitUnit::Millimetres, ..conventions(1.0, 0.02) };
    let like = imported(&file("booster-like.tfs"), &file("booster-like.csv"), like, Some(44.7e6), &[]);
    let fit = fitted(&like, &HELD).fit;
    assert_eq!(fit.groups[0].len(), 96);
    assert!((0.8..0.95).contains(&fit.chi2_loco), "{}", fit.chi2_loco);
}

/// QF of the fourth cell became 1 % stronger between two lattices of which one has a marker more, and a monitor less.
#[test]
fn measurements_with_other_markers_and_monitors_are_compared() {
    let Some(folder) = shared("reports/compare-other-lattice") else { return };
    let [before, after] = ["before", "after"].map(|name| {
        let [lattice, matrix] = ["json", "csv"].map(|kind| folder.join(format!("{name}.{kind}")));
        imported(&lattice, &matrix, conventions(0.2, 7e-7), None, &[])
    });
    let (_, changes) = measured::compare(&before, &after, &Settings::default(), &mut |_| ()).unwrap();
    let changed: Vec<_> = changes.gradients.iter().filter(|one| one.has_changed).collect();
    assert!(changed.len() == 1 && changed[0].name == "QF.40", "{changed:?}");
    assert!((changed[0].relative - 0.01).abs() < 3.0 * changed[0].sigma, "{changed:?}");
}

/// A supply keeps its kick when its cable is at another magnet: no gain is far from 1.
#[test]
fn correctors_with_unlike_kicks_that_are_exchanged_keep_their_kicks() {
    let Some(folder) = shared("reports/exchanged-unlike-kicks") else { return };
    let file = |name: &str| folder.join(name);
    let kick = PerInstrument::parse("--kick", file("kicks.txt").to_str().unwrap()).unwrap();
    let stated = Conventions { kick, ..conventions(1.0, 1e-6) };
    let lattice = Lattice::read(&file("ring.json")).unwrap();
    let instruments = Instruments::choose(&lattice, &[], &[]).unwrap();
    let matrix = Table::read(&file("orm.csv")).unwrap();
    let measured = Measurement { matrix: &matrix, dispersion: None, order: None, conventions: &stated };
    let made = written(&assemble(&lattice, &instruments, None, &measured).unwrap(), &Settings::default()).unwrap();
    let found = fitted(&made, &Settings::default());
    assert!(matches!(&found.cables[..], [Wiring::CorrectorsExchanged(pair)] if pair.len() == 2), "{:?}", found.cables);
    let fit = &found.fit;
    assert!(fit.chi2_loco < 1.0, "{}", fit.chi2_loco);
    for (at, one) in fit.unknowns.iter().enumerate().filter(|(_, one)| matches!(one.kind, Kind::CorrectorGain(_))) {
        assert!((fit.values[at] - 1.0).abs() < 0.02, "{:?} {}", one.kind, fit.values[at]);
    }
}

/// LOCO without coupling has 128 elements of the diagonal blocks and 16 of the dispersion.
#[test]
fn loco_without_coupling_leaves_the_blocks_of_the_other_plane_out() {
    let Some(folder) = shared("reports/loco-coupling-no") else { return };
    let fit = fitted(&loco(&folder.join("coupling-no.mat")), &Settings::default()).fit;
    assert_eq!(fit.elements, 144);
    assert!((0.5..0.9).contains(&fit.chi2_loco), "{}", fit.chi2_loco);
}

/// All dipoles have K = 0.004 /m2 as one parameter that starts at 0; quadrupoles are off by 0.4 % rms.
#[test]
fn a_gradient_of_dipoles_that_starts_at_nothing_is_added() {
    let Some(folder) = shared("reports/loco-gradient-from-zero") else { return };
    let fit = fitted(&loco(&folder.join("gradient-from-zero.mat")), &Settings::default()).fit;
    let at = fit.unknowns.iter().position(|one| matches!(one.kind, Kind::Added(_))).unwrap();
    assert!((fit.values[at] - 0.004).abs() < 3.0 * fit.sigma(at) && fit.sigma(at) < 0.002, "{}", fit.values[at]);
    let truth = [(4, 1.0), (8, 1.0012), (16, 0.9989), (20, 0.9964), (28, 0.9982), (32, 0.9960)];
    for (row, expected) in truth {
        let [value, sigma] = strength(&fit, row);
        assert!((value - expected).abs() < 3.0 * sigma, "{row}: {value} ± {sigma}, expected {expected}");
    }
}

/// The third QF is 1 % stronger, in metres per radian, per 10 urad, and as the Matlab Middle Layer has it; noise ten times too large is told.
#[test]
fn a_matrix_per_radian_is_that_of_a_kick_of_ten_microradians() {
    let Some(folder) = shared("reports/m-per-rad") else { return };
    let file = |name: &str| folder.join(name);
    let lattice = file("ring.json");
    let is_right = |fit: &Fit| {
        let [value, sigma] = strength(fit, 28);
        assert!((value - 1.01).abs() < 3.0 * sigma && sigma < 0.001, "{value} ± {sigma}");
        fit.overstated_noise()
    };
    let radians = imported(&lattice, &file("orm_m_per_rad.csv"), conventions(1e3, 0.01), None, &[]);
    let small = |noise| imported(&lattice, &file("orm_m_per_10urad.csv"), conventions(0.01, noise), None, &[]);
    let [radians, small, noisy] = [radians, small(1e-7), small(1e-6)].map(|folder| fitted(&folder, &HELD).fit);
    assert!((radians.values.clone() - &small.values).amax() < 1e-6);
    assert!((small.chi2_loco - 0.60).abs() < 0.01, "{}", small.chi2_loco);
    assert_eq!([&radians, &small].map(is_right), [None, None]);
    assert!((8.0..12.0).contains(&is_right(&noisy).unwrap()));
    let Some(mml) = shared("reports/mml-rmat") else { return };
    let matrix = Table::read(&mml.join("BPMRespMat.mat")).unwrap();
    assert_eq!((matrix.stated.unit, matrix.stated.kick), (Some(OrbitUnit::Millimetres), Some(1e3)));
    let stated = Conventions { unit: OrbitUnit::Millimetres, ..conventions(1e3, 10.0) };
    let fit = fitted(&imported(&mml.join("ring.json"), &mml.join("BPMRespMat.mat"), stated, None, &[]), &HELD).fit;
    assert!((fit.chi2_loco - 0.60).abs() < 0.01, "{}", fit.chi2_loco);
}

/// Equal cells with equal places of correctors, the momentum held: that is said, though exchanged columns are as good.
#[test]
fn a_held_momentum_is_told_in_a_ring_of_equal_cells() {
    let Some(folder) = shared("reports/momentum-held-symmetric") else { return };
    let file = |name: &str| folder.join(name);
    let made = imported(&file("ring.json"), &file("orm.csv"), conventions(0.01, 1e-7), None, &[]);
    let straight = fitted(&made, &Settings::default());
    let share = Share::of_fit(&straight.folder, &straight.fit, &Settings::default(), &mut |_| ()).unwrap();
    assert!(share.other() == Some(Rf::FixedMomentum) && share.gain > 100.0, "{share:?}");
    let [value, sigma] = strength(&fitted(&made, &HELD).fit, 28);
    assert!((value - 1.01).abs() < 3.0 * sigma && sigma < 0.001, "{value} ± {sigma}");
}

#[test]
fn a_rolled_dipole_is_left_out_and_said() {
    let Some(folder) = shared("reports/rolled-dipole") else { return };
    let lattice = Lattice::read(&folder.join("roll.json")).unwrap();
    assert!(lattice.left_out.contains_key("rolls of dipoles (they bend horizontally)"), "{:?}", lattice.left_out);
}

/// The matrix is the lattice's own, without noise: windings kick all along their magnets.
#[test]
fn windings_of_magnets_have_a_gain_of_one() {
    let Some(folder) = shared("reports/winding-in-gradient-magnet") else { return };
    let file = |name: &str| folder.join(name);
    let made = imported(&file("winding.json"), &file("winding.csv"), conventions(0.01, 1e-7), None, &["B"]);
    for one in agreement(&made, Rf::FixedMomentum).unwrap() {
        assert!((one.factor - 1.0).abs() < 1e-4 && one.correlation > 0.999_999, "{one:?}");
    }
    let fit = fitted(&made, &HELD).fit;
    let off = fit.unknowns.iter().zip(&fit.values).map(|(one, value)| (value - one.mean).abs()).fold(0.0, f64::max);
    assert!(off < 1e-3, "{off}");
}

/// Each is read, written as a folder that is fitted, and has a chi-square per element that is not above LOCO's per degree of freedom where LOCO's fit
/// went down.
#[test]
fn loco_files_of_a_real_ring_are_fitted_as_well_as_loco_does() {
    let Some(folder) = shared("recordings/real/uvx/loco") else { return };
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    for path in files.filter(|path| path.extension().is_some_and(|kind| kind == "mat")) {
        let made = loco(&path);
        let fit = fitted(&made, &Settings::default()).fit;
        let stated = &made.meta.reference_fit.as_ref().unwrap().rest["chi2_per_iteration"];
        let stated: Vec<f64> = stated.as_array().unwrap().iter().map(|one| one.as_f64().unwrap()).collect();
        let (first, last) = (stated[0], stated[stated.len() - 1]);
        println!("{}: {first} -> {last} by LOCO, {} -> {}", path.display(), fit.chi2_start, fit.chi2_loco);
        assert!((fit.chi2_start / first - 1.0).abs() < 2e-4, "{}: {}", path.display(), fit.chi2_start);
        assert!(last > first || fit.chi2_loco <= last, "{}: {}", path.display(), fit.chi2_loco);
    }
}
