//! Checkpoints are written by a thread of their own: the loop does not wait for the disk.

use std::io;
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};

use results::output::{tell, warn};

use super::{Checkpoint, lock, write};
use crate::source::queue::Queue;

/// Writes checkpoints, and counts those that it could not write.
#[derive(Debug)]
pub struct Keeper {
    files: Option<SyncSender<Checkpoint>>,
    queue: Queue,
    thread: Option<JoinHandle<()>>,
}

impl Keeper {
    /// For a file that no other daemon keeps; failures are counted in the queue.
    ///
    /// # Errors
    /// What the system says of a new thread, or that another daemon keeps this file.
    pub fn start(path: &Path, queue: &Queue) -> io::Result<Self> {
        let lock = lock(path)?;
        let (files, received) = sync_channel(1);
        let (path, counted) = (path.to_owned(), queue.clone());
        let thread = thread::Builder::new().name("checkpoint".into());
        let thread = thread.spawn(move || {
            keep(&path, &received, &counted);
            drop(lock);
        })?;
        Ok(Self { files: Some(files), queue: queue.clone(), thread: Some(thread) })
    }

    /// Write this one, unless the one before last is still being written: the next one will do.
    pub fn offer(&self, file: Checkpoint) {
        let taken = self.files.as_ref().is_some_and(|files| files.try_send(file).is_ok());
        self.queue.count(|faults| faults.unsaved += u64::from(!taken));
    }

    /// Write this last one, after those that wait.
    pub fn finish(&mut self, file: Checkpoint) {
        let taken = self.files.take().is_some_and(|files| files.send(file).is_ok());
        let ended = self.thread.take().is_some_and(|thread| thread.join().is_ok());
        self.queue.count(|faults| faults.unsaved += u64::from(!(taken && ended)));
    }
}

/// A failure is said once, and again when it ends.
fn keep(path: &Path, files: &Receiver<Checkpoint>, queue: &Queue) {
    let mut failed = 0_u64;
    for file in files {
        match write(path, &file.encode()) {
            Ok(()) if failed > 0 => {
                tell(format_args!("{}: checkpoints are saved again, {failed} were not", path.display()));
                failed = 0;
            }
            Ok(()) => {}
            Err(error) => {
                if failed == 0 {
                    warn(format_args!("{}: checkpoint not saved: {error}; the loop goes on", path.display()));
                }
                failed += 1;
                queue.count(|faults| faults.unsaved += 1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::checkpoint;
    use super::*;
    use crate::source::queue::Faults;

    #[test]
    fn the_last_one_is_written_before_the_end_and_failures_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let queue = Queue::new(1, Faults::default());
        let mut keeper = Keeper::start(&path, &queue).unwrap();
        assert!(Keeper::start(&path, &queue).unwrap_err().to_string().contains("another daemon keeps it"));
        keeper.offer(checkpoint(1));
        let last = checkpoint(2);
        keeper.finish(last.clone());
        assert_eq!((std::fs::read(&path).unwrap(), queue.faults().unsaved), (last.encode(), 0));
        let mut keeper = Keeper::start(&path, &queue).unwrap();
        drop(folder);
        keeper.finish(checkpoint(3));
        assert_eq!(queue.faults().unsaved, 1);
    }
}
