//! A device on the host: the loop that a chip runs, fed with recorded frames, bad bytes and new tables, beside the core in
//! process.

use core::hash::{Hash as _, Hasher as _};
use std::collections::{BTreeMap, VecDeque};
use std::hash::DefaultHasher;

use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
use estimator::booster::{
    Answer, Estimator, Feedback, Frame, Green, LINE, PACKET, Parcel, Reply, Request, SIZES, Setup, Steer, TRIANGLE,
};
use estimator::surrogate::Table;
use estimator::wire::link::{self, Correction, Form, REPLY, REQUEST, Refusal, Status, Taken, UNASKED, Vitals};
use estimator::{Gate, Hold, Parcel as AnyParcel, ParcelError, Sizes, Tables as _, Walk};
use firmware_sim::{Device, Panel};
use inference::Recording;
use inference::stream::{self, Core, Estimate};
use system_tests::faults::{Body, FAULTS, faulty, sealed};
use system_tests::feedback::{Control, Known, Loop, Scenario, recommended};
use system_tests::machine::{LAYOUT, Machine, Random, wire_of};
use system_tests::repository;
use training::{Tables, rooms};
use twin::Ring;

/// Bytes from memory, a cycle of silence where there is none.
struct Source(Vec<Option<u8>>);

/// Bytes to memory.
struct Sink(Vec<u8>);

impl ErrorType for Source {
    type Error = ErrorKind;
}

impl ErrorType for Sink {
    type Error = ErrorKind;
}

impl Read for Source {
    fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
        let Some(next) = self.0.pop() else { return Ok(0) };
        to[0] = next.ok_or(ErrorKind::TimedOut)?;
        Ok(1)
    }
}

/// No packet waits until all slices are done.
impl ReadReady for Source {
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        Ok(false)
    }
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        self.0.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        Ok(())
    }
}

/// A pin of no lamp.
struct Dark;

impl embedded_hal::digital::ErrorType for Dark {
    type Error = core::convert::Infallible;
}

impl embedded_hal::digital::OutputPin for Dark {
    fn set_low(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }
}

/// Run a device with these tables in flash until its source ends.
fn run<R: Read<Error = ErrorKind> + ReadReady, W: Write<Error = ErrorKind>>(
    built_in: &Green,
    source: &mut R,
    sink: &mut W,
) {
    let (mut core, mut steer, mut slot) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK), Box::new(Green::BLANK));
    let mut device = Device::<_, _, LINE>::new(&mut *core, &mut *steer, built_in, &mut *slot);
    let mut panel = Panel::new(Dark, Dark, Dark);
    let run = firmware_sim::run::<_, _, _, _, LINE, PACKET>;
    run(&mut device, source, sink, &mut panel, Vitals::default).unwrap();
}

/// Replies of a device with these tables in flash to these bytes, each with the number of its request.
fn numbered(built_in: &Green, bytes: &[Option<u8>]) -> Vec<(u32, Reply)> {
    let (mut source, mut sink) = (Source(bytes.iter().rev().copied().collect()), Sink(Vec::new()));
    run(built_in, &mut source, &mut sink);
    let packets = sink.0.split_inclusive_mut(|byte| *byte == 0).map(Reply::decode);
    packets.map(|(number, reply)| (number, reply.unwrap())).collect()
}

fn replies(built_in: &Green, bytes: &[Option<u8>]) -> Vec<Reply> {
    numbered(built_in, bytes).into_iter().map(|(_, reply)| reply).collect()
}

fn request(request: &Request) -> Vec<Option<u8>> {
    heard(&packet(7, request))
}

fn packet(number: u32, request: &Request) -> Vec<u8> {
    let mut bytes = vec![0; PACKET];
    let n = request.encode(number, &mut bytes).unwrap();
    bytes.truncate(n);
    bytes
}

fn heard(bytes: &[u8]) -> Vec<Option<u8>> {
    bytes.iter().copied().map(Some).collect()
}

fn paper_vars() -> (Ring, Recording) {
    let ring = Ring::paper_booster();
    let recording = Recording::read(&repository("recordings/former/paper-vars"), &ring).unwrap();
    (ring, recording)
}

fn wires(recording: &Recording) -> Vec<Vec<u8>> {
    recording.rows.iter().map(|row| stream::wire(recording, row).unwrap()).collect()
}

fn start(core: &Core) -> Vec<Option<u8>> {
    restart(&core.setup)
}

/// As a host that talks to devices of any size.
fn restart(setup: &stream::Setup) -> Vec<Option<u8>> {
    let mut bytes = vec![0; rooms::largest::PACKET];
    let n = rooms::largest::Request::Restart(setup.on_wire()).encode(1, &mut bytes).unwrap();
    heard(&bytes[..n])
}

/// Tables as a device of this machine has them in flash.
fn in_flash(tables: &Tables) -> Box<Green> {
    let mut green = Box::new(Green::BLANK);
    tables.fill(&mut *green).unwrap();
    green
}

/// A reply as read by a host that serves devices of any size.
fn estimate_of(sent: &Answer) -> Estimate {
    let mut bytes = vec![0; PACKET];
    let n = Reply::Estimate(sent.clone()).encode(UNASKED, &mut bytes).unwrap();
    let (UNASKED, Ok(rooms::largest::Reply::Estimate(sent))) = rooms::largest::Reply::decode(&mut bytes[..n]) else {
        panic!("another reply")
    };
    Estimate::of_answer(&sent).unwrap()
}

fn estimates(replies: &[Reply]) -> Vec<Estimate> {
    let sent = |reply: &Reply| match reply {
        Reply::Estimate(sent) => Some(estimate_of(sent)),
        _ => None,
    };
    replies.iter().filter_map(sent).collect()
}

#[test]
fn the_loop_replies_as_the_core_in_process() {
    let (ring, recording) = paper_vars();
    let mut core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let mut bytes = start(&core);
    for (at, wire) in wires(&recording).iter().enumerate() {
        if at % 100 == 0 {
            bytes.extend(request(&Request::Covariance));
        }
        bytes.extend(heard(wire));
    }
    bytes.extend(request(&Request::Status));
    let replies = replies(&in_flash(&core.tables), &bytes);
    let mut replies = replies.iter();
    assert_eq!(replies.next(), Some(&Reply::Restarted));
    for (at, wire) in wires(&recording).iter_mut().enumerate() {
        core.prepare();
        let estimate = core.ingest(wire).unwrap();
        let Some(Reply::Estimate(sent)) = replies.next() else { panic!("no estimate") };
        assert!(estimate_of(sent) == estimate, "frame {at}");
        let mut places = (0..48).flat_map(|i| (0..=i).map(move |j| (i, j)));
        for _ in (0..if at % 100 == 0 { TRIANGLE } else { 0 }).step_by(56) {
            let Some(Reply::Covariance { sequence, entries, .. }) = replies.next() else { panic!("no covariance") };
            assert_eq!(*sequence, estimate.sequence);
            assert!(entries.iter().zip(&mut places).all(|(entry, (i, j))| *entry == core.covariance(i, j)));
        }
    }
    core.prepare();
    let quality = core.fit_quality();
    let Some(Reply::Status(status)) = replies.next() else { panic!("no status") };
    assert_eq!((status.frames, status.refused, status.loaded), (346, 0, false));
    assert_eq!((status.chi_square, status.degrees_of_freedom), (quality.chi_square, quality.degrees_of_freedom));
    assert_eq!(replies.next(), None);
}

#[test]
fn bad_bytes_are_counted_and_change_no_estimate() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let good = wires(&recording);
    let (mut clean, mut faulty) = (start(&core), start(&core));
    let mut faults = Vec::new();
    for (at, wire) in good.iter().take(120).enumerate() {
        clean.extend(heard(wire));
        faulty.extend(heard(wire));
        let next = &good[at + 1];
        match at % 6 {
            0 => {
                faulty.extend(heard(wire));
                faults.push(Refusal::Repeated);
            }
            1 => {
                faulty.extend(heard(&good[0]));
                faults.push(Refusal::OutOfOrder);
            }
            2 => {
                // reset in mid-frame: half of the next one, and then it restarts
                faulty.extend(heard(&next[..next.len() / 2]));
                faulty.push(Some(0));
                faults.push(Refusal::Framing);
            }
            3 => {
                // stalled in mid-frame
                faulty.extend(heard(&next[..next.len() / 3]));
                faulty.extend([None, None]);
                faults.push(Refusal::Stalled);
            }
            4 => {
                faulty.extend([Some(1); 4000]);
                faulty.push(Some(0));
                faults.push(Refusal::Oversized);
            }
            _ => {
                let mut changed = next.clone();
                changed[100] ^= 0x10;
                faulty.extend(heard(&changed));
            }
        }
    }
    let (clean, faulty) = (replies(&in_flash(&core.tables), &clean), replies(&in_flash(&core.tables), &faulty));
    let rejected_frames = |mut estimate: Estimate| {
        estimate.rejected_frames = 0;
        estimate
    };
    let posteriors = |replies: &[Reply]| estimates(replies).into_iter().map(rejected_frames).collect::<Vec<_>>();
    assert!(posteriors(&clean) == posteriors(&faulty), "another posterior");
    let refused: Vec<(Refusal, u32)> = faulty
        .iter()
        .filter_map(|reply| match reply {
            Reply::Refused { why, count } => Some((*why, *count)),
            _ => None,
        })
        .collect();
    assert_eq!(refused.len(), 120, "one for each fault");
    assert!(refused.iter().zip(1..).all(|((_, count), n)| *count == n), "all are counted");
    let known: Vec<Refusal> = refused.iter().map(|(why, _)| *why).collect();
    assert!(known.chunks(6).zip(faults.chunks(5)).all(|(known, faults)| {
        // half a frame may have lost its framing, or only its CRC
        known[..2] == faults[..2] && known[3..5] == faults[3..]
    }));
}

/// Tables of a ring whose first quadrupole is 1 % stronger than the design.
fn other_tables(ring: &Ring) -> Tables {
    let mut vars = vec![1.0; 48];
    vars[0] = 1.01;
    training::green::tables(&ring.with_vars(&vars)).unwrap()
}

#[test]
fn new_tables_change_the_estimate_as_they_do_in_process() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let good = wires(&recording);
    let other = other_tables(&ring);
    let mut bytes = start(&core);
    good[..200].iter().for_each(|wire| bytes.extend(heard(wire)));
    other.parcels::<LINE>().for_each(|parcel| bytes.extend(request(&Request::Model(parcel))));
    good[200..].iter().for_each(|wire| bytes.extend(heard(wire)));
    bytes.extend(request(&Request::Status));
    bytes.extend(request(&Request::BuiltIn));
    bytes.extend(request(&Request::Status));
    let replies = replies(&in_flash(&core.tables), &bytes);
    // a core with the new tables from its first frame on, linearised at other moments
    let mut expected = Core::with_tables(other.clone(), core.setup.clone()).unwrap();
    let mut last = None;
    stream::replay(&mut expected, &recording, |_, estimate| last = Some(estimate.clone())).unwrap();
    let (last, got) = (last.unwrap(), estimates(&replies).pop().unwrap());
    for i in 0..48 {
        let shift = (got.map_params[i] - last.map_params[i]) / last.params_sigma[i];
        assert!(shift.abs() < 0.1, "{i}: {shift}"); // as between orders of the frames
    }
    // ln var is relative to the tables' own ring
    assert!((got.map_params[0] - (0.99862_f32 / 1.01).ln()).abs() < 5e-4, "{}", got.map_params[0]);
    let status: Vec<_> = replies.iter().filter_map(|r| if let Reply::Status(s) = r { Some(s) } else { None }).collect();
    assert_eq!((status[0].loaded, status[0].tables), (true, other.digest::<LINE>()));
    assert_eq!((status[1].loaded, status[1].tables), (false, core.tables.digest::<LINE>()));
}

#[test]
fn damaged_tables_are_rejected_whole() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let good = wires(&recording);
    let parcels: Vec<Parcel> = other_tables(&ring).parcels().collect();
    let mut clean = start(&core);
    good.iter().take(40).for_each(|wire| clean.extend(heard(wire)));
    let mut faulty = start(&core);
    good[..20].iter().for_each(|wire| faulty.extend(heard(wire)));
    // one parcel lost
    let lost = parcels.iter().enumerate().filter(|(at, _)| *at != 77);
    lost.for_each(|(_, parcel)| faulty.extend(request(&Request::Model(parcel.clone()))));
    // one code changed, and its packet's CRC right
    for parcel in &parcels {
        let mut parcel = parcel.clone();
        if let Parcel::Codes { table, line: 50, codes } = &mut parcel
            && *table == Table::MutualX as u8
        {
            codes[3] += 1;
        }
        faulty.extend(request(&Request::Model(parcel)));
    }
    // a part without its head
    faulty.extend(request(&Request::Model(parcels[5].clone())));
    good[20..40].iter().for_each(|wire| faulty.extend(heard(wire)));
    let (clean, faulty) = (replies(&in_flash(&core.tables), &clean), replies(&in_flash(&core.tables), &faulty));
    assert!(estimates(&clean) == estimates(&faulty), "another posterior");
    let wrong: Vec<ParcelError> =
        faulty.iter().filter_map(|r| if let Reply::Model(Err(e)) = r { Some(*e) } else { None }).collect();
    assert!(
        matches!(wrong[..], [ParcelError::Corrupted { .. }, ParcelError::Corrupted { .. }, ParcelError::Headless]),
        "{wrong:?}"
    );
    assert!(!faulty.contains(&Reply::Model(Ok(Taken::InUse))));
}

/// Status of the device at the end.
fn last_status(replies: &[Reply]) -> Status {
    match replies.last() {
        Some(Reply::Status(status)) => *status,
        other => panic!("{other:?}"),
    }
}

#[test]
fn tables_that_cannot_be_left_stay_in_use() {
    // given tables in flash that are right at vars = 1 and have no stable ring anywhere else
    let (ring, recording) = paper_vars();
    let mut core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let mut steep = in_flash(&core.tables);
    steep.weight.iter_mut().for_each(|weight| *weight *= 1e4);
    // when frames by other tables have moved the vars, and the device is to go back
    let good = wires(&recording);
    let mut bytes = start(&core);
    core.tables.parcels::<LINE>().for_each(|parcel| bytes.extend(request(&Request::Model(parcel))));
    good[..60].iter().for_each(|wire| bytes.extend(heard(wire)));
    bytes.extend(request(&Request::BuiltIn));
    good[60..90].iter().for_each(|wire| bytes.extend(heard(wire)));
    bytes.extend(request(&Request::Status));
    let replies = replies(&steep, &bytes);
    // then it refuses, and goes on with the tables that it has
    assert!(replies.contains(&Reply::Model(Err(ParcelError::Unstable))));
    let status = last_status(&replies);
    assert_eq!((status.loaded, status.tables, status.frames), (true, core.tables.digest::<LINE>(), 90));
    let sent = estimates(&replies);
    for (wire, got) in good[..90].iter().zip(&sent) {
        core.prepare();
        let expected = core.ingest(&mut wire.clone()).unwrap();
        for i in 0..48 {
            let shift = (got.map_params[i] - expected.map_params[i]) / expected.params_sigma[i];
            assert!(shift.abs() < 0.1, "frame {}, {i}: {shift}", got.sequence); // linearised once more
        }
    }
}

#[test]
fn a_restart_with_tables_without_a_design_goes_back_to_those_in_flash() {
    // given tables whose Green's function between nodes is beyond all numbers
    let (ring, recording) = paper_vars();
    let mut core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let mut endless = in_flash(&core.tables);
    endless.x.mutual.scale = f32::MAX;
    // when they come before the first setup, and then it
    let mut bytes = Vec::new();
    endless.parcels::<LINE>().for_each(|parcel| bytes.extend(request(&Request::Model(parcel))));
    bytes.extend(start(&core));
    let wire = &wires(&recording)[0];
    bytes.extend(heard(wire));
    bytes.extend(request(&Request::Status));
    let replies = replies(&in_flash(&core.tables), &bytes);
    // then it says that it drops them, and uses those in flash for the frame
    let [.., Reply::Model(taken), Reply::Model(Err(ParcelError::Unstable)), Reply::Restarted, sent, _] = &replies[..]
    else {
        panic!("{:?}", replies.iter().rev().take(5).collect::<Vec<_>>());
    };
    assert_eq!(*taken, Ok(Taken::InUse));
    let Reply::Estimate(sent) = sent else { panic!("no estimate") };
    assert!(estimate_of(sent) == core.ingest(&mut wire.clone()).unwrap());
    let status = last_status(&replies);
    assert_eq!((status.loaded, status.tables, status.refused), (false, core.tables.digest::<LINE>(), 0));
}

#[test]
fn a_device_without_a_design_says_so() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let mut endless = in_flash(&core.tables);
    endless.x.mutual.scale = f32::MAX;
    let bytes = [start(&core), heard(&wires(&recording)[0])].concat();
    let replies = replies(&endless, &bytes);
    assert_eq!(replies[0], Reply::Refused { why: Refusal::NoDesign, count: 1 });
    assert_eq!(replies[1], Reply::Refused { why: Refusal::NotStarted, count: 2 });
}

#[test]
fn a_front_end_that_restarts_its_counter_is_accepted_after_a_request() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let good = wires(&recording);
    let mut bytes = start(&core);
    bytes.extend(heard(&good[10]));
    bytes.extend(heard(&good[0]));
    bytes.extend(request(&Request::ForgetSequence));
    bytes.extend(heard(&good[0]));
    let replies = replies(&in_flash(&core.tables), &bytes);
    assert!(matches!(replies[2], Reply::Refused { why: Refusal::OutOfOrder, count: 1 }));
    assert!(matches!(&replies[4], Reply::Estimate(sent) if sent.sequence == 0 && sent.frames == 2));
}

#[test]
fn a_device_says_what_it_lacks() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let mut bytes = heard(&wires(&recording)[0]);
    bytes.extend(restart(&stream::Setup { noise: vec![0.0; 33], ..core.setup.clone() }));
    let replies = replies(&in_flash(&core.tables), &bytes);
    assert_eq!(replies[0], Reply::Refused { why: Refusal::NotStarted, count: 1 });
    assert_eq!(replies[1], Reply::Refused { why: Refusal::Setup, count: 2 });
}

#[test]
fn tables_of_another_ring_are_refused() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    // given a ring with one monitor less, for which there would be room
    let mut smaller = ring.clone();
    smaller.read_monitors.pop();
    let other = training::green::tables(&smaller).unwrap();
    let mut bytes = start(&core);
    other.parcels::<LINE>().take(1).for_each(|parcel| bytes.extend(request(&Request::Model(parcel))));
    let replies = replies(&in_flash(&core.tables), &bytes);
    let got = other.sizes();
    assert_eq!(replies[1], Reply::Model(Err(ParcelError::Sizes { room: core.tables.sizes(), got })));
}

#[test]
fn a_reply_repeats_the_number_of_its_request() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let wire = &wires(&recording)[0];
    let mut bytes = start(&core); // whose number is 1
    bytes.extend(heard(&packet(9, &Request::Covariance)));
    bytes.extend(heard(&packet(u32::MAX, &Request::Status)));
    bytes.extend(heard(wire));
    // one that this version does not know, and one whose number is damaged with the rest
    bytes.extend(heard(&sealed(REQUEST, &[12, 99])));
    bytes.extend(heard(&sealed(REQUEST, &[0x80])));
    bytes.extend(heard(&packet(13, &Request::Form(Form::Short))));
    bytes.extend(heard(wire));
    let replies = numbered(&in_flash(&core.tables), &bytes);
    let malformed = |count| Reply::Refused { why: Refusal::Malformed, count };
    assert_eq!(replies[0], (1, Reply::Restarted));
    assert!(matches!(replies[1], (u32::MAX, Reply::Status(_))));
    assert!(matches!(replies[2], (UNASKED, Reply::Estimate(_))));
    assert!(replies[3..24].iter().all(|reply| matches!(reply, (9, Reply::Covariance { sequence: 0, .. }))));
    assert_eq!(replies[24..26], [(12, malformed(1)), (UNASKED, malformed(2))]);
    assert_eq!(replies[26], (13, Reply::Form(Form::Short)));
    assert_eq!(replies[27..], [(UNASKED, Reply::Refused { why: Refusal::Repeated, count: 3 })]);
}

#[test]
fn a_device_says_its_version_and_its_ring() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let status = last_status(&replies(&in_flash(&core.tables), &request(&Request::Status)));
    assert_eq!((status.version, status.frame_version), (link::VERSION, Frame::VERSION));
    assert_eq!((status.ring, status.room), (core.tables.sizes(), SIZES));
}

#[test]
fn a_short_reply_says_what_the_estimate_says() {
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let good = wires(&recording);
    let all = |form: Form| {
        let mut bytes = start(&core);
        bytes.extend(request(&Request::Form(form)));
        good.iter().for_each(|wire| bytes.extend(heard(wire)));
        bytes.extend(request(&Request::Status));
        replies(&in_flash(&core.tables), &bytes)
    };
    let (full, short) = (all(Form::Full), all(Form::Short));
    assert_eq!((full.len(), short.len()), (349, 349));
    assert_eq!(last_status(&short), last_status(&full));
    for (full, short) in full[2..348].iter().zip(&short[2..348]) {
        let (Reply::Estimate(full), Reply::Short(short)) = (full, short) else { panic!("{short:?}") };
        assert_eq!((short.sequence, short.nis, short.remarks), (full.sequence, full.nis, full.remarks));
        let faulty = full.health.iter().any(|(state, ..)| *state != 0) || full.clipped.iter().any(|word| *word != 0);
        assert_eq!(short.attention, faulty, "frame {}", short.sequence);
        assert_eq!(short.correction, None, "nothing was asked of it");
        let mut bytes = [0; PACKET];
        assert!(Reply::Short(short.clone()).encode(UNASKED, &mut bytes).unwrap() < 40, "short it is");
    }
    // a restart ends it: the next host may not know of it
    let mut bytes = request(&Request::Form(Form::Short));
    bytes.extend([start(&core), heard(&good[0])].concat());
    assert!(matches!(replies(&in_flash(&core.tables), &bytes)[..], [_, Reply::Restarted, Reply::Estimate(_)]));
}

/// What the setpoints are, and why, while a device steers a loop: those of the loop in process, bit for bit.
#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn a_device_steers_from_one_request_to_the_next() {
    // given a loop with a lost beam and a corrector that sticks
    let known = Known::read().unwrap();
    let scenario = Scenario::of_faults(5);
    let mut closed = Loop::new(&known, recommended(), Control::Estimated, scenario).unwrap();
    let cycles: Vec<_> = (0..130)
        .map(|_| {
            let steered = closed.cycle().unwrap().steered;
            (closed.wire.clone(), steered, closed.setpoints().to_vec())
        })
        .collect();
    let wire = |at: usize| heard(&cycles[at].0);
    let wanted = closed.feedback().clone();
    let on = || request(&Request::Feedback(Some(wanted.clone())));
    // when a device hears the same frames, is told to steer from the 21st on, and once what is not sound
    let core = Known::core().unwrap();
    let mut bytes = [start(&core), request(&Request::Form(Form::Short))].concat();
    (0..20).for_each(|at| bytes.extend(wire(at)));
    bytes.extend(on());
    (20..100).for_each(|at| bytes.extend(wire(at)));
    bytes.extend(request(&Request::Feedback(Some(Feedback { walk: f32::NAN, ..wanted.clone() }))));
    (100..120).for_each(|at| bytes.extend(wire(at)));
    // off, on again, and restarted
    bytes.extend([request(&Request::Feedback(None)), wire(120), on(), wire(121), wire(122)].concat());
    bytes.extend([start(&core), request(&Request::Form(Form::Short)), wire(123)].concat());
    let replies = replies(&in_flash(&core.tables), &bytes);
    let corrections: Vec<_> = replies
        .iter()
        .filter_map(|reply| match reply {
            Reply::Short(short) => Some(short.correction.clone()),
            _ => None,
        })
        .collect();
    // then it steers as the loop does, and else not at all
    assert_eq!(corrections.len(), 124);
    let said: Vec<_> =
        replies.iter().filter(|reply| matches!(reply, Reply::Feedback(_) | Reply::Refused { .. })).collect();
    let refused = Reply::Refused { why: Refusal::Setup, count: 1 };
    assert_eq!(said, [&Reply::Feedback(true), &refused, &Reply::Feedback(false), &Reply::Feedback(true)]);
    assert!(corrections[..20].iter().chain([&corrections[120], &corrections[123]]).all(Option::is_none));
    let mut holds = BTreeMap::new();
    let mut left_out = 0;
    for (at, (correction, (_, steered, setpoints))) in corrections.iter().zip(&cycles).enumerate().take(120).skip(20) {
        let Correction { steered: got, prepared, setpoints: sent } = correction.as_ref().unwrap();
        assert_eq!((Some(*got), *prepared, sent.as_slice()), (*steered, true, setpoints.as_slice()), "frame {at}");
        got.hold.into_iter().for_each(|hold| *holds.entry(hold.to_string()).or_insert(0) += 1);
        left_out = left_out.max(got.left_out);
    }
    assert_eq!((holds[&Hold::Stale.to_string()], left_out), (1, 1), "{holds:?}");
    assert!(holds[&Hold::PutAside.to_string()] >= 6, "{holds:?}");
    // switched on again it begins where the correctors are
    let again = corrections[121].as_ref().unwrap();
    let frame = Frame::decode(&LAYOUT, &mut cycles[121].0.clone()).unwrap();
    assert_eq!((again.steered.hold, again.setpoints.as_slice()), (Some(Hold::Stale), frame.corrector.as_slice()));
    assert_eq!(corrections[122].as_ref().unwrap().steered.hold, Some(Hold::Unprepared), "the other plane's gains");
}

/// The bytes that `docs/device.md` shows.
#[test]
fn the_packets_of_the_page_have_these_bytes() {
    let page = include_str!("../../docs/device.md");
    let reply = |number: u32, reply: Reply| {
        let mut bytes = vec![0; PACKET];
        let n = reply.encode(number, &mut bytes).unwrap();
        bytes.truncate(n);
        bytes
    };
    let packets = [
        packet(1, &Request::Status),
        packet(2, &Request::Covariance),
        packet(4, &Request::Form(Form::Short)),
        packet(5, &Request::Feedback(None)),
        reply(3, Reply::Restarted),
        reply(UNASKED, Reply::Refused { why: Refusal::NotStarted, count: 1 }),
        reply(5, Reply::Feedback(false)),
    ];
    for bytes in packets {
        let hex: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        assert!(page.contains(&format!("`{}`", hex.join(" "))), "{hex:?}");
    }
}

// ---- A bad line ----

/// What comes between good frames besides what [`faulty`] makes of them.
const STRANGE: usize = 12;

/// A front end whose frames come alone, or on a bad line.
struct FrontEnd {
    machine: Machine,
    /// Of the line; none on a good one.
    faults: Option<Random>,
    setup: Setup,
    sequence: u32,
    frames: usize,
    first: Vec<u8>,
    last: Vec<u8>,
    waiting: VecDeque<Option<u8>>,
}

impl FrontEnd {
    fn new(core: &Core, faults: Option<Random>) -> Self {
        let (machine, setup) = (Machine::drawn(core, 3), core.setup.in_room(&LAYOUT));
        let waiting = restart(&core.setup).into();
        Self { machine, faults, setup, sequence: 0, frames: 0, first: Vec::new(), last: Vec::new(), waiting }
    }

    /// One frame, and before it on a bad line a fault.
    fn send(&mut self) {
        let count = 1 + self.machine.random.below(6);
        let corrector = self.machine.random.powered(count, 1.0, 10.0);
        self.sequence += 1 + u32::from(self.frames.is_multiple_of(50)); // cycles may be lost
        let mut frame = self.machine.cycle_with(self.sequence, corrector);
        let silent = (self.frames.is_multiple_of(7)).then(|| self.machine.random.below(33));
        silent.into_iter().for_each(|monitor| frame.valid.put(monitor, false));
        let mut wire = wire_of(&frame);
        if let Some(mut random) = self.faults.take() {
            self.go_wrong(&wire, &mut random);
            // a front end may write anything for a monitor that did not report
            let mut body = Body::of(&wire);
            silent.into_iter().for_each(|monitor| body.reading[monitor] = [i32::MIN, i32::MAX][random.below(2)]);
            wire = body.wire();
            self.faults = Some(random);
        }
        self.say(&wire);
        if self.first.is_empty() {
            self.first = wire.clone();
        }
        (self.last, self.frames) = (wire, self.frames + 1);
    }

    /// Send bytes; a zero first, so that whatever came before ends there.
    fn say(&mut self, bytes: &[u8]) {
        self.waiting.push_back(Some(0));
        self.waiting.extend(bytes.iter().copied().map(Some));
    }

    fn go_wrong(&mut self, next: &[u8], random: &mut Random) {
        let last = if self.last.is_empty() { next } else { &self.last };
        let bytes = match self.frames % (FAULTS + STRANGE) {
            // what repeats a frame has to come after it
            13 | 14 | 16 if self.first.is_empty() => Vec::new(),
            fault if fault < FAULTS => faulty(fault, last, next, &self.first, random).0,
            strange => self.strange(strange - FAULTS, next, random),
        };
        self.say(&bytes);
        if self.frames % (FAULTS + STRANGE) == FAULTS {
            self.waiting.extend([None, None]); // the rest of it does not come
        }
    }

    fn strange(&mut self, what: usize, next: &[u8], random: &mut Random) -> Vec<u8> {
        let number = random.below(1 << 30) as u32;
        match what {
            0 => next[..1 + random.below(next.len() - 2)].to_vec(),
            1 => (0..random.below(2 * PACKET)).map(|_| random.byte()).collect(),
            2 => (0..PACKET + random.below(4 * PACKET)).map(|_| random.byte() | 1).collect(),
            // requests that this version does not know, of another version, cut off, or damaged
            3 => sealed(REQUEST, &[5, 8 + random.below(100) as u8, 1, 2, 3]),
            4 => sealed(REQUEST ^ 1, &[5, 3]),
            5 => sealed(REQUEST, &[5, 0, 1, 2, 3]),
            6 => {
                let mut bytes = packet(number, &Request::Restart(self.setup.clone()));
                let at = random.below(bytes.len() - 1);
                bytes[at] ^= 1 << random.below(8);
                bytes
            }
            7 => packet(number, &Request::Restart(self.unsound(random))),
            // parts of tables without their head, and the head of another ring's
            8 => packet(number, &Request::Model(AnyParcel::Seal { crc: 7 })),
            9 => packet(number, &Request::Model(AnyParcel::Head { version: 3, sizes: Sizes { params: 47, ..SIZES } })),
            // an echo of its own replies
            10 => sealed(REPLY, &[0, 3]),
            // a front end of an earlier life
            _ => Body { epoch: u32::MAX, ..Body::of(next) }.wire(),
        }
    }

    /// A setup in which one number is none, or not positive.
    fn unsound(&self, random: &mut Random) -> Setup {
        let mut setup = self.setup.clone();
        let wrong = [f32::NAN, f32::INFINITY, -1.0][random.below(3)];
        match random.below(8) {
            0 => setup.prior[random.below(8)].sigma = wrong,
            1 => setup.gate = Gate { sigmas: wrong },
            2 => setup.walk.params = wrong,
            3 => setup.tune_calibration = Some(wrong),
            4 => setup.noise.all = wrong,
            5 => setup.walk.baselines = wrong,
            6 => setup.calibration.dipole = Some(wrong),
            _ => setup.calibration.supplies[0].nominal = wrong,
        }
        setup
    }
}

/// So many frames, then a request for the covariance before the last one, and the status.
struct Sent(FrontEnd, usize);

impl ErrorType for Sent {
    type Error = ErrorKind;
}

impl ReadReady for Sent {
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        Ok(false)
    }
}

impl Read for Sent {
    fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
        let Self(front_end, frames) = self;
        if front_end.waiting.is_empty() && front_end.frames < *frames {
            if front_end.frames + 1 == *frames {
                front_end.say(&packet(1, &Request::Covariance));
            }
            front_end.send();
            if front_end.frames == *frames {
                front_end.say(&packet(2, &Request::Status));
            }
        }
        let Some(next) = front_end.waiting.pop_front() else { return Ok(0) };
        to[0] = next.ok_or(ErrorKind::TimedOut)?;
        Ok(1)
    }
}

/// What a device says, in few bytes.
#[derive(Default)]
struct Heard {
    packet: Vec<u8>,
    /// Of each estimate but for the number of refused frames, to the bit.
    estimates: Vec<u64>,
    /// Each piece of a covariance.
    covariance: Vec<u64>,
    refused: BTreeMap<String, u32>,
    status: Option<Status>,
}

impl Heard {
    fn hear(&mut self, reply: Reply) {
        let bits = |reply: &Reply| {
            let (mut hasher, mut bytes) = (DefaultHasher::new(), [0; PACKET]);
            let n = reply.encode(UNASKED, &mut bytes).unwrap();
            bytes[..n].hash(&mut hasher);
            hasher.finish()
        };
        match reply {
            Reply::Estimate(estimate) => {
                self.estimates.push(bits(&Reply::Estimate(Answer { rejected_frames: 0, ..estimate })));
            }
            Reply::Covariance { .. } => self.covariance.push(bits(&reply)),
            Reply::Refused { why, count } => {
                *self.refused.entry(format!("{why:?}")).or_default() += 1;
                assert_eq!(self.refused.values().sum::<u32>(), count, "each is counted, and said");
            }
            Reply::Status(status) => self.status = Some(status),
            Reply::Restarted | Reply::Model(Err(_)) => {}
            other => panic!("{other:?}"),
        }
    }
}

impl ErrorType for Heard {
    type Error = ErrorKind;
}

impl Write for Heard {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        for byte in bytes {
            self.packet.push(*byte);
            if *byte == 0 {
                let reply = Reply::decode(&mut self.packet).1.unwrap();
                self.packet.clear();
                self.hear(reply);
            }
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        Ok(())
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_hundred_thousand_frames_with_a_fault_before_each_are_those_frames_alone() {
    const FRAMES: usize = 100_000;
    let (ring, recording) = paper_vars();
    let core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
    let built_in = in_flash(&core.tables);
    let hear = |faults: Option<Random>| {
        let (mut sent, mut heard) = (Sent(FrontEnd::new(&core, faults), FRAMES), Heard::default());
        run(&built_in, &mut sent, &mut heard);
        heard
    };
    let (alone, mixed) = std::thread::scope(|scope| {
        let alone = scope.spawn(|| hear(None));
        let mixed = hear(Some(Random::new(5)));
        (alone.join().unwrap(), mixed)
    });
    assert_eq!((alone.estimates.len(), alone.covariance.len(), alone.refused.len()), (FRAMES, 21, 0));
    let different = alone.estimates.iter().zip(&mixed.estimates).position(|(alone, mixed)| alone != mixed);
    assert_eq!((different, mixed.estimates.len()), (None, FRAMES));
    assert_eq!(alone.covariance, mixed.covariance);
    // nothing else of the device has moved either, but for the cycles in which a sender has stalled
    let (alone, mixed_status) = (alone.status.unwrap(), mixed.status.unwrap());
    assert_eq!(Status { refused: 0, vitals: alone.vitals, ..mixed_status }, alone);
    // each kind of refusal stands for a kind of fault, of which there is one in 32 frames
    let kinds: Vec<(&str, bool)> = mixed.refused.iter().map(|(why, count)| (why.as_str(), *count > 1000)).collect();
    let all =
        "Beyond Corrupted Count Framing Malformed OutOfOrder Oversized Range Repeated Setup Stalled Truncated Version";
    assert_eq!(kinds, all.split(' ').map(|why| (why, true)).collect::<Vec<_>>(), "{:?}", mixed.refused);
}
