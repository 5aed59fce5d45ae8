//! `recordings`: files of the last seconds of servants, which the daemon keeps.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;
use api::recordings::Recording;
use futures_util::StreamExt;
use http_body_util::BodyStream;
use hyper::Method;

use crate::client::{Client, empty, escaped};
use crate::inside;
use crate::output::{self, Format, Table};
use crate::whole::Half;

/// Black boxes: what flowed in servants in the seconds before their robots waited too long.
///
/// The daemon writes them where its configuration says so ([black_box]).
#[derive(Debug, clap::Args)]
pub struct Recordings {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    List(List),
    Get(Get),
    Take(Take),
    Rm(Rm),
}

/// List them, the newest first.
#[derive(Debug, clap::Args)]
struct List {
    /// Only those of this service.
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// Only those of this robot.
    #[arg(long, value_name = "ID")]
    robot: Option<String>,
}

/// Fetch one: an MCAP file, as `cloudroidctl record` writes them.
#[derive(Debug, clap::Args)]
struct Get {
    /// Its number.
    number: u64,
    /// The file; recording-NUMBER.mcap by default. An earlier one is replaced when the new one is whole.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Write what flowed in a servant in the last seconds, now.
#[derive(Debug, clap::Args)]
struct Take {
    /// The servant's id, or the name of a service that has one servant.
    servant: String,
}

/// Remove one.
#[derive(Debug, clap::Args)]
struct Rm {
    /// Its number.
    number: u64,
}

impl Recordings {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        match self.verb {
            Verb::List(verb) => verb.run(client, format).await,
            Verb::Get(verb) => verb.run(client, format).await,
            Verb::Take(verb) => {
                let servant = inside::servant(client, &verb.servant).await?;
                let path = format!("/api/v1/servants/{}/recording", escaped(&servant));
                let taken: Recording = client.post(&path, &()).await?;
                list(&[taken], format)
            }
            Verb::Rm(verb) => {
                let path = format!("/api/v1/recordings/{}", verb.number);
                let left: Vec<Recording> = client.delete(&path).await?;
                list(&left, format)
            }
        }
    }
}

impl List {
    async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let asked = [("service", self.service), ("robot", self.robot)];
        let asked: Vec<String> = asked
            .into_iter()
            .filter_map(|(name, value)| Some(format!("{name}={}", escaped(&value?))))
            .collect();
        let path = format!("/api/v1/recordings?{}", asked.join("&"));
        let all: Vec<Recording> = client.get(&path).await?;
        if all.is_empty() && format == Format::Table {
            output::complain(match asked.is_empty() {
                true => {
                    "there are no recordings: where [black_box] has seconds in the daemon's configuration, it writes one when a robot waits longer than it accepts, and by: cloudroidctl recordings take SERVANT"
                }
                false => {
                    "there are no recordings of that service and robot; without --service and --robot all are listed"
                }
            });
        }
        list(&all, format)
    }
}

impl Get {
    async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let target = self
            .output
            .unwrap_or_else(|| PathBuf::from(format!("recording-{}.mcap", self.number)));
        let path = format!("/api/v1/recordings/{}", self.number);
        let answer = client.send(Method::GET, &path, empty()).await?;
        let half = Half::beside(&target)?;
        let mut bytes = 0;
        let mut parts = BodyStream::new(answer.into_body());
        while let Some(part) = parts.next().await {
            let part = part.context("the daemon broke off its answer")?;
            let part = part.into_data().unwrap_or_default();
            bytes += part.len() as u64;
            (&half.file)
                .write_all(&part)
                .with_context(|| half.failed())?;
        }
        half.publish()?;
        match format {
            Format::Json => output::json(&serde_json::json!({ "path": target, "bytes": bytes })),
            Format::Table => output::line(&format!("{} ({})", target.display(), api::Size(bytes))),
        }
    }
}

fn list(all: &[Recording], format: Format) -> anyhow::Result<()> {
    if format == Format::Json {
        return output::json(&all);
    }
    if all.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&[
        "NUMBER", "TIME", "SERVICE", "ROBOT", "SECONDS", "MESSAGES", "SIZE", "WHY",
    ]);
    for one in all {
        table.row([
            one.number.to_string(),
            output::clock(one.time),
            one.service.clone(),
            one.robot.clone(),
            format!("{:.1}", one.seconds),
            one.messages.to_string(),
            one.bytes.to_string(),
            one.why.clone(),
        ]);
    }
    table.print()
}
