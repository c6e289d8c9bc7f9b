//! The names that a ring's recordings use for its instruments and supplies.

use std::borrow::Cow;
use std::collections::HashMap;

use twin::{Plane, Ring, Supply};

/// Supplies of a recording of format 1: that of all focusing quadrupoles, and that of all others.
pub(super) const FOCUSING: [&str; 2] = ["qh", "qv"];

/// Monitors, correctors and supplies of a ring by the names that a recording may use for them.
#[derive(Debug, Clone, PartialEq)]
pub struct Names {
    /// Monitors with their plane, `x_A6` [B].
    pub monitors: Vec<String>,
    /// Correctors, `A2` [C].
    pub correctors: Vec<String>,
    /// Supplies [F].
    pub supplies: Vec<String>,
    /// Index of a monitor or corrector by each of its names.
    monitor: HashMap<String, usize>,
    corrector: HashMap<String, usize>,
}

impl Names {
    /// A monitor is `x_` or `y_` and its label or its element's name; a corrector is its label if that is unique among all
    /// correctors, `H_` or `V_` and its label, or its element's name.
    pub fn from_ring(ring: &Ring) -> Self {
        let mut names = Self {
            monitors: ring.monitor_names(),
            correctors: Vec::new(),
            supplies: ring.supplies.iter().map(|supply| supply.name.clone()).collect(),
            monitor: HashMap::new(),
            corrector: HashMap::new(),
        };
        for (b, (own, &at)) in ring.monitor_names().into_iter().zip(&ring.read_monitors).enumerate() {
            let axis = if ring.monitors[at].plane == Plane::X { "x" } else { "y" };
            names.monitor.insert(own, b);
            names.monitor.insert(format!("{axis}_{}", ring.elements[ring.monitors[at].element].name), b);
        }
        let label = |c: usize| ring.label(ring.correctors[c].element);
        for (c, with_plane) in ring.corrector_names().into_iter().enumerate() {
            let unique = (0..ring.correctors.len()).all(|other| other == c || label(other) != label(c));
            names.correctors.push(if unique { label(c).to_owned() } else { with_plane.clone() });
            let element = ring.correctors[c].element;
            let alone = ring.correctors.iter().filter(|corrector| corrector.element == element).count() == 1;
            if alone {
                names.corrector.insert(ring.elements[element].name.clone(), c);
            }
            names.corrector.insert(with_plane, c);
        }
        // a short name wins over another element's long one
        names.corrector.extend(names.correctors.iter().cloned().zip(0..));
        names
    }

    /// Index of a corrector by any of its names.
    pub fn corrector(&self, name: &str) -> Option<usize> {
        self.corrector.get(name).copied()
    }

    /// Index of a monitor by any of its names.
    pub fn monitor(&self, name: &str) -> Option<usize> {
        self.monitor.get(name).copied()
    }

    /// A column's name as this ring's recordings write it.
    pub fn canonical(&self, column: &str) -> String {
        let corrector = column.strip_prefix("ic_").and_then(|rest| self.corrector(rest.strip_suffix("_A")?));
        let monitor = column.strip_suffix("_mm").and_then(|name| self.monitor(name));
        match (corrector, monitor) {
            (Some(c), _) => self.corrector_column(c),
            (_, Some(b)) => self.monitor_column(b),
            _ => column.to_owned(),
        }
    }

    /// Column of a corrector's read-back.
    pub fn corrector_column(&self, c: usize) -> String {
        format!("ic_{}_A", self.correctors[c])
    }

    /// Column of a monitor's readings.
    pub fn monitor_column(&self, b: usize) -> String {
        format!("{}_mm", self.monitors[b])
    }
}

/// Which of [`FOCUSING`] feeds each supply in a recording of format 1 [F]: that of its quadrupoles' sign.
pub(super) fn feeds(ring: &Ring) -> Vec<usize> {
    let gradients = ring.gradients();
    let focuses =
        |supply: usize| (ring.quadrupoles.iter().zip(&gradients)).any(|(q, k)| q.supply == Some(supply) && *k > 0.0);
    (0..ring.supplies.len()).map(|supply| usize::from(!focuses(supply))).collect()
}

/// The ring as a recording of format 1 powers it: every quadrupole by the supply of its sign.
///
/// That is the ring itself where each supply feeds quadrupoles of one sign and none is in series with the dipoles.
pub(super) fn by_focusing(ring: &Ring) -> Cow<'_, Ring> {
    let (gradients, feeds) = (ring.gradients(), feeds(ring));
    let own = |k1: f64| usize::from(k1 <= 0.0);
    let fits = |supply: Option<usize>, k1: f64| supply.is_some_and(|supply| feeds[supply] == own(k1));
    if ring.quadrupoles.iter().zip(&gradients).all(|(q, k1)| fits(q.supply, *k1)) {
        return Cow::Borrowed(ring);
    }
    let mut powered = ring.clone();
    powered.supplies = FOCUSING.map(|name| Supply { name: name.into() }).to_vec();
    for (quadrupole, k1) in powered.quadrupoles.iter_mut().zip(&gradients) {
        quadrupole.supply = Some(own(*k1));
    }
    Cow::Owned(powered)
}
