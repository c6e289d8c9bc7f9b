//! Cables before physics: rows and columns that are exchanged or reversed, seen by comparing the measurement with the lattice as it is
//! written down.
//!
//! Of a monitor's row the elements with correctors of its own plane count, of a corrector's column those of its own plane. `u(i, j)` is the share of
//! measured row `i` that predicted row `j` leaves unexplained at the scale that suits it best, `1 - corr^2`. Two rows are exchanged where both are
//! explained [`BETTER`] times better by the other's prediction; a row is reversed where most of it is explained with a negative scale. Neither
//! needs the strengths to be right: errors of them change all rows alike.

use nalgebra::DMatrix;
use twin::Plane;

use crate::error::MeasuredError;
use crate::fit::Settings;
use crate::folder::Folder;
use crate::model::Model;
use crate::unknowns::groups;

/// What is wrong with a cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wiring {
    /// Two monitors of one plane are exchanged: rows.
    MonitorsExchanged([usize; 2]),
    /// Two correctors of one plane are exchanged: columns.
    CorrectorsExchanged([usize; 2]),
    /// A monitor reads with the other sign: its row.
    MonitorReversed(usize),
    /// A corrector kicks with the other sign: its column.
    CorrectorReversed(usize),
    /// All kicks of a plane have the other sign, or all its readings: nobody can tell which.
    PlaneReversed(Plane),
}

/// Unexplained shares of exchanged rows fall by this factor: with 8 elements or more that is the 99.9 % of a variance ratio by chance,
/// squared for both rows.
const BETTER: f64 = 4.0;
/// Elements that a row or column must have to be judged.
const ENOUGH: usize = 8;
/// A reversed row is explained to this share ...
const EXPLAINED: f64 = 0.5;
/// ... at a scale beyond this: the sign of a dead monitor says nothing.
const ALIVE: f64 = 0.2;

/// The measurement with its cables put right, and what was wrong.
///
/// # Errors
/// [`MeasuredError`].
pub fn straightened(folder: &Folder, settings: &Settings) -> Result<(Folder, Vec<Wiring>), MeasuredError> {
    let predicted = Model::of(folder, &groups(folder).into(), settings.rf)?.as_written()?;
    let found = found(folder, &predicted);
    let mut right = folder.clone();
    found.iter().for_each(|one| one.put_right(&mut right));
    Ok((right, found))
}

/// What is wrong by the matrix that perfect instruments would measure [mm].
pub fn found(folder: &Folder, predicted: &DMatrix<f64>) -> Vec<Wiring> {
    let monitors = judge(&Lines::of_monitors(folder, predicted));
    let correctors = judge(&Lines::of_correctors(folder, predicted));
    // where most monitors of a plane are reversed, so are its correctors: it is the sign of the kicks, or of all readings
    let is_reversed = |plane: &Plane| {
        let of_plane = |row: &&usize| folder.monitors[**row].plane == *plane;
        let all = folder.monitors.iter().filter(|one| one.plane == *plane && one.is_used).count();
        2 * monitors.reversed.iter().filter(of_plane).count() > all
    };
    let planes: Vec<Plane> = [Plane::X, Plane::Y].into_iter().filter(is_reversed).collect();
    let rows = monitors.reversed.iter().filter(|&&row| !planes.contains(&folder.monitors[row].plane));
    let columns = correctors.reversed.iter().filter(|&&column| !planes.contains(&folder.correctors[column].plane));
    (planes.iter().map(|&plane| Wiring::PlaneReversed(plane)))
        .chain(monitors.exchanged.iter().map(|&pair| Wiring::MonitorsExchanged(pair)))
        .chain(correctors.exchanged.iter().map(|&pair| Wiring::CorrectorsExchanged(pair)))
        .chain(rows.map(|&row| Wiring::MonitorReversed(row)))
        .chain(columns.map(|&column| Wiring::CorrectorReversed(column)))
        .collect()
}

impl Wiring {
    /// Name of what is wrong and its place.
    pub fn named(&self, folder: &Folder) -> (&'static str, String) {
        let pair =
            |[i, j]: [usize; 2], of: fn(&Folder, usize) -> String| format!("{},{}", of(folder, i), of(folder, j));
        match *self {
            Self::MonitorsExchanged(rows) => ("bpm_swap", pair(rows, Folder::monitor)),
            Self::CorrectorsExchanged(columns) => ("corrector_swap", pair(columns, Folder::corrector)),
            Self::MonitorReversed(row) => ("bpm_reversed", folder.monitor(row)),
            Self::CorrectorReversed(column) => ("corrector_reversed", folder.corrector(column)),
            Self::PlaneReversed(Plane::X) => ("plane_reversed", "x".into()),
            Self::PlaneReversed(Plane::Y) => ("plane_reversed", "y".into()),
        }
    }

    fn put_right(&self, folder: &mut Folder) {
        match *self {
            Self::MonitorsExchanged([i, j]) => {
                folder.matrix.swap_rows(i, j);
                if let Some(dispersion) = &mut folder.dispersion {
                    dispersion.swap_rows(i, j);
                }
            }
            Self::CorrectorsExchanged([i, j]) => folder.matrix.swap_columns(i, j),
            Self::MonitorReversed(row) => {
                folder.matrix.row_mut(row).neg_mut();
                if let Some(dispersion) = &mut folder.dispersion {
                    dispersion[row] = -dispersion[row];
                }
            }
            Self::CorrectorReversed(column) => folder.matrix.column_mut(column).neg_mut(),
            Self::PlaneReversed(plane) => {
                for (column, _) in folder.correctors.iter().enumerate().filter(|(_, one)| one.plane == plane) {
                    folder.matrix.column_mut(column).neg_mut();
                }
            }
        }
    }
}

/// Rows of one kind of instrument as they are compared: measured and predicted, NaN where an element does not count.
struct Lines {
    measured: DMatrix<f64>,
    predicted: DMatrix<f64>,
    planes: Vec<Plane>,
}

impl Lines {
    fn of_monitors(folder: &Folder, predicted: &DMatrix<f64>) -> Self {
        let planes = folder.monitors.iter().map(|one| one.plane).collect();
        Self { measured: own_plane(folder, &folder.matrix), predicted: own_plane(folder, predicted), planes }
    }

    fn of_correctors(folder: &Folder, predicted: &DMatrix<f64>) -> Self {
        let planes = folder.correctors.iter().map(|one| one.plane).collect();
        let [measured, predicted] = [&folder.matrix, predicted].map(|matrix| own_plane(folder, matrix).transpose());
        Self { measured, predicted, planes }
    }

    /// Correlation of measured line `i` with predicted line `j`, and the scale that suits it best; `None` where too few elements count.
    fn compared(&self, i: usize, j: usize) -> Option<[f64; 2]> {
        let pairs = self.measured.row(i).into_iter().copied().zip(self.predicted.row(j).into_iter().copied());
        let (mut sums, mut counted) = ([0.0; 3], 0);
        for (m, p) in pairs.filter(|(m, p)| m.is_finite() && p.is_finite()) {
            sums = [sums[0] + m * m, sums[1] + m * p, sums[2] + p * p];
            counted += 1;
        }
        let size = (sums[0] * sums[2]).sqrt();
        (counted >= ENOUGH && size > 0.0).then(|| [sums[1] / size, sums[1] / sums[2]])
    }
}

/// Elements of one plane's monitors and the same plane's correctors, of those in use.
fn own_plane(folder: &Folder, matrix: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(folder.monitors.len(), folder.correctors.len(), |i, j| {
        let (monitor, corrector) = (&folder.monitors[i], &folder.correctors[j]);
        let counts = monitor.plane == corrector.plane && monitor.is_used && corrector.is_used;
        if counts { matrix[(i, j)] } else { f64::NAN }
    })
}

/// Lines that are exchanged, and those that are reversed.
struct Judged {
    exchanged: Vec<[usize; 2]>,
    reversed: Vec<usize>,
}

fn judge(lines: &Lines) -> Judged {
    let n = lines.planes.len();
    let unexplained = DMatrix::from_fn(n, n, |i, j| match lines.planes[i] == lines.planes[j] {
        true => lines.compared(i, j).map_or(f64::NAN, |[r, _]| 1.0 - r * r),
        false => f64::NAN,
    });
    let gain = |i: usize, j: usize| {
        let by = |one: usize, other: usize| unexplained[(one, one)] / unexplained[(one, other)];
        by(i, j).min(by(j, i))
    };
    // a line is exchanged with the one that suits it best, and that one with it
    let best =
        |i: usize| (0..n).filter(|&j| j != i && gain(i, j) > BETTER).max_by(|&a, &b| gain(i, a).total_cmp(&gain(i, b)));
    let pairs = (0..n).filter_map(|i| best(i).filter(|&j| i < j && best(j) == Some(i)).map(|j| [i, j]));
    let exchanged: Vec<[usize; 2]> = pairs.collect();
    let of = |i: usize| exchanged.iter().flatten().any(|&one| one == i);
    let is_reversed = |i: usize| lines.compared(i, i).is_some_and(|[r, scale]| r < -EXPLAINED.sqrt() && scale < -ALIVE);
    let reversed = (0..n).filter(|&i| !of(i) && is_reversed(i)).collect();
    Judged { exchanged, reversed }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{NOISE, machine, measured, ring};

    fn found(change: impl FnOnce(&mut Folder)) -> (Folder, Folder, Vec<Wiring>) {
        let ring = ring();
        let plain = measured(&ring, &machine(&ring, 12), NOISE, 1);
        let mut folder = plain.clone();
        change(&mut folder);
        let (right, found) = straightened(&folder, &Settings::default()).unwrap();
        (plain, right, found)
    }

    #[test]
    fn cables_are_put_right() {
        let (_, _, nothing) = found(|_| ());
        assert_eq!(nothing, []);
        for wrong in [
            Wiring::MonitorsExchanged([2, 3]),
            Wiring::MonitorsExchanged([13, 20]),
            Wiring::CorrectorsExchanged([0, 5]),
            Wiring::MonitorReversed(7),
            Wiring::CorrectorReversed(15),
            Wiring::PlaneReversed(Plane::Y),
        ] {
            let (plain, right, found) = found(|folder| wrong.put_right(folder));
            assert_eq!(found, [wrong]);
            assert_eq!((right.matrix, right.dispersion), (plain.matrix, plain.dispersion));
        }
    }

    #[test]
    fn a_dead_monitor_is_not_a_cable() {
        let (_, _, found) = found(|folder| folder.matrix.row_mut(4).fill(NOISE));
        assert_eq!(found, []);
    }
}
