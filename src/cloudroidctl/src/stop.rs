//! `stop`: ends servants.

use std::collections::BTreeSet;

use api::Stopped;

use crate::client::{Client, escaped};
use crate::inside;
use crate::output::{self, Format};

/// End servants. A robot that connects again is given a new one.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("which").required(true).args(["servants", "service", "all"])))]
pub struct Stop {
    /// Ids of servants, or names of services that have one servant.
    servants: Vec<String>,
    /// All servants of this service.
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// All servants.
    #[arg(long)]
    all: bool,
}

impl Stop {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let mut ended = Stopped::default();
        let paths = if self.all {
            vec!["/api/v1/servants".to_owned()]
        } else if let Some(service) = &self.service {
            vec![format!("/api/v1/servants?service={}", escaped(service))]
        } else {
            // All are known before the first is ended.
            let (mut ids, mut paths) = (BTreeSet::new(), Vec::new());
            for named in &self.servants {
                let id = inside::servant(client, named).await?;
                // One that was ended is not there to be ended again.
                if ids.insert(id.clone()) {
                    paths.push(format!("/api/v1/servants/{}", escaped(&id)));
                }
            }
            paths
        };
        for path in paths {
            ended
                .stopped
                .extend(client.delete::<Stopped>(&path).await?.stopped);
        }
        match format {
            Format::Json => output::json(&ended),
            Format::Table if ended.stopped.is_empty() => output::line("no servants to stop"),
            Format::Table => output::line(&format!("stopped {}", ended.stopped.join(", "))),
        }
    }
}
