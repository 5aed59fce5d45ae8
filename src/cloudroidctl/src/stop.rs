//! `stop`: ends servants.

use std::collections::BTreeSet;

use api::Stopped;

use crate::client::{DaemonClient, percent_encode};
use crate::inside;
use crate::output::{self, OutputFormat};

/// End servants. A robot that connects again gets a new one.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("which").required(true).args(["servants", "service", "all"])))]
pub struct StopArgs {
    /// Ids of servants, or names of services that have one servant.
    servants: Vec<String>,
    /// End all servants of this service.
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// End all servants.
    #[arg(long)]
    all: bool,
}

impl StopArgs {
    /// Sends the requests and prints the ended servants.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let mut ended = Stopped::default();
        let paths = if self.all {
            vec!["/api/v1/servants".to_owned()]
        } else if let Some(service) = &self.service {
            vec![format!("/api/v1/servants?service={}", percent_encode(service))]
        } else {
            // Resolve all names before the first servant is ended.
            let (mut ids, mut paths) = (BTreeSet::new(), Vec::new());
            for named in &self.servants {
                let id = inside::resolve_servant(client, named).await?;
                // A servant that is named twice can be ended only once.
                if ids.insert(id.clone()) {
                    paths.push(format!("/api/v1/servants/{}", percent_encode(&id)));
                }
            }
            paths
        };
        for path in paths {
            ended.stopped.extend(client.delete::<Stopped>(&path).await?.stopped);
        }
        match format {
            OutputFormat::Json => output::json(&ended),
            OutputFormat::Table if ended.stopped.is_empty() => output::line("no servants to stop"),
            OutputFormat::Table => output::line(&format!("stopped {}", ended.stopped.join(", "))),
        }
    }
}
