//! A checkpoint: what frames have made of the core, on disk, so that a restart goes on there.
//!
//! The file is a line of JSON that says of what it is ([`Head`]), the core's state, and the CRC-32 (ISO-HDLC) of both. It is
//! written beside itself, put on the disk and renamed, so that there is a whole one at every moment.

mod keeper;

use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crc::{CRC_32_ISO_HDLC, Crc};
use results::Remarked;
use serde::{Deserialize, Serialize};
use twin::limits::FILE;

use crate::health::Health;
use crate::source::queue::Faults;

pub use keeper::Keeper;

/// Version of the file's form.
const VERSION: u32 = 2;
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
const CRC_BYTES: usize = 4;

/// Of what a state is: one of another model is not loaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Model {
    /// Digest of the tables.
    pub tables: u32,
    /// CRC-32 of priors, noise, calibration and walk.
    pub setup: u32,
    /// CRC-32 of the names and lengths of what is saved.
    pub layout: u32,
}

/// The first line of the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Head {
    version: u32,
    /// Of what the state is.
    pub model: Model,
    /// Last frame in it.
    pub sequence: u32,
    /// Frames in it.
    pub frames: u32,
    /// When it was made [s since 1970].
    pub saved: u64,
    /// What was said of the frames.
    pub remarked: Remarked,
    /// What went wrong.
    pub faults: Faults,
    /// Of monitors and correctors.
    pub health: Health,
}

/// A checkpoint in memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Of what it is.
    pub head: Head,
    /// The core's.
    pub state: Vec<u8>,
}

/// Why a file is no checkpoint of this daemon.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The system cannot read it.
    #[error("{0}")]
    Read(String),
    /// It is too short for its CRC.
    #[error("{bytes} bytes are no checkpoint")]
    Truncated {
        /// Its bytes.
        bytes: usize,
    },
    /// Some of its bytes have changed.
    #[error("damaged: its CRC-32 is {got:08x}, its last bytes say {need:08x}")]
    Damaged {
        /// As the file has it.
        need: u32,
        /// Of its bytes.
        got: u32,
    },
    /// Its first line is another one.
    #[error("its first line: {0}")]
    Head(String),
    /// It has another form.
    #[error("version {got}, this program reads version {VERSION}")]
    Version {
        /// Its version.
        got: u32,
    },
    /// It is of another model.
    #[error("of other {what}: {got:08x}, now {need:08x}")]
    Model {
        /// Which part of the model.
        what: &'static str,
        /// Of the daemon.
        need: u32,
        /// Of the file.
        got: u32,
    },
    /// The core does not take the state.
    #[error(transparent)]
    State(#[from] estimator::StateError),
}

impl Head {
    /// Of a state after a frame, made now.
    pub fn new(model: Model, last: [u32; 2], remarked: Remarked, faults: Faults, health: Health) -> Self {
        let [sequence, frames] = last;
        Self { version: VERSION, model, sequence, frames, saved: now(), remarked, faults, health }
    }

    /// Age [s].
    pub fn age(&self) -> u64 {
        now().saturating_sub(self.saved)
    }
}

/// Time [s since 1970].
fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

impl Checkpoint {
    /// As a file.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec(&self.head).expect("plain numbers are JSON");
        bytes.push(b'\n');
        bytes.extend_from_slice(&self.state);
        bytes.extend_from_slice(&CRC.checksum(&bytes).to_le_bytes());
        bytes
    }

    /// Of a file's bytes, for this model.
    ///
    /// # Errors
    /// [`CheckpointError`].
    pub fn decode(bytes: &[u8], model: &Model) -> Result<Self, CheckpointError> {
        let short = CheckpointError::Truncated { bytes: bytes.len() };
        let (body, crc) = bytes.split_last_chunk::<CRC_BYTES>().ok_or(short)?;
        let (need, got) = (u32::from_le_bytes(*crc), CRC.checksum(body));
        if need != got {
            return Err(CheckpointError::Damaged { need, got });
        }
        let end = body.iter().position(|byte| *byte == b'\n').unwrap_or(body.len());
        let (line, state) = body.split_at(end);
        let head: Head = serde_json::from_slice(line).map_err(|error| CheckpointError::Head(error.to_string()))?;
        if head.version != VERSION {
            return Err(CheckpointError::Version { got: head.version });
        }
        expect(&head.model, model)?;
        Ok(Self { head, state: state.get(1..).unwrap_or_default().to_vec() })
    }
}

fn expect(found: &Model, model: &Model) -> Result<(), CheckpointError> {
    let parts = [
        ("tables", model.tables, found.tables),
        ("priors, noise, calibration or walk", model.setup, found.setup),
        ("contents, by another program", model.layout, found.layout),
    ];
    let other = parts.into_iter().find(|(_, need, got)| need != got);
    other.map_or(Ok(()), |(what, need, got)| Err(CheckpointError::Model { what, need, got }))
}

/// Read a checkpoint; none if there is no file.
///
/// # Errors
/// [`CheckpointError`]; the file is as it was.
pub fn read(path: &Path, model: &Model) -> Result<Option<Checkpoint>, CheckpointError> {
    match FILE.bytes(path) {
        Ok(bytes) => Checkpoint::decode(&bytes, model).map(Some),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(CheckpointError::Read(error.to_string())),
    }
}

/// Rename a file that is not loaded, so that it is neither read nor overwritten; returns its new name.
///
/// # Errors
/// What the system says.
pub fn set_aside(path: &Path) -> io::Result<PathBuf> {
    let free = (0..).map(|i| beside(path, &format!("set-aside-{}-{i}", now()))).find(|name| !name.exists());
    let name = free.expect("numbers do not end");
    fs::rename(path, &name)?;
    Ok(name)
}

/// The checkpoint before the last one.
pub fn previous(path: &Path) -> PathBuf {
    beside(path, "previous")
}

/// Put a checkpoint in the place of the last one, which becomes the previous one; after an error the last one is still there.
///
/// # Errors
/// What the system says, for instance that the disk is full.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let new = beside(path, "new");
    let mut file = File::create(&new)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    if path.exists() {
        let previous = previous(path);
        remove(&previous)?;
        fs::hard_link(path, &previous)?;
    }
    fs::rename(&new, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

/// A lock beside a checkpoint, held as long as this lives: two daemons do not keep one file.
fn lock(path: &Path) -> io::Result<File> {
    let name = beside(path, "lock");
    let wrong = |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", name.display()));
    let file = File::options().create(true).append(true).open(&name).map_err(wrong)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(fs::TryLockError::WouldBlock) => {
            let said = format!("{}: another daemon keeps it; give each a checkpoint.file of its own", path.display());
            Err(io::Error::new(ErrorKind::WouldBlock, said))
        }
        Err(fs::TryLockError::Error(error)) => Err(wrong(error)),
    }
}

fn remove(path: &Path) -> io::Result<()> {
    fs::remove_file(path).or_else(|error| if error.kind() == ErrorKind::NotFound { Ok(()) } else { Err(error) })
}

fn beside(path: &Path, end: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(end);
    name.into()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    const MODEL: Model = Model { tables: 1, setup: 2, layout: 3 };

    pub(crate) fn checkpoint(sequence: u32) -> Checkpoint {
        let head =
            Head::new(MODEL, [sequence, sequence + 1], Remarked::default(), Faults::default(), Health::new(&[1e-4], 1));
        Checkpoint { head, state: vec![10, 0, 10, 255] }
    }

    #[test]
    fn what_was_written_is_read_and_so_is_the_one_before() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        assert_eq!(read(&path, &MODEL), Ok(None));
        for sequence in 0..3 {
            write(&path, &checkpoint(sequence).encode()).unwrap();
        }
        assert_eq!(read(&path, &MODEL).unwrap().unwrap().state, checkpoint(2).state);
        let sequence = |path: &Path| read(path, &MODEL).unwrap().unwrap().head.sequence;
        assert_eq!([sequence(&path), sequence(&previous(&path))], [2, 1]);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2, "nothing else is left");
    }

    #[test]
    fn no_changed_bit_and_no_cut_is_loaded() {
        let bytes = checkpoint(7).encode();
        for bit in 0..8 * bytes.len() {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            let error = Checkpoint::decode(&changed, &MODEL).unwrap_err();
            assert!(matches!(error, CheckpointError::Damaged { .. }), "bit {bit}: {error}");
        }
        for length in 0..bytes.len() {
            assert!(Checkpoint::decode(&bytes[..length], &MODEL).is_err(), "{length} bytes");
        }
    }

    #[test]
    fn another_model_is_said() {
        let bytes = checkpoint(7).encode();
        let said = |model| Checkpoint::decode(&bytes, &model).unwrap_err().to_string();
        assert_eq!(said(Model { tables: 0xab, ..MODEL }), "of other tables: 00000001, now 000000ab");
        assert!(said(Model { setup: 9, ..MODEL }).contains("priors, noise, calibration or walk"));
        assert!(said(Model { layout: 9, ..MODEL }).contains("another program"));
        let mut newer = checkpoint(7);
        newer.head.version = 3;
        let error = Checkpoint::decode(&newer.encode(), &MODEL).unwrap_err();
        assert_eq!(error.to_string(), "version 3, this program reads version 2");
    }

    #[test]
    fn a_full_disk_leaves_the_last_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        write(&path, &checkpoint(1).encode()).unwrap();
        std::os::unix::fs::symlink("/dev/full", beside(&path, "new")).unwrap();
        let error = write(&path, &checkpoint(2).encode()).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::StorageFull);
        assert_eq!(read(&path, &MODEL).unwrap().unwrap().head.sequence, 1);
    }

    #[test]
    fn what_is_set_aside_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let names = [1, 2].map(|i| {
            fs::write(&path, [i]).unwrap();
            set_aside(&path).unwrap()
        });
        assert!(!path.exists());
        assert_eq!(names.map(|name| fs::read(name).unwrap()), [[1], [2]]);
    }
}
