//! Index of which Debian package contains which file: the archive's Contents lists, reduced once to what is looked up
//! in them (ROS packages and their programs, shared libraries, what CMake and Python look for) in a small sorted file.
//!
//! The lists are 670 MB of text for bookworm; the result is 4 MB and is searched in place.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use flate2::read::MultiGzDecoder;

use crate::error::{Error, IoContext};
use crate::spelling;

/// The reduced index.
#[derive(Debug)]
pub struct Contents {
    /// Sorted lines: `lNAME\tDEB` for libraries, `rNAME\tDEB\tKINDS` for ROS packages, `cNAME\tDEB` for CMake
    /// configuration files (NAME in lower case), `gNAME\tDEB` for pkg-config modules, `mNAME\tDEB` for Python modules,
    /// `pNAME\tDEB\tROSPACKAGE` for programs of ROS packages.
    lines: Vec<String>,
}

/// Part of a ROS package contained in a Debian package.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RosPackagePart {
    /// Manifest: `share/P/package.xml`.
    Manifest,
    /// Programs: `lib/P/…`.
    Programs,
    /// Python module.
    Python,
    /// Definitions: `share/P/{msg,srv,action}/…`.
    Definitions,
    /// CMake configuration.
    CMake,
    /// Any other file below `share/P`, such as launch files and plugin lists.
    Share,
}

impl RosPackagePart {
    const ALL: [(Self, char); 6] = [
        (Self::Manifest, 'x'),
        (Self::Programs, 'e'),
        (Self::Python, 'p'),
        (Self::Definitions, 'd'),
        (Self::CMake, 'c'),
        (Self::Share, 's'),
    ];

    fn letter(self) -> char {
        Self::ALL.into_iter().find(|(part, _)| *part == self).map_or('?', |(_, letter)| letter)
    }
}

/// Debian package → the parts of a ROS package that it contains.
pub type Carriers = BTreeMap<String, BTreeSet<RosPackagePart>>;

/// Format version; to be increased when the file's format or content changes.
const VERSION: u32 = 4;

impl Contents {
    /// Opens the index of these lists, creating it below `cache` if needed. Blocking: creating it takes a few seconds
    /// on two cores.
    pub fn open(cache: &Path, lists: &[PathBuf]) -> Result<Self, Error> {
        let path = cache.join(format!("contents-{}.txt", stamp(lists)?));
        if !path.is_file() {
            let lines = build_index(lists)?;
            let mut file = tempfile::NamedTempFile::new_in(cache).io_context("creating a file in", cache)?;
            file.write_all(lines.join("\n").as_bytes()).io_context("writing", file.path())?;
            file.as_file().sync_data().io_context("writing", file.path())?;
            file.persist(&path).map_err(|error| Error::io("writing", &path, error.error))?;
            sweep(cache, &path);
        }
        let text = fs::read_to_string(&path).io_context("reading", &path)?;
        Ok(Self { lines: text.lines().map(str::to_owned).collect() })
    }

    /// Reads the result of [`Contents::as_text`].
    pub(crate) fn from_text(text: &str) -> Self {
        let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
        // It comes from another server; lookups rely on the order.
        lines.sort();
        Self { lines }
    }

    /// Returns the text form, for a file.
    pub(crate) fn as_text(&self) -> String {
        self.lines.join("\n")
    }

    /// Returns the lines that begin with `prefix`, without it.
    fn with_prefix<'a>(&'a self, prefix: &'a str) -> impl Iterator<Item = &'a str> {
        let start = self.lines.partition_point(|line| line.as_str() < prefix);
        self.lines[start..].iter().map_while(move |line| line.strip_prefix(prefix))
    }

    /// Returns the Debian package with this shared library, by its soname (`libfoo.so.1`). If there are several, the
    /// one whose name is closest to the library's.
    pub fn library(&self, name: &str) -> Option<&str> {
        let prefix = format!("l{name}\t");
        let start = self.lines.partition_point(|line| line.as_str() < prefix.as_str());
        self.lines[start..]
            .iter()
            .map_while(|line| line.strip_prefix(prefix.as_str()))
            .min_by_key(|deb| (deb.ends_with("-dev"), !deb.starts_with("lib"), deb.len()))
    }

    /// Returns the versions of a library (`libfoo.so.1` for `libfoo.so`) with their Debian packages, shortest name
    /// first.
    pub fn library_versions(&self, name: &str) -> Vec<(String, &str)> {
        let prefix = format!("l{name}.");
        let start = self.lines.partition_point(|line| line.as_str() < prefix.as_str());
        let of_name = self.lines[start..].iter().map_while(|line| line.strip_prefix(prefix.as_str()));
        let mut versions: Vec<(String, &str)> = of_name
            .filter_map(|rest| rest.split_once('\t'))
            .filter(|(_, deb)| !deb.ends_with("-dev"))
            .map(|(version, deb)| (format!("{name}.{version}"), deb))
            .collect();
        versions.sort_by_key(|(name, _)| name.len());
        versions
    }

    /// Returns the Debian packages that contain parts of a ROS package; empty if it is not packaged.
    pub fn ros_package(&self, name: &str) -> Carriers {
        let prefix = format!("r{name}\t");
        let mut carriers = Carriers::new();
        for rest in self.with_prefix(&prefix) {
            let (deb, letters) = rest.split_once('\t').unwrap_or((rest, ""));
            let parts =
                RosPackagePart::ALL.into_iter().filter(|(_, letter)| letters.contains(*letter)).map(|(part, _)| part);
            carriers.insert(deb.to_owned(), parts.collect());
        }
        carriers
    }

    /// Returns the ROS packages whose names differ from this one by a slip of the hand, nearest first.
    pub fn misspelt_ros_packages(&self, name: &str) -> Vec<&str> {
        let fields = self.with_prefix("r").filter_map(|rest| rest.split('\t').next());
        let near = fields.filter_map(|other| Some((spelling::slips(name, other)?, other)));
        let near: BTreeSet<(usize, &str)> = near.collect();
        near.into_iter().map(|(_, other)| other).collect()
    }

    /// Returns the Debian packages that satisfy CMake's `find_package(NAME)`.
    pub fn cmake_config(&self, name: &str) -> BTreeSet<&str> {
        self.debs_with('c', &name.to_lowercase())
    }

    /// Returns the Debian packages with a pkg-config module.
    pub fn pkg_config(&self, name: &str) -> BTreeSet<&str> {
        self.debs_with('g', name)
    }

    /// Returns the Debian packages with a top-level Python module (`numpy` for `numpy.linalg`).
    pub fn python_module(&self, name: &str) -> BTreeSet<&str> {
        self.debs_with('m', name)
    }

    /// Returns the ROS packages with a program of this name, and their Debian packages.
    pub fn programs(&self, name: &str) -> BTreeSet<(&str, &str)> {
        let of_name = self.with_kind('p', name);
        of_name.filter_map(|rest| rest.split_once('\t')).map(|(deb, package)| (package, deb)).collect()
    }

    fn debs_with(&self, kind: char, name: &str) -> BTreeSet<&str> {
        self.with_kind(kind, name).collect()
    }

    fn with_kind(&self, kind: char, name: &str) -> impl Iterator<Item = &str> {
        let prefix = format!("{kind}{name}\t");
        let start = self.lines.partition_point(|line| line.as_str() < prefix.as_str());
        self.lines[start..].iter().map_while(move |line| line.strip_prefix(prefix.as_str()))
    }

    /// Returns the Debian packages that contain parts of any ROS package.
    pub fn ros_carriers(&self) -> BTreeSet<String> {
        let fields = self.with_prefix("r").filter_map(|rest| rest.split('\t').nth(1));
        fields.map(str::to_owned).collect()
    }

    /// Returns the ROS packages with a part in these Debian packages, each with the first of them.
    pub(crate) fn ros_packages_by_deb(&self, debs: &BTreeSet<&str>) -> BTreeMap<String, String> {
        let mut found = BTreeMap::new();
        for (name, rest) in self.with_prefix("r").filter_map(|rest| rest.split_once('\t')) {
            let deb = rest.split('\t').next().unwrap_or(rest);
            if debs.contains(deb) {
                found.entry(name.to_owned()).or_insert_with(|| deb.to_owned());
            }
        }
        found
    }

    /// Returns the ROS packages of which a Debian package contains parts.
    pub fn ros_packages_in(&self, deb: &str) -> Vec<&str> {
        let fields = self.with_prefix("r").filter_map(|rest| rest.split_once('\t'));
        fields.filter(|(_, rest)| rest.split('\t').next() == Some(deb)).map(|(name, _)| name).collect()
    }
}

/// Returns a fingerprint of the lists.
fn stamp(lists: &[PathBuf]) -> Result<String, Error> {
    let mut key = crate::key::Key::new("contents").input("version", VERSION.to_string());
    for list in lists {
        let about = list.metadata().io_context("reading", list)?;
        let changed = about.modified().ok().and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
        // Only the file name counts, since a cache may be moved.
        let name = list.file_name().unwrap_or_default().to_string_lossy();
        let text = format!("{name} {} {changed:?}", about.len());
        key = key.input("list", text);
    }
    Ok(key.finish()[..16].to_owned())
}

/// Removes the indexes of older lists.
fn sweep(cache: &Path, keep: &Path) {
    for entry in fs::read_dir(cache).into_iter().flatten().flatten() {
        let path = entry.path();
        let name = entry.file_name();
        if path != keep && name.to_string_lossy().starts_with("contents-") {
            // A reader may have it open, but has read it completely. A failure does not matter.
            let _ = fs::remove_file(path);
        }
    }
}

/// A classified line of a list; names are slices of the line.
#[derive(Clone, Copy, PartialEq, Eq)]
enum ListedFile<'a> {
    Library(&'a [u8]),
    /// A part of the ROS package of this name, if there is one.
    Ros(&'a [u8], RosPackagePart),
    Config(&'a [u8]),
    PkgConfig(&'a [u8]),
    Module(&'a [u8]),
    /// Name and directory: a program, if the directory is a ROS package.
    Program(&'a [u8], &'a [u8]),
}

/// Owned form of [`ListedFile`].
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum OwnedListedFile {
    Library(Vec<u8>),
    Ros(Vec<u8>, RosPackagePart),
    Config(Vec<u8>),
    PkgConfig(Vec<u8>),
    Module(Vec<u8>),
    Program(Vec<u8>, Vec<u8>),
}

impl OwnedListedFile {
    fn from_listed(what: ListedFile<'_>) -> Self {
        match what {
            ListedFile::Library(name) => Self::Library(name.to_owned()),
            ListedFile::Ros(name, part) => Self::Ros(name.to_owned(), part),
            ListedFile::Config(name) => Self::Config(name.to_ascii_lowercase()),
            ListedFile::PkgConfig(name) => Self::PkgConfig(name.to_owned()),
            ListedFile::Module(name) => Self::Module(name.to_owned()),
            ListedFile::Program(name, package) => Self::Program(name.to_owned(), package.to_owned()),
        }
    }

    fn is_same(&self, what: ListedFile<'_>) -> bool {
        match (self, what) {
            (Self::Library(name), ListedFile::Library(new)) => name == new,
            (Self::Ros(name, part), ListedFile::Ros(new, new_part)) => *part == new_part && name == new,
            (Self::Config(name), ListedFile::Config(new)) => name.eq_ignore_ascii_case(new),
            (Self::PkgConfig(name), ListedFile::PkgConfig(new)) | (Self::Module(name), ListedFile::Module(new)) => {
                name == new
            }
            _ => false,
        }
    }
}

/// Builds the index in a single pass over all lists, with one thread each. Which names are ROS packages is known only
/// at the end; the candidates are few once duplicates are removed.
fn build_index(lists: &[PathBuf]) -> Result<Vec<String>, Error> {
    let found = std::thread::scope(|scope| {
        let threads: Vec<_> = lists.iter().map(|list| scope.spawn(move || scan(list))).collect();
        let mut all = BTreeSet::new();
        for thread in threads {
            match thread.join() {
                Ok(kept) => all.extend(kept?),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        Ok::<_, Error>(all)
    })?;
    let ros: BTreeSet<&[u8]> = found
        .iter()
        .filter_map(|(kept, _)| match kept {
            OwnedListedFile::Ros(name, RosPackagePart::Manifest) => Some(name.as_slice()),
            _ => None,
        })
        .collect();
    let mut lines = BTreeSet::new();
    let mut parts: BTreeMap<(String, String), BTreeSet<RosPackagePart>> = BTreeMap::new();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    for (kept, debs) in &found {
        // `section/name,section/name`
        let debs = text(debs);
        for deb in debs.split(',').filter_map(|entry| entry.rsplit('/').next()) {
            match kept {
                OwnedListedFile::Library(name) => {
                    lines.insert(format!("l{}\t{deb}", text(name)));
                }
                OwnedListedFile::Ros(name, part) if ros.contains(name.as_slice()) => {
                    parts.entry((text(name), deb.to_owned())).or_default().insert(*part);
                }
                OwnedListedFile::Ros(..) => {}
                OwnedListedFile::Config(name) => {
                    lines.insert(format!("c{}\t{deb}", text(name)));
                }
                OwnedListedFile::PkgConfig(name) => {
                    lines.insert(format!("g{}\t{deb}", text(name)));
                }
                OwnedListedFile::Module(name) => {
                    lines.insert(format!("m{}\t{deb}", text(name)));
                }
                OwnedListedFile::Program(name, package) if ros.contains(package.as_slice()) => {
                    lines.insert(format!("p{}\t{deb}\t{}", text(name), text(package)));
                }
                OwnedListedFile::Program(..) => {}
            }
        }
    }
    for ((name, deb), parts) in parts {
        let letters: String = parts.into_iter().map(RosPackagePart::letter).collect();
        lines.insert(format!("r{name}\t{deb}\t{letters}"));
    }
    Ok(lines.into_iter().collect())
}

/// Reads a list in large chunks: it has millions of lines, nearly all irrelevant.
fn scan(list: &Path) -> Result<Vec<(OwnedListedFile, Vec<u8>)>, Error> {
    let file = File::open(list).io_context("reading", list)?;
    let mut reader = MultiGzDecoder::new(BufReader::with_capacity(1 << 18, file));
    let mut kept: Vec<(OwnedListedFile, Vec<u8>)> = Vec::new();
    let mut buffer = vec![0; 1 << 20];
    let mut filled = 0;
    loop {
        let read = reader.read(&mut buffer[filled..]).io_context("reading", list)?;
        if read == 0 {
            break;
        }
        filled += read;
        let mut start = 0;
        for end in memchr::memchr_iter(b'\n', &buffer[..filled]) {
            keep_new(&buffer[start..end], &mut kept);
            start = end + 1;
        }
        buffer.copy_within(start..filled, 0);
        filled -= start;
        if filled == buffer.len() {
            // A line that exceeds the buffer is irrelevant.
            filled = 0;
        }
    }
    keep_new(&buffer[..filled], &mut kept);
    Ok(kept)
}

/// Adds the information of a line unless the previous lines had it.
fn keep_new(line: &[u8], kept: &mut Vec<(OwnedListedFile, Vec<u8>)>) {
    let Some(space) = memchr::memrchr2(b' ', b'\t', line) else {
        return;
    };
    let debs = &line[space + 1..];
    for what in [classify(line), classify_lookup(line)].into_iter().flatten() {
        let mut last = kept.iter().rev().take(2);
        if !last.any(|(last, of)| of == debs && last.is_same(what)) {
            kept.push((OwnedListedFile::from_listed(what), debs.to_owned()));
        }
    }
}

/// Classifies what builds or programs look up by name: CMake configurations, Python modules, programs.
fn classify_lookup(line: &[u8]) -> Option<ListedFile<'_>> {
    let rest = line.strip_prefix(b"usr/")?;
    let path = &rest[..memchr::memchr2(b' ', b'\t', rest)?];
    for end in [&b"Config.cmake"[..], b"-config.cmake"] {
        if let Some(stem) = path.strip_suffix(end) {
            let name = stem.rsplit(|byte| *byte == b'/').next()?;
            return (!name.is_empty()).then_some(ListedFile::Config(name));
        }
    }
    if let Some(module) = path.strip_prefix(b"lib/python3/dist-packages/") {
        let name = match split_first(module) {
            Some((name, b"__init__.py")) => name,
            Some(_) => return None,
            None if module.ends_with(b".py") => &module[..module.len() - 3],
            None if module.ends_with(b".so") => module.split(|byte| *byte == b'.').next()?,
            None => return None,
        };
        return Some(ListedFile::Module(name));
    }
    if let Some(stem) = path.strip_suffix(b".pc") {
        let (directory, name) = stem.split_at(memchr::memrchr(b'/', stem)? + 1);
        let shared = [b"lib/pkgconfig/".as_slice(), b"share/pkgconfig/"];
        let is_own = directory
            .strip_prefix(b"lib/")
            .and_then(|rest| rest.strip_prefix(triplet().as_bytes()))
            .is_some_and(|rest| rest == b"/pkgconfig/");
        return (is_own || shared.contains(&directory)).then_some(ListedFile::PkgConfig(name));
    }
    let (package, program) = split_first(path.strip_prefix(b"lib/")?)?;
    let plain = !program.contains(&b'/') && package != triplet().as_bytes();
    plain.then_some(ListedFile::Program(program, package))
}

/// Splits a path at the first `/`.
fn split_first(path: &[u8]) -> Option<(&[u8], &[u8])> {
    let at = memchr::memchr(b'/', path)?;
    Some((&path[..at], &path[at + 1..]))
}

fn classify(line: &[u8]) -> Option<ListedFile<'_>> {
    if let Some(rest) = line.strip_prefix(b"usr/share/") {
        let (name, rest) = split_first(rest)?;
        let part = match split_first(rest) {
            Some((b"msg" | b"srv" | b"action", _)) => RosPackagePart::Definitions,
            Some((b"cmake", _)) => RosPackagePart::CMake,
            // Directly in the directory, not in a subdirectory. Followed by spaces and a section that contains a slash.
            _ if rest.starts_with(b"package.xml ") || rest.starts_with(b"package.xml\t") => RosPackagePart::Manifest,
            _ => RosPackagePart::Share,
        };
        return Some(ListedFile::Ros(name, part));
    }
    if let Some(rest) = line.strip_prefix(b"usr/lib/python3/dist-packages/") {
        return Some(ListedFile::Ros(split_first(rest)?.0, RosPackagePart::Python));
    }
    let rest = line.strip_prefix(b"usr/lib/").or_else(|| line.strip_prefix(b"lib/"))?;
    let end = memchr::memchr2(b' ', b'\t', rest)?;
    let path = &rest[..end];
    let own = triplet().as_bytes();
    let (first, inner) = split_first(path).unwrap_or((b"", path));
    if !first.is_empty() && first != own {
        return Some(ListedFile::Ros(first, RosPackagePart::Programs));
    }
    let name = match split_first(inner) {
        None => inner,
        Some((b"cmake", below)) => {
            return Some(ListedFile::Ros(split_first(below)?.0, RosPackagePart::CMake));
        }
        // Directories of alternatives, and where Debian puts plugins of ROS packages.
        Some((b"blas" | b"lapack" | b"ros", name)) => name,
        Some(_) => return None,
    };
    let library = name.ends_with(b".so") || memchr::memmem::find(name, b".so.").is_some();
    (library && !name.contains(&b'/')).then_some(ListedFile::Library(name))
}

/// Returns this machine's directory below `/usr/lib`.
pub(crate) fn triplet() -> &'static str {
    match std::env::consts::ARCH {
        "x86_64" => "x86_64-linux-gnu",
        "aarch64" => "aarch64-linux-gnu",
        "arm" => "arm-linux-gnueabihf",
        "riscv64" => "riscv64-linux-gnu",
        _ => "unknown-linux-gnu",
    }
}

#[cfg(test)]
pub(crate) mod tests;
