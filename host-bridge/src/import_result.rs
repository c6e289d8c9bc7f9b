//! The result of `orbitcal import`: as JSON and as a table, so that its user sees that it is the right ring.

use core::fmt;
use std::collections::BTreeMap;

use measured::import::{Instruments, Lattice};
use serde::Serialize;

use crate::output::{fill, table};

/// What was read. Field names are those of the command's JSON.
#[derive(Debug, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Imported {
    pub file: String,
    pub format: String,
    pub circumference_m: f64,
    #[serde(rename = "energy_GeV")]
    pub energy: Option<f64>,
    #[serde(rename = "rf_Hz")]
    pub rf: Option<f64>,
    /// Of the twin of the lattice.
    pub tunes: [f64; 2],
    /// Names by which a table may call them.
    pub monitors: Vec<String>,
    pub correctors: Vec<String>,
    /// Types and how many elements have each.
    pub elements: BTreeMap<String, usize>,
    /// Fields that the twin does not have, and in how many elements.
    pub left_out: BTreeMap<&'static str, usize>,
    /// The folder that was made.
    pub folder: Option<String>,
}

impl Imported {
    /// Of a lattice, with the tunes of its twin.
    pub fn of(lattice: &Lattice, instruments: &Instruments, tunes: [f64; 2]) -> Self {
        Self {
            file: lattice.file.clone(),
            format: lattice.format.to_string(),
            circumference_m: lattice.circumference(),
            energy: lattice.energy,
            rf: lattice.rf(),
            tunes,
            monitors: instruments.monitor_names(lattice),
            correctors: instruments.corrector_names(lattice),
            elements: lattice.kinds().into_iter().map(|(kind, count)| (kind.to_owned(), count)).collect(),
            left_out: lattice.left_out.clone(),
            folder: None,
        }
    }
}

impl fmt::Display for Imported {
    fn fmt(&self, to: &mut fmt::Formatter) -> fmt::Result {
        let mut rows = table([self.format.as_str(), &self.file]);
        rows.add_row(["circumference", &format!("{:.4} m", self.circumference_m)]);
        rows.add_row(["energy", &self.energy.map_or("not stated".into(), |one| format!("{one:.4} GeV"))]);
        rows.add_row(["RF frequency", &self.rf.map_or("not stated: --rf HZ".into(), |one| format!("{one:.1} Hz"))]);
        rows.add_row(["tunes", &format!("{:.5}, {:.5}", self.tunes[0], self.tunes[1])]);
        rows.add_row(["monitors", &counted(&self.monitors)]);
        rows.add_row(["correctors", &counted(&self.correctors)]);
        let kinds: Vec<String> = self.elements.iter().map(|(kind, count)| format!("{count} {kind}")).collect();
        rows.add_row(["elements", &kinds.join(", ")]);
        write!(to, "{rows}")?;
        for (what, count) in &self.left_out {
            write!(to, "\n\n{}", fill(&format!("Left out of {count} elements: {what}.")))?;
        }
        match &self.folder {
            Some(folder) => write!(to, "\n\n{folder}: made for fit, diagnose and compare"),
            None => Ok(()),
        }
    }
}

/// How many, the first and the last.
fn counted(names: &[String]) -> String {
    match names {
        [] => "none".into(),
        [one] => format!("1: {one}"),
        [first, .., last] => format!("{}: {first} to {last}", names.len()),
    }
}
