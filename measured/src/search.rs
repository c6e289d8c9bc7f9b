//! Members that stand out of what their kind does everywhere.
//!
//! A member has a further amplitude `z` [widths of its prior] beside what it has as one of its family. All unknowns adapting, the posterior's slope and curvature
//! of it are, with the families' precision `L`, deviations `d` and covariance `C`,
//!
//! `g = L d`, `G = L - L C L`.
//!
//! `g/G` is an estimate of `z` and `1/G` its variance `v`: what the data leave, widened where errors are alike along rows and columns, and the scatter `s^2` of the
//! family, which the other members tell. Its `ln` Bayes factor is that of two densities of the estimate,
//!
//! `ln t_1(g/G; v + 1) - ln t_k(g/G; v)`.
//!
//! A scatter told by `n` others, and by what is ordinary, has heavier tails than a normal one: Student's, with `k = n v^2/s^4` degrees of freedom (F. E. Satterthwaite, Biometrics 2 (1946)
//! 110); that of skew quadrupoles, which are set one by one, is that of an ordinary ring. What stands out has any size, Cauchy's density about the prior's width (A. Zellner and A. Siow, Trabajos de Estadistica 31 (1980) 585).
//!
//! Of the members that stand out, the one that explains most of the data is released, then the others adapt, and so on; those that it takes the gain from are its
//! alternatives. What a member explains is the same ratio of two normal densities, with independent errors, over the largest widening of those that stand out, and its
//! probability beforehand. With Student's densities a member that alone widens its family would be hidden by its neighbour.

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{Continuous, StudentsT};

use crate::error::MeasuredError;
use crate::family::{BEFOREHAND, FREE, Family};
use crate::hierarchy::{Hierarchy, Posterior};
use crate::linear::product;
use crate::unknowns::Kind;

/// Members that are released in one search at most.
const MOST: usize = 64;
/// A member is released where it is this much more probable than that nothing stands out: of several that widen one family each shows when the others are
/// released.
const RELEASED: f64 = 1.0;
/// Gains of alternatives are within this of the best [nat].
const NEAR: f64 = 10.0;
/// And at least this, or they explain nothing [nat].
const LEAST: f64 = 2.0;
/// An alternative keeps at most this share of its gain when the best one is released.
const TAKEN: f64 = 0.5;
/// Amplitudes that are tried for a limit, in widths of the prior.
const LARGEST: f64 = 30.0;
/// A member is named with this probability.
pub const NAMED: f64 = 0.95;

/// Something that stands out.
#[derive(Debug, Clone, PartialEq)]
pub struct Outlier {
    /// Its number among the unknowns.
    pub unknown: usize,
    /// `ln` Bayes factor [nat].
    pub gain: f64,
    /// Probability beside its alternatives and nothing at all.
    pub probability: f64,
    /// `ln` of its probability beforehand.
    pub prior: f64,
    /// Others that explain the same, the most probable first.
    pub alternatives: Vec<Rival>,
}

impl Outlier {
    /// True where it is so much more probable than nothing that it is named, or one of its alternatives is.
    pub fn stands_out(&self) -> bool {
        is_decisive(self.gain + self.prior)
    }

    /// The same by a fit in which it is released, and the scatter of its family is that of the others alone.
    pub fn confirmed(mut self, hierarchy: &Hierarchy) -> Self {
        let unknown = self.unknown;
        let Some(family) = hierarchy.family_of(unknown) else { return self };
        let width = hierarchy.unknowns[unknown].width;
        let posterior = (hierarchy.sigma_off_family(unknown) / width).powi(2);
        let error = 1.0 / (1.0 / posterior - FREE.powi(-2)).max(f64::EPSILON);
        let estimate = hierarchy.off_family(unknown) / width * error / posterior;
        let gain = log_bayes_factor(estimate, error, family.expected_variance(), family.members.len());
        let rivals: f64 = self.alternatives.iter().map(|rival| rival.probability / self.probability).sum();
        self.probability = 1.0 / (1.0 + rivals + (-gain - self.prior).exp());
        self.gain = gain;
        self
    }
}

/// True of `ln` odds at which something is named beside nothing.
fn is_decisive(log_odds: f64) -> bool {
    log_odds > (NAMED / (1.0 - NAMED)).ln()
}

/// `ln` Bayes factor of a further amplitude [widths] that is estimated with some variance, in a family whose scatter so many others tell.
fn log_bayes_factor(estimate: f64, error: f64, scatter: f64, others: usize) -> f64 {
    let ordinary = error + scatter;
    let density = |variance: f64, freedom: f64| {
        StudentsT::new(0.0, variance.sqrt(), freedom).map_or(f64::NEG_INFINITY, |student| student.ln_pdf(estimate))
    };
    density(ordinary + 1.0, 1.0) - density(ordinary, (others as f64 + BEFOREHAND) * (ordinary / scatter).powi(2))
}

/// Another explanation of the same.
#[derive(Debug, Clone, PartialEq)]
pub struct Rival {
    /// Its number among the unknowns.
    pub unknown: usize,
    /// Further amplitude, and its standard deviation.
    pub amplitude: [f64; 2],
    /// `ln` Bayes factor [nat].
    pub gain: f64,
    /// Probability beside the others and nothing at all.
    pub probability: f64,
}

/// Probability beforehand that a ring has one member of a kind that stands out.
fn expected(kind: Kind) -> f64 {
    match kind {
        Kind::MonitorGain(_) | Kind::CorrectorGain(_) => 0.3,
        Kind::MonitorCoupling(_) | Kind::CorrectorCoupling(_) => 0.1,
        Kind::Strength(_) => 0.2,
        Kind::Skew(_) | Kind::Gradient(_) | Kind::Wiggler(_) | Kind::Added(_) => 0.1,
        Kind::Moment(..) | Kind::RfScale | Kind::HeldFrequency => 0.0,
    }
}

/// Members of families, and how far they are off.
#[derive(Clone)]
struct Members {
    /// Numbers among the unknowns.
    unknowns: Vec<usize>,
    /// Family of each.
    family: Vec<usize>,
    /// Slope and curvature of the further amplitudes.
    slope: DVector<f64>,
    curvature: DMatrix<f64>,
    /// Weighted squares of the deviations, expected by the posterior, whose mean is the variance of the family.
    squares: Vec<f64>,
    /// Variance that each has as a member of its family, in the posterior.
    held: Vec<f64>,
    /// The same beside which it stands out.
    scatter: Vec<f64>,
    widening: Vec<f64>,
    /// `ln` of the prior probability.
    prior: Vec<f64>,
    released: Vec<bool>,
}

/// What a search found, and what it would have found.
#[derive(Debug, Clone, PartialEq)]
pub struct Search {
    /// Everything that stands out, in the order in which it was found.
    pub outliers: Vec<Outlier>,
    /// Unknowns that can stand out, with the amplitude at which each would be named and the standard deviation of an estimate where nothing stands out.
    pub limits: Vec<(usize, [f64; 2])>,
}

impl Search {
    /// Numbers of what stands out.
    pub fn unknowns(&self) -> Vec<usize> {
        self.outliers.iter().map(|outlier| outlier.unknown).collect()
    }
}

/// Everything that stands out of its family.
///
/// # Errors
/// [`MeasuredError::Singular`].
pub fn search(hierarchy: &Hierarchy) -> Result<Search, MeasuredError> {
    let mut members = Members::of_families(hierarchy)?;
    let mut found = Vec::new();
    while found.len() < MOST {
        let before = members.gains();
        let odds = |member: usize| before[member] + members.prior[member];
        let standing: Vec<usize> = (0..before.len()).filter(|&member| odds(member) > RELEASED.ln()).collect();
        let widening = standing.iter().fold(1.0_f64, |widest, &member| widest.max(members.widening[member]));
        let explains = |member: usize| members.explained(member) / widening + members.prior[member];
        let Some(best) = standing.into_iter().max_by(|&a, &b| explains(a).total_cmp(&explains(b))) else { break };
        let mut after = members.clone_released(best);
        let left = after.gains();
        let is_rival = |&member: &usize| {
            member != best && before[member] > (before[best] - NEAR).max(LEAST) && left[member] < TAKEN * before[member]
        };
        let mut rivals: Vec<usize> = (0..before.len()).filter(is_rival).collect();
        rivals.sort_by(|&a, &b| explains(b).total_cmp(&explains(a)));
        // a rival that does not stand out itself is no more probable than the one that does
        let weight = |member: usize| (explains(member) - explains(best)).min(0.0).exp();
        let nothing = (-odds(best)).exp();
        let sum = 1.0 + nothing + rivals.iter().map(|&rival| weight(rival)).sum::<f64>();
        let width = |member: usize| hierarchy.unknowns[members.unknowns[member]].width;
        let rival = |&member: &usize| Rival {
            unknown: members.unknowns[member],
            amplitude: members.estimate(member).map(|widths| widths * width(member)),
            gain: before[member],
            probability: weight(member) / sum,
        };
        let alternatives = rivals.iter().map(rival);
        found.push(Outlier {
            unknown: members.unknowns[best],
            gain: before[best],
            probability: 1.0 / sum,
            prior: members.prior[best],
            alternatives: alternatives.collect(),
        });
        core::mem::swap(&mut members, &mut after);
    }
    let open = (0..members.unknowns.len()).filter(|&member| !members.released[member]);
    let width = |unknown: usize| hierarchy.unknowns[unknown].width;
    let limits = open.map(|member| {
        let unknown = members.unknowns[member];
        (unknown, [members.limit(member), members.spread(member).sqrt()].map(|widths| widths * width(unknown)))
    });
    Ok(Search { limits: limits.collect(), outliers: found })
}

impl Members {
    fn of_families(hierarchy: &Hierarchy) -> Result<Self, MeasuredError> {
        let Hierarchy { posterior, families, unknowns: all, uncertainty, .. } = hierarchy;
        let alike: Vec<Family> = families.iter().map(Family::with_alike_members).collect();
        let equal = Posterior::of_families(posterior.information.clone(), posterior.slope.clone(), &alike)?;
        let (mut unknowns, mut family, mut squares) = (Vec::new(), Vec::new(), Vec::new());
        let (mut held, mut scatter) = (Vec::new(), Vec::new());
        let mut precision = DMatrix::zeros(all.len(), all.len());
        for (number, (one, alike)) in families.iter().zip(&alike).enumerate() {
            alike.add_precision(&mut precision);
            if one.is_shared() {
                let deviations = one.deviations(&posterior.values, &posterior.covariance);
                unknowns.extend(&one.members);
                family.extend(one.members.iter().map(|_| number));
                let squared = deviations.iter().map(|(value, variance)| value * value + variance);
                let normal = one.variance() / one.scale.powi(2);
                let weighted = squared.zip(&one.weights).map(|(square, weight)| normal * square * weight);
                squares.extend(
                    weighted.map(|square| if one.is_set_one_by_one() { one.expected_variance() } else { square }),
                );
                held.extend(alike.weights.iter().map(|weight| one.scale * one.scale / weight));
                scatter.extend(one.members.iter().map(|_| one.expected_variance().min(one.scale * one.scale)));
            }
        }
        let slope = &precision * &equal.values;
        let curvature = &precision - product(&product(&precision, &equal.covariance), &precision);
        let prior = |&unknown: &usize| {
            let kind = all[unknown].kind;
            let alike = unknowns.iter().filter(|&&other: &&usize| all[other].kind.word() == kind.word()).count();
            (expected(kind) / alike as f64).ln()
        };
        Ok(Self {
            slope: slope.select_rows(&unknowns),
            curvature: curvature.select_rows(&unknowns).select_columns(&unknowns),
            widening: unknowns.iter().map(|&unknown| uncertainty.widening(unknown)).collect(),
            prior: unknowns.iter().map(prior).collect(),
            held,
            scatter,
            released: vec![false; unknowns.len()],
            unknowns,
            family,
            squares,
        })
    }

    /// `ln` Bayes factors of all members, beside those that are released.
    fn gains(&self) -> Vec<f64> {
        (0..self.unknowns.len())
            .map(|member| if self.released[member] { f64::NEG_INFINITY } else { self.gain(member) })
            .collect()
    }

    fn gain(&self, member: usize) -> f64 {
        self.gain_of(member, self.slope[member] / self.curvature[(member, member)])
    }

    /// The same with the scatter of its family known and independent errors: rivals of several families are compared by what they explain of the data, whatever the
    /// tails of their families.
    fn explained(&self, member: usize) -> f64 {
        let [estimate, _] = self.estimate(member);
        let ordinary = self.independent_error(member) + self.scatter[member];
        let log_density = |variance: f64| -0.5 * (estimate * estimate / variance + variance.ln());
        log_density(ordinary + 1.0) - log_density(ordinary)
    }

    /// `ln` Bayes factor of a member whose further amplitude is estimated at some value.
    fn gain_of(&self, member: usize, estimate: f64) -> f64 {
        if self.curvature[(member, member)] <= 0.0 {
            return f64::NEG_INFINITY;
        }
        let (scatter, others) = self.scatter_of_others(member);
        log_bayes_factor(estimate, self.error(member), scatter, others)
    }

    /// Variance of what the data say of a further amplitude.
    fn error(&self, member: usize) -> f64 {
        self.independent_error(member) * self.widening[member]
    }

    /// The same where errors are independent.
    fn independent_error(&self, member: usize) -> f64 {
        (1.0 / self.curvature[(member, member)] - self.held[member]).max(0.0)
    }

    /// Variance of an estimate of a further amplitude that is not there: error of the data and scatter of the others.
    fn spread(&self, member: usize) -> f64 {
        self.error(member) + self.scatter_of_others(member).0
    }

    /// Further amplitude by the data alone, and its standard deviation [widths].
    fn estimate(&self, member: usize) -> [f64; 2] {
        [self.slope[member] / self.curvature[(member, member)], self.error(member).sqrt()]
    }

    /// Amplitude that a member must have to be named [widths], beside those that are released; the largest of a prior where none is.
    fn limit(&self, member: usize) -> f64 {
        let is_named = |amplitude: f64| is_decisive(self.gain_of(member, amplitude) + self.prior[member]);
        let (mut low, mut high) = (0.0, LARGEST);
        while high - low > 1e-3 * high {
            let middle = 0.5 * (low + high);
            if is_named(middle) { high = middle } else { low = middle }
        }
        high
    }

    /// Mean square deviation of a member's family without it and without what is released, and how many tell it.
    fn scatter_of_others(&self, member: usize) -> (f64, usize) {
        let others = (0..self.unknowns.len()).filter(|&other| other != member && !self.released[other]);
        let of_family = others.filter(|&other| self.family[other] == self.family[member]);
        let (sum, count) = of_family.fold((0.0, 0), |(sum, count), other| (sum + self.squares[other], count + 1));
        // where all others are released the scale of the family is what is known
        (if count > 0 { sum / f64::from(count) } else { self.scatter[member] }, count as usize)
    }

    /// The same with a member released: what it explains is taken from the others.
    fn clone_released(&self, member: usize) -> Self {
        let power = self.curvature[(member, member)] + 1.0;
        let across = self.curvature.column(member).into_owned();
        let mut others = self.clone();
        others.released[member] = true;
        others.slope -= &across * (self.slope[member] / power);
        others.curvature -= &across * across.transpose() / power;
        others
    }
}

#[cfg(test)]
mod tests {
    use crate::diagnose::{Diagnosis, Verdict};
    use crate::fit::{Settings, fit};
    use crate::folder::Folder;
    use crate::model::Model;
    use crate::testing::{NOISE, machine, measured, ring};
    use crate::unknowns::{Kind, Unknown, groups};
    use twin::Rf;

    fn diagnosed(folder: &Folder) -> Diagnosis {
        let settings = Settings::default();
        let fitted = fit(folder, &settings, &mut |_| ()).unwrap();
        Diagnosis::of_fit((folder, &[]), &fitted, &settings, &mut |_| ()).unwrap()
    }

    /// A ring with a thin gradient or skew gradient [1/m] in the middle of a row.
    fn with_gradient(seed: u64, gradient: Option<(usize, f64, bool)>) -> Folder {
        let ring = ring();
        let (model, mut unknowns, mut values) = machine(&ring, seed);
        let Some((row, size, is_skew)) = gradient else {
            return measured(&ring, &(model, unknowns, values), NOISE, 500 + seed);
        };
        let mut groups = groups(&ring);
        let place = groups[0].len() + groups[1].len();
        let sort = if is_skew { 1 } else { 2 };
        let kind = if is_skew { Kind::Skew(groups[1].len()) } else { Kind::Gradient(0) };
        groups[sort].push(vec![row]);
        unknowns.insert(place, Unknown { kind, mean: 0.0, width: 0.01 });
        values = values.insert_row(place, size);
        let model = Model::of(&ring, &groups, Rf::FixedFrequency).unwrap();
        measured(&ring, &(model, unknowns, values), NOISE, 500 + seed)
    }

    #[test]
    fn nothing_stands_out_of_an_ordinary_ring() {
        for seed in 40..52 {
            let found = diagnosed(&with_gradient(seed, None));
            assert_eq!(found.verdict, Verdict::Consistent, "{seed}: {:?}", found.findings);
        }
    }

    #[test]
    fn a_gradient_that_others_of_its_kind_do_not_have_is_named() {
        let ring = ring();
        let rows = |name: &str| -> Vec<usize> {
            (0..ring.lattice.len()).filter(|&row| ring.lattice[row].name == name).collect()
        };
        let (bend, quadrupole) = (rows("B")[1], rows("QF")[6]);
        // strengths scatter by 0.012 /m, as gradients in dipoles look
        for (seed, row, size, is_skew, word) in [
            (50, bend, 0.1, false, "dipole_gradient"),
            (51, bend, 0.02, true, "skew_gradient"),
            (52, quadrupole, 0.02, true, "skew_gradient"),
        ] {
            let found = diagnosed(&with_gradient(seed, Some((row, size, is_skew))));
            let first =
                found.findings.first().unwrap_or_else(|| panic!("{seed}: nothing named, {:?}", found.imperfections));
            assert_eq!((first.word, &first.at), (word, &ring.element(row)), "{seed}: {:?}", found.findings);
            assert!(first.is_named() && found.verdict == Verdict::Identified, "{seed}: {first:?}");
            assert!((first.amplitude - size).abs() < 4.0 * first.sigma, "{seed}: {first:?}");
        }
    }

    #[test]
    fn gains_far_from_those_of_others_are_named_and_nothing_else() {
        let ring = ring();
        for seed in 0..4 {
            let mut wrong = measured(&ring, &machine(&ring, 30 + seed), NOISE, seed);
            let row = 3 + seed as usize;
            wrong.matrix.row_mut(row).scale_mut(0.3);
            wrong.dispersion.as_mut().unwrap()[row] *= 0.3;
            wrong.matrix.column_mut(5).scale_mut(0.3);
            let found = diagnosed(&wrong);
            let mut named: Vec<_> = found.findings.iter().map(|one| (one.word, one.at.clone())).collect();
            named.sort();
            let expected = [("bpm_gain", wrong.monitor(row)), ("corrector_gain", wrong.corrector(5))];
            assert_eq!(named, expected, "{seed}");
        }
    }
}
