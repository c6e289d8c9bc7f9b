//! What the image is made of besides code: sizes and tables of its machine, the built-in one or that of the file `MACHINE`,
//! and how it is linked.
//!
//! The link arguments are said here and not in `.cargo/config.toml`, so that they hold from any folder, whatever
//! `RUSTFLAGS` says, and for no other program.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

use estimator::surrogate::{Pass, Plain};
use training::Tables;
use training::network::PLANES;
use twin::Ring;

fn main() {
    println!("cargo::rerun-if-env-changed=MACHINE");
    println!("cargo::rerun-if-changed=../memory.x");
    match machine() {
        Ok((ring, tables)) => write(&ring, &tables),
        Err(error) => println!("cargo::error={error}"),
    }
    digests();
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "none") {
        link("-Tlink.x"); // cortex-m-rt: vector table and sections
        link("-Tdefmt.x"); // defmt: the texts of log lines stay in the ELF file and take no flash
        link("--nmagic"); // sections are not aligned to pages, which a chip does not have
    }
}

/// What the networks of the Booster arrive at on the host.
fn digests() {
    let mut pass = Pass::BLANK;
    let digests = PLANES.map(|network| network.digest::<Plain>(&mut pass));
    let source = format!("/// Digests of the networks in x and y.\npub const DIGESTS: [u32; 2] = {digests:?};\n");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("network.rs"), source).expect("the build folder can be written");
}

fn link(argument: &str) {
    println!("cargo::rustc-link-arg-bins={argument}");
}

/// The machine of the image, and its tables. A path is taken from the workspace's folder, where `make` runs.
fn machine() -> Result<(Ring, Tables), Box<dyn core::error::Error>> {
    let ring = match env::var_os("MACHINE").filter(|file| !file.is_empty()) {
        Some(file) => {
            let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(file);
            println!("cargo::rerun-if-changed={}", file.display());
            Ring::read(&file)?
        }
        None => Ring::booster(),
    };
    let tables = training::green::tables(&ring)?;
    Ok((ring, tables))
}

/// Sizes and tables as Rust, so that the tables lie in flash ready for use.
fn write(ring: &Ring, tables: &Tables) {
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let [bx, by, cx, cy, quadrupoles, params, supplies] = tables.sizes().all();
    let numbers = format!(
        "{bx} + {by} monitors, {cx} + {cy} correctors, {quadrupoles} quadrupoles, {params} params and {supplies} supplies"
    );
    let too_large = format!("{}: the core of {numbers} does not fit the RAM that memory.x grants", ring.name);
    let machine = format!("{}\npub const TOO_LARGE: &str = {too_large:?};\n", tables.machine_source());
    fs::write(out.join("machine.rs"), machine).expect("the build folder can be written");
    fs::write(out.join("tables.rs"), tables.source()).expect("the build folder can be written");
}
