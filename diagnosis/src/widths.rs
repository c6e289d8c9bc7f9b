//! The ordinary imperfections of a machine: what every real one has, and what is therefore part of the model before any missing
//! physics is looked for.
//!
//! A family is one property of all instruments or magnets of a sort. Its members have unknown amplitudes `a`, normal about zero with
//! the width `w` of the family; what they have in common is a family of one member. The width of a family of many is learnt
//! from the recording: with `G` the Gram matrix of the members' whitened signatures and `g` their products with the readings, both less
//! what vars and effects absorb,
//!
//! `ln L(w) = -ln det(1 + W G W)/2 + g W (1 + W G W)^-1 W g/2 - sum of (w/t)^2/2`, `W = diag(w)`,
//!
//! the last term a prior of the size of the tolerance `t`, largest where nothing is wrong. At its maximum
//! `sum of (a/w)^2 = n - trace(1 + W G W)^-1 + (w/t)^2` in each family, which gives the next width from the last. The scatter of the vars is learnt with
//! them, with a prior of its own ([`super::scatter`]).
//!
//! Source: D. J. C. MacKay, Neural Comput. 4 (1992) 415, eq. 4.8; A. Gelman, Bayesian Anal. 1 (2006) 515, half-normal priors of widths.

use core::iter;
use core::ops::Range;

use evidence::Factor;
use nalgebra::{DMatrix, DVector};
use twin::{EffectKind, Measured, Unit};

use super::data::Data;
use super::family::{Family, Grouping, family_of};
use super::fit::Fitted;
use super::hypothesis::Hypothesis;
use super::scatter::{self, Scatter};
use super::term::Term;
use super::unknown::{Member, Quantity};
use inference::{Imperfection, Measure};

/// Widths of its family from which on a member stands out: of 48 of a normal distribution the largest is 2.3 on average.
pub(super) const STANDS_OUT: f64 = 2.3;
/// Gain error below which an instrument may be dead or reversed: twice the largest scatter that is quoted. Such a one widens its family, whose prior still
/// pulls its gain from -1 or -2 towards 0.
const FAILS: f64 = -0.1;
/// Share of its tolerance below which a family does not count.
const NONE: f64 = 0.02;
/// Steps of the widths at most, and the change, in tolerances, at which they have settled.
const STEPS: usize = 30;
const SETTLED: f64 = 0.01;

/// The vars and the members of the families in a fit: `1 + W G W` without its `W`, and `g`, in units of their priors and tolerances.
struct Projected {
    gram: DMatrix<f64>,
    pull: DVector<f64>,
    /// Which of the widths each has: the first that of the vars, then those of the families.
    of: Vec<usize>,
    /// The vars of focusing quadrupoles, and those of defocusing ones.
    groups: Vec<Vec<usize>>,
}

/// Posterior of all in units of their widths.
struct Posterior {
    mean: DVector<f64>,
    variance: DVector<f64>,
    /// Variance of the mean of each group of vars.
    of_means: Vec<f64>,
}

impl Projected {
    /// From the normal matrix of a fit, of which the vars are the first unknowns and the members the last.
    fn from_fit(data: &Data, fitted: &Fitted) -> Option<Self> {
        let Hypothesis { ordinary, scatter, .. } = &fitted.hypothesis;
        let sized = |(f, family): (usize, &Family)| {
            let scale = family.tolerance / family.width;
            iter::repeat_n((f + 1, scale), family.members(data).len())
        };
        let of_vars = iter::repeat_n((0, scatter.0.recip()), fitted.params.len());
        let of_families = ordinary.iter().enumerate().flat_map(sized);
        let (of, scale): (Vec<usize>, Vec<f64>) = of_vars.chain(of_families).unzip();
        let (all, vars) = (fitted.u.len(), fitted.params.len());
        let others: Vec<usize> = (vars..all + vars - of.len()).collect();
        let own: Vec<usize> = (0..vars).chain(all + vars - of.len()..all).collect();
        let normal = fitted.factor.matrix();
        let mut u = fitted.u.clone();
        others.iter().for_each(|&i| u[i] = 0.0);
        let slope = fitted.jacobian.tr_mul(&(&fitted.jacobian * &u + &fitted.residual));
        let of_others = (&slope - &fitted.u).select_rows(&others);
        let columns = normal.select_columns(&own);
        let cross = columns.select_rows(&others);
        let factor = Factor::of(normal.select_rows(&others).select_columns(&others))?;
        let taken = factor.solve(&cross);
        let mut gram = columns.select_rows(&own) - cross.transpose() * &taken;
        (0..own.len()).for_each(|i| gram[(i, i)] -= 1.0);
        let mut pull = slope.select_rows(&own) - taken.tr_mul(&of_others);
        let scale = DVector::from_vec(scale);
        pull.component_mul_assign(&scale);
        gram.column_iter_mut()
            .zip(scale.iter())
            .for_each(|(mut column, s)| column.component_mul_assign(&(&scale * *s)));
        let groups = data.ring.params_by_focusing().into_iter().filter(|group| !group.is_empty()).collect();
        Some(Self { gram, pull, of, groups })
    }

    fn posterior(&self, widths: &[f64]) -> Option<Posterior> {
        let w = DVector::from_iterator(self.of.len(), self.of.iter().map(|&of| widths[of]));
        let mut matrix = self.gram.clone();
        matrix.column_iter_mut().zip(w.iter()).for_each(|(mut column, s)| column.component_mul_assign(&(&w * *s)));
        (0..w.len()).for_each(|i| matrix[(i, i)] += 1.0);
        let factor = Factor::of(matrix)?;
        let of_mean = |group: &Vec<usize>| {
            let mut each = DVector::zeros(w.len());
            group.iter().for_each(|&i| each[i] = 1.0 / group.len() as f64);
            factor.whiten(&each).norm_squared()
        };
        Some(Posterior {
            mean: factor.solve(&self.pull.component_mul(&w)),
            variance: DVector::from_vec(factor.inverse_diagonal()),
            of_means: self.groups.iter().map(of_mean).collect(),
        })
    }

    /// Sum of squares of the vars about the mean of their group, in widths, and how many of these differences the recording shows: what all have in common may
    /// be something else that the vars absorb, such as a gradient in all dipoles, and is no scatter.
    fn scatter(&self, Posterior { mean, variance, of_means }: &Posterior) -> (f64, f64) {
        let of_group = |(group, of_mean): (&Vec<usize>, &f64)| {
            let count = group.len() as f64;
            let middle = group.iter().map(|&i| mean[i]).sum::<f64>() / count;
            let squares: f64 = group.iter().map(|&i| (mean[i] - middle).powi(2)).sum();
            let left = group.iter().map(|&i| variance[i]).sum::<f64>() - count * of_mean;
            (squares, count - 1.0 - left)
        };
        let of_each = self.groups.iter().zip(of_means).map(of_group);
        of_each.fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
    }

    /// The most likely widths of the vars and of the families that are learnt, from a start, in units of priors and tolerances; `is_learnt`: each family.
    fn widths(&self, mut widths: Vec<f64>, is_learnt: &[bool]) -> Vec<f64> {
        for _ in 0..STEPS {
            let Some(posterior) = self.posterior(&widths) else { break };
            let Posterior { mean, variance, .. } = &posterior;
            let of_family = |(f, &is_learnt): (usize, &bool)| {
                let (width, members) = (widths[f + 1], || (0..mean.len()).filter(|&i| self.of[i] == f + 1));
                let squares: f64 = members().map(|i| mean[i].powi(2)).sum();
                let known: f64 = members().map(|i| 1.0 - variance[i]).sum();
                let next = width * (squares / (known + width.powi(2)).max(f64::MIN_POSITIVE)).sqrt();
                if is_learnt { next } else { width }
            };
            let (squares, known) = self.scatter(&posterior);
            let Scatter(of_vars) = Scatter::from_squares(squares * widths[0].powi(2), known);
            let next: Vec<f64> = iter::once(of_vars).chain(is_learnt.iter().enumerate().map(of_family)).collect();
            let moved = next.iter().zip(&widths).map(|(one, other)| (one - other).abs()).fold(0.0, f64::max);
            widths = next;
            if moved < SETTLED {
                break;
            }
        }
        widths
    }
}

/// The hypothesis of a fit with the widths that its recording shows, of vars and families; families that it shows none of are left out.
pub fn learnt(data: &Data, fitted: &Fitted) -> Hypothesis {
    let mut hypothesis = fitted.hypothesis.clone();
    let Some(projected) = Projected::from_fit(data, fitted) else { return hypothesis };
    let families = &mut hypothesis.ordinary;
    let of_families = families.iter().map(|family| family.width / family.tolerance);
    let start = iter::once(hypothesis.scatter.0).chain(of_families).collect();
    let is_learnt: Vec<bool> = families.iter().map(Family::is_learnt).collect();
    let widths = projected.widths(start, &is_learnt);
    families.iter_mut().zip(&widths[1..]).for_each(|(family, width)| family.width = family.tolerance * width);
    families.retain(|family| !family.is_learnt() || family.width > NONE * family.tolerance);
    hypothesis.scatter = Scatter(widths[0]);
    hypothesis
}

/// The member of each learnt family that stands out most of it, of an instrument both planes: it may have made the family as wide as it is, and then hide in it. An instrument
/// whose gain is more than 10 % too small may be dead or reversed, which a gain of -1 or -2 in a wide family hides as well.
pub fn outstanding(data: &Data, fitted: &Fitted) -> Vec<Term> {
    let unknowns = fitted.hypothesis.unknowns(data);
    // the amplitude of each member in widths of its family, and in its unit
    let members: Vec<(&Member, f64, f64)> = (unknowns.iter())
        .zip(fitted.u.iter().skip(fitted.params.len()))
        .filter_map(|(unknown, u)| match &unknown.quantity {
            Quantity::Ordinary(member) => Some((member, u.abs(), u * unknown.sigma)),
            _ => None,
        })
        .collect();
    let most = |family: &Family| {
        let outstanding = members.iter().filter(|(member, u, _)| member.family == family.name && *u > STANDS_OUT);
        outstanding.max_by(|(_, one, _), (_, other, _)| one.total_cmp(other))
    };
    let stands_out = fitted.hypothesis.ordinary.iter().filter(|family| family.is_learnt()).filter_map(most);
    let proposed = |(member, _, amplitude): &(&Member, f64, f64)| {
        let failed = failures(member.terms[0], *amplitude);
        member.terms.iter().copied().chain(failed).collect::<Vec<_>>()
    };
    stands_out.flat_map(proposed).collect()
}

/// The instrument of a gain dead, and reversed, where it may be that.
fn failures(gain: Term, amplitude: f64) -> impl Iterator<Item = Term> {
    let fails = move |kind: &EffectKind| amplitude < FAILS && *kind != gain.kind && family_of(*kind) == gain.kind;
    EffectKind::ALL.iter().copied().filter(fails).map(move |kind| Term { kind, ..gain })
}

/// The scatter of the vars and the sizes of the ordinary imperfections in a fit, of several recordings those of the first where each has its own. The Fisher information of `ln w` is `2 sum of (1 - c)^2`, `c` the share of a member's
/// prior variance that the recording leaves: `1 - c` is 1 for a member that is well known, 0 for one that it does not show.
pub fn rows(data: &Data, fitted: &Fitted) -> Vec<Imperfection> {
    let covariance = fitted.factor.inverse();
    let families = &fitted.hypothesis.ordinary;
    let members: usize = families.iter().map(|family| family.members(data).len()).sum();
    let mut at = fitted.u.len() - members;
    let of_vars = information(&covariance, 0..fitted.params.len()) + 2.0 * scatter::COUNTS;
    let width = fitted.units.sigma.mean();
    let mut rows = vec![Imperfection {
        name: "strengths of quadrupoles",
        kind: "var",
        at: "all".into(),
        measure: Measure::Scatter,
        measured: Measured { value: width, sigma: width / of_vars.sqrt() },
        unit: Unit::PERCENT,
        ordinary: data.units.sigma.mean(),
    }];
    for family in families {
        let places = at..at + family.members(data).len();
        at = places.end;
        let width = family.width;
        let (value, sigma) = match family.grouping {
            _ if places.is_empty() => continue,
            Grouping::Each | Grouping::Instrument if family.is_learnt() => {
                (width, width / information(&covariance, places).sqrt())
            }
            Grouping::Each | Grouping::Instrument | Grouping::OfOrbit => continue,
            Grouping::Plane(_) | Grouping::All => {
                (fitted.u[places.start] * width, covariance[(places.start, places.start)].sqrt() * width)
            }
        };
        rows.push(Imperfection {
            name: family.name,
            kind: family.kind.word(),
            at: family.place().into(),
            measure: if family.is_learnt() { Measure::Scatter } else { Measure::Mean },
            measured: Measured { value, sigma },
            unit: family.kind.unit(),
            ordinary: family.tolerance,
        });
    }
    rows
}

/// Fisher information of `ln` of the width of some unknowns.
fn information(covariance: &DMatrix<f64>, of: Range<usize>) -> f64 {
    of.map(|i| 2.0 * (1.0 - covariance[(i, i)]).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Coloured, template, whitened};

    /// Members that the recording shows in full are as wide as their rms; those that it does not show at all get no width.
    #[test]
    fn a_width_is_the_rms_of_well_known_members_and_none_without_any() {
        let of = [1; 20].into_iter().chain([2; 20]).collect();
        let amplitudes = DVector::from_fn(40, |i, _| if i < 20 { f64::sin(2.4 * i as f64) } else { 0.0 });
        let gram = DMatrix::from_diagonal_element(40, 40, 1e6);
        let projected = Projected { pull: &gram * amplitudes, gram, of, groups: Vec::new() };
        let width = projected.widths(vec![1.0; 3], &[true, true]);
        assert_eq!(width[0], 1.0, "there are no vars");
        // rms 0.71 of 20, and the prior of width 1 takes the square root of 1 - 0.5/20
        assert!((width[1] - 0.70).abs() < 0.02 && width[2] < NONE, "{width:?}");
    }

    /// Two groups of 20 whose means are 3 and -2 prior widths.
    #[test]
    fn what_all_vars_have_in_common_is_no_scatter() {
        let groups: Vec<Vec<usize>> = vec![(0..20).collect(), (20..40).collect()];
        let own = |i: usize| f64::sin(2.4 * i as f64);
        let amplitudes = DVector::from_fn(40, |i, _| own(i) + if i < 20 { 3.0 } else { -2.0 });
        let gram = DMatrix::from_diagonal_element(40, 40, 1e6);
        let projected = Projected { pull: &gram * amplitudes, gram, of: vec![0; 40], groups };
        let width = projected.widths(vec![1.0], &[])[0];
        // mean square 0.5 of 38, and that of the prior, 1, of two more
        assert!((width - (21.0_f64 / 40.0).sqrt()).abs() < 0.02, "{width}");
    }

    /// Vars of half and of the whole width of their prior, in four campaigns each: the scatter is known to a tenth or so.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn the_scatter_of_the_vars_is_learnt_with_its_error() {
        let (ring, recording) = template();
        let mut square = 0.0;
        for seed in 0..8 {
            let mut made = Coloured::white(&ring, &recording, 90 + seed);
            let power = if seed % 2 == 0 { 0.5 } else { 1.0 };
            made.vars.iter_mut().for_each(|var| *var = var.powf(power));
            let rms = (made.vars.iter().map(|var| var.ln().powi(2)).sum::<f64>() / made.vars.len() as f64).sqrt();
            let data = whitened(&ring, &made.campaign(&ring, &recording, &[]));
            let first = Fitted::from_guess(&data, &Hypothesis::plain(), &DVector::zeros(data.units.len())).unwrap();
            let hypothesis = learnt(&data, &first);
            let fitted = Fitted::from_guess(&data, &hypothesis, &first.guess(&data, &hypothesis)).unwrap();
            let row = rows(&data, &fitted).into_iter().find(|row| row.kind == "var").unwrap().measured;
            println!("{rms:.4} {:.4} {:.4}", row.value, row.sigma);
            assert!(row.sigma < 0.15 * row.value);
            square += ((row.value - rms) / row.sigma).powi(2) / 8.0;
        }
        // a chi-square of 8 has 2.5 of its mean in one case in a hundred
        assert!(square < 2.5, "{square}");
    }

    /// What all monitors of a plane have in common, and what each has for itself, are families of their own.
    #[test]
    fn families_hold_every_instrument_once() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let of = |name: &str| Family::all().into_iter().find(|family| family.name == name).unwrap().members(&data);
        assert_eq!(of("gains of monitors").len(), 33);
        let together = [of("gain of all horizontal monitors"), of("gain of all vertical monitors")];
        assert_eq!(
            together.map(|members| members.iter().map(|one| one.terms.len()).collect::<Vec<_>>()),
            [vec![15], vec![18]]
        );
        assert_eq!(of("gradient in all dipoles").len(), 1);
        assert_eq!(of("edge angle of all dipoles")[0].terms.len(), 1);
    }

    /// The exact machine of the first fit, which starts at none, is 0.7 standard deviations of all readings together (root of the sum of
    /// squares) from its first order; that of the next, which starts at the first, 0.005.
    #[test]
    fn ordinary_imperfections_are_of_first_order() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let plain = Hypothesis::plain();
        let first = Fitted::from_guess(&data, &plain, &DVector::zeros(data.units.len())).unwrap();
        let second = Fitted::from_guess(&data, &plain, &first.u).unwrap();
        let off = |fitted: &Fitted| (fitted.residual_of(&data).unwrap() - &fitted.residual).norm();
        let (first, second) = (off(&first), off(&second));
        println!("{first} {second}");
        assert!(first < 1.0 && second < 0.02, "{first} {second}");
    }
}
