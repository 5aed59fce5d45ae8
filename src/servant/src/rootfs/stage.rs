//! The place where a root is put together, and what lets layers belong to other users there.

use std::fs;
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, MsFlags, mount, umount2};
use nix::sched::{CloneFlags, unshare};

use super::make_directory;
use crate::container::Mount;
use crate::{Error, sys};

/// A directory that every host has and every user can reach, and that must be covered anyway.
const STAGE: &str = "/sys/fs/cgroup";

/// Moves the calling process to a mount namespace of its own in which `/sys/fs/cgroup` is an empty tmpfs, and nothing is a
/// cgroup mount any more.
///
/// So libcontainer has no cgroup to act on: ours is made, limited and removed by us alone. This is a matter of safety, too. When
/// a creation fails, libcontainer kills whatever it finds in the cgroup that it takes for the container's, and on cgroup
/// v1 that can be the root of a hierarchy, with the host's processes (0.7.0, `cleanup_container`).
pub(super) fn enter() -> Result<PathBuf, Error> {
    unshare(CloneFlags::CLONE_NEWNS).map_err(Error::nix("unshare of a mount namespace"))?;
    let private = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
    mount(None::<&str>, "/", None::<&str>, private, None::<&str>)
        .map_err(Error::nix("making mounts private"))?;
    let points = || {
        let table = fs::read_to_string("/proc/self/mountinfo")
            .map_err(Error::file("read", "/proc/self/mountinfo"))?;
        Ok::<_, Error>(cgroup_mounts(&table))
    };
    // The deepest first: a mount with others in it is busy.
    for point in points()?.into_iter().rev() {
        umount2(&point, MntFlags::MNT_DETACH)
            .map_err(|error| Error::file("hide the cgroups at", &point)(error.into()))?;
    }
    if let Some(left) = points()?.first() {
        let reason = "a cgroup mount cannot be hidden from the creation of a container".into();
        return Err(Error::Malformed {
            path: left.clone(),
            reason,
        });
    }
    mount(
        Some("cloudroid"),
        STAGE,
        Some("tmpfs"),
        MsFlags::MS_NODEV,
        Some("mode=755,size=1m"),
    )
    .map_err(|error| Error::file("cover", STAGE)(error.into()))?;
    Ok(STAGE.into())
}

/// Where cgroup filesystems are mounted, in the order of their mounting.
fn cgroup_mounts(mountinfo: &str) -> Vec<PathBuf> {
    let point = |line: &str| {
        let (left, right) = line.split_once(" - ")?;
        right
            .starts_with("cgroup")
            .then(|| left.split(' ').nth(4).map(PathBuf::from))
            .flatten()
    };
    mountinfo.lines().filter_map(point).collect()
}

/// Attaches a read-only copy of `layer` at `place` whose ids are shifted.
pub(super) fn attach_shifted(layer: &Path, place: &Path, shift: &OwnedFd) -> Result<(), Error> {
    let copy = sys::clone_mount(layer).map_err(Error::file("open the layer", layer))?;
    sys::shift_mount(copy.as_fd(), shift.as_fd()).map_err(|source| {
        let unsupported = matches!(
            source.raw_os_error(),
            Some(libc::EINVAL | libc::ENOSYS | libc::EOPNOTSUPP)
        );
        if !unsupported {
            return Error::file("shift the ids of", layer)(source);
        }
        Error::IdmapUnsupported {
            path: layer.into(),
            filesystem: filesystem_of(layer),
            source,
        }
    })?;
    sys::attach_mount(copy.as_fd(), place).map_err(Error::file("attach a layer at", place))
}

/// A detached copy of what is to be mounted: of the very file or directory that was opened, where one was.
pub(super) fn copy_volume(volume: &Mount) -> Result<OwnedFd, Error> {
    let copy = match &volume.opened {
        Some(opened) => sys::clone_opened(opened.as_fd()),
        None => sys::clone_mount(&volume.source),
    };
    copy.map_err(Error::file("mount", &volume.source))
}

/// Attaches the copy of what is to be mounted into the container. A read-only volume has shifted ids where its filesystem
/// can, so that inside root may read what belongs to root; a writable one never, lest root inside write as root.
pub(super) fn attach_volume(
    volume: &Mount,
    copy: &OwnedFd,
    place: &Path,
    shift: &OwnedFd,
) -> Result<(), Error> {
    let is_directory = volume.is_directory();
    if is_directory.map_err(Error::file("mount", &volume.source))? {
        make_directory(place)?;
    } else {
        fs::write(place, "").map_err(Error::file("make", place))?;
    }
    if !volume.writable {
        // All or nothing: a filesystem that cannot leaves the copy as it was.
        let _ = sys::shift_mount(copy.as_fd(), shift.as_fd());
    }
    sys::attach_mount(copy.as_fd(), place).map_err(Error::file("attach a volume at", place))
}

/// The type of the filesystem that holds `path`, from the mount table.
fn filesystem_of(path: &Path) -> String {
    let table = fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    let path = path.canonicalize().unwrap_or_else(|_| path.into());
    let holds = |line: &str| {
        let (left, right) = line.split_once(" - ")?;
        let point = left.split(' ').nth(4)?.to_owned();
        path.starts_with(&point).then(|| {
            (
                point.len(),
                right.split(' ').next().unwrap_or("").to_owned(),
            )
        })
    };
    // Of mounts at the same place the last is the visible one.
    let found = table
        .lines()
        .filter_map(holds)
        .max_by_key(|(length, _)| *length);
    found.map_or_else(|| "an unknown filesystem".into(), |(_, kind)| kind)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_cgroup_mount_is_found() {
        let table = "30 24 0:26 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n31 24 0:27 / /c2 rw x:1 - cgroup2 c rw\n32 1 0:1 / / rw - ext4 /dev/a rw\n";
        assert_eq!(
            cgroup_mounts(table),
            [Path::new("/sys/fs/cgroup/cpu"), Path::new("/c2")]
        );
    }

    #[test]
    fn the_filesystem_of_a_path_is_named() {
        assert_eq!(filesystem_of(Path::new("/proc/self/status")), "proc");
    }
}
