//! Message, service and action definitions in extracted layers.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use ros::schema::{InterfaceFile, SchemaError};

use crate::merged::{self, LayerDirectory, MergedDirectory};
use crate::{Error, names};

/// Definition texts by `package/msg/Type`, `package/srv/Type` and `package/action/Type`.
pub type Definitions = BTreeMap<String, String>;

/// Maximum size of a definition in bytes.
const MAX_BYTES: u64 = 256 << 10;
/// Maximum total size of all definitions in bytes.
const MAX_TOTAL: usize = 32 << 20;
const MAX_FILES: usize = 20_000;
/// Maximum number and depth of the directories of a package that are searched for definitions.
const MAX_DIRECTORIES: usize = 2000;
const MAX_DEPTH: usize = 8;

/// Directories of a package that usually contain definitions, and the file extension of each kind.
const KINDS: [(&str, &str); 3] = [("msg", ".msg"), ("srv", ".srv"), ("action", ".action")];

/// An additional format of interface files; some ROS 2 packages have no other.
struct InterfaceFormat {
    extension: &'static str,
    read: fn(&str, &str) -> Result<InterfaceFile, SchemaError>,
}

const FORMS: [InterfaceFormat; 2] = [
    InterfaceFormat { extension: ".idl", read: InterfaceFile::read_idl },
    InterfaceFormat { extension: ".json", read: InterfaceFile::read_description },
];

/// Reads all definitions below the share directories of a stack of layers.
///
/// `layers` are extracted trees, lowest first. `shares` are paths in them such as `usr/share` and
/// `opt/ros/noetic/share`; of a package in several of them only the definitions in the first are used, as in ROS
/// itself; of several definitions of one type the one in `msg`, `srv` or `action`. Text that is not UTF-8 (in comments)
/// is replaced. IDL and type descriptions are converted to the language of `.msg` if the package has no such file.
pub fn read<L: AsRef<Path>, S: AsRef<str>>(layers: &[L], shares: &[S]) -> Result<Definitions, Error> {
    let stack = merged::open_layers(layers)?;
    let mut reader = DefinitionReader { definitions: Definitions::new(), packages: BTreeSet::new(), total: 0 };
    for share in shares {
        reader.read_share(&MergedDirectory::open_path(&stack, share.as_ref())?)?;
    }
    Ok(reader.definitions)
}

struct DefinitionReader {
    definitions: Definitions,
    /// Packages found in earlier share directories.
    packages: BTreeSet<String>,
    total: usize,
}

impl DefinitionReader {
    fn read_share(&mut self, share: &MergedDirectory) -> Result<(), Error> {
        let mut found = Vec::new();
        for name in share.names()?.into_keys() {
            let Ok(name) = String::from_utf8(name) else {
                continue;
            };
            if !names::is_package(&name) || self.packages.contains(&name) {
                continue;
            }
            let before = self.definitions.len();
            self.read_package(&name, &share.open_child(name.as_bytes())?)?;
            if self.definitions.len() > before {
                found.push(name);
            }
        }
        self.packages.extend(found);
        Ok(())
    }

    fn read_package(&mut self, package: &str, directory: &MergedDirectory) -> Result<(), Error> {
        for (kind, extension) in KINDS {
            let merged = directory.open_child(kind.as_bytes())?;
            let files = merged.names()?;
            for (level, name, of_type) in files_with_extension(&files, extension) {
                if let Some(text) = self.read_file(level, name)? {
                    self.definitions.insert(format!("{package}/{kind}/{of_type}"), text);
                }
            }
            for form in FORMS {
                for (level, name, of_type) in files_with_extension(&files, form.extension) {
                    let key = format!("{package}/{kind}/{of_type}");
                    if self.definitions.contains_key(&key) {
                        continue;
                    }
                    let Some(text) = self.read_file(level, name)? else {
                        continue;
                    };
                    // A definition that cannot be parsed is reported where it is needed.
                    if let Ok(read) = (form.read)(&key, &text)
                        && let Some(text) = read.definitions.get(&key)
                    {
                        self.definitions.insert(key, text.clone());
                    }
                }
            }
        }
        let mut left = MAX_DIRECTORIES;
        self.read_subdirectories(package, directory, MAX_DEPTH, &mut left)
    }

    /// Adds definitions in other directories of a ROS package, as installed by `add_service_files(DIRECTORY services)`
    /// of ROS 1. Large files and directories are data and are skipped.
    fn read_subdirectories(
        &mut self,
        package: &str,
        directory: &MergedDirectory,
        depth: usize,
        left: &mut usize,
    ) -> Result<(), Error> {
        let files = match directory.names() {
            Err(Error::TooMany { .. }) => return Ok(()),
            files => files?,
        };
        // Besides ROS packages, `share` contains many other, large directories.
        if depth == MAX_DEPTH && !files.contains_key(b"package.xml".as_slice()) {
            return Ok(());
        }
        for (kind, extension) in KINDS {
            for (level, name, of_type) in files_with_extension(&files, extension) {
                let key = format!("{package}/{kind}/{of_type}");
                if self.definitions.contains_key(&key) {
                    continue;
                }
                let text = match self.read_file(level, name) {
                    Err(Error::TooLarge { .. }) => None,
                    text => text?,
                };
                if let Some(text) = text {
                    self.definitions.insert(key, text);
                }
            }
        }
        for name in files.keys() {
            if depth == 0 || *left == 0 {
                break;
            }
            let inside = directory.open_child(name)?;
            if inside.exists() {
                *left -= 1;
                self.read_subdirectories(package, &inside, depth - 1, left)?;
            }
        }
        Ok(())
    }

    /// Reads the text of a file; `None` for a link, a deletion or anything else that is not a file.
    fn read_file(&mut self, level: &LayerDirectory, name: &str) -> Result<Option<String>, Error> {
        let Some(file) = level.file(name.as_bytes(), MAX_BYTES)? else {
            return Ok(None);
        };
        let (path, bytes) = (level.path().join(name), file.bytes);
        self.total += bytes.len();
        if self.total > MAX_TOTAL || self.definitions.len() >= MAX_FILES {
            return Err(Error::TooMany { path, what: "message definitions before it", limit: self.definitions.len() });
        }
        Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
    }
}

/// Returns the files with an extension and a valid type name, and the names without it.
fn files_with_extension<'a>(
    files: &'a BTreeMap<Vec<u8>, &'a LayerDirectory>,
    extension: &'a str,
) -> impl Iterator<Item = (&'a LayerDirectory, &'a str, &'a str)> {
    files.iter().filter_map(move |(name, level)| {
        let name = std::str::from_utf8(name).ok()?;
        let of_type = name.strip_suffix(extension)?;
        names::is_type(of_type).then_some((*level, name, of_type))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;
    use std::path::PathBuf;

    use rustix::fs::Mode;

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
            let layers: Vec<PathBuf> = layers.iter().map(|layer| self.0.path().join(layer)).collect();
            read(&layers, &["opt/x/share", "usr/share"])
        }
    }

    fn list(definitions: &Definitions) -> Vec<(&str, &str)> {
        definitions.iter().map(|(key, text)| (key.as_str(), text.as_str())).collect()
    }

    #[test]
    fn definitions_of_all_kinds_are_found_and_nothing_else() {
        let layers = Layers::new();
        layers
            .write("base/usr/share/std_msgs/msg/String.msg", "string data")
            .write("base/usr/share/std_srvs/srv/Empty.srv", "---")
            .write("base/usr/share/demo/action/Go.action", b"# caf\xe9\n---\n---\n")
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

    /// Interface files that rosidl generates next to each other.
    const IDL: &str = "module p { module msg { struct Point { double x; double y; }; }; };";
    const DESCRIPTION: &str = r#"{"type_description_msg": {"type_description": {"type_name": "p/msg/Count",
        "fields": [{"name": "n", "type": {"type_id": 6, "capacity": 0, "string_capacity": 0,
        "nested_type_name": ""}, "default_value": "7"}]}, "referenced_type_descriptions": []}}"#;

    #[test]
    fn other_forms_of_ros_2_count_where_there_is_no_text() {
        let layers = Layers::new();
        layers
            .write("base/usr/share/p/msg/Point.idl", IDL)
            .write("base/usr/share/p/msg/Count.json", DESCRIPTION)
            .write("base/usr/share/p/msg/Both.msg", "int8 of_text")
            .write("base/usr/share/p/msg/Both.idl", IDL)
            .write("base/usr/share/p/msg/Torn.idl", "module p {")
            .write("base/usr/share/p/srv/readme.json", "{}");
        let found = layers.read(&["base"]).unwrap();
        let names: Vec<_> = found.keys().map(String::as_str).collect();
        assert_eq!(names, ["p/msg/Both", "p/msg/Count", "p/msg/Point"]);
        assert_eq!(found["p/msg/Both"], "int8 of_text");
        assert_eq!(found["p/msg/Count"], "int32 n 7\n");
        let registry = ros::schema::Registry::with_definitions(ros::bus::RosVersion::Two, &found).unwrap();
        assert_eq!(registry.message("p/msg/Point").unwrap().fields().len(), 2);
    }

    #[test]
    fn definitions_anywhere_in_a_package_are_found() {
        let layers = Layers::new();
        layers
            .write("base/usr/share/p/package.xml", "x")
            .write("base/usr/share/p/msg/Twice.msg", "int8 canonical")
            .write("base/usr/share/p/services/Ask.srv", "---")
            .write("base/usr/share/p/interfaces/deep/Told.msg", "string told")
            .write("base/usr/share/p/interfaces/deep/Go.action", "---\n---\n")
            .write("base/usr/share/p/a/Twice.msg", "int8 other")
            .write("base/usr/share/p/mail/Large.msg", "#".repeat(300 << 10))
            // Not a ROS package, whatever it contains.
            .write("base/usr/share/doc/mails/Letter.msg", "x");
        for number in 0..=merged::MAX_FILES {
            layers.write(&format!("base/usr/share/p/data/{number}.png"), "");
        }
        let found = layers.read(&["base"]).unwrap();
        assert_eq!(
            list(&found),
            [
                ("p/action/Go", "---\n---\n"),
                ("p/msg/Told", "string told"),
                ("p/msg/Twice", "int8 canonical"),
                ("p/srv/Ask", "---"),
            ]
        );
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
        rustix::fs::setxattr(&fresh, "user.overlay.opaque", b"y", rustix::fs::XattrFlags::empty()).unwrap();
        let found = layers.read(&["lower", "upper"]).unwrap();
        assert_eq!(list(&found), [("fresh/msg/New", "new"), ("p/msg/A", "lower A"), ("p/msg/B", "upper B")]);
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
        symlink(outside.0.path().join("msg/Secret.msg"), layers.path("base/usr/share/p/msg/S.msg")).unwrap();
        symlink(outside.0.path().join("msg"), layers.path("base/usr/share/p/srv")).unwrap();
        symlink(outside.0.path(), layers.path("base/usr/share/q")).unwrap();
        symlink(outside.0.path(), layers.path("base/opt/x/share")).unwrap();
        let here = std::fs::File::open(layers.path("base/usr/share/p/msg/x").parent().unwrap()).unwrap();
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
        assert!(text.contains("p/msg/Big.msg is larger than the limit of 262144 bytes"), "{text}");
        let text = layers.read(&["missing"]).unwrap_err().to_string();
        assert!(text.starts_with("cannot open ") && text.contains("missing"), "{text}");
    }
}
