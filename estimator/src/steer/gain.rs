//! The gains of one plane: the inverse of `A`, made between frames, and the kicks that follow from it.

use crate::linear::add;
use crate::triangle::Triangle;

/// Correctors that are brought back to their limit, one after the other, while the others make up for it.
const BROUGHT_BACK: usize = 4;

/// `A^-1` of one plane of `C` correctors [rad^2].
#[derive(Debug, Clone)]
pub struct Gain<const C: usize, const T: usize> {
    inverse: Triangle<C, T>,
    ready: bool,
}

impl<const C: usize, const T: usize> Gain<C, T> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { inverse: Triangle::ZERO, ready: false };

    /// They are not to be used any more: other correctors count.
    pub fn forget(&mut self) {
        self.ready = false;
    }

    /// True once they are made.
    pub fn is_ready(&self) -> bool {
        self.ready
    }

    /// Make them; without a positive `A` there are none.
    #[inline(never)]
    pub fn invert(&mut self, mut matrix: Triangle<C, T, f64>) {
        self.ready = matrix.factorise().is_some();
        if !self.ready {
            return;
        }
        matrix.invert();
        matrix.square();
        let each = self.inverse.entries_mut().iter_mut().zip(matrix.entries_mut());
        each.for_each(|(to, from)| *to = *from as f32);
    }

    /// The kicks `-A^-1 pull` [rad], within the room that each corrector has, and scaled so that none moves faster than its rate; the
    /// plane's correctors are those from the `first` on.
    ///
    /// Where the best kicks are beyond a corrector's room, it is held at its edge and the others make up for it:
    /// `d -= A^-1 e_c (d_c - edge)/(A^-1)_cc` is the minimum on condition that `d_c = edge`.
    #[inline(never)]
    pub fn step(
        &self,
        pull: &[f32],
        room: &impl Fn(usize) -> [f32; 2],
        rate: &impl Fn(usize) -> f32,
        first: usize,
        step: &mut [f32],
    ) {
        let (room, rate) = (|c| room(first + c), |c| rate(first + c));
        let mut best = [0.0; C];
        best.iter_mut().zip(pull).for_each(|(to, pull)| *to = -pull);
        best = self.inverse.multiply(&best);
        for _ in 0..BROUGHT_BACK {
            let beyond = |(c, d): (usize, &f32)| {
                let [lower, upper] = room(c);
                (c, (d - upper).max(0.0) + (d - lower).min(0.0))
            };
            let each = best.iter().enumerate().map(beyond);
            let worst = each.fold((0, 0.0_f32), |worst, this| if this.1.abs() > worst.1.abs() { this } else { worst });
            if worst.1 == 0.0 {
                break;
            }
            self.bring_back(&mut best, worst);
        }
        let mut share = 1.0_f32;
        for (c, d) in best.iter_mut().enumerate() {
            let [lower, upper] = room(c);
            *d = if d.is_finite() { d.min(upper).max(lower) } else { 0.0 };
            share = share.min(rate(c) / d.abs());
        }
        step.iter_mut().zip(best).for_each(|(to, d)| *to = share * d);
    }

    fn bring_back(&self, kicks: &mut [f32; C], (c, excess): (usize, f32)) {
        let mut column = [0.0; C];
        self.inverse.copy_row(c, &mut column);
        let own = self.inverse.get(c, c);
        if own > 0.0 {
            add(kicks, -excess / own, &column);
        }
    }
}
