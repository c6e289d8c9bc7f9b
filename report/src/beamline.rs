//! What stands along the beam, and what is to be marked there: the data of the maps and strips of a ring.

/// What a magnet or instrument looks like on the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Symbol {
    /// A bar along the path.
    Bend,
    /// A bar across the path that sticks out.
    Focusing,
    /// A bar across the path that sticks in.
    Defocusing,
    /// A dot outside the path.
    Monitor,
    /// A hollow dot outside the path.
    UnreadMonitor,
    /// A small triangle inside the path.
    Corrector,
    /// A small diamond on the path.
    Sextupole,
}

/// One magnet or instrument.
#[derive(Debug, Clone, PartialEq)]
pub struct Magnet {
    /// Its look.
    pub symbol: Symbol,
    /// Where it begins [m].
    pub s: f64,
    /// Its length [m].
    pub length: f64,
}

/// Something to point at.
#[derive(Debug, Clone, PartialEq)]
pub struct Spotted {
    /// What is written beside it.
    pub label: String,
    /// Where it is [m].
    pub s: f64,
    /// What it is.
    pub look: Look,
}

/// What is pointed at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Look {
    /// What was found: a filled square.
    Finding,
    /// What may be there instead: an open circle.
    Alternative,
    /// An instrument at fault: a cross.
    Faulty,
}

impl Look {
    /// In one word.
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Finding => "finding",
            Self::Alternative => "alternative",
            Self::Faulty => "faulty",
        }
    }
}

/// Magnets and instruments, and the places to mark in the figure above them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Strip {
    /// Magnets and instruments.
    pub magnets: Vec<Magnet>,
    /// Places that a line marks, labelled below.
    pub marks: Vec<Spotted>,
}
