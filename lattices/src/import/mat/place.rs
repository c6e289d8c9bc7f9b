//! A value of a file and where it stands: `BPMData(1).HBPMIndex`.

use super::Mat;
use measured::MeasuredError;
use twin::limits::FINITE;

/// A value, with its place for errors.
#[derive(Debug, Clone)]
pub(in crate::import) struct Place<'a> {
    file: &'a str,
    path: String,
    /// The value.
    pub value: &'a Mat,
    /// Of a struct array, the element that fields are of.
    element: Option<usize>,
}

impl<'a> Place<'a> {
    /// A variable.
    pub fn of(file: &'a str, name: &str, value: &'a Mat) -> Self {
        Self { file, path: name.into(), value, element: None }
    }

    /// Elements of a cell array or a struct array, called by Matlab's numbers; a struct's are structs of one.
    pub fn elements(&self) -> Result<Vec<Self>, MeasuredError> {
        let count = match self.value {
            Mat::Cells(_, values) => values.len(),
            Mat::Structs(_, _, values) => values.len(),
            _ => return Err(self.expected("a cell array or a struct")),
        };
        Ok((0..count).map(|index| self.element(index)).collect())
    }

    fn element(&self, index: usize) -> Self {
        match self.value {
            Mat::Cells(_, values) => {
                Self { path: format!("{}{{{}}}", self.path, index + 1), value: &values[index], element: None, ..*self }
            }
            _ => Self { path: format!("{}({})", self.path, index + 1), element: Some(index), ..*self },
        }
    }

    /// Names of a struct's fields.
    pub fn names(&self) -> &'a [String] {
        if let Mat::Structs(_, names, _) = self.value { names } else { &[] }
    }

    /// A field of one element of a struct array; none where there is no such field, or nothing in it.
    pub fn field_of(&self, element: usize, name: &str) -> Option<Self> {
        let Mat::Structs(shape, names, values) = self.value else { return None };
        let at = names.iter().position(|own| own == name)?;
        let value = values.get(element)?.get(at).filter(|value| !value.is_empty())?;
        let is_array = self.element.is_none() && shape.iter().product::<usize>() > 1;
        let number = if is_array { format!("({})", element + 1) } else { String::new() };
        Some(Self { path: format!("{}{number}.{name}", self.path), value, element: None, ..*self })
    }

    /// A field of a struct of one, or of the element of an array that this is.
    pub fn field(&self, name: &str) -> Option<Self> {
        self.field_of(self.element.unwrap_or(0), name)
    }

    /// A field of the last element of a struct array that has something in it: LOCO adds an element an iteration, and the last may be empty.
    pub fn last(&self, name: &str) -> Option<Self> {
        let Mat::Structs(_, _, values) = self.value else { return None };
        (0..values.len()).rev().find_map(|at| self.field_of(at, name))
    }

    /// Structs of a cell array, of a struct array, or of cell arrays within each other.
    pub fn structs(&self) -> Result<Vec<Self>, MeasuredError> {
        if self.is_struct() {
            return Ok(vec![self.clone()]);
        }
        let each = self.elements()?.into_iter().map(|one| one.structs());
        Ok(each.collect::<Result<Vec<_>, _>>()?.concat())
    }

    /// True of one struct.
    pub fn is_struct(&self) -> bool {
        matches!(self.value, Mat::Structs(_, _, values) if self.element.is_some() || values.len() == 1)
    }

    /// The same, which must be there.
    pub fn need_of(&self, element: usize, name: &str) -> Result<Self, MeasuredError> {
        let missing = || self.wrong(&format!("no field {name}, or nothing in it; found {}", self.names().join(", ")));
        self.field_of(element, name).ok_or_else(missing)
    }

    /// The same of a struct of one.
    pub fn need(&self, name: &str) -> Result<Self, MeasuredError> {
        self.need_of(self.element.unwrap_or(0), name)
    }

    /// Numbers, the first dimension running fastest.
    pub fn numbers(&self) -> Result<&'a [f64], MeasuredError> {
        match self.value {
            Mat::Numbers(_, values) => Ok(values),
            _ => Err(self.expected("numbers")),
        }
    }

    /// As many numbers as there must be.
    pub fn many(&self, count: usize, of_what: &str) -> Result<&'a [f64], MeasuredError> {
        let found = self.numbers()?;
        if found.len() == count { Ok(found) } else { Err(self.expected(&format!("{count} numbers, {of_what}"))) }
    }

    /// One number.
    pub fn number(&self) -> Result<f64, MeasuredError> {
        match self.numbers()? {
            [one] => FINITE.check(*one).map_err(|problem| self.wrong(&problem)),
            _ => Err(self.expected("one number")),
        }
    }

    /// Numbers of Matlab, which begin with 1, as places below `length`.
    pub fn places(&self, length: usize, of_what: &str) -> Result<Vec<usize>, MeasuredError> {
        let place = |(at, number): (usize, &f64)| {
            let is_one = number.fract() == 0.0 && (1.0..=length as f64).contains(number);
            let problem = || format!("number {}: expected {of_what}, 1 to {length}, found {number}", at + 1);
            is_one.then(|| *number as usize - 1).ok_or_else(|| self.wrong(&problem()))
        };
        self.numbers()?.iter().enumerate().map(place).collect()
    }

    /// Text.
    pub fn text(&self) -> Option<&'a str> {
        if let Mat::Text(text) = self.value { Some(text) } else { None }
    }

    /// Rows and columns of a matrix.
    pub fn shape(&self) -> Option<[usize; 2]> {
        if let Mat::Numbers(shape, _) = self.value { shape.as_slice().try_into().ok() } else { None }
    }

    /// Something else stands here.
    pub fn expected(&self, what: &str) -> MeasuredError {
        self.wrong(&format!("expected {what}, found {}", self.value.words()))
    }

    /// A problem of this value.
    pub fn wrong(&self, problem: &str) -> MeasuredError {
        MeasuredError::Table { file: self.file.into(), problem: format!("{}: {problem}", self.path) }
    }
}
