//! A measured matrix beside that of the lattice as written: a wrong sign, unit or factor of 2 shows before anything is fitted.

use twin::{Plane, Rf};

use measured::Folder;
use measured::Likeness;
use measured::MeasuredError;
use measured::Model;
use measured::unknowns::groups;

/// How the elements of one plane (monitors and correctors of it) compare.
#[derive(Debug, Clone, Copy)]
pub struct Agreement {
    /// The plane.
    pub plane: Plane,
    /// The factor by which the lattice's elements are nearest to the measured ones, 1 where all is right.
    pub factor: f64,
    /// Correlation of both, 1 where all is right.
    pub correlation: f64,
    /// The largest difference of an element [mm].
    pub largest: f64,
}

/// Of each plane that has elements, the RF frequency or the momentum held.
///
/// # Errors
/// [`MeasuredError`]: the lattice makes no ring, or has no closed orbit.
pub fn agreement(folder: &Folder, rf: Rf) -> Result<Vec<Agreement>, MeasuredError> {
    let written = Model::of(folder, &groups(folder), rf)?.as_written()?;
    let of_plane = |plane: Plane| {
        let rows = folder.monitors.iter().enumerate().filter(move |(_, one)| one.plane == plane);
        let columns = |row| {
            folder
                .correctors
                .iter()
                .enumerate()
                .filter(move |(_, one)| one.plane == plane)
                .map(move |(column, _)| (row, column))
        };
        let both = rows.flat_map(|(row, _)| columns(row)).map(|at| (folder.matrix[at], written[at]));
        let both: Vec<(f64, f64)> = both.filter(|(measured, _)| measured.is_finite()).collect();
        let Likeness { correlation, factor, .. } = Likeness::of(both.iter().copied())?;
        let largest = both.iter().map(|(m, w)| (m - w).abs()).fold(0.0, f64::max);
        Some(Agreement { plane, factor, correlation, largest })
    };
    Ok([Plane::X, Plane::Y].into_iter().filter_map(of_plane).collect())
}
