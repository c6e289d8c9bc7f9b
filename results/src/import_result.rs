//! The result of `orbitcal import`: as JSON and as a table, so that its user sees that it is the right ring.

use core::fmt;
use std::collections::BTreeMap;

use lattices::import::{Agreement, Format, Instruments, Lattice};
use schemars::JsonSchema;
use serde::Serialize;
use twin::Plane;

use crate::output::{fill, table};

/// What was read. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Imported {
    pub file: String,
    pub format: String,
    pub circumference_m: f64,
    #[serde(rename = "energy_GeV", skip_serializing_if = "Option::is_none")]
    pub energy: Option<f64>,
    #[serde(rename = "rf_Hz", skip_serializing_if = "Option::is_none")]
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
    /// The measured matrix beside the lattice's.
    pub agreement: Vec<PlaneAgreement>,
    /// The folder that was made.
    pub folder: Option<String>,
    #[serde(skip)]
    hints: &'static Hints,
}

/// Where a convention that looks wrong is stated.
#[derive(Debug)]
struct Hints {
    sign: &'static str,
    order: &'static str,
    size: &'static str,
}

const OF_OPTIONS: Hints = Hints {
    sign: "--kick-sign, or the sign of all monitors",
    order: "the order of its lines and columns, and the lattice",
    size: "--orbit-unit, --kick and --kick-is",
};
const OF_LOCO: Hints = Hints {
    sign: "the signs of CMData's HCMKicks and VCMKicks, or of all monitors",
    order: "HBPMIndex, VBPMIndex, HCMIndex and VCMIndex, and the lattice",
    size: "LocoMeasData.M, which LOCO has in mm, and HCMKicks and VCMKicks, the whole kicks in mrad",
};

/// One plane of the matrix.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct PlaneAgreement {
    pub plane: &'static str,
    /// Measured over lattice, 1 where all is right.
    pub factor: f64,
    pub correlation: f64,
    pub largest_difference_mm: f64,
}

/// Gains of instruments are within a factor of two of what is believed.
const PLAUSIBLE: core::ops::Range<f64> = 0.5..2.0;

impl PlaneAgreement {
    fn of(one: &Agreement) -> Self {
        Self {
            plane: if one.plane == Plane::X { "x" } else { "y" },
            factor: one.factor,
            correlation: one.correlation,
            largest_difference_mm: one.largest,
        }
    }

    /// What to look at, where something is wrong.
    fn doubt(&self, hints: &Hints) -> Option<String> {
        let Self { plane, factor, correlation, .. } = self;
        if *correlation < -0.5 {
            Some(format!("{plane}: the measured matrix has the other sign: see {}.", hints.sign))
        } else if *correlation < 0.5 {
            Some(format!("{plane}: the matrix does not look like this ring's: see {}.", hints.order))
        } else if !PLAUSIBLE.contains(factor) {
            Some(format!("{plane}: the matrix is {factor:.3} times the lattice's: see {}.", hints.size))
        } else {
            None
        }
    }
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
            agreement: Vec::new(),
            folder: None,
            hints: if lattice.format == Format::Loco { &OF_LOCO } else { &OF_OPTIONS },
        }
    }

    /// With a matrix beside the lattice's.
    pub fn with_agreement(mut self, agreement: &[Agreement]) -> Self {
        self.agreement = agreement.iter().map(PlaneAgreement::of).collect();
        self
    }

    /// With a folder that was made.
    pub fn with_folder(mut self, folder: &str) -> Self {
        self.folder = Some(folder.into());
        self
    }
}

impl fmt::Display for Imported {
    fn fmt(&self, to: &mut fmt::Formatter) -> fmt::Result {
        let mut rows = table([self.format.as_str(), &self.file]);
        rows.add_row(["circumference", &format!("{:.4} m", self.circumference_m)]);
        rows.add_row(["energy", &self.energy.map_or("not stated".into(), |one| format!("{one:.4} GeV"))]);
        rows.add_row([
            "RF frequency",
            &self.rf.map_or("not stated: --rf-frequency HZ".into(), |one| format!("{one:.1} Hz")),
        ]);
        rows.add_row(["tunes", &format!("{:.5}, {:.5}", self.tunes[0], self.tunes[1])]);
        rows.add_row(["monitors", &counted(&self.monitors)]);
        rows.add_row(["correctors", &counted(&self.correctors)]);
        let kinds: Vec<String> = self.elements.iter().map(|(kind, count)| format!("{count} {kind}")).collect();
        rows.add_row(["elements", &kinds.join(", ")]);
        for one in &self.agreement {
            let numbers = format!("{:.3}, correlation {:.3}", one.factor, one.correlation);
            rows.add_row([format!("{}, measured/lattice", one.plane), numbers]);
        }
        write!(to, "{rows}")?;
        for doubt in self.agreement.iter().filter_map(|one| one.doubt(self.hints)) {
            write!(to, "\n\n{}", fill(&doubt))?;
        }
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
