//! Exports opened by the codes they are for, where `make exports` has installed them.

use std::path::Path;
use std::process::Command;

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn other_codes_find_the_same_tunes_and_responses() {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let python = repository.join(".venv-export/bin/python");
    if !python.exists() {
        eprintln!("exports are not opened by other codes: `make exports` installs them");
        return;
    }
    let script = repository.join("tests/peers/exports.py");
    let run = Command::new(python).arg(script).arg(env!("CARGO_BIN_EXE_orbitcal")).output().unwrap();
    let said = String::from_utf8_lossy(&run.stdout);
    assert!(run.status.success(), "{said}{}", String::from_utf8_lossy(&run.stderr));
    assert_eq!(said.lines().count(), 25, "five formats of five rings: {said}");
}
