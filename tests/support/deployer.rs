//! A deployer at a shell: runs `cloudroidctl` and checks exit status and output.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::Value;

use crate::layer_pool::FirstPush;
use crate::{binaries, cores};

/// Runs commands against one daemon.
#[derive(Debug, Clone)]
pub struct Deployer {
    /// Home of the daemon, which contains its socket.
    pub home: PathBuf,
}

/// Result of a command.
#[derive(Debug)]
pub struct CommandOutcome {
    /// Command line.
    pub command: String,
    /// Exit status.
    pub status: i32,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

impl CommandOutcome {
    /// Returns both streams, for searching.
    pub fn output(&self) -> String {
        format!("{}\n{}", self.stdout, self.stderr)
    }

    /// Returns the result if the command succeeded, otherwise an error.
    pub fn expect_success(self) -> anyhow::Result<CommandOutcome> {
        ensure!(self.status == 0, "{} ended with {}:\n{}", self.command, self.status, self.output());
        Ok(self)
    }

    /// Returns the result if the command failed and printed all of `words`, otherwise an error.
    pub fn expect_failure(self, words: &[&str]) -> anyhow::Result<CommandOutcome> {
        ensure!(self.status != 0, "{} succeeded:\n{}", self.command, self.output());
        let said = self.output();
        for word in words {
            ensure!(said.contains(word), "{} did not say {word:?}; it said:\n{said}", self.command);
        }
        ensure!(!said.contains("panicked"), "{} panicked:\n{said}", self.command);
        Ok(self)
    }
}

impl Deployer {
    /// Runs `cloudroidctl ARGUMENTS`.
    pub fn run<S: AsRef<str>>(&self, arguments: &[S]) -> anyhow::Result<CommandOutcome> {
        let arguments: Vec<&str> = arguments.iter().map(AsRef::as_ref).collect();
        // Commands that unpack, compile or pack keep a core busy.
        let is_work = arguments.iter().any(|word| ["push", "import"].contains(word));
        let _core = is_work.then(cores::acquire);
        let push = FirstPush::begin(&self.home, &arguments);
        let outcome = run(Command::new(binaries::path("cloudroidctl"))
            .args(&arguments)
            .env("CLOUDROID_HOME", &self.home)
            .env_remove("CLOUDROID_SERVER")
            .env_remove("ROS_VERSION"))?;
        if let Some(push) = push.filter(|_| outcome.status == 0) {
            push.keep();
        }
        Ok(outcome)
    }

    /// Runs a command with `--format json` and parses its output.
    pub fn run_json(&self, arguments: &[&str]) -> anyhow::Result<Value> {
        let outcome = self.run(&[&["--format", "json"], arguments].concat())?.expect_success()?;
        serde_json::from_str(&outcome.stdout)
            .with_context(|| format!("{} printed no JSON: {}", outcome.command, outcome.stdout))
    }

    /// Pushes a package below `tests/packages`, with further arguments.
    pub fn push(&self, package: &str, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
        let path = binaries::package(package);
        self.run(&[&["push", path_str(&path)], arguments].concat())
    }
}

/// Runs a command to its end.
pub fn run(command: &mut Command) -> anyhow::Result<CommandOutcome> {
    let typed = format!("{command:?}");
    let output = command.stdin(Stdio::null()).output().with_context(|| format!("cannot run {typed}"))?;
    Ok(CommandOutcome {
        command: typed,
        status: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

/// Returns a path of ours as a string.
pub fn path_str(path: &Path) -> &str {
    path.to_str().expect("paths of the stories are UTF-8")
}
