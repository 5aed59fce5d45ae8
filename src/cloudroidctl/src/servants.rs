//! `servants`: lists servants and their robots.

use api::{BackOff, Pressure, ResponseTimes, Servant, Size};

use crate::client::DaemonClient;
use crate::output::{self, OutputChoice, OutputFormat, Table, count};

/// List the servants: the running containers, each for one robot.
#[derive(Debug, clap::Args)]
pub struct ServantsArgs {
    /// Only servants of this service.
    service: Option<String>,
}

impl ServantsArgs {
    /// Sends the requests and prints the servants.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let mut servants: Vec<Servant> = client.get("/api/v1/servants").await?;
        servants.retain(|servant| self.service.as_ref().is_none_or(|service| *service == servant.service));
        if format == OutputFormat::Json {
            return output::json(&servants);
        }
        let mut failing: Vec<BackOff> = client.get("/api/v1/back-offs").await?;
        failing.retain(|one| self.service.as_ref().is_none_or(|it| *it == one.service));
        let headings = [
            "SERVANT",
            "SERVICE",
            "ROBOT",
            "STATE",
            "AGE",
            "CONNECTIONS",
            "MEMORY",
            "CPU",
            "THROTTLED",
            "PRESSURE",
            "RESPONSE",
            "LIMITS",
            "REQUESTED",
        ];
        let mut table =
            Table::new(&headings).hide_unless_wide(&["CONNECTIONS", "THROTTLED", "PRESSURE", "LIMITS", "REQUESTED"]);
        for servant in &servants {
            let usage = servant.usage.as_ref();
            table.row([
                servant.id.clone(),
                format!("{}:{}", servant.service, servant.revision),
                servant.robot.clone(),
                state(servant),
                output::age(servant.created),
                servant.connections.to_string(),
                usage.map(|usage| Size(usage.memory).to_string()).unwrap_or_default(),
                usage.map(|usage| format!("{:.1} s", usage.cpu_usec as f64 / 1e6)).unwrap_or_default(),
                usage.map(|usage| format!("{:.1} s", usage.throttled_usec as f64 / 1e6)).unwrap_or_default(),
                usage.map(|usage| usage.pressure.map_or("unknown".to_owned(), pressure)).unwrap_or_default(),
                servant.response.map(response).unwrap_or_default(),
                output::limits(servant.enforced.as_ref().unwrap_or(&servant.limits)),
                output::terms(servant),
            ]);
        }
        if failing.is_empty() || !servants.is_empty() {
            table.print_list("no servants (instances); one starts when a robot connects to a service")?;
        }
        for one in failing.iter().filter(|_| OutputChoice::current() != OutputChoice::Name) {
            output::line(&format!(
                "{}:{} for {} has failed {} in a row (last: {}); next start in {}",
                one.service,
                one.revision,
                one.robot,
                count(one.failures, "time"),
                one.reason,
                output::time_until(one.again),
            ))?;
        }
        Ok(())
    }
}

/// Formats the median and the 95th percentile of the response times of the last seconds.
fn response(times: ResponseTimes) -> String {
    format!("p50 {:.0}, p95 {:.0} ms", times.p50_ms, times.p95_ms)
}

/// Formats the resources that a servant waits for.
fn pressure(of: Pressure) -> String {
    let waits: Vec<String> = [("cpu", of.cpu), ("memory", of.memory), ("io", of.io)]
        .into_iter()
        .filter(|(_, percent)| *percent >= 1.0)
        .map(|(what, percent)| format!("{what} {percent:.0} %"))
        .collect();
    if waits.is_empty() {
        return "none".to_owned();
    }
    waits.join(", ")
}

fn state(servant: &Servant) -> String {
    let down: Vec<String> = servant
        .down
        .iter()
        .map(|down| {
            format!(
                "{} failed {} in a row, next start in {}",
                down.node,
                count(down.failures, "time"),
                output::time_until(down.again)
            )
        })
        .collect();
    let stages = servant.lifecycle.iter();
    let idle = stages.filter(|stage| stage.state != "active");
    let idle = idle.map(|stage| match &stage.refused {
        Some(refused) => refused.clone(),
        None => format!("{} is {}", stage.node, stage.state),
    });
    let down = down.into_iter().chain(servant.hung.clone());
    let down: Vec<String> = down.chain(idle).collect();
    match &servant.reason {
        Some(reason) => format!("{}: {reason}", servant.phase),
        None if !down.is_empty() => format!("{}: {}", servant.phase, down.join(", ")),
        None if servant.idle_until.is_some() => format!("{} (idle)", servant.phase),
        None => servant.phase.to_string(),
    }
}
