//! Hostile senders and hostile browsers of a daemon.

use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread;

/// What comes on the line before a good frame: halves of it, bytes without an end, nothing but ends, a flipped bit.
pub fn damage(frame: &[u8], number: usize) -> Vec<u8> {
    let mut flipped = frame.to_vec();
    flipped[frame.len() / 3] ^= 1;
    match number % 4 {
        0 => [&frame[..frame.len() / 2], &[0]].concat(),
        1 => [vec![0xff; 3 * frame.len()], vec![0]].concat(),
        2 => vec![0; 1000],
        _ => flipped,
    }
}

/// Browsers that ask for everything as fast as they are answered.
const HURRIED: usize = 16;

/// Browsers of a page, until they are told to end: 200 connections with half a request, headers of megabytes, lengths beyond all bounds, requests byte by byte,
/// and some that ask as fast as they are answered.
pub fn browse(page: u16, is_over: &AtomicBool) {
    thread::scope(|scope| {
        for _ in 0..HURRIED {
            scope.spawn(|| hurry(page, is_over));
        }
        stall(page, is_over);
    });
}

fn hurry(page: u16, is_over: &AtomicBool) {
    let requests = b"GET /state.json HTTP/1.1\r\nHost: localhost\r\n\r\nGET /trail.json?span=hour&var=D8 HTTP/1.1\r\nHost: localhost\r\n\r\n";
    while !is_over.load(Ordering::Relaxed) {
        let Ok(mut browser) = TcpStream::connect(("127.0.0.1", page)) else { continue };
        let mut read = vec![0; 1 << 16];
        while !is_over.load(Ordering::Relaxed)
            && browser.write_all(requests).is_ok()
            && browser.read(&mut read).is_ok_and(|length| length > 0)
        {}
    }
}

fn stall(page: u16, is_over: &AtomicBool) {
    let open = || TcpStream::connect(("127.0.0.1", page)).ok();
    // what the daemon refuses, or ends, is what is wanted
    let say = |browser: &mut Option<TcpStream>, text: &[u8]| {
        browser.as_mut().is_some_and(|browser| browser.write_all(text).is_ok())
    };
    while !is_over.load(Ordering::Relaxed) {
        let mut idle: Vec<Option<TcpStream>> = (0..200).map(|_| open()).collect();
        idle.iter_mut().for_each(|one| _ = say(one, b"GET /state.json HT"));
        let mut large = open();
        let _ = say(&mut large, b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")
            && (0..4).all(|_| say(&mut large, &vec![b'x'; 1 << 20]));
        say(&mut open(), b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 18446744073709551615\r\n\r\n");
        say(&mut open(), b"GET /state.json HTTP/1.1\r\nHost: elsewhere.example\r\n\r\n");
        let mut slow = open();
        for byte in b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n" {
            say(&mut slow, &[*byte]);
            say(&mut open(), b"GET /state.json HTTP/1.0\r\n\r\n");
            thread::sleep(Duration::from_millis(20));
        }
    }
}
