//! The live table: who publishes, a grid of vars, and the monitors that are not well. What does not fit is counted.

use std::collections::VecDeque;

use estimator::{FitQuality, MonitorState};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::Paragraph;
use results::output::lines;
use results::{EstimateRecord, ReadingUse, state_word};
use shared_memory::{HealthRecord, Published};

use super::{WatchSummary, band, ill};

/// Lines above the grid.
const HEADER: u16 = 3;
/// Width of mean, sigma, deviation and a gap.
const NUMBERS: usize = 19;
/// Narrowest band with its gap.
const BAND: usize = 12;
/// Widest band with its gap.
const WIDEST_BAND: usize = 44;
/// Lines for the instruments that are not ok, where there is room.
const ILL: usize = 6;
/// Deviation from which a var stands out [sigmas].
const NOTABLE: f32 = 2.0;
/// Weaker than nominal: sky blue; stronger: orange. Told apart with any colour vision, and by the sign as well.
const WEAKER: Color = Color::Indexed(74);
/// See [`WEAKER`].
const STRONGER: Color = Color::Indexed(214);
/// Points of a trend.
const TREND: usize = 60;
/// Estimates over which the rate is taken.
const RATE_OVER: usize = 64;

/// What is on the screen.
pub(super) struct Screen {
    service: String,
    latest: Option<Published>,
    /// Publication times of the last estimates of one publisher [ns].
    stamps: VecDeque<u64>,
    /// Of its monitors and correctors, and the names of these.
    health: Option<(HealthRecord, Vec<String>)>,
    /// Rate, and chi-square per degree of freedom, once a second.
    trend: VecDeque<[f64; 2]>,
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
    /// As many columns as have room for bands; without bands, if that shows all vars; and no more vars than fit.
    fn of(record: &EstimateRecord, width: usize, height: usize) -> Self {
        let vars = record.mean.len();
        let name = 1 + record.names.vars.iter().map(|name| name.chars().count()).max().unwrap_or(0);
        let cell = name + NUMBERS;
        let with_bands = (width / (cell + BAND)).max(1);
        let columns = if vars.div_ceil(with_bands) <= height { with_bands } else { (width / cell).max(1) };
        let is_whole = vars.div_ceil(columns) <= height;
        let rows = if is_whole { vars.div_ceil(columns) } else { height.saturating_sub(1) };
        Self { columns, rows, width: (width / columns).min(cell + WIDEST_BAND), name, shown: vars.min(rows * columns) }
    }

    /// Columns for a band and its gap; none where they are too few.
    fn room(&self) -> usize {
        let room = self.width.saturating_sub(self.name + NUMBERS);
        if room < BAND { 0 } else { room }
    }

    /// Lines with the title, and the count of what is left out.
    fn height(&self, vars: usize) -> u16 {
        (1 + self.rows + usize::from(self.shown < vars)) as u16
    }
}

impl Screen {
    pub(super) fn new(service: String) -> Self {
        Self { service, latest: None, stamps: VecDeque::new(), health: None, trend: VecDeque::new() }
    }

    /// Health as it came last.
    pub(super) fn take_health(&mut self, health: HealthRecord, correctors: Vec<String>) {
        self.health = Some((health, correctors));
    }

    /// A second has gone by.
    pub(super) fn tick(&mut self) {
        let fit =
            self.health.as_ref().map(|(health, _)| health.fit.chi_square / health.fit.degrees_of_freedom.max(1.0));
        if let Some(fit) = fit {
            if self.trend.len() == TREND {
                self.trend.pop_front();
            }
            self.trend.push_back([self.hertz().unwrap_or(0.0), f64::from(fit)]);
        }
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
        // a title above the vars, a line of monitors below; more of them where there is room
        let least = height.saturating_sub(usize::from(HEADER) + 2);
        let grid = Grid::of(record, width, least.saturating_sub(ILL));
        let grid = if grid.shown < record.mean.len() { Grid::of(record, width, least) } else { grid };
        let heights =
            [Constraint::Length(HEADER), Constraint::Length(grid.height(record.mean.len())), Constraint::Min(1)];
        let [top, middle, bottom] = Layout::vertical(heights).areas(area);
        frame.render_widget(Paragraph::new(self.header(published, summary, now_ns)), top);
        frame.render_widget(Paragraph::new(vars(record, &grid)), middle);
        let lines = self.below(record, width, usize::from(bottom.height));
        frame.render_widget(Paragraph::new(lines.into_iter().map(Line::from).collect::<Vec<_>>()), bottom);
    }

    /// Instruments that are not ok, and how rate and fit went where there is room.
    fn below(&self, record: &EstimateRecord, width: usize, height: usize) -> Vec<String> {
        let Some((health, correctors)) = &self.health else { return unwell(record, width, height) };
        let trends = if height >= 4 { self.trends() } else { Vec::new() };
        let gap = usize::from(height > trends.len() + 2);
        let mut lines = vec![String::new(); gap];
        lines.extend(ill::lines(record, health, correctors, height - trends.len() - gap));
        lines.extend(trends);
        lines
    }

    /// The last minute.
    fn trends(&self) -> Vec<String> {
        let line = |what: &str, which: usize| {
            let values: Vec<f64> = self.trend.iter().map(|point| point[which]).collect();
            let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
            format!("{what:<10} {} {low:.3} to {high:.3}", sparks(&values, low, high))
        };
        if self.trend.len() < 2 { Vec::new() } else { vec![line("rate/Hz", 0), line("chi2/dof", 1)] }
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
        let fit = self.health.as_ref().map_or(String::new(), |(health, _)| {
            let FitQuality { chi_square, degrees_of_freedom } = health.fit;
            let (ratio, excess) = (chi_square / degrees_of_freedom.max(1.0), health.fit.excess());
            format!("  chi2/dof {ratio:.3} ({excess:+.1} sigma)")
        });
        let third = format!("from {}: {}{fit}", stamp.publisher, record.names.machine);
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
        self.hertz().map_or_else(|| "- Hz".to_owned(), |hertz| format!("{hertz:.1} Hz"))
    }

    fn hertz(&self) -> Option<f64> {
        let (first, last) = (self.stamps.front().copied().unwrap_or(0), self.stamps.back().copied().unwrap_or(0));
        let seconds = last.saturating_sub(first) as f64 * 1e-9;
        let periods = self.stamps.len().saturating_sub(1) as f64;
        (seconds > 0.0).then(|| periods / seconds)
    }
}

/// Vars down the columns, each with mean, sigma, deviation from 1, and its band against nominal.
fn vars(record: &EstimateRecord, grid: &Grid) -> Vec<Line<'static>> {
    let Grid { columns, rows, width, name, shown } = *grid;
    let reach = band::reach(record);
    let title = format!("{:<name$}{:>6}{:>6}{:>6} ", "var", "mean", "sd/%", "dev");
    let title = match grid.room().checked_sub(13) {
        Some(more) => format!("{title}{:<1$.3}1{2:>1$.3} ", 1.0 - reach, 5 + more / 2, 1.0 + reach),
        None => title,
    };
    let title = Span::styled(format!("{title:<width$}").repeat(columns), Style::new().add_modifier(Modifier::DIM));
    let cells = |row| (row..shown).step_by(rows).flat_map(|i| cell(record, i, grid, reach));
    let left_out = record.mean.len() - shown;
    let left_out = (left_out > 0).then(|| {
        let var = if left_out == 1 { "var" } else { "vars" };
        Line::from(format!("and {left_out} more {var}: enlarge the window, or --trace FILE"))
    });
    core::iter::once(Line::from(title)).chain((0..rows).map(|row| cells(row).collect())).chain(left_out).collect()
}

fn cell(record: &EstimateRecord, i: usize, grid: &Grid, reach: f32) -> [Span<'static>; 2] {
    let deviation = record.deviation(i);
    let style = Style::new().fg(if deviation < 0.0 { WEAKER } else { STRONGER });
    let style = if deviation.abs() < NOTABLE { Style::new() } else { style };
    let (name, mean, percent) = (&record.names.vars[i], record.mean[i], 100.0 * record.sigma[i]);
    let text = format!("{name:<0$}{mean:>6.4}{percent:>6.2}{deviation:>+6.1} ", grid.name);
    let room = grid.room();
    let band = band::band(mean, record.sigma[i], reach, room.saturating_sub(1));
    [Span::styled(text, style), Span::styled(format!("{band:<room$}"), style)]
}

/// Monitors that are not ok, with their noise, in this many lines; how many more there are.
fn unwell(record: &EstimateRecord, width: usize, height: usize) -> Vec<String> {
    let tell = |b: usize| {
        let (mm, rejected) = (1e3 * record.monitor_sigma[b], record.monitor_rejected[b]);
        let (name, state) = (&record.names.monitors[b], state_word(record.monitor_state[b]));
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

/// Values as a line of bars between two ends.
fn sparks(values: &[f64], low: f64, high: f64) -> String {
    const BARS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let share = |value: &f64| if high > low { (value - low) / (high - low) } else { 0.5 };
    values.iter().map(|value| BARS[((share(value) * 8.0) as usize).min(7)]).collect()
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
    use results::Names;
    use shared_memory::{Condition, Stamp, State};

    use super::*;

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
        let mut record = EstimateRecord { sequence: 345, frames: 346, nis: 34.65, ..EstimateRecord::example(48, 33) };
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
        let mut record = EstimateRecord::example(260, 120);
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
        let mut record = EstimateRecord::example(4, 2);
        let vars = (0..4).map(|i| format!("SR01_QUAD_{i}")).collect();
        record.names = Arc::new(Names { vars, ..(*record.names).clone() });
        assert!(drawn(&filled(&record), 80, 24).contains("SR01_QUAD_3 1.0000  1.00  +0.0"));
    }

    #[test]
    fn no_size_is_too_small_or_too_large() {
        for (width, height) in [(1, 1), (20, 5), (80, 24), (200, 60), (400, 10)] {
            for record in [booster(), EstimateRecord::example(0, 0), EstimateRecord::example(260, 500)] {
                drawn(&filled(&record), width, height);
            }
            drawn(&screen(), width, height);
        }
    }

    #[test]
    fn with_room_there_are_bands_health_and_trends() {
        let mut screen = filled(&booster());
        let ok = Condition { state: State::Ok, ratios: [1.0, 0.0, 0.0] };
        let mut monitors = vec![ok; 33];
        monitors[4] = Condition { state: State::Dead, ratios: [1.0, 0.0, 1.0] };
        let fit = FitQuality { chi_square: 990.0, degrees_of_freedom: 1000.0 };
        let health = HealthRecord { sequence: 345, frames: 346, fit, monitors, correctors: vec![ok; 48] };
        screen.take_health(health, twin::Ring::booster().corrector_names());
        (0..70).for_each(|_| screen.tick());
        let text = drawn(&screen, 120, 40);
        assert!(text.contains("chi2/dof 0.990 (-0.2 sigma)"), "{text}");
        assert!(text.contains("dead   missing or without effect in 100 % of its frames"), "{text}");
        assert!(text.contains("F7 0.9580  0.30 -14.0 ") && text.contains("●"), "{text}");
        assert!(text.contains("rate/Hz    ▅") && text.contains("10.000 to 10.000"), "{text}");
        for (width, height) in [(1, 1), (80, 24), (90, 30), (400, 10)] {
            drawn(&screen, width, height);
        }
    }

    #[test]
    fn a_trend_goes_from_the_lowest_to_the_highest() {
        assert_eq!(sparks(&[0.0, 1.0, 0.5], 0.0, 1.0), "▁█▅");
        assert_eq!(sparks(&[2.0], 2.0, 2.0), "▅");
    }
}
