//! One element of a ring: what stands where, and what it does to the beam.

/// Transverse plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Plane {
    /// Horizontal, x outward.
    X,
    /// Vertical, y up.
    Y,
}

impl Plane {
    /// Where it stands in a pair of x and y.
    pub const fn index(self) -> usize {
        match self {
            Self::X => 0,
            Self::Y => 1,
        }
    }
}

/// Shift and roll of an element's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Misalignment {
    /// Horizontal shift [m].
    pub dx: f64,
    /// Vertical shift [m].
    pub dy: f64,
    /// Rotation about the beam axis, positive from x to y [rad].
    pub roll: f64,
}

impl Misalignment {
    /// True for an element in its place.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// A sector dipole.
#[derive(Debug, Clone, PartialEq)]
pub struct Bend {
    /// Curvature of the reference orbit, and of the field [1/m].
    pub curvature: f64,
    /// Gradient of the body [1/m^2].
    pub k1: f64,
    /// Sextupole of the body [1/m^3].
    pub k2: f64,
    /// Entrance edge angle [rad], MAD's e1.
    pub e1: f64,
    /// Exit edge angle [rad], MAD's e2.
    pub e2: f64,
    /// Soft-edge integral times full gap, `2 fint hgap` [m].
    pub fringe: f64,
}

/// What an element does to the beam.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// Field-free space.
    Drift,
    /// A named place.
    Marker,
    /// Beam position monitor; which planes it reads stands in [`Ring::monitors`](crate::Ring::monitors).
    Monitor,
    /// Steering magnet that kicks at its entrance; in which planes it can stands in
    /// [`Ring::correctors`](crate::Ring::correctors).
    Corrector {
        /// Kick in x and y [rad].
        kick: [f64; 2],
    },
    /// Quadrupole of gradient `k1` [1/m^2], focusing in x if positive.
    Quadrupole {
        /// Gradient over the rigidity [1/m^2].
        k1: f64,
    },
    /// Sector dipole.
    Bend(Bend),
    /// Sextupole of `k2` [1/m^3].
    Sextupole {
        /// Second derivative of the field over the rigidity [1/m^3].
        k2: f64,
    },
    /// Thin multipole at the entrance, then field-free, as where a stray field is in a free straight.
    Multipole {
        /// Integrated gradient [1/m].
        k1l: f64,
        /// Integrated skew gradient [1/m], `x' += k1sl y`, `y' += k1sl x`.
        k1sl: f64,
        /// Integrated sextupole [1/m^2].
        k2l: f64,
        /// Integrated octupole [1/m^3], `x' -= K3L (x^3 - 3 x y^2)/6`, `y' -= K3L (y^3 - 3 x^2 y)/6`.
        k3l: f64,
    },
    /// Thin lens of a planar wiggler at the entrance, then field-free: its poles focus vertically, and horizontally it is a drift on average.
    ///
    /// Source: R. P. Walker, Nucl. Instrum. Methods 214 (1983) 497, `y'' = -y/(2 rho^2)` of poles of radius `rho`.
    Wiggler {
        /// Integrated vertical focusing [1/m], `y' -= focusing y`.
        focusing: f64,
    },
    /// Solenoid of field over rigidity `ks` [1/m].
    Solenoid {
        /// Field over the rigidity [1/m].
        ks: f64,
    },
}

/// One element of a ring.
#[derive(Debug, Clone, PartialEq)]
pub struct Element {
    /// Name in the machine file; drifts that fill the gaps have none.
    pub name: String,
    /// Short name, unique among elements of its sort: `D8` of `QH_D8`.
    pub label: String,
    /// Part of the ring it belongs to, for reports.
    pub sector: Option<String>,
    /// What it does.
    pub kind: Kind,
    /// Position of its entrance [m].
    pub s: f64,
    /// Length along the reference orbit [m].
    pub length: f64,
    /// Shift and roll.
    pub misalignment: Misalignment,
}

impl Kind {
    /// Gradient of a quadrupole or of a dipole [1/m^2], none of what cannot have one along its body.
    pub fn gradient(&self) -> Option<f64> {
        match self {
            Self::Quadrupole { k1 } => Some(*k1),
            Self::Bend(bend) => Some(bend.k1),
            _ => None,
        }
    }

    /// The same to be changed.
    pub fn gradient_mut(&mut self) -> Option<&mut f64> {
        match self {
            Self::Quadrupole { k1 } => Some(k1),
            Self::Bend(bend) => Some(&mut bend.k1),
            _ => None,
        }
    }
}

impl Element {
    /// Field-free space without a name.
    pub fn drift(s: f64, length: f64) -> Self {
        Self {
            name: String::new(),
            label: String::new(),
            sector: None,
            kind: Kind::Drift,
            s,
            length,
            misalignment: Misalignment::default(),
        }
    }

    /// True if this is what it is called: by its label or by its name.
    pub fn is_called(&self, name: &str) -> bool {
        self.label == name || self.name == name
    }
}
