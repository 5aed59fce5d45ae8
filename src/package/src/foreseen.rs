//! Scan of the sources for what they will have to run, before anything is compiled.
//!
//! A push that does not state what to run uses the only executable, or else the only launch file. If the sources show
//! for certain that there are several, the push fails at once instead of after compilation. Build files may do
//! anything, so only unconditional literal statements count.

mod executables;
mod problems;
mod scripts;
mod variables;

use std::collections::BTreeSet;
use std::path::Path;

use foreign::Visit;
use ros::bus::RosVersion;
use rustix::fs::FileType;

use crate::workspace::{Package, Workspace};
use executables::BuildFileScan;

pub use problems::{SourceProblem, find_problems, has_no_programs};
pub use variables::{SetVariable, find_set_variable};

/// Minimum content of the image of a workspace.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceScan {
    /// Names of executables, as far as they are known; sorted by package.
    pub executables: Vec<String>,
    /// Launch files, relative to their packages.
    pub launch_files: Vec<String>,
    /// Number of executables that certainly exist, including those whose names are unknown.
    programs: usize,
    /// True if there may be further launch files.
    may_launch_more: bool,
}

/// File name suffixes of ROS 2 launch files, wherever they are installed.
const LAUNCH_OF_TWO: [&str; 4] = ["launch.py", "launch.xml", "launch.yaml", "launch.yml"];

/// Scans the sources of a workspace. Unreadable files are ignored. Blocking.
pub fn scan_sources(workspace: &Workspace, version: RosVersion) -> SourceScan {
    let mut foreseen = SourceScan::default();
    for package in &workspace.packages {
        let own = executables::scan_package(&workspace.root, package, version);
        foreseen.programs += own.programs.len();
        let names = own.programs.into_iter().filter(|name| !name.contains('$'));
        foreseen.executables.extend(names);
        foreseen.may_launch_more |= own.mentions_launch;
        foreseen.add_launch_files(&workspace.root, package, version, (&own.launch_directories, &own.launch_files));
    }
    foreseen
}

/// Returns the names of a package's executables, as far as its build files show them. Blocking.
pub(crate) fn programs_of(workspace: &Workspace, package: &Package, version: RosVersion) -> BTreeSet<String> {
    executables::scan_package(&workspace.root, package, version).programs
}

/// Returns whether no package can have a launch file of this name, because no file has it and no build file mentions it
/// or configures files. Unreadable directories may have anything. Blocking.
pub fn lacks_launch_file(workspace: &Workspace, launch: &str, version: RosVersion) -> bool {
    let Some(name) = Path::new(launch).file_name().and_then(|name| name.to_str()) else {
        return false;
    };
    let lacks = |package: &Package| {
        let BuildFileScan { text, is_cut, .. } = executables::scan_package(&workspace.root, package, version);
        if is_cut || text.contains("configure_file") || text.contains(name) {
            return false;
        }
        let mut found = false;
        let directory = workspace.root.join(&package.path).canonicalize();
        let walked = directory.map(|directory| {
            foreign::walk(&directory, |entry| {
                found |= entry.name().to_string_lossy().starts_with(name);
                Ok::<_, foreign::Error>(if found { Visit::Skip } else { Visit::Into })
            })
        });
        !found && walked.is_ok_and(|walked| walked.is_ok())
    };
    !launch.starts_with('/') && workspace.packages.iter().all(lacks)
}

impl SourceScan {
    /// Returns whether the push must state what to run, whatever else the packages contain.
    pub fn must_be_chosen(&self) -> bool {
        let launch_files = self.launch_files.len();
        self.programs > 1 && (launch_files > 1 || launch_files == 0 && !self.may_launch_more)
    }

    /// Adds the launch files of a package; `installed` are its directories and files that are installed.
    fn add_launch_files(
        &mut self,
        root: &Path,
        package: &Package,
        version: RosVersion,
        (directories, files): (&[String], &[String]),
    ) {
        // The package may be behind a link that stays inside, as in the search of the workspace.
        let Ok(directory) = root.join(&package.path).canonicalize() else {
            self.may_launch_more = true;
            return;
        };
        // Looked up for each file: a build file may list any number.
        let [directories, files] =
            [directories, files].map(|names| names.iter().map(Path::new).collect::<BTreeSet<&Path>>());
        let walked = foreign::walk(&directory, |entry| {
            if entry.kind() == FileType::Directory {
                return Ok(Visit::Into);
            }
            let path = entry.path;
            let name = entry.name().to_string_lossy();
            let is_installed = entry.kind() == FileType::RegularFile
                && match version {
                    RosVersion::One => name.ends_with(".launch") && scripts::is_shared(path),
                    RosVersion::Two => {
                        LAUNCH_OF_TWO.iter().any(|end| name.ends_with(end))
                            && (files.contains(path) || path.ancestors().any(|above| directories.contains(above)))
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

#[cfg(test)]
mod tests;
