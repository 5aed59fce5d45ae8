//! `audit`: the audit log.

use api::access::Audited;
use futures_util::StreamExt;

use crate::client::DaemonClient;
use crate::output::{self, OutputFormat};

/// Print the audit log: who did what to what from where, oldest first.
#[derive(Debug, clap::Args)]
pub struct AuditArgs {
    /// Keep printing new records.
    #[arg(short, long)]
    follow: bool,
    /// Number of recent records.
    #[arg(short = 'n', long, value_name = "RECORDS", default_value_t = 100)]
    tail: u32,
}

impl AuditArgs {
    /// Sends the request and prints the records.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/audit?follow={}&limit={}", self.follow, self.tail);
        let records = client.get_lines::<Audited>(&path).await?;
        let mut records = std::pin::pin!(records);
        while let Some(record) = records.next().await {
            let record = record?;
            match format {
                OutputFormat::Json => output::json_line(&record)?,
                OutputFormat::Table => output::line(&format_record(&record))?,
            }
        }
        Ok(())
    }
}

fn format_record(record: &Audited) -> String {
    let more = match record.more {
        0 => String::new(),
        more => format!(" (and {more} similar before)"),
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
