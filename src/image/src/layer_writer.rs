//! Turns the entries of a layer into a directory for an overlay mount, whatever the untrusted layer holds.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;

use rustix::fs::{AtFlags, FileType, Gid, Mode, Timespec, Timestamps, Uid, XattrFlags};
use rustix::io::Errno;

use crate::beneath::{self, Beneath, is, look};
use crate::entry::{Entry, Kind, shown};
use crate::names::{self, MAX_PATH, split};
use crate::tar_reader::{Stop, TarReader};
use crate::tree::{OPAQUE, WHITEOUT};
use crate::{Error, Refusal, capability};

const BUFFER: usize = 256 << 10;

/// Fills one directory.
pub(crate) struct LayerWriter {
    beneath: Beneath,
    /// What directories get when nothing is written into them any more.
    directories: BTreeMap<Vec<u8>, Metadata>,
    /// Only root can give files away and set trusted attributes.
    privileged: bool,
    tree: std::path::PathBuf,
    buffer: Vec<u8>,
}

#[derive(Debug, Clone, Copy)]
struct Metadata {
    mode: u32,
    uid: u32,
    gid: u32,
    mtime: u64,
}

/// Why an entry could not be written.
pub(crate) enum Failed {
    Refused(Refusal),
    File(&'static str, Vec<u8>, std::io::Error),
    Read(std::io::Error),
}

impl Failed {
    fn file(action: &'static str, path: &[u8], error: Errno) -> Self {
        Self::File(action, path.to_vec(), error.into())
    }

    /// With the names of the archive and of the tree.
    pub(crate) fn into_error<R: Read>(
        self,
        archive: &str,
        tree: &Path,
        reader: &TarReader<R>,
    ) -> Error {
        use std::os::unix::ffi::OsStrExt;
        match self {
            Self::Refused(refusal) => Error::stopped(archive, tree, Stop::Refused(refusal)),
            Self::File(action, path, error) => {
                Error::file(action, tree.join(std::ffi::OsStr::from_bytes(&path)), error)
            }
            Self::Read(error) => Error::stopped(archive, tree, reader.stop(error)),
        }
    }
}

impl From<Refusal> for Failed {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl LayerWriter {
    /// `tree` is an empty directory.
    pub(crate) fn new(tree: &Path) -> Result<Self, Error> {
        let beneath = Beneath::following(tree)
            .map_err(|error| Error::file("open the directory", tree, error))?;
        let root = Metadata {
            mode: 0o755,
            uid: 0,
            gid: 0,
            mtime: 0,
        };
        Ok(Self {
            beneath,
            directories: BTreeMap::from([(Vec::new(), root)]),
            privileged: rustix::process::geteuid().is_root(),
            tree: tree.to_owned(),
            buffer: vec![0; BUFFER],
        })
    }

    /// One entry; `content` gives its bytes.
    pub(crate) fn entry(&mut self, entry: &Entry, content: &mut impl Read) -> Result<(), Failed> {
        let path = names::normal(&entry.name, MAX_PATH)?;
        let metadata = metadata(entry)?;
        if path.is_empty() {
            if entry.kind == Kind::Directory {
                self.directories.insert(path, metadata);
            }
            return Ok(());
        }
        let (above, name) = split(&path);
        let parent = self
            .beneath
            .make_directory(above)
            .map_err(|error| Failed::file("create", above, error))?;
        if let Some(hidden) = name.strip_prefix(WHITEOUT) {
            return self.whiteout(&parent, above, name, hidden);
        }
        let failed = |error| Failed::file("create", &path, error);
        match entry.kind {
            Kind::Directory => return self.directory(&parent, &path, name, entry, metadata),
            Kind::File => {
                let file = self
                    .in_place_of_what_is_there(&parent, &path, || beneath::create(&parent, name))?;
                self.fill(&file, &path, content)?;
                self.adorn(&file, &path, metadata, entry)?;
            }
            Kind::Symlink => {
                self.in_place_of_what_is_there(&parent, &path, || {
                    rustix::fs::symlinkat(&entry.link[..], &parent, name)
                })?;
                self.adorn_unopened(&parent, name, metadata)
                    .map_err(failed)?;
            }
            Kind::Hardlink => self.hardlink(&parent, &path, entry)?,
            Kind::Fifo => {
                let fifo = || rustix::fs::mkfifoat(&parent, name, Mode::from_raw_mode(0o600));
                self.in_place_of_what_is_there(&parent, &path, fifo)?;
                rustix::fs::chmodat(
                    &parent,
                    name,
                    Mode::from_raw_mode(metadata.mode & 0o777),
                    AtFlags::empty(),
                )
                .map_err(failed)?;
                self.adorn_unopened(&parent, name, metadata)
                    .map_err(failed)?;
            }
            // A container gets its own /dev; an untrusted device node would reach the host's disks.
            Kind::Character | Kind::Block => {
                tracing::debug!(
                    entry = shown(&entry.name),
                    "left a device node out of an extracted layer"
                );
            }
            Kind::Other(flag) => {
                tracing::debug!(
                    entry = shown(&entry.name),
                    flag,
                    "left an unknown entry out of an extracted layer"
                );
            }
        }
        Ok(())
    }

    /// Gives all directories their rights and times.
    pub(crate) fn finish(mut self) -> Result<(), Error> {
        let directories = std::mem::take(&mut self.directories);
        // From the deepest up, as setting the rights of one may bar the way to those below.
        for (path, metadata) in directories.iter().rev() {
            let failed = |error| {
                use std::os::unix::ffi::OsStrExt;
                Error::file(
                    "set the rights of",
                    self.tree.join(std::ffi::OsStr::from_bytes(path)),
                    error,
                )
            };
            let (above, name) = split(path);
            let opened = if path.is_empty() {
                rustix::io::fcntl_dupfd_cloexec(self.beneath.root(), 0)
            } else {
                self.beneath
                    .directory(above)
                    .and_then(|parent| beneath::open_directory(&parent, name))
            };
            match opened {
                Ok(directory) => self.own(&directory, *metadata).map_err(failed)?,
                // A later entry took its place.
                Err(Errno::NOENT | Errno::NOTDIR | Errno::LOOP) => {}
                Err(error) => return Err(failed(error)),
            }
        }
        Ok(())
    }

    fn hardlink(&mut self, parent: &OwnedFd, path: &[u8], entry: &Entry) -> Result<(), Failed> {
        let target = names::normal(&entry.link, MAX_PATH)?;
        if path == target {
            return Ok(());
        }
        let nothing = || Refusal::LinkToNothing {
            entry: shown(&entry.name),
            target: shown(&entry.link),
        };
        let (above, name) = split(&target);
        let from = self.beneath.directory(above).map_err(|_| nothing())?;
        // The kernel links no directories.
        if look(&from, name)
            .ok()
            .flatten()
            .is_none_or(|stat| is(&stat, FileType::Directory))
        {
            return Err(nothing().into());
        }
        let link = || rustix::fs::linkat(&from, name, parent, split(path).1, AtFlags::empty());
        self.in_place_of_what_is_there(parent, path, link)
    }

    fn directory(
        &mut self,
        parent: &OwnedFd,
        path: &[u8],
        name: &[u8],
        entry: &Entry,
        metadata: Metadata,
    ) -> Result<(), Failed> {
        let failed = |error| Failed::file("create", path, error);
        let make = || rustix::fs::mkdirat(parent, name, Mode::RWXU);
        let mut hides = false;
        match make() {
            Ok(()) => {}
            Err(Errno::EXIST) => {
                let there = look(parent, name).map_err(failed)?;
                if !there.is_some_and(|stat| is(&stat, FileType::Directory)) {
                    // After a whiteout of its own name the directory is new, not merged.
                    hides = there.is_some_and(|stat| is(&stat, FileType::CharacterDevice));
                    self.in_place_of_what_is_there(parent, path, make)?;
                }
            }
            Err(error) => return Err(failed(error)),
        }
        let directory = beneath::open_directory(parent, name).map_err(failed)?;
        self.attributes(&directory, path, entry)?;
        if hides {
            self.make_opaque(&directory, path)?;
        }
        self.directories.insert(path.to_vec(), metadata);
        Ok(())
    }

    /// `.wh.NAME` deletes NAME of the layers below; `.wh..wh..opq` all of them in this directory.
    fn whiteout(
        &mut self,
        parent: &OwnedFd,
        above: &[u8],
        name: &[u8],
        hidden: &[u8],
    ) -> Result<(), Failed> {
        if name == OPAQUE {
            return self.make_opaque(parent, above);
        }
        // Other names of this form are an old union file system's own business (aufs).
        if hidden.starts_with(WHITEOUT) || hidden.is_empty() || hidden == b"." || hidden == b".." {
            return Ok(());
        }
        let failed = |error| Failed::file("create", &names::join(above, hidden), error);
        match rustix::fs::mknodat(parent, hidden, FileType::CharacterDevice, Mode::empty(), 0) {
            Ok(()) => Ok(()),
            // It is also in this layer: a file hides what is below anyway, a directory must be told to.
            Err(Errno::EXIST) => {
                let there = look(parent, hidden).map_err(failed)?;
                if there.is_some_and(|stat| is(&stat, FileType::Directory)) {
                    let directory = beneath::open_directory(parent, hidden).map_err(failed)?;
                    self.make_opaque(&directory, &names::join(above, hidden))?;
                }
                Ok(())
            }
            Err(error) => Err(failed(error)),
        }
    }

    fn make_opaque(&self, directory: &OwnedFd, path: &[u8]) -> Result<(), Failed> {
        let set = |name: &str| rustix::fs::fsetxattr(directory, name, b"y", XattrFlags::empty());
        let done = match set("trusted.overlay.opaque") {
            Err(Errno::PERM) => set("user.overlay.opaque"),
            other => other,
        };
        done.map_err(|error| Failed::file("mark as opaque", path, error))
    }

    /// Does `make`; if something else has the name, that goes first: the last entry of a name counts.
    fn in_place_of_what_is_there<T>(
        &mut self,
        parent: &OwnedFd,
        path: &[u8],
        make: impl Fn() -> Result<T, Errno>,
    ) -> Result<T, Failed> {
        let failed = |error| Failed::file("create", path, error);
        match make() {
            Err(Errno::EXIST) => {}
            other => return other.map_err(failed),
        }
        let (_, name) = split(path);
        self.beneath.forget();
        if look(parent, name)
            .map_err(failed)?
            .is_some_and(|stat| is(&stat, FileType::Directory))
        {
            use std::os::unix::ffi::OsStrExt;
            let within = format!("/proc/self/fd/{}", parent.as_raw_fd());
            let within = Path::new(&within).join(std::ffi::OsStr::from_bytes(name));
            foreign::remove(&within)
                .map_err(|error| Failed::File("replace", path.to_vec(), error.into()))?;
        } else {
            rustix::fs::unlinkat(parent, name, AtFlags::empty()).map_err(failed)?;
        }
        make().map_err(failed)
    }

    fn fill(&mut self, file: &OwnedFd, path: &[u8], content: &mut impl Read) -> Result<(), Failed> {
        let mut file = File::from(
            file.try_clone()
                .map_err(|error| Failed::File("create", path.to_vec(), error))?,
        );
        loop {
            let read = content.read(&mut self.buffer).map_err(Failed::Read)?;
            if read == 0 {
                return Ok(());
            }
            file.write_all(&self.buffer[..read])
                .map_err(|error| Failed::File("write", path.to_vec(), error))?;
        }
    }

    /// Owner, rights, attributes and time of an open file. In this order: a new owner clears set-id bits and
    /// capabilities.
    fn adorn(
        &self,
        file: &OwnedFd,
        path: &[u8],
        metadata: Metadata,
        entry: &Entry,
    ) -> Result<(), Failed> {
        self.own_and_allow(file, metadata)
            .map_err(|error| Failed::file("set the rights of", path, error))?;
        self.attributes(file, path, entry)?;
        rustix::fs::futimens(file, &times(metadata))
            .map_err(|error| Failed::file("set the time of", path, error))
    }

    fn own(&self, file: &OwnedFd, metadata: Metadata) -> Result<(), Errno> {
        self.own_and_allow(file, metadata)?;
        rustix::fs::futimens(file, &times(metadata))
    }

    fn own_and_allow(&self, file: &OwnedFd, metadata: Metadata) -> Result<(), Errno> {
        if self.privileged {
            let (uid, gid) = (Uid::from_raw(metadata.uid), Gid::from_raw(metadata.gid));
            rustix::fs::fchown(file, Some(uid), Some(gid))?;
        }
        rustix::fs::fchmod(file, Mode::from_raw_mode(metadata.mode))
    }

    /// Owner and time of what cannot be opened.
    fn adorn_unopened(
        &self,
        parent: &OwnedFd,
        name: &[u8],
        metadata: Metadata,
    ) -> Result<(), Errno> {
        if self.privileged {
            let (uid, gid) = (Uid::from_raw(metadata.uid), Gid::from_raw(metadata.gid));
            rustix::fs::chownat(
                parent,
                name,
                Some(uid),
                Some(gid),
                AtFlags::SYMLINK_NOFOLLOW,
            )?;
        }
        rustix::fs::utimensat(parent, name, &times(metadata), AtFlags::SYMLINK_NOFOLLOW)
    }

    /// Only file capabilities and the user's own: an overlay's attributes would make it look elsewhere.
    fn attributes(&self, file: &OwnedFd, path: &[u8], entry: &Entry) -> Result<(), Failed> {
        for (name, value) in &entry.xattrs {
            let capability = name == capability::NAME && self.privileged;
            let users = name.starts_with(b"user.") && !name.starts_with(b"user.overlay.");
            if !capability && !users {
                continue;
            }
            match rustix::fs::fsetxattr(file, &name[..], value, XattrFlags::empty()) {
                Ok(()) => {}
                Err(error @ (Errno::NOTSUP | Errno::PERM | Errno::INVAL)) => {
                    tracing::debug!(path = shown(path), attribute = shown(name), %error, "left an attribute out");
                }
                Err(error) => return Err(Failed::file("set an attribute of", path, error)),
            }
        }
        Ok(())
    }
}

fn metadata(entry: &Entry) -> Result<Metadata, Refusal> {
    let id = |value: u64| {
        // The highest one means "unchanged" to the kernel.
        u32::try_from(value)
            .ok()
            .filter(|&id| id != u32::MAX)
            .ok_or_else(|| Refusal::Malformed {
                after: shown(&entry.name),
                problem: format!("owner {value} is out of range"),
            })
    };
    Ok(Metadata {
        mode: entry.mode & 0o7777,
        uid: id(entry.uid)?,
        gid: id(entry.gid)?,
        mtime: entry.mtime,
    })
}

fn times(metadata: Metadata) -> Timestamps {
    let time = Timespec {
        tv_sec: i64::try_from(metadata.mtime).unwrap_or(0),
        tv_nsec: 0,
    };
    Timestamps {
        last_access: time,
        last_modification: time,
    }
}
