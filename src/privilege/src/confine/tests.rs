use std::fs::File;
use std::io::ErrorKind;
use std::os::unix::fs::PermissionsExt;
use std::thread;

use super::*;

/// Returns a field of `/proc/thread-self/status`.
fn status(name: &str) -> String {
    let text = std::fs::read_to_string("/proc/thread-self/status").expect("readable by its thread");
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    let words: Vec<&str> = line.expect(name).trim_start_matches(':').split_whitespace().collect();
    words.join(" ")
}

fn on_a_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    thread::spawn(work).join().expect("no panic")
}

#[test]
fn a_confined_thread_has_no_rights_and_others_keep_theirs() {
    let place = tempfile::tempdir().expect("a directory");
    let secret = place.path().join("secret");
    std::fs::write(&secret, "root's").expect("written");
    // Anybody may enter the directory: only the file is protected.
    let enter = PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(place.path(), enter).expect("set");
    std::fs::set_permissions(&secret, PermissionsExt::from_mode(0o600)).expect("set");
    let before = status("CapEff");
    let (path, opened) = (secret.clone(), File::open(&secret).expect("root's"));
    on_a_thread(move || {
        confine(Account::default()).expect("confined");
        for set in ["CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"] {
            assert_eq!(status(set), "0000000000000000", "{set}");
        }
        let number = DEFAULT_USER.to_string();
        let four = [number.as_str(); 4].join(" ");
        assert_eq!(status("Uid"), four, "real, effective, saved, of files");
        assert_eq!(status("Gid"), four);
        assert_eq!(status("Groups"), "");
        assert_eq!(status("NoNewPrivs"), "1");
        let refused = File::open(&path).expect_err("root's");
        assert_eq!(refused.kind(), ErrorKind::PermissionDenied);
        // There is no way back.
        // SAFETY: no pointers.
        assert_ne!(unsafe { libc::syscall(libc::SYS_setresuid, 0, 0, 0) }, 0);
        let program = std::process::Command::new("cat").arg(&path).output();
        assert!(!program.expect("started").status.success(), "a program reads it");
        // A file that was opened before can still be read.
        assert_eq!(std::io::read_to_string(opened).expect("open"), "root's");
        // Threads that it starts are confined as well, and confining them again does nothing.
        let again = on_a_thread(|| (status("CapBnd"), confine(Account::default())));
        assert_eq!(again.0, "0000000000000000");
        again.1.expect("confined already");
    });
    assert_eq!(status("CapEff"), before, "another thread");
    File::open(&secret).expect("root's");
}

#[test]
fn a_limited_thread_has_what_is_kept_and_cannot_get_the_rest_back() {
    on_a_thread(|| {
        limit_capabilities().expect("limited");
        let held = caps::read(None, CapSet::Permitted).expect("read");
        let kept: CapsHashSet = KEPT_CAPABILITIES.into_iter().chain([KEPT_IF_THERE]).collect();
        assert!(held.is_subset(&kept), "{held:?}");
        assert!(held.contains(&Capability::CAP_SYS_ADMIN), "run as root");
        let bounding = caps::read(None, CapSet::Bounding).expect("read");
        assert!(bounding.is_subset(&kept), "{bounding:?}");
        retain_capabilities(&[Capability::CAP_KILL]).expect("limited");
        let held = caps::read(None, CapSet::Effective).expect("read");
        assert_eq!(held, CapsHashSet::from([Capability::CAP_KILL]));
    });
}

#[test]
fn an_account_is_somebody_but_root() {
    let account = |user, group| Account { user, group };
    assert_eq!(Account::find("4711").expect("a number"), account(4711, 4711));
    let nobody = Account::find("nobody").expect("on every machine");
    assert!(nobody.user > 0 && nobody.group > 0, "{nobody:?}");
    for written in ["root", "0", "4294967295", "no such user", ""] {
        let refused = Account::find(written).expect_err(written).to_string();
        assert!(refused.contains("portal_user"), "{refused}");
    }
}

#[test]
fn the_unit_allows_what_is_kept_and_no_more() {
    let unit = include_str!("../../../../systemd/cloudroid.service");
    let lines = unit.lines();
    let named: CapsHashSet = lines
        .filter_map(|line| line.strip_prefix("CapabilityBoundingSet="))
        .flat_map(str::split_whitespace)
        .map(|name| name.parse().expect(name))
        .collect();
    let kept: CapsHashSet = KEPT_CAPABILITIES.into_iter().chain([KEPT_IF_THERE]).collect();
    assert_eq!(named, kept);
}
