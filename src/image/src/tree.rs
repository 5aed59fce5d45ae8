//! Deterministic conversion of a file tree to tar entries.
//!
//! The tree may be untrusted (written by a build): it is walked by directory descriptors, symbolic links are not
//! followed, and files that could block are not opened.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, Dir, FileType, Mode, OFlags, Stat};
use rustix::io::Errno;

use crate::entry::{Entry, Kind};
use crate::glob::Globs;
use crate::names::{MAX_DEPTH, join};
use crate::tar_writer::TarWriter;
use crate::{Error, Mtime, TreeOptions, capability};

/// Prefix of an entry that deletes the entry of that name in the layers below (OCI layer specification, whiteouts).
pub(crate) const WHITEOUT: &[u8] = b".wh.";
/// Name of an entry that hides the content of its directory in the layers below.
pub(crate) const OPAQUE: &[u8] = b".wh..wh..opq";

/// Number of bytes read from a file at once.
const BUFFER: usize = 256 << 10;
/// Maximum size of a list of attribute names, and of a value (linux/limits.h).
const XATTR_MAX: usize = 64 << 10;

const READ: OFlags = OFlags::RDONLY.union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC).union(OFlags::NONBLOCK);
const DIRECTORY: OFlags = READ.union(OFlags::DIRECTORY);

/// Packer of a file tree.
pub(crate) struct Packer<'a, W: Write> {
    writer: TarWriter<W>,
    options: &'a TreeOptions,
    exclude: Globs,
    root: PathBuf,
    /// First path of each file with several hard links, by device and inode.
    links: HashMap<(u64, u64), Vec<u8>>,
    buffer: Vec<u8>,
    /// Buffer for the attribute names of a file.
    attribute_names: Vec<u8>,
}

impl<'a, W: Write> Packer<'a, W> {
    pub(crate) fn new(writer: TarWriter<W>, options: &'a TreeOptions) -> Self {
        Self {
            writer,
            options,
            exclude: Globs::new(&options.exclude),
            root: PathBuf::new(),
            links: HashMap::new(),
            buffer: vec![0; BUFFER],
            attribute_names: vec![0; XATTR_MAX],
        }
    }

    /// Packs everything below `tree`.
    pub(crate) fn pack(&mut self, tree: &Path) -> Result<(), Error> {
        self.root = tree.to_owned();
        let root = rustix::fs::open(tree, DIRECTORY, Mode::empty())
            .map_err(|error| Error::file("open the directory", tree, error))?;
        self.pack_directory(root.as_fd(), b"", 0)
    }

    /// Writes the end mark and returns the output.
    pub(crate) fn finish(self) -> io::Result<W> {
        self.writer.finish()
    }

    fn pack_directory(&mut self, directory: BorrowedFd<'_>, path: &[u8], depth: usize) -> Result<(), Error> {
        if depth > MAX_DEPTH {
            return Err(self.tree_error(path, format!("it is more than {MAX_DEPTH} directories deep")));
        }
        let mut children = Vec::new();
        for name in self.list_names(directory, path)? {
            let child = join(path, &name);
            if self.exclude.matches(&child, &name) {
                continue;
            }
            let stat = rustix::fs::statat(directory, &name[..], AtFlags::SYMLINK_NOFOLLOW)
                .map_err(|error| self.file_error("look at", &child, error))?;
            if self.is_whiteout(&stat) {
                // Whiteouts come first, as the specification recommends.
                self.write(&Entry {
                    mtime: self.mtime(0),
                    ..Entry::new(join(path, &[WHITEOUT, &name].concat()), Kind::File, 0o644)
                })?;
                continue;
            }
            if name.starts_with(WHITEOUT) {
                return Err(self.tree_error(&child, "names that begin with .wh. mean deletions; rename it"));
            }
            children.push((name, child, stat));
        }
        for (name, child, stat) in children {
            self.pack_child(directory, &name, child, &stat, depth)?;
        }
        Ok(())
    }

    /// Returns the names in a directory, sorted bytewise.
    fn list_names(&self, directory: BorrowedFd<'_>, path: &[u8]) -> Result<Vec<Vec<u8>>, Error> {
        let failed = |error| self.file_error("list", path, error);
        let mut names = Vec::new();
        for entry in Dir::read_from(directory).map_err(failed)? {
            let name = entry.map_err(failed)?.file_name().to_bytes().to_vec();
            if name != b"." && name != b".." {
                names.push(name);
            }
        }
        names.sort_unstable();
        Ok(names)
    }

    fn pack_child(
        &mut self,
        parent: BorrowedFd<'_>,
        name: &[u8],
        path: Vec<u8>,
        stat: &Stat,
        depth: usize,
    ) -> Result<(), Error> {
        let mut entry = Entry {
            uid: self.mapped_id(stat.st_uid),
            gid: self.mapped_id(stat.st_gid),
            mtime: self.mtime(stat.st_mtime),
            ..Entry::new(path, Kind::File, stat.st_mode & 0o7777)
        };
        let kind = FileType::from_raw_mode(stat.st_mode);
        if kind != FileType::Directory && stat.st_nlink > 1 {
            if let Some(first) = self.links.get(&(stat.st_dev, stat.st_ino)) {
                (entry.kind, entry.link) = (Kind::Hardlink, first.clone());
                return self.write(&entry);
            }
            self.links.insert((stat.st_dev, stat.st_ino), entry.name.clone());
        }
        match kind {
            FileType::Directory => {
                let directory = self.open(parent, name, &entry.name, DIRECTORY)?;
                let attributes = self.list_and_read_attributes(directory.as_fd(), &entry.name)?;
                let path = std::mem::take(&mut entry.name);
                entry.kind = Kind::Directory;
                entry.name = [&path[..], b"/"].concat();
                entry.xattrs = attributes.kept;
                self.write(&entry)?;
                if attributes.opaque {
                    let opaque = Entry::new(join(&path, OPAQUE), Kind::File, 0o644);
                    self.write(&Entry { mtime: self.mtime(0), ..opaque })?;
                }
                self.pack_directory(directory.as_fd(), &path, depth + 1)
            }
            FileType::RegularFile => self.pack_file(parent, name, entry, stat),
            FileType::Symlink => {
                entry.kind = Kind::Symlink;
                // On Linux every link has all permissions; those of other systems must not make a difference.
                entry.mode = 0o777;
                entry.link = rustix::fs::readlinkat(parent, name, Vec::new())
                    .map_err(|error| self.file_error("read the link", &entry.name, error))?
                    .into_bytes();
                self.write(&entry)
            }
            FileType::CharacterDevice | FileType::BlockDevice => {
                entry.kind = if kind == FileType::BlockDevice { Kind::Block } else { Kind::Character };
                entry.device = (rustix::fs::major(stat.st_rdev), rustix::fs::minor(stat.st_rdev));
                self.write(&entry)
            }
            FileType::Fifo => {
                entry.kind = Kind::Fifo;
                self.write(&entry)
            }
            // A socket is useless without the process that listens on it.
            _ => Ok(()),
        }
    }

    fn pack_file(&mut self, parent: BorrowedFd<'_>, name: &[u8], mut entry: Entry, stat: &Stat) -> Result<(), Error> {
        let file = File::from(self.open(parent, name, &entry.name, READ)?);
        let now = rustix::fs::fstat(&file).map_err(|error| self.file_error("look at", &entry.name, error))?;
        if (now.st_dev, now.st_ino) != (stat.st_dev, stat.st_ino) {
            return Err(self.tree_error(&entry.name, "it was replaced while it was read"));
        }
        entry.size = now.st_size as u64;
        entry.xattrs = self.list_and_read_attributes(file.as_fd(), &entry.name)?.kept;
        let mut buffer = std::mem::take(&mut self.buffer);
        let written = self.writer.write_file(&entry, &file, &mut buffer);
        self.buffer = buffer;
        written.map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => self.tree_error(&entry.name, "it became shorter while it was read"),
            _ => Error::file("pack", self.full_path(&entry.name), error),
        })
    }

    fn open(&self, parent: BorrowedFd<'_>, name: &[u8], path: &[u8], flags: OFlags) -> Result<OwnedFd, Error> {
        rustix::fs::openat(parent, name, flags, Mode::empty()).map_err(|error| self.file_error("open", path, error))
    }

    fn write(&mut self, entry: &Entry) -> Result<(), Error> {
        self.writer.write_header(entry).map_err(|error| Error::file("pack", self.full_path(&entry.name), error))
    }

    /// Returns whether a file is an overlay's deletion mark: a character device with number 0:0.
    fn is_whiteout(&self, stat: &Stat) -> bool {
        self.options.overlay_upper
            && FileType::from_raw_mode(stat.st_mode) == FileType::CharacterDevice
            && stat.st_rdev == 0
    }

    fn mapped_id(&self, on_disk: u32) -> u64 {
        u64::from(on_disk.saturating_sub(self.options.uid_offset))
    }

    fn mtime(&self, on_disk: i64) -> u64 {
        match self.options.mtime {
            Mtime::Fixed(time) => time,
            Mtime::Clamp(latest) => u64::try_from(on_disk).unwrap_or(0).min(latest),
        }
    }

    fn list_and_read_attributes(&mut self, file: BorrowedFd<'_>, path: &[u8]) -> Result<Attributes, Error> {
        let mut names = std::mem::take(&mut self.attribute_names);
        let result = match rustix::fs::flistxattr(file, &mut names[..]) {
            Ok(0) | Err(Errno::NOTSUP) => Ok(Attributes::default()),
            Ok(length) => self.read_attributes(file, path, &names[..length]),
            Err(error) => Err(self.file_error("list the attributes of", path, error)),
        };
        self.attribute_names = names;
        result
    }

    fn read_attributes(&self, file: BorrowedFd<'_>, path: &[u8], names: &[u8]) -> Result<Attributes, Error> {
        let mut found = Attributes::default();
        let mut value = vec![0; XATTR_MAX];
        let mut names: Vec<&[u8]> = names.split(|&byte| byte == 0).filter(|name| !name.is_empty()).collect();
        names.sort_unstable();
        for name in names {
            let length = rustix::fs::fgetxattr(file, name, &mut value[..])
                .map_err(|error| self.file_error("read an attribute of", path, error))?;
            self.add_attribute(&mut found, name, &value[..length], path)?;
        }
        Ok(found)
    }

    fn add_attribute(&self, found: &mut Attributes, name: &[u8], value: &[u8], path: &[u8]) -> Result<(), Error> {
        let overlay = [&b"trusted.overlay."[..], b"user.overlay."].into_iter().find_map(|own| name.strip_prefix(own));
        match overlay {
            Some(b"opaque") if self.options.overlay_upper => found.opaque |= value == b"y",
            Some(b"redirect" | b"metacopy") if self.options.overlay_upper => {
                return Err(self.tree_error(
                    path,
                    "its content is partly in another layer; mount the overlay with \
                                               redirect_dir=off,metacopy=off",
                ));
            }
            Some(_) => {}
            None if name == capability::NAME => {
                if let Some(value) = capability::as_version_2(value, self.options.uid_offset) {
                    found.kept.push((name.to_vec(), value));
                }
            }
            None if name.starts_with(b"user.") => found.kept.push((name.to_vec(), value.to_vec())),
            None => {}
        }
        Ok(())
    }

    fn full_path(&self, path: &[u8]) -> PathBuf {
        self.root.join(std::ffi::OsStr::from_bytes(path))
    }

    fn file_error(&self, action: &'static str, path: &[u8], error: Errno) -> Error {
        Error::file(action, self.full_path(path), error)
    }

    fn tree_error(&self, path: &[u8], problem: impl Into<String>) -> Error {
        Error::Tree { path: self.full_path(path), problem: problem.into() }
    }
}

/// Extended attributes of a file.
#[derive(Default)]
struct Attributes {
    kept: Vec<(Vec<u8>, Vec<u8>)>,
    opaque: bool,
}
