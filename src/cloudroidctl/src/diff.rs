//! `diff`: compares two revisions.

use api::differences::{Difference, Differences};

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table};

/// Show the differences between two revisions of a service: interface, nodes, parameters, limits, packages of the
/// image.
#[derive(Debug, clap::Args)]
pub struct DiffArgs {
    /// Service whose revisions are compared.
    service: String,
    /// Revision to compare with (default: after a rollback, the one that was rolled back; otherwise the one before TO).
    from: Option<u64>,
    /// Revision to compare (default: the current one).
    to: Option<u64>,
}

impl DiffArgs {
    /// Sends the request and prints the differences.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let asked = [("from", self.from), ("to", self.to)];
        let asked = asked.iter();
        let query: Vec<String> = asked.filter_map(|(name, number)| Some(format!("{name}={}", (*number)?))).collect();
        let path = format!("/api/v1/services/{}/differences?{}", percent_encode(&self.service), query.join("&"));
        let found: Differences = client.get(&path).await?;
        match format {
            OutputFormat::Json => output::json(&found),
            OutputFormat::Table => show(&found),
        }
    }
}

fn show(found: &Differences) -> anyhow::Result<()> {
    let Differences { service, from, to, .. } = found;
    if found.differences.is_empty() {
        return output::line(&format!("no recorded differences between revisions {from} and {to} of {service}"));
    }
    let (before, after) = (format!("REVISION {from}"), format!("REVISION {to}"));
    let mut table = Table::new(&["PART", "NAME", &before, &after]);
    for one in &found.differences {
        table.row(cells(one));
    }
    table.print()
}

fn cells(of: &Difference) -> [String; 4] {
    let part = serde_json::to_value(of.part).unwrap_or_default();
    let part = part.as_str().unwrap_or_default().to_owned();
    let side = |side: &Option<String>| side.clone().unwrap_or_else(|| "-".to_owned());
    let after = match &of.after {
        // Some texts, such as definitions, are summarized: the summaries may be equal although the texts differ.
        Some(after) if of.before.as_ref() == Some(after) => format!("{after}, changed"),
        _ => side(&of.after),
    };
    [part, of.name.clone(), side(&of.before), after]
}
