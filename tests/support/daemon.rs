//! A daemon under test, with a home of its own.

use std::fs::File;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;

use anyhow::{Context, bail, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::binaries;
use crate::deployer::Deployer;
use crate::patience::{self, PatientStream};
use crate::robot::Robot;

/// A running `cloudroidd`.
pub struct Daemon {
    /// State directory.
    pub home: PathBuf,
    /// Listening address, such as `127.0.0.1:40123`.
    pub address: String,
    /// `None` if it was started by another process, such as systemd.
    child: Option<Child>,
    _space: Option<Arc<HomeSpace>>,
}

/// The disk space of a home, freed on drop: some hundred megabytes each, and all homes of a run together would exceed
/// the free space of many machines.
#[derive(Debug)]
struct HomeSpace(PathBuf);

impl Drop for HomeSpace {
    fn drop(&mut self) {
        for heavy in ["layers", "images"] {
            let _ = std::fs::remove_dir_all(self.0.join(heavy));
        }
    }
}

/// Options to start a daemon. Images are kept until this value and all daemons started from it are dropped.
#[derive(Debug, Clone)]
pub struct DaemonSetup {
    space: Arc<HomeSpace>,
    home: PathBuf,
    config: String,
    listen: String,
    environment: Vec<(String, String)>,
}

impl DaemonSetup {
    /// Creates options for a daemon with its state in `home`, on a free loopback port.
    pub fn new(home: &Path) -> DaemonSetup {
        DaemonSetup {
            space: Arc::new(HomeSpace(home.to_owned())),
            home: home.to_owned(),
            config: String::new(),
            listen: "127.0.0.1:0".to_owned(),
            environment: Vec::new(),
        }
    }

    /// Appends lines to the configuration.
    pub fn config(mut self, toml: &str) -> DaemonSetup {
        self.config.push_str(toml);
        self
    }

    /// Sets the listening address.
    pub fn listen(mut self, address: &str) -> DaemonSetup {
        self.listen = address.to_owned();
        self
    }

    /// Sets an environment variable.
    pub fn environment(mut self, key: &str, value: &str) -> DaemonSetup {
        self.environment.push((key.to_owned(), value.to_owned()));
        self
    }

    /// Returns the state directory.
    pub fn home(&self) -> &Path {
        &self.home
    }

    fn command(&self) -> anyhow::Result<Command> {
        std::fs::create_dir_all(&self.home)?;
        let mut command = Command::new(binaries::path("cloudroidd"));
        command.arg("--home").arg(&self.home).args(["--listen", &self.listen]);
        if !self.config.is_empty() {
            let path = self.home.join("test-config.toml");
            std::fs::write(&path, &self.config)?;
            command.arg("--config").arg(path);
        }
        command.env_remove("CLOUDROID_HOME");
        command.envs(self.environment.iter().map(|(key, value)| (key, value)));
        command.stdin(Stdio::null());
        Ok(command)
    }

    /// Starts the daemon and waits until it answers.
    pub fn start(&self) -> anyhow::Result<Daemon> {
        let log = File::options().create(true).append(true).open(self.home.join("daemon.log")).or_else(|_| {
            std::fs::create_dir_all(&self.home)?;
            File::options().create(true).append(true).open(self.home.join("daemon.log"))
        })?;
        let child = self.command()?.stdout(log.try_clone()?).stderr(log).spawn()?;
        let mut daemon = Daemon {
            home: self.home.clone(),
            address: "localhost".to_owned(),
            child: Some(child),
            _space: Some(Arc::clone(&self.space)),
        };
        let answers = crate::wait_until("a daemon that answers", || {
            if let Some(child) = &mut daemon.child
                && let Some(status) = child.try_wait()?
            {
                bail!("cloudroidd ended with {status}:\n{}", read_log(&self.home));
            }
            let pid = daemon.pid();
            let listens = daemon.status().and_then(|status| {
                ensure!(status["pid"] == pid, "{status:#}");
                address_in(&status)
            });
            Ok(listens.map_err(|error| format!("{error:#}")))
        });
        daemon.address = answers.with_context(|| read_log(&self.home))?;
        Ok(daemon)
    }

    /// Starts the daemon, which must refuse to start; returns its exit status and output.
    pub fn expect_refusal(&self) -> anyhow::Result<String> {
        let output = self.command()?.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
        let output = wait_with_output(output)?;
        let said = format!("{}{}", String::from_utf8_lossy(&output.1), String::from_utf8_lossy(&output.2));
        ensure!(!output.0.success(), "cloudroidd started and ended well:\n{said}");
        ensure!(!said.contains("panicked"), "cloudroidd panicked:\n{said}");
        Ok(said)
    }
}

/// Waits for its end, within the time limit of a story.
fn wait_with_output(mut child: Child) -> anyhow::Result<(ExitStatus, Vec<u8>, Vec<u8>)> {
    let pid = Pid::from_raw(child.id() as i32);
    let (mut out, mut err) = (child.stdout.take().expect("piped"), child.stderr.take().expect("piped"));
    let (done, ended) = std::sync::mpsc::channel::<()>();
    let watchdog = std::thread::spawn(move || {
        if patience::receive(&ended).is_err() {
            let _ = kill(pid, Signal::SIGKILL);
        }
    });
    let errors = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = err.read_to_end(&mut bytes);
        bytes
    });
    let mut bytes = Vec::new();
    out.read_to_end(&mut bytes)?;
    let status = child.wait()?;
    let _ = done.send(());
    let _ = watchdog.join();
    Ok((status, bytes, errors.join().unwrap_or_default()))
}

fn read_log(home: &Path) -> String {
    std::fs::read_to_string(home.join("daemon.log")).unwrap_or_default()
}

impl Daemon {
    /// Attaches to a daemon with its state in `home` that another process has started, once it answers; `not` is the
    /// pid of a daemon to ignore.
    pub fn attach(home: &Path, not: Option<i32>) -> anyhow::Result<Daemon> {
        let mut daemon = Daemon { home: home.to_owned(), address: "localhost".to_owned(), child: None, _space: None };
        daemon.address = crate::wait_until("a daemon that answers", || {
            let listens = daemon.status().and_then(|status| {
                ensure!(not.is_none_or(|pid| status["pid"] != pid), "{status:#}");
                address_in(&status)
            });
            Ok(listens.map_err(|error| format!("{error:#}")))
        })?;
        Ok(daemon)
    }

    fn status(&self) -> anyhow::Result<Value> {
        self.api("/api/v1/status")
    }

    /// Returns a deployer on this machine.
    pub fn deployer(&self) -> Deployer {
        Deployer { home: self.home.clone() }
    }

    /// Connects a robot to `path`, such as `opencv_apps?robot=r2`.
    pub fn robot(&self, path: &str) -> anyhow::Result<Robot> {
        Robot::connect(&self.url(path)).with_context(|| format!("the daemon said:\n{}", self.log_tail()))
    }

    /// Returns the WebSocket URL of `path`.
    pub fn url(&self, path: &str) -> String {
        format!("ws://{}/{path}", self.address)
    }

    /// Sends `GET PATH`; returns status and body.
    pub fn get(&self, path: &str) -> anyhow::Result<(u16, String)> {
        self.request("GET", path, &[])
    }

    /// Sends `GET PATH`; returns the JSON body.
    pub fn get_json(&self, path: &str) -> anyhow::Result<Value> {
        let (status, body) = self.get(path)?;
        ensure!(status == 200, "GET {path}: {status} {body}");
        Ok(serde_json::from_str(&body)?)
    }

    /// Sends an HTTP/1.1 request without a client library, so that the story controls the headers.
    pub fn request(&self, method: &str, path: &str, headers: &[(&str, &str)]) -> anyhow::Result<(u16, String)> {
        let stream = patience::connect(&self.address)?;
        self.exchange(stream, method, path, headers)
    }

    /// Sends a request with a body; returns status, header lines and body.
    pub fn request_with_body(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &str,
    ) -> anyhow::Result<(u16, String, String)> {
        let mut stream = patience::connect(&self.address)?;
        let given = |usual: &str| headers.iter().any(|(name, _)| name.eq_ignore_ascii_case(usual));
        let host = if given("host") { String::new() } else { format!("Host: {}\r\n", self.address) };
        let mut text = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n{host}");
        for (name, value) in headers {
            text.push_str(&format!("{name}: {value}\r\n"));
        }
        text.push_str(&format!("Content-Length: {}\r\n\r\n{body}", body.len()));
        stream.write_all(text.as_bytes())?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let (head, body) = answer.split_once("\r\n\r\n").context("an HTTP answer")?;
        let status = head.split(' ').nth(1).context("a status line")?.parse()?;
        Ok((status, head.to_owned(), body.to_owned()))
    }

    /// Sends `GET PATH` through the daemon's own socket, where the caller is an operator; returns the JSON body.
    pub fn api(&self, path: &str) -> anyhow::Result<Value> {
        let stream = UnixStream::connect(self.home.join("run/daemon.sock"))?;
        let (status, body) = self.exchange(PatientStream::new(stream)?, "GET", path, &[])?;
        ensure!(status == 200, "GET {path}: {status} {body}");
        Ok(serde_json::from_str(&body)?)
    }

    /// Polls the API until `find` returns a value for a response.
    pub fn wait_for<T>(&self, path: &str, what: &str, mut find: impl FnMut(&Value) -> Option<T>) -> anyhow::Result<T> {
        crate::wait_until(what, || {
            let answer = self.api(path)?;
            Ok(find(&answer).ok_or_else(|| format!("{answer:#}")))
        })
    }

    /// Waits for an event among the last 10000.
    pub fn wait_for_event(&self, what: &str, is: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
        self.wait_for("/api/v1/events?limit=10000", what, |events| {
            events.as_array()?.iter().find(|event| is(event)).cloned()
        })
    }

    fn exchange(
        &self,
        mut stream: impl Read + Write,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
    ) -> anyhow::Result<(u16, String)> {
        let mut text = format!("{method} {path} HTTP/1.1\r\n");
        for (usual, value) in [("Connection", "close"), ("Host", &self.address)] {
            let given = |(name, _): &(&str, &str)| name.eq_ignore_ascii_case(usual);
            if !headers.iter().any(given) {
                text.push_str(&format!("{usual}: {value}\r\n"));
            }
        }
        for (name, value) in headers {
            text.push_str(&format!("{name}: {value}\r\n"));
        }
        text.push_str("\r\n");
        stream.write_all(text.as_bytes())?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        // Chunks of a body may split characters, and an archive is not text.
        let head = answer.windows(4).position(|end| end == b"\r\n\r\n");
        let (head, body) = answer.split_at(head.context("an HTTP answer")?);
        let (head, body) = (String::from_utf8_lossy(head), &body[4..]);
        let status = head.split(' ').nth(1).context("a status line")?.parse()?;
        let body = if head.to_ascii_lowercase().contains("transfer-encoding: chunked") {
            dechunk(body)
        } else {
            body.to_owned()
        };
        Ok((status, String::from_utf8_lossy(&body).into_owned()))
    }

    /// Returns the servants of a service, from the API.
    pub fn servants_of(&self, service: &str) -> anyhow::Result<Vec<Value>> {
        let all = self.api("/api/v1/servants")?;
        let list = all.as_array().context("servants is a list")?;
        Ok(list.iter().filter(|servant| servant["service"] == service).cloned().collect())
    }

    /// Returns the servant of a robot.
    pub fn servant_of(&self, service: &str, robot: &str) -> anyhow::Result<Value> {
        self.servants_of(service)?
            .into_iter()
            .find(|servant| servant["robot"] == robot)
            .with_context(|| format!("{robot} has no servant of {service}"))
    }

    /// Returns the last lines of its log.
    pub fn log_tail(&self) -> String {
        let log = read_log(&self.home);
        let lines: Vec<&str> = log.lines().collect();
        lines[lines.len().saturating_sub(30)..].join("\n")
    }

    /// Returns its pid; 0 if another process started it.
    pub fn pid(&self) -> i32 {
        self.child.as_ref().map_or(0, |child| child.id() as i32)
    }

    /// Stops it with SIGTERM and waits.
    pub fn stop(mut self) -> anyhow::Result<ExitStatus> {
        let mut child = self.child.take().context("started by another")?;
        kill(Pid::from_raw(child.id() as i32), Signal::SIGTERM)?;
        Ok(child.wait()?)
    }

    /// Kills it with SIGKILL and waits.
    pub fn kill(mut self) -> anyhow::Result<()> {
        let mut child = self.child.take().context("started by another")?;
        child.kill()?;
        child.wait()?;
        Ok(())
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child
            && let Ok(None) = child.try_wait()
        {
            let _ = kill(Pid::from_raw(child.id() as i32), Signal::SIGTERM);
            let _ = child.wait();
        }
    }
}

fn address_in(status: &Value) -> anyhow::Result<String> {
    let address = status["listen"].as_str();
    Ok(address.context("status says where it listens")?.to_owned())
}

fn dechunk(mut body: &[u8]) -> Vec<u8> {
    let mut whole = Vec::new();
    while let Some(end) = body.windows(2).position(|end| end == b"\r\n") {
        let size = std::str::from_utf8(&body[..end]).unwrap_or_default();
        let rest = &body[end + 2..];
        let Ok(size) = usize::from_str_radix(size.trim(), 16) else {
            break;
        };
        if size == 0 || rest.len() < size {
            break;
        }
        whole.extend_from_slice(&rest[..size]);
        body = rest[size..].strip_prefix(b"\r\n").unwrap_or_default();
    }
    whole
}
