//! Numbers of a header that its frames contradict by so much that they are errors of the header, not faults of the machine.

use std::collections::HashMap;

use twin::median;

use super::drive;
use super::frames::Row;
use super::header::Header;
use super::limit::in_milli;

/// A key of the header, and what is wrong with its value.
type Fault = (&'static str, String);

/// Ratio of noise by repeats and by header, or its inverse, that no machine explains: monitors are noisy one by one, not all at once.
const CONTRADICTS: f64 = 30.0;
/// Largest kick that a corrector may make [rad]: a beam turned by more leaves the beam pipe.
const LARGEST_KICK: f64 = 0.1;
/// Relative change of a supply's current between two frames above which it was moved: ripple is 2e-4.
const MOVED: f64 = 1e-3;
/// Factor that the currents make of a family's gradient, over the dipoles' field, above which, or below its inverse, they are in another unit: the ring would
/// keep no beam.
const ANOTHER_UNIT: f64 = 2.0;
/// Step in which a corrector's read-back is taken, as a share of the largest one: in one setting they scatter by 1e-3.
const SCATTER: f64 = 1e-2;
/// Fewest differences of repeats that tell a monitor's noise.
const ENOUGH: usize = 8;
/// Median size of the difference of two numbers of a normal distribution of standard deviation 1: `sqrt(2)` times 0.6745.
const MEDIAN: f64 = 0.9539;

/// Look for such numbers.
///
/// # Errors
/// The first one.
pub(super) fn check(header: &Header, rows: &[Row], supplies: &[String]) -> Result<(), Fault> {
    check_supplies(header, rows, supplies)?;
    check_kick(header, rows)?;
    check_noise(header, rows)
}

fn check_supplies(header: &Header, rows: &[Row], supplies: &[String]) -> Result<(), Fault> {
    let drives = drive::in_rows(header, rows);
    let ordinary = -ANOTHER_UNIT.ln()..=ANOTHER_UNIT.ln();
    // a read-back that fails in some frames is no fault of the header
    let is_never = |f: &usize| !drives.iter().any(|drive| ordinary.contains(&drive.strength[*f]));
    let Some(f) = (0..supplies.len()).find(is_never).filter(|_| !drives.is_empty()) else { return Ok(()) };
    let factor = drives[0].strength[f].exp();
    let makes =
        if factor.is_finite() { format!("{factor:.2e} times the design's gradient") } else { "no gradient".into() };
    let mean = |of: &dyn Fn(&Row) -> f64| rows.iter().map(of).sum::<f64>() / rows.len() as f64;
    let expected = header.nominal[f];
    let found = mean(&|row| row.supply[f]);
    let dipole = header.nominal_dipole.map_or_else(String::new, |nominal| {
        format!("; in the dipoles {nominal:?} A and {:.4} A", mean(&|row| row.dipole.unwrap_or(nominal)))
    });
    let supply = &supplies[f];
    Err((
        "nominal_A",
        format!(
            "the currents make {makes} of supply {supply}: expected about {expected:?} A, found {found:.4} A{dipole}"
        ),
    ))
}

fn check_kick(header: &Header, rows: &[Row]) -> Result<(), Fault> {
    let kicks = |row: &Row| {
        let kicks = row.corrector_current.iter().zip(&header.kick_per_ampere).map(|(a, k)| (a * k).abs());
        kicks.fold(0.0, f64::max)
    };
    let largest = rows.iter().map(kicks).fold(0.0, f64::max);
    if largest <= LARGEST_KICK {
        return Ok(());
    }
    Err(("kick_mrad_per_A", format!("expected kicks up to {:?} mrad, found {largest:.2} rad", LARGEST_KICK * 1e3)))
}

/// The noise of a monitor in the middle of all, by repeats and by the header.
fn check_noise(header: &Header, rows: &[Row]) -> Result<(), Fault> {
    let pairs = repeats(header, rows);
    let noise = |(b, stated): (usize, &f64)| Some((noise_of(rows, &pairs, b)?, *stated));
    let mut all: Vec<(f64, f64)> = header.noise.iter().enumerate().filter_map(noise).collect();
    all.sort_by(|one, other| (one.0 / one.1).total_cmp(&(other.0 / other.1)));
    let Some(&(found, stated)) = all.get(all.len() / 2) else { return Ok(()) };
    if (found / stated).ln().abs() <= CONTRADICTS.ln() {
        return Ok(());
    }
    let found = found * 1e3;
    let found = if found < 0.01 { format!("{found:.1e}") } else { format!("{found:.3}") };
    Err(("bpm_sigma_mm", format!("{:?} mm, the repeats say {found} mm", in_milli(stated))))
}

/// Each frame with the last one before it that was driven alike, by the read-backs.
fn repeats(header: &Header, rows: &[Row]) -> Vec<[usize; 2]> {
    let is_ramped = header.ramp.is_given();
    let largest = rows.iter().flat_map(|row| &row.corrector_current).fold(0.0, |most: f64, a| most.max(a.abs()));
    let steps = |current: &f64| (current / (SCATTER * largest)).round() as i64;
    let time = |row: &Row| if is_ramped { in_milli(row.cycle_time).round() as i64 } else { 0 };
    let correctors = |row: &Row| row.corrector_current.iter().map(steps).collect::<Vec<_>>();
    let drive = |row: &Row| (time(row), row.rf_offset.to_bits(), correctors(row));
    let steady = |one: &[f64], other: &[f64]| one.iter().zip(other).all(|(a, b)| (a - b).abs() <= MOVED * b.abs());
    let is_steady = |[before, here]: &[usize; 2]| {
        let (before, here) = (&rows[*before], &rows[*here]);
        steady(&before.supply, &here.supply) && steady(before.dipole.as_slice(), here.dipole.as_slice())
    };
    let mut last = HashMap::new();
    let pair = |(here, row): (usize, &Row)| Some([last.insert(drive(row), here)?, here]);
    rows.iter().enumerate().filter_map(pair).filter(is_steady).collect()
}

/// Robust noise of a monitor [m]; none of one that has few repeats. Equal readings are those of a stuck one.
fn noise_of(rows: &[Row], repeats: &[[usize; 2]], b: usize) -> Option<f64> {
    let difference = |[before, here]: &[usize; 2]| Some((rows[*here].reading[b]? - rows[*before].reading[b]?).abs());
    let sizes: Vec<f64> = repeats.iter().filter_map(difference).filter(|size| *size > 0.0).collect();
    (sizes.len() >= ENOUGH).then(|| median(sizes)).flatten().map(|size| size / MEDIAN)
}
