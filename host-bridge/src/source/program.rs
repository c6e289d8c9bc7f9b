//! A process that speaks to a control system, and gives raw frames on its stdout: started, told what to gather, and ended with the line.

use core::time::Duration;
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command};
use std::thread;
use std::time::Instant;

/// How long a process may take to end by itself.
const END: Duration = Duration::from_secs(2);

/// How it is started.
#[derive(Debug, Clone)]
pub struct Program {
    /// Its path, or its name where `PATH` has it.
    pub path: PathBuf,
    /// The line that it is told first.
    pub request: String,
}

impl Program {
    /// Start it.
    ///
    /// # Errors
    /// What the system says of it.
    pub fn start(&self) -> io::Result<Running> {
        let (mut line, theirs) = UnixStream::pair()?;
        let theirs = OwnedFd::from(theirs);
        // in a group of its own: a Ctrl-C at the terminal is the daemon's to answer
        let mut command = Command::new(&self.path);
        let process = command.process_group(0).stdin(theirs.try_clone()?).stdout(theirs).spawn();
        // the process has the other end now, and nobody else
        drop(command);
        let process = process.map_err(|error| {
            let why = format!(
                "{}: {error}; `make control-env` installs it, source.program names another",
                self.path.display()
            );
            io::Error::new(error.kind(), why)
        })?;
        let running = Running { process, line: line.try_clone()? };
        line.write_all(self.request.as_bytes())?;
        Ok(running)
    }
}

/// The process, and the line from it.
#[derive(Debug)]
pub struct Running {
    process: Child,
    /// What is read from it.
    pub line: UnixStream,
}

impl Read for Running {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.line.read(into)
    }
}

impl Running {
    /// End its input, which is the end of the process; one that takes longer than this is killed. True if it ended by itself.
    fn end(&mut self, patience: Duration) -> bool {
        let _ = self.line.shutdown(std::net::Shutdown::Both);
        let deadline = Instant::now() + patience;
        while matches!(self.process.try_wait(), Ok(None)) && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(10));
        }
        let has_ended = matches!(self.process.try_wait(), Ok(Some(_)));
        let _ = self.process.kill();
        let _ = self.process.wait();
        has_ended
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end(END);
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn program(folder: &tempfile::TempDir, script: &str) -> Program {
        let path = folder.path().join("program");
        fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        Program { path, request: "the channels\n".into() }
    }

    #[test]
    fn what_it_is_told_and_what_it_says_pass_and_its_end_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let mut running = program(&folder, "read line; printf '%s' \"$line!\"").start().unwrap();
        let mut heard = String::new();
        running.read_to_string(&mut heard).unwrap();
        assert_eq!(heard, "the channels!");
    }

    #[test]
    fn one_that_goes_on_ends_with_the_line() {
        let folder = tempfile::tempdir().unwrap();
        let mut running = program(&folder, "read line; cat > /dev/null").start().unwrap();
        let id = running.process.id();
        assert!(running.end(Duration::from_secs(60)), "it was killed");
        assert!(!std::path::Path::new(&format!("/proc/{id}")).exists());
    }

    #[test]
    fn one_that_does_not_end_is_killed() {
        let folder = tempfile::tempdir().unwrap();
        let mut running = program(&folder, "read line; exec sleep 600").start().unwrap();
        assert!(!running.end(Duration::ZERO));
    }

    #[test]
    fn one_that_is_not_there_is_named() {
        let error = Program { path: "no/such/program".into(), request: String::new() }.start().unwrap_err();
        assert!(error.to_string().starts_with("no/such/program: No such file"), "{error}");
    }
}
