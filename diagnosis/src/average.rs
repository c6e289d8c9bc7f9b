//! The vars averaged over the competing causes: a mixture, weighted by their posterior probabilities.
//!
//! `mean = sum of p m`, `covariance = sum of p (C + (m - mean)(m - mean)^T)`.
//!
//! Source: J. A. Hoeting et al., Statist. Sci. 14 (1999) 382, Bayesian model averaging.

use nalgebra::{DMatrix, DVector};

use super::alternatives::{Cause, Competition};
use super::discrepancy::Discrepancy;
use super::family::Family;
use super::fit::{FitError, Fitted};
#[cfg(doc)]
use super::hypothesis::Hypothesis;
use super::odds::DECISIVE;
use super::search::Found;

/// `ln` of the vars.
#[derive(Debug, Clone)]
pub struct Vars {
    /// Mean of each `ln var`.
    pub mean: DVector<f64>,
    /// Covariance.
    pub covariance: DMatrix<f64>,
}

impl Vars {
    /// The vars of one fit.
    pub fn from_fit(fitted: &Fitted) -> Self {
        Self { mean: DVector::from_column_slice(&fitted.params), covariance: fitted.covariance() }
    }

    /// Normalised estimation error squared, per var, for the `ln` of the true ones.
    pub fn nees(&self, truth: &DVector<f64>) -> f64 {
        let off = &self.mean - truth;
        let solved = self.covariance.clone().cholesky().map(|factor| factor.solve(&off));
        solved.map_or(f64::INFINITY, |solved| off.dot(&solved) / off.len() as f64)
    }

    /// The vars averaged over the alternatives of the least certain finding.
    pub(crate) fn averaged(found: &Found) -> Self {
        let certainty = |competition: &&Competition| {
            competition.alternatives.first().map_or(competition.nothing, |a| a.probability)
        };
        let least = found.competitions.iter().min_by(|a, b| certainty(a).total_cmp(&certainty(b)));
        Self::over(least.filter(|competition| certainty(competition) < DECISIVE).unwrap_or(&found.next))
    }

    /// The same with room for what the recording cannot show ([`Hypothesis::unseen`], [`Family::hidden`]), to first order.
    pub(crate) fn widened(self, found: &Found) -> Result<Self, FitError> {
        let (data, best) = (&found.data, &found.best);
        let (step, wide) = best.widened(data, &best.hypothesis.unseen(data), &Family::hidden(data))?;
        Ok(Self { mean: self.mean + step, covariance: self.covariance + wide - best.covariance() })
    }

    fn over(competition: &Competition) -> Self {
        let plain = Self::from_fit(&competition.without);
        let (vars, units) = (plain.mean.len(), &competition.without.units);
        let mut parts = vec![(competition.nothing + competition.too_small, plain.clone())];
        for alternative in &competition.alternatives {
            let part = match (&alternative.fitted, &alternative.cause) {
                (Some(fitted), _) => Self::from_fit(fitted),
                (None, Cause::Unmodelled(Discrepancy { adapted: Some(adapted), .. })) => Self {
                    mean: &plain.mean + units.step(&adapted.step),
                    covariance: units.covariance(&adapted.covariance),
                },
                (None, Cause::Unmodelled(_)) => plain.clone(),
                (None, Cause::Effect(_)) => {
                    // to first order: the vars shift in proportion to the amplitude, and its uncertainty adds to theirs
                    let shift = units.step(&alternative.adapting);
                    let (amplitude, error) = alternative.amplitude;
                    let per_sigma = if amplitude == 0.0 { &shift * 0.0 } else { &shift * (error / amplitude) };
                    Self {
                        mean: &plain.mean + shift,
                        covariance: &plain.covariance + &per_sigma * per_sigma.transpose(),
                    }
                }
            };
            parts.push((alternative.probability, part));
        }
        let weight: f64 = parts.iter().map(|(p, _)| p).sum();
        let mean = parts.iter().fold(DVector::zeros(vars), |sum, (p, part)| sum + &part.mean * (p / weight));
        let covariance = parts.iter().fold(DMatrix::zeros(vars, vars), |sum, (p, part)| {
            let off = &part.mean - &mean;
            sum + (&part.covariance + &off * off.transpose()) * (p / weight)
        });
        Self { mean, covariance }
    }
}

#[cfg(test)]
mod tests {
    use twin::{Effect, EffectKind};

    use super::*;
    use crate::hypothesis::Hypothesis;
    use crate::testing::{Coloured, template, whitened};
    use crate::{Diagnosis, Verdict};

    /// To first order about the fit against a fit with all that: the vars move by little of their error bars, which agree.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn room_for_what_is_hidden_is_that_of_a_fit_with_it() {
        let (ring, recording) = template();
        let made = Coloured::white(&ring, &recording, 71).campaign(&ring, &recording, &[]);
        let data = whitened(&ring, &made);
        let plain = Hypothesis::plain();
        let fitted = Fitted::from_guess(&data, &plain, &DVector::zeros(data.units.len())).unwrap();
        let (wide, hidden) = (plain.unseen(&data), Family::hidden(&data));
        let (step, covariance) = fitted.widened(&data, &wide, &hidden).unwrap();
        let ordinary = hidden.into_iter().chain(wide.ordinary.clone()).collect();
        let whole = Hypothesis { ordinary, ..wide };
        let exact = Fitted::from_guess(&data, &whole, &fitted.guess(&data, &whole)).unwrap();
        let of_exact = exact.covariance();
        let (mut off, mut width) = (0.0_f64, 0.0_f64);
        for (i, (own, param)) in fitted.params.iter().zip(&exact.params).enumerate() {
            off = off.max((own + step[i] - param).abs() / of_exact[(i, i)].sqrt());
            width = width.max((covariance[(i, i)] / of_exact[(i, i)] - 1.0).abs());
        }
        println!("{off} {width}");
        // what the machine changes to second order
        assert!(off < 0.3 && width < 0.1, "{off} {width}");
    }

    /// A gradient of one prior width in one dipole is nothing that a recording shows, since its neighbours absorb it: their error bars know that in part. Without
    /// any room the NEES per var of these six is 6.1 on average, with that for straights and dipoles 2.1.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn error_bars_know_what_a_dipole_may_hide() {
        let (ring, recording) = template();
        let dipoles = EffectKind::DipoleGradient.sites(&ring);
        let mut means = [0.0; 2];
        for seed in 0..6 {
            let effect = Effect { kind: EffectKind::DipoleGradient, site: dipoles[6 * seed], amplitude: 0.012 };
            let made = Coloured::white(&ring, &recording, 40 + seed as u64);
            let found = Diagnosis::from_recording(&ring, &made.campaign(&ring, &recording, &[effect]), |_| ()).unwrap();
            assert_eq!(found.verdict, Verdict::Consistent, "{}", found.sentence);
            let truth = DVector::from_vec(made.vars).map(f64::ln);
            for (mean, vars) in means.iter_mut().zip([&found.vars_before, &found.vars_after]) {
                *mean += vars.nees(&truth) / 6.0;
            }
        }
        let [before, after] = means;
        println!("{before} {after}");
        // the mean of 6 times 48 squared pulls scatters by a tenth
        assert!(before > 3.0 && after < 2.5, "{before} {after}");
    }
}
