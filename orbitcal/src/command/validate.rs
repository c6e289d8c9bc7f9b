//! `orbitcal validate`: simulated blind campaigns through the diagnosis, on all cores; a stopped run resumes.

use std::path::Path;

use diagnosis::DataError;
use inference::{Campaign, Recording};
use results::output;
use twin::limits::FILE;
use twin::{EffectKind, Ring};
use validation::{CampaignError, Case, Cases, Class, Outcome, Tables, UnmodelledKind, known, run_all};

use super::{CommandError, check_outputs, machine_for, progress, recording};
use crate::cli::Validate;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Validate) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref(), options.page.as_deref()])?;
    let ring = machine_for(&options.template, options.common.machine.as_deref())?;
    let template = recording(&options.template, &ring)?;
    // which cases there are depends on the kinds
    let kinds = (EffectKind::ALL.len(), UnmodelledKind::ALL.len());
    let key = format!("{} {} {} {} {}", ring.file, template.name, options.seed, kinds.0, kinds.1);
    let known = known(&options.outcomes, &key).map_err(failed)?;
    let cases = cases(options, &ring, &template)?;
    let to_do: Vec<&Case> = cases.iter().filter(|case| !known.contains_key(&case.index)).collect();
    let bar = progress(cases.len(), "campaigns", options.common.quiet);
    bar.set_position(known.len() as u64);
    let fresh = run_all(&ring, &template, &to_do, &options.outcomes, &key, &|| bar.inc(1)).map_err(failed)?;
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

/// A file that somebody can put right, or anything else.
fn failed(error: CampaignError) -> CommandError {
    match error {
        CampaignError::Line { .. } => CommandError::Input(error.to_string()),
        _ => CommandError::other(error),
    }
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

const MARKS: [&str; 2] = ["<!-- tables of make validate -->", "<!-- end of tables -->"];

/// Replace what is between the marks of a page.
fn write_between_marks(path: &Path, tables: &str) -> Result<(), CommandError> {
    let wrong = |what: String| CommandError::Input(format!("{}: {what}", path.display()));
    let page = FILE.text(path).map_err(|error| wrong(twin::unreadable(&error)))?;
    let [start, end] = MARKS.map(|mark| page.find(mark));
    let (Some(start), Some(end)) = (start, end) else {
        return Err(wrong(format!("expected the marks {MARKS:?}, found none")));
    };
    let text = format!("{}{}\n\n{tables}\n{}", &page[..start], MARKS[0], &page[end..]);
    Ok(output::bytes(path, text.as_bytes())?)
}
