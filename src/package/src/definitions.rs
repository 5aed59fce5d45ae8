//! Definitions of messages, services and actions in extracted layers.
//!
//! The layers are other people's: each is a tree whose links, device nodes and sizes mean nothing good. So the
//! stack is walked by directory descriptors, as an overlay mount would merge it, without following any link.

use std::collections::{BTreeMap, BTreeSet};
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};

use rustix::fs::{Dir, Mode, OFlags};
use rustix::io::Errno;

use crate::{Error, names, read};

/// Texts by `package/msg/Type`, `package/srv/Type` and `package/action/Type`.
pub type Definitions = BTreeMap<String, String>;

/// The largest definition that is read.
const MAX_BYTES: u64 = 256 << 10;
/// All definitions together.
const MAX_TOTAL: usize = 32 << 20;
const MAX_FILES: usize = 20_000;

/// Directories of a package and the files in them.
const KINDS: [(&str, &str); 3] = [("msg", ".msg"), ("srv", ".srv"), ("action", ".action")];

const DIRECTORY: OFlags = OFlags::RDONLY
    .union(OFlags::DIRECTORY)
    .union(OFlags::NOFOLLOW)
    .union(OFlags::CLOEXEC);
const FILE: OFlags = OFlags::RDONLY
    .union(OFlags::NOFOLLOW)
    .union(OFlags::NONBLOCK)
    .union(OFlags::CLOEXEC);

/// Reads all definitions below the share directories of a stack of layers.
///
/// `layers` are extracted trees, lowest first. `shares` are paths in them such as `usr/share` and
/// `opt/ros/noetic/share`; of a package that is in several of them only the definitions in the first count, as ROS
/// itself finds them. Text that is not UTF-8 (in comments) is replaced.
pub fn read<L: AsRef<Path>, S: AsRef<str>>(
    layers: &[L],
    shares: &[S],
) -> Result<Definitions, Error> {
    let mut stack = Vec::new();
    for layer in layers.iter().rev() {
        let path = layer.as_ref().to_owned();
        // The layers' own paths are ours, and may lead through links.
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let directory = rustix::fs::open(&path, flags, Mode::empty())
            .map_err(|error| read::failed("open", &path, error))?;
        stack.push(Level { directory, path });
    }
    let mut reader = Reader {
        definitions: Definitions::new(),
        packages: BTreeSet::new(),
        total: 0,
    };
    for share in shares {
        let parts = share
            .as_ref()
            .split('/')
            .filter(|part| !part.is_empty() && *part != ".");
        let mut merged = Merged::top(&stack)?;
        for part in parts {
            merged = merged.below(part.as_bytes())?;
        }
        reader.share(&merged)?;
    }
    Ok(reader.definitions)
}

/// One layer's part of a directory.
struct Level {
    directory: OwnedFd,
    path: PathBuf,
}

/// A directory as an overlay mount shows it: its parts, the uppermost first.
struct Merged {
    levels: Vec<Level>,
}

impl Merged {
    fn top(stack: &[Level]) -> Result<Self, Error> {
        let levels = stack.iter().map(|level| {
            let directory = level
                .directory
                .try_clone()
                .map_err(|error| read::failed("open", &level.path, error))?;
            Ok(Level {
                directory,
                path: level.path.clone(),
            })
        });
        Ok(Self {
            levels: levels.collect::<Result<_, Error>>()?,
        })
    }

    /// A directory in this one; one without parts if there is none.
    fn below(&self, name: &[u8]) -> Result<Self, Error> {
        let mut levels = Vec::new();
        for level in &self.levels {
            let path = level.path.join(shown(name));
            match rustix::fs::openat(&level.directory, name, DIRECTORY, Mode::empty()) {
                Ok(directory) => {
                    let opaque = is_opaque(&directory);
                    levels.push(Level { directory, path });
                    if opaque {
                        break;
                    }
                }
                Err(Errno::NOENT) => {}
                // A file, a link or a deletion: it hides what the layers below have.
                Err(Errno::NOTDIR | Errno::LOOP | Errno::NXIO) => break,
                Err(error) => return Err(read::failed("open", &path, error)),
            }
        }
        Ok(Self { levels })
    }

    /// All names in it, each with the uppermost level that has it.
    fn names(&self) -> Result<BTreeMap<Vec<u8>, &Level>, Error> {
        let mut names = BTreeMap::new();
        for level in &self.levels {
            let failed = |error| read::failed("list", &level.path, error);
            for entry in Dir::read_from(level.directory.as_fd()).map_err(failed)? {
                let name = entry.map_err(failed)?.file_name().to_bytes().to_vec();
                names.entry(name).or_insert(level);
            }
            if names.len() > MAX_FILES {
                return Err(Error::TooMany {
                    path: level.path.clone(),
                    what: "files",
                    limit: MAX_FILES,
                });
            }
        }
        Ok(names)
    }
}

/// Whether a directory hides those of its name in the layers below.
fn is_opaque(directory: &OwnedFd) -> bool {
    ["trusted.overlay.opaque", "user.overlay.opaque"]
        .iter()
        .any(|name| {
            let mut value = [0; 4];
            rustix::fs::fgetxattr(directory, *name, &mut value[..])
                .is_ok_and(|length| &value[..length] == b"y")
        })
}

struct Reader {
    definitions: Definitions,
    /// Packages that an earlier share directory had.
    packages: BTreeSet<String>,
    total: usize,
}

impl Reader {
    fn share(&mut self, share: &Merged) -> Result<(), Error> {
        let mut found = Vec::new();
        for name in share.names()?.into_keys() {
            let Ok(name) = String::from_utf8(name) else {
                continue;
            };
            if !names::is_package(&name) || self.packages.contains(&name) {
                continue;
            }
            let before = self.definitions.len();
            self.package(&name, &share.below(name.as_bytes())?)?;
            if self.definitions.len() > before {
                found.push(name);
            }
        }
        self.packages.extend(found);
        Ok(())
    }

    fn package(&mut self, package: &str, directory: &Merged) -> Result<(), Error> {
        for (kind, extension) in KINDS {
            let merged = directory.below(kind.as_bytes())?;
            for (name, level) in merged.names()? {
                let Ok(name) = String::from_utf8(name) else {
                    continue;
                };
                let Some(of_type) = name
                    .strip_suffix(extension)
                    .filter(|name| names::is_type(name))
                else {
                    continue;
                };
                if let Some(text) = self.file(level, &name)? {
                    self.definitions
                        .insert(format!("{package}/{kind}/{of_type}"), text);
                }
            }
        }
        Ok(())
    }

    /// The text of a file; none for a link, a deletion or anything else that is no file.
    fn file(&mut self, level: &Level, name: &str) -> Result<Option<String>, Error> {
        let path = level.path.join(name);
        let file = match rustix::fs::openat(&level.directory, name, FILE, Mode::empty()) {
            Ok(file) => file,
            Err(Errno::LOOP | Errno::NXIO | Errno::NODEV | Errno::NOENT) => return Ok(None),
            Err(error) => return Err(read::failed("open", &path, error)),
        };
        let stat =
            rustix::fs::fstat(&file).map_err(|error| read::failed("look at", &path, error))?;
        if rustix::fs::FileType::from_raw_mode(stat.st_mode) != rustix::fs::FileType::RegularFile {
            return Ok(None);
        }
        let bytes = read::bytes(file, &path, MAX_BYTES)?;
        self.total += bytes.len();
        if self.total > MAX_TOTAL || self.definitions.len() >= MAX_FILES {
            return Err(Error::TooMany {
                path,
                what: "message definitions before it",
                limit: self.definitions.len(),
            });
        }
        Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
    }
}

fn shown(name: &[u8]) -> PathBuf {
    PathBuf::from(String::from_utf8_lossy(name).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    struct Layers(tempfile::TempDir);

    impl Layers {
        fn new() -> Self {
            Self(tempfile::tempdir().unwrap())
        }

        fn path(&self, name: &str) -> PathBuf {
            let path = self.0.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            path
        }

        fn write(&self, name: &str, text: impl AsRef<[u8]>) -> &Self {
            std::fs::write(self.path(name), text).unwrap();
            self
        }

        fn read(&self, layers: &[&str]) -> Result<Definitions, Error> {
            let layers: Vec<PathBuf> = layers
                .iter()
                .map(|layer| self.0.path().join(layer))
                .collect();
            read(&layers, &["opt/x/share", "usr/share"])
        }
    }

    fn list(definitions: &Definitions) -> Vec<(&str, &str)> {
        definitions
            .iter()
            .map(|(key, text)| (key.as_str(), text.as_str()))
            .collect()
    }

    #[test]
    fn definitions_of_all_kinds_are_found_and_nothing_else() {
        let layers = Layers::new();
        layers
            .write("base/usr/share/std_msgs/msg/String.msg", "string data")
            .write("base/usr/share/std_srvs/srv/Empty.srv", "---")
            .write(
                "base/usr/share/demo/action/Go.action",
                b"# caf\xe9\n---\n---\n",
            )
            .write("base/usr/share/std_msgs/msg/readme.txt", "x")
            .write("base/usr/share/std_msgs/msg/no-type.msg", "x")
            .write("base/usr/share/.hidden/msg/X.msg", "x")
            .write("base/usr/share/std_msgs/package.xml", "x");
        let found = layers.read(&["base"]).unwrap();
        let expected = [
            ("demo/action/Go", "# caf\u{fffd}\n---\n---\n"),
            ("std_msgs/msg/String", "string data"),
            ("std_srvs/srv/Empty", "---"),
        ];
        assert_eq!(list(&found), expected);
    }

    #[test]
    fn the_upper_layer_wins_and_can_delete() {
        let layers = Layers::new();
        layers
            .write("lower/usr/share/p/msg/A.msg", "lower A")
            .write("lower/usr/share/p/msg/B.msg", "lower B")
            .write("lower/usr/share/p/msg/C.msg", "lower C")
            .write("lower/usr/share/gone/msg/A.msg", "x")
            .write("lower/usr/share/fresh/msg/Old.msg", "x")
            .write("upper/usr/share/p/msg/B.msg", "upper B")
            .write("upper/usr/share/fresh/msg/New.msg", "new");
        let whiteout = |name: &str| {
            let parent = std::fs::File::open(layers.path(name).parent().unwrap()).unwrap();
            let name = Path::new(name).file_name().unwrap();
            let kind = rustix::fs::FileType::CharacterDevice;
            rustix::fs::mknodat(parent, name, kind, Mode::empty(), 0).unwrap();
        };
        whiteout("upper/usr/share/p/msg/C.msg");
        whiteout("upper/usr/share/gone");
        let fresh = layers.path("upper/usr/share/fresh");
        rustix::fs::setxattr(
            &fresh,
            "user.overlay.opaque",
            b"y",
            rustix::fs::XattrFlags::empty(),
        )
        .unwrap();
        let found = layers.read(&["lower", "upper"]).unwrap();
        assert_eq!(
            list(&found),
            [
                ("fresh/msg/New", "new"),
                ("p/msg/A", "lower A"),
                ("p/msg/B", "upper B")
            ]
        );
    }

    #[test]
    fn the_first_share_directory_has_the_whole_package() {
        let layers = Layers::new();
        layers
            .write("base/usr/share/p/msg/Old.msg", "old")
            .write("base/usr/share/q/msg/Q.msg", "q")
            .write("base/opt/x/share/p/msg/New.msg", "new")
            .write("base/opt/x/share/q/package.xml", "no definitions");
        let found = layers.read(&["base"]).unwrap();
        assert_eq!(list(&found), [("p/msg/New", "new"), ("q/msg/Q", "q")]);
    }

    #[test]
    fn no_link_is_followed_and_nothing_blocks() {
        let outside = Layers::new();
        outside.write("msg/Secret.msg", "secret");
        let layers = Layers::new();
        layers.write("base/usr/share/p/msg/A.msg", "a");
        symlink(
            outside.0.path().join("msg/Secret.msg"),
            layers.path("base/usr/share/p/msg/S.msg"),
        )
        .unwrap();
        symlink(
            outside.0.path().join("msg"),
            layers.path("base/usr/share/p/srv"),
        )
        .unwrap();
        symlink(outside.0.path(), layers.path("base/usr/share/q")).unwrap();
        symlink(outside.0.path(), layers.path("base/opt/x/share")).unwrap();
        let here =
            std::fs::File::open(layers.path("base/usr/share/p/msg/x").parent().unwrap()).unwrap();
        rustix::fs::mkfifoat(&here, "Fifo.msg", Mode::RWXU).unwrap();
        std::fs::create_dir(layers.path("base/usr/share/p/msg/Directory.msg")).unwrap();
        assert_eq!(list(&layers.read(&["base"]).unwrap()), [("p/msg/A", "a")]);
    }

    #[test]
    fn a_link_above_hides_what_is_below() {
        let layers = Layers::new();
        layers.write("lower/usr/share/p/msg/A.msg", "a");
        symlink("/etc", layers.path("upper/usr/share/p")).unwrap();
        assert!(layers.read(&["lower", "upper"]).unwrap().is_empty());
    }

    #[test]
    fn endless_definitions_are_refused() {
        let layers = Layers::new();
        layers.write("base/usr/share/p/msg/Big.msg", "#".repeat(300 << 10));
        let text = layers.read(&["base"]).unwrap_err().to_string();
        assert!(
            text.contains("p/msg/Big.msg is larger than the 262144 bytes"),
            "{text}"
        );
        let text = layers.read(&["missing"]).unwrap_err().to_string();
        assert!(
            text.starts_with("cannot open ") && text.contains("missing"),
            "{text}"
        );
    }
}
