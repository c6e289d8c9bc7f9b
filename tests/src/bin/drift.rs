//! `docs/drift.md`: how a stream is followed, and how soon steps are found.

use core::error::Error;
use core::fmt::Write as _;
use std::process::ExitCode;

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
    let ring = Ring::booster();
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
    let text = std::fs::read_to_string(repository("docs/drift.md"))?;
    let (before, rest) = text.split_once("| evidence |").ok_or("docs/drift.md has no table")?;
    let (_, after) = rest.split_once("\n\n").ok_or("docs/drift.md ends with its table")?;
    std::fs::write(repository("docs/drift.md"), format!("{before}{table}\n{after}"))?;
    Ok(())
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
