//! What changed from one measurement of a machine to the next.
//!
//! What the model misses is mostly the same in both and drops out: the second matrix is fitted less what the first fit left over, about the values of the first.
//! Its changes are families as those of a ring are ([`Hierarchy::of_changes`]): supplies, single magnets, sextupoles, straights and instruments compete, and what
//! did not change costs nothing. What remains then is the error of the comparison, learnt as that of a fit is.

use std::collections::BTreeMap;

use twin::median;

use crate::alignment::aligned;
use crate::data::Data;
use crate::departure::clear;
use crate::diagnose::{released, word};
use crate::error::MeasuredError;
use crate::family::{ALL, Family};
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::hierarchy::Hierarchy;
use crate::hold::Share;
use crate::model::Model;
use crate::search::NAMED;
use crate::straight::Straightened;
use crate::unknowns::{Kind, holds, name};
use crate::wiring::{Wiring, straightened_by};

/// A family's changes can be told where their found sizes would follow the true ones by a correlation of 0.92: this share of their variance is then no error.
const TOLD: f64 = 0.85;
/// A family in which no change shows can be told to have none where the error bars are below this, less than power supplies are set to.
const STILL: f64 = 0.001;
/// `ln` evidence that a family changed further than what is ordinary [nat].
const DECISIVE: f64 = 10.0;

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

/// What is not a gradient of the lattice and changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Other {
    /// What it is.
    pub word: &'static str,
    /// Where; of a whole family what its members share.
    pub at: String,
    /// Unit of the change, empty of a share.
    pub unit: &'static str,
    /// The change, of a whole family its rms.
    pub change: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// What changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Changes {
    /// Every fitted gradient.
    pub gradients: Vec<Change>,
    /// Everything else, the clearest first.
    pub others: Vec<Other>,
    /// Cables.
    pub wiring: Vec<Wiring>,
}

/// The first of two measurements, explained.
#[derive(Debug, Clone)]
pub struct Before {
    /// With its cables put right.
    pub folder: Folder,
    /// What was put right.
    pub cables: Vec<Wiring>,
    settings: Settings,
    /// Its fit with families.
    pub hierarchy: Hierarchy,
}

impl Before {
    /// Of a fitted measurement.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of_fit(
        (folder, cables): (Folder, Vec<Wiring>),
        fitted: &Fit,
        settings: &Settings,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        progress("what the RF holds");
        let share = Share::of_fit(&folder, fitted, settings, progress)?;
        let (fitted, settings) = share.fitted(&folder, fitted, settings, progress)?;
        let hierarchy = Hierarchy::of_fit(&folder, &fitted, &settings, progress)?;
        Ok(Self { folder, cables, settings, hierarchy })
    }

    /// The second measurement less what the first fit left over of the first, with the noise of both.
    fn changed(&self, after: &Folder) -> Data {
        let mut data = Data::with_coupling(after, &[]);
        let Hierarchy { data: before, residual, .. } = &self.hierarchy;
        // what is left over grows with the kick
        let per_kick = |j: usize| match (self.folder.correctors.get(j), after.correctors.get(j)) {
            (Some(before), Some(after)) => after.kick / before.kick,
            _ => after.meta.delta_rf / self.folder.meta.delta_rf,
        };
        for (i, j) in (0..data.sigma.ncols()).flat_map(|j| (0..residual.nrows()).map(move |i| (i, j))) {
            let both = (before.sigma[(i, j)] * per_kick(j)).hypot(data.sigma[(i, j)]);
            let counts = both.is_finite();
            data.sigma[(i, j)] = if counts { both } else { f64::INFINITY };
            data.measured[(i, j)] = if counts { data.measured[(i, j)] - residual[(i, j)] * per_kick(j) } else { 0.0 };
        }
        data
    }

    /// Changes from this measurement to another one of the same instruments in the same order.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn changes_to(&self, after: &Folder, progress: &mut dyn FnMut(&str)) -> Result<Changes, MeasuredError> {
        let mut after = after.clone();
        self.cables.iter().for_each(|cable| cable.put_right(&mut after));
        let (after, wiring) = straightened_by(&after, &self.folder.matrix);
        let model = Model::of(&self.folder, &self.hierarchy.groups, self.settings.rf)?.with_kicks(&after);
        let data = self.changed(&after);
        let changed = self.hierarchy.of_changes(&self.folder, (data, &model), progress)?;
        let (changed, found) = released(changed, &self.folder, &model, true, progress)?;
        let named = found.outliers.iter().filter(|outlier| outlier.probability >= NAMED);
        // of magnets themselves their own rows tell
        let is_other = |number: &usize| !matches!(changed.unknowns[*number].kind, Kind::Strength(_));
        let outliers: Vec<usize> = named.map(|outlier| outlier.unknown).filter(is_other).collect();
        let folder = &self.folder;
        let mut others: Vec<Other> = families(&changed)?;
        let is_told = |number: &usize| is_told_alone(&changed, *number) || outliers.contains(number);
        others.extend((0..changed.unknowns.len()).filter(is_told).map(|number| other(folder, &changed, number)));
        others.sort_by(|a, b| (b.change / b.sigma).abs().total_cmp(&(a.change / a.sigma).abs()));
        Ok(Changes { gradients: gradients(folder, &self.hierarchy, &changed), others, wiring })
    }
}

/// Changes from one measurement to another, as both were measured.
///
/// # Errors
/// [`MeasuredError`]; [`MeasuredError::Unlike`] where they are not of one machine.
pub fn compare(
    before: &Folder,
    after: &Folder,
    settings: &Settings,
    progress: &mut dyn FnMut(&str),
) -> Result<(Before, Changes), MeasuredError> {
    let [before, after] = aligned(before, after)?;
    let Straightened { folder, cables, fit } = Straightened::of(&before, settings, progress)?;
    let before = Before::of_fit((folder, cables), &fit, settings, progress)?;
    let changes = before.changes_to(&after, progress)?;
    Ok((before, changes))
}

/// Families of fields beside those of the lattice whose members changed further than what is ordinary.
fn families(changed: &Hierarchy) -> Result<Vec<Other>, MeasuredError> {
    let mut all = Vec::new();
    let is_field = |family: &&Family| matches!(family.kind, "stray_gradient" | "skew_gradient");
    let is_wider =
        |family: &&Family| family.has_members() && !family.is_set_one_by_one() && family.scale > family.ordinary;
    for family in changed.families.iter().filter(is_field).filter(is_wider) {
        let marginal = changed.posterior.marginal(family)?;
        let ordinary = family.with_scale(family.ordinary);
        // errors that are alike along rows and columns tell less than independent ones
        let widening = median(family.members.iter().map(|&member| changed.uncertainty.widening(member)));
        let widening = widening.expect("it has members");
        let evidence = family.log_evidence(&marginal).zip(ordinary.log_evidence(&marginal));
        let gain = evidence.map_or(0.0, |(learnt, ordinary)| learnt - ordinary) / widening;
        if gain > DECISIVE {
            let width = changed.unknowns[family.members[0]].width;
            let change = family.variance().sqrt() * width;
            // of n members
            let sigma = change / (2.0 * family.members.len() as f64).sqrt();
            let word = match (family.kind, family.class.as_str()) {
                ("stray_gradient", "sextupoles") => "sextupole_gradient",
                ("skew_gradient", "sextupoles") => "sextupole_skew_gradient",
                ("stray_gradient", "dipoles") => "dipole_gradient",
                (kind, _) => kind,
            };
            all.push(Other { word, at: format!("all {}", family.class), unit: "1/m", change, sigma });
        }
    }
    Ok(all)
}

/// True of what has no family to stand out of, or of which each tells its own story, and changed too far for chance: the factor of all gradients, the RF step, wigglers.
fn is_told_alone(changed: &Hierarchy, number: usize) -> bool {
    let is_alone = match changed.unknowns[number].kind {
        Kind::Strength(_) => changed.classes[number] == ALL,
        Kind::RfScale | Kind::Wiggler(_) | Kind::Moment(0, ..) | Kind::Added(_) => true,
        _ => false,
    };
    // beside what those of its kind change where nothing was changed
    let ordinary = changed.family_of(number).map_or(0.0, Family::ordinary_scatter);
    let (change, sigma) = change(changed, number);
    is_alone && change.abs() > clear(changed.unknowns.len()) * sigma.hypot(ordinary * changed.unknowns[number].width)
}

/// Change of an unknown beside its family, with its standard deviation: of gains by a share of themselves, the common scale of their plane tells nothing.
fn change(changed: &Hierarchy, number: usize) -> (f64, f64) {
    let share = match changed.unknowns[number].kind {
        Kind::Strength(_) | Kind::MonitorGain(_) | Kind::CorrectorGain(_) | Kind::RfScale => {
            changed.unknowns[number].mean
        }
        _ => 1.0,
    };
    (changed.off_family(number) / share, changed.sigma_off_family(number) / share.abs())
}

fn other(folder: &Folder, changed: &Hierarchy, number: usize) -> Other {
    let kind = changed.unknowns[number].kind;
    let (change, sigma) = change(changed, number);
    let unit = match kind {
        Kind::Skew(_) | Kind::Gradient(_) | Kind::Wiggler(_) | Kind::Moment(0, ..) => "1/m",
        Kind::Added(_) => "1/m^2",
        _ => "",
    };
    let at = name(folder, &changed.groups, kind);
    Other { word: word(folder, &changed.groups, kind), at, unit, change, sigma }
}

/// Changes of the groups of the fit.
fn gradients(folder: &Folder, before: &Hierarchy, changed: &Hierarchy) -> Vec<Change> {
    let strengths = &changed.groups[0];
    let has_factor = |group: usize| changed.unknowns.iter().any(|one| one.kind == Kind::Strength(group));
    let is_single =
        |&group: &usize| has_factor(group) && !strengths.iter().any(|other| holds(&strengths[group], other));
    let (of_before, of_changed) = (before.strengths(), changed.strengths());
    let mut all = Vec::new();
    for group in (0..strengths.len()).filter(is_single) {
        let rows = strengths[group].clone();
        let ([first, _], [second, sigma]) = (of_before[group], of_changed[group]);
        let (relative, sigma) = (second / first - 1.0, sigma / first.abs());
        all.push(Change {
            name: folder.element(rows[0]),
            family: folder.lattice[rows[0]].name.clone(),
            has_changed: relative.abs() > clear(changed.unknowns.len()) * sigma,
            rows,
            relative,
            sigma,
            is_identifiable: false,
        });
    }
    let mut families: BTreeMap<String, (f64, f64, usize)> = BTreeMap::new();
    for one in &all {
        let sums = families.entry(one.family.clone()).or_default();
        *sums = (sums.0 + one.relative.powi(2), sums.1 + one.sigma.powi(2), sums.2 + 1);
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
    use crate::testing::{NOISE, machine, measured, normal, ring};
    use crate::unknowns::{Unknown, fields_along, straights};

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
        let found = compare(&one, &other, &settings, &mut |_| ()).unwrap().1.gradients;
        let pulls = found.iter().zip(&changes).map(|(found, change)| ((found.relative - change) / found.sigma).powi(2));
        // 24 pulls: their mean square scatters by 0.29, three times that
        let mean = pulls.sum::<f64>() / 24.0;
        assert!((0.3..1.9).contains(&mean), "mean square pull {mean}");
        let of = |family: &str| found.iter().filter(|one| one.family == family).all(|one| one.is_identifiable);
        assert!(of("QF"), "{found:?}");
        // none of them changed, and a change of 0.1 % would show
        assert!(of("QD"), "{found:?}");
        assert!(found.iter().all(|one| one.sigma < 0.003), "{found:?}");
    }

    /// A wiggler of 0.2 /m whose poles are tilted and 3 cm off the middle of its straight: the magnets on both sides are as they were.
    #[test]
    fn a_tilted_wiggler_off_the_middle_of_its_straight_is_no_magnet_beside_it() {
        let ring = ring();
        let truth = machine(&ring, 5);
        let before = measured(&ring, &truth, NOISE, 1);
        let (_, mut unknowns, mut values) = truth;
        let [strengths, skews, ..] = crate::unknowns::groups(&ring);
        let (place, straight) = (strengths.len() + skews.len(), straights(&ring).swap_remove(3));
        let groups = [strengths, skews, Vec::new(), vec![straight.clone()]];
        let model = Model::of(&ring, &groups, twin::Rf::FixedFrequency).unwrap();
        let (whole, moments) = ([0.2, 0.02], [0.0, 0.006, 0.0]);
        let along: Vec<(Kind, f64)> = fields_along(1).zip(whole.into_iter().chain(moments)).collect();
        for (kind, value) in along.into_iter().rev() {
            unknowns.insert(place, Unknown { kind, mean: 0.0, width: 0.1 });
            values = values.insert_row(place, value);
        }
        let after = measured(&ring, &(model, unknowns, values), NOISE, 2);
        let found = compare(&before, &after, &Settings::default(), &mut |_| ()).unwrap().1;
        assert!(found.others.len() == 2, "{found:?}");
        for (word, value) in [("wiggler_focusing", 0.2), ("skew_gradient", 0.02)] {
            let one = found.others.iter().find(|one| one.word == word).unwrap();
            assert!(one.at == ring.element(straight[straight.len() / 2]), "{one:?}");
            assert!((one.change - value).abs() < 4.0 * one.sigma && one.sigma < 0.01, "{one:?}");
        }
        assert!(found.gradients.iter().all(|one| !one.has_changed), "{found:?}");
    }

    /// Two of four: the quadrupoles beside them have skew gradients too, and together nearly the same effect.
    #[test]
    fn skew_quadrupoles_that_were_set_are_named_and_no_neighbour() {
        let ring = ring();
        let truth = machine(&ring, 5);
        let before = measured(&ring, &truth, NOISE, 1);
        let (model, unknowns, mut values) = truth;
        let [strengths, skews, ..] = crate::unknowns::groups(&ring);
        let set = [(0, 0.012), (2, -0.007)];
        set.iter().for_each(|(skew, change)| values[strengths.len() + skew] += change);
        let after = measured(&ring, &(model, unknowns, values), NOISE, 2);
        let found = compare(&before, &after, &Settings::default(), &mut |_| ()).unwrap().1;
        assert!(found.others.len() == 2 && found.gradients.iter().all(|one| !one.has_changed), "{found:?}");
        for (skew, change) in set {
            let at = ring.element(skews[skew][0]);
            let one = found.others.iter().find(|one| one.word == "skew_gradient" && one.at == at).unwrap();
            assert!((one.change - change).abs() < 4.0 * one.sigma && one.sigma < 0.002, "{one:?}");
        }
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
        let found = compare(&one, &other, &settings, &mut |_| ()).unwrap().1;
        assert_eq!(found.wiring, [exchanged]);
        assert!(found.others.len() == 2, "{found:?}");
        for (word, at, change) in [("bpm_gain", one.monitor(4), 0.03), ("corrector_gain", one.corrector(7), -0.03)] {
            let one = found.others.iter().find(|one| one.word == word && one.at == at).unwrap();
            // 1 % is how far a gain is expected to change beforehand
            assert!((one.change - change).abs() < 4.0 * one.sigma && one.sigma < 0.005, "{one:?}");
        }
        assert!(found.gradients.iter().all(|one| one.relative.abs() < 4.0 * one.sigma), "{found:?}");
    }
}
