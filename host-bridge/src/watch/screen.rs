//! The live table: a grid of vars, and the monitors that are not well.

use std::collections::VecDeque;

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Wrap};

use super::WatchSummary;
use crate::record::{EstimateRecord, MONITORS, VARS};

/// Width of a var's cell without its bar.
const CELL: usize = 22;
/// Bar and gap on a terminal of 80 columns.
const BAR: usize = 4;
/// Deviation that fills half a bar [sigmas].
const FULL_BAR: f32 = 5.0;
/// Deviation from which a var stands out [sigmas].
const NOTABLE: f32 = 2.0;
/// Weaker than nominal: sky blue; stronger: orange. Told apart with any colour vision, and by the sign as well.
const WEAKER: Color = Color::Indexed(74);
/// See [`WEAKER`].
const STRONGER: Color = Color::Indexed(214);
/// Estimates over which the rate is taken.
const RATE_OVER: usize = 64;

/// What is on the screen.
pub(super) struct Screen {
    service: String,
    vars: Vec<String>,
    monitors: Vec<String>,
    latest: Option<EstimateRecord>,
    /// Publication times of the last estimates of one publisher [ns].
    stamps: VecDeque<u64>,
}

impl Screen {
    pub(super) fn new(service: String, vars: Vec<String>, monitors: Vec<String>) -> Self {
        Self { service, vars, monitors, latest: None, stamps: VecDeque::with_capacity(RATE_OVER) }
    }

    pub(super) fn take(&mut self, record: &EstimateRecord) {
        if self.latest.is_some_and(|latest| latest.started_ns != record.started_ns) {
            self.stamps.clear();
        }
        if self.stamps.len() == RATE_OVER {
            self.stamps.pop_front();
        }
        self.stamps.push_back(record.published_ns);
        self.latest = Some(*record);
    }

    pub(super) fn draw(&self, frame: &mut Frame, summary: &WatchSummary, now_ns: u64) {
        let width = usize::from(frame.area().width);
        let columns = (width / (CELL + BAR)).clamp(1, 6);
        let rows = VARS.div_ceil(columns);
        let areas = [Constraint::Length(3), Constraint::Length(rows as u16 + 1), Constraint::Min(1)];
        let [top, grid, bottom] = Layout::vertical(areas).areas(frame.area());
        let Some(record) = &self.latest else {
            let text = format!("{}: waiting for estimates, q quits", self.service);
            return frame.render_widget(Paragraph::new(text), top);
        };
        frame.render_widget(Paragraph::new(self.header(record, summary, now_ns)), top);
        frame.render_widget(Paragraph::new(self.grid(record, columns, width / columns)), grid);
        frame.render_widget(Paragraph::new(self.unwell(record)).wrap(Wrap { trim: true }), bottom);
    }

    fn header(&self, record: &EstimateRecord, summary: &WatchSummary, now_ns: u64) -> Vec<Line<'static>> {
        let nis = record.nis_per_reading().map_or("-".to_owned(), |nis| format!("{nis:.2}"));
        let (sequence, rejected, frames) = (record.sequence, record.rejected.count_ones(), record.frames);
        let (rate, age) = (self.rate(), age(now_ns.saturating_sub(record.published_ns)));
        let first = format!("seq {sequence}  {rate}  age {age}  nis/reading {nis}  rejected {rejected}");
        let WatchSummary { seen, lost, restarts } = summary;
        let second = format!(
            "frames {frames}, refused {}  seen {seen}  lost {lost}  restarts {restarts}  q quits",
            record.rejected_frames
        );
        let bold = Style::new().add_modifier(Modifier::BOLD);
        vec![Line::styled(first, bold), Line::from(second), Line::default()]
    }

    /// Rate of the last estimates, by their publication.
    fn rate(&self) -> String {
        let (first, last) = (self.stamps.front().copied().unwrap_or(0), self.stamps.back().copied().unwrap_or(0));
        let seconds = last.saturating_sub(first) as f64 * 1e-9;
        let periods = self.stamps.len().saturating_sub(1) as f64;
        if seconds > 0.0 { format!("{:.1} Hz", periods / seconds) } else { "- Hz".to_owned() }
    }

    /// Vars down the columns, each with mean, sigma, deviation from 1, and a bar of it.
    fn grid(&self, record: &EstimateRecord, columns: usize, width: usize) -> Vec<Line<'static>> {
        let rows = VARS.div_ceil(columns);
        let title = format!("{:<3}{:>6}{:>6}{:>6}", "var", "mean", "sd/%", "dev");
        let title = Span::styled(format!("{title:<width$}").repeat(columns), Style::new().add_modifier(Modifier::DIM));
        let cells = |row| (row..VARS).step_by(rows).flat_map(|i| self.cell(record, i, width));
        core::iter::once(Line::from(title)).chain((0..rows).map(|row| cells(row).collect())).collect()
    }

    fn cell(&self, record: &EstimateRecord, i: usize, width: usize) -> [Span<'static>; 2] {
        let deviation = record.deviation(i);
        let style = Style::new().fg(if deviation < 0.0 { WEAKER } else { STRONGER });
        let style = if deviation.abs() < NOTABLE { Style::new() } else { style };
        let percent = 100.0 * record.sigma[i];
        let text = format!("{:<3}{:>6.4}{percent:>6.2}{deviation:>+6.1} ", self.vars[i], record.mean[i]);
        let bar = bar(deviation, width.saturating_sub(CELL + 1).min(21));
        [Span::styled(text, style), Span::styled(format!("{bar:<0$}", width.saturating_sub(CELL)), style)]
    }

    /// Monitors that are not ok, with their noise.
    fn unwell(&self, record: &EstimateRecord) -> Line<'static> {
        let tell = |b: usize| {
            let state = ["ok", "noisy", "jumps", "dead"].get(usize::from(record.monitor_state[b])).unwrap_or(&"?");
            let (mm, rejected) = (1e3 * record.monitor_sigma[b], record.monitor_rejected[b]);
            format!("{} {state} {mm:.2} mm ({rejected} rejected)", self.monitors[b])
        };
        let unwell: Vec<_> = (0..MONITORS).filter(|&b| record.monitor_state[b] != 0).map(tell).collect();
        Line::from(if unwell.is_empty() { "all monitors ok".to_owned() } else { unwell.join(", ") })
    }
}

/// A bar from the middle, to the left for a deviation below zero; nothing if there is no room.
fn bar(deviation: f32, width: usize) -> String {
    let half = width / 2;
    if half == 0 {
        return String::new();
    }
    let filled = (deviation.abs() / FULL_BAR * half as f32).round().min(half as f32) as usize;
    let (blank, full) = (" ".repeat(half - filled), "█".repeat(filled));
    if deviation < 0.0 { format!("{blank}{full}│") } else { format!("{}│{full}", " ".repeat(half)) }
}

/// A time span in a unit that suits it.
fn age(ns: u64) -> String {
    let seconds = ns as f64 * 1e-9;
    if seconds < 1.0 { format!("{:.0} ms", seconds * 1e3) } else { format!("{seconds:.0} s") }
}

#[cfg(test)]
mod tests {
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::*;

    fn screen() -> Screen {
        let ring = twin::Ring::booster();
        Screen::new("orbitcal/estimate".to_owned(), ring.var_names(), ring.monitor_names())
    }

    fn drawn(screen: &Screen, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        let summary = WatchSummary { seen: 20, lost: 0, restarts: 1 };
        terminal.draw(|frame| screen.draw(frame, &summary, 2_012_000_000)).unwrap();
        terminal.backend().to_string()
    }

    fn filled() -> Screen {
        let mut screen = screen();
        let mut record =
            EstimateRecord { sequence: 345, frames: 346, accepted: 0b11, nis: 2.1, ..EstimateRecord::ZERO };
        (record.mean, record.sigma) = ([1.0; VARS], [0.003; VARS]);
        record.mean[47] = 0.958;
        (record.monitor_state[0], record.monitor_sigma[0], record.monitor_rejected[0]) = (1, 0.61e-3, 14);
        for i in 0..=10 {
            screen.take(&EstimateRecord { published_ns: 1_000_000_000 + 100_000_000 * i, ..record });
        }
        screen
    }

    #[test]
    fn everything_fits_on_eighty_by_twenty_four() {
        let text = drawn(&filled(), 80, 24);
        assert!(text.contains("seq 345  10.0 Hz  age 12 ms  nis/reading 1.05  rejected 0"), "{text}");
        assert!(text.contains("seen 20  lost 0  restarts 1"), "{text}");
        assert!(text.contains("F7 0.9580  0.30 -14.0"), "{text}");
        assert!(text.contains("x_A6 noisy 0.61 mm (14 rejected)"), "{text}");
        for name in twin::Ring::booster().var_names() {
            assert!(text.contains(&format!("{name} ")), "{name} is missing:\n{text}");
        }
    }

    #[test]
    fn no_size_is_too_small_or_too_large() {
        for (width, height) in [(1, 1), (20, 5), (80, 24), (200, 60), (400, 10)] {
            drawn(&filled(), width, height);
            drawn(&screen(), width, height);
        }
    }

    #[test]
    fn bars_grow_from_the_middle() {
        assert_eq!(bar(0.0, 11), "     │");
        assert_eq!(bar(2.0, 11), "     │██");
        assert_eq!(bar(-3.0, 11), "  ███│");
        assert_eq!(bar(-99.0, 11), "█████│");
        assert_eq!(bar(1.0, 1), "");
    }
}
