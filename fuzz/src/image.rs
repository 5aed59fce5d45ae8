//! Archives that are pushed, and images that other tools have saved.

use std::fs;
use std::path::Path;

use ::image::{Limits, Store, unpack};
use foreign::Tree;
use tempfile::TempDir;

/// Limits of an archive here.
const LIMITS: Limits = Limits { entries: 64, bytes: 1 << 20, path: 256 };

/// A tar archive, compressed or not.
pub fn archive(data: &[u8]) {
    let place = tempfile::tempdir().expect("a directory");
    let to = place.path().join("to");
    match unpack(data, &to, &LIMITS) {
        Ok(stats) => assert!(stats.entries <= LIMITS.entries && stats.bytes <= LIMITS.bytes, "{stats:?}"),
        Err(_) => assert!(!to.exists(), "what was refused is removed"),
    }
    let beside = fs::read_dir(place.path()).expect("it is there").flatten().filter(|entry| entry.path() != to);
    assert_eq!(beside.count(), 0, "something lies outside of it");
}

thread_local! {
    /// A store, and the directory that it is in.
    static STORE: (Store, TempDir) = {
        let place = tempfile::tempdir().expect("a directory");
        let store = Store::open(&place.path().join("images"), &place.path().join("layers")).expect("a store");
        (store, place)
    };
}

/// The list of an unpacked archive, as docker (`[…]`) or the OCI image layout have it, and a configuration after a zero
/// byte.
pub fn saved_image(data: &[u8]) {
    let place = tempfile::tempdir().expect("a directory");
    let mut parts = data.splitn(2, |byte| *byte == 0);
    let (list, config) = (parts.next().unwrap_or_default(), parts.next().unwrap_or_default());
    let write = |name: &str, bytes: &[u8]| fs::write(place.path().join(name), bytes).expect("written");
    write("config.json", config);
    if list.trim_ascii_start().starts_with(b"[") {
        write("manifest.json", list);
    } else {
        write("oci-layout", br#"{"imageLayoutVersion": "1.0.0"}"#);
        write("index.json", list);
    }
    receive(place.path());
}

fn receive(archive: &Path) {
    let archive = Tree::open(archive).expect("a directory");
    STORE.with(|(store, _)| {
        let _ = store.receive_saved(&archive, &LIMITS);
    });
}
