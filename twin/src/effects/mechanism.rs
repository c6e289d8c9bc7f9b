//! The properties of a kind of effect, and its words.

use super::{EffectError, Machine, Signature, Signatures};
use crate::lattice::{Plane, Ring};
use crate::site::Site;

/// How a kind of effect works: before any data, in the machine, and to first order.
///
/// What the machine does with it (exact orbits of single cycles, linear readings of all frames) follows from what
/// [`Mechanism::apply`] leaves in the machine; [`Mechanism::signature`] is the derivative of the latter with respect to the amplitude.
pub trait Mechanism {
    /// The word for it, as on the command line.
    fn word(&self) -> &'static str;

    /// Standard deviation of the amplitude among faults worth finding, mean 0, in the unit of the kind; `None` where the
    /// effect is there or not, without an amplitude.
    fn prior_scale(&self) -> Option<f64>;

    /// Unit of the amplitude.
    fn unit(&self) -> Unit;

    /// Every site where it may act, in the order of the ring.
    fn sites(&self, ring: &Ring) -> Vec<Site>;

    /// The sort of place where it acts, for messages.
    fn expected(&self) -> &'static str;

    /// The site that a name stands for, empty for the whole ring.
    fn site(&self, ring: &Ring, name: &str) -> Option<Site>;

    /// Put it into a machine.
    ///
    /// # Errors
    /// [`EffectError::Place`] at a site where the kind cannot act.
    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError>;

    /// Derivative of readings and tunes with respect to the amplitude; the whole change without one. Unless the kind has a formula
    /// for it, a difference of two machines.
    ///
    /// # Errors
    /// [`EffectError`] at a site where the kind cannot act, or if it makes the ring unstable.
    fn signature(&self, about: &Signatures, site: Site) -> Result<Signature, EffectError> {
        about.difference(self, site)
    }

    /// Coordinates of the orbit without kicks (element and plane) that decide how large it shows; none for most.
    fn orbit(&self, _ring: &Ring, _site: Site) -> Vec<(usize, Plane)> {
        Vec::new()
    }

    /// What is said of it: place, amplitude and error bar in the words of a control room.
    fn phrase(&self, ring: &Ring, site: Site, amplitude: Measured) -> String;

    /// The error of a name or a site that is none for it.
    fn misplaced(&self, ring: &Ring, found: String) -> EffectError {
        let example = self.sites(ring).first().map_or(String::new(), |site| site.name(ring));
        let example = if example.is_empty() { example } else { format!(" such as {example}") };
        EffectError::Place { kind: self.word(), expected: format!("{}{example}", self.expected()), found }
    }
}

/// A unit, as files state it and as people read it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unit {
    /// In files, `1` for a number without one.
    pub symbol: &'static str,
    /// What people read, after the number.
    pub shown: &'static str,
    /// How many of those one is.
    pub factor: f64,
}

impl Unit {
    /// Of an effect that is there or not.
    pub const NONE: Self = Self { symbol: "1", shown: "", factor: 1.0 };
    /// A relative error, read as a percentage.
    pub const PERCENT: Self = Self { symbol: "1", shown: "%", factor: 100.0 };
    /// A small relative error, read in thousandths.
    pub const PER_MILLE: Self = Self { symbol: "1", shown: "per mille", factor: 1e3 };
    /// An angle [rad], read in mrad.
    pub const ANGLE: Self = Self { symbol: "rad", shown: "mrad", factor: 1e3 };
    /// An integrated gradient [1/m].
    pub const PER_METRE: Self = Self { symbol: "1/m", shown: "/m", factor: 1.0 };
    /// An integrated sextupole field [1/m^2].
    pub const PER_SQUARE_METRE: Self = Self { symbol: "1/m2", shown: "/m2", factor: 1.0 };
    /// An integrated octupole field [1/m^3].
    pub const PER_CUBIC_METRE: Self = Self { symbol: "1/m3", shown: "/m3", factor: 1.0 };
    /// A cubic term [1/mm^2].
    pub const PER_SQUARE_MILLIMETRE: Self = Self { symbol: "1/mm2", shown: "/mm2", factor: 1.0 };

    /// An amplitude to two digits, with the unit as people read it.
    pub fn rounded(self, amplitude: f64) -> String {
        let shown = amplitude * self.factor;
        let digits = (1.0 - shown.abs().max(1e-9).log10().floor()).clamp(0.0, 9.0) as usize;
        format!("{shown:.digits$} {}", self.shown).trim_end().to_owned()
    }
}

/// An amplitude with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Most likely value.
    pub value: f64,
    /// Standard deviation, 0 if there is none.
    pub sigma: f64,
}

impl Measured {
    /// Without its sign, in a unit of which one is `factor`, both numbers to the second digit of the error bar: `7.21 ± 0.81`.
    pub fn size(self, factor: f64) -> String {
        let (value, sigma) = ((self.value * factor).abs(), self.sigma * factor);
        let digits = if sigma > 0.0 { (1.0 - sigma.log10().floor()).clamp(0.0, 6.0) as usize } else { 3 };
        format!("{value:.digits$} ± {sigma:.digits$}")
    }

    /// The same with its sign.
    pub fn signed(self, factor: f64) -> String {
        format!("{}{}", self.by_sign("+", "-"), self.size(factor))
    }

    /// One word above zero, another one below.
    pub fn by_sign(self, above: &'static str, below: &'static str) -> &'static str {
        if self.value < 0.0 { below } else { above }
    }
}
