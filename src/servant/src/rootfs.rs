//! The root of a servant: its layers, each with shifted ids, under one overlay. Made in a mount namespace of the
//! creating process's own, so that nothing shows on the host and nothing can be left behind.
//!
//! Only the lower layers are shifted: an upper directory whose mount is shifted makes the overlay read-only, and a shifted
//! overlay is refused (kernel 6.1 to 6.18). The upper directory belongs to the servant's root instead.

use std::fs;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Component, Path, PathBuf};

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};
use nix::sys::wait::waitpid;
use nix::unistd::{ForkResult, Gid, Uid};

use crate::Error;
use crate::spec::Mount;
use crate::sys;

/// Ids of the user that compiles, inside.
pub const COMPILE_USER: u32 = 1000;

/// What a root is made of.
#[derive(Debug, Clone, Copy)]
pub struct Rootfs<'a> {
    /// The servant's state directory: mount points are made in it.
    pub directory: &'a Path,
    /// Lowest first.
    pub layers: &'a [PathBuf],
    /// On top of them: mount points, hosts, hostname.
    pub skeleton: &'a Path,
    /// Where changes go; none for a read-only root.
    pub upper: Option<&'a Path>,
    /// First host uid (= gid) and how many.
    pub uid_range: (u32, u32),
}

impl Rootfs<'_> {
    /// Mounts it and tells where. The calling process must have one thread: it moves to a mount namespace of its own
    /// and changes its working directory.
    pub fn mount(&self) -> Result<PathBuf, Error> {
        unshare(CloneFlags::CLONE_NEWNS).map_err(Error::nix("unshare of a mount namespace"))?;
        let private = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
        mount(None::<&str>, "/", None::<&str>, private, None::<&str>)
            .map_err(Error::nix("making mounts private"))?;
        let shift = user_namespace(self.uid_range)?;
        let lower = self.directory.join("lower");
        let target = self.directory.join("rootfs");
        for path in [&lower, &target] {
            make_directory(path)?;
        }
        // The names are short because all of them together must fit into one page.
        let all = self
            .layers
            .iter()
            .map(PathBuf::as_path)
            .chain([self.skeleton]);
        let mut names = Vec::new();
        for (index, layer) in all.enumerate() {
            let place = lower.join(index.to_string());
            make_directory(&place)?;
            shift_layer(layer, &place, &shift)?;
            names.insert(0, index.to_string());
        }
        let mut options = format!("lowerdir={},redirect_dir=off,metacopy=off", names.join(":"));
        let mut flags = MsFlags::MS_NODEV;
        match self.upper {
            None => flags |= MsFlags::MS_RDONLY,
            Some(upper) => options += &self.upper_options(upper)?,
        }
        nix::unistd::chdir(&lower).map_err(Error::nix("chdir to the layers"))?;
        mount(
            Some("overlay"),
            &target,
            Some("overlay"),
            flags,
            Some(options.as_str()),
        )
        .map_err(|error| Error::file("mount the layers at", &target)(error.into()))?;
        nix::unistd::chdir("/").map_err(Error::nix("chdir to /"))?;
        Ok(target)
    }

    fn upper_options(&self, upper: &Path) -> Result<String, Error> {
        let work = work_directory(upper);
        fs::create_dir_all(upper).map_err(Error::file("make", upper))?;
        make_directory(&work)?;
        let base = self.uid_range.0;
        for path in [upper, &work] {
            std::os::unix::fs::chown(path, Some(base), Some(base))
                .map_err(Error::file("change the owner of", path))?;
            fs::set_permissions(path, fs::Permissions::from_mode(0o755))
                .map_err(Error::file("change", path))?;
        }
        let text = |path: &Path| match path
            .to_str()
            .filter(|text| !text.contains([',', ':', '\\']))
        {
            Some(text) => Ok(text.to_owned()),
            None => Err(Error::Malformed {
                path: path.into(),
                reason:
                    "a path with a comma, colon or backslash cannot be an overlay's upper directory"
                        .into(),
            }),
        };
        // Nothing in a build is worth a flush to disk before it is a layer.
        Ok(format!(
            ",upperdir={},workdir={},volatile",
            text(upper)?,
            text(&work)?
        ))
    }

    /// Makes directories inside the mounted root that belong to the compiling user; new ones above them to root.
    pub fn make_owned(&self, root: &Path, directories: &[PathBuf]) -> Result<(), Error> {
        let opened: OwnedFd = fs::File::open(root)
            .map_err(Error::file("open", root))?
            .into();
        for directory in directories {
            let mut walked = PathBuf::from("/");
            let mut handle = opened.try_clone().map_err(Error::file("open", root))?;
            for name in directory.components().filter_map(normal) {
                walked.push(name);
                let made = nix::sys::stat::mkdirat(
                    &handle,
                    name,
                    nix::sys::stat::Mode::from_bits_truncate(0o755),
                );
                handle = sys::open_in_root(opened.as_fd(), &walked)
                    .map_err(Error::file("make inside", &walked))?;
                let owner = if walked == *directory {
                    Some(COMPILE_USER)
                } else {
                    made.is_ok().then_some(0)
                };
                if let Some(owner) = owner {
                    let host = self.uid_range.0 + owner;
                    nix::unistd::fchown(
                        &handle,
                        Some(Uid::from_raw(host)),
                        Some(Gid::from_raw(host)),
                    )
                    .map_err(|error| {
                        Error::file("change the owner inside of", &walked)(error.into())
                    })?;
                }
            }
        }
        Ok(())
    }
}

/// The overlay's scratch directory beside an upper directory, on the same filesystem as it must be.
pub fn work_directory(upper: &Path) -> PathBuf {
    let name = upper.file_name().unwrap_or_default().to_string_lossy();
    upper.with_file_name(format!(".{name}.work"))
}

/// Fills the top layer: what every servant needs to find in a root that it cannot write.
pub fn make_skeleton(
    skeleton: &Path,
    id: &str,
    layers: &[PathBuf],
    mounts: &[Mount],
) -> Result<(), Error> {
    make_directory(skeleton)?;
    for (name, mode) in [
        ("dev", 0o755),
        ("etc", 0o755),
        ("proc", 0o555),
        ("root", 0o700),
        ("run", 0o755),
        ("sys", 0o555),
        ("tmp", 0o1777),
        ("var", 0o755),
        ("var/tmp", 0o1777),
    ] {
        let path = skeleton.join(name);
        make_directory(&path)?;
        fs::set_permissions(&path, fs::Permissions::from_mode(mode))
            .map_err(Error::file("change", &path))?;
    }
    let hosts = format!(
        "127.0.0.1\tlocalhost\n127.0.0.1\t{id}\n::1\tlocalhost ip6-localhost ip6-loopback\n"
    );
    let files = [
        ("hosts", hosts),
        ("hostname", format!("{id}\n")),
        ("resolv.conf", String::new()),
    ];
    for (name, text) in files {
        let path = skeleton.join("etc").join(name);
        fs::write(&path, text).map_err(Error::file("write", &path))?;
    }
    for mount in mounts {
        make_mount_point(skeleton, layers, mount)?;
    }
    Ok(())
}

/// A read-only root needs the target to be there. A directory made for it must not hide a link of the layers.
fn make_mount_point(skeleton: &Path, layers: &[PathBuf], mount: &Mount) -> Result<(), Error> {
    let inside: PathBuf = mount.target.components().filter_map(normal).collect();
    for part in inside
        .ancestors()
        .filter(|part| !part.as_os_str().is_empty())
    {
        let found = layers
            .iter()
            .rev()
            .find_map(|layer| fs::symlink_metadata(layer.join(part)).ok());
        if found.is_some_and(|metadata| metadata.is_symlink()) {
            return Err(Error::Malformed {
                path: mount.target.clone(),
                reason: format!(
                    "/{} is a link in the image: mount at the place it leads to",
                    part.display()
                ),
            });
        }
    }
    let path = skeleton.join(&inside);
    let source = fs::metadata(&mount.source).map_err(Error::file("mount", &mount.source))?;
    if source.is_dir() {
        return fs::create_dir_all(&path).map_err(Error::file("make", &path));
    }
    let above = path.parent().unwrap_or(skeleton);
    fs::create_dir_all(above).map_err(Error::file("make", above))?;
    fs::write(&path, "").map_err(Error::file("make", &path))
}

fn normal(component: Component<'_>) -> Option<&std::ffi::OsStr> {
    match component {
        Component::Normal(name) => Some(name),
        _ => None,
    }
}

fn make_directory(path: &Path) -> Result<(), Error> {
    match fs::DirBuilder::new().mode(0o755).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        result => result.map_err(Error::file("make", path)),
    }
}

/// Attaches a read-only copy of `layer` at `place` whose ids are shifted.
fn shift_layer(layer: &Path, place: &Path, shift: &OwnedFd) -> Result<(), Error> {
    let copy = sys::clone_mount(layer).map_err(Error::file("open the layer", layer))?;
    sys::shift_mount(copy.as_fd(), shift.as_fd()).map_err(|source| {
        match source.raw_os_error() {
            Some(libc::EINVAL | libc::ENOSYS | libc::EOPNOTSUPP) => Error::IdmapUnsupported {
                path: layer.into(),
                filesystem: filesystem_of(layer),
                source,
            },
            _ => Error::file("shift the ids of", layer)(source),
        }
    })?;
    sys::attach_mount(copy.as_fd(), place).map_err(Error::file("attach a layer at", place))
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

/// A user namespace whose root is the first uid of the range. The kernel gives its map to mounts; nobody lives in it.
fn user_namespace((first, count): (u32, u32)) -> Result<OwnedFd, Error> {
    let pair = || nix::unistd::pipe2(nix::fcntl::OFlag::O_CLOEXEC).map_err(Error::nix("pipe"));
    let ((unshared, tell), (wait, release)) = (pair()?, pair()?);
    // SAFETY: the calling process has one thread (see Rootfs::mount); the child makes system calls only.
    match unsafe { nix::unistd::fork() }.map_err(Error::nix("fork"))? {
        ForkResult::Child => {
            drop(release);
            let done = [u8::from(unshare(CloneFlags::CLONE_NEWUSER).is_ok())];
            let _ = nix::unistd::write(&tell, &done);
            let _ = nix::unistd::read(&wait, &mut [0]);
            // SAFETY: ends the child without running what the parent has registered for its own end.
            unsafe { libc::_exit(0) }
        }
        ForkResult::Parent { child } => {
            drop(tell);
            let mut done = [0];
            let read = nix::unistd::read(&unshared, &mut done);
            let opened = if read == Ok(1) && done == [1] {
                map_ids(child.as_raw(), first, count)
            } else {
                Err(Error::call("unshare of a user namespace")(io::Error::from(
                    io::ErrorKind::PermissionDenied,
                )))
            };
            drop(release);
            let _ = waitpid(child, None);
            opened
        }
    }
}

fn map_ids(pid: i32, first: u32, count: u32) -> Result<OwnedFd, Error> {
    for file in ["uid_map", "gid_map"] {
        let path = format!("/proc/{pid}/{file}");
        fs::write(&path, format!("0 {first} {count}\n")).map_err(Error::file("write", &path))?;
    }
    let path = format!("/proc/{pid}/ns/user");
    Ok(fs::File::open(&path)
        .map_err(Error::file("open", &path))?
        .into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mount_through_a_link_of_the_image_is_refused() {
        let home = tempfile::tempdir().unwrap();
        let layer = home.path().join("layer");
        fs::create_dir_all(layer.join("usr/lib")).unwrap();
        std::os::unix::fs::symlink("usr/lib", layer.join("lib")).unwrap();
        let mount = |target: &str| Mount {
            source: home.path().into(),
            target: target.into(),
            writable: false,
        };
        let make = |name: &str, target: &str| {
            make_skeleton(
                &home.path().join(name),
                "x",
                std::slice::from_ref(&layer),
                &[mount(target)],
            )
        };
        let error = make("one", "/lib/models").unwrap_err().to_string();
        assert!(error.contains("/lib is a link in the image"), "{error}");
        make("two", "/usr/lib/models").unwrap();
        assert!(home.path().join("two/usr/lib/models").is_dir());
        assert!(
            !layer.join("usr/lib/models").exists(),
            "the layer is not written"
        );
    }

    #[test]
    fn the_filesystem_of_a_path_is_named() {
        assert_eq!(filesystem_of(Path::new("/proc/self/status")), "proc");
    }
}
