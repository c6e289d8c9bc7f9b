//! Tables in parcels, small enough for a packet each, so that they travel to a device and are written where they belong as
//! they arrive. The CRC over the whole, in the last parcel, tells whether all of them did.

use core::fmt;

use heapless::Vec;
use serde::{Deserialize, Serialize};

use super::listed;
use super::packet::{LENGTH, VARINT_16, VARINT_32};
use crate::sizes::Sizes;

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

/// Part of a set of tables; a line has at most `L` entries. Which table and which list is which, the surrogate says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Parcel<const L: usize> {
    /// Comes first, and clears the tables.
    Head {
        /// Which surrogate, and which version of its tables.
        version: u16,
        /// How many of everything the ring has.
        sizes: Sizes,
    },
    /// One line of a table of codes: a column of a block, a row of a triangle.
    Codes {
        /// Which table.
        table: u8,
        /// Which line of it.
        line: u16,
        /// The codes.
        codes: Vec<i16, L>,
    },
    /// A list of numbers.
    Values {
        /// Which list.
        list: u8,
        /// The numbers.
        values: Vec<f32, L>,
    },
    /// Comes last: the CRC-32 (ISO-HDLC) of all before, see [`Parcel::digest`].
    Seal {
        /// The CRC.
        crc: u32,
    },
}

impl<const L: usize> Parcel<L> {
    /// Largest body of a packet that holds a parcel, behind number and kind of a request.
    pub const MAX_BYTES: usize = VARINT_32 + 2 + LENGTH + 4 * L + 8 * VARINT_16;

    /// One line of a table.
    pub fn codes(table: u8, line: usize, codes: impl IntoIterator<Item = i16>) -> Self {
        Self::Codes { table, line: line as u16, codes: listed(codes) }
    }

    /// A list of numbers.
    pub fn values(list: u8, values: &[f32]) -> Self {
        Self::Values { list, values: listed(values.iter().copied()) }
    }

    /// CRC-32 (ISO-HDLC) of parcels in postcard, one after the other.
    pub fn digest(parcels: impl Iterator<Item = Self>) -> u32 {
        let mut digest = CRC.digest();
        parcels.for_each(|parcel| parcel.add_to(&mut digest));
        digest.finalize()
    }

    /// As in postcard, piece by piece: a buffer for the longest line would lie on the stack.
    fn add_to(&self, digest: &mut crc::Digest<'_, u32>) {
        // what is fed in cannot be refused
        let _ = postcard::serialize_with_flavor(self, Fed(digest));
    }
}

/// Postcard's bytes, fed to a CRC as they come.
struct Fed<'d, 'c>(&'d mut crc::Digest<'c, u32>);

impl postcard::ser_flavors::Flavor for Fed<'_, '_> {
    type Output = ();

    fn try_push(&mut self, byte: u8) -> postcard::Result<()> {
        self.try_extend(&[byte])
    }

    fn try_extend(&mut self, bytes: &[u8]) -> postcard::Result<()> {
        self.0.update(bytes);
        Ok(())
    }

    fn finalize(self) -> postcard::Result<()> {
        Ok(())
    }
}

/// Why tables were refused; they must not be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParcelError {
    /// Written for another version, or another surrogate.
    Version {
        /// The version read here.
        supported: u16,
        /// The version of the parcels.
        got: u16,
    },
    /// Tables of another ring.
    Sizes {
        /// What there is room for.
        room: Sizes,
        /// What the ring has.
        got: Sizes,
    },
    /// No such line, or one of another length.
    Line {
        /// Its number.
        line: u16,
        /// Its length.
        length: u16,
    },
    /// A number that is not finite, or a size that is not positive.
    Number,
    /// A parcel is missing, or was changed.
    Corrupted {
        /// CRC in the parcels.
        stated: u32,
        /// CRC of the tables.
        computed: u32,
    },
    /// The tables are whole, but no ring like them is stable at the vars at hand.
    Unstable,
    /// A parcel without a head.
    Headless,
    /// The slot holds the tables in use.
    Busy,
}

impl fmt::Display for ParcelError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version { supported, got } => write!(f, "tables of version {got}, this reads version {supported}"),
            Self::Sizes { room, got } => write!(
                f,
                "tables of another ring: monitors x, y, correctors x, y, quadrupoles, params, supplies are {:?}, this \
                 machine's {:?}",
                got.all(),
                room.all()
            ),
            Self::Line { line, length } => write!(f, "no table has a line {line} of {length} entries there"),
            Self::Number => write!(f, "a number is not finite, or a step not positive"),
            Self::Corrupted { stated, computed } => {
                write!(f, "a part is missing or was changed: the tables' CRC is {computed:08x}, stated is {stated:08x}")
            }
            Self::Unstable => write!(f, "no ring like these tables is stable at the vars at hand"),
            Self::Headless => write!(f, "a part of tables came without their head"),
            Self::Busy => write!(f, "the tables in the slot are in use"),
        }
    }
}

impl core::error::Error for ParcelError {}
