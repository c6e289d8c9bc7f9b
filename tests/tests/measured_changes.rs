//! Pairs of measurements of a 1.37 GeV ring whose operators wrote down what they changed between them: supplies, a skew quadrupole, sextupoles, wigglers, nothing.
//!
//! The keys say what was set; what was found is compared with them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use measured::compare::{Change, Changes, compare};
use measured::{Folder, Settings};
use serde_json::Value;
use system_tests::measured_ring;

/// What changed between two measurements, and what was set.
fn pair(name: &str) -> Option<(Changes, Value)> {
    let path = measured_ring(&format!("uvx/{name}"))?;
    let [before, after] = ["before", "after"].map(|state| Folder::read(&path.join(state)).unwrap());
    let (_, changes) = compare(&before, &after, &Settings::default(), &mut |_| ()).unwrap();
    let key = serde_json::from_str(&std::fs::read_to_string(path.join("key.json")).unwrap()).unwrap();
    Some((changes, key))
}

/// What was set of a magnet's family [1].
fn set(key: &Value, one: &Change) -> f64 {
    key["changes"]["quadrupole_change_percent"][&one.family].as_f64().unwrap_or(0.0) / 1e2
}

/// Places that are named, of all kinds.
fn places(changes: &Changes) -> Vec<(&str, &str)> {
    changes.others.iter().map(|one| (one.word, one.at.as_str())).collect()
}

fn is_instrument(word: &str) -> bool {
    word.starts_with("bpm") || word.starts_with("corrector")
}

#[test]
fn where_nothing_was_changed_no_magnet_is_named() {
    for name in ["null_1", "null_2", "null_3"] {
        let Some((changes, _)) = pair(name) else { return };
        let magnets: Vec<_> = changes.gradients.iter().filter(|one| one.has_changed).collect();
        println!("{name}: {magnets:?} {:?}", places(&changes));
        assert!(magnets.is_empty(), "{name}: {magnets:?}");
        assert!(places(&changes).iter().all(|(word, _)| is_instrument(word)), "{name}: {:?}", changes.others);
        assert!(changes.others.len() < 3, "{name}: {:?}", changes.others);
        let pulls = changes.gradients.iter().map(|one| (one.relative / one.sigma).powi(2)).sum::<f64>();
        // 36 squares of errors that their families share
        assert!(pulls / (changes.gradients.len() as f64) < 2.0, "{name}: {pulls}");
    }
}

#[test]
fn supplies_that_were_changed_are_found() {
    for name in ["families_1", "families_2", "families_3"] {
        let Some((changes, key)) = pair(name) else { return };
        let pairs: Vec<(f64, f64)> = changes.gradients.iter().map(|one| (one.relative, set(&key, one))).collect();
        let n = pairs.len() as f64;
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / n;
        let [found, truth] = [mean(&|pair| pair.0), mean(&|pair| pair.1)];
        let product = mean(&|pair| (pair.0 - found) * (pair.1 - truth));
        let squares = [mean(&|pair| (pair.0 - found).powi(2)), mean(&|pair| (pair.1 - truth).powi(2))];
        let correlation = product / (squares[0] * squares[1]).sqrt();
        let pull = |one: &Change| ((one.relative - set(&key, one)) / one.sigma).powi(2);
        println!(
            "{name}: correlation {correlation:.3}, size {:.2}, common shift {:+.3} %, mean square pull {:.1}",
            product / squares[1],
            1e2 * (found - truth),
            changes.gradients.iter().map(pull).sum::<f64>() / n
        );
        assert!(correlation > 0.97, "{name}: {correlation}");
        // a change that was told, of a supply that was changed by more than what is told of all of them
        let wrong =
            |one: &&Change| one.has_changed && set(&key, one).abs() > 1e-3 && one.relative * set(&key, one) < 0.0;
        let wrong: Vec<_> = changes.gradients.iter().filter(wrong).collect();
        assert!(wrong.is_empty(), "{name}: {wrong:?}");
    }
}

#[test]
fn a_skew_quadrupole_that_was_changed_is_found_and_no_other_magnet() {
    let Some((changes, key)) = pair("skew_1") else { return };
    let field: Vec<_> = changes.others.iter().filter(|one| !is_instrument(one.word)).collect();
    assert_eq!(field.len(), 1, "{:?}", changes.others);
    assert!(field[0].word == "skew_gradient" && field[0].at.starts_with("SKEWCORR."), "{field:?}");
    // by its setting -0.0029 /m; the same magnet is found at 1.17 to 1.43 of it in other pairs
    assert!((-0.0043..-0.0029).contains(&field[0].change), "{field:?} {key}");
    assert!(changes.gradients.iter().all(|one| !one.has_changed), "{:?}", changes.gradients);
}

#[test]
fn sextupoles_that_were_switched_off_are_no_quadrupoles() {
    let Some((changes, _)) = pair("sextupoles_off_1") else { return };
    println!("{:?}", places(&changes));
    assert!(places(&changes).contains(&("sextupole_gradient", "all sextupoles")), "{:?}", changes.others);
    assert!(changes.others.iter().all(|one| one.word.contains("sextupole")), "{:?}", changes.others);
    assert!(changes.gradients.iter().all(|one| !one.has_changed), "{:?}", changes.gradients);
}

/// The quadrupoles beside them keep the sign of their supplies: they are changed by what the wigglers focus, -0.33 % and -0.03 %.
#[test]
fn wigglers_that_were_closed_focus_vertically() {
    let Some((changes, key)) = pair("insertion_devices_1") else { return };
    println!("{:?}", places(&changes));
    for (name, least, most) in [("AWG09.", 0.3, 0.5), ("AWG01.", 0.1, 0.3), ("AON11.", 0.008, 0.02)] {
        let found = changes.others.iter().find(|one| one.word == "wiggler_focusing" && one.at.starts_with(name));
        let found = found.unwrap_or_else(|| panic!("{name}: {:?}", changes.others));
        assert!((least..most).contains(&found.change), "{found:?}");
    }
    let told: Vec<_> = changes.gradients.iter().filter(|one| one.has_changed).collect();
    assert!(told.len() >= 10 && told.iter().all(|one| one.relative * set(&key, one) > 0.0), "{told:?}");
    let pulls = told.iter().map(|one| ((one.relative - set(&key, one)) / one.sigma).powi(2)).sum::<f64>();
    println!("mean square pull {:.2} of {}", pulls / told.len() as f64, told.len());
}

/// Ten measurements of one ring in four years, each compared with each, the first before the second: a change from one to another is the sum of those by way of a
/// third, whatever the supplies were set to. Two skew quadrupoles that were set are named, and no other.
#[test]
#[ignore = "a minute: make measured"]
fn changes_close_over_any_three_measurements() {
    let pairs = ["families_2", "null_1", "null_2", "sextupoles_off_1", "insertion_devices_1"];
    let paths: Option<Vec<_>> = pairs.into_iter().map(|name| measured_ring(&format!("uvx/{name}"))).collect();
    let Some(paths) = paths else { return };
    let states = |path: &PathBuf| ["before", "after"].map(|state| Folder::read(&path.join(state)).unwrap());
    let folders: Vec<Folder> = paths.iter().flat_map(states).collect();
    let changes =
        |(i, j): (usize, usize)| compare(&folders[i], &folders[j], &Settings::default(), &mut |_| ()).unwrap().1;
    let later = |i: usize| (i + 1..folders.len()).map(move |j| (i, j));
    let found: BTreeMap<(usize, usize), Changes> =
        (0..folders.len()).flat_map(later).map(|pair| (pair, changes(pair))).collect();
    let (mut closures, mut pulls) = (Vec::new(), Vec::new());
    for (&(i, k), direct) in &found {
        for j in i + 1..k {
            let ways = [direct, &found[&(i, j)], &found[&(j, k)]].map(|changes| &changes.gradients);
            for magnet in 0..direct.gradients.len() {
                let [direct, first, second] = ways.map(|changes| &changes[magnet]);
                let closure = first.relative.ln_1p() + second.relative.ln_1p() - direct.relative.ln_1p();
                let variance = direct.sigma.powi(2) + first.sigma.powi(2) + second.sigma.powi(2);
                closures.push(closure.abs());
                pulls.push(closure * closure / variance);
            }
        }
    }
    closures.sort_by(f64::total_cmp);
    let (mean, median) = (pulls.iter().sum::<f64>() / pulls.len() as f64, closures[closures.len() / 2]);
    println!("{} closures, median {:.4} %, mean square pull {mean:.2}", closures.len(), 1e2 * median);
    // 1.19: errors of one measurement are in two of the three comparisons, and cancel in part
    assert!((0.5..1.3).contains(&mean), "{mean}");

    // by the keys set from -0.10 to +1.90 A and from +0.10 to -1.03 A between the first four and the next four, the wigglers open in all
    let [mut named, mut others] = [0, 0];
    for changes in found.iter().filter(|((i, j), _)| *i < 4 && (4..8).contains(j)).map(|(_, changes)| changes) {
        for skew in changes.others.iter().filter(|one| one.word == "skew_gradient" && !one.at.starts_with("all ")) {
            println!("{} {:+.5} /m", skew.at, skew.change);
            let is_set = match skew.at.as_str() {
                "SKEWCORR.317" => (0.0036..0.0043).contains(&skew.change),
                // of the same magnet design, so by the ratio of the currents
                "SKEWCORR.888" => (-0.0025..-0.0019).contains(&skew.change),
                _ => false,
            };
            *if is_set { &mut named } else { &mut others } += 1;
        }
    }
    // 32 and 0: one that is near its limit may go either way where products of matrices round otherwise
    assert!(named >= 30 && others <= 1, "{named} {others}");

    // by the keys no skew quadrupole was set between the first four and the ninth, and the wigglers were opened: one of them couples, as much each time
    for (_, changes) in found.iter().filter(|((i, j), _)| *i < 4 && *j == 8) {
        let skews = changes.others.iter().filter(|one| one.word == "skew_gradient" && !one.at.starts_with("all "));
        let [only] = skews.collect::<Vec<_>>()[..] else { panic!("{:?}", changes.others) };
        println!("{} {:+.5} ± {:.5} /m", only.at, only.change, only.sigma);
        // 0.0060 to 0.0066, each with an error bar of 0.0009; two of these
        assert!(only.at == "AWG09.372" && (0.0044..0.0082).contains(&only.change), "{only:?}");
    }
}
