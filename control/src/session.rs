//! A measurement under way: settings made one after the other, frames taken at each.

use crate::channel::{Control, ControlError, Sample};
use crate::frame::{Frame, counter};
use crate::journal::{Journal, JournalError, Setting};
use crate::plan::Plan;
use crate::preflight::SetPoint;
use crate::restore::{RestoreError, restore};
use crate::step::Step;

/// Why a measurement ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    /// Somebody has asked for it.
    #[error("interrupted")]
    Interrupted,
    /// A device does not do what it is told.
    #[error(transparent)]
    NotFollowing(Box<NotFollowing>),
    /// No frame came.
    #[error("{step}: no frame in {after} s: {why}")]
    NoFrame {
        /// The setting.
        step: Step,
        /// How long was waited [s].
        after: f64,
        /// What was wrong with the last one.
        why: String,
    },
    /// A set point has no value, or one beyond the plan's limits, before anything is written.
    #[error("{channel} is at {found}, expected {low} to {high}")]
    Original {
        /// The set point.
        channel: String,
        /// Its value.
        found: f64,
        /// Limits of the plan.
        low: f64,
        /// Limits of the plan.
        high: f64,
    },
    /// A step would leave the plan's limits.
    #[error("{step}: {wanted} is not within {low} to {high}")]
    Limits {
        /// The setting.
        step: Step,
        /// What would have been written.
        wanted: f64,
        /// Limits of the plan.
        low: f64,
        /// Limits of the plan.
        high: f64,
    },
    /// A channel fails.
    #[error("{step}: {error}")]
    Control {
        /// The setting.
        step: Step,
        /// What it says.
        error: ControlError,
    },
    /// A set point cannot be read before anything is written.
    #[error("before the first setting: {0}")]
    Before(ControlError),
    /// What a killed measurement left behind cannot be put back.
    #[error("before the first setting: {0}")]
    Behind(RestoreError),
    /// The journal cannot be kept.
    #[error(transparent)]
    Journal(#[from] JournalError),
}

/// A device that does not do what it is told.
#[derive(Debug, thiserror::Error)]
#[error("{step}: {channel} was set to {wanted}, read-back {read} {found} after {after} s, expected within {tolerance}")]
pub struct NotFollowing {
    /// The setting.
    pub step: Step,
    /// Channel that was written.
    pub channel: String,
    /// What was written.
    pub wanted: f64,
    /// Channel that did not follow.
    pub read: String,
    /// Its value, or why there is none.
    pub found: String,
    /// How long was waited [s].
    pub after: f64,
    /// Largest distance.
    pub tolerance: f64,
}

/// How far a measurement is.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'s> {
    /// Settings done.
    pub done: usize,
    /// Of so many.
    pub of: usize,
    /// What is set now.
    pub step: &'s Step,
}

/// Time between two looks at a channel [s].
const POLL: f64 = 0.01;

/// A measurement under way; dropped, it puts the machine back.
pub(crate) struct Session<'a, C: Control> {
    pub control: &'a mut C,
    pub plan: &'a Plan,
    pub journal: &'a mut Journal,
    pub stop: &'a dyn Fn() -> bool,
    /// Last cycle that was looked at.
    pub seen: Option<u32>,
    /// Channel whose set point is not as it was, and what was written to it.
    pub moved: Option<(String, f64)>,
    pub back: bool,
}

impl<C: Control> Drop for Session<'_, C> {
    fn drop(&mut self) {
        // on a panic only: every other way puts the machine back before
        let _ = self.put_back();
    }
}

impl<C: Control> Session<'_, C> {
    /// Put the machine back, once.
    pub fn put_back(&mut self) -> Result<usize, RestoreError> {
        if core::mem::replace(&mut self.back, true) {
            return Ok(0);
        }
        restore(self.control, self.journal, self.plan.timeout)
    }

    /// Take the frames of every setting that the journal lacks.
    pub fn take_all(&mut self, mut progress: impl FnMut(Progress)) -> Result<(), SessionError> {
        self.keep_original()?;
        let plan = self.plan;
        let of = plan.steps.len();
        for (done, step) in plan.steps.iter().enumerate() {
            progress(Progress { done, of, step });
            if !self.journal.has(step) {
                self.set(step)?;
                let frames = (0..plan.repeats).map(|_| self.frame(step)).collect::<Result<_, _>>()?;
                self.journal.taken(step.clone(), frames)?;
            }
        }
        Ok(())
    }

    /// What every set point is at, kept before the first write. What a measurement that was killed has moved goes back before.
    fn keep_original(&mut self) -> Result<(), SessionError> {
        restore(self.control, self.journal, self.plan.timeout).map_err(SessionError::Behind)?;
        let set_points = self.plan.set_points();
        let names: Vec<&str> = set_points.iter().map(|set| set.write).collect();
        let samples = self.control.read(&names).map_err(SessionError::Before)?;
        let settings = set_points.iter().zip(&samples).map(|(set, sample)| {
            let ([low, high], found) = (set.limits, sample.number().unwrap_or(f64::NAN));
            let channel = set.write.to_owned();
            match (low..=high).contains(&found) {
                true => Ok(Setting { channel, value: found }),
                false => Err(SessionError::Original { channel, found, low, high }),
            }
        });
        let settings = settings.collect::<Result<_, _>>()?;
        Ok(self.journal.original(settings)?)
    }

    fn original(&self, channel: &str) -> f64 {
        let known = self.journal.pending().unwrap_or_default().iter().find(|setting| setting.channel == channel);
        known.expect("every set point of the plan was kept before the first write").value
    }

    /// Make a setting: what was moved before goes back first.
    fn set(&mut self, step: &Step) -> Result<(), SessionError> {
        let set = self.plan.set_point(step).expect("steps name devices of the machine");
        if let Some((before, _)) = self.moved.take_if(|(moved, _)| *moved != set.write) {
            let set_points = self.plan.set_points();
            let before = set_points.iter().find(|set| set.write == before).expect("it was set by a step");
            self.bring(step, before, self.original(before.write))?;
        }
        let wanted = match step {
            Step::Corrector { current, .. } => *current,
            Step::Rf { offset } => self.original(set.write) * (1.0 + offset),
        };
        let [low, high] = set.limits;
        if !(low..=high).contains(&wanted) {
            return Err(SessionError::Limits { step: step.clone(), wanted, low, high });
        }
        self.moved = Some((set.write.to_owned(), wanted));
        self.bring(step, &set, wanted)?;
        self.seen = None;
        Ok(())
    }

    /// Write a set point, and wait until its read-back has stayed there for the settling time.
    fn bring(&mut self, step: &Step, set: &SetPoint, wanted: f64) -> Result<(), SessionError> {
        let failed = |error| SessionError::Control { step: step.clone(), error };
        self.check()?;
        self.control.write(set.write, wanted).map_err(failed)?;
        let start = self.control.now();
        let mut there: Option<f64> = None;
        loop {
            self.check()?;
            let found = self.number(set.read).map_err(failed)?;
            let now = self.control.now();
            match &found {
                Ok(value) if (value - wanted).abs() <= set.tolerance => {
                    if now - *there.get_or_insert(now) >= self.plan.settle {
                        return Ok(());
                    }
                }
                _ => there = None,
            }
            if there.is_none() && now - start > self.plan.timeout {
                let problem = NotFollowing {
                    step: step.clone(),
                    channel: set.write.into(),
                    wanted,
                    read: set.read.into(),
                    found: found
                        .map_or_else(|why| format!("cannot be read ({why})"), |value| format!("is at {value:.6}")),
                    after: self.plan.timeout,
                    tolerance: set.tolerance,
                };
                return Err(SessionError::NotFollowing(Box::new(problem)));
            }
            self.control.pause(POLL);
        }
    }

    /// One frame of a cycle that begins after now.
    fn frame(&mut self, step: &Step) -> Result<Frame, SessionError> {
        let failed = |error| SessionError::Control { step: step.clone(), error };
        let (plan, start) = (self.plan, self.control.now());
        let set = plan.set_point(step).expect("steps name devices of the machine");
        let mut why = format!("{} does not count", plan.channels.cycle);
        loop {
            self.check()?;
            match self.cycle().map_err(failed)? {
                Err(said) => why = said,
                // this one may have begun before
                Ok(cycle) if *self.seen.get_or_insert(cycle) == cycle => {}
                Ok(cycle) => {
                    self.seen = Some(cycle);
                    match self.whole(cycle, &set).map_err(failed)? {
                        Ok(frame) => return Ok(frame),
                        Err(said) => why = said,
                    }
                }
            }
            if self.control.now() - start > plan.timeout {
                return Err(SessionError::NoFrame { step: step.clone(), after: plan.timeout, why });
            }
            self.control.pause(POLL);
        }
    }

    /// All of a cycle, if it is still that cycle's and the device stands where it was set.
    fn whole(&mut self, cycle: u32, set: &SetPoint) -> Result<Result<Frame, String>, ControlError> {
        let names = self.plan.channels.of_a_frame();
        let samples = match self.read(&names)? {
            Ok(samples) => samples,
            Err(why) => return Ok(Err(why)),
        };
        let frame = Frame::of(self.plan, &samples);
        if frame.as_ref().is_ok_and(|frame| frame.cycle != cycle) {
            return Ok(Err(format!("cycle {cycle} was over before it was read")));
        }
        let wanted = self.moved.as_ref().map_or(f64::NAN, |(_, wanted)| *wanted);
        Ok(match self.number(set.read)? {
            Ok(at) if (at - wanted).abs() <= set.tolerance => frame,
            Ok(at) => Err(format!("{} is at {at}, {} was set to {wanted}", set.read, set.write)),
            Err(why) => Err(why),
        })
    }

    fn cycle(&mut self) -> Result<Result<u32, String>, ControlError> {
        let name = &self.plan.channels.cycle;
        Ok(self.read(&[name])?.and_then(|samples| counter(name, &samples[0])))
    }

    fn number(&mut self, name: &str) -> Result<Result<f64, String>, ControlError> {
        let valid = |samples: Vec<Sample>| samples[0].number().ok_or_else(|| format!("{name} has no valid number"));
        Ok(self.read(&[name])?.and_then(valid))
    }

    /// Values, or why there are none at present: a connection may come back within the time-out.
    fn read(&mut self, names: &[&str]) -> Result<Result<Vec<Sample>, String>, ControlError> {
        match self.control.read(names) {
            Ok(samples) => Ok(Ok(samples)),
            Err(silent @ ControlError::Silent { .. }) => Ok(Err(silent.to_string())),
            Err(error) => Err(error),
        }
    }

    fn check(&self) -> Result<(), SessionError> {
        if (self.stop)() { Err(SessionError::Interrupted) } else { Ok(()) }
    }
}
