//! Raw frames of a recording, on a thread of its own: the daemon without a machine.

use std::io;
use std::thread;

use inference::{Recording, stream};
use results::output::warn;

use super::queue::Queue;
use super::{Clock, Rate};
use crate::stop::Stop;

/// Put the frames of a recording into a queue at a rate, then close it. Nothing is dropped: a queue that is full is waited for.
///
/// # Errors
/// What the system says of a new thread.
pub fn start(recording: Recording, rate: Rate, queue: &Queue, stop: &Stop) -> io::Result<()> {
    let (queue, stop) = (queue.clone(), stop.clone());
    let thread = thread::Builder::new().name("source".into());
    thread.spawn(move || {
        run(&recording, rate, &queue, &stop);
        queue.close();
    })?;
    Ok(())
}

fn run(recording: &Recording, rate: Rate, queue: &Queue, stop: &Stop) {
    let mut clock = Clock::new(rate, stop);
    for row in &recording.rows {
        clock.wait();
        if stop.is_requested() {
            return;
        }
        match stream::wire(recording, row) {
            Ok(frame) => queue.push_patiently(frame, stop),
            // a value that no frame can carry: counted like a packet that came damaged
            Err(error) => {
                warn(format_args!("{error}"));
                queue.count(|faults| faults.damaged += 1);
            }
        }
    }
}
