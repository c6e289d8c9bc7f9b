//! Files of Matlab, Octave and `scipy.io.savemat`: their variables, with the place of each value in every error.

mod level5;
mod level73;
mod place;

pub(super) use place::Place;

use measured::MeasuredError;

/// Dimensions of an array; the first runs fastest.
pub(super) type Shape = Vec<usize>;

/// What a number takes here, and in the document of a lattice [B].
const NUMBER: u64 = 40;
/// The same of a value beside its numbers, with its name in each struct.
const VALUE: u64 = 300;

/// A value of a file.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Mat {
    /// Numbers or logicals, the first dimension running fastest; of complex ones the real parts.
    Numbers(Shape, Vec<f64>),
    /// Characters, the lines of a matrix of them joined.
    Text(String),
    /// A cell array.
    Cells(Shape, Vec<Mat>),
    /// A struct array, or an object of the kind that is a struct: names of the fields, and one value a field of each.
    Structs(Shape, Vec<String>, Vec<Vec<Mat>>),
    /// What nothing here needs, by its class: sparse matrices, function handles, objects.
    Other(&'static str),
}

impl Mat {
    /// What it is, for an error.
    pub fn words(&self) -> String {
        let by = |shape: &Shape| shape.iter().map(usize::to_string).collect::<Vec<_>>().join("x");
        match self {
            Self::Numbers(shape, _) => format!("{} numbers", by(shape)),
            Self::Text(text) => format!("the text {:?}", text.chars().take(40).collect::<String>()),
            Self::Cells(shape, _) => format!("{} cells", by(shape)),
            Self::Structs(shape, _, _) => format!("a {} struct", by(shape)),
            Self::Other(class) => format!("a {class}"),
        }
    }

    /// An array without elements, which Matlab has for a field of nothing.
    pub fn is_empty(&self) -> bool {
        match self {
            Self::Numbers(_, values) => values.is_empty(),
            Self::Text(text) => text.is_empty(),
            Self::Cells(_, values) => values.is_empty(),
            Self::Structs(_, _, values) => values.is_empty(),
            Self::Other(_) => false,
        }
    }
}

/// The variables of a file.
#[derive(Debug)]
pub(super) struct MatFile {
    /// Name of the file.
    pub file: String,
    /// By name, in the order of the file.
    pub variables: Vec<(String, Mat)>,
}

impl MatFile {
    /// True where the bytes begin as such a file does.
    pub fn is_one(bytes: &[u8]) -> bool {
        bytes.starts_with(b"MATLAB ")
    }

    /// Read its bytes.
    ///
    /// # Errors
    /// [`MeasuredError::Table`]: the file is cut off or is not what it says.
    pub fn of(file: &str, bytes: Vec<u8>) -> Result<Self, MeasuredError> {
        let variables = if level73::is_one(&bytes) { level73::variables(bytes) } else { level5::variables(&bytes) };
        match variables {
            Ok(variables) => Ok(Self { file: file.into(), variables }),
            Err(problem) => Err(MeasuredError::Table { file: file.into(), problem }),
        }
    }

    /// A variable.
    pub fn variable<'a>(&'a self, name: &'a str) -> Option<Place<'a>> {
        let (_, value) = self.variables.iter().find(|(own, _)| own == name)?;
        Some(Place::of(&self.file, name, value))
    }

    /// Names and kinds of the variables, for an error.
    pub fn words(&self) -> String {
        let all = self.variables.iter().take(12).map(|(name, value)| format!("{name} ({})", value.words()));
        all.collect::<Vec<_>>().join(", ")
    }
}

#[cfg(test)]
mod tests {
    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};

    use super::*;

    #[test]
    fn every_kind_of_value_of_octave_is_read() {
        let bytes = include_bytes!("../../../../recordings/measured/imports/values.octave.mat");
        let file = MatFile::of("file", bytes.to_vec()).unwrap();
        let value = |name| file.variable(name).unwrap();
        assert_eq!(value("i8").value, &Mat::Numbers(vec![2, 2], vec![1.0, 3.0, 2.0, 4.0]));
        assert_eq!(value("c").text(), Some("abcd"));
        assert_eq!(value("s").value, &Mat::Other("sparse matrix"));
        assert_eq!(value("w").number().unwrap(), 1.0);
        assert!(value("z").value.is_empty() && value("e").value.is_empty());
        let second = value("P").field_of(1, "Function").unwrap();
        assert_eq!(second.field("expr").unwrap().text(), Some("a*x"));
        assert_eq!(value("P").need_of(1, "ElemIndex").unwrap().number().unwrap(), 4.0);
    }

    #[test]
    fn structs_and_cells_of_level_7_3_are_read() {
        let bytes = include_bytes!("../../../../recordings/measured/imports/values.v73.mat");
        let file = MatFile::of("file", bytes.to_vec()).unwrap();
        let value = |name| file.variable(name).unwrap();
        assert_eq!(value("i8").value, &Mat::Numbers(vec![2, 2], vec![1.0, 3.0, 2.0, 4.0]));
        let numbers = Mat::Numbers(vec![1, 2], vec![1.0, 2.0]);
        assert_eq!(value("c").value, &Mat::Cells(vec![1, 2], vec![numbers, Mat::Text("text".into())]));
        assert!(value("z").value.is_empty());
        assert_eq!(value("s").need("a").unwrap().number().unwrap(), 1.5);
        assert_eq!(value("P").need_of(1, "ElemIndex").unwrap().number().unwrap(), 4.0);
        assert_eq!(value("P").need_of(1, "FieldName").unwrap().text(), Some("PolynomB"));
    }

    #[test]
    fn no_byte_of_level_7_3_makes_it_panic() {
        let whole = include_bytes!("../../../../recordings/measured/imports/values.v73.mat");
        let mut random = StdRng::seed_from_u64(7);
        for _ in 0..1500 {
            let mut bytes = whole.to_vec();
            for _ in 0..random.random_range(1..4) {
                let at = random.random_range(512..bytes.len());
                bytes[at] = if random.random() { 0xff } else { random.random() };
            }
            if random.random_range(0..4) == 0 {
                bytes.truncate(random.random_range(520..whole.len()));
            }
            drop(MatFile::of("file", bytes));
        }
    }

    #[test]
    fn what_is_wrong_is_said_with_its_place() {
        let bytes = include_bytes!("../../../../recordings/measured/imports/values.octave.mat");
        let file = MatFile::of("file", bytes.to_vec()).unwrap();
        let groups = file.variable("P").unwrap();
        assert_eq!(
            groups.need_of(1, "Args").unwrap_err().to_string(),
            "file: P: no field Args, or nothing in it; found ElemIndex, Function"
        );
        let second = groups.need_of(1, "ElemIndex").unwrap();
        assert_eq!(
            second.many(3, "one a plane").unwrap_err().to_string(),
            "file: P(2).ElemIndex: expected 3 numbers, one a plane, found 1x1 numbers"
        );
        assert_eq!(
            second.places(3, "an element").unwrap_err().to_string(),
            "file: P(2).ElemIndex: number 1: expected an element, 1 to 3, found 4"
        );
    }
}
