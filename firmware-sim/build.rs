//! What the image is made of besides code: the Green's function tables of the built-in machine, and how it is linked.
//!
//! The link arguments are said here and not in `.cargo/config.toml`, so that they hold from any folder, whatever
//! `RUSTFLAGS` says, and for no other program.

use core::fmt::Write as _;
use std::env;
use std::path::PathBuf;

use estimator::booster::Green;
use estimator::surrogate::{Block, GreenPlane};

fn main() {
    println!("cargo::rerun-if-env-changed=PART");
    println!("cargo::rerun-if-changed=../memory.x");
    println!("cargo::rerun-if-changed=memory");
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "none") {
        let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
        std::fs::write(out.join("tables.rs"), tables()).expect("the build folder can be written");
        // Another part's addresses come first: memory.x, which link.x includes, asks for them.
        if let Ok(part) = env::var("PART") {
            link(&format!("-T{}/memory/{part}.x", env!("CARGO_MANIFEST_DIR")));
        }
        link("-Tlink.x"); // cortex-m-rt: vector table and sections
        link("-Tdefmt.x"); // defmt: the texts of log lines stay in the ELF file and take no flash
        link("--nmagic"); // sections are not aligned to pages, which a chip does not have
    }
}

fn link(argument: &str) {
    println!("cargo::rustc-link-arg-bins={argument}");
}

/// The tables as a Rust value, so that they lie in flash ready for use. Floats are written with the digits that read back
/// to the same bits.
fn tables() -> String {
    let green: Green = training::green::tables(&twin::Ring::booster()).expect("the built-in ring has tables");
    assert!(green.low_rank.is_empty(), "a ring as designed needs none");
    let d = &green.dispersion;
    let mut text = String::new();
    write!(
        text,
        "Green {{ x: {}, y: {}, first_family: {}, stated_error: {:?}, low_rank: LowRank::BLANK, \
         dispersion: Dispersion {{ monitor: {:?}, node: {:?}, \
         second_order: {:?}, spurious: {:?}, compaction: {:?}, inverse_gamma_squared: {:?}, circumference: {:?} }} }}",
        plane(&green.x),
        plane(&green.y),
        green.first_family,
        green.stated_error,
        d.monitor,
        d.node,
        d.second_order,
        d.spurious,
        d.compaction,
        d.inverse_gamma_squared,
        d.circumference,
    )
    .expect("a string takes all");
    text
}

fn plane<const B: usize, const C: usize, const Q: usize, const T: usize>(plane: &GreenPlane<B, C, Q, T>) -> String {
    let mutual = &plane.mutual;
    format!(
        "GreenPlane {{ direct: {}, seen: {}, driven: {}, mutual: SymmetricBlock {{ scale: {:?}, codes: {:?} }}, \
         weight: {:?} }}",
        block(&plane.direct),
        block(&plane.seen),
        block(&plane.driven),
        mutual.scale,
        mutual.codes,
        plane.weight,
    )
}

fn block<const R: usize, const C: usize>(block: &Block<R, C>) -> String {
    format!("Block {{ scale: {:?}, codes: {:?} }}", block.scale, block.codes)
}
