//! What makes a stub of ROS 2 an install space of ament: the index that tools find packages by, and set-up files for its search path.
//!
//! Tools look each resource of the index up by itself, in the first install space that has it. What the stub registers therefore
//! stands for it alone; what it does not (plugins, type support) is found in the original's, where that is installed.

use std::collections::BTreeSet;

use super::{About, Content, Contents, Files, Words, plain};

const INDEX: &str = "share/ament_index/resource_index";
const SETUP_SH: &str = include_str!("inside/ament/setup.sh");
const SETUP_BASH: &str = include_str!("inside/setup.bash");
const SETUP_ZSH: &str = include_str!("inside/setup.zsh");

/// Endings of files of the environment that an install space has for each package: they name places in the image.
const ENVIRONMENT: [&str; 5] = [".sh", ".bash", ".zsh", ".ps1", ".dsv"];

/// What texts call things.
pub(super) const WORDS: Words = Words {
    run: "ros2 run",
    order: "because a workspace that is sourced later is searched first",
    plugins: "Components of this package cannot be loaded into\na container that runs on the robot",
    settings: "a parameter of the node (-p cloudroid.max:=0.3, or `cloudroid: {max: 0.3}` in a parameters file)",
};

/// Files beside those of the package.
pub(super) fn files(about: &About<'_>, contents: &Contents) -> Files {
    let package = about.package;
    let mut files = Files::new();
    // colcon's tools source local_setup files, people the others; here nothing stands behind this install space.
    for name in ["setup", "local_setup"] {
        for (ending, text) in [("sh", SETUP_SH), ("bash", SETUP_BASH), ("zsh", SETUP_ZSH)] {
            files.insert(format!("{name}.{ending}"), plain(text));
        }
    }
    let mut register = |kind: &str, text: &str| {
        files.insert(format!("{INDEX}/{kind}/{package}"), plain(text));
    };
    register("packages", "");
    let interfaces = interfaces(about, contents);
    if !interfaces.is_empty() {
        register("rosidl_interfaces", &interfaces);
    }
    if !contents.components.is_empty() {
        register("rclcpp_components", &refusing(about, &contents.components));
    }
    files
}

/// Files of messages, services and actions, as rosidl lists them.
fn interfaces(about: &About<'_>, contents: &Contents) -> String {
    let shared = contents.share.keys().filter(|path| {
        let kinds = ["msg", "srv", "action"];
        let (Some((kind, name)), Some((_, ending))) = (path.split_once('/'), path.rsplit_once('.'))
        else {
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

/// Components of an outsourced package cannot be loaded into a container that runs on the robot. The original may be installed
/// beside the stub, and its library would be loaded silently, so the stub registers the same classes in a library that nobody has,
/// whose name is the explanation: containers print it, and answer with it. What they read is one `CLASS;LIBRARY` for each line.
fn refusing(about: &About<'_>, classes: &BTreeSet<String>) -> String {
    let library = format!(
        "{} runs in the cloud: its components cannot be loaded into a container on this robot - \
         start its executables, or let the server run the launch file",
        about.package
    );
    let lines = classes.iter().map(|class| format!("{class};{library}\n"));
    lines.collect()
}

/// Every name that has a launcher in `lib/PACKAGE`, the only place where ROS 2 looks for programs.
pub(super) fn executables(about: &About<'_>, contents: &Contents) -> BTreeSet<String> {
    contents
        .executables
        .union(about.outsourced)
        .cloned()
        .collect()
}

/// Whether a shared file belongs to the image's install space, and not to the package.
pub(super) fn is_of_the_install_space(path: &str, content: &Content) -> bool {
    if matches!(content, Content::Link(_)) {
        return false;
    }
    let (top, name) = path.split_once('/').unwrap_or(("", path));
    let ending = ENVIRONMENT
        .iter()
        .find_map(|ending| name.strip_suffix(ending));
    match top {
        "" => matches!(ending, Some("local_setup" | "package")),
        // As ament and colcon call the directories of their hooks.
        "environment" | "hook" => ending.is_some(),
        _ => false,
    }
}
