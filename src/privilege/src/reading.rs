//! Reading what strangers have written in files that only root may read: sources of a push, what a build has left, layers.

use std::thread;

use crate::confine::confine_to_reading;
use crate::engine::is_engines;

/// Does `work` on a thread of its own that may read every file and do nothing else: of all capabilities it has
/// CAP_DAC_READ_SEARCH alone, and it has the ids of the threads that have no rights. To be called on the engine's threads, which wait; on others `work` is done where it is called.
///
/// # Panics
/// As `work` does; and where no such thread can be had, since no other may read that.
pub fn reading<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let Some(account) = is_engines() else {
        return work();
    };
    let done = thread::scope(|scope| {
        let reader = thread::Builder::new().name("reader".into());
        let reader = reader.spawn_scoped(scope, || confine_to_reading(account).map(|()| work()));
        let reader = reader.unwrap_or_else(|error| panic!("no thread can be started: {error}"));
        reader
            .join()
            .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    done.unwrap_or_else(|error| panic!("{error}"))
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::fs;
    use std::io::ErrorKind;
    use std::os::unix::fs::PermissionsExt;

    use caps::{CapSet, Capability};

    use super::*;
    use crate::{Account, Engine, blocking};

    #[tokio::test]
    async fn what_is_roots_is_read_and_nothing_else_is_done() {
        let place = tempfile::tempdir().expect("a directory");
        let secret = place.path().join("secret");
        fs::write(&secret, "root's").expect("written");
        fs::set_permissions(&secret, PermissionsExt::from_mode(0o600)).expect("set");
        let engine = Engine::start(Account::default()).expect("started");
        let work = move || {
            let before = caps::read(None, CapSet::Effective).expect("read");
            reading(|| {
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
                // What it executes cannot read even that.
                let program = std::process::Command::new("cat").arg(&secret).output();
                assert!(!program.expect("started").status.success());
            });
            let after = caps::read(None, CapSet::Effective).expect("read");
            assert_eq!(before, after, "the engine's thread");
            let broken = std::panic::catch_unwind(|| reading(|| panic!("of the work")));
            let said = broken.expect_err("it panicked");
            assert_eq!(said.downcast_ref(), Some(&"of the work"));
        };
        blocking(work).await.expect("done");
        // Where there are no rights to give up.
        assert_eq!(reading(|| thread::current().id()), thread::current().id());
        engine.end(std::time::Duration::from_secs(1));
    }
}
