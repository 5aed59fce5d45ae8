//! `logs`: what nodes print.

use api::LogLine;
use futures_util::StreamExt;

use crate::client::{Client, escaped};
use crate::inside;
use crate::output::{self, Format};

/// Print what a servant's nodes have printed.
#[derive(Debug, clap::Args)]
pub struct Logs {
    /// The servant's id, or the name of a service that has one servant.
    servant: String,
    /// Go on printing as lines come.
    #[arg(short, long)]
    follow: bool,
    /// Only so many of the last lines.
    #[arg(short = 'n', long, value_name = "LINES")]
    tail: Option<usize>,
}

impl Logs {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let servant = inside::servant(client, &self.servant).await?;
        let tail = self
            .tail
            .map(|lines| format!("&tail={lines}"))
            .unwrap_or_default();
        let path = format!(
            "/api/v1/servants/{}/logs?follow={}{tail}",
            escaped(&servant),
            self.follow
        );
        let mut lines = client.lines::<LogLine>(&path).await?;
        while let Some(entry) = lines.next().await {
            let entry = entry?;
            match format {
                Format::Json => output::json_line(&entry)?,
                Format::Table => {
                    output::line(&format!(
                        "{} {} | {}",
                        output::clock(entry.time),
                        entry.node,
                        entry.line
                    ))?;
                }
            }
        }
        Ok(())
    }
}
