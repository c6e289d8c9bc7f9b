//! Monitors and correctors of a lattice, and the names by which a table may call them.
//!
//! An element of a name that others have too is called by its number among them, as MAD-X does: `BPM[3]` is the third. A table says the plane in front
//! of the name, `x:BPM[3]`, where the element has both. An instrument that is chosen by another field of the file is called by that.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use twin::Plane;

use super::element::{Lattice, Role};
use super::pattern::Pattern;
use measured::MeasuredError;

/// An element that measures or kicks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instrument {
    /// Number of the element in the lattice, from 0.
    pub element: usize,
    /// Whether it does in x, in y.
    pub planes: [bool; 2],
}

/// Those of a lattice, in beam order.
#[derive(Debug, Clone)]
pub struct Instruments {
    /// Monitors.
    pub monitors: Vec<Instrument>,
    /// Correctors.
    pub correctors: Vec<Instrument>,
    /// Names of elements that were chosen by another field.
    pub called: BTreeMap<usize, String>,
}

/// What is looked for.
#[derive(Debug, Clone, Copy)]
struct Sought {
    word: &'static str,
    option: &'static str,
    example: &'static str,
    planes: fn(Role) -> Option<[bool; 2]>,
}

const MONITORS: Sought = Sought {
    word: "monitors",
    option: "--monitors",
    example: "'BPM*'",
    planes: |role| if let Role::Monitor(planes) = role { Some(planes) } else { None },
};
const CORRECTORS: Sought = Sought {
    word: "correctors",
    option: "--correctors",
    example: "'x:CH*'",
    planes: |role| if let Role::Corrector(planes) = role { Some(planes) } else { None },
};

impl Instruments {
    /// By patterns of their names, or by the types of the elements where there are no patterns.
    ///
    /// # Errors
    /// [`MeasuredError::Table`]: none were found, with the types of elements that were.
    pub fn choose(lattice: &Lattice, monitors: &[Pattern], correctors: &[Pattern]) -> Result<Self, MeasuredError> {
        let called = lattice.elements.iter().enumerate().filter_map(|(element, one)| {
            let name = monitors.iter().chain(correctors).find_map(|pattern| pattern.name(one))?;
            (name != one.name).then(|| (element, name.to_owned()))
        });
        Ok(Self {
            monitors: chosen(lattice, monitors, MONITORS)?,
            correctors: chosen(lattice, correctors, CORRECTORS)?,
            called: called.collect(),
        })
    }

    /// Names of the monitors in a table, all of x before all of y.
    pub fn monitor_names(&self, lattice: &Lattice) -> Vec<String> {
        labels(&self.monitors, &names(lattice, &self.called))
    }

    /// The same of the correctors.
    pub fn corrector_names(&self, lattice: &Lattice) -> Vec<String> {
        labels(&self.correctors, &names(lattice, &self.called))
    }
}

fn labels(of: &[Instrument], names: &[String]) -> Vec<String> {
    in_order(of, Order::Planes).into_iter().map(|channel| label(channel, names)).collect()
}

fn chosen(lattice: &Lattice, patterns: &[Pattern], sought: Sought) -> Result<Vec<Instrument>, MeasuredError> {
    let elements = || lattice.elements.iter().enumerate().filter(|(_, one)| one.role != Role::Ring);
    if let Some(idle) = patterns.iter().find(|pattern| elements().all(|(_, one)| pattern.name(one).is_none())) {
        let words: BTreeSet<&str> = elements().filter_map(|(_, one)| idle.word(one)).collect();
        let fields: BTreeSet<&str> = elements().flat_map(|(_, one)| one.words.keys()).map(String::as_str).collect();
        let some = |all: BTreeSet<&str>| all.into_iter().take(12).collect::<Vec<_>>().join(", ");
        let have = match words.is_empty() {
            true => format!("no element has the field; fields that are text are {}", some(fields)),
            false => format!("no element has such a name; there are {}", some(words)),
        };
        return lattice.refuse(format!("{} {}: {have}", sought.option, idle.text()));
    }
    let found = elements().filter_map(|(element, one)| {
        let of_type = (sought.planes)(one.role);
        let planes = match patterns {
            [] => of_type?,
            _ => joined(patterns.iter().filter_map(|pattern| pattern.name(one).map(|_| pattern.planes(of_type))))?,
        };
        Some(Instrument { element, planes })
    });
    let found: Vec<Instrument> = found.collect();
    if found.is_empty() {
        let kinds: Vec<String> = lattice.kinds().iter().map(|(kind, count)| format!("{count} {kind}")).collect();
        return lattice.refuse(format!(
            "no {} by the types of the elements ({}); name them with {} PATTERN, such as {}",
            sought.word,
            kinds.join(", "),
            sought.option,
            sought.example
        ));
    }
    Ok(found)
}

fn joined(all: impl Iterator<Item = [bool; 2]>) -> Option<[bool; 2]> {
    all.reduce(|one, other| [one[0] || other[0], one[1] || other[1]])
}

/// One plane of an instrument: its place among the elements, and the plane.
pub(super) type Channel = (usize, Plane);

/// Planes of an instrument, x first.
pub(super) fn planes(one: &Instrument) -> impl Iterator<Item = Plane> {
    [Plane::X, Plane::Y].into_iter().filter(|plane| one.planes[plane.index()])
}

/// In which order the lines or columns of a table without names stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// All of x in beam order, then all of y.
    Planes,
    /// x and y of each instrument in turn.
    Pairs,
}

/// All channels in an order.
pub(super) fn in_order(of: &[Instrument], order: Order) -> Vec<Channel> {
    let mut all: Vec<Channel> = of.iter().flat_map(|one| planes(one).map(|plane| (one.element, plane))).collect();
    if order == Order::Planes {
        all.sort_by_key(|(_, plane)| plane.index());
    }
    all
}

/// Names of the elements, some of which are called by another one: as they are where they are unique, else with their number among those of the name.
pub(super) fn names(lattice: &Lattice, called: &BTreeMap<usize, String>) -> Vec<String> {
    let names = lattice.elements.iter().enumerate().map(|(element, one)| called.get(&element).unwrap_or(&one.name));
    let mut totals: HashMap<&str, usize> = HashMap::new();
    names.clone().for_each(|name| *totals.entry(name).or_default() += 1);
    let mut seen: HashMap<&str, usize> = HashMap::new();
    let numbered = names.map(|name| {
        let number = seen.entry(name).or_default();
        *number += 1;
        if totals[name.as_str()] == 1 { name.clone() } else { format!("{name}[{number}]") }
    });
    numbered.collect()
}

/// Names of monitors and of correctors in a table, in the order in which the ring of the lattice has them.
pub fn table_names(lattice: &Lattice, instruments: &Instruments) -> [Vec<String>; 2] {
    [instruments.monitor_names(lattice), instruments.corrector_names(lattice)]
}

/// Name of a channel in a table: `x:BPM[3]`.
pub(super) fn label((element, plane): Channel, names: &[String]) -> String {
    format!("{}:{}", if plane == Plane::X { "x" } else { "y" }, names[element])
}

/// The channel that a table means by a name.
pub(super) fn channel(name: &str, of: &[Instrument], names: &[String]) -> Result<Channel, String> {
    let (plane, bare) = match name.split_at_checked(2) {
        Some(("x:", bare)) => (Some(Plane::X), bare),
        Some(("y:", bare)) => (Some(Plane::Y), bare),
        _ => (None, name),
    };
    let found = of.iter().find(|one| names[one.element].eq_ignore_ascii_case(bare));
    let Some(one) = found else {
        let some: Vec<String> =
            of.iter().flat_map(|one| planes(one).map(|plane| label((one.element, plane), names))).take(4).collect();
        return Err(format!("{name} is none of the lattice's, which are {} and so on", some.join(", ")));
    };
    match (plane, one.planes) {
        (Some(plane), has) if has[plane.index()] => Ok((one.element, plane)),
        (None, [true, false]) => Ok((one.element, Plane::X)),
        (None, [false, true]) => Ok((one.element, Plane::Y)),
        (None, _) => Err(format!("{name} has both planes; write x:{bare} or y:{bare}")),
        (Some(_), _) => Err(format!("{name}: the lattice has {bare} in the other plane only")),
    }
}
