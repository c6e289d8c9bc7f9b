//! The emulated chip in a loop, beside the core in process.

use core::error::Error;
use core::fmt;
use core::time::Duration;
use std::os::unix::net::UnixStream;
use std::thread;

use estimator::Each;
use estimator::booster::{self, Estimate, Estimator, Feedback};
use estimator::wire::link::{Form, Short, Status};
use host_bridge::source::link::{Heard, Link, LinkError};
use inference::stream;
use training::rooms::largest::{self, Setpoints};

use super::Known;
use crate::machine::LAYOUT;
use crate::qemu::Emulator;
use crate::sil::bits;

/// Steps whose instructions are counted, by the words of the table and the function in the image.
pub const REGIONS: [(&str, &str); 5] = [
    ("frame to setpoints", "judge_and_steer"),
    ("steer", "Steer::steer"),
    ("learn", "Estimator::learn"),
    ("gains of a plane", "Steer::prepare"),
    ("reply", "Reply::encode"),
];

/// A device on the emulated chip.
pub struct Chip<'e> {
    link: Link<&'e UnixStream>,
    steers: bool,
    /// Frames that it has answered.
    pub frames: usize,
    /// Frames that the core in process has answered otherwise, in any bit.
    pub different: usize,
}

impl fmt::Debug for Chip<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Chip").field("frames", &self.frames).field("different", &self.different).finish_non_exhaustive()
    }
}

/// What it says of a frame: before it steers in full, with the covariance, then in short.
#[derive(Debug)]
pub enum Said {
    /// The estimate.
    Full(Box<Heard>),
    /// With setpoints.
    Short(Box<Short<Setpoints>>),
}

impl Said {
    /// Slices of work that the core has done before the frame.
    pub fn slices(&self) -> u32 {
        match self {
            Self::Full(heard) => heard.estimate.remarks.slices,
            Self::Short(short) => short.remarks.slices,
        }
    }

    /// True if the work for the feedback was done.
    pub fn prepared(&self) -> bool {
        match self {
            Self::Full(_) => false,
            Self::Short(short) => short.correction.as_ref().is_some_and(|correction| correction.prepared),
        }
    }
}

impl<'e> Chip<'e> {
    /// At the prior.
    ///
    /// # Errors
    /// If the device does not take its setup.
    pub fn start(emulator: &'e Emulator) -> Result<Self, Box<dyn Error>> {
        let mut link = Link::new(emulator.uart());
        link.restart(&Known::core()?.setup)?;
        Ok(Self { link, steers: false, frames: 0, different: 0 })
    }

    /// Send a frame, and hear what is said of it; the chip steers from the first frame on that has a feedback.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn hear(&mut self, feedback: Option<&Feedback>, sequence: u32, wire: &[u8]) -> Result<Said, LinkError> {
        self.frames += 1;
        let Some(feedback) = feedback else {
            return self.link.ingest(sequence, wire).map(|heard| Said::Full(Box::new(heard)));
        };
        if !core::mem::replace(&mut self.steers, true) {
            // of a cycle's time the emulator has hardly any; an operator who switches the feedback on gives it seconds
            thread::sleep(Duration::from_secs(2));
            self.link.form(Form::Short)?;
            self.link.steer(Some(on_wire(feedback)))?;
        }
        let short = self.link.feedback(sequence, wire)?;
        // answered once the frame is learnt: the next one does not come before that
        self.link.form(Form::Short)?;
        Ok(Said::Short(Box::new(short)))
    }

    /// How the device is.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn status(&mut self) -> Result<Status, LinkError> {
        self.link.status()
    }

    /// Hold what it said against the core in process, which has heard the same frame.
    pub fn compare(
        &mut self,
        said: &Said,
        core: &Estimator,
        estimate: &Estimate,
        short: Option<&Short<booster::Setpoints>>,
    ) {
        let is_same = match said {
            Said::Full(heard) => is_same(heard, core, estimate),
            Said::Short(said) => short.is_some_and(|short| says(said, short)),
        };
        self.different += usize::from(!is_same);
    }
}

/// True if estimate and covariance are the same, bit for bit.
fn is_same(heard: &Heard, core: &Estimator, estimate: &Estimate) -> bool {
    let estimate = stream::Estimate::from_core(estimate, &LAYOUT);
    let mut places = (0..estimate.mean.len()).flat_map(|i| (0..=i).map(move |j| (i, j)));
    bits(&heard.estimate) == bits(&estimate)
        && places.all(|(i, j)| core.covariance(i, j).to_bits() == heard.covariance(i, j).to_bits())
}

/// True if two short replies say the same, bit for bit.
fn says(said: &Short<Setpoints>, own: &Short<booster::Setpoints>) -> bool {
    let (Some(correction), Some(expected)) = (&said.correction, &own.correction) else { return false };
    (said.sequence, said.nis.to_bits()) == (own.sequence, own.nis.to_bits())
        && (said.remarks, said.attention) == (own.remarks, own.attention)
        && (correction.steered, correction.prepared) == (expected.steered, expected.prepared)
        && correction.setpoints.as_slice() == expected.setpoints.as_slice()
}

/// As a host sends it, which talks to devices of any size.
pub fn on_wire(feedback: &Feedback) -> largest::Feedback {
    largest::Feedback {
        orbit: wide(&feedback.orbit),
        walk: feedback.walk,
        step_kick: feedback.step_kick,
        total_kick: feedback.total_kick,
        limit: wide(&feedback.limit),
        rate: feedback.rate,
        probe: feedback.probe,
        close: feedback.close,
        patience_us: feedback.patience_us,
    }
}

fn wide<const L: usize, const M: usize>(each: &Each<L>) -> Each<M> {
    Each { all: each.all, own: each.own.iter().copied().collect() }
}
