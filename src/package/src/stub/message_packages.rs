//! Source packages of the messages that robots of the other ROS cannot get elsewhere: a robot's own nodes need their
//! code to speak with the stub. They are built in the robot's workspace as any package of messages.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::sync::Arc;

use ros::bus::RosVersion;
use ros::schema::{Base, MessageType, Registry, SchemaError};

use super::other_ros::manifest_head;
use super::{Files, StubInfo, text_file};
use crate::names;

/// Directory of the source packages in the package's share directory.
pub(super) const DIRECTORY: &str = "message_packages";

/// Packages of messages that come with every robot's ROS.
const COMMON: [&str; 22] = [
    "action_msgs",
    "actionlib_msgs",
    "builtin_interfaces",
    "composition_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "service_msgs",
    "shape_msgs",
    "statistics_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "tf2_msgs",
    "trajectory_msgs",
    "type_description_interfaces",
    "unique_identifier_msgs",
    "visualization_msgs",
];

/// Files and dependencies of a source package.
#[derive(Default)]
struct MessagePackage<'a> {
    /// Definitions by kind and name.
    definitions: BTreeSet<(&'a str, &'a str)>,
    dependencies: BTreeSet<String>,
}

/// Returns the names of the source packages of a stub.
pub(super) fn package_names(about: &StubInfo<'_>) -> BTreeSet<String> {
    definitions(about).map(|(package, ..)| package.to_owned()).collect()
}

/// Returns the files of all source packages, by path in the install space.
pub(super) fn source_files(about: &StubInfo<'_>) -> Result<Files, SchemaError> {
    let registry = Registry::for_version(about.ros);
    for (key, text) in &about.interface.definitions {
        // An invalid one is a problem only if a message uses it.
        let _ = registry.insert(key, text);
    }
    let mut packages: BTreeMap<&str, MessagePackage<'_>> = BTreeMap::new();
    let mut files = Files::new();
    let root = format!("share/{}/{DIRECTORY}", about.package);
    for (package, kind, name, text) in definitions(about) {
        let found = packages.entry(package).or_default();
        found.definitions.insert((kind, name));
        let used = used_packages(&registry, kind, &format!("{package}/{kind}/{name}"))?;
        found.dependencies.extend(used.into_iter().filter(|used| used != package));
        files.insert(format!("{root}/{package}/{kind}/{name}.{kind}"), text_file(text));
    }
    for (name, package) in packages {
        let (manifest, cmake) = match about.ros {
            RosVersion::One => (package.catkin_manifest(about, name), package.catkin_cmake(name)),
            RosVersion::Two => (package.ament_manifest(about, name), package.ament_cmake(name)),
        };
        files.insert(format!("{root}/{name}/package.xml"), text_file(&manifest));
        files.insert(format!("{root}/{name}/CMakeLists.txt"), text_file(&cmake));
    }
    Ok(files)
}

/// Returns the definitions that robots may lack: package, kind, name and text.
fn definitions<'a>(about: &StubInfo<'a>) -> impl Iterator<Item = (&'a str, &'a str, &'a str, &'a str)> {
    about.interface.definitions.iter().filter_map(|(key, text)| {
        let (package, rest) = key.split_once('/')?;
        let (kind, name) = rest.split_once('/')?;
        let is_known = matches!(kind, "msg" | "srv" | "action") && names::is_package(package) && names::is_type(name);
        (is_known && !COMMON.contains(&package)).then_some((package, kind, name, &**text))
    })
}

/// Returns the packages whose messages a definition uses.
fn used_packages(registry: &Registry, kind: &str, key: &str) -> Result<BTreeSet<String>, SchemaError> {
    let mut used = BTreeSet::new();
    let parts: Vec<Arc<MessageType>> = match kind {
        "srv" => {
            let service = registry.service(key)?;
            vec![Arc::clone(&service.request), Arc::clone(&service.response)]
        }
        "action" => {
            let action = registry.action(key)?;
            // The messages that carry ids and status.
            used.insert(if action.services.is_some() { "action_msgs" } else { "actionlib_msgs" }.to_owned());
            vec![Arc::clone(&action.goal), Arc::clone(&action.result), Arc::clone(&action.feedback)]
        }
        _ => vec![registry.message(key)?],
    };
    for field in parts.iter().flat_map(|part| part.fields()) {
        if let (Base::Message(_), Some((package, _))) = (&field.base, field.type_name.split_once('/')) {
            used.insert(package.to_owned());
        }
    }
    Ok(used)
}

impl MessagePackage<'_> {
    fn manifest(&self, about: &StubInfo<'_>, name: &str, tools: &str, end: &str) -> String {
        let mut text = manifest_head(about, name, "0.0.0", "see the original", "Messages");
        text.push_str(tools);
        for dependency in &self.dependencies {
            let _ = writeln!(text, "  <depend>{dependency}</depend>");
        }
        text + end + "</package>\n"
    }

    fn catkin_manifest(&self, about: &StubInfo<'_>, name: &str) -> String {
        const TOOLS: &str = "  <buildtool_depend>catkin</buildtool_depend>\n  \
                             <build_depend>message_generation</build_depend>\n  \
                             <exec_depend>message_runtime</exec_depend>\n";
        self.manifest(about, name, TOOLS, "")
    }

    /// Returns the build file of catkin, as its manual builds messages
    /// (<http://docs.ros.org/en/noetic/api/catkin/html/howto/format2/building_msgs.html>).
    fn catkin_cmake(&self, name: &str) -> String {
        let dependencies = self.dependencies.iter().fold(String::new(), |all, one| all + " " + one);
        let mut text = format!(
            "cmake_minimum_required(VERSION 3.0.2)\nproject({name})\n\
             find_package(catkin REQUIRED COMPONENTS message_generation{dependencies})\n"
        );
        for (kind, command) in [("msg", "message"), ("srv", "service"), ("action", "action")] {
            let files = self.files_of_kind(kind);
            if !files.is_empty() {
                let _ = writeln!(text, "add_{command}_files(DIRECTORY {kind} FILES{files})");
            }
        }
        let needed = if dependencies.is_empty() { String::new() } else { format!("DEPENDENCIES{dependencies}") };
        let _ =
            writeln!(text, "generate_messages({needed})\ncatkin_package(CATKIN_DEPENDS message_runtime{dependencies})");
        text
    }

    /// Returns the files of a kind, each after a space.
    fn files_of_kind(&self, wanted: &str) -> String {
        let of_kind = self.definitions.iter().filter(|(kind, _)| *kind == wanted);
        of_kind.fold(String::new(), |all, (kind, name)| format!("{all} {name}.{kind}"))
    }

    fn ament_manifest(&self, about: &StubInfo<'_>, name: &str) -> String {
        const TOOLS: &str = "  <buildtool_depend>ament_cmake</buildtool_depend>\n  \
                             <buildtool_depend>rosidl_default_generators</buildtool_depend>\n  \
                             <exec_depend>rosidl_default_runtime</exec_depend>\n";
        const END: &str = "  <member_of_group>rosidl_interface_packages</member_of_group>\n  \
                           <export><build_type>ament_cmake</build_type></export>\n";
        // Groups came with format 3 (REP 149).
        self.manifest(about, name, TOOLS, END).replacen("format=\"2\"", "format=\"3\"", 1)
    }

    /// Returns the build file of ament (docs.ros.org, "Creating custom msg and srv files").
    fn ament_cmake(&self, name: &str) -> String {
        let mut text = format!(
            "cmake_minimum_required(VERSION 3.8)\nproject({name})\nfind_package(ament_cmake REQUIRED)\n\
             find_package(rosidl_default_generators REQUIRED)\n"
        );
        for dependency in &self.dependencies {
            let _ = writeln!(text, "find_package({dependency} REQUIRED)");
        }
        text.push_str("rosidl_generate_interfaces(${PROJECT_NAME}");
        for (kind, name) in &self.definitions {
            let _ = write!(text, " \"{kind}/{name}.{kind}\"");
        }
        let dependencies = self.dependencies.iter().fold(String::new(), |all, one| all + " " + one);
        if !dependencies.is_empty() {
            let _ = write!(text, " DEPENDENCIES{dependencies}");
        }
        text + ")\nament_export_dependencies(rosidl_default_runtime)\nament_package()\n"
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::super::{Content, Portal};
    use super::*;
    use crate::interface::Interface;

    /// Returns the source packages' files for robots of this version, by path below their directory.
    fn source_files_for(ros: RosVersion) -> BTreeMap<String, String> {
        let mut interface = Interface::default();
        let header = match ros {
            RosVersion::One => "Header header\nPart[] parts\nq_msgs/Far far\n",
            RosVersion::Two => "std_msgs/Header header\nPart[] parts\nq_msgs/Far far\n",
        };
        for (key, text) in [
            ("p_msgs/msg/Found", header),
            ("p_msgs/msg/Part", "float32 score\n"),
            ("p_msgs/srv/Reset", "geometry_msgs/Point at\n---\n"),
            ("p_msgs/action/Go", "int32 to\n---\n---\n"),
            ("q_msgs/msg/Far", "int32 x\n"),
            ("geometry_msgs/msg/Point", "float64 x\n"),
        ] {
            interface.definitions.insert(key.into(), text.into());
        }
        let about = StubInfo {
            ros,
            service_ros: ros.other(),
            service: "serves",
            package: "p",
            revision: 3,
            image: "",
            portal: &Portal::default(),
            architecture: "x86_64",
            outsourced: &BTreeSet::new(),
            names: &BTreeMap::new(),
            interface: &interface,
            stateful: false,
            requests: &[],
            times: None,
        };
        assert_eq!(package_names(&about), ["p_msgs", "q_msgs"].map(str::to_owned).into());
        let files = source_files(&about).expect("valid definitions");
        let below = |path: &str| path.strip_prefix("share/p/message_packages/").expect("in its directory").to_owned();
        let text = |content| match content {
            Content::File { bytes, executable: false } => String::from_utf8(bytes).expect("text"),
            other => panic!("{other:?}"),
        };
        files.into_iter().map(|(path, content)| (below(&path), text(content))).collect()
    }

    #[test]
    fn robots_of_ros_1_get_packages_of_catkin() {
        let files = source_files_for(RosVersion::One);
        let paths: Vec<&str> = files.keys().map(String::as_str).collect();
        let expected = [
            "p_msgs/CMakeLists.txt",
            "p_msgs/action/Go.action",
            "p_msgs/msg/Found.msg",
            "p_msgs/msg/Part.msg",
            "p_msgs/package.xml",
            "p_msgs/srv/Reset.srv",
            "q_msgs/CMakeLists.txt",
            "q_msgs/msg/Far.msg",
            "q_msgs/package.xml",
        ];
        assert_eq!(paths, expected);
        let dependencies = "actionlib_msgs geometry_msgs q_msgs std_msgs";
        let cmake = &files["p_msgs/CMakeLists.txt"];
        for line in [
            &*format!("find_package(catkin REQUIRED COMPONENTS message_generation {dependencies})"),
            "add_message_files(DIRECTORY msg FILES Found.msg Part.msg)",
            "add_service_files(DIRECTORY srv FILES Reset.srv)",
            "add_action_files(DIRECTORY action FILES Go.action)",
            &format!("generate_messages(DEPENDENCIES {dependencies})"),
            &format!("catkin_package(CATKIN_DEPENDS message_runtime {dependencies})"),
        ] {
            assert!(cmake.lines().any(|one| one == line), "{line}: {cmake}");
        }
        assert!(files["q_msgs/CMakeLists.txt"].contains("generate_messages()\n"), "{files:?}");
        let manifest = &files["p_msgs/package.xml"];
        let variables = crate::condition::Variables::for_distribution(1, "noetic");
        let read = crate::manifest::Manifest::parse(manifest, std::path::Path::new("package.xml"), &variables);
        assert_eq!(read.expect("a manifest").name, "p_msgs");
    }

    #[test]
    fn robots_of_ros_2_get_packages_of_ament() {
        let files = source_files_for(RosVersion::Two);
        let cmake = &files["p_msgs/CMakeLists.txt"];
        let generated = "rosidl_generate_interfaces(${PROJECT_NAME} \"action/Go.action\" \"msg/Found.msg\" \
                         \"msg/Part.msg\" \"srv/Reset.srv\" DEPENDENCIES action_msgs geometry_msgs q_msgs std_msgs)";
        assert!(cmake.lines().any(|line| line == generated), "{cmake}");
        assert!(cmake.contains("find_package(q_msgs REQUIRED)\n"), "{cmake}");
        let manifest = &files["p_msgs/package.xml"];
        let theirs = "of ROS 1 for robots of ROS 2";
        for part in ["format=\"3\"", "<depend>q_msgs</depend>", "rosidl_interface_packages", theirs] {
            assert!(manifest.contains(part), "{part}: {manifest}");
        }
    }
}
