//! The node as roslaunch started it, and the robot's ROS as its environment tells.

use std::path::{Component, Path, PathBuf};

use anyhow::{Context, bail};
use link::control;
use ros::ros1::names::{self, PeerUri};

use crate::original;
use crate::revision::Revision;

/// Where the Master is when nothing is said.
const MASTER: &str = "http://localhost:11311";

/// What the command line and the environment say.
#[derive(Debug, Clone, PartialEq)]
pub struct Robot {
    /// The Master's host.
    pub master_host: String,
    /// The Master's port.
    pub master_port: u16,
    /// The host that others reach this node under, where it is said.
    pub host: Option<String>,
    /// Absolute name of the node.
    pub node: String,
    /// Arguments, remaps and private parameters for the real node; nothing that begins with `__`.
    pub argv: Vec<String>,
}

impl Robot {
    /// Reads `argv` (without the program) of the executable, whose default node name is `usual`.
    pub fn read(
        argv: &[String],
        usual: &str,
        variable: &dyn Fn(&str) -> Option<String>,
    ) -> anyhow::Result<Self> {
        let set = |name| variable(name).filter(|value| !value.is_empty());
        let mut namespace = set("ROS_NAMESPACE").unwrap_or_default();
        let mut name = usual.to_owned();
        let mut master = set("ROS_MASTER_URI").unwrap_or_else(|| MASTER.to_owned());
        let mut host = set("ROS_HOSTNAME").or_else(|| set("ROS_IP"));
        let mut passed = Vec::new();
        for argument in argv {
            match argument.split_once(":=") {
                Some(("__name", value)) => name = value.to_owned(),
                Some(("__ns", value)) => namespace = value.to_owned(),
                Some(("__master", value)) => master = value.to_owned(),
                Some(("__hostname" | "__ip", value)) => host = Some(value.to_owned()),
                Some((special, _)) if special.starts_with("__") => {}
                _ => passed.push(argument.clone()),
            }
        }
        if name.contains('/') {
            bail!("__name:={name} holds a slash; use __ns:= or ROS_NAMESPACE for the namespace");
        }
        let node = names::canonical(&format!("{namespace}/{name}"));
        if !names::is_global(&node) {
            bail!("{node:?} is not a name that ROS allows for a node");
        }
        let place = PeerUri::parse(&master, "http").with_context(|| {
            format!("ROS_MASTER_URI is {master:?}; it should look like {MASTER}")
        })?;
        Ok(Self {
            master_host: place.host,
            master_port: place.port,
            host,
            node,
            argv: passed,
        })
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

    fn read(argv: &[&str], environment: &[(&str, &str)]) -> anyhow::Result<Robot> {
        let argv: Vec<String> = argv.iter().map(|&argument| argument.to_owned()).collect();
        Robot::read(&argv, "usual", &|name| {
            let found = environment.iter().find(|(variable, _)| *variable == name);
            found.map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn roslaunch_s_arguments_are_understood() {
        let robot = read(
            &[
                "3",
                "image:=/camera/image",
                "_threshold:=2",
                "__name:=people",
                "__log:=/x/y.log",
            ],
            &[
                ("ROS_NAMESPACE", "/front/"),
                ("ROS_MASTER_URI", "http://brain:1234/"),
            ],
        )
        .unwrap();
        assert_eq!(robot.node, "/front/people");
        assert_eq!(robot.argv, ["3", "image:=/camera/image", "_threshold:=2"]);
        assert_eq!(
            (robot.master_host.as_str(), robot.master_port),
            ("brain", 1234)
        );
        assert_eq!(
            robot.for_the_cloud("p", "x", Path::new("")).namespace,
            "/front"
        );
    }

    #[test]
    fn without_any_the_usual_ones_hold() {
        let robot = read(&[], &[]).unwrap();
        assert_eq!(
            (robot.node.as_str(), robot.master_host.as_str()),
            ("/usual", "localhost")
        );
        assert_eq!(robot.for_the_cloud("p", "x", Path::new("")).namespace, "");
        assert_eq!(usual_name("image-view.py"), "image_view");
    }

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
    fn what_cannot_be_is_said() {
        for (argv, environment) in [
            (vec!["__name:=a/b"], vec![]),
            (vec!["__name:=ä"], vec![]),
            (vec![], vec![("ROS_MASTER_URI", "localhost:11311")]),
        ] {
            assert!(
                read(&argv, &environment).is_err(),
                "{argv:?} {environment:?}"
            );
        }
    }
}
