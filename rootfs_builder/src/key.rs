//! Cache keys: hashes of the inputs of a result.

use std::io::Read;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

use foreign::Visit;
use rustix::fs::FileType;
use sha2::{Digest, Sha256};

use crate::error::{Error, IoContext};

/// Part of every key; to be changed when the same inputs give another result.
const BUILDER: &str = "cloudroid-rootfs-1";

/// Returns the SHA-256 digest in hexadecimal.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// Builder of a key from named inputs. The order matters; all parts are delimited.
pub(crate) struct Key(Sha256);

impl Key {
    /// Starts a key for a kind of result, such as `base`.
    pub(crate) fn new(kind: &str) -> Self {
        Self(Sha256::new()).input("builder", BUILDER).input("kind", kind)
    }

    /// Adds an input.
    pub(crate) fn input(mut self, name: &str, value: impl AsRef<[u8]>) -> Self {
        for part in [name.as_bytes(), value.as_ref()] {
            self.0.update((part.len() as u64).to_le_bytes());
            self.0.update(part);
        }
        self
    }

    /// Adds several inputs of the same name.
    pub(crate) fn inputs<T: AsRef<[u8]>>(mut self, name: &str, values: impl IntoIterator<Item = T>) -> Self {
        for value in values {
            self = self.input(name, value);
        }
        self
    }

    /// Returns the key in hexadecimal.
    pub(crate) fn finish(self) -> String {
        hex::encode(self.0.finalize())
    }
}

/// Hashes the names, types, execute bits, links and contents of a file tree. Owners and times are ignored.
pub(crate) fn hash_tree(root: &Path) -> Result<String, Error> {
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 64 * 1024];
    let add = |hash: &mut Sha256, part: &[u8]| {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    };
    foreign::walk(root, |entry| {
        add(&mut hash, entry.path.as_os_str().as_bytes());
        match entry.kind() {
            FileType::Symlink => {
                add(&mut hash, b"link");
                add(&mut hash, &entry.read_link()?);
            }
            FileType::RegularFile => {
                let runs = entry.stat.st_mode & 0o111 != 0;
                add(&mut hash, if runs { b"executable" } else { b"file" });
                let mut file = entry.open()?;
                hash.update((entry.stat.st_size as u64).to_le_bytes());
                loop {
                    foreign::cancel::check().map_err(foreign::Error::from)?;
                    let read = file.read(&mut buffer).io_context("reading", entry.display_path())?;
                    if read == 0 {
                        break;
                    }
                    hash.update(&buffer[..read]);
                }
            }
            _ => add(&mut hash, b"directory"),
        }
        Ok::<_, Error>(Visit::Into)
    })?;
    Ok(hex::encode(hash.finalize()))
}

/// Hashes the sources visible to a build: everything in a sealed tree ([`crate::seal`]).
pub(crate) fn hash_sources(root: &Path) -> Result<String, Error> {
    hash_tree(root)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn parts_do_not_run_into_each_other() {
        let one = Key::new("x").input("a", "bc").finish();
        assert_ne!(one, Key::new("x").input("ab", "c").finish());
        assert_eq!(one, Key::new("x").input("a", "bc").finish());
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
            hash_tree(root.path()).expect("hashed")
        };
        let first = make("x", 0o644);
        assert_eq!(first, make("x", 0o600));
        assert_ne!(first, make("y", 0o644));
        assert_ne!(first, make("x", 0o755));
    }
}
