//! `rm`: removes a service.

use api::Stopped;

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat};

/// Remove a service: end its servants and delete its revisions and their images.
#[derive(Debug, clap::Args)]
pub struct RmArgs {
    /// Service to remove.
    service: String,
}

impl RmArgs {
    /// Sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let ended: Stopped = client.delete(&format!("/api/v1/services/{}", percent_encode(&self.service))).await?;
        match format {
            OutputFormat::Json => output::json(&ended),
            OutputFormat::Table => output::line(&match ended.stopped.as_slice() {
                [] => format!("removed {}", self.service),
                stopped => format!("removed {} and ended {}", self.service, stopped.join(", ")),
            }),
        }
    }
}
