//! `record`: what flows in a servant, into a file.

use std::collections::HashMap;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use foxglove::ws_protocol::client::{Subscribe, Subscription};
use foxglove::ws_protocol::server::{Channel, ServerMessage};
use recording::{Summary, Writer};
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use crate::client::Client;
use crate::inside::{self, Inside};
use crate::output::{self, Format};
use crate::token::lifetime;
use crate::topics::Topics;

/// Messages of a topic that wait in the daemon while the file is written.
const DEPTH: usize = 1000;
/// Between two times that what came is written out.
const FLUSH: Duration = Duration::from_secs(1);

/// Record the messages that flow in a servant into an MCAP file, until Ctrl-C, the servant's end, or the duration's.
#[derive(Debug, clap::Args)]
pub struct Record {
    /// The servant's id, or the name of a service that has one servant.
    servant: String,
    /// The file to write, which must not be there yet.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    topics: Topics,
    /// Record for so long, such as 30s or 5m.
    #[arg(short, long, value_name = "TIME", value_parser = lifetime)]
    duration: Option<Duration>,
}

impl Record {
    /// Records.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let servant = inside::servant(client, &self.servant).await?;
        let inside = Inside::attach(client, &servant, DEPTH).await?;
        let writer = Writer::create(&self.output, inside.format)
            .context("-o is to name a new file, in a directory that exists")?;
        output::complain(&format!(
            "recording {servant} into {}; Ctrl-C ends it",
            self.output.display()
        ));
        let mut recorder = Recorder {
            inside,
            writer,
            topics: self.topics,
            channels: HashMap::new(),
            subscribed: HashMap::new(),
            last: 0,
        };
        let begun = Instant::now();
        let ended = recorder.records(self.duration).await;
        // What came before is kept, whatever has ended it.
        let summary = recorder.writer.finish()?;
        told(&summary, begun.elapsed(), format)?;
        if recorder.last == 0 {
            output::complain(&format!(
                "none of the wanted topics was published in {servant}; see what is there with: cloudroidctl services NAME"
            ));
        }
        ended
    }
}

struct Recorder {
    inside: Inside,
    writer: Writer,
    topics: Topics,
    /// The file's channels by subscription.
    channels: HashMap<u32, u16>,
    /// Subscriptions by the daemon's channel.
    subscribed: HashMap<u64, u32>,
    last: u32,
}

impl Recorder {
    async fn records(&mut self, duration: Option<Duration>) -> anyhow::Result<()> {
        let begun = Instant::now();
        let deadline = duration.map(|duration| begun + duration);
        let time_up = async {
            match deadline {
                Some(deadline) => sleep_until(deadline).await,
                None => std::future::pending().await,
            }
        };
        tokio::pin!(time_up);
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut flush = interval(FLUSH);
        flush.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let shows = std::io::stderr().is_terminal();
        loop {
            tokio::select! {
                message = self.inside.next() => {
                    let Some(message) = message? else {
                        output::complain("the servant has ended");
                        return Ok(());
                    };
                    match inside::read(&message) {
                        Some(ServerMessage::Advertise(told)) => {
                            for channel in told.channels {
                                self.subscribe(&channel).await?;
                            }
                        }
                        Some(ServerMessage::Unadvertise(told)) => {
                            for channel in told.channel_ids {
                                if let Some(id) = self.subscribed.remove(&channel) {
                                    self.channels.remove(&id);
                                }
                            }
                        }
                        Some(ServerMessage::MessageData(told)) => {
                            if let Some(channel) = self.channels.get(&told.subscription_id) {
                                self.writer.add(*channel, told.log_time, &told.data)?;
                            }
                        }
                        Some(ServerMessage::Status(told)) => output::complain(&told.message),
                        _ => {}
                    }
                }
                _ = flush.tick() => {
                    self.writer.flush()?;
                    if shows {
                        let seconds = begun.elapsed().as_secs();
                        eprint!("\r{seconds} s, {} messages ", self.writer.messages());
                    }
                }
                () = &mut time_up => return Ok(()),
                _ = interrupt.recv() => return Ok(()),
                _ = terminate.recv() => return Ok(()),
            }
        }
    }

    async fn subscribe(&mut self, channel: &Channel<'_>) -> anyhow::Result<()> {
        let encoding = self.inside.format.encoding();
        if !self.topics.want(&channel.topic) || channel.encoding != encoding {
            return Ok(());
        }
        let Ok(definition) = channel.decode_schema() else {
            bail!("the daemon tells no definition of {}", channel.topic);
        };
        let written = self
            .writer
            .channel(&channel.topic, &channel.schema_name, &definition)?;
        self.last += 1;
        self.channels.insert(self.last, written);
        self.subscribed.insert(channel.id, self.last);
        let wanted = Subscribe::new([Subscription::new(self.last, channel.id)]);
        self.inside.send(&wanted).await
    }
}

fn told(summary: &Summary, time: Duration, format: Format) -> anyhow::Result<()> {
    if format == Format::Json {
        return output::json(summary);
    }
    if std::io::stderr().is_terminal() {
        eprintln!();
    }
    let mut table = output::Table::new(&["TOPIC", "TYPE", "MESSAGES", "BYTES"]);
    for topic in &summary.topics {
        table.row([
            topic.topic.clone(),
            topic.of.clone(),
            topic.messages.to_string(),
            topic.bytes.to_string(),
        ]);
    }
    table.print()?;
    output::line(&format!(
        "{} messages of {} topics in {:.1} s: {} ({:.1} MB)",
        summary.messages,
        summary.topics.len(),
        time.as_secs_f64(),
        summary.file.display(),
        summary.size as f64 / 1e6
    ))
}
