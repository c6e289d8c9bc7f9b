//! A calibrated ring as a lattice file of another code.
//!
//! A result of `fit`, `replay` or `diagnose` and the machine become a [`Lattice`]; each format is one function that writes
//! it. What a format has no words for stands in its comments or metadata.

mod at;
mod attributes;
mod bmad;
mod calibration;
mod lattice;
mod madx;
mod names;
mod pals;
mod xsuite;

pub use calibration::{Calibration, CalibrationError};
pub use lattice::{Channel, ExportError, Lattice};

use schemars::JsonSchema;
use serde::Serialize;

/// Lattice formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// A sequence for MAD-X.
    Madx,
    /// A lattice for Bmad and Tao.
    Bmad,
    /// JSON for pyAT.
    At,
    /// JSON for Xsuite.
    Xsuite,
    /// JSON in the Particle Accelerator Lattice Standard.
    Pals,
}

impl Format {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Madx, Self::Bmad, Self::At, Self::Xsuite, Self::Pals];

    /// Its word, which is that of its JSON.
    pub fn word(self) -> &'static str {
        match self {
            Self::Madx => "madx",
            Self::Bmad => "bmad",
            Self::At => "at",
            Self::Xsuite => "xsuite",
            Self::Pals => "pals",
        }
    }
}

/// The lattice as text of a format.
pub fn text(lattice: &Lattice, format: Format) -> String {
    match format {
        Format::Madx => madx::text(lattice),
        Format::Bmad => bmad::text(lattice),
        Format::At => json(&at::value(lattice)),
        Format::Xsuite => json(&xsuite::value(lattice)),
        Format::Pals => json(&pals::value(lattice)),
    }
}

fn json(value: &serde_json::Value) -> String {
    format!("{value:#}\n")
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use serde_json::Value;
    use twin::{Kind, Ring};

    use super::*;

    fn golden(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/exports").join(name)
    }

    /// A ring with every kind of element, and findings of every sort.
    fn lattice() -> Lattice {
        let ring = Ring::read(&golden("ring.json")).unwrap();
        let path = golden("fit.json");
        Lattice::of(&ring, &Calibration::read(&path).unwrap(), &path).unwrap()
    }

    /// Every number of these files can be checked by hand; `BLESS=1` rewrites them.
    #[test]
    fn every_kind_of_element_is_written_as_reviewed() {
        for format in Format::ALL {
            let (path, text) = (golden(&format!("tiny.{}", format.word())), text(&lattice(), format));
            if std::env::var_os("BLESS").is_some() {
                std::fs::write(&path, &text).unwrap();
            }
            assert_eq!(text, std::fs::read_to_string(&path).unwrap(), "{}", path.display());
        }
    }

    #[test]
    fn lengths_add_up_and_names_are_unique() {
        let lattice = lattice();
        let length: f64 = lattice.elements.iter().map(|element| element.length).sum();
        assert_eq!(length, lattice.circumference);
        let names: std::collections::HashSet<_> = lattice.elements.iter().map(|e| e.name.to_lowercase()).collect();
        assert_eq!(names.len(), lattice.elements.len());
    }

    #[test]
    fn findings_change_monitors_correctors_and_magnets() {
        let lattice = lattice();
        let of = |channels: &[Channel], name: &str| {
            let found = channels.iter().find(|channel| channel.name == name).unwrap();
            (found.gain, found.roll)
        };
        assert_eq!((of(&lattice.monitors, "x_1"), of(&lattice.monitors, "x_2")), ((0.5, 0.0), (1.0, 0.25)));
        assert_eq!((of(&lattice.correctors, "H_1"), of(&lattice.correctors, "V_2")), ((1.5, 0.0), (1.0, 0.5)));
        let slot = lattice.elements.iter().find(|element| element.name == "SLOT_2").unwrap();
        assert_eq!(slot.kind, Kind::Multipole { k1l: 0.0, k1sl: 0.25, k2l: 0.0, k3l: 0.0 });
        let not_here = lattice.remarks.iter().filter(|remark| remark.contains("not in this file"));
        assert_eq!(not_here.count(), 2, "the momentum offset, and what is not certain: {:?}", lattice.remarks);
    }

    #[test]
    fn what_a_format_has_no_words_for_is_said_in_it() {
        let counts = Format::ALL.map(|format| text(&lattice(), format).matches("does not act on").count());
        // a monitor's roll; nothing; gains of a monitor and a corrector and a roll; a monitor's gain and roll; as pyAT
        assert_eq!(counts, [1, 0, 3, 2, 3]);
    }

    #[test]
    fn a_line_feed_in_a_sentence_stays_a_comment() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fit.json");
        let text = std::fs::read_to_string(golden("fit.json")).unwrap().replace("x_1 reads half", "x_1\\nstop;\\n");
        std::fs::write(&path, text).unwrap();
        let ring = Ring::read(&golden("ring.json")).unwrap();
        let lattice = Lattice::of(&ring, &Calibration::read(&path).unwrap(), &path).unwrap();
        assert!(super::text(&lattice, Format::Madx).contains("! found: x_1 stop; \n"));
    }

    #[test]
    fn json_formats_are_json() {
        for format in [Format::At, Format::Xsuite, Format::Pals] {
            serde_json::from_str::<Value>(&text(&lattice(), format)).unwrap();
        }
    }
}
