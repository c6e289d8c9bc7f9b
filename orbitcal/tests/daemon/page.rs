//! The live page and the metrics: read over loopback, shown in a browser, and no way to change anything.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use serde_json::Value;
use shared_memory::Subscriber;

use crate::place::{Frames, Place, SOON, connected, listening, port, told};

/// What the server replies: status and body.
fn ask(port: u16, method: &str, path: &str, host: &str) -> (u16, String) {
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    write!(line, "{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
    let mut reply = String::new();
    line.read_to_string(&mut reply).unwrap();
    let (head, body) = reply.split_once("\r\n\r\n").unwrap_or((&reply, ""));
    assert!(!body.replace("http://www.w3.org/2000/svg", "").contains("://"), "{body}");
    (head.split(' ').nth(1).unwrap().parse().unwrap(), body.to_owned())
}

fn get(port: u16, path: &str) -> String {
    let (status, body) = ask(port, "GET", path, "localhost");
    assert_eq!(status, 200, "{path}: {body}");
    body
}

/// A daemon with a page, a faulty monitor, and some frames: `run` is told how many.
fn with_page(test: &str, run: impl FnOnce(u16, &Place, u32)) {
    let [frames_port, page] = [port(), port()];
    let more = format!("[page]\naddress = \"127.0.0.1:{page}\"\n[history]\nfolder = \"history\"\n");
    let place = Place::new(test, &format!("tcp://127.0.0.1:{frames_port}"), "listen", &more);
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let (mut frames, mut line) = (Frames::new(), connected(|| TcpStream::connect(("127.0.0.1", frames_port))));
    frames.recording.rows.iter_mut().for_each(|row| row.reading[7] = None);
    let mut feed = |sequence: u32| {
        line.write_all(&frames.wire(sequence)).unwrap();
        listening(&mut subscriber, 1);
    };
    (1..=300).for_each(&mut feed);
    // not every frame is in a picture, of which twenty at most are made a second
    let start = Instant::now();
    let is_shown = |sequence: &u32| {
        assert!(start.elapsed() < SOON, "{}", get(page, "/state.json"));
        feed(*sequence);
        get(page, "/state.json").contains(&format!("\"sequence\":{sequence},"))
    };
    let last = (301..).find(is_shown).expect("one of the frames is");
    run(page, &place, last);
    daemon.stop();
}

#[test]
fn the_page_the_numbers_and_the_metrics_are_read_and_nothing_is_changed() {
    with_page("page", |page, place, last| {
        let state: Value = serde_json::from_str(&get(page, "/state.json")).unwrap();
        assert_eq!((state["frames"].as_u64(), state["sequence"].as_u64()), (Some(last.into()), Some(last.into())));
        assert_eq!((state["vars"].as_array().unwrap().len(), state["monitors"].as_array().unwrap().len()), (48, 33));
        assert_eq!(state["monitors"][7]["state"], "dead", "{}", state["monitors"][7]);
        assert_eq!(state["monitors"][7]["residual_mm"], Value::Null);
        let residual = state["monitors"][0]["residual_mm"].as_f64().unwrap();
        // 0.15 mm of noise: six of it
        assert!(residual != 0.0 && residual.abs() < 0.9, "{residual}");
        let ring: Value = serde_json::from_str(&get(page, "/ring.json")).unwrap();
        let places = ["vars", "monitors", "correctors"].map(|of| ring["place"][of].as_array().unwrap().len());
        assert_eq!(places, [48, 33, 48]);
        let trail: Value = serde_json::from_str(&get(page, "/trail.json?span=hour&var=D8")).unwrap();
        assert!(!trail["points"].as_array().unwrap().is_empty());
        let metrics = get(page, "/metrics");
        for line in [
            format!("orbitcal_frames_total {last}"),
            "orbitcal_monitors{state=\"dead\"} 1".into(),
            format!("orbitcal_latency_seconds_count {last}"),
        ] {
            assert!(metrics.lines().any(|there| there == line), "{line} in\n{metrics}");
        }
        assert!(
            get(page, "/").contains("page.js")
                && get(page, "/page.css").contains("svg")
                && get(page, "/page.js").len() > 1000
        );
        for (method, path, host, status) in [
            ("POST", "/state.json", "localhost", 405),
            ("PUT", "/", "localhost", 405),
            ("DELETE", "/ring.json", "127.0.0.1:80", 405),
            ("GET", "/etc/passwd", "localhost", 404),
            ("GET", "/trail.json?span=hour&var=Z9", "localhost", 404),
            ("GET", "/", "evil.example", 421),
            ("GET", "/", "[::1]:9464", 200),
            ("GET", "/", "[::1]", 200),
        ] {
            assert_eq!(ask(page, method, path, host).0, status, "{method} {path} {host}");
        }
        assert!(place.said().contains(&format!("the page is at http://127.0.0.1:{page}")), "{}", place.said());
    });
}

/// A browser of the system, if there is one.
fn browser() -> Option<&'static str> {
    let is_there =
        |name: &&str| Command::new(name).arg("--version").output().is_ok_and(|output| output.status.success());
    ["chromium", "chromium-browser", "google-chrome"].into_iter().find(is_there)
}

#[test]
fn a_browser_shows_the_page_at_desk_and_phone_width() {
    let Some(browser) = browser() else {
        eprintln!("not tested: there is no Chromium here");
        return;
    };
    with_page("browser", |page, _, _| {
        for (name, width, height) in [("desk", 1280, 1900), ("phone", 390, 3400)] {
            let profile = tempfile::tempdir().unwrap();
            let shot = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("page-{name}.png"));
            let url = format!("http://127.0.0.1:{page}/");
            let run = |what: &str| {
                let mut command = Command::new(browser);
                command.args([
                    "--headless",
                    "--no-sandbox",
                    "--disable-gpu",
                    "--hide-scrollbars",
                    "--virtual-time-budget=6000",
                    // it asks nobody else in the network, and needs little of /dev/shm
                    "--disable-background-networking",
                    "--disable-component-update",
                    "--disable-dev-shm-usage",
                    "--disable-sync",
                    "--no-first-run",
                ]);
                command.arg(format!("--user-data-dir={}", profile.path().display()));
                command.arg(format!("--window-size={width},{height}")).args([what, &url]);
                // a browser that a signal ended, as some do at their first start, has shown nothing: it starts again
                let mut output = command.output().unwrap();
                for _ in 0..2 {
                    if output.status.signal().is_some() {
                        eprintln!("{}", told(&output));
                        output = command.output().unwrap();
                    }
                }
                assert!(output.status.success(), "{}", told(&output));
                String::from_utf8_lossy(&output.stdout).into_owned()
            };
            let shown = run("--dump-dom");
            for words in ["AGS Booster", " of 33 monitors and ", "missing, stuck or without effect", "D8: "] {
                assert!(shown.contains(words), "{name}: {words:?} is not shown:\n{shown}");
            }
            assert!(!shown.contains("Waiting for the first estimate") && !shown.contains("NaN"), "{shown}");
            run(&format!("--screenshot={}", shot.display()));
            assert!(fs::metadata(&shot).unwrap().len() > 10_000);
            println!("{}", shot.display());
        }
    });
}
