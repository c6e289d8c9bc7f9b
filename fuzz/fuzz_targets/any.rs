//! A target of the crate `hostile` under libFuzzer, which keeps what reaches new code: `TARGET=pals any FOLDER [OPTION]...`, `make libfuzzer`.
#![no_main]

use std::sync::LazyLock;
use std::{env, fs};

use hostile::{Target, attack, target};
use libfuzzer_sys::fuzz_target;

static TARGET: LazyLock<Target> = LazyLock::new(|| {
    let name = env::var("TARGET").expect("TARGET names one of the targets of the crate `hostile`");
    target(&name).unwrap_or_else(|| panic!("no target {name}"))
});

/// Good inputs in the folder that libFuzzer begins with.
fn sow() {
    let folder = env::args().nth(1).expect("a folder");
    fs::create_dir_all(&folder).expect("room for a folder");
    for (number, seed) in (TARGET.seeds)().iter().enumerate() {
        fs::write(format!("{folder}/seed-{number}"), seed).expect("room for a file");
    }
}

fuzz_target!(init: sow(), |input: &[u8]| {
    attack(&TARGET, input).expect("no panic, and 300 MB at most");
});
