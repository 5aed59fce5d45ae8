//! Which Debian package holds which file: the archive's Contents lists, boiled down once to what is asked of them
//! (ROS packages and their programs, shared libraries, what CMake and Python look for) in one small sorted file.
//!
//! The lists are 670 MB of text for bookworm; the result is 4 MB and is searched in place.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use flate2::read::MultiGzDecoder;

use crate::error::{Error, IoAt};

/// The searchable result.
#[derive(Debug)]
pub struct Contents {
    /// Sorted lines: `lNAME\tDEB` for libraries, `rNAME\tDEB\tKINDS` for ROS packages, `cNAME\tDEB` for configuration
    /// files of CMake (NAME in lower case), `gNAME\tDEB` for modules of pkg-config, `mNAME\tDEB` for Python modules,
    /// `pNAME\tDEB\tROSPACKAGE` for programs of ROS packages.
    lines: Vec<String>,
}

/// What a Debian package holds of a ROS package.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Part {
    /// `share/P/package.xml`
    Manifest,
    /// `lib/P/…`: programs.
    Programs,
    /// Its Python module.
    Python,
    /// `share/P/{msg,srv,action}/…`
    Definitions,
    /// What CMake needs to find it.
    CMake,
    /// Anything else below `share/P`, such as launch files and plugin lists.
    Share,
}

impl Part {
    const ALL: [(Self, char); 6] = [
        (Self::Manifest, 'x'),
        (Self::Programs, 'e'),
        (Self::Python, 'p'),
        (Self::Definitions, 'd'),
        (Self::CMake, 'c'),
        (Self::Share, 's'),
    ];

    fn letter(self) -> char {
        Self::ALL
            .into_iter()
            .find(|(part, _)| *part == self)
            .map_or('?', |(_, letter)| letter)
    }
}

/// Debian package → what it holds of one ROS package.
pub type Carriers = BTreeMap<String, BTreeSet<Part>>;

/// Raise it when the file's format or what is kept changes.
const VERSION: u32 = 4;

impl Contents {
    /// Opens the boiled-down file of these lists, made now below `cache` if it is not there. Blocking: a few
    /// seconds of two cores when made.
    pub fn open(cache: &Path, lists: &[PathBuf]) -> Result<Self, Error> {
        let path = cache.join(format!("contents-{}.txt", stamp(lists)?));
        if !path.is_file() {
            let lines = boil_down(lists)?;
            let mut file = tempfile::NamedTempFile::new_in(cache).at("making a file in", cache)?;
            file.write_all(lines.join("\n").as_bytes())
                .at("writing", file.path())?;
            file.as_file().sync_data().at("writing", file.path())?;
            file.persist(&path)
                .map_err(|error| Error::io("writing", &path, error.error))?;
            sweep(cache, &path);
        }
        let text = fs::read_to_string(&path).at("reading", &path)?;
        Ok(Self {
            lines: text.lines().map(str::to_owned).collect(),
        })
    }

    /// Lines that begin with `prefix`, without it.
    fn with_prefix<'a>(&'a self, prefix: &'a str) -> impl Iterator<Item = &'a str> {
        let start = self.lines.partition_point(|line| line.as_str() < prefix);
        self.lines[start..]
            .iter()
            .map_while(move |line| line.strip_prefix(prefix))
    }

    /// The Debian package with this shared library, by the name a program asks for (`libfoo.so.1`). Where several
    /// have it, the one whose name is nearest to the library's.
    pub fn library(&self, name: &str) -> Option<&str> {
        let prefix = format!("l{name}\t");
        let start = self
            .lines
            .partition_point(|line| line.as_str() < prefix.as_str());
        self.lines[start..]
            .iter()
            .map_while(|line| line.strip_prefix(prefix.as_str()))
            .min_by_key(|deb| (deb.ends_with("-dev"), !deb.starts_with("lib"), deb.len()))
    }

    /// Versions of this library (`libfoo.so.1` of `libfoo.so`) with their Debian packages, the shortest name first.
    pub fn library_versions(&self, name: &str) -> Vec<(String, &str)> {
        let prefix = format!("l{name}.");
        let start = self
            .lines
            .partition_point(|line| line.as_str() < prefix.as_str());
        let of_name = self.lines[start..]
            .iter()
            .map_while(|line| line.strip_prefix(prefix.as_str()));
        let mut versions: Vec<(String, &str)> = of_name
            .filter_map(|rest| rest.split_once('\t'))
            .filter(|(_, deb)| !deb.ends_with("-dev"))
            .map(|(version, deb)| (format!("{name}.{version}"), deb))
            .collect();
        versions.sort_by_key(|(name, _)| name.len());
        versions
    }

    /// Debian packages that hold something of this ROS package; empty where it is not packaged.
    pub fn ros_package(&self, name: &str) -> Carriers {
        let prefix = format!("r{name}\t");
        let mut carriers = Carriers::new();
        for rest in self.with_prefix(&prefix) {
            let (deb, letters) = rest.split_once('\t').unwrap_or((rest, ""));
            let parts = Part::ALL
                .into_iter()
                .filter(|(_, letter)| letters.contains(*letter))
                .map(|(part, _)| part);
            carriers.insert(deb.to_owned(), parts.collect());
        }
        carriers
    }

    /// Debian packages by which CMake's `find_package(NAME)` is satisfied.
    pub fn cmake_config(&self, name: &str) -> BTreeSet<&str> {
        self.debs('c', &name.to_lowercase())
    }

    /// Debian packages with this module of pkg-config.
    pub fn pkg_config(&self, name: &str) -> BTreeSet<&str> {
        self.debs('g', name)
    }

    /// Debian packages with this Python module (its first name: `numpy` of `numpy.linalg`).
    pub fn python_module(&self, name: &str) -> BTreeSet<&str> {
        self.debs('m', name)
    }

    /// ROS packages with a program of this name, and their Debian packages.
    pub fn programs(&self, name: &str) -> BTreeSet<(&str, &str)> {
        let of_name = self.with_kind('p', name);
        of_name
            .filter_map(|rest| rest.split_once('\t'))
            .map(|(deb, package)| (package, deb))
            .collect()
    }

    fn debs(&self, kind: char, name: &str) -> BTreeSet<&str> {
        self.with_kind(kind, name).collect()
    }

    fn with_kind(&self, kind: char, name: &str) -> impl Iterator<Item = &str> {
        let prefix = format!("{kind}{name}\t");
        let start = self
            .lines
            .partition_point(|line| line.as_str() < prefix.as_str());
        self.lines[start..]
            .iter()
            .map_while(move |line| line.strip_prefix(prefix.as_str()))
    }

    /// Debian packages that hold something of any ROS package.
    pub fn ros_carriers(&self) -> BTreeSet<String> {
        let fields = self
            .with_prefix("r")
            .filter_map(|rest| rest.split('\t').nth(1));
        fields.map(str::to_owned).collect()
    }

    /// ROS packages of which this Debian package holds something.
    pub fn ros_packages_in(&self, deb: &str) -> Vec<&str> {
        let fields = self
            .with_prefix("r")
            .filter_map(|rest| rest.split_once('\t'));
        fields
            .filter(|(_, rest)| rest.split('\t').next() == Some(deb))
            .map(|(name, _)| name)
            .collect()
    }
}

/// Changes when the lists do.
fn stamp(lists: &[PathBuf]) -> Result<String, Error> {
    let mut key = crate::key::Key::new("contents").with("version", VERSION.to_string());
    for list in lists {
        let about = list.metadata().at("reading", list)?;
        let changed = about
            .modified()
            .ok()
            .and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
        // By its name alone: a cache may be moved.
        let name = list.file_name().unwrap_or_default().to_string_lossy();
        let text = format!("{name} {} {changed:?}", about.len());
        key = key.with("list", text);
    }
    Ok(key.finish()[..16].to_owned())
}

/// Removes the results of older lists.
fn sweep(cache: &Path, keep: &Path) {
    for entry in fs::read_dir(cache).into_iter().flatten().flatten() {
        let path = entry.path();
        let name = entry.file_name();
        if path != keep && name.to_string_lossy().starts_with("contents-") {
            // Someone may have it open: they read it whole. Not worth failing for.
            let _ = fs::remove_file(path);
        }
    }
}

/// What a line of a list is about, as it is there: names are cut out of the line.
#[derive(Clone, Copy, PartialEq, Eq)]
enum What<'a> {
    Library(&'a [u8]),
    /// If there is a ROS package of this name, it is one of its parts.
    Ros(&'a [u8], Part),
    Config(&'a [u8]),
    PkgConfig(&'a [u8]),
    Module(&'a [u8]),
    /// Its name, and a directory: a program if that is a ROS package.
    Program(&'a [u8], &'a [u8]),
}

/// The same, kept.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Kept {
    Library(Vec<u8>),
    Ros(Vec<u8>, Part),
    Config(Vec<u8>),
    PkgConfig(Vec<u8>),
    Module(Vec<u8>),
    Program(Vec<u8>, Vec<u8>),
}

impl Kept {
    fn of(what: What<'_>) -> Self {
        match what {
            What::Library(name) => Self::Library(name.to_owned()),
            What::Ros(name, part) => Self::Ros(name.to_owned(), part),
            What::Config(name) => Self::Config(name.to_ascii_lowercase()),
            What::PkgConfig(name) => Self::PkgConfig(name.to_owned()),
            What::Module(name) => Self::Module(name.to_owned()),
            What::Program(name, package) => Self::Program(name.to_owned(), package.to_owned()),
        }
    }

    fn is(&self, what: What<'_>) -> bool {
        match (self, what) {
            (Self::Library(name), What::Library(new)) => name == new,
            (Self::Ros(name, part), What::Ros(new, new_part)) => *part == new_part && name == new,
            (Self::Config(name), What::Config(new)) => name.eq_ignore_ascii_case(new),
            (Self::PkgConfig(name), What::PkgConfig(new))
            | (Self::Module(name), What::Module(new)) => name == new,
            _ => false,
        }
    }
}

/// One pass over all lists at once, one thread each. Which names are ROS packages is known only at the end; what
/// might be theirs is little once repetitions are left out.
fn boil_down(lists: &[PathBuf]) -> Result<Vec<String>, Error> {
    let found = std::thread::scope(|scope| {
        let threads: Vec<_> = lists
            .iter()
            .map(|list| scope.spawn(move || scan(list)))
            .collect();
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
            Kept::Ros(name, Part::Manifest) => Some(name.as_slice()),
            _ => None,
        })
        .collect();
    let mut lines = BTreeSet::new();
    let mut parts: BTreeMap<(String, String), BTreeSet<Part>> = BTreeMap::new();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    for (kept, debs) in &found {
        // `section/name,section/name`
        let debs = text(debs);
        for deb in debs.split(',').filter_map(|entry| entry.rsplit('/').next()) {
            match kept {
                Kept::Library(name) => {
                    lines.insert(format!("l{}\t{deb}", text(name)));
                }
                Kept::Ros(name, part) if ros.contains(name.as_slice()) => {
                    parts
                        .entry((text(name), deb.to_owned()))
                        .or_default()
                        .insert(*part);
                }
                Kept::Ros(..) => {}
                Kept::Config(name) => {
                    lines.insert(format!("c{}\t{deb}", text(name)));
                }
                Kept::PkgConfig(name) => {
                    lines.insert(format!("g{}\t{deb}", text(name)));
                }
                Kept::Module(name) => {
                    lines.insert(format!("m{}\t{deb}", text(name)));
                }
                Kept::Program(name, package) if ros.contains(package.as_slice()) => {
                    lines.insert(format!("p{}\t{deb}\t{}", text(name), text(package)));
                }
                Kept::Program(..) => {}
            }
        }
    }
    for ((name, deb), parts) in parts {
        let letters: String = parts.into_iter().map(Part::letter).collect();
        lines.insert(format!("r{name}\t{deb}\t{letters}"));
    }
    Ok(lines.into_iter().collect())
}

/// Reads one list in large pieces: it has millions of lines, nearly all of no interest.
fn scan(list: &Path) -> Result<Vec<(Kept, Vec<u8>)>, Error> {
    let file = File::open(list).at("reading", list)?;
    let mut reader = MultiGzDecoder::new(BufReader::with_capacity(1 << 18, file));
    let mut kept: Vec<(Kept, Vec<u8>)> = Vec::new();
    let mut buffer = vec![0; 1 << 20];
    let mut filled = 0;
    loop {
        let read = reader.read(&mut buffer[filled..]).at("reading", list)?;
        if read == 0 {
            break;
        }
        filled += read;
        let mut start = 0;
        for end in memchr::memchr_iter(b'\n', &buffer[..filled]) {
            keep(&buffer[start..end], &mut kept);
            start = end + 1;
        }
        buffer.copy_within(start..filled, 0);
        filled -= start;
        if filled == buffer.len() {
            // A line without end is none of ours.
            filled = 0;
        }
    }
    keep(&buffer[..filled], &mut kept);
    Ok(kept)
}

/// Keeps what a line says that the one before did not.
fn keep(line: &[u8], kept: &mut Vec<(Kept, Vec<u8>)>) {
    let Some(space) = memchr::memrchr2(b' ', b'\t', line) else {
        return;
    };
    let debs = &line[space + 1..];
    for what in [classify(line), looked_for(line)].into_iter().flatten() {
        let mut last = kept.iter().rev().take(2);
        if !last.any(|(last, of)| of == debs && last.is(what)) {
            kept.push((Kept::of(what), debs.to_owned()));
        }
    }
}

/// What a build or a program looks for by a name: configurations of CMake, Python modules, programs.
fn looked_for(line: &[u8]) -> Option<What<'_>> {
    let rest = line.strip_prefix(b"usr/")?;
    let path = &rest[..memchr::memchr2(b' ', b'\t', rest)?];
    for end in [&b"Config.cmake"[..], b"-config.cmake"] {
        if let Some(stem) = path.strip_suffix(end) {
            let name = stem.rsplit(|byte| *byte == b'/').next()?;
            return (!name.is_empty()).then_some(What::Config(name));
        }
    }
    if let Some(module) = path.strip_prefix(b"lib/python3/dist-packages/") {
        let name = match cut(module) {
            Some((name, b"__init__.py")) => name,
            Some(_) => return None,
            None if module.ends_with(b".py") => &module[..module.len() - 3],
            None if module.ends_with(b".so") => module.split(|byte| *byte == b'.').next()?,
            None => return None,
        };
        return Some(What::Module(name));
    }
    if let Some(stem) = path.strip_suffix(b".pc") {
        let (directory, name) = stem.split_at(memchr::memrchr(b'/', stem)? + 1);
        let shared = [b"lib/pkgconfig/".as_slice(), b"share/pkgconfig/"];
        let is_own = directory
            .strip_prefix(b"lib/")
            .and_then(|rest| rest.strip_prefix(triplet().as_bytes()))
            .is_some_and(|rest| rest == b"/pkgconfig/");
        return (is_own || shared.contains(&directory)).then_some(What::PkgConfig(name));
    }
    let (package, program) = cut(path.strip_prefix(b"lib/")?)?;
    let plain = !program.contains(&b'/') && package != triplet().as_bytes();
    plain.then_some(What::Program(program, package))
}

/// Up to the first `/`, and after it.
fn cut(path: &[u8]) -> Option<(&[u8], &[u8])> {
    let at = memchr::memchr(b'/', path)?;
    Some((&path[..at], &path[at + 1..]))
}

fn classify(line: &[u8]) -> Option<What<'_>> {
    if let Some(rest) = line.strip_prefix(b"usr/share/") {
        let (name, rest) = cut(rest)?;
        let part = match cut(rest) {
            Some((b"msg" | b"srv" | b"action", _)) => Part::Definitions,
            Some((b"cmake", _)) => Part::CMake,
            // Below the directory, not in one below it. Behind it come spaces and a section with a slash.
            _ if rest.starts_with(b"package.xml ") || rest.starts_with(b"package.xml\t") => {
                Part::Manifest
            }
            _ => Part::Share,
        };
        return Some(What::Ros(name, part));
    }
    if let Some(rest) = line.strip_prefix(b"usr/lib/python3/dist-packages/") {
        return Some(What::Ros(cut(rest)?.0, Part::Python));
    }
    let rest = line
        .strip_prefix(b"usr/lib/")
        .or_else(|| line.strip_prefix(b"lib/"))?;
    let end = memchr::memchr2(b' ', b'\t', rest)?;
    let path = &rest[..end];
    let own = triplet().as_bytes();
    let (first, inner) = cut(path).unwrap_or((b"", path));
    if !first.is_empty() && first != own {
        return Some(What::Ros(first, Part::Programs));
    }
    let name = match cut(inner) {
        None => inner,
        Some((b"cmake", below)) => return Some(What::Ros(cut(below)?.0, Part::CMake)),
        // Where alternatives find them, and where Debian puts plugins of ROS packages.
        Some((b"blas" | b"lapack" | b"ros", name)) => name,
        Some(_) => return None,
    };
    let library = name.ends_with(b".so") || memchr::memmem::find(name, b".so.").is_some();
    (library && !name.contains(&b'/')).then_some(What::Library(name))
}

/// This machine's directory below `/usr/lib`.
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
