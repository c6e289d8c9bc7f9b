//! Vars beyond the range of their prior.
//!
//! The range is what the machine file thinks possible. A quadrupole may be outside, with a shorted turn or a wrong supply, and is then to be said,
//! and not to be taken for a field beside it: the fit may therefore go beyond, where the prior's normal goes on.

use core::fmt;

use twin::{Measured, Ring};

use super::average::Vars;

/// A var beyond its range.
#[derive(Debug, Clone, PartialEq)]
pub struct OutOfRange {
    /// Name of the param.
    pub name: String,
    /// The quadrupoles that it scales.
    pub quadrupoles: usize,
    /// Its var [1].
    pub var: Measured,
    /// Smallest and largest of the range [1].
    pub range: [f64; 2],
}

/// Standard deviations beyond a bound at which a normal number is on its other side with 95 %.
const CERTAIN: f64 = 1.645;

impl OutOfRange {
    /// Those that are outside with 95 %.
    pub fn all(ring: &Ring, vars: &Vars) -> Vec<Self> {
        let if_outside = |(i, parameter): (usize, &twin::Parameter)| {
            let (mean, sigma) = (vars.mean[i], vars.covariance[(i, i)].sqrt());
            let [lower, upper] = parameter.prior.range.map(f64::ln);
            let is_outside = (mean - upper).max(lower - mean) > CERTAIN * sigma;
            let var = Measured { value: mean.exp(), sigma: sigma * mean.exp() };
            let (name, quadrupoles) = (parameter.name.clone(), parameter.quadrupoles.len());
            is_outside.then_some(Self { name, quadrupoles, var, range: parameter.prior.range })
        };
        ring.parameters.iter().enumerate().filter_map(if_outside).collect()
    }
}

impl fmt::Display for OutOfRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let off = Measured { value: self.var.value - 1.0, sigma: self.var.sigma }.signed(100.0);
        let who = if self.quadrupoles == 1 { "quadrupole" } else { "quadrupole family" };
        // no more digits than it was written with
        let [lower, upper] = self.range.map(|bound| (1e4 * (bound - 1.0)).round() / 100.0);
        write!(f, "{who} {} is off by {off} %, its range ends at {lower:+} and {upper:+} %", self.name)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    #[test]
    fn what_is_surely_outside_is_told() {
        let ring = Ring::paper_booster();
        let n = ring.parameters.len();
        let mut vars = Vars { mean: DVector::zeros(n), covariance: DMatrix::identity(n, n) * 0.005_f64.powi(2) };
        let at = ring.parameters.iter().position(|one| one.name == "D8").unwrap();
        vars.mean[at] = 0.92_f64.ln();
        // within two standard deviations of the bound
        vars.mean[at + 1] = 1.065_f64.ln();
        let beyond = OutOfRange::all(&ring, &vars);
        let said: Vec<String> = beyond.iter().map(OutOfRange::to_string).collect();
        assert_eq!(said, ["quadrupole D8 is off by -8.00 ± 0.46 %, its range ends at -6 and +6 %"]);
    }
}
