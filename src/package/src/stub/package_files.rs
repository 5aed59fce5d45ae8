//! Files of a package in an image: its executables, as recorded, and its share directory.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use crate::Error;
use crate::inventory::InstalledPackage;
use crate::merged::{self, LayerDirectory, MergedDirectory};

/// Maximum size of a file in bytes; meshes and maps are shared as well.
const MAX_BYTES: u64 = 64 << 20;
/// Maximum total size of all files in bytes.
const MAX_TOTAL: usize = 256 << 20;
const MAX_FILES: usize = 20_000;
/// Maximum depth of directories in a package's share directory.
const MAX_DEPTH: usize = 16;

/// Files of a package in an image.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Contents {
    /// Names of the executables in `lib/PACKAGE`.
    pub executables: BTreeSet<String>,
    /// Files below `share/PACKAGE`, by relative path.
    pub share: BTreeMap<String, Content>,
    /// Component classes (ROS 2).
    pub components: BTreeSet<String>,
}

/// A file, or a link that stays within the package.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Content {
    /// A regular file.
    File {
        /// Content.
        bytes: Vec<u8>,
        /// True if it is executable.
        executable: bool,
    },
    /// A symbolic link, relative to its own directory.
    Link(String),
}

impl Contents {
    /// Reads a package from a stack of extracted layers, given lowest first.
    ///
    /// Special files, and links that leave the package, are left out.
    pub fn read<L: AsRef<Path>>(layers: &[L], package: &InstalledPackage) -> Result<Self, Error> {
        let mut share = BTreeMap::new();
        let directory = MergedDirectory::open_path(&merged::open_layers(layers)?, &package.share)?;
        let mut reader = ShareReader { share: &mut share, total: 0 };
        reader.directory(&directory, "", 0)?;
        Ok(Self {
            executables: package.executables.clone(),
            share,
            components: package.components.keys().cloned().collect(),
        })
    }
}

struct ShareReader<'a> {
    share: &'a mut BTreeMap<String, Content>,
    total: usize,
}

impl ShareReader<'_> {
    fn directory(&mut self, directory: &MergedDirectory, path: &str, depth: usize) -> Result<(), Error> {
        for (name, level) in directory.names()? {
            let Ok(text) = std::str::from_utf8(&name) else {
                continue;
            };
            if text == "." || text == ".." || text == "__pycache__" {
                continue;
            }
            let at = if path.is_empty() { text.to_owned() } else { format!("{path}/{text}") };
            if let Some(content) = read_content(level, &name, path)? {
                self.add(level, at, content)?;
            } else if depth < MAX_DEPTH {
                self.directory(&directory.open_child(&name)?, &at, depth + 1)?;
            }
        }
        Ok(())
    }

    fn add(&mut self, level: &LayerDirectory, path: String, content: Content) -> Result<(), Error> {
        if let Content::File { bytes, .. } = &content {
            self.total += bytes.len();
        }
        if self.total > MAX_TOTAL || self.share.len() >= MAX_FILES {
            return Err(Error::TooMany {
                path: level.path().join(path),
                what: "shared files before it",
                limit: self.share.len(),
            });
        }
        self.share.insert(path, content);
        Ok(())
    }
}

fn read_content(level: &LayerDirectory, name: &[u8], directory: &str) -> Result<Option<Content>, Error> {
    if let Some(file) = level.file(name, MAX_BYTES)? {
        return Ok(Some(Content::File { bytes: file.bytes, executable: file.executable }));
    }
    let target = level.link(name).filter(|target| stays_inside(target, directory));
    Ok(target.and_then(|target| Some(Content::Link(target.to_str()?.to_owned()))))
}

/// Returns whether a link in `directory` (relative to the package's) stays in the package.
fn stays_inside(target: &Path, directory: &str) -> bool {
    let mut depth = directory.split('/').filter(|part| !part.is_empty()).count();
    for part in target.components() {
        match part {
            Component::Normal(_) => depth += 1,
            Component::CurDir => {}
            Component::ParentDir if depth > 0 => depth -= 1,
            _ => return false,
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};
    use std::path::PathBuf;

    use super::*;

    struct Layers(tempfile::TempDir);

    impl Layers {
        fn file(&self, path: &str, text: &str, mode: u32) -> &Self {
            let path = self.place(path);
            std::fs::write(&path, text).expect("written");
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).expect("set");
            self
        }

        fn place(&self, path: &str) -> PathBuf {
            let path = self.0.path().join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            path
        }

        fn read(&self) -> Contents {
            let layers = [self.0.path().join("low"), self.0.path().join("high")];
            let package = InstalledPackage {
                share: "/usr/share/p".into(),
                lib: "/usr/lib/p".into(),
                executables: ["node".to_owned()].into(),
                ..InstalledPackage::default()
            };
            Contents::read(&layers, &package).expect("read")
        }
    }

    fn layers() -> Layers {
        let layers = Layers(tempfile::tempdir().expect("a directory"));
        layers
            .file("low/usr/share/p/package.xml", "low", 0o644)
            .file("low/usr/share/p/launch/a.launch", "<launch/>", 0o644)
            .file("high/usr/share/p/package.xml", "high", 0o644)
            .file("high/usr/share/p/scripts/tool.py", "#!", 0o755);
        layers
    }

    #[test]
    fn shared_files_of_all_layers_are_found() {
        let contents = layers().read();
        assert_eq!(contents.executables, ["node".to_owned()].into());
        let names: Vec<&str> = contents.share.keys().map(String::as_str).collect();
        assert_eq!(names, ["launch/a.launch", "package.xml", "scripts/tool.py"]);
        let Content::File { bytes, executable } = &contents.share["package.xml"] else { panic!("a file") };
        assert_eq!((&bytes[..], *executable), (&b"high"[..], false));
    }

    #[test]
    fn links_stay_in_the_package_or_are_left_out() {
        let layers = layers();
        for (name, target) in [
            ("high/usr/share/p/launch/b.launch", "a.launch"),
            ("high/usr/share/p/launch/up", "../package.xml"),
            ("high/usr/share/p/launch/out", "../../q/package.xml"),
            ("high/usr/share/p/launch/host", "/etc/shadow"),
        ] {
            symlink(target, layers.place(name)).expect("linked");
        }
        let contents = layers.read();
        assert_eq!(contents.share["launch/b.launch"], Content::Link("a.launch".into()));
        assert!(contents.share.contains_key("launch/up"));
        assert!(!contents.share.contains_key("launch/out"));
        assert!(!contents.share.contains_key("launch/host"));
    }
}
