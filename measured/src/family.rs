//! Families of unknowns: members of one kind and class scatter about what is expected, or about something that they have in common, by a scale that the measurement tells.
//!
//! In units of the prior's width a member is `x_i = e + d_i` from what is expected beforehand, `e ~ N(0, f^2)` what all have in common and `d_i ~ N(0, s^2/w_i)`,
//! `s` at most 1. With `e` integrated out the prior's precision of the `n` members is
//!
//! `(W - c w w^T)/s^2`, `c = 1/(sum w + s^2/f^2)`.
//!
//! The weights `w_i = (nu + 1)/(nu + d_i^2/s^2)` make a family one of Student's distribution: what one member has is not spread over those that
//! look like it, and does not widen the family.
//!
//! Two kinds have something in common: kicks, by the constant that amperes are converted with, and vertical focusing of straights, by the edges of the dipoles beside
//! them. A matrix tells no common scale of monitors and kicks of a plane: gains of monitors are about 1, and the scale is of the kicks. With a scale for either their
//! scatters would tell it, which are smaller for smaller gains. Gradients and skew gradients that the lattice does not have are about 0.
//!
//! The scale is the one of largest evidence. With `P` the prior's precision, `b x - x G x/2` the `ln` likelihood of the members where everything else adapts, and `k`
//! members of an ordinary ring whose scale is `s_0`, that is the maximum of
//!
//! `ln det P/2 - ln det(G + P)/2 + b (G + P)^-1 b/2 - k (ln s^2 + s_0^2/s^2)/2`.
//!
//! Source: D. J. C. MacKay, Neural Computation 4 (1992) 415, evidence for the scale of a prior.

use std::collections::BTreeMap;

use evidence::Factor;
use nalgebra::{DMatrix, DVector};

use crate::folder::Folder;
use crate::unknowns::{Groups, Kind, Unknown, holds};

/// Members that a scale can be learnt from; fewer have the prior of the fit each.
const ENOUGH: usize = 4;
/// Scales are within these, in widths of the prior.
const SCALES: [f64; 2] = [1e-3, 1.0];
/// First step between scales that are tried, and the last one, as logarithms.
const OCTAVE: f64 = core::f64::consts::LN_2;
const RESOLUTION: f64 = 0.05;
/// Scale of what is alone of its kind, in those of an ordinary family.
const ALONE: f64 = 3.0;
/// Scale of a member that is released: it has the size that the data give it.
pub const FREE: f64 = 10.0;
/// The scale of an ordinary ring: strengths 0.3 %, gains 2 %, couplings 0.5 %, gradients and skew gradients 0.001 /m.
pub const ORDINARY: f64 = 0.1;
/// The scale of changes of a ring in which nothing was changed: strengths 0.03 %, gains 0.2 %, gradients 0.0001 /m. With it, changes of strengths between repeated
/// measurements of a real ring have mean square pulls of 0.2 to 1.1.
pub const UNCHANGED: f64 = 0.01;
/// Class of magnets that have a skew gradient alone.
pub const SKEW_QUADRUPOLES: &str = "skew quadrupoles";
/// Class of the factor that all strengths have.
pub const ALL: &str = "all";
/// Members that the ordinary scale counts as.
pub const BEFOREHAND: f64 = 2.0;
/// Degrees of freedom of a family's distribution.
const TAILS: f64 = 4.0;
/// Variance of normal members over the square of the scale that this distribution gives them, the `r` of `E (nu + 1) r x^2/(nu + r x^2) = 1`.
const NORMAL: f64 = 1.48;
/// What all members may be off together, in widths of the prior: as far as one.
const FREEDOM: f64 = 1.0;

/// Unknowns of one kind and class.
#[derive(Debug, Clone, PartialEq)]
pub struct Family {
    /// Word of the kind.
    pub kind: &'static str,
    /// What the members share: a plane, a name, a sort of magnet; empty where a member has its own prior.
    pub class: String,
    /// Members, by their number among the unknowns.
    pub members: Vec<usize>,
    /// Scatter of the members in widths of the prior.
    pub scale: f64,
    /// The same of what is ordinary.
    pub ordinary: f64,
    /// Weight of each member.
    pub weights: Vec<f64>,
    /// What all may be off together, in widths of the prior; 0 where the members are about what is expected.
    pub freedom: f64,
}

/// Families of all unknowns with an ordinary scale; a member that is released, or that has no family, is one by itself. A family whose members are released stays one.
pub fn families(
    folder: &Folder,
    groups: &Groups,
    unknowns: &[Unknown],
    released: &[usize],
    ordinary: f64,
) -> Vec<Family> {
    let mut members: BTreeMap<(&'static str, String), Vec<usize>> = BTreeMap::new();
    for (number, unknown) in unknowns.iter().enumerate() {
        members.entry((unknown.kind.word(), class(folder, groups, unknown.kind))).or_default().push(number);
    }
    let (large, small): (Vec<_>, Vec<_>) = members.into_iter().partition(|(_, members)| members.len() >= ENOUGH);
    let is_held = |number: &usize| !released.contains(number);
    let large = large.into_iter().map(|((kind, class), mut members)| {
        members.retain(is_held);
        let weights = vec![1.0; members.len()];
        let has_mean = kind == Kind::CorrectorGain(0).word() || kind == Kind::Wiggler(0).word();
        let freedom = if has_mean { FREEDOM } else { 0.0 };
        Family { kind, class, members, scale: ordinary, ordinary, weights, freedom }
    });
    let alone = |number: usize, scale: f64| {
        let kind = unknowns[number].kind.word();
        Family {
            kind,
            class: String::new(),
            members: vec![number],
            scale,
            ordinary: scale,
            weights: vec![1.0],
            freedom: 0.0,
        }
    };
    let small = small
        .into_iter()
        .flat_map(|(_, members)| members)
        .filter(is_held)
        .map(|number| alone(number, ALONE * ordinary));
    let released = released.iter().map(|&number| alone(number, FREE));
    large.chain(small).chain(released).collect()
}

/// What the members of a family share.
pub fn class(folder: &Folder, groups: &Groups, kind: Kind) -> String {
    match kind {
        Kind::MonitorGain(row) | Kind::MonitorCoupling(row) => ["x", "y"][folder.monitors[row].plane.index()].into(),
        Kind::CorrectorGain(column) | Kind::CorrectorCoupling(column) => {
            ["H", "V"][folder.correctors[column].plane.index()].into()
        }
        Kind::Strength(group) => match groups[0].iter().filter(|other| holds(&groups[0][group], other)).count() {
            0 => sort(folder, groups[0][group][0]).into(),
            _ if groups[0].iter().any(|other| holds(other, &groups[0][group])) => "families".into(),
            _ => ALL.into(),
        },
        Kind::Skew(group) => match sort(folder, groups[1][group][0]) {
            "straights" => SKEW_QUADRUPOLES.into(),
            sort => sort.into(),
        },
        Kind::Gradient(group) => sort(folder, groups[2][group][0]).into(),
        Kind::Added(group) => sort(folder, groups[0][group][0]).into(),
        Kind::Wiggler(_) => "straights".into(),
        Kind::Moment(..) | Kind::RfScale | Kind::HeldFrequency => String::new(),
    }
}

/// Sort of a magnet, or of what has no field of its own.
pub fn sort(folder: &Folder, row: usize) -> &'static str {
    let magnet = &folder.lattice[row];
    match (magnet.bend != 0.0, magnet.k1 > 0.0, magnet.k1 < 0.0, magnet.half_k2 != 0.0) {
        (true, ..) => "dipoles",
        (_, true, ..) => "focusing quadrupoles",
        (_, _, true, _) => "defocusing quadrupoles",
        (.., true) => "sextupoles",
        _ => "straights",
    }
}

/// What the data say of the members of a family, everything else adapting: `ln` likelihood `b x - x G x/2`.
pub struct Marginal {
    /// `G`.
    pub information: DMatrix<f64>,
    /// `b`.
    pub slope: DVector<f64>,
}

impl Family {
    /// True where its members share something; false of what has a prior of its own.
    pub fn is_shared(&self) -> bool {
        !self.class.is_empty()
    }

    /// True of a family with members that are not released.
    pub fn has_members(&self) -> bool {
        self.is_shared() && !self.members.is_empty()
    }

    /// True where the scale is learnt. That of wigglers is not: with it what all straights have in common would differ by 5 % of a wiggler between two measurements.
    pub fn is_learnt(&self) -> bool {
        self.has_members() && self.kind != Kind::Wiggler(0).word()
    }

    /// True of skew quadrupoles. They are set one by one: what one is set to is no scatter that the others have.
    pub fn is_set_one_by_one(&self) -> bool {
        self.class == SKEW_QUADRUPOLES
    }

    /// Variance that a member has as one of them, in squares of the prior's width.
    pub fn expected_variance(&self) -> f64 {
        if self.is_set_one_by_one() { self.ordinary_scatter().powi(2).min(self.variance()) } else { self.variance() }
    }

    /// True where unknowns of a kind and class are its members, unless they are released.
    pub fn claims(&self, kind: &str, class: &str) -> bool {
        self.kind == kind && self.class == class
    }

    /// The same with members that all scatter alike, unless they are set one by one: what looks like one of them looks like its neighbours too.
    pub fn with_alike_members(&self) -> Self {
        let weights = if self.is_set_one_by_one() { self.weights.clone() } else { vec![1.0; self.members.len()] };
        Self { weights, ..self.clone() }
    }

    /// True where the members are about a value of their own.
    pub fn has_mean(&self) -> bool {
        self.freedom > 0.0
    }

    /// Variance of the members in squares of the prior's width.
    pub fn variance(&self) -> f64 {
        if self.is_shared() { NORMAL * self.scale * self.scale } else { self.scale * self.scale }
    }

    /// Standard deviation of the members of an ordinary ring in widths of the prior.
    pub fn ordinary_scatter(&self) -> f64 {
        NORMAL.sqrt() * self.ordinary
    }

    /// `c` of the precision, 0 without a mean.
    fn shared(&self) -> f64 {
        if self.has_mean() {
            1.0 / (self.weights.iter().sum::<f64>() + (self.scale / self.freedom).powi(2))
        } else {
            0.0
        }
    }

    /// Precision of the prior of the members.
    pub fn precision(&self) -> DMatrix<f64> {
        let (inverse, shared) = (self.scale.powi(-2), self.shared());
        let weights = DVector::from_column_slice(&self.weights);
        (DMatrix::from_diagonal(&weights) - &weights * weights.transpose() * shared) * inverse
    }

    /// Add it to the precision of all unknowns.
    pub fn add_precision(&self, precision: &mut DMatrix<f64>) {
        let own = self.precision();
        for (at, &i) in self.members.iter().enumerate() {
            self.members.iter().enumerate().for_each(|(other, &j)| precision[(i, j)] += own[(at, other)]);
        }
    }

    /// `ln` probability of what the data say of the members, and of the scale beforehand; none where rounding leaves no positive curvature.
    pub fn log_evidence(&self, marginal: &Marginal) -> Option<f64> {
        let whole = Factor::of(self.precision() + &marginal.information)?;
        Some(
            self.log_prior()? - 0.5 * whole.log_determinant() + 0.5 * marginal.slope.dot(&whole.solve(&marginal.slope)),
        )
    }

    /// `ln det P/2` and `ln` probability of the scale beforehand, up to a constant.
    pub fn log_prior(&self) -> Option<f64> {
        let square = (self.ordinary / self.scale).powi(2);
        Some(0.5 * Factor::of(self.precision())?.log_determinant() + 0.5 * BEFOREHAND * (square.ln() - square))
    }

    /// The same with another scale.
    pub fn with_scale(&self, scale: f64) -> Self {
        Self { scale, ..self.clone() }
    }

    /// The scale of the largest evidence: octaves up or down as long as it grows, then between.
    pub fn best_scale(&self, marginal: &Marginal) -> f64 {
        let [least, most] = SCALES.map(f64::ln);
        let evidence = |log: f64| self.with_scale(log.exp()).log_evidence(marginal).unwrap_or(f64::NEG_INFINITY);
        let mut best = (evidence(self.scale.ln()), self.scale.ln());
        let mut step = OCTAVE;
        while step > RESOLUTION {
            let tried =
                [best.1 - step, best.1 + step].map(|log| log.clamp(least, most)).map(|log| (evidence(log), log));
            match tried.into_iter().filter(|one| one.0 > best.0).max_by(|a, b| a.0.total_cmp(&b.0)) {
                Some(better) => best = better,
                None => step /= 2.0,
            }
        }
        best.1.exp()
    }

    /// Mean of the members' values.
    pub fn mean(&self, values: &DVector<f64>) -> f64 {
        self.weighted(|member| values[member]) / self.weights.iter().sum::<f64>()
    }

    /// What distances of the members have in common.
    pub fn common(&self, distance: impl Fn(usize) -> f64) -> f64 {
        self.shared() * self.weighted(distance)
    }

    /// Weighted sum over the members.
    fn weighted(&self, number: impl Fn(usize) -> f64) -> f64 {
        self.members.iter().zip(&self.weights).map(|(&member, weight)| weight * number(member)).sum()
    }

    /// Deviation of each member from what they have in common by the posterior of all unknowns, and its variance, in widths of the prior.
    pub fn deviations(&self, values: &DVector<f64>, covariance: &DMatrix<f64>) -> Vec<(f64, f64)> {
        let (shared, common) = (self.shared(), self.common(|i| values[i]));
        let weighted = || self.members.iter().copied().zip(&self.weights);
        let with_others: Vec<f64> =
            self.members.iter().map(|&i| weighted().map(|(j, weight)| weight * covariance[(i, j)]).sum()).collect();
        let of_mean =
            shared * shared * self.weights.iter().zip(&with_others).map(|(w, others)| w * others).sum::<f64>()
                + self.scale * self.scale * shared;
        let variance = |i: usize, others: f64| covariance[(i, i)] - 2.0 * shared * others + of_mean;
        let members = self.members.iter().zip(&with_others);
        members.map(|(&i, &others)| (values[i] - common, variance(i, others))).collect()
    }

    /// Weights by how far the members are off.
    pub fn weigh(&mut self, deviations: &[(f64, f64)]) {
        let square = |(value, variance): &(f64, f64)| value * value + variance.max(0.0);
        let weight = |square: f64| (TAILS + 1.0) / (TAILS + square / self.scale.powi(2));
        self.weights = deviations.iter().map(square).map(weight).collect();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn family(kind: &'static str, count: usize, scale: f64) -> Family {
        let weights = (0..count).map(|member| 1.0 / (1.0 + member as f64)).collect();
        let (class, members, freedom) = ("x".into(), (0..count).collect(), 0.0);
        Family { kind, class, members, scale, ordinary: ORDINARY, weights, freedom }
    }

    #[test]
    fn the_precision_is_the_inverse_of_scatter_and_mean() {
        for (kind, freedom) in [("corrector_gain", FREEDOM), ("skew_gradient", 0.0)] {
            let family = Family { freedom, ..family(kind, 5, 0.3) };
            let mut precision = DMatrix::zeros(5, 5);
            family.add_precision(&mut precision);
            let covariance = DMatrix::from_fn(5, 5, |i, j| {
                freedom * freedom + if i == j { 0.3 * 0.3 * (1.0 + i as f64) } else { 0.0 }
            });
            assert!((precision * covariance - DMatrix::identity(5, 5)).amax() < 1e-12, "{kind}: rounding");
        }
    }

    /// Scale and weights learnt from members that are known.
    fn learnt(mut family: Family, values: &DVector<f64>) -> Family {
        let (known, count) = (1e9, values.len());
        let marginal = Marginal { information: DMatrix::identity(count, count) * known, slope: values * known };
        for _ in 0..20 {
            family.scale = family.best_scale(&marginal);
            family.weigh(&family.deviations(values, &DMatrix::zeros(count, count)));
        }
        family
    }

    #[test]
    fn a_scale_is_that_of_members_that_are_known_but_for_one() {
        let mut values = DVector::from_fn(20, |i, _| if i % 2 == 0 { 0.2 } else { -0.2 });
        values[7] = 3.0;
        let family = learnt(family("skew_gradient", 20, 0.3), &values);
        // members of one size have tails that are lighter than Student's with four degrees of freedom: a scale of 0.2 where they weigh 1; a scale is found
        // to 5 %, and the weights follow it
        assert!((family.scale - 0.2).abs() < 0.04, "{}", family.scale);
        assert!(family.weights[7] < 0.05 && family.weights[6] > 0.9, "{:?}", family.weights);
    }

    #[test]
    fn the_variance_is_that_of_normal_members() {
        let mut random = crate::testing::normal(5);
        let values = DVector::from_fn(200, |_, _| 0.2 * random());
        let family = learnt(Family { weights: vec![1.0; 200], ..family("skew_gradient", 200, 0.3) }, &values);
        // 200 squares are known to 10 %, and a scale is found to 4 %, its square to 8 %; three times both
        let variance = values.norm_squared() / 200.0;
        assert!((family.variance() / variance - 1.0).abs() < 0.25, "{} {variance}", family.variance());
    }

    #[test]
    fn a_common_value_is_the_mean_and_no_scatter() {
        let family = Family { weights: vec![1.0; 400], freedom: FREEDOM, ..family("corrector_gain", 400, 0.1) };
        let found = family.deviations(&DVector::from_element(400, 0.05), &DMatrix::zeros(400, 400));
        // what is in common is drawn to 0 by (s/f)^2 of 400
        assert!(found.iter().all(|(value, _)| value.abs() < 0.05 * 0.01 / 400.0 * 1.01));
    }
}
