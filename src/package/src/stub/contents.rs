//! What an image holds of a package: its executables, and all that it shares.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use crate::merged::{self, Level, Merged};
use crate::{Error, names};

/// The largest single file: meshes and maps are shared, too.
const MAX_BYTES: u64 = 64 << 20;
/// All files together.
const MAX_TOTAL: usize = 256 << 20;
const MAX_FILES: usize = 20_000;
/// Links that are followed from one to the next.
const MAX_LINKS: usize = 8;
/// Directories below a package's.
const MAX_DEPTH: usize = 16;

/// What an image holds of a package.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Contents {
    /// Names in `lib/PACKAGE`.
    pub executables: BTreeSet<String>,
    /// Everything below `share/PACKAGE`, by path from there.
    pub share: BTreeMap<String, Content>,
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
    /// Reads `package` from a stack of extracted layers, given lowest first, as a process in the image would find
    /// it on these prefixes (`usr`, `opt/ros/noetic`), the first that has it. Nothing is found where none has.
    ///
    /// What is no file, and links that lead out of the package, are left out.
    pub fn read<L: AsRef<Path>, P: AsRef<str>>(
        layers: &[L],
        prefixes: &[P],
        package: &str,
    ) -> Result<Self, Error> {
        let mut contents = Self::default();
        if !names::is_package(package) {
            return Ok(contents);
        }
        let stack = merged::open(layers)?;
        let (mut found_share, mut found_lib) = (false, false);
        for prefix in prefixes {
            let prefix = prefix.as_ref();
            if !found_lib {
                let lib = Merged::at(&stack, &format!("{prefix}/lib/{package}"))?;
                contents.executables = executables(&lib)?;
                found_lib = !contents.executables.is_empty();
            }
            if !found_share {
                let share = Merged::at(&stack, &format!("{prefix}/share/{package}"))?;
                let mut reader = Reader {
                    share: &mut contents.share,
                    total: 0,
                };
                reader.directory(&share, "", 0)?;
                found_share = !contents.share.is_empty();
            }
        }
        Ok(contents)
    }
}

/// Whether the file at an absolute path of an image, given as in [`Contents::read`], may be executed; none where there is
/// none. Links are followed as a process in the image would.
pub fn is_program<L: AsRef<Path>>(layers: &[L], path: &Path) -> Result<Option<bool>, Error> {
    let stack = merged::open(layers)?;
    let mut path = path.to_owned();
    for _ in 0..MAX_LINKS {
        let (Some(parent), Some(name)) = (path.parent(), path.file_name()) else {
            return Ok(None);
        };
        let Some(directory) = parent.to_str() else {
            return Ok(None);
        };
        let directory = Merged::at(&stack, directory)?;
        let names = directory.names()?;
        let Some((name, level)) = names.get_key_value(name.as_encoded_bytes()) else {
            return Ok(None);
        };
        match level.link(name) {
            Some(target) => path = parent.join(target),
            None => return Ok(Some(level.is_executable(name))),
        }
    }
    Ok(None)
}

/// Of programs only the names are wanted, and a link to one is one.
fn executables(lib: &Merged) -> Result<BTreeSet<String>, Error> {
    let mut found = BTreeSet::new();
    for (name, level) in lib.names()? {
        let Ok(text) = String::from_utf8(name.clone()) else {
            continue;
        };
        if names::is_executable(&text)
            && (level.is_executable(&name) || level.link(&name).is_some())
        {
            found.insert(text);
        }
    }
    Ok(found)
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

        fn read(&self, package: &str) -> Contents {
            let layers = [self.0.path().join("low"), self.0.path().join("high")];
            Contents::read(&layers, &["opt/mine", "usr"], package).expect("read")
        }
    }

    fn layers() -> Layers {
        let layers = Layers(tempfile::tempdir().expect("a directory"));
        layers
            .file("low/usr/lib/p/node", "ELF", 0o755)
            .file("low/usr/lib/p/notes.txt", "", 0o644)
            .file("low/usr/share/p/package.xml", "low", 0o644)
            .file("low/usr/share/p/launch/a.launch", "<launch/>", 0o644)
            .file("high/usr/share/p/package.xml", "high", 0o644)
            .file("high/usr/share/p/scripts/tool.py", "#!", 0o755);
        layers
    }

    #[test]
    fn programs_and_shared_files_of_all_layers_are_found() {
        let contents = layers().read("p");
        assert_eq!(contents.executables, ["node".to_owned()].into());
        let names: Vec<&str> = contents.share.keys().map(String::as_str).collect();
        assert_eq!(names, ["launch/a.launch", "package.xml", "scripts/tool.py"]);
        let Content::File { bytes, executable } = &contents.share["package.xml"] else {
            panic!("a file")
        };
        assert_eq!((&bytes[..], *executable), (&b"high"[..], false));
    }

    #[test]
    fn the_first_prefix_wins_and_an_unknown_package_is_empty() {
        let layers = layers();
        layers
            .file("high/opt/mine/share/p/package.xml", "mine", 0o644)
            .file("high/opt/mine/lib/p/other", "", 0o755);
        let contents = layers.read("p");
        assert_eq!(contents.executables, ["other".to_owned()].into());
        assert_eq!(contents.share.len(), 1);
        assert_eq!(layers.read("q"), Contents::default());
        assert_eq!(layers.read("../p"), Contents::default());
    }

    #[test]
    fn programs_are_told_from_data() {
        let layers = layers();
        layers
            .file("low/usr/share/p/map.yaml", "", 0o644)
            .file("high/usr/lib/p/hidden", "", 0o644)
            .file("low/usr/lib/p/hidden", "", 0o755);
        for (name, target) in [
            ("high/usr/lib/p/alias", "../../share/p/scripts/tool.py"),
            ("high/usr/lib/p/data", "/usr/share/p/map.yaml"),
            ("high/usr/lib/p/lost", "nowhere"),
            ("high/usr/lib/p/round", "round"),
        ] {
            symlink(target, layers.place(name)).expect("linked");
        }
        let stack = [layers.0.path().join("low"), layers.0.path().join("high")];
        for (path, expected) in [
            ("/usr/lib/p/node", Some(true)),
            ("/usr/share/p/scripts/tool.py", Some(true)),
            ("/usr/lib/p/alias", Some(true)),
            ("/usr/share/p/map.yaml", Some(false)),
            ("/usr/share/p/launch", Some(false)),
            ("/usr/lib/p/data", Some(false)),
            ("/usr/lib/p/hidden", Some(false)),
            ("/usr/lib/p/lost", None),
            ("/usr/lib/p/round", None),
            ("/usr/lib/p/none", None),
            ("/", None),
        ] {
            let told = is_program(&stack, Path::new(path)).expect("read");
            assert_eq!(told, expected, "{path}");
        }
    }

    #[test]
    fn a_prefix_cannot_lead_out_of_the_layers() {
        let layers = layers();
        layers
            .file("secret/share/p/package.xml", "the host's", 0o600)
            .file("secret/lib/p/tool", "", 0o755);
        let stack = [layers.0.path().join("low"), layers.0.path().join("high")];
        for prefix in ["../secret", "usr/../../secret", "/../../../secret"] {
            let contents = Contents::read(&stack, &[prefix], "p").expect("read");
            assert_eq!(contents, Contents::default(), "{prefix}");
        }
        // As a process in the image would find it.
        let contents = Contents::read(&stack, &["opt/../usr", "../usr"], "p").expect("read");
        assert!(contents.share.contains_key("package.xml"));
    }

    #[test]
    fn links_stay_in_the_package_or_are_left_out() {
        let layers = layers();
        for (name, target) in [
            ("high/usr/share/p/launch/b.launch", "a.launch"),
            ("high/usr/share/p/launch/up", "../package.xml"),
            ("high/usr/share/p/launch/out", "../../q/package.xml"),
            ("high/usr/share/p/launch/host", "/etc/shadow"),
            ("high/usr/lib/p/alias", "node"),
        ] {
            symlink(target, layers.place(name)).expect("linked");
        }
        let contents = layers.read("p");
        assert_eq!(
            contents.share["launch/b.launch"],
            Content::Link("a.launch".into())
        );
        assert!(contents.share.contains_key("launch/up"));
        assert!(!contents.share.contains_key("launch/out"));
        assert!(!contents.share.contains_key("launch/host"));
        assert!(contents.executables.contains("alias"));
    }
}
