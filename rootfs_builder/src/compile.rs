//! Compilation of source packages in a container without network, as an unprivileged user.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use foreign::Visit;
use image::TreeOptions;
use ros::flavour::Version;
use rustix::fs::{AtFlags, FileType, Mode};
use serde::Serialize;
use servant::container::{Mount, Profile};

use crate::base::Base;
use crate::blocking;
use crate::bootstrap::{EPOCH, tree_options};
use crate::error::{Error, IoContext};
use crate::event::Progress;
use crate::excerpt::Excerpt;
use crate::install::write_tree;
use crate::modes::set_mode;
use crate::sandbox::SandboxRun;
use crate::workshop::BuildContext;

/// Maximum size of a stored log in bytes.
const LOG_LIMIT: u64 = 64 << 20;

/// A package to compile.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct BuildUnit {
    /// ROS name.
    pub(crate) name: String,
    /// Directory, relative to the pushed tree.
    pub(crate) path: PathBuf,
    /// Build type: `catkin`, `ament_cmake`, `ament_python` or `cmake`.
    pub(crate) build_type: String,
}

/// Task to perform with packages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Task {
    /// Check all packages before spending time on compiling any, since most errors show in seconds: ROS 1 packages are
    /// configured, against stand-ins of those among them that they need; of ROS 2 packages the package.xml is read.
    Check,
    /// Compile and install the packages.
    Compile,
}

#[derive(Serialize)]
struct Job<'a> {
    check: bool,
    packages: Vec<JobPackage<'a>>,
    workspace: Vec<&'a str>,
    prefix: &'a Path,
    cmake: &'a [String],
    jobs: usize,
}

#[derive(Serialize)]
struct JobPackage<'a> {
    #[serde(flatten)]
    unit: &'a BuildUnit,
    /// Packages of the job that it needs, in build order.
    needs: Vec<&'a str>,
}

/// Packages to compile, and their build environment.
pub(crate) struct CompileOrder<'a> {
    pub(crate) base: &'a Base,
    /// Trees of base, toolchain, build dependencies and packages compiled before; lowest first.
    pub(crate) layers: Vec<PathBuf>,
    /// Directory of the visible sources.
    pub(crate) source: &'a Path,
    /// Packages in build order, each with the indexes of those that it needs.
    pub(crate) units: Vec<(&'a BuildUnit, Vec<usize>)>,
    /// All packages of the push.
    pub(crate) workspace: &'a [BuildUnit],
}

/// Result of compiling: a tree that contains the prefix.
pub(crate) struct CompileOutput {
    /// Tree, owned by the compiling user, including whiteouts of the overlay.
    pub(crate) tree: PathBuf,
    /// Directory of the tree.
    pub(crate) directory: PathBuf,
    /// First host uid of the container.
    pub(crate) uid_offset: u32,
}

/// The complete log of a build, which is kept in any case.
pub(crate) struct BuildLog {
    path: PathBuf,
    file: fs::File,
}

impl BuildLog {
    pub(crate) fn create(path: &Path) -> Result<Self, Error> {
        let file = fs::File::options().read(true).append(true).create(true).open(path).io_context("making", path)?;
        crate::modes::set_mode(path, 0o600)?;
        file.set_len(0).io_context("emptying", path)?;
        Ok(Self { path: path.to_owned(), file })
    }

    /// Returns the current size in bytes.
    pub(crate) fn len(&self) -> u64 {
        self.file.metadata().map_or(0, |about| about.len())
    }

    /// Returns the text from a position on, at most its last mebibyte.
    pub(crate) fn text_since(&self, position: u64) -> String {
        use std::os::unix::fs::FileExt;
        let end = self.len();
        let start = position.max(end.saturating_sub(1 << 20));
        let mut bytes = vec![0; usize::try_from(end.saturating_sub(start)).unwrap_or(0)];
        match self.file.read_exact_at(&mut bytes, start) {
            Ok(()) => String::from_utf8_lossy(&bytes).into_owned(),
            Err(_) => String::new(),
        }
    }
}

/// Runs a task in a separate container.
pub(crate) async fn run_task(
    shop: &BuildContext,
    task: Task,
    order: &CompileOrder<'_>,
    log: &mut BuildLog,
    progress: &Progress,
) -> Result<CompileOutput, Error> {
    let base = order.base;
    let name = match task {
        Task::Check => "configure",
        Task::Compile => "compile",
    };
    let directory = shop.site.fresh_directory(name)?;
    let (tools, upper) = (directory.join("tools"), directory.join("upper"));
    fs::create_dir(&upper).io_context("making", &upper)?;
    let job = Job {
        check: task == Task::Check,
        packages: order
            .units
            .iter()
            .map(|(unit, needs)| JobPackage {
                unit,
                needs: needs.iter().map(|&index| order.units[index].0.name.as_str()).collect(),
            })
            .collect(),
        workspace: order.workspace.iter().map(|unit| unit.name.as_str()).collect(),
        prefix: &base.build.prefix,
        cmake: &base.build.cmake,
        jobs: std::thread::available_parallelism().map_or(1, usize::from),
    };
    let mut files = BTreeMap::from([
        (PathBuf::from("cloudroid/compile.py"), build_script(base.ros).as_bytes().to_vec()),
        (PathBuf::from("cloudroid/second_look.py"), include_str!("inside/second_look.py").as_bytes().to_vec()),
        (PathBuf::from("cloudroid/job.json"), serde_json::to_vec(&job).unwrap_or_default()),
        (PathBuf::from("cloudroid/source/.keep"), Vec::new()),
    ]);
    files.extend(base.build.files.iter().map(|(path, text)| (path.clone(), text.clone().into_bytes())));
    write_tree(&tools, &files)?;
    let mut layers = order.layers.clone();
    layers.push(tools);
    let mut environment = base.environment.clone();
    environment.extend(base.build.environment.clone());
    for (name, value) in [
        ("HOME", "/build/home"),
        ("USER", "builder"),
        ("SOURCE_DATE_EPOCH", &EPOCH.to_string()),
        ("PYTHONHASHSEED", "0"),
        ("ROS_HOME", "/build/home/.ros"),
    ] {
        environment.insert(name.into(), value.into());
    }
    for (name, value) in condition_variables(base) {
        environment.entry(name.into()).or_insert(value);
    }
    // Compiled Python files are needed here: they go into the layer.
    environment.remove("PYTHONDONTWRITEBYTECODE");

    // The prefix may already exist, with packages compiled before; for each owned directory the user must be able to
    // write in its parent.
    let owned = vec!["/build".into(), base.build.prefix.clone()];
    let (mut writing, mut logged) = (Ok(()), log.len());
    let mut failed: Vec<String> = Vec::new();
    let mut current = order.units.first().map_or_else(String::new, |(unit, _)| unit.name.clone());
    let mut excerpt = Excerpt::default();
    let mut looked_at = 0;
    let (mut lines, mut told) = crate::lines::channel();
    let forward = async {
        while let Some(line) = told.recv().await {
            match step_title(&line, order.workspace) {
                Some(step) => progress.step(&step).await,
                None => progress.log(&line).await,
            }
        }
    };
    let work = async {
        let result = shop
            .site
            .run(
                SandboxRun {
                    name,
                    profile: Profile::Compile,
                    layers,
                    writable: Some(upper.clone()),
                    owned,
                    mounts: vec![Mount {
                        source: order.source.to_owned(),
                        target: "/cloudroid/source".into(),
                        writable: false,
                        device: false,
                        opened: None,
                    }],
                    environment,
                    argv: ["/usr/bin/python3", "-u", "/cloudroid/compile.py"].map(str::to_owned).into(),
                },
                |line| {
                    // Only the beginning is stored: a build that prints without end must not fill the disk.
                    if writing.is_ok() && logged < LOG_LIMIT {
                        logged += line.len() as u64 + 1;
                        writing = writeln!(log.file, "{line}");
                    }
                    if let Some(name) = line.strip_prefix("::package ") {
                        current = name.to_owned();
                    } else if let Some(name) = line.strip_prefix("::failed ") {
                        failed.push(name.to_owned());
                    } else if line.starts_with("::configured ") {
                        looked_at += 1;
                        progress.count("packages", looked_at, Some(order.units.len() as u64));
                        return;
                    } else {
                        excerpt.push(line);
                    }
                    lines.send(line.to_owned());
                },
            )
            .await;
        drop(lines);
        result
    };
    let (finished, ()) = tokio::join!(work, forward);
    let finished = finished?;
    writing.io_context("writing", &log.path)?;
    if task == Task::Check && failed.is_empty() {
        // However it ended, it found no error in a package.
        return Ok(CompileOutput { tree: upper, directory, uid_offset: finished.uid_offset });
    }
    if !finished.success() {
        let mut last_lines = excerpt.text();
        if finished.exit.code != Some(1) {
            last_lines = format!("{last_lines}\n{}", finished.last_output());
        }
        let package = if failed.is_empty() { current } else { failed.join(", ") };
        if last_lines.contains("No space left on device") {
            return Err(Error::DiskFull { path: upper, what: format!("compiling {package}") });
        }
        return Err(Error::BuildFailed { package, log: log.path.clone(), last_lines, advice: Vec::new() });
    }
    let (prefix, tree) = (base.build.prefix.clone(), directory.join("tree"));
    let result = tree.clone();
    blocking::spawn(move || extract_prefix(&upper, &prefix, &tree)).await??;
    Ok(CompileOutput { tree: result, directory, uid_offset: finished.uid_offset })
}

/// Returns the script that compiles packages of a ROS version.
fn build_script(ros: Version) -> &'static str {
    match ros {
        Version::Ros1 => include_str!("inside/compile.py"),
        Version::Ros2 => include_str!("inside/colcon.py"),
    }
}

/// Returns the variables of package.xml conditions that the base does not set itself; colcon evaluates them as well.
fn condition_variables(base: &Base) -> Vec<(&'static str, String)> {
    match base.ros {
        // For Debian's catkin, ROS_DISTRO would mean a second ROS.
        Version::Ros1 => Vec::new(),
        Version::Ros2 => vec![
            ("ROS_VERSION", base.ros.ros_version().number().to_string()),
            ("ROS_DISTRO", base.ros_distribution.clone()),
            ("ROS_PYTHON_VERSION", "3".to_owned()),
        ],
    }
}

fn step_title(line: &str, units: &[BuildUnit]) -> Option<String> {
    let name = line.strip_prefix("::package ")?;
    let at = units.iter().position(|unit| unit.name == name)? + 1;
    Some(format!("compiling {name} ({at} of {})", units.len()))
}

/// Makes the pushed files readable for the compiling user; they may be readable only by their owner.
pub(crate) fn make_readable(source: &Path) -> Result<(), Error> {
    foreign::walk(source, |entry| {
        let mode = entry.stat.st_mode & 0o777;
        let run = if entry.kind() == FileType::Directory || mode & 0o100 != 0 { 0o111 } else { 0 };
        if entry.kind() != FileType::Symlink && mode != mode | 0o444 | run {
            let (parent, name) = entry.parent_and_name();
            let mode = Mode::from_raw_mode(mode | 0o444 | run);
            rustix::fs::chmodat(parent, name, mode, AtFlags::empty())
                .map_err(|error| Error::io("opening up", entry.display_path(), error.into()))?;
        }
        Ok::<_, Error>(Visit::Into)
    })
}

/// Moves the prefix from the container's upper directory to a separate tree.
fn extract_prefix(upper: &Path, prefix: &Path, tree: &Path) -> Result<(), Error> {
    let inside = prefix.strip_prefix("/").unwrap_or(prefix);
    let target = tree.join(inside);
    let parent = target.parent().unwrap_or(tree);
    fs::create_dir_all(parent).io_context("making", parent)?;
    for directory in parent.ancestors().take_while(|directory| directory.starts_with(tree)) {
        set_mode(directory, 0o755)?;
    }
    let from = upper.join(inside);
    fs::rename(&from, &target).io_context("moving", &from)
}

/// Returns the options for packing compiled packages into a layer of the cache; files keep the compiling user as their
/// owner.
pub(crate) fn unit_options(base: &Base, uid_offset: u32) -> TreeOptions {
    TreeOptions { uid_offset, exclude: Vec::new(), overlay_upper: true, ..tree_options(base) }
}

/// Returns the options for packing an install space into a layer of an image. `owner`, the current owner of its files,
/// becomes root.
pub(crate) fn package_options(base: &Base, owner: u32) -> TreeOptions {
    TreeOptions { uid_offset: owner, exclude: Vec::new(), level: 6, ..tree_options(base) }
}

#[cfg(test)]
mod scripts;

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn private_files_become_readable_and_programs_stay_programs() {
        let root = tempfile::tempdir().expect("a directory");
        let (script, text) = (root.path().join("d/run.py"), root.path().join("d/x.txt"));
        fs::create_dir(root.path().join("d")).expect("made");
        for (path, mode) in [(&script, 0o700), (&text, 0o600)] {
            fs::write(path, "").expect("written");
            set_mode(path, mode).expect("set");
        }
        set_mode(&root.path().join("d"), 0o700).expect("set");
        make_readable(root.path()).expect("done");
        let mode = |path: &Path| path.metadata().expect("there").permissions().mode() & 0o777;
        assert_eq!((mode(&script), mode(&text), mode(&root.path().join("d"))), (0o755, 0o644, 0o755));
    }

    #[test]
    fn steps_count_packages() {
        let unit = |name: &str| BuildUnit { name: name.into(), path: name.into(), build_type: "catkin".into() };
        let units = [unit("a"), unit("b")];
        assert_eq!(step_title("::package b", &units).as_deref(), Some("compiling b (2 of 2)"));
        assert_eq!(step_title("anything", &units), None);
    }
}
