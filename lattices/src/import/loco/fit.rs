//! `FitParameters` of a LOCO file: the strengths that the fit began at, and what it found.
//!
//! A parameter is a struct array, one struct a field of an element (`ElemIndex`, `FieldName`, `FieldIndex`), with the function that makes the field of
//! the parameter's value: `x`, or `a*x` where magnets keep a ratio.
//!
//! Source: `mkparamgroup.m` and `setparamgroup.m` of the Accelerator Toolbox.

use std::collections::HashMap;

use serde_json::{Map, Value, json};

use crate::import::at;
use crate::import::element::Lattice;
use crate::import::mat::{Mat, MatFile, Place};
use measured::MeasuredError;
use measured::folder::{Flags, Folder, Group, ReferenceFit};

/// Words of `LocoFlags` that are kept.
const FLAGS: [&str; 3] = ["SVmethod", "OutlierFactor", "ClosedOrbitType"];
/// More than a list of multipoles has.
const MOST: f64 = 100.0;

/// The fit's parameters.
pub(super) struct LocoFit<'a> {
    parameters: Vec<Parameter>,
    /// Values at the start.
    start: Vec<f64>,
    /// What the fit found; none where it found no numbers.
    end: Option<Vec<f64>>,
    models: Option<Place<'a>>,
    flags: Option<Place<'a>>,
    /// Number of elements of the lattice.
    pub length: usize,
    /// What of the parameters is not fitted here, once for each.
    pub left_out: Vec<&'static str>,
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

/// Left out: what is no gradient.
const OTHER: &str = "a parameter of LOCO's fit that is neither a gradient nor a skew gradient, or one of magnets in unlike ratios that starts at 0 (it stays as fitted)";
/// Left out: LOCO sets the parameters in their order.
const OVERWRITTEN: &str = "a parameter of LOCO's fit whose magnets a later one sets (the later one is fitted)";
/// Left out: AT tracks no field of it.
const WITHOUT_EFFECT: &str =
    "a parameter of LOCO's fit of elements that are tracked without a field (nothing follows it)";

impl Field {
    /// `K` of a gradient, `PolynomA` of a skew gradient.
    fn word(&self) -> Option<&'static str> {
        match (self.name.as_str(), self.index) {
            ("K", 0) | ("PolynomB", 1) => Some("K"),
            ("PolynomA", 1) => Some("PolynomA"),
            _ => None,
        }
    }

    /// True where the element is tracked with the field; a gradient without a length is no magnet that the twin has.
    fn has_effect(&self, elements: &[Value]) -> bool {
        let element = &elements[self.element];
        let is_thin = || element.get("Length").and_then(Value::as_f64).unwrap_or(0.0) <= 0.0;
        self.word().is_none_or(|word| !(at::is_off(element) || word == "K" && is_thin()))
    }
}

impl Parameter {
    /// The word of its fields; none for anything else, and for gradients in unlike ratios that start at 0 and lose them.
    fn word(&self, start: f64) -> Option<&'static str> {
        let first = self.fields.first()?.word()?;
        let is_like = |one: &Field| one.factor.is_some() && one.word() == Some(first);
        let are_alike = || self.fields.iter().all(|one| one.factor == self.fields[0].factor);
        (self.fields.iter().all(is_like) && (start != 0.0 || are_alike())).then_some(first)
    }
}

impl<'a> LocoFit<'a> {
    /// Of a file with a lattice; empty where it was not fitted.
    pub fn of(file: &'a MatFile, document: &Value) -> Result<Self, MeasuredError> {
        let elements = document["elements"].as_array().map_or(&[][..], Vec::as_slice);
        let mut fit = Self {
            parameters: Vec::new(),
            start: Vec::new(),
            end: None,
            models: file.variable("LocoModel"),
            flags: file.variable("LocoFlags"),
            length: elements.len(),
            left_out: Vec::new(),
        };
        let Some(all) = file.variable("FitParameters").filter(|all| !all.value.is_empty()) else { return Ok(fit) };
        // an iteration that was only prepared is empty, and numbers in place of Params are NaN
        let mut iterations = all.elements()?;
        iterations.retain(|one| {
            one.field("Values").is_some()
                && one.field("Params").is_some_and(|params| !matches!(params.value, Mat::Numbers(..)))
        });
        let (Some(first), Some(last)) = (iterations.first(), iterations.last()) else { return Ok(fit) };
        let params = first.need("Params")?;
        // one struct a parameter where there are as many, else all of them are one
        let each = params.elements()?;
        let is_list = matches!(params.value, Mat::Cells(..)) || first.need("Values")?.numbers()?.len() == each.len();
        let each = if is_list { each } else { vec![params] };
        let parameters = each.iter().map(|one| parameter(one, fit.length)).collect::<Result<Vec<_>, _>>()?;
        let start = first.need("Values")?.many(each.len(), "one a parameter of Params")?;
        if let Some((place, value)) = each.iter().zip(start).find(|(_, value)| !value.is_finite()) {
            return Err(place.wrong(&format!("starts at {value}")));
        }
        let end = finite(last.field("Values")).filter(|end| end.len() == each.len());
        fit.keep(parameters, start, end.as_deref(), elements);
        Ok(fit)
    }

    /// Parameters whose fields are their own, and act: LOCO sets them in their order, so that a field is that of the last one that has it.
    fn keep(&mut self, mut parameters: Vec<Parameter>, start: &[f64], end: Option<&[f64]>, elements: &[Value]) {
        let mut owner = HashMap::new();
        for (number, one) in parameters.iter().enumerate() {
            owner.extend(one.fields.iter().filter_map(|field| Some(((field.element, field.word()?), number))));
        }
        for (number, one) in parameters.iter_mut().enumerate() {
            let is_own = |field: &Field| field.word().is_none_or(|word| owner[&(field.element, word)] == number);
            let is_empty = one.fields.is_empty();
            one.fields.retain(is_own);
            let is_overwritten = one.fields.is_empty();
            one.fields.retain(|field| field.has_effect(elements));
            self.left_out.extend(match (is_empty, is_overwritten, one.fields.is_empty()) {
                (true, ..) => Some(OTHER),
                (_, true, _) => Some(OVERWRITTEN),
                (_, _, true) => Some(WITHOUT_EFFECT),
                _ => None,
            });
        }
        self.end = end.map(|_| Vec::new());
        for (number, one) in parameters.into_iter().enumerate().filter(|(_, one)| !one.fields.is_empty()) {
            if one.word(start[number]).is_none() {
                self.left_out.push(OTHER);
            }
            self.parameters.push(one);
            self.start.push(start[number]);
            self.end.iter_mut().zip(end).for_each(|(own, end)| own.push(end[number]));
        }
    }

    /// True of an element whose gradient is a parameter.
    pub fn has_gradient(&self, element: usize) -> bool {
        let words = self.parameters.iter().zip(&self.start).map(|(one, start)| (one, one.word(*start)));
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
    ) -> Option<ReferenceFit> {
        let words = self.parameters.iter().zip(&self.start).map(|(one, start)| one.word(*start));
        let kept: Vec<(usize, &'static str)> = words.enumerate().filter_map(|(at, word)| Some((at, word?))).collect();
        if kept.is_empty() {
            return None;
        }
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
        let of = |values: &[f64]| json!(kept.iter().map(|&(at, _)| values[at]).collect::<Vec<_>>());
        let mut rest = Map::new();
        rest.insert("values_start".into(), of(&self.start));
        rest.extend(self.end.as_deref().map(|end| ("values_final".to_owned(), of(end))));
        rest.extend(self.chi_square().map(|all| ("chi2_per_iteration".to_owned(), all)));
        for (place, name, word) in [
            (monitors, "HBPMGain", "bpm_gain_x"),
            (monitors, "VBPMGain", "bpm_gain_y"),
            (correctors, "HCMKicks", "corrector_kick_x_mrad"),
            (correctors, "VCMKicks", "corrector_kick_y_mrad"),
        ] {
            rest.extend(finite(place.last(name)).map(|numbers| (word.to_owned(), json!(numbers))));
        }
        Some(ReferenceFit { fit_parameters, flags: options(self.flags.as_ref()), rest })
    }

    /// Of each iteration that states it.
    fn chi_square(&self) -> Option<Value> {
        let models = self.models.as_ref()?.elements().ok()?;
        let all: Vec<f64> = models.iter().filter_map(|one| finite(one.field("ChiSquare"))).flatten().collect();
        (!all.is_empty()).then(|| json!(all))
    }
}

/// What a fit found, where that is numbers: one that went astray may have left others.
fn finite(place: Option<Place>) -> Option<Vec<f64>> {
    let numbers = place?.numbers().ok()?;
    numbers.iter().all(|one| one.is_finite()).then(|| numbers.to_vec())
}

/// Those of the last iteration that states each; LOCO's own where none does, `Yes` and `No` whatever their case.
fn options(flags: Option<&Place>) -> Flags {
    let word = |name: &str| {
        let place = flags?.last(name)?;
        match place.value {
            Mat::Text(text) => Some(text.trim().to_owned()),
            Mat::Numbers(_, values) if values.len() == 1 => Some(general(values[0])),
            _ => None,
        }
    };
    let is_yes = |name: &str, usual: &str| word(name).unwrap_or(usual.into()).eq_ignore_ascii_case("yes");
    let [coupling, dispersion] = [("Coupling", "No"), ("Dispersion", "Yes")]
        .map(|(name, usual)| if is_yes(name, usual) { "Yes".into() } else { "No".into() });
    let rest = FLAGS.into_iter().filter_map(|name| Some((name.to_owned(), json!(word(name)?)))).collect();
    Flags { coupling, dispersion, rest }
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

/// Give the lattice the strengths that the fit began at.
pub(super) fn start(fit: &LocoFit, document: &mut Value) {
    for (one, value) in fit.parameters.iter().zip(&fit.start).filter(|(one, value)| one.word(**value).is_some()) {
        for field in &one.fields {
            let Some(factor) = field.factor else { continue };
            set(&mut document["elements"][field.element][field.name.as_str()], field.index, factor * value);
        }
    }
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
    let mut fields = Vec::new();
    // nothing, where a family is not in the lattice
    let structs = if place.value.is_empty() { Vec::new() } else { place.structs()? };
    for one in structs.iter().filter(|one| one.field("ElemIndex").is_some()) {
        let name = one.need("FieldName")?;
        let Some(text) = name.text() else { return Err(name.expected("the name of a field")) };
        let (index, factor) = (index(one)?, factor(one)?);
        for element in one.need("ElemIndex")?.places(length, "an element of RINGData.Lattice")? {
            fields.push(Field { element, name: text.into(), index, factor });
        }
    }
    Ok(Parameter { fields })
}

/// Place in the list that a field is, from 0: `{1,2}` of a line, `{2,1}` of a column, or one number.
fn index(place: &Place) -> Result<usize, MeasuredError> {
    let Some(all) = place.field("FieldIndex") else { return Ok(0) };
    let numbers = match all.value {
        Mat::Numbers(_, numbers) => numbers.clone(),
        _ => all.elements()?.iter().map(Place::number).collect::<Result<_, _>>()?,
    };
    match numbers.iter().find(|one| one.fract() != 0.0 || !(1.0..=MOST).contains(*one)) {
        Some(wrong) => Err(all.wrong(&format!("expected whole numbers from 1 to {MOST}, found {wrong}"))),
        None => Ok(numbers.iter().map(|one| *one as usize - 1).sum()),
    }
}

/// What the value is multiplied by: `x`, `-x`, or `a*x` with `a` a number or the first argument; text or an inline function.
fn factor(place: &Place) -> Result<Option<f64>, MeasuredError> {
    let function = place.need("Function")?;
    let expression = function.field("expr").unwrap_or(function);
    let Some(text) = expression.text() else { return Ok(None) };
    let text = text.replace(char::is_whitespace, "").replace(".*", "*");
    let text = text.strip_prefix("@(x)").unwrap_or(&text);
    let factor = match text {
        "x" => return Ok(Some(1.0)),
        "-x" => return Ok(Some(-1.0)),
        text => text.strip_suffix("*x").or(text.strip_prefix("x*")),
    };
    match factor.map(|word| (word, word.parse::<f64>())) {
        Some((_, Ok(number))) => Ok(Some(number).filter(|one| one.is_finite())),
        Some((word, Err(_))) if word.chars().all(char::is_alphanumeric) => {
            let arguments = place.need("Args")?;
            let first = match arguments.value {
                Mat::Numbers(..) => arguments,
                _ => {
                    arguments.elements()?.into_iter().next().ok_or_else(|| place.wrong("Args: expected the factor"))?
                }
            };
            first.number().map(Some)
        }
        _ => Ok(None),
    }
}
