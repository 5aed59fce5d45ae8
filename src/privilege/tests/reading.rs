//! Tests of readers, in their own process, since a process has one engine.

use std::collections::HashSet;
use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::PermissionsExt;
use std::thread;

use caps::{CapSet, Capability};
use privilege::{Account, Engine, run_as_reader, spawn_blocking};

#[test]
fn what_is_roots_is_read_and_nothing_else_is_done() {
    let place = tempfile::tempdir().expect("a directory");
    let secret = place.path().join("secret");
    fs::write(&secret, "root's").expect("written");
    fs::set_permissions(&secret, PermissionsExt::from_mode(0o600)).expect("set");
    let engine = Engine::start(Account::default()).expect("started");
    let work = move || {
        let before = caps::read(None, CapSet::Effective).expect("read");
        run_as_reader(|| {
            let all = [CapSet::Effective, CapSet::Permitted, CapSet::Bounding];
            for set in all {
                let held = caps::read(None, set).expect("read");
                assert_eq!(held, HashSet::from([Capability::CAP_DAC_READ_SEARCH]));
            }
            assert_ne!(nix::unistd::geteuid().as_raw(), 0);
            assert_eq!(fs::read_to_string(&secret).expect("readable"), "root's");
            let refused = fs::write(&secret, "changed").expect_err("not to be written");
            assert_eq!(refused.kind(), ErrorKind::PermissionDenied);
            let refused = fs::remove_file(&secret).expect_err("not to be removed");
            assert_eq!(refused.kind(), ErrorKind::PermissionDenied);
            // A program that it executes cannot read even that.
            let program = std::process::Command::new("cat").arg(&secret).output();
            assert!(!program.expect("started").status.success());
        });
        let after = caps::read(None, CapSet::Effective).expect("read");
        assert_eq!(before, after, "the engine's thread");
        let broken = std::panic::catch_unwind(|| run_as_reader(|| panic!("of the work")));
        let said = broken.expect_err("it panicked");
        assert_eq!(said.downcast_ref(), Some(&"of the work"));
    };
    let others = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
    others.block_on(async { spawn_blocking(work).await.expect("done") });
    // Without privileges to drop, the work runs on the calling thread.
    assert_eq!(run_as_reader(|| thread::current().id()), thread::current().id());
    engine.end(std::time::Duration::from_secs(1));
}
