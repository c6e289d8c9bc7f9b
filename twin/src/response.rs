//! Orbit response and its derivatives from the closed-orbit Green's function, planes coupled, elements thick.
//!
//! Everything is written in the frame of the ring's start. A kick `v` at a place with transfer `T` appears there as the
//! source `c = T^-1 v`; the closed orbit at the start is `W c`, where `W` solves the closure equations of [`Hold`]; an
//! observer with row `a = e T` sees
//!
//! `G(observer, source) = a (W + step) c`, `step` = 1 downstream of the source, else 0.
//!
//! A change of gradient `dk` over an element acts as a kick `-dk x`, `+dk y` all along it, so that
//!
//! `dG/dk = -a (W + step) Q (W + step) c`, `Q` = integral over the element of `T^-1 E T ds`,
//!
//! which is `dG/dk = - integral G(s_i, s) G(s, s_j) ds`, coupled. The step and the hold (fixed momentum or frequency)
//! enter through `W` alone, so the formula is the same for all of them. Observers and sources stand outside the element
//! that changes, but for a winding of it: its kick `v` is spread along the element, `c` is the mean of `T^-1 v` over it, and
//!
//! `dG/dk = -a (W + step) (Q W c + integral of T^-1 E T c(s) ds)`, `c(s)` = what of `c` has acted down to `s`.
//! Derivatives are exact on the reference orbit; elsewhere the gradient also moves the orbit, and with it
//! the linear maps of what is not linear (feed-down), which is left out: at delta = 0.003 it makes up to 0.4 % of the
//! response's derivative, 9 % of the dispersion's and 4 % of the compaction's.
//!
//! Source: S. Y. Lee, Accelerator Physics, ch. 2; J. Safranek, NIM A 388 (1997) 27 for the use.

use nalgebra::{DMatrix, Matrix5, Matrix6, Matrix6xX, MatrixXx6, RowVector6, Vector6};

use crate::lattice::{Corrector, Element, Kind, Plane, Ring};
use crate::map::{DELTA, PATH, PX, PY, Phase, X, Y, inverse};
use crate::orbit::{ClosedOrbit, Hold, OrbitError, invert};

/// A place in the ring: inside element `element`, `depth` [m] from its entrance. Ordered along the beam.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct Place {
    /// Index of the element.
    pub element: usize,
    /// Distance from its entrance [m].
    pub depth: f64,
}

impl From<usize> for Place {
    /// The entrance of an element.
    fn from(element: usize) -> Self {
        Self { element, depth: 0.0 }
    }
}

/// Something that measures one coordinate of the orbit.
#[derive(Debug, Clone, Copy)]
pub struct Observer {
    pub(crate) place: Place,
    pub(crate) row: RowVector6<f64>,
}

/// Something that kicks the beam.
#[derive(Debug, Clone, Copy)]
pub struct Source {
    /// Of a winding the entrance of its element.
    pub(crate) place: Place,
    pub(crate) column: Vector6<f64>,
    /// Of a winding what of the column has acted down to each of [`NODES`].
    acted: Option<[Vector6<f64>; 4]>,
}

impl Observer {
    /// The same, reading `gain` times as much.
    pub fn times(self, gain: f64) -> Self {
        Self { row: self.row * gain, ..self }
    }
}

impl Source {
    /// The same, kicking `gain` times as much.
    pub fn times(self, gain: f64) -> Self {
        let acted = self.acted.map(|nodes| nodes.map(|column| column * gain));
        Self { column: self.column * gain, acted, ..self }
    }
}

/// An element (or a thin place) whose gradient may change.
#[derive(Debug, Clone, Copy)]
pub struct Gradient {
    pub(crate) place: Place,
    pub(crate) kernel: Matrix6<f64>,
    /// Of a thick element the kernel's share at each of [`NODES`].
    shares: Option<[Matrix6<f64>; 4]>,
}

impl Gradient {
    /// The same with an amplitude `gain` times as large.
    pub fn times(self, gain: f64) -> Self {
        let shares = self.shares.map(|nodes| nodes.map(|share| share * gain));
        Self { kernel: self.kernel * gain, shares, ..self }
    }

    fn thin(place: Place, kernel: Matrix6<f64>) -> Self {
        Self { place, kernel, shares: None }
    }

    /// What a winding of the same element sends into it, beside its closed orbit; none of other sources.
    pub(crate) fn within(&self, source: &Source) -> Option<Vector6<f64>> {
        let (shares, acted) = self.shares.zip(source.acted).filter(|_| source.place == self.place)?;
        Some(shares.iter().zip(&acted).map(|(share, acted)| share * acted).sum())
    }
}

/// Linear optics of a ring about its closed orbit.
#[derive(Debug, Clone)]
pub struct Optics<'r> {
    pub(crate) ring: &'r Ring,
    pub(crate) orbit: ClosedOrbit,
    /// Closed orbit at the start for a source, `W`.
    pub(crate) closed: Matrix6<f64>,
    /// The same with the momentum held.
    pub(crate) closed_at_momentum: Matrix6<f64>,
    /// Closed orbit at the start for a unit of momentum deviation.
    pub(crate) dispersive: Vector6<f64>,
}

/// `T^-1 E T` of a gradient.
fn normal(back: &Matrix6<f64>, map: &Matrix6<f64>) -> Matrix6<f64> {
    back.column(PX) * map.row(X) - back.column(PY) * map.row(Y)
}

/// `T^-1 E T` of a skew gradient, as a kick taken away.
fn skew(back: &Matrix6<f64>, map: &Matrix6<f64>) -> Matrix6<f64> {
    -(back.column(PX) * map.row(Y) + back.column(PY) * map.row(X))
}

/// Transverse coordinates x, x', y and y'.
const PHASE: [usize; 4] = [X, PX, Y, PY];

/// Nodes and weights of four-point Gauss-Legendre quadrature on 0..1; exact to better than 1e-10 for the phase advance
/// of any quadrupole of less than 0.8 rad (test `thick_gradients_are_exact`).
const NODES: [(f64, f64); 4] = [
    (0.069_431_844_202_973_71, 0.173_927_422_568_726_93),
    (0.330_009_478_207_571_87, 0.326_072_577_431_273_07),
    (0.669_990_521_792_428_1, 0.326_072_577_431_273_07),
    (0.930_568_155_797_026_3, 0.173_927_422_568_726_93),
];

impl<'r> Optics<'r> {
    /// Find the closed orbit of a ring and linearise about it.
    ///
    /// # Errors
    /// [`OrbitError`]; unstable motion is found by [`Optics::tunes`].
    pub fn of(ring: &'r Ring, hold: Hold) -> Result<Self, OrbitError> {
        Self::about(ring, hold, ClosedOrbit::find(ring, hold)?)
    }

    /// Linearise about a closed orbit that is known.
    ///
    /// # Errors
    /// [`OrbitError::Integer`].
    pub fn about(ring: &'r Ring, hold: Hold, orbit: ClosedOrbit) -> Result<Self, OrbitError> {
        let (turn, delta) = (*orbit.one_turn(), orbit.at[0][DELTA]);
        let (closed_at_momentum, dispersive) = close_at_momentum(ring, delta, &turn)?;
        let closed = match hold {
            Hold::Momentum { .. } => closed_at_momentum,
            Hold::Frequency { .. } => closed_orbits(&invert(&hold.closure(ring, delta, &turn), &turn)?, &turn, 5),
        };
        Ok(Self { ring, orbit, closed, closed_at_momentum, dispersive })
    }

    /// The closed orbit at a place.
    pub fn orbit(&self, element: usize) -> &Phase<f64> {
        &self.orbit.at[element]
    }

    /// The closed orbit everywhere.
    pub fn closed_orbit(&self) -> &ClosedOrbit {
        &self.orbit
    }

    /// Linear map from the start to a place: at an entrance in the ring's frame, inside in the element's own.
    pub(crate) fn transfer(&self, place: Place) -> Matrix6<f64> {
        if place.depth == 0.0 { self.orbit.transfer[place.element] } else { self.transfer_into(place) }
    }

    /// Linear map from the start into the element's own (shifted, rolled) frame.
    pub(crate) fn transfer_into(&self, place: Place) -> Matrix6<f64> {
        let inside = self.ring.elements[place.element].linearise_into(&self.orbit.at[place.element], place.depth);
        inside * self.orbit.transfer[place.element]
    }

    /// An observer of x or y at a place.
    pub fn observe(&self, place: impl Into<Place>, plane: Plane) -> Observer {
        let place = place.into();
        let index = if plane == Plane::X { X } else { Y };
        Observer { place, row: self.transfer(place).row(index).into_owned() }
    }

    /// An observer of the coordinate along a direction `(x, y)` at a place, longer than 1 with a gain.
    pub fn observe_along(&self, place: impl Into<Place>, direction: [f64; 2]) -> Observer {
        let place = place.into();
        let map = self.transfer(place);
        Observer { place, row: map.row(X) * direction[0] + map.row(Y) * direction[1] }
    }

    /// An observer of the slope in a plane, `dp/p0`, at a place.
    pub fn observe_slope(&self, place: impl Into<Place>, plane: Plane) -> Observer {
        let place = place.into();
        let index = if plane == Plane::X { PX } else { PY };
        Observer { place, row: self.transfer(place).row(index).into_owned() }
    }

    /// A thin kick `(dx', dy')` of the given direction at a place.
    pub fn kick(&self, place: impl Into<Place>, direction: [f64; 2]) -> Source {
        self.step(place, [0.0, direction[0], 0.0, direction[1]])
    }

    /// A thin step of the beam in x, x', y and y' at a place.
    pub fn step(&self, place: impl Into<Place>, step: [f64; 4]) -> Source {
        let place = place.into();
        let mut all = Vector6::zeros();
        (all[X], all[PX], all[Y], all[PY]) = (step[0], step[1], step[2], step[3]);
        Source { place, column: inverse(&self.transfer(place)) * all, acted: None }
    }

    /// A kick `(dx', dy')` that is spread evenly along an element, as that of a winding of a magnet is; observers stand outside the element.
    ///
    /// Beyond a magnet that is symmetric about its middle it is a thin kick there times `sin(f)/f`, or `sinh(f)/f` in the plane that is defocused,
    /// `f = sqrt|k| L/2`.
    pub fn winding(&self, element: usize, direction: [f64; 2]) -> Source {
        let length = self.ring.elements[element].length;
        if length == 0.0 {
            return self.kick(element, direction);
        }
        let kick = Vector6::new(0.0, direction[0], 0.0, direction[1], 0.0, 0.0);
        // from the entrance down to a share of the length
        let acted = |down_to: f64| -> Vector6<f64> {
            let at =
                |node: f64| inverse(&self.transfer_in_axes(Place { element, depth: node * down_to * length })) * kick;
            NODES.iter().map(|(node, weight)| at(*node) * (weight * down_to)).sum()
        };
        Source { place: element.into(), column: acted(1.0), acted: Some(NODES.map(|(node, _)| acted(node))) }
    }

    /// Linear map from the start to the middle of an element, in the ring's axes; of a free straight to its entrance, where a thin field is.
    fn transfer_to_middle(&self, element: usize) -> (Place, Matrix6<f64>) {
        let Element { kind, length, .. } = &self.ring.elements[element];
        let is_thin = matches!(kind, Kind::Marker | Kind::Multipole { .. } | Kind::Wiggler { .. });
        let place = Place { element, depth: if is_thin { 0.0 } else { 0.5 * length } };
        (place, self.transfer_in_axes(place))
    }

    /// Linear map from the start to a place, in the ring's axes whatever the roll of its element.
    fn transfer_in_axes(&self, place: Place) -> Matrix6<f64> {
        self.ring.elements[place.element].misalignment.rotation().transpose() * self.transfer_into(place)
    }

    /// Observers of x and y in the middle of an element, in the ring's axes whatever its roll.
    pub(crate) fn observe_middle(&self, element: usize) -> [Observer; 2] {
        let (place, map) = self.transfer_to_middle(element);
        [X, Y].map(|index| Observer { place, row: map.row(index).into_owned() })
    }

    /// Thin kicks along x and along y in the middle of an element, in the ring's axes whatever its roll.
    pub(crate) fn kick_middle(&self, element: usize) -> [Source; 2] {
        let (place, map) = self.transfer_to_middle(element);
        let back = inverse(&map);
        [PX, PY].map(|index| Source { place, column: back.column(index).into_owned(), acted: None })
    }

    /// Derivative with respect to the gradient [1/m^2] of an element, or to the integrated gradient [1/m] of a thin one, in its own axes.
    pub fn gradient(&self, element: usize) -> Gradient {
        self.change(element, normal)
    }

    /// Derivative with respect to the skew gradient of an element, units as in [`Optics::gradient`]: `x' += k1s y`,
    /// `y' += k1s x`.
    pub fn skew_gradient(&self, element: usize) -> Gradient {
        self.change(element, skew)
    }

    /// Derivative with respect to the integrated vertical focusing of a wiggler [1/m].
    pub fn vertical_focusing(&self, element: usize) -> Gradient {
        self.change(element, |back, map| back.column(PY) * map.row(Y))
    }

    /// Derivatives with respect to the gradient and the skew gradient of an element, in the ring's axes whatever its roll; units as in [`Optics::gradient`].
    pub(crate) fn gradients_in_axes(&self, element: usize) -> [Gradient; 2] {
        let to_axes = self.ring.elements[element].misalignment.rotation().transpose();
        let in_axes = |field: fn(&Matrix6<f64>, &Matrix6<f64>) -> Matrix6<f64>| {
            self.change(element, |_, map| {
                let map = to_axes * map;
                field(&inverse(&map), &map)
            })
        };
        [in_axes(normal), in_axes(skew)]
    }

    /// Derivative with respect to an integrated gradient [1/m] in the middle of an element, in the ring's axes whatever its roll.
    pub(crate) fn gradient_middle(&self, element: usize) -> Gradient {
        let (place, map) = self.transfer_to_middle(element);
        Gradient::thin(place, normal(&inverse(&map), &map))
    }

    /// Derivative with respect to an integrated gradient [1/m] at one place, in the ring's axes.
    pub fn thin_gradient(&self, place: Place) -> Gradient {
        let map = self.transfer_in_axes(place);
        Gradient::thin(place, normal(&inverse(&map), &map))
    }

    /// Derivative with respect to an integrated skew gradient [1/m] at one place, in the ring's axes.
    pub fn thin_skew_gradient(&self, place: Place) -> Gradient {
        let map = self.transfer_in_axes(place);
        Gradient::thin(place, skew(&inverse(&map), &map))
    }

    /// Derivative with respect to the strength of a thin linear element of Hamiltonian `strength z_i z_j` at one place, z = (x, x', y, y'): a position
    /// changes by the derivative of that with respect to its slope, a slope by minus the one with respect to its position; in the ring's axes. The unit of the strength is
    /// 1/m of two positions, 1 of a position and a slope, m of two slopes.
    pub fn thin_linear(&self, place: Place, [i, j]: [usize; 2]) -> Gradient {
        let map = self.transfer_in_axes(place);
        let back = inverse(&map);
        // x changes by dH/dx', x' by -dH/dx; taken away
        let part = |of: usize, by: usize| match of {
            0 => back.column(PX) * map.row(PHASE[by]),
            1 => -back.column(X) * map.row(PHASE[by]),
            2 => back.column(PY) * map.row(PHASE[by]),
            _ => -back.column(Y) * map.row(PHASE[by]),
        };
        Gradient::thin(place, part(i, j) + part(j, i))
    }

    /// `integral of T^-1 E T ds` over an element, `T^-1 E T` of a place given by `field`.
    fn change(&self, element: usize, field: impl Fn(&Matrix6<f64>, &Matrix6<f64>) -> Matrix6<f64>) -> Gradient {
        let length = self.ring.elements[element].length;
        let at = |depth: f64| {
            let map = self.transfer_into(Place { element, depth });
            field(&inverse(&map), &map)
        };
        if length == 0.0 {
            return Gradient::thin(element.into(), at(0.0));
        }
        let shares = NODES.map(|(node, weight)| at(node * length) * (weight * length));
        Gradient { place: element.into(), kernel: shares.iter().sum(), shares: Some(shares) }
    }

    /// Response of one observer to one source [m/rad].
    pub fn green(&self, observer: &Observer, source: &Source) -> f64 {
        let step = source.place < observer.place;
        let at_start = self.closed * source.column;
        (observer.row * if step { at_start + source.column } else { at_start })[0]
    }

    /// Orbit response [m/rad], rows observers, columns sources.
    pub fn response(&self, observers: &[Observer], sources: &[Source]) -> DMatrix<f64> {
        let orbits: Vec<_> = sources.iter().map(|s| (self.closed * s.column, s)).collect();
        DMatrix::from_fn(observers.len(), sources.len(), |i, j| {
            let (orbit, source) = &orbits[j];
            let near = (observers[i].row * orbit)[0];
            if source.place < observers[i].place { near + (observers[i].row * source.column)[0] } else { near }
        })
    }

    /// Derivative of [`Optics::response`] with respect to each gradient, same shape each.
    pub fn response_jacobian(
        &self,
        observers: &[Observer],
        sources: &[Source],
        gradients: &[Gradient],
    ) -> Vec<DMatrix<f64>> {
        let seen = seen_rows(observers, &self.closed);
        let columns = Matrix6xX::from_fn(sources.len(), |i, j| sources[j].column[i]);
        let closed = self.closed * &columns;
        let derivative = |gradient: &Gradient| {
            // what the gradient sends to each observer, and what each source sends into the gradient
            let row = |i: usize| seen[i][usize::from(gradient.place < observers[i].place)];
            let rows = -MatrixXx6::from_fn(observers.len(), |i, j| row(i)[j]);
            let within: Vec<_> = sources.iter().map(|source| gradient.within(source)).collect();
            let mut sent = closed.clone();
            for (j, mut sent) in sent.column_iter_mut().enumerate() {
                if sources[j].place <= gradient.place && within[j].is_none() {
                    sent += columns.column(j);
                }
            }
            let mut derivative = &rows * gradient.kernel * sent;
            for (mut column, within) in derivative.column_iter_mut().zip(within) {
                within.into_iter().for_each(|within| column += &rows * within);
            }
            derivative
        };
        gradients.iter().map(derivative).collect()
    }

    /// Observers of all read monitors, each in its own plane.
    pub fn read_monitors(&self) -> Vec<Observer> {
        self.ring.monitors_read().map(|monitor| self.observe(monitor.element, monitor.plane)).collect()
    }

    /// Observers of x or y at every monitor place.
    pub fn monitor_places(&self, plane: Plane) -> Vec<Observer> {
        self.ring.monitors.iter().map(|monitor| self.observe(monitor.element, plane)).collect()
    }

    /// Sources of all correctors, one radian each along its own axis (rolled if the corrector is).
    pub fn correctors(&self) -> Vec<Source> {
        self.ring.correctors.iter().map(|corrector| self.kick(corrector.element, self.axis(corrector))).collect()
    }

    /// Direction of a corrector's kick: `(cos, sin)` of its roll for H, `(-sin, cos)` for V.
    pub(crate) fn axis(&self, corrector: &Corrector) -> [f64; 2] {
        let (sin, cos) = self.ring.elements[corrector.element].misalignment.roll.sin_cos();
        match corrector.plane {
            Plane::X => [cos, sin],
            Plane::Y => [-sin, cos],
        }
    }

    /// Gradients of all quadrupoles `[M]`.
    pub fn quadrupoles(&self) -> Vec<Gradient> {
        self.ring.quadrupoles.iter().map(|q| self.gradient(q.element)).collect()
    }
}

/// With the momentum held: the matrix `W` of closed orbits at the start, and the dispersion there.
pub(crate) fn close_at_momentum(
    ring: &Ring,
    delta: f64,
    turn: &Matrix6<f64>,
) -> Result<(Matrix6<f64>, Vector6<f64>), OrbitError> {
    let inverse = invert(&Hold::Momentum { delta }.closure(ring, delta, turn), turn)?;
    let unit = inverse.column(4);
    Ok((closed_orbits(&inverse, turn, 4), Vector6::new(unit[0], unit[1], unit[2], unit[3], 1.0, 0.0)))
}

/// The matrix `W` of closed orbits at the start, from the inverse of the closure equations. A source drives their first
/// `driven` rows: four for the orbit, and with a fixed frequency a fifth, where its path drives the momentum.
fn closed_orbits(inverse: &Matrix5<f64>, turn: &Matrix6<f64>, driven: usize) -> Matrix6<f64> {
    let mut closed = Matrix6::zeros();
    for (row, from) in [0, 1, 2, 3, PATH].into_iter().take(driven).enumerate() {
        let mut into = closed.fixed_view_mut::<5, 6>(0, 0);
        into += inverse.column(row) * turn.row(from);
    }
    closed
}

/// Rows `a W` and `a (W + 1)` of each observer.
pub(crate) fn seen_rows(observers: &[Observer], closed: &Matrix6<f64>) -> Vec<[RowVector6<f64>; 2]> {
    let rows = |o: &Observer| {
        let near = o.row * closed;
        [near, near + o.row]
    };
    observers.iter().map(rows).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::Kind;

    const ON_MOMENTUM: Hold = Hold::Momentum { delta: 0.0 };

    #[test]
    fn response_equals_the_text_book_formula() {
        let ring = Ring::booster();
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let place = ring.monitors[ring.monitor(Plane::Y, "A1").unwrap()].element;
        // beta/2 cot(pi Q) of a kick at the monitor itself
        let own = optics.green(&optics.observe(place, Plane::Y), &optics.kick(place, [0.0, 1.0]));
        let known = 0.5 * optics.beta(place, Plane::Y) / (core::f64::consts::PI * optics.tunes().unwrap().y).tan();
        assert!((own - known).abs() < 1e-10, "{own} {known}");
    }

    /// The Booster with gradients in its dipoles, and kicks of these in both planes.
    fn with_gradients() -> (Ring, Vec<usize>) {
        let mut ring = Ring::booster();
        let is_bend = |&element: &usize| matches!(ring.elements[element].kind, Kind::Bend(_));
        let bends: Vec<usize> = (0..ring.elements.len()).filter(is_bend).collect();
        for (number, &element) in bends.iter().enumerate() {
            if let Kind::Bend(bend) = &mut ring.elements[element].kind {
                bend.k1 = if number % 2 == 0 { -0.06 } else { 0.05 };
            }
        }
        (ring, bends)
    }

    /// Many thin kicks in the place of one that is spread; their sum errs by the square of their distance.
    #[test]
    fn a_winding_kicks_all_along_its_magnet() {
        let (ring, bends) = with_gradients();
        for hold in [ON_MOMENTUM, Hold::Frequency { offset: 0.0 }] {
            let optics = Optics::of(&ring, hold).unwrap();
            let element = bends[5];
            let length = ring.elements[element].length;
            let observers = both_planes(&optics);
            for direction in [[1.0, 0.0], [0.0, 1.0]] {
                let winding = optics.response(&observers, &[optics.winding(element, direction)]);
                let pieces = 2000;
                let place = |piece: usize| Place { element, depth: (piece as f64 + 0.5) / pieces as f64 * length };
                let thin: Vec<Source> =
                    (0..pieces).map(|piece| optics.kick(place(piece), direction).times(1.0 / pieces as f64)).collect();
                let sum = optics.response(&observers, &thin).column_sum();
                assert!((winding.column(0) - sum).amax() < 1e-7 * winding.amax());
            }
        }
    }

    /// sin(f)/f and sinh(f)/f of a thin kick in the middle, curvature and gradient together.
    #[test]
    fn beyond_its_magnet_a_winding_is_a_smaller_or_a_larger_thin_kick() {
        let (ring, bends) = with_gradients();
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let element = bends[4];
        let Kind::Bend(bend) = &ring.elements[element].kind else { panic!("a dipole") };
        let half = 0.5 * ring.elements[element].length;
        let middle = Place { element, depth: half };
        let factor = |k: f64| {
            let f = k.abs().sqrt() * half;
            if k > 0.0 { f.sin() / f } else { f.sinh() / f }
        };
        let factors = [factor(bend.curvature.powi(2) + bend.k1), factor(-bend.k1)];
        for (direction, factor) in [[1.0, 0.0], [0.0, 1.0]].into_iter().zip(factors) {
            let sources = [optics.winding(element, direction), optics.kick(middle, direction)];
            let response = optics.response(&both_planes(&optics), &sources);
            let off = (response.column(0) - response.column(1) * factor).amax();
            assert!(off < 1e-10 * response.amax() && (factor - 1.0).abs() > 0.01, "{factor}: {off:e}");
        }
    }

    #[test]
    fn the_derivative_by_the_gradient_of_its_own_magnet_is_exact_for_a_winding() {
        let (ring, bends) = with_gradients();
        let element = bends[5];
        let respond = |change: f64| {
            let mut ring = ring.clone();
            if let Kind::Bend(bend) = &mut ring.elements[element].kind {
                bend.k1 += change;
            }
            let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
            optics.response(&both_planes(&optics), &[optics.winding(element, [1.0, 0.5])])
        };
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let winding = [optics.winding(element, [1.0, 0.5])];
        let exact = &optics.response_jacobian(&both_planes(&optics), &winding, &[optics.gradient(element)])[0];
        let off = (exact - (respond(1e-5) - respond(-1e-5)) / 2e-5).amax() / exact.amax();
        // differences: (1e-5)^2 and 1e-13/1e-5
        assert!(off < 1e-7, "{off:e}");
    }

    #[test]
    fn a_kick_closes_as_newton_says() {
        let mut ring = Ring::booster();
        let corrector = ring.corrector(Plane::X, "C4").unwrap();
        let at = ring.correctors[corrector].element;
        for hold in [ON_MOMENTUM, Hold::Frequency { offset: 0.0 }] {
            let plain = ring.clone();
            let optics = Optics::of(&plain, hold).unwrap();
            let linear = optics.response(&optics.monitor_places(Plane::X), &[optics.kick(at, [1e-6, 0.0])]);
            ring.set_kick(corrector, 1e-6);
            let orbit = ClosedOrbit::find(&ring, hold).unwrap();
            for (i, monitor) in ring.monitors.iter().enumerate() {
                let newton = orbit.at[monitor.element][X];
                assert!((newton - linear[i]).abs() < 1e-9, "{newton:e} {:e}", linear[i]); // second order of 1e-6 rad
            }
            ring = plain;
        }
    }

    /// Against five-point differences of the exact maps, at both holds and with a rolled quadrupole.
    #[test]
    fn thick_gradients_are_exact() {
        let mut ring = Ring::booster();
        let rolled = ring.quadrupole("C3").unwrap();
        let at = ring.quadrupoles[rolled].element;
        ring.elements[at].misalignment.roll = 0.02;
        for hold in [ON_MOMENTUM, Hold::Frequency { offset: 0.0 }] {
            let optics = Optics::of(&ring, hold).unwrap();
            let (observers, sources) = (both_planes(&optics), optics.correctors());
            for n in (0..48).filter(|n| n % 7 == 0 || *n == rolled) {
                let element = ring.quadrupoles[n].element;
                let exact = &optics.response_jacobian(&observers, &sources, &[optics.gradient(element)])[0];
                let at = |factor: f64| {
                    let mut vars = [1.0; 48];
                    vars[n] = factor;
                    let ring = ring.with_vars(&vars);
                    let optics = Optics::of(&ring, hold).unwrap();
                    optics.response(&both_planes(&optics), &optics.correctors())
                };
                let k1 = ring.gradients()[n];
                let h = 1e-4;
                // five-point difference: truncation (5e-4)^4 and rounding 1e-12/h are both below 1e-7
                let numeric =
                    ((at(1.0 + h) - at(1.0 - h)) * 8.0 - (at(1.0 + 2.0 * h) - at(1.0 - 2.0 * h))) / (12.0 * h * k1);
                let error = (exact - &numeric).abs().max() / exact.abs().max();
                assert!(error < 1e-7, "{}: {error:e}", ring.elements[element].name);
            }
        }
    }

    fn both_planes(optics: &Optics) -> Vec<Observer> {
        [optics.monitor_places(Plane::X), optics.monitor_places(Plane::Y)].concat()
    }

    /// A gradient is the Hamiltonian `k (x^2 - y^2)/2`; a solenoid turns the beam by an angle a wherever that is said in its drift, `a (x' y - x y')`.
    #[test]
    fn thin_linear_elements_are_gradients_rotations_and_drifts() {
        let ring = Ring::booster();
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let jacobian = |gradients: &[Gradient]| {
            optics.response_jacobian(&both_planes(&optics), &optics.correctors(), gradients).into_iter().sum()
        };
        let at = Place::from(ring.quadrupoles[10].element);
        let (x, y) = (optics.thin_linear(at, [0, 0]).times(0.5), optics.thin_linear(at, [2, 2]).times(-0.5));
        let gradient: DMatrix<f64> = jacobian(&[x, y]);
        let known: DMatrix<f64> = jacobian(&[optics.thin_gradient(at)]);
        assert!((gradient - &known).amax() < 1e-12 * known.amax(), "rounding");
        let is_drift = |element: &Element| element.kind == Kind::Drift && element.length > 0.5;
        let skew: DMatrix<f64> = jacobian(&[optics.thin_linear(at, [0, 2]).times(-1.0)]);
        let known: DMatrix<f64> = jacobian(&[optics.thin_skew_gradient(at)]);
        assert!((skew - &known).amax() < 1e-12 * known.amax(), "rounding");
        let drift = ring.elements.iter().position(is_drift).unwrap();
        let length = ring.elements[drift].length;
        let longer = |by: f64| {
            let mut ring = ring.clone();
            ring.elements[drift].length += by;
            let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
            optics.response(&both_planes(&optics), &optics.correctors())
        };
        let exact = (longer(1e-4) - longer(-1e-4)) / 2e-4;
        let here = Place { element: drift, depth: 0.5 * length };
        let drifted: DMatrix<f64> = jacobian(&[[1, 1], [3, 3]].map(|form| optics.thin_linear(here, form).times(0.5)));
        assert!((drifted - &exact).amax() < 1e-6 * exact.amax(), "second order of 0.1 mm, and rounding");
        let with = |angle: f64| {
            let mut ring = ring.clone();
            ring.elements[drift].kind = Kind::Solenoid { ks: 2.0 * angle / length };
            let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
            optics.response(&both_planes(&optics), &optics.correctors())
        };
        let exact = (with(1e-4) - with(-1e-4)) / 2e-4;
        for depth in [0.1, 0.9].map(|share| share * length) {
            let at = Place { element: drift, depth };
            let turned = [optics.thin_linear(at, [1, 2]), optics.thin_linear(at, [0, 3]).times(-1.0)];
            let turned: DMatrix<f64> = jacobian(&turned);
            // second order of 0.1 mrad, and rounding
            assert!((turned - &exact).amax() < 1e-6 * exact.amax());
        }
    }

    /// A rolled quadrupole is one of `k1 cos 2a` with a skew gradient of `-k1 sin 2a`; against differences of the exact twin.
    #[test]
    fn skew_gradients_are_exact() {
        let ring = Ring::booster();
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let (observers, sources) = (both_planes(&optics), optics.correctors());
        for (q, k1) in ring.quadrupoles.iter().zip(ring.gradients()).step_by(7) {
            let at = q.element;
            let respond = |roll: f64| {
                let mut ring = ring.clone();
                ring.elements[at].misalignment.roll = roll;
                let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
                optics.response(&both_planes(&optics), &optics.correctors())
            };
            let exact = &optics.response_jacobian(&observers, &sources, &[optics.skew_gradient(at)])[0];
            let numeric = (respond(1e-4) - respond(-1e-4)) / (-4e-4 * k1);
            let error = (exact - &numeric).abs().max() / exact.abs().max();
            assert!(error < 1e-6, "{}: {error:e}", ring.elements[at].name); // truncation (2e-4)^2
        }
    }

    #[test]
    fn a_thin_rolled_gradient_and_a_kick_at_its_entrance_are_exact() {
        let mut ring = Ring::booster();
        let at = ring.element("SLOT_F6").unwrap();
        ring.elements[at].kind = Kind::Multipole { k1l: 0.0, k1sl: 0.0, k2l: 0.0, k3l: 0.0 };
        ring.elements[at].misalignment.roll = 0.3;
        let respond = |k1l: f64| {
            let mut ring = ring.clone();
            ring.elements[at].kind = Kind::Multipole { k1l, k1sl: 0.0, k2l: 0.0, k3l: 0.0 };
            let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
            optics.response(&both_planes(&optics), &[optics.kick(at, [1.0, 0.0])])
        };
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let kick = [optics.kick(at, [1.0, 0.0])];
        let exact = &optics.response_jacobian(&both_planes(&optics), &kick, &[optics.gradient(at)])[0];
        let numeric = (respond(1e-5) - respond(-1e-5)) / 2e-5;
        assert!((exact - numeric).abs().max() < 1e-6 * exact.abs().max()); // differences: (1e-5)^2 and 1e-13/1e-5
    }
}
