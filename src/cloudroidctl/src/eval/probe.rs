//! Asks a servant over the network that lies between here and the daemon, as a robot does: requests and answers are the bytes that
//! they are, in a WebSocket of the portal. Which input each recorded topic goes to, the daemon has said when it replayed the same.

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use anyhow::{Context, bail};
use api::interface::Direction;
use api::{Calibration, ServiceDetail, Size};
use bytes::Bytes;
use foxglove::ws_protocol::client::advertise::Channel;
use foxglove::ws_protocol::client::{Advertise, MessageData, Subscribe, Subscription};
use foxglove::ws_protocol::schema::Schema;
use foxglove::ws_protocol::server::ServerMessage;
use ros::bag::Recorded;
use ros::codec::{Time, header_stamp};
use ros::schema::Registry;
use tokio::time::{Instant, timeout_at};

use crate::client::{Client, escaped};
use crate::inside::{self, Inside};
use crate::output;

/// So much of a recording is used, as by the daemon.
pub const RECORDED: usize = 300;
/// Requests where nobody says how many, as with the daemon.
pub const REQUESTS: usize = 40;
/// How long an answer is waited for, and how long all may take.
const ANSWER: Duration = Duration::from_secs(10);
const WHOLE: Duration = Duration::from_secs(60);
/// So many requests in vain, one after the other, are enough.
const IN_VAIN: usize = 3;
/// Until one was answered, a request is made again after this and twice the longest time at the node: a node may begin to listen only when
/// it is listened to, and the first messages are lost.
const AGAIN: Duration = Duration::from_millis(500);
/// Longer pauses of a recording are cut to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// Messages of a topic that wait in the daemon.
const DEPTH: usize = 16;

/// What came of it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Asked {
    /// Times of the requests in milliseconds, from here to here; none of those that were not answered. The first that was answered is
    /// not among them, nor those before it; where none was answered, all are.
    pub times: Vec<Option<f64>>,
    /// Bytes of the largest request.
    pub request: usize,
    /// Bytes of the largest answer.
    pub answer: usize,
    /// The input that was asked.
    pub asked: Option<String>,
    /// The output that answered.
    pub answered_by: Option<String>,
    /// Why they ended before all were made.
    pub broken: Option<String>,
}

impl Asked {
    /// So many requests, none of which was answered.
    pub fn unanswered(requests: usize) -> Asked {
        Asked {
            times: vec![None; requests],
            ..Asked::default()
        }
    }

    /// It came to nothing.
    pub fn broken(why: String) -> Asked {
        Asked {
            broken: Some(why),
            ..Asked::default()
        }
    }

    /// Notes a request. Until one was answered (`warm`), topics are being connected.
    fn note(&mut self, took: Option<f64>, warm: &mut bool) {
        if took.is_some() && !std::mem::replace(warm, true) {
            self.times.clear();
        } else {
            self.times.push(took);
        }
    }
}

/// What is asked.
pub struct Probe<'a> {
    /// The service.
    pub service: &'a ServiceDetail,
    /// What the daemon has measured with the same recording.
    pub calibration: &'a Calibration,
    /// The recording.
    pub recorded: &'a [Recorded],
    /// The input whose messages are the requests; none: the first that the recording feeds.
    pub input: Option<&'a str>,
    /// The output whose messages are the answers; none: that whose message comes first.
    pub output: Option<&'a str>,
    /// Each request follows the answer before it.
    pub fast: bool,
    /// Requests whose times are wanted.
    pub requests: usize,
}

/// Definitions of a service's types.
#[derive(serde::Deserialize)]
struct Definitions {
    definitions: BTreeMap<String, String>,
}

impl Probe<'_> {
    /// Asks, and waits for the answers.
    pub async fn ask(&self, client: &Client, servant: &str) -> anyhow::Result<Asked> {
        let name = escaped(&self.calibration.service);
        let path = format!("/api/v1/services/{name}/interface");
        let Definitions { definitions } = client.get(&path).await?;
        let registry = Registry::from_definitions(&definitions)
            .with_context(|| format!("a definition of {}", self.calibration.service))?;
        let round = Round::of(self.calibration, self.recorded, self.input, self.fast);
        if round.items.is_empty() {
            bail!(
                "nothing of the recording goes to an input of {}",
                self.calibration.service
            );
        }
        let mut line = Line {
            inside: Inside::attach(client, servant, DEPTH).await?,
            service: self.service,
            output: self.output,
            registry,
            outputs: HashMap::new(),
            answering: None,
        };
        line.open(self.calibration).await?;
        let input = self.calibration.inputs.get(round.request);
        let mut asked = Asked {
            asked: input.map(|input| input.topic.clone()),
            ..Asked::default()
        };
        // What was answered before stays measured.
        if let Err(error) = self.asks(&mut line, &round, &mut asked).await {
            asked.broken = Some(format!("{error:#}"));
        }
        Ok(asked)
    }

    async fn asks(
        &self,
        line: &mut Line<'_>,
        round: &Round,
        asked: &mut Asked,
    ) -> anyhow::Result<()> {
        let ends = Instant::now() + WHOLE;
        let mut began = Instant::now();
        let (mut warm, mut in_vain) = (false, 0);
        for turn in 0.. {
            let now = Instant::now();
            if asked.times.len() >= self.requests || in_vain >= IN_VAIN || now >= ends {
                break;
            }
            let item = &round.items[turn % round.items.len()];
            let lap = u32::try_from(turn / round.items.len())?;
            let due = began + round.length * lap + item.at;
            // Of time that was lost, no more is made up for than lies between two requests.
            began += now
                .saturating_duration_since(due)
                .saturating_sub(round.gap());
            line.wait(due).await?;
            let mut since = Instant::now();
            let given_up = since + ANSWER;
            line.publish(item, given_up).await?;
            if item.input != round.request {
                continue;
            }
            asked.request = asked.request.max(item.bytes.len());
            let stamp = line.stamp(&self.calibration.inputs[item.input].type_name, &item.bytes);
            let answer = loop {
                let patience = if warm {
                    ANSWER
                } else {
                    again(self.calibration)
                };
                let until = given_up.min(since + patience);
                let answer = line.answer(stamp, until).await?;
                if answer.is_some() || until >= given_up {
                    break answer;
                }
                since = Instant::now();
                line.publish(item, given_up).await?;
            };
            in_vain = if answer.is_some() { 0 } else { in_vain + 1 };
            if let Some(answer) = &answer {
                asked.answer = asked.answer.max(answer.bytes);
                asked.answered_by = line.named(answer.output);
            }
            let took = answer.map(|answer| (answer.at - since).as_secs_f64() * 1000.0);
            asked.note(took, &mut warm);
        }
        Ok(())
    }
}

/// After which a request is made again that nobody may have heard.
fn again(calibration: &Calibration) -> Duration {
    let longest = super::measure::point(calibration).compute;
    let longest = longest.map_or(0.0, |compute| compute.max);
    AGAIN + Duration::from_secs_f64(longest * 2.0 / 1000.0).min(ANSWER)
}

/// An answer.
struct Answer {
    at: Instant,
    /// Number of the subscription.
    output: u32,
    bytes: usize,
}

/// The recording's messages that go to an input, once.
struct Round {
    items: Vec<Item>,
    /// Number of the input whose messages are requests.
    request: usize,
    /// From the first message to the first of the next round.
    length: Duration,
}

struct Item {
    /// Number among the inputs that the daemon has fed.
    input: usize,
    at: Duration,
    bytes: Bytes,
}

impl Round {
    fn of(
        calibration: &Calibration,
        recorded: &[Recorded],
        request: Option<&str>,
        fast: bool,
    ) -> Round {
        let inputs = &calibration.inputs;
        let mut round = Round {
            items: Vec::new(),
            request: request
                .and_then(|named| inputs.iter().position(|input| input.topic == named))
                .unwrap_or_default(),
            length: Duration::ZERO,
        };
        let mut before = None;
        for message in recorded {
            let goes = inputs.iter().position(|input| {
                let topic = &*message.topic;
                input.type_name == message.wire_type.name
                    && (input.topic == topic || input.from.iter().any(|from| from == topic))
            });
            let Some(input) = goes else { continue };
            if !fast {
                let pause = message.time.saturating_sub(before.unwrap_or(message.time));
                round.length += Duration::from_nanos(pause).min(LONGEST_PAUSE);
                before = Some(message.time.max(before.unwrap_or(0)));
            }
            round.items.push(Item {
                input,
                at: round.length,
                bytes: message.bytes.clone(),
            });
        }
        if let Some(pauses) = u32::try_from(round.items.len()).ok().filter(|n| *n > 1) {
            round.length += round.length / (pauses - 1);
        }
        round
    }

    /// Between two requests.
    fn gap(&self) -> Duration {
        let requests = self.items.iter().filter(|item| item.input == self.request);
        self.length / u32::try_from(requests.count().max(1)).unwrap_or(u32::MAX)
    }
}

/// The connection to the servant.
struct Line<'a> {
    inside: Inside,
    service: &'a ServiceDetail,
    /// The only output that is listened to.
    output: Option<&'a str>,
    registry: Registry,
    /// Names and types of outputs that are listened to, by subscription.
    outputs: HashMap<u32, (String, String)>,
    /// The output whose messages answer requests that have no stamp.
    answering: Option<u32>,
}

impl Line<'_> {
    /// Listens to the outputs, and advertises the inputs.
    async fn open(&mut self, calibration: &Calibration) -> anyhow::Result<()> {
        // The daemon tells which topics there are as soon as one has come.
        let deadline = Instant::now() + ANSWER;
        while self.outputs.is_empty() {
            if Instant::now() >= deadline {
                bail!(
                    "{} of {} is not published where it could be heard from here",
                    self.output.unwrap_or("any output"),
                    calibration.service
                );
            }
            self.heard(deadline).await?;
        }
        for (number, input) in (0..).zip(&calibration.inputs) {
            let format = self.inside.format;
            let schema = Schema::new(&*input.type_name, format.schema(), &b""[..]);
            let told = Channel::builder(number, &*input.topic, format.encoding());
            let told = told.with_schema(schema);
            self.inside.send(&Advertise::new([told.build()?])).await?;
        }
        Ok(())
    }

    async fn publish(&mut self, item: &Item, deadline: Instant) -> anyhow::Result<()> {
        let message = MessageData::new(u32::try_from(item.input)?, &item.bytes[..]);
        match timeout_at(deadline, self.inside.send(&message)).await {
            Ok(sent) => sent,
            // Half of a message may be on its way.
            Err(_) => bail!(
                "a request of {} was not taken within {} s",
                Size(item.bytes.len() as u64),
                ANSWER.as_secs()
            ),
        }
    }

    fn named(&self, output: u32) -> Option<String> {
        self.outputs.get(&output).map(|(name, _)| name.clone())
    }

    fn stamp(&self, type_name: &str, bytes: &[u8]) -> Option<Time> {
        header_stamp(&*self.registry.message(type_name).ok()?, bytes)
    }

    /// Until then, what comes answers nothing; also what has come by now.
    async fn wait(&mut self, due: Instant) -> anyhow::Result<()> {
        while self.next(due).await?.is_some() {}
        Ok(())
    }

    /// When the answer came, and its bytes: the first output with the request's stamp, or, where either has none, the next on the
    /// topic that answered the first request.
    async fn answer(
        &mut self,
        asked: Option<Time>,
        deadline: Instant,
    ) -> anyhow::Result<Option<Answer>> {
        loop {
            let Some(heard) = self.next(deadline).await? else {
                return Ok(None);
            };
            let Some((number, at, bytes)) = heard else {
                continue;
            };
            let stamp = self.outputs.get(&number);
            let stamp = stamp.and_then(|(_, type_name)| self.stamp(type_name, &bytes));
            let answers = match (asked, stamp) {
                (Some(asked), Some(stamp)) => asked == stamp,
                _ => *self.answering.get_or_insert(number) == number,
            };
            if answers {
                return Ok(Some(Answer {
                    at,
                    output: number,
                    bytes: bytes.len(),
                }));
            }
        }
    }

    async fn heard(&mut self, deadline: Instant) -> anyhow::Result<()> {
        self.next(deadline).await.map(drop)
    }

    /// The next that comes until then; none when it is time. Within it, a message of an output.
    async fn next(
        &mut self,
        deadline: Instant,
    ) -> anyhow::Result<Option<Option<(u32, Instant, Vec<u8>)>>> {
        let Ok(message) = timeout_at(deadline, self.inside.next_at()).await else {
            return Ok(None);
        };
        let Some((at, message)) = message? else {
            bail!("the measured servant has ended while it was asked over the network")
        };
        match inside::read(&message) {
            Some(ServerMessage::MessageData(told)) => {
                return Ok(Some(Some((told.subscription_id, at, told.data.to_vec()))));
            }
            Some(ServerMessage::Advertise(told)) => {
                for channel in told.channels {
                    self.listen(channel.id, &channel.topic).await?;
                }
            }
            Some(ServerMessage::Status(told)) => output::complain(&told.message),
            _ => {}
        }
        Ok(Some(None))
    }

    async fn listen(&mut self, channel: u64, topic: &str) -> anyhow::Result<()> {
        // Latched outputs tell a state; they answer nothing.
        let output = self.service.interface.topics.iter().find(|known| {
            known.direction == Direction::Output
                && known.name == *topic
                && self.output.map_or(!known.latched, |only| only == topic)
        });
        let Some(output) = output else { return Ok(()) };
        let number = u32::try_from(self.outputs.len())? + 1;
        self.outputs
            .insert(number, (output.name.clone(), output.type_name.clone()));
        let wanted = Subscribe::new([Subscription::new(number, channel)]);
        self.inside.send(&wanted).await
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use api::trial::Fed;
    use ros::bus::WireType;

    use super::*;

    fn recorded(topic: &str, type_name: &str, millis: u64) -> Recorded {
        Recorded {
            topic: topic.into(),
            wire_type: Arc::new(WireType::new(type_name, "x", "")),
            time: millis * 1_000_000,
            bytes: Bytes::from_static(b"\0\0\0\0"),
        }
    }

    fn fed(topic: &str, type_name: &str, from: &[&str]) -> Fed {
        Fed {
            topic: topic.into(),
            type_name: type_name.into(),
            sent: 1,
            from: from.iter().map(|topic| (*topic).to_owned()).collect(),
        }
    }

    #[test]
    fn requests_before_the_first_answer_count_where_none_comes() {
        let noted = |all: &[Option<f64>]| {
            let (mut asked, mut warm) = (Asked::default(), false);
            all.iter().for_each(|took| asked.note(*took, &mut warm));
            asked.times
        };
        assert_eq!(noted(&[None; 3]), [None; 3]);
        assert_eq!(
            noted(&[None, Some(9.0), Some(2.0), None]),
            [Some(2.0), None]
        );
        assert_eq!(noted(&[Some(9.0), None]), [None]);
    }

    #[test]
    fn the_first_request_is_made_again_soon_but_not_before_a_slow_node_can_answer() {
        let again = |compute: f64| again(&crate::eval::side::tests::calibration(1.0, compute, 20));
        assert_eq!(again(24.0), AGAIN + Duration::from_millis(48));
        assert!(again(4000.0) > Duration::from_secs(8));
    }

    #[test]
    fn recorded_messages_go_where_the_daemon_sent_them_at_their_pace() {
        let calibration = Calibration {
            inputs: vec![
                fed("/say", "std_msgs/String", &["/chatter"]),
                fed("/count", "std_msgs/Int32", &[]),
            ],
            ..Calibration::default()
        };
        let bag = [
            recorded("/chatter", "std_msgs/String", 1000),
            recorded("/tf", "tf2_msgs/TFMessage", 1050),
            recorded("/count", "std_msgs/Int32", 1100),
            // After a minute of nothing.
            recorded("/chatter", "std_msgs/String", 61_100),
        ];
        let round = Round::of(&calibration, &bag, Some("/count"), false);
        let told: Vec<(usize, u128)> = round
            .items
            .iter()
            .map(|item| (item.input, item.at.as_millis()))
            .collect();
        assert_eq!(told, [(0, 0), (1, 100), (0, 1100)]);
        assert_eq!((round.request, round.length.as_millis()), (1, 1650));
        assert_eq!(round.gap().as_millis(), 1650);
        let fast = Round::of(&calibration, &bag, None, true);
        assert_eq!((fast.request, fast.length), (0, Duration::ZERO));
        assert!(fast.items.iter().all(|item| item.at.is_zero()));
    }
}
