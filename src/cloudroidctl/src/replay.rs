//! `replay`: what a file holds, into a servant, at its times.

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use foxglove::ws_protocol::client::advertise::Channel;
use foxglove::ws_protocol::client::{Advertise, MessageData};
use foxglove::ws_protocol::schema::Schema;
use foxglove::ws_protocol::server::ServerMessage;
use foxglove::ws_protocol::server::status::Level;
use recording::{Played, Reader};
use tokio::time::{Instant, sleep_until};
use tokio_tungstenite::tungstenite::Message;

use crate::client::Client;
use crate::inside::{self, Inside};
use crate::output::{self, Format};
use crate::topics::Topics;

/// Messages of a topic that wait for a node that is slow.
const DEPTH: usize = 1000;

/// Publish the messages of an MCAP file in a servant of the same ROS, as far apart as they were recorded.
#[derive(Debug, clap::Args)]
pub struct Replay {
    /// The file, such as record writes.
    file: PathBuf,
    /// The servant's id, or the name of a service that has one servant.
    #[arg(long, value_name = "SERVANT")]
    to: String,
    #[command(flatten)]
    topics: Topics,
    /// So many times as fast as they were recorded.
    #[arg(short, long, value_name = "FACTOR", default_value_t = 1.0, value_parser = rate)]
    rate: f64,
    /// Begin again at the end, until Ctrl-C.
    #[arg(short = 'l', long = "loop")]
    again: bool,
}

fn rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().map_err(|_| "it is no number".to_owned())?;
    match rate.is_finite() && rate > 0.0 {
        true => Ok(rate),
        false => Err("it must be more than 0".to_owned()),
    }
}

impl Replay {
    /// Publishes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        // Before anybody is asked: what cannot be read is said first.
        if let Err(error) = Reader::open(&self.file).and_then(|mut file| file.next_message()) {
            let hint = "; cloudroidctl record writes such, and `mcap convert` makes one of a bag";
            match error {
                recording::Error::NoRecording { .. } => bail!("{error}{hint}"),
                error => return Err(error.into()),
            }
        }
        let servant = inside::servant(client, &self.to).await?;
        let mut player = Player {
            inside: Inside::attach(client, &servant, DEPTH).await?,
            channels: HashMap::new(),
            published: BTreeMap::new(),
            left_out: BTreeMap::new(),
            complaints: 0,
        };
        let played = async {
            loop {
                let published = player.plays(&self).await?;
                if !self.again || !published {
                    return anyhow::Ok(());
                }
            }
        };
        tokio::select! {
            played = played => played?,
            _ = tokio::signal::ctrl_c() => {}
        }
        let Player {
            inside,
            published,
            left_out,
            mut complaints,
            ..
        } = player;
        for message in inside.leave().await {
            complaints += told(&message);
        }
        for (topic, why) in &left_out {
            output::complain(&format!("{topic} was left out: {why}"));
        }
        if published.is_empty() {
            bail!(
                "nothing of {} was published: it holds no message of a wanted topic",
                self.file.display()
            );
        }
        match format {
            Format::Json => output::json(&published)?,
            Format::Table => {
                let mut table = output::Table::new(&["TOPIC", "MESSAGES"]);
                for (topic, messages) in &published {
                    table.row([topic.clone(), messages.to_string()]);
                }
                table.print()?;
            }
        }
        if complaints > 0 {
            bail!(
                "not all of {} was published: the words above say why; --topic names what to play, and push --with DEBIAN-PACKAGE adds definitions to an image",
                self.file.display()
            );
        }
        Ok(())
    }
}

struct Player {
    inside: Inside,
    /// By topic.
    channels: HashMap<String, u32>,
    /// How many messages, by topic.
    published: BTreeMap<String, u64>,
    /// Topics, and why.
    left_out: BTreeMap<String, String>,
    /// How often the daemon refused something.
    complaints: usize,
}

/// Passes on what the daemon says; 1 where it is a refusal.
fn told(message: &Message) -> usize {
    let Some(ServerMessage::Status(told)) = inside::read(message) else {
        return 0;
    };
    output::complain(&told.message);
    usize::from(told.level == Level::Error)
}

impl Player {
    /// Plays the file once; whether there was anything.
    async fn plays(&mut self, replay: &Replay) -> anyhow::Result<bool> {
        let mut reader = Reader::open(&replay.file)?;
        let mut first = None;
        let begun = Instant::now();
        while let Some(played) = reader.next_message()? {
            if !replay.topics.want(&played.topic) {
                continue;
            }
            let since = played
                .time
                .saturating_sub(*first.get_or_insert(played.time));
            let due = begun + Duration::from_nanos(since).div_f64(replay.rate);
            self.wait(due).await?;
            self.publish(&played).await?;
        }
        if reader.breaks_off() {
            output::complain(&format!(
                "{} breaks off; what it holds up to there was published",
                replay.file.display()
            ));
        }
        Ok(first.is_some())
    }

    /// Until then, what the daemon says is passed on.
    async fn wait(&mut self, due: Instant) -> anyhow::Result<()> {
        loop {
            tokio::select! {
                biased;
                () = sleep_until(due) => return Ok(()),
                message = self.inside.next() => {
                    let Some(message) = message? else { bail!("the servant has ended") };
                    self.complaints += told(&message);
                }
            }
        }
    }

    async fn publish(&mut self, played: &Played) -> anyhow::Result<()> {
        let encoding = self.inside.format.encoding();
        if played.encoding != encoding {
            let why = format!(
                "it is written as {:?}, and this servant takes {encoding}: its service is of {}; replay it to one of the other ROS",
                played.encoding,
                match self.inside.format {
                    recording::Format::Ros1 => "ROS 1",
                    recording::Format::Ros2 => "ROS 2",
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
        assert_eq!(rate("0.5"), Ok(0.5));
        for wrong in ["0", "-1", "nan", "inf", "fast"] {
            rate(wrong).expect_err(wrong);
        }
    }
}
