//! A model test of both ends of a link: two [`Outgoing`] and two [`Incoming`], the frames in flight between them, and
//! faults.
//!
//! The following holds for any sequence of messages, control messages, calls and lines, and any combination of lost
//! connections with everything in flight, lost welcomes, delayed hellos of displaced connections, and restarts of
//! either end:
//!
//! 1. Control messages arrive in the order in which they were sent, each once. A resumed session loses none.
//! 2. Calls and goals arrive in the order in which they were made, each once, over all topics and services; a cancel
//!    never overtakes its goal.
//! 3. No message arrives before its channel was opened or after it was closed.
//! 4. No end sends anything that exceeds the limits announced by its peer, so no session ends because of permitted
//!    input.
//! 5. What is queued, kept and in flight stays below its limits, in number and in bytes.
//! 6. Lines arrive in order, and the number of omitted lines is reported.

use std::collections::{BTreeSet, VecDeque};

use bytes::{BufMut, Bytes, BytesMut};
use proptest::prelude::*;
use proptest::test_runner::TestCaseResult;

use crate::frame::Frame;
use crate::incoming::Incoming;
use crate::limits::{LinkLimits, WAITING};
use crate::outgoing::{DeliveryMode, Outgoing};
use crate::record::{Data, Record};

/// The lowest limits that an end may announce.
const LIMITS: LinkLimits = LinkLimits { record: 1 << 20, under_way: 8, under_way_bytes: 1 << 20, ahead: 256 };
const CHANNELS: u32 = 12;

/// One end: its state, what it has sent and received, and its frames in flight.
struct ModelEnd {
    out: Outgoing,
    incoming: Incoming,
    wire: VecDeque<Frame>,
    told: u32,
    heard: u32,
    called: u32,
    answered: u32,
    /// Channels that this end has opened, and channels that the peer has announced.
    opened: BTreeSet<u32>,
    known: BTreeSet<u32>,
    /// Channels that were closed and are never opened again.
    gone: BTreeSet<u32>,
    printed: u32,
    read: u32,
}

impl ModelEnd {
    fn new() -> Self {
        let mut end = Self {
            out: Outgoing::new(Some(50)),
            incoming: Incoming::default(),
            wire: VecDeque::new(),
            told: 0,
            heard: 0,
            called: 0,
            answered: 0,
            opened: BTreeSet::new(),
            known: BTreeSet::new(),
            gone: BTreeSet::new(),
            printed: 0,
            read: 0,
        };
        end.out.set_limits(LIMITS);
        end.incoming.limits = LIMITS;
        end
    }

    fn next_control(&mut self, kind: u8, channel: u32, size: usize) -> Record {
        self.told += 1;
        control(kind, self.told, channel, size)
    }

    fn push(&mut self, step: &ModelStep) {
        match *step {
            ModelStep::Goal(channel, _) | ModelStep::Publish(channel, ..) if self.gone.contains(&channel) => {}
            ModelStep::Tell(size) => {
                let record = self.next_control(b'T', 0, size);
                self.out.push(&record, DeliveryMode::Each);
            }
            ModelStep::Call(size) => {
                self.called += 1;
                let (id, request) = (self.called, vec![0; size].into());
                let call = Record::Call { id, service: 1, request };
                self.out.push(&call, DeliveryMode::Each);
            }
            ModelStep::Goal(channel, size) => {
                self.open(channel, size);
                self.called += 1;
                let goal = data(channel, self.called.into(), size);
                self.out.push(&goal, DeliveryMode::InOrder);
            }
            ModelStep::Publish(channel, size, each) => {
                self.open(channel, size);
                let quality = if each { DeliveryMode::Each } else { DeliveryMode::Newest };
                self.out.push(&data(channel, 0, size), quality);
            }
            ModelStep::Close(channel) if self.opened.remove(&channel) => {
                self.gone.insert(channel);
                // The close arrives after everything queued on the channel, independently of other control messages.
                let record = control(b'C', 0, channel, 0);
                self.out.close_channel(channel, &record);
            }
            ModelStep::Print(size) => {
                self.printed += 1;
                let line = control(b'L', self.printed, 0, size);
                self.out.push_line(&line);
            }
            _ => {}
        }
    }

    fn open(&mut self, channel: u32, size: usize) {
        if self.opened.insert(channel) {
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
            Ok(None) => {}
            Ok(Some(Record::Control(text))) => self.check_control(&text)?,
            Ok(Some(Record::Call { id, .. })) => self.check_call(id)?,
            Ok(Some(Record::Data(data))) => {
                let channel = data.channel;
                prop_assert!(self.known.contains(&channel), "{channel} is not open");
                if data.born > 0 {
                    self.check_call(data.born as u32)?;
                }
            }
            other => panic!("{other:?}"),
        }
        Ok(())
    }

    fn check_control(&mut self, text: &[u8]) -> TestCaseResult {
        let word = |at: usize| u32::from_le_bytes(text[at..at + 4].try_into().unwrap());
        match text[0] {
            b'{' => {
                let text = String::from_utf8_lossy(text);
                let digits = text.split('[').nth(1).and_then(|text| text.split(' ').next());
                self.read += digits.unwrap().parse::<u32>().unwrap();
            }
            b'L' => {
                self.read += 1;
                prop_assert_eq!(word(1), self.read, "a line before others that were not told of");
            }
            b'C' => prop_assert!(self.known.remove(&word(5)), "closed and not open"),
            kind => {
                self.heard += 1;
                prop_assert_eq!(word(1), self.heard, "an order out of its order");
                if kind == b'O' {
                    self.known.insert(word(5));
                }
            }
        }
        Ok(())
    }

    fn check_call(&mut self, number: u32) -> TestCaseResult {
        self.answered += 1;
        prop_assert_eq!(number, self.answered, "a call or goal out of its order");
        Ok(())
    }

    /// Checks that what is queued, kept and in flight is within the limits.
    fn check(&self) -> TestCaseResult {
        let (_, ahead) = self.incoming.received_numbers();
        prop_assert!(ahead.len() <= LIMITS.ahead);
        prop_assert!(self.out.unacknowledged_count() <= LIMITS.ahead);
        let (under_way, bytes) = self.incoming.in_flight();
        prop_assert!(under_way <= LIMITS.under_way && bytes <= LIMITS.under_way_bytes);
        for waiting in self.out.queue_lengths() {
            // Records that were sent and not received are queued again.
            prop_assert!(waiting <= WAITING.messages + LIMITS.ahead, "{waiting}");
        }
        Ok(())
    }
}

fn control(kind: u8, number: u32, channel: u32, size: usize) -> Record {
    let mut text = BytesMut::new();
    text.put_u8(kind);
    text.put_u32_le(number);
    text.put_u32_le(channel);
    text.put_bytes(0, size);
    Record::Control(text.freeze())
}

fn data(channel: u32, born: i64, size: usize) -> Record {
    Record::Data(Data {
        channel,
        encoded: false,
        latching: false,
        born,
        left: 0,
        serialise: 0,
        answered: None,
        message: Bytes::from(vec![0; size]),
    })
}

#[derive(Debug, Clone)]
enum ModelStep {
    Tell(usize),
    Call(usize),
    Goal(u32, usize),
    Publish(u32, usize, bool),
    Close(u32),
    Print(usize),
    /// This many frames are sent.
    Leave(usize),
    /// This many frames are received.
    Come(usize),
    Acknowledge,
    /// The connection is lost and replaced by another one.
    Reconnect,
    /// As above, but the first welcome is lost, after this many frames from the cloud.
    LoseWelcome(usize),
    RestartRobot,
    RestartCloud,
}

fn step() -> impl Strategy<Value = ModelStep> {
    let size = || prop_oneof![4 => 0usize..2000, 1 => 30_000usize..120_000, 1 => Just(600_000usize)];
    let channel = || 1..CHANNELS;
    prop_oneof![
        4 => size().prop_map(ModelStep::Tell),
        4 => size().prop_map(ModelStep::Call),
        3 => (CHANNELS..CHANNELS + 4, size()).prop_map(|(of, size)| ModelStep::Goal(of, size)),
        8 => (channel(), size(), any::<bool>()).prop_map(|(of, size, each)| ModelStep::Publish(of, size, each)),
        1 => (1..CHANNELS + 4).prop_map(ModelStep::Close),
        4 => (0usize..10_000).prop_map(ModelStep::Print),
        10 => (1usize..40).prop_map(ModelStep::Leave),
        10 => (1usize..60).prop_map(ModelStep::Come),
        4 => Just(ModelStep::Acknowledge),
        2 => Just(ModelStep::Reconnect),
        1 => (0usize..20).prop_map(ModelStep::LoseWelcome),
        1 => prop_oneof![Just(ModelStep::RestartRobot), Just(ModelStep::RestartCloud)],
    ]
}

/// Both ends, the robot's first.
struct LinkModel([ModelEnd; 2]);

impl LinkModel {
    fn new() -> Self {
        let mut world = Self([ModelEnd::new(), ModelEnd::new()]);
        world.connect(None);
        world
    }

    /// Reconnects: frames in flight are lost, and hello and welcome are exchanged, unless the welcome is `lost` after
    /// this many frames.
    fn connect(&mut self, lost: Option<usize>) {
        let [robot, cloud] = &mut self.0;
        robot.wire.clear();
        cloud.wire.clear();
        let (has, ahead) = robot.incoming.received_numbers();
        let next = robot.out.next_number();
        let (cloud_has, cloud_ahead) = cloud.incoming.received_numbers();
        let cloud_next = cloud.out.next_number();
        cloud.out.reconnect(has, &ahead);
        cloud.incoming.reconnect(next);
        if let Some(frames) = lost {
            for _ in 0..frames {
                cloud.out.next(0);
            }
            return self.connect(None);
        }
        robot.out.reconnect(cloud_has, &cloud_ahead);
        robot.incoming.reconnect(cloud_next);
    }

    /// Replaces a session of which one end has lost its state. Numbering continues if the robot's end is the same.
    fn restart(&mut self, is_robot: bool) {
        let next = self.0[0].out.next_number();
        self.0 = [ModelEnd::new(), ModelEnd::new()];
        if !is_robot {
            self.0[0].out.begin_at(next);
        }
        self.connect(None);
    }

    fn take(&mut self, at_robot: bool, step: &ModelStep) -> TestCaseResult {
        let [robot, cloud] = &mut self.0;
        let (this, other) = if at_robot { (robot, cloud) } else { (cloud, robot) };
        match step {
            ModelStep::Leave(frames) => {
                let left = std::iter::from_fn(|| this.out.next(0)).take(*frames);
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
            ModelStep::Reconnect => self.connect(None),
            ModelStep::LoseWelcome(frames) => self.connect(Some(*frames)),
            ModelStep::RestartRobot => self.restart(true),
            ModelStep::RestartCloud => self.restart(false),
            step => this.push(step),
        }
        self.0.iter().try_for_each(ModelEnd::check)
    }

    /// Keeps the connection up until everything has been delivered.
    fn finish(&mut self) -> TestCaseResult {
        self.connect(None);
        while !self.0.iter().all(|end| end.out.is_empty()) {
            for at_robot in [true, false] {
                for step in [ModelStep::Leave(50), ModelStep::Acknowledge, ModelStep::Come(usize::MAX)] {
                    self.take(at_robot, &step)?;
                }
            }
        }
        let [robot, cloud] = &self.0;
        for (from, to) in [(robot, cloud), (cloud, robot)] {
            prop_assert_eq!(from.told, to.heard, "orders");
            prop_assert_eq!(from.called, to.answered, "calls and goals");
            prop_assert_eq!(from.printed, to.read, "lines, with those that were told of");
            prop_assert_eq!(&from.opened, &to.known, "channels");
        }
        Ok(())
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_to_a_link_its_promises_hold(steps in prop::collection::vec((any::<bool>(), step()), 0..300)) {
        let mut world = LinkModel::new();
        for (at_robot, step) in &steps {
            world.take(*at_robot, step)?;
        }
        world.finish()?;
    }
}
