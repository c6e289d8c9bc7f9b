//! Green's function tables in parcels: the numbers of tables and lists, and the lines that the ring has.

use heapless::Vec;

use super::{Green, GreenPlane, LowRank, TERMS, Tables};
use crate::sizes::{Layout, Sizes};
use crate::wire::{Parcel, ParcelError, listed};

/// The version of Green's function tables that is written and read here.
pub const VERSION: u16 = 3;

/// Entries of the list [`List::Ring`].
pub const RING: usize = 9;

/// A table of codes, by its number in a parcel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // the fields of `GreenPlane`, `LowRank` and `Green`
#[repr(u8)]
pub enum Table {
    DirectX,
    DirectY,
    SeenX,
    SeenY,
    DrivenX,
    DrivenY,
    MutualX,
    MutualY,
    TermSeenX,
    TermSeenY,
    TermDrivenX,
    TermDrivenY,
    /// One line: the param of each quadrupole, -1 for none.
    Param,
    /// One line: the supply of each quadrupole, -1 for none.
    Supply,
    /// One line: the prior of each param.
    Group,
}

/// A list of numbers, by its number in a parcel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // the fields of `Green`, `Dispersion` and `LowRank`
#[repr(u8)]
pub enum List {
    /// Sizes of a step in `direct`, `seen`, `driven` and `mutual`, of x and then of y, all positive.
    Steps,
    Weight,
    MonitorDispersion,
    NodeDispersion,
    SecondOrder,
    /// Spurious dispersion in x and y, momentum compaction, `1/gamma^2`, circumference, tunes, stated errors.
    Ring,
    TermScale,
    TermRfOffset,
}

impl Table {
    /// All of them, by their number.
    pub const ALL: [Self; 15] = [
        Self::DirectX,
        Self::DirectY,
        Self::SeenX,
        Self::SeenY,
        Self::DrivenX,
        Self::DrivenY,
        Self::MutualX,
        Self::MutualY,
        Self::TermSeenX,
        Self::TermSeenY,
        Self::TermDrivenX,
        Self::TermDrivenY,
        Self::Param,
        Self::Supply,
        Self::Group,
    ];

    /// The table of a number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }
}

impl List {
    /// All of them, by their number.
    pub const ALL: [Self; 8] = [
        Self::Steps,
        Self::Weight,
        Self::MonitorDispersion,
        Self::NodeDispersion,
        Self::SecondOrder,
        Self::Ring,
        Self::TermScale,
        Self::TermRfOffset,
    ];

    /// The list of a number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }
}

/// How many lines a ring's table has, and how many codes each; but for the rows of a triangle, each longer than the last.
pub fn shape(table: Table, ring: &Sizes, terms: usize) -> (usize, usize) {
    let ([bx, by], [cx, cy]) = (ring.monitors.map(usize::from), ring.correctors.map(usize::from));
    let nodes = 2 * usize::from(ring.quadrupoles);
    match table {
        Table::DirectX => (cx, bx),
        Table::DirectY => (cy, by),
        Table::SeenX => (bx, nodes),
        Table::SeenY => (by, nodes),
        Table::DrivenX => (cx, nodes),
        Table::DrivenY => (cy, nodes),
        Table::MutualX | Table::MutualY => (nodes, nodes),
        Table::TermSeenX => (terms, bx),
        Table::TermSeenY => (terms, by),
        Table::TermDrivenX => (terms, cx),
        Table::TermDrivenY => (terms, cy),
        Table::Param | Table::Supply => (1, usize::from(ring.quadrupoles)),
        Table::Group => (1, usize::from(ring.params)),
    }
}

impl<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Tables for Green<BX, BY, CX, CY, M, N, Q, T>
{
    const BLANK: Self = Self::BLANK;
    const ROOM: Sizes = Sizes::new([BX, BY], [CX, CY], [M, N, u16::MAX as usize]);

    fn layout(&self) -> Layout {
        Layout { ring: self.sizes, room: Self::ROOM }
    }

    fn parts<const L: usize>(&self) -> impl Iterator<Item = Parcel<L>> + '_ {
        let terms = self.low_rank.len();
        let lines = move |table| {
            let lines = 0..shape(table, &self.sizes, terms).0;
            lines.map(move |line| {
                let codes = self.line(table, line).unwrap_or_default();
                Parcel::codes(table as u8, line, codes.iter().copied())
            })
        };
        let is_there = move |list: &List| terms > 0 || !matches!(list, List::TermScale | List::TermRfOffset);
        let lists = List::ALL.into_iter().filter(is_there);
        core::iter::once(Parcel::Head { version: VERSION, sizes: self.sizes })
            .chain(lists.map(|list| Parcel::Values { list: list as u8, values: self.values(list) }))
            .chain(Table::ALL.into_iter().flat_map(lines))
    }

    fn take<const L: usize>(&mut self, parcel: &Parcel<L>) -> Result<(), ParcelError> {
        match parcel {
            Parcel::Head { version, sizes } => self.take_head(*version, sizes),
            Parcel::Codes { table, line, codes } => {
                let to = Table::from_number(*table).and_then(|table| self.line_mut(table, usize::from(*line)));
                let wrong = ParcelError::Line { line: *line, length: codes.len() as u16 };
                copy(to.unwrap_or_default(), codes).ok_or(wrong)
            }
            Parcel::Values { list, values } => {
                let is_step = *list == List::Steps as u8;
                if !values.iter().all(|v| v.is_finite() && (*v > 0.0 || !is_step)) {
                    return Err(ParcelError::Number);
                }
                let wrong = ParcelError::Line { line: 0, length: values.len() as u16 };
                List::from_number(*list).and_then(|list| self.take_values(list, values)).ok_or(wrong)
            }
            Parcel::Seal { crc: stated } => {
                let computed = self.digest::<L>();
                if computed == *stated { Ok(()) } else { Err(ParcelError::Corrupted { stated: *stated, computed }) }
            }
        }
    }
}

impl<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Green<BX, BY, CX, CY, M, N, Q, T>
{
    fn take_head(&mut self, version: u16, sizes: &Sizes) -> Result<(), ParcelError> {
        if version != VERSION {
            return Err(ParcelError::Version { supported: VERSION, got: version });
        }
        if !Self::ROOM.hold(sizes) {
            return Err(ParcelError::Sizes { room: Self::ROOM, got: *sizes });
        }
        self.sizes = *sizes;
        self.x.clear();
        self.y.clear();
        self.low_rank.clear();
        (self.weight, self.param, self.supply, self.group) = ([0.0; M], [super::NONE; M], [super::NONE; M], [0; N]);
        let d = &mut self.dispersion;
        (d.monitor, d.node, d.second_order) = ([0.0; BX], [0.0; Q], [0.0; BX]);
        Ok(())
    }

    /// One line of the ring's.
    fn line(&self, table: Table, line: usize) -> Option<&[i16]> {
        let all = match table {
            Table::DirectX => self.x.direct.codes.get(line)?.as_slice(),
            Table::DirectY => self.y.direct.codes.get(line)?,
            Table::SeenX => self.x.seen.codes.get(line)?,
            Table::SeenY => self.y.seen.codes.get(line)?,
            Table::DrivenX => self.x.driven.codes.get(line)?,
            Table::DrivenY => self.y.driven.codes.get(line)?,
            Table::MutualX => self.x.mutual.row(line)?,
            Table::MutualY => self.y.mutual.row(line)?,
            Table::TermSeenX => self.low_rank.seen_x.get(line)?,
            Table::TermSeenY => self.low_rank.seen_y.get(line)?,
            Table::TermDrivenX => self.low_rank.driven_x.get(line)?,
            Table::TermDrivenY => self.low_rank.driven_y.get(line)?,
            Table::Param => &self.param,
            Table::Supply => &self.supply,
            Table::Group => &self.group,
        };
        all.get(..self.length(table, line)?)
    }

    /// One line of the ring's, to be changed.
    fn line_mut(&mut self, table: Table, line: usize) -> Option<&mut [i16]> {
        let length = self.length(table, line)?;
        let all = match table {
            Table::DirectX => self.x.direct.codes.get_mut(line)?.as_mut_slice(),
            Table::DirectY => self.y.direct.codes.get_mut(line)?,
            Table::SeenX => self.x.seen.codes.get_mut(line)?,
            Table::SeenY => self.y.seen.codes.get_mut(line)?,
            Table::DrivenX => self.x.driven.codes.get_mut(line)?,
            Table::DrivenY => self.y.driven.codes.get_mut(line)?,
            Table::MutualX => self.x.mutual.row_mut(line)?,
            Table::MutualY => self.y.mutual.row_mut(line)?,
            Table::TermSeenX => self.low_rank.seen_x.get_mut(line)?,
            Table::TermSeenY => self.low_rank.seen_y.get_mut(line)?,
            Table::TermDrivenX => self.low_rank.driven_x.get_mut(line)?,
            Table::TermDrivenY => self.low_rank.driven_y.get_mut(line)?,
            Table::Param => &mut self.param,
            Table::Supply => &mut self.supply,
            Table::Group => &mut self.group,
        };
        all.get_mut(..length)
    }

    /// Codes of a line; none if the ring has no such line.
    fn length(&self, table: Table, line: usize) -> Option<usize> {
        let (lines, length) = shape(table, &self.sizes, TERMS);
        let length = if matches!(table, Table::MutualX | Table::MutualY) { line.saturating_add(1) } else { length };
        (line < lines).then_some(length)
    }

    fn values<const L: usize>(&self, list: List) -> Vec<f32, L> {
        let (d, of) = (&self.dispersion, |values: &[f32], size: u16| listed(values.iter().take(size.into()).copied()));
        let (quadrupoles, monitors) = (self.sizes.quadrupoles, self.sizes.monitors[0]);
        match list {
            List::Steps => listed(self.x.steps().into_iter().chain(self.y.steps())),
            List::Weight => of(&self.weight, quadrupoles),
            List::MonitorDispersion => of(&d.monitor, monitors),
            List::NodeDispersion => of(&d.node, 2 * quadrupoles),
            List::SecondOrder => of(&d.second_order, monitors),
            List::Ring => {
                let momentum = [d.compaction, d.inverse_gamma_squared, d.circumference];
                let all = d.spurious.into_iter().chain(momentum).chain(self.tune).chain(self.stated_error);
                listed(all)
            }
            List::TermScale => of(&self.low_rank.scale, TERMS as u16),
            List::TermRfOffset => of(&self.low_rank.rf_offset, TERMS as u16),
        }
    }

    fn take_values(&mut self, list: List, values: &[f32]) -> Option<()> {
        let (d, ring) = (&mut self.dispersion, &self.sizes);
        let (quadrupoles, monitors) = (usize::from(ring.quadrupoles), usize::from(ring.monitors[0]));
        match list {
            List::Steps => {
                let (x, y) = values.split_first_chunk::<4>()?;
                self.x.set_steps(x);
                self.y.set_steps(y.try_into().ok()?);
                Some(())
            }
            List::Weight => copy(self.weight.get_mut(..quadrupoles)?, values),
            List::MonitorDispersion => copy(d.monitor.get_mut(..monitors)?, values),
            List::NodeDispersion => copy(d.node.get_mut(..2 * quadrupoles)?, values),
            List::SecondOrder => copy(d.second_order.get_mut(..monitors)?, values),
            List::Ring => {
                let &[sx, sy, compaction, inverse, circumference, tune_x, tune_y, error_x, error_y] = values else {
                    return None;
                };
                (d.spurious, d.compaction, d.inverse_gamma_squared) = ([sx, sy], compaction, inverse);
                (d.circumference, self.tune, self.stated_error) = (circumference, [tune_x, tune_y], [error_x, error_y]);
                Some(())
            }
            List::TermScale => copy(&mut self.low_rank.scale, values),
            List::TermRfOffset => copy(&mut self.low_rank.rf_offset, values),
        }
    }
}

impl<const B: usize, const C: usize, const Q: usize, const T: usize> GreenPlane<B, C, Q, T> {
    fn steps(&self) -> [f32; 4] {
        [self.direct.scale, self.seen.scale, self.driven.scale, self.mutual.scale]
    }

    fn set_steps(&mut self, steps: &[f32; 4]) {
        [self.direct.scale, self.seen.scale, self.driven.scale, self.mutual.scale] = *steps;
    }

    fn clear(&mut self) {
        // in place: blank ones of all of them would lie on the stack
        self.direct.codes.as_flattened_mut().fill(0);
        self.seen.codes.as_flattened_mut().fill(0);
        self.driven.codes.as_flattened_mut().fill(0);
        self.mutual.codes.fill(0);
        self.set_steps(&[0.0; 4]);
    }
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize> LowRank<BX, BY, CX, CY> {
    fn clear(&mut self) {
        self.scale.fill(0.0);
        self.rf_offset.fill(0.0);
        self.seen_x.as_flattened_mut().fill(0);
        self.seen_y.as_flattened_mut().fill(0);
        self.driven_x.as_flattened_mut().fill(0);
        self.driven_y.as_flattened_mut().fill(0);
    }
}

fn copy<V: Copy>(to: &mut [V], from: &[V]) -> Option<()> {
    (!to.is_empty() && to.len() == from.len()).then(|| to.copy_from_slice(from))
}

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec;

    use super::*;
    use crate::surrogate::{Block, NONE, SymmetricBlock};

    type Small = Green<2, 1, 1, 2, 2, 1, 4, 10>;
    type Roomy = Green<3, 2, 2, 2, 4, 3, 8, 36>;
    type Part = Parcel<9>;

    const SIZES: Sizes = Sizes::new([2, 1], [1, 2], [2, 1, 1]);

    fn plane<const B: usize, const C: usize>(shift: f64) -> GreenPlane<B, C, 4, 10> {
        let value = |r: usize, c: usize| shift + r as f64 - 2.0 * c as f64;
        GreenPlane {
            direct: Block::quantise(value),
            seen: Block::quantise(value),
            driven: Block::quantise(value),
            mutual: SymmetricBlock::quantise(value),
        }
    }

    fn tables() -> Small {
        let mut tables = Small { sizes: SIZES, x: plane(0.5), y: plane(1.5), weight: [0.1, -0.3], ..Small::BLANK };
        (tables.param, tables.supply, tables.tune) = ([0, NONE], [NONE, 0], [4.83, 4.6]);
        tables.dispersion.monitor = [1.0, 2.0];
        tables.dispersion.circumference = 200.0;
        assert!(tables.low_rank.push([&[1.0, 2.0], &[3.0]], [&[0.5], &[0.25, 0.125]], 1.0));
        tables
    }

    #[test]
    fn tables_survive_their_parcels_in_any_order_between_head_and_seal() {
        let mut parcels: Vec<Part> = tables().parcels().collect();
        let last = parcels.len() - 1;
        parcels[1..last].reverse();
        let mut taken = Small { tune: [2.0; 2], ..Small::BLANK };
        parcels.iter().for_each(|parcel| taken.take(parcel).unwrap());
        assert_eq!(taken, tables());
    }

    #[test]
    fn tables_with_more_room_have_the_same_parcels() {
        let mut roomy = Roomy::BLANK;
        tables().parcels::<9>().for_each(|parcel| roomy.take(&parcel).unwrap());
        let parcels: Vec<Part> = tables().parcels().collect();
        assert_eq!(roomy.parcels::<9>().collect::<Vec<Part>>(), parcels);
        assert_eq!(roomy.digest::<40>(), tables().digest::<9>());
    }

    /// The seal's result for these parcels.
    fn sealed<'p>(parcels: impl IntoIterator<Item = &'p Part>) -> Result<(), ParcelError> {
        let mut taken = Small::BLANK;
        parcels.into_iter().map(|parcel| taken.take(parcel)).last().unwrap()
    }

    #[test]
    fn a_lost_parcel_breaks_the_seal() {
        let parcels: Vec<Part> = tables().parcels().collect();
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
        let parcels: Vec<Part> = tables().parcels().collect();
        for changed in 1..parcels.len() {
            let mut parcels = parcels.clone();
            match &mut parcels[changed] {
                Parcel::Head { .. } => {}
                Parcel::Codes { codes, .. } => *codes.last_mut().unwrap() ^= 1,
                Parcel::Values { values, .. } => values[0] = f32::from_bits(values[0].to_bits() ^ 1),
                Parcel::Seal { crc } => *crc ^= 1,
            }
            assert!(matches!(sealed(&parcels), Err(ParcelError::Corrupted { .. })), "parcel {changed}");
        }
    }

    #[test]
    fn parcels_of_other_tables_are_refused() {
        let mut taken = Small::BLANK;
        let other = Part::Head { version: VERSION, sizes: Sizes { monitors: [3, 1], ..SIZES } };
        assert!(matches!(taken.take(&other), Err(ParcelError::Sizes { .. })));
        for other in [2, 4] {
            let head = Part::Head { version: other, sizes: SIZES };
            assert_eq!(taken.take(&head), Err(ParcelError::Version { supported: 3, got: other }));
        }
        taken.take(&Part::Head { version: VERSION, sizes: SIZES }).unwrap();
        for (list, value) in [(List::Weight, f32::INFINITY), (List::Steps, 0.0)] {
            assert_eq!(taken.take(&Part::values(list as u8, &[value; 2])), Err(ParcelError::Number));
        }
        let wrong = [
            (Table::SeenX as u8, 9, 4),
            (Table::SeenX as u8, 0, 3),
            (Table::MutualX as u8, 1, 1),
            (Table::TermSeenX as u8, 8, 2),
            (15, 0, 1),
        ];
        for (table, line, length) in wrong {
            let codes = core::iter::repeat_n(1, length);
            assert!(matches!(taken.take(&Part::codes(table, line, codes)), Err(ParcelError::Line { .. })));
        }
    }
}
