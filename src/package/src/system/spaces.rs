//! Search for install spaces of ROS in a root file system, and the choice among several.

use std::collections::{BTreeMap, BTreeSet};

use ros::bus::RosVersion;

use super::view::View;
use super::{HIDDEN_DIRECTORIES, LARGEST_TEXT, SystemError};
use crate::install_space::{INDEX, MARKER};
use crate::{Error, names};

/// Depth to which directories are searched: `/home/robot/ws/install`.
pub(super) const DEPTH: usize = 4;
/// Maximum number of directories that are searched.
const MOST_DIRECTORIES: usize = 5000;
/// Maximum number of install spaces.
const MOST_SPACES: usize = 64;
/// Maximum number of packages of a space.
const MOST_PACKAGES: usize = 5000;
/// Directories at the root that contain no workspace.
const SYSTEM: [&str; 14] =
    ["bin", "boot", "dev", "etc", "lib", "lib32", "lib64", "libx32", "proc", "run", "sbin", "sys", "tmp", "var"];
/// Directories of workspaces with other content than install spaces.
const SKIPPED_DIRECTORIES: [&str; 6] = ["build", "log", "logs", "node_modules", "src", "share"];
/// Distribution's name of Debian's own ROS 1, which is of the time of Noetic.
const OF_DEBIAN: &str = "noetic";

/// Layout of an install space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpaceLayout {
    /// One prefix for all packages.
    Merged,
    /// A prefix for each package, in a directory of its name.
    Isolated,
}

/// An install space in a root file system.
#[derive(Debug, Clone, PartialEq)]
pub struct RosSpace {
    /// Absolute path.
    pub path: String,
    /// ROS version.
    pub ros: RosVersion,
    /// Layout.
    pub layout: SpaceLayout,
    /// Packages with their versions, which may be empty.
    pub packages: BTreeMap<String, String>,
    /// ROS distribution that it says it is; `None` for an overlay, which says nothing.
    pub distribution: Option<String>,
    /// True if its Python modules are for Python 2 only.
    pub is_for_python_two: bool,
}

impl RosSpace {
    /// Returns the prefixes in which its packages are.
    pub fn prefixes(&self) -> Vec<String> {
        match self.layout {
            SpaceLayout::Merged => vec![self.path.clone()],
            SpaceLayout::Isolated => self.packages.keys().map(|name| format!("{}/{name}", self.path)).collect(),
        }
    }
}

/// All spaces that were found.
#[derive(Debug, Default)]
pub(super) struct FoundSpaces {
    spaces: Vec<RosSpace>,
    unusable: Vec<(String, &'static str)>,
}

/// The ROS that counts.
pub(super) struct ChosenRos {
    pub(super) ros: RosVersion,
    pub(super) distribution: String,
    pub(super) spaces: Vec<RosSpace>,
    pub(super) unusable: Vec<(String, &'static str)>,
}

/// Finds all install spaces: those that the environment names, in its order, then others by path.
pub(super) fn find_spaces(view: &View, environment: &BTreeMap<String, String>) -> Result<FoundSpaces, Error> {
    let mut found = FoundSpaces::default();
    let mut seen = BTreeSet::new();
    let variable = |name: &str| environment.get(name).map_or("", String::as_str).split(':');
    let named = ["COLCON_PREFIX_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"].into_iter().flat_map(variable);
    for path in named.filter(|path| is_plain_path(path)) {
        if found.spaces.len() >= MOST_SPACES {
            break;
        }
        let path = path.trim_end_matches('/');
        // A prefix of a single package belongs to the space above it.
        let above = path.rsplit_once('/').map_or("", |(above, _)| above);
        for path in [above, path] {
            if path.len() > 1 && seen.insert(path.to_owned()) && look_at(view, path, &mut found)? {
                break;
            }
        }
    }
    let mut waiting: Vec<(String, usize)> = vec![(String::new(), 0)];
    let mut searched = 0;
    while let Some((path, depth)) = waiting.pop() {
        let is_space = !path.is_empty() && seen.insert(path.clone()) && look_at(view, &path, &mut found)?;
        let is_known = found.spaces.iter().any(|space| space.path == path);
        searched += 1;
        if is_space || is_known || depth == DEPTH || searched > MOST_DIRECTORIES || found.spaces.len() >= MOST_SPACES {
            continue;
        }
        let names = match view.names(&path) {
            // Data, not a workspace.
            Err(Error::TooMany { .. }) => continue,
            names => names?,
        };
        for name in names.into_iter().rev() {
            let skipped = match depth {
                0 => SYSTEM.contains(&name.as_str()),
                // Of /usr only what is not the distribution's.
                1 if path == "/usr" => name != "local",
                _ => SKIPPED_DIRECTORIES.contains(&name.as_str()) || name.starts_with('.'),
            };
            let below = format!("{path}/{name}");
            if !skipped && view.has_directory(&below)? {
                waiting.push((below, depth + 1));
            }
        }
    }
    Ok(found)
}

/// Returns whether a path from an environment is absolute and goes only down, in the one way of writing it.
fn is_plain_path(path: &str) -> bool {
    path.starts_with('/')
        && path.len() < 4096
        && path.chars().all(|c| !c.is_control() && !matches!(c, ':' | '"' | '\''))
        && path.trim_end_matches('/').split('/').skip(1).all(|part| !matches!(part, "" | "." | ".."))
}

/// Returns a path for messages.
fn show_path(path: &str) -> String {
    path.chars().filter(|c| !c.is_control()).collect()
}

/// Records the space at a directory; returns whether there is one.
fn look_at(view: &View, path: &str, found: &mut FoundSpaces) -> Result<bool, Error> {
    let index = |prefix: &str| view.has_directory(&format!("{prefix}/{INDEX}"));
    let (ros, layout) = if index(path)? {
        (RosVersion::Two, SpaceLayout::Merged)
    } else if let Some(marker) = view.read_text(&format!("{path}/{MARKER}"), LARGEST_TEXT)? {
        if !marker.trim().is_empty() {
            let reason = "is a devel space; install its workspace (catkin_make install)";
            found.unusable.push((show_path(path), reason));
            return Ok(true);
        }
        (RosVersion::One, SpaceLayout::Merged)
    } else {
        let names = match view.names(path) {
            Err(Error::TooMany { .. }) => return Ok(false),
            names => names?,
        };
        if !names.contains(".colcon_install_layout") && !names.contains("local_setup.sh") {
            return Ok(false);
        }
        let mut is_isolated = false;
        for name in names.iter().filter(|name| names::is_package(name)) {
            is_isolated = is_isolated || index(&format!("{path}/{name}"))?;
        }
        if !is_isolated {
            return Ok(false);
        }
        (RosVersion::Two, SpaceLayout::Isolated)
    };
    if !is_plain_path(path) {
        found.unusable.push((show_path(path), "has a name with special characters"));
        return Ok(true);
    }
    if HIDDEN_DIRECTORIES.iter().any(|hidden| path == *hidden || path.starts_with(&format!("{hidden}/"))) {
        found.unusable.push((path.to_owned(), "is hidden by scratch space in containers; install it below /opt"));
        return Ok(true);
    }
    let packages = read_packages(view, path, layout)?;
    found.spaces.push(RosSpace {
        distribution: find_distribution(view, path)?,
        is_for_python_two: is_for_python_two(view, path)?,
        path: path.to_owned(),
        ros,
        layout,
        packages,
    });
    Ok(true)
}

/// Returns the packages of a space with the versions in their package.xml.
fn read_packages(view: &View, path: &str, layout: SpaceLayout) -> Result<BTreeMap<String, String>, Error> {
    let mut packages = BTreeMap::new();
    let places: Vec<(String, String)> = match layout {
        SpaceLayout::Merged => {
            let indexed = view.names(&format!("{path}/{INDEX}"))?;
            let shared = view.names(&format!("{path}/share"))?.into_iter();
            let all: BTreeSet<String> = indexed.into_iter().chain(shared).collect();
            all.into_iter().map(|name| (format!("{path}/share/{name}"), name)).collect()
        }
        SpaceLayout::Isolated => {
            let all = view.names(path)?.into_iter();
            all.map(|name| (format!("{path}/{name}/share/{name}"), name)).collect()
        }
    };
    for (share, name) in places.into_iter().filter(|(_, name)| names::is_package(name)).take(MOST_PACKAGES) {
        // Whatever the index says, packages without a manifest are no packages for a build.
        if let Some(text) = view.read_text(&format!("{share}/package.xml"), LARGEST_TEXT)? {
            packages.insert(name, read_version(&text).unwrap_or_default());
        }
    }
    Ok(packages)
}

/// Returns the version in a package.xml.
fn read_version(text: &str) -> Option<String> {
    let document = crate::xml::parse(text).ok()?;
    let version = document.root_element().children().find(|part| part.has_tag_name("version"))?;
    let plain = |c: &char| c.is_ascii_alphanumeric() || ".+-~".contains(*c);
    Some(version.text()?.trim().chars().take_while(plain).take(64).collect())
}

/// Returns the ROS distribution in the hooks of the package `ros_environment`, or by the name of the directory that ROS
/// is installed in (REP 122).
fn find_distribution(view: &View, path: &str) -> Result<Option<String>, Error> {
    for hooks in ["share/ros_environment/environment", "etc/catkin/profile.d"] {
        let directory = format!("{path}/{hooks}");
        for name in view.names(&directory)?.into_iter().filter(|name| name.ends_with("ros_distro.sh")) {
            let text = view.read_text(&format!("{directory}/{name}"), LARGEST_TEXT)?.unwrap_or_default();
            let value = text.lines().find_map(|line| line.trim().strip_prefix("export ROS_DISTRO="));
            if let Some(value) = value.map(|value| value.trim_matches(['"', '\''])).filter(|name| is_distribution(name))
            {
                return Ok(Some(value.to_owned()));
            }
        }
    }
    Ok(path.strip_prefix("/opt/ros/").filter(|name| is_distribution(name)).map(str::to_owned))
}

/// Returns whether a text is like the name of a ROS distribution: lower-case letters, digits and `_`.
pub(super) fn is_distribution(name: &str) -> bool {
    !name.is_empty()
        && name.len() <= 32
        && name.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_')
}

fn is_for_python_two(view: &View, path: &str) -> Result<bool, Error> {
    let libraries = view.names(&format!("{path}/lib"))?;
    let has = |start: &str| libraries.iter().any(|name| name.starts_with(start));
    Ok(has("python2") && !has("python3"))
}

/// Chooses the ROS that counts: `wanted`, or that of the image's environment, or the only one.
pub(super) fn choose_distribution(
    view: &View,
    found: FoundSpaces,
    environment: &BTreeMap<String, String>,
    wanted: Option<&str>,
) -> Result<ChosenRos, SystemError> {
    let FoundSpaces { mut spaces, unusable } = found;
    let own = environment.get("ROS_DISTRO").map(String::as_str).filter(|name| is_distribution(name));
    if spaces.is_empty() {
        if !view.has_directory("/usr/lib/python3/dist-packages/rospy")? {
            let also = unusable.iter().map(|(path, why)| format!("; {path} {why}")).collect();
            return Err(SystemError::NoRos { also });
        }
        let distribution = wanted.or(own).unwrap_or(OF_DEBIAN).to_owned();
        return Ok(ChosenRos { ros: RosVersion::One, distribution, spaces, unusable });
    }
    // Spaces that say what they are; others are overlays of one of them.
    let said: BTreeSet<(String, u8)> =
        spaces.iter().filter_map(|space| Some((space.distribution.clone()?, space.ros.number()))).collect();
    let list = || said.iter().map(|(name, ros)| format!("{name} (ROS {ros})")).collect::<Vec<_>>();
    let is_said = |name: &str| said.iter().any(|(said, _)| said == name);
    let distribution = match (wanted, own) {
        (Some(wanted), _) if said.is_empty() || is_said(wanted) => wanted.to_owned(),
        (Some(wanted), _) => return Err(SystemError::NoSuchRos { wanted: wanted.to_owned(), found: list() }),
        (None, Some(own)) if said.is_empty() || is_said(own) => own.to_owned(),
        (None, _) => {
            match said.iter().map(|(name, _)| name).collect::<BTreeSet<_>>().into_iter().collect::<Vec<_>>()[..] {
                [only] => only.clone(),
                [] => return Err(SystemError::UnknownDistribution(spaces[0].path.clone())),
                _ => return Err(SystemError::SeveralRos(list())),
            }
        }
    };
    let base = spaces.iter().find(|space| space.distribution.as_deref() == Some(&*distribution));
    let Some(ros) = base.or(spaces.first()).map(|space| space.ros) else {
        return Err(SystemError::NoRos { also: String::new() });
    };
    spaces.retain(|space| space.ros == ros && space.distribution.as_ref().is_none_or(|said| *said == distribution));
    // Overlays come before what they stand on.
    spaces.sort_by_key(|space| space.distribution.is_some());
    Ok(ChosenRos { ros, distribution, spaces, unusable })
}
