//! How the image is linked. Its machine and tables are those of `firmware-sim`.

fn main() {
    println!("cargo::rerun-if-changed=memory.x");
    for argument in ["-Tlink.x", "-Tdefmt.x", "--nmagic"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
}
