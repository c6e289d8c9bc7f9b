//! `FitParameters` of a LOCO file: the strengths that the fit began at, and what it found.
//!
//! A parameter is a struct array, one struct a field of an element (`ElemIndex`, `FieldName`, `FieldIndex`), with the function that makes the field of
//! the parameter's value: `x`, or `a*x` where magnets keep a ratio.
//!
//! Source: `mkparamgroup.m` and `setparamgroup.m` of the Accelerator Toolbox.

use serde_json::{Map, Value, json};

use crate::import::element::Lattice;
use crate::import::mat::{Mat, MatFile, Place};
use measured::MeasuredError;
use measured::folder::{Flags, Folder, Group, ReferenceFit};

/// Words of `LocoFlags` that are kept.
const FLAGS: [&str; 3] = ["SVmethod", "OutlierFactor", "ClosedOrbitType"];

/// The fit's parameters.
pub(super) struct LocoFit<'a> {
    parameters: Vec<Parameter>,
    /// At the start, and at the end.
    values: [Vec<f64>; 2],
    models: Option<Place<'a>>,
    flags: Option<Place<'a>>,
    /// Number of elements of the lattice.
    pub length: usize,
}

/// One parameter.
struct Parameter {
    fields: Vec<Field>,
}

/// A field of an element that follows it.
struct Field {
    element: usize,
    name: String,
    index: usize,
    /// Of the value of the parameter; none where the function is another.
    factor: Option<f64>,
}

impl Parameter {
    /// `K` of a gradient, `PolynomA` of a skew gradient; none for anything else, and for gradients in unlike ratios that start at 0 and lose them.
    fn word(&self, start: f64) -> Option<&'static str> {
        let word = |one: &Field| match (one.name.as_str(), one.index) {
            ("K", 0) | ("PolynomB", 1) => Some("K"),
            ("PolynomA", 1) => Some("PolynomA"),
            _ => None,
        };
        let first = word(self.fields.first()?)?;
        let is_like = |one: &Field| one.factor.is_some() && word(one) == Some(first);
        let are_alike = || self.fields.iter().all(|one| one.factor == self.fields[0].factor);
        (self.fields.iter().all(is_like) && (start != 0.0 || are_alike())).then_some(first)
    }
}

impl<'a> LocoFit<'a> {
    /// Of a file with a lattice; empty where it was not fitted.
    pub fn of(file: &'a MatFile, document: &Value) -> Result<Self, MeasuredError> {
        let length = document["elements"].as_array().map_or(0, Vec::len);
        let mut fit = Self {
            parameters: Vec::new(),
            values: [Vec::new(), Vec::new()],
            models: file.variable("LocoModel"),
            flags: file.variable("LocoFlags"),
            length,
        };
        let Some(all) = file.variable("FitParameters").filter(|all| !all.value.is_empty()) else { return Ok(fit) };
        let Some(parameters) = all.field("Params") else { return Ok(fit) };
        let parameters =
            if matches!(parameters.value, Mat::Cells(..)) { parameters.elements()? } else { vec![parameters] };
        fit.parameters = parameters.iter().map(|one| parameter(one, length)).collect::<Result<_, _>>()?;
        let last = all.elements()?.len() - 1;
        let values = |element| {
            let values = all.need_of(element, "Values")?.many(fit.parameters.len(), "one a parameter");
            values.map(<[f64]>::to_vec)
        };
        fit.values = [values(0)?, values(last)?];
        Ok(fit)
    }

    /// True of an element whose gradient is a parameter.
    pub fn has_gradient(&self, element: usize) -> bool {
        let words = self.parameters.iter().zip(&self.values[0]).map(|(one, start)| (one, one.word(*start)));
        let mut gradients = words.filter(|(_, word)| *word == Some("K")).map(|(one, _)| one);
        gradients.any(|one| one.fields.iter().any(|field| field.element == element))
    }

    /// The fit, for the folder; none where nothing was fitted.
    pub fn reference(
        &self,
        [monitors, correctors]: [&Place; 2],
        folder: &Folder,
        lattice: &Lattice,
        places: &[usize],
    ) -> Result<Option<ReferenceFit>, MeasuredError> {
        let words = self.parameters.iter().zip(&self.values[0]).map(|(one, start)| one.word(*start));
        let kept: Vec<(usize, &'static str)> = words.enumerate().filter_map(|(at, word)| Some((at, word?))).collect();
        let (Some(flags), false) = (&self.flags, kept.is_empty()) else { return Ok(None) };
        // a magnet with a corrector in it was cut around a row of no length
        let of_element = |one: &Field| match places[one.element] {
            cut if folder.lattice[cut].length < lattice.elements[one.element].length => vec![cut - 1, cut + 1],
            whole => vec![whole],
        };
        let rows = |one: &Parameter| one.fields.iter().flat_map(of_element).collect();
        let fit_parameters = kept
            .iter()
            .map(|&(at, field)| Group { elements: rows(&self.parameters[at]), field: field.into() })
            .collect();
        let [first, last] = &self.values;
        let of = |values: &[f64]| json!(kept.iter().map(|&(at, _)| values[at]).collect::<Vec<_>>());
        let mut rest = Map::new();
        rest.insert("values_start".into(), of(first));
        rest.insert("values_final".into(), of(last));
        rest.extend(self.chi_square()?.map(|all| ("chi2_per_iteration".to_owned(), all)));
        for (place, name, word) in [
            (monitors, "HBPMGain", "bpm_gain_x"),
            (monitors, "VBPMGain", "bpm_gain_y"),
            (correctors, "HCMKicks", "corrector_kick_x_mrad"),
            (correctors, "VCMKicks", "corrector_kick_y_mrad"),
        ] {
            let last = place.field_of(place.elements()?.len() - 1, name);
            let numbers = last.map(|list| list.numbers()).transpose()?;
            rest.extend(numbers.map(|numbers| (word.to_owned(), json!(numbers))));
        }
        Ok(Some(ReferenceFit { fit_parameters, flags: options(flags)?, rest }))
    }

    /// Of each iteration that states it.
    fn chi_square(&self) -> Result<Option<Value>, MeasuredError> {
        let Some(models) = self.models.as_ref().filter(|one| !one.value.is_empty()) else { return Ok(None) };
        let all = (0..models.elements()?.len()).filter_map(|at| models.field_of(at, "ChiSquare"));
        let all = all.map(|one| one.number()).collect::<Result<Vec<_>, _>>()?;
        Ok((!all.is_empty()).then(|| json!(all)))
    }
}

fn options(flags: &Place) -> Result<Flags, MeasuredError> {
    let last = flags.elements()?.len().saturating_sub(1);
    let word = |name: &str| {
        let place = flags.field_of(last, name)?;
        match place.value {
            Mat::Text(text) => Some(text.clone()),
            Mat::Numbers(_, values) if values.len() == 1 => Some(general(values[0])),
            _ => None,
        }
    };
    // where LOCO has none it takes these
    let [coupling, dispersion] =
        [("Coupling", "No"), ("Dispersion", "Yes")].map(|(name, usual)| word(name).unwrap_or(usual.into()));
    let rest = FLAGS.into_iter().filter_map(|name| Some((name.to_owned(), json!(word(name)?)))).collect();
    Ok(Flags { coupling, dispersion, rest })
}

/// A number as `%g` of C and Matlab writes it.
fn general(number: f64) -> String {
    let text = format!("{number:e}");
    match text.split_once('e').and_then(|(digits, power)| Some((digits, power.parse::<i32>().ok()?))) {
        Some((digits, power)) if !(-4..15).contains(&power) => {
            format!("{digits}e{}{:02}", if power < 0 { '-' } else { '+' }, power.abs())
        }
        _ => number.to_string(),
    }
}

/// Give the lattice the strengths that the fit began at; says how many parameters are neither gradients nor skew gradients, and stay as they are.
pub(super) fn start(fit: &LocoFit, document: &mut Value) -> Result<usize, MeasuredError> {
    let mut others = 0;
    for (one, value) in fit.parameters.iter().zip(&fit.values[0]) {
        if one.word(*value).is_none() {
            others += 1;
            continue;
        }
        for field in &one.fields {
            let Some(factor) = field.factor else { continue };
            set(&mut document["elements"][field.element][field.name.as_str()], field.index, factor * value);
        }
    }
    Ok(others)
}

/// A number, or one of a list, which grows as Matlab's do.
fn set(field: &mut Value, index: usize, value: f64) {
    match field {
        Value::Array(list) => {
            list.resize(list.len().max(index + 1), json!(0.0));
            list[index] = json!(value);
        }
        field if index == 0 => *field = json!(value),
        field => *field = json!([vec![0.0; index], vec![value]].concat()),
    }
}

fn parameter(place: &Place, length: usize) -> Result<Parameter, MeasuredError> {
    let fields = (0..place.elements()?.len()).map(|at| {
        let element = place.need_of(at, "ElemIndex")?.places(length, "an element of RINGData.Lattice")?;
        let name = place.need_of(at, "FieldName")?;
        let Some(text) = name.text() else { return Err(name.expected("the name of a field")) };
        let index = place.field_of(at, "FieldIndex").map(|one| one.elements()).transpose()?.unwrap_or_default();
        let index = index.last().map(Place::number).transpose()?.unwrap_or(1.0);
        match element.as_slice() {
            &[element] => Ok(Field {
                element,
                name: text.into(),
                index: (index as usize).saturating_sub(1),
                factor: factor(place, at)?,
            }),
            _ => Err(place.wrong(&format!("struct {}: expected one ElemIndex, found {}", at + 1, element.len()))),
        }
    });
    Ok(Parameter { fields: fields.collect::<Result<_, _>>()? })
}

/// What the value is multiplied by: `inline('x')`, or `inline('a*x')` with its argument.
fn factor(place: &Place, at: usize) -> Result<Option<f64>, MeasuredError> {
    let function = place.need_of(at, "Function")?;
    let expression = function.field("expr").unwrap_or(function);
    match expression.text().map(str::trim) {
        Some("x") => Ok(Some(1.0)),
        Some("a*x") => {
            let arguments = place.need_of(at, "Args")?.elements()?;
            Ok(Some(arguments.first().ok_or_else(|| place.wrong("Args: expected the factor of a*x"))?.number()?))
        }
        _ => Ok(None),
    }
}
