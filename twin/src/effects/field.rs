//! Fields that the model does not have: gradients, edges, rolled quadrupoles, sextupoles, octupoles.
//!
//! The exact form is the changed element, and so is the form per frame, but that the field of a sextupole or an octupole depends on the
//! orbit that passes it: to a small deviation it is a gradient and a skew gradient ([`Machine::on_orbit`]), to larger ones curved ([`Crossed`]).
//! The derivative is one formula for all gradients, `dR = -a (W + step) Q (W + step) c` of [`crate::response`].

use nalgebra::{DMatrix, MatrixXx2, RowVector2};

use super::drives::Drives;
use super::hold::Held;
use super::mechanism::{Measured, Mechanism, Unit};
use super::{EffectError, EffectKind, Machine, Signature, Signatures};
use crate::lattice::{Bend, Element, Kind, Plane, Ring};
use crate::response::{Gradient, Optics, Place};
use crate::site::Site;

/// What is wrong with the fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FieldEffect {
    /// A quadrupole is rotated [rad].
    QuadRoll,
    /// A gradient in a free straight, K1L [1/m].
    StrayGradient,
    /// A skew gradient in a free straight, K1sL [1/m].
    StraySkewGradient,
    /// A gradient in a dipole's body, K1L [1/m].
    DipoleGradient,
    /// Edge angle of one dipole, or of all [rad].
    DipoleEdge,
    /// A field in a sextupole, K2L [1/m^2].
    Sextupole,
    /// A sextupole in the body of every dipole, K2L of each [1/m^2].
    DipoleSextupole,
    /// An octupole in a free straight, K3L [1/m^3].
    StrayOctupole,
}

/// A thin gradient at one place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Thin {
    /// `x' -= K1L x`, `y' += K1L y`.
    Normal,
    /// `x' += K1sL y`, `y' += K1sL x`.
    Skew,
}

impl Thin {
    /// The kind of effect that is one.
    pub const fn kind(self) -> EffectKind {
        match self {
            Self::Normal => EffectKind::StrayGradient,
            Self::Skew => EffectKind::StraySkewGradient,
        }
    }
}

impl FieldEffect {
    /// The thin gradient that acts on the beam as it does, if any.
    pub fn thin(self) -> Option<Thin> {
        match self {
            Self::StrayGradient | Self::DipoleGradient => Some(Thin::Normal),
            Self::StraySkewGradient | Self::QuadRoll => Some(Thin::Skew),
            Self::DipoleEdge | Self::Sextupole | Self::DipoleSextupole | Self::StrayOctupole => None,
        }
    }

    /// True for a field that does not grow with the magnets.
    pub fn is_stray(self) -> bool {
        match self {
            Self::StrayGradient | Self::StraySkewGradient | Self::StrayOctupole => true,
            Self::QuadRoll | Self::DipoleGradient | Self::DipoleEdge | Self::Sextupole | Self::DipoleSextupole => false,
        }
    }

    /// Change a ring, if the site is one of the kind.
    fn put(self, ring: &mut Ring, site: Site, amplitude: f64) -> Option<()> {
        match (self, site) {
            (Self::QuadRoll, Site::Quadrupole(at)) => {
                ring.elements[ring.quadrupoles[at].element].misalignment.roll += amplitude;
            }
            (Self::StrayGradient, Site::Element(at)) => stray(&mut ring.elements[at].kind, [amplitude, 0.0, 0.0])?,
            (Self::StraySkewGradient, Site::Element(at)) => stray(&mut ring.elements[at].kind, [0.0, amplitude, 0.0])?,
            (Self::StrayOctupole, Site::Element(at)) => stray(&mut ring.elements[at].kind, [0.0, 0.0, amplitude])?,
            (Self::DipoleGradient, Site::Element(at)) => {
                let per_length = amplitude / ring.elements[at].length;
                bend(&mut ring.elements[at])?.k1 += per_length;
            }
            (Self::DipoleEdge, Site::Element(at)) => turn_edges(bend(&mut ring.elements[at])?, amplitude),
            (Self::DipoleEdge, Site::Ring) => {
                ring.elements.iter_mut().filter_map(bend).for_each(|bend| turn_edges(bend, amplitude));
            }
            (Self::Sextupole, Site::Element(at)) => {
                let length = ring.elements[at].length;
                let Kind::Sextupole { k2 } = &mut ring.elements[at].kind else { return None };
                *k2 += amplitude / length;
            }
            (Self::DipoleSextupole, Site::Ring) => {
                for element in &mut ring.elements {
                    let length = element.length;
                    bend(element).into_iter().for_each(|bend| bend.k2 += amplitude / length);
                }
            }
            _ => return None,
        }
        Some(())
    }
}

impl Mechanism for FieldEffect {
    fn word(&self) -> &'static str {
        match self {
            Self::QuadRoll => "quad_roll",
            Self::StrayGradient => "stray_gradient",
            Self::StraySkewGradient => "stray_skew_gradient",
            Self::DipoleGradient => "dipole_gradient",
            Self::DipoleEdge => "dipole_edge",
            Self::Sextupole => "sextupole_error",
            Self::DipoleSextupole => "dipole_sextupole",
            Self::StrayOctupole => "stray_octupole",
        }
    }

    /// Supports turn a quadrupole by 10 mrad, ten times the survey's 1 to 5 mrad; a stray gradient is a tenth of a quadrupole, whose
    /// K1L is 0.28/m, skew and in a dipole half of that; edges differ by a tenth of the angle over which a rectangular magnet
    /// would; a chromaticity sextupole at full current has some 1/m2. Eddy currents in a chamber of conductivity s and thickness t between poles a
    /// distance 2 h apart make, by Ampere's law, `B'' = mu0 s t (dB/dt)/h`: 2 mm of Inconel (8e5 S/m), 5 T/s and 4 cm make 0.25 T/m2, over 2.4 m at 6 Tm
    /// K2L = 0.1/m2. An octupole of 0.3 m with 0.17 T at its poles 8 cm away has 100/m3 at 6 Tm.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::QuadRoll => Some(0.015),
            Self::StrayGradient => Some(0.025),
            Self::StraySkewGradient | Self::DipoleGradient => Some(0.012),
            Self::DipoleEdge => Some(0.05),
            Self::Sextupole => Some(2.0),
            Self::DipoleSextupole => Some(0.1),
            Self::StrayOctupole => Some(100.0),
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::QuadRoll | Self::DipoleEdge => Unit::ANGLE,
            Self::StrayGradient | Self::StraySkewGradient | Self::DipoleGradient => Unit::PER_METRE,
            Self::Sextupole | Self::DipoleSextupole => Unit::PER_SQUARE_METRE,
            Self::StrayOctupole => Unit::PER_CUBIC_METRE,
        }
    }

    fn sites(&self, ring: &Ring) -> Vec<Site> {
        let elements = |is: fn(&Kind) -> bool| {
            let found = ring.elements.iter().enumerate().filter(move |(_, element)| is(&element.kind));
            found.map(|(at, _)| Site::Element(at))
        };
        match self {
            Self::QuadRoll => (0..ring.quadrupoles.len()).map(Site::Quadrupole).collect(),
            Self::StrayGradient | Self::StraySkewGradient | Self::StrayOctupole => {
                elements(|kind| matches!(kind, Kind::Marker)).collect()
            }
            Self::DipoleGradient => elements(is_bend).collect(),
            Self::DipoleEdge => elements(is_bend).chain([Site::Ring]).collect(),
            Self::Sextupole => elements(is_sextupole).collect(),
            Self::DipoleSextupole => vec![Site::Ring],
        }
    }

    fn expected(&self) -> &'static str {
        match self {
            Self::QuadRoll => "a quadrupole",
            Self::StrayGradient | Self::StraySkewGradient | Self::StrayOctupole => "a free straight",
            Self::DipoleGradient | Self::DipoleEdge => "a dipole",
            Self::Sextupole => "a sextupole",
            Self::DipoleSextupole => "no place",
        }
    }

    fn site(&self, ring: &Ring, name: &str) -> Option<Site> {
        match self {
            Self::QuadRoll => ring.quadrupole(name).ok().map(Site::Quadrupole),
            Self::StrayGradient | Self::StraySkewGradient | Self::StrayOctupole => {
                Site::element(ring, name, |kind| matches!(kind, Kind::Marker | Kind::Multipole { .. }))
                    .map(Site::Element)
            }
            Self::DipoleEdge | Self::DipoleSextupole if name.is_empty() => Some(Site::Ring),
            Self::DipoleSextupole => None,
            Self::DipoleEdge | Self::DipoleGradient => Site::element(ring, name, is_bend).map(Site::Element),
            Self::Sextupole => {
                let short = || Site::element(ring, name.strip_prefix("SX_")?, is_sextupole);
                Site::element(ring, name, is_sextupole).or_else(short).map(Site::Element)
            }
        }
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        let put = self.put(&mut machine.ring, site, amplitude);
        put.ok_or_else(|| self.misplaced(&machine.ring, site.name(&machine.ring)))?;
        match (self, site) {
            (Self::Sextupole, Site::Element(at)) => machine.curved.push(Curved::sextupole(at, amplitude)),
            (Self::DipoleSextupole, _) => {
                machine.curved.extend(dipoles(&machine.ring).map(|at| Curved::sextupole(at, amplitude)));
            }
            (Self::StrayOctupole, Site::Element(at)) => machine.curved.push(Curved::octupole(at, amplitude)),
            _ => {}
        }
        Ok(())
    }

    fn signature(&self, about: &Signatures, site: Site) -> Result<Signature, EffectError> {
        let (ring, optics) = (&about.machine.ring, &about.optics);
        match (self, site) {
            (Self::QuadRoll, Site::Quadrupole(at)) => {
                // x'' = -k1 (x cos 2a + y sin 2a)
                let skew = optics.skew_gradient(ring.quadrupoles[at].element);
                Ok(about.of_gradient(&skew, -2.0 * ring.gradients()[at]))
            }
            (Self::StrayGradient, Site::Element(at)) => Ok(thin(about, at.into(), Thin::Normal)),
            (Self::StraySkewGradient, Site::Element(at)) => Ok(thin(about, at.into(), Thin::Skew)),
            (Self::DipoleGradient, Site::Element(at)) => {
                Ok(about.of_gradient(&optics.gradient(at), 1.0 / ring.elements[at].length))
            }
            (Self::DipoleEdge, Site::Element(at)) => Ok(edges(about, [at])),
            (Self::DipoleEdge, Site::Ring) => Ok(edges(about, 0..ring.elements.len())),
            (Self::Sextupole, Site::Element(at)) => Ok(sextupole(about, at)),
            (Self::DipoleSextupole, Site::Ring) => Ok(in_dipoles(about)),
            (Self::StrayOctupole, Site::Element(at)) => Ok(octupole(about, at)),
            _ => Err(self.misplaced(ring, site.name(ring))),
        }
    }

    fn orbit(&self, _ring: &Ring, site: Site) -> Vec<(usize, Plane)> {
        match (self, site) {
            (Self::Sextupole | Self::StrayOctupole, Site::Element(at)) => vec![(at, Plane::X), (at, Plane::Y)],
            _ => Vec::new(),
        }
    }

    fn phrase(&self, ring: &Ring, site: Site, amplitude: Measured) -> String {
        let name = site.name(ring);
        match (self, site) {
            (Self::QuadRoll, _) => format!("quadrupole {name} is rolled by {} mrad", amplitude.signed(1e3)),
            (Self::StrayGradient, _) => format!("there is a gradient K1L = {} /m at {name}", amplitude.signed(1.0)),
            (Self::StraySkewGradient, _) => {
                format!("there is a skew gradient K1sL = {} /m at {name}", amplitude.signed(1.0))
            }
            (Self::DipoleGradient, _) => format!("dipole {name} has a gradient K1L = {} /m", amplitude.signed(1.0)),
            (Self::DipoleEdge, Site::Ring) => format!("all dipoles have edge angles of {} mrad", amplitude.signed(1e3)),
            (Self::DipoleEdge, _) => format!("dipole {name} has edge angles of {} mrad", amplitude.signed(1e3)),
            (Self::DipoleSextupole, _) => format!("all dipoles have a field K2L = {} /m2", amplitude.signed(1.0)),
            (Self::Sextupole, _) => format!("sextupole {name} has a field K2L = {} /m2", amplitude.signed(1.0)),
            (Self::StrayOctupole, _) => format!("there is an octupole K3L = {} /m3 at {name}", amplitude.signed(1.0)),
        }
    }
}

fn is_bend(kind: &Kind) -> bool {
    matches!(kind, Kind::Bend(_))
}

/// The dipoles, by element.
fn dipoles(ring: &Ring) -> impl Iterator<Item = usize> {
    (0..ring.elements.len()).filter(|&at| is_bend(&ring.elements[at].kind))
}

fn is_sextupole(kind: &Kind) -> bool {
    matches!(kind, Kind::Sextupole { .. })
}

fn bend(element: &mut Element) -> Option<&mut Bend> {
    match &mut element.kind {
        Kind::Bend(bend) => Some(bend),
        _ => None,
    }
}

fn turn_edges(bend: &mut Bend, angle: f64) {
    bend.e1 += angle;
    bend.e2 += angle;
}

/// Add K1L, K1sL and K3L to the thin multipole at its entrance that a free straight then is.
fn stray(kind: &mut Kind, [normal, skew, octupole]: [f64; 3]) -> Option<()> {
    if *kind == Kind::Marker {
        *kind = Kind::Multipole { k1l: 0.0, k1sl: 0.0, k2l: 0.0, k3l: 0.0 };
    }
    let Kind::Multipole { k1l, k1sl, k3l, .. } = kind else { return None };
    *k1l += normal;
    *k1sl += skew;
    *k3l += octupole;
    Some(())
}

/// Of a thin gradient anywhere.
pub(super) fn thin(about: &Signatures, place: Place, kind: Thin) -> Signature {
    let gradient: Gradient = match kind {
        Thin::Normal => about.optics.thin_gradient(place),
        Thin::Skew => about.optics.thin_skew_gradient(place),
    };
    about.of_gradient(&gradient, 1.0)
}

/// Pole faces of some dipoles: to first order an edge of angle e is a thin gradient of `-h tan e`, h the bend's curvature. That a
/// soft fringe focuses y a little less is left out.
fn edges(about: &Signatures, elements: impl IntoIterator<Item = usize>) -> Signature {
    let of = |at: usize| {
        let element = &about.machine.ring.elements[at];
        let ends = match &element.kind {
            Kind::Bend(bend) => [(0.0, bend.e1), (element.length, bend.e2)].map(|end| Some((end, bend.curvature))),
            _ => [None; 2],
        };
        ends.into_iter().flatten().map(move |((depth, angle), curvature)| {
            (about.optics.thin_gradient(Place { element: at, depth }), -curvature / f64::cos(angle).powi(2))
        })
    };
    about.of_gradients(elements.into_iter().flat_map(of))
}

/// Feed-down of the orbit that passes a sextupole, and the quadratic kick of the orbit that the correctors add, per unit of K2L.
fn sextupole(about: &Signatures, at: usize) -> Signature {
    let ring = &about.machine.ring;
    let ([x, y], per_length) = (about.drives.orbit[at], 1.0 / ring.elements[at].length);
    // it is a rolled quadrupole where it has a field already
    let [normal, skew] = about.optics.gradients_in_axes(at);
    let mut signature = about.of_gradient(&normal, x * per_length);
    // a skew gradient moves no tune to first order
    signature.readings += about.of_gradient(&skew, y * per_length).readings;
    add_crossed(&mut signature, about, &[Curved::sextupole(at, 1.0)]);
    signature
}

/// The same of an octupole, per unit of K3L.
fn octupole(about: &Signatures, at: usize) -> Signature {
    let [x, y] = about.drives.orbit[at];
    let mut signature = about.of_gradient(&about.optics.thin_gradient(at.into()), 0.5 * (x * x - y * y));
    // a skew gradient moves no tune to first order
    signature.readings += about.of_gradient(&about.optics.thin_skew_gradient(at.into()), x * y).readings;
    add_crossed(&mut signature, about, &[Curved::octupole(at, 1.0)]);
    signature
}

/// That of a sextupole, of all dipoles: gradients of their feed-down, and the rest of the kick of what crosses them, per unit of the K2L of each.
fn in_dipoles(about: &Signatures) -> Signature {
    let ring = &about.machine.ring;
    let of = |at: usize| (about.optics.gradient(at), across(&about.drives.orbit, at)[0] / ring.elements[at].length);
    let mut signature = about.of_gradients(dipoles(ring).map(of));
    let fields: Vec<Curved> = dipoles(ring).map(|at| Curved::sextupole(at, 1.0)).collect();
    add_crossed(&mut signature, about, &fields);
    signature
}

/// Add the kicks of the orbit that crosses some fields, without what these do to the orbit in turn, and its changes of the tunes.
fn add_crossed(signature: &mut Signature, about: &Signatures, fields: &[Curved]) {
    let crossed = Crossed::of(&about.optics, &about.held, fields, about.drives, &about.kick);
    signature.readings += about.machine.ring.own_planes(&crossed.seen(&crossed.kicks(&crossed.orbit)));
    signature.tune_changes += crossed.tune_changes();
}

/// A field beyond the ring's that is no gradient.
#[derive(Debug, Clone, Copy)]
pub(super) struct Curved {
    element: usize,
    /// Sextupole [1/m^2].
    k2l: f64,
    /// Octupole [1/m^3].
    k3l: f64,
}

impl Curved {
    fn sextupole(element: usize, k2l: f64) -> Self {
        Self { element, k2l, k3l: 0.0 }
    }

    fn octupole(element: usize, k3l: f64) -> Self {
        Self { element, k2l: 0.0, k3l }
    }
}

/// The orbit (x, y) across an element, mean of both ends [m].
fn across(orbit: &[[f64; 2]], at: usize) -> [f64; 2] {
    let next = orbit[(at + 1) % orbit.len()];
    [0, 1].map(|plane| 0.5 * (orbit[at][plane] + next[plane]))
}

impl Machine {
    /// The same machine as small deviations from its orbit without kicks (x, y) see it: each stray sextupole is a gradient `k2 x`
    /// and a skew gradient `k2 y`, which together are a rolled quadrupole; in a dipole it is the gradient, and the skew one belongs to what
    /// crosses it. An octupole is a gradient `K3L (x^2 - y^2)/2` and a skew gradient `K3L x y`. Their dipole parts are in the orbit already. Fields of the
    /// ring itself stay as they are: what their feed-down does is in the strengths.
    #[must_use]
    pub fn on_orbit(&self, orbit: &[[f64; 2]]) -> Self {
        let mut machine = self.clone();
        for &Curved { element: at, k2l, k3l } in &self.curved {
            let ([x, y], element) = (orbit[at], &mut machine.ring.elements[at]);
            match &mut element.kind {
                Kind::Sextupole { .. } => {
                    // of all effects there: what it becomes is no sextupole for the next of them
                    let there = self.curved.iter().filter(|one| one.element == at).map(|one| one.k2l);
                    element.kind = Kind::Quadrupole { k1: there.sum::<f64>() / element.length * x.hypot(y) };
                    element.misalignment.roll = -0.5 * y.atan2(x);
                }
                Kind::Bend(bend) => {
                    let k2 = k2l / element.length;
                    bend.k1 += k2 * across(orbit, at)[0];
                    bend.k2 -= k2;
                }
                Kind::Multipole { k1l, k1sl, k3l: whole, .. } => {
                    *k1l += 0.5 * k3l * (x * x - y * y);
                    *k1sl += k3l * x * y;
                    *whole -= k3l;
                }
                _ => {}
            }
        }
        machine
    }
}

/// Rounds of the orbit in these fields and the kicks that it gets there, at most. Each leaves a share `G K2L dx` of the error, 0.1 for
/// 5 /m2 crossed 3 mm off the orbit.
const ROUNDS: usize = 8;
/// Change of the kicks in a round below which they have settled [rad]: some 0.1 nm at a monitor.
const SETTLED: f64 = 1e-11;

/// What crosses the stray sextupoles and octupoles of a machine beside the orbit (x, y) without kicks. With (dx, dy) the orbit in the middle of
/// each, `a = K2L + K3L x` and `b = K3L y`,
///
/// `dx' = -a (dx^2 - dy^2)/2 + b dx dy - K3L (dx^3 - 3 dx dy^2)/6 + S dy`,
/// `dy' = a dx dy + b (dx^2 - dy^2)/2 - K3L (dy^3 - 3 dx^2 dy)/6 + S dx`,
///
/// the fields' expansion about that orbit less its gradients, which are in the ring; but for the skew gradient `S = K2L y` of a dipole. It holds what the
/// correctors and the RF offset make, and what these kicks make in turn.
pub(super) struct Crossed {
    fields: Vec<FieldOnOrbit>,
    /// Orbit that correctors and RF offset make in their middles: rows frames, columns x and y of each [m].
    orbit: DMatrix<f64>,
    /// Orbit there by kicks there [m/rad].
    back: DMatrix<f64>,
    /// x and y at all monitors by kicks there [m/rad].
    monitors: [DMatrix<f64>; 2],
}

/// One field about the orbit that passes it.
struct FieldOnOrbit {
    /// Normal and skew sextupole, `a` and `b` [1/m^2].
    sextupole: [f64; 2],
    /// K3L [1/m^3].
    octupole: f64,
    /// S [1/m].
    skew: f64,
    /// Change of both tunes by a gradient there [m].
    tune_slope: [f64; 2],
}

impl FieldOnOrbit {
    fn of(optics: &Optics, &Curved { element, k2l, k3l }: &Curved, orbit: &[[f64; 2]]) -> Self {
        let is_of_a_dipole = is_bend(&optics.ring.elements[element].kind);
        let [x, y] = orbit[element];
        Self {
            sextupole: [k2l + k3l * x, k3l * y],
            octupole: k3l,
            skew: if is_of_a_dipole { k2l * across(orbit, element)[1] } else { 0.0 },
            tune_slope: optics.tune_slope(&optics.gradient_middle(element)),
        }
    }

    /// Kick of an orbit [rad].
    fn kick(&self, x: f64, y: f64) -> [f64; 2] {
        let ([a, b], cubic) = (self.sextupole, self.octupole / 6.0);
        let (half, product) = (0.5 * (x * x - y * y), x * y);
        [
            self.skew * y - a * half + b * product - cubic * x * (x * x - 3.0 * y * y),
            self.skew * x + a * product + b * half - cubic * y * (y * y - 3.0 * x * x),
        ]
    }

    /// Gradient on an orbit, less that without kicks [1/m].
    fn gradient(&self, x: f64, y: f64) -> f64 {
        let [a, b] = self.sextupole;
        a * x - b * y + 0.5 * self.octupole * (x * x - y * y)
    }
}

impl Crossed {
    /// Of some fields in a ring that holds something; `kick`: rows frames, columns correctors [rad].
    pub fn of(optics: &Optics, held: &Held, fields: &[Curved], drives: &Drives, kick: &DMatrix<f64>) -> Self {
        let (mut observers, mut sources) = (Vec::new(), Vec::new());
        for field in fields {
            observers.extend(optics.observe_middle(field.element));
            sources.extend(optics.kick_middle(field.element));
        }
        let mut orbit = kick * held.response(optics, &observers, &optics.correctors()).transpose();
        orbit.ger(1.0, &drives.rf_offset, &held.rf_response(optics, &observers), 1.0);
        Self {
            fields: fields.iter().map(|field| FieldOnOrbit::of(optics, field, &drives.orbit)).collect(),
            orbit,
            back: held.response(optics, &observers, &sources),
            monitors: [Plane::X, Plane::Y].map(|plane| held.response(optics, &optics.monitor_places(plane), &sources)),
        }
    }

    /// What the orbit of each frame does to the tunes by its feed-down, rows frames.
    pub fn tune_changes(&self) -> MatrixXx2<f64> {
        let mut changes = MatrixXx2::zeros(self.orbit.nrows());
        for (i, field) in self.fields.iter().enumerate() {
            let gradient = self.orbit.column(2 * i).zip_map(&self.orbit.column(2 * i + 1), |x, y| field.gradient(x, y));
            changes += gradient * RowVector2::from(field.tune_slope);
        }
        changes
    }

    /// Kicks of an orbit, same shape [rad].
    fn kicks(&self, orbit: &DMatrix<f64>) -> DMatrix<f64> {
        let mut kicks = DMatrix::zeros(orbit.nrows(), orbit.ncols());
        for (i, field) in self.fields.iter().enumerate() {
            for frame in 0..orbit.nrows() {
                let [x, y] = field.kick(orbit[(frame, 2 * i)], orbit[(frame, 2 * i + 1)]);
                (kicks[(frame, 2 * i)], kicks[(frame, 2 * i + 1)]) = (x, y);
            }
        }
        kicks
    }

    /// x and y at all monitors that kicks make, rows frames [m].
    fn seen(&self, kicks: &DMatrix<f64>) -> [DMatrix<f64>; 2] {
        [0, 1].map(|plane| kicks * self.monitors[plane].transpose())
    }

    /// What the monitors see of the kicks on the orbit that holds their own effect.
    pub fn curved(&self) -> [DMatrix<f64>; 2] {
        let (back, mut kicks) = (self.back.transpose(), self.kicks(&self.orbit));
        for _ in 1..ROUNDS {
            let again = self.kicks(&(&self.orbit + &kicks * &back));
            let moved = (&again - &kicks).amax();
            kicks = again;
            if moved < SETTLED {
                break;
            }
        }
        self.seen(&kicks)
    }
}
