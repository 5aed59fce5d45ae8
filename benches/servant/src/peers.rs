//! Other runtimes, where they are installed: create and start, as their command lines.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use servant::local::DEFAULT_UID_BASE;
use servant::rootfs::Staged;
use servant::spec::Spec;
use servant::uids;

use crate::bare;
use crate::root::Root;

/// Runtimes with the command line of runc.
const KNOWN: [&str; 2] = ["runc", "crun"];

/// One of them.
pub(crate) struct Peer {
    /// Its program.
    pub(crate) name: &'static str,
    cgroup: String,
}

impl Peer {
    /// Those that are installed.
    pub(crate) fn installed() -> Result<Vec<Self>> {
        let there = |name: &&str| {
            let output = Command::new(name).arg("--version").output();
            output.is_ok_and(|output| output.status.success())
        };
        // Below our own, so that our limits are theirs.
        let cgroup = format!("{}/cloudroid-bench-{}", own_cgroup()?, std::process::id());
        Ok(KNOWN
            .into_iter()
            .filter(there)
            .map(|name| Self {
                name,
                cgroup: cgroup.clone(),
            })
            .collect())
    }

    /// From the first command to the end of the second; the bundle is in `place`.
    pub(crate) fn time(&self, place: &Path, spec: &Spec) -> Result<Duration> {
        fs::create_dir_all(place)?;
        let made = self.missing_cgroups()?;
        let outcome = self.time_in(place, spec);
        for directory in made {
            // What is not empty is somebody else's by now.
            let _ = fs::remove_dir(directory);
        }
        fs::remove_dir_all(place)?;
        outcome
    }

    fn time_in(&self, place: &Path, spec: &Spec) -> Result<Duration> {
        let root = Root::mount(place, spec)?;
        let staged = Staged {
            root: root.path().to_owned(),
            volumes: Vec::new(),
        };
        let (first, _lock) = uids::take(DEFAULT_UID_BASE)?;
        let mut config = bare::configuration(spec, &staged, (first, uids::RANGE))?;
        config["linux"]["cgroupsPath"] = format!("{}/{}", self.cgroup, spec.id).into();
        // They know the operands of a masked comparison the right way round.
        for rule in config["linux"]["seccomp"]["syscalls"]
            .as_array_mut()
            .context("a filter")?
        {
            for argument in rule["args"].as_array_mut().into_iter().flatten() {
                let (value, mask) = (argument["value"].clone(), argument["valueTwo"].clone());
                (argument["value"], argument["valueTwo"]) = (mask, value);
            }
        }
        fs::write(place.join("config.json"), serde_json::to_vec(&config)?)?;
        let bundle = place.to_str().context("UTF-8")?;
        let begun = Instant::now();
        let made = self.run(place, &["create", "--bundle", bundle, &spec.id]);
        let started = made.and_then(|()| self.run(place, &["start", &spec.id]));
        let took = begun.elapsed();
        let removed = self.run(place, &["delete", "--force", &spec.id]);
        started.and(removed).map(|()| took)
    }

    fn run(&self, place: &Path, words: &[&str]) -> Result<()> {
        let log = place.join("log");
        let mut command = Command::new(self.name);
        command.arg("--root").arg(place.join("state")).args(words);
        // A file, not a pipe: the container inherits it.
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(&log)?);
        let status = command.status()?;
        let said = || fs::read_to_string(&log).unwrap_or_default();
        ensure!(
            status.success(),
            "{} {}: {}",
            self.name,
            words[0],
            said().trim()
        );
        Ok(())
    }

    /// The directories, the deepest first, that will be made in the hierarchies.
    fn missing_cgroups(&self) -> Result<Vec<PathBuf>> {
        let path = Path::new(&self.cgroup);
        let mut missing = Vec::new();
        let hierarchies =
            fs::read_dir("/sys/fs/cgroup")?.filter_map(|entry| Some(entry.ok()?.path()));
        for root in hierarchies.chain([PathBuf::from("/sys/fs/cgroup")]) {
            if !root.join("cgroup.procs").exists() {
                continue;
            }
            let places = path.ancestors().filter(|part| part.parent().is_some());
            let places = places.map(|part| root.join(part.strip_prefix("/").unwrap_or(part)));
            missing.extend(places.filter(|place| !place.exists()));
        }
        Ok(missing)
    }
}

/// Where we are in the hierarchy that counts memory.
fn own_cgroup() -> Result<String> {
    let text = fs::read_to_string("/proc/self/cgroup")?;
    let fields = text
        .lines()
        .filter_map(|line| line.split_once(':')?.1.split_once(':'));
    let fields: Vec<_> = fields.collect();
    let of = |name: &str| {
        let found = fields
            .iter()
            .find(|(controllers, _)| controllers.split(',').any(|one| one == name));
        found.map(|(_, path)| path.trim_end_matches('/').to_owned())
    };
    of("memory").or_else(|| of("")).context("no cgroup")
}
