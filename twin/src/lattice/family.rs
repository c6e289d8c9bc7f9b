//! Families of quadrupoles: what feeds them and how they are fitted, as the machine file says.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::{LatticeError, Parameter, ParameterPrior, Quadrupole, Supply};

/// The supply of magnets that are in series with the dipoles.
const DIPOLE: &str = "dipole";

/// What the machine file says of a family; every key may be left out.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Family {
    supply: Option<String>,
    #[serde(default)]
    fit: Fit,
    prior_width: Option<f64>,
    range: Option<[f64; 2]>,
    #[serde(rename = "note")]
    _note: Option<String>,
}

/// What of a family is fitted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Fit {
    /// Each magnet.
    #[default]
    Single,
    /// One factor on all.
    Family,
    /// Nothing.
    None,
}

pub(super) type Families = BTreeMap<String, Family>;

/// A quadrupole of the machine file.
#[derive(Debug)]
pub(super) struct Listed<'f> {
    pub element: usize,
    pub name: &'f str,
    pub label: &'f str,
    pub focusing: bool,
    pub family: Option<&'f str>,
    /// False to leave it at its design strength.
    pub fit: bool,
}

/// The quadrupoles of a ring with their supplies and params.
#[derive(Debug, Default)]
pub(super) struct Circuits {
    pub quadrupoles: Vec<Quadrupole>,
    pub supplies: Vec<Supply>,
    pub parameters: Vec<Parameter>,
}

impl Circuits {
    /// Focusing quadrupoles in beam order, then the others; supplies and params in the order of their first quadrupole.
    ///
    /// # Errors
    /// [`LatticeError`] where a family has no quadrupole or a prior that cannot be, or two params have one name.
    pub fn of(listed: &[Listed], families: &Families, prior: ParameterPrior) -> Result<Self, LatticeError> {
        families.iter().try_for_each(|(name, family)| family.check(name, listed))?;
        let mut circuits = Self::default();
        for focusing in [true, false] {
            for quadrupole in listed.iter().filter(|q| q.focusing == focusing) {
                circuits.add(quadrupole, families, prior)?;
            }
        }
        Ok(circuits)
    }

    fn add(&mut self, listed: &Listed, families: &Families, prior: ParameterPrior) -> Result<(), LatticeError> {
        let mut quadrupole = Quadrupole { element: listed.element, supply: None, parameter: None };
        let (mut fit, mut prior, mut name) = (Fit::Single, prior, listed.label);
        if let Some(of) = listed.family {
            let family = families.get(of).cloned().unwrap_or_default();
            quadrupole.supply = family.supply(of).map(|name| self.supply(name));
            (fit, prior) = (family.fit, family.prior(of, prior)?);
            name = if fit == Fit::Family { of } else { name };
        }
        if listed.fit && fit != Fit::None {
            quadrupole.parameter = Some(self.parameter(name, prior));
        }
        self.quadrupoles.push(quadrupole);
        Ok(())
    }

    /// The param of this name, which scales the quadrupole that comes next.
    fn parameter(&mut self, name: &str, prior: ParameterPrior) -> usize {
        let known = self.parameters.iter().position(|parameter| parameter.name == name);
        let index = known.unwrap_or(self.parameters.len());
        if known.is_none() {
            self.parameters.push(Parameter { name: name.into(), quadrupoles: Vec::new(), prior });
        }
        self.parameters[index].quadrupoles.push(self.quadrupoles.len());
        index
    }

    fn supply(&mut self, name: &str) -> usize {
        self.supplies.iter().position(|supply| supply.name == name).unwrap_or_else(|| {
            self.supplies.push(Supply { name: name.into() });
            self.supplies.len() - 1
        })
    }
}

impl Family {
    /// A family has members, and where it is one factor no other param has its name.
    fn check(&self, name: &str, listed: &[Listed]) -> Result<(), LatticeError> {
        if listed.iter().all(|q| q.family != Some(name)) {
            let (name, field) = (format!("family {name}"), "a quadrupole of this family");
            return Err(LatticeError::Field { name, field, found: "none".into() });
        }
        match listed.iter().find(|q| self.fit == Fit::Family && q.label == name) {
            Some(q) => Err(LatticeError::ParameterName { family: name.into(), quadrupole: q.name.into() }),
            None => Ok(()),
        }
    }

    /// The name of its supply: its own unless another is stated.
    pub fn supply<'f>(&'f self, name: &'f str) -> Option<&'f str> {
        Some(self.supply.as_deref().unwrap_or(name)).filter(|supply| *supply != DIPOLE)
    }

    fn prior(&self, name: &str, default: ParameterPrior) -> Result<ParameterPrior, LatticeError> {
        default.or(&format!("family {name}"), self.prior_width, self.range)
    }
}
