//! `status`: the daemon at a glance.

use api::{Pressure, Size};

use crate::client::DaemonClient;
use crate::output::{self, OutputFormat, count};
use crate::wait::WaitFlag;

/// Show the status of the daemon: its address, its load and its problems. With --wait, waits until it answers.
#[derive(Debug, clap::Args)]
pub struct StatusArgs {
    #[command(flatten)]
    wait: WaitFlag,
}

impl StatusArgs {
    /// Sends the request and prints the status.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let look = || async { client.get::<api::Status>("/api/v1/status").await.map(Ok) };
        let status = self.wait.poll_until(look).await?;
        match format {
            OutputFormat::Json => output::json(&status),
            OutputFormat::Table => show(&status),
        }
    }
}

/// Formats the daemon's address and certificate.
fn address(status: &api::Status) -> String {
    match &status.certificate {
        Some(fingerprint) => format!("https://{}, certificate {fingerprint}", status.listen),
        None => format!("http://{}", status.listen),
    }
}

fn show(status: &api::Status) -> anyhow::Result<()> {
    let room = &status.capacity;
    let isolation = match status.isolation.cgroup_version {
        0 => format!("{}, limits cannot be set", status.isolation.mode),
        version => format!("{}, cgroup v{version}", status.isolation.mode),
    };
    let rows = [
        ("daemon", format!("{} (pid {}), up {}", status.version, status.pid, output::age(status.started))),
        ("address", address(status)),
        ("home", status.home.clone()),
        ("default service", status.default_service.clone().unwrap_or_else(|| "none".to_owned())),
        ("services", status.services.to_string()),
        (
            "servants",
            format!(
                "{} with {}; {}, {} of them with running nodes",
                status.servants,
                count(status.connections, "connection"),
                count(status.warm_pool, "warm container"),
                status.warm_nodes
            ),
        ),
        (
            "used by servants",
            format!(
                "{} of memory, {:.1} s of CPU time, {:.1} s throttled",
                Size(status.usage.memory),
                status.usage.cpu_usec as f64 / 1e6,
                status.usage.throttled_usec as f64 / 1e6
            ),
        ),
        ("stalled (PSI)", pressure(status.usage.pressure)),
        ("isolation", isolation),
        ("limits of a servant", output::limits(&status.limits)),
        (
            "reserved",
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
        || "unknown: its kernel has no PSI".to_owned(),
        |of| format!("cpu {:.0} %, memory {:.0} %, io {:.0} % (last 10 s)", of.cpu, of.memory, of.io),
    )
}
