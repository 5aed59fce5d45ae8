//! `replay`: publishes the messages of a file in a servant, at the recorded times.

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{bail, ensure};
use foxglove::ws_protocol::client::advertise::Channel;
use foxglove::ws_protocol::client::{Advertise, MessageData};
use foxglove::ws_protocol::schema::Schema;
use foxglove::ws_protocol::server::ServerMessage;
use foxglove::ws_protocol::server::status::Level;
use recording::{RecordedMessage, RecordingReader};
use tokio::time::{Instant, sleep_until};
use tokio_tungstenite::tungstenite::Message;

use crate::client::DaemonClient;
use crate::inside::{self, FoxgloveSession};
use crate::output::{self, OutputFormat};
use crate::topic_selection::TopicFilter;

/// Length of the daemon's queue for each topic, for slow nodes.
const DEPTH: usize = 1000;

/// Replay the messages of an MCAP file in a servant of the same ROS version, at the recorded intervals.
#[derive(Debug, clap::Args)]
pub struct ReplayArgs {
    /// Recording to replay, such as a file written by record.
    file: PathBuf,
    /// Id of the servant, or name of a service that has one servant.
    #[arg(long, value_name = "SERVANT")]
    to: String,
    #[command(flatten)]
    topics: TopicFilter,
    /// Speed relative to the recording.
    #[arg(short, long, value_name = "FACTOR", default_value_t = 1.0, value_parser = rate)]
    rate: f64,
    /// Repeat the recording until Ctrl-C.
    #[arg(short = 'l', long = "loop")]
    again: bool,
}

fn rate(text: &str) -> anyhow::Result<f64> {
    let Ok(rate) = text.parse::<f64>() else {
        bail!("not a number");
    };
    ensure!(rate.is_finite() && rate > 0.0, "must be greater than 0");
    Ok(rate)
}

impl ReplayArgs {
    /// Replays the file and prints the number of messages by topic.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        // Report an unreadable file before anything is requested.
        if let Err(error) = RecordingReader::open(&self.file).and_then(|mut file| file.next_message()) {
            let hint = "; create one with cloudroidctl record, or convert a bag with `mcap convert`";
            match error {
                recording::Error::NoRecording { .. } => bail!("{error}{hint}"),
                error => return Err(error.into()),
            }
        }
        let servant = inside::resolve_servant(client, &self.to).await?;
        let mut player = Player {
            inside: FoxgloveSession::attach(client, &servant, DEPTH).await?,
            channels: HashMap::new(),
            published: BTreeMap::new(),
            left_out: BTreeMap::new(),
            complaints: 0,
        };
        let played = async {
            loop {
                let published = player.play_once(&self).await?;
                if !self.again || !published {
                    return anyhow::Ok(());
                }
            }
        };
        tokio::select! {
            played = played => played?,
            _ = tokio::signal::ctrl_c() => {}
        }
        let Player { inside, published, left_out, mut complaints, .. } = player;
        for message in inside.close().await {
            complaints += relay_status(&message);
        }
        for (topic, why) in &left_out {
            output::eprint_line(&format!("{topic} was skipped: {why}"));
        }
        if published.is_empty() {
            bail!("nothing of {} was published: it has no messages on the selected topics", self.file.display());
        }
        match format {
            OutputFormat::Json => output::json(&published)?,
            OutputFormat::Table => {
                let mut table = output::Table::new(&["TOPIC", "MESSAGES"]);
                for (topic, messages) in &published {
                    table.row([topic.clone(), messages.to_string()]);
                }
                table.print()?;
            }
        }
        if complaints > 0 {
            bail!(
                "not all of {} was published, for the reasons above; select topics with --topic, and add message \
                    definitions to the image with push --with DEBIAN-PACKAGE",
                self.file.display()
            );
        }
        Ok(())
    }
}

struct Player {
    inside: FoxgloveSession,
    /// Channel ids, by topic.
    channels: HashMap<String, u32>,
    /// Number of published messages, by topic.
    published: BTreeMap<String, u64>,
    /// Topics that were left out, with the reason.
    left_out: BTreeMap<String, String>,
    /// Number of refusals by the daemon.
    complaints: usize,
}

/// Prints a status message of the daemon; returns 1 if it is an error, otherwise 0.
fn relay_status(message: &Message) -> usize {
    let Some(ServerMessage::Status(told)) = inside::parse_message(message) else {
        return 0;
    };
    output::eprint_line(&told.message);
    usize::from(told.level == Level::Error)
}

impl Player {
    /// Plays the file once; returns whether it had any wanted message.
    async fn play_once(&mut self, replay: &ReplayArgs) -> anyhow::Result<bool> {
        let mut reader = RecordingReader::open(&replay.file)?;
        let mut first = None;
        let begun = Instant::now();
        while let Some(played) = reader.next_message()? {
            if !replay.topics.accepts(&played.topic) {
                continue;
            }
            let since = played.time.saturating_sub(*first.get_or_insert(played.time));
            let due = begun + Duration::from_nanos(since).div_f64(replay.rate);
            self.relay_until(due).await?;
            self.publish(&played).await?;
        }
        if reader.is_truncated() {
            output::eprint_line(&format!(
                "{} is truncated; everything up to that point was published",
                replay.file.display()
            ));
        }
        Ok(first.is_some())
    }

    /// Waits until `due` and prints the daemon's status messages meanwhile.
    async fn relay_until(&mut self, due: Instant) -> anyhow::Result<()> {
        loop {
            tokio::select! {
                biased;
                () = sleep_until(due) => return Ok(()),
                message = self.inside.next() => {
                    let Some(message) = message? else { bail!("the servant has ended") };
                    self.complaints += relay_status(&message);
                }
            }
        }
    }

    async fn publish(&mut self, played: &RecordedMessage) -> anyhow::Result<()> {
        let encoding = self.inside.format.encoding();
        if played.encoding != encoding {
            let why = format!(
                "it is encoded as {:?}, but this servant expects {encoding} because its service uses {}; replay it to \
                    a service of the other ROS version",
                played.encoding,
                match self.inside.format {
                    recording::RecordingFormat::Ros1 => "ROS 1",
                    recording::RecordingFormat::Ros2 => "ROS 2",
                }
            );
            self.left_out.insert(played.topic.clone(), why);
            return Ok(());
        }
        let channel = match self.channels.get(&played.topic) {
            Some(channel) => *channel,
            None => self.advertise(&played.topic, &played.of).await?,
        };
        let message = MessageData::new(channel, &played.message[..]);
        self.inside.send(&message).await?;
        *self.published.entry(played.topic.clone()).or_default() += 1;
        Ok(())
    }

    async fn advertise(&mut self, topic: &str, of: &str) -> anyhow::Result<u32> {
        let channel = u32::try_from(self.channels.len())?;
        let format = self.inside.format;
        let schema = Schema::new(of, format.schema(), &b""[..]);
        let told = Channel::builder(channel, topic, format.encoding()).with_schema(schema);
        self.inside.send(&Advertise::new([told.build()?])).await?;
        self.channels.insert(topic.to_owned(), channel);
        Ok(channel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_more_than_nothing() {
        assert_eq!(rate("0.5").ok(), Some(0.5));
        for wrong in ["0", "-1", "nan", "inf", "fast"] {
            rate(wrong).expect_err(wrong);
        }
    }
}
