//! Where estimates are shown: a live table on a terminal, one line each in a pipe, or nowhere.

use core::time::Duration;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::time::Instant;

use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};

use super::screen::Screen;
use super::{WatchOptions, WatchSummary};
use crate::publish::now_ns;
use crate::record::EstimateRecord;

/// Time between two pictures: what an eye can follow.
const REDRAW: Duration = Duration::from_millis(100);

/// The live table; the terminal is as before once this is gone, after a panic too.
pub(super) struct Live {
    terminal: DefaultTerminal,
    screen: Screen,
    drawn: Instant,
}

/// Where estimates are shown.
pub(super) enum View {
    Live(Box<Live>),
    Lines(Vec<String>),
    Silent,
}

impl View {
    pub(super) fn open(options: &WatchOptions, vars: Vec<String>, monitors: Vec<String>) -> io::Result<Self> {
        if options.quiet {
            return Ok(Self::Silent);
        }
        if !io::stdout().is_terminal() {
            let is_open = say(&format!("listening on {}", options.service))?;
            return Ok(if is_open { Self::Lines(vars) } else { Self::Silent });
        }
        let screen = Screen::new(options.service.clone(), vars, monitors);
        let mut live = Box::new(Live { terminal: ratatui::try_init()?, screen, drawn: Instant::now() });
        live.draw(&WatchSummary::default())?;
        Ok(Self::Live(live))
    }

    /// Show what has come; false if nobody looks any more.
    pub(super) fn show(&mut self, records: &[EstimateRecord], summary: &WatchSummary) -> io::Result<bool> {
        match self {
            Self::Live(live) => live.show(records, summary),
            Self::Lines(vars) => {
                let mut lines = records.iter().map(|record| say(&line(record, vars)));
                lines.try_fold(true, |open, line| Ok(open && line?))
            }
            Self::Silent => Ok(true),
        }
    }
}

impl Live {
    fn show(&mut self, records: &[EstimateRecord], summary: &WatchSummary) -> io::Result<bool> {
        records.iter().for_each(|record| self.screen.take(record));
        if self.drawn.elapsed() >= REDRAW {
            self.draw(summary)?;
        }
        while event::poll(Duration::ZERO)? {
            if is_goodbye(&event::read()?) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn draw(&mut self, summary: &WatchSummary) -> io::Result<()> {
        self.drawn = Instant::now();
        self.terminal.draw(|frame| self.screen.draw(frame, summary, now_ns()))?;
        Ok(())
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        ratatui::restore();
    }
}

/// `q`, Escape or Ctrl-C, which is a key like others while the table is shown.
fn is_goodbye(event: &Event) -> bool {
    let Event::Key(key) = event else { return false };
    let is_ctrl_c = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
    key.kind == KeyEventKind::Press && (is_ctrl_c || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc))
}

/// Print a line at once; false if the reader has gone.
fn say(line: &str) -> io::Result<bool> {
    let mut stdout = io::stdout().lock();
    match writeln!(stdout, "{line}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        done => done.map(|()| true),
    }
}

/// An estimate in a line: what was used, how well it fits, and the var that is farthest from 1.
fn line(record: &EstimateRecord, vars: &[String]) -> String {
    let nis = record.nis_per_reading().map_or("-".to_owned(), |nis| format!("{nis:.2}"));
    let farthest = (0..vars.len()).max_by(|&i, &j| record.deviation(i).abs().total_cmp(&record.deviation(j).abs()));
    let var = farthest.map_or(String::new(), |i| {
        format!("{} {:.4} +- {:.4} ({:+.1} sigma)", vars[i], record.mean[i], record.sigma[i], record.deviation(i))
    });
    let (sequence, frames, rejected) = (record.sequence, record.frames, record.rejected.count_ones());
    format!("seq {sequence} frames {frames} nis/reading {nis} rejected {rejected} farthest {var}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_names_the_farthest_var() {
        let mut record = EstimateRecord {
            sequence: 9,
            frames: 8,
            accepted: 0b111,
            rejected: 0b1000,
            nis: 3.3,
            ..EstimateRecord::ZERO
        };
        (record.mean, record.sigma) = ([1.0; 48], [0.01; 48]);
        (record.mean[3], record.mean[5]) = (0.95, 1.02);
        let vars: Vec<_> = (0..48).map(|i| format!("V{i}")).collect();
        let expected = "seq 9 frames 8 nis/reading 1.10 rejected 1 farthest V3 0.9500 +- 0.0100 (-5.0 sigma)";
        assert_eq!(line(&record, &vars), expected);
    }

    #[test]
    fn q_escape_and_control_c_say_goodbye() {
        let press = |code, modifiers| Event::Key(event::KeyEvent::new(code, modifiers));
        assert!(is_goodbye(&press(KeyCode::Char('q'), KeyModifiers::NONE)));
        assert!(is_goodbye(&press(KeyCode::Esc, KeyModifiers::NONE)));
        assert!(is_goodbye(&press(KeyCode::Char('c'), KeyModifiers::CONTROL)));
        assert!(!is_goodbye(&press(KeyCode::Char('c'), KeyModifiers::NONE)));
    }
}
