//! A measurement in the rows and columns of another one of the same machine: lattices may differ by markers, instruments by what was switched off, and one may
//! lack the dispersion.

use nalgebra::{DMatrix, DVector};
use twin::Plane;

use crate::error::MeasuredError;
use crate::folder::Folder;

/// Instruments of one name are the same where their places differ by less than this [m].
const SAME_PLACE: f64 = 0.05;

/// Instruments of both measurements: for each of the first its number in the second, if that has it.
struct Pairs {
    rows: Vec<Option<usize>>,
    columns: Vec<Option<usize>>,
}

/// Two measurements of one machine as two of the same instruments in the same order: what one lacks counts in neither. The lattice is that of the first.
///
/// # Errors
/// [`MeasuredError::Unlike`]: the rings are not of one length, or have no element of the matrix in common.
pub fn aligned(one: &Folder, other: &Folder) -> Result<[Folder; 2], MeasuredError> {
    let [length, other_length] = [one, other].map(|folder| folder.meta.circumference);
    if (length - other_length).abs() > SAME_PLACE {
        let (a, b) = (&one.name, &other.name);
        return Err(MeasuredError::Unlike(format!("{a} is {length} m long, {b} {other_length} m: not one machine")));
    }
    let pairs = Pairs::of(one, other);
    if pairs.rows.iter().flatten().count() * pairs.columns.iter().flatten().count() == 0 {
        let [a, b] = [one, other].map(|folder| {
            let names = (folder.monitors.len().min(1), folder.correctors.len().min(1));
            let first =
                (0..names.0).map(|row| folder.monitor(row)).chain((0..names.1).map(|column| folder.corrector(column)));
            format!(
                "{} has {} monitors and {} correctors, {}",
                folder.name,
                folder.monitors.len(),
                folder.correctors.len(),
                first.collect::<Vec<_>>().join(" and ")
            )
        });
        return Err(MeasuredError::Unlike(format!(
            "{a}; {b}, ...: no monitor or no corrector of one name and place, not one machine"
        )));
    }
    let mut both = [one.clone(), pairs.reordered(one, other)];
    for folder in &mut both {
        pairs.rows.iter().zip(&mut folder.monitors).for_each(|(pair, one)| one.is_used &= pair.is_some());
        pairs.columns.iter().zip(&mut folder.correctors).for_each(|(pair, one)| one.is_used &= pair.is_some());
        if one.dispersion.is_none() || other.dispersion.is_none() {
            folder.dispersion = None;
        }
    }
    Ok(both)
}

impl Pairs {
    fn of(one: &Folder, other: &Folder) -> Self {
        let place = |folder: &Folder, at: usize| (folder.lattice[at].name.clone(), folder.lattice[at].s);
        let pair = |(plane, at): (Plane, usize), all: &[(Plane, usize)]| {
            let (name, s) = place(one, at);
            let is_same = |&(other_plane, at): &(Plane, usize)| {
                let (other_name, other_s) = place(other, at);
                other_plane == plane && other_name == name && (other_s - s).abs() < SAME_PLACE
            };
            all.iter().position(is_same)
        };
        let monitors = |folder: &Folder| -> Vec<_> { folder.monitors.iter().map(|one| (one.plane, one.at)).collect() };
        let correctors =
            |folder: &Folder| -> Vec<_> { folder.correctors.iter().map(|one| (one.plane, one.at)).collect() };
        let [there, kicking] = [monitors(other), correctors(other)];
        Self {
            rows: monitors(one).into_iter().map(|it| pair(it, &there)).collect(),
            columns: correctors(one).into_iter().map(|it| pair(it, &kicking)).collect(),
        }
    }

    /// The second measurement in the rows and columns of the first; 0 where it has none.
    fn reordered(&self, one: &Folder, other: &Folder) -> Folder {
        let value = |row: usize, column: usize| Some(other.matrix[(self.rows[row]?, self.columns[column]?)]);
        let mut again = Folder { name: other.name.clone(), meta: other.meta.clone(), ..one.clone() };
        again.meta.reference_fit.clone_from(&one.meta.reference_fit);
        again.matrix =
            DMatrix::from_fn(one.matrix.nrows(), one.matrix.ncols(), |row, column| value(row, column).unwrap_or(0.0));
        again.dispersion = other.dispersion.as_ref().map(|dispersion| {
            DVector::from_fn(self.rows.len(), |row, _| self.rows[row].map_or(0.0, |pair| dispersion[pair]))
        });
        for (monitor, pair) in again.monitors.iter_mut().zip(&self.rows) {
            if let Some(pair) = pair.map(|row| &other.monitors[row]) {
                (monitor.sigma, monitor.is_used) = (pair.sigma, pair.is_used);
            }
        }
        for (corrector, pair) in again.correctors.iter_mut().zip(&self.columns) {
            if let Some(pair) = pair.map(|column| &other.correctors[column]) {
                (corrector.kick, corrector.is_used) = (pair.kick, pair.is_used);
            }
        }
        again
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::folder::Row;
    use crate::testing::{NOISE, machine, measured, ring};

    #[test]
    fn a_marker_more_and_a_monitor_less_are_the_same_machine() {
        let ring = ring();
        let one = measured(&ring, &machine(&ring, 5), NOISE, 1);
        let mut other = one.clone();
        other
            .lattice
            .insert(1, Row { name: "MARK".into(), length: 0.0, s: one.lattice[1].s, ..one.lattice[0].clone() });
        other.monitors.iter_mut().for_each(|monitor| monitor.at += usize::from(monitor.at >= 1));
        other.correctors.iter_mut().for_each(|corrector| corrector.at += usize::from(corrector.at >= 1));
        other.monitors.remove(3);
        other.matrix = other.matrix.remove_row(3);
        other.dispersion = None;
        let [before, after] = aligned(&one, &other).unwrap();
        assert_eq!(before.matrix, one.matrix);
        assert!(!before.monitors[3].is_used && !after.monitors[3].is_used && before.dispersion.is_none());
        for row in (0..one.matrix.nrows()).filter(|&row| row != 3) {
            assert_eq!(after.matrix.row(row), one.matrix.row(row), "{row}");
        }
    }

    #[test]
    fn another_ring_is_refused_with_what_both_have() {
        let one = ring();
        let mut other = one.clone();
        other.lattice.iter_mut().for_each(|row| row.name = format!("X{}", row.name));
        let refused = aligned(&one, &other).unwrap_err().to_string();
        assert!(refused.contains("x_BPM.0") && refused.contains("x_XBPM.0"), "{refused}");
        other.meta.circumference += 1.0;
        let refused = aligned(&one, &other).unwrap_err().to_string();
        assert!(refused.contains("m long"), "{refused}");
    }
}
