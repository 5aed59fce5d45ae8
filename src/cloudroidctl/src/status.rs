//! `status`: the daemon at a glance.

use api::{Pressure, Size};

use crate::client::Client;
use crate::output::{self, Format};
use crate::wait::WaitFlag;

/// Show the daemon: where it listens, what it holds, what does not work as it should. With --wait, once it answers.
#[derive(Debug, clap::Args)]
pub struct Status {
    #[command(flatten)]
    wait: WaitFlag,
}

impl Status {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let look = || async { client.get::<api::Status>("/api/v1/status").await.map(Ok) };
        let status = self.wait.until(look).await?;
        match format {
            Format::Json => output::json(&status),
            Format::Table => show(&status),
        }
    }
}

/// Where it listens, and what it shows there.
fn address(status: &api::Status) -> String {
    match &status.certificate {
        Some(fingerprint) => format!("https://{}, certificate {fingerprint}", status.listen),
        None => format!("http://{}", status.listen),
    }
}

fn show(status: &api::Status) -> anyhow::Result<()> {
    let room = &status.capacity;
    let isolation = match status.isolation.cgroup_version {
        0 => format!("{}, no limits can be set", status.isolation.mode),
        version => format!("{}, cgroup v{version}", status.isolation.mode),
    };
    let rows = [
        (
            "daemon",
            format!(
                "{} (pid {}), up {}",
                status.version,
                status.pid,
                output::age(status.started)
            ),
        ),
        ("address", address(status)),
        ("home", status.home.clone()),
        (
            "default service",
            status
                .default_service
                .clone()
                .unwrap_or_else(|| "none".to_owned()),
        ),
        ("services", status.services.to_string()),
        (
            "servants",
            format!(
                "{} with {} connections; {} warm containers, {} of them with nodes",
                status.servants, status.connections, status.warm_pool, status.warm_nodes
            ),
        ),
        (
            "used by servants",
            format!(
                "{} of memory, {:.1} s of processor time, {:.1} s throttled",
                Size(status.usage.memory),
                status.usage.cpu_usec as f64 / 1e6,
                status.usage.throttled_usec as f64 / 1e6
            ),
        ),
        ("machine waits for", pressure(status.usage.pressure)),
        ("isolation", isolation),
        ("limits of a servant", output::limits(&status.limits)),
        (
            "promised",
            format!(
                "{} of {} cpus, {} of {}; {} waiting",
                room.cpus_reserved,
                room.cpus,
                Size(room.memory_reserved),
                Size(room.memory),
                room.waiting
            ),
        ),
    ];
    for (name, value) in rows {
        output::line(&format!("{name:<20} {value}"))?;
    }
    for warning in &status.warnings {
        output::line(&format!("{:<20} {warning}", "warning"))?;
    }
    Ok(())
}

fn pressure(of: Option<Pressure>) -> String {
    of.map_or_else(
        || "unknown: its kernel does not tell (PSI)".to_owned(),
        |of| {
            format!(
                "cpu {:.0} %, memory {:.0} %, io {:.0} % of the last 10 s",
                of.cpu, of.memory, of.io
            )
        },
    )
}
