//! Numbers of a JSON object, with the element in every error, and the multipoles of a magnet in the terms of the twin.

use std::collections::BTreeMap;

use serde_json::Value;

use super::element::{Element, Lattice};
use measured::MeasuredError;
use twin::limits::FINITE;

/// Below this a stray number is rounding, and no field.
pub(super) const NONE: f64 = 1e-12;

/// Left out: what moves the orbit about which the response is measured.
pub(super) const KICKS: &str =
    "kicks of correctors and dipole fields beside the reference orbit's (the orbit is straight)";
/// See [`KICKS`].
pub(super) const DISPLACED: &str = "displacements (magnets stand on the reference orbit)";
/// Left out of an instrument.
pub(super) const ROLLED: &str = "rolls of monitors and correctors";
/// Left out of a dipole, which then bends in the horizontal plane.
const ROLLED_DIPOLE: &str = "rolls of dipoles (they bend horizontally)";
/// Errors of alignment are below this, and the bend that is left is the whole one within 5e-5 [rad]; beyond it the ring bends vertically by design.
const MISALIGNED: f64 = 0.01;

/// One element's object.
pub(super) struct Fields<'a> {
    pub file: &'a str,
    pub name: &'a str,
    pub value: &'a Value,
}

impl<'a> Fields<'a> {
    /// A number, 0 where there is none; null is what an infinite one was.
    pub fn number(&self, key: &str) -> Result<f64, MeasuredError> {
        self.value.get(key).map_or(Ok(0.0), |value| self.finite(key, value))
    }

    /// A number, if there is one.
    pub fn maybe(&self, key: &str) -> Result<Option<f64>, MeasuredError> {
        match self.value.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => self.finite(key, value).map(Some),
        }
    }

    /// Whether one of some numbers is there and not 0.
    pub fn any(&self, keys: &[&str]) -> Result<bool, MeasuredError> {
        keys.iter().try_fold(false, |found, key| Ok(found || self.maybe(key)?.unwrap_or(0.0) != 0.0))
    }

    /// A number of a list, 0 beyond its end and where there is no list.
    pub fn at(&self, key: &str, index: usize) -> Result<f64, MeasuredError> {
        match self.value.get(key) {
            None | Some(Value::Null) => Ok(0.0),
            Some(Value::Array(list)) => list.get(index).map_or(Ok(0.0), |value| self.finite(key, value)),
            Some(other) => Err(self.wrong(format!("{key}: expected a list, found {other}"))),
        }
    }

    /// Whether a list has a number other than 0 at or behind a place.
    pub fn has_from(&self, key: &str, first: usize) -> bool {
        let list = self.value.get(key).and_then(Value::as_array);
        list.is_some_and(|list| list.iter().skip(first).filter_map(Value::as_f64).any(|one| one.abs() > NONE))
    }

    /// Fields that are text.
    pub fn words(&self) -> BTreeMap<String, String> {
        let fields = self.value.as_object().into_iter().flatten();
        fields.filter_map(|(key, value)| Some((key.clone(), value.as_str()?.to_owned()))).collect()
    }

    /// A group of fields of the same element.
    pub fn group(&self, key: &str) -> Fields<'a> {
        Fields { value: self.value.get(key).unwrap_or(&Value::Null), ..*self }
    }

    fn finite(&self, key: &str, value: &Value) -> Result<f64, MeasuredError> {
        match value.as_f64() {
            Some(number) => FINITE.check(number).map_err(|problem| self.wrong(format!("{key}: {problem}"))),
            None => Err(self.wrong(format!("{key}: expected {FINITE}, found {value}"))),
        }
    }

    /// A problem of this element.
    pub fn wrong(&self, problem: String) -> MeasuredError {
        MeasuredError::Table { file: self.file.into(), problem: format!("element {}: {problem}", self.name) }
    }
}

/// Strengths of a magnet: integrated where it has no length, else per length.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Strengths {
    /// Field index 1: normal, skew.
    pub k1: [f64; 2],
    /// Field index 2: normal, skew.
    pub k2: [f64; 2],
    /// It has a dipole field besides that of the reference orbit.
    pub is_dipole: bool,
    /// It has higher fields.
    pub is_higher: bool,
    /// Angle by which it is rolled from x to y [rad].
    pub tilt: f64,
}

/// Give a magnet its strengths; what the twin does not carry is counted, or refused where the ring would not be the same without it.
pub(super) fn give(lattice: &mut Lattice, mut element: Element, of: Strengths) -> Result<(), MeasuredError> {
    let refuse = |lattice: &Lattice, what: String| lattice.refuse(format!("element {}: {what}", element.name));
    if element.bend != 0.0 && of.tilt.abs() > MISALIGNED {
        let expected = format!("expected a flat ring, whose errors of alignment are below {MISALIGNED} rad");
        return refuse(lattice, format!("a dipole rolled by {} rad, {expected}", of.tilt));
    }
    if element.bend != 0.0 && element.length <= 0.0 {
        return refuse(lattice, format!("a thin dipole of {} rad, expected a lattice of thick elements", element.bend));
    }
    if element.bend != 0.0 && of.tilt.abs() > NONE {
        lattice.leave_out(ROLLED_DIPOLE);
    }
    // a field of index 1 turns by twice the angle
    let (sin, cos) = (2.0 * of.tilt).sin_cos();
    let [normal, skew] = [of.k1[0] * cos - of.k1[1] * sin, of.k1[0] * sin + of.k1[1] * cos];
    if element.length <= 0.0 && normal.abs() > NONE {
        return refuse(lattice, format!("a thin quadrupole of {normal} /m, expected a lattice of thick elements"));
    }
    element.k1 = if normal.abs() > NONE { normal } else { 0.0 };
    if skew.abs() > NONE {
        lattice.leave_out("skew gradient (couples the planes)");
    }
    if of.k2 != [0.0; 2] {
        element.k2 = if element.length > 0.0 { of.k2[0] } else { 0.0 };
        lattice.leave_out("sextupole field (none to first order on the reference orbit)");
    }
    if element.is_fringe_uneven {
        lattice.leave_out("soft edges unlike at entrance and exit (their mean is at both)");
    }
    if of.is_dipole {
        lattice.leave_out(KICKS);
    }
    if of.is_higher {
        lattice.leave_out("octupole or higher field (none to first order on the reference orbit)");
    }
    lattice.push(element)
}
