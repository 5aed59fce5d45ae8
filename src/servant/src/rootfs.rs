//! The root of a servant: its layers, each idmapped, under one overlay. It is assembled in a mount namespace of the
//! creating process, so that nothing is visible on the host and nothing can be left behind; and at a path of that
//! namespace that the container's root user can reach, which the state directory (possibly below `/root`) need not be.
//!
//! Only the lower layers are idmapped: an idmapped upper directory makes the overlay read-only, and an idmapped overlay
//! is refused (kernel 6.1 to 6.18). The upper directory is owned by the servant's root instead.

use std::fs;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Component, Path, PathBuf};

use nix::mount::{MsFlags, mount};
use nix::unistd::{Gid, Uid};

use crate::container::Mount;
use crate::{Error, idmap, sys};

mod skeleton;
mod stage;

pub use skeleton::make_skeleton;

/// Uid and gid of the compile user in the container.
pub const COMPILE_USER: u32 = 1000;

/// Components of a root.
#[derive(Debug, Clone, Copy)]
pub struct Rootfs<'a> {
    /// Layers, lowest first.
    pub layers: &'a [PathBuf],
    /// Topmost read-only layer: mount points, hosts, hostname.
    pub skeleton: &'a Path,
    /// Directory for changes; `None` for a read-only root.
    pub upper: Option<&'a Path>,
    /// First host uid (= gid) and number of ids.
    pub uid_range: (u32, u32),
}

/// Mounts staged for the creation of the container. The paths exist only in the mount namespace of the calling process.
#[derive(Debug)]
pub struct StagedRoot {
    /// Path of the mounted root.
    pub root: PathBuf,
    /// Sources of the extra mounts, in order.
    pub volumes: Vec<PathBuf>,
    /// User namespace for the container, with the id mapping of the layers.
    pub user_namespace: OwnedFd,
}

impl Rootfs<'_> {
    /// Mounts the root and returns its paths. The calling process must have one thread: it moves to a new mount
    /// namespace and changes its working directory.
    pub fn mount(&self, volumes: &[Mount]) -> Result<StagedRoot, Error> {
        // Copied before changing the namespace, since the originals belong to the old one.
        let copies = volumes.iter().map(stage::copy_volume).collect::<Result<Vec<_>, _>>()?;
        let stage = stage::enter_mount_namespace()?;
        let shift = idmap::create_user_namespace(self.uid_range)?;
        let (lower, root) = (stage.join("lower"), stage.join("root"));
        for path in [&lower, &root] {
            make_directory(path)?;
        }
        // The names are short because all of them together must fit into one page.
        let all = self.layers.iter().map(PathBuf::as_path).chain([self.skeleton]);
        let mut names = Vec::new();
        for (index, layer) in all.enumerate() {
            let place = lower.join(index.to_string());
            make_directory(&place)?;
            stage::attach_shifted(layer, &place, &shift)?;
            names.insert(0, index.to_string());
        }
        let mut options = format!("lowerdir={},redirect_dir=nofollow,metacopy=off", names.join(":"));
        let mut flags = MsFlags::MS_NODEV;
        match self.upper {
            None => flags |= MsFlags::MS_RDONLY,
            Some(upper) => options += &self.upper_options(upper)?,
        }
        nix::unistd::chdir(&lower).map_err(Error::nix("chdir to the layers"))?;
        mount(Some("overlay"), &root, Some("overlay"), flags, Some(options.as_str()))
            .map_err(|error| Error::file("mount the layers at", &root)(error.into()))?;
        nix::unistd::chdir("/").map_err(Error::nix("chdir to /"))?;
        let volumes = volumes.iter().zip(&copies).enumerate();
        let volumes = volumes.map(|(index, (volume, copy))| {
            let place = stage.join(format!("volume{index}"));
            stage::attach_volume(volume, copy, &place, &shift).map(|()| place)
        });
        let volumes = volumes.collect::<Result<_, _>>()?;
        Ok(StagedRoot { volumes, root, user_namespace: shift })
    }

    fn upper_options(&self, upper: &Path) -> Result<String, Error> {
        let work = work_directory(upper);
        fs::create_dir_all(upper).map_err(Error::file("make", upper))?;
        make_directory(&work)?;
        let base = self.uid_range.0;
        for path in [upper, &work] {
            std::os::unix::fs::chown(path, Some(base), Some(base)).map_err(Error::file("change the owner of", path))?;
            fs::set_permissions(path, fs::Permissions::from_mode(0o755)).map_err(Error::file("change", path))?;
        }
        let text = |path: &Path| match path.to_str().filter(|text| !text.contains([',', ':', '\\'])) {
            Some(text) => Ok(text.to_owned()),
            None => Err(Error::Malformed {
                path: path.into(),
                reason: "a path with a comma, colon or backslash cannot be an overlay's upper directory".into(),
            }),
        };
        // A build's files are not worth flushing to disk before they become a layer.
        Ok(format!(",upperdir={},workdir={},volatile", text(upper)?, text(&work)?))
    }

    /// Creates directories inside the mounted root that are owned by the compile user; newly created parents are owned
    /// by root.
    pub fn make_owned_directories(&self, root: &Path, directories: &[PathBuf]) -> Result<(), Error> {
        let opened: OwnedFd = fs::File::open(root).map_err(Error::file("open", root))?.into();
        for directory in directories {
            let mut walked = PathBuf::from("/");
            let mut handle = opened.try_clone().map_err(Error::file("open", root))?;
            for name in directory.components().filter_map(normal_component) {
                walked.push(name);
                let made = nix::sys::stat::mkdirat(&handle, name, nix::sys::stat::Mode::from_bits_truncate(0o755));
                handle = sys::open_in_root(opened.as_fd(), &walked).map_err(Error::file("make inside", &walked))?;
                let owner = if walked == *directory { Some(COMPILE_USER) } else { made.is_ok().then_some(0) };
                if let Some(owner) = owner {
                    let host = self.uid_range.0 + owner;
                    nix::unistd::fchown(&handle, Some(Uid::from_raw(host)), Some(Gid::from_raw(host)))
                        .map_err(|error| Error::file("change the owner inside of", &walked)(error.into()))?;
                }
            }
        }
        Ok(())
    }
}

/// Returns the overlay's work directory beside an upper directory; it must be on the same file system.
pub fn work_directory(upper: &Path) -> PathBuf {
    let name = upper.file_name().unwrap_or_default().to_string_lossy();
    upper.with_file_name(format!(".{name}.work"))
}

fn normal_component(component: Component<'_>) -> Option<&std::ffi::OsStr> {
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
