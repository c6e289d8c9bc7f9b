//! A target of the crate `hostile` under libFuzzer: `TARGET=pals cargo fuzz run any -- -max_total_time=600`.
#![no_main]

use std::sync::LazyLock;

use hostile::Target;
use libfuzzer_sys::fuzz_target;

static TARGET: LazyLock<Target> = LazyLock::new(|| {
    let name = std::env::var("TARGET").expect("TARGET names one of the targets of the crate `hostile`");
    hostile::target(&name).unwrap_or_else(|| panic!("no target {name}"))
});

fuzz_target!(|input: &[u8]| _ = (TARGET.read)(input));
