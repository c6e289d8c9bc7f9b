//! Template and hardware of the campaigns that the tests simulate.

use std::path::Path;

use inference::recording::Recording;
use inference::simulate::Hardware;
use nalgebra::DMatrix;
use twin::Ring;

/// A campaign of the repository, on the ring as designed.
pub fn template() -> (Ring, Recording) {
    let ring = Ring::booster();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
    let recording = Recording::read(&folder, &ring).unwrap();
    (ring, recording)
}

/// Hardware without noise, offsets or jumps.
pub fn ideal(ring: &Ring) -> Hardware {
    let noise = vec![0.0; ring.read_monitors.len()];
    Hardware { misalignment: [1.8e-4; 2], offset: 0.0, noise, jumps: Vec::new(), tune_noise: 0.0 }
}

/// Readings, rows frames, columns read monitors.
pub fn readings(recording: &Recording) -> DMatrix<f64> {
    let rows = &recording.rows;
    DMatrix::from_fn(rows.len(), rows[0].reading.len(), |i, b| rows[i].reading[b].unwrap_or(f64::NAN))
}
