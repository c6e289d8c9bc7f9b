//! The loop: every estimate of a source into every sink.

use results::EstimateRecord;

use crate::sink::{SinkError, Sinks};
use crate::source::{Next, Source, SourceError};
use crate::stop::Stop;

/// Why a stream ended before its source did.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// The source failed.
    #[error(transparent)]
    Source(SourceError),
    /// A sink failed.
    #[error(transparent)]
    Sink(SinkError),
}

/// Hand every estimate of a source to the sinks, until the source ends or somebody asks to stop; `heard` is told of each.
/// Remarks are counted on the way. Returns the last one.
///
/// # Errors
/// [`ServeError`].
pub fn serve(
    source: &mut impl Source,
    sinks: &mut Sinks,
    stop: &Stop,
    mut heard: impl FnMut(),
) -> Result<Option<Box<EstimateRecord>>, ServeError> {
    let (mut last, mut remarked) = (None, source.remarked());
    while !stop.is_requested() {
        match source.next().map_err(ServeError::Source)? {
            Next::Estimate(mut record) => {
                remarked.add(&record.remarks);
                record.remarked = remarked;
                sinks.take(&record).map_err(ServeError::Sink)?;
                heard();
                last = Some(record);
            }
            Next::Nothing => {}
            Next::End => break,
        }
    }
    Ok(last)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use inference::Recording;
    use inference::stream::{self, Walk};
    use results::{FitResult, Names, Remarked};
    use twin::Ring;

    use super::*;
    use crate::source::replay::Replay;
    use crate::source::{Clock, Rate};

    /// Two frames without beam, whose monitors all read zero.
    #[test]
    fn frames_that_are_put_aside_are_said_and_not_counted_as_used() {
        let ring = Ring::booster();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
        let mut recording = Recording::read(&folder, &ring).unwrap();
        recording.rows.truncate(60);
        recording.rows[40..42].iter_mut().for_each(|row| row.reading.fill(Some(0.0)));
        let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
        let stop = Stop::default();
        let mut source = Replay::new(&recording, &Names::of(&ring), core, Clock::new(Rate::Max, &stop));
        let last = serve(&mut source, &mut Sinks::default(), &stop, || {}).unwrap().unwrap();
        assert_eq!((last.frames, last.remarked), (60, Remarked { put_aside_frames: 2, ..Remarked::default() }));
        let (quality, timing) = (source.quality(), source.times.quantiles());
        let result = FitResult::of_core("green", &ring, (&recording, Walk::NONE), &last, quality, timing).unwrap();
        assert_eq!(result.frames, 58);
        assert!(result.to_string().contains(", 2 frames put aside"), "{result}");
    }
}
