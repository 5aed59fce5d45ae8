//! Install spaces, which were compiled elsewhere.
//!
//! ```text
//!   catkin               .catkin  setup.sh  share/PACKAGE  lib/PACKAGE
//!   colcon, merged       setup.sh  share/ament_index  share/PACKAGE  lib/PACKAGE     (also plain ament)
//!   colcon, isolated     setup.sh  PACKAGE/share/ament_index  PACKAGE/share/PACKAGE  PACKAGE/lib/PACKAGE
//! ```

use std::path::{Path, PathBuf};

use ros::bus::RosVersion;

use crate::locate::{check_package_count, subdirectories};
use crate::{Error, read};

/// Marker of a catkin result space: empty in an install space, a list of sources in a devel space.
pub(crate) const MARKER: &str = ".catkin";
/// Package index of ament.
pub(crate) const INDEX: &str = "share/ament_index/resource_index/packages";
/// Maximum size of `setup.sh`, the marker and similar files in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Default prefixes in setup scripts of catkin, colcon and ament: the place where the space was installed when it was
/// built.
const PLACES: [(&str, &str); 4] = [
    ("setup.sh", "_CATKIN_SETUP_DIR:="),
    ("local_setup.sh", "_colcon_prefix_sh_COLCON_CURRENT_PREFIX="),
    ("setup.sh", "_colcon_prefix_chain_sh_COLCON_CURRENT_PREFIX="),
    ("local_setup.sh", "AMENT_CURRENT_PREFIX:="),
];

/// Layout of an install space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// catkin: one prefix for all packages.
    Catkin,
    /// ROS 2: one prefix for all packages (`colcon build --merge-install`).
    Merged,
    /// ROS 2: a prefix for each package, in a directory of its name (`colcon build`).
    Isolated,
}

impl Layout {
    /// Returns the ROS version of the packages in this layout.
    pub fn version(self) -> RosVersion {
        match self {
            Layout::Catkin => RosVersion::One,
            Layout::Merged | Layout::Isolated => RosVersion::Two,
        }
    }
}

/// An install space that was found.
pub(crate) struct LocatedSpace {
    /// Directory with `setup.sh`.
    pub(crate) root: PathBuf,
    pub(crate) layout: Layout,
    /// Directories with a package.xml, below `root`; at least one.
    pub(crate) packages: Vec<PathBuf>,
}

/// Finds the install space at a directory; `None` if it is not one.
pub(crate) fn find_install_space(root: &Path, space: &Path) -> Result<Option<LocatedSpace>, Error> {
    let Some(layout) = detect_layout(root, space)? else {
        return Ok(None);
    };
    if layout == Layout::Catkin && is_devel(root, space)? {
        return Err(Error::DevelSpace { path: space.to_owned() });
    }
    let prefixes = match layout {
        Layout::Catkin | Layout::Merged => vec![space.to_owned()],
        Layout::Isolated => subdirectories(root, space)?,
    };
    let mut packages = Vec::new();
    for prefix in prefixes {
        for path in share_packages(root, &prefix)? {
            check_no_symlink_install(space, &path)?;
            packages.push(path.strip_prefix(space).unwrap_or(&path).to_owned());
            check_package_count(packages.len(), space)?;
        }
    }
    if packages.is_empty() {
        let looked_for = "the install space has no share/*/package.xml".to_owned();
        return Err(Error::NoPackage { path: space.to_owned(), looked_for });
    }
    Ok(Some(LocatedSpace { root: space.to_owned(), layout, packages }))
}

fn detect_layout(root: &Path, space: &Path) -> Result<Option<Layout>, Error> {
    if space.join(INDEX).is_dir() {
        return Ok(Some(Layout::Merged));
    }
    let is_file = |name: &str| space.join(name).is_file();
    if is_file(MARKER) && (is_file("setup.sh") || is_file("_setup_util.py")) {
        return Ok(Some(Layout::Catkin));
    }
    // Other directories may contain packages side by side, each with a source directory `share`.
    if !is_file("local_setup.sh") && !is_file(".colcon_install_layout") {
        return Ok(None);
    }
    let isolated = subdirectories(root, space)?.iter().any(|prefix| prefix.join(INDEX).is_dir());
    Ok(isolated.then_some(Layout::Isolated))
}

fn is_devel(root: &Path, space: &Path) -> Result<bool, Error> {
    let marker = read::read_text(root, &space.join(MARKER), MAX_BYTES)?;
    Ok(!marker.trim().is_empty())
}

/// Returns the directories of packages in a prefix.
fn share_packages(root: &Path, prefix: &Path) -> Result<Vec<PathBuf>, Error> {
    let share = prefix.join("share");
    if !share.is_dir() {
        return Ok(Vec::new());
    }
    let mut found = subdirectories(root, &share)?;
    found.retain(|path| path.join("package.xml").is_file());
    Ok(found)
}

/// Rejects `--symlink-install`, which leaves Python modules where they were built, with a hook that points there.
fn check_no_symlink_install(space: &Path, package: &Path) -> Result<(), Error> {
    let hook = package.join("hook/pythonpath_develop.sh");
    if hook.is_file() {
        return Err(Error::SymlinkInstall { path: space.to_owned(), hook });
    }
    Ok(())
}

/// Returns the prefix for which a space was built.
pub(crate) fn read_prefix(root: &Path, space: &Path) -> Result<Option<PathBuf>, Error> {
    for (name, before) in PLACES {
        let script = space.join(name);
        if !script.is_file() {
            continue;
        }
        let text = read::read_text(root, &script, MAX_BYTES)?;
        if let Some((_, after)) = text.split_once(before) {
            return Ok(parse_plain_path(after));
        }
    }
    Ok(None)
}

/// Parses the path at the beginning of a line of a shell script. It becomes a path in the image, so only a literal
/// absolute path is accepted.
fn parse_plain_path(after: &str) -> Option<PathBuf> {
    let named = after.split(['}', '\n']).next()?;
    let name = named.trim().trim_matches(['"', '\'']);
    let is_plain = name.starts_with('/')
        && name.len() > 1
        && name.chars().all(|c| c.is_alphanumeric() || "/_-.+@ ".contains(c))
        && name.split('/').all(|part| part != "..");
    is_plain.then(|| PathBuf::from(name.trim_end_matches('/')))
}
