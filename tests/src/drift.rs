//! Streams of machines whose vars drift or step, by the exact twin, and how the core follows them.

use core::error::Error;

use estimator::booster::{Estimator, Green, PARAMS, Setup};
use estimator::{Model, Prepared};
use inference::Recording;
use inference::simulate::{self, Beyond, Hardware, Truth};
use inference::stream::{self, FOLLOW, Walk};
use twin::{Cycle, Ring};

use crate::machine::{LAYOUT, Random, nees};
use crate::{repository, truth};

/// What becomes of a var.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Course {
    /// It drifts from the first frame to the last, by so much of itself.
    Drifts(f64),
    /// It steps at this share of the stream, by so much of itself.
    Steps(f64, f64),
    /// It swings to and fro by so much of itself, twice.
    Swings(f64),
}

impl Course {
    /// Factor on the var at a share of the stream.
    fn factor(self, time: f64) -> f64 {
        match self {
            Self::Drifts(by) => 1.0 + by * time,
            Self::Steps(at, by) => 1.0 + if time >= at { by } else { 0.0 },
            Self::Swings(by) => 1.0 + by * (2.0 * core::f64::consts::TAU * time).sin(),
        }
    }
}

/// Vars, by index, that change.
#[derive(Debug, Clone, Default)]
pub struct Changes(pub Vec<(usize, Course)>);

impl Changes {
    /// The vars at a share of the stream, from those at its start.
    fn vars(&self, start: &[f64], time: f64) -> Vec<f64> {
        let mut vars = start.to_vec();
        self.0.iter().for_each(|(var, course)| vars[*var] *= course.factor(time));
        vars
    }
}

impl Beyond for Changes {
    fn alter_cycles(&self, cycles: &mut [Cycle]) {
        let frames = cycles.len() as f64;
        for (k, cycle) in cycles.iter_mut().enumerate() {
            for (var, course) in &self.0 {
                cycle.strength[*var] += course.factor(k as f64 / frames).ln();
            }
        }
    }
}

/// Vars that a machine may have: those within the prior's range, with room to the ends.
const RANGE: core::ops::Range<f64> = 0.945..1.055;

/// A stream whose truth is known.
#[derive(Debug, Clone)]
pub struct Stream {
    /// Its frames.
    pub recording: Recording,
    /// What is true of it.
    pub changes: Changes,
    start: Vec<f64>,
}

impl Stream {
    /// The stream that comes with the repository.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn committed(ring: &Ring) -> Result<Self, Box<dyn Error>> {
        let at = |name: &str| ring.var_names().iter().position(|var| var == name).ok_or("a var of the ring");
        let changes = vec![(at("D8")?, Course::Drifts(0.03)), (at("C3")?, Course::Steps(0.6, -0.02))];
        Ok(Self {
            recording: Recording::read(&repository("recordings/drift-stream"), ring)?,
            changes: Changes(changes),
            start: truth("recordings/drift-stream", ring),
        })
    }

    /// Another one of so many frames: the settings of that one in another order, vars drawn from the prior, a misaligned machine.
    ///
    /// # Errors
    /// If the committed one cannot be read.
    pub fn simulated(
        ring: &Ring,
        seed: u64,
        frames: usize,
        change: impl Fn(&mut Random) -> Changes,
    ) -> Result<Self, Box<dyn Error>> {
        let mut random = Random::new(seed);
        let mut template = Recording::read(&repository("recordings/drift-stream"), ring)?;
        template.rows.truncate(frames);
        shuffle(&mut template, &mut random);
        loop {
            let start = simulate::vars(ring, true, random.below(1 << 30) as u64)?;
            let changes = change(&mut random);
            let ends = changes.vars(&start, 1.0);
            if !changes.0.iter().all(|(var, _)| RANGE.contains(&start[*var]) && RANGE.contains(&ends[*var])) {
                continue;
            }
            let noise = template.header.noise.clone();
            let hardware = Hardware { jumps: vec![], noise, ..Hardware::shipped(ring, &template) };
            let known = Truth { vars: &start, beyond: &[&changes], effects: &[] };
            // a machine that loses its beam on the way is drawn anew
            if let Ok(recording) = simulate::campaign(&template, ring, &known, &hardware, random.below(1 << 30) as u64)
            {
                return Ok(Self { recording, changes, start });
            }
        }
    }

    /// True vars in a frame.
    pub fn vars(&self, frame: usize) -> Vec<f64> {
        self.changes.vars(&self.start, frame as f64 / self.recording.rows.len() as f64)
    }

    /// The first frame after a var has stepped.
    pub fn step(&self) -> Option<usize> {
        let at = |(_, course): &(usize, Course)| match course {
            Course::Steps(at, _) => Some((at * self.recording.rows.len() as f64).ceil() as usize),
            Course::Drifts(_) | Course::Swings(_) => None,
        };
        self.changes.0.iter().find_map(at)
    }
}

/// Give each frame the setting of another.
fn shuffle(recording: &mut Recording, random: &mut Random) {
    for i in (1..recording.rows.len()).rev() {
        let j = random.below(i + 1);
        let (before, after) = recording.rows.split_at_mut(i);
        if let (Some(one), Some(other)) = (before.get_mut(j), after.first_mut()) {
            core::mem::swap(&mut one.correctors, &mut other.correctors);
            core::mem::swap(&mut one.corrector_current, &mut other.corrector_current);
        }
    }
}

/// The core after a frame, beside the truth.
#[derive(Debug, Clone)]
pub struct Followed {
    /// Means of the vars.
    pub mean: Vec<f64>,
    /// Their standard deviations.
    pub sigma: Vec<f64>,
    /// The var that was let loose.
    pub let_loose: Option<usize>,
    /// Evidence for a step, before that [nat].
    pub evidence: f32,
    /// NEES over the number of vars; every hundredth frame.
    pub nees: Option<f64>,
}

/// The core of the Booster, as the daemon sets it up, on a stream.
///
/// # Errors
/// If there is no core for it.
///
/// # Panics
/// If it refuses a frame.
pub fn follow(ring: &Ring, stream: &Stream) -> Result<Vec<Followed>, Box<dyn Error>> {
    follow_with(ring, stream, FOLLOW)
}

/// The same with another walk.
///
/// # Errors
/// If there is no core for it.
///
/// # Panics
/// If it refuses a frame.
pub fn follow_with(ring: &Ring, stream: &Stream, walk: Walk) -> Result<Vec<Followed>, Box<dyn Error>> {
    let recording = &stream.recording;
    let core = stream::estimator(ring, recording, walk)?;
    let (mut surrogate, setup): (_, Setup) = (Box::new(Green::BLANK), core.setup.in_room(&LAYOUT));
    core.tables.fill(&mut *surrogate)?;
    let model = Model { surrogate: &*surrogate, setup: &setup };
    let mut core = Box::new(Estimator::BLANK);
    core.restart(&model).map_err(|_| "the design has no stable ring")?;
    let each = recording.rows.iter().enumerate();
    each.map(|(k, row)| {
        while core.prepare(&model) != Prepared::Nothing {}
        let estimate = core.ingest(&model, &mut stream::wire(recording, row)?).expect("a good frame");
        let vars = stream.vars(k);
        let error = core::array::from_fn::<_, PARAMS, _>(|i| f64::from(estimate.map_params[i]) - vars[i].ln());
        let nees = (k % 100 == 99).then(|| nees(&error, |i, j| core.covariance(i, j)) / PARAMS as f64);
        Ok(Followed {
            mean: estimate.mean.map(f64::from).to_vec(),
            sigma: estimate.sigma.map(f64::from).to_vec(),
            let_loose: estimate.remarks.let_loose.map(usize::from),
            evidence: core.step_evidence(&model),
            nees,
        })
    })
    .collect()
}

/// Frames after a step in which a var need not be within its band.
pub const GRACE: usize = 60;

/// Share of the frames in which a var is outside 3 sigma, the first ones after a step apart.
pub fn outside(stream: &Stream, followed: &[Followed], var: usize) -> f64 {
    let free = stream.step().map_or(0..0, |at| at..at + GRACE);
    let is_out = |(k, f): &(usize, &Followed)| {
        !free.contains(k) && (f.mean[var] - stream.vars(*k)[var]).abs() > 3.0 * f.sigma[var]
    };
    followed.iter().enumerate().filter(is_out).count() as f64 / followed.len() as f64
}

/// Mean standard deviation of the vars that stay, over all frames from the 500th on.
pub fn mean_sigma(stream: &Stream, followed: &[Followed]) -> f64 {
    let stays = |var: &usize| stream.changes.0.iter().all(|(changed, _)| changed != var);
    let vars: Vec<usize> = (0..PARAMS).filter(stays).collect();
    let late = &followed[500.min(followed.len())..];
    let sum: f64 = late.iter().flat_map(|f| vars.iter().map(|var| f.sigma[*var])).sum();
    sum / (late.len() * vars.len()) as f64
}
