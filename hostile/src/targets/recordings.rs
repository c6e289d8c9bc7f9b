//! Recordings and the machines that they are of.

use std::path::Path;
use std::sync::LazyLock;

use inference::Recording;
use results::CheckResult;
use twin::{Hold, Optics, Ring};
use validation::Truth;

use super::{Target, file, text, with_file};

pub(super) const TARGETS: [Target; 4] = [
    Target { name: "machine", seeds: || machines().to_vec(), read: machine },
    Target { name: "header", seeds: headers, read: |bytes| recording(bytes, FRAMES.as_bytes()) },
    Target {
        name: "frames_csv",
        seeds: || vec![FRAMES.as_bytes().to_vec()],
        read: |bytes| recording(HEADER.as_bytes(), bytes),
    },
    Target { name: "truth", seeds: || vec![file("recordings/concealed/open-10/truth.json")], read: truth },
];

static RING: LazyLock<Ring> = LazyLock::new(Ring::paper_booster);
static HEADER: LazyLock<String> = LazyLock::new(|| text("recordings/former/paper-vars/header.toml"));
/// The first frames: what may be wrong with one does not need more.
static FRAMES: LazyLock<String> =
    LazyLock::new(|| text("recordings/former/paper-vars/frames.csv").split_inclusive('\n').take(40).collect());

fn machines() -> [Vec<u8>; 4] {
    [
        "machines/booster-deck.json",
        "machines/booster.json",
        "recordings/ten-cells/ring.json",
        "recordings/three-families/ring.json",
    ]
    .map(file)
}

fn headers() -> Vec<Vec<u8>> {
    vec![HEADER.as_bytes().to_vec(), file("recordings/concealed/open-10/header.toml")]
}

fn machine(bytes: &[u8]) -> bool {
    let Ok(text) = core::str::from_utf8(bytes) else { return false };
    let tunes = |ring| Optics::of(&ring, Hold::Momentum { delta: 0.0 }).and_then(|optics| optics.tunes()).is_ok();
    Ring::parse(text, "machine").is_ok_and(tunes)
}

/// As `orbitcal check`.
fn recording(header: &[u8], frames: &[u8]) -> bool {
    let texts = core::str::from_utf8(header).ok().zip(core::str::from_utf8(frames).ok());
    let Some((header, frames)) = texts else { return false };
    let recording = Recording::parse(Path::new("recording"), &RING, header, frames);
    recording
        .is_ok_and(|recording| CheckResult::of(&RING, &recording).is_ok_and(|result| !result.to_string().is_empty()))
}

fn truth(bytes: &[u8]) -> bool {
    with_file("truth.json", bytes, |path| Truth::read(path.parent().expect("it is in a folder"), &RING).is_ok())
}
