//! `record`: records the messages in a servant to a file.

use std::collections::HashMap;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use foxglove::ws_protocol::client::{Subscribe, Subscription};
use foxglove::ws_protocol::server::{Channel, ServerMessage};
use recording::{RecordingFormat, RecordingWriter, Summary};
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::{Instant, Interval, MissedTickBehavior, interval, interval_at, sleep_until};

use crate::client::DaemonClient;
use crate::inside::{self, FoxgloveSession};
use crate::output::{self, OutputFormat, count};
use crate::token::lifetime;
use crate::topic_selection::TopicFilter;

/// Length of the daemon's queue for each topic, for while the file is written.
const DEPTH: usize = 1000;
/// Interval between flushes of the file.
const FLUSH: Duration = Duration::from_secs(1);

/// Record the messages in a servant to an MCAP file, until Ctrl-C, the servant's end, or the end of the duration.
///
/// -d is that of ros2 bag record: it begins a new file (drive_0.mcap, drive_1.mcap, …) whenever one is so long, and
/// goes on.
#[derive(Debug, clap::Args)]
pub struct RecordArgs {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
    /// Output file, which must not exist.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    topics: TopicFilter,
    /// Duration of the whole recording: seconds, or a time such as 5m (default: until Ctrl-C).
    #[arg(long, value_name = "TIME", value_parser = seconds)]
    duration: Option<Duration>,
    /// Duration of each file, in seconds or as a time such as 5m: then the next file begins.
    #[arg(short = 'd', long, value_name = "SECONDS", value_parser = seconds)]
    max_bag_duration: Option<Duration>,
}

/// Parses a whole number of seconds, as in ROS, or a time with its unit.
fn seconds(text: &str) -> anyhow::Result<Duration> {
    let number: Option<u64> = text.parse().ok().filter(|seconds| *seconds > 0);
    number.map_or_else(|| lifetime(text), |seconds| Ok(Duration::from_secs(seconds)))
}

/// Returns the path of a part of a recording, named as those of `ros2 bag record`: `drive_0.mcap`.
fn part_path(output: &Path, number: usize) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    let extension = output.extension().map(|extension| format!(".{}", extension.to_string_lossy()));
    output.with_file_name(format!("{stem}_{number}{}", extension.unwrap_or_default()))
}

impl RecordArgs {
    /// Records until the end and prints a summary.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let inside = FoxgloveSession::attach(client, &servant, DEPTH).await?;
        let first = match self.max_bag_duration {
            Some(_) => part_path(&self.output, 0),
            None => self.output.clone(),
        };
        let writer = create_file(&first, inside.format)?;
        output::eprint_line(&format!("recording {servant} to {}; stop with Ctrl-C", first.display()));
        let mut recorder = Recorder {
            inside,
            writer,
            output: self.output,
            finished: Vec::new(),
            topics: self.topics,
            channels: HashMap::new(),
            subscribed: HashMap::new(),
            last: 0,
        };
        let begun = Instant::now();
        let ended = recorder.record(self.duration, self.max_bag_duration).await;
        // Keep the messages recorded so far, whatever ended the recording.
        let mut files = recorder.finished;
        files.push(recorder.writer.finish()?);
        print_summaries(&files, begun.elapsed(), self.max_bag_duration.is_some(), format)?;
        if recorder.last == 0 {
            output::eprint_line(&format!(
                "none of the selected topics was published in {servant}; see its topics with: cloudroidctl services \
                    NAME"
            ));
        }
        ended
    }
}

fn create_file(path: &Path, format: RecordingFormat) -> anyhow::Result<RecordingWriter> {
    RecordingWriter::create(path, format).context("-o must name a new file in an existing directory")
}

/// A recorded topic.
struct RecordedTopic {
    /// Channel in the file.
    channel: u16,
    topic: String,
    of: String,
    definition: Vec<u8>,
}

struct Recorder {
    inside: FoxgloveSession,
    writer: RecordingWriter,
    /// Path given for the recording.
    output: PathBuf,
    /// Files that are complete, if there are several.
    finished: Vec<Summary>,
    topics: TopicFilter,
    /// Topics, by subscription id.
    channels: HashMap<u32, RecordedTopic>,
    /// Subscription ids, by the daemon's channel id.
    subscribed: HashMap<u64, u32>,
    last: u32,
}

impl Recorder {
    async fn record(&mut self, duration: Option<Duration>, each: Option<Duration>) -> anyhow::Result<()> {
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
        let mut split = each.map(|each| interval_at(begun + each, each));
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
                            if let Some(topic) = self.channels.get(&told.subscription_id) {
                                self.writer.add_message(topic.channel, told.log_time, &told.data)?;
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
                        eprint!("\r{seconds} s, {} ", count(self.writer.messages(), "message"));
                    }
                }
                () = wait_tick(split.as_mut()) => self.begin_next_file()?,
                () = &mut time_up => return Ok(()),
                _ = interrupt.recv() => return Ok(()),
                _ = terminate.recv() => return Ok(()),
            }
        }
    }

    /// Finishes the file and goes on with the same topics in the next one.
    fn begin_next_file(&mut self) -> anyhow::Result<()> {
        let path = part_path(&self.output, self.finished.len() + 1);
        let mut next = create_file(&path, self.inside.format)?;
        for topic in self.channels.values_mut() {
            topic.channel = next.add_channel(&topic.topic, &topic.of, &topic.definition)?;
        }
        let full = std::mem::replace(&mut self.writer, next);
        self.finished.push(full.finish()?);
        Ok(())
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
        let topic = RecordedTopic {
            channel: written,
            topic: channel.topic.to_string(),
            of: channel.schema_name.to_string(),
            definition: definition.to_vec(),
        };
        self.channels.insert(self.last, topic);
        self.subscribed.insert(channel.id, self.last);
        let wanted = Subscribe::new([Subscription::new(self.last, channel.id)]);
        self.inside.send(&wanted).await
    }
}

/// Waits for the next tick; forever without an interval.
async fn wait_tick(interval: Option<&mut Interval>) {
    match interval {
        Some(interval) => {
            interval.tick().await;
        }
        None => std::future::pending().await,
    }
}

fn print_summaries(files: &[Summary], time: Duration, has_parts: bool, format: OutputFormat) -> anyhow::Result<()> {
    match (format, files) {
        (OutputFormat::Json, [only]) if !has_parts => return output::json(only),
        (OutputFormat::Json, _) => return output::json(&files),
        (OutputFormat::Table, _) => {}
    }
    if std::io::stderr().is_terminal() {
        eprintln!();
    }
    for file in files {
        let mut table = output::Table::new(&["TOPIC", "TYPE", "MESSAGES", "BYTES"]);
        for topic in &file.topics {
            table.row([topic.topic.clone(), topic.of.clone(), topic.messages.to_string(), topic.bytes.to_string()]);
        }
        table.print()?;
        // Of several files only the whole recording was timed.
        let took = if has_parts { String::new() } else { format!(" in {:.1} s", time.as_secs_f64()) };
        output::line(&format!(
            "{} on {}{took}: {} ({:.1} MB)",
            count(file.messages, "message"),
            count(file.topics.len(), "topic"),
            file.file.display(),
            file.size as f64 / 1e6
        ))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_seconds_as_in_ros_or_have_a_unit() {
        for (text, expected) in [("30", 30), ("30s", 30), ("5m", 300)] {
            assert_eq!(seconds(text).expect(text), Duration::from_secs(expected));
        }
        for text in ["0", "-3", "soon", ""] {
            seconds(text).expect_err(text);
        }
    }

    #[test]
    fn parts_are_numbered_before_their_extension() {
        assert_eq!(part_path(Path::new("a/drive.mcap"), 0), Path::new("a/drive_0.mcap"));
        assert_eq!(part_path(Path::new("drive"), 12), Path::new("drive_12"));
    }
}
