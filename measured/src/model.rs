//! The predicted matrix, and its derivative by everything that is fitted.
//!
//! With `G` the response of the orbit in both planes at every monitor to a kick in either plane at every corrector [m/rad], the matrix [mm] is
//!
//! `M = A G B`,
//!
//! `A` holding the gain of each reading and what it has of the other plane, `B` the kicks [mrad] in both planes. The last column, if the
//! dispersion was measured, is the change of the orbit with the RF frequency.

use nalgebra::{DMatrix, DVector};
use twin::{Hold, Kind as Field, LatticeError, Observer, Optics, Plane, Rf, Ring, Source};

use crate::derivative::{ByMachine, Change, Share};
use crate::error::MeasuredError;
use crate::folder::Folder;
use crate::lattice::{lens_pairs, parts, ring, winding};
use crate::unknowns::{Groups, Kind, Unknown, fields_along, gains};

/// Millimetres a metre.
const MILLI: f64 = 1e3;

/// The model of one measurement.
#[derive(Debug, Clone)]
pub struct Model {
    ring: Ring,
    rf: Rf,
    /// Relative step of the RF frequency.
    rf_step: f64,
    has_dispersion: bool,
    /// Elements of each group; thin elements of each group of skew gradients and of further gradients.
    strengths: Vec<Vec<usize>>,
    skews: Vec<Vec<usize>>,
    gradients: Vec<Vec<usize>>,
    /// Lenses along each straight.
    straights: Vec<Vec<Pair>>,
    /// Element of each monitor's row, with the plane.
    monitors: Vec<(usize, Plane)>,
    /// Elements along which each corrector kicks, with their shares of the kick, and the plane.
    correctors: Vec<(Vec<(usize, f64)>, Plane)>,
    /// Kicks as believed [mrad].
    kicks: Vec<f64>,
}

/// Two lenses at one place of a straight.
#[derive(Debug, Clone, Copy)]
struct Pair {
    /// Element with a gradient, or a skew gradient.
    gradient: usize,
    /// Element that focuses vertically.
    wiggler: usize,
    /// Distance from the middle of the straight [m].
    off: f64,
}

/// A predicted matrix and its derivatives.
#[derive(Debug, Clone)]
pub struct Prediction {
    /// The matrix [mm], with the dispersion as its last column.
    pub matrix: DMatrix<f64>,
    /// By strengths, then skew gradients, then further gradients, then the share of a held RF frequency.
    pub by_machine: ByMachine,
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
    pub fn of(folder: &Folder, groups: &Groups, rf: Rf) -> Result<Self, MeasuredError> {
        let cut: Vec<usize> = groups[1..3].iter().flatten().flatten().copied().collect();
        let ring = ring(folder, &cut, &groups[3])?;
        let named = |row: usize| parts(&folder.element(row), cut.contains(&row));
        let thick = |group: &Vec<usize>| -> Result<Vec<usize>, LatticeError> {
            group.iter().flat_map(|&row| named(row).0).map(|name| ring.element(&name)).collect()
        };
        let strengths = groups[0].iter().map(thick).collect::<Result<_, _>>()?;
        let thin = |group: &Vec<usize>| -> Result<Vec<usize>, LatticeError> {
            group.iter().filter_map(|&row| named(row).1).map(|name| ring.element(&name)).collect()
        };
        let skews = groups[1].iter().map(thin).collect::<Result<_, _>>()?;
        let gradients = groups[2].iter().map(thin).collect::<Result<_, _>>()?;
        let pair = |([gradient, wiggler], off): ([String; 2], f64)| {
            Ok(Pair { gradient: ring.element(&gradient)?, wiggler: ring.element(&wiggler)?, off })
        };
        let lenses = |rows: &Vec<usize>| lens_pairs(folder, rows).into_iter().map(pair).collect();
        let straights = groups[3].iter().map(lenses).collect::<Result<_, LatticeError>>()?;
        let place = |kind: &str, at: usize| ring.element(&format!("{kind} {}", folder.element(at)));
        let monitors = folder.monitors.iter().map(|one| Ok((place("bpm", one.at)?, one.plane)));
        let correctors = folder.correctors.iter().map(|one| {
            let Some(halves) = winding(folder, one.at) else {
                return Ok((vec![(place("corrector", one.at)?, 1.0)], one.plane));
            };
            let pieces = halves.into_iter().flat_map(|row| named(row).0).map(|name| ring.element(&name));
            let pieces = pieces.collect::<Result<Vec<usize>, _>>()?;
            let length = |at: usize| ring.elements[at].length;
            let whole: f64 = pieces.iter().map(|&at| length(at)).sum();
            Ok((pieces.into_iter().map(|at| (at, length(at) / whole)).collect(), one.plane))
        });
        let monitors = monitors.collect::<Result<_, MeasuredError>>()?;
        let correctors = correctors.collect::<Result<_, MeasuredError>>()?;
        let kicks = folder.correctors.iter().map(|one| one.kick).collect();
        let rf_step = folder.meta.delta_rf / folder.meta.rf;
        let has_dispersion = folder.dispersion.is_some();
        Ok(Self {
            ring,
            rf,
            rf_step,
            has_dispersion,
            strengths,
            skews,
            gradients,
            straights,
            monitors,
            correctors,
            kicks,
        })
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
            if let Kind::Strength(group) | Kind::Added(group) = unknown.kind {
                for &element in &self.strengths[group] {
                    if let Some(k1) = ring.elements[element].kind.gradient_mut() {
                        *k1 = unknown.kind.gradient(*k1, value);
                    }
                }
            }
            for (element, change, share) in self.thin(unknown.kind) {
                match (&mut ring.elements[element].kind, change) {
                    (Field::Multipole { k1sl, .. }, Change::Skew) => *k1sl += share * value,
                    (Field::Multipole { k1l, .. }, _) => *k1l += share * value,
                    (Field::Wiggler { focusing }, _) => *focusing += share * value,
                    _ => {}
                }
            }
        }
        ring
    }

    /// The matrix that perfect instruments would measure of the lattice as it is written down [mm], without its dispersion.
    ///
    /// # Errors
    /// [`MeasuredError::Orbit`]: the ring has no closed orbit.
    pub fn as_written(&self) -> Result<DMatrix<f64>, MeasuredError> {
        let matrix = self.predict(&[], &DVector::zeros(0))?.matrix;
        Ok(matrix.columns(0, self.correctors.len()).into_owned())
    }

    /// The matrix for some values of the unknowns, with its derivatives.
    ///
    /// # Errors
    /// [`MeasuredError::Orbit`]: the ring has no closed orbit.
    pub fn predict(&self, unknowns: &[Unknown], values: &DVector<f64>) -> Result<Prediction, MeasuredError> {
        let ring = self.at(unknowns, values);
        let instruments = self.instruments(unknowns, values);
        let changes = self.changes(&self.gradients_of_factors(unknowns, values, &ring));
        let held = |hold| Ok::<_, MeasuredError>(self.held(&Optics::of(&ring, hold)?, &instruments, &changes));
        let [momentum, frequency] = [Hold::Momentum { delta: 0.0 }, Hold::Frequency { offset: 0.0 }];
        match (instruments.held_frequency, self.rf) {
            (Some(share), _) => Ok(held(momentum)?.towards(held(frequency)?, share)),
            (None, Rf::FixedMomentum) => held(momentum),
            (None, Rf::FixedFrequency) => held(frequency),
        }
    }

    /// Monitors with what each reads of both planes.
    fn observers(&self, optics: &Optics, weights: &[[f64; 2]]) -> Vec<Observer> {
        let places = self.monitors.iter().zip(weights);
        places.map(|(&(at, plane), &weights)| optics.observe_along(at, along(plane, weights))).collect()
    }

    /// Pieces of correctors with what each kicks in both planes [mrad].
    fn sources(&self, optics: &Optics, weights: &[[f64; 2]]) -> Vec<Source> {
        let correctors = self.correctors.iter().zip(weights).zip(&self.kicks);
        let pieces = correctors.flat_map(|(((pieces, plane), &weights), &kick)| {
            pieces.iter().map(move |&(at, share)| optics.winding(at, along(*plane, weights)).times(share * kick))
        });
        pieces.collect()
    }

    /// Columns of the pieces added up to those of the correctors.
    fn of_correctors(&self, of_pieces: DMatrix<f64>) -> DMatrix<f64> {
        if of_pieces.ncols() == self.correctors.len() {
            return of_pieces;
        }
        let mut sum = DMatrix::zeros(of_pieces.nrows(), self.correctors.len());
        let columns = self.correctors.iter().enumerate().flat_map(|(column, (pieces, _))| vec![column; pieces.len()]);
        for (column, piece) in columns.zip(of_pieces.column_iter()) {
            let mut into = sum.column_mut(column);
            into += piece;
        }
        sum
    }

    /// The prediction of one kind of hold.
    fn held(&self, optics: &Optics, instruments: &Instruments, changes: &[Vec<Share>]) -> Prediction {
        let (read, kicked) =
            (self.observers(optics, &instruments.monitors), self.sources(optics, &instruments.correctors));
        let [own, other] = [[1.0, 0.0], [0.0, 1.0]];
        let rf = instruments.rf;
        Prediction {
            matrix: self.seen(optics, &read, &kicked, rf),
            by_machine: ByMachine::about(
                optics,
                changes,
                (&read, &kicked),
                self.correctors.iter().map(|(pieces, _)| pieces.len()),
                self.has_dispersion.then_some(rf * self.rf_step * MILLI),
            ),
            by_monitor: [own, other]
                .map(|one| self.seen(optics, &self.observers(optics, &vec![one; self.monitors.len()]), &kicked, rf)),
            by_corrector: [(own, 1.0), (other, 0.0)].map(|(one, rf)| {
                self.seen(optics, &read, &self.sources(optics, &vec![one; self.correctors.len()]), rf)
            }),
        }
    }

    /// What observers see of sources [mm], and of a step of the RF frequency, `rf` times as large as it is believed to be.
    fn seen(&self, optics: &Optics, observers: &[Observer], sources: &[Source], rf: f64) -> DMatrix<f64> {
        let seen = self.of_correctors(optics.response(observers, sources));
        let offset = || optics.dispersion_of(observers) * (-rf * self.rf_step * MILLI / optics.slip_factor());
        self.and_dispersion(seen, offset)
    }

    /// Gradient of each element of each group per unit of the group's factor [1/m^2], since a magnet may have a factor of its own and one that it shares;
    /// 1 where a gradient is added.
    fn gradients_of_factors(&self, unknowns: &[Unknown], values: &DVector<f64>, ring: &Ring) -> Vec<Vec<f64>> {
        let now = |group: &Vec<usize>| {
            group.iter().map(|&at| ring.elements[at].kind.gradient().unwrap_or(0.0)).collect::<Vec<f64>>()
        };
        let mut each: Vec<Vec<f64>> = self.strengths.iter().map(now).collect();
        for (unknown, &value) in unknowns.iter().zip(values) {
            match unknown.kind {
                Kind::Strength(group) => each[group].iter_mut().for_each(|k1| *k1 /= value),
                Kind::Added(group) => each[group].fill(1.0),
                _ => {}
            }
        }
        each
    }

    /// What each unknown of a magnet changes, with the gradients of the factors.
    fn changes(&self, gradients: &[Vec<f64>]) -> Vec<Vec<Share>> {
        let strengths = self.strengths.iter().zip(gradients).map(|(group, gradients)| {
            let each = group.iter().zip(gradients);
            each.map(|(&at, &per_unit)| (at, Change::Normal, per_unit)).collect()
        });
        let skews = (0..self.skews.len()).map(Kind::Skew);
        let gradients = (0..self.gradients.len()).map(Kind::Gradient);
        let thin = skews.chain(gradients).chain(fields_along(self.straights.len()));
        strengths.chain(thin.map(|kind| self.thin(kind))).collect()
    }

    /// What an unknown changes of thin elements: each of its group, or along its straight all lenses alike, or in proportion to their distances `s` from the
    /// middle, `s / sum of s^2` for a moment of 1; nothing of any other unknown.
    fn thin(&self, kind: Kind) -> Vec<Share> {
        let each = |group: &[usize], change| group.iter().map(|&at| (at, change, 1.0)).collect();
        let (group, change) = match kind {
            Kind::Skew(group) => return each(&self.skews[group], Change::Skew),
            Kind::Gradient(group) => return each(&self.gradients[group], Change::Normal),
            Kind::Wiggler(group) => (group, Change::Vertical),
            Kind::Moment(_, change, group) => (group, change),
            _ => return Vec::new(),
        };
        let pairs = &self.straights[group];
        let squares: f64 = pairs.iter().map(|pair| pair.off * pair.off).sum();
        let share = |pair: &Pair| match kind {
            Kind::Moment(1, ..) => pair.off / squares,
            _ => 1.0 / pairs.len() as f64,
        };
        let element = |pair: &Pair| if change == Change::Vertical { pair.wiggler } else { pair.gradient };
        pairs.iter().map(|pair| (element(pair), change, share(pair))).collect()
    }

    /// A matrix with the dispersion as its last column, if it was measured.
    fn and_dispersion(&self, matrix: DMatrix<f64>, dispersion: impl Fn() -> DVector<f64>) -> DMatrix<f64> {
        if !self.has_dispersion {
            return matrix;
        }
        let column = matrix.ncols();
        let mut all = matrix.insert_column(column, 0.0);
        all.set_column(column, &dispersion());
        all
    }

    fn instruments(&self, unknowns: &[Unknown], values: &DVector<f64>) -> Instruments {
        let value_of = |kind: Kind| unknowns.iter().position(|unknown| unknown.kind == kind).map(|at| values[at]);
        Instruments {
            monitors: gains((unknowns, values), self.monitors.len(), Kind::of_monitor),
            correctors: gains((unknowns, values), self.correctors.len(), Kind::of_corrector),
            rf: value_of(Kind::RfScale).unwrap_or(1.0),
            held_frequency: value_of(Kind::HeldFrequency),
        }
    }
}

impl Prediction {
    /// Between two kinds of hold: `self` with share 0, `to` with 1. The derivative by the share comes after those by magnets.
    fn towards(self, to: Self, share: f64) -> Self {
        let between = |from: &DMatrix<f64>, to: &DMatrix<f64>| from * (1.0 - share) + to * share;
        let both = |from: &[DMatrix<f64>; 2], to: &[DMatrix<f64>; 2]| [0, 1].map(|i| between(&from[i], &to[i]));
        Self {
            matrix: between(&self.matrix, &to.matrix),
            by_monitor: both(&self.by_monitor, &to.by_monitor),
            by_corrector: both(&self.by_corrector, &to.by_corrector),
            by_machine: self.by_machine.towards(to.by_machine, share, &to.matrix - &self.matrix),
        }
    }
}

/// The direction `(x, y)` of an instrument with weights in its own plane and in the other one.
fn along(plane: Plane, [own, other]: [f64; 2]) -> [f64; 2] {
    match plane {
        Plane::X => [own, other],
        Plane::Y => [other, own],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::normal::Places;
    use crate::testing::{machine, ring, ring_with_winding};

    /// The derivative of the whole matrix by one unknown of the machine.
    fn by_one(at: &Prediction, unknown: usize) -> DMatrix<f64> {
        let columns: Vec<_> =
            (0..at.matrix.ncols()).map(|j| at.by_machine.columns(&[j]).column(unknown).into_owned()).collect();
        DMatrix::from_columns(&columns)
    }

    /// A gradient spread over a short quadrupole changes what a thin one in its middle does.
    #[test]
    fn thin_gradients_are_those_of_short_magnets() {
        let folder = ring();
        let groups = crate::unknowns::groups(&folder);
        let rows: Vec<usize> = groups[0].iter().map(|group| group[0]).collect();
        let each: Vec<Vec<usize>> = rows.iter().map(|&row| vec![row]).collect();
        let (_, unknowns, values) = machine(&folder, 4);
        let model =
            Model::of(&folder, &[groups[0].clone(), groups[1].clone(), each, Vec::new()], Rf::FixedFrequency).unwrap();
        let at = model.predict(&unknowns, &values).unwrap();
        let first = groups[0].len() + groups[1].len();
        for (number, row) in rows.into_iter().enumerate() {
            let [thick, thin] = [number, first + number].map(|unknown| by_one(&at, unknown));
            let magnet = &folder.lattice[row];
            let spread = thick / (magnet.k1 * magnet.length);
            // the focusing angle of a quadrupole is 0.6: second order of its half, 0.3^2/3
            assert!((&spread - &thin).norm() < 0.06 * thin.norm(), "{row}: {}", (&spread - &thin).norm() / thin.norm());
        }
    }

    /// What focuses along a straight has the sum and the first moment that its unknowns are.
    #[test]
    fn unknowns_of_a_straight_are_its_moments() {
        let folder = ring();
        let [strengths, skews, ..] = crate::unknowns::groups(&folder);
        let groups = [strengths, skews, Vec::new(), crate::unknowns::straights(&folder)];
        let model = Model::of(&folder, &groups, Rf::FixedFrequency).unwrap();
        assert!(model.straights.len() > 4, "{}", model.straights.len());
        for (group, pairs) in model.straights.iter().enumerate() {
            let moments = |kind: Kind| {
                let shares = model.thin(kind).into_iter().zip(pairs);
                shares.fold([0.0; 2], |[sum, first], ((_, _, share), pair)| [sum + share, first + share * pair.off])
            };
            let changes = [Change::Normal, Change::Vertical, Change::Skew];
            let firsts = changes.map(|change| (Kind::Moment(1, change, group), [0.0, 1.0]));
            let wholes = [Kind::Wiggler(group), Kind::Moment(0, Change::Skew, group)].map(|kind| (kind, [1.0, 0.0]));
            for (kind, expected) in wholes.into_iter().chain(firsts) {
                let found = moments(kind);
                assert!((0..2).all(|order| (found[order] - expected[order]).abs() < 1e-12), "{kind:?}: {found:?}");
            }
        }
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let mut folder = ring_with_winding();
        // a gradient that is added to dipoles, as one unknown
        let dipoles = (0..folder.lattice.len()).filter(|&row| folder.lattice[row].bend != 0.0).collect();
        let added = crate::folder::Group { elements: dipoles, field: "K".into() };
        folder.meta.reference_fit.as_mut().unwrap().fit_parameters.insert(3, added);
        let (_, mut unknowns, mut values) = machine(&folder, 3);
        // a further gradient and a skew gradient in a dipole and in a quadrupole
        let [strengths, skews, ..] = crate::unknowns::groups(&folder);
        let place = strengths.len() + skews.len();
        // and what focuses along a straight
        let straight = crate::unknowns::straights(&folder).swap_remove(0);
        let groups = [strengths, skews, vec![vec![4], vec![2]], vec![straight]];
        let model = Model::of(&folder, &groups, Rf::FixedFrequency).unwrap();
        let thin: Vec<Kind> = [Kind::Gradient(0), Kind::Gradient(1)].into_iter().chain(fields_along(1)).collect();
        for kind in thin.into_iter().rev() {
            unknowns.insert(place, Unknown { kind, mean: 0.0, width: 0.01 });
            values = values.insert_row(place, 0.004);
        }
        let magnets = unknowns.iter().filter(|one| one.kind.is_of_machine()).count();
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
            let of_machine = (unknown < at.by_machine.count()).then(|| by_one(&at, unknown));
            let exact = DMatrix::from_fn(numeric.nrows(), numeric.ncols(), |i, j| {
                of_machine.as_ref().map_or(0.0, |of_machine| of_machine[(i, j)])
                    + places.instruments(&at, i, j).map(|(one, by)| by * unit[one]).sum::<f64>()
            });
            // the differences err by the third derivative times step^2, and by rounding
            assert!((&numeric - &exact).amax() < 1e-6 * (1.0 + exact.amax()), "{:?}", unknowns[unknown].kind);
        }
    }
}
