//! A model of both ends of a link: two [`Outgoing`] and two [`Incoming`], the frames on their way between them, and whatever happens to those.
//!
//! However messages, orders, calls and lines are pushed, however often a connection is lost with all that is on its way, a welcome is lost, a hello
//! that was overtaken comes late, or one of the ends begins anew:
//!
//! 1. Orders come in the order in which they were told, each once. Over connections that are lost none is lost: a session that goes on has all.
//! 2. Calls and goals come in the order in which they were made, each once, over all topics and services: a cancel never before its goal.
//! 3. No message comes before the opening of its channel, and none after its closing.
//! 4. No end sends what the other one, by the limits that it has stated, refuses: no session ends by what was allowed.
//! 5. What waits, is kept, and is under way stays below the limits, in number and in bytes.
//! 6. Lines come in order, and the number of those that do not come is told.

use std::collections::{BTreeSet, VecDeque};

use bytes::{BufMut, Bytes, BytesMut};
use proptest::prelude::*;
use proptest::test_runner::TestCaseResult;

use crate::frame::Frame;
use crate::incoming::Incoming;
use crate::limits::{Limits, WAITING};
use crate::outgoing::{Outgoing, Quality};
use crate::record::{Data, Record};

/// As little as an end may state.
const LIMITS: Limits = Limits {
    record: 1 << 20,
    under_way: 8,
    under_way_bytes: 1 << 20,
    ahead: 256,
};
const CHANNELS: u32 = 12;

/// One end: what it sends, what it has heard, and the frames that it has sent and that have not come.
struct End {
    out: Outgoing,
    incoming: Incoming,
    wire: VecDeque<Frame>,
    told: u32,
    heard: u32,
    called: u32,
    answered: u32,
    /// Those that this end has opened, and those that it was told of.
    opened: BTreeSet<u32>,
    known: BTreeSet<u32>,
    /// Closed, and never opened again.
    gone: BTreeSet<u32>,
    printed: u32,
    read: u32,
}

impl End {
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

    fn tell(&mut self, kind: u8, channel: u32, size: usize) -> Record {
        self.told += 1;
        control(kind, self.told, channel, size)
    }

    fn push(&mut self, step: &Step) {
        match *step {
            Step::Goal(channel, _) | Step::Publish(channel, ..) if self.gone.contains(&channel) => {
            }
            Step::Tell(size) => {
                let record = self.tell(b'T', 0, size);
                self.out.push(&record, Quality::Each);
            }
            Step::Call(size) => {
                self.called += 1;
                let (id, request) = (self.called, vec![0; size].into());
                let call = Record::Call {
                    id,
                    service: 1,
                    request,
                };
                self.out.push(&call, Quality::Each);
            }
            Step::Goal(channel, size) => {
                self.open(channel, size);
                self.called += 1;
                let goal = data(channel, self.called.into(), size);
                self.out.push(&goal, Quality::InOrder);
            }
            Step::Publish(channel, size, each) => {
                self.open(channel, size);
                let quality = if each { Quality::Each } else { Quality::Newest };
                self.out.push(&data(channel, 0, size), quality);
            }
            Step::Close(channel) if self.opened.remove(&channel) => {
                self.gone.insert(channel);
                // It is told after all that waits on the channel, whatever orders are told meanwhile.
                let record = control(b'C', 0, channel, 0);
                self.out.close(channel, &record);
            }
            Step::Print(size) => {
                self.printed += 1;
                let line = control(b'L', self.printed, 0, size);
                self.out.print(&line);
            }
            _ => {}
        }
    }

    fn open(&mut self, channel: u32, size: usize) {
        if self.opened.insert(channel) {
            let record = self.tell(b'O', channel, size);
            self.out.push(&record, Quality::Each);
            self.out.opens(channel);
        }
    }

    /// Takes a frame of the other end, and checks what it completes.
    fn take(&mut self, frame: Frame) -> TestCaseResult {
        let record = match frame {
            Frame::Whole { number, record } => self.incoming.whole(number, record),
            Frame::Begin {
                stream,
                number,
                total,
                bytes,
            } => self.incoming.begin(stream, number, total, &bytes),
            Frame::More { stream, bytes } => self.incoming.more(stream, &bytes),
            Frame::Ack(received) => {
                self.out.acknowledge(received.number);
                Ok(None)
            }
            other => panic!("{other:?}"),
        };
        let record = record.map_err(|error| TestCaseError::fail(format!("refused: {error}")))?;
        match record.map(Record::decode).transpose() {
            Ok(None) => {}
            Ok(Some(Record::Control(text))) => self.hear(&text)?,
            Ok(Some(Record::Call { id, .. })) => self.is_called(id)?,
            Ok(Some(Record::Data(data))) => {
                let channel = data.channel;
                prop_assert!(self.known.contains(&channel), "{channel} is not open");
                if data.born > 0 {
                    self.is_called(data.born as u32)?;
                }
            }
            other => panic!("{other:?}"),
        }
        Ok(())
    }

    fn hear(&mut self, text: &[u8]) -> TestCaseResult {
        let word = |at: usize| u32::from_le_bytes(text[at..at + 4].try_into().unwrap());
        match text[0] {
            b'{' => {
                let text = String::from_utf8_lossy(text);
                let digits = text
                    .split('[')
                    .nth(1)
                    .and_then(|text| text.split(' ').next());
                self.read += digits.unwrap().parse::<u32>().unwrap();
            }
            b'L' => {
                self.read += 1;
                prop_assert_eq!(
                    word(1),
                    self.read,
                    "a line before others that were not told of"
                );
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

    fn is_called(&mut self, number: u32) -> TestCaseResult {
        self.answered += 1;
        prop_assert_eq!(number, self.answered, "a call or goal out of its order");
        Ok(())
    }

    /// What waits, is kept and is under way is within the limits.
    fn check(&self) -> TestCaseResult {
        let (_, ahead) = self.incoming.state();
        prop_assert!(ahead.len() <= LIMITS.ahead);
        prop_assert!(self.out.unacknowledged() <= LIMITS.ahead);
        let (under_way, bytes) = self.incoming.under_way();
        prop_assert!(under_way <= LIMITS.under_way && bytes <= LIMITS.under_way_bytes);
        for waiting in self.out.waiting() {
            // Those that were sent and did not come wait once more.
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
enum Step {
    Tell(usize),
    Call(usize),
    Goal(u32, usize),
    Publish(u32, usize, bool),
    Close(u32),
    Print(usize),
    /// So many frames leave.
    Leave(usize),
    /// So many come.
    Come(usize),
    Acknowledge,
    /// The connection is lost, and there is another one.
    Reconnect,
    /// The same; the first welcome is lost, after so many frames of the cloud.
    LoseWelcome(usize),
    RestartRobot,
    RestartCloud,
}

fn step() -> impl Strategy<Value = Step> {
    let size =
        || prop_oneof![4 => 0usize..2000, 1 => 30_000usize..120_000, 1 => Just(600_000usize)];
    let channel = || 1..CHANNELS;
    prop_oneof![
        4 => size().prop_map(Step::Tell),
        4 => size().prop_map(Step::Call),
        3 => (CHANNELS..CHANNELS + 4, size()).prop_map(|(of, size)| Step::Goal(of, size)),
        8 => (channel(), size(), any::<bool>()).prop_map(|(of, size, each)| Step::Publish(of, size, each)),
        1 => (1..CHANNELS + 4).prop_map(Step::Close),
        4 => (0usize..10_000).prop_map(Step::Print),
        10 => (1usize..40).prop_map(Step::Leave),
        10 => (1usize..60).prop_map(Step::Come),
        4 => Just(Step::Acknowledge),
        2 => Just(Step::Reconnect),
        1 => (0usize..20).prop_map(Step::LoseWelcome),
        1 => prop_oneof![Just(Step::RestartRobot), Just(Step::RestartCloud)],
    ]
}

/// Both ends, the robot's first.
struct World([End; 2]);

impl World {
    fn new() -> Self {
        let mut world = Self([End::new(), End::new()]);
        world.connect(None);
        world
    }

    /// What was on its way is lost; hello and welcome pass, the welcome unless it is `lost` after so many frames.
    fn connect(&mut self, lost: Option<usize>) {
        let [robot, cloud] = &mut self.0;
        robot.wire.clear();
        cloud.wire.clear();
        let (has, ahead) = robot.incoming.state();
        let next = robot.out.next_number();
        let (cloud_has, cloud_ahead) = cloud.incoming.state();
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

    /// A session of which one end knows nothing any more is replaced; numbers go on where the robot's end is the same.
    fn restart(&mut self, is_robot: bool) {
        let next = self.0[0].out.next_number();
        self.0 = [End::new(), End::new()];
        if !is_robot {
            self.0[0].out.begin_at(next);
        }
        self.connect(None);
    }

    fn take(&mut self, at_robot: bool, step: &Step) -> TestCaseResult {
        let [robot, cloud] = &mut self.0;
        let (this, other) = if at_robot {
            (robot, cloud)
        } else {
            (cloud, robot)
        };
        match step {
            Step::Leave(frames) => {
                let left = std::iter::from_fn(|| this.out.next(0)).take(*frames);
                this.wire.extend(left);
            }
            Step::Come(frames) => {
                let frames = this.wire.len().min(*frames);
                for frame in this.wire.drain(..frames) {
                    other.take(frame)?;
                }
            }
            Step::Acknowledge => {
                let received = this.incoming.received();
                this.wire.push_back(Frame::Ack(received));
            }
            Step::Reconnect => self.connect(None),
            Step::LoseWelcome(frames) => self.connect(Some(*frames)),
            Step::RestartRobot => self.restart(true),
            Step::RestartCloud => self.restart(false),
            step => this.push(step),
        }
        self.0.iter().try_for_each(End::check)
    }

    /// A connection that holds: in the end all has come.
    fn finish(&mut self) -> TestCaseResult {
        self.connect(None);
        while !self.0.iter().all(|end| end.out.is_empty()) {
            for at_robot in [true, false] {
                for step in [Step::Leave(50), Step::Acknowledge, Step::Come(usize::MAX)] {
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
        let mut world = World::new();
        for (at_robot, step) in &steps {
            world.take(*at_robot, step)?;
        }
        world.finish()?;
    }
}
