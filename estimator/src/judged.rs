//! A frame that was judged, and not yet learnt: what a feedback acts on.
//!
//! The setpoints of the correctors, and the reply that tells them, do not wait until a frame is learnt: that takes two thirds of the
//! time, and what one frame adds to the vars is less than their error bars. Steering has the frame's orbit, and the vars of the frame
//! before.

use crate::campaign::Verdict;
use crate::drive::Drive;
use crate::estimate::{Health, Remarks};
use crate::mask::Mask;
use crate::wire::Frame;

/// Standard deviations of the NIS beyond which a frame surprises: by chance one in a million, its skewness counted.
const SURPRISING: f32 = 6.0;

/// A frame, and which of its readings count: `B` monitors, `C` correctors, `F` supplies, `W` words.
#[derive(Debug, Clone)]
#[must_use = "it is to be learnt"]
pub struct Judged<const B: usize, const C: usize, const F: usize, const W: usize> {
    /// The frame.
    pub frame: Frame<B, C, F, W>,
    /// Normalised innovation squared of the readings used, once the frame is learnt: on average one a reading. Where it is steered by,
    /// before that: each by itself, its correlation with others and tunes left out.
    pub nis: f32,
    /// The model was linearised anew since the frame before.
    pub linearised: bool,
    /// What is to be said of the frame as a whole, and so far of the posterior.
    pub remarks: Remarks,
    /// State of every monitor.
    pub health: [Health; B],
    pub(crate) drive: Drive<C, F>,
    pub(crate) expected: Expected<B, W>,
    /// The stored setting that it repeats.
    pub(crate) cell: Option<u16>,
    pub(crate) screened: Screened<W>,
}

/// What the model makes of each reading.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Expected<const B: usize, const W: usize> {
    /// Measured minus expected [m]; 0 where none is reported.
    pub surprise: [f32; B],
    /// Its variance but for the uncertainty of the params [m^2].
    pub certain: [f32; B],
    /// Those within the gate.
    pub within: Mask<W>,
}

/// Which readings of a frame are used.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Screened<const W: usize> {
    pub accepted: Mask<W>,
    pub rejected: Mask<W>,
    pub confirmed: Mask<W>,
    pub restarted: Mask<W>,
    /// Growth of the repeats' squared deviations from the means of their settings, over the noise.
    pub scatter: f64,
    /// Innovation of each tune that is used [1].
    pub tune: [Option<f32>; 2],
}

impl<const W: usize> Screened<W> {
    /// Take note of what the repeats say of a reading.
    pub(crate) fn note(&mut self, b: usize, verdict: Verdict) {
        self.accepted.put(b, verdict.waiting() == 0);
        self.rejected.put(b, verdict.waiting() > 0);
        self.confirmed.put(b, matches!(verdict, Verdict::Confirms { .. }));
        self.restarted.put(b, verdict == Verdict::Confirms { outvotes: true });
    }

    /// None of a frame's readings, which monitors with a 1 have reported.
    pub fn none_of(valid: &Mask<W>) -> Self {
        Self { rejected: *valid, ..Self::default() }
    }

    /// Number of readings that are used.
    pub fn count(&self) -> u32 {
        self.accepted.count() + self.tune.iter().flatten().count() as u32
    }
}

/// True if so many readings are further from the prediction, by their squares over their variances, than chance explains.
pub(crate) fn is_surprising(nis: f32, readings: u32) -> bool {
    nis > most(readings)
}

/// NIS of so many readings beyond which a frame surprises.
pub(crate) fn most(readings: u32) -> f32 {
    let expected = readings as f32;
    expected + SURPRISING * libm::sqrtf(2.0 * expected)
}
