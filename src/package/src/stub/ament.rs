//! Files that make a ROS 2 stub an ament install space: the resource index by which tools find packages, and setup
//! files for its search path.
//!
//! Tools look up each resource of the index separately, in the first install space that contains it. So an entry of the
//! stub hides only itself; other resources (plugins, type support) are found in the original, if that is installed.

use std::collections::BTreeSet;

use super::{Content, Contents, Files, RosTerms, StubInfo, text_file};

const INDEX: &str = "share/ament_index/resource_index";
const SETUP_SH: &str = include_str!("inside/ament/setup.sh");
const SETUP_BASH: &str = include_str!("inside/setup.bash");
const SETUP_ZSH: &str = include_str!("inside/setup.zsh");

/// Suffixes of a package's environment hooks in an install space, which contain paths of the image.
const ENVIRONMENT: [&str; 5] = [".sh", ".bash", ".zsh", ".ps1", ".dsv"];

/// Terms of ROS 2.
pub(super) const TERMS: RosTerms = RosTerms {
    run: "ros2 run",
    order: "because the workspace that is sourced last is searched first",
    plugins: "Components of this package cannot be loaded into\na container that runs on the robot",
    settings: "a parameter of the node (-p cloudroid.max:=0.3, or `cloudroid: {max: 0.3}` in a parameters file)",
};

/// Returns the files in addition to those of the package.
pub(super) fn index_files(about: &StubInfo<'_>, contents: &Contents) -> Files {
    let package = about.package;
    let mut files = Files::new();
    // colcon's tools source the local_setup files, people the others; this install space has no underlay.
    for name in ["setup", "local_setup"] {
        for (ending, text) in [("sh", SETUP_SH), ("bash", SETUP_BASH), ("zsh", SETUP_ZSH)] {
            files.insert(format!("{name}.{ending}"), text_file(text));
        }
    }
    let mut register = |kind: &str, text: &str| {
        files.insert(format!("{INDEX}/{kind}/{package}"), text_file(text));
    };
    register("packages", "");
    let interfaces = interface_list(about, contents);
    if !interfaces.is_empty() {
        register("rosidl_interfaces", &interfaces);
    }
    if !contents.components.is_empty() {
        register("rclcpp_components", &unloadable_components(about, &contents.components));
    }
    files
}

/// Lists the files of messages, services and actions in rosidl's format.
fn interface_list(about: &StubInfo<'_>, contents: &Contents) -> String {
    let shared = contents.share.keys().filter(|path| {
        let kinds = ["msg", "srv", "action"];
        let (Some((kind, name)), Some((_, ending))) = (path.split_once('/'), path.rsplit_once('.')) else {
            return false;
        };
        kinds.contains(&kind) && !name.contains('/') && (ending == kind || ending == "idl")
    });
    let prefix = format!("share/{}/", about.package);
    let told = about.interface.definitions.keys();
    let told = told
        .filter_map(|key| super::definition_path(about.package, key))
        .filter_map(|path| Some(path.strip_prefix(&prefix)?.to_owned()));
    let all: BTreeSet<String> = shared.cloned().chain(told).collect();
    all.into_iter().map(|path| path + "\n").collect()
}

/// Registers the component classes of an outsourced package so that they cannot be loaded into a container on the
/// robot. The original may be installed besides the stub, and its library would be loaded silently, so the stub
/// registers the same classes in a nonexistent library whose name is the explanation: containers print it and return it
/// in their response. The format is `CLASS;LIBRARY`, one per line.
fn unloadable_components(about: &StubInfo<'_>, classes: &BTreeSet<String>) -> String {
    let library = format!(
        "{} runs in the cloud: its components cannot be loaded into a container on this robot - \
         start its executables, or let the server run the launch file",
        about.package
    );
    let lines = classes.iter().map(|class| format!("{class};{library}\n"));
    lines.collect()
}

/// Returns the names of all launchers in `lib/PACKAGE`, the only directory in which ROS 2 looks for executables.
pub(super) fn launcher_names(about: &StubInfo<'_>, contents: &Contents) -> BTreeSet<String> {
    contents.executables.union(about.outsourced).cloned().collect()
}

/// Returns whether a shared file belongs to the image's install space rather than to the package.
pub(super) fn belongs_to_install_space(path: &str, content: &Content) -> bool {
    if matches!(content, Content::Link(_)) {
        return false;
    }
    let (top, name) = path.split_once('/').unwrap_or(("", path));
    let ending = ENVIRONMENT.iter().find_map(|ending| name.strip_suffix(ending));
    match top {
        "" => matches!(ending, Some("local_setup" | "package")),
        // Directories of the hooks of ament and colcon.
        "environment" | "hook" => ending.is_some(),
        _ => false,
    }
}
