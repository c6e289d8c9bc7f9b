//! What leaves the core each cycle: plain data.

use serde::{Deserialize, Serialize};

use crate::mask::Mask;
use crate::prior::{Marginal, Prior};
use crate::state::{Bytes, State, StateError};

/// State of a monitor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum MonitorState {
    /// As expected.
    #[default]
    Ok = 0,
    /// Its repeats scatter more than 1.5 times the expected noise.
    Noisy = 1,
    /// It jumps occasionally.
    Jumps = 2,
    /// It does not report, or repeats one value.
    Dead = 3,
}

impl MonitorState {
    /// The state of a code, as in a record.
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Ok),
            1 => Some(Self::Noisy),
            2 => Some(Self::Jumps),
            3 => Some(Self::Dead),
            _ => None,
        }
    }
}

impl State for MonitorState {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        let mut code = *self as u8;
        code.pass(bytes)?;
        *self = Self::from_code(code).ok_or(StateError::Value { what: "a monitor's state", got: code.into() })?;
        Ok(())
    }
}

/// State and noise of one monitor.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Health {
    /// Its state.
    pub state: MonitorState,
    /// Noise of one reading [m].
    pub noise: f32,
    /// Noise that sets the weight of a reading: larger than `noise` for a monitor that jumps [m].
    pub weighted_as: f32,
    /// Readings that were not used.
    pub rejected: u32,
}

/// What is to be said of a frame as a whole, and of the posterior besides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Remarks {
    /// No beam, or one that the model does not know: nothing in the frame was used.
    pub put_aside: bool,
    /// The baselines have moved; this frame and those put aside before it agree on by how much.
    pub baselines_moved: bool,
    /// The information was not positive, and was made so, or given up for the prior.
    pub unsolved: bool,
    /// Slices of work done since the estimate before ([`crate::Estimator::prepare`]): with as many before each frame, another
    /// core arrives at the same bits.
    pub slices: u32,
    /// The param whose var has stepped: it was let loose, and is as unknown as at the start until frames say where it is.
    pub let_loose: Option<u16>,
}

/// The vars and the state of the monitors after a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate<const B: usize, const N: usize, const W: usize> {
    /// Sequence number of the frame.
    pub sequence: u32,
    /// Time of the frame [us].
    pub time_us: u64,
    /// Frames taken in so far, those that were put aside included.
    pub frames: u32,
    /// Frames refused so far: corrupted, repeated, out of order.
    pub rejected_frames: u32,
    /// Mean of each var [1].
    pub mean: [f32; N],
    /// Standard deviation of each var [1].
    pub sigma: [f32; N],
    /// MAP of each `theta = ln var`.
    pub map_params: [f32; N],
    /// Centre of each theta's normal before truncation; equals the MAP unless a param sits at a bound.
    pub centre: [f32; N],
    /// Its standard deviation.
    pub params_sigma: [f32; N],
    /// Bit `i` is 1 if param `i` is clipped to the prior's range.
    pub clipped: Mask<W>,
    /// Joint normalised innovation squared of the readings used, tunes included.
    pub nis: f32,
    /// Bit `b` is 1 if the reading of monitor `b` was used.
    pub accepted: Mask<W>,
    /// Bit `b` is 1 if monitor `b` reported and its reading was not used.
    pub rejected: Mask<W>,
    /// Bit `b` is 1 if this reading confirmed the one before in the same setting, which is now used as well.
    pub confirmed: Mask<W>,
    /// Bit `b` is 1 if this reading and the one before outvoted all earlier ones in the same setting.
    pub restarted: Mask<W>,
    /// Fractional tune in x and y, measured minus predicted, where it was used [1].
    pub tune_innovation: [Option<f32>; 2],
    /// The setting that the frame repeats, if it is kept as one.
    pub setting: Option<u16>,
    /// `ln` of the evidence of all readings under the model.
    pub log_evidence: f32,
    /// The model was relinearised since the last estimate.
    pub linearised: bool,
    /// What is to be said of the whole.
    pub remarks: Remarks,
    /// State of every monitor.
    pub health: [Health; B],
}

impl<const B: usize, const N: usize, const W: usize> Estimate<B, N, W> {
    /// Marginal posterior of param `i`; none beyond the last.
    pub fn marginal(&self, i: usize, prior: &Prior) -> Option<Marginal> {
        Some(Marginal {
            mean: *self.centre.get(i)?,
            sigma: *self.params_sigma.get(i)?,
            lower: prior.lower,
            upper: prior.upper,
        })
    }
}
