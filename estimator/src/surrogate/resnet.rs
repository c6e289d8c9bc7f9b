//! The published network as a surrogate: responses to kicks and their derivatives are its, all else is the Green's function's.
//!
//! The network knows one orbit of one corrector at its setting. A kick's orbit is proportional to it, so that 48 orbits, one for each
//! corrector, are the response; linearising evaluates them one a step, with their Jacobians:
//!
//! `R_bc = (design_bc + y_b(22 A in corrector c, v))/kick`, `dR_bc/d(ln var_q) = v_q dy_b/dv_q/kick`.
//!
//! A quadrupole's current acts through its product with the var: `v` is that product, the network's own inputs for currents stay at
//! nominal. Tunes, dispersion, the slip factor, and how orbits follow the supplies are unknown to the network and come from the
//! Green's function of the same ring. Its terms of low rank are left out: the network was trained on the design.
//!
//! Outside the vars and the tunes that it was trained on a network extrapolates, which [`Surrogate::is_within`] says.

use super::network::{HIDDEN, Network, Pass, Products};
use super::quantised::Column;
use super::{Green, GreenLinearised, GreenProgress, Prediction, Steerable, Surrogate, Tables, Unstable};
use crate::drive::Drive;
use crate::linear::dot;
use crate::sizes::{Layout, Sizes};
use crate::state::state;
use crate::wire::{Parcel, ParcelError};
use core::marker::PhantomData;

/// Trained networks of a ring, and how a target multiplies.
pub trait Trained {
    /// In x and y.
    const PLANES: [Network<'static>; 2];
    /// Inner loop.
    type Products: Products;
}

/// Input of the corrector that is set.
pub const CORRECTOR: f32 = 5.0;
/// Kick of its setting [rad].
pub const SETTING_KICK: f32 = 0.277_91e-3;
/// Orbit of an output of 1 [m].
pub const ORBIT: f32 = 1e-3;
/// Magnet currents among the inputs: dipole, QH, QV, SH, SV.
pub const CURRENTS: usize = 5;
/// Range of the vars about 1 that it was trained on.
pub const SPAN: f32 = 0.06;
/// Largest distance of a tune from the design that it was trained on.
pub const TUNE_SPAN: f32 = 0.05;
/// Input of a var at the end of its range: evenly distributed vars have a variance of 1.
pub const LAST_VAR: f32 = 1.73;

/// The network as a surrogate, for a ring with one quadrupole a param.
#[derive(Debug, PartialEq)]
pub struct ResNet<
    R,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> {
    /// What the network does not know.
    pub green: Green<BX, BY, CX, CY, M, N, Q, T>,
    trained: PhantomData<R>,
}

impl<
    R,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Clone for ResNet<R, BX, BY, CX, CY, M, N, Q, T>
{
    fn clone(&self) -> Self {
        Self { green: self.green.clone(), trained: PhantomData }
    }
}

/// What it predicts at given vars.
#[derive(Debug, Clone)]
pub struct ResNetLinearised<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
> {
    green: GreenLinearised<BX, BY, CX, CY, M, Q>,
    x: PlaneLearned<BX, CX, N>,
    y: PlaneLearned<BY, CY, N>,
    is_within: bool,
}

state!([const BX: usize, const BY: usize, const CX: usize, const CY: usize, const M: usize, const N: usize, const Q: usize]
    ResNetLinearised<BX, BY, CX, CY, M, N, Q> { green, x, y, is_within });

/// One plane of it.
#[derive(Debug, Clone)]
struct PlaneLearned<const B: usize, const C: usize, const N: usize> {
    /// Response [m/rad].
    response: [[f32; B]; C],
    /// Its derivative with respect to `ln` of every var.
    slope: [[Column<N>; B]; C],
}

state!([const B: usize, const C: usize, const N: usize] PlaneLearned<B, C, N> { response, slope });

/// How far linearising has come, and its work space.
#[derive(Debug, Clone)]
pub struct ResNetProgress<const Q: usize, const T: usize> {
    green: GreenProgress<Q, T>,
    /// Correctors done, once the Green's function is.
    done: Option<usize>,
    pass: Pass,
}

impl<const B: usize, const C: usize, const N: usize> PlaneLearned<B, C, N> {
    const BLANK: Self = Self { response: [[0.0; B]; C], slope: [[Column::ZERO; B]; C] };

    /// `R^T orbit` [m^2/rad].
    fn pull(&self, orbit: &[f32], into: &mut [f32]) {
        into.iter_mut().zip(&self.response).for_each(|(to, response)| *to = dot(response, orbit));
    }

    /// Response and derivative of one corrector; `vars` are the products of vars and currents.
    fn learn<P: Products>(&mut self, network: &Network, corrector: usize, vars: &[f32; N], pass: &mut Pass) {
        let mut inputs = [0.0; HIDDEN];
        if let Some(input) = inputs.get_mut(corrector) {
            *input = CORRECTOR;
        }
        let of_vars = inputs.iter_mut().skip(C + CURRENTS).zip(vars);
        of_vars.for_each(|(input, var)| *input = (var - 1.0) * (LAST_VAR / SPAN));
        let mut outputs = [0.0; B];
        network.forward::<P>(&inputs, pass, &mut outputs);
        let (Some(response), Some(slopes)) = (self.response.get_mut(corrector), self.slope.get_mut(corrector)) else {
            return;
        };
        for (b, (response, slope)) in response.iter_mut().zip(slopes).enumerate() {
            let output = outputs.get(b).copied().unwrap_or_default();
            *response = (network.design(corrector, b) + ORBIT * output) / SETTING_KICK;
            network.back(b, pass, &mut inputs);
            let mut by_param = [0.0; N];
            let of_vars = inputs.iter().skip(C + CURRENTS).zip(vars);
            let of_vars = of_vars.map(|(g, var)| g * var * (LAST_VAR / SPAN * ORBIT / SETTING_KICK));
            by_param.iter_mut().zip(of_vars).for_each(|(to, g)| *to = g);
            slope.quantise(&by_param);
        }
    }

    /// Add the orbit of some kicks, at params that have changed by so much.
    fn read(&self, kicks: &[f32], change: Option<&[f32; N]>, reading: &mut [f32]) {
        for ((response, slopes), kick) in self.response.iter().zip(&self.slope).zip(kicks) {
            for ((reading, response), slope) in reading.iter_mut().zip(response).zip(slopes) {
                *reading += kick * (response + change.map_or(0.0, |change| slope.dot(change)));
            }
        }
    }

    /// Add the derivatives of the orbit of some kicks, a line a monitor.
    fn differentiate(&self, kicks: &[f32], jacobian: &mut [f32]) {
        for (slopes, kick) in self.slope.iter().zip(kicks) {
            let lines = jacobian.chunks_exact_mut(N.max(1)).zip(slopes);
            lines.for_each(|(line, slope)| slope.add_to(*kick, line));
        }
    }
}

impl<
    R,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> ResNet<R, BX, BY, CX, CY, M, N, Q, T>
{
    /// Each param's entry of a list of the supplies' numbers.
    fn of_supply<const F: usize>(&self, supplies: &[f32; F]) -> [f32; N] {
        let mut each = [0.0; N];
        for (param, supply) in self.green.param.iter().zip(&self.green.supply) {
            let value = supplies.get(*supply as usize).copied().unwrap_or(0.0);
            each.get_mut(*param as usize).into_iter().for_each(|to| *to = value);
        }
        each
    }

    /// The sums of a line of derivatives by the supply of each param.
    fn by_supply<const F: usize>(&self, line: &[f32], into: &mut [f32; F]) {
        for (param, supply) in self.green.param.iter().zip(&self.green.supply) {
            let value = line.get(*param as usize).copied().unwrap_or(0.0);
            into.get_mut(*supply as usize).into_iter().for_each(|to| *to += value);
        }
    }
}

impl<
    R,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Tables for ResNet<R, BX, BY, CX, CY, M, N, Q, T>
{
    const BLANK: Self = Self { green: Green::BLANK, trained: PhantomData };
    const ROOM: Sizes = <Green<BX, BY, CX, CY, M, N, Q, T> as Tables>::ROOM;

    fn layout(&self) -> Layout {
        self.green.layout()
    }

    /// Those of the Green's function: the networks are part of the program.
    fn parts<const L: usize>(&self) -> impl Iterator<Item = Parcel<L>> + '_ {
        self.green.parts()
    }

    fn take<const L: usize>(&mut self, parcel: &Parcel<L>) -> Result<(), ParcelError> {
        self.green.take(parcel)
    }
}

impl<
    R: Trained,
    const B: usize,
    const C: usize,
    const F: usize,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Surrogate<B, C, F, N> for ResNet<R, BX, BY, CX, CY, M, N, Q, T>
where
    Green<BX, BY, CX, CY, M, N, Q, T>:
        Surrogate<B, C, F, N, Linearised = GreenLinearised<BX, BY, CX, CY, M, Q>, Progress = GreenProgress<Q, T>>,
{
    type Linearised = ResNetLinearised<BX, BY, CX, CY, M, N, Q>;
    const UNLINEARISED: Self::Linearised = ResNetLinearised {
        green: <Green<BX, BY, CX, CY, M, N, Q, T> as Surrogate<B, C, F, N>>::UNLINEARISED,
        x: PlaneLearned::BLANK,
        y: PlaneLearned::BLANK,
        is_within: false,
    };

    type Progress = ResNetProgress<Q, T>;
    const BEGIN: Self::Progress = ResNetProgress {
        green: <Green<BX, BY, CX, CY, M, N, Q, T> as Surrogate<B, C, F, N>>::BEGIN,
        done: None,
        pass: Pass::BLANK,
    };

    #[inline(never)]
    fn advance(
        &self,
        params: &[f32; N],
        supplies: &[f32; F],
        progress: &mut Self::Progress,
        at: &mut Self::Linearised,
    ) -> Result<bool, Unstable> {
        let Some(corrector) = progress.done else {
            let is_done = self.green.advance(params, supplies, &mut progress.green, &mut at.green)?;
            progress.done = is_done.then_some(0);
            return Ok(false);
        };
        let mut vars = self.of_supply(supplies);
        vars.iter_mut().zip(params).for_each(|(var, param)| *var = libm::expf(*var + param));
        match corrector.checked_sub(CX) {
            None => at.x.learn::<R::Products>(&R::PLANES[0], corrector, &vars, &mut progress.pass),
            Some(corrector) => at.y.learn::<R::Products>(&R::PLANES[1], corrector, &vars, &mut progress.pass),
        }
        let done = corrector + 1;
        progress.done = (done < C).then_some(done);
        if done < C {
            return Ok(false);
        }
        let is_near = |plane: usize| {
            let tune = self.green.tune(&at.green, plane, &[0.0; F]).0;
            let design = self.green.tune.get(plane).copied().unwrap_or_default();
            (tune - (design - libm::floorf(design))).abs() <= TUNE_SPAN
        };
        at.is_within = vars.iter().all(|var| (var - 1.0).abs() <= SPAN) && is_near(0) && is_near(1);
        Ok(true)
    }

    fn is_within(&self, at: &Self::Linearised) -> bool {
        at.is_within
    }

    fn orbit(&self, at: &Self::Linearised, drive: &Drive<C, F>, into: &mut [f32; B]) {
        self.green.orbit(&at.green, &Drive { kick: [0.0; C], ..*drive }, into);
        let change = (drive.strength != [0.0; F]).then(|| self.of_supply(&drive.strength));
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let (x, y) = into.split_at_mut(BX.min(B));
        at.x.read(kick_x, change.as_ref(), x);
        at.y.read(kick_y, change.as_ref(), y);
    }

    fn predict(&self, at: &Self::Linearised, drive: &Drive<C, F>, into: &mut Prediction<B, F, N>) {
        // what an RF offset makes
        self.green.predict(&at.green, &Drive { kick: [0.0; C], ..*drive }, into);
        self.orbit(at, drive, &mut into.reading);
        let mut own = [[0.0; N]; B];
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let (x, y) = own.split_at_mut(BX.min(B));
        at.x.differentiate(kick_x, x.as_flattened_mut());
        at.y.differentiate(kick_y, y.as_flattened_mut());
        let lines = into.jacobian.as_mut_slice().chunks_exact_mut(N.max(1)).zip(&mut into.by_supply);
        for (own, (line, by_supply)) in own.iter().zip(lines) {
            line.iter_mut().zip(own).for_each(|(to, own)| *to += own);
            self.by_supply(own, by_supply);
        }
    }

    fn tune(&self, at: &Self::Linearised, plane: usize, strength: &[f32; F]) -> (f32, [f32; N]) {
        self.green.tune(&at.green, plane, strength)
    }

    fn prior_group(&self, param: usize) -> usize {
        Surrogate::<B, C, F, N>::prior_group(&self.green, param)
    }

    fn error_variance(&self, monitor: usize, rf_offset: f32, orbit: f32) -> f32 {
        let stated = R::PLANES[usize::from(monitor >= BX)].stated_error();
        // the orbit that an RF offset makes is the Green's function's, and so is its error, which is small against the network's
        stated * stated + Surrogate::<B, C, F, N>::error_variance(&self.green, monitor, rf_offset, orbit)
    }

    fn follow(&self, at: &Self::Linearised, plane: usize) -> ([f32; F], f32) {
        self.green.follow(&at.green, plane)
    }
}

/// How uncertain the responses are is the Green's function's, whose derivatives come as sums of products; the network's are not used for that.
impl<
    R: Trained,
    const B: usize,
    const C: usize,
    const F: usize,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Steerable<B, C, F, N> for ResNet<R, BX, BY, CX, CY, M, N, Q, T>
where
    Green<BX, BY, CX, CY, M, N, Q, T>:
        Steerable<B, C, F, N, Linearised = GreenLinearised<BX, BY, CX, CY, M, Q>, Progress = GreenProgress<Q, T>>,
{
    fn pull(&self, at: &Self::Linearised, orbit: &[f32; B], into: &mut [f32; C]) {
        let (orbit_x, orbit_y) = orbit.split_at(BX.min(B));
        let (pull_x, pull_y) = into.split_at_mut(CX.min(C));
        at.x.pull(orbit_x, pull_x);
        at.y.pull(orbit_y, pull_y);
    }

    fn response_covariance(
        &self,
        at: &Self::Linearised,
        plane: usize,
        weight: &[f32; B],
        covariance: impl Fn(usize) -> [f32; N],
        add: impl FnMut(&[f32], &[f32]),
    ) {
        Steerable::<B, C, F, N>::response_covariance(&self.green, &at.green, plane, weight, covariance, add);
    }
}
