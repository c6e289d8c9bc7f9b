//! What happens to the machine of a loop, and when.

use core::error::Error;
use core::ops::Range;

use estimator::booster::PARAMS;

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
    /// Of machine and noise.
    pub seed: u64,
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

/// Frames between moves of the quadrupoles.
const MOVES: u32 = 4;

impl Scenario {
    /// Nothing happens but drift.
    pub fn quiet(seed: u64, frames: u32) -> Self {
        Self { seed, frames, campaign: 98, walk: 1e-5, ground: 2e-7, counts: true, events: Vec::new() }
    }

    fn during(&self, frame: u32) -> impl Iterator<Item = &Event> {
        self.events.iter().filter(move |(at, event)| event.span(*at).contains(&frame)).map(|(_, event)| event)
    }

    pub(super) fn disturb(
        &self,
        frame: u32,
        plant: &mut Plant,
        random: &mut Random,
    ) -> Result<(), Box<dyn Error>> {
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
    fn span(&self, at: u32) -> Range<u32> {
        let frames = match self {
            Self::Moves(..) | Self::Steps(..) | Self::Gap(_) => 1,
            Self::Sticks(_, frames) | Self::Lost(frames) | Self::Silent(_, frames) | Self::Momentum(_, frames) => *frames,
        };
        at..at + frames
    }
}
