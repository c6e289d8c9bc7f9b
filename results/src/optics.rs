//! Optics functions at monitors and quadrupoles in the results of a fit, each with its standard deviation.

use core::f64::consts::TAU;

use schemars::JsonSchema;
use serde::Serialize;
use twin::{Kind, Ring, Twiss};

/// Optics at the entrance of a monitor or of a quadrupole, on momentum. Field names are those of the command's JSON.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct OpticsAt {
    pub name: String,
    pub kind: &'static str,
    pub s_m: f64,
    pub beta_x_m: f64,
    pub beta_x_sigma_m: f64,
    pub beta_y_m: f64,
    pub beta_y_sigma_m: f64,
    /// Phase advance from the start of the ring [turns].
    pub phase_x: f64,
    pub phase_x_sigma: f64,
    pub phase_y: f64,
    pub phase_y_sigma: f64,
    pub dispersion_x_m: f64,
    pub dispersion_x_sigma_m: f64,
}

/// At some places, names and elements, from the optics of every element and their standard deviations.
pub fn optics_at(ring: &Ring, places: &[(String, usize)], twiss: &[Twiss], sigma: &[Twiss]) -> Vec<OpticsAt> {
    let at = |(name, element): &(String, usize)| {
        let (twiss, sigma) = (&twiss[*element], &sigma[*element]);
        OpticsAt {
            name: name.clone(),
            kind: if ring.elements[*element].kind == Kind::Monitor { "monitor" } else { "quadrupole" },
            s_m: ring.elements[*element].s,
            beta_x_m: twiss.beta[0],
            beta_x_sigma_m: sigma.beta[0],
            beta_y_m: twiss.beta[1],
            beta_y_sigma_m: sigma.beta[1],
            phase_x: twiss.phase_advance[0] / TAU,
            phase_x_sigma: sigma.phase_advance[0] / TAU,
            phase_y: twiss.phase_advance[1] / TAU,
            phase_y_sigma: sigma.phase_advance[1] / TAU,
            dispersion_x_m: twiss.dispersion[0],
            dispersion_x_sigma_m: sigma.dispersion[0],
        }
    };
    places.iter().map(at).collect()
}

/// Monitors and quadrupoles of a ring by their labels, in beam order.
pub fn places(ring: &Ring) -> Vec<(String, usize)> {
    let is_place = |&at: &usize| matches!(ring.elements[at].kind, Kind::Monitor | Kind::Quadrupole { .. });
    (0..ring.elements.len()).filter(is_place).map(|at| (ring.elements[at].label.clone(), at)).collect()
}
