//! Why a machine file, or a place of its ring, is refused.

/// Why a machine file is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LatticeError {
    /// The file cannot be read.
    #[error("{path}: {}", reason(source))]
    Read {
        /// The file.
        path: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Not the JSON that docs/machine.md describes.
    #[error("{path}: {source}")]
    Syntax {
        /// The file.
        path: String,
        /// Position and reason.
        source: serde_json::Error,
    },
    /// An element starts before the one in front of it ends.
    #[error("element {name} starts at {start} m, before {before} ends at {end} m")]
    Overlap {
        /// The element.
        name: String,
        /// Its start [m].
        start: f64,
        /// The element in front.
        before: String,
        /// Where that one ends [m].
        end: f64,
    },
    /// The last element ends beyond the circumference.
    #[error("elements end at {end} m, beyond the circumference of {circumference} m")]
    TooLong {
        /// End of the last element [m].
        end: f64,
        /// Stated circumference [m].
        circumference: f64,
    },
    /// A field that is needed here is missing, or has a value that it cannot have.
    #[error("{name}: expected {field}, found {found}")]
    Field {
        /// The element, family or list.
        name: String,
        /// The field.
        field: &'static str,
        /// What stands there.
        found: String,
    },
    /// Two elements of one name.
    #[error("element {name}: a second element of this name, at {s} m")]
    Duplicate {
        /// The name.
        name: String,
        /// Where the second one starts [m].
        s: f64,
    },
    /// A stated label that is another element's label or name.
    #[error("element {name}: label {label:?} is taken by element {other}")]
    Label {
        /// The element.
        name: String,
        /// Its label.
        label: String,
        /// Who has it.
        other: String,
    },
    /// Two params of one name: a family fitted as one factor, and a quadrupole of that label.
    #[error("family {family}: fitted as one factor under this name, which is the label of quadrupole {quadrupole}")]
    ParameterName {
        /// The family.
        family: String,
        /// The quadrupole.
        quadrupole: String,
    },
    /// A length that this type of element cannot have.
    #[error("element {name}: expected {expected}, found a length of {found} m")]
    Length {
        /// The element.
        name: String,
        /// What it can have.
        expected: &'static str,
        /// What stands there [m].
        found: f64,
    },
    /// An unknown element type.
    #[error("element {name}: unknown type {found:?}")]
    Type {
        /// The element.
        name: String,
        /// The type it states.
        found: String,
    },
    /// A place that the machine does not have.
    #[error("no {what} {name:?} in {machine}")]
    NoSuchPlace {
        /// Sort of place.
        what: &'static str,
        /// The name that was asked for.
        name: String,
        /// The machine.
        machine: String,
    },
}

/// What the system says of a file that cannot be used, in the words of the program.
pub fn unreadable(error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::NotFound => "file not found".into(),
        std::io::ErrorKind::InvalidData => "expected UTF-8 text".into(),
        std::io::ErrorKind::FileTooLarge => error.to_string(),
        kind => kind.to_string(),
    }
}

/// The system's reason, in short where it is the usual one.
fn reason(error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::NotFound => "file not found".into(),
        _ => error.to_string(),
    }
}
