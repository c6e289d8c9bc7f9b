//! A device on a line: fed by us from a recording, or heard while somebody else feeds it.

use std::io::{Read, Write};
use std::sync::Arc;

use estimator::FitQuality;
use inference::{Recording, stream};
use results::output::warn;
use results::{EstimateRecord, Names};
use training::rooms::largest::Request;

use super::link::{Heard, Link, LinkError};
use super::{Clock, Next, Source, SourceError, Times};

impl Heard {
    /// What it says to every sink.
    pub fn record(&self, names: &Arc<Names>) -> Box<EstimateRecord> {
        // the alarm is a question of its own, which the line has no time for in every cycle
        let vars = 0..self.estimate.mean.len();
        let covariance: Vec<f32> = vars.flat_map(|i| (0..=i).map(move |j| self.covariance(i, j))).collect();
        Box::new(EstimateRecord::of(names, self.estimate.clone(), &covariance, None))
    }
}

/// A device that gets the frames of a recording, one after the other.
pub struct Fed<'r, L> {
    recording: &'r Recording,
    names: Arc<Names>,
    link: &'r mut Link<L>,
    clock: Clock,
    next: usize,
    /// From frame to estimate, over the line.
    pub times: Times,
}

impl<'r, L: Read + Write> Fed<'r, L> {
    /// At the first frame; the device has been restarted.
    pub fn new(recording: &'r Recording, names: &Arc<Names>, link: &'r mut Link<L>, clock: Clock) -> Self {
        Self { recording, names: names.clone(), link, clock, next: 0, times: Times::default() }
    }

    /// Send the next frame and wait for what the device says to it, to the bit; none at the end.
    ///
    /// # Errors
    /// Whatever ends the stream before its end.
    pub fn advance(&mut self) -> Result<Option<Heard>, SourceError> {
        let Some(row) = self.recording.rows.get(self.next) else { return Ok(None) };
        self.next += 1;
        let wire = stream::wire(self.recording, row)?;
        self.clock.wait();
        let heard = self.times.of(|| self.link.ingest(row.sequence, &wire));
        Ok(Some(heard.map_err(|error| format!("frame {}: {error}", row.sequence))?))
    }

    /// How well the device says that its model describes the frames so far.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn quality(&mut self) -> Result<FitQuality, LinkError> {
        let status = self.link.status()?;
        Ok(FitQuality { chi_square: status.chi_square, degrees_of_freedom: status.degrees_of_freedom })
    }
}

impl<L: Read + Write> Source for Fed<'_, L> {
    fn next(&mut self) -> Result<Next, SourceError> {
        Ok(self.advance()?.map_or(Next::End, |heard| Next::Estimate(heard.record(&self.names))))
    }
}

/// A device that a front end feeds: each of its estimates is heard, with the covariance that was asked for before.
pub struct Overheard<L> {
    link: Link<L>,
    names: Arc<Names>,
    /// Estimates that are still wanted.
    wanted: u64,
    /// The covariance has been asked for since the last reply.
    is_asked: bool,
}

impl<L: Read + Write> Overheard<L> {
    /// From now on, this many estimates.
    pub fn new(link: Link<L>, names: &Arc<Names>, wanted: u64) -> Self {
        Self { link, names: names.clone(), wanted, is_asked: false }
    }
}

impl<L: Read + Write> Source for Overheard<L> {
    fn next(&mut self) -> Result<Next, SourceError> {
        if self.wanted == 0 {
            return Ok(Next::End);
        }
        if !self.is_asked {
            // each time anew: the last request may have been damaged, or the device reset. A second one changes nothing
            self.link.send(&Request::Covariance)?;
            self.is_asked = true;
        }
        let heard = self.link.listen();
        self.is_asked = matches!(heard, Err(LinkError::Silent { .. }));
        match heard {
            Ok(heard) => {
                self.wanted -= 1;
                Ok(Next::Estimate(heard.record(&self.names)))
            }
            Err(LinkError::Silent { .. }) => Ok(Next::Nothing),
            // a packet that is refused is its sender's concern, and was counted; a damaged reply is one lost
            Err(error @ (LinkError::Refused { .. } | LinkError::Reply(_))) => {
                warn(error);
                Ok(Next::Nothing)
            }
            Err(error) => Err(error.into()),
        }
    }
}
