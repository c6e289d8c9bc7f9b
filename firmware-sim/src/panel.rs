//! The three output pins of a device, for the operator and a watchdog.

use embedded_hal::digital::OutputPin;

/// Two lamps, a heartbeat and one that asks for attention; and the line whose edges feed an external watchdog.
#[derive(Debug)]
pub struct Panel<P, W> {
    heartbeat: Line<P>,
    attention: P,
    watchdog: Line<W>,
}

/// A pin that signals by an edge.
#[derive(Debug)]
struct Line<P> {
    pin: P,
    is_high: bool,
}

impl<P: OutputPin> Line<P> {
    fn toggle(&mut self) -> Result<(), P::Error> {
        self.is_high = !self.is_high;
        self.pin.set_state(self.is_high.into())
    }
}

impl<P: OutputPin, W: OutputPin> Panel<P, W> {
    /// Drive three pins, all low so far.
    pub fn new(heartbeat: P, attention: P, watchdog: W) -> Self {
        let heartbeat = Line { pin: heartbeat, is_high: false };
        Self { heartbeat, attention, watchdog: Line { pin: watchdog, is_high: false } }
    }

    /// Show an estimate: the heartbeat toggles, and attention lights while a person should have a look, see
    /// [`estimator::Core::needs_attention`].
    ///
    /// # Errors
    /// What the pins report.
    pub fn show(&mut self, needs_attention: bool) -> Result<(), P::Error> {
        self.heartbeat.toggle()?;
        self.attention.set_state(needs_attention.into())
    }

    /// Light attention until the next good estimate: a packet was refused.
    ///
    /// # Errors
    /// What the pin reports.
    pub fn alarm(&mut self) -> Result<(), P::Error> {
        self.attention.set_high()
    }

    /// Feed the watchdog.
    ///
    /// # Errors
    /// What the pin reports.
    pub fn feed(&mut self) -> Result<(), W::Error> {
        self.watchdog.toggle()
    }
}

#[cfg(test)]
mod tests {
    use embedded_hal_mock::eh1::digital::{Mock, State, Transaction};

    use super::*;

    fn pin(states: &[State]) -> Mock {
        Mock::new(&states.iter().map(|state| Transaction::set(*state)).collect::<std::vec::Vec<_>>())
    }

    #[test]
    fn pins_follow_the_loop() {
        use State::{High, Low};
        // given pins that expect a beat per estimate, attention from the fault on, and an edge per turn of the loop
        let mut pins = [pin(&[High, Low, High]), pin(&[Low, High, Low, High]), pin(&[High, Low])];
        let [heartbeat, attention, watchdog] = pins.clone();
        let mut panel = Panel::new(heartbeat, attention, watchdog);
        // when two turns show a good, a faulty and a good estimate, and an alarm
        panel.show(false).unwrap();
        panel.feed().unwrap();
        panel.show(true).unwrap();
        panel.feed().unwrap();
        panel.show(false).unwrap();
        panel.alarm().unwrap();
        // then nothing else was done to them
        pins.iter_mut().for_each(Mock::done);
    }
}
