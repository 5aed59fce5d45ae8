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
    let Audited { who, from, did, object, status, .. } = record;
    let outcome = match record.outcome() {
        "failed" => format!("failed ({status})"),
        outcome => outcome.to_owned(),
    };
    format!("{} {who} from {from}: {did}, {object}: {outcome}{more}", output::clock(record.time))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_says_who_did_what_and_how_it_ended() {
        let record = |did: &str, status, more| Audited {
            id: 1,
            time: 0,
            who: "alice (deployer)".into(),
            from: "192.0.2.7:4711".into(),
            action: "deploy".into(),
            did: did.into(),
            object: "service student_vision".into(),
            status,
            more,
        };
        for (record, words) in [
            (record("begin a push", 200, 0), "begin a push, service student_vision: done"),
            (record("push", 422, 0), "push, service student_vision: failed (422)"),
            (record("remove", 403, 2), "remove, service student_vision: refused (and 2 similar before)"),
            (record("remove", 401, 0), "remove, service student_vision: refused"),
            (record("stop", 500, 0), "stop, service student_vision: failed (500)"),
        ] {
            let line = format_record(&record);
            assert!(line.ends_with(&format!(" alice (deployer) from 192.0.2.7:4711: {words}")), "{line}");
        }
    }
}
