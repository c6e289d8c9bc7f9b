//! The closed-orbit Green's function of the design ring, quantised, with the gradient errors included exactly.
//!
//! Each quadrupole is two Gauss-Legendre nodes. With `G` the design Green's functions between correctors c, monitors b
//! and nodes q, and `D = diag(k L w (strength - 1))` (k becomes -k in y, w = 1/2), the function between the nodes of the
//! ring as it is, `Z_qq = (1 + G_qq D)^-1 G_qq`, is built up node by node: switching on the error `e` of node n subtracts
//!
//! `g g^T e/(1 + e g_n)`, `g` column n. The rest are products:
//!
//! `Z_qc = G_qc - Z_qq D G_qc`, `Z_qb = G_qb - Z_qq D G_qb`, `R = G_bc - Z_bq D G_qc`, and
//! `dR_bc/d(ln strength) = - sum over the quadrupole's nodes of k L w strength Z_qb Z_qc`.
//!
//! The product of all `1 + e g_n` is `det(1 + G_qq D)`, which gives the tunes: `sin^2(pi Q) = sin^2(pi Q0) det(1 + G_qq D)`, and
//! `dQ/d(ln strength) = tan(pi Q)/(2 pi) sum over the quadrupole's nodes of k L w strength Z_nn`.
//!
//! Dispersion is one more column of the same form, whose source is the dipoles. Both planes are independent; coupling and
//! other extension terms are a short sum of products on top, see [`LowRank`].
//!
//! Source: the resolvent (Dyson) form of the perturbed Green's function, by successive rank-one updates (J. Sherman
//! and W. J. Morrison, Ann. Math. Stat. 21 (1950) 124); S. Y. Lee, Accelerator Physics, ch. 2, for G.

use super::quantised::{Column, dot_codes, dot_four_codes};
use super::{Block, LowRank, Prediction, Steerable, Surrogate, SymmetricBlock, Unstable};
use crate::drive::Drive;
use crate::linear::{add, add_four_to_each, dot};
use crate::sizes::Sizes;
use crate::state::state;
use crate::triangle::Triangle;

/// In place of the number of a param or of a supply: none.
pub const NONE: i16 = -1;

/// One plane: `B` monitors, `C` correctors, `Q` nodes (two a quadrupole), `T = Q (Q + 1)/2` pairs of nodes.
#[derive(Debug, Clone, PartialEq)]
pub struct GreenPlane<const B: usize, const C: usize, const Q: usize, const T: usize> {
    /// Monitors to correctors, `G_bc` [m/rad].
    pub direct: Block<B, C>,
    /// Nodes to monitors, `G_qb` [m/rad].
    pub seen: Block<Q, B>,
    /// Nodes to correctors, `G_qc` [m/rad].
    pub driven: Block<Q, C>,
    /// Nodes to nodes, `G_qq` [m/rad].
    pub mutual: SymmetricBlock<Q, T>,
}

/// Horizontal dispersion and the slip factor, for frames with an RF offset.
#[derive(Debug, Clone, PartialEq)]
pub struct Dispersion<const B: usize, const Q: usize> {
    /// Design dispersion at the monitors [m].
    pub monitor: [f32; B],
    /// Design dispersion at the nodes [m].
    pub node: [f32; Q],
    /// Design orbit of second order in the relative RF offset, at the monitors [m].
    pub second_order: [f32; B],
    /// Change of a misaligned ring's orbit per unit of RF offset and of rms orbit, beyond the design dispersion, in x and y: the standard
    /// deviation for a reading by itself, the root of 8 times the rms [1].
    pub spurious: [f32; 2],
    /// Design momentum compaction [1].
    pub compaction: f32,
    /// `1/gamma^2` of the beam [1].
    pub inverse_gamma_squared: f32,
    /// Circumference [m].
    pub circumference: f32,
}

/// Green's function surrogate of a ring with monitors and correctors in two planes, `M` quadrupoles and `N` params.
#[derive(Debug, Clone, PartialEq)]
pub struct Green<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> {
    /// How much of all the room the ring takes.
    pub sizes: Sizes,
    /// Horizontal plane: the first `BX` monitors and `CX` correctors.
    pub x: GreenPlane<BX, CX, Q, T>,
    /// Vertical plane: the rest.
    pub y: GreenPlane<BY, CY, Q, T>,
    /// `k L w` of both nodes of each quadrupole [1/m], those that focus in x positive and first; in y with the other sign.
    pub weight: [f32; M],
    /// Param of each quadrupole, or [`NONE`].
    pub param: [i16; M],
    /// Supply of each quadrupole, or [`NONE`] in series with the dipoles.
    pub supply: [i16; M],
    /// Which of the setup's priors each param has.
    pub group: [i16; N],
    /// Momentum.
    pub dispersion: Dispersion<BX, Q>,
    /// Design tunes [1].
    pub tune: [f32; 2],
    /// Extension terms; none in a ring as designed.
    pub low_rank: LowRank<BX, BY, CX, CY>,
    /// Stated rms error in x and y [m].
    pub stated_error: [f32; 2],
}

/// One plane at given strengths, quantised column by column: half the memory, and errors within those of the tables.
#[derive(Debug, Clone)]
struct PlaneLinearised<const B: usize, const C: usize, const M: usize, const Q: usize> {
    /// Nodes to monitors, `Z_qb`.
    seen: [Column<Q>; B],
    /// Nodes to correctors, `Z_qc`.
    driven: [Column<Q>; C],
    /// Monitors to correctors, `R`.
    response: [Column<B>; C],
    /// Tune up to an integer [1].
    tune: f32,
    /// Derivative of the tune with respect to `ln` of each quadrupole's strength.
    tune_slope: [f32; M],
}

state!([const B: usize, const C: usize, const M: usize, const Q: usize] PlaneLinearised<B, C, M, Q> {
    seen,
    driven,
    response,
    tune,
    tune_slope,
});

/// The surrogate at given strengths.
#[derive(Debug, Clone)]
pub struct GreenLinearised<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const Q: usize,
> {
    x: PlaneLinearised<BX, CX, M, Q>,
    y: PlaneLinearised<BY, CY, M, Q>,
    /// `k L w strength` of both nodes of each quadrupole; in y with the other sign.
    slope: [f32; M],
    /// Dispersion at the monitors [m].
    monitor_dispersion: [f32; BX],
    /// Dispersion at the nodes [m].
    node_dispersion: [f32; Q],
    /// Slip factor `compaction - 1/gamma^2` [1].
    slip: f32,
}

state!([const BX: usize, const BY: usize, const CX: usize, const CY: usize, const M: usize, const Q: usize] GreenLinearised<BX, BY, CX, CY, M, Q> {
    x,
    y,
    slope,
    monitor_dispersion,
    node_dispersion,
    slip,
});

impl<const B: usize, const C: usize, const M: usize, const Q: usize> PlaneLinearised<B, C, M, Q> {
    const BLANK: Self = Self {
        seen: [Column::ZERO; B],
        driven: [Column::ZERO; C],
        response: [Column::ZERO; C],
        tune: 0.0,
        tune_slope: [0.0; M],
    };
}

/// How far linearising has come, and its work space.
#[derive(Debug, Clone)]
pub struct GreenProgress<const Q: usize, const T: usize> {
    /// x comes last: its function between the nodes also gives the dispersion.
    is_x: bool,
    step: Step,
    /// `det(1 + G_qq D)` of the nodes that are switched on.
    determinant: f32,
    /// `Z_qq` of these.
    mutual: Triangle<Q, T>,
    /// Columns before they are quantised.
    columns: [[f32; Q]; COLUMNS],
    /// Rows of `Z_qq` that enter them.
    rows: [[f32; Q]; 4],
}

/// What is next in a plane. Each is at most 0.3 million instructions of a chip for a ring of 48 quadrupoles.
#[derive(Debug, Clone, Copy)]
enum Step {
    /// Switch pairs of quadrupoles on, from this one.
    Pairs(usize),
    /// Columns of `Z_qb`, from this one.
    Seen(usize),
    /// Columns of `Z_qc`, from this one.
    Driven(usize),
    /// Columns of `R`, from this one.
    Response(usize),
}

/// Pairs of quadrupoles that are switched on in one step.
const PAIRS: usize = 4;
/// Columns that are filled in one step.
const COLUMNS: usize = 8;
/// Columns of `R` that are made in one step: all of a ring like the Booster.
const RESPONSES: usize = 32;

impl<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Green<BX, BY, CX, CY, M, N, Q, T>
{
    /// Memory for tables, all zero.
    pub const BLANK: Self = Self {
        sizes: Sizes::new([0; 2], [0; 2], [0; 3]),
        x: GreenPlane::BLANK,
        y: GreenPlane::BLANK,
        weight: [0.0; M],
        param: [0; M],
        supply: [0; M],
        group: [0; N],
        dispersion: Dispersion {
            monitor: [0.0; BX],
            node: [0.0; Q],
            second_order: [0.0; BX],
            spurious: [0.0; 2],
            compaction: 0.0,
            inverse_gamma_squared: 0.0,
            circumference: 0.0,
        },
        tune: [0.0; 2],
        low_rank: LowRank::BLANK,
        stated_error: [0.0; 2],
    };
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const M: usize, const Q: usize>
    GreenLinearised<BX, BY, CX, CY, M, Q>
{
    /// Relative momentum that an RF offset makes.
    fn delta<const C: usize, const F: usize>(&self, drive: &Drive<C, F>) -> f32 {
        -drive.rf_offset / self.slip
    }

    /// Kicks in x and y that a unit of `ln strength` adds at each node: `-k L w strength` times the orbit there [rad].
    fn pushes<const C: usize, const F: usize>(&self, drive: &Drive<C, F>) -> [[f32; Q]; 2] {
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let delta = self.delta(drive);
        let mut pushes = [
            self.x.orbit_at_nodes(kick_x, self.node_dispersion.map(|d| d * delta)),
            self.y.orbit_at_nodes(kick_y, [0.0; Q]),
        ];
        let [x, y] = &mut pushes;
        let nodes = x.as_chunks_mut::<2>().0.iter_mut().zip(y.as_chunks_mut::<2>().0);
        for ((x, y), k) in nodes.zip(&self.slope) {
            x.iter_mut().for_each(|x| *x *= -k);
            y.iter_mut().for_each(|y| *y *= k);
        }
        pushes
    }
}

impl<
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
> Surrogate<B, C, F, N> for Green<BX, BY, CX, CY, M, N, Q, T>
{
    type Linearised = GreenLinearised<BX, BY, CX, CY, M, Q>;
    type Progress = GreenProgress<Q, T>;

    const BEGIN: Self::Progress = GreenProgress {
        is_x: false,
        step: Step::Pairs(0),
        determinant: 0.0,
        mutual: Triangle::ZERO,
        columns: [[0.0; Q]; COLUMNS],
        rows: [[0.0; Q]; 4],
    };

    const UNLINEARISED: Self::Linearised = GreenLinearised {
        x: PlaneLinearised::BLANK,
        y: PlaneLinearised::BLANK,
        slope: [0.0; M],
        monitor_dispersion: [0.0; BX],
        node_dispersion: [0.0; Q],
        slip: 0.0,
    };

    #[inline(never)]
    fn advance(
        &self,
        params: &[f32; N],
        supplies: &[f32; F],
        progress: &mut Self::Progress,
        at: &mut Self::Linearised,
    ) -> Result<bool, Unstable> {
        const { assert!(B == BX + BY && C == CX + CY && Q == 2 * M, "planes and nodes add up") };
        let mut strength = self.ln_strength(params, supplies);
        strength.iter_mut().for_each(|s| *s = libm::expf(*s));
        at.slope = product(&strength, self.weight.iter().copied());
        let focusing = self.focusing();
        if !progress.is_x {
            let (excess, slope) = (self.excess(&strength, -1.0), at.slope.map(|k| -k));
            progress.is_x = self.y.advance(&excess, (self.tune[1], &slope), focusing, progress, &mut at.y)?;
            return Ok(false);
        }
        let excess = self.excess(&strength, 1.0);
        let is_done = self.x.advance(&excess, (self.tune[0], &at.slope), focusing, progress, &mut at.x)?;
        if is_done {
            self.linearise_dispersion(&excess, at, &progress.mutual);
        }
        Ok(is_done)
    }

    fn orbit(&self, at: &Self::Linearised, drive: &Drive<C, F>, into: &mut [f32; B]) {
        // without a change of current the nodes add nothing
        let pushes = if drive.strength == [0.0; F] { [[0.0; Q]; 2] } else { at.pushes(drive) };
        self.read(at, drive, &pushes, into);
    }

    fn predict(&self, at: &Self::Linearised, drive: &Drive<C, F>, into: &mut Prediction<B, F, N>) {
        let pushes = at.pushes(drive);
        self.read(at, drive, &pushes, &mut into.reading);
        let (jacobian_x, jacobian_y) = into.jacobian.as_mut_slice().split_at_mut(N * BX.min(B));
        let (by_supply_x, by_supply_y) = into.by_supply.split_at_mut(BX.min(B));
        self.differentiate(&at.x, &pushes[0], jacobian_x, by_supply_x);
        self.differentiate(&at.y, &pushes[1], jacobian_y, by_supply_y);
        if drive.rf_offset != 0.0 {
            let scale = at.delta(drive) / self.dispersion.circumference;
            self.differentiate_slip(at, scale, jacobian_x, by_supply_x);
        }
    }

    fn tune(&self, at: &Self::Linearised, plane: usize, strength: &[f32; F]) -> (f32, [f32; N]) {
        let (tune, slopes) = if plane == 0 { (at.x.tune, &at.x.tune_slope) } else { (at.y.tune, &at.y.tune_slope) };
        let (mut by_param, mut by_supply) = ([0.0; N], [0.0; F]);
        self.spread(slopes.iter().copied(), &mut by_param, &mut by_supply);
        (tune + dot(&by_supply, strength), by_param)
    }

    fn prior_group(&self, param: usize) -> usize {
        self.group.get(param).map_or(0, |group| *group as usize)
    }

    fn error_variance(&self, monitor: usize, rf_offset: f32, orbit: f32) -> f32 {
        let plane = usize::from(monitor >= BX);
        let spurious = self.dispersion.spurious[plane] * orbit * rf_offset;
        self.stated_error[plane] * self.stated_error[plane] + spurious * spurious
    }

    fn follow(&self, at: &Self::Linearised, plane: usize) -> ([f32; F], f32) {
        let Sizes { monitors: [bx, by], correctors: [cx, cy], .. } = self.sizes;
        match plane {
            0 => at.x.follow(&at.slope, &self.supply, [bx, cx].map(usize::from)),
            _ => at.y.follow(&at.slope, &self.supply, [by, cy].map(usize::from)),
        }
    }
}

impl<
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
> Steerable<B, C, F, N> for Green<BX, BY, CX, CY, M, N, Q, T>
{
    fn pull(&self, at: &Self::Linearised, orbit: &[f32; B], into: &mut [f32; C]) {
        let (x, y) = orbit.split_at(BX.min(B));
        let (pull_x, pull_y) = into.split_at_mut(CX.min(C));
        at.x.pull(x, pull_x);
        at.y.pull(y, pull_y);
        self.low_rank.pull([x, y], [pull_x, pull_y]);
    }

    fn response_covariance(
        &self,
        at: &Self::Linearised,
        plane: usize,
        weight: &[f32; B],
        covariance: impl Fn(usize) -> [f32; N],
        add: impl FnMut(&[f32], &[f32]),
    ) {
        let (x, y) = weight.split_at(BX.min(B));
        let (slope, param) = (&at.slope, &self.param);
        if plane == 0 {
            response_covariance(&at.x.seen, &at.x.driven, x, slope, param, covariance, add);
        } else {
            response_covariance(&at.y.seen, &at.y.driven, y, slope, param, covariance, add);
        }
    }
}

impl<
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const M: usize,
    const N: usize,
    const Q: usize,
    const T: usize,
> Green<BX, BY, CX, CY, M, N, Q, T>
{
    /// Number of quadrupoles that focus in x; they come first.
    fn focusing(&self) -> usize {
        self.weight.iter().take_while(|weight| **weight > 0.0).count()
    }

    /// `ln` of each quadrupole's strength: that of its param and of its supply, where it has them. ([`NONE`] as an index is
    /// beyond any list.)
    fn ln_strength(&self, params: &[f32], supplies: &[f32]) -> [f32; M] {
        let mut strength = [0.0; M];
        for (to, (param, supply)) in strength.iter_mut().zip(self.param.iter().zip(&self.supply)) {
            let of = |list: &[f32], i: i16| list.get(i as usize).copied().unwrap_or(0.0);
            *to = of(params, *param) + of(supplies, *supply);
        }
        strength
    }

    /// `D` of a plane, the integrated gradient error of each node [1/m].
    fn excess(&self, strength: &[f32; M], sign: f32) -> [f32; Q] {
        let mut excess = [0.0; Q];
        for (pair, (weight, strength)) in excess.as_chunks_mut::<2>().0.iter_mut().zip(self.weight.iter().zip(strength))
        {
            *pair = [sign * weight * (strength - 1.0); 2];
        }
        excess
    }

    /// Add derivatives with respect to `ln` of each quadrupole's strength to those of its param and of its supply. ([`NONE`] as
    /// an index is beyond any list.) Neighbours mostly share a supply, whose sum stays in a register meanwhile: one in memory would make
    /// each addition wait for the one before, a tenth of all that a frame takes.
    #[inline]
    fn spread(&self, slopes: impl Iterator<Item = f32>, by_param: &mut [f32], by_supply: &mut [f32]) {
        let (mut at, mut sum) = (NONE, 0.0);
        for (slope, (param, supply)) in slopes.zip(self.param.iter().zip(&self.supply)) {
            by_param.get_mut(*param as usize).into_iter().for_each(|to| *to += slope);
            if *supply != at {
                by_supply.get_mut(at as usize).into_iter().for_each(|to| *to = sum);
                (at, sum) = (*supply, by_supply.get(*supply as usize).copied().unwrap_or(0.0));
            }
            sum += slope;
        }
        by_supply.get_mut(at as usize).into_iter().for_each(|to| *to = sum);
    }

    /// Derivatives of the readings of a plane, one column a monitor, for the pushes of the nodes.
    fn differentiate<const B: usize, const C: usize, const F: usize>(
        &self,
        plane: &PlaneLinearised<B, C, M, Q>,
        push: &[f32; Q],
        jacobian: &mut [f32],
        by_supply: &mut [[f32; F]],
    ) {
        let push = push.as_chunks::<2>().0;
        for ((by_param, by_supply), seen) in jacobian.chunks_exact_mut(N).zip(by_supply).zip(&plane.seen) {
            by_param.fill(0.0);
            by_supply.fill(0.0);
            let codes = seen.codes.as_chunks::<2>().0.iter().zip(push);
            let slopes = codes.map(|(z, x)| seen.scale * (f32::from(z[0]) * x[0] + f32::from(z[1]) * x[1]));
            self.spread(slopes, by_param, by_supply);
        }
    }

    /// Add the derivative of the momentum through the slip factor, `d(slip)/d(ln strength) = -sum of k L w strength D^2 / C`;
    /// `scale` is the momentum over the circumference.
    fn differentiate_slip<const F: usize>(
        &self,
        at: &GreenLinearised<BX, BY, CX, CY, M, Q>,
        scale: f32,
        jacobian: &mut [f32],
        by_supply: &mut [[f32; F]],
    ) {
        let each = jacobian.chunks_exact_mut(N).zip(by_supply).zip(&at.monitor_dispersion);
        for ((by_param, by_supply), dispersion) in each {
            let scale = dispersion * scale / at.slip;
            let nodes = at.node_dispersion.as_chunks::<2>().0.iter().zip(&at.slope);
            let slopes = nodes.map(|(d, k)| scale * (k * d[0] * d[0] + k * d[1] * d[1]));
            self.spread(slopes, by_param, by_supply);
        }
    }

    /// Dispersion `D' = D - Z_qq D_q D` at the nodes, alike at the monitors, and the slip factor.
    #[inline(never)]
    fn linearise_dispersion(
        &self,
        excess: &[f32; Q],
        at: &mut GreenLinearised<BX, BY, CX, CY, M, Q>,
        mutual: &Triangle<Q, T>,
    ) {
        let d = &self.dispersion;
        let kick = product(excess, d.node.iter().copied());
        at.node_dispersion = d.node;
        add(&mut at.node_dispersion, -1.0, &mutual.multiply(&kick));
        for ((to, design), seen) in at.monitor_dispersion.iter_mut().zip(&d.monitor).zip(&at.x.seen) {
            *to = design - seen.dot(&kick);
        }
        let compaction = d.compaction - dot(&kick, &at.node_dispersion) / d.circumference;
        at.slip = compaction - d.inverse_gamma_squared;
    }

    /// The orbit: kicks by the response, a known change of a supply's current as a change of `ln strength`, and the
    /// momentum `delta = -offset/slip` that an RF offset makes.
    fn read<const C: usize, const F: usize>(
        &self,
        at: &GreenLinearised<BX, BY, CX, CY, M, Q>,
        drive: &Drive<C, F>,
        pushes: &[[f32; Q]; 2],
        reading: &mut [f32],
    ) {
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let (x, y) = reading.split_at_mut(BX.min(reading.len()));
        at.x.read(kick_x, x);
        at.y.read(kick_y, y);
        self.low_rank.read([kick_x, kick_y], drive.rf_offset, [&mut *x, &mut *y]);
        let strength = self.ln_strength(&[], &drive.strength);
        if drive.strength != [0.0; F] {
            at.x.read_nodes(&scaled(&pushes[0], &strength), x);
            at.y.read_nodes(&scaled(&pushes[1], &strength), y);
        }
        if drive.rf_offset == 0.0 {
            return;
        }
        let change = at.slope.iter().zip(&strength).zip(at.node_dispersion.as_chunks::<2>().0);
        let slip = change.fold(0.0, |sum, ((k, s), d)| sum + k * s * d[0] * d[0] + k * s * d[1] * d[1]);
        let relative = 1.0 + slip / (at.slip * self.dispersion.circumference);
        let (delta, offset) = (at.delta(drive) * relative, drive.rf_offset);
        let each = at.monitor_dispersion.iter().zip(&self.dispersion.second_order);
        x.iter_mut().zip(each).for_each(|(x, (first, second))| *x += first * delta + second * offset * offset);
    }
}

/// Each node's value times the `ln` strength of its quadrupole.
fn scaled<const Q: usize, const M: usize>(values: &[f32; Q], strength: &[f32; M]) -> [f32; Q] {
    let mut scaled = *values;
    let pairs = scaled.as_chunks_mut::<2>().0.iter_mut().zip(strength);
    pairs.for_each(|(pair, s)| pair.iter_mut().for_each(|v| *v *= s));
    scaled
}

impl<const B: usize, const C: usize, const Q: usize, const T: usize> GreenPlane<B, C, Q, T> {
    const BLANK: Self =
        Self { direct: Block::BLANK, seen: Block::BLANK, driven: Block::BLANK, mutual: SymmetricBlock::BLANK };

    /// One step towards the plane at the errors of its nodes; `tune` is that of the design, `slope` is `k L w strength` of each
    /// quadrupole. True after the last step.
    #[inline(never)]
    fn advance<const M: usize>(
        &self,
        excess: &[f32; Q],
        (tune, slope): (f32, &[f32; M]),
        focusing: usize,
        progress: &mut GreenProgress<Q, T>,
        at: &mut PlaneLinearised<B, C, M, Q>,
    ) -> Result<bool, Unstable> {
        progress.step = match progress.step {
            Step::Pairs(from) => {
                let GreenProgress { determinant, mutual, .. } = &mut *progress;
                if from == 0 {
                    *determinant = 1.0;
                    self.mutual.values().zip(mutual.entries_mut()).for_each(|(v, to)| *to = v);
                }
                // one focusing and one defocusing quadrupole at a time: the intermediate tunes then stay between the design's
                // and the ring's
                let pairs = focusing.max(M - focusing.min(M));
                let to = pairs.min(from + PAIRS);
                for k in from..to {
                    let (one, other) = (2 * k, 2 * (k + focusing));
                    let one = if k < focusing { [one, one + 1] } else { [Q; 2] };
                    *determinant *= switch_on(mutual, excess, [one[0], one[1], other, other + 1])?;
                }
                if to == pairs {
                    at.set_tune(tune_at(tune, *determinant)?, slope, mutual);
                }
                if to < pairs { Step::Pairs(to) } else { Step::Seen(0) }
            }
            Step::Seen(from) => {
                let table = self.seen.codes.get(from..).unwrap_or_default();
                fill(at.seen.get_mut(from..).unwrap_or_default(), (self.seen.scale, table), excess, progress);
                if from + COLUMNS < B { Step::Seen(from + COLUMNS) } else { Step::Driven(0) }
            }
            Step::Driven(from) => {
                let table = self.driven.codes.get(from..).unwrap_or_default();
                fill(at.driven.get_mut(from..).unwrap_or_default(), (self.driven.scale, table), excess, progress);
                if from + COLUMNS < C { Step::Driven(from + COLUMNS) } else { Step::Response(0) }
            }
            Step::Response(from) => {
                self.respond(excess, from, at);
                if from + RESPONSES >= C {
                    progress.step = Step::Pairs(0);
                    return Ok(true);
                }
                Step::Response(from + RESPONSES)
            }
        };
        Ok(false)
    }

    /// `R = G_bc - Z_bq D G_qc`, the first [`RESPONSES`] columns from one on.
    fn respond<const M: usize>(&self, excess: &[f32; Q], from: usize, at: &mut PlaneLinearised<B, C, M, Q>) {
        let relief = excess.map(|error| -error);
        for c in (from..C).take(RESPONSES) {
            let mut response = [0.0; B];
            response.iter_mut().zip(self.direct.column(c)).for_each(|(to, direct)| *to = direct);
            at.read_nodes(&product(&relief, self.driven.column(c)), &mut response);
            at.response.get_mut(c).into_iter().for_each(|to| to.quantise(&response));
        }
    }
}

/// The tune up to an integer of a ring whose closure `4 sin^2(pi Q)` is `determinant` times that of the design, on the
/// design's side of the half-integer.
fn tune_at(design: f32, determinant: f32) -> Result<f32, Unstable> {
    let sine = libm::sinf(core::f32::consts::PI * design);
    let square = sine * sine * determinant;
    if !(0.0..1.0).contains(&square) {
        return Err(Unstable);
    }
    let tune = libm::asinf(libm::sqrtf(square)) * core::f32::consts::FRAC_1_PI;
    let fraction = design - libm::floorf(design);
    Ok(if fraction < 0.5 { tune } else { 1.0 - tune })
}

impl<const B: usize, const C: usize, const M: usize, const Q: usize> PlaneLinearised<B, C, M, Q> {
    /// Rms of `dR_bc/d(ln strength) = - sum over nodes of k L w strength Z_qb Z_qc` over a [`sample`] of the ring's monitors `b` and correctors `c`, for the
    /// quadrupoles of each supply and for all of them, over the rms of `R_bc`.
    #[inline(never)]
    fn follow<const F: usize>(
        &self,
        slope: &[f32; M],
        supply: &[i16; M],
        [monitors, correctors]: [usize; 2],
    ) -> ([f32; F], f32) {
        let (mut by_supply, mut of_all, mut size) = ([0.0; F], 0.0, 0.0);
        let driven = sample(correctors).filter_map(|c| self.driven.get(c).zip(self.response.get(c)));
        for (driven, response) in driven {
            size += response.squares(sample(monitors));
            for seen in sample(monitors).filter_map(|b| self.seen.get(b)) {
                let (mut change, mut all) = ([0.0; F], 0.0);
                let nodes = seen.codes.as_chunks::<2>().0.iter().zip(driven.codes.as_chunks::<2>().0);
                for (([a, b], [c, d]), (slope, supply)) in nodes.zip(slope.iter().zip(supply)) {
                    let one = slope * (f32::from(*a) * f32::from(*c) + f32::from(*b) * f32::from(*d));
                    all += one;
                    change.get_mut(*supply as usize).into_iter().for_each(|to| *to += one);
                }
                let scale = seen.scale * driven.scale;
                of_all += scale * all * (scale * all);
                by_supply.iter_mut().zip(change).for_each(|(sum, change)| *sum += scale * change * (scale * change));
            }
        }
        if size > 0.0 {
            (by_supply.map(|sum| libm::sqrtf(sum / size)), libm::sqrtf(of_all / size))
        } else {
            ([0.0; F], 0.0)
        }
    }

    /// The tune, and `dQ/d(ln strength) = tan(pi Q)/(2 pi) slope (sum of Z_nn)` of each quadrupole.
    fn set_tune<const T: usize>(&mut self, tune: f32, slope: &[f32; M], mutual: &Triangle<Q, T>) {
        self.tune = tune;
        let steep = libm::tanf(core::f32::consts::PI * tune) / core::f32::consts::TAU;
        for (q, (to, slope)) in self.tune_slope.iter_mut().zip(slope).enumerate() {
            *to = steep * slope * (mutual.get(2 * q, 2 * q) + mutual.get(2 * q + 1, 2 * q + 1));
        }
    }

    /// The orbit that kicks make at the nodes, on top of the `orbit` that the momentum makes there [m].
    fn orbit_at_nodes(&self, kick: &[f32], mut orbit: [f32; Q]) -> [f32; Q] {
        acting(kick, self.driven.iter()).for_each(|(kick, driven)| driven.add_to(kick, &mut orbit));
        orbit
    }

    /// Readings for kicks of correctors.
    fn read(&self, kick: &[f32], reading: &mut [f32]) {
        reading.fill(0.0);
        acting(kick, self.response.iter()).for_each(|(kick, response)| response.add_to(kick, reading));
    }

    /// `R^T orbit` [m^2/rad].
    fn pull(&self, orbit: &[f32], pull: &mut [f32]) {
        let each = pull.iter_mut().zip(&self.response);
        each.for_each(|(pull, response)| *pull = response.scale * dot_codes(&response.codes, orbit));
    }

    /// Add readings for kicks of nodes.
    fn read_nodes(&self, kick: &[f32; Q], reading: &mut [f32]) {
        let ((seen, last_seen), (reading, last)) = (self.seen.as_chunks::<4>(), reading.as_chunks_mut::<4>());
        for (reading, seen) in reading.iter_mut().zip(seen) {
            let sums = dot_four_codes(seen.each_ref().map(|seen| seen.codes.as_slice()), kick);
            let each = reading.iter_mut().zip(seen.iter().zip(sums));
            each.for_each(|(reading, (seen, sum))| *reading += seen.scale * sum);
        }
        last.iter_mut().zip(last_seen).for_each(|(reading, seen)| *reading += seen.dot(kick));
    }
}

/// The sum of the codes of a quadrupole's two nodes, which is exact.
fn both([a, b]: &[i16; 2]) -> f32 {
    (i32::from(*a) + i32::from(*b)) as f32
}

/// That of every quadrupole.
fn both_nodes<const M: usize, const Q: usize>(nodes: &Column<Q>) -> [f32; M] {
    let mut sums = [0.0; M];
    sums.iter_mut().zip(nodes.codes.as_chunks::<2>().0).for_each(|(to, pair)| *to = both(pair));
    sums
}

/// `sum over b of weight_b cov(R_bc, R_bd)` as a sum over quadrupoles `q` of products `Z_qc (sum over p of A_qp cov_qp Z_pc)`
/// with `A_qp = 4 slope_q slope_p sum over b of weight_b Z_qb Z_pb`. The two nodes of a quadrupole count as one between
/// them: within half a metre an orbit hardly bends.
#[inline(never)] // one for both planes
fn response_covariance<const C: usize, const M: usize, const N: usize, const Q: usize>(
    seen: &[Column<Q>],
    driven: &[Column<Q>; C],
    weight: &[f32],
    slope: &[f32; M],
    param: &[i16; M],
    covariance: impl Fn(usize) -> [f32; N],
    mut add: impl FnMut(&[f32], &[f32]),
) {
    let pairs = driven.each_ref().map(both_nodes::<M, Q>);
    for (q, (own, slope_q)) in param.iter().zip(slope).enumerate() {
        let Some(own) = usize::try_from(*own).ok().filter(|own| *own < N) else { continue };
        let mut row = [0.0; M];
        for (seen, weight) in seen.iter().zip(weight) {
            let factor = weight * seen.scale * between(seen, q);
            let nodes = seen.codes.as_chunks::<2>().0;
            row.iter_mut().zip(nodes).for_each(|(to, pair)| *to += factor * both(pair));
        }
        let shared = covariance(own);
        for (to, (slope, param)) in row.iter_mut().zip(slope.iter().zip(param)) {
            let covariance = shared.get(*param as usize).copied().unwrap_or(0.0);
            *to *= slope_q * slope * covariance;
        }
        let (mut here, mut there) = ([0.0; C], [0.0; C]);
        for ((driven, pairs), (here, there)) in driven.iter().zip(&pairs).zip(here.iter_mut().zip(&mut there)) {
            *here = between(driven, q);
            *there = driven.scale * row.iter().zip(pairs).map(|(row, pair)| row * pair).sum::<f32>();
        }
        add(&here, &there);
    }
}

/// The mean of the two nodes of quadrupole `q`.
fn between<const Q: usize>(nodes: &Column<Q>, q: usize) -> f32 {
    let mean = |[a, b]: &[i16; 2]| 0.5 * (f32::from(*a) + f32::from(*b));
    nodes.codes.as_chunks::<2>().0.get(q).map_or(0.0, |codes| nodes.scale * mean(codes))
}

/// Monitors and correctors of a plane at most over which [`PlaneLinearised::follow`] takes its means: off by 1.3 % at most on rings of 64 to 256 cells
/// (`tests/tests/ripple.rs`).
const SAMPLE: usize = 64;

/// Indices of all of a number of instruments, or of [`SAMPLE`] where there are more: at multiples of the golden ratio, which falls in step with no cell and no
/// betatron phase; of fewer than 127 some repeat.
fn sample(number: usize) -> impl Iterator<Item = usize> {
    (0..number.min(SAMPLE)).map(move |i| {
        let turn = 0.618_034 * i as f32;
        if number > SAMPLE { ((turn - libm::floorf(turn)) * number as f32) as usize } else { i }
    })
}

/// The kicks that are not zero, each with its column.
fn acting<V>(kick: &[f32], columns: impl Iterator<Item = V>) -> impl Iterator<Item = (f32, V)> {
    kick.iter().copied().zip(columns).filter(|(kick, _)| *kick != 0.0)
}

/// The first [`COLUMNS`] columns, at most, of a part of a table, in the ring as it is: `Z = G - Z_qq D G`, four rows of `Z_qq` at a
/// time.
#[inline(never)]
fn fill<const Q: usize, const T: usize>(
    to: &mut [Column<Q>],
    (scale, table): (f32, &[[i16; Q]]),
    excess: &[f32; Q],
    GreenProgress { mutual, columns, rows, .. }: &mut GreenProgress<Q, T>,
) {
    for (column, codes) in columns.iter_mut().zip(table) {
        column.iter_mut().zip(codes).for_each(|(to, code)| *to = scale * f32::from(*code));
    }
    for first in (0..Q).step_by(4) {
        let mut errors = [0.0; 4];
        for ((n, row), error) in (first..Q).zip(&mut *rows).zip(&mut errors) {
            mutual.copy_row(n, row);
            *error = -scale * excess.get(n).copied().unwrap_or(0.0);
        }
        let rows = rows.each_ref().map(<[f32; Q]>::as_slice);
        let kicks = |codes: &[i16; Q]| {
            let mut kicks = errors;
            kicks.iter_mut().zip(codes.iter().skip(first)).for_each(|(k, code)| *k *= f32::from(*code));
            kicks
        };
        add_four_to_each(
            columns.iter_mut().zip(table).map(|(column, codes)| (column.as_mut_slice(), kicks(codes))),
            rows,
        );
    }
    to.iter_mut().zip(&*columns).for_each(|(to, column)| to.quantise(column));
}

/// `a b`, one by one.
fn product<const Q: usize>(a: &[f32; Q], b: impl Iterator<Item = f32>) -> [f32; Q] {
    let mut product = *a;
    product.iter_mut().zip(b).for_each(|(a, b)| *a *= b);
    product
}

/// Switch on the errors of four nodes, one after the other; a node beyond the last has none. Returns the product of their
/// `1 + e g_n`.
///
/// `1 + e g_n` is the ring's closure with the node's error over that without; it reaches zero at an integer resonance,
/// and a ring beyond one is not connected with the design.
#[inline(never)]
fn switch_on<const Q: usize, const T: usize>(
    mutual: &mut Triangle<Q, T>,
    excess: &[f32; Q],
    nodes: [usize; 4],
) -> Result<f32, Unstable> {
    let (mut columns, mut weights, mut determinant) = ([[0.0; Q]; 4], [0.0; 4], 1.0);
    for (i, &node) in nodes.iter().enumerate() {
        let (Some((done, [column, ..])), Some(error)) = (columns.split_at_mut_checked(i), excess.get(node)) else {
            continue;
        };
        mutual.copy_row(node, column);
        for (before, weight) in done.iter().zip(&weights) {
            add(column, -weight * before.get(node).copied().unwrap_or(0.0), before);
        }
        let pivot = 1.0 + error * column.get(node).copied().unwrap_or(0.0);
        if pivot.is_nan() || pivot < 1e-3 {
            return Err(Unstable);
        }
        weights.get_mut(i).into_iter().for_each(|w| *w = error / pivot);
        determinant *= pivot;
    }
    let factors = |r: usize| {
        let mut factors = weights;
        factors.iter_mut().zip(&columns).for_each(|(w, column)| *w *= -column.get(r).copied().unwrap_or(0.0));
        factors
    };
    mutual.add_products(factors, columns.each_ref().map(<[f32; Q]>::as_slice));
    Ok(determinant)
}

#[cfg(test)]
mod tests {
    use nalgebra::SMatrix;

    use super::*;

    /// A symmetric Green's function of six nodes, and errors.
    fn example() -> (SMatrix<f32, 6, 6>, [f32; 6]) {
        let g = SMatrix::<f32, 6, 6>::from_fn(|r, c| libm::cosf(2.4 - (r as f32 - c as f32).abs()));
        (g, core::array::from_fn(|n| 0.1 * libm::sinf(2.0 * n as f32)))
    }

    fn triangle(g: &SMatrix<f32, 6, 6>) -> Triangle<6, 21> {
        let mut triangle = Triangle::ZERO;
        for (r, row) in triangle.rows_mut().enumerate() {
            row.iter_mut().enumerate().for_each(|(c, v)| *v = g[(r, c)]);
        }
        triangle
    }

    #[test]
    fn node_by_node_is_the_resolvent() {
        let (g, excess) = example();
        let mut mutual = triangle(&g);
        let first = switch_on(&mut mutual, &excess, [0, 1, 4, 5]).unwrap();
        let second = switch_on(&mut mutual, &excess, [2, 3, 6, 7]).unwrap();
        let closure = SMatrix::identity() + g * SMatrix::from_diagonal(&excess.into());
        let exact = closure.try_inverse().unwrap() * g;
        assert!((first * second - closure.determinant()).abs() < 1e-5); // f32 rounding
        for r in 0..6 {
            for c in 0..=r {
                assert!((mutual.get(r, c) - exact[(r, c)]).abs() < 1e-5); // f32 rounding
            }
        }
    }

    /// A thin quadrupole of `k L` at `beta` shifts a tune by `cos(2 pi Q') = cos(2 pi Q) - k L beta sin(2 pi Q)/2`.
    ///
    /// Source: S. Y. Lee, Accelerator Physics, ch. 2, effect of quadrupole field error.
    #[test]
    fn a_thin_quadrupole_shifts_the_tune() {
        for (design, gradient) in [(4.83_f64, 0.01), (4.17, 0.01), (2.3, -0.02)] {
            let (beta, angle) = (7.0, core::f64::consts::TAU * design);
            let green = beta * libm::cos(0.5 * angle) / (2.0 * libm::sin(0.5 * angle));
            let cosine = libm::cos(angle) - 0.5 * gradient * beta * libm::sin(angle);
            let exact = libm::acos(cosine) / core::f64::consts::TAU;
            let fraction = design - libm::floor(design);
            let exact = if fraction < 0.5 { exact } else { 1.0 - exact };
            let tune = tune_at(design as f32, (1.0 + gradient * green) as f32).unwrap();
            assert!((f64::from(tune) - exact).abs() < 1e-6, "{tune} {exact}"); // f32 rounding
        }
        assert_eq!(tune_at(0.45, 2.0), Err(Unstable));
    }

    #[test]
    fn a_ring_beyond_the_resonance_is_unstable() {
        let (g, mut excess) = example();
        excess[2] = -1.2 / g[(2, 2)];
        assert_eq!(switch_on(&mut triangle(&g), &excess, [2, 3, 0, 1]), Err(Unstable));
        assert_eq!(switch_on(&mut triangle(&g), &[f32::NAN; 6], [0, 1, 2, 3]), Err(Unstable));
    }
}
