//! The supply law: how read-backs of currents become fields, and fields the strengths of magnets.
//!
//! A current is a weighted sum of read-backs: the main current, and a trim by its ratio of turns or with its sign. What a current makes is a
//! polynomial in amperes. With the rigidity `B rho = B(I_dipole) radius`,
//!
//! `K1 = G(I)/(B rho L) (1 - ramp Bdot/B)`,      `K2 = S(I)/(B rho L)`,      `kick = corrector I/(B rho)`.

use core::{fmt, iter};
use std::collections::BTreeMap;

use serde::Deserialize;

/// Polynomial in a current [A], from its constant term.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Polynomial(Vec<f64>);

impl Polynomial {
    /// Its value at a current [A].
    pub fn at(&self, current: f64) -> f64 {
        self.0.iter().rev().fold(0.0, |sum, c| sum * current + c)
    }

    /// Its coefficients in the current over a nominal one [A], the sum of which is its value there.
    pub fn over(&self, nominal: f64) -> Vec<f64> {
        self.0.iter().zip(0..).map(|(c, n)| c * nominal.powi(n)).collect()
    }
}

/// Weights of read-backs by name, whose sum is a current.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Weights(pub BTreeMap<String, f64>);

impl fmt::Display for Weights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let each: Vec<String> = self.0.iter().map(|(name, weight)| format!("{weight} {name}")).collect();
        f.write_str(&each.join(" + "))
    }
}

impl Weights {
    /// The current of some read-backs [A]; the first that is missing, if one is.
    ///
    /// # Errors
    /// The name of a missing read-back.
    pub fn current(&self, read_back: impl Fn(&str) -> Option<f64>) -> Result<f64, &str> {
        self.0.iter().map(|(name, weight)| Ok(weight * read_back(name).ok_or(name.as_str())?)).sum()
    }
}

/// The dipoles.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DipoleLaw {
    /// Their current.
    pub current: Weights,
    /// Field [T].
    #[serde(rename = "field_T")]
    pub field: Polynomial,
    /// Radius of the reference orbit in them [m].
    #[serde(rename = "radius_m")]
    pub radius: f64,
    /// Gradient of the body, `K1 radius` [1/m].
    #[serde(rename = "k1_radius_1_m", default)]
    k1: Option<Polynomial>,
    /// Sextupole of the body, `K2 radius` [1/m^2].
    #[serde(rename = "k2_radius_1_m2", default)]
    k2: Option<Polynomial>,
    /// What the ramp adds to that, per relative rate `Bdot/B` [s/m^2].
    #[serde(rename = "k2_radius_per_ramp_rate_s_m2", default)]
    k2_ramp: f64,
}

/// Magnets of one current.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MagnetLaw {
    /// Their current.
    pub current: Weights,
    /// Integrated gradient of a quadrupole [T], integrated second derivative of the field of a sextupole [T/m].
    pub integrated: Polynomial,
    /// Share of that which eddy currents take, per relative rate `Bdot/B` [s].
    #[serde(rename = "ramp_s", default)]
    ramp: f64,
    /// The same of single magnets by name, as in another chamber [s].
    #[serde(rename = "ramp_s_of", default)]
    ramp_of: BTreeMap<String, f64>,
}

impl MagnetLaw {
    /// Strength of a magnet by name and length [m], at a current [A], a rigidity [T m] and a relative ramp rate [1/s].
    fn strength(&self, name: &str, length: f64, current: f64, rigidity: f64, ramp_rate: f64) -> f64 {
        let ramp = self.ramp_of.get(name).copied().unwrap_or(self.ramp);
        self.integrated.at(current) / (rigidity * length) * (1.0 - ramp * ramp_rate)
    }
}

/// The supply law of a machine, and the read-backs at which its file states it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Currents {
    /// Read-backs at which the machine is the design [A].
    #[serde(rename = "design_A")]
    design: BTreeMap<String, f64>,
    /// Relative rate `Bdot/B` there [1/s]; 0 on a flat-top.
    #[serde(rename = "ramp_rate_1_s", default)]
    ramp_rate: f64,
    /// The dipoles.
    pub dipole: DipoleLaw,
    /// Quadrupoles, by supply.
    pub quadrupoles: BTreeMap<String, MagnetLaw>,
    /// Sextupoles, by family.
    #[serde(default)]
    sextupoles: BTreeMap<String, MagnetLaw>,
    /// Integrated field of a corrector [T m/A].
    #[serde(rename = "corrector_T_m_per_A")]
    corrector: f64,
}

/// Read-back of the dipoles.
const DIPOLE: &str = "dipole";
/// Momentum of a unit charge over the rigidity, the speed of light in these units [GeV/c per T m].
const MOMENTUM: f64 = 0.299_792_458;

impl Currents {
    /// Current of magnets at the design [A].
    ///
    /// # Errors
    /// The name of a read-back that the design does not state.
    pub fn at_design<'c>(&self, weights: &'c Weights) -> Result<f64, &'c str> {
        weights.current(|name| self.design.get(name).copied())
    }

    /// Current of a supply of quadrupoles at the design [A]; none of one that the law does not know.
    pub fn supply(&self, name: &str) -> Option<f64> {
        self.at_design(&self.quadrupoles.get(name)?.current).ok()
    }

    /// Current of the dipoles at the design [A].
    pub fn dipole_current(&self) -> f64 {
        self.at_design(&self.dipole.current).expect("the law is checked with its file")
    }

    /// Rigidity at the design [T m].
    pub fn rigidity(&self) -> f64 {
        self.dipole.field.at(self.dipole_current()) * self.dipole.radius
    }

    /// Momentum at the design [GeV/c].
    pub fn momentum(&self) -> f64 {
        MOMENTUM * self.rigidity()
    }

    /// Kick of a corrector at the design [rad/A].
    pub fn kick_per_ampere(&self) -> f64 {
        self.corrector / self.rigidity()
    }

    /// K1 of a quadrupole by supply, name and length [m], at the design [1/m^2]; none of a supply that the law does not know.
    pub(super) fn k1(&self, supply: &str, name: &str, length: f64) -> Option<f64> {
        self.strength(self.quadrupoles.get(supply)?, name, length)
    }

    /// K2 of a sextupole by family, name and length [m], at the design [1/m^3]; none of a family that the law does not know.
    pub(super) fn k2(&self, family: &str, name: &str, length: f64) -> Option<f64> {
        self.strength(self.sextupoles.get(family)?, name, length)
    }

    fn strength(&self, law: &MagnetLaw, name: &str, length: f64) -> Option<f64> {
        let current = self.at_design(&law.current).ok()?;
        Some(law.strength(name, length, current, self.rigidity(), self.ramp_rate))
    }

    /// K1 [1/m^2] and K2 [1/m^3] of the dipoles' body at the design, as far as the law states them.
    pub(super) fn body(&self) -> [Option<f64>; 2] {
        let (current, radius) = (self.dipole_current(), self.dipole.radius);
        let at = |law: &Option<Polynomial>| law.as_ref().map(|law| law.at(current) / radius);
        let ramp = self.dipole.k2_ramp * self.ramp_rate / radius;
        [at(&self.dipole.k1), at(&self.dipole.k2).map(|k2| k2 + ramp)]
    }

    /// Supplies and families, and magnets whose eddy currents are their own.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        let laws = self.quadrupoles.iter().chain(&self.sextupoles);
        laws.flat_map(|(name, law)| iter::once(name).chain(law.ramp_of.keys())).map(String::as_str)
    }

    /// What the law lacks, and what would be there: a read-back of a current, or a field of the dipoles.
    pub(super) fn lack(&self) -> Option<(&'static str, String)> {
        let magnets = self.quadrupoles.values().chain(self.sextupoles.values()).map(|law| &law.current);
        let missing = magnets.chain([&self.dipole.current]).find_map(|weights| self.at_design(weights).err());
        if let Some(name) = missing {
            return Some(("every read-back of a current in design_A", format!("no {name}")));
        }
        // a recording has a column of the dipoles, and one of each read-back of a supply
        if self.dipole.current.0 != BTreeMap::from([(DIPOLE.to_owned(), 1.0)]) {
            return Some(("the read-back dipole alone as the current of the dipoles", self.dipole.current.to_string()));
        }
        for (supply, law) in &self.quadrupoles {
            let Weights(weights) = &law.current;
            if weights.contains_key(supply) && (weights.len() > 1 || weights[supply] != 1.0) {
                return Some(("a supply that is no read-back of its own sum", format!("{supply}: {}", law.current)));
            }
            let current = self.supply(supply).unwrap_or_default();
            if !(current.is_finite() && current > 0.0) {
                return Some(("a current of each supply above 0 at design_A", format!("{current} A of {supply}")));
            }
        }
        if !(self.corrector.is_finite() && self.corrector > 0.0) {
            return Some(("corrector_T_m_per_A above 0", self.corrector.to_string()));
        }
        let rigidity = self.rigidity();
        (!(rigidity.is_finite() && rigidity > 0.0))
            .then(|| ("a field of the dipoles above 0 at design_A", format!("{rigidity} T m")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 1 T in dipoles of 10 m at 1000 A, and quadrupoles of 2 T per 1000 A in series with these, with a trim of a fifth of the turns.
    fn law(text: &str) -> Currents {
        let law = r#"{
            "design_A": {"dipole": 1000, "trim": -500},
            "dipole": {"current": {"dipole": 1}, "field_T": [0, 1e-3], "radius_m": 10, "k1_radius_1_m": [0.01, 1e-5]},
            "quadrupoles": {"Q": {"current": {"dipole": 1, "trim": 0.2}, "integrated": [0, 2e-3], "ramp_s": 1e-4, "ramp_s_of": {"Q2": 2e-4}}},
            "corrector_T_m_per_A": 1e-4"#;
        serde_json::from_str(&format!("{law}{text}}}")).unwrap()
    }

    #[test]
    fn strengths_follow_from_read_backs() {
        let law = law("");
        assert_eq!((law.dipole_current(), law.rigidity(), law.supply("Q")), (1000.0, 10.0, Some(900.0)));
        assert!((law.momentum() - 2.997_924_58).abs() < 1e-12 && (law.kick_per_ampere() - 1e-5).abs() < 1e-18);
        assert!((law.k1("Q", "Q1", 0.5).unwrap() - 1.8 / 5.0).abs() < 1e-12);
        assert_eq!((law.k1("other", "Q1", 0.5), law.k2("S", "S1", 0.1), law.lack()), (None, None, None));
        let [k1, k2] = law.body();
        assert!((k1.unwrap() - 0.002).abs() < 1e-15 && k2.is_none());
        // the same gradient by the current over its nominal one
        let over = law.quadrupoles["Q"].integrated.over(900.0);
        assert_eq!(over, [0.0, 1.8]);
    }

    #[test]
    fn eddy_currents_take_their_share_on_the_ramp() {
        let law = law(r#", "ramp_rate_1_s": 10"#);
        let share = |name| law.k1("Q", name, 0.5).unwrap() / 0.36;
        assert!((share("Q1") - 0.999).abs() < 1e-12 && (share("Q2") - 0.998).abs() < 1e-12);
    }

    #[test]
    fn a_read_back_that_is_missing_is_named() {
        let mut law = law("");
        law.design.remove("trim");
        assert_eq!(law.lack(), Some(("every read-back of a current in design_A", "no trim".into())));
    }

    #[test]
    fn a_law_that_recordings_cannot_follow_is_refused() {
        let found = |change: &dyn Fn(&mut Currents)| {
            let mut law = law("");
            change(&mut law);
            law.lack().unwrap().1
        };
        let sum = |names: [(&str, f64); 2]| Weights(names.map(|(name, weight)| (name.to_owned(), weight)).into());
        let of_supply = |names| {
            found(&|law: &mut Currents| {
                law.design.insert("Q".into(), 10.0);
                law.quadrupoles.get_mut("Q").unwrap().current = sum(names);
            })
        };
        assert_eq!(of_supply([("Q", 1.0), ("trim", 0.2)]), "Q: 1 Q + 0.2 trim");
        assert_eq!(of_supply([("dipole", 1.0), ("trim", 3.0)]), "-500 A of Q");
        assert_eq!(found(&|law| law.dipole.current = sum([("dipole", 1.0), ("trim", 0.1)])), "1 dipole + 0.1 trim");
        assert_eq!(found(&|law| law.corrector = -1e-4), "-0.0001");
    }
}
