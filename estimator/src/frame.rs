//! One machine cycle as the front end sends it. The bytes of a worked example stand in `docs/frame.md`.
//!
//! On the wire a frame is COBS-encoded and ends with a zero byte. Inside: version (1 byte), length of the body (2 bytes,
//! little endian), the body in postcard, and the CRC-32 (ISO-HDLC, 4 bytes, little endian) of all that; see `packet.rs`.

use core::fmt;

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::packet;

/// Largest decoded frame; the largest body of 64 monitors and 64 correctors is 719 bytes.
const MAX_BYTES: usize = 768;

macro_rules! code {
    ($(#[$doc:meta])* $name:ident, $unit:ident = $lsb:literal, limit $limit:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
        pub struct $name(i32);

        impl $name {
            /// Size of one step, in the unit of the value.
            pub const $unit: f32 = $lsb;
            /// Largest magnitude, in steps.
            pub const LIMIT: i32 = $limit;

            /// The code of this many steps, if it is within the limit.
            pub const fn try_new(steps: i32) -> Option<Self> {
                if steps >= -Self::LIMIT && steps <= Self::LIMIT { Some(Self(steps)) } else { None }
            }

            /// The code nearest to a value; none if that is beyond the limit or not a number.
            pub fn nearest(value: f64) -> Option<Self> {
                let steps = libm::round(value / $lsb);
                if libm::fabs(steps) <= Self::LIMIT as f64 { Some(Self(steps as i32)) } else { None }
            }

            /// Number of steps.
            pub const fn steps(self) -> i32 {
                self.0
            }

            /// The value, in the unit of the step.
            pub fn value(self) -> f32 {
                self.0 as f32 * Self::$unit
            }
        }
    };
}

code!(
    /// A beam position in steps of 0.1 um, within +-100 mm: offsets reach 10 mm, and jumps more.
    PositionCode, METRES_PER_LSB = 1e-7, limit 1_000_000
);
code!(
    /// A magnet or corrector current in steps of 0.1 mA, within +-10 kA.
    CurrentCode, AMPERES_PER_LSB = 1e-4, limit 100_000_000
);
code!(
    /// A relative offset of the RF frequency in steps of 1e-9, within +-1 %.
    RfCode, RATIO_PER_LSB = 1e-9, limit 10_000_000
);
code!(
    /// A fractional tune in steps of 1e-6, within 0..1.
    TuneCode, TURNS_PER_LSB = 1e-6, limit 1_000_000
);

/// Currents of the five main supplies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MagnetCurrents {
    /// Dipoles.
    pub dipole: CurrentCode,
    /// Horizontally focusing quadrupoles.
    pub qh: CurrentCode,
    /// Vertically focusing quadrupoles.
    pub qv: CurrentCode,
    /// Horizontal sextupoles.
    pub sh: CurrentCode,
    /// Vertical sextupoles.
    pub sv: CurrentCode,
}

/// One machine cycle: `B` monitors, `C` correctors. Every value is within its range by its type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame<const B: usize, const C: usize> {
    /// Number of the cycle; grows from frame to frame, with gaps where cycles were lost.
    pub sequence: u32,
    /// Time since the start of the stream [us].
    pub time_us: u64,
    /// Time within the cycle at which the orbit was read [us].
    pub cycle_time_us: u32,
    /// Read-backs of the correctors [C].
    pub corrector: [CurrentCode; C],
    /// Currents of the main supplies.
    pub magnets: MagnetCurrents,
    /// RF frequency relative to its nominal value.
    pub rf_offset: RfCode,
    /// Monitor readings [B]; meaningful where `valid` has a 1.
    pub reading: [PositionCode; B],
    /// Fractional tunes of the tune meter, x and y.
    pub tune: [Option<TuneCode>; 2],
    /// Bit `b` is 1 if monitor `b` reported.
    pub valid: u64,
}

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
        /// Its place in its list.
        index: usize,
        /// Largest magnitude, in steps.
        limit: i32,
        /// What stands there, in steps.
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

/// The body on the wire: lists carry their length, so that a frame of another machine is told from noise.
#[derive(Serialize, Deserialize)]
struct Body<const B: usize, const C: usize> {
    sequence: u32,
    time_us: u64,
    cycle_time_us: u32,
    corrector: Vec<i32, C>,
    magnets: [i32; 5],
    rf_offset: i32,
    reading: Vec<i32, B>,
    tune: [Option<i32>; 2],
    valid: u64,
}

/// What the body of any machine begins with; read when the lists do not fit this one.
#[derive(Deserialize)]
struct Lists {
    _sequence: u32,
    _time_us: u64,
    _cycle_time_us: u32,
    corrector: Vec<i32, 64>,
    _magnets: [i32; 5],
    _rf_offset: i32,
    reading: Vec<i32, 64>,
}

impl<const B: usize, const C: usize> Frame<B, C> {
    /// Version of the format.
    pub const VERSION: u8 = 1;
    /// A buffer of this many bytes holds any encoded frame.
    pub const MAX_WIRE_BYTES: usize = cobs::max_encoding_length(MAX_BYTES) + 1;

    const FITS: () = assert!(B <= 64 && C <= 64, "the validity mask of a frame is one u64, and a body 768 bytes");

    /// Write the frame to `out`, terminator included; returns the number of bytes.
    ///
    /// # Errors
    /// [`FrameError::Space`] if `out` is too small; [`Frame::MAX_WIRE_BYTES`] always suffice.
    pub fn encode(&self, out: &mut [u8]) -> Result<usize, FrameError> {
        let () = Self::FITS;
        packet::seal(Self::VERSION, &self.body(), out)
    }

    /// Read a frame from its bytes, with or without the terminating zero; `bytes` is used as work space.
    ///
    /// # Errors
    /// [`FrameError`]: COBS, length, CRC, version, counts and ranges are all checked here, and nowhere else.
    pub fn decode(bytes: &mut [u8]) -> Result<Self, FrameError> {
        let () = Self::FITS;
        let body = packet::open(Self::VERSION, Self::MAX_WIRE_BYTES, bytes)?;
        match postcard::take_from_bytes::<Body<B, C>>(body) {
            Ok((body, [])) => body.frame(),
            _ => Err(miscounted(body, B, C)),
        }
    }

    /// True if monitor `b` reported.
    pub fn is_valid(&self, b: usize) -> bool {
        b < B && self.valid >> b & 1 == 1
    }

    fn body(&self) -> Body<B, C> {
        let m = &self.magnets;
        Body {
            sequence: self.sequence,
            time_us: self.time_us,
            cycle_time_us: self.cycle_time_us,
            corrector: self.corrector.iter().map(|c| c.0).collect(),
            magnets: [m.dipole.0, m.qh.0, m.qv.0, m.sh.0, m.sv.0],
            rf_offset: self.rf_offset.0,
            reading: self.reading.iter().map(|r| r.0).collect(),
            tune: self.tune.map(|t| t.map(|t| t.0)),
            valid: self.valid,
        }
    }
}

/// Which list of a body with a good CRC does not fit this machine.
fn miscounted(body: &[u8], monitors: usize, correctors: usize) -> FrameError {
    let Ok((lists, _)) = postcard::take_from_bytes::<Lists>(body) else { return FrameError::Malformed };
    let (c, b) = (lists.corrector.len(), lists.reading.len());
    if c != correctors {
        FrameError::Count { list: "correctors", need: correctors, got: c }
    } else if b != monitors {
        FrameError::Count { list: "readings", need: monitors, got: b }
    } else {
        FrameError::Malformed
    }
}

impl<const B: usize, const C: usize> Body<B, C> {
    fn frame(&self) -> Result<Frame<B, C>, FrameError> {
        let current = |field, index, got| {
            CurrentCode::try_new(got).ok_or(FrameError::Range { field, index, limit: CurrentCode::LIMIT, got })
        };
        let [dipole, qh, qv, sh, sv] = self.magnets;
        Ok(Frame {
            sequence: self.sequence,
            time_us: self.time_us,
            cycle_time_us: self.cycle_time_us,
            corrector: list("correctors", &self.corrector, |i, got| current("corrector", i, got))?,
            magnets: MagnetCurrents {
                dipole: current("magnet", 0, dipole)?,
                qh: current("magnet", 1, qh)?,
                qv: current("magnet", 2, qv)?,
                sh: current("magnet", 3, sh)?,
                sv: current("magnet", 4, sv)?,
            },
            rf_offset: RfCode::try_new(self.rf_offset).ok_or(FrameError::Range {
                field: "rf offset",
                index: 0,
                limit: RfCode::LIMIT,
                got: self.rf_offset,
            })?,
            reading: list("readings", &self.reading, |index, got| {
                let beyond = FrameError::Range { field: "reading", index, limit: PositionCode::LIMIT, got };
                PositionCode::try_new(got).ok_or(beyond)
            })?,
            tune: [tune(0, self.tune[0])?, tune(1, self.tune[1])?],
            valid: self.valid,
        })
    }
}

fn tune(index: usize, got: Option<i32>) -> Result<Option<TuneCode>, FrameError> {
    let Some(got) = got else { return Ok(None) };
    let code = TuneCode::try_new(got).filter(|t| t.0 >= 0);
    code.map(Some).ok_or(FrameError::Range { field: "tune", index, limit: TuneCode::LIMIT, got })
}

/// A list of the right length, each entry within its range.
fn list<T: Copy + Default, const L: usize>(
    name: &'static str,
    from: &[i32],
    parse: impl Fn(usize, i32) -> Result<T, FrameError>,
) -> Result<[T; L], FrameError> {
    if from.len() != L {
        return Err(FrameError::Count { list: name, need: L, got: from.len() });
    }
    let mut to = [T::default(); L];
    for (i, (to, &from)) in to.iter_mut().zip(from).enumerate() {
        *to = parse(i, from)?;
    }
    Ok(to)
}

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec as Bytes;

    use super::*;
    use crate::packet::{HEADER, TRAILER};

    const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

    fn frame() -> Frame<2, 3> {
        Frame {
            sequence: 7,
            time_us: 28_000_000,
            cycle_time_us: 92_000,
            corrector: [220_000, -13, 5].map(CurrentCode),
            magnets: MagnetCurrents {
                dipole: CurrentCode(23_997_850),
                qh: CurrentCode(18_000_130),
                qv: CurrentCode(17_902_020),
                sh: CurrentCode(440),
                sv: CurrentCode(348),
            },
            rf_offset: RfCode(200_000),
            reading: [28_900, -18_666].map(PositionCode),
            tune: [Some(TuneCode(805_620)), None],
            valid: 0b11,
        }
    }

    fn wire() -> Bytes<u8> {
        let mut out = [0; Frame::<2, 3>::MAX_WIRE_BYTES];
        let n = frame().encode(&mut out).unwrap();
        out[..n].to_vec()
    }

    /// The plain bytes of a frame after a change, with a CRC that fits again.
    fn resealed(change: impl Fn(&mut Bytes<u8>)) -> Bytes<u8> {
        let mut plain = wire();
        let n = cobs::decode_in_place(&mut plain[..]).unwrap();
        plain.truncate(n - TRAILER);
        change(&mut plain);
        let body = (plain.len() - HEADER) as u16;
        plain[1..3].copy_from_slice(&body.to_le_bytes());
        let crc = CRC.checksum(&plain);
        plain.extend_from_slice(&crc.to_le_bytes());
        let mut out = std::vec![0; cobs::max_encoding_length(plain.len()) + 1];
        let n = cobs::encode(&plain, &mut out);
        out.truncate(n + 1);
        out
    }

    #[test]
    fn a_frame_survives_the_wire() {
        assert_eq!(Frame::decode(&mut wire()), Ok(frame()));
        let mut bare = wire();
        bare.pop();
        assert_eq!(Frame::decode(&mut bare), Ok(frame()), "without its terminator");
    }

    /// The bytes that `docs/frame.md` explains.
    #[test]
    fn the_worked_example_has_these_bytes() {
        let hex: std::string::String = wire().iter().map(|b| std::format!("{b:02x} ")).collect();
        let page = include_str!("../../docs/frame.md");
        let shown: Bytes<&str> =
            page.split("```text\n").nth(1).unwrap().split("```").next().unwrap().split_whitespace().collect();
        assert_eq!(shown.join(" "), hex.trim_end());
    }

    #[test]
    fn every_flipped_bit_is_an_error() {
        for at in 0..wire().len() * 8 {
            let mut bytes = wire();
            bytes[at / 8] ^= 1 << (at % 8);
            if at / 8 == bytes.len() - 1 {
                continue; // the terminator belongs to the stream, not to the frame
            }
            assert!(Frame::<2, 3>::decode(&mut bytes).is_err(), "bit {at}");
        }
    }

    #[test]
    fn every_truncation_is_an_error() {
        for n in 0..wire().len() - 1 {
            assert!(Frame::<2, 3>::decode(&mut wire()[..n].to_vec()).is_err(), "{n} bytes");
        }
    }

    #[test]
    fn each_fault_has_its_own_error() {
        let decode = |mut bytes: Bytes<u8>| Frame::<2, 3>::decode(&mut bytes).unwrap_err();
        assert!(matches!(decode(std::vec![1; 5000]), FrameError::Oversized { got: 5000, .. }));
        assert!(matches!(decode(std::vec![9, 1]), FrameError::Framing));
        assert!(matches!(decode(std::vec![]), FrameError::Truncated { got: 0, .. }));
        assert_eq!(decode(resealed(|p| p[0] = 2)), FrameError::Version { supported: 1, got: 2 });
        let longer = resealed(|p| p.push(0));
        assert_eq!(decode(longer), FrameError::Malformed);
        let other_machine = Frame { reading: [PositionCode(1); 4], corrector: frame().corrector, ..blank() };
        let mut out = [0; Frame::<4, 3>::MAX_WIRE_BYTES];
        let n = other_machine.encode(&mut out).unwrap();
        assert_eq!(decode(out[..n].to_vec()), FrameError::Count { list: "readings", need: 2, got: 4 });
        let far = Frame { reading: [PositionCode(0), PositionCode(2_000_000)], ..frame() };
        let n = far.encode(&mut out).unwrap();
        assert_eq!(
            decode(out[..n].to_vec()),
            FrameError::Range { field: "reading", index: 1, limit: 1_000_000, got: 2_000_000 }
        );
        assert_eq!(frame().encode(&mut [0; 20]), Err(FrameError::Space { got: 20 }));
    }

    fn blank<const B: usize>() -> Frame<B, 3> {
        Frame {
            sequence: 0,
            time_us: 0,
            cycle_time_us: 0,
            corrector: [CurrentCode(0); 3],
            magnets: MagnetCurrents::default(),
            rf_offset: RfCode(0),
            reading: [PositionCode(0); B],
            tune: [None; 2],
            valid: 0,
        }
    }

    #[test]
    fn the_largest_frame_fits() {
        let full = Frame::<64, 64> {
            sequence: u32::MAX,
            time_us: u64::MAX,
            cycle_time_us: u32::MAX,
            corrector: [CurrentCode(i32::MIN); 64],
            magnets: MagnetCurrents {
                dipole: CurrentCode(i32::MIN),
                qh: CurrentCode(i32::MIN),
                qv: CurrentCode(i32::MIN),
                sh: CurrentCode(i32::MIN),
                sv: CurrentCode(i32::MIN),
            },
            rf_offset: RfCode(i32::MIN),
            reading: [PositionCode(i32::MIN); 64],
            tune: [Some(TuneCode(i32::MIN)); 2],
            valid: u64::MAX,
        };
        assert!(full.encode(&mut [0; Frame::<64, 64>::MAX_WIRE_BYTES]).is_ok());
    }

    #[test]
    fn codes_round_to_the_nearest_step() {
        assert_eq!(PositionCode::nearest(-1.8666e-3).map(PositionCode::steps), Some(-18_666));
        assert_eq!(PositionCode::nearest(0.2), None);
        assert_eq!(PositionCode::nearest(f64::NAN), None);
    }
}
