//! `logs`: the output of nodes.

use api::LogLine;
use futures_util::StreamExt;

use crate::client::{DaemonClient, percent_encode};
use crate::inside;
use crate::output::{self, OutputFormat};

/// Print the output of a servant's nodes.
#[derive(Debug, clap::Args)]
pub struct LogsArgs {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
    /// Keep printing new lines.
    #[arg(short, long)]
    follow: bool,
    /// Number of recent lines (default: 10000).
    #[arg(short = 'n', long, value_name = "LINES")]
    tail: Option<usize>,
}

impl LogsArgs {
    /// Sends the request and prints the lines.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let tail = self.tail.map(|lines| format!("&tail={lines}")).unwrap_or_default();
        let path = format!("/api/v1/servants/{}/logs?follow={}{tail}", percent_encode(&servant), self.follow);
        let mut lines = client.get_lines::<LogLine>(&path).await?;
        while let Some(entry) = lines.next().await {
            let entry = entry?;
            match format {
                OutputFormat::Json => output::json_line(&entry)?,
                OutputFormat::Table => {
                    output::line(&format!("{} {} | {}", output::clock(entry.time), entry.node, entry.line))?;
                }
            }
        }
        Ok(())
    }
}
