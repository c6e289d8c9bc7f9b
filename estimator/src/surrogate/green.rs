//! The closed-orbit Green's function of the design ring, quantised, with the gradient errors taken in exactly.
//!
//! Each quadrupole is two Gauss-Legendre nodes. With `G` the design Green's functions between correctors c, monitors b
//! and nodes q, and `D = diag(k L w (strength - 1))` (k becomes -k in y, w = 1/2), the function between the nodes of the
//! ring as it is, `Z_qq = (1 + G_qq D)^-1 G_qq`, is built up node by node: switching on the error `e` of node n takes
//!
//! `g g^T e/(1 + e g_n)` from it, `g` its column n. The rest are products:
//!
//! `Z_qc = G_qc - Z_qq D G_qc`, `Z_qb = G_qb - Z_qq D G_qb`, `R = G_bc - Z_bq D G_qc`, and
//! `dR_bc/d(ln strength) = - sum over the quadrupole's nodes of k L w strength Z_qb Z_qc`.
//!
//! Dispersion is one more column of the same form, whose source is the dipoles. Both planes are independent; what couples
//! them, and whatever else a ring has beyond its design, is a short sum of products on top, see [`LowRank`].
//!
//! Source: the resolvent (Dyson) form of the perturbed Green's function, taken in by rank one after rank one (J. Sherman
//! and W. J. Morrison, Ann. Math. Stat. 21 (1950) 124); S. Y. Lee, Accelerator Physics, ch. 2, for G.

use nalgebra::SMatrix;

use super::{Block, LowRank, Prediction, Surrogate, SymmetricBlock, Unstable};
use crate::drive::Drive;
use crate::linear::{add, add_four, add_four_twice, combine, dot, zeros};
use crate::triangle::Triangle;

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
    /// `k L w` of each node, focusing in this plane positive [1/m].
    pub weight: [f32; Q],
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
#[derive(Debug, Clone, PartialEq)]
pub struct Green<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize, const T: usize> {
    /// Horizontal plane: the first `BX` monitors and `CX` correctors.
    pub x: GreenPlane<BX, CX, Q, T>,
    /// Vertical plane: the rest.
    pub y: GreenPlane<BY, CY, Q, T>,
    /// Momentum.
    pub dispersion: Dispersion<BX, Q>,
    /// What is beyond both planes' Green's functions; none in a ring as designed.
    pub low_rank: LowRank<BX, BY, CX, CY>,
    /// Number of quadrupoles on the first (QH) supply; they come first.
    pub first_family: u16,
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
}

impl<const B: usize, const C: usize, const Q: usize> PlaneLinearised<B, C, Q> {
    const BLANK: Self = Self { seen: zeros(), driven: zeros(), response: zeros(), slope: [0.0; Q] };
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize, const T: usize>
    Green<BX, BY, CX, CY, Q, T>
{
    /// Memory for tables, all zero.
    pub const BLANK: Self = Self {
        x: GreenPlane::BLANK,
        y: GreenPlane::BLANK,
        dispersion: Dispersion {
            monitor: [0.0; BX],
            node: [0.0; Q],
            second_order: [0.0; BX],
            spurious: [0.0; 2],
            compaction: 0.0,
            inverse_gamma_squared: 0.0,
            circumference: 0.0,
        },
        low_rank: LowRank::BLANK,
        first_family: 0,
        stated_error: [0.0; 2],
    };
    /// Bytes of the tables, without room for terms of low rank.
    pub const BYTES: usize =
        GreenPlane::<BX, CX, Q, T>::BYTES + GreenPlane::<BY, CY, Q, T>::BYTES + 4 * (2 * BX + Q + 5);
    /// Entries of the tables.
    pub const PARAMETERS: usize = BX * CX + BY * CY + Q * (BX + BY + CX + CY + 3) + 2 * T + 2 * BX + 5;
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

    /// Relative momentum that an RF offset makes.
    fn delta<const C: usize>(&self, drive: &Drive<C>) -> f32 {
        -drive.rf_offset / self.slip
    }

    /// Kicks in x and y that a unit of `ln strength` adds at each node: `-k L w strength` times the orbit there [rad].
    fn pushes<const C: usize>(&self, drive: &Drive<C>) -> [[f32; Q]; 2] {
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let delta = self.delta(drive);
        [self.x.push(kick_x, self.node_dispersion.map(|d| d * delta)), self.y.push(kick_y, [0.0; Q])]
    }

    /// Add the derivative of the momentum through the slip factor, `d(slip)/d(ln strength) = -sum of k L w strength D^2 / C`;
    /// `scale` is the momentum over the circumference.
    fn differentiate_slip(&self, scale: f32, jacobian: &mut [f32]) {
        for (slopes, dispersion) in jacobian.chunks_exact_mut(Q / 2).zip(&self.monitor_dispersion) {
            let scale = dispersion * scale / self.slip;
            let nodes = self.node_dispersion.chunks_exact(2).zip(self.x.slope.chunks_exact(2));
            for (slope, (d, k)) in slopes.iter_mut().zip(nodes) {
                *slope += scale * (k[0] * d[0] * d[0] + k[1] * d[1] * d[1]);
            }
        }
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
    const T: usize,
> Surrogate<B, C, N> for Green<BX, BY, CX, CY, Q, T>
{
    type Linearised = GreenLinearised<BX, BY, CX, CY, Q>;

    const BLANK: Self::Linearised = GreenLinearised {
        x: PlaneLinearised::BLANK,
        y: PlaneLinearised::BLANK,
        monitor_dispersion: [0.0; BX],
        node_dispersion: [0.0; Q],
        slip: 0.0,
    };

    #[inline(never)] // 19 kB of stack, for as long as it runs
    fn linearise(&self, strength: &[f32; N], at: &mut Self::Linearised) -> Result<(), Unstable> {
        const { assert!(B == BX + BY && C == CX + CY && Q == 2 * N, "planes and nodes add up") };
        let mut mutual = Triangle::ZERO;
        let first_family = usize::from(self.first_family);
        self.y.linearise(strength, first_family, &mut at.y, &mut mutual)?;
        // x last: what it leaves between the nodes is used once more, for the dispersion
        self.x.linearise(strength, first_family, &mut at.x, &mut mutual)?;
        self.linearise_dispersion(&self.x.excess(strength), at, &mutual);
        Ok(())
    }

    fn orbit(&self, at: &Self::Linearised, drive: &Drive<C>, into: &mut [f32; B]) {
        // without a change of current, what the nodes would add is not needed
        let pushes = if drive.strength == [0.0; 2] { [[0.0; Q]; 2] } else { at.pushes(drive) };
        self.read(at, drive, &pushes, into);
    }

    fn predict(&self, at: &Self::Linearised, drive: &Drive<C>, into: &mut Prediction<B, N>) {
        let pushes = at.pushes(drive);
        self.read(at, drive, &pushes, &mut into.reading);
        let (jacobian_x, jacobian_y) = into.jacobian.as_mut_slice().split_at_mut(N * BX.min(B));
        at.x.differentiate(&pushes[0], jacobian_x);
        at.y.differentiate(&pushes[1], jacobian_y);
        if drive.rf_offset != 0.0 {
            at.differentiate_slip(at.delta(drive) / self.dispersion.circumference, jacobian_x);
        }
    }

    fn first_family(&self) -> usize {
        usize::from(self.first_family)
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

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize, const Q: usize, const T: usize>
    Green<BX, BY, CX, CY, Q, T>
{
    #[inline(never)]
    /// Dispersion `D' = D - Z_qq D_q D` at the nodes, alike at the monitors, and the slip factor.
    fn linearise_dispersion(
        &self,
        excess: &[f32; Q],
        at: &mut GreenLinearised<BX, BY, CX, CY, Q>,
        mutual: &Triangle<Q, T>,
    ) {
        let d = &self.dispersion;
        let kick = product(excess, d.node.iter().copied());
        at.node_dispersion = d.node;
        add(&mut at.node_dispersion, -1.0, &mutual.multiply(&kick));
        let seen = at.x.seen.as_slice().chunks_exact(Q);
        for ((to, design), seen) in at.monitor_dispersion.iter_mut().zip(&d.monitor).zip(seen) {
            *to = design - dot(seen, &kick);
        }
        let compaction = d.compaction - dot(&kick, &at.node_dispersion) / d.circumference;
        at.slip = compaction - d.inverse_gamma_squared;
    }

    /// The orbit: kicks by the response, a known change of a family's current as a change of `ln strength`, and the
    /// momentum `delta = -offset/slip` that an RF offset makes.
    fn read<const C: usize>(
        &self,
        at: &GreenLinearised<BX, BY, CX, CY, Q>,
        drive: &Drive<C>,
        pushes: &[[f32; Q]; 2],
        reading: &mut [f32],
    ) {
        let (kick_x, kick_y) = drive.kick.split_at(CX.min(C));
        let (x, y) = reading.split_at_mut(BX.min(reading.len()));
        let first = 2 * usize::from(self.first_family);
        at.x.read(kick_x, x);
        at.y.read(kick_y, y);
        self.low_rank.read([kick_x, kick_y], drive.rf_offset, [&mut *x, &mut *y]);
        if drive.strength != [0.0; 2] {
            at.x.read_nodes(&scaled(&pushes[0], first, drive.strength), x);
            at.y.read_nodes(&scaled(&pushes[1], first, drive.strength), y);
        }
        if drive.rf_offset == 0.0 {
            return;
        }
        let change = scaled(&at.x.slope, first, drive.strength);
        let slip: f32 = change.iter().zip(&at.node_dispersion).map(|(k, d)| k * d * d).sum();
        let relative = 1.0 + slip / (at.slip * self.dispersion.circumference);
        let (delta, offset) = (at.delta(drive) * relative, drive.rf_offset);
        let each = at.monitor_dispersion.iter().zip(&self.dispersion.second_order);
        x.iter_mut().zip(each).for_each(|(x, (first, second))| *x += first * delta + second * offset * offset);
    }
}

/// Each node's value times the `ln` factor of its family.
fn scaled<const Q: usize>(values: &[f32; Q], first_family: usize, strength: [f32; 2]) -> [f32; Q] {
    let mut scaled = *values;
    let (first, second) = scaled.split_at_mut(first_family.min(Q));
    first.iter_mut().for_each(|v| *v *= strength[0]);
    second.iter_mut().for_each(|v| *v *= strength[1]);
    scaled
}

impl<const B: usize, const C: usize, const Q: usize, const T: usize> GreenPlane<B, C, Q, T> {
    /// Bytes of the tables of one plane.
    pub const BYTES: usize =
        Block::<B, C>::BYTES + Block::<Q, B>::BYTES + Block::<Q, C>::BYTES + SymmetricBlock::<Q, T>::BYTES + 4 * Q;
    const BLANK: Self = Self {
        direct: Block::BLANK,
        seen: Block::BLANK,
        driven: Block::BLANK,
        mutual: SymmetricBlock::BLANK,
        weight: [0.0; Q],
    };

    /// `D`, the integrated gradient error of each node [1/m].
    fn excess<const N: usize>(&self, strength: &[f32; N]) -> [f32; Q] {
        let mut excess = self.weight;
        for (pair, strength) in excess.chunks_exact_mut(2).zip(strength) {
            pair.iter_mut().for_each(|e| *e *= strength - 1.0);
        }
        excess
    }

    #[inline(never)]
    fn linearise<const N: usize>(
        &self,
        strength: &[f32; N],
        first_family: usize,
        at: &mut PlaneLinearised<B, C, Q>,
        mutual: &mut Triangle<Q, T>,
    ) -> Result<(), Unstable> {
        let excess = self.excess(strength);
        self.mutual.values().zip(mutual.entries_mut()).for_each(|(v, to)| *to = v);
        // a quadrupole of each family together: in between, the tunes stay between the design's and the ring's
        for k in 0..first_family.max(N - first_family.min(N)) {
            let (one, other) = (2 * k, 2 * (k + first_family));
            let one = if k < first_family { [one, one + 1] } else { [Q; 2] };
            switch_on(mutual, &excess, [one[0], one[1], other, other + 1])?;
        }
        fill(at.seen.as_mut_slice(), &self.seen, mutual, &excess);
        fill(at.driven.as_mut_slice(), &self.driven, mutual, &excess);
        let responses = at.response.as_mut_slice().chunks_exact_mut(B);
        for (c, response) in responses.enumerate() {
            let kick = product(&excess, self.driven.column(c));
            let seen = at.seen.as_slice().chunks_exact(Q);
            for ((to, direct), seen) in response.iter_mut().zip(self.direct.column(c)).zip(seen) {
                *to = direct - dot(seen, &kick);
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
    /// What a unit of `ln strength` adds at each node to the kicks, on top of the `orbit` that the momentum makes there.
    fn push(&self, kick: &[f32], mut orbit: [f32; Q]) -> [f32; Q] {
        combine(&mut orbit, acting(kick, self.driven.as_slice().chunks_exact(Q)));
        orbit.iter_mut().zip(&self.slope).for_each(|(x, k)| *x *= -k);
        orbit
    }

    /// Readings for kicks of correctors.
    fn read(&self, kick: &[f32], reading: &mut [f32]) {
        reading.fill(0.0);
        combine(reading, acting(kick, self.response.as_slice().chunks_exact(B)));
    }

    /// Add readings for kicks of nodes.
    fn read_nodes(&self, kick: &[f32; Q], reading: &mut [f32]) {
        let seen = self.seen.as_slice().chunks_exact(Q);
        reading.iter_mut().zip(seen).for_each(|(reading, seen)| *reading += dot(seen, kick));
    }

    /// Derivatives of the readings, one column a monitor, for the pushes of the nodes.
    fn differentiate(&self, push: &[f32; Q], jacobian: &mut [f32]) {
        let push = push.as_chunks::<2>().0;
        for (slopes, seen) in jacobian.chunks_exact_mut(Q / 2).zip(self.seen.as_slice().chunks_exact(Q)) {
            for (slope, (z, x)) in slopes.iter_mut().zip(seen.as_chunks::<2>().0.iter().zip(push)) {
                *slope = z[0] * x[0] + z[1] * x[1];
            }
        }
    }
}

/// The kicks that are not zero, each with its column.
fn acting<'a>(kick: &'a [f32], columns: impl Iterator<Item = &'a [f32]>) -> impl Iterator<Item = (f32, &'a [f32])> {
    kick.iter().copied().zip(columns).filter(|(kick, _)| *kick != 0.0)
}

/// Columns of a table, in the ring as it is: `Z = G - Z_qq D G`, four rows of `Z_qq` at a time.
#[inline(never)]
fn fill<const Q: usize, const M: usize, const T: usize>(
    to: &mut [f32],
    table: &Block<Q, M>,
    mutual: &Triangle<Q, T>,
    excess: &[f32; Q],
) {
    for (m, column) in to.chunks_exact_mut(Q).enumerate() {
        column.iter_mut().zip(table.column(m)).for_each(|(to, g)| *to = g);
    }
    let mut rows = [[0.0; Q]; 4];
    for from in (0..Q).step_by(4) {
        let mut errors = [0.0; 4];
        for ((n, row), error) in (from..Q).zip(&mut rows).zip(&mut errors) {
            mutual.copy_row(n, row);
            *error = -table.scale * excess.get(n).copied().unwrap_or(0.0);
        }
        let rows = rows.each_ref().map(<[f32; Q]>::as_slice);
        let kicks = |codes: &[i16; Q]| {
            let mut kicks = errors;
            kicks.iter_mut().zip(codes.iter().skip(from)).for_each(|(k, code)| *k *= f32::from(*code));
            kicks
        };
        let mut each = to.chunks_exact_mut(Q).zip(&table.codes);
        while let Some((one, codes)) = each.next() {
            match each.next() {
                Some((other, others)) => add_four_twice([one, other], [kicks(codes), kicks(others)], rows),
                None => add_four(one, kicks(codes), rows),
            }
        }
    }
}

/// `a b`, one by one.
fn product<const Q: usize>(a: &[f32; Q], b: impl Iterator<Item = f32>) -> [f32; Q] {
    let mut product = *a;
    product.iter_mut().zip(b).for_each(|(a, b)| *a *= b);
    product
}

/// Switch on the errors of four nodes, one after the other; a node beyond the last has none.
///
/// `1 + e g_n` is the ring's closure with the node's error over that without; it reaches zero at an integer resonance,
/// and a ring beyond one is not connected with the design.
#[inline(never)]
fn switch_on<const Q: usize, const T: usize>(
    mutual: &mut Triangle<Q, T>,
    excess: &[f32; Q],
    nodes: [usize; 4],
) -> Result<(), Unstable> {
    let (mut columns, mut weights) = ([[0.0; Q]; 4], [0.0; 4]);
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
    }
    let factors = |r: usize| {
        let mut factors = weights;
        factors.iter_mut().zip(&columns).for_each(|(w, column)| *w *= -column.get(r).copied().unwrap_or(0.0));
        factors
    };
    mutual.add_products(factors, columns.each_ref().map(<[f32; Q]>::as_slice));
    Ok(())
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
        switch_on(&mut mutual, &excess, [0, 1, 4, 5]).unwrap();
        switch_on(&mut mutual, &excess, [2, 3, 6, 7]).unwrap();
        let d = SMatrix::from_diagonal(&excess.into());
        let exact = (SMatrix::identity() + g * d).try_inverse().unwrap() * g;
        for r in 0..6 {
            for c in 0..=r {
                assert!((mutual.get(r, c) - exact[(r, c)]).abs() < 1e-5); // f32 rounding
            }
        }
    }

    #[test]
    fn a_ring_beyond_the_resonance_is_unstable() {
        let (g, mut excess) = example();
        excess[2] = -1.2 / g[(2, 2)];
        assert_eq!(switch_on(&mut triangle(&g), &excess, [2, 3, 0, 1]), Err(Unstable));
        assert_eq!(switch_on(&mut triangle(&g), &[f32::NAN; 6], [0, 1, 2, 3]), Err(Unstable));
    }
}
