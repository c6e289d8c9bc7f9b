//! A device on the host: the loop that a chip runs, fed with recorded frames, bad bytes and new tables, beside the core in
//! process.

use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
use estimator::booster::{Answer, Estimator, Green, LINE, PACKET, Parcel, Reply, Request, TRIANGLE};
use estimator::surrogate::Table;
use estimator::wire::link::{Refusal, Status, Taken, Vitals};
use estimator::{ParcelError, Tables as _, Walk};
use firmware_sim::{Device, Panel};
use inference::Recording;
use inference::stream::{self, Core, Estimate};
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

/// Replies of a device with these tables in flash to these bytes.
fn replies(built_in: &Green, bytes: &[Option<u8>]) -> Vec<Reply> {
    let (mut core, mut slot) = (Box::new(Estimator::BLANK), Box::new(Green::BLANK));
    let mut device = Device::<_, LINE>::new(&mut *core, built_in, &mut *slot);
    let (mut source, mut sink) = (Source(bytes.iter().rev().copied().collect()), Sink(Vec::new()));
    let mut panel = Panel::new(Dark, Dark, Dark);
    let run = firmware_sim::run::<_, _, _, LINE, PACKET>;
    run(&mut device, &mut source, &mut sink, &mut panel, Vitals::default).unwrap();
    sink.0.split_inclusive_mut(|byte| *byte == 0).map(|packet| Reply::decode(packet).unwrap()).collect()
}

fn request(request: &Request) -> Vec<Option<u8>> {
    let mut bytes = vec![0; PACKET];
    let n = request.encode(&mut bytes).unwrap();
    heard(&bytes[..n])
}

fn heard(bytes: &[u8]) -> Vec<Option<u8>> {
    bytes.iter().copied().map(Some).collect()
}

fn paper_vars() -> (Ring, Recording) {
    let ring = Ring::booster();
    let recording = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
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
    let mut bytes = vec![0; rooms::large::PACKET];
    let n = rooms::large::Request::Restart(setup.on_wire()).encode(&mut bytes).unwrap();
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
    let n = Reply::Estimate(sent.clone()).encode(&mut bytes).unwrap();
    let rooms::large::Reply::Estimate(sent) = rooms::large::Reply::decode(&mut bytes[..n]).unwrap() else {
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
