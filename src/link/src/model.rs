//! A model test of both ends of a link: two [`Outgoing`] and two [`Incoming`], the frames in flight between them, and
//! faults.
//!
//! The following holds for any sequence of messages, control messages, calls, responses and lines, and any combination
//! of lost connections with everything in flight, lost welcomes, delayed hellos of displaced connections, and restarts
//! of either end:
//!
//! 1. Control messages arrive in the order in which they were sent, each once. A resumed session loses none.
//! 2. Calls and goals arrive in the order in which they were made, each once, over all topics and services; a cancel
//!    never overtakes its goal. Responses arrive each once.
//! 3. No message arrives before its channel was opened or after it was closed.
//! 4. Messages of a topic arrive in the order in which they were published, none twice. While the link stands, the
//!    newest one always arrives; of those that all must be delivered, each; and any other one arrives or is counted as
//!    dropped.
//! 5. No end sends anything that exceeds the limits announced by its peer, so no session ends because of permitted
//!    input.
//! 6. What is queued, kept and in flight stays below its limits, in number and in bytes, and is released once it is
//!    acknowledged. The bytes that one end has sent are those that the other one has received.
//! 7. Lines arrive in order, and the number of omitted lines is reported.
//! 8. Whatever is queued is sent in the end.

use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

use budget::Budget;
use bytes::{BufMut, Bytes, BytesMut};
use proptest::prelude::*;
use proptest::test_runner::{TestCaseResult, TestRunner};
use ros::ring::Ring;

use crate::frame::Frame;
use crate::incoming::Incoming;
use crate::limits::{LinkLimits, WAITING};
use crate::outgoing::{DeliveryMode, Outgoing};
use crate::record::{Call, Data, InputTiming, Record};

/// The lowest limits that an end may announce.
const LIMITS: LinkLimits =
    LinkLimits { record: 1 << 20, under_way: 8, under_way_bytes: 1 << 20, ahead: 256, told: 1 << 20 };
/// Channels of messages have lower numbers, those of goals start here.
const GOALS: u32 = 12;
/// Maximum age of a message, in milliseconds of the model.
const MAX_AGE: i64 = 50;
/// Maximum number of records in a burst.
const BURST: usize = 100;
/// A length that makes a message the only one that its topic keeps.
const BIG: usize = 40_000;
/// Number of rounds in which everything arrives.
const ROUNDS: usize = 2000;

static ZEROS: [u8; LIMITS.record + 1] = [0; LIMITS.record + 1];

/// Counts of what an end has sent, or received.
#[derive(Debug, Default)]
struct Ledger {
    orders: u32,
    /// Calls and goals.
    calls: u32,
    answers: BTreeSet<u32>,
    lines: u32,
    messages: u64,
    /// Messages that must all be delivered.
    each: u64,
    /// Number of the last message of each channel.
    newest: BTreeMap<u32, i64>,
    /// Open channels.
    channels: BTreeSet<u32>,
}

/// One end: its state, what it has sent and received, and its frames in flight.
struct ModelEnd {
    out: Outgoing,
    incoming: Incoming,
    budget: Budget,
    wire: VecDeque<Frame>,
    sent: Ledger,
    received: Ledger,
    /// Channels that were closed and are never opened again.
    gone: BTreeSet<u32>,
    /// The message that is being encoded.
    encoding: Option<Bytes>,
    /// More messages waited on a topic than are kept of those that must all be delivered.
    was_crowded: bool,
}

impl ModelEnd {
    fn new() -> Self {
        let budget = Budget::new("an end of the model", 1 << 30);
        let mut end = Self {
            out: Outgoing::new(Some(MAX_AGE)),
            incoming: Incoming::default(),
            budget,
            wire: VecDeque::new(),
            sent: Ledger::default(),
            received: Ledger::default(),
            gone: BTreeSet::new(),
            encoding: None,
            was_crowded: false,
        };
        end.out.permit = Some(end.budget.permit());
        end.out.set_limits(LIMITS);
        end.out.encoding.pays = true;
        end.incoming.limits = LIMITS;
        end
    }

    fn next_control(&mut self, kind: u8, channel: u32, size: usize) -> Record {
        self.sent.orders += 1;
        control(kind, self.sent.orders, channel, size)
    }

    fn push(&mut self, step: &ModelStep, now: i64) {
        match *step {
            ModelStep::Goal(channel, _) | ModelStep::Publish(channel, ..) if self.gone.contains(&channel) => {}
            ModelStep::Tell(size) => {
                let record = self.next_control(b'T', 0, size);
                self.out.push(&record, DeliveryMode::Each);
            }
            ModelStep::Call(size) => {
                self.sent.calls += 1;
                let call = Record::Call(Call { id: self.sent.calls, service: 1, request: make_zeros(size) });
                self.out.push(&call, DeliveryMode::Each);
            }
            ModelStep::Answer(size) => {
                let id = self.sent.answers.len() as u32;
                self.sent.answers.insert(id);
                let answer = Record::Answer { id, taken: 0, given: 0, response: Ok(make_zeros(size)) };
                self.out.push(&answer, DeliveryMode::Each);
            }
            ModelStep::Goal(channel, size) => {
                self.open(channel, size);
                self.sent.calls += 1;
                let goal = data(channel, (now, self.sent.calls.into()), true, size);
                self.out.push(&goal, DeliveryMode::InOrder);
            }
            ModelStep::Publish(channel, size, each) => self.publish(channel, now, size, each),
            ModelStep::Close(channel) if self.sent.channels.remove(&channel) => {
                self.gone.insert(channel);
                // The close arrives after everything queued on the channel, independently of other control messages.
                let record = control(b'C', 0, channel, 0);
                self.out.close_channel(channel, &record);
            }
            ModelStep::Print(size) => {
                self.sent.lines += 1;
                let line = control(b'L', self.sent.lines, 0, size);
                self.out.push_line(&line);
            }
            ModelStep::Encode => match self.encoding.take() {
                Some(message) => {
                    let frame = message.slice(..message.len() / 2);
                    self.out.encoding.finish(Some((frame, std::time::Duration::ZERO)));
                }
                None => self.encoding = self.out.encoding.take().map(|(_, message, _)| message),
            },
            _ => {}
        }
    }

    fn publish(&mut self, channel: u32, now: i64, size: usize, each: bool) {
        self.open(channel, size.min(BIG));
        let number = self.sent.newest.entry(channel).or_default();
        *number += 1;
        self.sent.messages += 1;
        self.sent.each += u64::from(each);
        let quality = if each { DeliveryMode::Each } else { DeliveryMode::Newest };
        self.out.push(&data(channel, (now, *number), each, size), quality);
    }

    fn open(&mut self, channel: u32, size: usize) {
        if self.sent.channels.insert(channel) {
            let record = self.next_control(b'O', channel, size);
            self.out.push(&record, DeliveryMode::Each);
            self.out.open_channel(channel);
        }
    }

    /// Receives a frame from the other end and checks the record that it completes.
    fn take(&mut self, frame: Frame) -> TestCaseResult {
        let record = match frame {
            Frame::Whole { number, record } => self.incoming.receive_whole(number, record),
            Frame::Begin { stream, number, total, bytes } => self.incoming.receive_begin(stream, number, total, &bytes),
            Frame::More { stream, bytes } => self.incoming.receive_more(stream, &bytes),
            Frame::Ack(received) => {
                self.out.acknowledge(received.number);
                Ok(None)
            }
            other => panic!("{other:?}"),
        };
        let record = record.map_err(|error| TestCaseError::fail(format!("refused: {error}")))?;
        match record.map(Record::decode).transpose() {
            Ok(None) => Ok(()),
            Ok(Some(Record::Control(text))) => self.check_control(&text),
            Ok(Some(Record::Call(Call { id, .. }))) => self.check_call(id),
            Ok(Some(Record::Answer { id, .. })) => {
                prop_assert!(self.received.answers.insert(id), "answer {} comes twice", id);
                Ok(())
            }
            Ok(Some(Record::Data(data))) => self.check_message(&data),
            Err(error) => Err(TestCaseError::fail(error.to_string())),
        }
    }

    fn check_control(&mut self, text: &[u8]) -> TestCaseResult {
        let word = |at: usize| u32::from_le_bytes(text[at..at + 4].try_into().unwrap());
        let received = &mut self.received;
        match text[0] {
            b'{' => {
                let text = String::from_utf8_lossy(text);
                let digits = text.split('[').nth(1).and_then(|text| text.split(' ').next());
                received.lines += digits.unwrap().parse::<u32>().unwrap();
            }
            b'L' => {
                received.lines += 1;
                prop_assert_eq!(word(1), received.lines, "a line before others that were not told of");
            }
            b'C' => prop_assert!(received.channels.remove(&word(5)), "closed and not open"),
            kind => {
                received.orders += 1;
                prop_assert_eq!(word(1), received.orders, "an order out of its order");
                if kind == b'O' {
                    received.channels.insert(word(5));
                }
            }
        }
        Ok(())
    }

    fn check_call(&mut self, number: u32) -> TestCaseResult {
        self.received.calls += 1;
        prop_assert_eq!(number, self.received.calls, "a call or goal out of its order");
        Ok(())
    }

    fn check_message(&mut self, data: &Data) -> TestCaseResult {
        let received = &mut self.received;
        prop_assert!(received.channels.contains(&data.channel), "{} is not open", data.channel);
        let InputTiming { born: number, serialise: each, .. } = data.answered.unwrap();
        if data.channel >= GOALS {
            return self.check_call(number as u32);
        }
        received.messages += 1;
        received.each += u64::from(each);
        let before = received.newest.insert(data.channel, number);
        prop_assert!(before < Some(number), "message {} of topic {} after {:?}", number, data.channel, before);
        Ok(())
    }

    /// Checks that what is queued, kept and in flight is within the limits.
    fn check(&mut self) -> TestCaseResult {
        let (_, ahead) = self.incoming.received_numbers();
        prop_assert!(ahead.len() <= LIMITS.ahead);
        prop_assert!(self.out.unacknowledged_count() <= LIMITS.ahead);
        let (under_way, bytes) = (self.incoming.streams.len(), self.incoming.partial);
        prop_assert!(under_way <= LIMITS.under_way && bytes <= LIMITS.under_way_bytes);
        for waiting in self.out.topics.values().map(Ring::len) {
            // Records that were sent and not received are queued again.
            prop_assert!(waiting <= WAITING.messages + LIMITS.ahead, "{}", waiting);
            self.was_crowded |= waiting > WAITING.messages - BURST;
        }
        Ok(())
    }

    /// Returns whether everything that was queued has been sent and acknowledged.
    fn is_through(&self) -> bool {
        self.out.is_empty() && self.out.unacknowledged_count() == 0 && self.wire.is_empty()
    }

    /// Returns the number of messages that were counted as dropped.
    fn count_dropped(&self) -> u64 {
        self.out.dropped.iter().map(|(_, _, count)| count).sum()
    }
}

fn make_zeros(size: usize) -> Bytes {
    Bytes::from_static(&ZEROS[..size])
}

fn control(kind: u8, number: u32, channel: u32, size: usize) -> Record {
    let mut text = BytesMut::new();
    text.put_u8(kind);
    text.put_u32_le(number);
    text.put_u32_le(channel);
    text.put_bytes(0, size);
    Record::Control(text.freeze())
}

/// Creates a message with a number, in the place of the input that it answers.
fn data(channel: u32, (born, number): (i64, i64), each: bool, size: usize) -> Record {
    let answered = InputTiming { born: number, serialise: u32::from(each), left: 0, taken: 0, given: 0 };
    Record::Data(Data {
        channel,
        encoded: false,
        latching: false,
        born,
        left: 0,
        serialise: 0,
        answered: Some(answered),
        message: make_zeros(size),
    })
}

#[derive(Debug, Clone)]
enum ModelStep {
    Tell(usize),
    Call(usize),
    Answer(usize),
    Goal(u32, usize),
    Publish(u32, usize, bool),
    Close(u32),
    Print(usize),
    /// The step is taken this many times.
    Burst(usize, Box<ModelStep>),
    /// The encoder takes a message, or is done with one.
    Encode,
    /// This many milliseconds pass.
    Wait(i64),
    /// This many frames are sent.
    Leave(usize),
    /// This many frames are received.
    Come(usize),
    Acknowledge,
    /// The connection is lost and replaced by another one.
    Reconnect,
    /// The connection is replaced, but the first welcome is lost, after this many frames from the cloud.
    LoseWelcome(usize),
    RestartRobot,
    RestartCloud,
}

fn any_record(size: impl Strategy<Value = usize> + Clone + 'static) -> impl Strategy<Value = ModelStep> {
    let goals = (GOALS..GOALS + 4, size.clone());
    let messages = (1..GOALS, size.clone(), any::<bool>());
    prop_oneof![
        4 => size.clone().prop_map(ModelStep::Tell),
        4 => size.clone().prop_map(ModelStep::Call),
        3 => size.prop_map(ModelStep::Answer),
        3 => goals.prop_map(|(of, size)| ModelStep::Goal(of, size)),
        8 => messages.prop_map(|(of, size, each)| ModelStep::Publish(of, size, each)),
        4 => (0usize..10_000).prop_map(ModelStep::Print),
    ]
}

fn any_step() -> impl Strategy<Value = ModelStep> {
    let size = prop_oneof![4 => 0usize..2000, 1 => 30_000usize..120_000, 1 => Just(600_000usize)].boxed();
    let burst = (1..=BURST, any_record((0usize..2000).boxed()));
    prop_oneof![
        22 => any_record(size),
        4 => burst.prop_map(|(times, step)| ModelStep::Burst(times, Box::new(step))),
        1 => (1..GOALS).prop_map(|of| ModelStep::Publish(of, LIMITS.record + 1, false)),
        1 => (1..GOALS + 4).prop_map(ModelStep::Close),
        4 => Just(ModelStep::Encode),
        2 => (1..2 * MAX_AGE).prop_map(ModelStep::Wait),
        10 => (1usize..80).prop_map(ModelStep::Leave),
        10 => (1usize..80).prop_map(ModelStep::Come),
        3 => Just(ModelStep::Acknowledge),
        2 => Just(ModelStep::Reconnect),
        1 => (0usize..20).prop_map(ModelStep::LoseWelcome),
        1 => prop_oneof![Just(ModelStep::RestartRobot), Just(ModelStep::RestartCloud)],
    ]
}

/// Both ends, the robot's first.
struct LinkModel {
    ends: [ModelEnd; 2],
    /// Milliseconds since the beginning.
    now: i64,
    /// The link stands: connections are not lost.
    is_steady: bool,
}

impl LinkModel {
    fn new(is_steady: bool) -> Self {
        let mut world = Self { ends: [ModelEnd::new(), ModelEnd::new()], now: 0, is_steady };
        world.connect(None);
        world
    }

    /// Reconnects: frames in flight are lost, and hello and welcome are exchanged, unless the welcome is `lost` after
    /// this many frames.
    fn connect(&mut self, lost: Option<usize>) {
        let now = self.now;
        let [robot, cloud] = &mut self.ends;
        for end in [&mut *robot, &mut *cloud] {
            end.wire.clear();
            end.encoding = None;
        }
        let (has, ahead) = robot.incoming.received_numbers();
        let next = robot.out.next_number();
        let (cloud_has, cloud_ahead) = cloud.incoming.received_numbers();
        let cloud_next = cloud.out.next_number();
        cloud.out.reconnect(has, &ahead);
        cloud.incoming.reconnect(next);
        if let Some(frames) = lost {
            for _ in 0..frames {
                cloud.out.next(now);
            }
            return self.connect(None);
        }
        robot.out.reconnect(cloud_has, &cloud_ahead);
        robot.incoming.reconnect(cloud_next);
    }

    /// Replaces a session of which one end has lost its state. Numbering continues if the robot's end is the same.
    fn restart(&mut self, is_robot: bool) {
        let next = self.ends[0].out.next_number();
        self.ends = [ModelEnd::new(), ModelEnd::new()];
        if !is_robot {
            self.ends[0].out.begin_at(next);
        }
        self.connect(None);
    }

    fn take(&mut self, at_robot: bool, step: &ModelStep) -> TestCaseResult {
        let now = self.now;
        let [robot, cloud] = &mut self.ends;
        let (this, other) = if at_robot { (robot, cloud) } else { (cloud, robot) };
        match step {
            ModelStep::Leave(frames) => {
                let left = std::iter::from_fn(|| this.out.next(now)).take(*frames);
                this.wire.extend(left);
            }
            ModelStep::Come(frames) => {
                let frames = this.wire.len().min(*frames);
                for frame in this.wire.drain(..frames) {
                    other.take(frame)?;
                }
            }
            ModelStep::Acknowledge => {
                let received = this.incoming.progress();
                this.wire.push_back(Frame::Ack(received));
            }
            ModelStep::Burst(times, step) => (0..*times).for_each(|_| this.push(step, now)),
            ModelStep::Wait(time) => self.now += time,
            ModelStep::Reconnect | ModelStep::LoseWelcome(_) if self.is_steady => {}
            ModelStep::RestartRobot | ModelStep::RestartCloud if self.is_steady => {}
            ModelStep::Reconnect => self.connect(None),
            ModelStep::LoseWelcome(frames) => self.connect(Some(*frames)),
            ModelStep::RestartRobot => self.restart(true),
            ModelStep::RestartCloud => self.restart(false),
            step => this.push(step, now),
        }
        self.ends.iter_mut().try_for_each(ModelEnd::check)
    }

    /// Keeps the connection up until everything has been delivered, with a last message of each topic.
    fn finish(&mut self) -> TestCaseResult {
        if !self.is_steady {
            self.connect(None);
        }
        for end in &mut self.ends {
            end.out.encoding.pays = false;
            for channel in end.sent.channels.clone().into_iter().filter(|channel| *channel < GOALS) {
                end.publish(channel, self.now, BIG, false);
            }
        }
        let mut rounds = 0..ROUNDS;
        while !self.ends.iter().all(ModelEnd::is_through) {
            prop_assert!(rounds.next().is_some(), "something is never sent");
            self.exchange()?;
        }
        // The acknowledgement of what needs none.
        self.exchange()?;
        let [robot, cloud] = &self.ends;
        self.check_delivery(robot, cloud)?;
        self.check_delivery(cloud, robot)
    }

    fn exchange(&mut self) -> TestCaseResult {
        let encode = ModelStep::Encode;
        for at_robot in [true, false] {
            for step in [&encode, &ModelStep::Leave(50), &ModelStep::Acknowledge, &ModelStep::Come(usize::MAX)] {
                self.take(at_robot, step)?;
            }
        }
        Ok(())
    }

    /// Checks what has become of everything that one end has sent.
    fn check_delivery(&self, from: &ModelEnd, to: &ModelEnd) -> TestCaseResult {
        let (sent, received) = (&from.sent, &to.received);
        prop_assert_eq!(sent.orders, received.orders, "orders");
        prop_assert_eq!(sent.calls, received.calls, "calls and goals");
        prop_assert_eq!(&sent.answers, &received.answers, "answers");
        prop_assert_eq!(sent.lines, received.lines, "lines, with those that were told of");
        prop_assert_eq!(&sent.channels, &received.channels, "channels");
        for channel in sent.channels.iter().filter(|channel| **channel < GOALS) {
            prop_assert_eq!(sent.newest.get(channel), received.newest.get(channel), "the newest of {}", channel);
        }
        prop_assert_eq!(from.out.buffered_bytes(), 0, "bytes of what was acknowledged");
        prop_assert_eq!(from.budget.used_bytes(), 0, "bytes of the budget");
        prop_assert!(received.messages + from.count_dropped() <= sent.messages, "messages that were never sent");
        if self.is_steady {
            prop_assert_eq!(from.out.sent, to.incoming.progress().bytes, "bytes of all records");
            prop_assert_eq!(received.messages + from.count_dropped(), sent.messages, "messages, with those dropped");
            prop_assert!(from.was_crowded || received.each == sent.each, "messages that must all be delivered");
        }
        Ok(())
    }
}

#[test]
fn whatever_happens_to_a_link_its_promises_hold() {
    let config = ProptestConfig { failure_persistence: None, ..ProptestConfig::default() };
    let most_ahead = Cell::new((0, 0));
    let steps = prop::collection::vec((any::<bool>(), any_step()), 0..600);
    let tried = TestRunner::new(config).run(&(any::<bool>(), steps), |(is_steady, steps)| {
        let mut world = LinkModel::new(is_steady);
        for (at_robot, step) in &steps {
            world.take(*at_robot, step)?;
            for end in &world.ends {
                let (unacknowledged, ahead) = most_ahead.get();
                let received = end.incoming.received_numbers().1.len();
                most_ahead.set((end.out.unacknowledged_count().max(unacknowledged), received.max(ahead)));
            }
        }
        world.finish()
    });
    tried.unwrap_or_else(|failure| panic!("{failure}"));
    let (unacknowledged, ahead) = most_ahead.get();
    let is_reached = unacknowledged == LIMITS.ahead && ahead > LIMITS.ahead / 4;
    assert!(is_reached, "at most {unacknowledged} numbers unacknowledged, {ahead} ahead of a missing one");
}
