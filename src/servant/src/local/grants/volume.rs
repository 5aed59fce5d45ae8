//! Volumes: a file or directory of this host that nodes may read. It is opened once, and the open descriptor is both
//! checked and mounted, so that nobody can replace it in between.

use std::fs::File;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{OFlag, OpenHow, ResolveFlag, openat2};

use super::not_allowed;
use crate::container::{Mount, OpenedSource};
use crate::grant_error::GrantError;

/// Number of retries while something is being renamed.
const AGAIN: u32 = 100;

/// Opens a volume if it lies in one of the allowed directories.
pub(super) fn open(volume: &api::Volume, allowed: &[PathBuf]) -> Result<Mount, GrantError> {
    let broken = |source| GrantError::Volume { path: volume.source.clone(), source };
    // Resolves links first, since a link must not lead out of what is allowed. From here on no link is followed.
    let source = Path::new(&volume.source).canonicalize().map_err(broken)?;
    for place in allowed {
        let Ok(root) = place.canonicalize() else {
            continue;
        };
        let Ok(below) = source.strip_prefix(&root) else {
            continue;
        };
        let opened = open_place(&root).and_then(|root| open_beneath(root.as_fd(), below)).map_err(broken)?;
        return Ok(Mount {
            source,
            target: PathBuf::from(&volume.target),
            writable: false,
            device: false,
            opened: Some(OpenedSource::new(opened)),
        });
    }
    Err(not_allowed("volume", &volume.source))
}

/// Opens an allowed path of the operator, which contains no links any more.
fn open_place(path: &Path) -> std::io::Result<OwnedFd> {
    let root = File::open("/")?;
    let below = path.strip_prefix("/").unwrap_or(path);
    open_beneath(root.as_fd(), below)
}

fn open_beneath(directory: BorrowedFd<'_>, path: &Path) -> std::io::Result<OwnedFd> {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    let how = OpenHow::new()
        .flags(OFlag::O_PATH | OFlag::O_CLOEXEC)
        .resolve(ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_SYMLINKS | ResolveFlag::RESOLVE_NO_MAGICLINKS);
    for _ in 0..AGAIN {
        match openat2(directory, path, how) {
            // Something was renamed meanwhile.
            Err(Errno::EAGAIN) => {}
            result => return Ok(result?),
        }
    }
    Err(Errno::EAGAIN.into())
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd;
    use std::os::unix::fs::symlink;

    use super::*;

    fn asks(source: PathBuf, allowed: &Path) -> Result<Mount, GrantError> {
        let volume = api::Volume { source: source.display().to_string(), target: "/models".into() };
        open(&volume, std::slice::from_ref(&allowed.to_owned()))
    }

    /// Creates a directory that is allowed, and a sibling that is not.
    fn lay_out() -> (tempfile::TempDir, PathBuf, PathBuf) {
        let place = tempfile::tempdir().expect("a directory");
        let (models, secret) = (place.path().join("models"), place.path().join("secret"));
        for directory in [&models, &secret] {
            std::fs::create_dir_all(directory.join("net")).expect("made");
            let text = directory.file_name().expect("named").to_string_lossy();
            std::fs::write(directory.join("net/weights"), &*text).expect("made");
        }
        (place, models, secret)
    }

    fn read(mount: &Mount, below: &str) -> String {
        let opened = mount.opened.as_ref().expect("opened");
        let path = format!("/proc/self/fd/{}{below}", opened.as_fd().as_raw_fd());
        std::fs::read_to_string(path).expect("read")
    }

    #[test]
    fn a_link_out_of_an_allowed_directory_is_refused() {
        let (_place, models, _) = lay_out();
        symlink("../secret", models.join("sly")).expect("made");
        symlink("net", models.join("latest")).expect("made");
        let whole = asks(models.clone(), &models).expect("allowed");
        assert!(!whole.writable);
        assert_eq!(read(&whole, "/net/weights"), "models");
        let linked = asks(models.join("latest"), &models).expect("leads to what is allowed");
        assert_eq!(linked.source, models.join("net").canonicalize().expect("there"));
        let refused = asks(models.join("sly"), &models).expect_err("leads out").to_string();
        assert!(refused.contains("[allow]"), "{refused}");
        assert!(asks(models.join("../secret"), &models).is_err());
        assert!(matches!(asks(models.join("none"), &models), Err(GrantError::Volume { .. })));
    }

    #[test]
    fn what_takes_its_place_later_is_not_what_was_opened() {
        let (place, models, secret) = lay_out();
        let net = models.join("net");
        let mount = asks(net.clone(), &models).expect("allowed");
        std::fs::rename(&net, place.path().join("moved")).expect("moved");
        symlink(secret.join("net"), &net).expect("made");
        assert_eq!(read(&mount, "/weights"), "models");
    }

    #[test]
    fn a_link_that_appears_on_the_way_is_not_followed() {
        let (place, models, secret) = lay_out();
        let root = open_place(&models.canonicalize().expect("there")).expect("opened");
        std::fs::rename(models.join("net"), place.path().join("moved")).expect("moved");
        symlink(&secret, models.join("net")).expect("made");
        for path in ["net", "net/weights", "../secret", "/etc"] {
            open_beneath(root.as_fd(), Path::new(path)).expect_err(path);
        }
    }
}
