//! The envelope of everything on the wire: COBS, then kind, length, body in postcard, CRC. Frames are one kind; a device's
//! requests and replies are others.
//!
//! COBS gives boundaries, not integrity: without the CRC a flipped bit decodes as a good body.

use cobs::{DecodeResult, DecoderState, EncoderState, PushResult};
use serde::{Deserialize, Serialize};

use super::FrameError;

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

/// Bytes in front of the body: kind and length.
const HEADER: usize = 3;
/// Bytes of the CRC.
const TRAILER: usize = 4;

/// Bytes that hold any packet whose body has at most so many.
pub const fn wire_bytes(body: usize) -> usize {
    cobs::max_encoding_length(HEADER + body + TRAILER) + 1
}

/// Most bytes of a varint of 16, 32 and 64 bits in postcard.
pub(crate) const VARINT_16: usize = 3;
pub(crate) const VARINT_32: usize = 5;
pub(crate) const VARINT_64: usize = 10;
/// Most bytes of the length of a list; none has more than 16,383 entries.
pub(crate) const LENGTH: usize = 2;

/// The kind of a packet, read off its encoded bytes: COBS leaves the first byte where it is, behind its own, unless it is 0.
pub fn kind(encoded: &[u8]) -> Option<u8> {
    encoded.get(1).copied()
}

/// Write a packet to `out`, terminator included; returns the number of bytes.
///
/// # Errors
/// [`FrameError::Space`] if `out` is too small; [`wire_bytes`] of the largest body always suffice.
pub fn seal(kind: u8, body: &impl Serialize, out: &mut [u8]) -> Result<usize, FrameError> {
    let space = FrameError::Space { got: out.len() };
    // COBS adds a byte to every 254: with a gap of as many in front, what is written never overtakes what is still to be read
    let gap = 1 + out.len().saturating_sub(1) / 255;
    let plain = out.get_mut(gap..).ok_or(space)?;
    let (header, rest) = plain.split_first_chunk_mut::<HEADER>().ok_or(space)?;
    let length = postcard::to_slice(body, rest).map_err(|_| space)?.len();
    *header = [kind, length as u8, (length >> 8) as u8];
    let covered = HEADER + length;
    let crc = CRC.checksum(plain.get(..covered).ok_or(space)?);
    plain.get_mut(covered..covered + TRAILER).ok_or(space)?.copy_from_slice(&crc.to_le_bytes());
    stuff(out, gap, covered + TRAILER).ok_or(space)
}

/// Encode COBS in place: `length` plain bytes that stand `gap` from the front, the terminator added. Returns the number of
/// encoded bytes.
fn stuff(bytes: &mut [u8], gap: usize, length: usize) -> Option<usize> {
    let (mut state, mut end, mut code_is_due) = (EncoderState::default(), 1, true);
    for at in gap..gap + length {
        // after a full block of 254 the next one's code has no place yet: there may be none
        end += usize::from(!core::mem::replace(&mut code_is_due, true));
        match state.push(*bytes.get(at)?) {
            PushResult::AddSingle(byte) => *bytes.get_mut(end)? = byte,
            PushResult::ModifyFromStartAndSkip((code, value)) => *bytes.get_mut(code)? = value,
            PushResult::ModifyFromStartAndPushAndSkip((code, value, byte)) => {
                *bytes.get_mut(code)? = value;
                *bytes.get_mut(end)? = byte;
                code_is_due = false;
            }
        }
        end += 1;
    }
    if code_is_due {
        let (code, value) = state.finalize();
        *bytes.get_mut(code)? = value;
    }
    *bytes.get_mut(end)? = 0;
    Some(end + 1)
}

/// The bytes of a packet's body, its length, CRC and kind checked; `bytes` (with or without the terminating zero) is used
/// as work space.
///
/// # Errors
/// [`FrameError`].
pub fn open(expected: u8, limit: usize, bytes: &mut [u8]) -> Result<&[u8], FrameError> {
    if bytes.len() > limit {
        return Err(FrameError::Oversized { limit, got: bytes.len() });
    }
    let encoded = match bytes {
        [encoded @ .., 0] => encoded,
        encoded => encoded,
    };
    if encoded.is_empty() {
        return Err(FrameError::Truncated { need: HEADER + TRAILER, got: 0 });
    }
    // the decoder would stop at a zero within and drop what follows
    if encoded.contains(&0) {
        return Err(FrameError::Framing);
    }
    let length = unstuff(encoded).ok_or(FrameError::Framing)?;
    checked(encoded.get(..length).ok_or(FrameError::Framing)?, expected)
}

/// Decode COBS in place, byte by byte: the library's own loop over a whole buffer holds index checks that can panic.
fn unstuff(bytes: &mut [u8]) -> Option<usize> {
    let (mut state, mut length) = (DecoderState::Idle, 0);
    for at in 0..bytes.len() {
        if let DecodeResult::DataContinue(byte) = state.feed(*bytes.get(at)?).ok()? {
            *bytes.get_mut(length)? = byte;
            length += 1;
        }
    }
    matches!(state.feed(0), Ok(DecodeResult::DataComplete)).then_some(length)
}

/// What all of these bytes say.
///
/// # Errors
/// [`FrameError::Malformed`] if they are not of this type, or there are more.
pub fn whole<'b, T: Deserialize<'b>>(body: &'b [u8]) -> Result<T, FrameError> {
    match postcard::take_from_bytes(body) {
        Ok((body, [])) => Ok(body),
        _ => Err(FrameError::Malformed),
    }
}

/// The body, if length, CRC and kind are right.
fn checked(plain: &[u8], expected: u8) -> Result<&[u8], FrameError> {
    let (&[kind, low, high], rest) = plain
        .split_first_chunk::<HEADER>()
        .ok_or(FrameError::Truncated { need: HEADER + TRAILER, got: plain.len() })?;
    let need = HEADER + usize::from(u16::from_le_bytes([low, high])) + TRAILER;
    if plain.len() < need {
        return Err(FrameError::Truncated { need, got: plain.len() });
    }
    if plain.len() > need {
        return Err(FrameError::Oversized { limit: need, got: plain.len() });
    }
    let (body, trailer) = rest.split_last_chunk::<TRAILER>().ok_or(FrameError::Truncated { need, got: plain.len() })?;
    let stated = u32::from_le_bytes(*trailer);
    let mut digest = CRC.digest();
    digest.update(&[kind, low, high]);
    digest.update(body);
    let computed = digest.finalize();
    if stated != computed {
        return Err(FrameError::Corrupted { stated, computed });
    }
    if kind != expected {
        return Err(FrameError::Version { supported: expected, got: kind });
    }
    Ok(body)
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::*;

    const MOST: usize = wire_bytes(64);

    #[test]
    fn a_body_survives_and_its_kind_shows() {
        let mut out = [0; MOST];
        let body = [7_u32, 0, 300];
        let n = seal(0x11, &body, &mut out).unwrap();
        assert_eq!(kind(&out[..n]), Some(0x11));
        assert_eq!(open(0x11, MOST, &mut { out }[..n]).and_then(whole), Ok(body));
        let other = FrameError::Version { supported: 1, got: 0x11 };
        assert_eq!(open(1, MOST, &mut { out }[..n]), Err(other));
        assert_eq!(open(0x11, MOST, &mut out[..n]).and_then(whole::<[u32; 2]>), Err(FrameError::Malformed));
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        assert_eq!(seal(1, &[[1_u8; 32]; 32], &mut [0; 100]), Err(FrameError::Space { got: 100 }));
        assert_eq!(seal(1, &1_u8, &mut []), Err(FrameError::Space { got: 0 }));
        assert_eq!(kind(&[]), None);
    }

    /// In place, from the smallest buffer that is promised to suffice, for lengths about those of COBS's blocks.
    #[test]
    fn bodies_of_every_length_survive_in_the_smallest_buffer() {
        for length in (0..1100).chain(65_000..65_010) {
            for zeros in [usize::MAX, 1, 7] {
                let body: std::vec::Vec<u8> = (0..length).map(|i| u8::from((i + 1) % zeros != 0)).collect();
                let raw = Raw(&body);
                let mut out = std::vec![9; wire_bytes(length)];
                let n = seal(3, &raw, &mut out).unwrap();
                assert!(out[..n - 1].iter().all(|byte| *byte != 0) && out[n - 1] == 0, "{length}");
                assert_eq!(open(3, n, &mut out[..n]), Ok(body.as_slice()), "{length}");
            }
        }
    }

    /// Bytes as they are.
    struct Raw<'b>(&'b [u8]);

    impl Serialize for Raw<'_> {
        fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
            use serde::ser::SerializeTuple as _;
            let mut tuple = serializer.serialize_tuple(self.0.len())?;
            self.0.iter().try_for_each(|byte| tuple.serialize_element(byte))?;
            tuple.end()
        }
    }
}
