//! Inputs that were too much for a reader, and a few mutations of good ones; `make fuzz` has more of these.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use hostile::{Mutator, Target, attack, target, targets};

/// Mutations of each target.
const COUNT: u64 = 40;

fn corpus() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus")
}

#[test]
fn inputs_of_the_corpus_are_read_or_refused() {
    for folder in fs::read_dir(corpus()).unwrap().flatten() {
        let name = folder.file_name().into_string().unwrap();
        let target = target(&name).unwrap_or_else(|| panic!("corpus/{name}: expected the name of a target"));
        for file in fs::read_dir(folder.path()).unwrap().flatten() {
            let result = attack(&target, &fs::read(file.path()).unwrap());
            assert!(result.is_ok(), "{}: {result:?}", file.path().display());
        }
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn mutations_are_read_or_refused() {
    for target in targets() {
        let mutator = Mutator::new((target.seeds)());
        for number in 0..COUNT {
            let result = attack(&target, &mutator.input(number));
            assert!(result.is_ok(), "{}: input {number}: {result:?}", target.name);
        }
    }
}

/// Else mutations would not reach what lies behind the first check.
#[test]
fn seeds_are_read() {
    let of =
        |target: Target| (target.seeds)().into_iter().enumerate().map(move |(number, seed)| (target, number, seed));
    let refused = targets().flat_map(of).filter(|(target, _, seed)| !(target.read)(seed));
    let refused: Vec<(&str, usize)> = refused.map(|(target, number, _)| (target.name, number)).collect();
    assert!(refused.is_empty(), "{refused:?}");
}

#[test]
fn names_of_targets_differ() {
    let names: Vec<&str> = targets().map(|target| target.name).collect();
    assert_eq!(names.iter().collect::<BTreeSet<_>>().len(), names.len(), "{names:?}");
}
