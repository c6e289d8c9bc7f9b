//! Four measured rings beside the reference's LOCO fits of them.
//!
//! The measurements have no licence and are not part of the repository. They are looked for in `ORBITCAL_MEASURED`, then in
//! `../shared/recordings/real` beside the checkout; a test that finds none says so and passes.

use core::f64::consts::SQRT_2;
use std::path::PathBuf;

use measured::data::Data;
use measured::departure::beforehand;
use measured::{
    Before, Believed, Changes, Concealed, Fit, Folder, Kind, Model, Prediction, Settings, Straightened, Wiring,
    against, conceal, fit, straightened,
};
use nalgebra::{DMatrix, DVector};
use rand::rngs::StdRng;
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};
use system_tests::{measured_ring as ring, repository};
use twin::Rf;

/// A measurement with its cables put right, what was wrong, and its fit.
fn fitted_with_cables(as_measured: &Folder, settings: &Settings) -> (Folder, Vec<Wiring>, Fit) {
    let Straightened { folder, cables, fit } = Straightened::of(as_measured, settings, &mut |_| ()).unwrap();
    (folder, cables, fit)
}

/// True of an instrument that is left out.
fn is_dead(cable: &&Wiring) -> bool {
    matches!(cable, Wiring::MonitorsDead(_) | Wiring::CorrectorsDead(_))
}

/// Numbers without names, one line a row.
fn table(path: PathBuf) -> DMatrix<f64> {
    let text = std::fs::read_to_string(path).unwrap();
    let rows: Vec<Vec<f64>> =
        text.lines().map(|line| line.split(',').map(|field| field.trim().parse().unwrap()).collect()).collect();
    DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j])
}

/// The twin's matrix of the start lattice is that of AT: tracking through other integrators differs by 0.05 um of 1 mm, at ALS by 0.035.
#[test]
fn the_start_matrix_is_that_of_at() {
    for (name, bar) in [("sps_2007", 1e-4), ("spear3_example", 1e-4), ("pls_2009", 1e-4), ("als_2005_topoff", 2e-4)] {
        let Some(path) = ring(name) else { continue };
        let folder = Folder::read(&path).unwrap();
        let theirs = table(path.join("orm_reference_model_start_mm.csv"));
        let model = Model::of(&folder, &Default::default(), Rf::FixedFrequency).unwrap();
        let ours = model.as_written().unwrap();
        let used = |uses: Vec<bool>| (0..uses.len()).filter(|&i| uses[i]).collect::<Vec<_>>();
        let rows = used(folder.monitors.iter().map(|one| one.is_used).collect());
        let columns = used(folder.correctors.iter().map(|one| one.is_used).collect());
        let ours = ours.select_rows(&rows).select_columns(&columns);
        assert_eq!(ours.shape(), theirs.shape(), "{name}");
        let rms = (&ours - &theirs).norm() / (ours.len() as f64).sqrt();
        println!("{name}: rms {:.4} um", 1e3 * rms);
        assert!(rms < bar, "{name}: {rms} mm");
    }
}

/// The stated noise is that of a difference of frames next to each other, in which the orbit has no time to drift.
#[test]
fn the_stated_noise_is_that_of_pairs_of_frames() {
    let Some(path) = ring("sps_2007") else { return };
    let folder = Folder::read(&path).unwrap();
    let text = std::fs::read_to_string(path.join("noise_frames_100_mm.csv")).unwrap();
    let numbers = |line: &str| line.split(',').skip(1).map(|field| field.parse().unwrap()).collect::<Vec<f64>>();
    let frames: Vec<Vec<f64>> = text.lines().skip(1).map(numbers).collect();
    for (row, one) in folder.monitors.iter().enumerate().filter(|(_, one)| one.is_used) {
        let squares: f64 = frames.windows(2).map(|pair| (pair[1][row] - pair[0][row]).powi(2)).sum();
        let pairs = (squares / (frames.len() - 1) as f64).sqrt();
        // a hundredth: the mean of the differences counts or not
        assert!((one.sigma / pairs - 1.0).abs() < 0.01, "{}: {} {pairs}", folder.monitor(row), one.sigma);
    }
}

/// Chi-square as LOCO counts it, with no more unknowns than the reference had, is not above the reference's.
fn the_fit_is_no_worse_than_that_of_loco(name: &str, reference: f64) {
    let Some(path) = ring(name) else { return };
    // as it was measured, wrong cables and all
    let fitted = fit(&Folder::read(&path).unwrap(), &Settings::default(), &mut |_| ()).unwrap();
    let (elements, aside) = (fitted.elements, fitted.outliers.len());
    println!("{name}: {:.2}, the reference {reference}; {elements} elements, {aside} set aside", fitted.chi2_loco);
    assert!(fitted.has_ended && fitted.chi2_loco <= reference, "{name}: {} above {reference}", fitted.chi2_loco);
    // PLS has three monitors whose cables are wrong, 0.8 % of the elements
    assert!((aside as f64) < 0.01 * elements as f64, "{name}: {:?}", fitted.outliers);
}

#[test]
fn the_fit_of_sps_is_no_worse_than_that_of_loco() {
    the_fit_is_no_worse_than_that_of_loco("sps_2007", 5.43);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn the_fit_of_spear3_is_no_worse_than_that_of_loco() {
    the_fit_is_no_worse_than_that_of_loco("spear3_example", 1056.6);
}

#[test]
#[ignore = "make measured"]
fn the_fits_of_larger_rings_are_no_worse_than_those_of_loco() {
    the_fit_is_no_worse_than_that_of_loco("pls_2009", 516.0);
    the_fit_is_no_worse_than_that_of_loco("als_2005_topoff", 24.0);
}

/// Chi-square of the SPS without couplings of the instruments: the reference has 5.60.
#[test]
fn a_fit_without_coupling_is_no_worse_either() {
    let Some(path) = ring("sps_2007") else { return };
    let settings = Settings { coupling: Some(false), ..Settings::default() };
    let fitted = fit(&Folder::read(&path).unwrap(), &settings, &mut |_| ()).unwrap();
    println!("sps_2007 without coupling: {:.2}", fitted.chi2_loco);
    assert!(fitted.chi2_loco <= 5.60, "{}", fitted.chi2_loco);
}

/// Cables of PLS that were wrong in 2009: two monitors read each other's vertical orbit, and one of them the horizontal orbit of a third, whose own
/// cable is dead.
fn at_pls() -> Vec<Wiring> {
    vec![Wiring::MonitorsExchanged(vec![147, 153]), Wiring::MonitorsExchanged(vec![45, 57])]
}

/// And two neighbouring correctors, which show beside the fit: 0.83 and 1.28 of the stated kick become 1.11 and 1.00, and what a column leaves
/// unexplained falls to a fifth and to a ninth.
#[test]
#[ignore = "make measured"]
fn cables_that_were_wrong_are_found_and_the_fit_is_better() {
    let Some(path) = ring("pls_2009") else { return };
    let as_measured = Folder::read(&path).unwrap();
    let settings = Settings::default();
    let before = fit(&straightened(&as_measured, &settings).unwrap().0, &settings, &mut |_| ()).unwrap();
    let (_, found, fitted) = fitted_with_cables(&as_measured, &settings);
    let (dead, cables): (Vec<Wiring>, Vec<Wiring>) = found.into_iter().partition(|one| is_dead(&one));
    assert_eq!(cables, [at_pls(), vec![Wiring::CorrectorsExchanged(vec![23, 24])]].concat());
    println!("pls_2009: {dead:?}");
    // monitor 45 has the dead cable now
    let [Wiring::MonitorsDead(rows)] = &dead[..] else { panic!("{dead:?}") };
    assert!(rows.contains(&45) && rows.len() == 10, "{dead:?}");
    let gain = |kind: Kind| fitted.values[fitted.unknowns.iter().position(|one| one.kind == kind).unwrap()];
    // nobody tells the fit what the gains are: a prior of 1 ± 0.2, and with the wrong cables -1.96 to 0.83
    let gains = [57, 147, 153].map(|row| gain(Kind::MonitorGain(row)));
    assert!(gains.into_iter().all(|gain| (0.8..1.2).contains(&gain)), "{gains:?}");
    let gains = [23, 24].map(|column| gain(Kind::CorrectorGain(column)));
    assert!(gains.into_iter().all(|gain| (0.85..1.15).contains(&gain)), "{gains:?}");
    println!("pls_2009, cables put right: {:.1}, then {:.1}", before.chi2_loco, fitted.chi2_loco);
    // a fifth of all squares was in these lines; ten that are dead are left out at last, which have fewer than others
    assert!(before.chi2_loco < 400.0, "{}", before.chi2_loco);
    let squares = |one: &Fit| one.chi2_loco * one.elements as f64;
    assert!(squares(&fitted) < 0.96 * squares(&before), "{}", fitted.chi2_loco);
}

/// Two monitors of a measured ring exchanged, one reversed: seen before the fit, on each ring.
#[test]
fn wrong_cables_are_found_in_measured_data() {
    for name in ["sps_2007", "spear3_example", "pls_2009", "als_2005_topoff"] {
        let Some(path) = ring(name) else { continue };
        let plain = Folder::read(&path).unwrap();
        let (_, before) = straightened(&plain, &Settings::default()).unwrap();
        assert_eq!(before, if name == "pls_2009" { at_pls() } else { Vec::new() }, "{name}");
        let used: Vec<usize> = (0..plain.monitors.len()).filter(|&row| plain.monitors[row].is_used).collect();
        let (one, other, third) = (used[2], used[5], used[8]);
        let mut wrong = plain.clone();
        wrong.matrix.swap_rows(one, other);
        wrong.matrix.row_mut(third).neg_mut();
        let (_, found) = straightened(&wrong, &Settings::default()).unwrap();
        let hidden = [Wiring::MonitorsExchanged(vec![one, other]), Wiring::MonitorReversed(third)];
        assert!(hidden.iter().chain(&before).all(|wiring| found.contains(wiring)), "{name}: {found:?}");
        assert_eq!(found.len(), before.len() + 2, "{name}: {found:?}");
    }
}

/// Two measurements, of which the second is the first with changes of a size put into every other quadrupole, and the noise of two measurements: what is
/// found against what was put in. Changes of half a percent are below the error bars of most quadrupoles of the SPS, whose monitors scatter by 5 um.
fn changes_that_were_put_in(name: &str, size: f64) {
    let Some(path) = ring(name) else { return };
    let settings = Settings::default();
    let (one, _, fitted) = fitted_with_cables(&Folder::read(&path).unwrap(), &settings);
    let explained = Before::of_fit((one.clone(), Vec::new()), &fitted, &settings, &mut |_| ()).unwrap();
    let hierarchy = &explained.hierarchy;
    let model = Model::of(&one, &hierarchy.groups, settings.rf).unwrap();
    let mut random = StdRng::seed_from_u64(16);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let quadrupoles = fitted.groups[0].len();
    let changes: Vec<f64> = (0..quadrupoles).map(|i| if i % 2 == 0 { size * normal() } else { 0.0 }).collect();
    let mut values = hierarchy.values.clone();
    changes.iter().enumerate().for_each(|(i, change)| values[i] *= 1.0 + change);
    let [before, after] = [&hierarchy.values, &values].map(|at| model.predict(&hierarchy.unknowns, at).unwrap().matrix);
    let mut other = one.clone();
    let correctors = one.matrix.ncols();
    for ((i, j), value) in
        (0..correctors).flat_map(|j| (0..one.matrix.nrows()).map(move |i| (i, j))).zip(&mut other.matrix)
    {
        *value += after[(i, j)] - before[(i, j)] + 2f64.sqrt() * one.monitors[i].sigma * normal();
    }
    if let Some(dispersion) = &mut other.dispersion {
        *dispersion += after.column(correctors) - before.column(correctors);
    }
    let found = explained.changes_to(&other, &mut |_| ()).unwrap().gradients;
    let told: Vec<(f64, f64, f64)> = (found.iter().zip(&changes).filter(|(one, _)| one.is_identifiable))
        .map(|(one, change)| (one.relative, *change, one.sigma))
        .collect();
    let n = told.len() as f64;
    let pulls = told.iter().map(|(found, put, sigma)| ((found - put) / sigma).powi(2)).sum::<f64>() / n;
    let sum = |of: fn(&(f64, f64, f64)) -> f64| told.iter().map(of).sum::<f64>();
    let correlation = sum(|t| t.0 * t.1) / (sum(|t| t.0 * t.0) * sum(|t| t.1 * t.1)).sqrt();
    println!("{name}: {n} of {quadrupoles} can be told, correlation {correlation:.3}, mean square pull {pulls:.2}");
    // the errors of a ring's quadrupoles follow each other: of n squares about a third count, and the logarithm of their mean scatters by sqrt(6/n); three
    // times that
    // SPEAR3's is 0.13: its error bars hold the common factor of all strengths, which was not changed, and are too wide
    assert!(pulls.ln() < 3.0 * (6.0 / n).sqrt(), "{name}: mean square pull {pulls} of {n}");
    assert!(correlation > 0.92, "{name}: {correlation}");
}

#[test]
fn changes_that_were_put_in_are_found_at_sps() {
    changes_that_were_put_in("sps_2007", 0.02);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn changes_that_were_put_in_are_found_at_spear3() {
    changes_that_were_put_in("spear3_example", 0.005);
}

#[test]
#[ignore = "make measured"]
fn changes_that_were_put_in_are_found_at_pls() {
    changes_that_were_put_in("pls_2009", 0.005);
}

/// What was left out of a fit.
#[derive(Debug, Clone, Copy)]
enum Side {
    Monitors,
    Correctors,
}

/// One element of an instrument that was left out.
struct LeftOut {
    /// Measured less predicted [mm].
    residual: f64,
    /// The same over each scale that its monitor may have, and degrees of freedom.
    off: Vec<f64>,
    freedom: f64,
}

impl LeftOut {
    /// How much of Student's distribution is nearer to 0, on average of the scales.
    fn nearer(&self) -> f64 {
        let below = |off: &f64| match self.freedom.is_finite() {
            true => StudentsT::new(0.0, 1.0, self.freedom).unwrap().cdf(off.abs()),
            false => Normal::standard().cdf(off.abs()),
        };
        2.0 * self.off.iter().map(below).sum::<f64>() / self.off.len() as f64 - 1.0
    }
}

/// Every instrument of a side left out of one of some fits. Its own gain and coupling are fitted to its own row or column, since nothing else tells
/// them: least squares first, then with the weights of the tails.
fn left_out(name: &str, folds: usize, side: Side) -> Option<Vec<LeftOut>> {
    let (as_measured, settings) = (Folder::read(&ring(name)?).unwrap(), Settings::default());
    let (mut folder, _) = straightened(&as_measured, &settings).unwrap();
    fitted_with_cables(&as_measured, &settings).1.iter().filter(is_dead).for_each(|one| one.put_right(&mut folder));
    let is_used: Vec<bool> = match side {
        Side::Monitors => folder.monitors.iter().map(|one| one.is_used).collect(),
        Side::Correctors => folder.correctors.iter().map(|one| one.is_used).collect(),
    };
    let used: Vec<usize> = (0..is_used.len()).filter(|&one| is_used[one]).collect();
    let mut all = Vec::new();
    for fold in 0..folds {
        let out: Vec<usize> = used.iter().copied().skip(fold).step_by(folds).collect();
        let mut others = folder.clone();
        out.iter().for_each(|&one| match side {
            Side::Monitors => others.monitors[one].is_used = false,
            Side::Correctors => others.correctors[one].is_used = false,
        });
        let fitted = fit(&others, &Settings::default(), &mut |_| ()).unwrap();
        let model = Model::of(&folder, &fitted.groups, Rf::FixedFrequency).unwrap();
        let at = model.predict(&fitted.unknowns, &fitted.values).unwrap();
        for one in out {
            all.extend(of_instrument(&folder, &fitted, &at, side, one));
        }
    }
    Some(all)
}

fn of_instrument(folder: &Folder, fitted: &Fit, at: &Prediction, side: Side, one: usize) -> Vec<LeftOut> {
    let (rows, columns) = folder.matrix.shape();
    let elements: Vec<(usize, usize)> = match side {
        Side::Monitors => (0..columns).map(|j| (one, j)).collect(),
        Side::Correctors => (0..rows).map(|i| (i, one)).collect(),
    };
    // the reference did not fit couplings of the instruments at PLS, nor their blocks
    let coupled = fitted.unknowns.iter().any(|one| matches!(one.kind, Kind::MonitorCoupling(_)));
    let is_read = |&(i, j): &(usize, usize)| {
        let (monitor, corrector) = (&folder.monitors[i], &folder.correctors[j]);
        let is_fitted = coupled || monitor.plane == corrector.plane;
        monitor.is_used && corrector.is_used && is_fitted && folder.matrix[(i, j)].is_finite()
    };
    let elements: Vec<(usize, usize)> = elements.into_iter().filter(is_read).collect();
    let by = match side {
        Side::Monitors => &at.by_monitor,
        Side::Correctors => &at.by_corrector,
    };
    let scale = |&(i, j): &(usize, usize)| {
        let by_machine = at.by_machine.columns(&[j]).row(i).transpose();
        let of_magnets = fitted.uncertainty.variance(&by_machine.resize_vertically(fitted.values.len(), 0.0));
        let missed = fitted.noise.blocks[fitted.data.block[(i, j)]];
        ((fitted.noise.monitors[i] * missed.spread(folder.monitors[i].sigma)).hypot(of_magnets.sqrt()), missed.freedom)
    };
    let (scale, freedom): (Vec<f64>, Vec<f64>) = elements.iter().map(scale).unzip();
    let n = elements.len();
    let numbers = if coupled { 2 } else { 1 };
    let mut off = vec![0.0; n];
    for _ in 0..5 {
        let root = |r: usize| match freedom[r].is_finite() {
            true => ((freedom[r] + 1.0) / (freedom[r] + off[r] * off[r])).sqrt() / scale[r],
            false => scale[r].recip(),
        };
        let own = DMatrix::from_fn(n, numbers, |r, k| by[k][elements[r]] * root(r));
        let seen = DVector::from_fn(n, |r, _| folder.matrix[elements[r]] * root(r));
        let normal = own.tr_mul(&own) + DMatrix::identity(numbers, numbers) * 1e-12;
        let solved = normal.cholesky().unwrap().solve(&own.tr_mul(&seen));
        let predicted = |r: usize| (0..numbers).map(|k| by[k][elements[r]] * solved[k]).sum::<f64>();
        off = (0..n).map(|r| (folder.matrix[elements[r]] - predicted(r)) / scale[r]).collect();
    }
    // a monitor that was left out errs as any of the others in its plane
    let scales: Vec<f64> = match side {
        Side::Correctors => vec![1.0],
        Side::Monitors => {
            let is_fitted = |row: &usize| fitted.data.sigma.row(*row).iter().any(|sigma| sigma.is_finite());
            let plane = |row: usize| folder.monitors[row].plane;
            let others = (0..rows).filter(|&row| plane(row) == plane(one)).filter(is_fitted);
            others.map(|row| fitted.noise.monitors[row]).collect()
        }
    };
    let left_out = |r: usize| LeftOut {
        residual: off[r] * scale[r],
        off: scales.iter().map(|other| off[r] / other).collect(),
        freedom: freedom[r],
    };
    (0..n).map(left_out).collect()
}

/// Bands of 68 and 95 % of what is predicted for instruments that were left out hold 63 to 73 and 92 to 98 %, as is asked for.
fn are_predicted_within_the_learnt_error(side: Side) {
    for (name, folds) in [("sps_2007", 7), ("spear3_example", 4), ("pls_2009", 3), ("als_2005_topoff", 2)] {
        let Some(all) = left_out(name, folds, side) else { continue };
        let within = |band: f64| all.iter().filter(|one| one.nearer() < band).count() as f64 / all.len() as f64;
        let rms = (all.iter().map(|one| one.residual.powi(2)).sum::<f64>() / all.len() as f64).sqrt();
        let [low, high] = [0.68, 0.95].map(within);
        println!(
            "{name}, {side:?}: {:.1} % and {:.1} % of {}, rms {:.1} um",
            1e2 * low,
            1e2 * high,
            all.len(),
            1e3 * rms
        );
        assert!((0.63..0.73).contains(&low) && (0.92..0.98).contains(&high), "{name}");
    }
}

#[test]
#[ignore = "make measured"]
fn correctors_left_out_are_predicted_within_the_learnt_error() {
    are_predicted_within_the_learnt_error(Side::Correctors);
}

#[test]
#[ignore = "make measured"]
fn monitors_left_out_are_predicted_within_the_learnt_error() {
    are_predicted_within_the_learnt_error(Side::Monitors);
}

/// What was said of one effect that was put into a measured matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Answer {
    Named,
    Silent,
    Wrong,
}

/// Effects of kinds, places and sizes by their seeds, put into a measured matrix with the noise of two measurements, and compared with the matrix as it
/// was measured: what each could gain at most [nat], and what was said.
fn injected(name: &str, seeds: u64) -> Option<Vec<(Concealed, Answer)>> {
    let settings = Settings::default();
    let (one, cables, fitted) = fitted_with_cables(&Folder::read(&ring(name)?).unwrap(), &settings);
    let before = Before::of_fit((one.clone(), cables.clone()), &fitted, &settings, &mut |_| ()).unwrap();
    let answer = |seed: u64| {
        let (mut other, hidden) = conceal(&one, &fitted, &settings, seed).unwrap();
        let mut random = StdRng::seed_from_u64(1000 + seed);
        for i in 0..one.monitors.len() {
            let sigma = other.monitors[i].sigma;
            let mut noise = || -> f64 { 2f64.sqrt() * sigma * random.sample::<f64, _>(StandardNormal) };
            other.matrix.row_mut(i).iter_mut().for_each(|element| *element += noise());
        }
        // the cables that were put right before are wrong in the second measurement as well; pairs and signs undo themselves
        cables.iter().rev().for_each(|cable| cable.put_right(&mut other));
        let found = before.changes_to(&other, &mut |_| ()).unwrap();
        let answer = judged(&one, &hidden, &found);
        let changes =
            found.others.iter().map(|one| format!("{} {} {:.5} ± {:.5}", one.word, one.at, one.change, one.sigma));
        let gradients = found.gradients.iter().filter(|one| one.has_changed);
        let said: Vec<String> = changes
            .chain(gradients.map(|one| format!("{} {:.5} ± {:.5}", one.name, one.relative, one.sigma)))
            .collect();
        println!("{name} {seed}: {hidden:?} {answer:?} {said:?}");
        (hidden, answer)
    };
    Some((0..seeds).map(answer).collect())
}

/// Named where it is said with its place and within four standard deviations, wrong where anything else is said.
fn judged(folder: &Folder, hidden: &Concealed, found: &Changes) -> Answer {
    let is_within = |change: f64, sigma: f64| hidden.amplitude.is_some_and(|it| (change - it).abs() < 4.0 * sigma);
    let cables = found.wiring.iter().map(|one| one.named(folder) == (hidden.kind, hidden.at.clone()));
    let others = found
        .others
        .iter()
        .map(|one| one.word == hidden.kind && one.at == hidden.at && is_within(one.change, one.sigma));
    let gradients =
        found.gradients.iter().filter(|one| one.has_changed).map(|one| {
            hidden.kind == "quadrupole_gradient" && one.name == hidden.at && is_within(one.relative, one.sigma)
        });
    let said: Vec<bool> = cables.chain(others).chain(gradients).collect();
    match (said.contains(&false), said.contains(&true)) {
        (true, _) => Answer::Wrong,
        (false, true) => Answer::Named,
        (false, false) => Answer::Silent,
    }
}

#[test]
#[ignore = "make measured"]
fn effects_put_into_measured_data_are_named() {
    let mut false_answers = 0;
    // of ALS the first ten: 40 take four minutes
    for (name, seeds) in [("sps_2007", 40), ("spear3_example", 40), ("pls_2009", 40), ("als_2005_topoff", 10)] {
        let Some(all) = injected(name, seeds) else { continue };
        let of = |least: f64, most: f64, answer: Answer| {
            all.iter().filter(|(hidden, said)| (least..most).contains(&hidden.gain) && *said == answer).count()
        };
        for (least, most) in [(0.0, 9.0), (9.0, 25.0), (25.0, f64::INFINITY)] {
            let [named, silent, wrong] =
                [Answer::Named, Answer::Silent, Answer::Wrong].map(|answer| of(least, most, answer));
            println!("{name}, gain {least} to {most}: {named} named, {silent} silent, {wrong} wrong");
            if least == 25.0 {
                // as is asked for
                assert!(named as f64 >= 0.9 * (named + silent + wrong) as f64, "{name}");
            }
        }
        // the fit of PLS has no couplings: a magnet that changes in it is none of a ring whose monitors see up to half of the other plane
        let wrong = all.iter().filter(|(_, said)| *said == Answer::Wrong).count();
        false_answers += if name == "pls_2009" { 0 } else { wrong };
    }
    // beside a kick that changed by 10 %, its coupling, which is told in kicks; beside a gradient that changed by 1.8 %, some of 0.1 %; one of SPS
    assert!(false_answers <= 3, "{false_answers} of 90");
}

/// A measurement with some of the stated noise in addition: with `sqrt(2)` of it, it differs from the first by as much as two measurements do.
fn measured_again(folder: &Folder, share: f64, seed: u64) -> Folder {
    let sigma = Data::of(folder).sigma.map(|sigma| if sigma.is_finite() { sigma } else { 0.0 });
    let mut random = StdRng::seed_from_u64(900 + seed);
    let noise =
        sigma.map(|sigma| sigma * share * <StandardNormal as Distribution<f64>>::sample(&StandardNormal, &mut random));
    let columns = folder.correctors.len();
    let mut again = folder.clone();
    again.matrix += noise.columns(0, columns);
    if let Some(dispersion) = &mut again.dispersion {
        *dispersion += noise.column(columns);
    }
    again
}

/// Variance of each unknown by the data alone, everything else departing as far as it may.
fn by_data(fitted: &Fit) -> DVector<f64> {
    let independent = &fitted.uncertainty.independent;
    let mut precision = independent.clone().try_inverse().unwrap();
    let width = |at: usize| beforehand(fitted.unknowns[at].kind);
    (0..fitted.unknowns.len())
        .for_each(|at| precision[(at, at)] += width(at).powi(-2) - fitted.unknowns[at].width.powi(-2));
    let held = precision.try_inverse().unwrap();
    DVector::from_fn(fitted.unknowns.len(), |at, _| {
        let alike = fitted.sigma(at).powi(2) / independent[(at, at)];
        alike / (held[(at, at)].recip() - width(at).powi(-2)).max(f64::EPSILON)
    })
}

/// Of a measured ring the gains of ten instruments that an oracle would gain 25 nat from, ten pairs of monitors and all skew gradients are taken
/// out of the fitted model, gains and pairs in some runs, and looked for in the measurement: how many of each were named, of how many, and what
/// was said of other places.
fn hidden(path: PathBuf, noise: f64, runs: usize) -> [[usize; 2]; 4] {
    let settings = Settings::default();
    let as_measured = Folder::read(&path).unwrap();
    let (folder, cables, fitted) = fitted_with_cables(&as_measured, &settings);
    let whole = Believed::of(&as_measured, &cables, &fitted);
    let mut random = StdRng::seed_from_u64(8);
    let named = |kind: Kind| measured::unknowns::name(&folder, &fitted.groups, kind);
    let value = |kind: Kind| fitted.values[fitted.unknowns.iter().position(|one| one.kind == kind).unwrap()];
    // what kind and place alone could gain [nat] in a second measurement, everything else adapting as far as it may depart
    let (_, _, again) = fitted_with_cables(&measured_again(&as_measured, noise, 99), &settings);
    let [by_first, by_second] = [&fitted, &again].map(by_data);
    let oracle = |at: usize, nothing: f64| 0.5 * (fitted.values[at] - nothing).powi(2) / (by_first[at] + by_second[at]);
    let is_known = |at: &usize| {
        let is_gain = matches!(fitted.unknowns[*at].kind, Kind::MonitorGain(_) | Kind::CorrectorGain(_));
        is_gain && oracle(*at, 1.0) > 25.0
    };
    let known: Vec<usize> = (0..fitted.unknowns.len()).filter(is_known).collect();
    let gains: Vec<Kind> = known.sample(&mut random, 10).map(|&at| fitted.unknowns[at].kind).collect();
    // monitors that read, and whose cables are right
    let reads = |row: &usize| {
        let is_hidden = gains.contains(&Kind::MonitorGain(*row));
        let name = folder.monitor(*row);
        let is_wrong = cables.iter().any(|one| one.named(&folder).1.contains(&name));
        folder.monitors[*row].is_used && !is_hidden && !is_wrong && value(Kind::MonitorGain(*row)) > 0.3
    };
    let mut rows: Vec<usize> = (0..folder.monitors.len()).filter(reads).collect();
    rows.shuffle(&mut random);
    let (horizontal, vertical): (Vec<usize>, Vec<usize>) =
        rows.into_iter().partition(|&row| folder.monitors[row].plane == twin::Plane::X);
    let pairs: Vec<Vec<usize>> = horizontal
        .chunks_exact(2)
        .zip(vertical.chunks_exact(2))
        .flat_map(|(x, y)| [x, y])
        .take(10)
        .map(|pair| vec![pair[0].min(pair[1]), pair[0].max(pair[1])])
        .collect();
    let [mut of_gains, mut of_pairs, mut of_skews, mut wrong] = [[0, 0]; 4];
    for run in 0..runs {
        let mut model = whole.clone();
        let out: Vec<Kind> = gains.iter().skip(run).step_by(runs).copied().collect();
        out.iter()
            .for_each(|&kind| assert_eq!(model.take_out(&format!("{} {}", kind.word(), named(kind))).unwrap(), 1));
        let exchanged: Vec<Wiring> =
            pairs.iter().skip(run).step_by(runs).cloned().map(Wiring::MonitorsExchanged).collect();
        let mut measured = measured_again(&as_measured, noise, run as u64);
        exchanged.iter().for_each(|one| one.put_right(&mut measured));
        let (_, _, by_itself) = fitted_with_cables(&measured, &settings);
        let found = against(&measured, &by_itself, &model, &settings, &mut |_| ()).unwrap();
        let right = found.departures.iter().filter(|one| out.contains(&one.kind)).count();
        let cables = found.wiring.iter().filter(|one| exchanged.contains(one)).count();
        for one in &found.departures {
            println!(
                "{} {}: {:+.4} ± {:.4}, hidden {:+.4}",
                one.kind.word(),
                one.at,
                one.amplitude,
                one.sigma,
                value(one.kind) - 1.0
            );
        }
        of_gains = [of_gains[0] + right, of_gains[1] + out.len()];
        of_pairs = [of_pairs[0] + cables, of_pairs[1] + exchanged.len()];
        wrong[0] += found.departures.len() - right + found.wiring.len() - cables;
        wrong[1] += found.departures.len() + found.wiring.len();
    }
    let mut model = whole;
    if model.take_out("skew_gradient *").is_ok() {
        let measured = measured_again(&as_measured, noise, 100);
        let (_, _, by_itself) = fitted_with_cables(&measured, &settings);
        let found = against(&measured, &by_itself, &model, &settings, &mut |_| ()).unwrap();
        let is_skew = |kind: Kind| matches!(kind, Kind::Skew(_));
        let skews = fitted.unknowns.iter().enumerate().filter(|(_, one)| is_skew(one.kind));
        of_skews[1] = skews.filter(|(at, _)| oracle(*at, 0.0) > 25.0).count();
        of_skews[0] = found.departures.iter().filter(|one| is_skew(one.kind)).count();
        wrong[0] += found.departures.len() - of_skews[0] + found.wiring.len();
        wrong[1] += found.departures.len() + found.wiring.len();
    }
    println!("{}: gains {of_gains:?}, pairs {of_pairs:?}, skew gradients {of_skews:?}, wrong {wrong:?}", folder.name);
    [of_gains, of_pairs, of_skews, wrong]
}

/// Nothing false is said; of gains nine of ten are named, of exchanged cables eight. Which pairs are drawn follows from which gains an oracle would see; two
/// that are drawn at SPS, y monitors 118 and 193, 54 and 80, are not seen.
fn hidden_values_are_found_again(path: PathBuf, noise: f64, runs: usize) {
    let [gains, pairs, skews, wrong] = hidden(path, noise, runs);
    assert!(10 * gains[0] >= 9 * gains[1] && 10 * pairs[0] >= 8 * pairs[1], "{gains:?} {pairs:?}");
    // an oracle knows all others; of skew gradients that are all unknown some follow each other
    assert!(10 * skews[0] >= 9 * skews[1] && wrong[0] == 0, "{skews:?} {wrong:?}");
}

#[test]
fn hidden_values_are_found_again_in_twelve_cells() {
    hidden_values_are_found_again(repository("recordings/measured/twelve-cells/before"), SQRT_2, 2);
}

#[test]
fn hidden_values_are_found_again_at_sps() {
    let Some(path) = ring("sps_2007") else { return };
    // as noisy as the model is wrong, so that no gain is seen where the noise comes twice again: without that, each by itself
    hidden_values_are_found_again(path.clone(), 0.0, 10);
    let [_, pairs, _, wrong] = hidden(path, SQRT_2, 10);
    assert!(10 * pairs[0] >= 7 * pairs[1] && wrong[0] == 0, "{pairs:?} {wrong:?}");
}

#[test]
#[ignore = "make measured"]
fn hidden_values_are_found_again_at_larger_rings() {
    for path in ["spear3_example", "pls_2009", "als_2005_topoff"].into_iter().filter_map(ring) {
        hidden_values_are_found_again(path, SQRT_2, 2);
    }
}
