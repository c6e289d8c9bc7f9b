//! Why bytes are not a packet, or not a frame.

use core::fmt;

/// Why bytes are not a frame. None of these touches the posterior.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum FrameError {
    /// The COBS structure is broken: bytes were lost or a code byte was changed.
    Framing,
    /// Fewer bytes than the frame states.
    Truncated {
        /// Bytes that the header (or the smallest frame) calls for.
        need: usize,
        /// Bytes that arrived.
        got: usize,
    },
    /// More bytes than the frame states, or than any frame has.
    Oversized {
        /// Most bytes allowed.
        limit: usize,
        /// Bytes that arrived.
        got: usize,
    },
    /// The CRC does not match.
    Corrupted {
        /// CRC in the frame.
        stated: u32,
        /// CRC of the bytes.
        computed: u32,
    },
    /// Written for another version of this format.
    Version {
        /// The version read here.
        supported: u8,
        /// The frame's version.
        got: u8,
    },
    /// The CRC is right but the body is not that of a frame.
    Malformed,
    /// The frame is of a machine with other numbers of monitors or correctors.
    Count {
        /// Which list.
        list: &'static str,
        /// Entries of this machine.
        need: usize,
        /// Entries in the frame.
        got: usize,
    },
    /// A value beyond its range.
    Range {
        /// Which value.
        field: &'static str,
        /// Its index in its list.
        index: usize,
        /// Largest magnitude, in steps.
        limit: i32,
        /// The value, in steps.
        got: i32,
    },
    /// The buffer to write to is too small.
    Space {
        /// Bytes it has.
        got: usize,
    },
}

impl fmt::Display for FrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Framing => write!(f, "broken COBS framing"),
            Self::Truncated { need, got } => write!(f, "frame of {got} bytes, {need} needed"),
            Self::Oversized { limit, got } => write!(f, "frame of {got} bytes, at most {limit} expected"),
            Self::Corrupted { stated, computed } => write!(f, "crc {computed:08x} of the bytes, {stated:08x} stated"),
            Self::Version { supported, got } => write!(f, "frame version {got}, version {supported} supported"),
            Self::Malformed => write!(f, "crc is right but the body is not a frame"),
            Self::Count { list, need, got } => write!(f, "{got} entries of {list}, {need} expected"),
            Self::Range { field, index, limit, got } => write!(f, "{field} {index} is {got} steps, beyond {limit}"),
            Self::Space { got } => write!(f, "frame does not fit a buffer of {got} bytes"),
        }
    }
}

impl core::error::Error for FrameError {}
