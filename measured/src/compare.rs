//! What changed from one measurement of a machine to the next.
//!
//! What the model misses is mostly the same in both and drops out: the second matrix is fitted less what the first fit left over, from the values
//! of the first, and what remains then is the error of the comparison, learnt as that of a fit is.

use std::collections::BTreeMap;

use crate::data::Data;
use crate::departure::{Departures, Expected};
use crate::error::MeasuredError;
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::model::Model;
use crate::unknowns::{Kind, name};
use crate::wiring::{Wiring, straightened_by};

/// A family's changes can be told where their found sizes would follow the true ones by a correlation of 0.92: this share of their variance is then no error.
const TOLD: f64 = 0.85;
/// A family in which no change shows can be told to have none where the error bars are below this, less than power supplies are set to.
const STILL: f64 = 0.001;

/// Relative change of one magnet, or of the magnets of one group.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Its name.
    pub name: String,
    /// Its family.
    pub family: String,
    /// Rows of the lattice.
    pub rows: Vec<usize>,
    /// Strength in the second measurement over that in the first, less 1.
    pub relative: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// True where it is too large for chance.
    pub has_changed: bool,
    /// False where the measurements cannot tell the changes of its family from their errors.
    pub is_identifiable: bool,
}

/// What is not a gradient and changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Other {
    /// What it is.
    pub kind: Kind,
    /// Where.
    pub name: String,
    /// Of a gain its relative change; of what is read or kicked in the other plane per gain, of a skew gradient [1/m] the change itself.
    pub change: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// What changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Changes {
    /// Every fitted gradient.
    pub gradients: Vec<Change>,
    /// Skew gradients, gains and couplings, the clearest first.
    pub others: Vec<Other>,
    /// Cables.
    pub wiring: Vec<Wiring>,
}

/// Changes from one measurement, whose cables were put right and which has been fitted, to another as it was measured.
///
/// # Errors
/// [`MeasuredError`]; [`MeasuredError::Unlike`] where the instruments are not the same.
pub fn compare(
    (one, cables, fitted): (&Folder, &[Wiring], &Fit),
    other: &Folder,
    settings: &Settings,
    progress: &mut dyn FnMut(&str),
) -> Result<Changes, MeasuredError> {
    expect_alike(one, other)?;
    let mut other = other.clone();
    cables.iter().for_each(|cable| cable.put_right(&mut other));
    let (other, wiring) = straightened_by(&other, &one.matrix);
    let model = Model::of(one, &fitted.groups, settings.rf)?.with_kicks(&other);
    let (first, mut data) = (&fitted.data, Data::of(&other));
    // what is left over grows with the kick
    let per_kick = |j: usize| match (one.correctors.get(j), other.correctors.get(j)) {
        (Some(one), Some(other)) => other.kick / one.kick,
        _ => other.meta.delta_rf / one.meta.delta_rf,
    };
    for j in 0..data.sigma.ncols() {
        for i in 0..data.sigma.nrows() {
            let both = (first.sigma[(i, j)] * per_kick(j)).hypot(data.sigma[(i, j)]);
            let counts = both.is_finite();
            data.sigma[(i, j)] = if counts { both } else { f64::INFINITY };
            data.measured[(i, j)] =
                if counts { data.measured[(i, j)] - fitted.residual[(i, j)] * per_kick(j) } else { 0.0 };
        }
    }
    // the errors of the first stand in the elements
    let expected = Expected { values: fitted.values.clone(), covariance: None };
    let found = Departures::of(&model, &fitted.unknowns, &expected, &data, progress)?;
    Ok(Changes { gradients: gradients(one, fitted, &found), others: others(one, fitted, &found), wiring })
}

/// The same elements and instruments, in the same order.
fn expect_alike(one: &Folder, other: &Folder) -> Result<(), MeasuredError> {
    let unlike = |what: &str, a: usize, b: usize| {
        Err(MeasuredError::Unlike(format!("{} has {a} {what}, {} has {b}: not one machine", one.name, other.name)))
    };
    if one.lattice.len() != other.lattice.len() {
        return unlike("elements", one.lattice.len(), other.lattice.len());
    }
    if one.matrix.shape() != other.matrix.shape() || one.dispersion.is_some() != other.dispersion.is_some() {
        return unlike("readings", one.matrix.len(), other.matrix.len());
    }
    let monitors = one.monitors.iter().zip(&other.monitors).position(|(a, b)| (a.at, a.plane) != (b.at, b.plane));
    let correctors = one.correctors.iter().zip(&other.correctors).position(|(a, b)| (a.at, a.plane) != (b.at, b.plane));
    let differs = |what: &str, a: String, b: String| {
        Err(MeasuredError::Unlike(format!(
            "{}: {a}, {}: {b}; the {what} must stand in the same order",
            one.name, other.name
        )))
    };
    match (monitors, correctors) {
        (Some(row), _) => differs("monitors", one.monitor(row), other.monitor(row)),
        (_, Some(column)) => differs("correctors", one.corrector(column), other.corrector(column)),
        (None, None) => Ok(()),
    }
}

/// What is not a gradient and changed.
fn others(folder: &Folder, fitted: &Fit, found: &Departures) -> Vec<Other> {
    let mut all = Vec::new();
    for (at, unknown) in fitted.unknowns.iter().enumerate() {
        if matches!(unknown.kind, Kind::Strength(_) | Kind::HeldFrequency) {
            continue;
        }
        let (change, sigma) = found.change(at);
        if found.is_clear((change, sigma)) {
            all.push(Other { kind: unknown.kind, name: name(folder, &fitted.groups, unknown.kind), change, sigma });
        }
    }
    all.sort_by(|a, b| (b.change / b.sigma).abs().total_cmp(&(a.change / a.sigma).abs()));
    all
}

fn gradients(folder: &Folder, fitted: &Fit, found: &Departures) -> Vec<Change> {
    let mut all = Vec::new();
    for (at, unknown) in fitted.unknowns.iter().enumerate() {
        let Kind::Strength(group) = unknown.kind else { continue };
        let rows = fitted.groups[0][group].clone();
        let (relative, sigma) = found.change(at);
        all.push(Change {
            name: name(folder, &fitted.groups, unknown.kind),
            family: folder.lattice[rows[0]].name.clone(),
            rows,
            relative,
            sigma,
            has_changed: found.is_clear((relative, sigma)),
            is_identifiable: false,
        });
    }
    let mut families: BTreeMap<String, (f64, f64, usize)> = BTreeMap::new();
    for one in &all {
        let of = families.entry(one.family.clone()).or_default();
        *of = (of.0 + one.relative.powi(2), of.1 + one.sigma.powi(2), of.2 + 1);
    }
    for one in &mut all {
        let (squares, errors, n) = families[&one.family];
        let told = 1.0 - errors / squares.max(f64::MIN_POSITIVE);
        // of n squares that are errors only the sum scatters by sqrt(2/n) of itself
        let is_still = squares < errors * (1.0 + 2.0 * (2.0 / n as f64).sqrt());
        one.is_identifiable = told > TOLD || (is_still && (errors / n as f64).sqrt() < STILL);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::fit;
    use crate::testing::{NOISE, machine, measured, normal, ring};

    #[test]
    fn changes_are_found_within_their_error_bars_where_the_model_errs_alike() {
        let ring = ring();
        let (model, unknowns, values) = machine(&ring, 5);
        let mut normal = normal(9);
        let mut later = values.clone();
        let changes: Vec<f64> = (0..24).map(|magnet| if magnet % 2 == 0 { 0.004 * normal() } else { 0.0 }).collect();
        changes.iter().enumerate().for_each(|(magnet, change)| later[magnet] *= 1.0 + change);
        let (mut one, mut other) = (
            measured(&ring, &(model.clone(), unknowns.clone(), values), NOISE, 1),
            measured(&ring, &(model, unknowns, later), NOISE, 2),
        );
        // what the model misses, ten times the noise and the same in both
        for (i, (a, b)) in one.matrix.iter_mut().zip(other.matrix.iter_mut()).enumerate() {
            let missed = 10.0 * NOISE * (1.7 * i as f64).sin();
            *a += missed;
            *b += missed;
        }
        let settings = Settings::default();
        let fitted = fit(&one, &settings, &mut |_| ()).unwrap();
        let found = compare((&one, &[], &fitted), &other, &settings, &mut |_| ()).unwrap().gradients;
        let pulls = found.iter().zip(&changes).map(|(found, change)| ((found.relative - change) / found.sigma).powi(2));
        // 24 pulls: their mean square scatters by 0.29, three times that
        let mean = pulls.sum::<f64>() / 24.0;
        assert!((0.3..1.9).contains(&mean), "mean square pull {mean}");
        let of = |family: &str| found.iter().filter(|one| one.family == family).all(|one| one.is_identifiable);
        assert!(of("QF"), "{found:?}");
        // none of them changed, and a change of 0.16 % would not show
        assert!(!of("QD"), "{found:?}");
        assert!(found.iter().all(|one| one.sigma < 0.003), "{found:?}");
    }

    #[test]
    fn gains_and_cables_that_changed_are_named() {
        let ring = ring();
        let truth = machine(&ring, 5);
        let (one, mut other) = (measured(&ring, &truth, NOISE, 1), measured(&ring, &truth, NOISE, 2));
        other.matrix.row_mut(4).scale_mut(1.03);
        other.matrix.column_mut(7).scale_mut(0.97);
        let exchanged = Wiring::MonitorsExchanged(vec![2, 6]);
        exchanged.put_right(&mut other);
        let settings = Settings::default();
        let fitted = fit(&one, &settings, &mut |_| ()).unwrap();
        let found = compare((&one, &[], &fitted), &other, &settings, &mut |_| ()).unwrap();
        assert_eq!(found.wiring, [exchanged]);
        let kinds: Vec<Kind> = found.others.iter().map(|one| one.kind).collect();
        assert!(kinds.len() == 2, "{found:?}");
        for (kind, change) in [(Kind::MonitorGain(4), 0.03), (Kind::CorrectorGain(7), -0.03)] {
            let one = found.others.iter().find(|one| one.kind == kind).unwrap();
            // 1 % is how far a gain is expected to change beforehand
            assert!((one.change - change).abs() < 4.0 * one.sigma && one.sigma < 0.005, "{one:?}");
        }
        assert!(found.gradients.iter().all(|one| one.relative.abs() < 4.0 * one.sigma), "{found:?}");
    }

    #[test]
    fn other_instruments_are_refused() {
        let one = ring();
        let fitted = fit(&measured(&one, &machine(&one, 1), NOISE, 1), &Settings::default(), &mut |_| ()).unwrap();
        let mut other = one.clone();
        other.monitors.swap(0, 1);
        let refused = compare((&one, &[], &fitted), &other, &Settings::default(), &mut |_| ()).unwrap_err();
        assert_eq!(refused.to_string(), "ring: x_BPM.0, ring: x_BPM.8; the monitors must stand in the same order");
    }
}
