//! `rm`: takes a service away.

use api::Stopped;

use crate::client::{Client, escaped};
use crate::output::{self, Format};

/// Remove a service: its servants are ended, its revisions and their images forgotten.
#[derive(Debug, clap::Args)]
pub struct Rm {
    /// The service.
    service: String,
}

impl Rm {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let ended: Stopped = client
            .delete(&format!("/api/v1/services/{}", escaped(&self.service)))
            .await?;
        match format {
            Format::Json => output::json(&ended),
            Format::Table => output::line(&match ended.stopped.as_slice() {
                [] => format!("removed {}", self.service),
                stopped => format!("removed {} and ended {}", self.service, stopped.join(", ")),
            }),
        }
    }
}
