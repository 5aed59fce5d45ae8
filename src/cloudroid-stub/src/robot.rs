//! The node as launch files started it, and the robot's ROS as its environment describes it.

mod other_ros;
mod ros1;
mod ros2;

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use link::control;
use ros::DiscoveryNetwork;
use ros::bus::{ParamValue, RosVersion};

use crate::network::Variable;
use crate::original;
use crate::revision::Revision;

/// Settings from the command line and the environment.
#[derive(Debug, Clone, PartialEq)]
pub struct LaunchedNode {
    /// The robot's ROS version.
    pub ros: RosVersion,
    /// Location of its other nodes.
    pub place: RosLocation,
    /// Absolute name of the node.
    pub node: String,
    /// Absolute name that the program gives its node, if known.
    pub name_by_program: Option<String>,
    /// Arguments for the node in the cloud, as the robot's ROS writes them. In ROS 1 they omit those that define its
    /// name and namespace; in ROS 2 they contain them, because a program may create several nodes. Parameters from
    /// files of the robot are expanded.
    pub argv: Vec<String>,
    /// Arguments for the local original.
    pub original_argv: Vec<String>,
    /// The node's parameters on its command line (ROS 2).
    pub parameters: BTreeMap<String, ParamValue>,
    /// Set if the node takes its time from `/clock`, as far as its command line says (ROS 2).
    pub sim_time: bool,
}

/// Location where the nodes of a robot discover each other.
#[derive(Debug, Clone, PartialEq)]
pub enum RosLocation {
    /// A Master (ROS 1).
    Master {
        /// Host of the Master.
        host: String,
        /// Port of the Master.
        port: u16,
        /// Host under which other nodes reach this node, if configured.
        own: Option<String>,
    },
    /// A domain (ROS 2).
    Domain {
        /// `ROS_DOMAIN_ID`.
        id: u16,
        /// Network in which nodes of that domain are discovered.
        network: DiscoveryNetwork,
    },
}

/// Name of a node unless the robot sets one.
#[derive(Debug, Clone, Copy)]
pub struct DefaultName<'a> {
    /// The name; with the namespace that its program sets, if it sets one (ROS 2).
    pub name: &'a str,
    /// The program sets this name itself, so it need not be passed.
    pub by_program: bool,
}

impl<'a> DefaultName<'a> {
    /// Returns the namespace, which may be empty, and the name in it.
    fn split(&self) -> (&'a str, &'a str) {
        self.name.rsplit_once('/').unwrap_or(("", self.name))
    }

    /// Returns the absolute name, if the program sets it.
    fn name_by_program(&self) -> Option<String> {
        let (above, name) = self.split();
        self.by_program.then(|| format!("{above}/{name}"))
    }
}

impl LaunchedNode {
    /// Parses `argv` (without the program) of the executable, whose default node name is `usual`.
    ///
    /// # Errors
    /// The invalid argument, file or variable, and the reason.
    pub async fn read(
        argv: &[String],
        usual: DefaultName<'_>,
        ros: RosVersion,
        variable: Variable<'_>,
    ) -> anyhow::Result<Self> {
        match ros {
            RosVersion::One => ros1::read(argv, usual, variable),
            RosVersion::Two => ros2::read(argv, usual, variable).await,
        }
    }

    /// Returns the node's parameters that are settings of the stub, by key: `cloudroid.max` as `max`.
    pub fn settings(&self) -> BTreeMap<String, ParamValue> {
        let parameters = self.parameters.iter();
        let settings = parameters.filter_map(|(name, value)| {
            let key = name.strip_prefix(ros2::SETTINGS)?;
            Some((key.to_owned(), value.clone()))
        });
        settings.collect()
    }

    /// Returns the description of the node that the cloud is to run.
    pub fn to_cloud_node(&self, package: &str, executable: &str, share: &Path) -> control::NodeLaunch {
        let made_of = Revision::read(share);
        let share = normalize(share);
        let directory = working_directory(&share, std::env::current_dir().unwrap_or_default());
        let service = made_of.service_ros();
        let argv = if service == self.ros { self.argv.clone() } else { other_ros::translate_arguments(self) };
        control::NodeLaunch {
            name: self.node.clone(),
            package: package.to_owned(),
            executable: executable.to_owned(),
            argv,
            namespace: self.node.rsplit_once('/').map_or("", |(parent, _)| parent).to_owned(),
            share: share.to_string_lossy().into_owned(),
            directory: directory.to_string_lossy().into_owned(),
            revision: made_of.revision,
            image: made_of.image,
            named_by_argv: service == RosVersion::Two,
        }
    }
}

/// Returns a path without `..`, in the form that other programs on the robot use: launchers use
/// `lib/PKG/../../share/PKG`, while rospack, and so `$(find PKG)`, uses `share/PKG`.
fn normalize(path: &Path) -> PathBuf {
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

/// Returns the working directory. Within the overlay it has the same form as the share directory, even if symbolic
/// links lead there.
fn working_directory(share: &Path, current: PathBuf) -> PathBuf {
    let overlay = original::overlay(share);
    let canonical = overlay.canonicalize();
    let below = canonical.ok().and_then(|overlay| Some(current.strip_prefix(overlay).ok()?.to_owned()));
    below.map_or(current, |below| overlay.join(below))
}

/// Returns the name of a node that is started without one, derived from its executable.
pub fn default_node_name(executable: &str) -> String {
    let stem = executable.strip_suffix(".py").unwrap_or(executable);
    let allowed = |letter: char| {
        if letter.is_ascii_alphanumeric() { letter } else { '_' }
    };
    stem.chars().map(allowed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_the_overlay_are_written_as_launch_files_write_them() {
        let share = normalize(Path::new("/o/lib/p/../../share/./p"));
        assert_eq!(share, Path::new("/o/share/p"));
        let place = tempfile::tempdir().unwrap();
        let (real, link) = (place.path().join("real"), place.path().join("link"));
        std::fs::create_dir_all(real.join("lib/p")).unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        let current = real.canonicalize().unwrap().join("lib/p");
        assert_eq!(working_directory(&link.join("share/p"), current), link.join("lib/p"));
        assert_eq!(working_directory(&link.join("share/p"), "/root".into()), Path::new("/root"));
    }

    #[test]
    fn a_node_without_a_name_has_its_executables() {
        assert_eq!(default_node_name("image-view.py"), "image_view");
    }
}
