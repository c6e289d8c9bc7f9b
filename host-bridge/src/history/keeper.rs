//! What the loop tells the history, and the thread that writes it: the loop does not wait for the disk.

use core::time::Duration;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use results::EstimateRecord;
use results::output::{tell, warn};

use super::Plan;
use super::files::{Files, HistoryError, lock};
use super::row::{Columns, Row};
use crate::health::{HealthRecord, State};

/// Rows that wait for the disk; further ones are left out and counted.
const WAITING: usize = 64;
/// After a failure the disk is tried again as often as this.
const AGAIN: Duration = Duration::from_secs(1);

/// What the loop has of the history: it notes what every frame brings, and hands on a row when one is due.
#[derive(Debug)]
pub struct Recorder {
    every: Duration,
    /// When the frame of the last row came.
    last: Option<Instant>,
    mismatch: bool,
    worst: Vec<State>,
    keeper: Keeper,
}

impl Recorder {
    /// Of rows that go to a keeper.
    pub fn new(plan: &Plan, columns: &Columns, keeper: Keeper) -> Self {
        let worst = vec![State::Ok; columns.instruments.len()];
        Self { every: plan.0[0].every, last: None, mismatch: false, worst, keeper }
    }

    /// Note what must not be forgotten of a frame between two rows; true if a row is due by when the frames came, however late they are
    /// noted.
    pub fn note(&mut self, record: &EstimateRecord, came: Instant) -> bool {
        self.mismatch |= record.mismatch == Some(true);
        self.last.is_none_or(|last| came.saturating_duration_since(last) >= self.every)
    }

    /// Note the states of all instruments, which have changed.
    pub fn note_states(&mut self, health: &HealthRecord) {
        let states = health.monitors.iter().chain(&health.correctors).map(|each| each.state);
        self.worst.iter_mut().zip(states).for_each(|(worst, state)| *worst = worse(*worst, state));
    }

    /// Hand on a row of a frame.
    pub fn record(&mut self, record: &EstimateRecord, health: &HealthRecord, came: Instant, time_ms: u64) {
        self.note_states(health);
        self.last = Some(came);
        self.keeper.offer(Row {
            time_ms,
            sequence: record.sequence,
            frames: record.frames,
            is_usable: record.is_usable(),
            mismatch: core::mem::take(&mut self.mismatch),
            chi_square: [health.fit.chi_square, health.fit.degrees_of_freedom],
            nis_per_reading: record.nis_per_reading().unwrap_or(f32::NAN),
            vars: record.mean.iter().zip(&record.sigma).map(|(mean, sigma)| [*mean, *sigma]).collect(),
            states: self.worst.clone(),
        });
        let now = health.monitors.iter().chain(&health.correctors).map(|each| each.state);
        self.worst = now.collect();
    }

    /// Wait until all is written.
    pub fn finish(self) {
        self.keeper.finish();
    }
}

/// The worse of two states.
fn worse(one: State, other: State) -> State {
    let rank = |state| match state {
        State::Ok => 0,
        State::Back => 1,
        State::Noisy => 2,
        State::Jumps => 3,
        State::Dead => 4,
    };
    if rank(other) > rank(one) { other } else { one }
}

/// Hands rows to the thread that writes them.
#[derive(Debug)]
pub struct Keeper {
    rows: SyncSender<Row>,
    lost: Arc<dyn Lost>,
    thread: JoinHandle<()>,
}

/// Somebody who counts rows that were not written.
pub trait Lost: core::fmt::Debug + Send + Sync {
    /// One more.
    fn count(&self);
}

impl Keeper {
    /// For a folder that no other daemon writes, made if it is not there.
    ///
    /// # Errors
    /// [`HistoryError`].
    pub fn start(folder: &Path, plan: &Plan, columns: &Columns, lost: Arc<dyn Lost>) -> Result<Self, HistoryError> {
        let lock = lock(folder)?;
        let tiers = plan.0.iter().enumerate().map(|(i, tier)| {
            // of the finest, the loop sends those rows only that are due
            let every = if i == 0 { Duration::ZERO } else { tier.every };
            Ok(Thinned::new(every, Files::open(folder, tier, columns)?))
        });
        let tiers: Vec<Thinned> = tiers.collect::<Result<_, HistoryError>>()?;
        let (rows, received) = sync_channel(WAITING);
        let writer = Writer { folder: folder.to_owned(), tiers, lost: lost.clone(), failure: None, _lock: lock };
        let thread = thread::Builder::new().name("history".into()).spawn(move || writer.run(&received));
        Ok(Self { rows, lost, thread: thread.map_err(|error| HistoryError::of(folder, error))? })
    }

    /// Write this row, unless the disk is so slow that others wait: then it is left out and counted.
    fn offer(&self, row: Row) {
        if let Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) = self.rows.try_send(row) {
            self.lost.count();
        }
    }

    fn finish(self) {
        drop(self.rows);
        let _ = self.thread.join();
    }
}

/// A tier, and what happened since its last row.
struct Thinned {
    every: Duration,
    files: Files,
    last: Option<Instant>,
    mismatch: bool,
    worst: Vec<State>,
}

impl Thinned {
    fn new(every: Duration, files: Files) -> Self {
        Self { every, files, last: None, mismatch: false, worst: Vec::new() }
    }

    /// Take a row in, if one is due; what is left out counts in the next one.
    fn take(&mut self, row: &Row) -> std::io::Result<()> {
        self.mismatch |= row.mismatch;
        self.worst.resize(row.states.len(), State::Ok);
        self.worst.iter_mut().zip(&row.states).for_each(|(worst, state)| *worst = worse(*worst, *state));
        if !self.is_due(row.time_ms) {
            return Ok(());
        }
        self.files.append(&Row { mismatch: self.mismatch, states: self.worst.clone(), ..row.clone() })?;
        (self.last, self.mismatch) = (Some(Instant::now()), false);
        self.worst.clear();
        Ok(())
    }

    /// By the monotonic clock; after a start by the clock of the system, so that a daemon which is started again and again does not
    /// fill the disk.
    fn is_due(&self, time_ms: u64) -> bool {
        match (self.last, self.files.last_ms) {
            (Some(last), _) => last.elapsed() >= self.every,
            (None, Some(last_ms)) => time_ms.abs_diff(last_ms) >= self.every.as_millis() as u64,
            (None, None) => true,
        }
    }
}

struct Writer {
    folder: PathBuf,
    tiers: Vec<Thinned>,
    lost: Arc<dyn Lost>,
    /// Since when the disk has failed, and rows that were lost by that.
    failure: Option<(Instant, u64)>,
    _lock: File,
}

impl Writer {
    fn run(mut self, rows: &Receiver<Row>) {
        for row in rows {
            // a disk that is full is not asked a thousand times a second
            let written = match &self.failure {
                Some((tried, _)) if tried.elapsed() < AGAIN => false,
                _ => self.write(&row),
            };
            if !written {
                self.lost.count();
                self.failure.iter_mut().for_each(|(_, lost)| *lost += 1);
            }
        }
    }

    /// Write a row; a failure is said once, and again when it ends.
    fn write(&mut self, row: &Row) -> bool {
        let written =
            fs::create_dir_all(&self.folder).and_then(|()| self.tiers.iter_mut().try_for_each(|tier| tier.take(row)));
        let folder = self.folder.display();
        match (written, self.failure.take()) {
            (Ok(()), None) => true,
            (Ok(()), Some((_, lost))) => {
                tell(format_args!("{folder}: the history is written again, {lost} rows are not in it"));
                true
            }
            (Err(error), before) => {
                if before.is_none() {
                    warn(format_args!("{folder}: history not written: {error}; the loop goes on"));
                }
                self.failure = Some((Instant::now(), before.map_or(0, |(_, lost)| lost)));
                false
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use core::sync::atomic::{AtomicU64, Ordering};

    use super::super::{Span, read};
    use super::*;
    use crate::health::Condition;

    impl Lost for AtomicU64 {
        fn count(&self) {
            self.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn columns() -> Columns {
        Columns { vars: vec!["V0".into(), "V1".into()], instruments: vec!["M0".into(), "H0".into()] }
    }

    fn health(states: [State; 2]) -> HealthRecord {
        let condition = |state| vec![Condition { state, ratios: [0.0; 3] }];
        let fit = estimator::FitQuality { chi_square: 3.0, degrees_of_freedom: 2.0 };
        HealthRecord { sequence: 0, frames: 0, fit, monitors: condition(states[0]), correctors: condition(states[1]) }
    }

    /// What lies between two rows is not in them, but that something was wrong is.
    #[test]
    fn rows_are_thinned_and_faults_are_not() {
        let folder = tempfile::tempdir().unwrap();
        let plan = Plan::new(Duration::from_millis(1), 1, [1, 1]);
        let lost = Arc::new(AtomicU64::new(0));
        let keeper = Keeper::start(folder.path(), &plan, &columns(), lost.clone()).unwrap();
        let mut recorder = Recorder::new(&plan, &columns(), keeper);
        let start = Instant::now();
        let (right, wrong) =
            (EstimateRecord::example(2, 1), EstimateRecord { mismatch: Some(true), ..EstimateRecord::example(2, 1) });
        for (i, states) in [[State::Ok; 2], [State::Dead, State::Ok], [State::Ok, State::Back]].into_iter().enumerate()
        {
            let came = start + Duration::from_millis(i as u64);
            assert_eq!(recorder.note(if i == 1 { &wrong } else { &right }, came - Duration::from_micros(1)), i == 0);
            assert!(recorder.note(&right, came));
            recorder.record(&EstimateRecord::example(2, 1), &health(states), came, 1_000_000 + i as u64);
        }
        recorder.finish();
        assert_eq!(lost.load(Ordering::Relaxed), 0);
        let history = read(folder.path(), &Span::default()).unwrap();
        let told: Vec<_> = history.rows.iter().map(|row| (row.time_ms, row.mismatch, row.states.clone())).collect();
        use State::{Back, Dead, Ok};
        assert_eq!(
            told,
            [(1_000_000, false, vec![Ok, Ok]), (1_000_001, true, vec![Dead, Ok]), (1_000_002, false, vec![Dead, Back])]
        );
        let rows = |tier| {
            let files = super::super::files::numbered(folder.path(), tier);
            files.iter().map(|(_, path)| fs::read_to_string(path).unwrap().lines().count() - 1).sum::<usize>()
        };
        assert_eq!(["fine", "minutes", "hours"].map(rows), [3, 1, 1]);
        // started again within the minute: no further row of it
        let keeper = Keeper::start(folder.path(), &plan, &columns(), lost).unwrap();
        let mut recorder = Recorder::new(&plan, &columns(), keeper);
        recorder.record(&EstimateRecord::example(2, 1), &health([Ok; 2]), start, 1_000_500);
        recorder.finish();
        assert_eq!(["fine", "minutes", "hours"].map(rows), [4, 1, 1]);
    }

    #[test]
    fn a_disk_that_fails_is_counted_and_survived() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("history");
        let plan = Plan::new(Duration::from_nanos(1), 1, [1, 1]);
        let lost = Arc::new(AtomicU64::new(0));
        let keeper = Keeper::start(&path, &Plan(plan.0.clone()), &columns(), lost.clone()).unwrap();
        let mut recorder = Recorder::new(&plan, &columns(), keeper);
        fs::remove_dir_all(&path).unwrap();
        fs::write(&path, "").unwrap();
        (0..3)
            .for_each(|i| recorder.record(&EstimateRecord::example(2, 1), &health([State::Ok; 2]), Instant::now(), i));
        recorder.finish();
        assert_eq!(lost.load(Ordering::Relaxed), 3);
    }
}
