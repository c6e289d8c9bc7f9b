//! The image on the emulated chip beside the core in process: the same bits, within its memory and its instructions, and
//! alive whatever comes over the wire.

use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::io::Write;
use std::process::Command;
use std::sync::{Arc, LazyLock};

use estimator::Walk;
use estimator::booster::Frame;
use estimator::wire::link::{Refusal, Status};
use estimator::{Hold, Tables as _};
use host_bridge::source::link::Link;
use inference::Recording;
use inference::stream::{self, Core, Estimate};
use system_tests::endurance::endure;
use system_tests::feedback::{Chip, Control, Known, Loop, REGIONS, Scenario, recommended};
use system_tests::machine::LAYOUT;
use system_tests::qemu::{Emulator, Image, Options};
use system_tests::sil::{bits, compare, largest};
use system_tests::{recording, repository};
use training::LINE;
use training::rooms::largest::{PACKET, Reply, Request};
use twin::{Effect, Ring};

/// Built once for all tests.
static IMAGE: LazyLock<Image> = LazyLock::new(|| Image::build().unwrap_or_else(|error| panic!("{error}")));

fn wires(recording: &Recording) -> Vec<Vec<u8>> {
    recording.rows.iter().map(|row| stream::wire(recording, row).unwrap()).collect()
}

/// Number of a frame.
fn sequence(wire: &[u8]) -> u32 {
    Frame::decode(&LAYOUT, &mut wire.to_vec()).unwrap().sequence
}

fn start() -> Emulator {
    Emulator::start(&IMAGE, &Options::default()).unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn the_image_fits_its_memory() {
    let sizes = IMAGE.sizes().unwrap();
    // a network of 760 kB has room in what is left of 1 MB
    assert!(sizes.flash <= 256 * 1024, "{} bytes of flash", sizes.flash);
    assert!(sizes.ram <= 238 * 1024, "{} bytes of RAM", sizes.ram);
}

/// The linker grants 18 kB and starts the stack there, so that a count ends at 18: one that is full has to be told by less.
fn check_stack(status: &Status) {
    assert!(status.vitals.stack_bytes <= 17 * 1024 + 512, "{} bytes of stack", status.vitals.stack_bytes);
}

/// Most instructions of each step, beside those that were committed; `BLESS=1` rewrites them.
///
/// The counts repeat exactly with one compiler; 2 % leaves room for another one's patch release.
fn check_instructions(counts: &[(&'static str, u64)]) {
    let path = repository("tests/golden/instructions.csv");
    let table: String = counts.iter().map(|(step, most)| format!("{step},{most}\n")).collect();
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, format!("step,most\n{table}")).unwrap();
    }
    let golden = std::fs::read_to_string(&path).unwrap_or_default();
    let mut golden = golden.lines().skip(1).filter_map(|line| line.split_once(','));
    for (step, most) in counts {
        let (name, expected) = golden.next().unwrap_or_else(|| panic!("{}: no row for {step}", path.display()));
        let expected: f64 = expected.parse().unwrap();
        assert_eq!(name, *step, "{}", path.display());
        let ratio = *most as f64 / expected;
        assert!((ratio - 1.0).abs() < 0.02, "{step}: {most} instructions, {expected} committed; BLESS=1 rewrites");
    }
}

#[test]
fn the_chip_answers_a_campaign_as_the_host_does() {
    let (ring, recording) = recording("paper-vars");
    let run = compare(&IMAGE, (&ring, &recording), Walk::NONE, true, |_| Ok(())).unwrap();
    assert_eq!((run.frames, run.different.as_slice()), (346, [].as_slice()));
    assert!(run.interrupting > 0, "no frame came between two slices");
    assert_eq!((run.status.refused, run.status.vitals.lost_bytes), (0, 0));
    check_stack(&run.status);
    let counts = largest(&run.counts);
    let of = |step: &str| counts.iter().find(|(name, _)| *name == step).unwrap().1;
    assert!(of("ingest") + of("encode") <= 1_000_000, "{} + {}", of("ingest"), of("encode"));
    // frames of no setting, here those before it is known where the correctors stand, count in two sums, and their MAP may be at bounds
    let most = run.counts["Estimator::ingest"].iter().max().unwrap();
    assert!(*most <= 2_000_000, "{most}");
    assert!(of("slice") <= 1_500_000, "{}", of("slice"));
    check_instructions(&counts);
}

#[test]
fn the_chip_answers_as_the_host_does_while_params_walk_and_monitors_drop_out() {
    let (ring, mut recording) = recording("random-vars");
    for row in &mut recording.rows[100..200] {
        (row.reading[3], row.reading[20]) = (None, None);
    }
    let walk = stream::walk_per_cycle(&recording, 2e-4, 0.0);
    let run = compare(&IMAGE, (&ring, &recording), walk, false, |_| Ok(())).unwrap();
    assert_eq!((run.frames, run.different.as_slice()), (346, [].as_slice()));
    assert_eq!(run.status.vitals.lost_bytes, 0);
}

/// A device on the emulated chip, and the core in process that hears the same good frames.
struct Pair<'e> {
    link: Link<&'e std::os::unix::net::UnixStream>,
    core: Core,
}

impl<'e> Pair<'e> {
    fn start(emulator: &'e Emulator, ring: &Ring, recording: &Recording) -> Self {
        let core = stream::estimator(ring, recording, Walk::NONE).unwrap();
        let mut link = Link::new(emulator.uart());
        link.restart(&core.setup).unwrap();
        Self { link, core }
    }

    /// A good frame, answered alike; the device may count refusals that the core has not seen.
    fn agree(&mut self, wire: &[u8]) {
        let heard = self.link.ingest(sequence(wire), wire).unwrap();
        self.expect(wire, heard.estimate);
    }

    fn expect(&mut self, wire: &[u8], mut answer: Estimate) {
        for _ in 0..answer.remarks.slices {
            let _ = self.core.slice();
        }
        let expected = self.core.ingest(&mut wire.to_vec()).unwrap();
        answer.rejected_frames = expected.rejected_frames;
        assert!(bits(&answer) == bits(&expected), "frame {}", expected.sequence);
    }

    fn refused(&mut self) -> Refusal {
        match self.link.next().unwrap().1 {
            Reply::Refused { why, .. } => why,
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn faults_on_the_wire_are_counted_and_change_nothing() {
    let (ring, recording) = recording("paper-vars");
    let good = wires(&recording);
    let emulator = start();
    let mut pair = Pair::start(&emulator, &ring, &recording);
    let before = pair.link.status().unwrap().vitals;
    for (at, wire) in good.iter().take(60).enumerate() {
        pair.agree(wire);
        let next = &good[at + 1];
        let (bytes, expected): (Vec<u8>, &[Refusal]) = match at % 8 {
            0 => (wire.clone(), &[Refusal::Repeated]),
            1 if at > 8 => (good[at - 5].clone(), &[Refusal::OutOfOrder]),
            // a byte dropped, a byte repeated, two exchanged, one changed
            2 => ([&next[..90], &next[91..]].concat(), &[Refusal::Framing, Refusal::Truncated, Refusal::Corrupted]),
            3 => ([&next[..90], &next[89..]].concat(), &[Refusal::Framing, Refusal::Oversized, Refusal::Corrupted]),
            4 => {
                let mut bytes = next.clone();
                bytes.swap(100, 103);
                (bytes, &[Refusal::Framing, Refusal::Corrupted])
            }
            5 => {
                let mut bytes = next.clone();
                bytes[120] ^= 0x10;
                (bytes, &[Refusal::Framing, Refusal::Corrupted, Refusal::Truncated])
            }
            // reset in mid-frame: the front end begins with a zero
            6 => {
                ([&next[..next.len() / 2], &[0]].concat(), &[Refusal::Framing, Refusal::Truncated, Refusal::Corrupted])
            }
            // no packet at all
            _ => ([vec![0x55; 5000], vec![0]].concat(), &[Refusal::Oversized]),
        };
        pair.link.write(&bytes).unwrap();
        let why = pair.refused();
        assert!(expected.contains(&why), "after frame {at}: {why:?}, expected {expected:?}");
    }
    let after = pair.link.status().unwrap().vitals;
    let [cycles, silent] = [after.cycles - before.cycles, after.silent_cycles - before.silent_cycles];
    assert!(silent <= cycles / 4, "{silent} of {cycles} cycles with frames in them were silent");
    // a sender that stalls in mid-frame: after two cycles the rest is not waited for
    pair.link.write(&good[60][..100]).unwrap();
    assert_eq!(pair.refused(), Refusal::Stalled);
    pair.agree(&good[60]);
    let status = pair.link.status().unwrap();
    assert_eq!((status.frames, status.refused, status.vitals.lost_bytes), (61, 61, 0));
    assert!(status.vitals.silent_cycles > after.silent_cycles);
}

/// Longer than the watchdog of a board waits: the emulator stands still, its timers do not.
#[test]
fn a_host_that_stands_still_changes_nothing() {
    let (ring, recording) = recording("paper-vars");
    let good = wires(&recording);
    let emulator = start();
    let mut pair = Pair::start(&emulator, &ring, &recording);
    for wires in good[..40].chunks(20) {
        wires.iter().for_each(|wire| pair.agree(wire));
        emulator.freeze(Duration::from_secs(7)).unwrap();
    }
    good[40..60].iter().for_each(|wire| pair.agree(wire));
    assert_eq!(pair.link.status().unwrap().frames, 60);
}

/// `make endure` sends twenty times as many.
#[test]
fn a_long_feedback_on_a_bad_line_is_the_same_on_the_chip() {
    let endured = endure(&IMAGE, 1000, || ()).unwrap();
    assert!(endured.different.is_empty(), "{:?}", endured.different);
    let status = &endured.status;
    assert_eq!((status.frames, status.refused, status.vitals.lost_bytes), (1000, endured.refused, 0));
    assert!(endured.refused > 300, "a fault in three frames: {} refused", endured.refused);
    check_stack(status);
}

/// The chip closes the loop: its setpoints are the host's, bit for bit, through a lost beam and a corrector that sticks. `make loop`
/// shows what becomes of the orbit.
#[test]
fn the_chip_steers_as_the_host_does() {
    let known = Known::read().unwrap();
    let scenario = Scenario::of_faults(5);
    let regions = REGIONS.iter().map(|(_, name)| IMAGE.function(name).unwrap()).collect();
    let emulator = Emulator::start(&IMAGE, &Options { regions, ..Options::default() }).unwrap();
    let mut closed = Loop::new(&known, recommended(), Control::Estimated, scenario).unwrap();
    closed.chip = Some(Chip::start(&emulator).unwrap());
    let samples = closed.run().unwrap();
    let mut chip = closed.chip.take().unwrap();
    let status = chip.status().unwrap();
    assert_eq!((chip.frames, chip.different, status.frames, status.refused), (130, 0, 130, 0));
    check_stack(&status);
    let steered: Vec<_> = samples.iter().filter_map(|sample| sample.steered).collect();
    let held = |why| steered.iter().filter(|steered| steered.hold == Some(why)).count();
    assert!(held(Hold::PutAside) >= 6 && held(Hold::Stale) == 1, "{steered:?}");
    assert!(steered.iter().any(|steered| steered.left_out == 1), "the corrector that sticks");
    drop(closed);
    let counts = emulator.stop().unwrap().counts;
    let most = |name: &str| counts[name].iter().copied().max().unwrap();
    assert!(most("Steer::prepare") <= 1_500_000, "{}", most("Steer::prepare"));
    assert!(most("Steer::steer") <= 300_000, "{}", most("Steer::steer"));
}

/// 13 frames of 260 bytes come in 37 ms at 921,600 baud, longer than all slices together take, and far more than a front end
/// sends in a cycle. The emulated UART has no rate: they are sent at once, just as the chip begins to linearise.
#[test]
fn frames_that_come_during_an_update_are_not_lost() {
    let (ring, recording) = recording("paper-vars");
    let good = wires(&recording);
    let emulator = start();
    let mut pair = Pair::start(&emulator, &ring, &recording);
    let (mut bursts, mut at) = (0, 0);
    while at + 14 <= good.len() && bursts < 5 {
        pair.agree(&good[at]);
        at += 1;
        // does the chip linearise after this frame?
        if !pair.core.clone().prepare() {
            continue;
        }
        let burst = good[at..at + 13].concat();
        pair.link.write(&burst).unwrap();
        for wire in &good[at..at + 13] {
            let (_, Reply::Estimate(answer)) = pair.link.next().unwrap() else { panic!("a burst frame was refused") };
            pair.expect(wire, Estimate::of_answer(&answer).unwrap());
        }
        at += 13;
        bursts += 1;
    }
    assert_eq!(bursts, 5);
    assert_eq!(pair.link.status().unwrap().vitals.lost_bytes, 0);
}

/// More than any device can take: what was answered is right, what was not is counted, and the device lives.
#[test]
fn a_storm_of_frames_is_survived() {
    let (ring, recording) = recording("paper-vars");
    let good = wires(&recording);
    let emulator = start();
    let mut pair = Pair::start(&emulator, &ring, &recording);
    // covariances with every frame keep the chip busy sending; meanwhile its queue fills
    let mut request = vec![0; PACKET];
    let n = Request::Covariance.encode(1, &mut request).unwrap();
    let storm: Vec<u8> = good[..200].iter().flat_map(|wire| [&request[..n], wire].concat()).collect();
    let status = {
        let n = Request::Status.encode(2, &mut request).unwrap();
        [&[0], &request[..n]].concat()
    };
    let mut uart = emulator.uart().try_clone().unwrap();
    let heard = Arc::new(AtomicBool::new(false));
    let is_heard = heard.clone();
    let sender = std::thread::spawn(move || -> std::io::Result<()> {
        uart.write_all(&storm)?;
        // a request may be lost, too, until the queue has emptied
        while !is_heard.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_secs(2));
            uart.write_all(&status)?;
        }
        Ok(())
    });
    let (mut answered, mut refused) = (0, 0);
    let status = loop {
        match pair.link.next().unwrap().1 {
            Reply::Estimate(answer) => {
                let answer = Estimate::of_answer(&answer).unwrap();
                pair.expect(&good[answer.sequence as usize], answer);
                answered += 1;
            }
            Reply::Refused { count, .. } => refused = count,
            Reply::Covariance { .. } => {}
            Reply::Status(status) => break status,
            other => panic!("{other:?}"),
        }
    };
    heard.store(true, Ordering::Relaxed);
    sender.join().unwrap().unwrap();
    assert_eq!((status.frames, status.refused), (answered, refused));
    // how many depends on how fast the emulator runs beside the host
    assert!(answered > 0, "{answered} of 200 frames answered, {refused} packets refused");
    assert!(answered == 200 || status.vitals.lost_bytes > 0, "what is lost is counted: {status:?}");
    // the device is as it was
    pair.link.write(&good[200]).unwrap();
    loop {
        match pair.link.next().unwrap().1 {
            Reply::Estimate(answer) => break pair.expect(&good[200], Estimate::of_answer(&answer).unwrap()),
            // asked for during the storm, or cut by it
            Reply::Status(_) | Reply::Covariance { .. } | Reply::Refused { .. } => {}
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn new_tables_reach_the_chip() {
    let (ring, recording) = recording("paper-vars");
    let good = wires(&recording);
    let emulator = start();
    let mut pair = Pair::start(&emulator, &ring, &recording);
    good[..30].iter().for_each(|wire| pair.agree(wire));
    let mut vars = vec![1.0; 48];
    vars[0] = 1.01;
    let rolled = [Effect::parse("quad_roll@F2=0.01", &ring).unwrap()];
    let other = training::extended::tables(&ring.with_vars(&vars), &rolled, &[1.0; 48]).unwrap().tables;
    assert!(other.terms() > 0);
    pair.link.load(&other, || ()).unwrap();
    // the host goes over to them after the same frame
    pair.core.prepare();
    pair.core.adopt(other.clone()).unwrap();
    good[30..60].iter().for_each(|wire| pair.agree(wire));
    let status = pair.link.status().unwrap();
    assert_eq!((status.loaded, status.tables), (true, other.digest::<LINE>()));
    check_stack(&status); // a parcel lies on it while the tables are linearised
}

#[test]
fn the_log_is_decoded_and_a_fault_reported() {
    // the first instruction of a step replaced by an undefined one, `udf #0`
    let step = IMAGE.function("Device::ingest").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let image = IMAGE.patched(&step, &[0x00, 0xde], &folder.path().join("firmware")).unwrap();
    let emulator = Emulator::start(&image, &Options::default()).unwrap();
    let (_, recording) = recording("paper-vars");
    Link::new(emulator.uart()).write(&wires(&recording)[0]).unwrap();
    let run = emulator.wait(Duration::from_secs(120)).unwrap();
    let log = IMAGE.log(&run.stdout).unwrap();
    let messages: Vec<&str> = log.iter().map(|line| line.message.as_str()).collect();
    let pc = format!("pc {:#x}", step.address & !1);
    assert!(messages[0].starts_with("orbitcal device, tables "), "{messages:?}");
    assert!(messages[1].starts_with("hard fault: ") && messages[1].contains(&pc), "{messages:?}, {pc}");
    assert_eq!(run.status, Some(1));
}

/// A panic handler that calls a function that exists nowhere: a path to a panic, from the bytes that come in to those that go
/// out, would not link.
#[test]
fn no_path_leads_from_bytes_to_a_panic() {
    let link = |example: &str| {
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let build = ["build", "--locked", "--profile", "firmware", "-p", "firmware-sim", "--example", example];
        let mut command = Command::new(cargo);
        command.args(build).args(["--target", "thumbv7em-none-eabihf"]).current_dir(repository("."));
        let output = command.output().unwrap();
        (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (linked, message) = link("never_panics");
    assert!(linked, "{message}");
    let (linked, message) = link("can_panic");
    assert!(!linked && message.contains("undefined symbol: the_loop_can_panic"), "{message}");
}
