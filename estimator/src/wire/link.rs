//! Messages of host and device besides frames: requests in, replies out, each a packet of its own kind. See
//! `docs/device.md`.

use heapless::Vec;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::packet::{self, LENGTH, VARINT_16, VARINT_32, VARINT_64};
use super::{CurrentCode, FrameError, ParcelError, listed};
use crate::estimate::{Estimate, Remarks};
use crate::estimator::{GROUPS, IngestError, Setup};
use crate::mask::Mask;
use crate::ramp::RAMP_POINTS;
use crate::sizes::Sizes;
use crate::steer::{Feedback, Steered};

/// Version of requests and replies.
pub const VERSION: u8 = 4;
/// First byte of a request.
pub const REQUEST: u8 = 0x10 | VERSION;
/// First byte of a reply.
pub const REPLY: u8 = 0x20 | VERSION;
/// Number of replies that no request has asked for: those to frames, and to what was neither. No request should have it.
pub const UNASKED: u32 = 0;
/// Most entries of a covariance in one piece.
pub const PIECE: usize = 56;
/// Most bytes of the body of a request or reply whose size does not depend on the machine: a piece of a covariance.
pub const OTHER_BYTES: usize = VARINT_32 + 1 + VARINT_32 + VARINT_32 + LENGTH + 4 * PIECE;

/// A request of a host: `S` is the setup of the device's core, `P` a parcel of its tables, `W` what is wanted of the orbit. On the wire
/// its number comes first, which the reply repeats, so that a host never takes the reply to an earlier request for that to a later one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // there is no allocator to box one with
pub enum Request<S, P, W> {
    /// Forget all frames and begin at the prior.
    Restart(S),
    /// Take the next frame whatever its number: the front end has restarted its counter.
    ForgetSequence,
    /// Send the covariance after the next estimate.
    Covariance,
    /// Send the status of the device.
    Status,
    /// A part of new tables. The last one puts them in use, if they are whole.
    Model(P),
    /// Use the tables in flash again, which frees the slot.
    BuiltIn,
    /// Reply to frames in this form, until told otherwise or restarted.
    Form(Form),
    /// Steer from the next frame on, as if it were the first; or no more. Restarted, a device does not steer.
    Feedback(Option<W>),
}

/// How a device replies to frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum Form {
    /// By the estimate: see [`Reply::Estimate`].
    #[default]
    Full,
    /// By what feedback needs: see [`Reply::Short`].
    Short,
}

/// A reply of a device: `A` is its core's estimate on the wire, `U` are setpoints. On the wire the number of the request comes first,
/// or [`UNASKED`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // there is no allocator to box one with
pub enum Reply<A, U> {
    /// The estimate after a frame.
    Estimate(A),
    /// A part of the covariance of `theta = ln var`, lower triangle row by row.
    Covariance {
        /// The frame after which it was taken.
        sequence: u32,
        /// Place of the first entry.
        first: u32,
        /// The entries.
        entries: Vec<f32, PIECE>,
    },
    /// A packet was refused; the posterior is as it was, except after [`Refusal::NoDesign`].
    Refused {
        /// Why.
        why: Refusal,
        /// Packets refused so far.
        count: u32,
    },
    /// The device begins at the prior.
    Restarted,
    /// The next frame may have any number.
    SequenceForgotten,
    /// A part of new tables was taken, or not; or tables in use have no design, and those in flash are in use from a restart on.
    Model(Result<Taken, ParcelError>),
    /// How the device is.
    Status(Status),
    /// What feedback needs after a frame.
    Short(Short<U>),
    /// Frames are replied to in this form.
    Form(Form),
    /// The device steers from the next frame on, or no more.
    Feedback(bool),
}

/// What feedback needs after a frame.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Short<U> {
    /// Sequence number of the frame.
    pub sequence: u32,
    /// What is to be said of the frame and of the posterior, see [`Remarks`].
    pub remarks: Remarks,
    /// An operator should look, see [`crate::Core::needs_attention`].
    pub attention: bool,
    /// Normalised innovation squared of the readings used; with a correction, each of them by itself (`Judged::nis`).
    pub nis: f32,
    /// What the correctors are to do, while the device steers.
    pub correction: Option<Correction<U>>,
}

/// What the correctors are to do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Correction<U> {
    /// What became of the frame, a reason to hold if there is one.
    pub steered: Steered,
    /// The work for the feedback after the frame before was done ([`crate::Estimator::prepare_steer`], once): with the same slices and
    /// the same work before each frame, another core arrives at the same bits.
    pub prepared: bool,
    /// Currents that the correctors should have, in their order, also those that hold or probe.
    pub setpoints: U,
}

/// Setpoints of `C` correctors.
pub type Setpoints<const C: usize> = Vec<CurrentCode, C>;

impl<const C: usize> Short<Setpoints<C>> {
    /// Largest body of a reply that holds one.
    pub const MAX_BYTES: usize = VARINT_32 + 1 + VARINT_32 + 3 + VARINT_32 + 1 + VARINT_16 // the frame, remarks
        + 1 + 4 // attention, nis
        + 1 + 2 + 2 * VARINT_16 + 1 + LENGTH + VARINT_32 * C; // correction
}

/// What became of a part of new tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Taken {
    /// It waits for the rest.
    Stored,
    /// All are in use now; the posterior is that of all frames so far under them.
    InUse,
    /// The tables in flash are in use.
    BuiltIn,
}

/// Why a packet was refused: the kind of the error, without the values that disagreed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[allow(missing_docs)] // named after `FrameError` and `IngestError`
pub enum Refusal {
    Framing,
    Truncated,
    Oversized,
    Corrupted,
    Version,
    Malformed,
    Count,
    Range,
    Repeated,
    OutOfOrder,
    Beyond,
    NotStarted,
    /// A setup with a number that is not finite, or a size that is not positive.
    Setup,
    /// The rest of it did not come within two cycles.
    Stalled,
    /// A setup for tables in flash that have no design; there is no posterior any more.
    NoDesign,
}

impl From<FrameError> for Refusal {
    fn from(error: FrameError) -> Self {
        match error {
            FrameError::Framing => Self::Framing,
            FrameError::Truncated { .. } => Self::Truncated,
            FrameError::Oversized { .. } => Self::Oversized,
            FrameError::Corrupted { .. } => Self::Corrupted,
            FrameError::Version { .. } => Self::Version,
            FrameError::Count { .. } => Self::Count,
            FrameError::Range { .. } => Self::Range,
            _ => Self::Malformed,
        }
    }
}

impl From<IngestError> for Refusal {
    fn from(error: IngestError) -> Self {
        match error {
            IngestError::Frame(error) => error.into(),
            IngestError::Repeated { .. } => Self::Repeated,
            IngestError::OutOfOrder { .. } => Self::OutOfOrder,
            IngestError::Beyond(_) => Self::Beyond,
            _ => Self::NotStarted,
        }
    }
}

/// Status of a board.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Vitals {
    /// Bytes lost because the receive queue or the receiver was full.
    pub lost_bytes: u32,
    /// Machine cycles since power-on.
    pub cycles: u32,
    /// Whole cycles in which nothing came.
    pub silent_cycles: u32,
    /// Most stack used so far [bytes].
    pub stack_bytes: u32,
}

/// How the device is.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Status {
    /// Version of its requests and replies, [`VERSION`].
    pub version: u8,
    /// Version of its frames, [`crate::Frame::VERSION`].
    pub frame_version: u8,
    /// How many of everything the ring has that it is for.
    pub ring: Sizes,
    /// What its core has room for.
    pub room: Sizes,
    /// Frames taken in so far, those that were put aside included.
    pub frames: u32,
    /// Packets refused so far.
    pub refused: u32,
    /// Status of the board.
    pub vitals: Vitals,
    /// CRC of the tables in use, see [`crate::Tables::digest`].
    pub tables: u32,
    /// The tables in use came over the wire.
    pub loaded: bool,
    /// See [`crate::FitQuality`].
    pub chi_square: f32,
    /// Degrees of freedom of that.
    pub degrees_of_freedom: f32,
}

/// An [`Estimate`] on the wire: the same fields in the same order, lists with their length, masks as lists of words.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)] // those of `Estimate`
pub struct Answer<const B: usize, const N: usize, const W: usize> {
    pub sequence: u32,
    pub time_us: u64,
    pub frames: u32,
    pub rejected_frames: u32,
    pub mean: Vec<f32, N>,
    pub sigma: Vec<f32, N>,
    pub map_params: Vec<f32, N>,
    pub centre: Vec<f32, N>,
    pub params_sigma: Vec<f32, N>,
    pub clipped: Vec<u32, W>,
    pub nis: f32,
    pub accepted: Vec<u32, W>,
    pub rejected: Vec<u32, W>,
    pub confirmed: Vec<u32, W>,
    pub restarted: Vec<u32, W>,
    pub tune_innovation: [Option<f32>; 2],
    pub setting: Option<u16>,
    pub log_evidence: f32,
    pub linearised: bool,
    pub remarks: Remarks,
    pub health: Vec<(u8, f32, f32, u32), B>,
}

impl<const B: usize, const N: usize, const W: usize> From<&Estimate<B, N, W>> for Answer<B, N, W> {
    fn from(e: &Estimate<B, N, W>) -> Self {
        let mask = |mask: &Mask<W>, bits| listed(mask.as_words().iter().take(crate::mask::words(bits)).copied());
        Self {
            sequence: e.sequence,
            time_us: e.time_us,
            frames: e.frames,
            rejected_frames: e.rejected_frames,
            mean: listed(e.mean),
            sigma: listed(e.sigma),
            map_params: listed(e.map_params),
            centre: listed(e.centre),
            params_sigma: listed(e.params_sigma),
            clipped: mask(&e.clipped, N),
            nis: e.nis,
            accepted: mask(&e.accepted, B),
            rejected: mask(&e.rejected, B),
            confirmed: mask(&e.confirmed, B),
            restarted: mask(&e.restarted, B),
            tune_innovation: e.tune_innovation,
            setting: e.setting,
            log_evidence: e.log_evidence,
            linearised: e.linearised,
            remarks: e.remarks,
            health: listed(e.health.iter().map(|h| (h.state as u8, h.noise, h.weighted_as, h.rejected))),
        }
    }
}

impl<const B: usize, const N: usize, const W: usize> Answer<B, N, W> {
    /// Largest body of a reply that holds one.
    pub const MAX_BYTES: usize = VARINT_32 + 1 + 5 * (LENGTH + 4 * N) // mean .. params_sigma
        + 5 * (LENGTH + VARINT_32 * W) // masks
        + LENGTH + B * (1 + 8 + VARINT_32) // health
        + 3 * VARINT_32 + VARINT_64 // the frame, and how many
        + 2 * 4 + 2 * 5 + 2 * 4 + 4 + VARINT_32; // nis, log_evidence, tunes, setting and the param let loose, linearised and other remarks, slices
}

impl<const B: usize, const C: usize, const F: usize> Setup<B, C, F> {
    /// Largest body of a request that holds one.
    pub const MAX_BYTES: usize = VARINT_32 + 1 + 16 * GROUPS // priors
        + 2 * (4 + LENGTH) + 4 * (B + C) // noise, kicks
        + 5 + LENGTH + 28 * F // dipole, supplies
        + LENGTH + RAMP_POINTS * (VARINT_32 + 12 + LENGTH + 4 * F) // ramp
        + 3 * 4 + 5; // gate, both walks, tunes
}

impl<const B: usize, const C: usize> Feedback<B, C> {
    /// Largest body of a request that holds one.
    pub const MAX_BYTES: usize = VARINT_32 + 2 + 2 * (4 + LENGTH) + 4 * (B + C) + 6 * 4 + VARINT_64;
}

impl<S: Serialize, P: Serialize, W: Serialize> Request<S, P, W> {
    /// Write the request as a packet; returns its bytes.
    ///
    /// # Errors
    /// [`FrameError::Space`]; the machine's `PACKET` bytes always suffice.
    pub fn encode(&self, number: u32, out: &mut [u8]) -> Result<usize, FrameError> {
        packet::seal(REQUEST, &(number, self), out)
    }
}

impl<S: DeserializeOwned, P: DeserializeOwned, W: DeserializeOwned> Request<S, P, W> {
    /// Read a request and its number, which is [`UNASKED`] where that is damaged; `bytes` is used as work space.
    pub fn decode(bytes: &mut [u8]) -> (u32, Result<Self, FrameError>) {
        unseal(REQUEST, bytes)
    }
}

impl<A: Serialize, U: Serialize> Reply<A, U> {
    /// Write the reply as a packet; returns its bytes.
    ///
    /// # Errors
    /// [`FrameError::Space`]; the machine's `PACKET` bytes always suffice.
    #[inline(never)] // so that a count of instructions leaves out the waiting for the line
    pub fn encode(&self, number: u32, out: &mut [u8]) -> Result<usize, FrameError> {
        packet::seal(REPLY, &(number, self), out)
    }
}

impl<A: DeserializeOwned, U: DeserializeOwned> Reply<A, U> {
    /// Read a reply and the number of its request; `bytes` is used as work space.
    pub fn decode(bytes: &mut [u8]) -> (u32, Result<Self, FrameError>) {
        unseal(REPLY, bytes)
    }
}

/// The number first, so that a body which this version does not know is tied to its sender's request all the same.
fn unseal<T: DeserializeOwned>(kind: u8, bytes: &mut [u8]) -> (u32, Result<T, FrameError>) {
    let body = match packet::open(kind, bytes.len(), bytes) {
        Ok(body) => body,
        Err(error) => return (UNASKED, Err(error)),
    };
    match postcard::take_from_bytes(body) {
        Ok((number, rest)) => (number, packet::whole(rest)),
        Err(_) => (UNASKED, Err(FrameError::Malformed)),
    }
}
