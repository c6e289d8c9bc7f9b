//! Watchdogs, fed by the same edge.

use embedded_hal::digital::{ErrorType, OutputPin};

/// A pin to an external watchdog, each edge of which feeds the part's own as well.
#[derive(Debug)]
pub struct Supervisor<P, F> {
    pin: P,
    feed: F,
}

impl<P: OutputPin, F: FnMut()> Supervisor<P, F> {
    /// `feed` restarts the count of the part's own.
    pub fn new(pin: P, feed: F) -> Self {
        Self { pin, feed }
    }
}

impl<P: OutputPin, F: FnMut()> ErrorType for Supervisor<P, F> {
    type Error = P::Error;
}

impl<P: OutputPin, F: FnMut()> OutputPin for Supervisor<P, F> {
    fn set_low(&mut self) -> Result<(), P::Error> {
        (self.feed)();
        self.pin.set_low()
    }

    fn set_high(&mut self) -> Result<(), P::Error> {
        (self.feed)();
        self.pin.set_high()
    }
}

#[cfg(test)]
mod tests {
    use embedded_hal_mock::eh1::MockError;
    use embedded_hal_mock::eh1::digital::{Mock, State, Transaction};

    use super::*;

    #[test]
    fn each_edge_feeds_once_whether_or_not_the_pin_works() {
        let broken = Transaction::set(State::High).with_error(MockError::Io(std::io::ErrorKind::NotConnected));
        let (mut pin, mut fed) = (Mock::new(&[Transaction::set(State::High), Transaction::set(State::Low), broken]), 0);
        let mut supervisor = Supervisor::new(pin.clone(), || fed += 1);
        supervisor.set_high().unwrap();
        supervisor.set_low().unwrap();
        assert!(supervisor.set_high().is_err());
        assert_eq!(fed, 3);
        pin.done();
    }
}
