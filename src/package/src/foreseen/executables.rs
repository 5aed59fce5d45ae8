//! Executables that build files install by literal, unconditional statements.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use foreign::{DirectoryLookup, Tree};
use ros::bus::RosVersion;

use super::scripts;
use crate::cmake::{self, Command};
use crate::read;
use crate::workspace::Package;

/// Maximum size of a build file in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Maximum depth of `add_subdirectory`, and maximum number of files read.
const MAX_DEPTH: usize = 8;
const MAX_FILES: usize = 200;
/// Size in bytes of the build files of a package after which no further one is read.
const MAX_TEXT: usize = 4 << 20;

/// Maximum number of files of a directory `launch` that are looked for in a `setup.py`, and maximum size of that in
/// bytes: for each file all of it is searched.
const MAX_LAUNCH_FILES: usize = 100;
const MAX_SETUP: usize = 64 << 10;
/// Words in a build file that change where executables are installed, or whether they are built.
const UNCLEAR: [&str; 3] = ["RUNTIME_OUTPUT_DIRECTORY", "OUTPUT_NAME", "EXCLUDE_FROM_ALL"];

/// Words of build files of ROS 1 without which no program is installed as such.
const ROS1_INSTALL_WORDS: [&str; 7] =
    ["add_executable", "catkin_install_python", "PROGRAMS", "TARGETS", "DIRECTORY", "include", "add_subdirectory"];

/// Keywords that end the list of targets in `install(TARGETS …)`.
const TARGET_KEYWORDS: [&str; 5] = ["DESTINATION", "RUNTIME", "ARCHIVE", "LIBRARY", "EXPORT"];

/// Commands that begin a block whose content is conditional.
const BLOCKS: [&str; 6] = ["if", "foreach", "while", "function", "macro", "block"];

/// Result of scanning a package's build files.
#[derive(Debug, Default)]
pub(super) struct BuildFileScan {
    /// Names of executables, which may contain unknown variables.
    pub(super) programs: BTreeSet<String>,
    /// Directories of the package that are installed as a whole.
    pub(super) launch_directories: Vec<String>,
    /// Files of the package that are installed one by one.
    pub(super) launch_files: Vec<String>,
    /// Texts of the build files that were read.
    pub(super) text: String,
    /// True if launch files may be generated or renamed.
    pub(super) mentions_launch: bool,
    /// True if there are more build files than are read, which may mention anything.
    pub(super) is_cut: bool,
}

/// Scans the build files of a package.
pub(super) fn scan_package(root: &Path, package: &Package, version: RosVersion) -> BuildFileScan {
    let mut reading = BuildFileReader {
        root,
        package: &package.path,
        name: &package.manifest.name,
        version,
        shown: BuildFileScan::default(),
        targets: BTreeSet::new(),
        auto_targets: BTreeSet::new(),
        has_place: version == RosVersion::Two,
        is_unclear: package.manifest.build_type == "cmake",
        files: 0,
    };
    if package.manifest.build_type == "ament_python" {
        reading.read_setup_py();
    } else {
        reading.read_cmake_lists(&package.path, MAX_DEPTH);
    }
    if reading.is_unclear {
        reading.shown.programs.clear();
        reading.shown.launch_directories.clear();
        reading.shown.launch_files.clear();
    } else if version == RosVersion::One && !ROS1_INSTALL_WORDS.iter().any(|word| reading.shown.text.contains(word)) {
        // Of a package that installs no program, those in its share directory are found.
        let scripts = scripts::find_scripts(&root.join(&package.path)).into_iter();
        let scripts = scripts.filter(|script| script.is_executable && scripts::is_shared(&script.path));
        reading.shown.programs.extend(scripts.filter_map(|script| script.name().map(str::to_owned)));
    }
    reading.shown
}

struct BuildFileReader<'a> {
    root: &'a Path,
    package: &'a Path,
    name: &'a str,
    version: RosVersion,
    shown: BuildFileScan,
    /// Targets that are executables.
    targets: BTreeSet<String>,
    /// Executables of `ament_auto_add_executable`, which `ament_auto_package` installs.
    auto_targets: BTreeSet<String>,
    /// True if executables from here on are installed where `rosrun` looks, because `catkin_package` has been called.
    has_place: bool,
    is_unclear: bool,
    files: usize,
}

impl BuildFileReader<'_> {
    /// Reads the `CMakeLists.txt` of a directory and its subdirectories; returns whether the statements after it are
    /// certain to be executed.
    fn read_cmake_lists(&mut self, directory: &Path, depth: usize) -> bool {
        self.files += 1;
        // A build file may add any directory again, its own included.
        if self.files > MAX_FILES || self.shown.text.len() > MAX_TEXT {
            self.is_unclear = true;
            self.shown.is_cut = true;
            return false;
        }
        let path = self.root.join(directory).join("CMakeLists.txt");
        let text = read::read_text(self.root, &path, MAX_BYTES);
        let Ok(text) = text else {
            return false;
        };
        if UNCLEAR.iter().any(|word| text.contains(word)) {
            self.is_unclear = true;
        }
        let launch = match self.version {
            RosVersion::One => ".launch",
            RosVersion::Two => "launch",
        };
        self.shown.mentions_launch |= text.contains(launch);
        self.shown.text.push_str(&text);
        self.shown.text.push('\n');
        let mut open = 0_usize;
        for command in cmake::parse_commands(&text) {
            if BLOCKS.contains(&command.name.as_str()) {
                open += 1;
            } else if let Some(block) = command.name.strip_prefix("end")
                && BLOCKS.contains(&block)
            {
                open = open.saturating_sub(1);
            } else if command.name == "return" || command.name == "include" && includes_own_file(&command) {
                // The following statements may not be reached, or may be affected by other files.
                return false;
            } else if open == 0 && !self.apply_command(&command, directory, depth) {
                return false;
            }
        }
        true
    }

    fn apply_command(&mut self, command: &Command, directory: &Path, depth: usize) -> bool {
        let arguments = command.arguments.as_slice();
        match (command.name.as_str(), arguments) {
            ("catkin_package", _) => self.has_place = true,
            ("add_executable", [target, ..]) => {
                let is_made = !arguments.iter().any(|word| word == "IMPORTED" || word == "ALIAS");
                if is_made && self.has_place {
                    let target = self.expand_project_name(target);
                    if self.version == RosVersion::One {
                        self.shown.programs.insert(target.clone());
                    }
                    self.targets.insert(target);
                }
            }
            ("add_subdirectory", [inner]) if depth > 0 && !inner.contains('$') => {
                return self.read_cmake_lists(&directory.join(inner), depth - 1);
            }
            ("ament_auto_add_executable", [target, ..]) => {
                let target = self.expand_project_name(target);
                self.auto_targets.insert(target);
            }
            ("ament_auto_package", _) if directory == self.package => {
                self.shown.programs.append(&mut self.auto_targets);
                let shared = arguments.iter().skip_while(|word| *word != "INSTALL_TO_SHARE").skip(1);
                let shared = shared.map(|word| word.trim_end_matches('/').to_owned());
                self.shown.launch_directories.extend(shared);
            }
            ("rclcpp_components_register_node", _) => {
                let mut words = arguments.iter().skip_while(|word| *word != "EXECUTABLE").skip(1);
                let program = words.next().map(|program| self.expand_project_name(program));
                self.shown.programs.extend(program);
            }
            ("install" | "catkin_install_python", [kind, rest @ ..]) => {
                self.apply_install(kind, rest, directory);
            }
            _ => {}
        }
        true
    }

    fn apply_install(&mut self, kind: &str, arguments: &[String], directory: &Path) {
        // Of several destinations, that of `RUNTIME` is for executables.
        let runtime = arguments.windows(2).position(|words| words[0] == "RUNTIME" && words[1] == "DESTINATION");
        let runtime = runtime.filter(|_| kind == "TARGETS").map(|at| at + 1);
        let Some(at) = runtime.or_else(|| arguments.iter().position(|word| word == "DESTINATION")) else {
            return;
        };
        let Some(destination) = arguments.get(at + 1) else {
            return;
        };
        let destination = self.expand_project_name(destination.trim_end_matches('/'));
        let of_programs = ["${CATKIN_PACKAGE_BIN_DESTINATION}".to_owned(), format!("lib/{}", self.name)];
        let share = format!("share/{}", self.name);
        let is_in_share = destination.strip_prefix(&share).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'));
        let is_plain = |word: &&String| !word.contains('$');
        let listed = &arguments[..at];
        match kind {
            "PROGRAMS" if of_programs.contains(&destination) && arguments.len() == at + 2 => {
                let files = listed.iter().filter(is_plain);
                let files = files.filter(|file| !file.ends_with(".cfg"));
                let there = files.filter(|file| self.has_file(&directory.join(file)));
                let names = there.filter_map(|file| Some(file.rsplit('/').next()?.to_owned()));
                let names: Vec<String> = names.collect();
                self.shown.programs.extend(names);
            }
            "TARGETS" if of_programs.contains(&destination) => {
                let names = listed.iter().take_while(|word| !TARGET_KEYWORDS.contains(&word.as_str()));
                let names = names.map(|target| self.expand_project_name(target));
                let names: Vec<String> = names.filter(|name| self.targets.contains(name)).collect();
                let is_for_others = |word: &String| word == "ARCHIVE" || word == "LIBRARY";
                if runtime.is_some() || !listed.iter().any(is_for_others) {
                    self.shown.programs.extend(names);
                }
            }
            "DIRECTORY" if is_in_share && arguments.len() == at + 2 && directory == self.package => {
                let directories = listed.iter().filter(is_plain);
                let names = directories.map(|name| name.trim_end_matches('/').to_owned());
                self.shown.launch_directories.extend(names);
            }
            "FILES" if is_in_share && arguments.len() == at + 2 && directory == self.package => {
                self.shown.launch_files.extend(listed.iter().filter(is_plain).cloned());
            }
            _ => {}
        }
    }

    /// Expands the project name, which many targets and destinations contain.
    fn expand_project_name(&self, text: &str) -> String {
        text.replace("${PROJECT_NAME}", self.name)
    }

    fn has_file(&self, path: &Path) -> bool {
        let found = Tree::open(self.root).and_then(|tree| tree.read_file_following(path, MAX_BYTES));
        found.is_ok_and(|file| file.is_some())
    }

    /// Reads the executables listed in `setup.py`, if `setup.cfg` installs them where `ros2 run` looks.
    fn read_setup_py(&mut self) {
        let text = |name: &str| {
            let path: PathBuf = self.root.join(self.package).join(name);
            read::read_text(self.root, &path, MAX_BYTES).unwrap_or_default()
        };
        let (setup, places) = (text("setup.py"), text("setup.cfg"));
        self.shown.mentions_launch |= setup.contains("launch");
        if places.contains(&format!("/lib/{}", self.name)) {
            self.shown.programs.extend(console_scripts(&setup));
        }
        let launch = Tree::open(self.root).and_then(|tree| tree.open_directory(self.package.join("launch")));
        let names = match launch {
            Ok(DirectoryLookup::Directory(launch)) => launch.names().unwrap_or_default(),
            _ => Vec::new(),
        };
        if names.len() > MAX_LAUNCH_FILES || setup.len() > MAX_SETUP {
            self.shown.mentions_launch = true;
        } else {
            let names = names.iter().filter_map(|name| name.to_str());
            let installed = names.filter(|name| installs_launch_file(&setup, name));
            self.shown.launch_files.extend(installed.map(|name| format!("launch/{name}")));
        }
        self.shown.text = setup;
    }
}

/// Returns whether the command includes a file of the package itself rather than a CMake module.
fn includes_own_file(command: &Command) -> bool {
    command.arguments.first().is_some_and(|file| file.contains(['/', '.', '$']))
}

/// Returns whether the `data_files` of a `setup.py` include a file of its directory `launch`: by its path as a literal,
/// or by one of the usual patterns of `glob`.
fn installs_launch_file(setup: &str, name: &str) -> bool {
    let lines = setup.lines().filter(|line| !line.trim_start().starts_with('#'));
    let text: String = lines.flat_map(|line| line.chars().filter(|c| !c.is_whitespace() && *c != '"')).collect();
    // Without spaces and double quotes, which may stand for single ones.
    let text = text.replace('\'', "");
    let has = |words: &str| text.contains(words);
    let by_pattern = |pattern: &str| {
        let starts = ["glob(launch/", "glob(os.path.join(launch,"];
        starts.iter().any(|start| has(&format!("{start}{pattern})")))
    };
    let extension = name.rsplit('.').next().unwrap_or_default();
    let is_usual = name.contains("launch.") && ["py", "xml", "yaml"].contains(&extension);
    has(&format!("launch/{name}"))
        || by_pattern("*")
        || by_pattern(&format!("*.{extension}"))
        || by_pattern(&format!("*launch.{extension}")) && name.ends_with(&format!("launch.{extension}"))
        || by_pattern(&format!("*.launch.{extension}")) && name.ends_with(&format!(".launch.{extension}"))
        || is_usual && (by_pattern("*launch.[pxy][yma]*") || by_pattern("*launch.*"))
}

/// Returns the names before `=` in the list of `console_scripts`; empty unless it consists of string literals only.
pub(super) fn console_scripts(setup: &str) -> Vec<String> {
    let Some((_, rest)) = setup.split_once("console_scripts") else {
        return Vec::new();
    };
    let list = rest
        .trim_start_matches(|c: char| c.is_whitespace() || "'\":=".contains(c))
        .strip_prefix('[')
        .and_then(|rest| rest.split_once(']'));
    let Some((list, _)) = list else {
        return Vec::new();
    };
    let entries = list.lines().map(|line| line.split('#').next().unwrap_or_default());
    let entries: String = entries.collect();
    let names = entries.split(',').map(str::trim).filter(|entry| !entry.is_empty());
    let names = names.map(|entry| {
        let inside = entry.strip_prefix(['\'', '"'])?.strip_suffix(['\'', '"'])?;
        Some(inside.split_once('=')?.0.trim().to_owned())
    });
    names.collect::<Option<_>>().unwrap_or_default()
}
