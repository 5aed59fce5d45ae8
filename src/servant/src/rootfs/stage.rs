//! The directory where a root is assembled, and idmapped mounts of its layers.

use std::fs;
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, MsFlags, mount, umount2};
use nix::sched::{CloneFlags, unshare};

use super::make_directory;
use crate::container::Mount;
use crate::{Error, sys};

/// A directory that exists on every host, that every user can reach, and that must be covered anyway.
const STAGE: &str = "/sys/fs/cgroup";

/// Moves the calling process to a new mount namespace in which `/sys/fs/cgroup` is an empty tmpfs, and no cgroup is
/// mounted any more.
///
/// This prevents libcontainer from using cgroups: only we create, limit and remove them. It is also a safety measure:
/// when a creation fails, libcontainer kills everything in the cgroup that it takes for the container's, which on
/// cgroup v1 can be the root of a hierarchy, with the host's processes (0.7.0, `cleanup_container`).
pub(super) fn enter_mount_namespace() -> Result<PathBuf, Error> {
    unshare(CloneFlags::CLONE_NEWNS).map_err(Error::nix("unshare of a mount namespace"))?;
    let private = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
    mount(None::<&str>, "/", None::<&str>, private, None::<&str>).map_err(Error::nix("making mounts private"))?;
    let points = || {
        let table = fs::read_to_string("/proc/self/mountinfo").map_err(Error::file("read", "/proc/self/mountinfo"))?;
        Ok::<_, Error>(cgroup_mounts(&table))
    };
    // The deepest first: a mount with others inside is busy.
    for point in points()?.into_iter().rev() {
        umount2(&point, MntFlags::MNT_DETACH)
            .map_err(|error| Error::file("hide the cgroups at", &point)(error.into()))?;
    }
    if let Some(left) = points()?.first() {
        let reason = "a cgroup mount cannot be hidden from the creation of a container".into();
        return Err(Error::Malformed { path: left.clone(), reason });
    }
    mount(Some("cloudroid"), STAGE, Some("tmpfs"), MsFlags::MS_NODEV, Some("mode=755,size=1m"))
        .map_err(|error| Error::file("cover", STAGE)(error.into()))?;
    Ok(STAGE.into())
}

/// Returns the mount points of cgroup file systems, in mount order.
fn cgroup_mounts(mountinfo: &str) -> Vec<PathBuf> {
    let point = |line: &str| {
        let (left, right) = line.split_once(" - ")?;
        right.starts_with("cgroup").then(|| left.split(' ').nth(4).map(PathBuf::from)).flatten()
    };
    mountinfo.lines().filter_map(point).collect()
}

/// Attaches a read-only, idmapped copy of `layer` at `place`.
pub(super) fn attach_shifted(layer: &Path, place: &Path, shift: &OwnedFd) -> Result<(), Error> {
    let copy = sys::clone_mount(layer).map_err(Error::file("open the layer", layer))?;
    sys::idmap_mount(copy.as_fd(), shift.as_fd()).map_err(|source| {
        let unsupported = matches!(source.raw_os_error(), Some(libc::EINVAL | libc::ENOSYS | libc::EOPNOTSUPP));
        if !unsupported {
            return Error::file("shift the ids of", layer)(source);
        }
        Error::IdmapUnsupported { path: layer.into(), filesystem: filesystem_of(layer), source }
    })?;
    sys::attach_mount(copy.as_fd(), place).map_err(Error::file("attach a layer at", place))
}

/// Returns a detached copy of a mount's source: of the open file or directory itself, if there is one.
pub(super) fn copy_volume(volume: &Mount) -> Result<OwnedFd, Error> {
    let copy = match &volume.opened {
        Some(opened) => sys::clone_mount_of(opened.as_fd()),
        None => sys::clone_mount(&volume.source),
    };
    copy.map_err(Error::file("mount", &volume.source))
}

/// Attaches the copy of a mount's source for the container. A read-only volume is idmapped if its file system supports
/// it, so that root in the container may read root's files; a writable one never is, since root in the container would
/// then write as root.
pub(super) fn attach_volume(volume: &Mount, copy: &OwnedFd, place: &Path, shift: &OwnedFd) -> Result<(), Error> {
    let is_directory = volume.is_directory();
    if is_directory.map_err(Error::file("mount", &volume.source))? {
        make_directory(place)?;
    } else {
        fs::write(place, "").map_err(Error::file("make", place))?;
    }
    if !volume.writable {
        // All or nothing: if the file system does not support it, the copy is unchanged.
        let _ = sys::idmap_mount(copy.as_fd(), shift.as_fd());
    }
    sys::attach_mount(copy.as_fd(), place).map_err(Error::file("attach a volume at", place))
}

/// Returns the type of the file system that holds `path`, from the mount table.
fn filesystem_of(path: &Path) -> String {
    let table = fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    let path = path.canonicalize().unwrap_or_else(|_| path.into());
    let holds = |line: &str| {
        let (left, right) = line.split_once(" - ")?;
        let point = left.split(' ').nth(4)?.to_owned();
        path.starts_with(&point).then(|| (point.len(), right.split(' ').next().unwrap_or("").to_owned()))
    };
    // Among mounts at the same path the last one is visible.
    let found = table.lines().filter_map(holds).max_by_key(|(length, _)| *length);
    found.map_or_else(|| "an unknown filesystem".into(), |(_, kind)| kind)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_cgroup_mount_is_found() {
        let table = "30 24 0:26 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n\
                     31 24 0:27 / /c2 rw x:1 - cgroup2 c rw\n32 1 0:1 / / rw - ext4 /dev/a rw\n";
        assert_eq!(cgroup_mounts(table), [Path::new("/sys/fs/cgroup/cpu"), Path::new("/c2")]);
    }

    #[test]
    fn the_filesystem_of_a_path_is_named() {
        assert_eq!(filesystem_of(Path::new("/proc/self/status")), "proc");
    }
}
