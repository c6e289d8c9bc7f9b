//! Extension terms: responses that no Green's function of one plane has, as a short sum of products.
//!
//! A rolled quadrupole or a skew gradient couples the planes through the orbit at one place, a held RF frequency adds the
//! dispersion at the monitor times that at the corrector, a rolled monitor or corrector is one row or one column: each is a
//! product `seen driven^T`, or few of them. They are constant: their dependence on the vars is left out.

use super::quantised::{add_codes, code, dot_codes, step};

/// Terms there is room for: three effects of two each, and two to spare.
pub const TERMS: usize = 8;

/// Products added to the orbit, `reading_b += scale seen_b (sum of driven_c kick_c + rf_offset f)`, each with its codes.
///
/// Terms come first; the first `scale` of zero ends the list, so that an empty one costs nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct LowRank<const BX: usize, const BY: usize, const CX: usize, const CY: usize> {
    /// Size of one step of `seen` times one of `driven` [m/rad].
    pub scale: [f32; TERMS],
    /// What one unit of RF offset drives, in steps of `driven` [rad].
    pub rf_offset: [f32; TERMS],
    /// At the horizontal monitors.
    pub seen_x: [[i16; BX]; TERMS],
    /// At the vertical monitors.
    pub seen_y: [[i16; BY]; TERMS],
    /// By the horizontal correctors.
    pub driven_x: [[i16; CX]; TERMS],
    /// By the vertical correctors.
    pub driven_y: [[i16; CY]; TERMS],
}

impl<const BX: usize, const BY: usize, const CX: usize, const CY: usize> LowRank<BX, BY, CX, CY> {
    /// No term.
    pub const BLANK: Self = Self {
        scale: [0.0; TERMS],
        rf_offset: [0.0; TERMS],
        seen_x: [[0; BX]; TERMS],
        seen_y: [[0; BY]; TERMS],
        driven_x: [[0; CX]; TERMS],
        driven_y: [[0; CY]; TERMS],
    };

    /// Number of terms.
    pub fn len(&self) -> usize {
        self.scale.iter().take_while(|scale| **scale != 0.0).count()
    }

    /// No term.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Add the term `seen driven^T`, all of it finite: at the monitors in x and y [m], by the correctors in x and y [1/rad],
    /// and by the RF [1]. Off by half a step in each, `max/65534`. Returns false, and adds nothing, if there is no room.
    pub fn push(&mut self, seen: [&[f64]; 2], driven: [&[f64]; 2], rf_offset: f64) -> bool {
        let term = self.len();
        let [seen_step, driven_step] = [seen, driven].map(|[x, y]| step(x.iter().chain(y).copied()));
        let (Some(scale), Some(rf)) = (self.scale.get_mut(term), self.rf_offset.get_mut(term)) else { return false };
        (*scale, *rf) = (seen_step * driven_step, (rf_offset / f64::from(driven_step)) as f32);
        quantise(self.seen_x.get_mut(term), seen[0], seen_step);
        quantise(self.seen_y.get_mut(term), seen[1], seen_step);
        quantise(self.driven_x.get_mut(term), driven[0], driven_step);
        quantise(self.driven_y.get_mut(term), driven[1], driven_step);
        true
    }

    /// Add the orbit that kicks [rad] and a relative RF offset make through the terms [m].
    pub(super) fn read(&self, [kick_x, kick_y]: [&[f32]; 2], rf_offset: f32, [x, y]: [&mut [f32]; 2]) {
        let seen = self.seen_x.iter().zip(&self.seen_y);
        let driven = self.driven_x.iter().zip(&self.driven_y);
        let terms = self.scale.iter().zip(&self.rf_offset).zip(seen.zip(driven));
        for ((scale, rf), ((seen_x, seen_y), (driven_x, driven_y))) in
            terms.take_while(|((scale, _), _)| **scale != 0.0)
        {
            let amplitude = scale * (dot_codes(driven_x, kick_x) + dot_codes(driven_y, kick_y) + rf * rf_offset);
            add_codes(x, amplitude, seen_x);
            add_codes(y, amplitude, seen_y);
        }
    }

    /// Add what an orbit asks of the correctors through the terms: the transpose of [`LowRank::read`] for kicks.
    pub(super) fn pull(&self, [x, y]: [&[f32]; 2], [pull_x, pull_y]: [&mut [f32]; 2]) {
        let seen = self.seen_x.iter().zip(&self.seen_y);
        let driven = self.driven_x.iter().zip(&self.driven_y);
        for (scale, ((seen_x, seen_y), (driven_x, driven_y))) in
            self.scale.iter().zip(seen.zip(driven)).take_while(|(scale, _)| **scale != 0.0)
        {
            let amplitude = scale * (dot_codes(seen_x, x) + dot_codes(seen_y, y));
            add_codes(pull_x, amplitude, driven_x);
            add_codes(pull_y, amplitude, driven_y);
        }
    }
}

fn quantise<const L: usize>(to: Option<&mut [i16; L]>, values: &[f64], step: f32) {
    to.into_iter().flatten().zip(values).for_each(|(to, value)| *to = code(*value, step));
}

#[cfg(test)]
mod tests {
    use super::*;

    type Small = LowRank<2, 1, 1, 2>;

    #[test]
    fn a_term_adds_seen_times_driven() {
        let mut terms = Small::BLANK;
        assert!(terms.push([&[3.0, -1.0], &[2.0]], [&[0.5], &[1.0, -0.25]], 4.0));
        let (mut x, mut y) = ([10.0_f32, 20.0], [30.0_f32]);
        terms.read([&[2.0], &[1.0, 8.0]], 0.5, [&mut x, &mut y]);
        // 0.5*2 + 1*1 - 0.25*8 + 4*0.5 = 2, at the monitors 6, -2, 4; half a step of each factor is 1.5e-5 of its largest
        for (got, expected) in x.iter().chain(&y).zip([16.0, 18.0, 34.0]) {
            assert!((got - expected).abs() < 1e-3, "{got} {expected}");
        }
    }

    #[test]
    fn pull_is_the_transpose() {
        let mut terms = Small::BLANK;
        assert!(terms.push([&[3.0, -1.0], &[2.0]], [&[0.5], &[1.0, -0.25]], 4.0));
        let (mut x, mut y, mut pull_x, mut pull_y) = ([0.0; 2], [0.0], [0.0], [0.0; 2]);
        let (kick, orbit) = ([2.0, 1.0, 8.0], [0.3, 0.7, -0.2]);
        terms.read([&kick[..1], &kick[1..]], 0.0, [&mut x, &mut y]);
        terms.pull([&orbit[..2], &orbit[2..]], [&mut pull_x, &mut pull_y]);
        let seen: f32 = x.iter().chain(&y).zip(orbit).map(|(a, b)| a * b).sum();
        let asked: f32 = pull_x.iter().chain(&pull_y).zip(kick).map(|(a, b)| a * b).sum();
        assert!((seen - asked).abs() < 1e-6, "{seen} {asked}"); // rounding
    }

    #[test]
    fn no_term_leaves_every_bit() {
        let (mut x, mut y) = ([-0.0_f32, 20.0], [f32::MIN_POSITIVE]);
        Small::BLANK.read([&[2.0], &[1.0, 8.0]], 0.5, [&mut x, &mut y]);
        assert_eq!((x.map(f32::to_bits), y[0]), ([(-0.0_f32).to_bits(), 20_f32.to_bits()], f32::MIN_POSITIVE));
    }

    #[test]
    fn a_term_beyond_the_room_is_refused() {
        let mut terms = Small::BLANK;
        assert!((0..TERMS).all(|_| terms.push([&[1.0; 2], &[1.0]], [&[1.0], &[1.0; 2]], 1.0)));
        let full = terms.clone();
        assert!(!terms.push([&[1.0; 2], &[1.0]], [&[1.0], &[1.0; 2]], 1.0) && terms == full && full.len() == TERMS);
    }
}
