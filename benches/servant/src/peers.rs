//! Runtimes and engines of others, where they are installed: a container created and started as their command lines do it.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde_json::Value;
use servant::container::ContainerSpec;
use tempfile::TempDir;

use crate::bundle::{Bundle, PROGRAM};
use crate::cgroups::{self, Cgroups};
use crate::root::Root;

/// Runtimes with the command line of runc.
const RUNTIMES: [&str; 2] = ["runc", "crun"];
/// A container engine, which calls one of them.
const ENGINE: &str = "podman";

/// A program that is measured beside ours.
pub(crate) struct Peer {
    /// Its program.
    pub(crate) name: &'static str,
    /// Where an engine keeps what it knows, from one container to the next. A short path: podman refuses more than 50 characters.
    store: Option<TempDir>,
}

impl Peer {
    /// All that are looked for, and why those that are not there are not.
    pub(crate) fn looked_for() -> Result<Vec<(Self, Result<()>)>> {
        let store = tempfile::Builder::new()
            .prefix("peer-")
            .tempdir_in("/tmp")?;
        let runtimes = RUNTIMES.map(|name| Self { name, store: None });
        let engine = Self {
            name: ENGINE,
            store: Some(store),
        };
        let with = |peer: Self| {
            let there = there(peer.name);
            (peer, there)
        };
        Ok(runtimes.into_iter().chain([engine]).map(with).collect())
    }

    /// From the first command to the end of the last; what the container needs is in `place`.
    pub(crate) fn time(&self, place: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let took = cgroups::as_of_one_version(|| match &self.store {
            None => self.runtime(place, spec),
            Some(store) => self.engine(place, store.path(), spec),
        });
        fs::remove_dir_all(place)?;
        took
    }

    fn runtime(&self, place: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let bundle = Bundle::make(place, spec, put_operands_right)?;
        let path = place.to_str().context("UTF-8")?;
        let state = place.join("state");
        let global = ["--root", state.to_str().context("UTF-8")?];
        let begun = Instant::now();
        let made = self.run(place, &global, &["create", "--bundle", path, &spec.id]);
        let started = made.and_then(|()| self.run(place, &global, &["start", &spec.id]));
        let took = begun.elapsed();
        let removed = self.run(place, &global, &["delete", "--force", &spec.id]);
        drop(bundle);
        started.and(removed).map(|()| took)
    }

    /// The same root under a layer that can be written, as an engine's containers have one, the same limits, no network.
    fn engine(&self, place: &Path, store: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let (root, cgroups) = (Root::mount(place, spec)?, Cgroups::place()?);
        let [images, run, temporary] =
            ["images", "run", "tmp"].map(|name| store.join(name).display().to_string());
        let global = [
            "--root",
            &images,
            "--runroot",
            &run,
            "--tmpdir",
            &temporary,
            "--storage-driver",
            "vfs",
            "--cgroup-manager",
            "cgroupfs",
        ];
        let limits = &spec.limits;
        let number =
            |option: &str, value: Option<String>| value.map(|value| format!("--{option}={value}"));
        let mut words = vec![
            "run".to_owned(),
            "--detach".to_owned(),
            format!("--name={}", spec.id),
            "--network=none".to_owned(),
            "--log-driver=none".to_owned(),
            format!("--cgroup-parent={}", cgroups.parent()),
            // The process that watches over it stays where we are.
            "--cgroups=no-conmon".to_owned(),
            // Without CAP_SYS_RESOURCE, what it takes by default is more than may be set.
            "--ulimit=nofile=1024:1024".to_owned(),
            "--ulimit=nproc=4096:4096".to_owned(),
        ];
        words.extend(number(
            "memory",
            limits.memory.map(|bytes| bytes.to_string()),
        ));
        words.extend(number("cpus", limits.cpus.map(|cpus| cpus.to_string())));
        words.extend(number(
            "pids-limit",
            limits.pids.map(|pids| pids.to_string()),
        ));
        words.push("--rootfs".to_owned());
        words.push(format!("{}:O", root.path().display()));
        words.extend(PROGRAM.map(str::to_owned));
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let begun = Instant::now();
        let started = self.run(place, &global, &words);
        let took = begun.elapsed();
        let removed = self.run(place, &global, &["rm", "--force", "--time", "0", &spec.id]);
        started.and(removed).map(|()| took)
    }

    fn run(&self, place: &Path, global: &[&str], words: &[&str]) -> Result<()> {
        let log = place.join("log");
        let mut command = Command::new(self.name);
        command.args(global).args(words);
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
}

/// Why a program cannot be called, if it cannot.
fn there(name: &str) -> Result<()> {
    let version = Command::new(name).arg("--version").output();
    let output = version.context("it is not installed")?;
    ensure!(
        output.status.success(),
        "--version ended with {}",
        output.status
    );
    Ok(())
}

/// They know the operands of a masked comparison the right way round; libcontainer does not.
fn put_operands_right(seccomp: &mut Value) {
    for rule in seccomp["syscalls"].as_array_mut().into_iter().flatten() {
        for argument in rule["args"].as_array_mut().into_iter().flatten() {
            let (value, mask) = (argument["value"].clone(), argument["valueTwo"].clone());
            (argument["value"], argument["valueTwo"]) = (mask, value);
        }
    }
}
