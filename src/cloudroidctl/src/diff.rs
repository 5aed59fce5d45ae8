//! `diff`: two revisions side by side.

use api::differences::{Difference, Differences};

use crate::client::{Client, escaped};
use crate::output::{self, Format, Table};

/// Show what differs between two revisions of a service: interface, nodes, parameters, limits, packages of the image.
#[derive(Debug, clap::Args)]
pub struct Diff {
    /// The service.
    service: String,
    /// The revision to compare with; the one before the other by default.
    from: Option<u64>,
    /// The revision to compare; the current one by default.
    to: Option<u64>,
}

impl Diff {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let asked = [("from", self.from), ("to", self.to)];
        let asked = asked.iter();
        let query: Vec<String> = asked
            .filter_map(|(name, number)| Some(format!("{name}={}", (*number)?)))
            .collect();
        let path = format!(
            "/api/v1/services/{}/differences?{}",
            escaped(&self.service),
            query.join("&")
        );
        let found: Differences = client.get(&path).await?;
        match format {
            Format::Json => output::json(&found),
            Format::Table => show(&found),
        }
    }
}

fn show(found: &Differences) -> anyhow::Result<()> {
    let Differences {
        service, from, to, ..
    } = found;
    if found.differences.is_empty() {
        return output::line(&format!(
            "nothing that is recorded differs between revisions {from} and {to} of {service}"
        ));
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
        // Text that is not told, such as a definition's, may differ where what is told of it does not.
        Some(after) if of.before.as_ref() == Some(after) => format!("{after}, changed"),
        _ => side(&of.after),
    };
    [part, of.name.clone(), side(&of.before), after]
}
