//! Monitors and correctors as they are, which need not be as the machine file has them.

use twin::{Observer, Optics, Ring, Source};

/// What monitors and correctors make of the orbit of a beam. As it is taken into the tables, it acts on every derivative.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Instruments {
    /// Momentum deviation of the beam.
    pub delta: f64,
    /// Which monitor each one really is [B].
    pub monitor: Vec<usize>,
    /// What each one makes of a metre [B].
    pub monitor_gain: Vec<f64>,
    /// Which corrector each one really is [C].
    pub corrector: Vec<usize>,
    /// What each one makes of a radian [C].
    pub corrector_gain: Vec<f64>,
}

impl Instruments {
    /// All as they should be.
    pub fn sound(ring: &Ring) -> Self {
        let (monitors, correctors) = (ring.read_monitors.len(), ring.correctors.len());
        Self {
            delta: 0.0,
            monitor: (0..monitors).collect(),
            monitor_gain: vec![1.0; monitors],
            corrector: (0..correctors).collect(),
            corrector_gain: vec![1.0; correctors],
        }
    }

    /// The read monitors as they are.
    pub fn monitors(&self, optics: &Optics) -> Vec<Observer> {
        let read = optics.read_monitors();
        self.monitor.iter().zip(&self.monitor_gain).map(|(&b, &gain)| read[b].times(gain)).collect()
    }

    /// The corrector whose setting powers one.
    pub fn supply_of(&self, corrector: usize) -> usize {
        self.corrector.iter().position(|&c| c == corrector).expect("exchanges leave every corrector powered")
    }

    /// What one makes of a radian.
    pub fn gain_of(&mut self, corrector: usize) -> &mut f64 {
        let supply = self.supply_of(corrector);
        &mut self.corrector_gain[supply]
    }

    /// The correctors as they are.
    pub fn correctors(&self, optics: &Optics) -> Vec<Source> {
        let sources = optics.correctors();
        self.corrector.iter().zip(&self.corrector_gain).map(|(&c, &gain)| sources[c].times(gain)).collect()
    }
}
