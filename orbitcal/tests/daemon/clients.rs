//! Readers that are not ours: the example in Python, and the command line of iceoryx2. `make clients` installs both and runs this.

use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::env;
use std::io::Write;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::thread;

use crate::place::{Frames, Place, connected, port};

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// A daemon that gets a frame every ten milliseconds while others read.
fn with_daemon(test: &str, run: impl FnOnce(&Place)) {
    let port = port();
    let place = Place::new(test, &format!("tcp://127.0.0.1:{port}"), "listen", "");
    let mut daemon = place.start();
    let ends = Arc::new(AtomicBool::new(false));
    let feeder = {
        let ends = ends.clone();
        thread::spawn(move || {
            let (mut frames, mut line) = (Frames::new(), connected(|| TcpStream::connect(("127.0.0.1", port))));
            frames.recording.rows.iter_mut().for_each(|row| row.reading[7] = None);
            for sequence in 1.. {
                if ends.load(Ordering::Relaxed) || line.write_all(&frames.wire(sequence)).is_err() {
                    return;
                }
                thread::sleep(Duration::from_millis(10));
            }
        })
    };
    place.hear("connected");
    run(&place);
    ends.store(true, Ordering::Relaxed);
    feeder.join().unwrap();
    daemon.stop();
}

#[test]
fn the_example_in_python_reads_estimates_and_health() {
    let python = root(".venv-iceoryx/bin/python");
    let has_package = Command::new(&python).args(["-c", "import iceoryx2"]).stderr(Stdio::null()).status();
    if !has_package.is_ok_and(|status| status.success()) {
        eprintln!("not tested: `make clients` installs the package iceoryx2");
        return;
    }
    with_daemon("python", |place| {
        let mut command = Command::new(&python);
        let output =
            command.arg(root("contrib/orbitcal_reader.py")).args([&place.service, "300", "20"]).output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
        assert!(said.contains("from orbitcal: AGS Booster") && said.contains(", 48 vars, 33 monitors"), "{said}");
        assert!(said.contains("300 estimates seen, 0 lost"), "{said}");
        assert!(said.contains("81 instruments") && said.contains("x_D8 dead"), "{said}");
    });
}

#[test]
fn the_command_line_of_iceoryx2_shows_the_services() {
    let program = root("target/tools/bin/iox2");
    if !program.is_file() {
        eprintln!("not tested: `make clients` installs iox2");
        return;
    }
    // it looks for its commands, iox2-service and others, as a shell does
    let others = env::var_os("PATH").unwrap_or_default();
    let path = env::join_paths([root("target/tools/bin")].into_iter().chain(env::split_paths(&others))).unwrap();
    with_daemon("iox2", |place| {
        let run = |arguments: &[&str]| {
            let output = Command::new(&program).args(arguments).env("PATH", &path).output().unwrap();
            String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
        };
        let listed = run(&["service", "list"]);
        for service in [place.service.clone(), place.service.clone() + "/health", place.service.clone() + "/request"] {
            assert!(listed.contains(&service), "{service}: {listed}");
        }
        let details = run(&["service", "details", &place.service]);
        assert!(details.contains("orbitcal.Estimate.v4"), "{details}");
        let nodes = run(&["node", "list"]);
        assert!(!nodes.is_empty(), "{nodes}");
    });
}
