//! Green's function tables of a ring of any size, for a core of its size or one with room for it.

use estimator::surrogate::{List, RING, TERMS, Table, VERSION, code, shape, step};
use estimator::{Layout, Parcel, ParcelError, Sizes, Tables as _};
use nalgebra::DMatrix;

use crate::rooms;

/// Entries of the longest line of any room's tables.
pub const LINE: usize = rooms::largest::LINE;

/// A part of tables, of any room.
pub type AnyParcel = Parcel<LINE>;

/// The numbers of Green's function tables, by table and line, and by list.
#[derive(Debug, Clone, PartialEq)]
pub struct Tables {
    sizes: Sizes,
    codes: [Vec<Vec<i16>>; Table::ALL.len()],
    lists: [Vec<f32>; List::ALL.len()],
}

/// Where the stated errors stand in the list of the ring.
const STATED: usize = RING - 2;

/// One step of a table in a plane, in the list of them.
fn step_of(table: Table) -> Option<usize> {
    let planes = [
        Table::DirectX,
        Table::SeenX,
        Table::DrivenX,
        Table::MutualX,
        Table::DirectY,
        Table::SeenY,
        Table::DrivenY,
        Table::MutualY,
    ];
    planes.iter().position(|of| *of == table)
}

impl Tables {
    /// Tables of zeros.
    pub fn zeros(sizes: Sizes) -> Self {
        let lines = |table| {
            let (lines, length) = shape(table, &sizes, 0);
            let length = |line: usize| if is_triangle(table) { line + 1 } else { length };
            (0..lines).map(|line| vec![0; length(line)]).collect()
        };
        let length = |list| match list {
            List::Steps => 8,
            List::Weight => usize::from(sizes.quadrupoles),
            List::NodeDispersion => 2 * usize::from(sizes.quadrupoles),
            List::MonitorDispersion | List::SecondOrder => usize::from(sizes.monitors[0]),
            List::Ring => RING,
            List::TermScale | List::TermRfOffset => 0,
        };
        Self { sizes, codes: Table::ALL.map(lines), lists: List::ALL.map(|list| vec![0.0; length(list)]) }
    }

    /// How many of everything the ring has.
    pub fn sizes(&self) -> Sizes {
        self.sizes
    }

    /// The numbers of a list.
    pub fn list(&self, list: List) -> &[f32] {
        &self.lists[list as usize]
    }

    pub(crate) fn list_mut(&mut self, list: List) -> &mut [f32] {
        &mut self.lists[list as usize]
    }

    /// The lines of a table.
    pub fn lines(&self, table: Table) -> &[Vec<i16>] {
        &self.codes[table as usize]
    }

    pub(crate) fn line_mut(&mut self, table: Table) -> &mut [i16] {
        &mut self.codes[table as usize][0]
    }

    /// Quantise a table; `value(entry, line)` must be finite.
    pub(crate) fn quantise(&mut self, table: Table, value: impl Fn(usize, usize) -> f64) {
        let lines = &mut self.codes[table as usize];
        let all = lines.iter().enumerate().flat_map(|(l, line)| (0..line.len()).map(move |e| (e, l)));
        let scale = step(all.map(|(entry, line)| value(entry, line)));
        for (l, line) in lines.iter_mut().enumerate() {
            line.iter_mut().enumerate().for_each(|(e, to)| *to = code(value(e, l), scale));
        }
        self.lists[List::Steps as usize][step_of(table).expect("a table with a step")] = scale;
    }

    /// The values of a table, a column a line; of a triangle, the whole symmetric matrix.
    ///
    /// # Panics
    /// If the codes of the table are no multiples of a step.
    pub fn matrix(&self, table: Table) -> DMatrix<f64> {
        let (lines, length) = shape(table, &self.sizes, 0);
        let scale = f64::from(self.list(List::Steps)[step_of(table).expect("a table with a step")]);
        DMatrix::from_fn(length, lines, |entry, line| {
            let (entry, line) = if is_triangle(table) { (entry.min(line), entry.max(line)) } else { (entry, line) };
            scale * f64::from(self.lines(table)[line][entry])
        })
    }

    /// Which of the ring's priors a param has.
    ///
    /// # Panics
    /// If there is no such param.
    pub fn prior_group(&self, param: usize) -> usize {
        self.lines(Table::Group)[0][param] as usize
    }

    /// Rms error of the response in x and y that the tables state [m].
    pub fn stated_error(&self) -> [f32; 2] {
        [0, 1].map(|plane| self.list(List::Ring)[STATED + plane])
    }

    pub(crate) fn state_error(&mut self, error: [f32; 2]) {
        self.list_mut(List::Ring)[STATED..].copy_from_slice(&error);
    }

    /// Number of terms of low rank.
    pub fn terms(&self) -> usize {
        self.lines(Table::TermSeenX).len()
    }

    /// Add the term `seen driven^T`, see [`estimator::surrogate::LowRank::push`]; false, and nothing is added, if there is no
    /// room.
    pub(crate) fn push_term(&mut self, seen: &[f64], driven: &[f64], rf_offset: f64) -> bool {
        let term = self.terms();
        if term == TERMS {
            return false;
        }
        let (seen_step, driven_step) = (step(seen.iter().copied()), step(driven.iter().copied()));
        let coded = |values: &[f64], step| values.iter().map(|v| code(*v, step)).collect::<Vec<i16>>();
        let (seen_x, seen_y) = seen.split_at(self.sizes.monitors[0].into());
        let (driven_x, driven_y) = driven.split_at(self.sizes.correctors[0].into());
        let lines = [
            (Table::TermSeenX, coded(seen_x, seen_step)),
            (Table::TermSeenY, coded(seen_y, seen_step)),
            (Table::TermDrivenX, coded(driven_x, driven_step)),
            (Table::TermDrivenY, coded(driven_y, driven_step)),
        ];
        lines.into_iter().for_each(|(table, line)| self.codes[table as usize].push(line));
        let numbers = [
            (List::TermScale, seen_step * driven_step),
            (List::TermRfOffset, (rf_offset / f64::from(driven_step)) as f32),
        ];
        for (list, value) in numbers {
            self.lists[list as usize].resize(TERMS, 0.0);
            self.lists[list as usize][term] = value;
        }
        true
    }

    /// Without the terms of low rank.
    pub fn without_terms(&self) -> Self {
        let mut tables = self.clone();
        for table in [Table::TermSeenX, Table::TermSeenY, Table::TermDrivenX, Table::TermDrivenY] {
            tables.codes[table as usize].clear();
        }
        [List::TermScale, List::TermRfOffset].iter().for_each(|list| tables.lists[*list as usize].clear());
        tables
    }

    /// The same numbers as tables of a core.
    ///
    /// # Errors
    /// [`ParcelError::Sizes`] if it has no room for them.
    pub fn fill<T: estimator::Tables>(&self, tables: &mut T) -> Result<(), ParcelError> {
        self.parcels::<LINE>().try_for_each(|parcel| tables.take(&parcel))
    }
}

fn is_triangle(table: Table) -> bool {
    matches!(table, Table::MutualX | Table::MutualY)
}

impl estimator::Tables for Tables {
    const BLANK: Self = Self {
        sizes: Sizes::new([0; 2], [0; 2], [0; 3]),
        codes: [const { Vec::new() }; Table::ALL.len()],
        lists: [const { Vec::new() }; List::ALL.len()],
    };
    const ROOM: Sizes = rooms::largest::SIZES;

    fn layout(&self) -> Layout {
        Layout { ring: self.sizes, room: self.sizes }
    }

    fn parts<const L: usize>(&self) -> impl Iterator<Item = Parcel<L>> + '_ {
        let lists = List::ALL.into_iter().filter(|list| !self.list(*list).is_empty());
        let lines = |table| {
            let lines = self.lines(table).iter().enumerate();
            lines.map(move |(line, codes)| Parcel::codes(table as u8, line, codes.iter().copied()))
        };
        core::iter::once(Parcel::Head { version: VERSION, sizes: self.sizes })
            .chain(lists.map(|list| Parcel::values(list as u8, self.list(list))))
            .chain(Table::ALL.into_iter().flat_map(lines))
    }

    fn take<const L: usize>(&mut self, parcel: &Parcel<L>) -> Result<(), ParcelError> {
        match parcel {
            Parcel::Head { version, .. } if *version != VERSION => {
                return Err(ParcelError::Version { supported: VERSION, got: *version });
            }
            Parcel::Head { sizes, .. } if !Self::ROOM.hold(sizes) => {
                return Err(ParcelError::Sizes { room: Self::ROOM, got: *sizes });
            }
            Parcel::Head { sizes, .. } => *self = Self::zeros(*sizes),
            Parcel::Codes { table, line, codes } => {
                let wrong = ParcelError::Line { line: *line, length: codes.len() as u16 };
                let table = Table::from_number(*table).ok_or(wrong)?;
                let (lines, length) = shape(table, &self.sizes, TERMS);
                let line = usize::from(*line);
                let length = if is_triangle(table) { line + 1 } else { length };
                if line >= lines || codes.len() != length {
                    return Err(wrong);
                }
                let lines = &mut self.codes[table as usize];
                lines.resize(lines.len().max(line + 1), vec![0; length]); // terms are as many as come
                lines[line] = codes.to_vec();
            }
            Parcel::Values { list, values } => {
                let is_step = *list == List::Steps as u8;
                if !values.iter().all(|v| v.is_finite() && (*v > 0.0 || !is_step)) {
                    return Err(ParcelError::Number);
                }
                let wrong = ParcelError::Line { line: 0, length: values.len() as u16 };
                let list = List::from_number(*list).ok_or(wrong)?;
                let is_term = matches!(list, List::TermScale | List::TermRfOffset);
                let expected = if is_term { TERMS } else { self.list(list).len() };
                if values.len() != expected {
                    return Err(wrong);
                }
                self.lists[list as usize] = values.to_vec();
            }
            Parcel::Seal { crc: stated } => {
                let computed = self.digest::<LINE>();
                if computed != *stated {
                    return Err(ParcelError::Corrupted { stated: *stated, computed });
                }
            }
        }
        Ok(())
    }
}
