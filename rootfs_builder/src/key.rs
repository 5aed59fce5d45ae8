//! Keys: names of results by what they were made from.

use std::ffi::OsStr;
use std::fs::File;
use std::io::Read;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::error::{Error, IoAt};

/// Part of every key: raise it when the same inputs begin to give another result.
const BUILDER: &str = "cloudroid-rootfs-1";

/// SHA-256, hex.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// A key that grows by named inputs. Order matters; every part is delimited.
pub(crate) struct Key(Sha256);

impl Key {
    /// Of one kind of result, such as `base`.
    pub(crate) fn new(kind: &str) -> Self {
        Self(Sha256::new())
            .with("builder", BUILDER)
            .with("kind", kind)
    }

    /// One more input.
    pub(crate) fn with(mut self, name: &str, value: impl AsRef<[u8]>) -> Self {
        for part in [name.as_bytes(), value.as_ref()] {
            self.0.update((part.len() as u64).to_le_bytes());
            self.0.update(part);
        }
        self
    }

    /// Several inputs of one name.
    pub(crate) fn with_all<T: AsRef<[u8]>>(
        mut self,
        name: &str,
        values: impl IntoIterator<Item = T>,
    ) -> Self {
        for value in values {
            self = self.with(name, value);
        }
        self
    }

    /// Hex.
    pub(crate) fn finish(self) -> String {
        hex::encode(self.0.finalize())
    }
}

/// A file tree's names, kinds, execute bits and contents. Owners and times do not matter.
pub(crate) fn tree(root: &Path) -> Result<String, Error> {
    hash(root, |_| true)
}

/// The same without what version control keeps beside the sources.
pub(crate) fn sources(root: &Path) -> Result<String, Error> {
    hash(root, |name| {
        ![".git", ".hg", ".svn"].iter().any(|kept| name == *kept)
    })
}

fn hash(root: &Path, wanted: impl Fn(&OsStr) -> bool) -> Result<String, Error> {
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 64 * 1024];
    let add = |hash: &mut Sha256, part: &[u8]| {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    };
    let entries = walkdir::WalkDir::new(root).sort_by_file_name().into_iter();
    for entry in entries.filter_entry(|entry| entry.depth() == 0 || wanted(entry.file_name())) {
        let entry = entry.map_err(|error| Error::io("reading", root, error.into()))?;
        let path = entry.path();
        let relative = path.strip_prefix(root).unwrap_or(path);
        add(&mut hash, relative.as_os_str().as_bytes());
        let kind = entry.file_type();
        if kind.is_symlink() {
            add(&mut hash, b"link");
            add(
                &mut hash,
                std::fs::read_link(path)
                    .at("reading", path)?
                    .as_os_str()
                    .as_bytes(),
            );
        } else if kind.is_file() {
            let mut file = File::open(path).at("reading", path)?;
            let about = file.metadata().at("reading", path)?;
            add(
                &mut hash,
                if about.permissions().mode() & 0o111 != 0 {
                    b"executable"
                } else {
                    b"file"
                },
            );
            hash.update(about.len().to_le_bytes());
            loop {
                let read = file.read(&mut buffer).at("reading", path)?;
                if read == 0 {
                    break;
                }
                hash.update(&buffer[..read]);
            }
        } else {
            add(&mut hash, b"directory");
        }
    }
    Ok(hex::encode(hash.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_do_not_run_into_each_other() {
        let one = Key::new("x").with("a", "bc").finish();
        assert_ne!(one, Key::new("x").with("ab", "c").finish());
        assert_eq!(one, Key::new("x").with("a", "bc").finish());
        assert_ne!(Key::new("x").finish(), Key::new("y").finish());
    }

    #[test]
    fn a_tree_is_known_by_content_and_not_by_time() {
        let make = |text: &str, mode: u32| {
            let root = tempfile::tempdir().expect("a directory");
            let file = root.path().join("d/f");
            std::fs::create_dir(root.path().join("d")).expect("made");
            std::fs::write(&file, text).expect("written");
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).expect("set");
            tree(root.path()).expect("hashed")
        };
        let first = make("x", 0o644);
        assert_eq!(first, make("x", 0o600));
        assert_ne!(first, make("y", 0o644));
        assert_ne!(first, make("x", 0o755));
    }

    #[test]
    fn a_commit_changes_no_sources() {
        let root = tempfile::tempdir().expect("a directory");
        std::fs::create_dir(root.path().join(".git")).expect("made");
        std::fs::write(root.path().join("CMakeLists.txt"), "project(x)").expect("written");
        let before = (
            sources(root.path()).expect("hashed"),
            tree(root.path()).expect("hashed"),
        );
        std::fs::write(root.path().join(".git/HEAD"), "x").expect("written");
        assert_eq!(sources(root.path()).expect("hashed"), before.0);
        assert_ne!(tree(root.path()).expect("hashed"), before.1);
    }
}
