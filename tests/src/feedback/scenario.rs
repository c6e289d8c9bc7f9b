//! What happens to the machine of a loop, and when.

use core::error::Error;
use core::fmt;
use core::ops::Range;

use estimator::booster::{CORRECTORS, PARAMS};
use twin::Ring;

use super::Plant;
use crate::machine::Random;

/// Something that happens at a frame, or lasts for some.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A quadrupole moves in x and y [m].
    Moves(usize, [f64; 2]),
    /// A var changes by a factor.
    Steps(usize, f64),
    /// A corrector's current stays as it is.
    Sticks(usize, u32),
    /// No beam.
    Lost(u32),
    /// Monitors do not report.
    Silent(Vec<usize>, u32),
    /// The beam is off momentum.
    Momentum(f64, u32),
    /// Cycles without a frame.
    Gap(u32),
}

/// A run of a loop.
#[derive(Debug, Clone)]
pub struct Scenario {
    /// Of the machine and what happens to it.
    pub seed: u64,
    /// Of the noise of its monitors and correctors: runs that differ by it alone tell what is chance.
    pub noise: u64,
    /// How long it is.
    pub frames: u32,
    /// Frames of a campaign before the feedback is switched on: each corrector in turn, up and down.
    pub campaign: u32,
    /// Random walk of each `ln var` a frame.
    pub walk: f64,
    /// Random walk of each quadrupole's position [m] a frame.
    pub ground: f64,
    /// The front end counts particles.
    pub counts: bool,
    /// What happens, and at which frame.
    pub events: Vec<(u32, Event)>,
}

/// A campaign with each corrector up and down, and one frame without.
const CAMPAIGN: u32 = 2 * CORRECTORS as u32 + 1;
/// Frames between moves of the quadrupoles.
const MOVES: u32 = 4;

impl Scenario {
    /// Nothing happens but drift.
    pub fn quiet(seed: u64, frames: u32) -> Self {
        let events = Vec::new();
        Self {
            seed,
            noise: seed + 1_000_003,
            frames,
            campaign: CAMPAIGN,
            walk: 1e-5,
            ground: 2e-7,
            counts: true,
            events,
        }
    }

    /// One of everything, at places drawn from the seed.
    pub fn of_everything(seed: u64) -> Self {
        let mut random = Random::new(seed + 7);
        let mut either = |size: f64| if random.below(2) == 0 { size } else { -size };
        let sizes = [either(4e-4), either(4e-4), either(2e-4), either(2e-4), either(0.03), either(5e-4)];
        let mut place = |among| random.below(among);
        let (moved, moved_meanwhile, var) = (place(PARAMS), place(PARAMS), place(PARAMS));
        let (corrector, silent) = (place(CORRECTORS), vec![place(15), 15 + place(18)]);
        let events = vec![
            (300, Event::Moves(moved, [sizes[0], sizes[1]])),
            (450, Event::Steps(var, 1.0 + sizes[4])),
            (600, Event::Sticks(corrector, 200)),
            (650, Event::Moves(moved_meanwhile, [sizes[2], sizes[3]])),
            (850, Event::Lost(10)),
            (950, Event::Silent(silent, 150)),
            (1150, Event::Momentum(sizes[5], 100)),
            (1350, Event::Gap(100)),
        ];
        Self { events, ..Self::quiet(seed, 1450) }
    }

    /// A lost beam, and a corrector that sticks while the orbit moves, in a few frames.
    pub fn of_faults(seed: u64) -> Self {
        let events = vec![(60, Event::Lost(6)), (80, Event::Sticks(30, 40)), (82, Event::Moves(11, [4e-4, -4e-4]))];
        Self { campaign: 20, events, ..Self::quiet(seed, 130) }
    }

    /// What a stretch of frames shows: from the first frame with feedback, and from each event on, to the next.
    pub fn stretches(&self) -> Vec<(String, Range<usize>)> {
        let begin = (self.campaign, "feedback is switched on".to_owned());
        let starts: Vec<_> =
            [begin].into_iter().chain(self.events.iter().map(|(at, e)| (*at, e.to_string()))).collect();
        let ends = starts.iter().skip(1).map(|(at, _)| *at).chain([self.frames]);
        starts.iter().zip(ends).map(|((from, name), to)| (name.clone(), *from as usize..to as usize)).collect()
    }

    fn during(&self, frame: u32) -> impl Iterator<Item = &Event> {
        self.events.iter().filter(move |(at, event)| event.span(*at).contains(&frame)).map(|(_, event)| event)
    }

    pub(super) fn disturb(&self, frame: u32, plant: &mut Plant, random: &mut Random) -> Result<(), Box<dyn Error>> {
        plant.params.iter_mut().for_each(|theta| *theta += self.walk * random.normal());
        if frame.is_multiple_of(MOVES) {
            let size = self.ground * f64::from(MOVES).sqrt();
            (0..PARAMS).for_each(|q| plant.move_quadrupole(q, [size * random.normal(), size * random.normal()]));
        }
        for (_, event) in self.events.iter().filter(|(at, _)| *at == frame) {
            match event {
                Event::Moves(quadrupole, by) => plant.move_quadrupole(*quadrupole, *by),
                Event::Steps(param, factor) => plant.params[*param] += factor.ln(),
                _ => {}
            }
        }
        Ok(())
    }

    pub(super) fn gap(&self, frame: u32) -> u32 {
        let lost = self.events.iter().filter(|(at, _)| *at == frame);
        lost.map(|(_, event)| if let Event::Gap(cycles) = event { *cycles } else { 0 }).sum()
    }

    pub(super) fn sticks(&self, frame: u32, corrector: usize) -> bool {
        self.during(frame).any(|event| matches!(event, Event::Sticks(c, _) if *c == corrector))
    }

    pub(super) fn is_lost(&self, frame: u32) -> bool {
        self.during(frame).any(|event| matches!(event, Event::Lost(_)))
    }

    pub(super) fn is_silent(&self, frame: u32, monitor: usize) -> bool {
        self.during(frame).any(|event| matches!(event, Event::Silent(which, _) if which.contains(&monitor)))
    }

    pub(super) fn momentum(&self, frame: u32) -> f64 {
        self.during(frame).map(|event| if let Event::Momentum(delta, _) = event { *delta } else { 0.0 }).sum()
    }
}

impl Event {
    /// What it happens to.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Moves(..) => "quadrupole",
            Self::Steps(..) => "var",
            Self::Sticks(..) => "corrector",
            Self::Lost(_) => "beam",
            Self::Silent(..) => "monitors",
            Self::Momentum(..) => "momentum",
            Self::Gap(_) => "no frames",
        }
    }

    fn lasting(&self) -> u32 {
        match self {
            Self::Moves(..) | Self::Steps(..) | Self::Gap(_) => 1,
            Self::Sticks(_, frames) | Self::Lost(frames) | Self::Silent(_, frames) | Self::Momentum(_, frames) => {
                *frames
            }
        }
    }

    fn span(&self, at: u32) -> Range<u32> {
        at..at + self.lasting()
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ring = Ring::booster();
        match self {
            Self::Moves(quadrupole, [x, y]) => {
                let name = ring.label(ring.quadrupoles[*quadrupole].element);
                write!(f, "quadrupole {name} moves by {:+.1}, {:+.1} mm", 1e3 * x, 1e3 * y)
            }
            Self::Steps(param, factor) => {
                write!(f, "var {} steps by {:+.0} %", ring.var_names()[*param], 100.0 * (factor - 1.0))
            }
            Self::Sticks(corrector, frames) => {
                write!(f, "corrector {} sticks for {frames} frames", ring.corrector_name(*corrector))
            }
            Self::Lost(frames) => write!(f, "no beam for {frames} frames"),
            Self::Silent(monitors, frames) => {
                let read: Vec<String> = ring.monitor_names();
                let names: Vec<&str> = monitors.iter().map(|b| read[*b].as_str()).collect();
                write!(f, "monitors {} silent for {frames} frames", names.join(", "))
            }
            Self::Momentum(delta, frames) => {
                write!(f, "momentum off by {:+.2} per mille for {frames} frames", 1e3 * delta)
            }
            Self::Gap(cycles) => write!(f, "{cycles} cycles without a frame"),
        }
    }
}
