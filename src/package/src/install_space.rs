//! Install spaces: what was compiled elsewhere.
//!
//! ```text
//!   catkin               .catkin  setup.sh  share/PACKAGE  lib/PACKAGE
//!   colcon, merged       setup.sh  share/ament_index  share/PACKAGE  lib/PACKAGE     (also of ament alone)
//!   colcon, isolated     setup.sh  PACKAGE/share/ament_index  PACKAGE/share/PACKAGE  PACKAGE/lib/PACKAGE
//! ```

use std::path::{Path, PathBuf};

use ros::bus::RosVersion;

use crate::locate::{not_too_many, subdirectories};
use crate::{Error, read};

/// Marks a catkin result space: empty in an install space, a list of sources in a devel space.
pub(crate) const MARKER: &str = ".catkin";
/// Where ament's tools find the names of packages.
pub(crate) const INDEX: &str = "share/ament_index/resource_index/packages";
/// `setup.sh`, the marker and the like.
const MAX_BYTES: u64 = 1 << 20;
/// What setup scripts of catkin, colcon and ament fall back to where nobody says where they are: the place that they were
/// made for.
const PLACES: [(&str, &str); 4] = [
    ("setup.sh", "_CATKIN_SETUP_DIR:="),
    ("local_setup.sh", "_colcon_prefix_sh_COLCON_CURRENT_PREFIX="),
    ("setup.sh", "_colcon_prefix_chain_sh_COLCON_CURRENT_PREFIX="),
    ("local_setup.sh", "AMENT_CURRENT_PREFIX:="),
];

/// How an install space is laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// catkin's: one prefix for all packages.
    Catkin,
    /// One prefix for all packages of ROS 2 (`colcon build --merge-install`).
    Merged,
    /// A prefix for each package of ROS 2, in a directory of its name (`colcon build`).
    Isolated,
}

impl Layout {
    /// The version of ROS that packages in it are of.
    pub fn version(self) -> RosVersion {
        match self {
            Layout::Catkin => RosVersion::One,
            Layout::Merged | Layout::Isolated => RosVersion::Two,
        }
    }
}

/// One that was found.
pub(crate) struct Space {
    /// The directory with `setup.sh`.
    pub(crate) root: PathBuf,
    pub(crate) layout: Layout,
    /// Directories with a package.xml, below `root`; at least one.
    pub(crate) packages: Vec<PathBuf>,
}

/// The install space at a directory; none where it is none.
pub(crate) fn at(root: &Path, space: &Path) -> Result<Option<Space>, Error> {
    let Some(layout) = layout(root, space)? else {
        return Ok(None);
    };
    if layout == Layout::Catkin && is_devel(root, space)? {
        return Err(Error::DevelSpace {
            path: space.to_owned(),
        });
    }
    let prefixes = match layout {
        Layout::Catkin | Layout::Merged => vec![space.to_owned()],
        Layout::Isolated => subdirectories(root, space)?,
    };
    let mut packages = Vec::new();
    for prefix in prefixes {
        for path in shared(root, &prefix)? {
            is_no_link_to_sources(space, &path)?;
            packages.push(path.strip_prefix(space).unwrap_or(&path).to_owned());
            not_too_many(packages.len(), space)?;
        }
    }
    if packages.is_empty() {
        let looked_for = "it is an install space without a share/*/package.xml".to_owned();
        return Err(Error::NoPackage {
            path: space.to_owned(),
            looked_for,
        });
    }
    Ok(Some(Space {
        root: space.to_owned(),
        layout,
        packages,
    }))
}

fn layout(root: &Path, space: &Path) -> Result<Option<Layout>, Error> {
    if space.join(INDEX).is_dir() {
        return Ok(Some(Layout::Merged));
    }
    let is_file = |name: &str| space.join(name).is_file();
    if is_file(MARKER) && (is_file("setup.sh") || is_file("_setup_util.py")) {
        return Ok(Some(Layout::Catkin));
    }
    // Elsewhere packages may be side by side, each with a directory `share` of its sources.
    if !is_file("local_setup.sh") && !is_file(".colcon_install_layout") {
        return Ok(None);
    }
    let isolated = subdirectories(root, space)?
        .iter()
        .any(|prefix| prefix.join(INDEX).is_dir());
    Ok(isolated.then_some(Layout::Isolated))
}

fn is_devel(root: &Path, space: &Path) -> Result<bool, Error> {
    let marker = read::text_inside(root, &space.join(MARKER), MAX_BYTES)?;
    Ok(!marker.trim().is_empty())
}

/// Directories of packages in a prefix.
fn shared(root: &Path, prefix: &Path) -> Result<Vec<PathBuf>, Error> {
    let share = prefix.join("share");
    if !share.is_dir() {
        return Ok(Vec::new());
    }
    let mut found = subdirectories(root, &share)?;
    found.retain(|path| path.join("package.xml").is_file());
    Ok(found)
}

/// With `--symlink-install` Python modules stay where they were built, and a hook leads there.
fn is_no_link_to_sources(space: &Path, package: &Path) -> Result<(), Error> {
    let hook = package.join("hook/pythonpath_develop.sh");
    if hook.is_file() {
        return Err(Error::SymlinkInstall {
            path: space.to_owned(),
            hook,
        });
    }
    Ok(())
}

/// Where a space was installed when it was built.
pub(crate) fn prefix(root: &Path, space: &Path) -> Result<Option<PathBuf>, Error> {
    for (name, before) in PLACES {
        let script = space.join(name);
        if !script.is_file() {
            continue;
        }
        let text = read::text_inside(root, &script, MAX_BYTES)?;
        if let Some((_, after)) = text.split_once(before) {
            return Ok(plain(after));
        }
    }
    Ok(None)
}

/// The path that a line of a shell script begins with. It becomes a path in the image: nothing but a plain absolute path
/// will do.
fn plain(after: &str) -> Option<PathBuf> {
    let named = after.split(['}', '\n']).next()?;
    let name = named.trim().trim_matches(['"', '\'']);
    let is_plain = name.starts_with('/')
        && name.len() > 1
        && name
            .chars()
            .all(|c| c.is_alphanumeric() || "/_-.+@ ".contains(c))
        && name.split('/').all(|part| part != "..");
    is_plain.then(|| PathBuf::from(name.trim_end_matches('/')))
}
