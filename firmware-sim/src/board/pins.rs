//! Output pins: two LEDs for the operator, and a line to an external watchdog supervisor.

use core::convert::Infallible;

use cortex_m::interrupt;
use embedded_hal::digital::{ErrorType, OutputPin, StatefulOutputPin};

use super::registers::{FPGAIO_LED, GPIO0_DATAOUT, GPIO0_OUTENSET, Register};

/// One bit of an output register.
///
/// The level is remembered here: a register that cannot be read back still toggles.
pub struct Pin {
    output: Register,
    mask: u32,
    high: bool,
}

/// The pins of the board, all low.
pub struct Pins {
    /// User LED 0.
    pub heartbeat: Pin,
    /// User LED 1.
    pub attention: Pin,
    /// GPIO 0 pin 0, an edge of which feeds an external supervisor. QEMU has no GPIO: writes there vanish.
    pub supervisor: Pin,
}

impl Pins {
    /// Take the pins and drive them low.
    pub fn start() -> Self {
        GPIO0_OUTENSET.write(1 << 0);
        Self {
            heartbeat: Pin::low(FPGAIO_LED, 0),
            attention: Pin::low(FPGAIO_LED, 1),
            supervisor: Pin::low(GPIO0_DATAOUT, 0),
        }
    }
}

impl Pin {
    fn low(output: Register, bit: u32) -> Self {
        let mut pin = Self { output, mask: 1 << bit, high: false };
        pin.drive(false);
        pin
    }

    /// Pins share the register: nobody may write it between this look and this write.
    fn drive(&mut self, high: bool) {
        self.high = high;
        interrupt::free(|_| {
            let others = self.output.read() & !self.mask;
            self.output.write(others | if high { self.mask } else { 0 });
        });
    }
}

impl ErrorType for Pin {
    type Error = Infallible;
}

impl OutputPin for Pin {
    fn set_low(&mut self) -> Result<(), Infallible> {
        self.drive(false);
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        self.drive(true);
        Ok(())
    }
}

impl StatefulOutputPin for Pin {
    fn is_set_high(&mut self) -> Result<bool, Infallible> {
        Ok(self.high)
    }

    fn is_set_low(&mut self) -> Result<bool, Infallible> {
        Ok(!self.high)
    }
}
