//! Executed instructions of functions, by the plugin in `tests/plugin/insncount.c`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::{Error, Function};
use crate::repository;

/// Instructions of each run of each region, by its name, in the order of the runs.
///
/// A run counts from the call of the function to its return, all that it calls included. Interrupt handlers do not count,
/// so that the numbers do not depend on when bytes arrive.
pub type Counts = BTreeMap<String, Vec<u64>>;

/// The compiled plugin and its reports, in a folder.
#[derive(Debug)]
pub(super) struct Plugin {
    library: PathBuf,
    summary: PathBuf,
    runs: PathBuf,
    regions: Vec<Function>,
}

impl Plugin {
    /// Compile the plugin into a folder.
    pub(super) fn build(folder: &Path, regions: &[Function]) -> Result<Self, Error> {
        let library = folder.join("insncount.so");
        let mut compile = Command::new("cc");
        compile.args(["-O2", "-shared", "-fPIC", "-o"]).arg(&library).arg(repository("tests/plugin/insncount.c"));
        let output = compile.output().map_err(Error::starting("cc"))?;
        Error::unless_successful("cc", &output)?;
        Ok(Self { library, summary: folder.join("summary"), runs: folder.join("runs"), regions: regions.to_vec() })
    }

    /// The emulator's argument after `-plugin`. Regions go by their number: a name may hold what separates arguments.
    pub(super) fn argument(&self, excluded: &[Function]) -> String {
        let files = [("file", &self.library), ("out", &self.summary), ("runs", &self.runs)];
        let files = files.map(|(key, path)| format!("{key}={}", path.display()));
        let regions = self.regions.iter().enumerate().map(|(i, f)| format!("region={i}:{:#x}", f.address));
        let excluded = excluded.iter().map(|f| format!("exclude={:#x}:{:#x}", f.address, f.size));
        files.into_iter().chain(regions).chain(excluded).collect::<Vec<_>>().join(",")
    }

    /// The counts, once the emulator has ended.
    pub(super) fn counts(&self) -> Result<Counts, Error> {
        self.check_entries()?;
        let mut counts: Counts = self.regions.iter().map(|f| (f.name.clone(), Vec::new())).collect();
        for line in read(&self.runs)?.lines() {
            let (region, count) = self.run(line).ok_or_else(|| Error::Report(line.into()))?;
            counts.entry(region).or_default().push(count);
        }
        Ok(counts)
    }

    fn run(&self, line: &str) -> Option<(String, u64)> {
        let (region, count) = line.split_once(' ')?;
        let region = self.regions.get(region.parse::<usize>().ok()?)?;
        Some((region.name.clone(), count.parse().ok()?))
    }

    fn check_entries(&self) -> Result<(), Error> {
        for line in read(&self.summary)?.lines().filter(|line| line.starts_with("region ")) {
            let words: Vec<_> = line.split(' ').collect();
            let after = |key| words.iter().skip_while(|&&w| w != key).nth(1).and_then(|w| w.parse().ok());
            match (after("region"), after("entries")) {
                (Some(_), Some(0)) => (),
                (Some(i), Some(entries)) => {
                    return Err(Error::Entered { region: self.regions[i as usize].name.clone(), entries });
                }
                _ => return Err(Error::Report(line.into())),
            }
        }
        Ok(())
    }
}

fn read(path: &Path) -> Result<String, Error> {
    fs::read_to_string(path).map_err(Error::file(path))
}
