//! `topics`: what is published in a servant, and how much.

use api::topics::PublishedTopics;
use futures_util::StreamExt;

use crate::client::{Client, escaped};
use crate::inside;
use crate::output::{self, Format, Table};

/// Print what is published on each topic of a servant: rate, bandwidth, and how old messages are when they come.
///
/// To count it, the daemon hears all of it beside the servant's robot: nodes that publish only what somebody listens to publish it then.
#[derive(Debug, clap::Args)]
pub struct Published {
    /// The servant's id, or the name of a service that has one servant.
    servant: String,
    /// Count for so many seconds, a table for each; without it until Ctrl-C.
    #[arg(short = 'n', long, value_name = "SECONDS")]
    seconds: Option<usize>,
}

impl Published {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let servant = inside::servant(client, &self.servant).await?;
        let path = format!("/api/v1/servants/{}/topics", escaped(&servant));
        let told = client.lines::<PublishedTopics>(&path).await?;
        let mut told = std::pin::pin!(told.take(self.seconds.unwrap_or(usize::MAX)));
        while let Some(topics) = told.next().await {
            let topics = topics?;
            if format == Format::Json {
                output::json_line(&topics)?;
                continue;
            }
            let mut table = Table::new(&["TOPIC", "TYPE", "RATE", "BANDWIDTH", "LATENCY"]);
            for topic in topics.topics {
                table.row([
                    topic.topic,
                    topic.of,
                    format!("{:.1} Hz", topic.rate),
                    format!("{:.1} kB/s", topic.bandwidth / 1e3),
                    topic
                        .latency
                        .map_or_else(|| "-".to_owned(), |age| format!("{:.1} ms", age * 1e3)),
                ]);
            }
            table.print()?;
            output::line("")?;
        }
        Ok(())
    }
}
