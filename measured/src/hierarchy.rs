//! The fit of a matrix with everything that an ordinary ring has: beside the unknowns of the fit as LOCO has them, factors that strengths have in common, an
//! integrated gradient in every dipole, sextupole and straight, vertical focusing along straights, a skew gradient in every magnet, and couplings of all
//! instruments. Each kind is a family ([`Family`]) whose scatter is learnt, so that what the ring does not have costs nothing and takes nothing.
//!
//! Gauss-Newton on the fit's likelihood with the families' priors; about each linearisation scales are learnt, that of the family first which gains most, then the error
//! of the model.

use core::cmp::Ordering;
use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};

use crate::data::Data;
use crate::error::MeasuredError;
use crate::family::{Family, Marginal, ORDINARY, UNCHANGED, class, families, sort};
use crate::fit::{Fit, Settings};
use crate::folder::{Folder, Row};
use crate::linear::{Factor, inverse, product};
use crate::model::{Model, Prediction};
use crate::noise::Noise;
use crate::normal::{Places, times};
use crate::uncertainty::Uncertainty;
use crate::unknowns::{Groups, Kind, Magnets, Unknown, Widths, magnets, straights, unknowns};

/// Linearisations: the first begins at the fit, whose values differ from the last ones by what families take.
const ROUNDS: usize = 7;
/// Times that each family has its turn, at most.
const MOST_TURNS: usize = 40;
/// What is not linear may look like a family with this share of the gain of the first, until all is linearised anew.
const NONLINEAR: f64 = 0.1;
/// A fit has settled where a round promises less than this, of sums of thousands [nat].
const SETTLED: f64 = 30.0;
/// Gain of a scale that is worth a turn [nat].
const ENOUGH: f64 = 2.0;
/// Damping of the first step: gains of all monitors and kicks of all correctors together tell nothing, and go nowhere.
const DAMPING: f64 = 1e-6;
/// Damping at which no step helps.
const STUCK: f64 = 1e6;

/// A measurement with all its families.
#[derive(Debug, Clone)]
pub struct Hierarchy {
    /// What is explained.
    pub data: Data,
    /// Groups of magnets, those of the fit first.
    pub groups: Groups,
    /// All unknowns.
    pub unknowns: Vec<Unknown>,
    /// Most probable values.
    pub values: DVector<f64>,
    /// Class of each unknown in its kind.
    pub classes: Vec<String>,
    /// Families, with their scales.
    pub families: Vec<Family>,
    /// Posterior about the last linearisation.
    pub posterior: Posterior,
    /// Errors of the elements.
    pub noise: Noise,
    /// Measured less predicted [mm].
    pub residual: DMatrix<f64>,
    /// How well the values are known where errors are alike along rows and columns.
    pub uncertainty: Uncertainty,
    /// Prediction at the values.
    pub prediction: Prediction,
}

/// Posterior of all unknowns in widths of their priors, to first order.
#[derive(Debug, Clone)]
pub struct Posterior {
    /// Curvature of `-ln` likelihood.
    pub information: DMatrix<f64>,
    /// Its slope where all unknowns are at the means of their families.
    pub slope: DVector<f64>,
    /// Distance of the values from the means of their families.
    pub values: DVector<f64>,
    /// Covariance.
    pub covariance: DMatrix<f64>,
}

/// A family that may take another scale.
struct Turn {
    number: usize,
    /// What its best scale gains [nat], and that scale.
    gain: f64,
    scale: f64,
    /// False where another family took its scale since.
    is_told: bool,
}

impl Posterior {
    /// With the priors of some families.
    pub fn of_families(
        information: DMatrix<f64>,
        slope: DVector<f64>,
        families: &[Family],
    ) -> Result<Self, MeasuredError> {
        let precision = &information + precision(families, slope.len());
        let covariance = inverse(&precision).ok_or(MeasuredError::Singular(0))?;
        Ok(Self { values: &covariance * &slope, information, slope, covariance })
    }

    /// With scales and then weights that are learnt, and how far the scales went [nat].
    fn learn(mut self, families: &mut [Family], share: f64) -> Result<(Self, f64), MeasuredError> {
        let gained = self.learn_scales(families, share)?;
        for family in families.iter_mut().filter(|family| family.is_learnt()) {
            family.weigh(&family.deviations(&self.values, &self.covariance));
        }
        Ok((Self::of_families(self.information, self.slope, families)?, gained))
    }

    /// The scales that make the measurement most probable: that of the family first which gains most, since what one explains another needs not to. Gains that
    /// were told before another family took its scale order the turns, and are told anew when theirs comes. The sum of what was gained.
    fn learn_scales(&mut self, families: &mut [Family], share: f64) -> Result<f64, MeasuredError> {
        let (mut least, mut gained) = (ENOUGH, 0.0);
        let mut turns: Vec<Turn> = (0..families.len())
            .filter(|&number| families[number].is_learnt())
            .map(|number| Turn { number, gain: f64::INFINITY, scale: 0.0, is_told: false })
            .collect();
        for _ in 0..MOST_TURNS * turns.len() {
            turns.sort_by(|a, b| {
                (b.gain > least, b.gain).partial_cmp(&(a.gain > least, a.gain)).unwrap_or(Ordering::Equal)
            });
            let first = turns.iter().position(|turn| turn.gain > least || !turn.is_told);
            let Some(first) = first.map(|first| &mut turns[first]) else { break };
            let family = &families[first.number];
            if !first.is_told {
                let marginal = self.marginal(family)?;
                first.scale = family.best_scale(&marginal);
                let better = family.with_scale(first.scale).log_evidence(&marginal);
                first.gain = better.zip(family.log_evidence(&marginal)).map_or(0.0, |(better, now)| better - now);
                first.is_told = true;
                continue;
            }
            (least, gained) = (least.max(share * first.gain), gained + first.gain);
            let scaled = family.with_scale(first.scale);
            self.add_precision(&family.members, &(scaled.precision() - family.precision()))?;
            families[first.number] = scaled;
            first.gain = 0.0;
            let number = first.number;
            turns.iter_mut().filter(|turn| turn.number != number).for_each(|turn| turn.is_told = false);
        }
        Ok(gained)
    }

    /// With a prior that is more precise by `P` for some members: with `C` the covariance, `C_m` its columns of these and `C_mm` their own block,
    ///
    /// `C - C_m (1 + P C_mm)^-1 P C_m^T`,
    ///
    /// products with few columns in place of an inverse of all.
    fn add_precision(&mut self, members: &[usize], further: &DMatrix<f64>) -> Result<(), MeasuredError> {
        let columns = self.covariance.select_columns(members);
        let own = columns.select_rows(members);
        let inner = DMatrix::identity(members.len(), members.len()) + further * own;
        let inner = inner.lu().solve(further).ok_or(MeasuredError::Singular(0))?;
        self.covariance -= product(&product(&columns, &inner), &columns.transpose());
        self.values = &self.covariance * &self.slope;
        Ok(())
    }

    /// What the data say of the members of a family, everything else adapting.
    ///
    /// # Errors
    /// [`MeasuredError::Singular`].
    pub fn marginal(&self, family: &Family) -> Result<Marginal, MeasuredError> {
        let covariance = self.covariance.select_rows(&family.members).select_columns(&family.members);
        let whole = inverse(&covariance).ok_or(MeasuredError::Singular(0))?;
        let slope = &whole * self.values.select_rows(&family.members);
        Ok(Marginal { information: whole - family.precision(), slope })
    }
}

impl Hierarchy {
    /// Of a fitted measurement.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of_fit(
        folder: &Folder,
        fitted: &Fit,
        settings: &Settings,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        let groups = everything(folder, &fitted.groups);
        let unknowns = all_unknowns(folder, &groups, settings);
        let start = unknowns.iter().map(|unknown| {
            let known = fitted.unknowns.iter().position(|one| one.kind == unknown.kind);
            known.map_or(unknown.mean, |number| fitted.values[number])
        });
        let values = DVector::from_iterator(unknowns.len(), start);
        let mut families = families(folder, &groups, &unknowns, &[], ORDINARY);
        for family in &mut families {
            family.mean_from(&unknowns, &values);
        }
        let model = Model::of(folder, &groups, settings.rf)?;
        let classes = unknowns.iter().map(|unknown| class(folder, &groups, unknown.kind)).collect();
        let data = Data::with_coupling(folder, &fitted.outliers);
        let prediction = model.predict(&unknowns, &values)?;
        let residual = data.residual(&prediction);
        // what follows the data is not known yet
        let nothing = DMatrix::zeros(residual.nrows(), residual.ncols());
        let (noise, _) = fitted.noise.learnt(&data, &residual, &nothing);
        let start = Start { data, groups, unknowns, values, classes, families, noise };
        start.settle(&model, ROUNDS, progress)
    }

    /// The same with some members released, linearised anew.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn with_released(
        self,
        folder: &Folder,
        model: &Model,
        released: &[usize],
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        let ordinary = self.families.iter().find(|family| family.is_learnt()).map_or(ORDINARY, |one| one.ordinary);
        let mut families = families(folder, &self.groups, &self.unknowns, released, ordinary);
        for family in &mut families {
            let known = self.families.iter().find(|one| one.is_learnt() && one.claims(family.kind, &family.class));
            let Some(known) = known else { continue };
            (family.mean, family.scale, family.freedom) = (known.mean, known.scale, known.freedom);
        }
        let Self { data, groups, unknowns, values, classes, noise, .. } = self;
        let start = Start { data, groups, unknowns, values, classes, families, noise };
        start.settle(model, ROUNDS / 2, progress)
    }

    /// Of another measurement of the same ring: changes about the values of this one, which are small beforehand.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of_changes(
        &self,
        folder: &Folder,
        (data, model): (Data, &Model),
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        let about = self.unknowns.iter().zip(&self.values);
        let unknowns: Vec<Unknown> = about.map(|(unknown, &mean)| Unknown { mean, ..*unknown }).collect();
        let mut families = families(folder, &self.groups, &unknowns, &[], UNCHANGED);
        // edges of dipoles do not change
        let wigglers = families.iter_mut().filter(|family| family.kind == Kind::Wiggler(0).word());
        wigglers.for_each(|family| family.freedom = 0.0);
        let Self { groups, values, classes, noise, .. } = self.clone();
        let start = Start { data, groups, unknowns, values, classes, families, noise };
        start.settle(model, ROUNDS, progress)
    }

    /// Precision of the prior in widths.
    pub fn precision(&self) -> DMatrix<f64> {
        precision(&self.families, self.unknowns.len())
    }

    /// Distance of the values from the means of their families, in widths.
    pub fn off_means(&self) -> DVector<f64> {
        let means = means(&self.families, self.unknowns.len());
        DVector::from_fn(means.len(), |i, _| self.off_prior(i) - means[i])
    }

    /// Distance of a value from what was expected beforehand, in widths.
    fn off_prior(&self, unknown: usize) -> f64 {
        let Unknown { mean, width, .. } = self.unknowns[unknown];
        (self.values[unknown] - mean) / width
    }

    /// The family that an unknown is of, whether it is released or not.
    pub fn family_of(&self, unknown: usize) -> Option<&Family> {
        let (kind, class) = (self.unknowns[unknown].kind.word(), &self.classes[unknown]);
        self.families.iter().find(|family| family.is_learnt() && family.claims(kind, class))
    }

    /// What a distance from the mean of a family is told in shares of: gains and strengths of the mean of their family, couplings of the mean gain in the other
    /// plane, which the orbits that they see or make are of, since monitors and kicks of a plane have a common scale that no matrix tells; 1 of anything else.
    pub fn scale_of(&self, unknown: usize) -> f64 {
        let mean = |unknown: usize| self.unknowns[unknown].mean + self.in_common(unknown);
        let other_plane = |gain: &str| {
            let class = &self.classes[unknown];
            let of_gain = |&number: &usize| self.unknowns[number].kind.word() == gain && self.classes[number] != *class;
            (0..self.unknowns.len()).find(of_gain).map_or(1.0, mean)
        };
        match self.unknowns[unknown].kind {
            Kind::MonitorGain(_) | Kind::CorrectorGain(_) | Kind::Strength(_) => mean(unknown),
            Kind::MonitorCoupling(_) => other_plane("bpm_gain"),
            Kind::CorrectorCoupling(_) => other_plane("corrector_gain"),
            _ => 1.0,
        }
    }

    /// Strength of each group of magnets over that of the lattice, the product of all factors that they have, with its standard deviation.
    pub fn strengths(&self) -> Vec<[f64; 2]> {
        let factor = |number: usize| match self.unknowns[number].kind {
            Kind::Strength(group) => Some((number, &self.groups[0][group])),
            _ => None,
        };
        let factors: Vec<(usize, &Magnets)> = (0..self.unknowns.len()).filter_map(factor).collect();
        let numbers: Vec<usize> = factors.iter().map(|(number, _)| *number).collect();
        let share = |group: usize, factor: usize| {
            let (number, magnets) = factors[factor];
            if magnets.contains(&self.groups[0][group][0]) { 1.0 / self.values[number] } else { 0.0 }
        };
        let relative = DMatrix::from_fn(self.groups[0].len(), factors.len(), share);
        let variances = self.uncertainty.among(&numbers).variances(&relative);
        let strength = |group: usize| {
            let strength: f64 =
                relative.row(group).iter().filter(|share| **share != 0.0).map(|share| 1.0 / share).product();
            [strength, strength * variances[group].sqrt()]
        };
        (0..self.groups[0].len()).map(strength).collect()
    }

    /// Distance of a value from the mean of the family that it is of, whether it is released or not.
    pub fn off_family(&self, unknown: usize) -> f64 {
        self.values[unknown] - self.unknowns[unknown].mean - self.in_common(unknown)
    }

    /// What the members of an unknown's family have in common beyond their means beforehand. What the family expects is ahead of the values where nothing tells it, as
    /// the common scale of gains and kicks: it is told anew by the values.
    fn in_common(&self, unknown: usize) -> f64 {
        let Some(family) = self.family_of(unknown) else { return 0.0 };
        let further = family.further_mean(|member| self.off_prior(member) - family.mean);
        (family.mean + further) * self.unknowns[unknown].width
    }

    /// Standard deviation of that distance: what all members have in common is in both.
    pub fn sigma_off_family(&self, unknown: usize) -> f64 {
        let mut combination = DVector::zeros(self.values.len());
        if let Some(family) = self.family_of(unknown).filter(|family| family.has_mean()) {
            let share = 1.0 / family.members.len() as f64;
            family.members.iter().for_each(|&member| combination[member] -= share);
        }
        combination[unknown] += 1.0;
        self.uncertainty.variance(&combination).sqrt()
    }
}

/// Where the fit with families begins.
struct Start {
    data: Data,
    groups: Groups,
    unknowns: Vec<Unknown>,
    values: DVector<f64>,
    classes: Vec<String>,
    families: Vec<Family>,
    noise: Noise,
}

/// The likelihood about some values, with distances in widths of the priors.
struct Linearised {
    residual: DMatrix<f64>,
    weight: DMatrix<f64>,
    information: DMatrix<f64>,
    slope: DVector<f64>,
    /// What the means of the families expect.
    expected: DVector<f64>,
    /// Distance of the values from it.
    off: DVector<f64>,
}

/// What stays while a fit settles.
struct Scene<'s> {
    model: &'s Model,
    places: Places,
    width: DVector<f64>,
    mean: DVector<f64>,
}

impl Start {
    /// Linearise, learn and go on, in turn.
    fn settle(
        mut self,
        model: &Model,
        rounds: usize,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Hierarchy, MeasuredError> {
        let (rows, columns) = self.data.measured.shape();
        let each = |of: fn(&Unknown) -> f64| DVector::from_iterator(self.unknowns.len(), self.unknowns.iter().map(of));
        let places = Places::of(&self.unknowns, rows, columns);
        let scene = Scene { model, places, width: each(|one| one.width), mean: each(|one| one.mean) };
        let mut prediction = model.predict(&self.unknowns, &self.values)?;
        let (mut damping, mut followed, mut curvature) = (DAMPING, DMatrix::zeros(0, 0), None);
        for round in 1..=rounds {
            progress(&format!("families, round {round} of {rounds}"));
            let here = self.linearise(&scene, &prediction, None);
            let share = if round < rounds { NONLINEAR } else { 0.0 };
            let (posterior, gained) = here.posterior(&self.families)?.learn(&mut self.families, share)?;
            let promised;
            (prediction, promised) = self.descend(&scene, &here, prediction, &mut damping)?;
            for family in &mut self.families {
                family.mean += family.deviations(&posterior.values, &posterior.covariance).mean;
            }
            let left = self.data.residual(&prediction);
            // what the unknowns follow of an element changes with the families' scales, and little with the size of the errors
            if round == 1 || gained > 0.0 {
                let covariance = times(posterior.covariance, &scene.width);
                followed = self.noise.followed(&self.data, &scene.places, &prediction, (&left, &covariance));
            }
            (self.noise, _) = self.noise.learnt(&self.data, &left, &followed);
            if gained + promised < SETTLED {
                // the first round has the errors of another fit; later neither they nor so small a step change the curvature by much
                curvature = (round > 1).then_some(here.information);
                break;
            }
        }
        let here = self.linearise(&scene, &prediction, curvature);
        let (posterior, _) = here.posterior(&self.families)?.learn(&mut self.families, 0.0)?;
        let covariance = times(posterior.covariance.clone(), &scene.width);
        let information = times(posterior.information.clone(), &scene.width.map(f64::recip));
        let uncertainty =
            Uncertainty::about((&scene.places, &prediction), (covariance, information), (&self.data, &self.noise));
        let Self { data, groups, unknowns, values, classes, families, noise } = self;
        let residual = here.residual;
        Ok(Hierarchy {
            data,
            groups,
            unknowns,
            values,
            classes,
            families,
            posterior,
            noise,
            residual,
            uncertainty,
            prediction,
        })
    }

    /// About a prediction, with a curvature that is known or is made.
    fn linearise(&self, scene: &Scene, prediction: &Prediction, curvature: Option<DMatrix<f64>>) -> Linearised {
        let n = self.unknowns.len();
        let residual = self.data.residual(prediction);
        let weight = self.data.weight(&self.noise, &residual);
        let slope = scene.places.back(prediction, &weight.component_mul(&residual));
        let expected = &scene.mean + means(&self.families, n).component_mul(&scene.width);
        Linearised {
            information: curvature
                .unwrap_or_else(|| times(scene.places.information(prediction, &weight), &scene.width)),
            slope: slope.component_mul(&scene.width),
            off: (&self.values - &expected).component_div(&scene.width),
            residual,
            weight,
            expected,
        }
    }

    /// A damped step downhill, with what it promised [nat]: the longest one that is not worse, none where no step helps.
    fn descend(
        &mut self,
        scene: &Scene,
        here: &Linearised,
        prediction: Prediction,
        damping: &mut f64,
    ) -> Result<(Prediction, f64), MeasuredError> {
        let prior = precision(&self.families, self.unknowns.len());
        let distance = |values: &DVector<f64>, prediction: &Prediction| {
            let left = self.data.residual(prediction);
            let off = (values - &here.expected).component_div(&scene.width);
            left.component_mul(&left).dot(&here.weight) + off.dot(&(&prior * &off))
        };
        let now = distance(&self.values, &prediction);
        let downhill = &here.slope - &prior * &here.off;
        let whole = &here.information + &prior;
        while *damping < STUCK {
            let mut damped = whole.clone();
            (0..downhill.len()).for_each(|i| damped[(i, i)] *= 1.0 + *damping);
            let step = Factor::of(&damped).ok_or(MeasuredError::Singular(0))?.solve(&downhill);
            let there = &self.values + step.component_mul(&scene.width);
            match scene.model.predict(&self.unknowns, &there) {
                Ok(better) if distance(&there, &better) <= now => {
                    self.values = there;
                    *damping = (*damping * 0.1).clamp(DAMPING, 1.0);
                    return Ok((better, 0.5 * downhill.dot(&step)));
                }
                _ => *damping *= 10.0,
            }
        }
        *damping = 1.0;
        Ok((prediction, 0.0))
    }
}

impl Linearised {
    fn posterior(&self, families: &[Family]) -> Result<Posterior, MeasuredError> {
        let slope = &self.slope + &self.information * &self.off;
        Posterior::of_families(self.information.clone(), slope, families)
    }
}

/// Mean of each unknown's family in widths.
fn means(families: &[Family], unknowns: usize) -> DVector<f64> {
    let mut means = DVector::zeros(unknowns);
    families.iter().for_each(|family| family.members.iter().for_each(|&member| means[member] = family.mean));
    means
}

/// Precision of the families' priors in widths.
fn precision(families: &[Family], unknowns: usize) -> DMatrix<f64> {
    let mut precision = DMatrix::zeros(unknowns, unknowns);
    families.iter().for_each(|family| family.add_precision(&mut precision));
    precision
}

/// Groups of the fit, and those that have a factor in common; a gradient in each dipole, sextupole, straight and quadrupole of a group, and a skew gradient in each
/// magnet, where the fit has none; straights.
fn everything(folder: &Folder, fitted: &Groups) -> Groups {
    let [mut strengths, mut skews, mut gradients, _] = fitted.clone();
    let is_magnet = |row: &Row| row.k1 != 0.0 || row.bend != 0.0 || row.half_k2 != 0.0;
    for magnet in magnets(folder, is_magnet) {
        let middle = vec![magnet[magnet.len() / 2]];
        if !skews.iter().flatten().any(|row| magnet.contains(row)) {
            skews.push(middle.clone());
        }
        if !strengths.contains(&magnet) {
            gradients.push(middle);
        }
    }
    let with_gradient = fitted[0].iter().filter(|group| group.iter().any(|&row| folder.lattice[row].k1 != 0.0));
    strengths.extend(in_common(folder, &with_gradient.cloned().collect::<Vec<_>>()));
    let straights = straights(folder);
    gradients.extend(straights.iter().map(|rows| vec![rows[rows.len() / 2]]));
    [strengths, skews, gradients, straights]
}

/// Groups of groups whose strengths have a factor in common: those of one name, as of one supply or one design, else of one sort; then all of them, as the
/// momentum scales all.
fn in_common(folder: &Folder, groups: &[Magnets]) -> Vec<Magnets> {
    let name = |group: &Magnets| folder.lattice[group[0]].name.clone();
    let mut by_name: BTreeMap<String, Vec<&Magnets>> = BTreeMap::new();
    for group in groups {
        let is_alone = groups.iter().filter(|other| name(other) == name(group)).count() == 1;
        by_name.entry(if is_alone { sort(folder, group[0]).into() } else { name(group) }).or_default().push(group);
    }
    let several = by_name.into_values().filter(|within| within.len() > 1 && within.len() < groups.len());
    let everything = (groups.len() > 1).then(|| groups.iter().collect());
    several.chain(everything).map(|within: Vec<&Magnets>| within.into_iter().flatten().copied().collect()).collect()
}

/// Unknowns of all groups and of all instruments.
fn all_unknowns(folder: &Folder, groups: &Groups, settings: &Settings) -> Vec<Unknown> {
    let Widths { skew, wiggler, .. } = settings.widths;
    let fitted = unknowns(folder, groups, true, &settings.widths);
    let (magnets, instruments) = fitted.split_at(groups[0].len() + groups[1].len());
    let gradients = (0..groups[2].len()).map(|group| Unknown { kind: Kind::Gradient(group), mean: 0.0, width: skew });
    let wigglers = (0..groups[3].len()).map(|group| Unknown { kind: Kind::Wiggler(group), mean: 0.0, width: wiggler });
    magnets.iter().copied().chain(gradients).chain(wigglers).chain(instruments.iter().copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::fit;
    use crate::testing::{NOISE, machine, measured, ring};

    #[test]
    fn scatters_of_an_imperfect_ring_are_learnt_and_its_strengths_found() {
        let ring = ring();
        let settings = Settings::default();
        let (mut nees, mut strengths, mut scatters) = (0.0, 0, std::collections::BTreeMap::<&str, Vec<f64>>::new());
        for seed in 0..6 {
            let truth = machine(&ring, seed);
            let folder = measured(&ring, &truth, NOISE, 700 + seed);
            let fitted = fit(&folder, &settings, &mut |_| ()).unwrap();
            let found = Hierarchy::of_fit(&folder, &fitted, &settings, &mut |_| ()).unwrap();
            for family in found.families.iter().filter(|family| family.is_learnt()) {
                scatters.entry(family.kind).or_default().push(family.scale * found.unknowns[family.members[0]].width);
            }
            for (group, [strength, sigma]) in found.strengths().into_iter().take(fitted.groups[0].len()).enumerate() {
                nees += ((strength - truth.2[group]) / sigma).powi(2);
                strengths += 1;
            }
        }
        // the ring has gains of 3 %, couplings of 1 % and strengths of 1 %; of twelve members each a scatter is known to 20 %, of twelve such to
        // 6 %: four of these, and what the members of an ordinary ring draw it to
        for (kind, expected) in
            [("bpm_gain", 0.03), ("corrector_gain", 0.03), ("bpm_coupling", 0.01), ("quadrupole_gradient", 0.01)]
        {
            let scatters = &scatters[kind];
            let mean = scatters.iter().sum::<f64>() / scatters.len() as f64;
            assert!((mean / expected - 1.0).abs() < 0.35, "{kind}: {mean}");
        }
        // gradients that the ring has not are drawn to those of an ordinary one, 0.001 /m, by two members beside twelve; of twelve families one takes what
        // strengths leave
        let large = scatters["stray_gradient"].iter().filter(|&&scatter| scatter > 0.002).count();
        assert!(large < 2, "{:?}", scatters["stray_gradient"]);
        // 144 strengths: their mean square scatters by 0.12, four times that
        let mean = nees / f64::from(strengths);
        assert!((0.4..1.5).contains(&mean), "NEES {mean}");
    }

    /// The curvature is that of the last round, where nothing moved by much any more: its diagonal is off by 6.5 % at most, half of that in error bars, and by 0.8 % on
    /// average.
    #[test]
    fn the_curvature_is_that_at_the_values() {
        let ring = ring();
        let settings = Settings::default();
        let (mut most, mut mean) = (0.0_f64, 0.0);
        for seed in 0..4 {
            let folder = measured(&ring, &machine(&ring, seed), NOISE, 700 + seed);
            let fitted = fit(&folder, &settings, &mut |_| ()).unwrap();
            let found = Hierarchy::of_fit(&folder, &fitted, &settings, &mut |_| ()).unwrap();
            let Hierarchy { data, unknowns, noise, residual, prediction, posterior, .. } = &found;
            let places = Places::of(unknowns, residual.nrows(), residual.ncols());
            let width = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.width));
            let exact = times(places.information(prediction, &data.weight(noise, residual)), &width);
            let off = posterior.information.diagonal().component_div(&exact.diagonal()).add_scalar(-1.0);
            (most, mean) = (most.max(off.amax()), mean + off.mean().abs() / 4.0);
        }
        assert!(most < 0.066 && mean < 0.008, "{most} {mean}");
    }
}
