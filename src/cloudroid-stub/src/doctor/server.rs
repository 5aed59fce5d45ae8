//! Checks of the server: whether it is reachable, knows the token and the service, has a synchronized clock, and can
//! send large responses.

use std::time::{Duration, UNIX_EPOCH};

use serde_json::Value;

use super::check::Check;
use super::overlay::ExaminedStub;
use crate::config::Config;
use crate::http;
use crate::resolver;

/// Number of requests for the clock; the one with the shortest round trip is used.
const SAMPLES: usize = 5;
/// Clock difference in seconds that is worth fixing. Stamps are corrected on the link, but people compare logs of both
/// sides.
const IN_STEP: f64 = 0.1;

/// Runs all checks of the server. If it is unreachable, there is only one.
pub async fn checks(config: &Config, stub: &ExaminedStub) -> Vec<Check> {
    let portal = match PortalProbe::find(config, stub).await {
        Ok(portal) => portal,
        Err(check) => return vec![*check],
    };
    let reached = match portal.get("/healthz").await {
        Ok(answer) if answer.status == 200 => {
            Check::good("server", format!("{} answers in {:.1} ms", config.server, millis(answer.waited)))
        }
        Ok(answer) => {
            let found = format!("{} answers with status {}", config.server, answer.status);
            return vec![Check::bad("server", found, portal.other_server())];
        }
        Err(error) => {
            let found = format!("{} cannot be reached: {error}", config.server);
            return vec![Check::bad("server", found, portal.other_server())];
        }
    };
    let mut checks = vec![reached, portal.service(config, stub).await];
    checks.push(portal.clock().await);
    checks.push(portal.mtu().await);
    checks
}

struct PortalProbe {
    server: http::HttpServer,
    token: Option<String>,
    installer: String,
}

impl PortalProbe {
    async fn find(config: &Config, stub: &ExaminedStub) -> Result<PortalProbe, Box<Check>> {
        let installer = stub.installer();
        let fix = format!("{installer} --server ws://HOST:9090");
        let bad = |found: String, fix: String| Box::new(Check::bad("server", found, fix));
        let address = match config.address() {
            Ok(address) => address,
            Err(error) => return Err(bad(error.to_string(), fix)),
        };
        let token = config.token().map_err(|error| {
            let fix = format!("{installer} --token TOKEN");
            Box::new(Check::bad("token", format!("{error:#}"), fix))
        })?;
        let trust = config.trust().map_err(|error| {
            let fix = format!("{installer} --pair 'LINE'");
            Box::new(Check::bad("pairing", format!("{error:#}"), fix))
        })?;
        // A paired robot presents its certificate instead.
        let token = token.filter(|token| !token.is_empty() && trust.identity.is_none());
        match resolver::resolve(&address.host).await {
            Ok(ip) => Ok(PortalProbe { server: http::HttpServer { address, ip, trust, only: None }, token, installer }),
            Err(error) => Err(bad(format!("{} is not found: {error}", address.host), fix)),
        }
    }

    async fn get(&self, path: &str) -> std::io::Result<http::HttpAnswer> {
        http::get(&self.server, path, self.token.as_deref()).await
    }

    /// Returns a URL for people.
    fn url(&self, path: &str) -> String {
        let scheme = if self.server.address.secure { "https" } else { "http" };
        format!("{scheme}://{}{path}", self.server.address.authority)
    }

    fn other_server(&self) -> String {
        format!("{} --server ws://HOST:9090", self.installer)
    }

    /// Checks the token and the service, by requesting the service with the token.
    async fn service(&self, config: &Config, stub: &ExaminedStub) -> Check {
        let name = &config.service;
        let answer = match self.get(&format!("/api/v1/services/{name}")).await {
            Ok(answer) => answer,
            Err(error) => return Check::bad("service", error.to_string(), self.other_server()),
        };
        let body: Value = serde_json::from_slice(&answer.body).unwrap_or_default();
        let words = body["detail"].as_str().unwrap_or_default();
        match answer.status {
            200 => {}
            401 if self.server.trust.identity.is_some() => {
                let fix = format!("{} --pair 'LINE' of cloudroidctl pair", self.installer);
                return Check::bad("pairing", words, fix);
            }
            401 | 403 => {
                let given = match self.token {
                    Some(_) => "the token is refused",
                    None => "the server requires a token",
                };
                let fix = format!("{} --token TOKEN", self.installer);
                return Check::bad("token", format!("{given}: {words}"), fix);
            }
            404 => {
                let fix = "have it pushed there (cloudroidctl push), or correct service in stub.toml";
                return Check::bad("service", words, fix);
            }
            status => {
                let found = format!("status {status}: {words}");
                return Check::bad("service", found, "see the daemon's log on the server");
            }
        }
        let there = body["revision"].as_u64();
        let made_of = stub.revision();
        match (there, made_of.revision) {
            (Some(there), Some(here)) if there != here => Check::warning(
                "service",
                format!("{name} is at revision {there}, but this stub was made from revision {here}"),
                format!(
                    "download it again: {}",
                    self.url(&format!("/stubs/{name}.tar.gz?ros={}", made_of.ros().number()))
                ),
            ),
            _ => {
                let by = match self.server.trust.identity {
                    Some(_) => format!("this robot is paired as {}", config.robot_id()),
                    None => "the token is valid".to_owned(),
                };
                Check::good("service", format!("{name} is published, {by}"))
            }
        }
    }

    /// Compares the clocks; the uncertainty is half of the round trip.
    async fn clock(&self) -> Check {
        let mut best: Option<(Duration, f64)> = None;
        for _ in 0..SAMPLES {
            let Ok(answer) = self.get("/api/v1/clock").await else {
                continue;
            };
            let since = answer.arrived.duration_since(UNIX_EPOCH);
            let here = since.map_or(0.0, |since| since.as_secs_f64());
            let here = here - answer.waited.as_secs_f64() / 2.0;
            let body: Value = serde_json::from_slice(&answer.body).unwrap_or_default();
            let Some(there) = body["now"].as_f64() else {
                continue;
            };
            if best.is_none_or(|(waited, _)| answer.waited < waited) {
                best = Some((answer.waited, there / 1000.0 - here));
            }
        }
        let Some((waited, ahead)) = best else {
            return Check::warning(
                "clock",
                "the server does not report its time",
                "update the server to this stub's version",
            );
        };
        let unsure = waited.as_secs_f64() / 2.0;
        let found = format!(
            "the server's clock is {:.1} ms {} (±{:.1} ms)",
            ahead.abs() * 1000.0,
            if ahead < 0.0 { "behind" } else { "ahead" },
            unsure * 1000.0
        );
        if ahead.abs() > IN_STEP + unsure {
            Check::warning("clock", found, "sudo apt install chrony, on the robot and on the server")
        } else {
            Check::good("clock", found)
        }
    }

    /// Checks that large responses arrive: if packets of the link's MTU are lost on the way, small responses arrive and
    /// large ones never do.
    async fn mtu(&self) -> Check {
        match self.get("/api/v1/openapi.json").await {
            Ok(answer) => {
                let mtu = answer.mtu.map_or_else(|| "not known".to_owned(), |mtu| format!("{mtu} bytes"));
                let found = format!("{mtu}; received a response of {} bytes", answer.body.len());
                Check::good("mtu", found)
            }
            Err(error) => Check::bad(
                "mtu",
                format!("small responses arrive, but a large one does not: {error}"),
                "sudo ip link set dev INTERFACE mtu 1280",
            ),
        }
    }
}

fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1000.0
}
