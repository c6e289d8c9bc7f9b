//! The loop: every estimate of a source into every sink.

use crate::record::{EstimateRecord, Remarked};
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
    let (mut last, mut remarked) = (None, Remarked::default());
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
