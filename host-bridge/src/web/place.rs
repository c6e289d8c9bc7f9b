//! Where vars and instruments are along the ring, for the page.

use serde::Serialize;
use twin::Ring;

/// Where the vars and instruments are along the ring, in the order of records.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Place {
    /// The machine.
    machine: String,
    /// [m]
    circumference: f64,
    vars: Vec<Spot>,
    monitors: Vec<Spot>,
    correctors: Vec<Spot>,
}

#[derive(Debug, Clone, Serialize)]
struct Spot {
    name: String,
    /// Middles of the magnets [m]: those of a family are several.
    s: Vec<f64>,
}

impl Place {
    /// Of a ring.
    pub fn of(ring: &Ring) -> Self {
        let middle = |element: usize| ring.elements[element].s + 0.5 * ring.elements[element].length;
        let spot = |(name, s): (String, Vec<f64>)| Spot { name, s };
        let of_var =
            |var: &twin::Parameter| var.quadrupoles.iter().map(|&q| middle(ring.quadrupoles[q].element)).collect();
        let vars: Vec<Vec<f64>> = ring.parameters.iter().map(of_var).collect();
        let monitors = ring.monitors_read().map(|monitor| vec![middle(monitor.element)]);
        let correctors = ring.correctors.iter().map(|corrector| vec![middle(corrector.element)]);
        Self {
            machine: ring.name.clone(),
            circumference: ring.circumference,
            vars: ring.var_names().into_iter().zip(vars).map(spot).collect(),
            monitors: ring.monitor_names().into_iter().zip(monitors).map(spot).collect(),
            correctors: ring.corrector_names().into_iter().zip(correctors).map(spot).collect(),
        }
    }

    /// Names of the vars.
    pub(super) fn vars(&self) -> impl Iterator<Item = &String> {
        self.vars.iter().map(|spot| &spot.name)
    }

    /// Number of a var.
    pub(super) fn var(&self, name: &str) -> Option<usize> {
        self.vars.iter().position(|spot| spot.name == name)
    }
}
