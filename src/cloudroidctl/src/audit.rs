//! `audit`: who did what.

use api::access::Audited;
use futures_util::StreamExt;

use crate::client::Client;
use crate::output::{self, Format};

/// Print who did what to what from where, oldest first.
#[derive(Debug, clap::Args)]
pub struct Audit {
    /// Go on printing as records come.
    #[arg(short, long)]
    follow: bool,
    /// So many of the last records.
    #[arg(short = 'n', long, value_name = "RECORDS", default_value_t = 100)]
    tail: u32,
}

impl Audit {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let path = format!("/api/v1/audit?follow={}&limit={}", self.follow, self.tail);
        let records = client.lines::<Audited>(&path).await?;
        let mut records = std::pin::pin!(records);
        while let Some(record) = records.next().await {
            let record = record?;
            match format {
                Format::Json => output::json_line(&record)?,
                Format::Table => output::line(&in_a_line(&record))?,
            }
        }
        Ok(())
    }
}

fn in_a_line(record: &Audited) -> String {
    let more = match record.more {
        0 => String::new(),
        more => format!(" (and {more} alike before)"),
    };
    format!(
        "{} {} from {}: {}, {}: {}{more}",
        output::clock(record.time),
        record.who,
        record.from,
        record.did,
        record.object,
        record.status
    )
}
