//! A lattice, its instruments and a table as one measurement.
//!
//! A monitor with a length reads in its middle, and a corrector kicks all along its length. A monitor, and a corrector within the field of a magnet, cut their
//! element in two with a row of no length between the halves.

use nalgebra::{DMatrix, DVector};

use super::conventions::Conventions;
use super::element::{Element, Lattice};
use super::instruments::{Channel, Instruments, Order, in_order, names};
use super::table::Table;
use measured::MeasuredError;
use measured::folder::{CorrectorRow, Folder, Meta, MonitorRow, Row};

/// Tables of a measurement.
#[derive(Debug, Clone)]
pub struct Measurement<'a> {
    /// The matrix.
    pub matrix: &'a Table,
    /// Change of the orbit with a step of the RF frequency [Hz].
    pub dispersion: Option<(&'a Table, f64)>,
    /// Order of lines and columns without names.
    pub order: Option<Order>,
    /// What the tables do not say.
    pub conventions: &'a Conventions,
}

/// The measurement of a lattice.
///
/// # Errors
/// [`MeasuredError`].
pub fn assemble(
    lattice: &Lattice,
    instruments: &Instruments,
    rf: Option<f64>,
    measured: &Measurement,
) -> Result<Folder, MeasuredError> {
    let Measurement { matrix, dispersion, order, conventions } = measured;
    let names = names(lattice, &instruments.called);
    let lines = matrix.lines(&instruments.monitors, &names, *order)?;
    let columns = matrix.columns(&instruments.correctors, &names, *order)?;
    let kicks = conventions.kick.of("--kick", &columns, &instruments.correctors, &names)?;
    let noise = conventions.noise.of("--noise", &lines, &instruments.monitors, &names)?;
    let unit = conventions.unit.millimetres();
    let mut folder = empty(lattice, instruments, rf)?;
    let places = places(lattice, instruments);
    for (&(at, plane), sigma) in lines.iter().zip(noise) {
        folder.monitors.push(MonitorRow { plane, at: places[at], sigma: sigma.abs() * unit, is_used: true });
    }
    let sign = |(column, kick): (&Channel, &f64)| {
        if conventions.is_reversed(column.1) { -kick.signum() } else { kick.signum() }
    };
    let signs: Vec<f64> = columns.iter().zip(&kicks).map(sign).collect();
    for (&(at, plane), kick) in columns.iter().zip(kicks) {
        let at = places[at];
        folder.correctors.push(CorrectorRow { plane, at, kick: conventions.full(kick).abs(), is_used: true });
    }
    folder.matrix = DMatrix::from_fn(lines.len(), columns.len(), |i, j| signs[j] * unit * matrix.value(i, j));
    if let Some((table, step)) = dispersion {
        folder.meta.delta_rf = *step;
        let unit = table.stated.unit.unwrap_or(conventions.unit).millimetres();
        folder.dispersion = Some(column(table, instruments, &names, *order, &lines)? * unit);
    }
    Ok(folder)
}

/// The lattice with all of its monitors and correctors and a matrix of zeros: for the tunes, and for the names.
///
/// # Errors
/// [`MeasuredError`].
pub fn bare(lattice: &Lattice, instruments: &Instruments) -> Result<Folder, MeasuredError> {
    let mut folder = empty(lattice, instruments, lattice.rf().or(Some(0.0)))?;
    let places = places(lattice, instruments);
    for (at, plane) in in_order(&instruments.monitors, Order::Planes) {
        folder.monitors.push(MonitorRow { plane, at: places[at], sigma: 1.0, is_used: true });
    }
    for (at, plane) in in_order(&instruments.correctors, Order::Planes) {
        folder.correctors.push(CorrectorRow { plane, at: places[at], kick: 1.0, is_used: true });
    }
    folder.matrix = DMatrix::zeros(folder.monitors.len(), folder.correctors.len());
    Ok(folder)
}

/// The dispersion orbit in the order of the matrix's lines.
fn column(
    table: &Table,
    instruments: &Instruments,
    names: &[String],
    order: Option<Order>,
    lines: &[Channel],
) -> Result<DVector<f64>, MeasuredError> {
    if table.width() != 1 {
        return table.refuse(format!("expected one number a line, found {}", table.width()));
    }
    let own = table.lines(&instruments.monitors, names, order)?;
    let value = |line| own.iter().position(|one| one == line).map_or(f64::NAN, |place| table.value(place, 0));
    Ok(DVector::from_iterator(lines.len(), lines.iter().map(value)))
}

/// Rows of the lattice, and nothing measured.
pub(super) fn empty(lattice: &Lattice, instruments: &Instruments, rf: Option<f64>) -> Result<Folder, MeasuredError> {
    let circumference = lattice.circumference();
    let Some(rf) = rf.or(lattice.rf()) else {
        return lattice.refuse("no cavity with a frequency; state the RF frequency with --rf-frequency HZ".into());
    };
    let mut rows = Vec::new();
    for (one, is_cut) in lattice.elements.iter().zip(cuts(lattice, instruments)) {
        let s = rows.last().map_or(0.0, |last: &Row| last.s + last.length);
        rows.extend(pieces(one, s, is_cut));
    }
    let meta = Meta {
        circumference,
        energy: lattice.energy,
        particle: lattice.particle,
        rf,
        delta_rf: 0.0,
        reference_fit: None,
    };
    Ok(Folder {
        name: "imported".into(),
        meta,
        lattice: rows,
        monitors: Vec::new(),
        correctors: Vec::new(),
        matrix: DMatrix::zeros(0, 0),
        dispersion: None,
    })
}

/// Which elements are cut: a monitor with a length, or a corrector in a field.
fn cuts(lattice: &Lattice, instruments: &Instruments) -> Vec<bool> {
    let mut cuts = vec![false; lattice.elements.len()];
    instruments.monitors.iter().for_each(|one| cuts[one.element] = lattice.elements[one.element].length > 0.0);
    for corrector in &instruments.correctors {
        let one = &lattice.elements[corrector.element];
        cuts[corrector.element] |= one.length > 0.0 && (one.bend != 0.0 || one.k1 != 0.0);
    }
    cuts
}

/// The row of an element whose entrance is at `s`, or its halves with a row of no length between.
fn pieces(one: &Element, s: f64, is_cut: bool) -> Vec<Row> {
    let whole = Row {
        name: one.name.clone(),
        s,
        length: one.length,
        bend: one.bend,
        edge_in: one.edge_in,
        edge_out: one.edge_out,
        fringe: one.fringe,
        k1: one.k1,
        half_k2: one.k2 / 2.0,
    };
    if !is_cut {
        return vec![whole];
    }
    // a soft edge acts at both ends of each half
    let half = Row { length: one.length / 2.0, bend: one.bend / 2.0, fringe: one.fringe / 2.0, ..whole };
    let middle = s + half.length;
    let thin = Row {
        s: middle,
        length: 0.0,
        bend: 0.0,
        edge_in: 0.0,
        edge_out: 0.0,
        fringe: 0.0,
        k1: 0.0,
        half_k2: 0.0,
        ..half.clone()
    };
    vec![Row { edge_out: 0.0, ..half.clone() }, thin, Row { s: middle, edge_in: 0.0, ..half }]
}

/// Row of the folder where each element acts: the row of no length, where it is cut.
pub(super) fn places(lattice: &Lattice, instruments: &Instruments) -> Vec<usize> {
    let mut next = 0;
    let places = cuts(lattice, instruments).into_iter().map(|is_cut| {
        let cut = usize::from(is_cut);
        next += 1 + 2 * cut;
        next - 1 - cut
    });
    places.collect()
}
