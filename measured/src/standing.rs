//! Fitted values that stand out of those of their kind: a gain far from the gains of all other monitors, a magnet far from its family.
//!
//! A value is compared with the median `m` of its family, instruments of one plane or magnets of one name, and with the robust spread
//! `s = 1.4826 median |v - m|` of all of its kind. A value `v ± e` is `z = |v - m|/hypot(s, e)` off. As the spread of `n` values is known no better
//! than from `0.37 n` normal ones, `z` follows Student's distribution with so many degrees of freedom; what one fit in a hundred would have
//! by chance stands out, and at least 5. Its `ln` Bayes factor is that of the fit's prior width `w` against the spread of its kind,
//! `z^2/2 - ln(hypot(w, e)/hypot(s, e))`.
//!
//! Source: P. J. Rousseeuw and C. Croux, J. Am. Stat. Assoc. 88 (1993) 1273, for the 0.37.

use std::collections::BTreeMap;

use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::fit::Fit;
use crate::folder::Folder;
use crate::unknowns::{Kind, name};

/// Robust standard deviations that a value must be off at least: of normal values one in 1.7 million is.
const OUT: f64 = 5.0;
/// Fits in which anything stands out by chance: one in so many.
const FALSE: f64 = 100.0;
/// Normal values that tell a spread as well as the median of one does.
const EFFICIENCY: f64 = 0.37;
/// Values that a family must have to have a median beside each of them.
const ENOUGH: usize = 4;

/// A value that stands out.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// What it is.
    pub kind: Kind,
    /// Where.
    pub at: String,
    /// Fitted value.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Median of its family and robust spread of its kind.
    pub others: [f64; 2],
    /// Values of its kind.
    pub count: usize,
    /// Robust standard deviations from the median.
    pub off: f64,
    /// `ln` Bayes factor [nat].
    pub log_evidence_gain: f64,
}

/// Values that stand out, the farthest first.
pub fn standing(folder: &Folder, fitted: &Fit) -> Vec<Standing> {
    let mut families: BTreeMap<(&str, String), Vec<usize>> = BTreeMap::new();
    for (at, unknown) in fitted.unknowns.iter().enumerate() {
        if let Some(family) = family(folder, fitted, unknown.kind) {
            families.entry((unknown.kind.word(), family)).or_default().push(at);
        }
    }
    families.retain(|_, members| members.len() >= ENOUGH);
    let mut kinds: BTreeMap<&str, Vec<(usize, f64)>> = BTreeMap::new();
    for ((kind, _), members) in &families {
        let middle = median(members.iter().map(|&at| fitted.values[at]));
        kinds.entry(kind).or_default().extend(members.iter().map(|&at| (at, middle)));
    }
    let mut all: Vec<Standing> = Vec::new();
    for members in kinds.values() {
        let spread = 1.4826 * median(members.iter().map(|&(at, middle)| (fitted.values[at] - middle).abs()));
        let limit = limit(members.len(), fitted.unknowns.len());
        let each = members.iter().map(|&(at, middle)| of(folder, fitted, at, [middle, spread], members.len()));
        all.extend(each.filter(|one| one.off > limit));
    }
    all.sort_by(|a, b| b.off.total_cmp(&a.off));
    all
}

/// Robust standard deviations from which on one of `count` values of a kind stands out, in a fit of some unknowns.
fn limit(count: usize, unknowns: usize) -> f64 {
    let student = StudentsT::new(0.0, 1.0, EFFICIENCY * count as f64).expect("a kind has values");
    OUT.max(-student.inverse_cdf(0.5 / (FALSE * unknowns as f64)))
}

fn of(folder: &Folder, fitted: &Fit, at: usize, others: [f64; 2], count: usize) -> Standing {
    let (value, sigma, unknown) = (fitted.values[at], fitted.sigma(at), &fitted.unknowns[at]);
    let [middle, spread] = others;
    let off = (value - middle).abs() / spread.hypot(sigma);
    let occam = (unknown.width.hypot(sigma) / spread.hypot(sigma)).ln();
    let (kind, at) = (unknown.kind, name(folder, &fitted.groups, unknown.kind));
    Standing { kind, at, value, sigma, others, count, off, log_evidence_gain: 0.5 * off * off - occam }
}

/// What an unknown is compared with: instruments of its plane, magnets of its family.
fn family(folder: &Folder, fitted: &Fit, kind: Kind) -> Option<String> {
    match kind {
        Kind::MonitorGain(row) | Kind::MonitorCoupling(row) => Some(format!("{:?}", folder.monitors[row].plane)),
        Kind::CorrectorGain(column) | Kind::CorrectorCoupling(column) => {
            Some(format!("{:?}", folder.correctors[column].plane))
        }
        Kind::Strength(group) => Some(folder.lattice[fitted.groups[0][group][0]].name.clone()),
        Kind::Skew(group) => Some(folder.lattice[fitted.groups[1][group][0]].name.clone()),
        Kind::RfScale | Kind::HeldFrequency => None,
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    if values.len() % 2 == 1 { values[half] } else { 0.5 * (values[half - 1] + values[half]) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::{Settings, fit};
    use crate::testing::{NOISE, machine, measured, ring};

    #[test]
    fn what_is_far_from_its_kind_stands_out_and_nothing_else() {
        let ring = ring();
        for seed in 0..4 {
            let plain = measured(&ring, &machine(&ring, 30 + seed), NOISE, seed);
            let standing = |folder: &Folder| {
                let fitted = fit(folder, &Settings::default(), &mut |_| ()).unwrap();
                standing(folder, &fitted).into_iter().map(|one| one.kind).collect::<Vec<_>>()
            };
            assert_eq!(standing(&plain), [], "{seed}");
            let (row, mut wrong) = (3 + seed as usize, plain);
            wrong.matrix.row_mut(row).scale_mut(0.3);
            wrong.dispersion.as_mut().unwrap()[row] *= 0.3;
            wrong.matrix.column_mut(5).scale_mut(0.3);
            let found = standing(&wrong);
            assert_eq!(found.len(), 2, "{seed}: {found:?}");
            assert!(found.contains(&Kind::MonitorGain(row)) && found.contains(&Kind::CorrectorGain(5)), "{found:?}");
        }
    }
}
