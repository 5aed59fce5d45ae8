//! `rollback`: returns to an earlier revision.

use api::ServiceDetail;

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat};

/// Roll a service back: new servants start from an earlier revision, existing ones are not changed.
#[derive(Debug, clap::Args)]
pub struct RollbackArgs {
    /// Service to roll back.
    service: String,
    /// Revision to return to (default: the one before the current).
    revision: Option<u64>,
}

impl RollbackArgs {
    /// Sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}/rollback", percent_encode(&self.service));
        let service: ServiceDetail = client.post(&path, &api::Rollback { revision: self.revision }).await?;
        match format {
            OutputFormat::Json => output::json(&service),
            OutputFormat::Table => {
                let summary = &service.summary;
                output::line(&format!("{} is back at revision {}", summary.name, summary.revision))
            }
        }
    }
}
