//! `explain`: shows why a robot is slow or served by its local original.

use api::explain::{Explanation, Link, Served, Weight};

use crate::client::{DaemonClient, percent_encode};
use crate::colour::Colour;
use crate::output::{self, OutputFormat, Table, count};

/// Explain why a robot is slow or served by its local original.
#[derive(Debug, clap::Args)]
pub struct ExplainArgs {
    /// Id of the robot.
    robot: String,
}

impl ExplainArgs {
    /// Sends the request and prints the explanation.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/robots/{}/explain", percent_encode(&self.robot));
        let explanation: Explanation = client.get(&path).await?;
        match format {
            OutputFormat::Json => output::json(&explanation),
            OutputFormat::Table => print(&explanation),
        }
    }
}

fn print(explanation: &Explanation) -> anyhow::Result<()> {
    if explanation.causes.is_empty() {
        output::line(&format!("{}: nothing is wrong", explanation.robot))?;
    }
    for cause in &explanation.causes {
        let mark = match cause.weight {
            Weight::Blocks => "BLOCKS",
            Weight::Slows => "slows ",
            Weight::Hint => "hint  ",
        };
        let colour = match cause.weight {
            Weight::Blocks => Some(Colour::Red),
            Weight::Slows => Some(Colour::Yellow),
            Weight::Hint => None,
        };
        output::line(&format!("{}  {}\n        {}", output::colour_text(mark, colour), cause.what, cause.next))?;
    }
    for served in &explanation.servants {
        print_servant(served)?;
    }
    if !explanation.events.is_empty() {
        output::line("\nlately")?;
    }
    for event in &explanation.events {
        output::line(&format!("  {}  {}", output::clock(event.time), event.message))?;
    }
    Ok(())
}

fn print_servant(served: &Served) -> anyhow::Result<()> {
    let servant = &served.servant;
    output::line(&format!(
        "\n{} of {} (revision {}): {}, {}, {:.2} cores used, throttled {:.0} % of the time, limits {}",
        servant.id,
        servant.service,
        servant.revision,
        servant.phase,
        count(servant.connections, "connection"),
        served.cores,
        served.throttled * 100.0,
        output::limits(&servant.enforced.unwrap_or(servant.limits)),
    ))?;
    if let Some(terms) = &servant.terms {
        output::line(&format!("  stated: {}", output::terms(servant)))?;
        for why in &terms.why {
            output::line(&format!("  {why}"))?;
        }
    }
    served.links.iter().try_for_each(print_link)
}

/// Returns the robot's SLA in words.
fn promise_in_words(link: &Link) -> String {
    let millis = |time: Option<f64>| time.map_or("-".to_owned(), |time| format!("{time:.1} ms"));
    let threshold = link.threshold.map_or_else(String::new, |threshold| format!(", Q_t {threshold:.1}"));
    if let Some(after) = link.fallback_after {
        let after = after / 1000.0;
        return format!("no response time set, fallback {after:.1} s after the link is lost");
    }
    match (link.frames_per_second, link.age) {
        (Some(rate), _) => {
            let desired = link.desired_frames_per_second;
            let desired = desired.map_or_else(String::new, |rate| format!(", {rate} desired"));
            format!("at least {rate} frames per second{desired}{threshold}")
        }
        (None, Some(_)) => {
            let desired = link.desired_age.map(|_| millis(link.desired_age));
            let desired = desired.map_or_else(String::new, |age| format!(", {age} desired"));
            format!("at most {} old{desired}{threshold}", millis(link.age))
        }
        (None, None) => format!("T_desire {}, T_max {}{threshold}", millis(link.desire), millis(link.max)),
    }
}

fn print_link(link: &Link) -> anyhow::Result<()> {
    let millis = |time: Option<f64>| time.map_or("-".to_owned(), |time| format!("{time:.1} ms"));
    output::line(&format!(
        "  {}: link {}, round trip {}, clock {}, {}, Q {}; of {} {} late, {} answered locally",
        link.node,
        if link.up { "up" } else { "DOWN" },
        millis(link.round_trip),
        millis(link.clock),
        promise_in_words(link),
        link.satisfaction.map_or("-".to_owned(), |q| format!("{q:.1}")),
        count(link.requests, "request"),
        link.late,
        link.local,
    ))?;
    if let Some(trace) = &link.trace {
        output::line(&format!("    trace {trace}"))?;
    }
    let mut table = Table::new(&["    PART", "P50", "P90", "MAX"]);
    for part in &link.phases {
        table.row([
            format!("    {}", part.name),
            format!("{:.1} ms", part.p50),
            format!("{:.1} ms", part.p90),
            format!("{:.1} ms", part.max),
        ]);
    }
    if table.is_empty() {
        return Ok(());
    }
    table.print()
}
