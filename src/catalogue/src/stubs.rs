//! Stubs of published services: composed from the image and the interface, packed with the robot's program.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use api::stub::{ARCHITECTURES, architecture};
use flate2::{Compression, GzBuilder};
use package::inventory::Inventory;
use package::stub::{About, Content, Contents, Files, PROGRAM, compose};
use store::RevisionRecord;
use tar::{EntryType, Header};

use crate::{Error, inventory};

/// The time of every file: the same input gives the same archive.
const MTIME: u64 = 1_700_000_000;

/// The robot's program, for each architecture that there is one for: `stubs/ARCHITECTURE/cloudroid-stub` beside
/// this program or where it is installed.
pub struct Programs {
    found: Vec<Program>,
}

/// A program of a stub.
pub struct Program {
    /// As in [`ARCHITECTURES`].
    pub architecture: &'static str,
    path: PathBuf,
}

impl Programs {
    /// Looks for them. They may be added while the daemon runs.
    pub fn look() -> Programs {
        let beside = std::env::current_exe()
            .ok()
            .and_then(|path| Some(path.parent()?.to_owned()));
        let installed = ["/usr/local/lib/cloudroid", "/usr/lib/cloudroid"].map(PathBuf::from);
        let places: Vec<PathBuf> = beside.into_iter().chain(installed).collect();
        Self::below(&places)
    }

    fn below(places: &[PathBuf]) -> Programs {
        let find = |architecture: &'static str| {
            let of = |place: &PathBuf| place.join("stubs").join(architecture).join(PROGRAM);
            let path = places.iter().map(of).find(|path| path.is_file())?;
            Some(Program { architecture, path })
        };
        Programs {
            found: ARCHITECTURES.into_iter().filter_map(find).collect(),
        }
    }

    /// Architectures for which there is a program.
    pub fn held(&self) -> Vec<String> {
        self.found
            .iter()
            .map(|program| program.architecture.to_owned())
            .collect()
    }

    /// Architectures for which there is no program.
    pub fn lacking(&self) -> Vec<String> {
        let held = self.held();
        ARCHITECTURES
            .into_iter()
            .map(str::to_owned)
            .filter(|architecture| !held.contains(architecture))
            .collect()
    }

    /// The one for an architecture; none: this machine's.
    pub fn of(self, asked: Option<&str>) -> Result<Program, Error> {
        let asked = asked.unwrap_or(std::env::consts::ARCH);
        let exists = self.held();
        let wanted = architecture(asked);
        self.found
            .into_iter()
            .find(|program| Some(program.architecture) == wanted)
            .ok_or_else(|| Error::UnknownArchitecture {
                asked: asked.to_owned(),
                exists,
            })
    }
}

/// `HOST` or `HOST:PORT`, nothing that a file or script could misunderstand.
pub fn is_authority(text: &str) -> bool {
    !text.is_empty()
        && text
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "-._:[]".contains(c))
}

/// The files of a revision's stub, but for the robot's program.
pub fn files(
    store: &image::Store,
    revision: &RevisionRecord,
    inventory: &Inventory,
    architecture: &str,
    server: &str,
) -> Result<Files, Error> {
    let no_stub = |error: package::Error| Error::NoStub {
        service: revision.service.clone(),
        reason: error.to_string(),
    };
    let layers = inventory::layers(store, &revision.image)?;
    let contents = match inventory.packages.get(&revision.package) {
        Some(package) => Contents::read(&layers, package).map_err(no_stub)?,
        None => Contents::default(),
    };
    let about = About {
        service: &revision.service,
        package: &revision.package,
        revision: revision.number,
        image: &revision.image,
        server,
        architecture,
        outsourced: &inventory.programs.keys().cloned().collect(),
        interface: &revision.interface,
        stateful: revision.plan.stateful,
        times: times(&revision.plan.sla),
    };
    compose(&about, contents).map_err(no_stub)
}

/// T_desire and T_max in seconds; where one of them is given it is both.
fn times(sla: &api::Sla) -> Option<(f64, f64)> {
    let (desire, max) = (sla.rrt.or(sla.max_rrt)?, sla.max_rrt.or(sla.rrt)?);
    Some((desire.as_seconds(), max.as_seconds()))
}

/// The archive of a revision's stub, in a file that is gone when it is closed.
pub fn archive(
    store: &image::Store,
    revision: &RevisionRecord,
    inventory: &Inventory,
    program: &Program,
    server: &str,
) -> Result<File, Error> {
    let files = files(store, revision, inventory, program.architecture, server)?;
    let failed = |error: std::io::Error| Error::NoStub {
        service: revision.service.clone(),
        reason: format!("it could not be packed: {error}"),
    };
    let mut binary = File::open(&program.path).map_err(failed)?;
    let packed = pack(&revision.service, &revision.package, &files, &mut binary);
    packed.map_err(failed)
}

fn pack(service: &str, package: &str, files: &Files, binary: &mut File) -> std::io::Result<File> {
    let file = tempfile::tempfile()?;
    let gzip = GzBuilder::new()
        .mtime(0)
        .write(file, Compression::default());
    let mut archive = tar::Builder::new(gzip);
    let top = format!("{service}-stub");
    let program = format!("lib/{package}/{PROGRAM}");
    for directory in directories(files.keys().chain([&program])) {
        let mut header = header(EntryType::Directory, true, 0);
        archive.append_data(&mut header, format!("{top}/{directory}"), std::io::empty())?;
    }
    for (path, content) in files {
        let at = format!("{top}/{path}");
        match content {
            Content::File { bytes, executable } => {
                let mut header = header(EntryType::Regular, *executable, bytes.len() as u64);
                archive.append_data(&mut header, at, bytes.as_slice())?;
            }
            Content::Link(target) => {
                let mut header = header(EntryType::Symlink, true, 0);
                archive.append_link(&mut header, at, Path::new(target))?;
            }
        }
    }
    let mut header = header(EntryType::Regular, true, binary.metadata()?.len());
    archive.append_data(&mut header, format!("{top}/{program}"), binary)?;
    let mut file = archive.into_inner()?.finish()?;
    file.flush()?;
    file.seek(SeekFrom::Start(0))?;
    Ok(file)
}

/// Every directory that these paths are in, each after its parent.
fn directories<'a>(paths: impl Iterator<Item = &'a String>) -> BTreeSet<String> {
    let mut directories = BTreeSet::from([String::new()]);
    for path in paths {
        let mut path = path.as_str();
        while let Some((parent, _)) = path.rsplit_once('/') {
            directories.insert(format!("{parent}/"));
            path = parent;
        }
    }
    directories
}

fn header(kind: EntryType, executable: bool, size: u64) -> Header {
    let mut header = Header::new_gnu();
    header.set_entry_type(kind);
    header.set_mode(if executable { 0o755 } else { 0o644 });
    header.set_size(size);
    header.set_mtime(MTIME);
    header.set_uid(0);
    header.set_gid(0);
    header
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn the_same_files_make_the_same_archive() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("program");
        std::fs::write(&path, "ELF").expect("written");
        let files: Files = [
            (
                "lib/p/node".to_owned(),
                Content::File {
                    bytes: b"#!/bin/sh".to_vec(),
                    executable: true,
                },
            ),
            ("share/p/a/b".to_owned(), Content::Link("c".into())),
        ]
        .into();
        let pack = || {
            let mut binary = File::open(&path).expect("opened");
            let mut bytes = Vec::new();
            super::pack("serves", "p", &files, &mut binary)
                .expect("packed")
                .read_to_end(&mut bytes)
                .expect("read");
            bytes
        };
        let bytes = pack();
        assert_eq!(bytes, pack());
        let mut archive = tar::Archive::new(flate2::read::GzDecoder::new(&bytes[..]));
        let names: Vec<String> = archive
            .entries()
            .expect("an archive")
            .map(|entry| {
                let entry = entry.expect("an entry");
                entry.path().expect("a path").display().to_string()
            })
            .collect();
        assert_eq!(
            names,
            [
                "serves-stub/",
                "serves-stub/lib/",
                "serves-stub/lib/p/",
                "serves-stub/share/",
                "serves-stub/share/p/",
                "serves-stub/share/p/a/",
                "serves-stub/lib/p/node",
                "serves-stub/share/p/a/b",
                "serves-stub/lib/p/cloudroid-stub",
            ]
        );
    }

    #[test]
    fn architectures_are_held_or_lacking() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("stubs/aarch64");
        std::fs::create_dir_all(&directory).expect("made");
        std::fs::write(directory.join(PROGRAM), "").expect("written");
        let look = || Programs::below(&[place.path().to_owned()]);
        assert_eq!(look().held(), ["aarch64"]);
        assert_eq!(look().lacking(), ["x86_64", "armv7"]);
        assert_eq!(
            look()
                .of(Some("arm64"))
                .ok()
                .map(|program| program.architecture),
            Some("aarch64")
        );
        let refused = look().of(Some("riscv64")).err();
        assert!(
            matches!(&refused, Some(Error::UnknownArchitecture { exists, .. }) if *exists == ["aarch64"]),
            "{refused:?}"
        );
    }

    #[test]
    fn an_address_holds_nothing_that_could_be_misunderstood() {
        assert!(is_authority("server.local:9090") && is_authority("[::1]:9090"));
        assert!(!is_authority("a\"b") && !is_authority("") && !is_authority("a/b"));
    }
}
