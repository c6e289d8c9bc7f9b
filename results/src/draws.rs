//! Draws as CmdStan's CSV files, one a chain, for `arviz.from_cmdstan(posterior=[...])` and what else reads them.
//!
//! A line of columns, then one line a draw: seven statistics whose names end in `__`, then the quantities. Numbers are
//! as short as reads back to the same bits. An infinite or undefined number is `inf`, `-inf` or `NaN`.
//!
//! Source: CmdStan User's Guide, Stan CSV files; ArviZ 0.23, `from_cmdstan`.

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use inference::{Chain, DrawStats, Draws};

use crate::output::{self, OutputError};

/// CmdStan's names of [`DrawStats`]' fields, in their order.
const STATS: [&str; 7] =
    ["lp__", "accept_stat__", "stepsize__", "treedepth__", "n_leapfrog__", "divergent__", "energy__"];

/// Write `chain-1.csv` and so on, each whole or not at all.
///
/// The folder is made where there is none. Chains of an earlier run beyond the last are removed, so that no reader
/// takes the two runs for one.
///
/// # Errors
/// [`OutputError`]; nothing is written if a name would be read back as something else, or is there twice.
pub fn save_draws(draws: &Draws, folder: &Path) -> Result<(), OutputError> {
    check_names(&draws.names).map_err(|reason| OutputError::of(folder, reason))?;
    fs::create_dir_all(folder).map_err(|error| OutputError::of(folder, error.kind()))?;
    for (number, chain) in (1..).zip(&draws.chains) {
        write(&draws.names, chain, &path(folder, number))?;
    }
    remove_beyond(folder, draws.chains.len())
}

fn check_names(names: &[String]) -> Result<(), String> {
    let unfit = names.iter().enumerate().find(|&(i, name)| !is_name(name) || names[..i].contains(name));
    unfit.map_or(Ok(()), |(_, name)| {
        Err(format!("{name:?} cannot name a quantity: expected words without a comma and `__` at the end, each once"))
    })
}

/// A word, and for the element of an array its indices, each after a point. CmdStan's own columns end in `__`.
fn is_name(name: &str) -> bool {
    let mut parts = name.split('.');
    let word = parts.next().unwrap_or_default();
    let is_index = |part: &str| part.parse::<u32>().is_ok_and(|index| index > 0);
    let splits = |c: char| c == ',' || c == '"' || c == '#' || c.is_whitespace() || c.is_control();
    !word.is_empty() && !word.ends_with("__") && !word.contains(splits) && parts.all(is_index)
}

fn path(folder: &Path, number: usize) -> PathBuf {
    folder.join(format!("chain-{number}.csv"))
}

fn remove_beyond(folder: &Path, last: usize) -> Result<(), OutputError> {
    let number = |name: &str| name.strip_prefix("chain-")?.strip_suffix(".csv")?.parse::<usize>().ok();
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    for number in entries.filter_map(|entry| number(entry.file_name().to_str()?)).filter(|&number| number > last) {
        let file = path(folder, number);
        fs::remove_file(&file).map_err(|error| OutputError::of(&file, error.kind()))?;
    }
    Ok(())
}

fn write(names: &[String], chain: &Chain, file: &Path) -> Result<(), OutputError> {
    let mut buffer = BufWriter::new(output::temporary(file)?);
    write_rows(names, chain, &mut buffer).map_err(|error| OutputError::of(file, error.kind()))?;
    let written = buffer.into_inner().map_err(|error| OutputError::of(file, error.error().kind()))?;
    written.persist(file).map_err(|error| OutputError::of(file, error.error.kind()))?;
    Ok(())
}

/// No cell needs quotes: names that would are refused.
fn write_rows(names: &[String], chain: &Chain, to: &mut impl Write) -> io::Result<()> {
    let columns: Vec<&str> = STATS.into_iter().chain(names.iter().map(String::as_str)).collect();
    writeln!(to, "{}", columns.join(","))?;
    for (stats, draw) in chain.stats.iter().zip(&chain.draws) {
        let row: Vec<String> = cells(stats).into_iter().chain(draw.iter().map(number)).collect();
        writeln!(to, "{}", row.join(","))?;
    }
    Ok(())
}

fn cells(stats: &DrawStats) -> [String; STATS.len()] {
    let DrawStats { lp, acceptance, step_size, depth, leapfrogs, divergent, energy } = stats;
    [
        number(lp),
        number(acceptance),
        number(step_size),
        depth.to_string(),
        leapfrogs.to_string(),
        u8::from(*divergent).to_string(),
        number(energy),
    ]
}

/// With an exponent where it is far from 1: `Display` writes out up to 300 zeros.
fn number(value: &f64) -> String {
    format!("{value:?}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values that are hard to print.
    fn draws(chains: usize) -> Draws {
        let stats = DrawStats {
            lp: -1.0,
            acceptance: 1.0 / 3.0,
            step_size: 0.1,
            depth: 3,
            leapfrogs: 7,
            divergent: true,
            energy: 1e-300,
        };
        let chain = Chain { draws: vec![vec![0.1 + 0.2, -0.0], vec![f64::MAX, f64::INFINITY]], stats: vec![stats; 2] };
        Draws { names: vec!["A2".into(), "vars.1".into()], chains: vec![chain; chains] }
    }

    fn files(folder: &Path) -> Vec<String> {
        let names = fs::read_dir(folder).unwrap().map(|file| file.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names
    }

    #[test]
    fn numbers_are_written_to_the_last_bit() {
        let folder = tempfile::tempdir().unwrap();
        save_draws(&draws(1), &folder.path().join("new/run")).unwrap();
        let text = fs::read_to_string(folder.path().join("new/run/chain-1.csv")).unwrap();
        let stats = "-1.0,0.3333333333333333,0.1,3,7,1,1e-300";
        assert_eq!(
            text.lines().collect::<Vec<_>>(),
            [
                "lp__,accept_stat__,stepsize__,treedepth__,n_leapfrog__,divergent__,energy__,A2,vars.1".to_owned(),
                format!("{stats},0.30000000000000004,-0.0"),
                format!("{stats},1.7976931348623157e308,inf"),
            ]
        );
    }

    #[test]
    fn chains_of_an_earlier_run_do_not_stay() {
        let folder = tempfile::tempdir().unwrap();
        save_draws(&draws(12), folder.path()).unwrap();
        save_draws(&draws(2), folder.path()).unwrap();
        assert_eq!(files(folder.path()), ["chain-1.csv", "chain-2.csv"]);
    }

    #[test]
    fn names_that_a_file_would_change_are_refused_before_anything_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let named = |name: &str| Draws { names: vec!["other".into(), name.into()], ..draws(1) };
        for bad in ["", "a,b", "a b", "a\n", "\"a\"", "#a", "lp__", ".1", "vars.0", "vars.x", "vars.", "other"] {
            let error = save_draws(&named(bad), folder.path()).unwrap_err().to_string();
            assert!(error.contains(&format!("{bad:?} cannot name a quantity")), "{error}");
        }
        assert!(files(folder.path()).is_empty());
        for good in ["A2", "vars.12", "gain_x.1.3", "β"] {
            save_draws(&named(good), folder.path()).unwrap();
        }
    }

    #[test]
    fn folder_that_cannot_be_made_is_named() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let error = save_draws(&draws(1), &file.path().join("run")).unwrap_err();
        assert!(error.to_string().contains("/run: "), "{error}");
    }
}
