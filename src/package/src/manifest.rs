//! `package.xml`, formats 1 (REP 127), 2 (REP 140) and 3 (REP 149).

use std::collections::BTreeSet;
use std::path::Path;

use roxmltree::{Document, Node};

use crate::condition::Variables;
use crate::{Error, names, read, xml};

/// Group of the packages for whose `.msg`, `.srv` and `.action` files rosidl generates code.
pub const INTERFACES: &str = "rosidl_interface_packages";

/// Maximum size of a `package.xml` in bytes.
pub(crate) const MAX_BYTES: u64 = 1 << 20;

/// Content of a `package.xml`, with conditions evaluated for a distribution.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Manifest {
    /// Format: 1, 2 or 3.
    pub format: u8,
    /// Name of the package, validated.
    pub name: String,
    /// Version as written, such as `1.2.3`; empty if missing.
    pub version: String,
    /// Text of the description, with white space collapsed.
    pub description: String,
    /// Licences, as written.
    pub licenses: Vec<String>,
    /// Dependencies and their kinds.
    pub dependencies: BTreeSet<Dependency>,
    /// Build type; `catkin` unless exported otherwise.
    pub build_type: String,
    /// Groups that the package is a member of, such as [`INTERFACES`] (format 3).
    pub groups: BTreeSet<String>,
    /// Groups all of whose members are needed to build it (format 3).
    pub group_dependencies: BTreeSet<String>,
    /// Packages or rosdep keys that the package replaces (`<replace>`).
    pub replaces: BTreeSet<String>,
    /// True for a metapackage.
    pub metapackage: bool,
}

/// A dependency.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Dependency {
    /// Name of a package or a rosdep key, validated.
    pub name: String,
    /// Kind of dependency.
    pub kind: Kind,
}

/// Kinds of dependencies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// Build tool, such as catkin.
    Buildtool,
    /// Build tool for those who build against the package.
    BuildtoolExport,
    /// Headers and libraries for building it.
    Build,
    /// Headers and libraries for building against it.
    BuildExport,
    /// Needed at run time.
    Exec,
    /// Needed for testing.
    Test,
    /// Needed for building the documentation.
    Doc,
}

impl Kind {
    /// Returns whether a package of another name is needed to build or run it.
    pub fn is_needed(self) -> bool {
        !matches!(self, Self::Test | Self::Doc)
    }

    /// Returns the kinds that an element stands for in a format; `None` if the format does not define it.
    fn from_element(element: &str, format: u8) -> Option<&'static [Self]> {
        Some(match (element, format) {
            ("buildtool_depend", _) => &[Self::Buildtool],
            ("build_depend", _) => &[Self::Build],
            ("test_depend", _) => &[Self::Test],
            // Format 1 does not distinguish running from building against.
            ("run_depend", 1) => &[Self::BuildExport, Self::Exec],
            ("depend", 2..) => &[Self::Build, Self::BuildExport, Self::Exec],
            ("build_export_depend", 2..) => &[Self::BuildExport],
            ("buildtool_export_depend", 2..) => &[Self::BuildtoolExport],
            ("exec_depend", 2..) => &[Self::Exec],
            ("doc_depend", 2..) => &[Self::Doc],
            _ => return None,
        })
    }
}

impl Manifest {
    /// Reads `path` in the untrusted tree `root`, following links that stay inside.
    pub(crate) fn load(root: &Path, path: &Path, variables: &Variables) -> Result<Self, Error> {
        let text = read::read_text(root, path, MAX_BYTES)?;
        Self::parse(&text, path, variables)
    }

    /// Parses the text of a file; `path` is used in messages.
    pub fn parse(text: &str, path: &Path, variables: &Variables) -> Result<Self, Error> {
        let document = xml::parse(text).map_err(|error| Error::Manifest {
            path: path.to_owned(),
            line: error.line,
            column: error.column,
            problem: error.problem,
        })?;
        let reader = ManifestReader { document: &document, path, variables };
        reader.parse_manifest()
    }

    /// Returns whether the package needs a group that another one is a member of.
    pub fn needs_group_of(&self, other: &Self) -> bool {
        !self.group_dependencies.is_disjoint(&other.groups)
    }

    /// Returns whether at most the Python module of a dependency can be meant: the package itself consists of Python,
    /// or needs it only at run time.
    pub fn needs_as_module(&self, name: &str) -> bool {
        // Looked up, since a package may have any number of dependencies.
        let needs = |kind: Kind| self.dependencies.contains(&Dependency { name: name.to_owned(), kind });
        self.build_type == "ament_python"
            || ![Kind::Buildtool, Kind::BuildtoolExport, Kind::Build, Kind::BuildExport].into_iter().any(needs)
    }

    /// Returns the names of the dependencies of any of `kinds`.
    pub fn needs(&self, kinds: &[Kind]) -> BTreeSet<&str> {
        let wanted = self.dependencies.iter().filter(|dependency| kinds.contains(&dependency.kind));
        wanted.map(|dependency| dependency.name.as_str()).collect()
    }
}

struct ManifestReader<'a> {
    document: &'a Document<'a>,
    path: &'a Path,
    variables: &'a Variables,
}

impl<'a> ManifestReader<'a> {
    fn parse_manifest(&self) -> Result<Manifest, Error> {
        let root = self.document.root_element();
        if !root.has_tag_name("package") {
            let problem = format!("the root element is <{}>, not <package>", root.tag_name().name());
            return Err(self.manifest_error(root, problem));
        }
        let format = self.format(root)?;
        let name = self.name(root)?;
        let version = self.children(root, "version")?.first().map(|node| self.text(*node)).unwrap_or_default();
        let description =
            self.children(root, "description")?.first().map(|node| folded_text(*node)).unwrap_or_default();
        let licenses = self.children(root, "license")?.into_iter().map(|node| self.text(node)).collect();
        let dependencies = self.dependencies(root, format)?;
        let (build_type, metapackage) = self.export(root)?;
        let groups = self.groups(root, "member_of_group", format)?;
        let group_dependencies = self.groups(root, "group_depend", format)?;
        let replaces = self.names_in(root, "replace", "dependency")?;
        Ok(Manifest {
            format,
            name,
            version,
            description,
            licenses,
            dependencies,
            build_type,
            groups,
            group_dependencies,
            replaces,
            metapackage,
        })
    }

    fn format(&self, root: Node<'a, 'a>) -> Result<u8, Error> {
        match root.attribute("format").map(str::trim) {
            None | Some("1") => Ok(1),
            Some("2") => Ok(2),
            Some("3") => Ok(3),
            Some(other) => {
                Err(self.manifest_error(root, format!("unknown format {other:?}; supported are 1, 2 and 3")))
            }
        }
    }

    fn name(&self, root: Node<'a, 'a>) -> Result<String, Error> {
        let names = self.children(root, "name")?;
        let node = match names[..] {
            [] => return Err(self.manifest_error(root, "the <name> element is missing".to_owned())),
            [only] => only,
            [_, second, ..] => {
                return Err(self.manifest_error(second, "a second <name> element".to_owned()));
            }
        };
        let name = self.text(node);
        if !names::is_package(&name) {
            let problem = format!("{name:?} is not a package name: a letter, then letters, digits, _ and -");
            return Err(self.manifest_error(node, problem));
        }
        Ok(name)
    }

    fn dependencies(&self, root: Node<'a, 'a>, format: u8) -> Result<BTreeSet<Dependency>, Error> {
        let mut dependencies = BTreeSet::new();
        for node in root.children().filter(Node::is_element) {
            let Some(kinds) = Kind::from_element(node.tag_name().name(), format) else {
                continue;
            };
            if !self.applies(node)? {
                continue;
            }
            let name = self.text(node);
            if !names::is_dependency(&name) {
                let problem = format!("{name:?} in <{}> is not a valid dependency name", node.tag_name().name());
                return Err(self.manifest_error(node, problem));
            }
            dependencies.extend(kinds.iter().map(|&kind| Dependency { name: name.clone(), kind }));
        }
        Ok(dependencies)
    }

    /// Returns the names of groups in elements of this name.
    fn groups(&self, root: Node<'a, 'a>, element: &str, format: u8) -> Result<BTreeSet<String>, Error> {
        match format {
            3.. => self.names_in(root, element, "group"),
            _ => Ok(BTreeSet::new()),
        }
    }

    /// Returns the names in elements of this name, each of which names a `what`.
    fn names_in(&self, root: Node<'a, 'a>, element: &str, what: &str) -> Result<BTreeSet<String>, Error> {
        let named = self.children(root, element)?.into_iter().map(|node| {
            let name = self.text(node);
            if names::is_dependency(&name) {
                Ok(name)
            } else {
                Err(self.manifest_error(node, format!("{name:?} in <{element}> is not a valid {what} name")))
            }
        });
        named.collect()
    }

    fn export(&self, root: Node<'a, 'a>) -> Result<(String, bool), Error> {
        let (mut build_type, mut metapackage) = ("catkin".to_owned(), false);
        for export in self.children(root, "export")? {
            if let Some(node) = self.children(export, "build_type")?.first() {
                build_type = self.text(*node);
            }
            metapackage |= !self.children(export, "metapackage")?.is_empty();
        }
        Ok((build_type, metapackage))
    }

    /// Returns the child elements of this name whose conditions hold.
    fn children(&self, parent: Node<'a, 'a>, name: &str) -> Result<Vec<Node<'a, 'a>>, Error> {
        let mut found = Vec::new();
        for node in parent.children().filter(|node| node.has_tag_name(name)) {
            if self.applies(node)? {
                found.push(node);
            }
        }
        Ok(found)
    }

    fn applies(&self, node: Node<'a, 'a>) -> Result<bool, Error> {
        let Some(condition) = node.attribute("condition") else {
            return Ok(true);
        };
        let wrong = |problem| self.manifest_error(node, format!("invalid condition {condition:?}: {problem}"));
        self.variables.evaluate(condition).map_err(wrong)
    }

    fn text(&self, node: Node<'a, 'a>) -> String {
        folded_text(node)
    }

    fn manifest_error(&self, node: Node<'a, 'a>, problem: String) -> Error {
        let position = self.document.text_pos_at(node.range().start);
        Error::Manifest { path: self.path.to_owned(), line: position.row, column: position.col, problem }
    }
}

/// Returns all text in an element, with white space collapsed.
fn folded_text(node: Node<'_, '_>) -> String {
    let texts = node.descendants().filter(Node::is_text).filter_map(|text| text.text());
    let text: String = texts.collect();
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Manifest, Error> {
        Manifest::parse(text, Path::new("src/x/package.xml"), &Variables::for_distribution(1, "noetic"))
    }

    fn refusal(text: &str) -> String {
        parse(text).unwrap_err().to_string()
    }

    fn needs(manifest: &Manifest, kind: Kind) -> Vec<&str> {
        manifest.needs(&[kind]).into_iter().collect()
    }

    #[test]
    fn format_1() {
        let manifest = parse(
            r#"<package>
                 <name> people_detect </name><version>1.2.3</version>
                 <description>Finds <b>people</b>
                   in pictures</description>
                 <license>BSD</license><license>MIT</license>
                 <buildtool_depend>catkin</buildtool_depend>
                 <build_depend version_gte="1.0">roscpp</build_depend>
                 <run_depend>rospy</run_depend>
                 <test_depend>gtest</test_depend>
                 <depend>ignored_in_format_1</depend>
               </package>"#,
        )
        .unwrap();
        assert_eq!((manifest.format, &manifest.name[..], &manifest.version[..]), (1, "people_detect", "1.2.3"));
        assert_eq!(manifest.description, "Finds people in pictures");
        assert_eq!(manifest.licenses, ["BSD", "MIT"]);
        assert_eq!(needs(&manifest, Kind::Buildtool), ["catkin"]);
        assert_eq!(needs(&manifest, Kind::Build), ["roscpp"]);
        assert_eq!(needs(&manifest, Kind::BuildExport), ["rospy"]);
        assert_eq!(needs(&manifest, Kind::Exec), ["rospy"]);
        assert_eq!(needs(&manifest, Kind::Test), ["gtest"]);
        assert_eq!((&manifest.build_type[..], manifest.metapackage), ("catkin", false));
    }

    #[test]
    fn format_2() {
        let manifest = parse(
            r#"<?xml version="1.0"?>
               <?xml-model href="package_format2.xsd"?>
               <package format="2">
                 <name>x</name>
                 <depend>roscpp</depend>
                 <build_export_depend>eigen</build_export_depend>
                 <exec_depend>rospy</exec_depend>
                 <doc_depend>doxygen</doc_depend>
                 <buildtool_export_depend>genmsg</buildtool_export_depend>
                 <export><metapackage/></export>
               </package>"#,
        )
        .unwrap();
        assert_eq!(needs(&manifest, Kind::Build), ["roscpp"]);
        assert_eq!(needs(&manifest, Kind::BuildExport), ["eigen", "roscpp"]);
        assert_eq!(needs(&manifest, Kind::Exec), ["roscpp", "rospy"]);
        assert_eq!(needs(&manifest, Kind::Doc), ["doxygen"]);
        assert_eq!(needs(&manifest, Kind::BuildtoolExport), ["genmsg"]);
        assert!(manifest.metapackage);
    }

    #[test]
    fn format_3_is_read_for_its_distribution() {
        let manifest = parse(
            r#"<package format="3">
                 <name>x</name>
                 <depend condition="$ROS_VERSION == 1">roscpp</depend>
                 <depend condition="$ROS_VERSION == 2">rclcpp</depend>
                 <exec_depend condition="$ROS_PYTHON_VERSION == 2">python-numpy</exec_depend>
                 <exec_depend condition="$ROS_PYTHON_VERSION == 3">python3-numpy</exec_depend>
                 <export>
                   <build_type condition="$ROS_VERSION == 1">catkin</build_type>
                   <build_type condition="$ROS_VERSION == 2">ament_cmake</build_type>
                 </export>
               </package>"#,
        )
        .unwrap();
        assert_eq!(needs(&manifest, Kind::Exec), ["python3-numpy", "roscpp"]);
        assert_eq!(manifest.build_type, "catkin");
    }

    /// A typical package.xml for both ROS versions.
    const MANIFEST_OF_BOTH: &str = r#"<?xml version="1.0"?>
        <package format="3">
          <name>both_msgs</name><version>1.0.0</version>
          <buildtool_depend condition="$ROS_VERSION == 1">catkin</buildtool_depend>
          <buildtool_depend condition="$ROS_VERSION == 2">ament_cmake</buildtool_depend>
          <buildtool_depend condition="$ROS_VERSION == 2">rosidl_default_generators</buildtool_depend>
          <build_depend condition="$ROS_VERSION == 1">message_generation</build_depend>
          <depend>std_msgs</depend>
          <exec_depend condition="$ROS_DISTRO >= iron and $ROS_VERSION == 2">new_one</exec_depend>
          <exec_depend condition="$ROS_VERSION == 2">rosidl_default_runtime</exec_depend>
          <member_of_group condition="$ROS_VERSION == 2">rosidl_interface_packages</member_of_group>
          <export condition="$ROS_VERSION == 1"><build_type>catkin</build_type></export>
          <export condition="$ROS_VERSION == 2"><build_type>ament_cmake</build_type></export>
        </package>"#;

    #[test]
    fn one_manifest_for_both_versions() {
        let read = |version, distribution| {
            let variables = Variables::for_distribution(version, distribution);
            Manifest::parse(MANIFEST_OF_BOTH, Path::new("package.xml"), &variables).unwrap()
        };
        let one = read(1, "noetic");
        assert_eq!(one.build_type, "catkin");
        assert_eq!(needs(&one, Kind::Buildtool), ["catkin"]);
        assert_eq!(needs(&one, Kind::Exec), ["std_msgs"]);
        assert!(one.groups.is_empty());
        let two = read(2, "jazzy");
        assert_eq!(two.build_type, "ament_cmake");
        assert_eq!(needs(&two, Kind::Buildtool), ["ament_cmake", "rosidl_default_generators"]);
        assert_eq!(needs(&two, Kind::Exec), ["new_one", "rosidl_default_runtime", "std_msgs"]);
        assert_eq!(two.groups, BTreeSet::from([INTERFACES.to_owned()]));
        assert!(!needs(&read(2, "humble"), Kind::Exec).contains(&"new_one"));
    }

    #[test]
    fn groups_are_of_format_3() {
        let text = |format: u8| {
            format!(
                "<package format='{format}'><name>x</name><group_depend>g</group_depend>\
                 <member_of_group>h</member_of_group></package>"
            )
        };
        let manifest = parse(&text(3)).unwrap();
        assert_eq!(manifest.group_dependencies, BTreeSet::from(["g".to_owned()]));
        assert_eq!(manifest.groups, BTreeSet::from(["h".to_owned()]));
        let manifest = parse(&text(2)).unwrap();
        assert!(manifest.group_dependencies.is_empty() && manifest.groups.is_empty());
        let message = refusal("<package format='3'><name>x</name><member_of_group>../g</member_of_group></package>");
        assert!(message.contains("not a valid group name"), "{message}");
    }

    #[test]
    fn what_a_package_replaces_is_read_in_every_format() {
        for format in 1..=3 {
            let text = |name: &str| {
                format!("<package format='{format}'><name>x</name><replace version_lt='2.0'>{name}</replace></package>")
            };
            assert_eq!(parse(&text("old_x")).unwrap().replaces, BTreeSet::from(["old_x".to_owned()]));
            let message = refusal(&text("-o x"));
            assert!(message.contains("\"-o x\" in <replace> is not a valid dependency name"), "{message}");
        }
    }

    #[test]
    fn malformed_xml_is_told_with_its_place() {
        let text = refusal("<package>\n  <name>x</nam>\n</package>");
        assert!(text.starts_with("src/x/package.xml, line 2, column "), "{text}");
        assert!(text.contains("malformed XML") && !text.contains(" at 2:"), "{text}");
        assert!(refusal("").contains("malformed XML"));
        let entities = r#"<!DOCTYPE p [<!ENTITY a "aaaa">]><package><name>&a;</name></package>"#;
        assert!(refusal(entities).contains("malformed XML"));
    }

    #[test]
    fn what_a_manifest_must_not_say() {
        for (text, reason) in [
            ("<launch/>", "<launch>, not <package>"),
            ("<package/>", "<name> element is missing"),
            ("<package>\n<name>a</name>\n<name>b</name></package>", "line 3, column 1: a second <name>"),
            ("<package><name>1x</name></package>", "\"1x\" is not a package name"),
            ("<package><name></name></package>", "\"\" is not a package name"),
            ("<package><name>../x</name></package>", "not a package name"),
            ("<package format='4'><name>x</name></package>", "unknown format \"4\""),
            ("<package><name>x</name><build_depend>-o x</build_depend></package>", "\"-o x\" in <build_depend>"),
            ("<package format='2'><name>x</name><depend></depend></package>", "\"\" in <depend>"),
            (
                "<package format='3'><name>x</name><depend condition='$A'>y</depend></package>",
                "invalid condition \"$A\"",
            ),
        ] {
            let message = refusal(text);
            assert!(message.contains(reason), "{message}");
        }
    }

    #[test]
    fn a_file_that_is_missing_or_endless_is_told() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("package.xml");
        let read = || {
            Manifest::load(directory.path(), &path, &Variables::for_distribution(1, "noetic")).unwrap_err().to_string()
        };
        assert!(read().starts_with("cannot open ") && read().contains("package.xml"));
        std::fs::write(&path, " ".repeat(2 << 20)).unwrap();
        assert!(read().contains("larger than the limit of 1048576 bytes"));
        std::fs::write(&path, b"<package>\xff").unwrap();
        assert!(read().contains("UTF-8"), "{}", read());
    }
}
