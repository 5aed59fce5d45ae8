//! `events`: the daemon's journal.

use api::{Event, Level};

use crate::client::Client;
use crate::output::{self, Format};

/// Print what happened lately: pushes, starts, failures.
#[derive(Debug, clap::Args)]
pub struct Events {
    /// So many of the last events.
    #[arg(short = 'n', long, default_value_t = 50, value_name = "EVENTS")]
    tail: u32,
}

impl Events {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let events: Vec<Event> = client
            .get(&format!("/api/v1/events?limit={}", self.tail))
            .await?;
        if format == Format::Json {
            return output::json(&events);
        }
        for event in &events {
            let mark = match event.level {
                Level::Info => ' ',
                Level::Warning => '!',
                Level::Error => 'X',
            };
            output::line(&format!(
                "{} {mark} {}",
                output::clock(event.time),
                event.message
            ))?;
        }
        Ok(())
    }
}
