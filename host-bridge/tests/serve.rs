//! `orbitcal serve` with a device at the other end of a socket: what it writes is what `orbitcal replay` writes.

use std::io::{Read as _, Write as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::process::{Command, Output};
use std::thread;

use embedded_hal::digital::{ErrorType as PinErrorType, OutputPin};
use embedded_io::{ErrorKind, ErrorType, Read, Write};
use estimator::booster::{Estimator, Green};
use firmware_sim::link::Vitals;
use firmware_sim::{Device, Panel};

const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");

/// One direction of a socket.
struct Socket(UnixStream);

impl ErrorType for Socket {
    type Error = ErrorKind;
}

impl Read for Socket {
    fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
        self.0.read(to).map_err(|e| e.kind().into())
    }
}

impl Write for Socket {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        self.0.write(bytes).map_err(|e| e.kind().into())
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        Ok(())
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

/// A device that serves one host, beside the test.
fn device(path: &Path) {
    let listener = UnixListener::bind(path).unwrap();
    thread::Builder::new()
        .stack_size(16 << 20) // the state is built on it
        .spawn(move || {
            let (line, _) = listener.accept().unwrap();
            let tables = training::green::tables(&twin::Ring::booster()).unwrap();
            let (mut core, mut slot) = (Box::new(Estimator::BLANK), Box::new(Green::BLANK));
            let mut device = Device::new(&mut core, &tables, &mut slot);
            let (mut source, mut sink) = (Socket(line.try_clone().unwrap()), Socket(line));
            let mut panel = Panel::new(NoLamp, NoLamp, NoLamp);
            let _ = firmware_sim::run(&mut device, &mut source, &mut sink, &mut panel, Vitals::default);
        })
        .unwrap();
}

fn orbitcal(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).output().unwrap()
}

#[test]
fn a_device_is_published_as_the_core_in_process_is() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).display().to_string();
    device(&folder.path().join("uart"));
    let service = format!("orbitcal/test/{}/serve", std::process::id());
    let source = format!("unix:{}", file("uart"));
    let feed = ["serve", "--source", &source, "--feed", RECORDING, "--load", "--service", &service];
    let served = orbitcal(&[&feed[..], &["--trace", &file("a.csv"), "--json", &file("a.json")]].concat());
    assert!(served.status.success(), "{}", String::from_utf8_lossy(&served.stderr));
    let replayed =
        orbitcal(&["replay", RECORDING, "--service", &service, "--trace", &file("b.csv"), "--json", &file("b.json")]);
    assert!(replayed.status.success());
    assert!(std::fs::read(file("a.csv")).unwrap() == std::fs::read(file("b.csv")).unwrap(), "the traces differ");
    let answer = |name: &str| {
        let mut answer: serde_json::Value = serde_json::from_slice(&std::fs::read(file(name)).unwrap()).unwrap();
        answer["timing"].take();
        answer
    };
    assert!(answer("a.json") == answer("b.json"), "the answers differ");
    let table = |output: &Output| {
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        text.lines().filter(|line| !line.starts_with("frame to estimate")).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(table(&served), table(&replayed));
}

#[test]
fn nobody_there_is_said_in_one_line() {
    let output = orbitcal(&["serve", "--source", "unix:/nowhere/uart"]);
    assert_eq!(output.status.code(), Some(1));
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.starts_with("orbitcal: unix:/nowhere/uart: ") && message.lines().count() == 1, "{message}");
    let output = orbitcal(&["serve", "--source", "usb:3"]);
    assert_eq!(output.status.code(), Some(2));
}
