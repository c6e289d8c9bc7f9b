//! Does another process see what the core says? Two real processes, and the shared memory between them.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

const FRAMES: u64 = 346;

/// The program, in the root of the workspace.
fn orbitcal(arguments: &[&str], service: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    command.current_dir(root).args(arguments).args(["--service", service]).stdin(Stdio::null());
    command
}

/// A process that is killed if a test fails before its end.
struct Running(Child);

impl Running {
    fn start(command: &mut Command) -> Self {
        Self(command.spawn().expect("the program was built for this test"))
    }

    fn has_succeeded(&mut self) -> bool {
        self.0.wait().expect("it is a child of this process").success()
    }

    /// SIGKILL: nothing is cleared away.
    fn kill(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.kill();
    }
}

/// `orbitcal watch`, once it listens.
struct Watch {
    process: Running,
    lines: BufReader<ChildStdout>,
}

impl Watch {
    fn start(service: &str, arguments: &[&str]) -> Self {
        let mut command = orbitcal(&[&["watch", "--idle", "20"], arguments].concat(), service);
        let mut process = Running::start(command.stdout(Stdio::piped()));
        let stdout = process.0.stdout.take().expect("it is piped");
        let mut watch = Self { process, lines: BufReader::new(stdout) };
        assert_eq!(watch.line(), format!("listening on {service}"));
        watch
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.lines.read_line(&mut line).expect("lines are UTF-8");
        line.trim_end().to_owned()
    }

    /// Frames that went into the next estimate; a new publisher is named before its first one.
    fn frames(&mut self) -> u64 {
        let mut line = self.line();
        if line.starts_with("from orbitcal: AGS Booster") {
            line = self.line();
        }
        let number = line.split(' ').skip_while(|word| *word != "frames").nth(1);
        number.and_then(|number| number.parse().ok()).unwrap_or_else(|| panic!("no estimate: {line:?}"))
    }

    /// Everything until its end.
    fn rest(mut self) -> String {
        let mut text = String::new();
        self.lines.read_to_string(&mut text).expect("lines are UTF-8");
        assert!(self.process.has_succeeded());
        text
    }
}

fn service(test: &str) -> String {
    format!("orbitcal/test/{}/{test}", std::process::id())
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary folders have plain names")
}

/// Replay a recording at a rate while another process watches; both keep a trace.
fn replayed_and_watched(test: &str, rate: &str, folder: &Path) -> (Vec<u8>, Vec<u8>) {
    let [seen, said]: [PathBuf; 2] = ["seen.csv", "said.csv"].map(|name| folder.join(name));
    let count = FRAMES.to_string();
    let watch = Watch::start(&service(test), &["--trace", text(&seen), "--count", &count]);
    let arguments = ["replay", "recordings/paper-vars", "--rate", rate, "--trace", text(&said), "--quiet"];
    assert!(Running::start(&mut orbitcal(&arguments, &service(test))).has_succeeded());
    let shown = watch.rest();
    assert!(shown.contains("346 estimates seen, 0 lost"), "{}", shown.lines().last().unwrap_or_default());
    [seen, said].map(|path| std::fs::read(path).expect("both traces are whole")).into()
}

#[test]
fn another_process_sees_every_estimate_at_1_khz() {
    let folder = tempfile::tempdir().unwrap();
    let (seen, said) = replayed_and_watched("every", "1000", folder.path());
    assert_eq!(said.iter().filter(|byte| **byte == b'\n').count() as u64, FRAMES + 1);
    assert!(seen == said, "the traces of the two processes differ");
}

#[test]
fn a_reader_survives_publishers_that_are_killed() {
    let mut watch = Watch::start(&service("kill"), &[]);
    let arguments = ["replay", "recordings/paper-vars", "--rate", "500", "--quiet"];
    for until in [16, 20, 50, FRAMES] {
        let mut replay = Running::start(&mut orbitcal(&arguments, &service("kill")));
        while watch.frames() != 1 {} // what the one before had sent when it was killed
        (2..=until).for_each(|expected| assert_eq!(watch.frames(), expected));
        replay.kill();
    }
}
