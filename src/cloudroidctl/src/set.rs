//! `set`: changes the limits of a servant at work.

use anyhow::bail;
use api::{Limits, Servant};

use crate::client::{Client, escaped};
use crate::inside;
use crate::limits::LimitFlags;
use crate::output::{self, Format};

/// Change limits of a servant while it works. Those that are not named stay; what it is promised changes too.
#[derive(Debug, clap::Args)]
pub struct Set {
    /// The servant's id, or the name of a service that has one servant.
    servant: String,
    #[command(flatten)]
    limits: LimitFlags,
}

impl Set {
    /// Asks and prints what is in force then.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let limits = Limits::from(self.limits);
        if limits == Limits::default() {
            bail!("nothing to change; name a limit, such as --cpus 1.5 or --memory 512M");
        }
        let servant = inside::servant(client, &self.servant).await?;
        let path = format!("/api/v1/servants/{}", escaped(&servant));
        let servant: Servant = client.patch(&path, &limits).await?;
        match format {
            Format::Json => output::json(&servant),
            Format::Table => output::line(&format!(
                "{}: {}",
                servant.id,
                output::limits(servant.enforced.as_ref().unwrap_or(&servant.limits))
            )),
        }
    }
}
