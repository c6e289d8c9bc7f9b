//! EPICS, spoken by a process of its own: a kept library does it, and requests and replies pass as JSON lines.

use core::time::Duration;
use std::io::{self, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread;
use std::time::Instant;

use serde::Deserialize;
use serde_json::{Value, json};
use twin::limits::TEXT;

use crate::channel::{Channel, Control, ControlError, Sample};

/// A connection to EPICS.
pub struct Epics {
    process: Child,
    requests: Option<ChildStdin>,
    replies: Receiver<io::Result<String>>,
    asked: u64,
    /// The last request that was replied to; the replies to those before it came too late, or never.
    heard: u64,
    timeout: f64,
    began: Instant,
}

/// How much longer than a request may take the process is waited for: Python and its libraries start within a second or two [s].
const GRACE: f64 = 20.0;

/// Replies that wait to be read; a process that says more has to wait.
const WAITING: usize = 16;

/// Characters of a reply that are quoted.
const QUOTED: usize = 200;

/// How long the process may take to end by itself.
const END: Duration = Duration::from_secs(5);

#[derive(Deserialize)]
struct Reply {
    id: u64,
    #[serde(default)]
    channels: Vec<Channel>,
    #[serde(default)]
    samples: Vec<Sampled>,
    error: Option<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum Sampled {
    Sample(Sample),
    Error(String),
}

impl Epics {
    /// Start the program; every request may take so long [s].
    ///
    /// # Errors
    /// [`ControlError::Process`].
    pub fn start(program: &Path, timeout: f64) -> Result<Self, ControlError> {
        let mut command = Command::new(program);
        // in a group of its own: a Ctrl-C at the terminal must not end it before the machine is back
        command.process_group(0).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut process = command.spawn().map_err(|error| {
            ControlError::Process(format!(
                "{}: {}; `make control-env` installs it",
                program.display(),
                twin::unreadable(&error)
            ))
        })?;
        let (requests, replies) = (process.stdin.take(), process.stdout.take().expect("it is piped"));
        let (send, receive) = sync_channel(WAITING);
        // ends with the lines, or when nobody listens any more
        thread::spawn(move || TEXT.lines(BufReader::new(replies)).try_for_each(|line| send.send(line)));
        Ok(Self { process, requests, replies: receive, asked: 0, heard: 0, timeout, began: Instant::now() })
    }

    fn ask(&mut self, mut request: Value) -> Result<Reply, ControlError> {
        let gone = || ControlError::Process("the process that speaks EPICS has ended".into());
        self.asked += 1;
        request["id"] = self.asked.into();
        request["timeout_s"] = self.timeout.into();
        let requests = self.requests.as_mut().expect("open until it is dropped");
        writeln!(requests, "{request}").and_then(|()| requests.flush()).map_err(|_| gone())?;
        let deadline = Instant::now() + Duration::from_secs_f64(self.timeout + GRACE);
        loop {
            let line = match self.replies.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(Ok(line)) => line,
                Ok(Err(error)) => return Err(self.given_up(&error.to_string())),
                Err(RecvTimeoutError::Disconnected) => return Err(gone()),
                Err(RecvTimeoutError::Timeout) => {
                    let waited = self.timeout + GRACE;
                    return Err(ControlError::Process(format!(
                        "the process that speaks EPICS is silent for {waited} s"
                    )));
                }
            };
            let reply: Reply = serde_json::from_str(&line).map_err(|error| {
                let line: String = line.chars().take(QUOTED).collect();
                ControlError::Process(format!("the process that speaks EPICS said {line:?}: {error}"))
            })?;
            if !(self.heard + 1..=self.asked).contains(&reply.id) {
                let (asked, found) = (self.asked, reply.id);
                return Err(self.given_up(&format!("expected a reply to request {asked}, found one to {found}")));
            }
            self.heard = reply.id;
            if reply.id == self.asked {
                return Ok(reply);
            }
        }
    }
}

impl Epics {
    /// The process says what nobody asked for, and may go on with it: its end is not waited for.
    fn given_up(&mut self, why: &str) -> ControlError {
        let _ = self.process.kill();
        ControlError::Process(format!("the process that speaks EPICS: {why}"))
    }
}

impl Drop for Epics {
    fn drop(&mut self) {
        // the end of its input is the end of the process, and nobody listens to what it still says
        drop(self.requests.take());
        self.replies = sync_channel(0).1;
        let deadline = Instant::now() + END;
        while matches!(self.process.try_wait(), Ok(None)) && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(10));
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Control for Epics {
    fn describe(&mut self, names: &[&str]) -> Result<Vec<Channel>, ControlError> {
        let reply = self.ask(json!({"do": "describe", "channels": names}))?;
        expect_all(names, reply.channels)
    }

    fn sample(&mut self, names: &[&str]) -> Result<Vec<Result<Sample, String>>, ControlError> {
        let sampled = expect_all(names, self.ask(json!({"do": "read", "channels": names}))?.samples)?;
        let one = |sampled| match sampled {
            Sampled::Sample(sample) => Ok(sample),
            Sampled::Error(error) => Err(error),
        };
        Ok(sampled.into_iter().map(one).collect())
    }

    fn write(&mut self, name: &str, value: f64) -> Result<(), ControlError> {
        let reply = self.ask(json!({"do": "write", "channels": [name], "value": value}))?;
        let refused = |why| ControlError::Refused { channel: name.into(), value, why };
        reply.error.map_or(Ok(()), |why| Err(refused(why)))
    }

    fn now(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn pause(&mut self, seconds: f64) {
        thread::sleep(Duration::from_secs_f64(seconds));
    }
}

/// As many replies as were asked for.
fn expect_all<T>(names: &[&str], replies: Vec<T>) -> Result<Vec<T>, ControlError> {
    let (need, got) = (names.len(), replies.len());
    let wrong = || ControlError::Process(format!("the process that speaks EPICS gave {got} values of {need}"));
    (need == got).then_some(replies).ok_or_else(wrong)
}
