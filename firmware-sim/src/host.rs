//! Software in the loop: a device between standard input and output, for tests of feedback without any hardware.

use std::io::{self, Read as _, Write as _};

use embedded_hal::digital::{ErrorType as PinErrorType, OutputPin};
use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
use estimator::wire::link::Vitals;
use firmware_sim::machine::{BUILT_IN, Estimator, LINE, PACKET, Steer, Tables};
use firmware_sim::{Device, Panel};

/// Run until standard input ends.
pub fn run() -> io::Result<()> {
    let (mut core, mut steer) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK));
    let mut slot = Box::new(Tables::BLANK);
    let mut device = Device::<_, _, LINE>::new(&mut *core, &mut *steer, &BUILT_IN, &mut *slot);
    let (mut source, mut sink) = (Stdin(io::stdin()), Stdout(io::stdout()));
    let mut panel = Panel::new(NoLamp, NoLamp, NoLamp);
    let run = firmware_sim::run::<_, _, _, _, LINE, PACKET>;
    let ended = run(&mut device, &mut source, &mut sink, &mut panel, Vitals::default);
    ended.map_err(|kind| io::Error::other(format!("{kind:?}")))
}

struct Stdin(io::Stdin);
struct Stdout(io::Stdout);

impl ErrorType for Stdin {
    type Error = ErrorKind;
}

impl ErrorType for Stdout {
    type Error = ErrorKind;
}

impl Read for Stdin {
    fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
        self.0.read(to).map_err(|e| e.kind().into())
    }
}

/// All slices are done before the next packet is read: standard input cannot say whether one waits.
impl ReadReady for Stdin {
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        Ok(false)
    }
}

impl Write for Stdout {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        self.0.write(bytes).and_then(|n| self.0.flush().map(|()| n)).map_err(|e| e.kind().into())
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        self.0.flush().map_err(|e| e.kind().into())
    }
}

/// A pin with nothing on it.
struct NoLamp;

impl PinErrorType for NoLamp {
    type Error = core::convert::Infallible;
}

impl OutputPin for NoLamp {
    fn set_low(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }
}
