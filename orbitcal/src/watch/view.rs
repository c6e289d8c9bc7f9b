//! Where estimates are shown: a live table on a terminal, one line each in a pipe, or nowhere.

use core::time::Duration;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::time::Instant;

use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use results::{EstimateRecord, ReadingUse};
use shared_memory::{HealthReader, Published, Stamp, now_ns};

use super::screen::Screen;
use super::{WatchOptions, WatchSummary};

/// Time between two pictures: what an eye can follow.
const REDRAW: Duration = Duration::from_millis(100);

/// Time between two points of a trend.
const TICK: Duration = Duration::from_secs(1);

/// The live table; the terminal is as before once this is gone, after a panic too.
pub(super) struct Live {
    terminal: DefaultTerminal,
    screen: Screen,
    drawn: Instant,
    ticked: Instant,
    /// None where the daemon's health cannot be read: monitors are then shown as the core judges them.
    health: Option<HealthReader>,
}

/// Where estimates are shown.
pub(super) enum View {
    Live(Box<Live>),
    Lines {
        /// The publisher of the last estimate.
        from: Option<Stamp>,
    },
    Silent,
}

impl View {
    pub(super) fn open(options: &WatchOptions) -> io::Result<Self> {
        if options.quiet {
            return Ok(Self::Silent);
        }
        if !io::stdout().is_terminal() {
            let is_open = say(&format!("listening on {}", options.service))?;
            return Ok(if is_open { Self::Lines { from: None } } else { Self::Silent });
        }
        let screen = Screen::new(options.service.clone());
        let (health, now) = (HealthReader::try_new(&options.service).ok(), Instant::now());
        let mut live = Box::new(Live { terminal: ratatui::try_init()?, screen, drawn: now, ticked: now, health });
        live.draw(&WatchSummary::default())?;
        Ok(Self::Live(live))
    }

    /// Show what has come; false if nobody looks any more.
    pub(super) fn show(&mut self, published: &[Published], summary: &WatchSummary) -> io::Result<bool> {
        match self {
            Self::Live(live) => live.show(published, summary),
            Self::Lines { from } => {
                let mut lines = published.iter().flat_map(|published| told(published, from));
                lines.try_fold(true, |open, line| Ok(open && say(&line)?))
            }
            Self::Silent => Ok(true),
        }
    }
}

impl Live {
    fn show(&mut self, published: &[Published], summary: &WatchSummary) -> io::Result<bool> {
        published.iter().for_each(|one| self.screen.take(one));
        if let Some((health, names)) = self.health.as_mut().and_then(|reader| reader.newest_with_names().ok().flatten())
        {
            self.screen.take_health(health, names);
        }
        if self.ticked.elapsed() >= TICK {
            self.ticked = Instant::now();
            self.screen.tick();
        }
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

/// What is said of an estimate: first its publisher, if that is another one than before.
fn told(published: &Published, from: &mut Option<Stamp>) -> Vec<String> {
    let Published { record, stamp } = published;
    let is_new = from.as_ref().is_none_or(|from| from.started_ns != stamp.started_ns);
    *from = Some(stamp.clone());
    let publisher = is_new.then(|| format!("from {}: {}", stamp.publisher, record.names.machine));
    publisher.into_iter().chain([line(record)]).collect()
}

/// An estimate in a line: what was used, how well it fits, and the var that is farthest from 1.
fn line(record: &EstimateRecord) -> String {
    let nis = record.nis_per_reading().map_or("-".to_owned(), |nis| format!("{nis:.2}"));
    let var = record.farthest().map_or(String::new(), |i| {
        let (name, mean, sigma) = (&record.names.vars[i], record.mean[i], record.sigma[i]);
        format!("{name} {mean:.4} ± {sigma:.4} ({:+.1} sigma)", record.deviation(i))
    });
    let alarm = (record.mismatch == Some(true)).then_some("mismatch");
    let alarms: String = record.words().chain(alarm).map(|word| format!(", {word}")).collect();
    let (sequence, frames, rejected) = (record.sequence, record.frames, record.readings(ReadingUse::Rejected));
    format!("seq {sequence} frames {frames} nis {nis} rejected {rejected} {var}{alarms}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_names_the_farthest_var() {
        let mut record =
            EstimateRecord { sequence: 123_456, frames: 123_455, nis: 3.3, ..EstimateRecord::example(48, 33) };
        record.reading = vec![ReadingUse::Absent; 33];
        record.reading[..4].copy_from_slice(&[
            ReadingUse::Used,
            ReadingUse::Used,
            ReadingUse::Used,
            ReadingUse::Rejected,
        ]);
        (record.mean[3], record.mean[5]) = (0.95, 1.02);
        let expected = "seq 123456 frames 123455 nis 1.10 rejected 1 V3 0.9500 ± 0.0100 (-5.0 sigma)";
        assert_eq!(line(&record), expected);
        (record.remarks.put_aside, record.mismatch) = (true, Some(true));
        assert_eq!(line(&record), format!("{expected}, put aside, mismatch"));
    }

    #[test]
    fn a_publisher_is_named_once() {
        let stamp = Stamp { publisher: "control room".into(), started_ns: 3, published_ns: 4 };
        let published = Published { record: EstimateRecord::example(2, 1), stamp };
        let mut from = None;
        assert_eq!(told(&published, &mut from)[0], "from control room: test ring");
        assert_eq!(told(&published, &mut from).len(), 1);
        let restarted = Published { stamp: Stamp { started_ns: 5, ..published.stamp.clone() }, ..published };
        assert_eq!(told(&restarted, &mut from).len(), 2);
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
