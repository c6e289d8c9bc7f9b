//! The elements of a lattice file, whatever its format: what a ring needs to first order, and what was left out.

use core::f64::consts::TAU;
use core::fmt;
use std::collections::BTreeMap;

use measured::MeasuredError;
use measured::folder::Particle;
use twin::limits::ELEMENTS;

/// Angles of dipoles in files are rounded, and are those of measured fields; all of them make a turn within this share.
const ROUNDING: f64 = 0.01;
/// Left out, as the code does that tracks such a dipole: an insertion device that is modelled by dipoles and switched off.
pub(super) const UNBENT: &str = "bending of dipoles that are tracked as drifts (they are drifts)";
/// Speed of light [m/s].
const LIGHT: f64 = 299_792_458.0;

/// A lattice as a file has it.
#[derive(Debug, Clone)]
pub struct Lattice {
    /// Name of the file.
    pub file: String,
    /// Its format.
    pub format: Format,
    /// Elements in beam order.
    pub elements: Vec<Element>,
    /// What is stored; the sign of the charge is of no consequence.
    pub particle: Particle,
    /// Total energy of a particle [GeV], if the file states it.
    pub energy: Option<f64>,
    /// RF frequency [Hz], if the file states it.
    pub(super) rf: Option<f64>,
    /// Cavities run at this multiple of the revolution frequency, if the file states that instead.
    pub(super) harmonic: Option<f64>,
    /// Fields that the twin of a measured ring does not have, and in how many elements.
    pub left_out: BTreeMap<&'static str, usize>,
}

/// Formats that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// JSON by pyAT's `at.save_lattice`.
    At,
    /// MAT-file by pyAT's `at.save_mat`, or Matlab's `save` of AT's cell array.
    AtMat,
    /// MAT-file of LOCO, `RINGData.Lattice`.
    Loco,
    /// JSON by Xsuite's `line.to_json`.
    Xsuite,
    /// Table by MAD-X's `twiss, file=`.
    Madx,
    /// YAML or JSON in the Particle Accelerator Lattice Standard.
    Pals,
}

impl fmt::Display for Format {
    fn fmt(&self, to: &mut fmt::Formatter) -> fmt::Result {
        to.write_str(match self {
            Self::At => "pyAT JSON",
            Self::AtMat => "AT MAT-file",
            Self::Loco => "LOCO file",
            Self::Xsuite => "Xsuite JSON",
            Self::Madx => "MAD-X table",
            Self::Pals => "PALS",
        })
    }
}

/// An element; strengths as in MAD, 0 where the element has none.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Element {
    /// Its name, which others may have too.
    pub name: String,
    /// Its type, in the word of the file.
    pub kind: String,
    /// Length along the reference orbit [m].
    pub length: f64,
    /// Angle of a dipole [rad].
    pub bend: f64,
    /// Angle of the pole face at the entrance against a sector dipole's [rad].
    pub edge_in: f64,
    /// The same at the exit.
    pub edge_out: f64,
    /// Soft edge of a dipole: fringe integral times full gap [m].
    pub fringe: f64,
    /// The soft edges differ, and `fringe` is their mean.
    pub is_fringe_uneven: bool,
    /// Gradient [1/m^2], focusing horizontally above 0.
    pub k1: f64,
    /// Sextupole [1/m^3].
    pub k2: f64,
    /// What the type says that it measures or sets.
    pub role: Role,
    /// Fields of the file that are text, by which an instrument can be chosen.
    pub words: BTreeMap<String, String>,
}

impl Element {
    /// Fringe integral times full gap of the entrance and of the exit [m]; the twin has one number for both.
    pub(super) fn set_fringe(&mut self, entrance: f64, exit: f64) {
        self.fringe = (entrance + exit) / 2.0;
        self.is_fringe_uneven = (entrance - exit).abs() > 1e-9;
    }
}

/// What the type of an element says of its use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Role {
    /// Neither monitor nor corrector.
    #[default]
    Other,
    /// A monitor of x, of y.
    Monitor([bool; 2]),
    /// A corrector in x, in y.
    Corrector([bool; 2]),
    /// Properties of the ring, which stand among its elements: never an instrument.
    Ring,
}

impl Lattice {
    /// An empty lattice.
    pub(super) fn new(file: &str, format: Format) -> Self {
        Self {
            file: file.into(),
            format,
            elements: Vec::new(),
            particle: Particle::Electron,
            energy: None,
            rf: None,
            harmonic: None,
            left_out: BTreeMap::new(),
        }
    }

    /// Circumference [m].
    pub fn circumference(&self) -> f64 {
        self.elements.iter().map(|one| one.length).sum()
    }

    /// The dipoles bend by a full turn.
    ///
    /// # Errors
    /// [`MeasuredError::Table`]: the file holds one period of a ring, or no ring, with the angle that was found.
    pub fn expect_ring(&self) -> Result<(), MeasuredError> {
        let turns = self.elements.iter().map(|one| one.bend).sum::<f64>().abs() / TAU;
        let is_whole = |turns: f64| (turns - 1.0).abs() < ROUNDING;
        if is_whole(turns) {
            return Ok(());
        }
        let periods = turns.recip().round();
        if let Some(count) = self.left_out.get(UNBENT) {
            return self.refuse(format!(
                "the dipoles bend by {:.4} degrees, expected the 360 of a ring; {count} of them are tracked as drifts",
                360.0 * turns
            ));
        }
        let hint = match (is_whole(turns * periods), self.format) {
            (false, _) => String::new(),
            (true, Format::At | Format::AtMat) => {
                format!("; it looks like one of {periods} periods: state the periodicity, or write all of the ring")
            }
            (true, _) => format!("; it looks like one of {periods} periods: write all of the ring"),
        };
        self.refuse(format!("the dipoles bend by {:.4} degrees, expected the 360 of a ring{hint}", 360.0 * turns))
    }

    /// RF frequency [Hz]: as stated, or by the harmonic number and the speed of the particle.
    pub fn rf(&self) -> Option<f64> {
        let by_harmonic = || {
            let gamma = self.energy? / self.particle.rest_energy();
            Some(self.harmonic? * LIGHT * (1.0 - gamma.powi(-2)).sqrt() / self.circumference())
        };
        self.rf.or_else(by_harmonic)
    }

    /// Add an element.
    pub(super) fn push(&mut self, one: Element) -> Result<(), MeasuredError> {
        if let Err(exceeded) = ELEMENTS.check(self.elements.len() as u64 + 1) {
            return self.refuse(exceeded.to_string());
        }
        self.elements.push(one);
        Ok(())
    }

    /// Count a field that is left out.
    pub(super) fn leave_out(&mut self, what: &'static str) {
        *self.left_out.entry(what).or_default() += 1;
    }

    /// Types and how many elements have each.
    pub fn kinds(&self) -> BTreeMap<&str, usize> {
        let mut kinds = BTreeMap::new();
        for one in &self.elements {
            *kinds.entry(one.kind.as_str()).or_default() += 1;
        }
        kinds
    }

    /// A problem of this file.
    pub(super) fn refuse<T>(&self, problem: String) -> Result<T, MeasuredError> {
        Err(MeasuredError::Table { file: self.file.clone(), problem })
    }
}
