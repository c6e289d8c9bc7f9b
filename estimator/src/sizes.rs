//! Sizes of a ring and of a core, and the slots of a larger core that the ring takes.

use serde::{Deserialize, Serialize};

/// How many of everything.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sizes {
    /// Monitors in x and in y.
    pub monitors: [u16; 2],
    /// Correctors in x and in y.
    pub correctors: [u16; 2],
    /// Quadrupoles, fitted or not.
    pub quadrupoles: u16,
    /// Params.
    pub params: u16,
    /// Supplies of quadrupoles.
    pub supplies: u16,
}

impl Sizes {
    /// Sizes as constants of a program.
    pub const fn new(monitors: [usize; 2], correctors: [usize; 2], magnets: [usize; 3]) -> Self {
        let [quadrupoles, params, supplies] = magnets;
        Self {
            monitors: [monitors[0] as u16, monitors[1] as u16],
            correctors: [correctors[0] as u16, correctors[1] as u16],
            quadrupoles: quadrupoles as u16,
            params: params as u16,
            supplies: supplies as u16,
        }
    }

    /// Each number: monitors x, y, correctors x, y, quadrupoles, params, supplies.
    pub const fn all(&self) -> [u16; 7] {
        let ([bx, by], [cx, cy]) = (self.monitors, self.correctors);
        [bx, by, cx, cy, self.quadrupoles, self.params, self.supplies]
    }

    /// True if there is room for all of a ring's.
    pub fn hold(&self, ring: &Self) -> bool {
        self.all().iter().zip(ring.all()).all(|(room, has)| has <= *room)
    }
}

/// A ring in a core that may have room for more. Of monitors and correctors those of x come first, and those of y begin
/// where the core's do; all else begins at 0. What is spare stays silent: a monitor that never reports, a corrector that is
/// never powered, a param that no quadrupole has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// What the ring has.
    pub ring: Sizes,
    /// What the core has room for.
    pub room: Sizes,
}

impl Layout {
    /// Slot of a ring's monitor; x in beam order, then y.
    pub fn monitor(&self, index: usize) -> usize {
        slot(index, self.ring.monitors, self.room.monitors)
    }

    /// Slot of a ring's corrector.
    pub fn corrector(&self, index: usize) -> usize {
        slot(index, self.ring.correctors, self.room.correctors)
    }

    /// Number of the ring's monitors.
    pub fn monitors(&self) -> usize {
        total(self.ring.monitors)
    }

    /// Number of the ring's correctors.
    pub fn correctors(&self) -> usize {
        total(self.ring.correctors)
    }

    /// Number of the ring's params.
    pub fn params(&self) -> usize {
        usize::from(self.ring.params)
    }

    /// Number of the ring's supplies.
    pub fn supplies(&self) -> usize {
        usize::from(self.ring.supplies)
    }

    /// Slot of the first vertical monitor.
    pub fn first_vertical(&self) -> usize {
        usize::from(self.room.monitors[0])
    }
}

fn total([x, y]: [u16; 2]) -> usize {
    usize::from(x) + usize::from(y)
}

fn slot(index: usize, ring: [u16; 2], room: [u16; 2]) -> usize {
    let horizontal = usize::from(ring[0]);
    if index < horizontal { index } else { index - horizontal + usize::from(room[0]) }
}

/// The largest of some numbers.
pub const fn largest(of: &[usize]) -> usize {
    let (mut most, mut i) = (0, 0);
    while i < of.len() {
        if of[i] > most {
            most = of[i];
        }
        i += 1;
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vertical_ones_begin_where_the_core_s_do() {
        let layout = Layout { ring: Sizes::new([2, 1], [1, 2], [3; 3]), room: Sizes::new([4, 4], [2, 2], [3; 3]) };
        assert_eq!([0, 1, 2].map(|b| layout.monitor(b)), [0, 1, 4]);
        assert_eq!([0, 1, 2].map(|c| layout.corrector(c)), [0, 2, 3]);
        assert!(layout.room.hold(&layout.ring) && !layout.ring.hold(&layout.room));
    }
}
