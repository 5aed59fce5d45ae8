//! Other runtimes, where they are installed: create and start, as their command lines.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde_json::Value;
use servant::container::ContainerSpec;

use crate::bundle::Bundle;

/// Runtimes with the command line of runc.
const KNOWN: [&str; 2] = ["runc", "crun"];

/// A program that is measured beside ours.
pub(crate) struct Peer {
    /// Its program.
    pub(crate) name: &'static str,
}

impl Peer {
    /// Those that are installed.
    pub(crate) fn installed() -> Vec<Self> {
        let there = |name: &&str| {
            let output = Command::new(name).arg("--version").output();
            output.is_ok_and(|output| output.status.success())
        };
        KNOWN
            .into_iter()
            .filter(there)
            .map(|name| Self { name })
            .collect()
    }

    /// From the first command to the end of the second; the bundle is in `place`.
    pub(crate) fn time(&self, place: &Path, spec: &ContainerSpec) -> Result<Duration> {
        let bundle = Bundle::make(place, spec, put_operands_right)?;
        let path = place.to_str().context("UTF-8")?;
        let begun = Instant::now();
        let made = self.run(place, &["create", "--bundle", path, &spec.id]);
        let started = made.and_then(|()| self.run(place, &["start", &spec.id]));
        let took = begun.elapsed();
        let removed = self.run(place, &["delete", "--force", &spec.id]);
        drop(bundle);
        fs::remove_dir_all(place)?;
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
