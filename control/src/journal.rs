//! The journal of a measurement: what the machine was set to before the first write, and every frame taken since.
//!
//! One JSON object a line, on the disk before the next thing is done. A journal is there as long as its measurement is not finished.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twin::limits::FILE;

use crate::frame::Frame;
use crate::plan::{Channels, Plan};
use crate::step::Step;

/// What a channel was set to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Setting {
    /// The set point.
    pub channel: String,
    /// Its value before the measurement.
    pub value: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Entry {
    /// The measurement that this is the journal of.
    Plan { header: String, channels: Box<Channels> },
    /// What the machine was set to before the writes that follow.
    Original(Vec<Setting>),
    /// Frames of a setting, complete.
    Taken { step: Step, frames: Vec<Frame> },
    /// The machine is back at these settings.
    Restored,
}

/// What is wrong with a journal.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum JournalError {
    /// The system does not let it be used.
    #[error("{}: {}", .0.display(), twin::unreadable(.1))]
    File(PathBuf, io::Error),
    /// Another process is at it.
    #[error("{}: in use by another measurement", .0.display())]
    Used(PathBuf),
    /// A line is none of a journal.
    #[error("{}, line {line}: {why}", .file.display())]
    Damaged {
        /// The journal.
        file: PathBuf,
        /// Where.
        line: usize,
        /// What the parser says.
        why: String,
    },
    /// It belongs to another measurement.
    #[error("{}: the journal of a measurement with another {what}; restore with --restore and remove it to begin anew", .file.display())]
    Other {
        /// The journal.
        file: PathBuf,
        /// What differs.
        what: &'static str,
    },
}

/// An open journal, locked against other processes.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    file: File,
    entries: Vec<Entry>,
}

impl Journal {
    /// The journal at a path, for measuring a plan: a new one, or what is there of the same measurement.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn open(path: &Path, plan: &Plan) -> Result<Self, JournalError> {
        let mut journal = Self::at(path, true)?;
        let (header, channels) = (&plan.header_text, &plan.channels);
        let other = |what| Err(JournalError::Other { file: path.into(), what });
        match journal.entries.first() {
            Some(Entry::Plan { header: known, .. }) if known != header => return other("header"),
            Some(Entry::Plan { channels: known, .. }) if **known != *channels => return other("table of channels"),
            Some(Entry::Plan { .. }) => {}
            _ => journal.append(Entry::Plan { header: header.clone(), channels: Box::new(channels.clone()) })?,
        }
        Ok(journal)
    }

    /// One that is there, to restore from.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn existing(path: &Path) -> Result<Self, JournalError> {
        Self::at(path, false)
    }

    fn at(path: &Path, create: bool) -> Result<Self, JournalError> {
        let failed = |error| JournalError::File(path.into(), error);
        let mut file =
            OpenOptions::new().read(true).write(true).create(create).truncate(false).open(path).map_err(failed)?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => return Err(JournalError::Used(path.into())),
            Err(TryLockError::Error(error)) => return Err(failed(error)),
            Ok(()) => {}
        }
        let bytes = FILE.bytes_of(&file).map_err(failed)?;
        let text = String::from_utf8(bytes).map_err(|error| failed(io::Error::new(ErrorKind::InvalidData, error)))?;
        // a line without its end was being written when the process was killed; nothing that it announces was done
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        let entry = |(index, line): (usize, &str)| {
            serde_json::from_str(line).map_err(|error| JournalError::Damaged {
                file: path.into(),
                line: index + 1,
                why: error.to_string(),
            })
        };
        let entries = text[..whole].lines().enumerate().map(entry).collect::<Result<_, _>>()?;
        file.set_len(whole as u64).and_then(|()| file.seek(SeekFrom::End(0))).map_err(failed)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        File::open(folder).and_then(|folder| folder.sync_all()).map_err(failed)?;
        Ok(Self { path: path.into(), file, entries })
    }

    fn append(&mut self, entry: Entry) -> Result<(), JournalError> {
        let failed = |error| JournalError::File(self.path.clone(), error);
        let line = serde_json::to_string(&entry).map_err(|error| failed(error.into()))? + "\n";
        self.file.write_all(line.as_bytes()).and_then(|()| self.file.sync_all()).map_err(failed)?;
        self.entries.push(entry);
        Ok(())
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the machine has to be put back to; none if it is back, or was never touched.
    pub fn pending(&self) -> Option<&[Setting]> {
        self.entries.iter().rev().find_map(|entry| match entry {
            Entry::Restored => Some(None),
            Entry::Original(settings) => Some(Some(settings.as_slice())),
            _ => None,
        })?
    }

    /// Keep what the machine is set to; on the disk when this returns.
    ///
    /// # Errors
    /// [`JournalError::File`].
    pub fn original(&mut self, settings: Vec<Setting>) -> Result<(), JournalError> {
        self.append(Entry::Original(settings))
    }

    /// The machine is back.
    ///
    /// # Errors
    /// [`JournalError::File`].
    pub fn restored(&mut self) -> Result<(), JournalError> {
        self.append(Entry::Restored)
    }

    /// Keep the frames of a setting.
    ///
    /// # Errors
    /// [`JournalError::File`].
    pub fn taken(&mut self, step: Step, frames: Vec<Frame>) -> Result<(), JournalError> {
        self.append(Entry::Taken { step, frames })
    }

    /// All settings with their frames, in the order in which they were taken.
    pub fn frames(&self) -> impl Iterator<Item = (&Step, &[Frame])> {
        self.entries.iter().filter_map(|entry| match entry {
            Entry::Taken { step, frames } => Some((step, frames.as_slice())),
            _ => None,
        })
    }

    /// True if a setting's frames are there.
    pub fn has(&self, step: &Step) -> bool {
        self.frames().any(|(taken, _)| taken == step)
    }

    /// The measurement is finished and its recording written.
    ///
    /// # Errors
    /// [`JournalError::File`].
    pub fn remove(self) -> Result<(), JournalError> {
        std::fs::remove_file(&self.path).map_err(|error| JournalError::File(self.path, error))
    }
}
