//! Rings of the repository.

use std::path::Path;

use twin::Ring;

/// The Booster, ten cells of one quadrupole a supply, three families.
pub fn rings() -> [Ring; 3] {
    let read = |folder: &str| {
        Ring::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings").join(folder).join("ring.json")).unwrap()
    };
    [Ring::booster(), read("ten-cells"), read("three-families")]
}
