//! The diagnosis of measured rings: what is held, families on elements held out, halves of one measurement, effects put into one matrix.

use std::collections::BTreeMap;

use measured::diagnose::{Finding, Verdict, What};
use measured::{Diagnosis, Folder, Kind, Model, Settings, Straightened, Wiring};
use rand::rngs::StdRng;
use rand::seq::IteratorRandom;
use rand::{RngExt, SeedableRng};
use system_tests::measured_ring;
use twin::Rf;

fn diagnosed(as_measured: &Folder, settings: &Settings) -> (Folder, Diagnosis) {
    let Straightened { folder, cables, fit } = Straightened::of(as_measured, settings, &mut |_| ()).unwrap();
    let found = Diagnosis::of_fit((&folder, &cables), &fit, settings, &mut |_| ()).unwrap();
    (folder, found)
}

/// These rings hold their RF frequency. A model that holds the momentum lacks a term, which is said first, in its size.
fn the_held_frequency_is_found(name: &str) {
    let Some(path) = measured_ring(name) else { return };
    let settings = Settings { rf: Rf::FixedMomentum, ..Settings::default() };
    let (_, found) = diagnosed(&Folder::read(&path).unwrap(), &settings);
    let held = found.findings.first().expect("a hold was found");
    println!("{name}: {:.3} ± {:.3}, {:.0} nat", held.amplitude, held.sigma, held.gain);
    assert_eq!((held.word, &held.what), ("fixed_rf_frequency", &What::Hold(Rf::FixedFrequency)), "{name}");
    assert!((held.amplitude - 1.0).abs() < 3.0 * held.sigma && held.sigma < 0.25, "{name}: {held:?}");
    assert_eq!(found.verdict, Verdict::Identified, "{name}");
}

#[test]
fn the_held_frequency_is_found_at_sps() {
    the_held_frequency_is_found("sps_2007");
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn the_held_frequency_is_found_at_spear3() {
    the_held_frequency_is_found("spear3_example");
}

#[test]
#[ignore = "make measured"]
fn the_held_frequency_is_found_at_larger_rings() {
    the_held_frequency_is_found("pls_2009");
    the_held_frequency_is_found("als_2005_topoff");
}

/// A ring with a momentum compaction near 0 has a share between the two holds, which decides nothing.
#[test]
fn a_momentum_compaction_near_0_is_no_other_hold() {
    let Some(path) = measured_ring("uvx/low_alpha/measured") else { return };
    let (_, found) = diagnosed(&Folder::read(&path).unwrap(), &Settings::default());
    println!("low alpha: {:.3} ± {:.3}", found.share.value, found.share.sigma());
    assert_eq!(found.share.other(), None, "{:?}", found.share);
}

/// Gradients in dipoles and sextupoles, skew gradients everywhere and couplings of all instruments predict elements that they were not learnt from: thousands
/// of nat better than the fit as LOCO has it. What remains of SPS is of its instruments: y monitors 1 and 17, counted from 1, and V corrector 3 or 4.
fn families_predict(name: &str, nat: f64, rms_um: f64) {
    let Some(path) = measured_ring(name) else { return };
    let (_, found) = diagnosed(&Folder::read(&path).unwrap(), &Settings::default());
    let [before, after] = &found.held_out;
    let (gain, error) = after.gain_over(before);
    println!(
        "{name}: {:.2} -> {:.2} um, chi2 {:.2} -> {:.2}, {gain:.0} ± {error:.0} nat",
        1e3 * before.rms,
        1e3 * after.rms,
        before.chi2,
        after.chi2
    );
    assert!(gain > nat && 1e3 * after.rms < rms_um, "{name}: {gain} ± {error}, {}", after.rms);
}

#[test]
fn what_remains_at_sps_is_of_its_instruments() {
    let Some(path) = measured_ring("sps_2007") else { return };
    families_predict("sps_2007", -20.0, 110.0);
    let (_, found) = diagnosed(&Folder::read(&path).unwrap(), &Settings::default());
    let has = |name: &str| found.unexplained.iter().any(|one| one.at == name);
    assert!(has("y_BPM.3") && has("y_BPM.169") && has("V_CORV.58"), "{:?}", found.unexplained);
}

#[test]
#[ignore = "make measured"]
fn families_predict_the_larger_rings() {
    families_predict("spear3_example", 17_000.0, 1.4);
    families_predict("pls_2009", 15_000.0, 0.95);
    families_predict("als_2005_topoff", 7_000.0, 1.8);
}

/// Every second corrector of a measurement.
fn half(folder: &Folder, part: usize) -> Folder {
    let columns: Vec<usize> = (part..folder.correctors.len()).step_by(2).collect();
    Folder {
        correctors: columns.iter().map(|&column| folder.correctors[column].clone()).collect(),
        matrix: folder.matrix.select_columns(&columns),
        ..folder.clone()
    }
}

/// Findings by kind and place, of what both of two measurements have.
fn by_place(found: &Diagnosis) -> BTreeMap<(&'static str, String), &Finding> {
    let named = found.findings.iter().filter(|one| one.is_named());
    named.map(|one| ((one.word, one.at.clone()), one)).collect()
}

/// Of what one of two measurements names how much the other one names too, or could not name, and the pulls of the amplitudes of both.
fn named_again(one: &Diagnosis, other: &Diagnosis) -> (usize, usize, Vec<f64>) {
    let (mut again, mut all, mut pulls) = (0, 0, Vec::new());
    for (first, second) in [(one, other), (other, one)] {
        let there = by_place(second);
        for (place, finding) in by_place(first) {
            // correctors are of one half
            if !matches!(finding.what, What::Member(kind) if !matches!(kind, Kind::CorrectorGain(_) | Kind::CorrectorCoupling(_)))
            {
                continue;
            }
            let limit = second.limits.iter().find(|limit| (limit.word, &limit.at) == (place.0, &place.1));
            let is_below = limit.is_some_and(|limit| finding.amplitude.abs() < limit.amplitude);
            let same = there.get(&place);
            (all, again) = (all + 1, again + usize::from(is_below || same.is_some()));
            pulls.extend(same.map(|same| (finding.amplitude - same.amplitude) / finding.sigma.hypot(same.sigma)));
            println!(
                "  {place:?} {:+.5} ± {:.5}: again {}, below its limit {is_below}",
                finding.amplitude,
                finding.sigma,
                same.is_some()
            );
        }
    }
    (again, all, pulls)
}

fn halves_agree(name: &str) -> (usize, usize, Vec<f64>) {
    let Some(path) = measured_ring(name) else { return (0, 0, Vec::new()) };
    let folder = Folder::read(&path).unwrap();
    let [one, other] = [0, 1].map(|part| diagnosed(&half(&folder, part), &Settings::default()).1);
    let agreed = named_again(&one, &other);
    println!("{name}: {} of {} again, pulls {:.2?}", agreed.0, agreed.1, agreed.2);
    agreed
}

/// Nine of ten places named by one half of the correctors are named by the other, or below what it can see.
#[test]
#[ignore = "make measured"]
fn what_one_half_of_the_correctors_names_the_other_names() {
    let all = ["sps_2007", "spear3_example", "pls_2009", "als_2005_topoff"].map(halves_agree);
    let (again, count) = all.iter().fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
    let pulls: Vec<f64> = all.into_iter().flat_map(|one| one.2).collect();
    let mean = pulls.iter().map(|pull| pull * pull).sum::<f64>() / pulls.len().max(1) as f64;
    println!("{again} of {count} again, mean square pull {mean:.2} of {}", pulls.len());
    assert!(again as f64 >= 0.9 * count as f64, "{again} of {count}");
    // 1.32 is measured, of seven couplings at PLS, each told both ways; their mean square is above 1.6 once in eight times
    assert!(mean < 1.6, "mean square pull {mean}");
}

/// Where nothing was changed between two measurements, both name the same places, the wigglers that were closed.
#[test]
fn what_one_measurement_names_the_next_one_names() {
    let (mut again, mut count, mut pulls) = (0, 0, Vec::new());
    for name in ["null_1", "null_2", "null_3"] {
        let Some(path) = measured_ring(&format!("uvx/{name}")) else { return };
        let [before, after] = ["before", "after"]
            .map(|state| diagnosed(&Folder::read(&path.join(state)).unwrap(), &Settings::default()).1);
        let said = named_again(&before, &after);
        println!("{name}: {} of {} again, pulls {:.2?}", said.0, said.1, said.2);
        (again, count) = (again + said.0, count + said.1);
        pulls.extend(said.2);
    }
    let mean = pulls.iter().map(|pull| pull * pull).sum::<f64>() / pulls.len() as f64;
    println!("{again} of {count} again, mean square pull {mean:.2} of {}", pulls.len());
    assert!(count > 0 && again as f64 >= 0.9 * f64::from(count as u32), "{again} of {count}");
    // 1.19 is measured, of five differences, each told both ways; their mean square is above 1.6 once in six times
    assert!(mean < 1.6, "mean square pull {mean}");
}

/// An effect of a kind that one matrix shows, put into it: what was put in, with its oracle gain, the square of its size over twice the variance of what the data say
/// and of what its family scatters [nat].
fn injected(folder: &Folder, found: &Diagnosis, seed: u64) -> (Folder, &'static str, String, f64) {
    let mut random = StdRng::seed_from_u64(seed);
    let mut changed = folder.clone();
    let sign = if random.random_bool(0.5) { -1.0 } else { 1.0 };
    let rows = (0..folder.monitors.len()).filter(|&row| folder.monitors[row].is_used);
    let row = rows.clone().choose(&mut random).expect("a measurement has monitors");
    let cable = match seed % 5 {
        0 => Some(Wiring::MonitorReversed(row)),
        1 => {
            let alike = |other: &usize| *other != row && folder.monitors[*other].plane == folder.monitors[row].plane;
            let other = rows.filter(alike).choose(&mut random).expect("a plane has monitors");
            Some(Wiring::MonitorsExchanged(vec![row.min(other), row.max(other)]))
        }
        2 => Some(Wiring::MonitorsDead(vec![row])),
        _ => None,
    };
    if let Some(cable) = cable {
        match &cable {
            Wiring::MonitorsDead(_) => {
                let sigma = folder.monitors[row].sigma;
                changed.matrix.row_mut(row).iter_mut().for_each(|one| *one = sigma * random.random_range(-1.0..1.0));
                changed.dispersion.iter_mut().for_each(|one| one[row] = 0.0);
            }
            _ => cable.put_right(&mut changed),
        }
        let (kind, at) = cable.named(folder);
        return (changed, kind, at, f64::INFINITY);
    }
    let hierarchy = &found.hierarchy;
    let is_it =
        |kind: Kind| if seed % 5 == 3 { matches!(kind, Kind::Strength(_)) } else { matches!(kind, Kind::Skew(_)) };
    let magnets = (0..hierarchy.unknowns.len()).filter(|&number| is_it(hierarchy.unknowns[number].kind));
    let number = magnets.choose(&mut random).expect("a ring has magnets");
    let most = hierarchy.unknowns[number].width;
    let amplitude = sign * random.random_range((0.05 * most).ln()..(2.0 * most).ln()).exp();
    let model = Model::of(folder, &hierarchy.groups, Rf::FixedFrequency).unwrap();
    let mut values = hierarchy.values.clone();
    values[number] += amplitude;
    let change = model.predict(&hierarchy.unknowns, &values).unwrap().matrix - &hierarchy.prediction.matrix;
    changed.matrix += change.columns(0, folder.matrix.ncols());
    if let Some(dispersion) = &mut changed.dispersion {
        *dispersion += change.column(folder.matrix.ncols());
    }
    let at = measured::unknowns::name(folder, &hierarchy.groups, hierarchy.unknowns[number].kind);
    let word = hierarchy.unknowns[number].kind.word();
    let limit = found.limits.iter().find(|limit| (limit.word, &limit.at) == (word, &at));
    let gain = limit.map_or(0.0, |limit| 0.5 * (amplitude / limit.sigma).powi(2));
    (changed, word, at, gain)
}

/// What was named of effects put into the matrix of a ring.
#[derive(Debug, Default)]
struct Named {
    /// Effects of an oracle gain above 25 nat.
    visible: usize,
    /// Of these named, with kind and place.
    named: usize,
    /// Of these among the alternatives of what was found.
    listed: usize,
    /// Places named that were not there before.
    wrong: usize,
}

fn injections(name: &str, seeds: u64) -> Option<Named> {
    let settings = Settings::default();
    let (folder, plain) = diagnosed(&Folder::read(&measured_ring(name)?).unwrap(), &settings);
    let known = by_place(&plain);
    let mut all = Named::default();
    for seed in 0..seeds {
        let (changed, kind, at, gain) = injected(&folder, &plain, seed);
        let (_, found) = diagnosed(&changed, &settings);
        let said = by_place(&found);
        let is_it = |word: &str, place: &str| word == kind && place == at;
        let is_named = said.keys().any(|(word, place)| is_it(word, place));
        let is_listed = found
            .findings
            .iter()
            .any(|one| is_it(one.word, &one.at) || one.alternatives.iter().any(|other| is_it(other.word, &other.at)));
        let others: Vec<_> =
            said.keys().filter(|place| !known.contains_key(*place) && !is_it(place.0, &place.1)).collect();
        println!(
            "{name} {seed}: {kind} at {at}, {gain:.1} nat: named {is_named}, listed {is_listed}, others {others:?}"
        );
        if gain > 25.0 {
            all.visible += 1;
            all.named += usize::from(is_named);
            all.listed += usize::from(!is_named && is_listed);
        }
        all.wrong += others.len();
    }
    println!("{name}: {all:?}");
    Some(all)
}

/// Of SPS 22 of 26 are named and one effect wrongly: what is not named stands out beside a neighbour that looks alike; an exchange with y_BPM.3, which is broken, is
/// told as the gains of both.
#[test]
fn effects_put_into_the_matrix_of_sps_are_named() {
    let Some(all) = injections("sps_2007", 40) else { return };
    assert!(all.named >= 22 && all.wrong <= 2, "{all:?}");
}

#[test]
#[ignore = "make measured"]
fn effects_put_into_the_matrix_of_spear3_are_named() {
    let Some(all) = injections("spear3_example", 15) else { return };
    assert!(all.named as f64 >= 0.9 * all.visible as f64 && all.wrong == 0, "{all:?}");
}
