//! Reads Debian packages without installing them.

use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::{Component, Path, PathBuf};
use std::process::{Command, Stdio};

use serde::{Deserialize, Serialize};

use crate::cache_cleanup;
use crate::error::{Error, IoContext};

/// A file or link of a Debian package.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct DebMember {
    /// Path relative to the root, such as `usr/share/x/package.xml`.
    pub(crate) path: PathBuf,
    /// Permission bits.
    pub(crate) mode: u32,
    /// Modification time in seconds since 1970.
    pub(crate) mtime: u64,
    /// Content of the file, or target of the link.
    pub(crate) content: MemberContent,
}

/// Content of a member.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum MemberContent {
    /// A regular file.
    File(#[serde(with = "hex")] Vec<u8>),
    /// A symbolic link.
    Link(PathBuf),
}

/// Directory of the cache; to be changed when [`is_needed_at_runtime`] changes.
const CACHE_DIRECTORY: &str = "members-1";

/// Returns the members that are needed at run time ([`is_needed_at_runtime`]), sorted by path. They are cached below
/// `cache` under the name of the package's file, since most ROS packages are inspected repeatedly and unpacking takes
/// long. Blocking.
pub(crate) fn runtime_members(deb: &Path, cache: &Path) -> Result<Vec<DebMember>, Error> {
    let directory = cache.join(CACHE_DIRECTORY);
    let name = Path::new(deb.file_name().unwrap_or_default()).with_extension("tar");
    let path = directory.join(name);
    if let Ok(file) = File::open(&path)
        && let Ok(found) = read_archive(BufReader::new(file), &path, |_| true)
    {
        cache_cleanup::mark_used(&path);
        return Ok(found);
    }
    let mut found = read_members(deb, is_needed_at_runtime)?;
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found.dedup_by(|later, first| later.path == first.path);
    std::fs::create_dir_all(&directory).io_context("making", &directory)?;
    let made = tempfile::NamedTempFile::new_in(&directory).io_context("creating a file in", &directory)?;
    write_tar(&found, made.path())?;
    made.as_file().sync_data().io_context("writing", &path)?;
    made.persist(&path).map_err(|error| Error::io("writing", &path, error.error))?;
    Ok(found)
}

/// Returns the members that `keep` accepts. Blocking.
pub(crate) fn read_members(deb: &Path, keep: impl Fn(&Path) -> bool) -> Result<Vec<DebMember>, Error> {
    let mut unpack = Command::new("dpkg-deb");
    unpack.arg("--fsys-tarfile").arg(deb).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = unpack.spawn().map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => Error::MissingProgram { program: "dpkg-deb", package: "dpkg" },
        _ => Error::io("reading", deb, error),
    })?;
    let found = match child.stdout.take() {
        Some(stdout) => read_archive(BufReader::new(stdout), deb, keep)?,
        None => Vec::new(),
    };
    let status = child.wait().io_context("reading", deb)?;
    if !status.success() {
        return Err(Error::Program {
            program: format!("dpkg-deb --fsys-tarfile {}", deb.display()),
            status: status.to_string(),
            last_lines: "the package is damaged: remove it from the cache and push again".into(),
        });
    }
    Ok(found)
}

/// Reads files and links of a tar archive that is part of, or derived from, the package `deb`.
fn read_archive(archive: impl Read, deb: &Path, keep: impl Fn(&Path) -> bool) -> Result<Vec<DebMember>, Error> {
    let mut found = Vec::new();
    let mut archive = tar::Archive::new(archive);
    for entry in archive.entries().io_context("reading", deb)? {
        let mut entry = entry.io_context("reading", deb)?;
        let path: PathBuf = entry
            .path()
            .io_context("reading", deb)?
            .components()
            .filter(|part| matches!(part, Component::Normal(_)))
            .collect();
        if !keep(&path) {
            continue;
        }
        let header = entry.header();
        let (mode, mtime) = (header.mode().io_context("reading", deb)?, header.mtime().io_context("reading", deb)?);
        let kind = header.entry_type();
        let content = if kind.is_symlink() {
            match entry.link_name().io_context("reading", deb)? {
                Some(target) => MemberContent::Link(target.into_owned()),
                None => continue,
            }
        } else if kind.is_file() {
            let mut bytes = Vec::new();
            entry.read_to_end(&mut bytes).io_context("reading", deb)?;
            MemberContent::File(bytes)
        } else {
            continue;
        };
        found.push(DebMember { path, mode: mode & 0o777, mtime, content });
    }
    Ok(found)
}

/// Returns whether a file of a development package is needed at run time: the ROS package's own directory except its
/// CMake files, programs, and the unversioned names of libraries, by which plugins are loaded.
pub(crate) fn is_needed_at_runtime(path: &Path) -> bool {
    let parts: Vec<&str> = path.iter().filter_map(|part| part.to_str()).collect();
    match parts.as_slice() {
        ["usr", "share", directory, inner, ..] => {
            !matches!(*directory, "doc" | "man" | "cmake" | "pkgconfig" | "lintian" | "bug") && *inner != "cmake"
        }
        ["usr", "lib", name] | ["usr", "lib", _, name] => name.ends_with(".so"),
        _ => false,
    }
}

/// Writes members as a tar archive, sorted by path and owned by root; of several with the same path the first is used.
/// Blocking.
pub(crate) fn write_tar(members: &[DebMember], to: &Path) -> Result<(), Error> {
    let file = File::create(to).io_context("writing", to)?;
    let mut archive = tar::Builder::new(std::io::BufWriter::new(file));
    let mut sorted: Vec<&DebMember> = members.iter().collect();
    sorted.sort_by(|a, b| a.path.cmp(&b.path));
    sorted.dedup_by(|later, first| later.path == first.path);
    for member in sorted {
        let mut header = tar::Header::new_gnu();
        header.set_mode(member.mode);
        header.set_mtime(member.mtime);
        header.set_uid(0);
        header.set_gid(0);
        match &member.content {
            MemberContent::File(bytes) => {
                header.set_entry_type(tar::EntryType::Regular);
                header.set_size(bytes.len() as u64);
                archive.append_data(&mut header, &member.path, bytes.as_slice()).io_context("writing", to)?;
            }
            MemberContent::Link(target) => {
                header.set_entry_type(tar::EntryType::Symlink);
                header.set_size(0);
                archive.append_link(&mut header, &member.path, target).io_context("writing", to)?;
            }
        }
    }
    archive.into_inner().and_then(|mut file| file.flush()).io_context("writing", to)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn development_packages_give_what_running_needs() {
        let wanted = [
            "usr/share/opencv_apps/package.xml",
            "usr/share/opencv_apps/launch/x.launch",
            "usr/lib/x86_64-linux-gnu/libopencv_apps.so",
        ];
        let not = [
            "usr/include/opencv_apps/x.h",
            "usr/share/opencv_apps/cmake/x.cmake",
            "usr/share/doc/libx-dev/copyright",
            "usr/lib/x86_64-linux-gnu/cmake/opencv_apps/x.cmake",
            "usr/lib/x86_64-linux-gnu/libx.a",
            "usr/lib/x86_64-linux-gnu/pkgconfig/x.pc",
        ];
        for path in wanted {
            assert!(is_needed_at_runtime(Path::new(path)), "{path}");
        }
        for path in not {
            assert!(!is_needed_at_runtime(Path::new(path)), "{path}");
        }
    }

    /// Creates a package with these files.
    fn package(directory: &Path, files: &[(&str, &str)]) -> PathBuf {
        let tree = directory.join("tree");
        let control = "Package: robot-dev\nVersion: 1\nArchitecture: all\nMaintainer: a <a@b.invalid>\n\
                       Description: d\n";
        for (path, text) in files.iter().copied().chain([("DEBIAN/control", control)]) {
            let path = tree.join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let deb = directory.join("robot-dev_1_all.deb");
        let mut build = Command::new("dpkg-deb");
        build.args(["--root-owner-group", "--build"]).arg(&tree).arg(&deb);
        let said = build.output().expect("run");
        assert!(said.status.success(), "{said:?}");
        deb
    }

    #[test]
    fn a_package_is_unpacked_once() {
        let directory = tempfile::tempdir().expect("a directory");
        let cache = directory.path().join("cache");
        let files = [
            ("usr/share/robot/package.xml", "<package/>"),
            ("usr/share/robot/launch/a.launch", "<launch/>"),
            ("usr/include/robot.h", "not wanted"),
        ];
        let deb = package(directory.path(), &files);
        let first = runtime_members(&deb, &cache).expect("unpacked");
        let paths: Vec<&str> = first.iter().filter_map(|member| member.path.to_str()).collect();
        assert_eq!(paths, ["usr/share/robot/launch/a.launch", "usr/share/robot/package.xml"]);
        std::fs::remove_file(&deb).expect("removed");
        assert_eq!(runtime_members(&deb, &cache).expect("kept"), first);
        // Nothing is cached for a package that cannot be unpacked.
        let torn = directory.path().join("torn_1_all.deb");
        std::fs::write(&torn, "torn").expect("written");
        runtime_members(&torn, &cache).expect_err("not a package");
        assert!(!cache.join(CACHE_DIRECTORY).join("torn_1_all.tar").exists());
    }

    #[test]
    fn members_become_the_same_archive_whatever_their_order() {
        let member = |path: &str, content| DebMember { path: path.into(), mode: 0o644, mtime: 5, content };
        let file = member("usr/share/x/a", MemberContent::File(b"text".to_vec()));
        let link = member("usr/lib/t/libx.so", MemberContent::Link("libx.so.1".into()));
        let directory = tempfile::tempdir().expect("a directory");
        let (one, two) = (directory.path().join("1"), directory.path().join("2"));
        write_tar(&[file.clone(), link.clone()], &one).expect("written");
        write_tar(&[link.clone(), file.clone(), link], &two).expect("written");
        let bytes = std::fs::read(&one).expect("there");
        assert_eq!(bytes, std::fs::read(&two).expect("there"));
        let mut archive = tar::Archive::new(bytes.as_slice());
        let names: Vec<_> = archive
            .entries()
            .expect("an archive")
            .map(|e| e.expect("one").path().expect("named").into_owned())
            .collect();
        assert_eq!(names, [Path::new("usr/lib/t/libx.so"), Path::new("usr/share/x/a")]);
    }
}
