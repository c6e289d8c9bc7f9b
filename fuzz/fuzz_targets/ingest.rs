//! Hostile bytes: a stream, split at its zeros as a receiver splits it, through `Frame::decode` and a core of the Booster.
//!
//! Nothing may panic, whatever passes has its CRC right, and every estimate is finite. The first byte of an input chooses the
//! core, and what the rest is: a stream as it stands, bodies whose header and CRC are made right, or changes to the bodies of
//! recorded frames, so that what lies behind the CRC is reached as well.
#![no_main]

use estimator::Walk;
use std::path::Path;
use std::sync::LazyLock;

use estimator::booster::Frame;
use inference::Recording;
use inference::stream::{self, Core, Estimate};
use libfuzzer_sys::fuzz_target;
use twin::Ring;

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

struct Campaign {
    /// A core at its prior, whose params walk; and one that has heard the first `HEARD` frames.
    cores: [Core; 2],
    /// Bodies of all frames.
    bodies: Vec<Vec<u8>>,
}

const HEARD: usize = 100;

static CAMPAIGN: LazyLock<Campaign> = LazyLock::new(|| {
    let ring = Ring::booster();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
    let recording = Recording::read(&path, &ring).expect("a recording that ships with the repository");
    let wires: Vec<_> = recording.rows.iter().map(|row| stream::wire(&recording, row).expect("a frame")).collect();
    let [fresh, mut seasoned] =
        [1e-5, 0.0].map(|params| stream::estimator(&ring, &recording, Walk { params, ..Walk::NONE }).expect("a stable ring"));
    for wire in wires.iter().take(HEARD) {
        seasoned.ingest(&mut wire.clone()).expect("a good frame");
    }
    let body = |mut wire: Vec<u8>| {
        let n = cobs::decode_in_place(&mut wire).expect("a good frame");
        wire[3..n - 4].to_vec()
    };
    Campaign { cores: [fresh, seasoned], bodies: wires.into_iter().map(body).collect() }
});

/// A body as a wire frame whose version, length and CRC are right.
fn sealed(body: &[u8]) -> Vec<u8> {
    let mut plain = vec![Frame::VERSION, body.len() as u8, (body.len() >> 8) as u8];
    plain.extend_from_slice(body);
    plain.extend_from_slice(&CRC.checksum(&plain).to_le_bytes());
    let mut wire = vec![0; cobs::max_encoding_length(plain.len()) + 1];
    let n = cobs::encode(&plain, &mut wire);
    wire.truncate(n + 1);
    wire
}

fn is_sealed(wire: &[u8]) -> bool {
    let mut plain = wire.strip_suffix(&[0]).unwrap_or(wire).to_vec();
    let decoded = cobs::decode_in_place(&mut plain).ok().and_then(|n| plain.get(..n));
    decoded
        .and_then(<[u8]>::split_last_chunk::<4>)
        .is_some_and(|(covered, crc)| CRC.checksum(covered).to_le_bytes() == *crc)
}

fn is_finite(e: &Estimate) -> bool {
    let lists = [&e.mean, &e.sigma, &e.map_params, &e.centre, &e.params_sigma];
    let numbers = lists.into_iter().flatten().chain([&e.nis, &e.log_evidence]).chain(e.tune_innovation.iter().flatten());
    numbers.copied().all(f32::is_finite)
}

fn ingest(core: &mut Core, wire: &[u8]) {
    core.prepare();
    if let Ok(estimate) = core.ingest(&mut wire.to_vec()) {
        assert!(is_sealed(wire), "accepted without its CRC");
        assert!(is_finite(&estimate), "{estimate:?}");
    }
}

/// Bodies, each behind its length.
fn bodies(mut input: &[u8]) -> Vec<Vec<u8>> {
    let mut bodies = Vec::new();
    while let Some(([low, high], tail)) = input.split_first_chunk() {
        let (body, after) = tail.split_at(usize::from(u16::from_le_bytes([*low, *high])).min(tail.len()));
        bodies.push(body.to_vec());
        input = after;
    }
    bodies
}

/// A recorded body for every 16 bytes: four places, and bytes to write there or bits to flip.
fn changed(input: &[u8], recorded: &[Vec<u8>]) -> Vec<Vec<u8>> {
    let change = |(edits, body): (&[u8], &Vec<u8>)| {
        let mut body = body.clone();
        for edit in edits.chunks_exact(4) {
            let at = usize::from(u16::from_le_bytes([edit[0], edit[1]])) % body.len();
            body[at] = if edit[2] & 1 == 1 { edit[3] } else { body[at] ^ edit[3] };
        }
        body
    };
    input.chunks(16).zip(recorded).map(change).collect()
}

fuzz_target!(|input: &[u8]| {
    let Some((&choice, input)) = input.split_first() else { return };
    let seasoned = usize::from(choice & 1);
    let mut core = CAMPAIGN.cores[seasoned].clone();
    match choice >> 1 & 3 {
        0 => input.split_inclusive(|byte| *byte == 0).for_each(|wire| ingest(&mut core, wire)),
        1 => bodies(input).iter().for_each(|body| ingest(&mut core, &sealed(body))),
        _ => {
            let recorded = &CAMPAIGN.bodies[HEARD * seasoned..];
            changed(input, recorded).iter().for_each(|body| ingest(&mut core, &sealed(body)));
        }
    }
});
