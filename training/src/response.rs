//! Orbit response and tunes of a core with given tables, at given vars.

use estimator::{Drive, Surrogate};
use nalgebra::DMatrix;

use crate::network::fit::columns;
use crate::network::layers::{self, Network};
use crate::network::settings::{self, response_of_core, settings};
use crate::tables::Tables;
use crate::{in_room, with_stack};

/// RF offset at which a core is evaluated [1]: its second order is below the first by 1e-3 there, and cancels.
const RF_OFFSET: f32 = 1e-4;

/// Prediction of a core for a ring.
#[derive(Debug, Clone)]
pub(crate) struct CoreResponse {
    /// Response [m/rad], rows monitors, columns correctors and the RF [m].
    pub response: DMatrix<f64>,
    /// Tunes up to an integer [1].
    pub tunes: [f64; 2],
}

/// Predictions of a core with these tables at each of many vars `[N]`; none where no ring is stable.
///
/// # Panics
/// If there is no core for the ring, which its tables exclude.
pub(crate) fn responses(tables: &Tables, vars: &[Vec<f64>]) -> Vec<Option<CoreResponse>> {
    let all = in_room!(tables.sizes(), |room| {
        const B: usize = room::MONITORS;
        const C: usize = room::CORRECTORS;
        const F: usize = room::SUPPLIES;
        with_stack(|| responses_of::<room::Green, B, C, F, { room::PARAMS }>(tables, vars))
    });
    all.expect("tables are made for rings that there is a core for")
}

fn responses_of<G: Surrogate<B, C, F, N>, const B: usize, const C: usize, const F: usize, const N: usize>(
    tables: &Tables,
    vars: &[Vec<f64>],
) -> Vec<Option<CoreResponse>> {
    let (mut surrogate, mut at) = (Box::new(G::BLANK), Box::new(G::UNLINEARISED));
    tables.fill(&mut *surrogate).expect("they fit this room");
    let mut each = |vars: &Vec<f64>| {
        let mut params = [0.0; N];
        params.iter_mut().zip(vars).for_each(|(to, var)| *to = var.ln() as f32);
        surrogate.linearise(&params, &[0.0; F], &mut at).ok()?;
        Some(response_of(&*surrogate, &at))
    };
    vars.iter().map(&mut each).collect()
}

/// Predictions of the networks of the core at each of many vars `[N]`, without tunes.
pub(crate) fn network_responses(vars: &[Vec<f64>]) -> Vec<Option<CoreResponse>> {
    vars.iter().map(|vars| Some(without_tunes(response_of_core(vars)))).collect()
}

/// Predictions of networks in f32, beyond the design of those of the core.
pub(crate) fn network_responses_f32(free: &[Network; 2], vars: &[Vec<f64>]) -> Vec<Option<CoreResponse>> {
    let of_vars = |vars: &Vec<f64>| {
        let inputs = settings(vars);
        let [x, y] = free.each_ref().map(|network| {
            let mut pass = layers::Pass::new(network, inputs.ncols());
            pass.forward(network, &columns(&inputs, 0, inputs.ncols())).clone()
        });
        Some(without_tunes(settings::response([&x, &y])))
    };
    vars.iter().map(of_vars).collect()
}

fn without_tunes(response: DMatrix<f64>) -> CoreResponse {
    CoreResponse { response, tunes: [f64::NAN; 2] }
}

fn response_of<G: Surrogate<B, C, F, N>, const B: usize, const C: usize, const F: usize, const N: usize>(
    surrogate: &G,
    at: &G::Linearised,
) -> CoreResponse {
    let layout = surrogate.layout();
    let (monitors, correctors) = (layout.monitors(), layout.correctors());
    let orbit = |drive: &Drive<C, F>| {
        let mut orbit = [0.0; B];
        surrogate.orbit(at, drive, &mut orbit);
        (0..monitors).map(|b| f64::from(orbit[layout.monitor(b)])).collect::<Vec<f64>>()
    };
    let still = Drive { kick: [0.0; C], strength: [0.0; F], rf_offset: 0.0 };
    let mut response = DMatrix::zeros(monitors, correctors + 1);
    for c in 0..correctors {
        let mut drive = still;
        drive.kick[layout.corrector(c)] = 1.0;
        response.column_mut(c).copy_from_slice(&orbit(&drive));
    }
    let [up, down] = [RF_OFFSET, -RF_OFFSET].map(|rf_offset| orbit(&Drive { rf_offset, ..still }));
    let slope = |b: usize| (up[b] - down[b]) / (2.0 * f64::from(RF_OFFSET));
    response.column_mut(correctors).iter_mut().enumerate().for_each(|(b, to)| *to = slope(b));
    CoreResponse { response, tunes: [0, 1].map(|plane| f64::from(surrogate.tune(at, plane, &[0.0; F]).0)) }
}
