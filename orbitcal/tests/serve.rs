//! `orbitcal serve` with a device at the other end of a socket: what it writes is what `orbitcal replay` writes.

use core::time::Duration;
use std::io::{Read as _, Write as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::thread::{self, JoinHandle};

use embedded_hal::digital::{ErrorType as PinErrorType, OutputPin};
use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
use estimator::Tables as _;
use estimator::Walk;
use estimator::booster::{Estimator, Green, LINE, PACKET, Request, Steer};
use estimator::wire::link::Vitals;
use firmware_sim::{Device, Event, Inbox, Panel};
use inference::{Recording, stream};
use shared_memory::Subscriber;
use training::rooms::largest;

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

impl ReadReady for Socket {
    /// All slices are done before the next frame: the same bits as in process.
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        Ok(false)
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

fn tables() -> Box<Green> {
    let mut green = Box::new(Green::BLANK);
    training::green::tables(&twin::Ring::booster()).unwrap().fill(&mut *green).unwrap();
    green
}

/// Something at the other end of a line, beside the test.
fn beside(path: &Path, run: impl FnOnce(UnixStream) + Send + 'static) -> JoinHandle<()> {
    let listener = UnixListener::bind(path).unwrap();
    thread::Builder::new()
        .stack_size(16 << 20) // the state of a device is built on it
        .spawn(move || run(listener.accept().unwrap().0))
        .unwrap()
}

/// A device that serves one host.
fn device(path: &Path, tables: Box<Green>) {
    beside(path, move |line| {
        let (mut core, mut steer) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK));
        let mut slot = Box::new(Green::BLANK);
        let mut device = Device::<_, _, LINE>::new(&mut *core, &mut *steer, &tables, &mut *slot);
        let (mut source, mut sink) = (Socket(line.try_clone().unwrap()), Socket(line));
        let mut panel = Panel::new(NoLamp, NoLamp, NoLamp);
        let run = firmware_sim::run::<_, _, _, _, LINE, PACKET>;
        let _ = run(&mut device, &mut source, &mut sink, &mut panel, Vitals::default);
    });
}

fn orbitcal(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).output().unwrap()
}

#[test]
fn a_device_is_published_as_the_core_in_process_is() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).display().to_string();
    device(&folder.path().join("uart"), tables());
    let service = format!("orbitcal/test/{}/serve", std::process::id());
    let source = format!("unix:{}", file("uart"));
    let feed = ["serve", "--source", &source, "--feed", RECORDING, "--load", "--service", &service];
    let served = orbitcal(&[&feed[..], &["--trace", &file("a.csv"), "--json", &file("a.json")]].concat());
    assert!(served.status.success(), "{}", String::from_utf8_lossy(&served.stderr));
    let replay = ["replay", RECORDING, "--follow", "--service", &service];
    let replayed = orbitcal(&[&replay[..], &["--trace", &file("b.csv"), "--json", &file("b.json")]].concat());
    assert!(replayed.status.success());
    assert!(std::fs::read(file("a.csv")).unwrap() == std::fs::read(file("b.csv")).unwrap(), "the traces differ");
    let result = |name: &str| {
        let mut result: serde_json::Value = serde_json::from_slice(&std::fs::read(file(name)).unwrap()).unwrap();
        result["timing"].take();
        result
    };
    assert!(result("a.json") == result("b.json"), "the results differ");
    let table = |output: &Output| {
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        text.lines().filter(|line| !line.contains(": median ")).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(table(&served), table(&replayed));
}

#[test]
fn tables_of_another_ring_are_not_answered_by() {
    let folder = tempfile::tempdir().unwrap();
    let mut other = tables();
    other.stated_error[0] *= 2.0;
    let message =
        format!("uses tables {:08x}, this model has {:08x}; --load", other.digest::<LINE>(), tables().digest::<LINE>());
    device(&folder.path().join("uart"), other);
    let source = format!("unix:{}", folder.path().join("uart").display());
    let service = format!("orbitcal/test/{}/other", std::process::id());
    let output = orbitcal(&["serve", "--source", &source, "--feed", RECORDING, "--service", &service]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains(&message), "{said}");
}

/// A line on which a front end and a host talk to one device.
struct Shared<'d> {
    device: Device<'d, Estimator, Steer, LINE>,
    host: UnixStream,
    inbox: Inbox<PACKET>,
    /// Replies until one that is spoiled on its way.
    spoiled: Option<u32>,
}

impl Shared<'_> {
    /// The front end sends a packet, after which the host asks for covariances this many times.
    fn send(&mut self, mut bytes: Vec<u8>, requests: u32) {
        let (host, spoiled) = (&mut self.host, &mut self.spoiled);
        self.device.hear(&mut bytes, Vitals::default, &mut |number, reply| {
            let mut bytes = [0; PACKET];
            let n = reply.encode(number, &mut bytes).unwrap();
            *spoiled = spoiled.and_then(|left| left.checked_sub(1).or_else(|| flip(&mut bytes[5])));
            host.write_all(&bytes[..n]).unwrap();
        });
        self.hear(requests);
    }

    fn hear(&mut self, requests: u32) {
        for _ in 0..requests {
            let mut source = Socket(self.host.try_clone().unwrap());
            let Event::Packet(bytes) = self.inbox.next(&mut source).unwrap() else { panic!("no request") };
            let request = Request::decode(&mut bytes.to_vec()).1.unwrap();
            assert_eq!(request, Request::Covariance);
            self.device.hear(bytes, Vitals::default, &mut |_, reply| panic!("{reply:?}"));
        }
    }
}

/// Change a byte; there is none to be changed after it.
fn flip(byte: &mut u8) -> Option<u32> {
    *byte ^= 0x10;
    None
}

/// The setup as a host sends it, in packets that are the same for a machine of any size.
fn restart(setup: &stream::Setup) -> Vec<u8> {
    let mut bytes = vec![0; largest::PACKET];
    let n = largest::Request::Restart(setup.on_wire()).encode(1, &mut bytes).unwrap();
    bytes.truncate(n);
    bytes
}

fn request(request: &Request) -> Vec<u8> {
    let mut bytes = vec![0; PACKET];
    let n = request.encode(2, &mut bytes).unwrap();
    bytes.truncate(n);
    bytes
}

/// Everything that may happen while somebody else feeds the device; then the line breaks.
fn a_day_of_a_front_end(line: UnixStream) {
    let recording = Recording::read(Path::new(RECORDING), &twin::Ring::booster()).unwrap();
    let ring = twin::Ring::booster();
    let setup = stream::setup(&recording.powered(&ring), &recording, Walk::NONE).unwrap();
    let restart = || restart(&setup);
    let frame = |at: usize| stream::wire(&recording, &recording.rows[at]).unwrap();
    let tables = tables();
    let (mut core, mut steer) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK));
    let mut slot = Box::new(Green::BLANK);
    let device = Device::new(&mut *core, &mut *steer, &tables, &mut *slot);
    let mut shared = Shared { device, host: line, inbox: Inbox::default(), spoiled: None };
    // the host begins to listen in the middle of a reply
    shared.host.write_all(&[9, 9, 9, 0]).unwrap();
    shared.hear(2);
    // answers to the front end, and frames, of which one is bad
    shared.send(restart(), 0);
    shared.send(frame(0), 1);
    shared.send(request(&Request::Status), 0);
    shared.send(frame(1), 1);
    shared.send(frame(1), 1);
    shared.send(frame(2), 1);
    // a piece of a covariance is spoiled: its estimate is heard with the next one
    shared.spoiled = Some(3);
    shared.send(frame(3), 1);
    // the device is reset, and knows no more what was asked of it
    let (mut core, mut steer) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK));
    let mut slot = Box::new(Green::BLANK);
    let Shared { host, inbox, .. } = shared;
    let mut shared =
        Shared { device: Device::new(&mut *core, &mut *steer, &tables, &mut *slot), host, inbox, spoiled: None };
    shared.send(restart(), 0);
    shared.send(frame(4), 1);
    shared.send(frame(5), 2);
    // a last estimate whose covariance does not come
    shared.spoiled = Some(1);
    shared.send(frame(6), 1);
}

#[test]
fn a_front_end_may_do_what_it_likes_and_nothing_is_lost() {
    let folder = tempfile::tempdir().unwrap();
    let (uart, trace) = (folder.path().join("uart"), folder.path().join("trace.csv"));
    let service = format!("orbitcal/test/{}/front-end", std::process::id());
    let mut subscriber = Subscriber::try_new(&service).unwrap();
    let front_end = beside(&uart, a_day_of_a_front_end);
    let source = format!("unix:{}", uart.display());
    let serve = ["serve", "--source", &source, "--service", &service, "--trace", &trace.display().to_string()];
    let mut serving = Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(serve).stderr(Stdio::piped()).spawn().unwrap();
    let mut heard = Vec::new();
    while serving.try_wait().unwrap().is_none() {
        heard.extend(subscriber.wait(Duration::from_millis(20)).unwrap());
    }
    heard.extend(subscriber.wait(Duration::ZERO).unwrap());
    let output = serving.wait_with_output().unwrap();
    front_end.join().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.ends_with("the device has closed its line\n"), "{said}");
    assert_eq!(said.lines().count(), 5, "two spoiled pieces, half a reply, a refused frame, the end: {said}");
    let heard: Vec<_> = heard.iter().map(|p| (p.record.sequence, p.record.covariance[0] > 0.0)).collect();
    let expected = [(0, true), (1, true), (2, true), (3, false), (4, false), (5, true), (6, false)];
    assert_eq!(heard, expected, "frames, and whether their covariance came");
    assert_eq!(std::fs::read_to_string(trace).unwrap().lines().count(), 1 + expected.len());
}

#[test]
fn a_silent_device_does_not_hold_up_a_signal() {
    let folder = tempfile::tempdir().unwrap();
    let (uart, trace) = (folder.path().join("uart"), folder.path().join("trace.csv"));
    let (heard, hears) = std::sync::mpsc::channel();
    beside(&uart, move |mut line| {
        assert!(line.read(&mut [0; 64]).unwrap() > 0); // the request for a covariance
        heard.send(()).unwrap();
        let _ = line.read(&mut [0]); // until it is closed
    });
    let service = format!("orbitcal/test/{}/silent", std::process::id());
    let source = format!("unix:{}", uart.display());
    let serve = ["serve", "--source", &source, "--service", &service, "--trace", &trace.display().to_string()];
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    let mut serving = command.args(serve).stderr(Stdio::null()).spawn().unwrap();
    hears.recv().unwrap();
    // the handler is installed after the request, with the first look for a signal
    while !catches_sigterm(serving.id()) {
        thread::sleep(Duration::from_millis(5));
    }
    assert!(Command::new("kill").arg(serving.id().to_string()).status().unwrap().success());
    assert_eq!(serving.wait().unwrap().code(), Some(0));
    assert_eq!(std::fs::read_to_string(trace).unwrap().lines().count(), 1, "the header");
}

/// Whether a process has a handler for signal 15.
fn catches_sigterm(process: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
    u64::from_str_radix(caught.trim(), 16).unwrap() & (1 << 14) != 0
}

#[test]
fn a_result_needs_a_recording() {
    let output = orbitcal(&["serve", "--source", "unix:/nowhere/uart", "--json", "-"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).starts_with("orbitcal: --json needs --feed: "));
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
