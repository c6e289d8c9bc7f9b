//! Cables before physics: rows and columns that are exchanged or reversed, seen by comparing the measurement with the lattice as it is
//! written down.
//!
//! Of a monitor's row the elements with correctors of its own plane count, of a corrector's column those of its own plane. `u(i, j)` is the share of
//! measured row `i` that predicted row `j` leaves unexplained at the scale that suits it best, `1 - corr^2`. Rows are exchanged, in a ring of two or
//! more, where each is explained better by the next one's prediction than by its own at a positive scale, four times on average and twice at least, and
//! better than by its own at any. A row that no prediction explains is dead, and closes the ring that it stands in. A row is reversed where most of
//! it is explained with a negative scale. Neither needs the strengths to be right: errors of them change all rows alike.

use nalgebra::DMatrix;
use twin::Plane;

use crate::error::MeasuredError;
use crate::fit::Settings;
use crate::folder::Folder;
use crate::likeness::Likeness;
use crate::model::Model;
use crate::unknowns::groups;

/// What is wrong with a cable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wiring {
    /// Monitors of one plane are exchanged: each row is that of the monitor of the next, the last one that of the first.
    MonitorsExchanged(Vec<usize>),
    /// Correctors of one plane are exchanged: columns in the same way.
    CorrectorsExchanged(Vec<usize>),
    /// A monitor reads with the other sign: its row.
    MonitorReversed(usize),
    /// A corrector kicks with the other sign: its column.
    CorrectorReversed(usize),
    /// Monitors read nothing of the orbit, and are left out.
    MonitorsDead(Vec<usize>),
    /// Correctors kick nothing, and are left out.
    CorrectorsDead(Vec<usize>),
    /// All kicks of a plane have the other sign, or all its readings: nobody can tell which.
    PlaneReversed(Plane),
}

/// Unexplained shares of exchanged rows fall by this factor, geometric mean: with 8 elements or more that is the 99.9 % of a variance ratio by chance,
/// squared for both rows.
const BETTER: f64 = 4.0;
/// And each of them by this one at least.
const LEAST: f64 = 2.0;
/// Elements that a row or column must have to be judged.
const ENOUGH: usize = 8;
/// A row is dead that nothing explains to this share; a reversed one is explained to it ...
const EXPLAINED: f64 = 0.5;
/// ... at a scale beyond this: the sign of a dead monitor says nothing.
const ALIVE: f64 = 0.2;

/// The measurement with its cables put right, and what was wrong.
///
/// # Errors
/// [`MeasuredError`].
pub fn straightened(folder: &Folder, settings: &Settings) -> Result<(Folder, Vec<Wiring>), MeasuredError> {
    Ok(straightened_by(folder, &Model::of(folder, &groups(folder), settings.rf)?.as_written()?))
}

/// The same by a matrix that perfect instruments would measure, or that the same ones have measured before [mm].
pub fn straightened_by(folder: &Folder, expected: &DMatrix<f64>) -> (Folder, Vec<Wiring>) {
    let (mut right, mut all) = exchanged_back(folder, expected);
    // an exchanged line may be reversed too, which shows at its own place
    for one in reversed(&right, &with_kicks_of(&right, folder, expected)) {
        one.put_right(&mut right);
        all.push(one);
    }
    (right, all)
}

/// What one folder's kicks make of the matrix that is expected with those of another [mm].
fn with_kicks_of(folder: &Folder, other: &Folder, expected: &DMatrix<f64>) -> DMatrix<f64> {
    let kick = |folder: &Folder, column: usize| folder.correctors.get(column).map_or(1.0, |one| one.kick);
    let share = |column| if kick(other, column) == 0.0 { 1.0 } else { kick(folder, column) / kick(other, column) };
    DMatrix::from_fn(expected.nrows(), expected.ncols(), |i, j| expected[(i, j)] * share(j))
}

/// The measurement with exchanged rows and columns put back, the clearest first: a row that is at a wrong place is in the way where columns are
/// judged. What is expected [mm] need not have the right scale in any row or column.
pub fn exchanged_back(folder: &Folder, expected: &DMatrix<f64>) -> (Folder, Vec<Wiring>) {
    let (mut right, mut all) = (folder.clone(), Vec::new());
    // no line is exchanged more than once
    for _ in 0..folder.monitors.len() + folder.correctors.len() {
        let Some(one) = clearest_exchange(&right, expected) else { break };
        one.put_right(&mut right);
        all.push(one);
    }
    (right, all)
}

/// The exchange that explains most, of rows or of columns.
fn clearest_exchange(folder: &Folder, predicted: &DMatrix<f64>) -> Option<Wiring> {
    let monitors = Lines::of_monitors(folder, predicted).exchanges().into_iter();
    let correctors = Lines::of_correctors(folder, predicted).exchanges().into_iter();
    monitors
        .map(|one| (one.better, Wiring::MonitorsExchanged(one.lines)))
        .chain(correctors.map(|one| (one.better, Wiring::CorrectorsExchanged(one.lines))))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, wiring)| wiring)
}

/// What is reversed, once nothing is exchanged.
fn reversed(folder: &Folder, predicted: &DMatrix<f64>) -> Vec<Wiring> {
    let monitors = Lines::of_monitors(folder, predicted).reversed();
    let correctors = Lines::of_correctors(folder, predicted).reversed();
    // where most monitors of a plane are reversed, so are its correctors: it is the sign of the kicks, or of all readings
    let is_reversed = |plane: &Plane| {
        let of_plane = |row: &&usize| folder.monitors[**row].plane == *plane;
        let all = folder.monitors.iter().filter(|one| one.plane == *plane && one.is_used).count();
        2 * monitors.iter().filter(of_plane).count() > all
    };
    let planes: Vec<Plane> = [Plane::X, Plane::Y].into_iter().filter(is_reversed).collect();
    let rows = monitors.iter().filter(|&&row| !planes.contains(&folder.monitors[row].plane));
    let columns = correctors.iter().filter(|&&column| !planes.contains(&folder.correctors[column].plane));
    (planes.iter().map(|&plane| Wiring::PlaneReversed(plane)))
        .chain(rows.map(|&row| Wiring::MonitorReversed(row)))
        .chain(columns.map(|&column| Wiring::CorrectorReversed(column)))
        .collect()
}

impl Wiring {
    /// Name of what is wrong and its place.
    pub fn named(&self, folder: &Folder) -> (&'static str, String) {
        let all = |lines: &[usize], of: fn(&Folder, usize) -> String| {
            lines.iter().map(|&line| of(folder, line)).collect::<Vec<_>>().join(",")
        };
        match self {
            Self::MonitorsExchanged(rows) => ("bpm_swap", all(rows, Folder::monitor)),
            Self::CorrectorsExchanged(columns) => ("corrector_swap", all(columns, Folder::corrector)),
            Self::MonitorReversed(row) => ("bpm_reversed", folder.monitor(*row)),
            Self::CorrectorReversed(column) => ("corrector_reversed", folder.corrector(*column)),
            Self::MonitorsDead(rows) => ("bpm_dead", all(rows, Folder::monitor)),
            Self::CorrectorsDead(columns) => ("corrector_dead", all(columns, Folder::corrector)),
            Self::PlaneReversed(Plane::X) => ("plane_reversed", "x".into()),
            Self::PlaneReversed(Plane::Y) => ("plane_reversed", "y".into()),
        }
    }

    /// What [`Self::named`] names.
    ///
    /// # Errors
    /// [`MeasuredError::Unlike`]: a kind or an instrument that the measurement has not.
    pub fn of_name(folder: &Folder, kind: &str, at: &str) -> Result<Self, MeasuredError> {
        let unlike = || MeasuredError::Unlike(format!("{kind} at {at}: no such cable in {}", folder.name));
        let lines = |count: usize, of: fn(&Folder, usize) -> String| {
            let line = |name: &str| (0..count).find(|&line| of(folder, line) == name).ok_or_else(unlike);
            at.split(',').map(line).collect::<Result<Vec<_>, _>>()
        };
        let rows = || lines(folder.monitors.len(), Folder::monitor);
        let columns = || lines(folder.correctors.len(), Folder::corrector);
        Ok(match (kind, at) {
            ("bpm_swap", _) => Self::MonitorsExchanged(rows()?),
            ("corrector_swap", _) => Self::CorrectorsExchanged(columns()?),
            ("bpm_reversed", _) => Self::MonitorReversed(rows()?[0]),
            ("corrector_reversed", _) => Self::CorrectorReversed(columns()?[0]),
            ("bpm_dead", _) => Self::MonitorsDead(rows()?),
            ("corrector_dead", _) => Self::CorrectorsDead(columns()?),
            ("plane_reversed", "x") => Self::PlaneReversed(Plane::X),
            ("plane_reversed", "y") => Self::PlaneReversed(Plane::Y),
            _ => return Err(unlike()),
        })
    }

    /// Exchange or turn rows or columns, which puts a wrong cable right and a right one wrong; leave out what is dead.
    pub fn put_right(&self, folder: &mut Folder) {
        match self {
            Self::MonitorsExchanged(rows) => {
                // from the last pair on, so that each row arrives at its own place
                for pair in rows.windows(2).rev() {
                    folder.matrix.swap_rows(pair[0], pair[1]);
                    // noise was measured through the same cable
                    let [one, other] = [pair[0], pair[1]].map(|row| folder.monitors[row].sigma);
                    (folder.monitors[pair[0]].sigma, folder.monitors[pair[1]].sigma) = (other, one);
                    if let Some(dispersion) = &mut folder.dispersion {
                        dispersion.swap_rows(pair[0], pair[1]);
                    }
                }
            }
            Self::CorrectorsExchanged(columns) => {
                for pair in columns.windows(2).rev() {
                    folder.matrix.swap_columns(pair[0], pair[1]);
                    // a supply keeps its kick, whichever magnet its cable leads to
                    let [one, other] = [pair[0], pair[1]].map(|column| folder.correctors[column].kick);
                    (folder.correctors[pair[0]].kick, folder.correctors[pair[1]].kick) = (other, one);
                }
            }
            Self::MonitorReversed(row) => {
                folder.matrix.row_mut(*row).neg_mut();
                if let Some(dispersion) = &mut folder.dispersion {
                    dispersion[*row] = -dispersion[*row];
                }
            }
            Self::CorrectorReversed(column) => folder.matrix.column_mut(*column).neg_mut(),
            Self::MonitorsDead(rows) => rows.iter().for_each(|&row| folder.monitors[row].is_used = false),
            Self::CorrectorsDead(columns) => {
                columns.iter().for_each(|&column| folder.correctors[column].is_used = false);
            }
            Self::PlaneReversed(plane) => {
                for (column, _) in folder.correctors.iter().enumerate().filter(|(_, one)| one.plane == *plane) {
                    folder.matrix.column_mut(column).neg_mut();
                }
            }
        }
    }
}

impl Wiring {
    /// Sum of squares that the wrong cable, or the dead instrument as a live one, would leave of a prediction [mm], over the squares of the elements' errors [mm].
    pub fn squares(&self, right: &Folder, predicted: &DMatrix<f64>, error: impl Fn(usize, usize) -> f64) -> f64 {
        let mut wrong = right.clone();
        match self {
            Self::MonitorsDead(rows) => rows.iter().for_each(|&row| wrong.matrix.row_mut(row).fill(0.0)),
            Self::CorrectorsDead(columns) => {
                columns.iter().for_each(|&column| wrong.matrix.column_mut(column).fill(0.0))
            }
            _ => self.put_right(&mut wrong),
        }
        let changed = |row: usize, column: usize| match self {
            Self::MonitorsDead(rows) => rows.contains(&row),
            Self::CorrectorsDead(columns) => columns.contains(&column),
            _ => wrong.matrix[(row, column)] != right.matrix[(row, column)],
        };
        let (rows, columns) = right.matrix.shape();
        let elements = (0..columns).flat_map(|column| (0..rows).map(move |row| (row, column)));
        let of_wrong = with_kicks_of(&wrong, right, predicted);
        let off = elements.filter(|&(row, column)| changed(row, column)).map(|(row, column)| {
            let [wrong, right] = [(&wrong, &of_wrong), (right, predicted)]
                .map(|(folder, predicted)| folder.matrix[(row, column)] - predicted[(row, column)]);
            // a dead one is compared with what it reads
            let right = if matches!(self, Self::MonitorsDead(_) | Self::CorrectorsDead(_)) { 0.0 } else { right };
            (wrong * wrong - right * right) / error(row, column).powi(2)
        });
        off.filter(|square| square.is_finite()).sum::<f64>().max(0.0)
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

    /// Measured elements of a line.
    fn counted(&self, i: usize) -> usize {
        self.measured.row(i).iter().filter(|one| one.is_finite()).count()
    }

    /// Measured line `i` beside predicted line `j`; `None` where too few elements count.
    fn compared(&self, i: usize, j: usize) -> Option<Likeness> {
        let pairs = self.measured.row(i).into_iter().copied().zip(self.predicted.row(j).into_iter().copied());
        Likeness::of(pairs).filter(|likeness| likeness.counted >= ENOUGH)
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

/// Lines that are exchanged in a ring.
struct Exchange {
    /// Each is that of the next, the last one that of the first.
    lines: Vec<usize>,
    /// By how much their unexplained shares fall, geometric mean.
    better: f64,
}

impl Lines {
    /// Lines that are each explained better by the prediction of the next one.
    fn exchanges(&self) -> Vec<Exchange> {
        let n = self.planes.len();
        let unexplained = DMatrix::from_fn(n, n, |i, j| match self.planes[i] == self.planes[j] {
            true => self.compared(i, j).map_or(f64::NAN, |one| 1.0 - one.correlation.powi(2)),
            false => f64::NAN,
        });
        // with the right sign, which an exchanged line of a place in antiphase has not
        let own = |i: usize| self.compared(i, i).map_or(f64::NAN, |one| 1.0 - one.correlation.max(0.0).powi(2));
        let own: Vec<f64> = (0..n).map(own).collect();
        let is_better =
            |i: usize, j: usize| own[i] > LEAST * unexplained[(i, j)] && unexplained[(i, i)] > unexplained[(i, j)];
        // the line whose prediction a line suits best
        let best = |i: usize| {
            let better = (0..n).filter(|&j| j != i && is_better(i, j));
            better.min_by(|&a, &b| unexplained[(i, a)].total_cmp(&unexplained[(i, b)]))
        };
        let best: Vec<Option<usize>> = (0..n).map(best).collect();
        // what a dead one measures is of no line: it closes the ring that it stands in
        let is_dead = |i: usize| self.counted(i) >= ENOUGH && !(0..n).any(|j| unexplained[(i, j)] < EXPLAINED);
        let next = |i: usize| best[i].or_else(|| if is_dead(i) { first_before(&best, i) } else { None });
        // a noisy line gains less than the others of its ring
        let gain = |i: usize, j: usize| if is_dead(i) { 1.0 } else { own[i] / unexplained[(i, j)] };
        let better = |ring: &[usize]| {
            let gains = (0..ring.len()).map(|at| gain(ring[at], ring[(at + 1) % ring.len()]));
            gains.product::<f64>().powf(1.0 / ring.len() as f64)
        };
        (0..n)
            .filter_map(|first| ring_from(first, next))
            .map(|lines| Exchange { better: better(&lines), lines })
            .filter(|one| one.better > BETTER)
            .collect()
    }

    /// Lines that their own prediction explains with the other sign.
    fn reversed(&self) -> Vec<usize> {
        let is_reversed = |one: Likeness| one.correlation < -EXPLAINED.sqrt() && one.factor < -ALIVE;
        (0..self.planes.len()).filter(|&i| self.compared(i, i).is_some_and(is_reversed)).collect()
    }
}

/// Where the lines begin that each measure what belongs to the next, and end at this one; `None` where none does.
fn first_before(next: &[Option<usize>], last: usize) -> Option<usize> {
    let mut chain = vec![last];
    while let Some(before) = (0..next.len()).find(|&i| next[i] == chain.last().copied() && !chain.contains(&i)) {
        chain.push(before);
    }
    chain.pop().filter(|&first| first != last)
}

/// The ring that begins and ends at a line, if it is the least of it.
fn ring_from(first: usize, next: impl Fn(usize) -> Option<usize>) -> Option<Vec<usize>> {
    let mut ring = vec![first];
    loop {
        match next(ring[ring.len() - 1])? {
            next if next == first => return Some(ring),
            // one that does not come back to its least is none
            next if next < first || ring.contains(&next) => return None,
            next => ring.push(next),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{NOISE, machine, measured, normal, ring};

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
            Wiring::MonitorsExchanged(vec![2, 3]),
            Wiring::MonitorsExchanged(vec![13, 20]),
            Wiring::CorrectorsExchanged(vec![0, 5]),
            Wiring::MonitorReversed(7),
            Wiring::CorrectorReversed(15),
            Wiring::PlaneReversed(Plane::Y),
        ] {
            let (plain, right, found) = found(|folder| wrong.put_right(folder));
            let (kind, at) = wrong.named(&plain);
            assert_eq!(Wiring::of_name(&plain, kind, &at).unwrap(), wrong);
            assert_eq!(found, [wrong]);
            assert_eq!((right.matrix, right.dispersion), (plain.matrix, plain.dispersion));
        }
    }

    /// A supply of thrice the kick at its neighbour's magnet: its column is at the neighbour's place, and so is its kick.
    #[test]
    fn kicks_go_with_the_columns_of_exchanged_cables() {
        let mut ring = ring();
        ring.correctors[5].kick *= 3.0;
        let plain = measured(&ring, &machine(&ring, 12), NOISE, 1);
        let (mut folder, cable) = (plain.clone(), Wiring::CorrectorsExchanged(vec![4, 5]));
        cable.put_right(&mut folder);
        // the folder as it is written has the kicks of the supplies, in the order of the columns
        assert_eq!(folder.correctors[4].kick, 3.0 * folder.correctors[5].kick);
        let (right, found) = straightened(&folder, &Settings::default()).unwrap();
        assert_eq!(found, [cable]);
        assert_eq!(right.matrix, plain.matrix);
        assert!(right.correctors.iter().zip(&plain.correctors).all(|(right, plain)| right.kick == plain.kick));
    }

    /// Three in a ring: row 1 has what monitor 4 reads, row 4 what monitor 9 reads, row 9 what monitor 1 reads.
    #[test]
    fn cables_in_a_ring_are_put_right() {
        let (plain, right, found) = found(|folder| {
            let rows = [1, 4, 9].map(|row| folder.matrix.row(row).into_owned());
            [1, 4, 9].iter().zip([1, 2, 0]).for_each(|(&row, from)| folder.matrix.set_row(row, &rows[from]));
            folder.dispersion = None;
        });
        assert_eq!(found, [Wiring::MonitorsExchanged(vec![1, 4, 9])]);
        assert_eq!(right.matrix, plain.matrix);
    }

    #[test]
    fn an_exchanged_row_that_is_reversed_too_is_put_right() {
        let wrong = [Wiring::MonitorsExchanged(vec![2, 7]), Wiring::MonitorReversed(7)];
        let (plain, right, found) = found(|folder| wrong.iter().rev().for_each(|one| one.put_right(folder)));
        assert_eq!(found, wrong);
        assert_eq!(right.matrix, plain.matrix);
    }

    /// Monitor 5 has the cable of a dead one, which is at its own place.
    #[test]
    fn a_cable_that_is_exchanged_with_that_of_a_dead_monitor_is_found() {
        let ring = ring();
        let mut plain = measured(&ring, &machine(&ring, 12), NOISE, 1);
        let mut normal = normal(3);
        plain.matrix.row_mut(9).iter_mut().for_each(|element| *element = NOISE * normal());
        for rows in [vec![5, 9], vec![9, 11], vec![3, 9, 11]] {
            let (mut folder, cable) = (plain.clone(), Wiring::MonitorsExchanged(rows));
            // a ring of three is undone by going round it twice more
            let times = if matches!(&cable, Wiring::MonitorsExchanged(rows) if rows.len() == 3) { 2 } else { 1 };
            (0..times).for_each(|_| cable.put_right(&mut folder));
            let (right, found) = straightened(&folder, &Settings::default()).unwrap();
            assert_eq!(found, [cable]);
            assert!(right.matrix == plain.matrix);
        }
        assert_eq!(straightened(&plain, &Settings::default()).unwrap().1, []);
    }

    #[test]
    fn a_dead_monitor_is_not_a_cable() {
        let (_, _, found) = found(|folder| folder.matrix.row_mut(4).fill(NOISE));
        assert_eq!(found, []);
    }
}
