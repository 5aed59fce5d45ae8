//! `topics`: publication statistics of a servant's topics.

use api::topics::PublishedTopics;
use futures_util::StreamExt;

use crate::client::{DaemonClient, percent_encode};
use crate::inside;
use crate::output::{self, OutputFormat, Table};

/// Print the statistics of each topic of a servant: rate, bandwidth, and age of messages on arrival.
///
/// The daemon subscribes to all topics for this, besides the servant's robot: nodes that publish only when they have
/// subscribers start to publish.
#[derive(Debug, clap::Args)]
pub struct TopicsArgs {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
    /// Number of tables, one each second (default: until Ctrl-C); like -n of rostopic echo and of top.
    #[arg(short = 'n', long, alias = "seconds", value_name = "COUNT")]
    count: Option<usize>,
    /// One table: --count 1, like --once of ros2 topic echo.
    #[arg(long, conflicts_with = "count")]
    once: bool,
}

impl TopicsArgs {
    /// Sends the request and prints the statistics.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let tables = if self.once { 1 } else { self.count.unwrap_or(usize::MAX) };
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let path = format!("/api/v1/servants/{}/topics", percent_encode(&servant));
        let told = client.get_lines::<PublishedTopics>(&path).await?;
        let mut told = std::pin::pin!(told.take(tables));
        while let Some(topics) = told.next().await {
            let topics = topics?;
            if format == OutputFormat::Json {
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
                    topic.latency.map_or_else(|| "-".to_owned(), |age| format!("{:.1} ms", age * 1e3)),
                ]);
            }
            table.print()?;
            output::line("")?;
        }
        Ok(())
    }
}
