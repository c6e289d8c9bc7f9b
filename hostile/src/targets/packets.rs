//! Packets: streams as they stand, and bodies whose header and check sum are made right, so that what lies behind it is reached.
//!
//! Nothing that passes has its CRC wrong, and every estimate is finite.

use std::sync::LazyLock;

use crc::{CRC_32_ISO_HDLC, Crc};
use estimator::booster::Frame;
use estimator::wire::link::{REPLY, REQUEST, Reply, Vitals};
use estimator::{Tables as _, Walk};
use firmware_sim::machine::{BUILT_IN, Estimator, LINE, PACKET, Steer, Tables};
use firmware_sim::{Device, Event, Inbox};
use inference::Recording;
use inference::stream::{self, Core, Estimate};
use training::rooms::largest;
use twin::Ring;

use super::{Target, repository};

pub(super) const TARGETS: [Target; 4] = [
    Target { name: "stream", seeds: || vec![WIRES[HEARD..HEARD + 5].concat()], read: stream },
    Target {
        name: "frames",
        seeds: || bodies(&WIRES[HEARD..HEARD + 20]),
        read: |bytes| frame(&sealed(Frame::VERSION, bytes)),
    },
    Target { name: "requests", seeds: || bodies(&REQUESTS), read: |bytes| device(&sealed(REQUEST, bytes)) },
    Target { name: "replies", seeds: || bodies(&answers()), read: |bytes| reply(&sealed(REPLY, bytes)) },
];

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
/// Frames that the second core has heard.
const HEARD: usize = 100;

static RECORDING: LazyLock<Recording> = LazyLock::new(|| {
    let path = repository().join("recordings/paper-vars");
    Recording::read(&path, &Ring::booster()).expect("a recording that ships with the repository")
});
static WIRES: LazyLock<Vec<Vec<u8>>> =
    LazyLock::new(|| RECORDING.rows.iter().map(|row| stream::wire(&RECORDING, row).expect("a frame")).collect());
/// At its prior, with params that walk; and after some frames.
pub(super) static CORES: LazyLock<[Core; 2]> = LazyLock::new(|| {
    let core =
        |params| stream::estimator(&Ring::booster(), &RECORDING, Walk { params, ..Walk::NONE }).expect("a stable ring");
    let (fresh, mut seasoned) = (core(1e-5), core(0.0));
    for wire in &WIRES[..HEARD] {
        seasoned.ingest(&mut wire.clone()).expect("a good frame");
    }
    [fresh, seasoned]
});
static REQUESTS: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let ring = Ring::booster();
    let setup = stream::setup(&RECORDING.powered(&ring), &RECORDING, Walk::NONE).expect("a good recording");
    let tables = training::green::tables(&ring).expect("the built-in ring has tables");
    let parcels = tables.parcels::<{ training::LINE }>().map(largest::Request::Model);
    let all = [largest::Request::Restart(setup.on_wire()), largest::Request::Status, largest::Request::Covariance];
    all.into_iter().chain(parcels).map(|request| encoded(|to| request.encode(1, to))).collect()
});

fn encoded(encode: impl FnOnce(&mut [u8]) -> Result<usize, estimator::FrameError>) -> Vec<u8> {
    let mut bytes = vec![0; largest::PACKET];
    let length = encode(&mut bytes).expect("a packet has room for it");
    bytes.truncate(length);
    bytes
}

/// What packets say, without header and check sum.
fn bodies(wires: &[Vec<u8>]) -> Vec<Vec<u8>> {
    let body = |wire: &Vec<u8>| {
        let mut plain = wire.clone();
        let length = cobs::decode_in_place(&mut plain).expect("a good packet");
        plain[3..length - 4].to_vec()
    };
    wires.iter().map(body).collect()
}

/// A body as a packet whose kind, length and CRC are right.
fn sealed(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut plain = vec![kind, body.len() as u8, (body.len() >> 8) as u8];
    plain.extend_from_slice(body);
    plain.extend_from_slice(&CRC.checksum(&plain).to_le_bytes());
    let mut wire = vec![0; cobs::max_encoding_length(plain.len()) + 1];
    let length = cobs::encode(&plain, &mut wire);
    wire.truncate(length);
    wire.push(0); // what stands there need not be one, after a full block
    wire
}

fn is_sealed(wire: &[u8]) -> bool {
    let mut plain = wire.strip_suffix(&[0]).unwrap_or(wire).to_vec();
    let decoded = cobs::decode_in_place(&mut plain).ok().and_then(|length| plain.get(..length));
    decoded
        .and_then(<[u8]>::split_last_chunk::<4>)
        .is_some_and(|(covered, crc)| CRC.checksum(covered).to_le_bytes() == *crc)
}

fn is_finite(e: &Estimate) -> bool {
    let lists = [&e.mean, &e.sigma, &e.map_params, &e.centre, &e.params_sigma];
    let numbers =
        lists.into_iter().flatten().chain([&e.nis, &e.log_evidence]).chain(e.tune_innovation.iter().flatten());
    numbers.copied().all(f32::is_finite)
}

/// False if it is refused.
fn ingest(core: &mut Core, wire: &[u8]) -> bool {
    core.prepare();
    let Ok(estimate) = core.ingest(&mut wire.to_vec()) else { return false };
    assert!(is_sealed(wire), "accepted without its CRC");
    assert!(is_finite(&estimate), "{estimate:?}");
    true
}

/// And a good frame after it.
fn frame(wire: &[u8]) -> bool {
    let heard = CORES.each_ref().map(|core| {
        let mut core = core.clone();
        let is_taken = ingest(&mut core, wire);
        ingest(&mut core, &WIRES[HEARD + 20]);
        is_taken
    });
    heard.contains(&true)
}

pub(super) fn hear_a_good_frame(core: &mut Core) -> bool {
    ingest(core, &WIRES[HEARD])
}

fn stream(bytes: &[u8]) -> bool {
    let mut core = CORES[1].clone();
    let taken = bytes.split_inclusive(|byte| *byte == 0).filter(|wire| ingest(&mut core, wire)).count();
    device(bytes);
    taken > 0
}

/// What a device makes of bytes after it was set up, and of two frames after them; false if it refuses any of all that.
fn device(bytes: &[u8]) -> bool {
    let setup = REQUESTS[0].clone();
    let (mut core, mut steer) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK));
    let mut slot = Box::new(Tables::BLANK);
    let mut device = Device::<_, _, LINE>::new(&mut *core, &mut *steer, &BUILT_IN, &mut *slot);
    let (mut inbox, all) = (Inbox::<{ PACKET }>::default(), [&setup, bytes, &WIRES[0], &WIRES[1]].concat());
    let mut source = all.as_slice();
    loop {
        match inbox.next(&mut source).expect("memory does not fail") {
            Event::Packet(bytes) => _ = device.hear(bytes, Vitals::default, &mut |_, _| ()),
            Event::Broken(why) => device.refuse(why, &mut |_, _| ()),
            Event::Silence => {}
            Event::End => return device.refused() == 0,
        }
        while device.prepare() != estimator::Prepared::Nothing {}
    }
}

/// Replies of a device to a setup and frames.
fn answers() -> Vec<Vec<u8>> {
    let (mut core, mut steer) = (Box::new(Estimator::BLANK), Box::new(Steer::BLANK));
    let mut slot = Box::new(Tables::BLANK);
    let mut device = Device::<_, _, LINE>::new(&mut *core, &mut *steer, &BUILT_IN, &mut *slot);
    let mut answers = Vec::new();
    let mut reply = |number: u32, reply: &firmware_sim::Reply<Estimator>| {
        answers.push(encoded(|to| reply.encode(number, to)));
    };
    for wire in REQUESTS[..3].iter().chain(&WIRES[..3]) {
        device.hear(&mut wire.clone(), Vitals::default, &mut reply);
    }
    answers
}

/// What the host makes of a reply.
fn reply(wire: &[u8]) -> bool {
    match largest::Reply::decode(&mut wire.to_vec()).1 {
        Ok(Reply::Estimate(answer)) => Estimate::of_answer(&answer).is_some(),
        reply => reply.is_ok(),
    }
}
