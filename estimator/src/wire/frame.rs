//! One machine cycle as the front end sends it. The bytes of a worked example stand in `docs/frame.md`.
//!
//! On the wire a frame is COBS-encoded and ends with a zero byte. Inside: version (1 byte), length of the body (2 bytes,
//! little endian), the body in postcard, and the CRC-32 (ISO-HDLC, 4 bytes, little endian) of all that; see `packet.rs`.

use core::fmt;

use heapless::Vec;
use serde::de::{SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::packet::{self, LENGTH, VARINT_32, VARINT_64};
use super::{FrameError, listed};
use crate::mask::Mask;
use crate::sizes::Layout;
use crate::state::{Blank, Bytes, State, StateError};

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

            /// No step.
            pub const ZERO: Self = Self(0);

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

        impl State for $name {
            fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
                let mut steps = self.0;
                steps.pass(bytes)?;
                let error = StateError::Value { what: stringify!($name), got: steps as u32 };
                *self = Self::try_new(steps).ok_or(error)?;
                Ok(())
            }
        }

        impl Blank for $name {
            const BLANK: Self = Self::ZERO;
        }
    };
}

code!(
    /// A beam position in steps of 0.1 um, within ±100 mm: offsets reach 10 mm, and jumps more.
    PositionCode, METRES_PER_LSB = 1e-7, limit 1_000_000
);
impl PositionCode {
    /// This position moved by so much [m], up to the limit.
    pub fn moved(self, by: f32) -> Self {
        let steps = self.0.saturating_add(libm::roundf(by / Self::METRES_PER_LSB) as i32);
        Self(steps.clamp(-Self::LIMIT, Self::LIMIT))
    }
}

code!(
    /// A magnet or corrector current in steps of 0.1 mA, within ±10 kA.
    CurrentCode, AMPERES_PER_LSB = 1e-4, limit 100_000_000
);

/// On the wire a current is its number of steps.
impl Serialize for CurrentCode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.0.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for CurrentCode {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let beyond = || serde::de::Error::custom("a current beyond its range");
        Self::try_new(i32::deserialize(deserializer)?).ok_or_else(beyond)
    }
}

code!(
    /// A relative offset of the RF frequency in steps of 1e-9, within ±1 %.
    RfCode, RATIO_PER_LSB = 1e-9, limit 10_000_000
);
code!(
    /// A fractional tune in steps of 1e-6, within 0..1.
    TuneCode, TURNS_PER_LSB = 1e-6, limit 1_000_000
);

code!(
    /// A number of particles in steps of 1e6, up to 2e15.
    IntensityCode, PARTICLES_PER_LSB = 1e6, limit 2_000_000_000
);

/// Currents of the main supplies: the dipoles', and `F` of quadrupoles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MagnetCurrents<const F: usize> {
    /// Dipoles.
    pub dipole: CurrentCode,
    /// Supplies of quadrupoles.
    pub supply: [CurrentCode; F],
}

/// One machine cycle: `B` monitors, `C` correctors, `F` supplies, `W` words for as many bits as there are monitors. Every
/// value is within its range by its type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame<const B: usize, const C: usize, const F: usize, const W: usize> {
    /// Which life of the front end counts the cycles: larger after each restart of it.
    pub epoch: u32,
    /// Number of the cycle; grows from frame to frame, with gaps where cycles were lost, and begins at 0 again after the last
    /// number there is.
    pub sequence: u32,
    /// Time since the start of the stream [us].
    pub time_us: u64,
    /// Time within the cycle at which the orbit was read [us].
    pub cycle_time_us: u32,
    /// Read-backs of the correctors [C].
    pub corrector: [CurrentCode; C],
    /// Currents of the main supplies.
    pub magnets: MagnetCurrents<F>,
    /// RF frequency relative to its nominal value.
    pub rf_offset: RfCode,
    /// Monitor readings [B]; meaningful where `valid` has a 1.
    pub reading: [PositionCode; B],
    /// Fractional tunes of the tune meter, x and y.
    pub tune: [Option<TuneCode>; 2],
    /// Beam intensity.
    pub intensity: Option<IntensityCode>,
    /// Bit `b` is 1 if monitor `b` reported.
    pub valid: Mask<W>,
}

/// The body on the wire: lists carry their length, so that a frame of another machine is told from damage.
#[derive(Serialize, Deserialize)]
struct Body<const B: usize, const C: usize, const F: usize, const W: usize> {
    epoch: u32,
    sequence: u32,
    time_us: u64,
    cycle_time_us: u32,
    corrector: Vec<i32, C>,
    dipole: i32,
    supply: Vec<i32, F>,
    rf_offset: i32,
    reading: Vec<i32, B>,
    tune: [Option<i32>; 2],
    intensity: Option<i32>,
    valid: Vec<u32, W>,
}

/// What the body of any machine begins with; read when the lists do not fit this one.
#[derive(Deserialize)]
struct Lists {
    _epoch: u32,
    _sequence: u32,
    _time_us: u64,
    _cycle_time_us: u32,
    corrector: Counted,
    _dipole: i32,
    supply: Counted,
    _rf_offset: i32,
    reading: Counted,
}

/// A list of whole numbers of which only the length is kept.
struct Counted(usize);

impl<'de> Deserialize<'de> for Counted {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Count;
        impl<'de> Visitor<'de> for Count {
            type Value = Counted;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a list")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Counted, A::Error> {
                let mut count = 0;
                while list.next_element::<i32>()?.is_some() {
                    count += 1;
                }
                Ok(Counted(count))
            }
        }
        deserializer.deserialize_seq(Count)
    }
}

impl<const B: usize, const C: usize, const F: usize, const W: usize> Frame<B, C, F, W> {
    /// Version of the format.
    pub const VERSION: u8 = 3;
    /// Largest body: every number at its longest.
    pub const MAX_BYTES: usize = VARINT_32 * (C + F + B + W + 5) + VARINT_64 + 3 * (1 + VARINT_32) + 4 * LENGTH;
    /// A buffer of this many bytes holds any encoded frame.
    pub const MAX_WIRE_BYTES: usize = packet::wire_bytes(Self::MAX_BYTES);

    const FITS: () = assert!(W >= crate::mask::words(B), "W words have a bit for each of B monitors");

    /// Write the frame of a ring to `out`, terminator included; returns the number of bytes. Spare slots are not sent.
    ///
    /// # Errors
    /// [`FrameError::Space`] if `out` is too small; [`Frame::MAX_WIRE_BYTES`] always suffice.
    pub fn encode(&self, layout: &Layout, out: &mut [u8]) -> Result<usize, FrameError> {
        let () = Self::FITS;
        packet::seal(Self::VERSION, &self.body(layout), out)
    }

    /// Read the frame of a ring from its bytes, with or without the terminating zero; `bytes` is used as work space.
    ///
    /// # Errors
    /// [`FrameError`]: COBS, length, CRC, version, counts and ranges are all checked here, and nowhere else.
    pub fn decode(layout: &Layout, bytes: &mut [u8]) -> Result<Self, FrameError> {
        let () = Self::FITS;
        let body = packet::open(Self::VERSION, Self::MAX_WIRE_BYTES, bytes)?;
        match postcard::take_from_bytes::<Body<B, C, F, W>>(body) {
            Ok((body, [])) => body.frame(layout),
            _ => Err(miscounted(body, layout)),
        }
    }

    fn body(&self, layout: &Layout) -> Body<B, C, F, W> {
        let mut valid = Mask::<W>::NONE;
        let monitors = 0..layout.monitors();
        monitors.clone().for_each(|b| valid.put(b, self.valid.has(layout.monitor(b))));
        Body {
            epoch: self.epoch,
            sequence: self.sequence,
            time_us: self.time_us,
            cycle_time_us: self.cycle_time_us,
            corrector: listed(
                (0..layout.correctors()).filter_map(|c| self.corrector.get(layout.corrector(c))).map(|c| c.0),
            ),
            dipole: self.magnets.dipole.0,
            supply: listed(self.magnets.supply.iter().take(layout.supplies()).map(|s| s.0)),
            rf_offset: self.rf_offset.0,
            reading: listed(monitors.filter_map(|b| self.reading.get(layout.monitor(b))).map(|r| r.0)),
            tune: self.tune.map(|t| t.map(|t| t.0)),
            intensity: self.intensity.map(|i| i.0),
            valid: listed(valid.as_words().iter().take(crate::mask::words(layout.monitors())).copied()),
        }
    }
}

/// Which list of a body with a good CRC does not fit this machine.
fn miscounted(body: &[u8], layout: &Layout) -> FrameError {
    let Ok((lists, _)) = postcard::take_from_bytes::<Lists>(body) else { return FrameError::Malformed };
    let counts = [
        ("correctors", layout.correctors(), lists.corrector.0),
        ("supplies", layout.supplies(), lists.supply.0),
        ("readings", layout.monitors(), lists.reading.0),
    ];
    let wrong = counts.into_iter().find(|(_, need, got)| need != got);
    wrong.map_or(FrameError::Malformed, |(list, need, got)| FrameError::Count { list, need, got })
}

impl<const B: usize, const C: usize, const F: usize, const W: usize> Body<B, C, F, W> {
    fn frame(&self, layout: &Layout) -> Result<Frame<B, C, F, W>, FrameError> {
        let mut valid = Mask::NONE;
        let sent = Mask::<W>::from_words(&self.valid);
        (0..layout.monitors()).for_each(|b| valid.put(layout.monitor(b), sent.has(b)));
        let (mut corrector, mut supply, mut reading) = ([CurrentCode(0); C], [CurrentCode(0); F], [PositionCode(0); B]);
        place(
            &mut corrector,
            ("correctors", layout.correctors(), &self.corrector),
            |c| layout.corrector(c),
            |c, got| current("corrector", c, got),
        )?;
        place(&mut supply, ("supplies", layout.supplies(), &self.supply), |f| f, |f, got| current("supply", f, got))?;
        place(
            &mut reading,
            ("readings", layout.monitors(), &self.reading),
            |b| layout.monitor(b),
            |index, got| {
                let beyond = FrameError::Range { field: "reading", index, limit: PositionCode::LIMIT, got };
                // of a monitor that did not report the reading means nothing, whatever it is
                let unread = (!sent.has(index)).then(PositionCode::default);
                PositionCode::try_new(got).or(unread).ok_or(beyond)
            },
        )?;
        // after the lists, whose counts say more
        if self.valid.len() != crate::mask::words(layout.monitors()) {
            return Err(FrameError::Malformed);
        }
        let got = self.rf_offset;
        let beyond = FrameError::Range { field: "rf offset", index: 0, limit: RfCode::LIMIT, got };
        Ok(Frame {
            epoch: self.epoch,
            sequence: self.sequence,
            time_us: self.time_us,
            cycle_time_us: self.cycle_time_us,
            corrector,
            magnets: MagnetCurrents { dipole: current("dipole", 0, self.dipole)?, supply },
            rf_offset: RfCode::try_new(got).ok_or(beyond)?,
            reading,
            tune: [tune(0, self.tune[0])?, tune(1, self.tune[1])?],
            intensity: intensity(self.intensity)?,
            valid,
        })
    }
}

fn current(field: &'static str, index: usize, got: i32) -> Result<CurrentCode, FrameError> {
    CurrentCode::try_new(got).ok_or(FrameError::Range { field, index, limit: CurrentCode::LIMIT, got })
}

fn tune(index: usize, got: Option<i32>) -> Result<Option<TuneCode>, FrameError> {
    let Some(got) = got else { return Ok(None) };
    let code = TuneCode::try_new(got).filter(|t| t.0 >= 0);
    code.map(Some).ok_or(FrameError::Range { field: "tune", index, limit: TuneCode::LIMIT, got })
}

fn intensity(got: Option<i32>) -> Result<Option<IntensityCode>, FrameError> {
    let Some(got) = got else { return Ok(None) };
    let code = IntensityCode::try_new(got).filter(|i| i.0 >= 0);
    code.map(Some).ok_or(FrameError::Range { field: "intensity", index: 0, limit: IntensityCode::LIMIT, got })
}

/// A list of the right length, each entry within its range, to its slots.
fn place<T>(
    to: &mut [T],
    (list, need, from): (&'static str, usize, &[i32]),
    slot: impl Fn(usize) -> usize,
    parse: impl Fn(usize, i32) -> Result<T, FrameError>,
) -> Result<(), FrameError> {
    if from.len() != need {
        return Err(FrameError::Count { list, need, got: from.len() });
    }
    for (i, &from) in from.iter().enumerate() {
        let value = parse(i, from)?;
        if let Some(to) = to.get_mut(slot(i)) {
            *to = value;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec as Bytes;

    use super::*;
    use crate::sizes::Sizes;

    const HEADER: usize = 3;
    const TRAILER: usize = 4;
    type Small = Frame<2, 3, 2, 1>;
    const LAYOUT: Layout = whole([1, 1], [2, 1]);

    const fn whole(monitors: [usize; 2], correctors: [usize; 2]) -> Layout {
        let sizes = Sizes::new(monitors, correctors, [2; 3]);
        Layout { ring: sizes, room: sizes }
    }

    const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

    fn frame() -> Small {
        Frame {
            epoch: 1,
            sequence: 7,
            time_us: 28_000_000,
            cycle_time_us: 92_000,
            corrector: [220_000, -13, 5].map(CurrentCode),
            magnets: MagnetCurrents {
                dipole: CurrentCode(23_997_850),
                supply: [18_000_130, 17_902_020].map(CurrentCode),
            },
            rf_offset: RfCode(200_000),
            reading: [28_900, -18_666].map(PositionCode),
            tune: [Some(TuneCode(805_620)), None],
            intensity: Some(IntensityCode(4_500)),
            valid: Mask::from_words(&[0b11]),
        }
    }

    fn wire() -> Bytes<u8> {
        let mut out = [0; Small::MAX_WIRE_BYTES];
        let n = frame().encode(&LAYOUT, &mut out).unwrap();
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
        assert_eq!(Frame::decode(&LAYOUT, &mut wire()), Ok(frame()));
        let mut bare = wire();
        bare.pop();
        assert_eq!(Frame::decode(&LAYOUT, &mut bare), Ok(frame()), "without its terminator");
    }

    /// The bytes that `docs/frame.md` explains.
    #[test]
    fn the_worked_example_has_these_bytes() {
        let hex: std::string::String = wire().iter().map(|b| std::format!("{b:02x} ")).collect();
        let page = include_str!("../../../docs/frame.md");
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
            assert!(Small::decode(&LAYOUT, &mut bytes).is_err(), "bit {at}");
        }
    }

    #[test]
    fn every_truncation_is_an_error() {
        for n in 0..wire().len() - 1 {
            assert!(Small::decode(&LAYOUT, &mut wire()[..n].to_vec()).is_err(), "{n} bytes");
        }
    }

    #[test]
    fn each_fault_has_its_own_error() {
        let decode = |mut bytes: Bytes<u8>| Small::decode(&LAYOUT, &mut bytes).unwrap_err();
        assert!(matches!(decode(std::vec![1; 5000]), FrameError::Oversized { got: 5000, .. }));
        assert!(matches!(decode(std::vec![9, 1]), FrameError::Framing));
        assert!(matches!(decode(std::vec![]), FrameError::Truncated { got: 0, .. }));
        assert_eq!(decode(resealed(|p| p[0] = 1)), FrameError::Version { supported: 3, got: 1 });
        let longer = resealed(|p| p.push(0));
        assert_eq!(decode(longer), FrameError::Malformed);
        let far = Frame { reading: [PositionCode(0), PositionCode(2_000_000)], ..frame() };
        let mut out = [0; Small::MAX_WIRE_BYTES];
        let n = far.encode(&LAYOUT, &mut out).unwrap();
        assert_eq!(
            decode(out[..n].to_vec()),
            FrameError::Range { field: "reading", index: 1, limit: 1_000_000, got: 2_000_000 }
        );
        assert_eq!(frame().encode(&LAYOUT, &mut [0; 20]), Err(FrameError::Space { got: 20 }));
    }

    #[test]
    fn a_sentinel_in_a_reading_that_is_not_valid_means_nothing() {
        let sentinel = Frame { reading: [28_900, i32::MIN].map(PositionCode), ..frame() };
        let mut out = [0; Small::MAX_WIRE_BYTES];
        let mut decoded = |valid: u32| {
            let frame = Frame { valid: Mask::from_words(&[valid]), ..sentinel.clone() };
            let n = frame.encode(&LAYOUT, &mut out).unwrap();
            Small::decode(&LAYOUT, &mut out[..n])
        };
        assert_eq!(decoded(0b01).unwrap().reading, [28_900, 0].map(PositionCode));
        assert!(matches!(decoded(0b11), Err(FrameError::Range { field: "reading", index: 1, .. })));
    }

    #[test]
    fn a_frame_of_another_machine_is_told_by_its_lists() {
        let readings = [PositionCode(1); 300];
        let other = of_machine::<300, 3, 2, 10>(readings);
        assert_eq!(other, FrameError::Count { list: "readings", need: 2, got: 300 });
        let other = of_machine::<2, 4, 2, 1>([PositionCode(1); 2]);
        assert_eq!(other, FrameError::Count { list: "correctors", need: 3, got: 4 });
        let other = of_machine::<2, 3, 1, 1>([PositionCode(1); 2]);
        assert_eq!(other, FrameError::Count { list: "supplies", need: 2, got: 1 });
    }

    /// The error of this machine for the frame of a larger or smaller one.
    fn of_machine<const B: usize, const C: usize, const F: usize, const W: usize>(
        reading: [PositionCode; B],
    ) -> FrameError {
        let frame = blank::<B, C, F, W>(reading);
        let sizes = Sizes::new([B, 0], [C, 0], [F; 3]);
        let mut out = [0; 4096];
        let n = frame.encode(&Layout { ring: sizes, room: sizes }, &mut out).unwrap();
        // as a buffer of this machine's: what is longer than any of its frames is refused before
        let body = packet::open(Small::VERSION, n, &mut out[..n]).unwrap();
        match postcard::take_from_bytes::<Body<2, 3, 2, 1>>(body) {
            Ok((body, [])) => body.frame(&LAYOUT).unwrap_err(),
            _ => miscounted(body, &LAYOUT),
        }
    }

    fn blank<const B: usize, const C: usize, const F: usize, const W: usize>(
        reading: [PositionCode; B],
    ) -> Frame<B, C, F, W> {
        Frame {
            epoch: 0,
            sequence: 0,
            time_us: 0,
            cycle_time_us: 0,
            corrector: [CurrentCode(0); C],
            magnets: MagnetCurrents { dipole: CurrentCode(0), supply: [CurrentCode(0); F] },
            rf_offset: RfCode(0),
            reading,
            tune: [None; 2],
            intensity: None,
            valid: Mask::NONE,
        }
    }

    /// Spare slots are not sent, and are silent in the receiver.
    #[test]
    fn a_core_with_more_room_reads_the_same_bytes() {
        let room = Sizes::new([4, 40], [3, 5], [3; 3]);
        let layout = Layout { ring: LAYOUT.ring, room };
        let read = Frame::<44, 8, 3, 2>::decode(&layout, &mut wire()).unwrap();
        assert_eq!([0, 1, 4].map(|b| read.reading[b].steps()), [28_900, 0, -18_666]);
        assert_eq!([0, 1, 2, 3].map(|c| read.corrector[c].steps()), [220_000, -13, 0, 5]);
        assert_eq!((read.valid.count(), read.valid.has(0), read.valid.has(4)), (2, true, true));
        let mut out = [0; Frame::<44, 8, 3, 2>::MAX_WIRE_BYTES];
        let n = read.encode(&layout, &mut out).unwrap();
        assert_eq!(out[..n], wire());
    }

    #[test]
    fn the_largest_frame_fits() {
        let full = Frame::<256, 256, 8, 8> {
            epoch: u32::MAX,
            sequence: u32::MAX,
            time_us: u64::MAX,
            cycle_time_us: u32::MAX,
            corrector: [CurrentCode(i32::MIN); 256],
            magnets: MagnetCurrents { dipole: CurrentCode(i32::MIN), supply: [CurrentCode(i32::MIN); 8] },
            rf_offset: RfCode(i32::MIN),
            tune: [Some(TuneCode(i32::MIN)); 2],
            intensity: Some(IntensityCode(i32::MIN)),
            valid: Mask::from_words(&[u32::MAX; 8]),
            ..blank([PositionCode(i32::MIN); 256])
        };
        let body = full.body(&Layout { ring: FULL, room: FULL });
        let mut out = [0; Frame::<256, 256, 8, 8>::MAX_BYTES];
        // two of its four lists have a length of one byte
        assert_eq!(postcard::to_slice(&body, &mut out).unwrap().len(), out.len() - 2);
    }

    const FULL: Sizes = Sizes::new([128, 128], [128, 128], [8; 3]);

    #[test]
    fn codes_round_to_the_nearest_step() {
        assert_eq!(PositionCode::nearest(-1.8666e-3).map(PositionCode::steps), Some(-18_666));
        assert_eq!(PositionCode::nearest(0.2), None);
        assert_eq!(PositionCode::nearest(f64::NAN), None);
    }
}
