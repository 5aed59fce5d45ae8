//! Extraction of an untrusted layer into a directory for an overlay mount.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;

use rustix::fs::{AtFlags, FileType, Gid, Mode, Timespec, Timestamps, Uid, XattrFlags};
use rustix::io::Errno;

use crate::beneath::{self, ConfinedRoot, is_kind, stat_entry};
use crate::entry::{Entry, Kind, display_name};
use crate::names::{self, MAX_PATH, split};
use crate::tar_reader::{ReadStop, TarReader};
use crate::tree::{OPAQUE, WHITEOUT};
use crate::{Error, Refusal, capability};

const BUFFER: usize = 256 << 10;

/// Writer of the entries of a layer into a directory.
pub(crate) struct LayerWriter {
    beneath: ConfinedRoot,
    /// Metadata that directories get once nothing more is written into them.
    directories: BTreeMap<Vec<u8>, Metadata>,
    /// True if running as root: only root can change owners and set trusted attributes.
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

/// Error of writing an entry.
pub(crate) enum WriteFailure {
    Refused(Refusal),
    File(&'static str, Vec<u8>, std::io::Error),
    Read(std::io::Error),
}

impl WriteFailure {
    fn file(action: &'static str, path: &[u8], error: Errno) -> Self {
        Self::File(action, path.to_vec(), error.into())
    }

    /// Converts to an error that names the archive and the tree.
    pub(crate) fn into_error<R: Read>(self, archive: &str, tree: &Path, reader: &TarReader<R>) -> Error {
        use std::os::unix::ffi::OsStrExt;
        match self {
            Self::Refused(refusal) => Error::from_stop(archive, tree, ReadStop::Refused(refusal)),
            Self::File(action, path, error) => {
                Error::file(action, tree.join(std::ffi::OsStr::from_bytes(&path)), error)
            }
            Self::Read(error) => Error::from_stop(archive, tree, reader.classify_error(error)),
        }
    }
}

impl From<Refusal> for WriteFailure {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl LayerWriter {
    /// Creates a writer for `tree`, an empty directory.
    pub(crate) fn new(tree: &Path) -> Result<Self, Error> {
        let beneath =
            ConfinedRoot::following_links(tree).map_err(|error| Error::file("open the directory", tree, error))?;
        let root = Metadata { mode: 0o755, uid: 0, gid: 0, mtime: 0 };
        Ok(Self {
            beneath,
            directories: BTreeMap::from([(Vec::new(), root)]),
            privileged: rustix::process::geteuid().is_root(),
            tree: tree.to_owned(),
            buffer: vec![0; BUFFER],
        })
    }

    /// Writes an entry; `content` is its data.
    pub(crate) fn write_entry(&mut self, entry: &Entry, content: &mut impl Read) -> Result<(), WriteFailure> {
        let path = names::normalize(&entry.name, MAX_PATH)?;
        let metadata = read_metadata(entry)?;
        if path.is_empty() {
            if entry.kind == Kind::Directory {
                self.directories.insert(path, metadata);
            }
            return Ok(());
        }
        let (above, name) = split(&path);
        let parent = self.beneath.make_directory(above).map_err(|error| WriteFailure::file("create", above, error))?;
        if let Some(hidden) = name.strip_prefix(WHITEOUT) {
            return self.create_whiteout(&parent, above, name, hidden);
        }
        let failed = |error| WriteFailure::file("create", &path, error);
        match entry.kind {
            Kind::Directory => return self.create_directory(&parent, &path, name, entry, metadata),
            Kind::File => {
                let file = self.replace_existing(&parent, &path, || beneath::create(&parent, name))?;
                self.copy_content(&file, &path, content)?;
                self.set_metadata(&file, &path, metadata, entry)?;
            }
            Kind::Symlink => {
                self.replace_existing(&parent, &path, || rustix::fs::symlinkat(&entry.link[..], &parent, name))?;
                self.set_metadata_at(&parent, name, metadata).map_err(failed)?;
            }
            Kind::Hardlink => self.create_hardlink(&parent, &path, entry)?,
            Kind::Fifo => {
                let fifo = || rustix::fs::mkfifoat(&parent, name, Mode::from_raw_mode(0o600));
                self.replace_existing(&parent, &path, fifo)?;
                rustix::fs::chmodat(&parent, name, Mode::from_raw_mode(metadata.mode & 0o777), AtFlags::empty())
                    .map_err(failed)?;
                self.set_metadata_at(&parent, name, metadata).map_err(failed)?;
            }
            // A container has its own /dev; an untrusted device node would give access to the host's disks.
            Kind::Character | Kind::Block => {
                tracing::debug!(entry = display_name(&entry.name), "skipped a device node of a layer");
            }
            Kind::Other(flag) => {
                tracing::debug!(entry = display_name(&entry.name), flag, "skipped an unknown entry of a layer");
            }
        }
        Ok(())
    }

    /// Sets the permissions and times of all directories.
    pub(crate) fn finish(mut self) -> Result<(), Error> {
        let directories = std::mem::take(&mut self.directories);
        // Deepest first, because the permissions of a directory may prevent access to those below.
        for (path, metadata) in directories.iter().rev() {
            let failed = |error| {
                use std::os::unix::ffi::OsStrExt;
                Error::file("set the rights of", self.tree.join(std::ffi::OsStr::from_bytes(path)), error)
            };
            let (above, name) = split(path);
            let opened = if path.is_empty() {
                rustix::io::fcntl_dupfd_cloexec(self.beneath.root(), 0)
            } else {
                self.beneath.directory(above).and_then(|parent| beneath::open_directory(&parent, name))
            };
            match opened {
                Ok(directory) => self.set_owner_and_times(&directory, *metadata).map_err(failed)?,
                // A later entry has replaced it.
                Err(Errno::NOENT | Errno::NOTDIR | Errno::LOOP) => {}
                Err(error) => return Err(failed(error)),
            }
        }
        Ok(())
    }

    fn create_hardlink(&mut self, parent: &OwnedFd, path: &[u8], entry: &Entry) -> Result<(), WriteFailure> {
        let target = names::normalize(&entry.link, MAX_PATH)?;
        if path == target {
            return Ok(());
        }
        let nothing = || Refusal::LinkToNothing { entry: display_name(&entry.name), target: display_name(&entry.link) };
        let (above, name) = split(&target);
        let from = self.beneath.directory(above).map_err(|_| nothing())?;
        // The kernel does not allow hard links to directories.
        if stat_entry(&from, name).ok().flatten().is_none_or(|stat| is_kind(&stat, FileType::Directory)) {
            return Err(nothing().into());
        }
        let link = || rustix::fs::linkat(&from, name, parent, split(path).1, AtFlags::empty());
        self.replace_existing(parent, path, link)
    }

    fn create_directory(
        &mut self,
        parent: &OwnedFd,
        path: &[u8],
        name: &[u8],
        entry: &Entry,
        metadata: Metadata,
    ) -> Result<(), WriteFailure> {
        let failed = |error| WriteFailure::file("create", path, error);
        let make = || rustix::fs::mkdirat(parent, name, Mode::RWXU);
        let mut hides = false;
        match make() {
            Ok(()) => {}
            Err(Errno::EXIST) => {
                let there = stat_entry(parent, name).map_err(failed)?;
                if !there.is_some_and(|stat| is_kind(&stat, FileType::Directory)) {
                    // After a whiteout of the same name the directory is new, not merged.
                    hides = there.is_some_and(|stat| is_kind(&stat, FileType::CharacterDevice));
                    self.replace_existing(parent, path, make)?;
                }
            }
            Err(error) => return Err(failed(error)),
        }
        let directory = beneath::open_directory(parent, name).map_err(failed)?;
        self.set_xattrs(&directory, path, entry)?;
        if hides {
            self.make_opaque(&directory, path)?;
        }
        self.directories.insert(path.to_vec(), metadata);
        Ok(())
    }

    /// Writes a whiteout: `.wh.NAME` deletes NAME from the layers below, `.wh..wh..opq` everything in this directory.
    fn create_whiteout(
        &mut self,
        parent: &OwnedFd,
        above: &[u8],
        name: &[u8],
        hidden: &[u8],
    ) -> Result<(), WriteFailure> {
        if name == OPAQUE {
            return self.make_opaque(parent, above);
        }
        // Other names of this form are internal to an old union file system (aufs).
        if hidden.starts_with(WHITEOUT) || hidden.is_empty() || hidden == b"." || hidden == b".." {
            return Ok(());
        }
        let failed = |error| WriteFailure::file("create", &names::join(above, hidden), error);
        match rustix::fs::mknodat(parent, hidden, FileType::CharacterDevice, Mode::empty(), 0) {
            Ok(()) => Ok(()),
            // The name also exists in this layer: a file hides what is below anyway, a directory must be marked as
            // opaque.
            Err(Errno::EXIST) => {
                let there = stat_entry(parent, hidden).map_err(failed)?;
                if there.is_some_and(|stat| is_kind(&stat, FileType::Directory)) {
                    let directory = beneath::open_directory(parent, hidden).map_err(failed)?;
                    self.make_opaque(&directory, &names::join(above, hidden))?;
                }
                Ok(())
            }
            Err(error) => Err(failed(error)),
        }
    }

    fn make_opaque(&self, directory: &OwnedFd, path: &[u8]) -> Result<(), WriteFailure> {
        let set = |name: &str| rustix::fs::fsetxattr(directory, name, b"y", XattrFlags::empty());
        let done = match set("trusted.overlay.opaque") {
            Err(Errno::PERM) => set("user.overlay.opaque"),
            other => other,
        };
        done.map_err(|error| WriteFailure::file("mark as opaque", path, error))
    }

    /// Calls `make`, removing an existing file of the name first: the last entry of a name wins.
    fn replace_existing<T>(
        &mut self,
        parent: &OwnedFd,
        path: &[u8],
        make: impl Fn() -> Result<T, Errno>,
    ) -> Result<T, WriteFailure> {
        let failed = |error| WriteFailure::file("create", path, error);
        match make() {
            Err(Errno::EXIST) => {}
            other => return other.map_err(failed),
        }
        let (_, name) = split(path);
        self.beneath.invalidate_cache();
        if stat_entry(parent, name).map_err(failed)?.is_some_and(|stat| is_kind(&stat, FileType::Directory)) {
            use std::os::unix::ffi::OsStrExt;
            let within = format!("/proc/self/fd/{}", parent.as_raw_fd());
            let within = Path::new(&within).join(std::ffi::OsStr::from_bytes(name));
            foreign::remove(&within).map_err(|error| WriteFailure::File("replace", path.to_vec(), error.into()))?;
        } else {
            rustix::fs::unlinkat(parent, name, AtFlags::empty()).map_err(failed)?;
        }
        make().map_err(failed)
    }

    fn copy_content(&mut self, file: &OwnedFd, path: &[u8], content: &mut impl Read) -> Result<(), WriteFailure> {
        let mut file =
            File::from(file.try_clone().map_err(|error| WriteFailure::File("create", path.to_vec(), error))?);
        loop {
            let read = content.read(&mut self.buffer).map_err(WriteFailure::Read)?;
            if read == 0 {
                return Ok(());
            }
            file.write_all(&self.buffer[..read]).map_err(|error| WriteFailure::File("write", path.to_vec(), error))?;
        }
    }

    /// Sets owner, permissions, attributes and time of an open file, in this order, since changing the owner clears
    /// set-id bits and capabilities.
    fn set_metadata(&self, file: &OwnedFd, path: &[u8], metadata: Metadata, entry: &Entry) -> Result<(), WriteFailure> {
        self.set_owner_and_mode(file, metadata)
            .map_err(|error| WriteFailure::file("set the rights of", path, error))?;
        self.set_xattrs(file, path, entry)?;
        rustix::fs::futimens(file, &timestamps(metadata))
            .map_err(|error| WriteFailure::file("set the time of", path, error))
    }

    fn set_owner_and_times(&self, file: &OwnedFd, metadata: Metadata) -> Result<(), Errno> {
        self.set_owner_and_mode(file, metadata)?;
        rustix::fs::futimens(file, &timestamps(metadata))
    }

    fn set_owner_and_mode(&self, file: &OwnedFd, metadata: Metadata) -> Result<(), Errno> {
        if self.privileged {
            let (uid, gid) = (Uid::from_raw(metadata.uid), Gid::from_raw(metadata.gid));
            rustix::fs::fchown(file, Some(uid), Some(gid))?;
        }
        rustix::fs::fchmod(file, Mode::from_raw_mode(metadata.mode))
    }

    /// Sets owner and time of a file that cannot be opened.
    fn set_metadata_at(&self, parent: &OwnedFd, name: &[u8], metadata: Metadata) -> Result<(), Errno> {
        if self.privileged {
            let (uid, gid) = (Uid::from_raw(metadata.uid), Gid::from_raw(metadata.gid));
            rustix::fs::chownat(parent, name, Some(uid), Some(gid), AtFlags::SYMLINK_NOFOLLOW)?;
        }
        rustix::fs::utimensat(parent, name, &timestamps(metadata), AtFlags::SYMLINK_NOFOLLOW)
    }

    /// Sets file capabilities and user attributes only, since overlay attributes would redirect lookups.
    fn set_xattrs(&self, file: &OwnedFd, path: &[u8], entry: &Entry) -> Result<(), WriteFailure> {
        for (name, value) in &entry.xattrs {
            let capability = name == capability::NAME && self.privileged;
            let users = name.starts_with(b"user.") && !name.starts_with(b"user.overlay.");
            if !capability && !users {
                continue;
            }
            match rustix::fs::fsetxattr(file, &name[..], value, XattrFlags::empty()) {
                Ok(()) => {}
                Err(error @ (Errno::NOTSUP | Errno::PERM | Errno::INVAL)) => {
                    tracing::debug!(path = display_name(path), attribute = display_name(name), %error,
                        "skipped an attribute");
                }
                Err(error) => return Err(WriteFailure::file("set an attribute of", path, error)),
            }
        }
        Ok(())
    }
}

fn read_metadata(entry: &Entry) -> Result<Metadata, Refusal> {
    let id = |value: u64| {
        // The highest id means "unchanged" to the kernel.
        u32::try_from(value).ok().filter(|&id| id != u32::MAX).ok_or_else(|| Refusal::Malformed {
            after: display_name(&entry.name),
            problem: format!("owner {value} is out of range"),
        })
    };
    Ok(Metadata { mode: entry.mode & 0o7777, uid: id(entry.uid)?, gid: id(entry.gid)?, mtime: entry.mtime })
}

fn timestamps(metadata: Metadata) -> Timestamps {
    let time = Timespec { tv_sec: i64::try_from(metadata.mtime).unwrap_or(0), tv_nsec: 0 };
    Timestamps { last_access: time, last_modification: time }
}
