//! `make fuzz`: mutated good files and packets for each target, or for those that are named.
//!
//! `hostile COUNT [TARGET]...` reads so many inputs a target and says of each target how many took how long. What is wrong is said with
//! the number of its input, which is left in `target/hostile`; so is an input that ends the process. Inputs beyond 2 s are named too.

use core::time::Duration;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Instant;
use std::{env, fs, process, thread};

use hostile::{Mutator, Target, attack, repository, target, targets};

/// Longest time for an input.
const SLOW: Duration = Duration::from_secs(2);
/// After which it is given up.
const HANG: Duration = Duration::from_secs(20);

fn main() -> ExitCode {
    let mut arguments = env::args().skip(1);
    let count = arguments.next().and_then(|count| count.parse().ok()).expect("usage: hostile COUNT [TARGET]...");
    let named: Vec<String> = arguments.collect();
    let faults = match named.as_slice() {
        [name] => target(name).map_or(1, |target| run(&target, count)),
        [] => targets().filter(|target| !survives(target.name, count)).count(),
        several => several.iter().filter(|name| !survives(name, count)).count(),
    };
    if faults == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// A target in a process of its own: an overflow of the stack ends that alone.
fn survives(name: &str, count: u64) -> bool {
    let program = env::current_exe().expect("it runs");
    let status = Command::new(program).args([&count.to_string(), name]).status().expect("it has run before");
    if !status.success() {
        println!("{name}: {status}");
    }
    status.success()
}

/// Returns the number of faults.
fn run(target: &Target, count: u64) -> usize {
    let folder = repository().join("target/hostile");
    fs::create_dir_all(&folder).expect("target is there");
    let current = folder.join(format!("{}-current", target.name));
    let (began, mut faults, mut slowest) = (Instant::now(), 0, Duration::ZERO);
    let mutator = Mutator::new((target.seeds)());
    let (progress, watched) = channel();
    let (name, file) = (target.name, current.clone());
    thread::spawn(move || watch(name, &watched, &file));
    for number in 0..count {
        let input = mutator.input(number);
        fs::write(&current, &input).expect("room for a file");
        let what = match attack(target, &input) {
            Ok(took) if took <= SLOW => {
                slowest = slowest.max(took);
                None
            }
            Ok(took) => Some(format!("{:.1} s", took.as_secs_f64())),
            Err(fault) => Some(format!("{fault:?}")),
        };
        if let Some(what) = what {
            faults += 1;
            println!("{name}: input {number}: {what}: {}", kept(&current, number).display());
        }
        progress.send(()).expect("it is watched");
    }
    fs::remove_file(&current).expect("it was written");
    let seconds = began.elapsed().as_secs_f64();
    println!("{name}: {count} inputs in {seconds:.1} s, slowest {:.3} s, {faults} faults", slowest.as_secs_f64());
    faults
}

fn kept(current: &Path, number: u64) -> PathBuf {
    let to = PathBuf::from(current.to_string_lossy().replace("-current", &format!("-{number}")));
    fs::copy(current, &to).expect("room for a file");
    to
}

/// End the process when an input takes too long.
fn watch(name: &str, progress: &Receiver<()>, current: &Path) {
    loop {
        match progress.recv_timeout(HANG) {
            Ok(()) => {}
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {
                println!("{name}: longer than {HANG:?}: {}", current.display());
                process::exit(1);
            }
        }
    }
}
