//! The stub: a package that robots install under the original's name, with launchers in place of executables.
//!
//! ```text
//!  image ──contents──▶ Contents ────┐
//!  service, interface ─▶ StubInfo ──┴─compose─▶ files of an install space (catkin, ament) ──(caller)──▶ NAME.tar.gz
//! ```
//!
//! Install spaces are searched only up to the first that contains a package. So the stub has a launcher for every
//! executable, not only for those that run in the cloud, and all shared files. The same input gives the same files. The
//! robot's program, `lib/PACKAGE/cloudroid-stub`, is added by the caller, who has it.

mod ament;
mod catkin;
mod info;
mod manifest;
mod message_packages;
mod needed;
mod nodelets;
mod other_ros;
mod package_files;
mod settings;

use std::collections::BTreeSet;

pub use info::{Files, Portal, ProgramRequest, StubInfo};
use info::{RosTerms, definition_path, text_file};
pub use manifest::{MANIFEST, SIGNATURE, SIGNER, manifest};
pub use package_files::{Content, Contents};
use ros::bus::RosVersion;

use crate::Error;

/// Name of the robot's program in `lib/PACKAGE`.
pub const PROGRAM: &str = "cloudroid-stub";

const RUN: &str = include_str!("stub/inside/run.sh");
const ORIGINAL: &str = include_str!("stub/inside/original.sh");
const INSTALL: &str = include_str!("stub/inside/install.sh");
const README: &str = include_str!("stub/inside/README.md");

/// Files that the stub and its installer keep in `share/PACKAGE`. A file of the package with such a name is left out: a
/// robot's token would get its permissions, and its content would be read as a setting.
const OURS: [&str; 6] = ["token", "ca.pem", "install.sh", "stub.toml", "interface.toml", "revision.toml"];

/// Composes the files of a stub.
pub fn compose(about: &StubInfo<'_>, mut contents: Contents) -> Result<Files, Error> {
    let package = about.package;
    if !contents.share.contains_key("package.xml") {
        return Err(Error::NoManifest { package: package.to_owned() });
    }
    if about.is_for_other_ros() {
        contents = other_ros::adapt_contents(about, contents);
    }
    let mut files = match about.ros {
        RosVersion::One => {
            catkin::replace_plugin_lists(about, &mut contents);
            catkin::setup_files()
        }
        RosVersion::Two => ament::index_files(about, &contents),
    };
    if about.is_for_other_ros() {
        let sources = message_packages::source_files(about);
        files.extend(sources.map_err(|error| Error::BadTwins { service: about.service.to_owned(), error })?);
    }
    let names = launcher_names(about, &contents);
    files.insert("install.sh".to_owned(), text_file(&fill_template(INSTALL, about)));
    files.insert("README.md".to_owned(), text_file(&readme(about, &names)));
    for name in &names {
        let launcher = launcher(about, name, "/../..");
        files.insert(format!("lib/{package}/{name}"), launcher);
    }
    for (path, content) in contents.share {
        // Also below such a name, which is then a directory.
        if OURS.contains(&path.split('/').next().unwrap_or_default()) || !is_shipped(about, &path, &content) {
            continue;
        }
        let content = to_stub_content(about, &path, content);
        files.insert(format!("share/{package}/{path}"), content);
    }
    for (key, text) in &about.interface.definitions {
        // For images that contain definitions without their files.
        if let Some(path) = definition_path(package, key) {
            files.entry(path).or_insert_with(|| text_file(text));
        }
    }
    for (name, text) in [
        ("interface.toml", about.interface.to_toml()),
        ("stub.toml", settings::stub_toml(about)),
        ("revision.toml", settings::revision_toml(about, &names)),
    ] {
        files.insert(format!("share/{package}/{name}"), text_file(&text));
    }
    Ok(files)
}

fn is_shipped(about: &StubInfo<'_>, path: &str, content: &Content) -> bool {
    if about.service_ros == RosVersion::Two && ament::belongs_to_install_space(path, content) {
        return false;
    }
    match content {
        Content::File { executable, .. } => needed::is_needed(path, *executable),
        Content::Link(target) => needed::is_needed(path, false) && !target.chars().any(char::is_control),
    }
}

/// Returns the names of all launchers in `lib/PACKAGE`.
fn launcher_names(about: &StubInfo<'_>, contents: &Contents) -> BTreeSet<String> {
    let mut names = match about.ros {
        RosVersion::One => catkin::launcher_names(about, contents),
        RosVersion::Two => ament::launcher_names(about, contents),
    };
    names.retain(|name| name != PROGRAM && !name.chars().any(char::is_control));
    names
}

impl RosTerms {
    fn for_ros(ros: RosVersion) -> &'static RosTerms {
        match ros {
            RosVersion::One => &catkin::TERMS,
            RosVersion::Two => &ament::TERMS,
        }
    }
}

/// Converts a shared file for the stub: executables are replaced by launchers.
fn to_stub_content(about: &StubInfo<'_>, path: &str, content: Content) -> Content {
    let Content::File { bytes, executable: true } = &content else {
        return content;
    };
    let name = path.rsplit('/').next().unwrap_or(path);
    let machine_code = bytes.starts_with(b"\x7fELF");
    if !about.outsourced.contains(name) && !machine_code {
        return content;
    }
    // From the directory of the file up to the install space: it is below share/PACKAGE, so two more than in the path.
    let up = "/..".repeat(2 + path.matches('/').count());
    launcher(about, name, &up)
}

fn launcher(about: &StubInfo<'_>, node: &str, up: &str) -> Content {
    let template = if about.outsourced.contains(node) { RUN } else { ORIGINAL };
    let text = template
        .replace("@PACKAGE@", about.package)
        .replace("@UP@", up)
        // Last, since the name may contain anything.
        .replace("@NODE@", &shell_quote(node));
    Content::File { bytes: text.into_bytes(), executable: true }
}

/// Quotes a word for a shell.
fn shell_quote(word: &str) -> String {
    format!("'{}'", word.replace('\'', "'\\''"))
}

fn fill_template(template: &str, about: &StubInfo<'_>) -> String {
    let words = RosTerms::for_ros(about.ros);
    template
        .replace("@ROS@", &about.ros.number().to_string())
        .replace("@RUN@", words.run)
        .replace("@ORDER@", words.order)
        .replace("@PLUGINS@", words.plugins)
        .replace("@PACKAGE@", about.package)
        .replace("@SERVICE@", about.service)
        .replace("@REVISION@", &about.revision.to_string())
}

fn readme(about: &StubInfo<'_>, names: &BTreeSet<String>) -> String {
    let list = |names: Vec<&str>| match names.len() {
        0 => "none".to_owned(),
        _ => names.join(", "),
    };
    let original = names.difference(about.outsourced).map(String::as_str);
    let example = about.outsourced.first().or(names.first());
    fill_template(README, about)
        .replace("@OTHER@", &other_ros_notice(about))
        .replace("@OUTSOURCED@", &list(about.outsourced.iter().map(String::as_str).collect()))
        .replace("@ORIGINAL@", &list(original.collect()))
        .replace("@EXAMPLE@", example.map_or("NODE", String::as_str))
}

/// Returns what the owner of a robot of the other ROS has to know; empty for robots of the service's ROS.
fn other_ros_notice(about: &StubInfo<'_>) -> String {
    if !about.is_for_other_ros() {
        return String::new();
    }
    let (ros, service_ros) = (about.ros.number(), about.service_ros.number());
    let packages: Vec<String> = message_packages::package_names(about).into_iter().collect();
    let sources = match &*packages {
        [] => String::new(),
        packages => format!(
            " If this robot's nodes use the messages of {}, copy\n`share/{}/{}` into the robot's workspace and build \
             it.",
            packages.join(", "),
            about.package,
            message_packages::DIRECTORY
        ),
    };
    format!(
        "\nThe service is of ROS {service_ros}, this archive for robots of ROS {ros}: the server translates the \
         messages, the stub the nodes' arguments.{sources}\n"
    )
}

#[cfg(test)]
mod tests;
