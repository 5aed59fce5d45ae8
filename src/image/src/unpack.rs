//! Unpacks untrusted archives: files, directories and links, and nothing outside of the destination.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;

use flate2::bufread::MultiGzDecoder;
use rustix::fs::{AtFlags, FileType, Mode, OFlags, ResolveFlags};
use rustix::io::Errno;

use crate::beneath::{self, Beneath, is, look};
use crate::entry::{Entry, Kind, shown};
use crate::gzip::{self, Format};
use crate::names::{self, split};
use crate::tar_reader::{Stop, TarReader};
use crate::{Error, Refusal, files};

/// How much an archive may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Files, directories and links; extended headers count as much.
    pub entries: u64,
    /// Bytes of the uncompressed archive.
    pub bytes: u64,
    /// Bytes of one entry's path.
    pub path: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            entries: 200_000,
            bytes: 8 << 30,
            path: 1024,
        }
    }
}

/// What was unpacked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Unpacked {
    /// Files, directories and links.
    pub entries: u64,
    /// Bytes in files.
    pub bytes: u64,
}

/// What messages call a stream.
const STREAM: &str = "the archive";

/// Unpacks a tar stream, gzip or not, into `destination`, which must not exist yet or be empty.
///
/// Files belong to this process; of their rights only "executable" is taken over. The stream is read to its end.
/// On any failure `destination` is removed, and a refusal ([`Error::Archive`]) names the entry.
///
/// # Errors
/// [`Error::Archive`] for `..`, absolute paths, devices, links that leave the tree, paths behind links, second
/// entries of one name, unusable names, more than `limits` allow, and a stream that is cut off or damaged;
/// [`Error::DiskFull`] and [`Error::File`] otherwise.
pub fn unpack(archive: impl Read, destination: &Path, limits: &Limits) -> Result<Unpacked, Error> {
    claim(destination)?;
    let result = unpack_into(archive, destination, limits);
    if result.is_err() {
        if let Err(error) = files::remove_tree(destination) {
            tracing::warn!(%error, "a refused archive's files remain");
        }
    }
    result
}

/// Makes the destination; one that exists must be empty, as it is removed on failure.
fn claim(destination: &Path) -> Result<(), Error> {
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

fn unpack_into(archive: impl Read, destination: &Path, limits: &Limits) -> Result<Unpacked, Error> {
    let mut input = BufReader::with_capacity(256 << 10, archive);
    let stopped = |stop| Error::stopped(STREAM, Path::new(STREAM), stop);
    let format = gzip::detect(&mut input).map_err(|error| stopped(Stop::Source(error)))?;
    let input: Box<dyn Read + '_> = match format {
        Format::Gzip => Box::new(MultiGzDecoder::new(input)),
        Format::Plain => Box::new(input),
        Format::Zstd => {
            let problem = "it is compressed with zstd".to_owned();
            return Err(stopped(Stop::Refused(Refusal::Malformed {
                after: String::new(),
                problem,
            })));
        }
    };
    let reader = TarReader::new(Metered {
        input,
        left: limits.bytes,
        exceeded: false,
    });
    let beneath =
        Beneath::strict(destination).map_err(|error| Error::file("open", destination, error))?;
    Unpacker {
        reader,
        beneath,
        destination,
        limits,
        done: Unpacked::default(),
        unsure: Vec::new(),
        buffer: vec![0; 256 << 10],
    }
    .run()
}

struct Unpacker<'a, R> {
    reader: TarReader<Metered<R>>,
    /// Refuses symbolic links on the way to anything.
    beneath: Beneath,
    destination: &'a Path,
    limits: &'a Limits,
    done: Unpacked,
    /// Symbolic links that only a look at the whole tree can clear, and their targets.
    unsure: Vec<(Vec<u8>, Vec<u8>)>,
    buffer: Vec<u8>,
}

impl<R: Read> Unpacker<'_, R> {
    fn run(mut self) -> Result<Unpacked, Error> {
        let mut last = Vec::new();
        loop {
            let next = self.reader.next_entry();
            let Some(entry) = next.map_err(|stop| self.stopped(stop, &last))? else {
                break;
            };
            self.entry(&entry)?;
            last = entry.name;
        }
        self.clear_unsure_links()?;
        // To the end, for gzip's own checksum, and for a sender that waits until all was read.
        let mut rest = [0; 4096];
        loop {
            match self.reader.source().read(&mut rest) {
                Ok(0) => return Ok(self.done),
                Ok(_) => {}
                Err(error) => {
                    let stop = self.reader.stop(error);
                    return Err(self.stopped(stop, &last));
                }
            }
        }
    }

    fn entry(&mut self, entry: &Entry) -> Result<(), Error> {
        self.done.entries += 1;
        if self.reader.headers() > self.limits.entries {
            return Err(refused(Refusal::TooManyEntries {
                entry: shown(&entry.name),
                limit: self.limits.entries,
            }));
        }
        if entry.name.starts_with(b"/") {
            return Err(refused(Refusal::AbsolutePath {
                entry: shown(&entry.name),
            }));
        }
        let path = names::normal(&entry.name, self.limits.path).map_err(refused)?;
        if path.is_empty() {
            // The root of the archive itself, "./".
            return if entry.kind == Kind::Directory {
                Ok(())
            } else {
                Err(refused(unnamed(entry)))
            };
        }
        match entry.kind {
            Kind::Directory => self.directory(entry, &path),
            Kind::File => self.file(entry, &path),
            Kind::Symlink => self.symlink(entry, &path),
            Kind::Hardlink => self.hardlink(entry, &path),
            kind => Err(refused(Refusal::special(&entry.name, kind))),
        }
    }

    fn directory(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        match self.beneath.make_directory(path) {
            Ok(_) => Ok(()),
            Err(error) => Err(self.no_directory(entry, path, error)),
        }
    }

    fn file(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        let parent = self.parent(entry, path)?;
        let file = beneath::create(&parent, split(path).1)
            .map_err(|error| self.not_made(entry, path, error))?;
        let mut file = File::from(file);
        loop {
            let read = match self.reader.read(&mut self.buffer) {
                Ok(read) => read,
                Err(error) => {
                    let stop = self.reader.stop(error);
                    return Err(self.stopped(stop, &entry.name));
                }
            };
            if read == 0 {
                break;
            }
            let written = file.write_all(&self.buffer[..read]);
            written.map_err(|error| {
                Error::file("write", self.shown(path), error).needing(entry.size)
            })?;
            self.done.bytes += read as u64;
        }
        let mode = if entry.mode & 0o111 == 0 {
            0o644
        } else {
            0o755
        };
        rustix::fs::fchmod(&file, Mode::from_raw_mode(mode))
            .map_err(|error| Error::file("set the rights of", self.shown(path), error))
    }

    fn symlink(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        let above = split(path).0;
        match target_of(above, &entry.link) {
            Target::Leaves => return Err(refused(leaves(entry))),
            Target::Unsure => self.unsure.push((path.to_vec(), entry.link.clone())),
            Target::Within => {}
        }
        let parent = self.parent(entry, path)?;
        rustix::fs::symlinkat(&entry.link[..], &parent, split(path).1)
            .map_err(|error| self.not_made(entry, path, error))
    }

    fn hardlink(&mut self, entry: &Entry, path: &[u8]) -> Result<(), Error> {
        if entry.link.starts_with(b"/") {
            return Err(refused(leaves(entry)));
        }
        let target = match names::normal(&entry.link, self.limits.path) {
            Ok(target) => target,
            Err(Refusal::ParentDirectory { .. }) => return Err(refused(leaves(entry))),
            Err(other) => return Err(refused(other)),
        };
        let (target_above, target_name) = split(&target);
        let nothing = || {
            refused(Refusal::LinkToNothing {
                entry: shown(&entry.name),
                target: shown(&entry.link),
            })
        };
        let from = self
            .beneath
            .directory(target_above)
            .map_err(|_| nothing())?;
        // A link to a symbolic link would give its relative target another meaning.
        let there = look(&from, target_name).map_err(|_| nothing())?;
        if !there.is_some_and(|stat| is(&stat, FileType::RegularFile)) {
            return Err(nothing());
        }
        let parent = self.parent(entry, path)?;
        rustix::fs::linkat(&from, target_name, &parent, split(path).1, AtFlags::empty())
            .map_err(|error| self.not_made(entry, path, error))
    }

    fn parent(&mut self, entry: &Entry, path: &[u8]) -> Result<std::rc::Rc<OwnedFd>, Error> {
        let above = split(path).0;
        self.beneath
            .make_directory(above)
            .map_err(|error| self.no_directory(entry, above, error))
    }

    /// Why the directory `path` could not be had for `entry`.
    fn no_directory(&mut self, entry: &Entry, path: &[u8], error: Errno) -> Error {
        match error {
            Errno::LOOP | Errno::NOTDIR | Errno::EXIST => {
                let link = self.first_link(path);
                refused(match link {
                    Some(link) if link != path || entry.kind != Kind::Directory => {
                        Refusal::BehindLink {
                            entry: shown(&entry.name),
                            link: shown(&link),
                        }
                    }
                    _ => Refusal::Duplicate {
                        entry: shown(&entry.name),
                    },
                })
            }
            error => Error::file("create", self.shown(path), error),
        }
    }

    fn not_made(&self, entry: &Entry, path: &[u8], error: Errno) -> Error {
        match error {
            Errno::EXIST => refused(Refusal::Duplicate {
                entry: shown(&entry.name),
            }),
            error => Error::file("create", self.shown(path), error),
        }
    }

    /// The first part of a path that is a symbolic link.
    fn first_link(&mut self, path: &[u8]) -> Option<Vec<u8>> {
        let ends = (0..=path.len()).filter(|&at| at == path.len() || path[at] == b'/');
        for end in ends {
            let (above, name) = split(&path[..end]);
            let parent = self.beneath.directory(above).ok()?;
            let stat = look(&parent, name).ok()??;
            if is(&stat, FileType::Symlink) {
                return Some(path[..end].to_vec());
            }
        }
        None
    }

    /// Targets that go down and up again, such as `a/../b`, depend on whether `a` is a link: the kernel resolves
    /// them in the finished tree and says whether they stay inside.
    fn clear_unsure_links(&self) -> Result<(), Error> {
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
                return Err(refused(Refusal::LinkLeaves {
                    entry: shown(path),
                    target: shown(target),
                }));
            }
        }
        Ok(())
    }

    fn stopped(&mut self, stop: Stop, entry: &[u8]) -> Error {
        if self.reader.source().exceeded {
            return refused(Refusal::TooLarge {
                entry: shown(entry),
                limit: self.limits.bytes,
            });
        }
        Error::stopped(STREAM, Path::new(STREAM), stop)
    }

    fn shown(&self, path: &[u8]) -> std::path::PathBuf {
        use std::os::unix::ffi::OsStrExt;
        self.destination.join(std::ffi::OsStr::from_bytes(path))
    }
}

fn refused(problem: Refusal) -> Error {
    Error::Archive {
        archive: STREAM.to_owned(),
        problem,
    }
}

fn unnamed(entry: &Entry) -> Refusal {
    Refusal::BadName {
        entry: shown(&entry.name),
        problem: "it is the root of the archive".to_owned(),
    }
}

fn leaves(entry: &Entry) -> Refusal {
    Refusal::LinkLeaves {
        entry: shown(&entry.name),
        target: shown(&entry.link),
    }
}

/// Where a symbolic link leads, as far as its text tells.
enum Target {
    Within,
    Leaves,
    Unsure,
}

/// `above` is the link's own directory, which holds no links itself: leading `..` count exactly. What follows
/// them only goes down, through links that were judged themselves, unless another `..` comes.
fn target_of(above: &[u8], target: &[u8]) -> Target {
    if target.starts_with(b"/") || target.is_empty() || target.contains(&0) {
        return Target::Leaves;
    }
    let depth = above
        .split(|&byte| byte == b'/')
        .filter(|part| !part.is_empty())
        .count();
    let parts: Vec<&[u8]> = target
        .split(|&byte| byte == b'/')
        .filter(|part| !matches!(*part, b"" | b"."))
        .collect();
    let ups = parts.iter().take_while(|part| **part == b"..").count();
    if ups > depth {
        return Target::Leaves;
    }
    if parts[ups..].contains(&&b".."[..]) {
        Target::Unsure
    } else {
        Target::Within
    }
}

/// Ends the stream with an error when it is longer than allowed.
struct Metered<R> {
    input: R,
    left: u64,
    exceeded: bool,
}

impl<R: Read> Read for Metered<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        foreign::cancel::check()?;
        // One byte more than allowed tells "just fits" from "too long".
        let most = usize::try_from(self.left.saturating_add(1))
            .unwrap_or(usize::MAX)
            .min(buffer.len());
        let read = self.input.read(&mut buffer[..most])?;
        if read as u64 > self.left {
            self.exceeded = true;
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "it is too large",
            ));
        }
        self.left -= read as u64;
        Ok(read)
    }
}

#[cfg(test)]
mod tests;
