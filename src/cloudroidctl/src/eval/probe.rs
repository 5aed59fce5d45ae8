//! Sends requests to a servant over the network between this machine and the daemon, as a robot does: requests and
//! answers are serialized messages in a WebSocket of the portal. The mapping of recorded topics to inputs is the one
//! that the daemon reported when it replayed the same recording.

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
use ros::bag::BagMessage;
use ros::codec::{Time, header_stamp};
use ros::schema::Registry;
use tokio::time::{Instant, timeout_at};

use crate::client::{DaemonClient, percent_encode};
use crate::inside::{self, FoxgloveSession};
use crate::output;

/// Number of messages of a recording that are used, as by the daemon.
pub const MAX_RECORDED: usize = 300;
/// Default number of requests, as by the daemon.
pub const REQUESTS: usize = 40;
/// Time allowed for one answer, and for all requests.
const ANSWER: Duration = Duration::from_secs(10);
const WHOLE: Duration = Duration::from_secs(60);
/// Number of consecutive unanswered requests after which the probe stops.
const IN_VAIN: usize = 3;
/// Until one request was answered, each is repeated after this time plus twice the longest response time at the node: a
/// node may subscribe only when it has subscribers itself, so the first messages are lost.
const AGAIN: Duration = Duration::from_millis(500);
/// Longer pauses of a recording are shortened to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// Length of the daemon's queue for each topic.
const DEPTH: usize = 16;

/// Outcome of a probe.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ProbeOutcome {
    /// Response times in milliseconds, measured here; `None` for requests that were not answered. The first answered
    /// request and those before it are not included, unless none was answered.
    pub times: Vec<Option<f64>>,
    /// Size of the largest request in bytes.
    pub request: usize,
    /// Size of the largest answer in bytes.
    pub answer: usize,
    /// Input that was sent the requests.
    pub asked: Option<String>,
    /// Output that answered.
    pub answered_by: Option<String>,
    /// Reason why the probe stopped before all requests were sent.
    pub broken: Option<String>,
}

impl ProbeOutcome {
    /// Creates the outcome of requests of which none was answered.
    pub fn without_answers(requests: usize) -> ProbeOutcome {
        ProbeOutcome { times: vec![None; requests], ..ProbeOutcome::default() }
    }

    /// Creates the outcome of a probe that failed before its first request.
    pub fn from_failure(why: String) -> ProbeOutcome {
        ProbeOutcome { broken: Some(why), ..ProbeOutcome::default() }
    }

    /// Records a request. Until one was answered (`warm`), topics are still being connected.
    fn record(&mut self, took: Option<f64>, warm: &mut bool) {
        if took.is_some() && !std::mem::replace(warm, true) {
            self.times.clear();
        } else {
            self.times.push(took);
        }
    }
}

/// Parameters of a probe.
pub struct NetworkProbe<'a> {
    /// Service under test.
    pub service: &'a ServiceDetail,
    /// The daemon's measurement with the same recording.
    pub calibration: &'a Calibration,
    /// Messages of the recording.
    pub recorded: &'a [BagMessage],
    /// Input whose messages are the requests; `None` for the first that the recording feeds.
    pub input: Option<&'a str>,
    /// Output whose messages are the answers; `None` for the first one to publish.
    pub output: Option<&'a str>,
    /// Send each request as soon as the previous one is answered.
    pub fast: bool,
    /// Number of requests to measure.
    pub requests: usize,
}

/// Definitions of a service's types.
#[derive(serde::Deserialize)]
struct Definitions {
    definitions: BTreeMap<String, String>,
}

impl NetworkProbe<'_> {
    /// Sends the requests and waits for the answers.
    pub async fn run(&self, client: &DaemonClient, servant: &str) -> anyhow::Result<ProbeOutcome> {
        let name = percent_encode(&self.calibration.service);
        let path = format!("/api/v1/services/{name}/interface");
        let Definitions { definitions } = client.get(&path).await?;
        let registry = Registry::from_definitions(&definitions)
            .with_context(|| format!("invalid message definition of {}", self.calibration.service))?;
        let round = ReplayRound::from_recording(self.calibration, self.recorded, self.input, self.fast);
        if round.items.is_empty() {
            bail!("the recording has no messages for an input of {}", self.calibration.service);
        }
        let mut line = ProbeConnection {
            inside: FoxgloveSession::attach(client, servant, DEPTH).await?,
            service: self.service,
            output: self.output,
            registry,
            outputs: HashMap::new(),
            answering: None,
        };
        line.open(self.calibration).await?;
        let input = self.calibration.inputs.get(round.request);
        let mut asked = ProbeOutcome { asked: input.map(|input| input.topic.clone()), ..ProbeOutcome::default() };
        // Requests that were answered before an error stay in the outcome.
        if let Err(error) = self.send_requests(&mut line, &round, &mut asked).await {
            asked.broken = Some(format!("{error:#}"));
        }
        Ok(asked)
    }

    async fn send_requests(
        &self,
        line: &mut ProbeConnection<'_>,
        round: &ReplayRound,
        asked: &mut ProbeOutcome,
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
            // Lost time is made up for by at most one interval between requests.
            began += now.saturating_duration_since(due).saturating_sub(round.request_interval());
            line.drain_until(due).await?;
            let mut since = Instant::now();
            let given_up = since + ANSWER;
            line.publish(item, given_up).await?;
            if item.input != round.request {
                continue;
            }
            asked.request = asked.request.max(item.bytes.len());
            let stamp = line.stamp(&self.calibration.inputs[item.input].type_name, &item.bytes);
            let answer = loop {
                let patience = if warm { ANSWER } else { retry_interval(self.calibration) };
                let until = given_up.min(since + patience);
                let answer = line.wait_for_answer(stamp, until).await?;
                if answer.is_some() || until >= given_up {
                    break answer;
                }
                since = Instant::now();
                line.publish(item, given_up).await?;
            };
            in_vain = if answer.is_some() { 0 } else { in_vain + 1 };
            if let Some(answer) = &answer {
                asked.answer = asked.answer.max(answer.bytes);
                asked.answered_by = line.output_name(answer.output);
            }
            let took = answer.map(|answer| (answer.at - since).as_secs_f64() * 1000.0);
            asked.record(took, &mut warm);
        }
        Ok(())
    }
}

/// Returns the time after which a request is repeated that may not have been received.
fn retry_interval(calibration: &Calibration) -> Duration {
    let longest = super::side::only_point(calibration).compute;
    let longest = longest.map_or(0.0, |compute| compute.max);
    AGAIN + Duration::from_secs_f64(longest * 2.0 / 1000.0).min(ANSWER)
}

/// An answer.
struct ProbeAnswer {
    at: Instant,
    /// Id of the subscription.
    output: u32,
    bytes: usize,
}

/// One round of the recording's messages that go to an input.
struct ReplayRound {
    items: Vec<ReplayMessage>,
    /// Index of the input whose messages are requests.
    request: usize,
    /// Time from the first message to the first of the next round.
    length: Duration,
}

struct ReplayMessage {
    /// Index of the input, among those that the daemon has fed.
    input: usize,
    at: Duration,
    bytes: Bytes,
}

impl ReplayRound {
    fn from_recording(
        calibration: &Calibration,
        recorded: &[BagMessage],
        request: Option<&str>,
        fast: bool,
    ) -> ReplayRound {
        let inputs = &calibration.inputs;
        let mut round = ReplayRound {
            items: Vec::new(),
            request: request.and_then(|named| inputs.iter().position(|input| input.topic == named)).unwrap_or_default(),
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
            round.items.push(ReplayMessage { input, at: round.length, bytes: message.bytes.clone() });
        }
        if let Some(pauses) = u32::try_from(round.items.len()).ok().filter(|n| *n > 1) {
            round.length += round.length / (pauses - 1);
        }
        round
    }

    /// Returns the mean interval between two requests.
    fn request_interval(&self) -> Duration {
        let requests = self.items.iter().filter(|item| item.input == self.request);
        self.length / u32::try_from(requests.count().max(1)).unwrap_or(u32::MAX)
    }
}

/// Connection to the servant.
struct ProbeConnection<'a> {
    inside: FoxgloveSession,
    service: &'a ServiceDetail,
    /// Output to subscribe to; `None` for all that are not latched.
    output: Option<&'a str>,
    registry: Registry,
    /// Names and types of the subscribed outputs, by subscription id.
    outputs: HashMap<u32, (String, String)>,
    /// Output whose messages answer requests without a stamp.
    answering: Option<u32>,
}

impl ProbeConnection<'_> {
    /// Subscribes to the outputs and advertises the inputs.
    async fn open(&mut self, calibration: &Calibration) -> anyhow::Result<()> {
        // The daemon advertises its topics when a client has connected.
        let deadline = Instant::now() + ANSWER;
        while self.outputs.is_empty() {
            if Instant::now() >= deadline {
                bail!(
                    "cannot receive {} of {}: the daemon does not advertise it to this client",
                    self.output.unwrap_or("any output"),
                    calibration.service
                );
            }
            self.process_next(deadline).await?;
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

    async fn publish(&mut self, item: &ReplayMessage, deadline: Instant) -> anyhow::Result<()> {
        let message = MessageData::new(u32::try_from(item.input)?, &item.bytes[..]);
        match timeout_at(deadline, self.inside.send(&message)).await {
            Ok(sent) => sent,
            // The message may have been sent in part.
            Err(_) => {
                bail!("a request of {} was not sent within {} s", Size(item.bytes.len() as u64), ANSWER.as_secs())
            }
        }
    }

    fn output_name(&self, output: u32) -> Option<String> {
        self.outputs.get(&output).map(|(name, _)| name.clone())
    }

    fn stamp(&self, type_name: &str, bytes: &[u8]) -> Option<Time> {
        header_stamp(&*self.registry.message(type_name).ok()?, bytes)
    }

    /// Processes messages until `due`; none of them is an answer. Also clears messages that have arrived by now.
    async fn drain_until(&mut self, due: Instant) -> anyhow::Result<()> {
        while self.next_message(due).await?.is_some() {}
        Ok(())
    }

    /// Waits for the answer to a request: the first output with the request's stamp, or, if either has no stamp, the
    /// next message on the topic that answered the first request.
    async fn wait_for_answer(&mut self, asked: Option<Time>, deadline: Instant) -> anyhow::Result<Option<ProbeAnswer>> {
        loop {
            let Some(heard) = self.next_message(deadline).await? else {
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
                return Ok(Some(ProbeAnswer { at, output: number, bytes: bytes.len() }));
            }
        }
    }

    async fn process_next(&mut self, deadline: Instant) -> anyhow::Result<()> {
        self.next_message(deadline).await.map(drop)
    }

    /// Returns the next event before the deadline, `None` at the deadline. The inner value is a message of an output,
    /// if the event is one.
    async fn next_message(&mut self, deadline: Instant) -> anyhow::Result<Option<Option<(u32, Instant, Vec<u8>)>>> {
        let Ok(message) = timeout_at(deadline, self.inside.next_timed()).await else {
            return Ok(None);
        };
        let Some((at, message)) = message? else { bail!("the servant ended during the measurement over the network") };
        match inside::parse_message(&message) {
            Some(ServerMessage::MessageData(told)) => {
                return Ok(Some(Some((told.subscription_id, at, told.data.to_vec()))));
            }
            Some(ServerMessage::Advertise(told)) => {
                for channel in told.channels {
                    self.subscribe(channel.id, &channel.topic).await?;
                }
            }
            Some(ServerMessage::Status(told)) => output::eprint_line(&told.message),
            _ => {}
        }
        Ok(Some(None))
    }

    async fn subscribe(&mut self, channel: u64, topic: &str) -> anyhow::Result<()> {
        // Latched outputs publish a state and answer no request.
        let output = self.service.interface.topics.iter().find(|known| {
            known.direction == Direction::Output
                && known.name == *topic
                && self.output.map_or(!known.latched, |only| only == topic)
        });
        let Some(output) = output else { return Ok(()) };
        let number = u32::try_from(self.outputs.len())? + 1;
        self.outputs.insert(number, (output.name.clone(), output.type_name.clone()));
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

    fn recorded_message(topic: &str, type_name: &str, millis: u64) -> BagMessage {
        BagMessage {
            topic: topic.into(),
            wire_type: Arc::new(WireType::new(type_name, "x", "")),
            time: millis * 1_000_000,
            bytes: Bytes::from_static(b"\0\0\0\0"),
        }
    }

    fn fed_input(topic: &str, type_name: &str, from: &[&str]) -> Fed {
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
            let (mut asked, mut warm) = (ProbeOutcome::default(), false);
            all.iter().for_each(|took| asked.record(*took, &mut warm));
            asked.times
        };
        assert_eq!(noted(&[None; 3]), [None; 3]);
        assert_eq!(noted(&[None, Some(9.0), Some(2.0), None]), [Some(2.0), None]);
        assert_eq!(noted(&[Some(9.0), None]), [None]);
    }

    #[test]
    fn the_first_request_is_made_again_soon_but_not_before_a_slow_node_can_answer() {
        let again = |compute: f64| retry_interval(&crate::eval::side::tests::calibration(1.0, compute, 20));
        assert_eq!(again(24.0), AGAIN + Duration::from_millis(48));
        assert!(again(4000.0) > Duration::from_secs(8));
    }

    #[test]
    fn recorded_messages_go_where_the_daemon_sent_them_at_their_pace() {
        let calibration = Calibration {
            inputs: vec![
                fed_input("/say", "std_msgs/String", &["/chatter"]),
                fed_input("/count", "std_msgs/Int32", &[]),
            ],
            ..Calibration::default()
        };
        let bag = [
            recorded_message("/chatter", "std_msgs/String", 1000),
            recorded_message("/tf", "tf2_msgs/TFMessage", 1050),
            recorded_message("/count", "std_msgs/Int32", 1100),
            // After a minute without messages.
            recorded_message("/chatter", "std_msgs/String", 61_100),
        ];
        let round = ReplayRound::from_recording(&calibration, &bag, Some("/count"), false);
        let told: Vec<(usize, u128)> = round.items.iter().map(|item| (item.input, item.at.as_millis())).collect();
        assert_eq!(told, [(0, 0), (1, 100), (0, 1100)]);
        assert_eq!((round.request, round.length.as_millis()), (1, 1650));
        assert_eq!(round.request_interval().as_millis(), 1650);
        let fast = ReplayRound::from_recording(&calibration, &bag, None, true);
        assert_eq!((fast.request, fast.length), (0, Duration::ZERO));
        assert!(fast.items.iter().all(|item| item.at.is_zero()));
    }
}
