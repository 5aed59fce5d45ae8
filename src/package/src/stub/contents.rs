//! What an image holds of a package: its executables, as recorded, and all that it shares.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use crate::Error;
use crate::inventory::Installed;
use crate::merged::{self, Level, Merged};

/// The largest single file: meshes and maps are shared, too.
const MAX_BYTES: u64 = 64 << 20;
/// All files together.
const MAX_TOTAL: usize = 256 << 20;
const MAX_FILES: usize = 20_000;
/// Directories below a package's.
const MAX_DEPTH: usize = 16;

/// What an image holds of a package.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Contents {
    /// Names in `lib/PACKAGE`.
    pub executables: BTreeSet<String>,
    /// Everything below `share/PACKAGE`, by path from there.
    pub share: BTreeMap<String, Content>,
    /// Classes of nodes for component containers (ROS 2).
    pub components: BTreeSet<String>,
}

/// A file, or a link that stays within the package.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Content {
    /// A file.
    File {
        /// Its bytes.
        bytes: Vec<u8>,
        /// Somebody may execute it.
        executable: bool,
    },
    /// A symbolic link to another path, relative to its own directory.
    Link(String),
}

impl Contents {
    /// Reads a package from a stack of extracted layers, given lowest first.
    ///
    /// What is no file, and links that lead out of the package, are left out.
    pub fn read<L: AsRef<Path>>(layers: &[L], package: &Installed) -> Result<Self, Error> {
        let mut share = BTreeMap::new();
        let directory = Merged::at(&merged::open(layers)?, &package.share)?;
        let mut reader = Reader {
            share: &mut share,
            total: 0,
        };
        reader.directory(&directory, "", 0)?;
        Ok(Self {
            executables: package.executables.clone(),
            share,
            components: package.components.keys().cloned().collect(),
        })
    }
}

struct Reader<'a> {
    share: &'a mut BTreeMap<String, Content>,
    total: usize,
}

impl Reader<'_> {
    fn directory(&mut self, directory: &Merged, path: &str, depth: usize) -> Result<(), Error> {
        for (name, level) in directory.names()? {
            let Ok(text) = std::str::from_utf8(&name) else {
                continue;
            };
            if text == "." || text == ".." || text == "__pycache__" {
                continue;
            }
            let at = if path.is_empty() {
                text.to_owned()
            } else {
                format!("{path}/{text}")
            };
            if let Some(content) = content(level, &name, path)? {
                self.add(level, at, content)?;
            } else if depth < MAX_DEPTH {
                self.directory(&directory.below(&name)?, &at, depth + 1)?;
            }
        }
        Ok(())
    }

    fn add(&mut self, level: &Level, path: String, content: Content) -> Result<(), Error> {
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

fn content(level: &Level, name: &[u8], directory: &str) -> Result<Option<Content>, Error> {
    if let Some(file) = level.file(name, MAX_BYTES)? {
        return Ok(Some(Content::File {
            bytes: file.bytes,
            executable: file.executable,
        }));
    }
    let target = level.link(name).filter(|target| stays(target, directory));
    Ok(target.and_then(|target| Some(Content::Link(target.to_str()?.to_owned()))))
}

/// Whether a link in `directory` (from the package's own) leads to somewhere in the package.
fn stays(target: &Path, directory: &str) -> bool {
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
            let package = Installed {
                share: "/usr/share/p".into(),
                lib: "/usr/lib/p".into(),
                executables: ["node".to_owned()].into(),
                ..Installed::default()
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
        let Content::File { bytes, executable } = &contents.share["package.xml"] else {
            panic!("a file")
        };
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
        assert_eq!(
            contents.share["launch/b.launch"],
            Content::Link("a.launch".into())
        );
        assert!(contents.share.contains_key("launch/up"));
        assert!(!contents.share.contains_key("launch/out"));
        assert!(!contents.share.contains_key("launch/host"));
    }
}
