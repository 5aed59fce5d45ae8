//! `rm`: removes a service.

use anyhow::bail;
use api::{ServiceDetail, Stopped};

use crate::client::{DaemonClient, percent_encode};
use crate::confirm::{YesFlag, ask};
use crate::output::{self, OutputFormat, count};

/// Remove a service: end its servants and delete its revisions and their images. On a terminal, asks first.
#[derive(Debug, clap::Args)]
pub struct RmArgs {
    /// Service to remove.
    service: String,
    #[command(flatten)]
    yes: YesFlag,
}

impl RmArgs {
    /// Asks on a terminal, sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}", percent_encode(&self.service));
        if self.yes.is_to_ask() {
            let service: ServiceDetail = client.get(&path).await?;
            if !ask(question(&service)).await? {
                bail!("{} was not removed; answer y, or pass --yes", self.service);
            }
        }
        let ended: Stopped = client.delete(&path).await?;
        match format {
            OutputFormat::Json => output::json(&ended),
            OutputFormat::Table => output::line(&match ended.stopped.as_slice() {
                [] => format!("removed {}", self.service),
                stopped => format!("removed {} and ended {}", self.service, stopped.join(", ")),
            }),
        }
    }
}

fn question(service: &ServiceDetail) -> String {
    let revisions = count(service.revisions.len(), "revision");
    let servants = match service.summary.servants {
        0 => String::new(),
        servants => format!(", and end {}", count(servants, "servant")),
    };
    format!("remove {} with {revisions}{servants}?", service.summary.name)
}
