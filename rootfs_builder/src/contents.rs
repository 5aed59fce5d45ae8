//! Which Debian package holds which file: the archive's Contents lists, boiled down once to what is asked of them
//! (ROS packages and shared libraries) in one small sorted file.
//!
//! The lists are 670 MB of text for bookworm; the result is 4 MB and is searched in place.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use flate2::read::MultiGzDecoder;

use crate::error::{Error, IoAt};

/// The searchable result.
#[derive(Debug)]
pub struct Contents {
    /// Sorted lines: `lNAME\tDEB` for libraries, `rNAME\tDEB\tKINDS` for ROS packages.
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
        Self::ALL.into_iter().find(|(part, _)| *part == self).map_or('?', |(_, letter)| letter)
    }
}

/// Debian package → what it holds of one ROS package.
pub type Carriers = BTreeMap<String, BTreeSet<Part>>;

/// Raise it when the file's format or what is kept changes.
const VERSION: u32 = 1;

impl Contents {
    /// Opens the boiled-down file of these lists, made now below `cache` if it is not there. Blocking: a few
    /// seconds of two cores when made.
    pub fn open(cache: &Path, lists: &[PathBuf]) -> Result<Self, Error> {
        let path = cache.join(format!("contents-{}.txt", stamp(lists)?));
        if !path.is_file() {
            let lines = boil_down(lists)?;
            let mut file = tempfile::NamedTempFile::new_in(cache).at("making a file in", cache)?;
            file.write_all(lines.join("\n").as_bytes()).at("writing", file.path())?;
            file.as_file().sync_data().at("writing", file.path())?;
            file.persist(&path).map_err(|error| Error::io("writing", &path, error.error))?;
            sweep(cache, &path);
        }
        let text = fs::read_to_string(&path).at("reading", &path)?;
        Ok(Self { lines: text.lines().map(str::to_owned).collect() })
    }

    /// Lines that begin with `prefix`, without it.
    fn with_prefix<'a>(&'a self, prefix: &'a str) -> impl Iterator<Item = &'a str> {
        let start = self.lines.partition_point(|line| line.as_str() < prefix);
        self.lines[start..].iter().map_while(move |line| line.strip_prefix(prefix))
    }

    /// The Debian package with this shared library, by the name a program asks for (`libfoo.so.1`). Where several
    /// have it, the one whose name is nearest to the library's.
    pub fn library(&self, name: &str) -> Option<&str> {
        let prefix = format!("l{name}\t");
        let start = self.lines.partition_point(|line| line.as_str() < prefix.as_str());
        self.lines[start..]
            .iter()
            .map_while(|line| line.strip_prefix(prefix.as_str()))
            .min_by_key(|deb| (deb.ends_with("-dev"), !deb.starts_with("lib"), deb.len()))
    }

    /// Debian packages that hold something of this ROS package; empty where it is not packaged.
    pub fn ros_package(&self, name: &str) -> Carriers {
        let prefix = format!("r{name}\t");
        let mut carriers = Carriers::new();
        for rest in self.with_prefix(&prefix) {
            let (deb, letters) = rest.split_once('\t').unwrap_or((rest, ""));
            let parts = Part::ALL.into_iter().filter(|(_, letter)| letters.contains(*letter)).map(|(part, _)| part);
            carriers.insert(deb.to_owned(), parts.collect());
        }
        carriers
    }

    /// ROS packages of which this Debian package holds something.
    pub fn ros_packages_in(&self, deb: &str) -> Vec<&str> {
        let fields = self.with_prefix("r").filter_map(|rest| rest.split_once('\t'));
        fields.filter(|(_, rest)| rest.split('\t').next() == Some(deb)).map(|(name, _)| name).collect()
    }

}

/// Changes when the lists do.
fn stamp(lists: &[PathBuf]) -> Result<String, Error> {
    let mut key = crate::key::Key::new("contents").with("version", VERSION.to_string());
    for list in lists {
        let about = list.metadata().at("reading", list)?;
        let changed = about.modified().ok().and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
        let text = format!("{} {} {:?}", list.display(), about.len(), changed);
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

/// Two passes, all lists at once: which ROS packages there are, then what of theirs is where.
fn boil_down(lists: &[PathBuf]) -> Result<Vec<String>, Error> {
    let names: BTreeSet<String> = each(lists, |path, _| {
        let name = path.strip_prefix("usr/share/")?.strip_suffix("/package.xml")?;
        (!name.contains('/')).then(|| name.to_owned())
    })?
    .into_iter()
    .collect();
    let found = each(lists, |path, debs| {
        let what = classify(path, &names)?;
        Some((what, debs.to_owned()))
    })?;
    let mut lines = BTreeSet::new();
    let mut parts: BTreeMap<(String, String), BTreeSet<Part>> = BTreeMap::new();
    for (what, debs) in found {
        // `section/name,section/name`
        for deb in debs.split(',').filter_map(|entry| entry.rsplit('/').next()) {
            match &what {
                What::Library(name) => {
                    lines.insert(format!("l{name}\t{deb}"));
                }
                What::Ros(name, part) => {
                    parts.entry((name.clone(), deb.to_owned())).or_default().insert(*part);
                }
            }
        }
    }
    for ((name, deb), parts) in parts {
        let letters: String = parts.into_iter().map(Part::letter).collect();
        lines.insert(format!("r{name}\t{deb}\t{letters}"));
    }
    Ok(lines.into_iter().collect())
}

/// Reads all lists, one thread each, and keeps what `pick` makes of their lines.
fn each<T: Send>(lists: &[PathBuf], pick: impl Fn(&str, &str) -> Option<T> + Sync) -> Result<Vec<T>, Error> {
    let pick = &pick;
    let read = move |list: &Path| -> Result<Vec<T>, Error> {
        let file = File::open(list).at("reading", list)?;
        let mut reader = BufReader::with_capacity(1 << 18, MultiGzDecoder::new(file));
        let mut kept = Vec::new();
        let mut line = Vec::new();
        while reader.read_until(b'\n', &mut line).at("reading", list)? > 0 {
            // Most lines are of no interest; look at the first bytes before anything else.
            if (line.starts_with(b"usr/") || line.starts_with(b"lib"))
                && let Ok(text) = std::str::from_utf8(&line)
                && let Some((path, debs)) = text.trim_end().rsplit_once([' ', '\t'])
                && let Some(value) = pick(path.trim_end(), debs)
            {
                kept.push(value);
            }
            line.clear();
        }
        Ok(kept)
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = lists.iter().map(|list| scope.spawn(move || read(list))).collect();
        let mut all = Vec::new();
        for thread in threads {
            match thread.join() {
                Ok(kept) => all.extend(kept?),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        Ok(all)
    })
}

enum What {
    Library(String),
    Ros(String, Part),
}

fn classify(path: &str, ros: &BTreeSet<String>) -> Option<What> {
    if let Some(rest) = path.strip_prefix("usr/share/") {
        let (name, rest) = rest.split_once('/')?;
        let part = match rest.split_once('/').map_or(rest, |(first, _)| first) {
            "package.xml" => Part::Manifest,
            "msg" | "srv" | "action" => Part::Definitions,
            "cmake" => Part::CMake,
            _ => Part::Share,
        };
        return ros.contains(name).then(|| What::Ros(name.to_owned(), part));
    }
    if let Some(rest) = path.strip_prefix("usr/lib/python3/dist-packages/") {
        let name = rest.split('/').next()?;
        return ros.contains(name).then(|| What::Ros(name.to_owned(), Part::Python));
    }
    let rest = path.strip_prefix("usr/lib/").or_else(|| path.strip_prefix("lib/"))?;
    let (first, inner) = rest.split_once('/').unwrap_or(("", rest));
    if let Some(below) = inner.strip_prefix("cmake/").filter(|_| first == triplet()) {
        let name = below.split('/').next()?;
        return ros.contains(name).then(|| What::Ros(name.to_owned(), Part::CMake));
    }
    if first.is_empty() || first == triplet() {
        let name = match inner.split_once('/') {
            None => inner,
            // Where alternatives find them.
            Some(("blas" | "lapack", name)) => name,
            Some(_) => return None,
        };
        let library = name.ends_with(".so") || name.contains(".so.");
        return (library && !name.contains('/')).then(|| What::Library(name.to_owned()));
    }
    ros.contains(first).then(|| What::Ros(first.to_owned(), Part::Programs))
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
mod tests {
    use super::*;
    use flate2::Compression;
    use flate2::write::GzEncoder;

    fn list(directory: &Path, name: &str, text: &str) -> PathBuf {
        let path = directory.join(name);
        let mut gz = GzEncoder::new(File::create(&path).expect("made"), Compression::fast());
        gz.write_all(text.as_bytes()).expect("written");
        gz.finish().expect("written");
        path
    }

    fn example(directory: &Path) -> Contents {
        let t = triplet();
        let native = format!(
            "usr/lib/nodelet/nodelet   libs/nodelet-tools\n\
             usr/lib/{t}/libfoo.so.1   libs/libfoo1\n\
             usr/lib/{t}/libfoo.so   libdevel/libfoo-dev\n\
             usr/lib/{t}/blas/libblas.so.3   libs/libblas3\n\
             usr/lib/{t}/deep/libdeep.so.3   libs/libdeep3\n\
             usr/lib/{t}/cmake/nodelet/nodeletConfig.cmake   libdevel/libnodelet-dev\n\
             lib/{t}/libc.so.6   libs/libc6,libs/libc6-other\n\
             usr/share/nodelet/package.xml   libs/nodelet-tools\n\
             usr/share/nodelet/srv/NodeletLoad.srv   devel/ros-nodelet-srvs\n"
        );
        let all = "usr/lib/python3/dist-packages/nodelet/__init__.py python/python3-nodelet\n\
                   usr/share/doc/with space/x doc/y\n";
        Contents::open(directory, &[list(directory, "a.gz", &native), list(directory, "b.gz", all)]).expect("read")
    }

    #[test]
    fn libraries_and_ros_packages_are_found() {
        let directory = tempfile::tempdir().expect("a directory");
        let contents = example(directory.path());
        assert_eq!(contents.library("libfoo.so.1"), Some("libfoo1"));
        assert_eq!(contents.library("libblas.so.3"), Some("libblas3"));
        assert_eq!(contents.library("libc.so.6"), Some("libc6"));
        assert_eq!(contents.library("libdeep.so.3"), None);
        let nodelet = contents.ros_package("nodelet");
        assert_eq!(nodelet["nodelet-tools"], [Part::Manifest, Part::Programs].into());
        assert_eq!(nodelet["ros-nodelet-srvs"], [Part::Definitions].into());
        assert_eq!(nodelet["python3-nodelet"], [Part::Python].into());
        assert_eq!(nodelet["libnodelet-dev"], [Part::CMake].into());
        assert!(contents.ros_package("nodele").is_empty());
        assert_eq!(contents.ros_packages_in("python3-nodelet"), ["nodelet"]);
    }

    #[test]
    fn it_is_made_once() {
        let directory = tempfile::tempdir().expect("a directory");
        example(directory.path());
        let made = || {
            let names = fs::read_dir(directory.path()).expect("listed").flatten().map(|entry| entry.file_name());
            names.filter(|name| name.to_string_lossy().starts_with("contents-")).collect::<Vec<_>>()
        };
        let first = made();
        assert_eq!(first.len(), 1);
        let lists = [directory.path().join("a.gz"), directory.path().join("b.gz")];
        fs::write(directory.path().join(&first[0]), "lx.so\tmarked").expect("written");
        let again = Contents::open(directory.path(), &lists).expect("read");
        assert_eq!(again.library("x.so"), Some("marked"), "read, not made again");
    }
}
