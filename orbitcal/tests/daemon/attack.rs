//! Hostile senders and hostile browsers: no good frame is lost.

use core::time::Duration;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread;

use estimator::booster::{Frame, PACKET};
use estimator::packet;
use results::EstimateRecord;
use shared_memory::Subscriber;

use crate::place::{Frames, Place, connected, listening, port};

/// A packet whose header and CRC are right, of a frame with these codes wherever it has any.
fn absurd(sequence: u32, code: i32, lists: [usize; 3]) -> Vec<u8> {
    let [correctors, supplies, readings] = lists.map(|length| vec![code; length]);
    let times = (0_u32, sequence, u64::from(sequence) * 1000, 0_u32);
    let body = (times, correctors, code, supplies, code, readings, [Some(code); 2], Some(code), vec![u32::MAX; 2]);
    let mut bytes = vec![0; PACKET];
    let length = packet::seal(Frame::VERSION, &body, &mut bytes).unwrap();
    bytes.truncate(length);
    bytes
}

/// What a hostile sender says between two good frames.
fn damage(frames: &Frames, sequence: u32) -> Vec<u8> {
    let good = frames.wire(sequence);
    match sequence % 5 {
        0 => [&good[..good.len() / 2], &[0]].concat(),
        1 => [absurd(sequence, i32::MIN, [48, 2, 33]), absurd(sequence, i32::MAX, [48, 2, 33])].concat(),
        2 => [absurd(sequence, 0, [0, 0, 0]), absurd(u32::MAX, 1, [47, 2, 33])].concat(),
        3 => vec![0xff; 3 * PACKET].into_iter().chain([0]).collect(),
        _ => vec![0; 1000],
    }
}

/// Estimates up to that of a frame: each is heard before the next frame is sent, so that nobody is too slow.
fn until(subscriber: &mut Subscriber, sequence: u32) -> Vec<EstimateRecord> {
    let mut heard = listening(subscriber, 1);
    while heard.last().is_none_or(|record| record.sequence != sequence) {
        heard.extend(listening(subscriber, 1));
    }
    heard
}

fn expect_all(heard: &[EstimateRecord], good: &[u32]) {
    let sequences: Vec<u32> = heard.iter().map(|record| record.sequence).collect();
    let lost: Vec<&u32> = good.iter().filter(|sequence| !sequences.contains(sequence)).collect();
    assert!(lost.is_empty(), "{lost:?} of {sequences:?}");
    assert!(heard.iter().all(|record| record.mean.iter().chain(&record.sigma).all(|number| number.is_finite())));
}

/// Half packets, right check sums with absurd fields, slow senders, and connections that end at any place.
#[test]
fn hostile_senders_cost_no_good_frame() {
    let port = port();
    let place = Place::new("senders", &format!("tcp://127.0.0.1:{port}"), "listen", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let frames = Frames::new();
    let connect = || connected(|| TcpStream::connect(("127.0.0.1", port)));
    let good: Vec<u32> = (1..=100).map(|number| 2 * number).collect();
    let mut heard = Vec::new();
    for sequences in good.chunks(10) {
        let mut line = connect();
        for sequence in sequences {
            line.write_all(&damage(&frames, sequence - 1)).unwrap();
            line.write_all(&[&[0], &frames.wire(*sequence)[..]].concat()).unwrap();
            heard.extend(until(&mut subscriber, *sequence));
        }
        line.write_all(&frames.wire(sequences[0])[..7]).unwrap(); // cut off by the end of the connection
    }
    let slow = frames.wire(202);
    let mut line = connect();
    slow.iter().for_each(|byte| line.write_all(&[*byte]).unwrap());
    heard.extend(until(&mut subscriber, 202));
    expect_all(&heard, &good);
    daemon.stop();
}

/// 200 connections to the page that say half a request and no more, requests that come byte by byte, and headers without an end.
#[test]
fn hostile_browsers_cost_no_frame_and_the_page_is_served() {
    let [frames_port, page] = [port(), port()];
    let more = format!("[page]\naddress = \"127.0.0.1:{page}\"\n");
    let place = Place::new("browsers", &format!("tcp://127.0.0.1:{frames_port}"), "listen", &more);
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let (frames, mut line) = (Frames::new(), connected(|| TcpStream::connect(("127.0.0.1", frames_port))));
    let browser = move || connected(|| TcpStream::connect(("127.0.0.1", page)));
    let ask = |browser: &mut TcpStream, text: &[u8]| browser.write_all(text).is_ok();
    let mut idle: Vec<TcpStream> = (0..200).map(|_| browser()).collect();
    idle.iter_mut().for_each(|one| _ = ask(one, b"GET /state.json HT"));
    let large = thread::spawn(move || {
        let mut browser = browser();
        ask(&mut browser, b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")
            && (0..4).all(|_| ask(&mut browser, &vec![b'x'; 1 << 20]))
    });
    let mut posts = browser();
    ask(&mut posts, b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 18446744073709551615\r\n\r\n");
    let mut slow = browser();
    let request = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    let (good, mut heard) = ((1..=200).collect::<Vec<u32>>(), Vec::new());
    for (sequence, byte) in good.iter().zip(request.iter().map(Some).chain(core::iter::repeat(None))) {
        line.write_all(&frames.wire(*sequence)).unwrap();
        if let Some(byte) = byte {
            slow.write_all(&[*byte]).unwrap();
        }
        heard.extend(until(&mut subscriber, *sequence));
    }
    expect_all(&heard, &good);
    let mut reply = String::new();
    slow.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    slow.read_to_string(&mut reply).unwrap();
    assert!(reply.starts_with("HTTP/1.1 200 OK") && reply.contains("orbitcal_frames_total "), "{reply}");
    let _ = large.join().unwrap();
    drop(idle);
    daemon.stop();
}
