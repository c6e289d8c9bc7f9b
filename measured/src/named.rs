//! Which instruments raw orbits without names are of: those of a lattice, in beam order, some missing on either side.
//!
//! Measured and predicted rows are laid beside each other as two sequences are aligned: the order stays, either side may skip, and the sum of
//! `corr` over the pairs is the largest (S. B. Needleman and C. D. Wunsch, J. Mol. Biol. 48 (1970) 443). Rows need the columns and columns the rows: they are
//! found in turn, from the guess that what is missing is spread evenly.

use nalgebra::DMatrix;
use twin::Plane;

use crate::error::MeasuredError;
use crate::folder::Folder;
use crate::likeness::Likeness;
use crate::raw::RawOrbits;

/// Rows and columns of one plane, measured and predicted.
struct Block {
    measured: DMatrix<f64>,
    predicted: DMatrix<f64>,
}

/// The pairs of one sequence, measured and predicted.
type Pairs = Vec<(usize, usize)>;

/// Turns of rows and columns.
const TURNS: usize = 10;
/// A pair less alike than this is none.
const ALIKE: f64 = 0.5;

/// The measurement that raw orbits make with the instruments of a lattice's folder, and the orbits with its rows and columns: those that were not
/// measured are not used, kicks are those that suit the lattice's matrix best, their calibration being unknown.
///
/// `[x, y]` monitors and correctors of the raw orbits say where the second plane begins.
///
/// # Errors
/// [`MeasuredError::Unlike`]: most instruments find none that is like them.
pub fn named(
    raw: &RawOrbits,
    lattice: &Folder,
    predicted: &DMatrix<f64>,
    [monitors, correctors]: [[usize; 2]; 2],
) -> Result<(Folder, RawOrbits), MeasuredError> {
    let all = |counts: [usize; 2]| counts.into_iter().fold(0, usize::saturating_add);
    let (shape, found, expected) = (lattice.matrix.shape(), raw.change.shape(), (all(monitors), all(correctors)));
    if found != expected {
        return Err(MeasuredError::Unlike(format!(
            "expected raw orbits of {} readings and {} correctors, found {} and {}",
            expected.0, expected.1, found.0, found.1
        )));
    }
    let mut rows: Pairs = Vec::new();
    let mut columns: Vec<(usize, usize, f64)> = Vec::new();
    for (p, plane) in [Plane::X, Plane::Y].into_iter().enumerate() {
        let own_rows: Vec<usize> = (0..shape.0).filter(|&row| lattice.monitors[row].plane == plane).collect();
        let own_columns: Vec<usize> =
            (0..shape.1).filter(|&column| lattice.correctors[column].plane == plane).collect();
        let first = [p * monitors[0], p * correctors[0]];
        let block = Block {
            measured: raw.change.view((first[0], first[1]), (monitors[p], correctors[p])).into_owned(),
            predicted: predicted.select_rows(&own_rows).select_columns(&own_columns),
        };
        if block.predicted.is_empty() && !block.measured.is_empty() {
            return Err(MeasuredError::Unlike(format!(
                "{}: expected monitors and correctors in {plane:?} as the raw orbits have, found {} and {}",
                lattice.name,
                own_rows.len(),
                own_columns.len()
            )));
        }
        let (of_rows, of_columns) = block.aligned();
        if 2 * of_rows.len() < monitors[p] || 2 * of_columns.len() < correctors[p] {
            return Err(MeasuredError::Unlike(format!(
                "{}: {} of {} monitors and {} of {} correctors in {plane:?} are like any of this lattice",
                lattice.name,
                of_rows.len(),
                monitors[p],
                of_columns.len(),
                correctors[p]
            )));
        }
        let factors = block.factors(&of_rows, &of_columns);
        rows.extend(of_rows.iter().map(|&(m, l)| (first[0] + m, own_rows[l])));
        columns.extend(of_columns.iter().zip(factors).map(|(&(m, l), factor)| (first[1] + m, own_columns[l], factor)));
    }
    let mut orbits = RawOrbits {
        change: DMatrix::from_element(shape.0, shape.1, f64::NAN),
        middle: DMatrix::from_element(shape.0, shape.1, f64::NAN),
        amperes: vec![1.0; shape.1],
    };
    let mut folder = lattice.clone();
    folder.monitors.iter_mut().for_each(|one| one.is_used = false);
    folder.correctors.iter_mut().for_each(|one| one.is_used = false);
    rows.iter().for_each(|&(_, row)| folder.monitors[row].is_used = lattice.monitors[row].is_used);
    for &(from, to, factor) in &columns {
        folder.correctors[to].is_used = lattice.correctors[to].is_used;
        folder.correctors[to].kick *= factor;
        orbits.amperes[to] = raw.amperes[from];
        for &(row, at) in &rows {
            orbits.change[(at, to)] = raw.change[(row, from)];
            orbits.middle[(at, to)] = raw.middle[(row, from)];
        }
    }
    folder.matrix = orbits.change.clone();
    folder.dispersion = None;
    Ok((folder, orbits))
}

impl Block {
    /// Pairs of rows and of columns.
    fn aligned(&self) -> (Pairs, Pairs) {
        let evenly = |measured: usize, predicted: usize| -> Pairs {
            (0..measured).map(|i| (i, (i * predicted / measured).min(predicted - 1))).collect()
        };
        let mut rows = evenly(self.measured.nrows(), self.predicted.nrows());
        let mut columns = Pairs::new();
        for _ in 0..TURNS {
            let of_columns = align(self.measured.ncols(), self.predicted.ncols(), |m, p| {
                Likeness::of(rows.iter().map(|&(i, j)| (self.measured[(i, m)], self.predicted[(j, p)])))
            });
            let of_rows = align(self.measured.nrows(), self.predicted.nrows(), |m, p| {
                Likeness::of(of_columns.iter().map(|&(i, j)| (self.measured[(m, i)], self.predicted[(p, j)])))
            });
            let is_settled = of_columns == columns && of_rows == rows;
            (rows, columns) = (of_rows, of_columns);
            if is_settled {
                break;
            }
        }
        (rows, columns)
    }

    /// Measured over predicted size of each column.
    fn factors(&self, rows: &Pairs, columns: &Pairs) -> Vec<f64> {
        let of = |&(m, p): &(usize, usize)| {
            Likeness::of(rows.iter().map(|&(i, j)| (self.measured[(i, m)], self.predicted[(j, p)])))
                .map_or(1.0, |one| one.factor)
        };
        columns.iter().map(of).collect()
    }
}

/// The pairs in order whose correlations have the largest sum.
fn align(measured: usize, predicted: usize, likeness: impl Fn(usize, usize) -> Option<Likeness>) -> Pairs {
    let alike =
        DMatrix::from_fn(measured, predicted, |m, p| likeness(m, p).map_or(0.0, |one| one.correlation.abs() - ALIKE));
    // the best sum of the first m and p
    let mut best = DMatrix::zeros(measured + 1, predicted + 1);
    for m in 1..=measured {
        for p in 1..=predicted {
            let paired: f64 = best[(m - 1, p - 1)] + alike[(m - 1, p - 1)];
            best[(m, p)] = paired.max(best[(m - 1, p)]).max(best[(m, p - 1)]);
        }
    }
    let (mut m, mut p, mut pairs) = (measured, predicted, Pairs::new());
    while m > 0 && p > 0 {
        if best[(m, p)] == best[(m - 1, p)] {
            m -= 1;
        } else if best[(m, p)] == best[(m, p - 1)] {
            p -= 1;
        } else {
            (m, p) = (m - 1, p - 1);
            pairs.push((m, p));
        }
    }
    pairs.reverse();
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{NOISE, machine, measured, ring};

    /// Raw orbits of a measured ring, some rows and columns left out and one row of nothing put in.
    fn raw(folder: &Folder, without: [usize; 2], row_of_nothing: usize) -> RawOrbits {
        let change = folder.matrix.clone().remove_row(without[0]).remove_column(without[1]);
        let change = change.insert_row(row_of_nothing, 0.0);
        let middle = DMatrix::from_element(change.nrows(), change.ncols(), 0.3);
        let amperes = (0..change.ncols()).map(|column| 1.0 + column as f64).collect();
        RawOrbits { change, middle, amperes }
    }

    #[test]
    fn instruments_are_found_by_their_responses() {
        let lattice = ring();
        let (model, unknowns, truth) = machine(&lattice, 5);
        let folder = measured(&lattice, &(model.clone(), unknowns, truth), NOISE, 3);
        let written = model.as_written().unwrap();
        // without the x monitor 4 and the vertical corrector 7, and with a thirteenth y monitor that reads nothing
        let raw = raw(&folder, [4, 12 + 7], 11 + 2);
        let (found, orbits) = named(&raw, &lattice, &written, [[11, 13], [12, 11]]).unwrap();
        let unused: Vec<usize> = (0..24).filter(|&row| !found.monitors[row].is_used).collect();
        assert_eq!(unused, [4]);
        let unused: Vec<usize> = (0..24).filter(|&column| !found.correctors[column].is_used).collect();
        assert_eq!(unused, [19]);
        for row in (0..24).filter(|row| *row != 4) {
            for column in (0..24).filter(|column| *column != 19) {
                assert_eq!(orbits.change[(row, column)], folder.matrix[(row, column)]);
            }
        }
        assert_eq!((orbits.amperes[18], orbits.amperes[20]), (19.0, 20.0));
        // gains of 5 % beside strengths 1 % off: each column has its kick to a few of these
        let kicks = found.correctors.iter().zip(&lattice.correctors).map(|(found, own)| found.kick / own.kick);
        assert!(kicks.into_iter().all(|ratio| (0.7..1.4).contains(&ratio)));
    }

    #[test]
    fn another_ring_s_orbits_are_refused() {
        let lattice = ring();
        let (model, ..) = machine(&lattice, 5);
        let noise = DMatrix::from_fn(24, 24, |i, j| ((7 * i + 13 * j * j + 5 * i * j) % 17) as f64 - 8.0);
        let raw = RawOrbits { middle: noise.clone(), change: noise, amperes: vec![1.0; 24] };
        let written = model.as_written().unwrap();
        let refused = |counts| named(&raw, &lattice, &written, counts).unwrap_err().to_string();
        assert!(refused([[12, 12], [12, 12]]).contains("are like any of this lattice"));
        assert_eq!(
            refused([[12, 11], [12, 12]]),
            "expected raw orbits of 23 readings and 24 correctors, found 24 and 24"
        );
    }
}
