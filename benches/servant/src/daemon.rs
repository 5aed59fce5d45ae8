//! A daemon to be measured.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use tempfile::TempDir;

/// Timeout of everything that is waited for and not measured; long, because the machine may be slow and busy.
const PATIENCE: Duration = Duration::from_secs(120);

/// Returns the path of a program: in the directory `BIN`, which `make bench` sets, or else next to this executable.
pub fn binary(name: &str) -> Result<PathBuf> {
    let directory = match std::env::var_os("BIN") {
        Some(directory) => PathBuf::from(directory),
        None => std::env::current_exe()?
            .parent()
            .context("a directory")?
            .to_owned(),
    };
    let path = directory.join(name);
    ensure!(
        path.exists(),
        "{} is missing; run this by make bench",
        path.display()
    );
    Ok(path)
}

/// A running `cloudroidd`. It ends on drop, together with its servants, and its home is removed.
pub struct Daemon {
    /// Listening address, such as `127.0.0.1:40123`.
    pub address: String,
    child: Child,
    place: TempDir,
}

impl Daemon {
    /// Starts the daemon with this configuration and these environment variables, and waits until it answers.
    pub fn start(place: TempDir, config: &str, environment: &[(&str, &Path)]) -> Result<Self> {
        // Containers reach their root file systems through this directory.
        fs::set_permissions(place.path(), fs::Permissions::from_mode(0o755))?;
        let file = place.path().join("config.toml");
        fs::write(&file, config)?;
        let log = File::create(place.path().join("daemon.log"))?;
        let mut command = Command::new(binary("cloudroidd")?);
        command.arg("--home").arg(place.path().join("home"));
        command
            .args(["--listen", "127.0.0.1:0"])
            .arg("--config")
            .arg(file);
        command
            .env_remove("CLOUDROID_HOME")
            .envs(environment.iter().copied());
        let child = command
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()?;
        let mut daemon = Self {
            address: String::new(),
            child,
            place,
        };
        daemon.address = daemon.wait_until_ready()?;
        Ok(daemon)
    }

    fn wait_until_ready(&mut self) -> Result<String> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Ok(status) = self.get("/api/v1/status") {
                return Ok(status["listen"]
                    .as_str()
                    .context("status says where it listens")?
                    .to_owned());
            }
            if let Some(status) = self.child.try_wait()? {
                bail!("cloudroidd ended with {status}:\n{}", self.log_tail());
            }
            ensure!(
                Instant::now() < deadline,
                "cloudroidd does not answer:\n{}",
                self.log_tail()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Returns its state directory.
    pub fn home(&self) -> PathBuf {
        self.place.path().join("home")
    }

    /// Returns its pid.
    pub fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    /// Returns a directory for other files, which is removed together with the daemon.
    pub fn directory(&self) -> &Path {
        self.place.path()
    }

    /// Returns the last lines of its log.
    pub fn log_tail(&self) -> String {
        let log = fs::read_to_string(self.place.path().join("daemon.log")).unwrap_or_default();
        let lines: Vec<&str> = log.lines().collect();
        lines[lines.len().saturating_sub(20)..].join("\n")
    }

    /// Sends a GET request to its HTTP API.
    pub fn get(&self, path: &str) -> Result<Value> {
        self.request("GET", path)
    }

    /// Stops all its servants.
    pub fn stop_servants(&self) -> Result<()> {
        self.request("DELETE", "/api/v1/servants")?;
        self.wait_for_servants(0)
    }

    fn request(&self, method: &str, path: &str) -> Result<Value> {
        let mut stream = UnixStream::connect(self.home().join("run/daemon.sock"))?;
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        )?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let (head, body) = answer.split_once("\r\n\r\n").context("an HTTP answer")?;
        ensure!(
            head.split(' ').nth(1) == Some("200"),
            "{method} {path}: {answer}"
        );
        serde_json::from_str(body).with_context(|| format!("{method} {path}: {body}"))
    }

    /// Returns the ids of its servants.
    pub fn servants(&self) -> Result<Vec<String>> {
        let servants = self.get("/api/v1/servants")?;
        let servants = servants.as_array().context("a list of servants")?;
        Ok(servants
            .iter()
            .filter_map(|servant| Some(servant["id"].as_str()?.to_owned()))
            .collect())
    }

    /// Waits until it has `count` servants; a servant that is stopping counts until it has been removed completely.
    pub fn wait_for_servants(&self, count: usize) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        while self.servants()?.len() != count {
            ensure!(
                Instant::now() < deadline,
                "waited in vain for {count} servants:\n{}",
                self.log_tail()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(())
    }

    /// Returns a `cloudroidctl` command for this daemon.
    pub fn ctl(&self) -> Result<Command> {
        let mut command = Command::new(binary("cloudroidctl")?);
        command
            .env("CLOUDROID_HOME", self.home())
            .env_remove("CLOUDROID_SERVER")
            .stdin(Stdio::null());
        Ok(command)
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        if let Ok(None) = self.child.try_wait() {
            // On SIGTERM the daemon stops its servants first.
            let _ = kill(Pid::from_raw(self.pid()), Signal::SIGTERM);
            let _ = self.child.wait();
        }
    }
}
