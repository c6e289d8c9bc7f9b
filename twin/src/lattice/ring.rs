//! A ring: its elements, and which of them are read, set, powered and fitted.

use core::ops::AddAssign;

use super::{Currents, Element, Kind, LatticeError, Parameter, Particle, Plane, Quadrupole, RampPoint, Supply};

/// One plane of a beam position monitor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Monitor {
    /// Index of its element.
    pub element: usize,
    /// The plane.
    pub plane: Plane,
}

/// One plane of a steering magnet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Corrector {
    /// Index of its element.
    pub element: usize,
    /// The plane.
    pub plane: Plane,
}

/// A ring: elements in beam order without gaps, and the lists in whose order every array of the program is.
#[derive(Debug, Clone)]
pub struct Ring {
    /// Name of the machine.
    pub name: String,
    /// Name of the file it was read from, without its folder.
    pub file: String,
    /// Length of the reference orbit [m].
    pub circumference: f64,
    /// Elements in beam order; gaps are filled with drifts.
    pub elements: Vec<Element>,
    /// Reference particle.
    pub particle: Particle,
    /// Energy and nominal currents along the ramp, in the order of time; none of a machine that is always at its reference energy.
    pub ramp: Vec<RampPoint>,
    /// The supply law, where the machine file states it.
    pub currents: Option<Currents>,
    /// All quadrupoles `[M]`: focusing ones in beam order, then the others.
    pub quadrupoles: Vec<Quadrupole>,
    /// Main supplies of quadrupoles `[F]`, in the order of their first quadrupole; that of the dipoles is not among them.
    pub supplies: Vec<Supply>,
    /// What is fitted `[N]`, in the order of their first quadrupole.
    pub parameters: Vec<Parameter>,
    /// All monitors, one for each plane: horizontal in beam order, then vertical.
    pub monitors: Vec<Monitor>,
    /// The monitors that are read `[B]`, indices into `monitors`: horizontal ones, then vertical.
    pub read_monitors: Vec<usize>,
    /// All correctors `[C]`, one for each plane: horizontal in beam order, then vertical.
    pub correctors: Vec<Corrector>,
}

impl Ring {
    /// Distance of two places along the ring, the shorter way round [m].
    pub fn distance(&self, s: f64, other: f64) -> f64 {
        let along = (s - other).rem_euclid(self.circumference);
        along.min(self.circumference - along)
    }

    /// Index of the element of this exact name.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn element(&self, name: &str) -> Result<usize, LatticeError> {
        self.found("element", name, self.elements.iter().position(|e| e.name == name))
    }

    /// Index into [`Ring::monitors`] of a monitor by plane and by label or name.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn monitor(&self, plane: Plane, name: &str) -> Result<usize, LatticeError> {
        let what = if plane == Plane::X { "horizontal monitor" } else { "vertical monitor" };
        let is = |m: &Monitor| m.plane == plane && self.elements[m.element].is_called(name);
        self.found(what, name, self.monitors.iter().position(is))
    }

    /// Index into [`Ring::correctors`] of a corrector by plane and by label or name.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn corrector(&self, plane: Plane, name: &str) -> Result<usize, LatticeError> {
        let what = if plane == Plane::X { "horizontal corrector" } else { "vertical corrector" };
        let is = |c: &Corrector| c.plane == plane && self.elements[c.element].is_called(name);
        self.found(what, name, self.correctors.iter().position(is))
    }

    /// Index into [`Ring::quadrupoles`] of a quadrupole by label or name.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn quadrupole(&self, name: &str) -> Result<usize, LatticeError> {
        let is = |q: &Quadrupole| self.elements[q.element].is_called(name);
        self.found("quadrupole", name, self.quadrupoles.iter().position(is))
    }

    fn found(&self, what: &'static str, name: &str, at: Option<usize>) -> Result<usize, LatticeError> {
        at.ok_or_else(|| LatticeError::NoSuchPlace { what, name: name.into(), machine: self.name.clone() })
    }

    /// Short name of an element.
    pub fn label(&self, element: usize) -> &str {
        &self.elements[element].label
    }

    /// Short names of elements.
    pub fn labels(&self, elements: impl IntoIterator<Item = usize>) -> Vec<String> {
        elements.into_iter().map(|element| self.label(element).to_owned()).collect()
    }

    /// Names of the params `[N]`.
    pub fn var_names(&self) -> Vec<String> {
        self.parameters.iter().map(|parameter| parameter.name.clone()).collect()
    }

    /// Names of the monitors that are read `[B]`, with their plane: `x_A6` ... `y_F7`.
    pub fn monitor_names(&self) -> Vec<String> {
        self.read_monitors.iter().map(|&monitor| self.monitor_name(monitor)).collect()
    }

    /// Name of one monitor, with its plane.
    pub fn monitor_name(&self, monitor: usize) -> String {
        let Monitor { element, plane } = self.monitors[monitor];
        format!("{}_{}", if plane == Plane::X { "x" } else { "y" }, self.label(element))
    }

    /// Names of all correctors `[C]` with their plane: `H_A2` ... `V_F7`.
    pub fn corrector_names(&self) -> Vec<String> {
        (0..self.correctors.len()).map(|corrector| self.corrector_name(corrector)).collect()
    }

    /// Name of one corrector, with its plane.
    pub fn corrector_name(&self, corrector: usize) -> String {
        let Corrector { element, plane } = self.correctors[corrector];
        format!("{}_{}", if plane == Plane::X { "H" } else { "V" }, self.label(element))
    }

    /// The monitors that are read, in their order.
    pub fn monitors_read(&self) -> impl ExactSizeIterator<Item = Monitor> {
        self.read_monitors.iter().map(|&monitor| self.monitors[monitor])
    }

    /// How many of the monitors that are read are horizontal; they come first.
    pub fn horizontal_monitors(&self) -> usize {
        self.monitors_read().filter(|monitor| monitor.plane == Plane::X).count()
    }

    /// How many of the correctors are horizontal; they come first.
    pub fn horizontal_correctors(&self) -> usize {
        self.correctors.iter().filter(|corrector| corrector.plane == Plane::X).count()
    }

    /// Gradient of each quadrupole `[M]` [1/m^2].
    pub fn gradients(&self) -> Vec<f64> {
        self.quadrupoles.iter().map(|q| self.k1(q.element)).collect()
    }

    /// Integrated gradient K1L of each quadrupole `[M]` [1/m].
    pub fn integrated_gradients(&self) -> Vec<f64> {
        self.quadrupoles.iter().map(|q| self.k1(q.element) * self.elements[q.element].length).collect()
    }

    /// The params of horizontally focusing quadrupoles, by their first, and the others.
    pub fn params_by_focusing(&self) -> [Vec<usize>; 2] {
        let gradients = self.gradients();
        let focuses = |i: &usize| self.parameters[*i].quadrupoles.first().is_some_and(|&q| gradients[q] > 0.0);
        let (focusing, others) = (0..self.parameters.len()).partition(focuses);
        [focusing, others]
    }

    fn k1(&self, element: usize) -> f64 {
        match self.elements[element].kind {
            Kind::Quadrupole { k1 } => k1,
            _ => unreachable!("the list holds quadrupoles"),
        }
    }

    /// Factor on the gradient of each quadrupole `[M]` at params `ln` factor `[N]` and supplies `ln` strength `[F]`: `exp(param + supply)`;
    /// what is not given, or what a quadrupole does not have, is 0.
    pub fn strengths(&self, params: &[f64], supplies: &[f64]) -> Vec<f64> {
        let of = |list: &[f64], index: Option<usize>| index.and_then(|i| list.get(i)).copied().unwrap_or(0.0);
        self.quadrupoles.iter().map(|q| (of(params, q.parameter) + of(supplies, q.supply)).exp()).collect()
    }

    /// Derivative with respect to each param `[N]` of what has these derivatives with respect to `ln` of each quadrupole's
    /// gradient `[M]`: the sum over its quadrupoles.
    pub fn by_parameter<T: Clone + AddAssign>(&self, of_quadrupoles: &[T]) -> Vec<T> {
        let sum = |parameter: &Parameter| {
            let mut all = parameter.quadrupoles.iter().map(|&q| of_quadrupoles[q].clone());
            let mut sum = all.next().expect("a param scales at least one quadrupole");
            all.for_each(|slope| sum += slope);
            sum
        };
        self.parameters.iter().map(sum).collect()
    }

    /// The same ring with each quadrupole's gradient multiplied by its factor `[M]`.
    ///
    /// # Panics
    /// If there is not one factor for each quadrupole.
    pub fn with_strengths(&self, factors: &[f64]) -> Self {
        assert_eq!(factors.len(), self.quadrupoles.len(), "one factor for each quadrupole");
        let mut ring = self.clone();
        for (q, factor) in self.quadrupoles.iter().zip(factors) {
            ring.elements[q.element].kind = Kind::Quadrupole { k1: self.k1(q.element) * factor };
        }
        ring
    }

    /// The same ring with the gradients of each param's quadrupoles multiplied by its factor `[N]`.
    ///
    /// # Panics
    /// If there is not one factor for each param.
    pub fn with_vars(&self, vars: &[f64]) -> Self {
        assert_eq!(vars.len(), self.parameters.len(), "one var for each param");
        let factor = |q: &Quadrupole| q.parameter.map_or(1.0, |parameter| vars[parameter]);
        self.with_strengths(&self.quadrupoles.iter().map(factor).collect::<Vec<_>>())
    }

    /// Let a corrector kick [rad].
    pub fn set_kick(&mut self, corrector: usize, angle: f64) {
        let Corrector { element, plane } = self.correctors[corrector];
        match &mut self.elements[element].kind {
            Kind::Corrector { kick } => kick[plane.index()] = angle,
            _ => unreachable!("the list holds correctors"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_booster_closes_and_has_its_magnets() {
        let ring = Ring::booster();
        let length: f64 = ring.elements.iter().map(|e| e.length).sum();
        assert!((length - 201.78).abs() < 1e-8, "{length}"); // nine decimals in the file, 240 elements
        let angle: f64 = ring
            .elements
            .iter()
            .filter_map(|e| if let Kind::Bend(b) = &e.kind { Some(b.curvature * e.length) } else { None })
            .sum();
        assert!((angle - core::f64::consts::TAU).abs() < 1e-8);
        assert_eq!((ring.quadrupoles.len(), ring.correctors.len(), ring.read_monitors.len()), (48, 48, 33));
        assert_eq!((ring.horizontal_monitors(), ring.horizontal_correctors()), (15, 24));
        assert_eq!(ring.var_names()[0], "A2");
        assert_eq!(ring.var_names()[24], "A1");
        assert_eq!(ring.monitor_names()[5], "x_C6");
        assert_eq!(ring.corrector_names()[47], "V_F7");
        assert_eq!(ring.supplies.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["QH", "QV"]);
    }
}
