//! Other runtimes and engines, if installed: a container is created and started through their command lines.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde_json::Value;
use servant::container::ContainerSpec;
use tempfile::TempDir;

use crate::bundle::{Bundle, PROGRAM};
use crate::cgroups::{self, BenchCgroup};
use crate::root::ImageRoot;

/// Runtimes with the command line of runc.
const RUNTIMES: [&str; 2] = ["runc", "crun"];
/// A container engine, which calls a runtime.
const ENGINE: &str = "podman";

/// A program that is compared with ours.
pub(crate) struct PeerRuntime {
    /// Name of the program.
    pub(crate) name: &'static str,
    /// State directory of an engine; its path is short, because podman refuses more than 50 characters.
    store: Option<TempDir>,
}

impl PeerRuntime {
    /// Returns all known peers, each with the reason if it is not available.
    pub(crate) fn find_peers() -> Result<Vec<(Self, Result<()>)>> {
        let store = tempfile::Builder::new().prefix("peer-").tempdir_in("/tmp")?;
        let runtimes = RUNTIMES.map(|name| Self { name, store: None });
        let engine = Self { name: ENGINE, store: Some(store) };
        let with = |peer: Self| {
            let there = check_installed(peer.name);
            (peer, there)
        };
        Ok(runtimes.into_iter().chain([engine]).map(with).collect())
    }

    /// Measures from the first command to the end of the last; files of the container are in `place`.
    pub(crate) fn time_container(&self, place: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let took = cgroups::with_only_version_1(|| match &self.store {
            None => self.time_runtime(place, spec),
            Some(store) => self.time_engine(place, store.path(), spec),
        });
        fs::remove_dir_all(place)?;
        took
    }

    fn time_runtime(&self, place: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let bundle = Bundle::make(place, spec, swap_masked_operands)?;
        let path = place.to_str().context("UTF-8")?;
        let state = place.join("state");
        let global = ["--root", state.to_str().context("UTF-8")?];
        let begun = Instant::now();
        let made = self.run_command(place, &global, &["create", "--bundle", path, &spec.id]);
        let started = made.and_then(|()| self.run_command(place, &global, &["start", &spec.id]));
        let took = begun.elapsed();
        let removed = self.run_command(place, &global, &["delete", "--force", &spec.id]);
        drop(bundle);
        started.and(removed).map(|()| took)
    }

    /// Measures an engine: the same root below a writable layer, the same limits, no network.
    fn time_engine(&self, place: &Path, store: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let (root, cgroups) = (ImageRoot::mount(place, spec)?, BenchCgroup::reserve()?);
        let [images, run, temporary] = ["images", "run", "tmp"].map(|name| store.join(name).display().to_string());
        let global = ["--root", &images, "--runroot", &run, "--tmpdir", &temporary];
        let global = [&global[..], &["--storage-driver", "vfs", "--cgroup-manager", "cgroupfs"]].concat();
        let limits = &spec.limits;
        let number = |option: &str, value: Option<String>| value.map(|value| format!("--{option}={value}"));
        // The monitor process stays in our cgroup. Without CAP_SYS_RESOURCE, the default limits exceed the permitted
        // maximum.
        let options = "run --detach --network=none --log-driver=none --cgroups=no-conmon --ulimit=nofile=1024:1024 \
                       --ulimit=nproc=4096:4096";
        let mut words: Vec<String> = options.split(' ').map(str::to_owned).collect();
        words.extend([format!("--name={}", spec.id), format!("--cgroup-parent={}", cgroups.parent())]);
        words.extend(number("memory", limits.memory.map(|bytes| bytes.to_string())));
        words.extend(number("cpus", limits.cpus.map(|cpus| cpus.to_string())));
        words.extend(number("pids-limit", limits.pids.map(|pids| pids.to_string())));
        words.extend(["--rootfs".to_owned(), format!("{}:O", root.path().display())]);
        words.extend(PROGRAM.map(str::to_owned));
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let begun = Instant::now();
        let started = self.run_command(place, &global, &words);
        let took = begun.elapsed();
        let removed = self.run_command(place, &global, &["rm", "--force", "--time", "0", &spec.id]);
        started.and(removed).map(|()| took)
    }

    fn run_command(&self, place: &Path, global: &[&str], words: &[&str]) -> Result<()> {
        let log = place.join("log");
        let mut command = Command::new(self.name);
        command.args(global).args(words);
        // A file rather than a pipe, because the container inherits it.
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(File::create(&log)?);
        let status = command.status()?;
        let said = || fs::read_to_string(&log).unwrap_or_default();
        ensure!(status.success(), "{} {}: {}", self.name, words[0], said().trim());
        Ok(())
    }
}

/// Checks that a program can be executed; the error says why not.
fn check_installed(name: &str) -> Result<()> {
    let version = Command::new(name).arg("--version").output();
    let output = version.context("it is not installed")?;
    ensure!(output.status.success(), "--version ended with {}", output.status);
    Ok(())
}

/// Swaps the operands of masked comparisons: the peers take them in the specified order, libcontainer does not.
fn swap_masked_operands(seccomp: &mut Value) {
    for rule in seccomp["syscalls"].as_array_mut().into_iter().flatten() {
        for argument in rule["args"].as_array_mut().into_iter().flatten() {
            let (value, mask) = (argument["value"].clone(), argument["valueTwo"].clone());
            (argument["value"], argument["valueTwo"]) = (mask, value);
        }
    }
}
