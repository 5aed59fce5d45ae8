//! The page is built in from `web/dist`: a page that is built anew is a reason to compile.

fn main() {
    println!("cargo::rerun-if-changed=../../web/dist");
}
