//! What became of the estimates over hours and months, in files that survive restarts: every estimate of the last hour, one a minute of
//! the last month, one an hour of the last years.
//!
//! Each of these is a [`Tier`]: a few CSV files, `files.rs`, of which the oldest is removed when another one begins, so that the disk it
//! takes is bounded. A thread of its own writes them, `keeper.rs`; `reading.rs` reads them, also while that goes on.

mod files;
mod keeper;
mod reading;
mod row;

use core::time::Duration;

pub use files::HistoryError;
pub use keeper::{Keeper, Lost, Recorder};
pub use reading::{History, Span, read};
pub use row::{Columns, Row};

/// Names of the tiers, the finest first.
const TIERS: [&str; 3] = ["fine", "minutes", "hours"];
/// Files of a tier that are kept beside the one that is being written.
const FILES: u64 = 8;

/// How often a row is kept, and for how long.
#[derive(Debug, Clone, PartialEq)]
pub struct Tier {
    /// The files are named after it.
    pub name: &'static str,
    /// A row is left out if the one before is not as old as this.
    pub every: Duration,
    /// Rows that are kept.
    pub rows: u64,
}

impl Tier {
    /// Rows of a file.
    fn rows_of_a_file(&self) -> u64 {
        self.rows.div_ceil(FILES).max(1)
    }
}

/// The tiers of a history, the finest first.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan(pub [Tier; 3]);

impl Plan {
    /// A row every `fine` for so many hours, one a minute and one an hour for so many days.
    pub fn new(fine: Duration, fine_hours: u64, [minute_days, hour_days]: [u64; 2]) -> Self {
        let fine_rows = (3600.0 * fine_hours as f64 / fine.as_secs_f64()).ceil() as u64;
        let [of_fine, of_minutes, of_hours] = TIERS;
        Self([
            Tier { name: of_fine, every: fine, rows: fine_rows },
            Tier { name: of_minutes, every: Duration::from_secs(60), rows: minute_days * 24 * 60 },
            Tier { name: of_hours, every: Duration::from_secs(3600), rows: hour_days * 24 },
        ])
    }

    /// Most bytes that the files of rows with these columns take, those that were set aside apart: the files that are kept, each with
    /// its line of names, and the one that is being written.
    pub fn most_bytes(&self, columns: &Columns) -> u64 {
        let of = |tier: &Tier| {
            let file = columns.header().len() as u64 + tier.rows_of_a_file() * columns.most_bytes();
            (FILES + 1) * file
        };
        self.0.iter().map(of).sum()
    }
}
