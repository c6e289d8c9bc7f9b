//! The live table: who publishes, a grid of vars, and the monitors that are not well. What does not fit is counted.

use std::collections::VecDeque;

use estimator::MonitorState;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::Paragraph;

use super::WatchSummary;
use crate::output::lines;
use crate::record::{EstimateRecord, ReadingUse};
use crate::result::word;
use crate::sink::shared_memory::Published;

/// Lines above the grid.
const HEADER: u16 = 3;
/// Width of mean, sigma, deviation and a gap.
const NUMBERS: usize = 19;
/// Bar and gap on a terminal of 80 columns.
const BAR: usize = 4;
/// Widest bar with its gap.
const WIDEST_BAR: usize = 22;
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
    latest: Option<Published>,
    /// Publication times of the last estimates of one publisher [ns].
    stamps: VecDeque<u64>,
}

/// How the vars are laid out.
struct Grid {
    columns: usize,
    rows: usize,
    /// Of a column.
    width: usize,
    /// Of a name and the gap after it.
    name: usize,
    /// Vars that are shown; a line below tells of the others.
    shown: usize,
}

impl Grid {
    /// As many columns as have room for bars; without bars, if that shows all vars; and no more vars than fit.
    fn of(record: &EstimateRecord, width: usize, height: usize) -> Self {
        let vars = record.mean.len();
        let name = 1 + record.names.vars.iter().map(|name| name.chars().count()).max().unwrap_or(0);
        let cell = name + NUMBERS;
        let with_bars = (width / (cell + BAR)).max(1);
        let columns = if vars.div_ceil(with_bars) <= height { with_bars } else { (width / cell).max(1) };
        let is_whole = vars.div_ceil(columns) <= height;
        let rows = if is_whole { vars.div_ceil(columns) } else { height.saturating_sub(1) };
        Self { columns, rows, width: (width / columns).min(cell + WIDEST_BAR), name, shown: vars.min(rows * columns) }
    }

    /// Lines with the title, and the count of what is left out.
    fn height(&self, vars: usize) -> u16 {
        (1 + self.rows + usize::from(self.shown < vars)) as u16
    }
}

impl Screen {
    pub(super) fn new(service: String) -> Self {
        Self { service, latest: None, stamps: VecDeque::with_capacity(RATE_OVER) }
    }

    pub(super) fn take(&mut self, published: &Published) {
        if self.latest.as_ref().is_some_and(|latest| latest.stamp.started_ns != published.stamp.started_ns) {
            self.stamps.clear();
        }
        if self.stamps.len() == RATE_OVER {
            self.stamps.pop_front();
        }
        self.stamps.push_back(published.stamp.published_ns);
        self.latest = Some(published.clone());
    }

    pub(super) fn draw(&self, frame: &mut Frame, summary: &WatchSummary, now_ns: u64) {
        let area = frame.area();
        let (width, height) = (usize::from(area.width), usize::from(area.height));
        let Some(published) = &self.latest else {
            let text = format!("{}: waiting for estimates, q quits", self.service);
            return frame.render_widget(Paragraph::new(text), area);
        };
        let record = &published.record;
        // a title above the vars, a line of monitors below
        let grid = Grid::of(record, width, height.saturating_sub(usize::from(HEADER) + 2));
        let heights =
            [Constraint::Length(HEADER), Constraint::Length(grid.height(record.mean.len())), Constraint::Min(1)];
        let [top, middle, bottom] = Layout::vertical(heights).areas(area);
        frame.render_widget(Paragraph::new(self.header(published, summary, now_ns)), top);
        frame.render_widget(Paragraph::new(vars(record, &grid)), middle);
        let lines = unwell(record, width, usize::from(bottom.height));
        frame.render_widget(Paragraph::new(lines.into_iter().map(Line::from).collect::<Vec<_>>()), bottom);
    }

    fn header(&self, published: &Published, summary: &WatchSummary, now_ns: u64) -> Vec<Line<'static>> {
        let Published { record, stamp } = published;
        let nis = record.nis_per_reading().map_or("-".to_owned(), |nis| format!("{nis:.2}"));
        let (rate, age) = (self.rate(), age(now_ns.saturating_sub(stamp.published_ns)));
        let rejected = record.readings(ReadingUse::Rejected);
        let first = format!("seq {}  {rate}  age {age}  nis/reading {nis}  rejected {rejected}", record.sequence);
        let WatchSummary { seen, lost, restarts } = summary;
        let (frames, refused, aside) = (record.frames, record.rejected_frames, record.remarked.put_aside_frames);
        let second = format!(
            "frames {frames}, {refused} refused, {aside} put aside  seen {seen}  lost {lost}  restarts {restarts}  q quits"
        );
        let third = format!("from {}: {}", stamp.publisher, record.names.machine);
        let mismatch = (record.mismatch == Some(true)).then_some("MISMATCH beyond noise");
        let alarm: String = mismatch.into_iter().chain(record.words()).map(|word| format!("{word}  ")).collect();
        let bold = Style::new().add_modifier(Modifier::BOLD);
        vec![
            Line::styled(first, bold),
            Line::from(second),
            Line::from(vec![Span::styled(alarm, bold.fg(STRONGER)), Span::from(third)]),
        ]
    }

    /// Rate of the last estimates, by their publication.
    fn rate(&self) -> String {
        let (first, last) = (self.stamps.front().copied().unwrap_or(0), self.stamps.back().copied().unwrap_or(0));
        let seconds = last.saturating_sub(first) as f64 * 1e-9;
        let periods = self.stamps.len().saturating_sub(1) as f64;
        if seconds > 0.0 { format!("{:.1} Hz", periods / seconds) } else { "- Hz".to_owned() }
    }
}

/// Vars down the columns, each with mean, sigma, deviation from 1, and a bar of it.
fn vars(record: &EstimateRecord, grid: &Grid) -> Vec<Line<'static>> {
    let Grid { columns, rows, width, name, shown } = *grid;
    let title = format!("{:<name$}{:>6}{:>6}{:>6}", "var", "mean", "sd/%", "dev");
    let title = Span::styled(format!("{title:<width$}").repeat(columns), Style::new().add_modifier(Modifier::DIM));
    let cells = |row| (row..shown).step_by(rows).flat_map(|i| cell(record, i, grid));
    let left_out = record.mean.len() - shown;
    let left_out = (left_out > 0).then(|| {
        let var = if left_out == 1 { "var" } else { "vars" };
        Line::from(format!("and {left_out} more {var}: enlarge the window, or --trace FILE"))
    });
    core::iter::once(Line::from(title)).chain((0..rows).map(|row| cells(row).collect())).chain(left_out).collect()
}

fn cell(record: &EstimateRecord, i: usize, grid: &Grid) -> [Span<'static>; 2] {
    let deviation = record.deviation(i);
    let style = Style::new().fg(if deviation < 0.0 { WEAKER } else { STRONGER });
    let style = if deviation.abs() < NOTABLE { Style::new() } else { style };
    let (name, mean, percent) = (&record.names.vars[i], record.mean[i], 100.0 * record.sigma[i]);
    let text = format!("{name:<0$}{mean:>6.4}{percent:>6.2}{deviation:>+6.1} ", grid.name);
    let room = grid.width.saturating_sub(grid.name + NUMBERS);
    let bar = bar(deviation, room.saturating_sub(1));
    [Span::styled(text, style), Span::styled(format!("{bar:<room$}"), style)]
}

/// Monitors that are not ok, with their noise, in this many lines; how many more there are.
fn unwell(record: &EstimateRecord, width: usize, height: usize) -> Vec<String> {
    let tell = |b: usize| {
        let (mm, rejected) = (1e3 * record.monitor_sigma[b], record.monitor_rejected[b]);
        let (name, state) = (&record.names.monitors[b], word(record.monitor_state[b]));
        format!("{name} {state} {mm:.2} mm ({rejected} rejected)")
    };
    let is_unwell = |b: &usize| record.monitor_state[*b] != MonitorState::Ok;
    let unwell: Vec<String> = (0..record.reading.len()).filter(is_unwell).map(tell).collect();
    if unwell.is_empty() {
        return vec!["all monitors ok".to_owned()];
    }
    let told = |count: usize| {
        let left_out = unwell.len() - count;
        let rest = (left_out > 0).then(|| format!("and {left_out} more monitors not ok"));
        lines(&unwell[..count].iter().cloned().chain(rest).collect::<Vec<_>>().join(", "), width)
    };
    (0..=unwell.len()).rev().map(told).find(|lines| lines.len() <= height).unwrap_or_default()
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
    use std::sync::Arc;

    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::*;
    use crate::record::Names;
    use crate::record::tests::record;
    use crate::sink::shared_memory::layout::Stamp;

    fn screen() -> Screen {
        Screen::new("orbitcal/estimate".to_owned())
    }

    fn drawn(screen: &Screen, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        let summary = WatchSummary { seen: 20, lost: 0, restarts: 1 };
        terminal.draw(|frame| screen.draw(frame, &summary, 2_012_000_000)).unwrap();
        terminal.backend().to_string()
    }

    /// The Booster, with its last var and its first monitor off.
    fn booster() -> EstimateRecord {
        let mut record = EstimateRecord { sequence: 345, frames: 346, nis: 34.65, ..record(48, 33) };
        record.names = Names::of(&twin::Ring::booster());
        record.sigma = vec![0.003; 48];
        record.mean[47] = 0.958;
        (record.monitor_state[0], record.monitor_sigma[0], record.monitor_rejected[0]) =
            (MonitorState::Noisy, 0.61e-3, 14);
        record
    }

    fn filled(record: &EstimateRecord) -> Screen {
        let mut screen = screen();
        for i in 0..=10 {
            let published_ns = 1_000_000_000 + 100_000_000 * i;
            let stamp = Stamp { publisher: "control room".into(), started_ns: 1, published_ns };
            screen.take(&Published { record: record.clone(), stamp });
        }
        screen
    }

    #[test]
    fn everything_of_the_booster_fits_on_eighty_by_twenty_four() {
        let text = drawn(&filled(&booster()), 80, 24);
        assert!(text.contains("seq 345  10.0 Hz  age 12 ms  nis/reading 1.05  rejected 0"), "{text}");
        assert!(text.contains("seen 20  lost 0  restarts 1"), "{text}");
        assert!(text.contains("from control room: AGS Booster"), "{text}");
        assert!(text.contains("F7 0.9580  0.30 -14.0"), "{text}");
        assert!(text.contains("x_A6 noisy 0.61 mm (14 rejected) "), "{text}");
        for name in twin::Ring::booster().var_names() {
            assert!(text.contains(&format!("{name} ")), "{name} is missing:\n{text}");
        }
        assert!(!text.contains("more"), "{text}");
    }

    #[test]
    fn what_is_cut_is_counted() {
        let mut record = record(260, 120);
        record.monitor_state = vec![MonitorState::Dead; 120];
        record.mismatch = Some(true);
        let text = drawn(&filled(&record), 80, 24);
        // 24 lines less three of header, the title, one of monitors and the count: 18 rows of three
        assert!(text.contains("and 206 more vars: enlarge the window, or --trace FILE"), "{text}");
        assert!(text.contains("V53 ") && !text.contains("V54 "), "{text}");
        assert!(text.contains("M0 dead 0.15 mm (0 rejected), and 119 more monitors not ok"), "{text}");
        assert!(text.contains("MISMATCH beyond noise  from control room: test ring"), "{text}");
    }

    #[test]
    fn long_names_keep_their_numbers() {
        let mut record = record(4, 2);
        let vars = (0..4).map(|i| format!("SR01_QUAD_{i}")).collect();
        record.names = Arc::new(Names { vars, ..(*record.names).clone() });
        assert!(drawn(&filled(&record), 80, 24).contains("SR01_QUAD_3 1.0000  1.00  +0.0"));
    }

    #[test]
    fn no_size_is_too_small_or_too_large() {
        for (width, height) in [(1, 1), (20, 5), (80, 24), (200, 60), (400, 10)] {
            for record in [booster(), record(0, 0), record(260, 500)] {
                drawn(&filled(&record), width, height);
            }
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
