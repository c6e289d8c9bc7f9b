//! The predicted matrix, and its derivative by everything that is fitted.
//!
//! With `G` the response of the orbit in both planes at every monitor to a kick in either plane at every corrector [m/rad], the matrix [mm] is
//!
//! `M = A G B`,
//!
//! `A` holding the gain of each reading and what it has of the other plane, `B` the kicks [mrad] in both planes. The last column, if the
//! dispersion was measured, is the change of the orbit with the RF frequency.

use nalgebra::{DMatrix, DVector};
use twin::{Hold, Kind as Field, Optics, Plane, Rf, Ring};

use crate::error::MeasuredError;
use crate::folder::Folder;
use crate::lattice::{parts, ring};
use crate::unknowns::{Kind, Magnets, Unknown};

/// The model of one measurement.
#[derive(Debug, Clone)]
pub struct Model {
    ring: Ring,
    rf: Rf,
    /// Relative step of the RF frequency.
    rf_step: f64,
    has_dispersion: bool,
    /// Elements of each group, with their gradients at the start; of a skew group the thin elements.
    strengths: Vec<Vec<(usize, f64)>>,
    skews: Vec<Vec<usize>>,
    /// Element of each monitor's row and of each corrector's column, with the plane.
    monitors: Vec<(usize, Plane)>,
    correctors: Vec<(usize, Plane)>,
    /// Kicks as believed [mrad].
    kicks: Vec<f64>,
}

/// A predicted matrix and its derivatives.
pub struct Prediction {
    /// The matrix [mm], with the dispersion as its last column.
    pub matrix: DMatrix<f64>,
    /// By strengths, then skew gradients, then the share of a held RF frequency, the same shape each.
    pub by_machine: Vec<DMatrix<f64>>,
    /// By the gain and by the coupling of the monitor of each row.
    pub by_monitor: [DMatrix<f64>; 2],
    /// By the gain and by the coupling of the corrector of each column, the last one by that of the scale of the RF step.
    pub by_corrector: [DMatrix<f64>; 2],
}

/// Gains and couplings of monitors and of correctors, the scale of the RF step, and the share of a held frequency.
struct Instruments {
    monitors: Vec<[f64; 2]>,
    correctors: Vec<[f64; 2]>,
    rf: f64,
    held_frequency: Option<f64>,
}

impl Model {
    /// Of a measurement with some groups of gradients and of skew gradients.
    ///
    /// # Errors
    /// [`MeasuredError::Lattice`].
    pub fn of(folder: &Folder, groups: &[Vec<Magnets>; 2], rf: Rf) -> Result<Self, MeasuredError> {
        let cut: Vec<usize> = groups[1].iter().flatten().copied().collect();
        let ring = ring(folder, &cut)?;
        let named = |row: usize| parts(&folder.element(row), cut.contains(&row));
        let mut strengths = Vec::new();
        for group in &groups[0] {
            let mut elements = Vec::new();
            for (name, k1) in
                group.iter().flat_map(|&row| named(row).0.into_iter().map(move |name| (name, folder.lattice[row].k1)))
            {
                elements.push((ring.element(&name)?, k1));
            }
            strengths.push(elements);
        }
        let mut skews = Vec::new();
        for group in &groups[1] {
            let thin = group.iter().filter_map(|&row| named(row).1).map(|name| ring.element(&name));
            skews.push(thin.collect::<Result<Vec<_>, _>>()?);
        }
        let place = |kind: &str, at: usize| ring.element(&format!("{kind} {}", folder.element(at)));
        let monitors = folder.monitors.iter().map(|one| Ok((place("bpm", one.at)?, one.plane)));
        let correctors = folder.correctors.iter().map(|one| Ok((place("corrector", one.at)?, one.plane)));
        let monitors = monitors.collect::<Result<_, MeasuredError>>()?;
        let correctors = correctors.collect::<Result<_, MeasuredError>>()?;
        let kicks = folder.correctors.iter().map(|one| one.kick).collect();
        let rf_step = folder.meta.delta_rf / folder.meta.rf;
        let has_dispersion = folder.dispersion.is_some();
        Ok(Self { ring, rf, rf_step, has_dispersion, strengths, skews, monitors, correctors, kicks })
    }

    /// The same with the kicks and the RF step of another measurement.
    pub fn with_kicks(self, other: &Folder) -> Self {
        let kicks = other.correctors.iter().map(|one| one.kick).collect();
        Self { kicks, rf_step: other.meta.delta_rf / other.meta.rf, ..self }
    }

    /// The ring with some values of the unknowns.
    pub fn at(&self, unknowns: &[Unknown], values: &DVector<f64>) -> Ring {
        let mut ring = self.ring.clone();
        for (unknown, &value) in unknowns.iter().zip(values) {
            match unknown.kind {
                Kind::Strength(group) => {
                    for &(element, start) in &self.strengths[group] {
                        match &mut ring.elements[element].kind {
                            Field::Quadrupole { k1 } => *k1 = start * value,
                            Field::Bend(bend) => bend.k1 = start * value,
                            _ => {}
                        }
                    }
                }
                Kind::Skew(group) => {
                    for &element in &self.skews[group] {
                        if let Field::Multipole { k1sl, .. } = &mut ring.elements[element].kind {
                            *k1sl = value;
                        }
                    }
                }
                _ => {}
            }
        }
        ring
    }

    /// The matrix that perfect instruments would measure of the lattice as it is written down [mm], without its dispersion.
    ///
    /// # Errors
    /// [`MeasuredError::Orbit`]: the ring has no closed orbit.
    pub fn as_written(&self) -> Result<DMatrix<f64>, MeasuredError> {
        self.without_instruments(&[], &DVector::zeros(0))
    }

    /// The same with the magnets that were found.
    ///
    /// # Errors
    /// [`MeasuredError::Orbit`].
    pub fn without_instruments(
        &self,
        unknowns: &[Unknown],
        values: &DVector<f64>,
    ) -> Result<DMatrix<f64>, MeasuredError> {
        let is_magnet = |one: &Unknown| matches!(one.kind, Kind::Strength(_) | Kind::Skew(_));
        let magnets = unknowns.iter().zip(values).filter(|(one, _)| is_magnet(one));
        let (magnets, values): (Vec<Unknown>, Vec<f64>) = magnets.map(|(one, value)| (*one, *value)).unzip();
        let matrix = self.predict(&magnets, &DVector::from_vec(values))?.matrix;
        Ok(matrix.columns(0, self.correctors.len()).into_owned())
    }

    /// The matrix for some values of the unknowns, with its derivatives.
    ///
    /// # Errors
    /// [`MeasuredError::Orbit`]: the ring has no closed orbit.
    pub fn predict(&self, unknowns: &[Unknown], values: &DVector<f64>) -> Result<Prediction, MeasuredError> {
        let ring = self.at(unknowns, values);
        let instruments = self.instruments(unknowns, values);
        let share = instruments.held_frequency;
        let [momentum, frequency] = [Hold::Momentum { delta: 0.0 }, Hold::Frequency { offset: 0.0 }];
        let holds = match (self.rf, share) {
            (Rf::FixedMomentum, None) => vec![(momentum, 1.0)],
            (Rf::FixedFrequency, None) => vec![(frequency, 1.0)],
            (_, Some(share)) => vec![(momentum, 1.0 - share), (frequency, share)],
        };
        let mut orbits = Vec::new();
        let mut by_machine: Vec<DMatrix<f64>> = Vec::new();
        for (hold, weight) in &holds {
            let optics = Optics::of(&ring, *hold)?;
            let (orbit, by_magnet) = self.orbits(&optics);
            for (at, slope) in by_magnet.iter().enumerate() {
                match by_machine.get_mut(at) {
                    Some(sum) => *sum += slope * *weight,
                    None => by_machine.push(slope * *weight),
                }
            }
            orbits.push(orbit);
        }
        if let [momentum, frequency] = orbits.as_slice() {
            by_machine.push(frequency - momentum);
        }
        let orbit = orbits
            .iter()
            .zip(&holds)
            .map(|(orbit, (_, weight))| orbit * *weight)
            .reduce(|a, b| a + b)
            .expect("one hold at least");
        let by_machine = by_machine.iter().map(|slope| self.seen(slope, &instruments)).collect();
        Ok(self.with_instruments(&orbit, by_machine, &instruments))
    }

    /// Orbits in both planes at every monitor's place [m], columns kicks in both planes at every corrector [rad] and the step of the RF frequency
    /// [mm], and their derivatives by strengths and skew gradients.
    fn orbits(&self, optics: &Optics) -> (DMatrix<f64>, Vec<DMatrix<f64>>) {
        let observers: Vec<_> =
            self.monitors.iter().flat_map(|&(at, plane)| both(plane).map(|p| optics.observe(at, p))).collect();
        let sources: Vec<_> =
            self.correctors.iter().flat_map(|&(at, plane)| both(plane).map(|p| optics.kick(at, axis(p)))).collect();
        let blank = DMatrix::zeros(observers.len(), sources.len() + usize::from(self.has_dispersion));
        let strengths = self
            .strengths
            .iter()
            .map(|group| group.iter().map(|&(at, per_unit)| (optics.gradient(at), per_unit)).unzip());
        let skews = self.skews.iter().map(|group| group.iter().map(|&at| (optics.skew_gradient(at), 1.0)).unzip());
        let by_magnet = strengths.chain(skews).map(|(gradients, per_unit): (Vec<_>, Vec<f64>)| {
            let mut sum = blank.clone();
            let of_orbit = optics.response_jacobian(&observers, &sources, &gradients);
            for (one, per_unit) in of_orbit.iter().zip(&per_unit) {
                let mut orbit = sum.columns_mut(0, sources.len());
                orbit += one * *per_unit;
            }
            if self.has_dispersion {
                let of_rf = optics.rf_jacobian(&observers, &gradients) * (self.rf_step * 1e3);
                sum.set_column(sources.len(), &(of_rf * DVector::from_vec(per_unit)));
            }
            sum
        });
        let by_magnet = by_magnet.collect();
        let mut orbit = blank.clone();
        orbit.columns_mut(0, sources.len()).copy_from(&optics.response(&observers, &sources));
        if self.has_dispersion {
            orbit.set_column(
                sources.len(),
                &(optics.dispersion_of(&observers) * (-self.rf_step * 1e3 / optics.slip_factor())),
            );
        }
        (orbit, by_magnet)
    }

    fn instruments(&self, unknowns: &[Unknown], values: &DVector<f64>) -> Instruments {
        let mut all = Instruments {
            monitors: vec![[1.0, 0.0]; self.monitors.len()],
            correctors: vec![[1.0, 0.0]; self.correctors.len()],
            rf: 1.0,
            held_frequency: None,
        };
        for (unknown, &value) in unknowns.iter().zip(values) {
            match unknown.kind {
                Kind::MonitorGain(row) => all.monitors[row][0] = value,
                Kind::MonitorCoupling(row) => all.monitors[row][1] = value,
                Kind::CorrectorGain(column) => all.correctors[column][0] = value,
                Kind::CorrectorCoupling(column) => all.correctors[column][1] = value,
                Kind::RfScale => all.rf = value,
                Kind::HeldFrequency => all.held_frequency = Some(value),
                Kind::Strength(_) | Kind::Skew(_) => {}
            }
        }
        all
    }

    /// `A G B` of orbits in both planes to kicks in both.
    fn seen(&self, orbit: &DMatrix<f64>, instruments: &Instruments) -> DMatrix<f64> {
        self.kicked(
            &self.read(orbit, instruments.weights(Side::Monitors)),
            instruments.weights(Side::Correctors),
            instruments.rf,
        )
    }

    /// `A G`: every pair of rows as one reading.
    fn read(&self, orbit: &DMatrix<f64>, weights: impl Fn(usize) -> [f64; 2]) -> DMatrix<f64> {
        let mut seen = DMatrix::zeros(self.monitors.len(), orbit.ncols());
        for row in 0..self.monitors.len() {
            let [own, other] = weights(row);
            seen.set_row(row, &(orbit.row(2 * row) * own + orbit.row(2 * row + 1) * other));
        }
        seen
    }

    /// `G B`: every pair of columns as one corrector, and the RF step.
    fn kicked(&self, orbit: &DMatrix<f64>, weights: impl Fn(usize) -> [f64; 2], rf: f64) -> DMatrix<f64> {
        let correctors = self.correctors.len();
        let mut kicked = DMatrix::zeros(orbit.nrows(), correctors + usize::from(self.has_dispersion));
        for column in 0..correctors {
            let [own, other] = weights(column).map(|weight| weight * self.kicks[column]);
            kicked.set_column(column, &(orbit.column(2 * column) * own + orbit.column(2 * column + 1) * other));
        }
        if self.has_dispersion {
            kicked.set_column(correctors, &(orbit.column(2 * correctors) * rf));
        }
        kicked
    }

    fn with_instruments(
        &self,
        orbit: &DMatrix<f64>,
        by_machine: Vec<DMatrix<f64>>,
        instruments: &Instruments,
    ) -> Prediction {
        let read = self.read(orbit, instruments.weights(Side::Monitors));
        let kicked = self.kicked(orbit, instruments.weights(Side::Correctors), instruments.rf);
        let matrix = self.kicked(&read, instruments.weights(Side::Correctors), instruments.rf);
        let [own, other] = [[1.0, 0.0], [0.0, 1.0]];
        Prediction {
            by_machine,
            by_monitor: [own, other].map(|weights| self.read(&kicked, |_| weights)),
            by_corrector: [self.kicked(&read, |_| own, 1.0), self.kicked(&read, |_| other, 0.0)],
            matrix,
        }
    }
}

/// Which instruments.
#[derive(Clone, Copy)]
enum Side {
    Monitors,
    Correctors,
}

impl Instruments {
    /// Weights of the own plane and of the other one of each instrument.
    fn weights(&self, side: Side) -> impl Fn(usize) -> [f64; 2] {
        let all = match side {
            Side::Monitors => &self.monitors,
            Side::Correctors => &self.correctors,
        };
        |at| all[at]
    }
}

/// A plane and the other one.
fn both(plane: Plane) -> [Plane; 2] {
    match plane {
        Plane::X => [Plane::X, Plane::Y],
        Plane::Y => [Plane::Y, Plane::X],
    }
}

fn axis(plane: Plane) -> [f64; 2] {
    match plane {
        Plane::X => [1.0, 0.0],
        Plane::Y => [0.0, 1.0],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::normal::Places;
    use crate::testing::{machine, ring};

    #[test]
    fn derivatives_are_those_of_differences() {
        let folder = ring();
        let (model, mut unknowns, values) = machine(&folder, 3);
        let magnets = unknowns.iter().filter(|one| matches!(one.kind, Kind::Strength(_) | Kind::Skew(_))).count();
        // between the two holds both count
        unknowns.insert(magnets, Unknown { kind: Kind::HeldFrequency, mean: 1.0, width: 1.0 });
        let values = values.insert_row(magnets, 0.4);
        let at = model.predict(&unknowns, &values).unwrap();
        let places = Places::of(&unknowns, at.matrix.nrows(), at.matrix.ncols());
        for unknown in 0..unknowns.len() {
            let step = 1e-5;
            let moved = |by: f64| {
                let mut values = values.clone();
                values[unknown] += by;
                model.predict(&unknowns, &values).unwrap().matrix
            };
            let numeric = (moved(step) - moved(-step)) / (2.0 * step);
            let mut unit = DVector::zeros(unknowns.len());
            unit[unknown] = 1.0;
            let exact = DMatrix::from_fn(numeric.nrows(), numeric.ncols(), |i, j| {
                let of_machine: f64 =
                    at.by_machine.iter().zip(unit.iter()).map(|(slope, one)| slope[(i, j)] * one).sum();
                of_machine + places.instruments(&at, i, j).map(|(one, by)| by * unit[one]).sum::<f64>()
            });
            // the differences err by the third derivative times step^2, and by rounding
            assert!((&numeric - &exact).amax() < 1e-6 * (1.0 + exact.amax()), "{:?}", unknowns[unknown].kind);
        }
    }
}
