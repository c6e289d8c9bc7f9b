//! What a line, a front end or a stranger can make of a packet.

use estimator::booster::{CORRECTORS, Frame, MONITORS, SUPPLIES};
use estimator::{CurrentCode, FrameError, IngestError, IntensityCode, PositionCode, RfCode, TuneCode};
use serde::{Deserialize, Serialize};

use crate::machine::{ALL, LAYOUT, Random, wire_of};

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);
/// Bytes in front of a packet's body, and behind it.
const ENVELOPE: (usize, usize) = (3, 4);

/// The body of a frame, whatever it says: beyond its ranges, of other lengths.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)] // those of `Frame`
pub struct Body {
    pub epoch: u32,
    pub sequence: u32,
    pub time_us: u64,
    pub cycle_time_us: u32,
    pub corrector: Vec<i32>,
    pub dipole: i32,
    pub supply: Vec<i32>,
    pub rf_offset: i32,
    pub reading: Vec<i32>,
    pub tune: [Option<i32>; 2],
    pub intensity: Option<i32>,
    pub valid: Vec<u32>,
}

impl Body {
    /// A frame that would be good.
    pub fn good(sequence: u32) -> Self {
        Self {
            epoch: 0,
            sequence,
            time_us: 1,
            cycle_time_us: 2,
            corrector: vec![0; CORRECTORS],
            dipole: 23_997_850,
            supply: vec![17_997_850; SUPPLIES],
            rf_offset: 0,
            reading: vec![1000; MONITORS],
            tune: [Some(800_000), None],
            intensity: None,
            valid: ALL.to_vec(),
        }
    }

    /// That of a frame on the wire.
    ///
    /// # Panics
    /// If it is none.
    pub fn of(wire: &[u8]) -> Self {
        let plain = plain(wire);
        postcard::from_bytes(&plain[ENVELOPE.0..plain.len() - ENVELOPE.1]).expect("the body of a frame")
    }

    /// As a packet.
    pub fn wire(&self) -> Vec<u8> {
        sealed(Frame::VERSION, &serialised(self))
    }
}

/// In postcard.
///
/// # Panics
/// If it is larger than any packet.
pub fn serialised(body: &impl Serialize) -> Vec<u8> {
    postcard::to_slice(body, &mut [0; 4096]).expect("room for any body").to_vec()
}

/// A packet of any kind and body whose length and CRC are right.
pub fn sealed(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut plain = vec![kind, body.len() as u8, (body.len() >> 8) as u8];
    plain.extend_from_slice(body);
    plain.extend_from_slice(&CRC.checksum(&plain).to_le_bytes());
    framed(&plain)
}

/// In COBS.
pub fn framed(plain: &[u8]) -> Vec<u8> {
    let mut wire = vec![0; cobs::max_encoding_length(plain.len()) + 1];
    let n = cobs::encode(plain, &mut wire);
    wire.truncate(n);
    wire.push(0); // what stands there need not be one, after a full block
    wire
}

/// What stands in a packet, without COBS.
///
/// # Panics
/// If it is none.
pub fn plain(wire: &[u8]) -> Vec<u8> {
    let mut plain = wire[..wire.len() - 1].to_vec();
    let n = cobs::decode_in_place(&mut plain).expect("COBS");
    plain.truncate(n);
    plain
}

/// The CRC of whatever these bytes hold is right.
pub fn is_sealed(wire: &[u8]) -> bool {
    let mut plain = wire.strip_suffix(&[0]).unwrap_or(wire).to_vec();
    let decoded = cobs::decode_in_place(&mut plain).ok().and_then(|n| plain.get(..n));
    decoded
        .and_then(<[u8]>::split_last_chunk::<4>)
        .is_some_and(|(covered, crc)| CRC.checksum(covered).to_le_bytes() == *crc)
}

/// A frame that would be good but for the lengths of its lists.
fn miscounted(sequence: u32, monitors: usize, correctors: usize) -> Vec<u8> {
    let (reading, corrector) = (vec![1000; monitors], vec![-5; correctors]);
    let valid = vec![u32::MAX; monitors.div_ceil(32)];
    Body { reading, corrector, valid, tune: [None; 2], ..Body::good(sequence) }.wire()
}

/// A frame that would be good but for one value.
fn beyond(sequence: u32, random: &mut Random) -> Vec<u8> {
    let mut body = Body::good(sequence);
    let far = |limit: i32, random: &mut Random| match random.below(4) {
        0 => i32::MIN, // what a front end may write for "no number"
        1 => i32::MAX,
        other => {
            let steps = limit + 1 + random.below((i32::MAX - limit) as usize) as i32;
            if other == 2 { steps } else { -steps }
        }
    };
    match random.below(8) {
        0 => body.corrector[random.below(CORRECTORS)] = far(CurrentCode::LIMIT, random),
        1 => body.dipole = far(CurrentCode::LIMIT, random),
        2 => body.supply[random.below(SUPPLIES)] = far(CurrentCode::LIMIT, random),
        3 => body.rf_offset = far(RfCode::LIMIT, random),
        4 => body.reading[random.below(MONITORS)] = far(PositionCode::LIMIT, random),
        5 => body.tune[random.below(2)] = Some(far(TuneCode::LIMIT, random)),
        6 => body.intensity = Some(far(IntensityCode::LIMIT, random)),
        _ => body.tune[random.below(2)] = Some(-1),
    }
    body.wire()
}

/// Kinds of faulty frames.
pub const FAULTS: usize = 20;

/// A faulty frame between two good ones, and whether an error is the one to expect of it. `first` is the stream's first frame.
///
/// # Panics
/// If a frame is none.
pub fn faulty(
    fault: usize,
    last: &[u8],
    next: &[u8],
    first: &[u8],
    random: &mut Random,
) -> (Vec<u8>, fn(&IngestError) -> bool) {
    use FrameError::{Corrupted, Count, Framing, Malformed, Oversized, Range, Truncated, Version};
    use IngestError::{Beyond, Frame as Of, OutOfOrder, Repeated};
    let garbled: fn(&IngestError) -> bool =
        |e| matches!(e, Of(Framing | Truncated { .. } | Oversized { .. } | Corrupted { .. }));
    let sequence = i32::MAX as u32 - random.below(1000) as u32;
    let mut bytes = next.to_vec();
    let n = bytes.len() - 1;
    match fault {
        0 => {
            bytes.truncate(random.below(n));
            (bytes, |e| matches!(e, Of(Framing | Truncated { .. })))
        }
        1 => {
            bytes[random.below(n)] ^= 1 << random.below(8);
            (bytes, garbled)
        }
        2 => {
            for _ in 0..2 + random.below(20) {
                bytes[random.below(n)] ^= 1 + (random.byte() & 0x7f);
            }
            (bytes, garbled)
        }
        3 => {
            let (i, j) = loop {
                let (i, j) = (random.below(n), random.below(n));
                if bytes[i] != bytes[j] {
                    break (i, j);
                }
            };
            bytes.swap(i, j);
            (bytes, garbled)
        }
        4 => ((0..random.below(600)).map(|_| random.byte()).collect(), garbled),
        5 => {
            let long = Frame::MAX_WIRE_BYTES + 1 + random.below(3000);
            ((0..long).map(|_| random.byte()).collect(), |e| {
                matches!(e, Of(Oversized { limit: Frame::MAX_WIRE_BYTES, .. }))
            })
        }
        6 => {
            let mut plain = plain(next);
            plain.extend((0..1 + random.below(20)).map(|_| random.byte()));
            (framed(&plain), |e| matches!(e, Of(Oversized { limit, got }) if got > limit))
        }
        7 => (Vec::new(), |e| *e == Of(Truncated { need: 7, got: 0 })),
        8 => (vec![0; 2 + random.below(400)], |e| *e == Of(Framing)),
        9 => {
            let (plain, other) = (plain(next), 4 + random.below(252) as u8);
            (sealed(other, &plain[3..plain.len() - 4]), |e| matches!(e, Of(Version { supported: 3, .. })))
        }
        10 => {
            let (monitors, correctors) = [(33, 47), (33, 49), (32, 48), (34, 48), (0, 0), (40, 40)][random.below(6)];
            (miscounted(sequence, monitors, correctors), |e| matches!(e, Of(Count { .. })))
        }
        11 => (beyond(sequence, random), |e| matches!(e, Of(Range { .. }))),
        12 => {
            let mut plain = plain(next);
            plain.truncate(plain.len() - 5); // the last byte of the mask
            (sealed(Frame::VERSION, &plain[3..]), |e| *e == Of(Malformed))
        }
        13 => (last.to_vec(), |e| matches!(e, Repeated { .. })),
        14 => (first.to_vec(), |e| matches!(e, OutOfOrder { .. } | Repeated { .. })),
        15 => {
            let mut frame = Frame::decode(&LAYOUT, &mut bytes).expect("a good frame");
            let current = |steps| CurrentCode::try_new(steps).expect("within the range");
            match random.below(4) {
                0 => frame.magnets.dipole = CurrentCode::default(),
                1 => frame.magnets.supply[1] = current(-17_900_000),
                2 => frame.corrector = [current(CurrentCode::LIMIT); CORRECTORS],
                _ => frame.rf_offset = RfCode::try_new(-RfCode::LIMIT).expect("within the range"),
            }
            frame.sequence = sequence;
            (wire_of(&frame), |e| matches!(e, Beyond(_)))
        }
        16 => ([&last[..last.len() - 1], next].concat(), garbled),
        17 => {
            // bytes that were lost
            let (at, lost) = (random.below(n - 5), 1 + random.below(5));
            ([&next[..at], &next[at + lost..]].concat(), garbled)
        }
        18 => {
            // bytes that came twice
            let (at, twice) = (random.below(n - 5), 1 + random.below(5));
            ([&next[..at + twice], &next[at..]].concat(), garbled)
        }
        _ => {
            let cut = n / 4 + random.below(n / 2);
            ([&last[..cut.min(last.len() - 1)], &next[cut..]].concat(), garbled)
        }
    }
}
