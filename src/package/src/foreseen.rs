//! What sources show of what their packages will have to run, before anything is compiled.
//!
//! A push that does not say what to run runs the only executable, or else the only launch file. Where the sources show
//! for certain that there are several, that is asked for at once, and not after everything was compiled. A package's
//! build files may do anything; so only what is written in plain words, outside of every condition, counts.

mod executables;

use std::path::{Component, Path};

use foreign::Visit;
use ros::bus::RosVersion;
use rustix::fs::FileType;

use crate::workspace::{Package, Workspace};

/// What an image of a workspace will have at least.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Foreseen {
    /// Names of programs, as far as they can be told; sorted by package.
    pub executables: Vec<String>,
    /// Launch files, relative to their packages.
    pub launch_files: Vec<String>,
    /// Programs for certain, those whose names cannot be told included.
    programs: usize,
    /// There may be launch files besides.
    may_launch_more: bool,
}

/// Directories of a package of ROS 1 whose files are not installed unless its build files say so.
const LEFT_OUT: [&str; 10] = [
    "build",
    "devel",
    "install",
    "test",
    "tests",
    "doc",
    "docs",
    "include",
    "__pycache__",
    "cmake",
];

/// Ends of names of launch files of ROS 2, wherever they are installed.
const LAUNCH_OF_TWO: [&str; 4] = ["launch.py", "launch.xml", "launch.yaml", "launch.yml"];

/// Looks through the sources of a workspace. What cannot be read shows nothing. Blocking.
pub fn foresee(workspace: &Workspace, version: RosVersion) -> Foreseen {
    let mut foreseen = Foreseen::default();
    for package in &workspace.packages {
        let own = executables::of(&workspace.root, package, version);
        foreseen.programs += own.programs.len();
        let names = own.programs.into_iter().filter(|name| !name.contains('$'));
        foreseen.executables.extend(names);
        foreseen.may_launch_more |= own.mentions_launch;
        foreseen.add_launch_files(&workspace.root, package, version, &own.launch_directories);
    }
    foreseen
}

impl Foreseen {
    /// Whether it must be said what to run, whatever else the packages turn out to have.
    pub fn must_be_chosen(&self) -> bool {
        let launch_files = self.launch_files.len();
        self.programs > 1 && (launch_files > 1 || launch_files == 0 && !self.may_launch_more)
    }

    fn add_launch_files(
        &mut self,
        root: &Path,
        package: &Package,
        version: RosVersion,
        installed: &[String],
    ) {
        // It may stand behind a link that stays inside, as the workspace was searched.
        let Ok(directory) = root.join(&package.path).canonicalize() else {
            self.may_launch_more = true;
            return;
        };
        let walked = foreign::walk(&directory, |entry| {
            if entry.kind() == FileType::Directory {
                return Ok(Visit::Into);
            }
            let path = entry.path;
            let name = entry.name().to_string_lossy();
            let is_installed = entry.kind() == FileType::RegularFile
                && match version {
                    RosVersion::One => name.ends_with(".launch") && is_shared(path),
                    RosVersion::Two => {
                        LAUNCH_OF_TWO.iter().any(|end| name.ends_with(end))
                            && installed
                                .iter()
                                .any(|directory| path.starts_with(directory))
                    }
                };
            if is_installed {
                self.launch_files.push(path.display().to_string());
            } else if path.to_string_lossy().contains("launch") {
                self.may_launch_more = true;
            }
            Ok::<_, foreign::Error>(Visit::Into)
        });
        self.may_launch_more |= walked.is_err();
    }
}

/// Whether a file of a package of ROS 1 comes into its share whatever its build files say.
fn is_shared(path: &Path) -> bool {
    path.components().all(|part| match part {
        Component::Normal(name) => {
            let name = name.to_string_lossy();
            !name.starts_with('.') && !LEFT_OUT.contains(&&*name)
        }
        _ => false,
    })
}

#[cfg(test)]
mod tests;
