//! Unpacking of untrusted archives: files, directories and links, and nothing outside the destination.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;

use flate2::bufread::MultiGzDecoder;
use rustix::fs::{AtFlags, FileType, Mode, OFlags, ResolveFlags};
use rustix::io::Errno;

use crate::beneath::{self, ConfinedRoot, is_kind, stat_entry};
use crate::entry::{Entry, Kind, display_name};
use crate::gzip::{self, Format};
use crate::names::{self, split};
use crate::tar_reader::{ReadStop, TarReader};
use crate::{Error, Refusal, files};

/// Limits of an archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum number of files, directories and links; extended headers count as well.
    pub entries: u64,
    /// Maximum size of the uncompressed archive in bytes.
    pub bytes: u64,
    /// Maximum length of an entry's path in bytes.
    pub path: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { entries: 200_000, bytes: 8 << 30, path: 1024 }
    }
}

/// Statistics of an unpacked archive.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct UnpackStats {
    /// Number of files, directories and links.
    pub entries: u64,
    /// Total size of the files in bytes.
    pub bytes: u64,
}

/// Name of a stream in messages.
const STREAM: &str = "the archive";

/// Unpacks a tar stream, gzip or not, into `destination`, which must not exist yet or be empty.
///
/// Files are owned by this process; of their permissions only "executable" is kept. The stream is read to its end. On
/// any failure `destination` is removed, and a refusal ([`Error::Archive`]) names the entry.
///
/// # Errors
/// [`Error::Archive`] for `..`, absolute paths, devices, links that leave the tree, paths behind links, duplicate
/// entries, unusable names, archives that exceed `limits`, and a truncated or corrupt stream; [`Error::DiskFull`] and
/// [`Error::File`] otherwise.
pub fn unpack(archive: impl Read, destination: &Path, limits: &Limits) -> Result<UnpackStats, Error> {
    claim_destination(destination)?;
    let result = unpack_into(archive, destination, limits);
    if result.is_err() {
        if let Err(error) = files::remove_tree(destination) {
            tracing::warn!(%error, "cannot remove the files of a refused archive");
        }
    }
    result
}

/// Creates the destination; an existing one must be empty, since it is removed on failure.
fn claim_destination(destination: &Path) -> Result<(), Error> {
    let made = std::fs::DirBuilder::new().mode(0o755).create(destination);
    match made {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && destination.is_dir() => {
            if files::list(destination)?.is_empty() {
                return Ok(());
            }
            let error = io::Error::new(io::ErrorKind::DirectoryNotEmpty, "it is not empty");
            Err(Error::file("unpack into", destination, error))
        }
        other => other.map_err(|error| Error::file("create", destination, error)),
    }
}

fn unpack_into(archive: impl Read, destination: &Path, limits: &Limits) -> Result<UnpackStats, Error> {
    let mut input = BufReader::with_capacity(256 << 10, archive);
    let stopped = |stop| Error::from_stop(STREAM, Path::new(STREAM), stop);
    let format = gzip::detect_format(&mut input).map_err(|error| stopped(ReadStop::Source(error)))?;
    let input: Box<dyn Read + '_> = match format {
        Format::Gzip => Box::new(MultiGzDecoder::new(input)),
        Format::Plain => Box::new(input),
        Format::Zstd => {
            let problem = "it is compressed with zstd".to_owned();
            return Err(stopped(ReadStop::Refused(Refusal::Malformed { after: String::new(), problem })));
        }
    };
    let reader = TarReader::new(MeteredReader { input, left: limits.bytes, exceeded: false });
    let beneath = ConfinedRoot::without_links(destination).map_err(|error| Error::file("open", destination, error))?;
    Unpacker {
        reader,
        beneath,
        destination,
        limits,
        done: UnpackStats::default(),
        unsure: Vec::new(),
        buffer: vec![0; 256 << 10],
    }
    .run()
}

struct Unpacker<'a, R> {
    reader: TarReader<MeteredReader<R>>,
    /// Destination, in which symbolic links on a path are rejected.
    beneath: ConfinedRoot,
    destination: &'a Path,
    limits: &'a Limits,
    done: UnpackStats,
    /// Symbolic links whose targets can only be checked in the complete tree, and these targets.
    unsure: Vec<(Vec<u8>, Vec<u8>)>,
    buffer: Vec<u8>,
}

impl<R: Read> Unpacker<'_, R> {
    fn run(mut self) -> Result<UnpackStats, Error> {
        let mut last = Vec::new();
        loop {
            let next = self.reader.next_entry();
            let Some(entry) = next.map_err(|stop| self.stop_error(stop, &last))? else {
                break;
            };
            self.unpack_entry(&entry)?;
            last = entry.name;
        }
        self.check_unsure_links()?;
        // To the end, for the checksum of gzip, and for a sender that waits until everything was read.
        let mut rest = [0; 4096];
        loop {
            match self.reader.source().read(&mut rest) {
                Ok(0) => return Ok(self.done),
                Ok(_) => {}
                Err(error) => {
                    let stop = self.reader.classify_error(error);
                    return Err(self.stop_error(stop, &last));
                }
            }
        }
    }

    fn unpack_entry(&mut self, entry: &Entry) -> Result<(), Error> {
        self.done.entries += 1;
        if self.reader.headers() > self.limits.entries {
            return Err(refusal_error(Refusal::TooManyEntries {
                entry: display_name(&entry.name),
                limit: self.limits.entries,
            }));
        }
        if entry.name.starts_with(b"/") {
            return Err(refusal_error(Refusal::AbsolutePath { entry: display_name(&entry.name) }));
        }
        let path = names::normalize(&entry.name, self.limits.path).map_err(refusal_error)?;
        if path.is_empty() {
            // The root of the archive itself, "./".
            return if entry.kind == Kind::Directory { Ok(()) } else { Err(refusal_error(root_refusal(entry))) };
        }
        match entry.kind {
            Kind::Directory => self.unpack_directory(entry, &path),
            Kind::File => self.unpack_file(entry, &path),
            Kind::Symlink => self.unpack_symlink(entry, &path),
            Kind::Hardlink => self.unpack_hardlink(entry, &path),
            kind => Err(refusal_error(Refusal::special(&entry.name, kind))),
        }
    }

    fn unpack_directory(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        match self.beneath.make_directory(path) {
            Ok(_) => Ok(()),
            Err(error) => Err(self.directory_error(entry, path, error)),
        }
    }

    fn unpack_file(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        let parent = self.make_parent(entry, path)?;
        let file = beneath::create(&parent, split(path).1).map_err(|error| self.create_error(entry, path, error))?;
        let mut file = File::from(file);
        loop {
            let read = match self.reader.read(&mut self.buffer) {
                Ok(read) => read,
                Err(error) => {
                    let stop = self.reader.classify_error(error);
                    return Err(self.stop_error(stop, &entry.name));
                }
            };
            if read == 0 {
                break;
            }
            let written = file.write_all(&self.buffer[..read]);
            written.map_err(|error| Error::file("write", self.full_path(path), error).with_needed_bytes(entry.size))?;
            self.done.bytes += read as u64;
        }
        let mode = if entry.mode & 0o111 == 0 { 0o644 } else { 0o755 };
        rustix::fs::fchmod(&file, Mode::from_raw_mode(mode))
            .map_err(|error| Error::file("set the rights of", self.full_path(path), error))
    }

    fn unpack_symlink(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        let above = split(path).0;
        match classify_target(above, &entry.link) {
            LinkTarget::Leaves => return Err(refusal_error(link_leaves(entry))),
            LinkTarget::Unsure => self.unsure.push((path.to_vec(), entry.link.clone())),
            LinkTarget::Within => {}
        }
        let parent = self.make_parent(entry, path)?;
        rustix::fs::symlinkat(&entry.link[..], &parent, split(path).1)
            .map_err(|error| self.create_error(entry, path, error))
    }

    fn unpack_hardlink(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        if entry.link.starts_with(b"/") {
            return Err(refusal_error(link_leaves(entry)));
        }
        let target = match names::normalize(&entry.link, self.limits.path) {
            Ok(target) => target,
            Err(Refusal::ParentDirectory { .. }) => return Err(refusal_error(link_leaves(entry))),
            Err(other) => return Err(refusal_error(other)),
        };
        let (target_above, target_name) = split(&target);
        let nothing = || {
            refusal_error(Refusal::LinkToNothing {
                entry: display_name(&entry.name),
                target: display_name(&entry.link),
            })
        };
        let from = self.beneath.directory(target_above).map_err(|_| nothing())?;
        // In a link to a symbolic link, a relative target would have another meaning.
        let there = stat_entry(&from, target_name).map_err(|_| nothing())?;
        if !there.is_some_and(|stat| is_kind(&stat, FileType::RegularFile)) {
            return Err(nothing());
        }
        let parent = self.make_parent(entry, path)?;
        rustix::fs::linkat(&from, target_name, &parent, split(path).1, AtFlags::empty())
            .map_err(|error| self.create_error(entry, path, error))
    }

    fn make_parent(&mut self, entry: &Entry, path: &[u8]) -> Result<std::rc::Rc<OwnedFd>, Error> {
        let above = split(path).0;
        self.beneath.make_directory(above).map_err(|error| self.directory_error(entry, above, error))
    }

    /// Returns the error of failing to open or create the directory `path` for `entry`.
    fn directory_error(&mut self, entry: &Entry, path: &[u8], error: Errno) -> Error {
        match error {
            Errno::LOOP | Errno::NOTDIR | Errno::EXIST => {
                let link = self.first_link(path);
                refusal_error(match link {
                    Some(link) if link != path || entry.kind != Kind::Directory => {
                        Refusal::BehindLink { entry: display_name(&entry.name), link: display_name(&link) }
                    }
                    _ => Refusal::Duplicate { entry: display_name(&entry.name) },
                })
            }
            error => Error::file("create", self.full_path(path), error),
        }
    }

    fn create_error(&self, entry: &Entry, path: &[u8], error: Errno) -> Error {
        match error {
            Errno::EXIST => refusal_error(Refusal::Duplicate { entry: display_name(&entry.name) }),
            error => Error::file("create", self.full_path(path), error),
        }
    }

    /// Returns the first prefix of a path that is a symbolic link.
    fn first_link(&mut self, path: &[u8]) -> Option<Vec<u8>> {
        let ends = (0..=path.len()).filter(|&at| at == path.len() || path[at] == b'/');
        for end in ends {
            let (above, name) = split(&path[..end]);
            let parent = self.beneath.directory(above).ok()?;
            let stat = stat_entry(&parent, name).ok()??;
            if is_kind(&stat, FileType::Symlink) {
                return Some(path[..end].to_vec());
            }
        }
        None
    }

    /// Checks targets that go down and up again, such as `a/../b`, which depend on whether `a` is a link: the kernel
    /// resolves them in the complete tree and decides whether they stay inside.
    fn check_unsure_links(&self) -> Result<(), Error> {
        for (path, target) in &self.unsure {
            let resolve = ResolveFlags::BENEATH | ResolveFlags::NO_MAGICLINKS;
            let opened = rustix::fs::openat2(
                self.beneath.root(),
                &path[..],
                OFlags::PATH | OFlags::CLOEXEC,
                Mode::empty(),
                resolve,
            );
            if opened.is_err() {
                return Err(refusal_error(Refusal::LinkLeaves {
                    entry: display_name(path),
                    target: display_name(target),
                }));
            }
        }
        Ok(())
    }

    fn stop_error(&mut self, stop: ReadStop, entry: &[u8]) -> Error {
        if self.reader.source().exceeded {
            return refusal_error(Refusal::TooLarge { entry: display_name(entry), limit: self.limits.bytes });
        }
        Error::from_stop(STREAM, Path::new(STREAM), stop)
    }

    fn full_path(&self, path: &[u8]) -> std::path::PathBuf {
        use std::os::unix::ffi::OsStrExt;
        self.destination.join(std::ffi::OsStr::from_bytes(path))
    }
}

fn refusal_error(problem: Refusal) -> Error {
    Error::Archive { archive: STREAM.to_owned(), problem }
}

fn root_refusal(entry: &Entry) -> Refusal {
    Refusal::BadName { entry: display_name(&entry.name), problem: "it is the root of the archive".to_owned() }
}

fn link_leaves(entry: &Entry) -> Refusal {
    Refusal::LinkLeaves { entry: display_name(&entry.name), target: display_name(&entry.link) }
}

/// Result of checking the text of a symbolic link's target.
enum LinkTarget {
    Within,
    Leaves,
    Unsure,
}

/// Classifies the target of a link in directory `above`, which contains no links itself, so leading `..` count exactly.
/// The rest only goes down, through links that were checked themselves, unless it contains another `..`.
fn classify_target(above: &[u8], target: &[u8]) -> LinkTarget {
    if target.starts_with(b"/") || target.is_empty() || target.contains(&0) {
        return LinkTarget::Leaves;
    }
    let depth = above.split(|&byte| byte == b'/').filter(|part| !part.is_empty()).count();
    let parts: Vec<&[u8]> = target.split(|&byte| byte == b'/').filter(|part| !matches!(*part, b"" | b".")).collect();
    let ups = parts.iter().take_while(|part| **part == b"..").count();
    if ups > depth {
        return LinkTarget::Leaves;
    }
    if parts[ups..].contains(&&b".."[..]) { LinkTarget::Unsure } else { LinkTarget::Within }
}

/// Reader that fails when the stream exceeds its limit.
struct MeteredReader<R> {
    input: R,
    left: u64,
    exceeded: bool,
}

impl<R: Read> Read for MeteredReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        foreign::cancel::check()?;
        // One extra byte distinguishes "just fits" from "too long".
        let most = usize::try_from(self.left.saturating_add(1)).unwrap_or(usize::MAX).min(buffer.len());
        let read = self.input.read(&mut buffer[..most])?;
        if read as u64 > self.left {
            self.exceeded = true;
            return Err(io::Error::new(io::ErrorKind::InvalidData, "it is too large"));
        }
        self.left -= read as u64;
        Ok(read)
    }
}

#[cfg(test)]
mod tests;
