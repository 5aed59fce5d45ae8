//! Mistakes in build files because of which a program is not installed where ROS looks for it.

use ros::bus::RosVersion;

use super::executables::{self, BuildFileScan, console_scripts};
use super::scripts;
use crate::read;
use crate::workspace::{Package, Workspace};

/// Maximum size of a `setup.cfg` in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Maximum number of bytes in which names of scripts are searched, in all packages; further scripts are passed over.
pub(super) const MAX_SEARCHED: usize = 1 << 30;
/// Words of build files by which a package may have programs.
const WAYS: [&str; 6] =
    ["add_executable", "PROGRAMS", "register_node", "ament_auto", "add_subdirectory", "install_python"];

/// A mistake with its remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SourceProblem {
    /// Programs of an ament_python package are installed to `bin`.
    #[error(
        "{package} has no setup.cfg that installs its programs ({programs}) to lib/{package}, where ros2 run looks; \
         write setup.cfg with the lines [develop], script_dir=$base/lib/{package}, [install], \
         install_scripts=$base/lib/{package}"
    )]
    NoSetupCfg {
        /// Name of the package.
        package: String,
        /// Names of the programs.
        programs: String,
    },
    /// An ament_python package without programs.
    #[error(
        "{package} has no console_scripts in its setup.py, so it has no program that ros2 run finds; add \
         entry_points={{'console_scripts': ['NODE = {package}.MODULE:main']}}"
    )]
    NoConsoleScripts {
        /// Name of the package.
        package: String,
    },
    /// An ament_python package without a `setup.py`.
    #[error("{package} has build type ament_python and no setup.py; write one, or choose another build type")]
    NoSetupPy {
        /// Name of the package.
        package: String,
    },
    /// A script that no build file of ROS 1 installs.
    #[error(
        "{script} of {package} is installed by no catkin_install_python in its CMakeLists.txt; here rosrun finds it \
         only if it is executable and no other program is installed: add catkin_install_python(PROGRAMS {script} \
         DESTINATION ${{CATKIN_PACKAGE_BIN_DESTINATION}})"
    )]
    ScriptOfRos1 {
        /// Name of the package.
        package: String,
        /// Path of the script in the package.
        script: String,
    },
    /// A script that no build file of ROS 2 installs.
    #[error(
        "{script} of {package} is not installed by its CMakeLists.txt, so ros2 run does not find it: add \
         install(PROGRAMS {script} DESTINATION lib/${{PROJECT_NAME}})"
    )]
    ScriptOfRos2 {
        /// Name of the package.
        package: String,
        /// Path of the script in the package.
        script: String,
    },
}

/// Returns the mistakes in a workspace, in the order of its packages. Unreadable files are ignored. Blocking.
pub fn find_problems(workspace: &Workspace, version: RosVersion) -> Vec<SourceProblem> {
    let mut left = MAX_SEARCHED;
    let all = workspace.packages.iter();
    all.flat_map(|package| {
        if package.manifest.build_type == "ament_python" {
            find_python_problem(workspace, package).into_iter().collect()
        } else {
            find_forgotten_scripts(workspace, package, version, &mut left)
        }
    })
    // Beside other packages it may be a library for them.
    .filter(|problem| workspace.packages.len() == 1 || !matches!(problem, SourceProblem::NoConsoleScripts { .. }))
    .collect()
}

/// Returns whether no package of the workspace can have a program, because of such mistakes. Blocking.
pub fn has_no_programs(workspace: &Workspace, version: RosVersion) -> bool {
    let mut mistakes = 0;
    let is_without = |package: &Package| {
        if package.manifest.build_type == "ament_python" {
            let problem = find_python_problem(workspace, package);
            mistakes += usize::from(problem.is_some());
            return problem.is_some();
        }
        let scan = executables::scan_package(&workspace.root, package, version);
        !scan.is_cut && !scan.text.is_empty() && !WAYS.iter().any(|word| scan.text.contains(word))
    };
    version == RosVersion::Two && workspace.packages.iter().all(is_without) && mistakes > 0
}

fn find_python_problem(workspace: &Workspace, package: &Package) -> Option<SourceProblem> {
    let text = |name: &str| {
        let path = workspace.root.join(&package.path).join(name);
        read::read_text(&workspace.root, &path, MAX_BYTES)
    };
    let name = package.manifest.name.clone();
    let places = text("setup.cfg").unwrap_or_default();
    let Ok(setup) = text("setup.py") else {
        return Some(SourceProblem::NoSetupPy { package: name });
    };
    let either = format!("{setup}{places}");
    let has = |words: &str| either.contains(words);
    // Programs may also be listed by other means, or be data files.
    if !has("console_scripts") && !has("gui_scripts") && !has("scripts=") && !has("scripts =") && !has("lib/") {
        return Some(SourceProblem::NoConsoleScripts { package: name });
    }
    let programs = console_scripts(&setup);
    // A path may be put together, as of `$base/lib` and a variable.
    (!programs.is_empty() && !has("install_scripts") && !has("install-scripts") && !has("lib/"))
        .then(|| SourceProblem::NoSetupCfg { package: name, programs: programs.join(", ") })
}

/// Returns the scripts that no build file installs; `left` bytes may be searched.
pub(super) fn find_forgotten_scripts(
    workspace: &Workspace,
    package: &Package,
    version: RosVersion,
    left: &mut usize,
) -> Vec<SourceProblem> {
    let BuildFileScan { mut text, is_cut, .. } = executables::scan_package(&workspace.root, package, version);
    // Scripts may be listed by a pattern.
    if is_cut || text.is_empty() || text.contains("GLOB") {
        return Vec::new();
    }
    // catkin also installs the scripts of a setup.py.
    let setup = workspace.root.join(&package.path).join("setup.py");
    text.push_str(&read::read_text(&workspace.root, &setup, MAX_BYTES).unwrap_or_default());
    let tree = foreign::Tree::open(&workspace.root);
    let found = scripts::find_scripts(&workspace.root.join(&package.path)).into_iter();
    let forgotten = found.filter(|script| {
        // Each of the three searches below goes through the whole text.
        let Some(rest) = left.checked_sub(3 * text.len()) else {
            return false;
        };
        *left = rest;
        let directory = script.path.parent().and_then(|parent| parent.to_str()).unwrap_or_default();
        let is_named = script.name().is_some_and(|name| text.contains(name));
        // A whole directory may be installed, or files by a variable; at the top there is only the package's own.
        let is_listed = text.contains("DIRECTORY") && text.contains(directory);
        let is_below = !directory.is_empty() && (is_listed || text.contains(&format!("{directory}/$")));
        // A build file that was not read, since it is added under a condition.
        let own_list = package.path.join(directory).join("CMakeLists.txt");
        let has_list = !directory.is_empty() && tree.as_ref().is_ok_and(|tree| tree.has_file(own_list));
        !is_named && !is_below && !has_list
    });
    let problems = forgotten.map(|script| {
        let (package, script) = (package.manifest.name.clone(), script.path.display().to_string());
        match version {
            RosVersion::One => SourceProblem::ScriptOfRos1 { package, script },
            RosVersion::Two => SourceProblem::ScriptOfRos2 { package, script },
        }
    });
    problems.collect()
}
