//! Raw frames from shared memory, on a thread of its own: whoever publishes them may start later, stop, and start again.

use core::time::Duration;
use std::io;
use std::sync::mpsc::sync_channel;
use std::thread;

use results::output::warn;
use shared_memory::{FrameReader, PublishError};

use super::queue::Queue;
use crate::stop::Stop;

/// Longest wait before somebody's wish to stop is looked at.
const GLANCE: Duration = Duration::from_millis(50);
/// Wait after a failure of the shared memory.
const PAUSE: Duration = Duration::from_secs(1);
/// Name of the reader's process among the nodes of the shared memory.
const READER: &str = "orbitcal-source";

/// Read frames of at most `most` bytes into a queue until somebody asks to stop.
///
/// # Errors
/// What keeps it from joining the service.
pub fn start(service: &str, most: usize, queue: &Queue, stop: &Stop) -> io::Result<()> {
    let (queue, stop, service) = (queue.clone(), stop.clone(), service.to_owned());
    let (joined, outcome) = sync_channel(1);
    // the ends of a service stay on the thread that made them
    thread::Builder::new().name("source".into()).spawn(move || match FrameReader::try_new(&service, READER) {
        Ok(reader) => {
            let _ = joined.send(Ok(()));
            run(reader, most, &queue, &stop);
        }
        Err(error) => _ = joined.send(Err(error)),
    })?;
    let outcome: Result<(), PublishError> = outcome.recv().map_err(io::Error::other)?;
    outcome.map_err(io::Error::other)
}

fn run(mut reader: FrameReader, most: usize, queue: &Queue, stop: &Stop) {
    let mut failure = String::new();
    while !stop.is_requested() {
        let heard = reader.wait(GLANCE, |frame| {
            if frame.len() <= most {
                queue.push(frame.to_vec());
            } else {
                queue.count(|faults| faults.damaged += 1);
            }
        });
        // said once, not at each attempt
        match heard {
            Ok(()) => failure.clear(),
            Err(error) => {
                if failure != error.to_string() {
                    failure = error.to_string();
                    warn(format_args!("{failure}; tried again until it works"));
                }
                thread::sleep(PAUSE);
            }
        }
    }
}
