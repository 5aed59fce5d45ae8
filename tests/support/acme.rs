//! An ACME server (RFC 8555): Pebble, with which Let's Encrypt tests clients, and a DNS in which every name resolves to
//! this machine.

use std::net::TcpStream;
use std::process::{Child, Command, Stdio};

use anyhow::Context;
use serde_json::json;

use crate::deployer::run;
use crate::machine::free_port;
use crate::tls::make_certificates;
use crate::world::{self, world};

/// Address and certificates of an ACME server, whether or not it is running.
pub struct AcmeDirectory {
    place: world::Directory,
    port: u16,
    management: u16,
}

/// A running ACME server. Each has a key of its own, and does not know the accounts of another.
pub struct PebbleServer {
    directory: u16,
    place: std::path::PathBuf,
    running: Vec<Child>,
}

impl AcmeDirectory {
    /// Creates an address at which no server runs yet.
    pub fn new() -> anyhow::Result<AcmeDirectory> {
        let place = world().directory("acme")?;
        make_certificates(place.path())?;
        Ok(AcmeDirectory { place, port: free_port()?, management: free_port()? })
    }

    /// Returns the URL of the ACME directory.
    pub fn url(&self) -> String {
        format!("https://localhost:{}/dir", self.port)
    }

    /// Returns the `[tls.acme]` section of a daemon that requests a certificate for `name`.
    pub fn section(&self, name: &str) -> String {
        format!(
            "[tls.acme]\nnames = [{name:?}]\naccept_terms = true\ndirectory = {:?}\nauthorities = {:?}\nretry \
             = \"1s\"\n",
            self.url(),
            self.place.path().join("ca.pem")
        )
    }

    /// Starts a server that issues certificates valid for `seconds`, and validates names at port `looked_at`.
    pub fn start(&self, looked_at: u16, seconds: u64) -> anyhow::Result<PebbleServer> {
        let place = self.place.path();
        let config = json!({"pebble": {
            "listenAddress": format!("127.0.0.1:{}", self.port),
            "managementListenAddress": format!("127.0.0.1:{}", self.management),
            "certificate": place.join("server.pem"),
            "privateKey": place.join("server.key"),
            "httpPort": 1,
            "tlsPort": looked_at,
            "ocspResponderURL": "",
            "externalAccountBindingRequired": false,
            "certificateValidityPeriod": seconds,
        }});
        let file = place.join("pebble.json");
        std::fs::write(&file, config.to_string())?;
        let names = free_port()?;
        // They end with the thread of the story, however that ends: the run's disk goes with its last process.
        let start = |program: &str, arguments: &[&str]| -> anyhow::Result<Child> {
            let log = std::fs::File::options().create(true).append(true).open(place.join("log"))?;
            let child = Command::new("setpriv")
                .args(["--pdeathsig", "KILL", program])
                .args(arguments)
                .env("PEBBLE_VA_NOSLEEP", "1")
                .stdin(Stdio::null())
                .stdout(log.try_clone()?)
                .stderr(log)
                .spawn();
            child.context("cannot start setpriv of util-linux")
        };
        let mut authority = PebbleServer { directory: self.port, place: place.to_owned(), running: Vec::new() };
        let (dns, control) = (format!("127.0.0.1:{names}"), format!("127.0.0.1:{}", free_port()?));
        let off = ["-defaultIPv6", "", "-http01", "", "-https01", "", "-tlsalpn01", ""];
        let resolver = [&off[..], &["-dns01", &dns, "-management", &control]].concat();
        authority.running.push(start("pebble-challtestsrv", &resolver)?);
        let config = file.to_str().context("a path in UTF-8")?;
        authority.running.push(start("pebble", &["-config", config, "-strict", "-dnsserver", &dns])?);
        authority.wait_until_ready()?;
        let root = run(Command::new("curl")
            .args(["--silent", "--show-error", "--fail", "--cacert"])
            .arg(place.join("ca.pem"))
            .arg("--output")
            .arg(place.join("root.pem"))
            .arg(format!("https://localhost:{}/roots/0", self.management)))?;
        root.expect_success()?;
        Ok(authority)
    }
}

impl PebbleServer {
    /// Waits until it listens.
    fn wait_until_ready(&mut self) -> anyhow::Result<()> {
        crate::wait_until("Pebble that listens", || {
            let reached = TcpStream::connect(("127.0.0.1", self.directory));
            for child in &mut self.running {
                if let Some(status) = child.try_wait()? {
                    let log = std::fs::read_to_string(self.place.join("log"))?;
                    anyhow::bail!("Pebble (Debian package pebble) ended with {status}:\n{log}");
                }
            }
            Ok(reached.map(drop).map_err(|error| error.to_string()))
        })
    }

    /// Returns its processes, which nobody ends any more.
    pub fn into_processes(mut self) -> Vec<Child> {
        std::mem::take(&mut self.running)
    }

    /// Returns the root certificate of the issued certificates.
    pub fn root(&self) -> std::path::PathBuf {
        self.place.join("root.pem")
    }
}

impl Drop for PebbleServer {
    fn drop(&mut self) {
        for child in &mut self.running {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
