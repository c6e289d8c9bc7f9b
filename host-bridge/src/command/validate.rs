//! `orbitcal validate`: simulated blind campaigns through the diagnosis, on all cores; a stopped run resumes.

use core::sync::atomic::{AtomicUsize, Ordering};
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::sync::Mutex;

use diagnosis::DataError;
use diagnosis::validation::tables::Tables;
use diagnosis::validation::{self, Case, Cases, Class, Outcome, UnmodelledKind};
use inference::{Campaign, Recording};
use twin::{EffectKind, Ring};

use super::{CommandError, check_outputs, machine, progress, recording};
use crate::cli::Validate;
use crate::output;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Validate) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref(), options.page.as_deref()])?;
    let ring = machine(options.common.machine.as_deref())?;
    let template = recording(&options.template, &ring)?;
    // which cases there are depends on the kinds
    let kinds = (EffectKind::ALL.len(), UnmodelledKind::ALL.len());
    let key = format!("{} {} {} {}", template.name, options.seed, kinds.0, kinds.1);
    let known = known(&options.outcomes, &key)?;
    let cases = cases(options, &ring, &template)?;
    let to_do: Vec<&Case> = cases.iter().filter(|case| !known.contains_key(&case.index)).collect();
    let bar = progress(cases.len(), "campaigns", options.common.quiet);
    bar.set_position(known.len() as u64);
    let fresh = all(&ring, &template, &to_do, &options.outcomes, &key, &|| bar.inc(1))?;
    bar.finish_and_clear();
    let wanted: Vec<usize> = cases.iter().map(|case| case.index).collect();
    let mut outcomes: Vec<Outcome> = known.into_values().chain(fresh).collect();
    outcomes.retain(|outcome| wanted.contains(&outcome.index));
    outcomes.sort_by_key(|outcome| outcome.index);
    let tables = Tables::of(&outcomes);
    if let Some(path) = &options.common.json {
        output::json(path, &tables)?;
    }
    if let Some(path) = &options.page {
        write_between_marks(path, &tables.markdown())?;
    }
    if options.common.speaks() {
        output::say(tables.markdown())?;
    }
    if options.strict && tables.wrong.of > 0 {
        let what = format!("false identifications in {} of {} campaigns", tables.wrong.of, tables.wrong.trials);
        return Err(CommandError::Other(what));
    }
    Ok(())
}

/// Cases of all classes; the number of a case fixes it, so that a longer run begins with the shorter one's.
fn cases(options: &Validate, ring: &Ring, template: &Recording) -> Result<Vec<Case>, CommandError> {
    let all = Cases::of(&Campaign::of(ring, template).map_err(DataError::from)?)?;
    let classes = [
        (Class::Empty, options.empty),
        (Class::Single, options.single),
        (Class::Pair, options.pair),
        (Class::Unknown, options.unknown),
    ];
    let of_class = |(class, count): (Class, usize)| {
        let all = &all;
        (0..count).map(move |i| all.draw(class, class.number(i), options.seed))
    };
    Ok(classes.into_iter().flat_map(of_class).collect())
}

/// What has been run before with this template and seed.
fn known(path: &Path, key: &str) -> Result<BTreeMap<usize, Outcome>, CommandError> {
    let Ok(text) = fs::read_to_string(path) else { return Ok(BTreeMap::new()) };
    let mut known = BTreeMap::new();
    for (number, line) in text.lines().enumerate() {
        // a line that a stop cut short is run again
        let Ok((of_key, outcome)) = serde_json::from_str::<(String, Outcome)>(line) else {
            if !line.ends_with('}') && !line.ends_with(']') || number + 1 == text.lines().count() {
                continue;
            }
            let what = "expected an outcome of this program's version; remove the file to begin anew";
            return Err(CommandError::Input(format!("{}, line {}: {what}", path.display(), number + 1)));
        };
        if of_key == key {
            known.insert(outcome.index, outcome);
        }
    }
    Ok(known)
}

/// Run cases on all cores, writing each outcome down as it comes.
fn all(
    ring: &Ring,
    template: &Recording,
    cases: &[&Case],
    path: &Path,
    key: &str,
    done: &(dyn Fn() + Sync),
) -> Result<Vec<Outcome>, CommandError> {
    let wrong = |error: std::io::Error| CommandError::Other(format!("{}: {error}", path.display()));
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(wrong)?;
    }
    // a line that a stop cut short is ended, so that it spoils no other
    let cut = fs::read(path).is_ok_and(|bytes| bytes.last().is_some_and(|last| *last != b'\n'));
    let file = Mutex::new(OpenOptions::new().create(true).append(true).open(path).map_err(wrong)?);
    if cut {
        file.lock().expect("no thread panics with it").write_all(b"\n").map_err(wrong)?;
    }
    let (next, outcomes) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = || -> Result<(), CommandError> {
        while let Some(case) = cases.get(next.fetch_add(1, Ordering::Relaxed)) {
            let outcome = validation::run(ring, template, case)
                .map_err(|error: DataError| CommandError::Other(format!("campaign {}: {error}", case.index)))?;
            if let Some(outcome) = outcome {
                append(&file, key, &outcome).map_err(wrong)?;
                outcomes.lock().expect("no thread panics with it").push(outcome);
            }
            done();
        }
        Ok(())
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
        threads.into_iter().try_for_each(|thread| thread.join().expect("a panic is a bug and stops the run"))
    })?;
    Ok(outcomes.into_inner().expect("no thread panics with it"))
}

fn append(file: &Mutex<File>, key: &str, outcome: &Outcome) -> std::io::Result<()> {
    let mut line = serde_json::to_string(&(key, outcome))?;
    line.push('\n');
    file.lock().expect("no thread panics with it").write_all(line.as_bytes())
}

const MARKS: [&str; 2] = ["<!-- tables of make validate -->", "<!-- end of tables -->"];

/// Replace what is between the marks of a page.
fn write_between_marks(path: &Path, tables: &str) -> Result<(), CommandError> {
    let wrong = |what: String| CommandError::Input(format!("{}: {what}", path.display()));
    let page = fs::read_to_string(path).map_err(|error| wrong(output::unreadable(&error)))?;
    let [start, end] = MARKS.map(|mark| page.find(mark));
    let (Some(start), Some(end)) = (start, end) else {
        return Err(wrong(format!("expected the marks {MARKS:?}, found none")));
    };
    let text = format!("{}{}\n\n{tables}\n{}", &page[..start], MARKS[0], &page[end..]);
    Ok(output::bytes(path, text.as_bytes())?)
}
