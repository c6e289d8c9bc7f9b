//! What the file of a matrix says of its numbers: unit of the orbit, size of the kicks, order of lines and columns.

use super::instruments::Order;

/// Unit of the orbit in the matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OrbitUnit {
    /// Metres.
    Metres,
    /// Millimetres.
    Millimetres,
    /// Micrometres.
    Micrometres,
}

impl OrbitUnit {
    /// Its size [mm].
    pub(super) fn millimetres(self) -> f64 {
        match self {
            Self::Metres => 1e3,
            Self::Millimetres => 1.0,
            Self::Micrometres => 1e-3,
        }
    }
}

/// Which change of the kick a column of the matrix belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KickIs {
    /// The whole change between the two orbits: from 0 to the kick, or from minus to plus half of it.
    Full,
    /// Half of it: the orbits are at plus and at minus the kick.
    Half,
}

/// What a file says of its own matrix.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Stated {
    /// Unit of the orbit.
    pub unit: Option<OrbitUnit>,
    /// Deflection that an element belongs to [mrad].
    pub kick: Option<f64>,
    /// Which change that is.
    pub kick_is: Option<KickIs>,
    /// Order of lines and columns, which have no names.
    pub order: Option<Order>,
}

impl Stated {
    /// By the words of a unit such as `mm/radian`, in small letters; what an ampere deflects by stands elsewhere.
    pub(super) fn of_units(units: &str) -> Self {
        let (orbit, kick) = units.split_once('/').unwrap_or((units, ""));
        let unit = match orbit.trim() {
            "m" | "meter" | "meters" => Some(OrbitUnit::Metres),
            "mm" | "millimeter" | "millimeters" => Some(OrbitUnit::Millimetres),
            "um" | "micron" | "microns" | "micrometer" => Some(OrbitUnit::Micrometres),
            _ => None,
        };
        let kick = match kick.trim() {
            "rad" | "radian" | "radians" => Some(1e3),
            "mrad" | "milliradian" | "milliradians" => Some(1.0),
            "urad" | "microradian" | "microradians" => Some(1e-3),
            _ => None,
        };
        Self { unit, kick, kick_is: kick.map(|_| KickIs::Full), order: None }
    }
}
