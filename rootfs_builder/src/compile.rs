//! Compiles source packages in a container without network, as a user without rights.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use foreign::Visit;
use image::{LayerInfo, TreeOptions};
use rustix::fs::{AtFlags, FileType, Gid, Mode, Uid};
use serde::Serialize;
use servant::spec::{Mount, Profile};

use crate::base::Base;
use crate::blocking;
use crate::bootstrap::{EPOCH, tree_options};
use crate::error::{Error, IoAt};
use crate::event::Progress;
use crate::install::{lay_out, set_mode};
use crate::process::Tail;
use crate::sandbox::Run;
use crate::workshop::Workshop;

/// Bytes of a log that are kept.
const LOG_LIMIT: u64 = 64 << 20;

/// One package to compile.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Unit {
    /// Its ROS name.
    pub(crate) name: String,
    /// Its directory, relative to the pushed tree.
    pub(crate) path: PathBuf,
    /// `catkin` or `cmake`.
    pub(crate) build_type: String,
}

#[derive(Serialize)]
struct Job<'a> {
    packages: &'a [Unit],
    prefix: &'a Path,
    cmake: &'a [String],
    jobs: usize,
}

/// Compiles `units` in this order. `below`: base, toolchain, build dependencies. `log`: where the complete log
/// goes; it stays there whatever happens. Gives a tree with the prefix in it, owned by root.
pub(crate) async fn compile(
    shop: &Workshop,
    base: &Base,
    below: &[LayerInfo],
    source: &Path,
    units: &[Unit],
    log: &Path,
    progress: &Progress,
) -> Result<PathBuf, Error> {
    let room = shop.site.fresh("compile")?;
    let (tools, upper) = (room.join("tools"), room.join("upper"));
    fs::create_dir(&upper).at("making", &upper)?;
    let job = Job {
        packages: units,
        prefix: &base.build.prefix,
        cmake: &base.build.cmake,
        jobs: std::thread::available_parallelism().map_or(1, usize::from),
    };
    let mut files = BTreeMap::from([
        (
            PathBuf::from("cloudroid/compile.py"),
            COMPILE.as_bytes().to_vec(),
        ),
        (
            PathBuf::from("cloudroid/job.json"),
            serde_json::to_vec(&job).unwrap_or_default(),
        ),
        (PathBuf::from("cloudroid/source/.keep"), Vec::new()),
    ]);
    files.extend(
        base.build
            .files
            .iter()
            .map(|(path, text)| (path.clone(), text.clone().into_bytes())),
    );
    lay_out(&tools, &files)?;
    open_up(source)?;
    let mut layers = shop.extracted(below).await?;
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
    // Compiled Python is wanted here: it goes into the layer.
    environment.remove("PYTHONDONTWRITEBYTECODE");

    let mut file = fs::File::create(log).at("making", log)?;
    crate::install::set_mode(log, 0o600)?;
    let (mut writing, mut logged) = (Ok(()), 0);
    let mut package = units
        .first()
        .map_or_else(String::new, |unit| unit.name.clone());
    let mut tail = Tail::default();
    let (mut lines, mut told) = crate::lines::channel();
    let forward = async {
        while let Some(line) = told.recv().await {
            match title(&line, units) {
                Some(step) => progress.step(&step).await,
                None => progress.log(&line).await,
            }
        }
    };
    let work = async {
        let result = shop
            .site
            .run(
                Run {
                    name: "compile",
                    profile: Profile::Compile,
                    layers,
                    writable: Some(upper.clone()),
                    owned: vec!["/build".into(), base.build.prefix.clone()],
                    mounts: vec![Mount {
                        source: source.to_owned(),
                        target: "/cloudroid/source".into(),
                        writable: false,
                        device: false,
                        opened: None,
                    }],
                    environment,
                    argv: ["/usr/bin/python3", "-u", "/cloudroid/compile.py"]
                        .map(str::to_owned)
                        .into(),
                },
                |line| {
                    // The beginning says most; a build that prints without end must not fill the disk.
                    if writing.is_ok() && logged < LOG_LIMIT {
                        logged += line.len() as u64 + 1;
                        writing = writeln!(file, "{line}");
                    }
                    if let Some(name) = line.strip_prefix("::package ") {
                        package = name.to_owned();
                    } else if worth_showing(line) {
                        tail.push(line);
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
    writing.at("writing", log)?;
    if !finished.success() {
        let mut last_lines = tail.text();
        if finished.exit.code != Some(1) {
            last_lines = format!("{last_lines}\n{}", finished.last_words());
        }
        if last_lines.contains("No space left on device") {
            return Err(Error::DiskFull {
                path: upper,
                what: format!("compiling {package}"),
            });
        }
        return Err(Error::BuildFailed {
            package,
            log: log.to_owned(),
            last_lines,
            advice: Vec::new(),
        });
    }
    let prefix = base.build.prefix.clone();
    let tree = room.join("tree");
    let result = tree.clone();
    blocking::spawn(move || take_out(&upper, &prefix, &tree)).await??;
    Ok(result)
}

const COMPILE: &str = include_str!("inside/compile.py");

fn title(line: &str, units: &[Unit]) -> Option<String> {
    let name = line.strip_prefix("::package ")?;
    let at = units.iter().position(|unit| unit.name == name)? + 1;
    Some(format!("compiling {name} ({at} of {})", units.len()))
}

/// make's and CMake's own chatter pushes what the compiler said out of the last lines.
fn worth_showing(line: &str) -> bool {
    let chatter =
        line.starts_with("make[") || line.starts_with("gmake[") || line.starts_with("-- ");
    let progress = line.starts_with('[')
        && line.get(4..6).is_some_and(|rest| rest == "%]")
        && !line.contains("Error");
    !chatter && !progress && !line.trim().is_empty()
}

/// What was pushed may be readable by its owner alone; the compiling user is another.
pub(crate) fn open_up(source: &Path) -> Result<(), Error> {
    foreign::walk(source, |entry| {
        let mode = entry.stat.st_mode & 0o777;
        let run = if entry.kind() == FileType::Directory || mode & 0o100 != 0 {
            0o111
        } else {
            0
        };
        if entry.kind() != FileType::Symlink && mode != mode | 0o444 | run {
            let (parent, name) = entry.place();
            let mode = Mode::from_raw_mode(mode | 0o444 | run);
            rustix::fs::chmodat(parent, name, mode, AtFlags::empty())
                .map_err(|error| Error::io("opening up", entry.shown(), error.into()))?;
        }
        Ok::<_, Error>(Visit::Into)
    })
}

/// Moves the prefix out of the container's upper directory into a tree of its own that belongs to root.
fn take_out(upper: &Path, prefix: &Path, tree: &Path) -> Result<(), Error> {
    let inside = prefix.strip_prefix("/").unwrap_or(prefix);
    let target = tree.join(inside);
    let parent = target.parent().unwrap_or(tree);
    fs::create_dir_all(parent).at("making", parent)?;
    for directory in parent
        .ancestors()
        .take_while(|directory| directory.starts_with(tree))
    {
        set_mode(directory, 0o755)?;
    }
    let from = upper.join(inside);
    fs::rename(&from, &target).at("moving", &from)?;
    foreign::walk(&target, |entry| {
        let (parent, name) = entry.place();
        let root = (Some(Uid::ROOT), Some(Gid::ROOT));
        rustix::fs::chownat(parent, name, root.0, root.1, AtFlags::SYMLINK_NOFOLLOW)
            .map_err(|error| Error::io("changing the owner of", entry.shown(), error.into()))?;
        Ok::<_, Error>(Visit::Into)
    })
}

/// Packs an install space.
pub(crate) async fn pack(shop: &Workshop, base: &Base, tree: &Path) -> Result<LayerInfo, Error> {
    let store = shop.layers.store().clone();
    let (tree, options) = (
        tree.to_owned(),
        TreeOptions {
            exclude: Vec::new(),
            level: 6,
            ..tree_options(base)
        },
    );
    Ok(blocking::spawn(move || store.layer_from_tree(&tree, &options)).await??)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn the_compilers_words_are_shown_and_makes_are_not() {
        for line in [
            "x.cpp:3:5: error: 'y' was not declared",
            "CMake Error at CMakeLists.txt:3",
            "  3 | y();",
        ] {
            assert!(worth_showing(line), "{line}");
        }
        for line in [
            "make[2]: *** [x.o] Error 1",
            "[ 50%] Building CXX object x.o",
            "-- Found x",
            "",
            "[100%] Built",
        ] {
            assert!(!worth_showing(line), "{line}");
        }
    }

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
        open_up(root.path()).expect("done");
        let mode = |path: &Path| path.metadata().expect("there").permissions().mode() & 0o777;
        assert_eq!(
            (mode(&script), mode(&text), mode(&root.path().join("d"))),
            (0o755, 0o644, 0o755)
        );
    }

    #[test]
    fn steps_count_packages() {
        let unit = |name: &str| Unit {
            name: name.into(),
            path: name.into(),
            build_type: "catkin".into(),
        };
        let units = [unit("a"), unit("b")];
        assert_eq!(
            title("::package b", &units).as_deref(),
            Some("compiling b (2 of 2)")
        );
        assert_eq!(title("anything", &units), None);
    }
}
