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
use crate::patience::{self, Patient};
use crate::robot::Robot;

/// A running `cloudroidd`.
pub struct Daemon {
    /// Its state directory.
    pub home: PathBuf,
    /// Where it listens, such as `127.0.0.1:40123`.
    pub address: String,
    /// None where another has started it, such as systemd.
    child: Option<Child>,
    _space: Option<Arc<Space>>,
}

/// What a home takes on the disk. Some hundred megabytes each: all of a run together are more than many machines have free.
#[derive(Debug)]
struct Space(PathBuf);

impl Drop for Space {
    fn drop(&mut self) {
        for heavy in ["layers", "images"] {
            let _ = std::fs::remove_dir_all(self.0.join(heavy));
        }
    }
}

/// How to start one. Images are kept for as long as this, or a daemon that it has started, is there.
#[derive(Debug, Clone)]
pub struct Setup {
    space: Arc<Space>,
    home: PathBuf,
    config: String,
    listen: String,
    environment: Vec<(String, String)>,
}

impl Setup {
    /// A daemon with its state in `home`, on a free port of loopback.
    pub fn new(home: &Path) -> Setup {
        Setup {
            space: Arc::new(Space(home.to_owned())),
            home: home.to_owned(),
            config: String::new(),
            listen: "127.0.0.1:0".to_owned(),
            environment: Vec::new(),
        }
    }

    /// With these lines of configuration.
    pub fn config(mut self, toml: &str) -> Setup {
        self.config.push_str(toml);
        self
    }

    /// Listening there.
    pub fn listen(mut self, address: &str) -> Setup {
        self.listen = address.to_owned();
        self
    }

    /// With this variable in its environment.
    pub fn environment(mut self, key: &str, value: &str) -> Setup {
        self.environment.push((key.to_owned(), value.to_owned()));
        self
    }

    /// The state directory.
    pub fn home(&self) -> &Path {
        &self.home
    }

    fn command(&self) -> anyhow::Result<Command> {
        std::fs::create_dir_all(&self.home)?;
        let mut command = Command::new(binaries::path("cloudroidd"));
        command
            .arg("--home")
            .arg(&self.home)
            .args(["--listen", &self.listen]);
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

    /// Starts it and waits until it answers.
    pub fn start(&self) -> anyhow::Result<Daemon> {
        let log = File::options()
            .create(true)
            .append(true)
            .open(self.home.join("daemon.log"))
            .or_else(|_| {
                std::fs::create_dir_all(&self.home)?;
                File::options()
                    .create(true)
                    .append(true)
                    .open(self.home.join("daemon.log"))
            })?;
        let child = self
            .command()?
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()?;
        let mut daemon = Daemon {
            home: self.home.clone(),
            address: "localhost".to_owned(),
            child: Some(child),
            _space: Some(Arc::clone(&self.space)),
        };
        let answers = crate::until("a daemon that answers", || {
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

    /// Starts it where it must refuse, and gives its status and words.
    pub fn refuses_to_start(&self) -> anyhow::Result<String> {
        let output = self
            .command()?
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let output = wait_with_output(output)?;
        let said = format!(
            "{}{}",
            String::from_utf8_lossy(&output.1),
            String::from_utf8_lossy(&output.2)
        );
        ensure!(
            !output.0.success(),
            "cloudroidd started and ended well:\n{said}"
        );
        ensure!(!said.contains("panicked"), "cloudroidd panicked:\n{said}");
        Ok(said)
    }
}

/// Waits for its end, as long as a story waits.
fn wait_with_output(mut child: Child) -> anyhow::Result<(ExitStatus, Vec<u8>, Vec<u8>)> {
    let pid = Pid::from_raw(child.id() as i32);
    let (mut out, mut err) = (
        child.stdout.take().expect("piped"),
        child.stderr.take().expect("piped"),
    );
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
    /// The one that another has started with its state in `home`, once it answers; not the one with the pid `not`.
    pub fn of_another(home: &Path, not: Option<i32>) -> anyhow::Result<Daemon> {
        let mut daemon = Daemon {
            home: home.to_owned(),
            address: "localhost".to_owned(),
            child: None,
            _space: None,
        };
        daemon.address = crate::until("a daemon that answers", || {
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

    /// A deployer at a shell of this machine.
    pub fn deployer(&self) -> Deployer {
        Deployer {
            home: self.home.clone(),
        }
    }

    /// A robot that connects to `path`, such as `opencv_apps?robot=r2`.
    pub fn robot(&self, path: &str) -> anyhow::Result<Robot> {
        Robot::connect(&self.url(path))
            .with_context(|| format!("the daemon said:\n{}", self.last_words()))
    }

    /// The WebSocket address of `path`.
    pub fn url(&self, path: &str) -> String {
        format!("ws://{}/{path}", self.address)
    }

    /// `GET PATH`: status and body.
    pub fn get(&self, path: &str) -> anyhow::Result<(u16, String)> {
        self.request("GET", path, &[])
    }

    /// `GET PATH` of JSON.
    pub fn get_json(&self, path: &str) -> anyhow::Result<Value> {
        let (status, body) = self.get(path)?;
        ensure!(status == 200, "GET {path}: {status} {body}");
        Ok(serde_json::from_str(&body)?)
    }

    /// An HTTP/1.1 request by hand, so that headers are what the story says.
    pub fn request(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
    ) -> anyhow::Result<(u16, String)> {
        let stream = patience::connect(&self.address)?;
        self.exchange(stream, method, path, headers)
    }

    /// The same with a body; also the answer's header lines.
    pub fn sends(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &str,
    ) -> anyhow::Result<(u16, String, String)> {
        let mut stream = patience::connect(&self.address)?;
        let given = |usual: &str| {
            headers
                .iter()
                .any(|(name, _)| name.eq_ignore_ascii_case(usual))
        };
        let host = if given("host") {
            String::new()
        } else {
            format!("Host: {}\r\n", self.address)
        };
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

    /// What the API answers to `GET PATH` over the daemon's own socket, where the caller is its operator.
    pub fn api(&self, path: &str) -> anyhow::Result<Value> {
        let stream = UnixStream::connect(self.home.join("run/daemon.sock"))?;
        let (status, body) = self.exchange(Patient::new(stream)?, "GET", path, &[])?;
        ensure!(status == 200, "GET {path}: {status} {body}");
        Ok(serde_json::from_str(&body)?)
    }

    /// Waits until there is something in what the API answers.
    pub fn awaits<T>(
        &self,
        path: &str,
        what: &str,
        mut find: impl FnMut(&Value) -> Option<T>,
    ) -> anyhow::Result<T> {
        crate::until(what, || {
            let answer = self.api(path)?;
            Ok(find(&answer).ok_or_else(|| format!("{answer:#}")))
        })
    }

    /// Waits for an event among the last 10000.
    pub fn awaits_event(&self, what: &str, is: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
        self.awaits("/api/v1/events?limit=10000", what, |events| {
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
        // Pieces of a body are cut by bytes, and an archive's are no text.
        let head = answer.windows(4).position(|end| end == b"\r\n\r\n");
        let (head, body) = answer.split_at(head.context("an HTTP answer")?);
        let (head, body) = (String::from_utf8_lossy(head), &body[4..]);
        let status = head.split(' ').nth(1).context("a status line")?.parse()?;
        let body = if head
            .to_ascii_lowercase()
            .contains("transfer-encoding: chunked")
        {
            dechunk(body)
        } else {
            body.to_owned()
        };
        Ok((status, String::from_utf8_lossy(&body).into_owned()))
    }

    /// The servants of a service, as the API tells.
    pub fn servants_of(&self, service: &str) -> anyhow::Result<Vec<Value>> {
        let all = self.api("/api/v1/servants")?;
        let list = all.as_array().context("servants is a list")?;
        Ok(list
            .iter()
            .filter(|servant| servant["service"] == service)
            .cloned()
            .collect())
    }

    /// The servant of one robot.
    pub fn servant_of(&self, service: &str, robot: &str) -> anyhow::Result<Value> {
        self.servants_of(service)?
            .into_iter()
            .find(|servant| servant["robot"] == robot)
            .with_context(|| format!("{robot} has no servant of {service}"))
    }

    /// What it printed last.
    pub fn last_words(&self) -> String {
        let log = read_log(&self.home);
        let lines: Vec<&str> = log.lines().collect();
        lines[lines.len().saturating_sub(30)..].join("\n")
    }

    /// Its process id; 0 where another has started it.
    pub fn pid(&self) -> i32 {
        self.child.as_ref().map_or(0, |child| child.id() as i32)
    }

    /// Ends it as an operator would and waits.
    pub fn ends(mut self) -> anyhow::Result<ExitStatus> {
        let mut child = self.child.take().context("started by another")?;
        kill(Pid::from_raw(child.id() as i32), Signal::SIGTERM)?;
        Ok(child.wait()?)
    }

    /// Ends it as a crash would and waits.
    pub fn is_killed(mut self) -> anyhow::Result<()> {
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
