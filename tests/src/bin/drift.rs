//! `docs/drift.md`: how a stream is followed, and how soon steps are found.

use core::error::Error;
use core::fmt::Write as _;
use std::process::ExitCode;
use std::thread;

use inference::stream::{FOLLOW, Walk};
use report::{Axes, Figure, Series};
use system_tests::drift::{self, Changes, Course, Followed, Stream};
use system_tests::repository;
use twin::Ring;

/// Streams of each size of step.
const STREAMS: u64 = 16;
/// Frames of each; the step comes at 0.6 of them.
const FRAMES: usize = 1500;
/// Frames in which the core finds out where the vars are: they do not count.
const START: usize = 300;
/// Evidence at which a step would be called found [nat]; the last one is the core's.
const THRESHOLDS: [f32; 4] = [6.0, 8.0, 10.0, 12.0];
const STEPS: [f64; 4] = [0.01, 0.02, 0.03, 0.04];
/// Alarms closer than this are one [frames].
const APART: usize = 100;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("drift: {error}");
            ExitCode::from(1)
        }
    }
}

fn run() -> Result<(), Box<dyn Error>> {
    let ring = Ring::paper_booster();
    let committed = Stream::committed(&ring)?;
    let followed = drift::follow(&ring, &committed)?;
    std::fs::write(repository("docs/figures/drift-stream.svg"), figure(&ring, &committed, &followed).svg)?;
    let quiet = streams(&ring, 1000, |_| Changes::default())?;
    let mut table = String::from("| evidence | false alarms in 1000 frames |");
    STEPS.iter().try_for_each(|step| write!(table, " {:.0} % step |", 100.0 * step))?;
    table.push_str("\n|---|---|---|---|---|---|\n");
    let stepped: Vec<Vec<Run>> = (2000..)
        .step_by(1000)
        .zip(STEPS)
        .map(|(seed, by)| streams(&ring, seed, move |sign| Changes(vec![(sign.0, Course::Steps(0.6, by * sign.1))])))
        .collect::<Result<_, _>>()?;
    for threshold in THRESHOLDS {
        let alarms: usize = quiet.iter().map(|run| alarms(&run.followed[START..], threshold)).sum();
        let frames = quiet.len() * (FRAMES - START);
        write!(table, "| {threshold} nat | {:.2} |", 1000.0 * alarms as f64 / frames as f64)?;
        for runs in &stepped {
            write!(table, " {} |", delays(runs, threshold))?;
        }
        table.push('\n');
    }
    let named: Vec<bool> = stepped.iter().flatten().filter_map(Run::is_named).collect();
    let right = named.iter().filter(|right| **right).count();
    println!("{table}\nlet loose as the most probable one: right in {right} of {}", named.len());
    let walks = table_of_walks(&ring)?;
    println!("{walks}");
    renew("| evidence |", &table)?;
    renew("| what happens in ten minutes |", &walks)
}

/// Put a table in the place of the one in `docs/drift.md` that begins like this.
fn renew(begins: &str, table: &str) -> Result<(), Box<dyn Error>> {
    let text = std::fs::read_to_string(repository("docs/drift.md"))?;
    let (before, rest) = text.split_once(begins).ok_or("docs/drift.md has no such table")?;
    let (_, after) = rest.split_once("\n\n").ok_or("docs/drift.md ends with its table")?;
    Ok(std::fs::write(repository("docs/drift.md"), format!("{before}{table}\n{after}"))?)
}

/// Walks of the vars that are compared, in the root of a second; the first one is what `replay --follow` has.
const WALKS: [f32; 3] = [FOLLOW.params, 2.5e-4, 3.5e-4];
/// Streams of each kind that they are compared in, and frames of each: ten minutes.
const WALKED: (u64, usize) = (4, 3000);
/// Quadrupoles of one supply: the first 24, half-cells of even number.
const SUPPLY: usize = 24;

/// What vars do in ten minutes; two of them are drawn, and a direction.
type Kind = (&'static str, fn([usize; 2], f64) -> Vec<(usize, Course)>);

const KINDS: [Kind; 7] = [
    ("one var drifts by 3 %, another steps by 2 %", |[one, other], sign| {
        vec![(one, Course::Drifts(0.03 * sign)), (other, Course::Steps(0.6, 0.02 * sign))]
    }),
    ("two vars drift by 3 %", |vars, sign| vars.map(|var| (var, Course::Drifts(0.03 * sign))).into()),
    ("one drifts by 1 %", |[one, _], sign| vec![(one, Course::Drifts(0.01 * sign))]),
    ("one drifts by 6 %", |[one, _], sign| vec![(one, Course::Drifts(0.06 * sign))]),
    ("one swings by 1.5 % twice", |[one, _], sign| vec![(one, Course::Swings(0.015 * sign))]),
    ("all vars of a supply drift by 1 %", |_, sign| {
        (0..SUPPLY).map(|var| (var, Course::Drifts(0.01 * sign))).collect()
    }),
    ("nothing", |_, _| Vec::new()),
];

/// Share of the frames in which vars that change are outside 3 sigma, NEES over their number, mean error bar of the vars that stay.
fn table_of_walks(ring: &Ring) -> Result<String, Box<dyn Error>> {
    let mut table = String::from("| what happens in ten minutes |");
    WALKS.iter().try_for_each(|walk| write!(table, " walk {walk:.1e} |"))?;
    table.push_str("\n|---|---|---|---|\n");
    let rows = thread::scope(|scope| {
        let rows: Vec<_> =
            (5000..).step_by(1000).zip(&KINDS).map(|(seed, kind)| scope.spawn(move || row(ring, seed, kind))).collect();
        rows.into_iter().map(|row| row.join().expect("no row panics")).collect::<Result<Vec<_>, String>>()
    })?;
    rows.iter().for_each(|row| table.push_str(row));
    Ok(table)
}

fn row(ring: &Ring, seed: u64, (name, change): &Kind) -> Result<String, String> {
    let (streams, frames) = WALKED;
    let streams: Vec<Stream> = (seed..seed + streams)
        .map(|seed| {
            Stream::simulated(ring, seed, frames, |random| {
                let one = random.below(48);
                let other = (one + 1 + random.below(47)) % 48;
                Changes(change([one, other], if random.below(2) == 0 { 1.0 } else { -1.0 }))
            })
        })
        .collect::<Result<_, _>>()
        .map_err(|error| error.to_string())?;
    let cells = WALKS.map(|params| cell(ring, &streams, Walk { params, ..FOLLOW }));
    let cells = cells.into_iter().collect::<Result<Vec<_>, _>>().map_err(|error| error.to_string())?;
    Ok(format!("| {name} | {} |\n", cells.join(" | ")))
}

fn cell(ring: &Ring, streams: &[Stream], walk: Walk) -> Result<String, Box<dyn Error>> {
    let (mut outside, mut nees, mut sigma) = (Vec::new(), Vec::new(), Vec::new());
    for stream in streams {
        let followed = drift::follow_with(ring, stream, walk)?;
        outside.extend(stream.changes.0.iter().map(|(var, _)| drift::outside(stream, &followed, *var)));
        nees.extend(followed.iter().skip(500).filter_map(|f| f.nees));
        sigma.push(drift::mean_sigma(stream, &followed));
    }
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let outside = if outside.is_empty() { "-".into() } else { format!("{:.1} %", 100.0 * mean(&outside)) };
    let sigma = if sigma.iter().all(|sigma| sigma.is_finite()) { mean(&sigma) } else { f64::NAN };
    Ok(format!("{outside}, {:.2}, {:.2} %", mean(&nees), 100.0 * sigma))
}

/// A stream, and how it was followed.
struct Run {
    stream: Stream,
    followed: Vec<Followed>,
}

impl Run {
    /// Frames from the step until the evidence suffices.
    fn delay(&self, threshold: f32) -> Option<usize> {
        let at = self.stream.step()?;
        self.followed[at..].iter().position(|f| f.evidence > threshold || f.let_loose.is_some())
    }

    /// Whether the var that was let loose as the most probable one is the one.
    fn is_named(&self) -> Option<bool> {
        let at = self.stream.step()?;
        Some(self.followed[at..].iter().find_map(|f| f.let_loose)? == self.stream.changes.0[0].0)
    }
}

/// Streams in which any var does this, in either direction.
fn streams(
    ring: &Ring,
    seed: u64,
    change: impl Fn((usize, f64)) -> Changes + Copy,
) -> Result<Vec<Run>, Box<dyn Error>> {
    (seed..seed + STREAMS)
        .map(|seed| {
            let stream = Stream::simulated(ring, seed, FRAMES, |random| {
                change((random.below(48), if random.below(2) == 0 { 1.0 } else { -1.0 }))
            })?;
            Ok(Run { followed: drift::follow(ring, &stream)?, stream })
        })
        .collect()
}

/// How often the evidence suffices where nothing has stepped.
fn alarms(followed: &[Followed], threshold: f32) -> usize {
    let (mut count, mut last) = (0, None);
    for (k, _) in followed.iter().enumerate().filter(|(_, f)| f.evidence > threshold || f.let_loose.is_some()) {
        count += usize::from(last.is_none_or(|last| k - last > APART));
        last = Some(k);
    }
    count
}

/// Median delay, that which nine in ten do not exceed, and how many were found.
fn delays(runs: &[Run], threshold: f32) -> String {
    let mut all: Vec<usize> = runs.iter().map(|run| run.delay(threshold).unwrap_or(usize::MAX)).collect();
    all.sort_unstable();
    let quantile = |p: f64| match all[((all.len() - 1) as f64 * p).round() as usize] {
        usize::MAX => "not found".into(),
        delay => (delay + 1).to_string(),
    };
    format!("{}, {}", quantile(0.5), quantile(0.9))
}

/// Truth, estimate and band of the vars that change, and of one that stays.
fn figure(ring: &Ring, stream: &Stream, followed: &[Followed]) -> Figure {
    let axes =
        Axes::new("A stream of ten minutes: estimates with bands of 2 sigma, and the truth", "time [s]", "var [1]");
    let at = |frame: usize| stream.recording.rows[frame].time;
    let axes = axes.marked(stream.step().map(|step| (at(step), "C3 steps".to_owned())).into_iter().collect());
    let names = ring.var_names();
    let shown: Vec<usize> =
        ["D8", "C3", "A5"].iter().filter_map(|name| names.iter().position(|var| var == name)).collect();
    let frames: Vec<usize> = (50..followed.len()).step_by(10).collect();
    let time: Vec<f64> = frames.iter().map(|k| stream.recording.rows[*k].time).collect();
    let mut series: Vec<Series> = Vec::new();
    for var in &shown {
        let mean: Vec<f64> = frames.iter().map(|k| followed[*k].mean[*var]).collect();
        let band = |k: &usize| {
            (
                followed[*k].mean[*var] - 2.0 * followed[*k].sigma[*var],
                followed[*k].mean[*var] + 2.0 * followed[*k].sigma[*var],
            )
        };
        series.push(Series::line(&names[*var], time.clone(), mean).within(frames.iter().map(band).collect()));
    }
    for var in &shown {
        let truth = frames.iter().map(|k| stream.vars(*k)[*var]).collect();
        series.push(Series::line(&format!("{}, truth", names[*var]), time.clone(), truth));
    }
    Figure::lines(&axes, &series)
}
