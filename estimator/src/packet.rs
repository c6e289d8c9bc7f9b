//! The envelope of everything on the wire: COBS, then kind, length, body in postcard, CRC. Frames are one kind; a device's
//! requests and replies are others.
//!
//! COBS gives boundaries, not integrity: without the CRC a flipped bit decodes as a good body.

use cobs::{DecodeResult, DecoderState};
use serde::{Deserialize, Serialize};

use crate::frame::FrameError;

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

/// Bytes in front of the body: kind and length.
pub(crate) const HEADER: usize = 3;
/// Bytes of the CRC.
pub(crate) const TRAILER: usize = 4;
/// Largest packet before COBS.
pub const MAX_BYTES: usize = 1536;
/// A buffer of this many bytes holds any packet.
pub const MAX_WIRE_BYTES: usize = cobs::max_encoding_length(MAX_BYTES) + 1;

/// The kind of a packet, read off its encoded bytes: COBS leaves the first byte where it is, behind its own, unless it is 0.
pub fn kind(encoded: &[u8]) -> Option<u8> {
    encoded.get(1).copied()
}

/// Write a packet to `out`, terminator included; returns the number of bytes.
///
/// # Errors
/// [`FrameError::Space`] if `out` is too small, or the body larger than any packet.
pub fn seal(kind: u8, body: &impl Serialize, out: &mut [u8]) -> Result<usize, FrameError> {
    let space = FrameError::Space { got: out.len() };
    let mut plain = [0u8; MAX_BYTES];
    let (header, rest) = plain.split_at_mut(HEADER);
    let length = postcard::to_slice(body, rest).map_err(|_| space)?.len();
    header.copy_from_slice(&[kind, length as u8, (length >> 8) as u8]);
    let covered = HEADER + length;
    let crc = CRC.checksum(plain.get(..covered).ok_or(space)?);
    plain.get_mut(covered..covered + TRAILER).ok_or(space)?.copy_from_slice(&crc.to_le_bytes());
    let plain = plain.get(..covered + TRAILER).ok_or(space)?;
    if out.len() <= cobs::max_encoding_length(plain.len()) {
        return Err(space);
    }
    let written = cobs::encode(plain, out);
    *out.get_mut(written).ok_or(space)? = 0;
    Ok(written + 1)
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

/// A packet's body.
///
/// # Errors
/// [`FrameError`]; [`FrameError::Malformed`] if the body is sound but not of this type.
pub fn unseal<'b, T: Deserialize<'b>>(kind: u8, bytes: &'b mut [u8]) -> Result<T, FrameError> {
    match postcard::take_from_bytes(open(kind, MAX_WIRE_BYTES, bytes)?) {
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
    use super::*;

    #[test]
    fn a_body_survives_and_its_kind_shows() {
        let mut out = [0; MAX_WIRE_BYTES];
        let body = [7_u32, 0, 300];
        let n = seal(0x11, &body, &mut out).unwrap();
        assert_eq!(kind(&out[..n]), Some(0x11));
        assert_eq!(unseal(0x11, &mut { out }[..n]), Ok(body));
        assert_eq!(unseal::<[u32; 3]>(1, &mut { out }[..n]), Err(FrameError::Version { supported: 1, got: 0x11 }));
        assert_eq!(unseal::<[u32; 2]>(0x11, &mut out[..n]), Err(FrameError::Malformed));
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        assert_eq!(seal(1, &[[1_u8; 32]; 32], &mut [0; 100]), Err(FrameError::Space { got: 100 }));
        assert_eq!(kind(&[]), None);
    }
}
