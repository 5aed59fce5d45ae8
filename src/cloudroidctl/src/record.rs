//! `record`: records the messages in a servant to a file.

use std::collections::HashMap;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use foxglove::ws_protocol::client::{Subscribe, Subscription};
use foxglove::ws_protocol::server::{Channel, ServerMessage};
use recording::{RecordingWriter, Summary};
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use crate::client::DaemonClient;
use crate::inside::{self, FoxgloveSession};
use crate::output::{self, OutputFormat};
use crate::token::lifetime;
use crate::topics::TopicFilter;

/// Length of the daemon's queue for each topic, for while the file is written.
const DEPTH: usize = 1000;
/// Interval between flushes of the file.
const FLUSH: Duration = Duration::from_secs(1);

/// Record the messages in a servant to an MCAP file, until Ctrl-C, the servant's end, or the end of the duration.
#[derive(Debug, clap::Args)]
pub struct RecordArgs {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
    /// Output file, which must not exist.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    topics: TopicFilter,
    /// Duration of the recording, such as 30s or 5m (default: until Ctrl-C).
    #[arg(short, long, value_name = "TIME", value_parser = lifetime)]
    duration: Option<Duration>,
}

impl RecordArgs {
    /// Records until the end and prints a summary.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let inside = FoxgloveSession::attach(client, &servant, DEPTH).await?;
        let writer = RecordingWriter::create(&self.output, inside.format)
            .context("-o must name a new file in an existing directory")?;
        output::eprint_line(&format!("recording {servant} to {}; stop with Ctrl-C", self.output.display()));
        let mut recorder = Recorder {
            inside,
            writer,
            topics: self.topics,
            channels: HashMap::new(),
            subscribed: HashMap::new(),
            last: 0,
        };
        let begun = Instant::now();
        let ended = recorder.record(self.duration).await;
        // Keep the messages recorded so far, whatever ended the recording.
        let summary = recorder.writer.finish()?;
        print_summary(&summary, begun.elapsed(), format)?;
        if recorder.last == 0 {
            output::eprint_line(&format!(
                "none of the selected topics was published in {servant}; see its topics with: cloudroidctl services \
                    NAME"
            ));
        }
        ended
    }
}

struct Recorder {
    inside: FoxgloveSession,
    writer: RecordingWriter,
    topics: TopicFilter,
    /// Channels of the file, by subscription id.
    channels: HashMap<u32, u16>,
    /// Subscription ids, by the daemon's channel id.
    subscribed: HashMap<u64, u32>,
    last: u32,
}

impl Recorder {
    async fn record(&mut self, duration: Option<Duration>) -> anyhow::Result<()> {
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
                        output::eprint_line("the servant has ended");
                        return Ok(());
                    };
                    match inside::parse_message(&message) {
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
                                self.writer.add_message(*channel, told.log_time, &told.data)?;
                            }
                        }
                        Some(ServerMessage::Status(told)) => output::eprint_line(&told.message),
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
        if !self.topics.accepts(&channel.topic) || channel.encoding != encoding {
            return Ok(());
        }
        let Ok(definition) = channel.decode_schema() else {
            bail!("the daemon sent no message definition of {}", channel.topic);
        };
        let written = self.writer.add_channel(&channel.topic, &channel.schema_name, &definition)?;
        self.last += 1;
        self.channels.insert(self.last, written);
        self.subscribed.insert(channel.id, self.last);
        let wanted = Subscribe::new([Subscription::new(self.last, channel.id)]);
        self.inside.send(&wanted).await
    }
}

fn print_summary(summary: &Summary, time: Duration, format: OutputFormat) -> anyhow::Result<()> {
    if format == OutputFormat::Json {
        return output::json(summary);
    }
    if std::io::stderr().is_terminal() {
        eprintln!();
    }
    let mut table = output::Table::new(&["TOPIC", "TYPE", "MESSAGES", "BYTES"]);
    for topic in &summary.topics {
        table.row([topic.topic.clone(), topic.of.clone(), topic.messages.to_string(), topic.bytes.to_string()]);
    }
    table.print()?;
    output::line(&format!(
        "{} messages on {} topics in {:.1} s: {} ({:.1} MB)",
        summary.messages,
        summary.topics.len(),
        time.as_secs_f64(),
        summary.file.display(),
        summary.size as f64 / 1e6
    ))
}
