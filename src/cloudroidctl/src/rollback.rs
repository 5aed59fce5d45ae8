//! `rollback`: back to an earlier revision.

use api::ServiceDetail;

use crate::client::{Client, escaped};
use crate::output::{self, Format};

/// Start new servants of a service from an earlier revision. Those at work stay as they are.
#[derive(Debug, clap::Args)]
pub struct Rollback {
    /// The service.
    service: String,
    /// The revision; the one before the current by default.
    revision: Option<u64>,
}

impl Rollback {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}/rollback", escaped(&self.service));
        let service: ServiceDetail = client
            .post(
                &path,
                &api::Rollback {
                    revision: self.revision,
                },
            )
            .await?;
        match format {
            Format::Json => output::json(&service),
            Format::Table => {
                let summary = &service.summary;
                output::line(&format!(
                    "{} is at revision {} again",
                    summary.name, summary.revision
                ))
            }
        }
    }
}
