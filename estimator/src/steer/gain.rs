//! The gains of one plane: the inverse of `A`, made between frames, and the kicks that follow from it.

use crate::linear::add;
use crate::triangle::Triangle;

/// Most times that each corrector is set in a frame.
const SWEEPS: usize = 8;
/// Share of a corrector's room by which it may still be off.
const CLOSE: f32 = 1e-3;

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

    /// The kicks of the least cost [rad] within the room that each corrector has in this frame; the plane's correctors are those from
    /// the `first` on.
    ///
    /// Without limits they are `-A^-1 pull`; a corrector at its edge adds a force `f_c` there: `d = -A^-1 (pull + f)`. One corrector
    /// after the other gets the force that it needs, or loses what it needs no more, until none changes.
    ///
    /// Source: C. Hildreth, A quadratic programming procedure, Naval Res. Logist. Q. 4 (1957) 79.
    #[inline(never)]
    pub fn step(&self, pull: &[f32], room: &impl Fn(usize) -> [f32; 2], first: usize, step: &mut [f32]) {
        let mut best = [0.0; C];
        best.iter_mut().zip(pull).for_each(|(to, pull)| *to = -pull);
        best = self.inverse.multiply(&best);
        let mut force = [0.0; C];
        for _ in 0..SWEEPS {
            if !self.sweep(&mut best, &mut force, &|c| room(first + c)) {
                break;
            }
        }
        for (c, (to, d)) in step.iter_mut().zip(best).enumerate() {
            *to = if d.is_finite() { within(d, room(first + c)) } else { 0.0 };
        }
    }

    /// Set the force on one corrector after the other; true if any has changed by what counts.
    fn sweep(&self, kicks: &mut [f32; C], force: &mut [f32; C], room: &impl Fn(usize) -> [f32; 2]) -> bool {
        let mut changed = false;
        for (c, force) in force.iter_mut().enumerate() {
            let (own, [lower, upper]) = (self.inverse.get(c, c), room(c));
            let kick = kicks.get(c).copied().unwrap_or_default();
            let free = kick + own * *force;
            let by = within(free, [lower, upper]) - kick;
            if by != 0.0 && own > 0.0 {
                let mut column = [0.0; C];
                self.inverse.copy_row(c, &mut column);
                add(kicks, by / own, &column);
                *force -= by / own;
                changed |= by.abs() > CLOSE * (upper - lower);
            }
        }
        changed
    }
}

/// The value within bounds that is nearest to this one.
fn within(value: f32, [lower, upper]: [f32; 2]) -> f32 {
    value.min(upper).max(lower)
}
