//! Green's function tables in parcels, small enough for a packet each, so that they travel to a device and are written
//! where they belong as they arrive. The CRC over the whole, in the last parcel, tells whether all of them did.

use core::fmt;

use heapless::Vec;
use serde::{Deserialize, Serialize};

use super::{Block, Green, GreenPlane, LowRank, TERMS};

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

/// Entries of the longest line of a table.
pub const LINE: usize = 96;

/// Part of a set of tables.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Parcel {
    /// Comes first, and clears the tables.
    Head(Head),
    /// One line of a table of codes: a column of a block, a row of a triangle.
    Codes {
        /// Which table.
        table: Table,
        /// Which line of it.
        line: u16,
        /// The codes.
        codes: Vec<i16, LINE>,
    },
    /// A list of numbers.
    Values {
        /// Which list.
        list: List,
        /// The numbers.
        values: Vec<f32, LINE>,
    },
    /// Comes last: the CRC-32 (ISO-HDLC) of all numbers, see [`Green::digest`].
    Seal {
        /// The CRC.
        crc: u32,
    },
}

/// What is one number each.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Head {
    /// Version of these parcels, [`Head::VERSION`].
    pub version: u16,
    /// Monitors x, y, correctors x, y, nodes.
    pub counts: [u16; 5],
    /// Number of quadrupoles on the first supply.
    pub first_family: u16,
    /// Size of a step in `direct`, `seen`, `driven` and `mutual`, of x and of y.
    pub steps: [[f32; 4]; 2],
    /// See [`super::Dispersion::spurious`].
    pub spurious: [f32; 2],
    /// Momentum compaction, `1/gamma^2` [1] and circumference [m].
    pub momentum: [f32; 3],
    /// Stated rms error in x and y [m].
    pub stated_error: [f32; 2],
}

impl Head {
    /// The version written here.
    pub const VERSION: u16 = 2;
}

/// A table of codes of one plane, 0 for x.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[allow(missing_docs)] // the fields of `GreenPlane` and `LowRank`
pub enum Table {
    Direct(u8),
    Seen(u8),
    Driven(u8),
    Mutual(u8),
    TermSeen(u8),
    TermDriven(u8),
}

/// A list of numbers; of one plane where a plane is given, 0 for x.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[allow(missing_docs)] // the fields of `GreenPlane`, `Dispersion` and `LowRank`
pub enum List {
    Weight(u8),
    MonitorDispersion,
    NodeDispersion,
    SecondOrder,
    TermScale,
    TermRfOffset,
}

/// Why tables were not taken. They are then not to be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParcelError {
    /// Written for another version.
    Version {
        /// The version read here.
        supported: u16,
        /// The version of the parcels.
        got: u16,
    },
    /// Tables of another ring: counts of monitors x, y, correctors x, y, nodes.
    Counts {
        /// This machine's.
        need: [u16; 5],
        /// The parcels'.
        got: [u16; 5],
    },
    /// No such line, or one of another length.
    Line {
        /// Its number.
        line: u16,
        /// Its length.
        length: u16,
    },
    /// A number that is none, or a size that is not positive.
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
            Self::Counts { need, got } => write!(
                f,
                "tables of another ring: monitors x, y, correctors x, y, nodes are {got:?}, this machine's {need:?}"
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

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize, const T: usize>
    Green<BX, BY, CX, CY, Q, T>
{
    const COUNTS: [u16; 5] = [BX as u16, BY as u16, CX as u16, CY as u16, Q as u16];

    /// Write a parcel where it belongs.
    ///
    /// # Errors
    /// [`ParcelError`].
    pub fn take(&mut self, parcel: &Parcel) -> Result<(), ParcelError> {
        match parcel {
            Parcel::Head(head) => self.take_head(head),
            Parcel::Codes { table, line, codes } => {
                let to = self.line_mut(*table, usize::from(*line));
                let wrong = ParcelError::Line { line: *line, length: codes.len() as u16 };
                copy(to.unwrap_or_default(), codes).ok_or(wrong)
            }
            Parcel::Values { list, values } => {
                if !values.iter().all(|v| v.is_finite()) {
                    return Err(ParcelError::Number);
                }
                let wrong = ParcelError::Line { line: 0, length: values.len() as u16 };
                copy(self.list_mut(*list).unwrap_or_default(), values).ok_or(wrong)
            }
            Parcel::Seal { crc: stated } => {
                let computed = self.digest();
                if computed == *stated { Ok(()) } else { Err(ParcelError::Corrupted { stated: *stated, computed }) }
            }
        }
    }

    fn take_head(&mut self, head: &Head) -> Result<(), ParcelError> {
        if head.version != Head::VERSION {
            return Err(ParcelError::Version { supported: Head::VERSION, got: head.version });
        }
        if head.counts != Self::COUNTS || head.first_family > Self::COUNTS[4] / 2 {
            return Err(ParcelError::Counts { need: Self::COUNTS, got: head.counts });
        }
        let positive = head.steps.as_flattened().iter().chain(&head.momentum[2..]);
        let mut all = head.momentum.iter().chain(&head.spurious).chain(&head.stated_error);
        if !positive.copied().all(|v| v.is_finite() && v > 0.0) || !all.all(|v| v.is_finite()) {
            return Err(ParcelError::Number);
        }
        self.x.clear(&head.steps[0]);
        self.y.clear(&head.steps[1]);
        let d = &mut self.dispersion;
        (d.monitor, d.node, d.second_order) = ([0.0; BX], [0.0; Q], [0.0; BX]);
        self.low_rank.clear();
        (d.spurious, [d.compaction, d.inverse_gamma_squared, d.circumference]) = (head.spurious, head.momentum);
        (self.first_family, self.stated_error) = (head.first_family, head.stated_error);
        Ok(())
    }

    fn line_mut(&mut self, table: Table, line: usize) -> Option<&mut [i16]> {
        match table {
            Table::Direct(0) => self.x.direct.codes.get_mut(line).map(|c| c.as_mut_slice()),
            Table::Direct(1) => self.y.direct.codes.get_mut(line).map(|c| c.as_mut_slice()),
            Table::Seen(0) => self.x.seen.codes.get_mut(line).map(|c| c.as_mut_slice()),
            Table::Seen(1) => self.y.seen.codes.get_mut(line).map(|c| c.as_mut_slice()),
            Table::Driven(0) => self.x.driven.codes.get_mut(line).map(|c| c.as_mut_slice()),
            Table::Driven(1) => self.y.driven.codes.get_mut(line).map(|c| c.as_mut_slice()),
            Table::Mutual(0) => self.x.mutual.row_mut(line),
            Table::Mutual(1) => self.y.mutual.row_mut(line),
            Table::TermSeen(0) => self.low_rank.seen_x.get_mut(line).map(|c| c.as_mut_slice()),
            Table::TermSeen(1) => self.low_rank.seen_y.get_mut(line).map(|c| c.as_mut_slice()),
            Table::TermDriven(0) => self.low_rank.driven_x.get_mut(line).map(|c| c.as_mut_slice()),
            Table::TermDriven(1) => self.low_rank.driven_y.get_mut(line).map(|c| c.as_mut_slice()),
            _ => None,
        }
    }

    fn list_mut(&mut self, list: List) -> Option<&mut [f32]> {
        match list {
            List::Weight(0) => Some(&mut self.x.weight),
            List::Weight(1) => Some(&mut self.y.weight),
            List::Weight(_) => None,
            List::MonitorDispersion => Some(&mut self.dispersion.monitor),
            List::NodeDispersion => Some(&mut self.dispersion.node),
            List::SecondOrder => Some(&mut self.dispersion.second_order),
            List::TermScale => Some(&mut self.low_rank.scale),
            List::TermRfOffset => Some(&mut self.low_rank.rf_offset),
        }
    }

    /// The tables in parcels, the seal last. Lines of more than 96 entries do not travel.
    pub fn parcels(&self) -> impl Iterator<Item = Parcel> + '_ {
        const { assert!(Q <= LINE && BX <= LINE && BY <= LINE) };
        let seal = core::iter::once_with(|| Parcel::Seal { crc: self.digest() });
        let d = &self.dispersion;
        let lists = [
            (List::Weight(0), self.x.weight.as_slice()),
            (List::Weight(1), &self.y.weight),
            (List::MonitorDispersion, &d.monitor),
            (List::NodeDispersion, &d.node),
            (List::SecondOrder, &d.second_order),
        ];
        core::iter::once(Parcel::Head(self.head()))
            .chain(self.x.lines(0))
            .chain(self.y.lines(1))
            .chain(lists.map(values))
            .chain(self.low_rank.parcels())
            .chain(seal)
    }

    fn head(&self) -> Head {
        let d = &self.dispersion;
        Head {
            version: Head::VERSION,
            counts: Self::COUNTS,
            first_family: self.first_family,
            steps: [self.x.steps(), self.y.steps()],
            spurious: d.spurious,
            momentum: [d.compaction, d.inverse_gamma_squared, d.circumference],
            stated_error: self.stated_error,
        }
    }

    /// CRC-32 (ISO-HDLC) of all numbers, little endian: of each plane the steps, the codes of `direct`, `seen`, `driven` and
    /// `mutual` line by line, and the weights; then dispersion at monitors, at nodes, second order, spurious, the three of
    /// the momentum, the stated errors, and the first family. Then of each term of low rank, if there are any: the codes
    /// `seen` in x and y and `driven` in x and y, its scale and its RF.
    pub fn digest(&self) -> u32 {
        let mut digest = CRC.digest();
        self.x.add_to(&mut digest);
        self.y.add_to(&mut digest);
        let head = self.head();
        let d = &self.dispersion;
        for list in [d.monitor.as_slice(), &d.node, &d.second_order, &d.spurious, &head.momentum, &head.stated_error] {
            list.iter().for_each(|v| digest.update(&v.to_le_bytes()));
        }
        digest.update(&head.first_family.to_le_bytes());
        self.low_rank.add_to(&mut digest);
        digest.finalize()
    }
}

impl<const B: usize, const C: usize, const Q: usize, const T: usize> GreenPlane<B, C, Q, T> {
    fn steps(&self) -> [f32; 4] {
        [self.direct.scale, self.seen.scale, self.driven.scale, self.mutual.scale]
    }

    fn clear(&mut self, steps: &[f32; 4]) {
        self.direct.codes = [[0; B]; C];
        self.seen.codes = [[0; Q]; B];
        self.driven.codes = [[0; Q]; C];
        self.mutual.codes = [0; T];
        self.weight = [0.0; Q];
        [self.direct.scale, self.seen.scale, self.driven.scale, self.mutual.scale] = *steps;
    }

    fn lines(&self, plane: u8) -> impl Iterator<Item = Parcel> + '_ {
        let mutual = self.mutual.rows().zip(0..).map(move |(row, line)| codes(Table::Mutual(plane), line, row));
        columns(&self.direct, Table::Direct(plane))
            .chain(columns(&self.seen, Table::Seen(plane)))
            .chain(columns(&self.driven, Table::Driven(plane)))
            .chain(mutual)
    }

    fn add_to(&self, digest: &mut crc::Digest<'_, u32>) {
        self.steps().iter().for_each(|v| digest.update(&v.to_le_bytes()));
        let codes = self.direct.codes.as_flattened().iter();
        let codes = codes.chain(self.seen.codes.as_flattened()).chain(self.driven.codes.as_flattened());
        codes.chain(&self.mutual.codes).for_each(|c| digest.update(&c.to_le_bytes()));
        self.weight.iter().for_each(|v| digest.update(&v.to_le_bytes()));
    }
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize> LowRank<BX, BY, CX, CY> {
    fn clear(&mut self) {
        // in place: blank ones of all of them would lie on the stack
        self.scale.fill(0.0);
        self.rf_offset.fill(0.0);
        self.seen_x.as_flattened_mut().fill(0);
        self.seen_y.as_flattened_mut().fill(0);
        self.driven_x.as_flattened_mut().fill(0);
        self.driven_y.as_flattened_mut().fill(0);
    }

    /// Nothing if there is no term.
    fn parcels(&self) -> impl Iterator<Item = Parcel> + '_ {
        const { assert!(BX <= LINE && BY <= LINE && CX <= LINE && CY <= LINE && TERMS <= LINE) };
        let terms = self.len();
        let lists = [(List::TermScale, self.scale.as_slice()), (List::TermRfOffset, &self.rf_offset)];
        lines(&self.seen_x, Table::TermSeen(0))
            .take(terms)
            .chain(lines(&self.seen_y, Table::TermSeen(1)).take(terms))
            .chain(lines(&self.driven_x, Table::TermDriven(0)).take(terms))
            .chain(lines(&self.driven_y, Table::TermDriven(1)).take(terms))
            .chain(lists.into_iter().filter(move |_| terms > 0).map(values))
    }

    fn add_to(&self, digest: &mut crc::Digest<'_, u32>) {
        let seen = self.seen_x.iter().zip(&self.seen_y);
        let driven = self.driven_x.iter().zip(&self.driven_y);
        let terms = seen.zip(driven).zip(self.scale.iter().zip(&self.rf_offset)).take(self.len());
        for (((seen_x, seen_y), (driven_x, driven_y)), (scale, rf)) in terms {
            let codes = seen_x.iter().chain(seen_y).chain(driven_x).chain(driven_y);
            codes.for_each(|code| digest.update(&code.to_le_bytes()));
            [scale, rf].into_iter().for_each(|v| digest.update(&v.to_le_bytes()));
        }
    }
}

fn columns<const R: usize, const C: usize>(block: &Block<R, C>, table: Table) -> impl Iterator<Item = Parcel> + '_ {
    lines(&block.codes, table)
}

fn lines<const R: usize>(each: &[[i16; R]], table: Table) -> impl Iterator<Item = Parcel> + '_ {
    each.iter().zip(0..).map(move |(entries, line)| codes(table, line, entries))
}

fn values((list, values): (List, &[f32])) -> Parcel {
    Parcel::Values { list, values: gathered(values) }
}

fn codes(table: Table, line: u16, codes: &[i16]) -> Parcel {
    Parcel::Codes { table, line, codes: gathered(codes) }
}

/// A list of at most [`LINE`] entries.
fn gathered<V: Clone>(values: &[V]) -> Vec<V, LINE> {
    Vec::from_slice(values).unwrap_or_default()
}

fn copy<V: Copy>(to: &mut [V], from: &[V]) -> Option<()> {
    (!to.is_empty() && to.len() == from.len()).then(|| to.copy_from_slice(from))
}

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec;

    use super::*;
    use crate::surrogate::SymmetricBlock;

    type Small = Green<2, 1, 1, 2, 4, 10>;

    fn plane<const B: usize, const C: usize>(shift: f64) -> GreenPlane<B, C, 4, 10> {
        let value = |r: usize, c: usize| shift + r as f64 - 2.0 * c as f64;
        GreenPlane {
            direct: Block::quantise(value),
            seen: Block::quantise(value),
            driven: Block::quantise(value),
            mutual: SymmetricBlock::quantise(value),
            weight: [0.1, 0.2, -0.3, 0.4],
        }
    }

    fn tables() -> Small {
        let mut tables = Small { x: plane(0.5), y: plane(1.5), first_family: 1, ..Small::BLANK };
        tables.dispersion.monitor = [1.0, 2.0];
        tables.dispersion.circumference = 200.0;
        assert!(tables.low_rank.push([&[1.0, 2.0], &[3.0]], [&[0.5], &[0.25, 0.125]], 1.0));
        tables
    }

    #[test]
    fn tables_survive_their_parcels_in_any_order_between_head_and_seal() {
        let mut parcels: Vec<Parcel> = tables().parcels().collect();
        let last = parcels.len() - 1;
        parcels[1..last].reverse();
        let mut taken = Small { first_family: 2, ..Small::BLANK };
        parcels.iter().for_each(|parcel| taken.take(parcel).unwrap());
        assert_eq!(taken, tables());
    }

    /// What the seal says of these parcels.
    fn sealed<'p>(parcels: impl IntoIterator<Item = &'p Parcel>) -> Result<(), ParcelError> {
        let mut taken = Small::BLANK;
        parcels.into_iter().map(|parcel| taken.take(parcel)).last().unwrap()
    }

    #[test]
    fn a_lost_parcel_breaks_the_seal() {
        let parcels: Vec<Parcel> = tables().parcels().collect();
        for lost in 1..parcels.len() - 1 {
            let others = parcels.iter().enumerate().filter(|(at, _)| *at != lost);
            let is_zero = match &parcels[lost] {
                Parcel::Codes { codes, .. } => codes.iter().all(|code| *code == 0),
                Parcel::Values { values, .. } => values.iter().all(|value| *value == 0.0),
                other => panic!("{other:?}"),
            };
            // the head clears all tables, so that a list of zeros is not missed
            assert_eq!(sealed(others.map(|(_, parcel)| parcel)).is_ok(), is_zero, "parcel {lost}");
        }
    }

    #[test]
    fn a_changed_parcel_breaks_the_seal() {
        let parcels: Vec<Parcel> = tables().parcels().collect();
        for changed in 0..parcels.len() {
            let mut parcels = parcels.clone();
            match &mut parcels[changed] {
                Parcel::Head(head) => head.spurious[1] += 1e-6,
                Parcel::Codes { codes, .. } => *codes.last_mut().unwrap() ^= 1,
                Parcel::Values { values, .. } => values[0] = f32::from_bits(values[0].to_bits() ^ 1),
                Parcel::Seal { crc } => *crc ^= 1,
            }
            assert!(matches!(sealed(&parcels), Err(ParcelError::Corrupted { .. })), "parcel {changed}");
        }
    }

    #[test]
    fn parcels_of_other_tables_are_refused() {
        let head = tables().head();
        let mut taken = Small::BLANK;
        let other = Head { counts: [9; 5], ..head };
        assert!(matches!(taken.take(&Parcel::Head(other)), Err(ParcelError::Counts { .. })));
        for other in [1, 3] {
            let head = Head { version: other, ..head };
            assert_eq!(taken.take(&Parcel::Head(head)), Err(ParcelError::Version { supported: 2, got: other }));
        }
        let infinite = Head { stated_error: [f32::INFINITY, 0.0], ..head };
        assert_eq!(taken.take(&Parcel::Head(infinite)), Err(ParcelError::Number));
        let wrong =
            [(Table::Seen(0), 9, 4), (Table::Seen(0), 0, 3), (Table::Mutual(2), 0, 1), (Table::TermSeen(0), 8, 2)];
        for (table, line, length) in wrong {
            let codes = core::iter::repeat_n(1, length).collect();
            assert!(matches!(taken.take(&Parcel::Codes { table, line, codes }), Err(ParcelError::Line { .. })));
        }
    }
}
