//! The page is compiled in from `web/dist`, so a rebuilt page requires a rebuild.

fn main() {
    println!("cargo::rerun-if-changed=../../web/dist");
}
