//! The network of the Booster as it was trained: `tables/resnet-x.bin` and `-y.bin`, which `make train` makes again.

use estimator::booster::{
    CHANNELS, CORRECTORS, COUPLINGS, MONITORS, NODES, PAIRS, PARAMS, QUADRUPOLES, SETTINGS, SUPPLIES, TRIANGLE, WORDS,
};
use estimator::surrogate::{CURRENTS, Network, Plain, SETTING_KICK, Trained};
use twin::{Hold, Optics, Ring};

/// Inputs in both planes: 24 correctors, the magnets' currents, 48 vars.
const INPUTS: usize = 24 + CURRENTS + PARAMS;
/// Both planes.
pub const PLANES: [Network<'static>; 2] = [
    Network::new(include_bytes!("../../tables/resnet-x.bin"), INPUTS, 15, 24),
    Network::new(include_bytes!("../../tables/resnet-y.bin"), INPUTS, 18, 24),
];

/// The networks of the Booster, with the compiler's own inner loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Booster;

impl Trained for Booster {
    const PLANES: [Network<'static>; 2] = PLANES;
    type Products = Plain;
}

/// The surrogate.
pub type ResNet = estimator::surrogate::ResNet<Booster, 15, 18, 24, 24, QUADRUPOLES, PARAMS, NODES, PAIRS>;
/// The Booster's core with it.
pub type Estimator = estimator::Estimator<
    ResNet,
    MONITORS,
    CORRECTORS,
    SUPPLIES,
    PARAMS,
    SETTINGS,
    CHANNELS,
    TRIANGLE,
    COUPLINGS,
    WORDS,
>;

/// The feedback on it.
pub use estimator::booster::Steer;

/// The ring is another than the network was trained on.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{ring}: the network was trained on the built-in Booster; another ring needs --model green")]
pub struct OtherRing {
    /// Its name.
    pub ring: String,
}

/// Largest difference of a ring's design orbits from those of the tables, relative to the largest: the tables' rounding.
const ALIKE: f64 = 1e-6;

/// See that a ring is the one of the tables.
///
/// # Errors
/// [`OtherRing`].
pub fn expect_known(ring: &Ring) -> Result<(), OtherRing> {
    let planes = [(ring.horizontal_monitors(), ring.horizontal_correctors()), (15, 24)];
    let totals = [(ring.read_monitors.len(), ring.correctors.len()), (MONITORS, CORRECTORS)];
    let has_var_each = ring.quadrupoles.iter().enumerate().all(|(q, quadrupole)| quadrupole.parameter == Some(q));
    let is_like = |pairs: [(usize, usize); 2]| pairs[0] == pairs[1];
    if is_like(planes) && is_like(totals) && ring.parameters.len() == PARAMS && has_var_each && is_design(ring) {
        return Ok(());
    }
    Err(OtherRing { ring: ring.name.clone() })
}

/// Whether the orbits of the tables are those of the ring as designed.
fn is_design(ring: &Ring) -> bool {
    let Ok(optics) = Optics::of(ring, Hold::Momentum { delta: 0.0 }) else { return false };
    let response = optics.response(&optics.read_monitors(), &optics.correctors()) * f64::from(SETTING_KICK);
    let differs = |plane: usize, (b, c): (usize, usize)| {
        let (first, across) = ([0, 15][plane], [0, 24][plane]);
        (f64::from(PLANES[plane].design(c, b)) - response[(first + b, across + c)]).abs()
    };
    let of_plane = |plane: usize| {
        let outputs = PLANES[plane].shape().1;
        (0..24).flat_map(move |c| (0..outputs).map(move |b| (b, c))).map(move |at| differs(plane, at))
    };
    let largest = of_plane(0).chain(of_plane(1)).fold(0.0, f64::max);
    largest <= ALIKE * response.amax()
}

#[cfg(test)]
mod tests {
    use super::super::fit::validation;
    use super::super::samples::Source;
    use super::super::tables::{self, network, rms};
    use super::*;

    /// On the published kind of validation set [mm]: the published errors of the emulator, which its likelihood has in each of the two orbits of a difference,
    /// and what the tables state.
    #[test]
    fn the_tables_are_as_good_as_the_published_network_and_as_they_state() {
        let source = Source::of(&Ring::booster());
        let files: [&[u8]; 2] =
            [include_bytes!("../../tables/resnet-x.bin"), include_bytes!("../../tables/resnet-y.bin")];
        for (plane, published) in [0.057, 0.017].into_iter().enumerate() {
            let samples = &validation(&source)[plane];
            let error = 2.0 * rms(&tables::errors(&source, plane, files[plane], samples));
            assert!(0.5 * error < published, "{error} mm");
            let stated = 2e3 * PLANES[plane].stated_error();
            assert!((error / stated - 1.0).abs() < 1e-3, "{error} mm, stated {stated} mm");
            // the codes of 16 bits that weights multiply cost next to nothing
            let in_f32 = 1e3 * super::super::fit::validate(&network(&PLANES[plane]), samples);
            assert!((in_f32 / error - 1.0).abs() < 0.02, "{in_f32} mm, in integers {error} mm");
        }
        assert!(files[0].len() + files[1].len() <= 760_000);
    }
}
