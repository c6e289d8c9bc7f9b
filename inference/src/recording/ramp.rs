//! The ramp of the machine file as a recording takes it: over the machine at its reference energy, currents as gradients.

use twin::{Hold, Optics, RampPoint, Ring};

/// The ramp; one of no points is a machine that is only looked at where it has its reference momentum.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Ramp {
    /// In the order of time; at least two, or none.
    pub points: Vec<At>,
}

/// The machine at one time in the cycle: what it would have at the reference momentum is 1.
#[derive(Debug, Clone, PartialEq)]
pub struct At {
    /// Time in the cycle [s].
    pub time: f64,
    /// Momentum.
    pub momentum: f64,
    /// Nominal current of the dipoles.
    pub dipole: f64,
    /// Slip factor `alpha_c - 1/gamma^2` of the design.
    pub slip: f64,
    /// Gradients of each supply's quadrupoles at which they have their design strengths [F].
    pub gradient: Vec<f64>,
}

/// What a header says of the machine at its reference energy.
pub(super) struct Nominal<'h> {
    /// Current of the dipoles [A].
    pub dipole: Option<f64>,
    /// Current of each supply [A].
    pub supply: &'h [f64],
    /// Gradient of a supply's quadrupoles at a current [A], over that at its nominal one.
    pub gradient: &'h dyn Fn(usize, f64) -> f64,
}

/// A key of the header, and why its value and the ramp do not go together.
type Fault = (&'static str, String);

/// By how much the gradients of a ramp may be off its momentum: beyond it the model describes no frame.
const APART: f64 = 0.05;

impl Ramp {
    /// That of a ring's machine file, in what a header says of currents.
    ///
    /// # Errors
    /// What of the header does not go with it.
    pub(super) fn from_ring(ring: &Ring, nominal: &Nominal<'_>) -> Result<Self, Fault> {
        if ring.ramp.is_empty() {
            return Ok(Self::default());
        }
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 });
        let compaction = optics.map_err(|error| ("lattice", error.to_string()))?.momentum_compaction();
        let slip = |momentum: f64| compaction - ring.particle.gamma(momentum - 1.0).powi(-2);
        let at = |point: &RampPoint| {
            let momentum = point.momentum(&ring.particle);
            let (dipole, gradient) = (dipole(point, nominal)?, gradients(point, ring, nominal, momentum)?);
            Ok(At { time: point.time, momentum, dipole, slip: slip(momentum) / slip(1.0), gradient })
        };
        Ok(Self { points: ring.ramp.iter().map(at).collect::<Result<_, _>>()? })
    }

    /// True if there is one.
    pub fn is_given(&self) -> bool {
        !self.points.is_empty()
    }

    /// First and last time [s]; none without a ramp.
    pub fn span(&self) -> Option<[f64; 2]> {
        Some([self.points.first()?.time, self.points.last()?.time])
    }

    /// The machine at a time in the cycle [s], linear between the ramp's; none before the first and after the last. Without a ramp it
    /// is the machine at its reference momentum, with so many supplies.
    pub fn at(&self, time: f64, supplies: usize) -> Option<At> {
        if !self.is_given() {
            return Some(At { time, momentum: 1.0, dipole: 1.0, slip: 1.0, gradient: vec![1.0; supplies] });
        }
        let pair = self.points.windows(2).find(|pair| (pair[0].time..=pair[1].time).contains(&time))?;
        let share = (time - pair[0].time) / (pair[1].time - pair[0].time);
        let between = |of: fn(&At) -> f64| of(&pair[0]) + share * (of(&pair[1]) - of(&pair[0]));
        let gradient = |f: usize| pair[0].gradient[f] + share * (pair[1].gradient[f] - pair[0].gradient[f]);
        Some(At {
            time,
            momentum: between(|at| at.momentum),
            dipole: between(|at| at.dipole),
            slip: between(|at| at.slip),
            gradient: (0..supplies).map(gradient).collect(),
        })
    }
}

/// Current of the dipoles over that of the header.
fn dipole(point: &RampPoint, nominal: &Nominal<'_>) -> Result<f64, Fault> {
    let Some(nominal) = nominal.dipole else { return Ok(1.0) };
    let current = point.dipole.ok_or_else(|| ("nominal_A", format!("has a dipole, the {} has none", point.place())))?;
    Ok(current / nominal)
}

/// Gradient of each supply over that at the current of the header: the momentum, nearly.
fn gradients(point: &RampPoint, ring: &Ring, nominal: &Nominal<'_>, momentum: f64) -> Result<Vec<f64>, Fault> {
    let of = |(f, supply): (usize, &twin::Supply)| {
        let (name, place) = (&supply.name, point.place());
        let current =
            point.supply.get(name).ok_or_else(|| ("nominal_A", format!("has {name}, the {place} has not")))?;
        let gradient = (nominal.gradient)(f, *current);
        if (gradient / momentum - 1.0).abs() <= APART {
            return Ok(gradient);
        }
        let said = format!(
            "{place}: {current} A of {name} make {gradient:.4} of the gradient that {} A make, the momentum is {momentum:.4} of that at \
             kinetic_energy_GeV",
            nominal.supply[f]
        );
        Err(("nominal_A", said))
    };
    ring.supplies.iter().enumerate().map(of).collect()
}
