//! A deployer at a shell: `cloudroidctl`, its exit status and its words.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::Value;

use crate::layer_pool::FirstPush;
use crate::{binaries, cores};

/// Types commands to one daemon.
#[derive(Debug, Clone)]
pub struct Deployer {
    /// The daemon's home, by whose socket it is reached.
    pub home: PathBuf,
}

/// What a command came to.
#[derive(Debug)]
pub struct Outcome {
    /// The command as typed.
    pub command: String,
    /// Its exit status.
    pub status: i32,
    /// What it printed.
    pub stdout: String,
    /// What it complained of.
    pub stderr: String,
}

impl Outcome {
    /// Both streams, for looking words up.
    pub fn said(&self) -> String {
        format!("{}\n{}", self.stdout, self.stderr)
    }

    /// The same, if it went well.
    pub fn succeeded(self) -> anyhow::Result<Outcome> {
        ensure!(
            self.status == 0,
            "{} ended with {}:\n{}",
            self.command,
            self.status,
            self.said()
        );
        Ok(self)
    }

    /// The same, if it failed and said all of `words` in doing so.
    pub fn failed_saying(self, words: &[&str]) -> anyhow::Result<Outcome> {
        ensure!(
            self.status != 0,
            "{} succeeded:\n{}",
            self.command,
            self.said()
        );
        let said = self.said();
        for word in words {
            ensure!(
                said.contains(word),
                "{} did not say {word:?}; it said:\n{said}",
                self.command
            );
        }
        ensure!(
            !said.contains("panicked"),
            "{} panicked:\n{said}",
            self.command
        );
        Ok(self)
    }
}

impl Deployer {
    /// Types `cloudroidctl ARGUMENTS`.
    pub fn types<S: AsRef<str>>(&self, arguments: &[S]) -> anyhow::Result<Outcome> {
        let arguments: Vec<&str> = arguments.iter().map(AsRef::as_ref).collect();
        // What unpacks, compiles or packs keeps a core busy.
        let is_work = arguments
            .iter()
            .any(|word| ["push", "import"].contains(word));
        let _core = is_work.then(cores::acquire);
        let push = FirstPush::begin(&self.home, &arguments);
        let outcome = run(Command::new(binaries::path("cloudroidctl"))
            .args(&arguments)
            .env("CLOUDROID_HOME", &self.home)
            .env_remove("CLOUDROID_SERVER"))?;
        if let Some(push) = push.filter(|_| outcome.status == 0) {
            push.keep();
        }
        Ok(outcome)
    }

    /// Types it with `--format json` and reads the answer.
    pub fn asks(&self, arguments: &[&str]) -> anyhow::Result<Value> {
        let outcome = self
            .types(&[&["--format", "json"], arguments].concat())?
            .succeeded()?;
        serde_json::from_str(&outcome.stdout)
            .with_context(|| format!("{} printed no JSON: {}", outcome.command, outcome.stdout))
    }

    /// Pushes a package below `tests/packages` with more arguments.
    pub fn pushes(&self, package: &str, arguments: &[&str]) -> anyhow::Result<Outcome> {
        let path = binaries::package(package);
        self.types(&[&["push", path_str(&path)], arguments].concat())
    }
}

/// Runs a command to its end.
pub fn run(command: &mut Command) -> anyhow::Result<Outcome> {
    let typed = format!("{command:?}");
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot run {typed}"))?;
    Ok(Outcome {
        command: typed,
        status: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

/// A path of ours as text.
pub fn path_str(path: &Path) -> &str {
    path.to_str().expect("paths of the stories are UTF-8")
}
