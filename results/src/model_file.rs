//! A model on disk: a line that names its machine, then the core's tables as the packets that a device takes.
//!
//! After that line the bytes are those of `orbitcal serve --load`, requests `Model` with one parcel each, head first and seal last
//! (`docs/device.md`), so that a file tells a device what it tells the core in process.

use std::path::Path;

use estimator::wire::link::UNASKED;
use estimator::{FrameError, Parcel, ParcelError, Tables as _};
use training::green::{Difference, difference};
use training::rooms::largest::{PACKET, Request};
use training::{AnyParcel, LINE, Tables, TrainingError};
use twin::Ring;
use twin::limits::FILE;

use crate::output::{self, OutputError};

/// Why a file is no model.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelFileError {
    /// The system cannot read it.
    #[error("{path}: {}", twin::unreadable(.source))]
    Read {
        /// The file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// It does not begin as a model file does.
    #[error("{path}: expected a model file, which begins with the line {FIRST:?} and its machine")]
    Kind {
        /// The file.
        path: String,
    },
    /// It is of another machine.
    #[error("{path}: a model of {found:?}, this machine is {machine:?}")]
    Machine {
        /// The file.
        path: String,
        /// The machine of the file.
        found: String,
        /// The machine at hand.
        machine: String,
    },
    /// It is of a machine of the same name that has other quadrupoles, params, supplies or priors.
    #[error("{path}: a model of another {machine:?}: {difference}")]
    Ring {
        /// The file.
        path: String,
        /// The name of both.
        machine: String,
        /// What differs.
        difference: Difference,
    },
    /// There is no model for the machine at hand.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// One of its packets is not what it should be.
    #[error("{path}, packet {packet}: {fault}")]
    Packet {
        /// The file.
        path: String,
        /// Which one, from 1; one beyond the last if the file ends too early.
        packet: usize,
        /// What is wrong with it.
        fault: Fault,
    },
}

/// What is wrong with a packet.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// It is damaged, or no packet of a device.
    #[error(transparent)]
    Envelope(#[from] FrameError),
    /// The tables do not take their part.
    #[error(transparent)]
    Tables(#[from] ParcelError),
    /// Something else is due.
    #[error("expected {expected}, found {found}")]
    Order {
        /// What is due.
        expected: &'static str,
        /// What is there.
        found: &'static str,
    },
}

/// How the first line of a file begins; the machine's name follows.
const FIRST: &str = "orbitcal model of ";

/// Write the tables of a machine to a file.
///
/// # Errors
/// [`OutputError`]; a file of that name is then as it was.
pub fn write(path: &Path, machine: &str, tables: &Tables) -> Result<(), OutputError> {
    let first = format!("{FIRST}{}\n", line(machine));
    output::bytes(
        path,
        &first.into_bytes().into_iter().chain(tables.parcels::<LINE>().flat_map(wire)).collect::<Vec<u8>>(),
    )
}

/// A name as it stands in a line.
fn line(name: &str) -> String {
    name.replace('\n', " ")
}

fn wire(parcel: AnyParcel) -> Vec<u8> {
    let mut bytes = vec![0; PACKET];
    let length = Request::Model(parcel).encode(UNASKED, &mut bytes).expect("a parcel fits a packet");
    bytes.truncate(length);
    bytes
}

/// The tables of a file, which has to be of this machine, as its supplies are recorded: [`inference::Recording::powered`].
///
/// # Errors
/// [`ModelFileError`].
pub fn read(path: &Path, ring: &Ring) -> Result<Tables, ModelFileError> {
    let machine = &ring.name;
    let name = || path.display().to_string();
    let mut bytes = FILE.bytes(path).map_err(|source| ModelFileError::Read { path: name(), source })?;
    let end = bytes.iter().position(|byte| *byte == b'\n').ok_or_else(|| ModelFileError::Kind { path: name() })?;
    let first = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let found = first.strip_prefix(FIRST).ok_or_else(|| ModelFileError::Kind { path: name() })?;
    if found != line(machine) {
        return Err(ModelFileError::Machine { path: name(), found: found.into(), machine: machine.into() });
    }
    let tables = tables(&mut bytes[end + 1..]);
    let tables = tables.map_err(|(packet, fault)| ModelFileError::Packet { path: name(), packet, fault })?;
    match difference(ring, &tables)? {
        Some(difference) => Err(ModelFileError::Ring { path: name(), machine: machine.clone(), difference }),
        None => Ok(tables),
    }
}

/// The tables of packets; or which of them, from 1, is wrong.
fn tables(bytes: &mut [u8]) -> Result<Tables, (usize, Fault)> {
    let mut tables = Tables::BLANK;
    let (mut due, mut packet) = (Due::Head, 0);
    for wire in bytes.split_inclusive_mut(|byte| *byte == 0) {
        packet += 1;
        due = take(&mut tables, due, wire).map_err(|fault| (packet, fault))?;
    }
    if due == Due::End {
        return Ok(tables);
    }
    Err((packet + 1, Fault::Order { expected: due.words(), found: "the end of the file" }))
}

/// What comes next in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Due {
    Head,
    Rest,
    End,
}

impl Due {
    fn words(self) -> &'static str {
        match self {
            Self::Head => "the head of tables",
            Self::Rest => "the rest of the tables and their seal",
            Self::End => "the end of the file",
        }
    }
}

/// Take one packet in; returns what is due then.
fn take(tables: &mut Tables, due: Due, wire: &mut [u8]) -> Result<Due, Fault> {
    let found = |found| Fault::Order { expected: due.words(), found };
    let Request::Model(parcel) = Request::decode(wire).1? else { return Err(found("another request")) };
    let next = match (due, &parcel) {
        (Due::Head, Parcel::Head { .. }) => Due::Rest,
        (Due::Rest, Parcel::Codes { .. } | Parcel::Values { .. }) => Due::Rest,
        (Due::Rest, Parcel::Seal { .. }) => Due::End,
        (_, Parcel::Head { .. }) => return Err(found("a head")),
        _ => return Err(found("a part of tables")),
    };
    tables.take(&parcel)?;
    Ok(next)
}

#[cfg(test)]
mod tests {
    use estimator::Sizes;
    use twin::Effect;

    use super::*;

    fn extended() -> Tables {
        let effects =
            ["quad_roll@F2=-0.018", "bpm_gain@x_E6=-0.08"].map(|text| Effect::parse(text, &Ring::booster()).unwrap());
        training::extended::tables(&Ring::booster(), &effects, &[1.0; 48]).unwrap().tables
    }

    const MACHINE: &str = "a machine";

    /// The Booster by another name.
    fn machine() -> Ring {
        Ring { name: MACHINE.into(), ..Ring::booster() }
    }

    /// What is said of a file with these bytes, without its path.
    fn refused_whole(bytes: &[u8]) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        std::fs::write(&path, bytes).unwrap();
        let error = read(&path, &machine()).unwrap_err().to_string();
        error.strip_prefix(&path.display().to_string()).unwrap().to_owned()
    }

    /// The same of these packets.
    fn refused(packets: &[u8]) -> String {
        refused_whole(&[b"orbitcal model of a machine\n", packets].concat())
    }

    #[test]
    fn tables_survive_their_file() {
        let (folder, tables) = (tempfile::tempdir().unwrap(), extended());
        let path = folder.path().join("model");
        write(&path, MACHINE, &tables).unwrap();
        assert_eq!(read(&path, &machine()).unwrap(), tables);
        let packets = std::fs::read(&path).unwrap().split_inclusive(|byte| *byte == 0).count();
        assert_eq!(packets, tables.parcels::<LINE>().count());
    }

    #[test]
    fn a_file_is_for_its_machine_alone() {
        let other = refused_whole(b"orbitcal model of ten cells\n");
        assert_eq!(other, ": a model of \"ten cells\", this machine is \"a machine\"");
        let expected = ": expected a model file, which begins with the line \"orbitcal model of \" and its machine";
        for bytes in [&b""[..], b"{}", b"{}\n", &wire(extended().parcels::<LINE>().next().unwrap())] {
            assert_eq!(refused_whole(bytes), expected);
        }
        assert_eq!(
            read(Path::new("/nonexistent"), &machine()).unwrap_err().to_string(),
            "/nonexistent: file not found"
        );
    }

    #[test]
    fn a_file_is_for_the_same_params_and_priors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        write(&path, MACHINE, &extended()).unwrap();
        let refused = |ring: &Ring| read(&path, ring).unwrap_err().to_string();
        let mut other = machine();
        other.parameters[7].prior.width = 0.01;
        let name = &other.parameters[7].name;
        let expected = format!(
            "{}: a model of another \"a machine\": the prior of {name} is not the one that it has in this machine",
            path.display()
        );
        assert_eq!(refused(&other), expected);
        other.parameters.pop();
        assert!(refused(&other).contains("params, supplies are [15, 18, 24, 24, 48, 48, 2]"), "{}", refused(&other));
    }

    #[test]
    fn what_is_no_model_is_refused_by_the_packet_that_says_so() {
        let packets: Vec<Vec<u8>> = extended().parcels::<LINE>().map(wire).collect();
        let (head, seal) = (&packets[0], packets.last().unwrap());
        assert_eq!(refused(&[]), ", packet 1: expected the head of tables, found the end of the file");
        assert_eq!(refused(&packets[1]), ", packet 1: expected the head of tables, found a part of tables");
        let short = packets[..9].concat();
        assert_eq!(
            refused(&short),
            ", packet 10: expected the rest of the tables and their seal, found the end of the file"
        );
        let more = [packets.concat(), head.clone()].concat();
        assert_eq!(
            refused(&more),
            format!(", packet {}: expected the end of the file, found a head", packets.len() + 1)
        );
        let lost = [head.clone(), packets[2..].concat()].concat();
        let missing = format!(", packet {}: a part is missing or was changed: the tables' CRC is ", packets.len() - 1);
        assert!(refused(&lost).starts_with(&missing), "{}", refused(&lost));
        assert!(refused(b"[model]").starts_with(", packet 1: "), "{}", refused(b"[model]"));
        let Parcel::Head { version, sizes } = extended().parcels::<LINE>().next().unwrap() else { panic!("no head") };
        let old = [wire(Parcel::Head { version: 1, sizes }), seal.clone()].concat();
        assert_eq!(refused(&old), format!(", packet 1: tables of version 1, this reads version {version}"));
        let sizes = Sizes { monitors: [500, 1], ..sizes };
        let other = [wire(Parcel::Head { version, sizes }), seal.clone()].concat();
        assert!(refused(&other).starts_with(", packet 1: "), "{}", refused(&other));
    }
}
