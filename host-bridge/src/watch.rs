//! Following the published estimates from another process: a live table on a terminal, a line each in a pipe.

use core::time::Duration;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Instant;

use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Cell, Paragraph, Row, Table};
use twin::Ring;

use crate::publish::{PublishError, Subscriber};
use crate::record::{EstimateRecord, now_ns};
use crate::trace::{Trace, TraceError};

/// What to follow, and until when.
#[derive(Debug, Clone)]
pub struct WatchOptions {
    /// Name of the service.
    pub service: String,
    /// CSV with a row for each estimate.
    pub trace: Option<PathBuf>,
    /// Stop after this many estimates.
    pub count: Option<u64>,
    /// Stop after this long without one.
    pub idle: Option<Duration>,
    /// Print nothing.
    pub quiet: bool,
}

/// What was seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WatchSummary {
    /// Estimates seen.
    pub seen: u64,
    /// Estimates that were published between two that were seen, and were not.
    pub lost: u64,
    /// Other runs of the publisher after the first.
    pub restarts: u64,
}

/// Why watching ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WatchError {
    /// Shared memory.
    #[error(transparent)]
    Publish(#[from] PublishError),
    /// The trace.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The terminal.
    #[error("terminal: {0}")]
    Terminal(#[from] std::io::Error),
}

/// How often the terminal and the end are looked after.
const TICK: Duration = Duration::from_millis(100);

/// Follow the estimates of a service.
///
/// # Errors
/// [`WatchError`].
pub fn watch(options: &WatchOptions, ring: &Ring) -> Result<WatchSummary, WatchError> {
    let mut subscriber = Subscriber::try_new(&options.service)?;
    let mut trace = options.trace.as_ref().map(|path| Trace::create(path, &ring.var_names())).transpose()?;
    let mut view = View::open(options.quiet, ring);
    let mut follower = Follower::default();
    let mut heard = Instant::now();
    while options.count.is_none_or(|count| follower.summary.seen < count) {
        let mut written = Ok(());
        let received = subscriber.wait(TICK, |record| {
            if options.count.is_some_and(|count| follower.summary.seen >= count) {
                return;
            }
            follower.follow(record);
            view.line(record);
            if let (Some(trace), Ok(())) = (&mut trace, &written) {
                written = trace.add(record);
            }
        })?;
        written?;
        if received > 0 {
            heard = Instant::now();
        } else if options.idle.is_some_and(|idle| heard.elapsed() > idle) {
            break;
        }
        if view.draw(&follower)? {
            break;
        }
    }
    trace.map_or(Ok(()), Trace::finish)?;
    Ok(follower.summary)
}

/// Counts what is seen and what is missing.
#[derive(Debug, Default)]
struct Follower {
    summary: WatchSummary,
    last: Option<EstimateRecord>,
    /// Estimates a second, smoothed.
    rate: f64,
}

impl Follower {
    fn follow(&mut self, record: &EstimateRecord) {
        self.summary.seen += 1;
        if let Some(last) = self.last.replace(*record) {
            if last.started_ns != record.started_ns {
                self.summary.restarts += 1;
                return;
            }
            self.summary.lost += u64::from(record.frames.saturating_sub(last.frames).saturating_sub(1));
            let interval = record.published_ns.saturating_sub(last.published_ns).max(1) as f64 * 1e-9;
            self.rate += 0.1 * (1.0 / interval - self.rate);
        }
    }
}

/// Where estimates are shown.
enum View {
    Nowhere,
    Lines,
    Terminal { terminal: DefaultTerminal, vars: Vec<String>, monitors: Vec<String> },
}

impl View {
    fn open(quiet: bool, ring: &Ring) -> Self {
        match (quiet, std::io::stdout().is_terminal()) {
            (true, _) => Self::Nowhere,
            (_, false) => Self::Lines,
            _ => Self::Terminal { terminal: ratatui::init(), vars: ring.var_names(), monitors: ring.monitor_names() },
        }
    }

    fn line(&self, record: &EstimateRecord) {
        if let Self::Lines = self {
            let readings = record.accepted.count_ones().max(1) as f32;
            let (nis, refused) = (record.nis / readings, record.rejected.count_ones());
            println!("cycle {}: NIS per reading {nis:.2}, {refused} readings refused", record.sequence);
        }
    }

    /// Draw the table; true if the user has had enough.
    fn draw(&mut self, follower: &Follower) -> Result<bool, std::io::Error> {
        let Self::Terminal { terminal, vars, monitors } = self else { return Ok(false) };
        terminal.draw(|frame| {
            let areas = Layout::vertical([Constraint::Length(2), Constraint::Min(13), Constraint::Length(3)]);
            let [head, body, foot] = areas.areas(frame.area());
            frame.render_widget(heading(follower), head);
            if let Some(record) = &follower.last {
                frame.render_widget(table(record, vars), body);
                frame.render_widget(footing(record, vars, monitors), foot);
            }
        })?;
        while event::poll(Duration::ZERO)? {
            if let Event::Key(key) = event::read()? {
                let interrupt = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
                if interrupt || key.code == KeyCode::Char('q') {
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }
}

impl Drop for View {
    fn drop(&mut self) {
        if let Self::Terminal { .. } = self {
            ratatui::restore();
        }
    }
}

fn heading(follower: &Follower) -> Paragraph<'static> {
    let Some(record) = &follower.last else { return Paragraph::new("waiting for estimates (q ends)") };
    let age = now_ns().saturating_sub(record.published_ns) as f64 * 1e-9;
    let nis = record.nis / record.accepted.count_ones().max(1) as f32;
    let lost = if follower.summary.lost > 0 { format!(", {} lost", follower.summary.lost) } else { String::new() };
    Paragraph::new(format!(
        "cycle {}   {:.1}/s   NIS per reading {nis:.2}   ln evidence {:.1}   {age:.1} s old   {} seen{lost}   q ends",
        record.sequence, follower.rate, record.log_evidence, follower.summary.seen
    ))
}

/// Twelve rows of four vars: name, mean, sigma in percent. Orange or blue (told apart by every eye, and by the sign)
/// where a var is 3 sigma from 1.
fn table(record: &EstimateRecord, vars: &[String]) -> Table<'static> {
    let cell = |i: usize| {
        let (mean, sigma) = (record.mean[i], record.sigma[i]);
        let away = (mean - 1.0) / sigma;
        let style = match away {
            a if a > 3.0 => Style::new().fg(Color::Rgb(230, 159, 0)),
            a if a < -3.0 => Style::new().fg(Color::Rgb(86, 180, 233)),
            _ => Style::new(),
        };
        Cell::from(format!("{:<3} {mean:.4} {:>5.2} % {away:>+5.1}", vars[i], 100.0 * sigma)).style(style)
    };
    let rows = (0..12).map(|row| Row::new((0..4).map(|column| cell(12 * column + row))));
    let head = Row::new(["var mean    sigma  sigmas"; 4]).bold();
    Table::new(rows, [Constraint::Length(27); 4]).header(head)
}

fn footing(record: &EstimateRecord, vars: &[String], monitors: &[String]) -> Paragraph<'static> {
    let faulty: Vec<Span> = (0..monitors.len())
        .filter(|&b| record.monitor_state[b] != 0)
        .map(|b| {
            let state = ["ok", "noisy", "jumps", "dead"][usize::from(record.monitor_state[b].min(3))];
            Span::raw(format!("  {} {state} ({:.2} mm)", monitors[b], record.monitor_noise[b] * 1e3))
        })
        .collect();
    let clipped: String =
        (0..vars.len()).filter(|i| record.clipped >> i & 1 == 1).map(|i| format!(" {}", vars[i])).collect();
    let mut monitors_line = vec![Span::raw("monitors:").bold()];
    monitors_line.extend(if faulty.is_empty() { vec![Span::raw(" all ok")] } else { faulty });
    let clipped =
        if clipped.is_empty() { Line::default() } else { Line::raw(format!("at a bound of 0.94..1.06:{clipped}")) };
    Paragraph::new(vec![Line::default(), Line::from(monitors_line), clipped])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(started_ns: u64, frames: u32) -> EstimateRecord {
        EstimateRecord {
            time_us: 0,
            started_ns,
            published_ns: 0,
            clipped: 0,
            accepted: 0,
            rejected: 0,
            sequence: frames,
            frames,
            rejected_frames: 0,
            linearised: 0,
            nis: 0.0,
            log_evidence: 0.0,
            mean: [1.0; 48],
            sigma: [0.03; 48],
            covariance: [0.0; 1176],
            monitor_noise: [0.0; 33],
            monitor_rejected: [0; 33],
            monitor_state: [0; 33],
            reserved: [0; 7],
        }
    }

    #[test]
    fn gaps_are_lost_estimates_and_another_start_is_a_restart() {
        let mut follower = Follower::default();
        for (start, frames) in [(1, 5), (1, 6), (1, 9), (2, 1), (2, 2)] {
            follower.follow(&record(start, frames));
        }
        assert_eq!(follower.summary, WatchSummary { seen: 5, lost: 2, restarts: 1 });
    }
}
