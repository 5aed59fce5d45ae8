//! The stub: the package as a robot installs it, under the original's name, with launchers in place of programs.
//!
//! ```text
//!  image ──contents──▶ Contents ─┐
//!  service, interface ─▶ About ──┴─compose─▶ files of an install space (catkin's, ament's) ──(caller)──▶ NAME.tar.gz
//! ```
//!
//! Install spaces are searched only up to the first that holds a package. So the stub has a launcher for every
//! executable, not only for those that run in the cloud, and everything that the package shares. The same input
//! gives the same files. The robot's program, `lib/PACKAGE/cloudroid-stub`, is added by the caller, who has it.

mod ament;
mod catkin;
mod contents;
mod manifest;
mod needed;
mod nodelets;
mod settings;

use std::collections::{BTreeMap, BTreeSet};

pub use contents::{Content, Contents};
pub use manifest::{MANIFEST, SIGNATURE, SIGNER, manifest};
use ros::bus::RosVersion;

use crate::Error;
use crate::interface::Interface;

/// The robot's program, in `lib/PACKAGE`.
pub const PROGRAM: &str = "cloudroid-stub";

const RUN: &str = include_str!("stub/inside/run.sh");
const ORIGINAL: &str = include_str!("stub/inside/original.sh");
const INSTALL: &str = include_str!("stub/inside/install.sh");
const README: &str = include_str!("stub/inside/README.md");

/// Where robots reach the portal.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Portal {
    /// Such as `wss://server:9090`.
    pub address: String,
    /// The fingerprint of its certificate, where no authority has signed it.
    pub fingerprint: Option<String>,
}

/// What a stub stands for.
#[derive(Debug, Clone)]
pub struct About<'a> {
    /// The service's ROS, which the robot's has to be.
    pub ros: RosVersion,
    /// The service.
    pub service: &'a str,
    /// The ROS package.
    pub package: &'a str,
    /// The service's revision.
    pub revision: u64,
    /// Digest of its image.
    pub image: &'a str,
    /// Where robots reach the portal.
    pub portal: &'a Portal,
    /// Architecture of the robot's program, as `uname -m` says it.
    pub architecture: &'a str,
    /// Executables that run in the cloud.
    pub outsourced: &'a BTreeSet<String>,
    /// Names that programs give their nodes where nobody else does, by executable, as far as they are known.
    pub names: &'a BTreeMap<String, String>,
    /// What the package shows.
    pub interface: &'a Interface,
    /// Answers depend on earlier requests, as the deployer says.
    pub stateful: bool,
    /// Which inputs of nodes are answered by which outputs.
    pub requests: &'a [Answered],
    /// T_desire and T_max in seconds, as the deployer says, where a robot says nothing of its own.
    pub times: Option<(f64, f64)>,
}

/// An input of a node and the outputs that answer it, as the node's program calls them.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Answered {
    /// Absolute name of the node at the push: what is below it or beside it is so on a robot, too.
    pub node: String,
    /// Its executable, where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub program: Option<String>,
    /// Absolute names of the topics, as they were without remaps.
    pub request: qos::Pair,
}

/// What the stub and its installer keep in `share/PACKAGE`. A file of the package with such a name is left out: a robot's
/// token would get its rights, and its content would be taken for a setting.
const OURS: [&str; 6] = [
    "token",
    "ca.pem",
    "install.sh",
    "stub.toml",
    "interface.toml",
    "revision.toml",
];

/// The files of a stub, by path in the install space.
pub type Files = BTreeMap<String, Content>;

/// Puts a stub together.
pub fn compose(about: &About<'_>, mut contents: Contents) -> Result<Files, Error> {
    let package = about.package;
    if !contents.share.contains_key("package.xml") {
        return Err(Error::NoManifest {
            package: package.to_owned(),
        });
    }
    let mut files = match about.ros {
        RosVersion::One => {
            catkin::replaced(about, &mut contents);
            catkin::files()
        }
        RosVersion::Two => ament::files(about, &contents),
    };
    let names = executables(about, &contents);
    files.insert("install.sh".to_owned(), plain(&filled(INSTALL, about)));
    files.insert("README.md".to_owned(), plain(&manual(about, &names)));
    for name in &names {
        let launcher = launcher(about, name, "/../..");
        files.insert(format!("lib/{package}/{name}"), launcher);
    }
    for (path, content) in contents.share {
        // Below such a name, too: then it is a directory.
        if OURS.contains(&path.split('/').next().unwrap_or_default())
            || !goes_along(about, &path, &content)
        {
            continue;
        }
        let content = shared(about, &path, content);
        files.insert(format!("share/{package}/{path}"), content);
    }
    for (key, text) in &about.interface.definitions {
        // Where an image has definitions without their files.
        if let Some(path) = definition_path(package, key) {
            files.entry(path).or_insert_with(|| plain(text));
        }
    }
    for (name, text) in [
        ("interface.toml", about.interface.to_toml()),
        ("stub.toml", settings::stub(about)),
        ("revision.toml", settings::revision(about, &names)),
    ] {
        files.insert(format!("share/{package}/{name}"), plain(&text));
    }
    Ok(files)
}

fn goes_along(about: &About<'_>, path: &str, content: &Content) -> bool {
    if about.ros == RosVersion::Two && ament::is_of_the_install_space(path, content) {
        return false;
    }
    match content {
        Content::File { executable, .. } => needed::is_needed(path, *executable),
        Content::Link(target) => {
            needed::is_needed(path, false) && !target.chars().any(char::is_control)
        }
    }
}

/// Every name that has a launcher in `lib/PACKAGE`.
fn executables(about: &About<'_>, contents: &Contents) -> BTreeSet<String> {
    let mut names = match about.ros {
        RosVersion::One => catkin::executables(about, contents),
        RosVersion::Two => ament::executables(about, contents),
    };
    names.retain(|name| name != PROGRAM && !name.chars().any(char::is_control));
    names
}

/// What texts call things that have other names in the other ROS.
struct Words {
    /// The command that starts a node.
    run: &'static str,
    /// Why the overlay's set-up file is sourced last.
    order: &'static str,
    /// What cannot be loaded on the robot.
    plugins: &'static str,
    /// Where a robot may give a setting beside `stub.toml`.
    settings: &'static str,
}

impl Words {
    fn of(ros: RosVersion) -> &'static Words {
        match ros {
            RosVersion::One => &catkin::WORDS,
            RosVersion::Two => &ament::WORDS,
        }
    }
}

/// A shared file as the stub has it: programs give way to launchers.
fn shared(about: &About<'_>, path: &str, content: Content) -> Content {
    let Content::File {
        bytes,
        executable: true,
    } = &content
    else {
        return content;
    };
    let name = path.rsplit('/').next().unwrap_or(path);
    let machine_code = bytes.starts_with(b"\x7fELF");
    if !about.outsourced.contains(name) && !machine_code {
        return content;
    }
    // From the file's directory up to the install space: below share/PACKAGE, so two more than in the path.
    let up = "/..".repeat(2 + path.matches('/').count());
    launcher(about, name, &up)
}

fn launcher(about: &About<'_>, node: &str, up: &str) -> Content {
    let template = if about.outsourced.contains(node) {
        RUN
    } else {
        ORIGINAL
    };
    let text = template
        .replace("@PACKAGE@", about.package)
        .replace("@UP@", up)
        // The last, since anything may stand in it.
        .replace("@NODE@", &quoted(node));
    Content::File {
        bytes: text.into_bytes(),
        executable: true,
    }
}

/// One word of a shell's command, whatever is in it.
fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', "'\\''"))
}

fn plain(text: &str) -> Content {
    Content::File {
        bytes: text.as_bytes().to_vec(),
        executable: false,
    }
}

fn filled(template: &str, about: &About<'_>) -> String {
    let words = Words::of(about.ros);
    template
        .replace("@ROS@", &about.ros.number().to_string())
        .replace("@RUN@", words.run)
        .replace("@ORDER@", words.order)
        .replace("@PLUGINS@", words.plugins)
        .replace("@PACKAGE@", about.package)
        .replace("@SERVICE@", about.service)
        .replace("@REVISION@", &about.revision.to_string())
}

fn manual(about: &About<'_>, names: &BTreeSet<String>) -> String {
    let list = |names: Vec<&str>| match names.len() {
        0 => "none".to_owned(),
        _ => names.join(", "),
    };
    let original = names.difference(about.outsourced).map(String::as_str);
    let example = about.outsourced.first().or(names.first());
    filled(README, about)
        .replace(
            "@OUTSOURCED@",
            &list(about.outsourced.iter().map(String::as_str).collect()),
        )
        .replace("@ORIGINAL@", &list(original.collect()))
        .replace("@EXAMPLE@", example.map_or("NODE", String::as_str))
}

/// `pkg/msg/Type` of this package as a path in the install space.
fn definition_path(package: &str, key: &str) -> Option<String> {
    let (kind, name) = key
        .strip_prefix(package)?
        .strip_prefix('/')?
        .split_once('/')?;
    let known = matches!(kind, "msg" | "srv" | "action") && crate::names::is_type(name);
    known.then(|| format!("share/{package}/{kind}/{name}.{kind}"))
}

#[cfg(test)]
mod tests;
