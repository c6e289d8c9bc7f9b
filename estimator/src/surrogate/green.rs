//! The closed-orbit Green's function of the design ring, quantised, with the gradient errors solved for exactly.
//!
//! Each quadrupole is two Gauss-Legendre nodes. With `G` the design Green's functions between correctors c, monitors b
//! and nodes q, and `D = diag(k L w (strength - 1))` (k becomes -k in y, w = 1/2), a kick drives at the nodes
//!
//! `Z_qc = (1 + G_qq D)^-1 G_qc`, and at the monitors `R = G_bc - G_bq D Z_qc`;
//!
//! with `Z_qb` made the same way, `dR_bc/d(ln strength) = - sum over the quadrupole's nodes of k L w strength Z_qb Z_qc`.
//! Dispersion is one more column of the same form, whose source is the dipoles. Both planes are independent: coupling
//! is left to a surrogate that carries it.
//!
//! Source: the resolvent (Dyson) form of the perturbed Green's function; S. Y. Lee, Accelerator Physics, ch. 2, for G.

use nalgebra::SMatrix;

use super::{Block, Prediction, Surrogate, Unstable};
use crate::drive::Drive;
use crate::linear::{add, dot};

/// One plane: `B` monitors, `C` correctors, `Q` nodes (two a quadrupole).
#[derive(Debug, Clone)]
pub struct GreenPlane<const B: usize, const C: usize, const Q: usize> {
    /// Monitors to correctors, `G_bc` [m/rad].
    pub direct: Block<B, C>,
    /// Nodes to monitors, `G_qb` [m/rad].
    pub seen: Block<Q, B>,
    /// Nodes to correctors, `G_qc` [m/rad].
    pub driven: Block<Q, C>,
    /// Nodes to nodes, `G_qq` [m/rad].
    pub mutual: Block<Q, Q>,
    /// `k L w` of each node, focusing in this plane positive [1/m].
    pub weight: [f32; Q],
}

/// Horizontal dispersion and the slip factor, for frames with an RF offset.
#[derive(Debug, Clone)]
pub struct Dispersion<const B: usize, const Q: usize> {
    /// Design dispersion at the monitors [m].
    pub monitor: [f32; B],
    /// Design dispersion at the nodes [m].
    pub node: [f32; Q],
    /// Design orbit of second order in the relative RF offset, at the monitors [m].
    pub second_order: [f32; B],
    /// Rms change of a misaligned ring's orbit per unit of RF offset and of rms orbit, beyond the design dispersion, in x
    /// and y [1].
    pub spurious: [f32; 2],
    /// Design momentum compaction [1].
    pub compaction: f32,
    /// `1/gamma^2` of the beam [1].
    pub inverse_gamma_squared: f32,
    /// Circumference [m].
    pub circumference: f32,
}

/// Green's function surrogate of a ring with monitors and correctors in two planes.
#[derive(Debug, Clone)]
pub struct Green<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize> {
    /// Horizontal plane: the first `BX` monitors and `CX` correctors.
    pub x: GreenPlane<BX, CX, Q>,
    /// Vertical plane: the rest.
    pub y: GreenPlane<BY, CY, Q>,
    /// Momentum.
    pub dispersion: Dispersion<BX, Q>,
    /// Number of quadrupoles on the first (QH) supply; they come first.
    pub first_family: usize,
    /// Stated rms error in x and y [m].
    pub stated_error: [f32; 2],
}

/// One plane at given strengths.
#[derive(Debug, Clone)]
struct PlaneLinearised<const B: usize, const C: usize, const Q: usize> {
    /// Nodes to monitors, `Z_qb`.
    seen: SMatrix<f32, Q, B>,
    /// Nodes to correctors, `Z_qc`.
    driven: SMatrix<f32, Q, C>,
    /// Monitors to correctors, `R`.
    response: SMatrix<f32, B, C>,
    /// `k L w strength` of each node.
    slope: [f32; Q],
}

/// The surrogate at given strengths.
#[derive(Debug, Clone)]
pub struct GreenLinearised<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize> {
    x: PlaneLinearised<BX, CX, Q>,
    y: PlaneLinearised<BY, CY, Q>,
    /// Dispersion at the monitors [m].
    monitor_dispersion: [f32; BX],
    /// Dispersion at the nodes [m].
    node_dispersion: [f32; Q],
    /// Slip factor `compaction - 1/gamma^2` [1].
    slip: f32,
    /// Factors of `1 + G_qq D`, work space of both planes.
    factors: SMatrix<f32, Q, Q>,
}

impl<const B: usize, const C: usize, const Q: usize> Default for PlaneLinearised<B, C, Q> {
    fn default() -> Self {
        Self { seen: SMatrix::zeros(), driven: SMatrix::zeros(), response: SMatrix::zeros(), slope: [0.0; Q] }
    }
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize> Default
    for GreenLinearised<BX, BY, CX, CY, Q>
{
    fn default() -> Self {
        Self {
            x: PlaneLinearised::default(),
            y: PlaneLinearised::default(),
            monitor_dispersion: [0.0; BX],
            node_dispersion: [0.0; Q],
            slip: 0.0,
            factors: SMatrix::zeros(),
        }
    }
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize> Green<BX, BY, CX, CY, Q> {
    /// Bytes of the tables.
    pub const BYTES: usize = GreenPlane::<BX, CX, Q>::BYTES + GreenPlane::<BY, CY, Q>::BYTES + 4 * (2 * BX + Q + 5);
    /// Entries of the tables.
    pub const PARAMETERS: usize = BX * CX + BY * CY + Q * (BX + BY + CX + CY + 2 * Q + 3) + 2 * BX + 5;
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize>
    GreenLinearised<BX, BY, CX, CY, Q>
{
    /// Response of the horizontal monitors to the horizontal correctors [m/rad].
    pub fn response_x(&self) -> &SMatrix<f32, BX, CX> {
        &self.x.response
    }

    /// Response of the vertical monitors to the vertical correctors [m/rad].
    pub fn response_y(&self) -> &SMatrix<f32, BY, CY> {
        &self.y.response
    }
}

impl<
    const B: usize,
    const C: usize,
    const N: usize,
    const BX: usize,
    const BY: usize,
    const CX: usize,
    const CY: usize,
    const Q: usize,
> Surrogate<B, C, N> for Green<BX, BY, CX, CY, Q>
{
    type Linearised = GreenLinearised<BX, BY, CX, CY, Q>;

    fn linearise(&self, strength: &[f32; N], at: &mut Self::Linearised) -> Result<(), Unstable> {
        const { assert!(B == BX + BY && C == CX + CY && Q == 2 * N, "planes and nodes add up") };
        let mut pivots = [0; Q];
        self.y.linearise(strength, &mut at.y, &mut at.factors, &mut pivots)?;
        // x last: its factors are used once more, for the dispersion
        self.x.linearise(strength, &mut at.x, &mut at.factors, &mut pivots)?;
        let d = &self.dispersion;
        at.node_dispersion = d.node;
        solve(&at.factors, &pivots, &mut at.node_dispersion);
        let excess = self.x.excess(strength);
        let mut compaction = d.compaction;
        let weighted: [f32; Q] = core::array::from_fn(|n| excess[n] * at.node_dispersion[n]);
        compaction -= dot(&weighted, &d.node) / d.circumference;
        at.slip = compaction - d.inverse_gamma_squared;
        let mut seen = [0.0; Q];
        for (b, (to, design)) in at.monitor_dispersion.iter_mut().zip(&d.monitor).enumerate() {
            seen.iter_mut().zip(self.x.seen.column(b)).for_each(|(s, v)| *s = v);
            *to = design - dot(&seen, &weighted);
        }
        Ok(())
    }

    fn predict(&self, at: &Self::Linearised, drive: &Drive<C>, into: &mut Prediction<B, N>) {
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let (reading_x, reading_y) = into.reading.split_at_mut(BX.min(B));
        let (jacobian_x, jacobian_y) = into.jacobian.as_mut_slice().split_at_mut(N * BX.min(B));
        let delta = -drive.rf_offset / at.slip;
        let mut orbit = at.node_dispersion.map(|d| d * delta);
        at.x.predict(kick_x, &mut orbit, reading_x, jacobian_x);
        at.y.predict(kick_y, &mut [0.0; Q], reading_y, jacobian_y);
        if drive.rf_offset != 0.0 {
            self.disperse(at, drive.rf_offset, delta, reading_x, jacobian_x);
        }
        // A change of a family's current is a change of ln strength that is known.
        for (reading, slope) in into.reading.iter_mut().zip(into.jacobian.as_slice().chunks_exact(N)) {
            let (first, second) = slope.split_at(self.first_family.min(N));
            *reading += drive.strength[0] * first.iter().sum::<f32>() + drive.strength[1] * second.iter().sum::<f32>();
        }
    }

    fn first_family(&self) -> usize {
        self.first_family
    }

    fn horizontal_monitors(&self) -> usize {
        BX
    }

    fn error_variance(&self, monitor: usize, rf_offset: f32, orbit: f32) -> f32 {
        let plane = usize::from(monitor >= BX);
        let spurious = self.dispersion.spurious[plane] * orbit * rf_offset;
        self.stated_error[plane] * self.stated_error[plane] + spurious * spurious
    }
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize> Green<BX, BY, CX, CY, Q> {
    /// Add the momentum `delta = -offset/slip` that an RF offset makes, with its derivative through the slip factor:
    /// `d(slip)/d(ln strength) = -sum of k L w strength D^2 / C`.
    fn disperse(
        &self,
        at: &GreenLinearised<BX, BY, CX, CY, Q>,
        offset: f32,
        delta: f32,
        reading: &mut [f32],
        jacobian: &mut [f32],
    ) {
        let params = Q / 2;
        for (b, reading) in reading.iter_mut().enumerate() {
            let dispersion = at.monitor_dispersion.get(b).copied().unwrap_or(0.0);
            let second = self.dispersion.second_order.get(b).copied().unwrap_or(0.0);
            *reading += dispersion * delta + second * offset * offset;
            let scale = dispersion * delta / (at.slip * self.dispersion.circumference);
            let slopes = jacobian.iter_mut().skip(b * params).take(params);
            let nodes = at.node_dispersion.chunks_exact(2).zip(at.x.slope.chunks_exact(2));
            for (slope, (d, k)) in slopes.zip(nodes) {
                *slope += scale * (k[0] * d[0] * d[0] + k[1] * d[1] * d[1]);
            }
        }
    }
}

impl<const B: usize, const C: usize, const Q: usize> GreenPlane<B, C, Q> {
    /// Bytes of the tables of one plane.
    pub const BYTES: usize =
        Block::<B, C>::BYTES + Block::<Q, B>::BYTES + Block::<Q, C>::BYTES + Block::<Q, Q>::BYTES + 4 * Q;

    /// `D`, the integrated gradient error of each node [1/m].
    fn excess<const N: usize>(&self, strength: &[f32; N]) -> [f32; Q] {
        let mut excess = self.weight;
        for (pair, strength) in excess.chunks_exact_mut(2).zip(strength) {
            pair.iter_mut().for_each(|e| *e *= strength - 1.0);
        }
        excess
    }

    fn linearise<const N: usize>(
        &self,
        strength: &[f32; N],
        at: &mut PlaneLinearised<B, C, Q>,
        factors: &mut SMatrix<f32, Q, Q>,
        pivots: &mut [usize; Q],
    ) -> Result<(), Unstable> {
        let excess = self.excess(strength);
        for (n, excess) in excess.iter().enumerate() {
            let column = factors.as_mut_slice().iter_mut().skip(n * Q).take(Q);
            column.zip(self.mutual.column(n)).for_each(|(f, g)| *f = g * excess);
            factors[(n, n)] += 1.0;
        }
        factorise(factors, pivots)?;
        fill(at.driven.as_mut_slice(), &self.driven, factors, pivots);
        fill(at.seen.as_mut_slice(), &self.seen, factors, pivots);
        let mut seen = SMatrix::<f32, Q, B>::zeros();
        for (b, to) in seen.as_mut_slice().chunks_exact_mut(Q).enumerate() {
            to.iter_mut().zip(self.seen.column(b)).zip(&excess).for_each(|((to, g), e)| *to = g * e);
        }
        let responses = at.response.as_mut_slice().chunks_exact_mut(B).zip(at.driven.as_slice().chunks_exact(Q));
        for (c, (response, driven)) in responses.enumerate() {
            let seen = seen.as_slice().chunks_exact(Q);
            for ((to, direct), seen) in response.iter_mut().zip(self.direct.column(c)).zip(seen) {
                *to = direct - dot(seen, driven);
            }
        }
        at.slope = self.weight;
        for (pair, strength) in at.slope.chunks_exact_mut(2).zip(strength) {
            pair.iter_mut().for_each(|k| *k *= strength);
        }
        Ok(())
    }
}

impl<const B: usize, const C: usize, const Q: usize> PlaneLinearised<B, C, Q> {
    /// Readings and their derivatives for kicks on top of the `orbit` that the momentum makes at the nodes.
    fn predict(&self, kick: &[f32], orbit: &mut [f32; Q], reading: &mut [f32], jacobian: &mut [f32]) {
        reading.fill(0.0);
        let columns = self.driven.as_slice().chunks_exact(Q).zip(self.response.as_slice().chunks_exact(B));
        for (kick, (driven, response)) in kick.iter().zip(columns) {
            add(orbit, *kick, driven);
            add(reading, *kick, response);
        }
        orbit.iter_mut().zip(&self.slope).for_each(|(x, k)| *x *= -k);
        for (slopes, seen) in jacobian.chunks_exact_mut(Q / 2).zip(self.seen.as_slice().chunks_exact(Q)) {
            for (slope, (z, x)) in slopes.iter_mut().zip(seen.chunks_exact(2).zip(orbit.chunks_exact(2))) {
                *slope = z[0] * x[0] + z[1] * x[1];
            }
        }
    }
}

/// Columns of a table, solved with the factors.
fn fill<const Q: usize, const M: usize>(
    to: &mut [f32],
    table: &Block<Q, M>,
    factors: &SMatrix<f32, Q, Q>,
    pivots: &[usize; Q],
) {
    for (m, column) in to.chunks_exact_mut(Q).enumerate() {
        column.iter_mut().zip(table.column(m)).for_each(|(to, v)| *to = v);
        solve(factors, pivots, column);
    }
}

/// LU factors with partial pivoting, in place. nalgebra's own take the matrix by value, 37 kB of stack at Q = 96.
///
/// The determinant is that of the ring's closure over the design's; it reaches zero at an integer resonance, and a
/// ring beyond one is not connected with the design.
fn factorise<const Q: usize>(a: &mut SMatrix<f32, Q, Q>, pivots: &mut [usize; Q]) -> Result<(), Unstable> {
    let mut positive = true;
    for (k, chosen) in pivots.iter_mut().enumerate() {
        let largest = (k..Q).fold(k, |best, r| if a[(r, k)].abs() > a[(best, k)].abs() { r } else { best });
        *chosen = largest;
        if largest != k {
            a.swap_rows(k, largest);
            positive = !positive;
        }
        let pivot = a[(k, k)];
        if pivot.is_nan() || pivot.abs() < 1e-3 {
            return Err(Unstable);
        }
        positive ^= pivot < 0.0;
        let (done, rest) = a.as_mut_slice().split_at_mut((k + 1) * Q);
        let Some(below) = done.get_mut(k * Q + k + 1..) else { continue };
        below.iter_mut().for_each(|l| *l /= pivot);
        for column in rest.chunks_exact_mut(Q) {
            if let Some((top, under)) = column.get_mut(k..).and_then(<[f32]>::split_first_mut) {
                add(under, -*top, below);
            }
        }
    }
    if positive { Ok(()) } else { Err(Unstable) }
}

/// Solve with the factors, in place.
fn solve<const Q: usize>(factors: &SMatrix<f32, Q, Q>, pivots: &[usize; Q], x: &mut [f32]) {
    for (k, &pivot) in pivots.iter().enumerate() {
        x.swap(k, pivot.min(Q - 1));
    }
    let columns = factors.as_slice().chunks_exact(Q);
    for (k, column) in columns.clone().enumerate() {
        if let (Some((top, under)), Some(below)) =
            (x.get_mut(k..).and_then(<[f32]>::split_first_mut), column.get(k + 1..))
        {
            add(under, -*top, below);
        }
    }
    for (k, column) in columns.enumerate().rev() {
        let (Some((above, pivot)), Some((over, top))) = (
            column.get(..=k).and_then(|c| c.split_last().map(|(p, a)| (a, *p))),
            x.get_mut(..=k).and_then(<[f32]>::split_last_mut).map(|(t, o)| (o, t)),
        ) else {
            continue;
        };
        *top /= pivot;
        add(over, -*top, above);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::SVector;

    use super::*;

    #[test]
    fn factors_solve_their_matrix() {
        let a =
            SMatrix::<f32, 6, 6>::from_fn(|r, c| if r == c { 1.0 } else { 0.3 * libm::sinf((3 * r + 5 * c) as f32) });
        let (mut factors, mut pivots) = (a, [0; 6]);
        let x = SVector::<f32, 6>::from_fn(|r, _| r as f32 - 2.0);
        let determinant = a.determinant();
        assert!(determinant > 0.0);
        factorise(&mut factors, &mut pivots).unwrap();
        let mut b = a * x;
        solve(&factors, &pivots, b.as_mut_slice());
        assert!((b - x).abs().max() < 1e-5, "{b}"); // f32 rounding
    }

    #[test]
    fn a_matrix_beyond_the_resonance_is_unstable() {
        let mut a = SMatrix::<f32, 4, 4>::identity();
        a[(2, 2)] = -0.2;
        assert_eq!(factorise(&mut a, &mut [0; 4]), Err(Unstable));
        assert_eq!(factorise(&mut SMatrix::<f32, 4, 4>::zeros(), &mut [0; 4]), Err(Unstable));
    }
}
