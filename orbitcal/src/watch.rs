//! Another process looks on: every estimate counted, shown live, and kept if asked.

mod band;
mod ill;
mod screen;
mod view;

use core::time::Duration;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use host_bridge::sink::trace::{Trace, TraceError};
use host_bridge::stop::Stop;
use shared_memory::{PublishError, Stamp, Subscriber};

use view::View;

/// What to watch, and when to stop.
#[derive(Debug, Clone)]
pub struct WatchOptions {
    /// Name of the service.
    pub service: String,
    /// CSV file of all estimates, one row each.
    pub trace: Option<PathBuf>,
    /// Stop after this many estimates.
    pub count: Option<u64>,
    /// Stop after this long without one.
    pub idle: Option<Duration>,
    /// Show nothing.
    pub quiet: bool,
}

/// What came, and what did not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct WatchSummary {
    /// Estimates received.
    pub seen: u64,
    /// Estimates between them that never came.
    pub lost: u64,
    /// Publishers after the first.
    pub restarts: u64,
}

/// Why watching failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WatchError {
    /// The shared memory.
    #[error(transparent)]
    Receive(#[from] PublishError),
    /// The trace.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The terminal, or stdout.
    #[error("cannot show estimates: {0}")]
    Show(#[from] std::io::Error),
}

/// How long to sleep without news: keys, signals and the age on the screen wait for it.
const TICK: Duration = Duration::from_millis(100);

/// Look on until there is enough, nothing more comes, or somebody asks to stop: `q` or Ctrl-C in a terminal, SIGINT,
/// SIGTERM, a reader of stdout that has gone. The trace is then finished with what has come.
///
/// # Errors
/// [`WatchError`].
pub fn watch(options: &WatchOptions) -> Result<WatchSummary, WatchError> {
    let stop = Stop::on_signals()?;
    let mut trace = options.trace.as_ref().map(|path| Trace::create(path)).transpose()?;
    let mut subscriber = Subscriber::try_new(&options.service)?;
    let mut view = View::open(options)?;
    let (mut tally, mut heard) = (Tally::default(), Instant::now());
    while !tally.is_enough(options.count) && options.idle.is_none_or(|idle| heard.elapsed() < idle) {
        let mut records = subscriber.wait(options.idle.map_or(TICK, |idle| idle.min(TICK)))?;
        records.truncate(tally.room(options.count));
        for record in &records {
            heard = Instant::now();
            tally.add(&record.stamp, record.record.frames);
            trace.as_mut().map_or(Ok(()), |trace| trace.add(&record.record))?;
        }
        if !view.show(&records, &tally.summary())? || stop.is_requested() {
            break;
        }
    }
    drop(view);
    trace.map_or(Ok(()), Trace::save)?;
    Ok(tally.summary())
}

/// Counts estimates. Those of one publisher number their frames without a gap.
#[derive(Debug, Default)]
struct Tally {
    seen: u64,
    lost: u64,
    /// Last frame count of each publisher, by its start.
    publishers: BTreeMap<u64, u32>,
}

impl Tally {
    fn add(&mut self, stamp: &Stamp, frames: u32) {
        self.seen += 1;
        if let Some(last) = self.publishers.insert(stamp.started_ns, frames) {
            self.lost += u64::from(frames.saturating_sub(last).saturating_sub(1));
        }
    }

    /// How many more are wanted.
    fn room(&self, count: Option<u64>) -> usize {
        count.map_or(usize::MAX, |count| usize::try_from(count - self.seen.min(count)).unwrap_or(usize::MAX))
    }

    fn is_enough(&self, count: Option<u64>) -> bool {
        self.room(count) == 0
    }

    fn summary(&self) -> WatchSummary {
        let restarts = self.publishers.len().saturating_sub(1) as u64;
        WatchSummary { seen: self.seen, lost: self.lost, restarts }
    }
}

#[cfg(test)]
mod tests {
    use results::EstimateRecord;
    use shared_memory::Publisher;

    use std::sync::mpsc::RecvTimeoutError;

    use super::*;

    fn tally(stamps: &[(u64, u32)]) -> WatchSummary {
        let mut tally = Tally::default();
        for &(started_ns, frames) in stamps {
            tally.add(&Stamp { started_ns, ..Stamp::default() }, frames);
        }
        tally.summary()
    }

    #[test]
    fn gaps_are_losses_and_restarts_are_not() {
        assert_eq!(tally(&[]), WatchSummary { seen: 0, lost: 0, restarts: 0 });
        assert_eq!(tally(&[(1, 17), (1, 18)]), WatchSummary { seen: 2, lost: 0, restarts: 0 });
        assert_eq!(tally(&[(1, 1), (1, 5), (1, 6)]), WatchSummary { seen: 3, lost: 3, restarts: 0 });
        assert_eq!(tally(&[(1, 9), (2, 1), (2, 2)]), WatchSummary { seen: 3, lost: 0, restarts: 1 });
        assert_eq!(tally(&[(1, 9), (2, 1), (1, 10), (2, 3)]), WatchSummary { seen: 4, lost: 1, restarts: 1 });
    }

    #[test]
    fn watching_ends_with_the_count_and_keeps_a_trace() {
        let folder = tempfile::tempdir().unwrap();
        let options = WatchOptions {
            service: format!("orbitcal/test/{}/watch", std::process::id()),
            trace: Some(folder.path().join("a.csv")),
            count: Some(3),
            idle: Some(Duration::from_secs(20)),
            quiet: true,
        };
        let (service, (end, ended)) = (options.service.clone(), std::sync::mpsc::channel::<()>());
        let writer = std::thread::spawn(move || {
            let record = |frames| EstimateRecord { sequence: frames, frames, ..EstimateRecord::example(20, 10) };
            let mut publisher = Publisher::try_new(&service, "a test", &record(1).names).unwrap();
            for frames in [1, 2, 4, 5] {
                publisher.publish(&record(frames)).unwrap();
            }
            // history is handed over with the next estimate, however late somebody looks on
            for frames in 6.. {
                if ended.recv_timeout(Duration::from_millis(50)) != Err(RecvTimeoutError::Timeout) {
                    return;
                }
                publisher.publish(&record(frames)).unwrap();
            }
        });
        let summary = watch(&options).unwrap();
        end.send(()).unwrap();
        writer.join().unwrap();
        assert_eq!(summary, WatchSummary { seen: 3, lost: 1, restarts: 0 });
        let text = std::fs::read_to_string(options.trace.unwrap()).unwrap();
        let first: Vec<_> = text.lines().map(|line| line.split(',').next().unwrap()).collect();
        assert_eq!(first, ["seq", "1", "2", "4"]);
    }

    #[test]
    fn watching_nothing_ends_when_idle() {
        let options = WatchOptions {
            service: format!("orbitcal/test/{}/nothing", std::process::id()),
            trace: None,
            count: None,
            idle: Some(Duration::from_millis(50)),
            quiet: true,
        };
        assert_eq!(watch(&options).unwrap(), WatchSummary::default());
    }
}
