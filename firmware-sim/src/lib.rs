//! What surrounds the core on a machine: so far the status outputs, two pins that an operator can see.
//!
//! The loop from bytes to estimates, and its image for a Cortex-M, will live here as well.
#![no_std]

use embedded_hal::digital::OutputPin;
use estimator::{Estimate, MonitorState};

/// Two lamps: one follows the cycle, one says that the instruments need a look.
#[derive(Debug)]
pub struct Panel<P> {
    heartbeat: P,
    attention: P,
    beat: bool,
}

impl<P: OutputPin> Panel<P> {
    /// Drive two pins.
    pub fn new(heartbeat: P, attention: P) -> Self {
        Self { heartbeat, attention, beat: false }
    }

    /// Show an estimate: the heartbeat toggles, and attention lights while any monitor is not ok or any var clipped.
    ///
    /// # Errors
    /// What the pins report.
    pub fn show<const B: usize, const N: usize>(&mut self, estimate: &Estimate<B, N>) -> Result<(), P::Error> {
        self.beat = !self.beat;
        self.heartbeat.set_state(self.beat.into())?;
        let faulty = estimate.health.iter().any(|h| h.state != MonitorState::Ok);
        self.attention.set_state((faulty || estimate.clipped != 0).into())
    }
}

#[cfg(test)]
mod tests {
    use core::cell::Cell;
    use core::convert::Infallible;

    use embedded_hal::digital::ErrorType;
    use estimator::Health;

    use super::*;

    #[derive(Debug)]
    struct Lamp<'a>(&'a Cell<bool>);

    impl ErrorType for Lamp<'_> {
        type Error = Infallible;
    }

    impl OutputPin for Lamp<'_> {
        fn set_low(&mut self) -> Result<(), Infallible> {
            self.0.set(false);
            Ok(())
        }

        fn set_high(&mut self) -> Result<(), Infallible> {
            self.0.set(true);
            Ok(())
        }
    }

    fn estimate(state: MonitorState) -> Estimate<1, 1> {
        Estimate {
            sequence: 0,
            time_us: 0,
            frames: 1,
            rejected_frames: 0,
            mean: [1.0],
            sigma: [0.01],
            map_params: [0.0],
            centre: [0.0],
            params_sigma: [0.01],
            clipped: 0,
            nis: 1.0,
            accepted: 1,
            rejected: 0,
            confirmed: 0,
            restarted: 0,
            setting: None,
            log_evidence: 0.0,
            linearised: false,
            health: [Health { state, ..Health::default() }],
        }
    }

    #[test]
    fn the_lamps_follow_the_estimates() {
        let (heartbeat, attention) = (Cell::new(false), Cell::new(false));
        let mut panel = Panel::new(Lamp(&heartbeat), Lamp(&attention));
        panel.show(&estimate(MonitorState::Ok)).unwrap();
        assert_eq!((heartbeat.get(), attention.get()), (true, false));
        panel.show(&estimate(MonitorState::Noisy)).unwrap();
        assert_eq!((heartbeat.get(), attention.get()), (false, true));
    }
}
