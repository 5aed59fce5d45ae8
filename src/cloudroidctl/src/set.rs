//! `set`: changes the limits of a running servant.

use anyhow::bail;
use api::{Limits, Servant};

use crate::client::{DaemonClient, percent_encode};
use crate::inside;
use crate::output::{self, OutputFormat};

/// Change limits of a running servant, and what is reserved for it. Limits that are not named stay the same.
#[derive(Debug, clap::Args)]
pub struct SetArgs {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
    #[command(flatten)]
    limits: Limits,
}

impl SetArgs {
    /// Sends the request and prints the limits in force.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let limits = self.limits;
        if limits == Limits::default() {
            bail!("nothing to change; name a limit, such as --cpus 1.5 or --memory 512M");
        }
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let path = format!("/api/v1/servants/{}", percent_encode(&servant));
        let servant: Servant = client.patch(&path, &limits).await?;
        match format {
            OutputFormat::Json => output::json(&servant),
            OutputFormat::Table => output::line(&format!(
                "{}: {}",
                servant.id,
                output::limits(servant.enforced.as_ref().unwrap_or(&servant.limits))
            )),
        }
    }
}
