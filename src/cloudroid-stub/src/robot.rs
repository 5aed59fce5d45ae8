//! The node as launch files started it, and the robot's ROS as its environment tells.

mod ros1;
mod ros2;

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use link::control;
use ros::Network;
use ros::bus::{ParamValue, RosVersion};

use crate::network::Variable;
use crate::original;
use crate::revision::Revision;

/// What the command line and the environment say.
#[derive(Debug, Clone, PartialEq)]
pub struct Robot {
    /// The robot's ROS.
    pub ros: RosVersion,
    /// Where its other nodes are.
    pub place: Place,
    /// Absolute name of the node.
    pub node: String,
    /// Arguments for the node in the cloud: what its name and its namespace follow from is left out in ROS 1, and said in ROS 2, where a program may be
    /// several nodes; parameters that stand in files of the robot are written out.
    pub argv: Vec<String>,
    /// Arguments for the local original.
    pub original_argv: Vec<String>,
    /// The parameters that the node is given by its command line (ROS 2).
    pub parameters: BTreeMap<String, ParamValue>,
    /// Whether the node's time is that of `/clock`, as far as its command line says (ROS 2).
    pub sim_time: bool,
}

/// Where the nodes of a robot find each other.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    /// At a Master (ROS 1).
    Master {
        /// Its host.
        host: String,
        /// Its port.
        port: u16,
        /// The host that others reach this node under, where it is said.
        own: Option<String>,
    },
    /// In a domain (ROS 2).
    Domain {
        /// `ROS_DOMAIN_ID`.
        id: u16,
        /// Where nodes of that domain are looked for.
        network: Network,
    },
}

/// What a node is called where the robot does not say it.
#[derive(Debug, Clone, Copy)]
pub struct Usual<'a> {
    /// Its name; in ROS 2 with the namespace that its program gives it.
    pub name: &'a str,
    /// Its program calls it so, and is not to be told.
    pub by_program: bool,
}

impl Robot {
    /// Reads `argv` (without the program) of the executable, whose node is usually called so.
    ///
    /// # Errors
    /// The argument, the file or the variable that cannot be, and why.
    pub async fn read(
        argv: &[String],
        usual: Usual<'_>,
        ros: RosVersion,
        variable: Variable<'_>,
    ) -> anyhow::Result<Self> {
        match ros {
            RosVersion::One => ros1::read(argv, usual.name, variable),
            RosVersion::Two => ros2::read(argv, usual, variable).await,
        }
    }

    /// What the node's parameters say of the stub itself, by key: `cloudroid.max` by `max`.
    pub fn settings(&self) -> BTreeMap<String, ParamValue> {
        let parameters = self.parameters.iter();
        let settings = parameters.filter_map(|(name, value)| {
            let key = name.strip_prefix(ros2::SETTINGS)?;
            Some((key.to_owned(), value.clone()))
        });
        settings.collect()
    }

    /// What the cloud is to run.
    pub fn for_the_cloud(&self, package: &str, executable: &str, share: &Path) -> control::Node {
        let made_of = Revision::read(share);
        let share = plain(share);
        let directory = directory(&share, std::env::current_dir().unwrap_or_default());
        control::Node {
            name: self.node.clone(),
            package: package.to_owned(),
            executable: executable.to_owned(),
            argv: self.argv.clone(),
            namespace: self
                .node
                .rsplit_once('/')
                .map_or("", |(parent, _)| parent)
                .to_owned(),
            share: share.to_string_lossy().into_owned(),
            directory: directory.to_string_lossy().into_owned(),
            revision: made_of.revision,
            image: made_of.image,
            named_by_argv: self.ros == RosVersion::Two,
        }
    }
}

/// A path without `..`, as others on the robot write it: launchers say `lib/PKG/../../share/PKG`, while rospack, and
/// so `$(find PKG)`, say `share/PKG`.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir if plain.file_name().is_some() => drop(plain.pop()),
            Component::CurDir => {}
            part => plain.push(part),
        }
    }
    plain
}

/// The working directory. Within the overlay it is written as the share directory is, even where links lead there.
fn directory(share: &Path, current: PathBuf) -> PathBuf {
    let overlay = original::overlay(share);
    let canonical = overlay.canonicalize();
    let below = canonical
        .ok()
        .and_then(|overlay| Some(current.strip_prefix(overlay).ok()?.to_owned()));
    below.map_or(current, |below| overlay.join(below))
}

/// The name of a node that is started without one, from its executable's.
pub fn usual_name(executable: &str) -> String {
    let stem = executable.strip_suffix(".py").unwrap_or(executable);
    let allowed = |letter: char| {
        if letter.is_ascii_alphanumeric() {
            letter
        } else {
            '_'
        }
    };
    stem.chars().map(allowed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_the_overlay_are_written_as_launch_files_write_them() {
        let share = plain(Path::new("/o/lib/p/../../share/./p"));
        assert_eq!(share, Path::new("/o/share/p"));
        let place = tempfile::tempdir().unwrap();
        let (real, link) = (place.path().join("real"), place.path().join("link"));
        std::fs::create_dir_all(real.join("lib/p")).unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        let current = real.canonicalize().unwrap().join("lib/p");
        assert_eq!(
            directory(&link.join("share/p"), current),
            link.join("lib/p")
        );
        assert_eq!(
            directory(&link.join("share/p"), "/root".into()),
            Path::new("/root")
        );
    }

    #[test]
    fn a_node_without_a_name_has_its_executables() {
        assert_eq!(usual_name("image-view.py"), "image_view");
    }
}
