//! An authority that is asked by ACME (RFC 8555): Pebble, which Let's Encrypt tests clients with, and a DNS in which every name leads to
//! this machine.

use std::net::TcpStream;
use std::process::{Child, Command, Stdio};

use anyhow::Context;
use serde_json::json;

use crate::deployer::run;
use crate::machine::free_port;
use crate::tls::make_certificates;
use crate::world::{self, world};

/// Where the authority is asked, whoever runs there.
pub struct Directory {
    place: world::Directory,
    port: u16,
    management: u16,
}

/// The authority at work. Each has a key of its own, and knows no account of another.
pub struct Authority {
    directory: u16,
    place: std::path::PathBuf,
    running: Vec<Child>,
}

impl Directory {
    /// A place for one, where nobody answers yet.
    pub fn new() -> anyhow::Result<Directory> {
        let place = world().directory("acme")?;
        make_certificates(place.path())?;
        Ok(Directory {
            place,
            port: free_port()?,
            management: free_port()?,
        })
    }

    /// Its address.
    pub fn url(&self) -> String {
        format!("https://localhost:{}/dir", self.port)
    }

    /// `[tls.acme]` of a daemon that asks it for a certificate of `name`.
    pub fn section(&self, name: &str) -> String {
        format!(
            "[tls.acme]\nnames = [{name:?}]\naccept_terms = true\ndirectory = {:?}\nauthorities = {:?}\nretry = \"1s\"\n",
            self.url(),
            self.place.path().join("ca.pem")
        )
    }

    /// Starts one whose certificates are good for `seconds`, and which looks at `looked_at` whether a name leads here.
    pub fn opens(&self, looked_at: u16, seconds: u64) -> anyhow::Result<Authority> {
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
        let quiet = |command: &mut Command| -> anyhow::Result<Child> {
            let log = std::fs::File::options()
                .create(true)
                .append(true)
                .open(place.join("log"))?;
            let child = command
                .stdin(Stdio::null())
                .stdout(log.try_clone()?)
                .stderr(log)
                .spawn();
            child.context("cannot start Pebble; the Debian package is pebble")
        };
        let mut authority = Authority {
            directory: self.port,
            place: place.to_owned(),
            running: Vec::new(),
        };
        authority.running.push(quiet(
            Command::new("pebble-challtestsrv")
                .args(["-defaultIPv6", "", "-http01", "", "-https01", ""])
                .args(["-tlsalpn01", "", "-dns01", &format!("127.0.0.1:{names}")])
                .args(["-management", &format!("127.0.0.1:{}", free_port()?)]),
        )?);
        authority.running.push(quiet(
            Command::new("pebble")
                .env("PEBBLE_VA_NOSLEEP", "1")
                .arg("-config")
                .arg(&file)
                .args(["-strict", "-dnsserver", &format!("127.0.0.1:{names}")]),
        )?);
        authority.is_reached()?;
        let root = run(Command::new("curl")
            .args(["--silent", "--show-error", "--fail", "--cacert"])
            .arg(place.join("ca.pem"))
            .arg("--output")
            .arg(place.join("root.pem"))
            .arg(format!("https://localhost:{}/roots/0", self.management)))?;
        root.succeeded()?;
        Ok(authority)
    }
}

impl Authority {
    /// Waits until it listens.
    fn is_reached(&mut self) -> anyhow::Result<()> {
        crate::until("Pebble that listens", || {
            let reached = TcpStream::connect(("127.0.0.1", self.directory));
            for child in &mut self.running {
                if let Some(status) = child.try_wait()? {
                    let log = std::fs::read_to_string(self.place.join("log"))?;
                    anyhow::bail!("Pebble ended with {status}:\n{log}");
                }
            }
            Ok(reached.map(drop).map_err(|error| error.to_string()))
        })
    }

    /// The certificate by which those are known that it has signed.
    pub fn root(&self) -> std::path::PathBuf {
        self.place.join("root.pem")
    }
}

impl Drop for Authority {
    fn drop(&mut self) {
        for child in &mut self.running {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
