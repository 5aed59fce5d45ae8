//! For any order of events, each request is answered once or failed once, and Q stays within its bounds.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use qos::{
    DeliveryVerdict, Effect, Failure, Governor, LocalState, QosEvent, QosSla, RequestChannel, RequestId, Responder,
    RetentionLimits, Stamp,
};

#[derive(Debug, Clone)]
enum Op {
    Call,
    Input,
    InputAgain,
    Pass(u64),
    /// The side answers one of its pending messages; the index is taken modulo their number. With `true` the message
    /// stays pending and may be answered again.
    Answer(Responder, usize, bool),
    Fail(Responder, usize, bool),
    LinkUp(bool),
    LinkDown,
    Local(LocalState),
    Crash,
}

fn side() -> impl Strategy<Value = Responder> {
    prop_oneof![Just(Responder::Cloud), Just(Responder::Local)]
}

fn ops() -> impl Strategy<Value = Vec<Op>> {
    let state = prop_oneof![
        4 => Just(LocalState::Ready),
        2 => Just(LocalState::Starting),
        2 => Just(LocalState::Stopped),
        1 => Just(LocalState::Missing),
    ];
    let op = prop_oneof![
        4 => Just(Op::Call),
        4 => Just(Op::Input),
        1 => Just(Op::InputAgain),
        6 => (0u64..400).prop_map(Op::Pass),
        1 => (0u64..40_000).prop_map(Op::Pass),
        12 => (side(), any::<usize>(), any::<bool>()).prop_map(|(side, which, again)| Op::Answer(side, which, again)),
        2 => (side(), any::<usize>(), any::<bool>()).prop_map(|(side, which, no)| Op::Fail(side, which, no)),
        2 => any::<bool>().prop_map(Op::LinkUp),
        2 => Just(Op::LinkDown),
        3 => state.prop_map(Op::Local),
        1 => Just(Op::Crash),
    ];
    prop::collection::vec(op, 0..200)
}

/// A message that one side received and has not answered, or may answer again.
#[derive(Clone, Copy, PartialEq)]
enum PendingMessage {
    Call(RequestId),
    Input(Stamp),
}

struct World {
    governor: Governor<Option<Stamp>>,
    now: Instant,
    given: [Vec<PendingMessage>; 2],
    calls: HashMap<RequestId, (u32, u32)>,
    inputs: HashMap<Stamp, (u32, u32)>,
    stamps: u32,
    call_name: Arc<str>,
    input_name: Arc<str>,
}

impl World {
    fn new(local: &str, mode: &str, by: &str) -> Self {
        let sla = serde_json::json!({
            "t_desire": 0.1, "t_max": 0.3, "local": local, "mode": mode,
            "safe_stop": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist"},
        });
        let pair = format!("/image -> /found, /marked by {by}");
        // Longer than any run: later answers would not be recognised.
        let limits = RetentionLimits { patience: Duration::from_secs(100_000), ..RetentionLimits::default() };
        let mut world = Self {
            governor: Governor::new(QosSla::parse(sla).unwrap(), vec![pair.parse().unwrap()], limits),
            now: Instant::now(),
            given: [vec![], vec![]],
            calls: HashMap::new(),
            inputs: HashMap::new(),
            stamps: 0,
            call_name: "/add".into(),
            input_name: "/image".into(),
        };
        world.governor.begin(world.now);
        world
    }

    fn apply_effects(&mut self) {
        while let Some(effect) = self.governor.next_effect() {
            match effect {
                Effect::Give { side, request, channel, payload } => {
                    let given = match channel {
                        RequestChannel::Call(_) => PendingMessage::Call(request.expect("calls are requests")),
                        RequestChannel::Topic(_) => PendingMessage::Input(payload.expect("inputs carry their stamp")),
                    };
                    self.given[side as usize].push(given);
                }
                Effect::Fail { request, channel, reason } => {
                    assert!(!reason.is_empty());
                    if matches!(channel, RequestChannel::Call(_)) {
                        self.calls.get_mut(&request).expect("only calls made fail").1 += 1;
                    }
                }
                Effect::Event(QosEvent::Stop(_)) => self.given[Responder::Local as usize].clear(),
                Effect::Event(_) | Effect::SafeStop | Effect::Outcome(_) => {}
            }
        }
        let q = self.governor.satisfaction().q();
        assert!((0.0..16.0).contains(&q), "Q is {q}");
    }

    fn answer(&mut self, side: Responder, given: PendingMessage) {
        match given {
            PendingMessage::Call(id) => {
                if self.governor.on_result(self.now, side, id) == DeliveryVerdict::Deliver {
                    self.calls.get_mut(&id).expect("it was made").0 += 1;
                }
            }
            PendingMessage::Input(stamp) => {
                let verdict = self.governor.output(self.now, side, "/found", Some(stamp.into()), Duration::ZERO);
                if verdict == DeliveryVerdict::Deliver {
                    let counts = self.inputs.get_mut(&stamp).expect("it was made");
                    // Each side may answer one input several times, but only one side is delivered.
                    counts.0 |= 1 << side as u32;
                }
            }
        }
    }

    fn pick(&mut self, side: Responder, which: usize, keep: bool) -> Option<PendingMessage> {
        let given = &mut self.given[side as usize];
        if given.is_empty() {
            return None;
        }
        let which = which % given.len();
        Some(if keep { given[which] } else { given.swap_remove(which) })
    }

    fn input(&mut self, stamp: Stamp) {
        self.inputs.entry(stamp).or_default();
        let name = self.input_name.clone();
        self.governor.input(self.now, &name, Some(stamp.into()), Some(stamp));
    }

    fn apply(&mut self, op: Op) {
        match op {
            Op::Call => {
                let name = self.call_name.clone();
                let id = self.governor.call(self.now, &name, None);
                self.calls.insert(id, (0, 0));
            }
            Op::Input => {
                self.stamps += 1;
                self.input(Stamp { secs: self.stamps, nsecs: 0 });
            }
            Op::InputAgain if self.stamps > 0 => self.input(Stamp { secs: self.stamps, nsecs: 0 }),
            Op::InputAgain => {}
            Op::Pass(ms) => {
                let until = self.now + Duration::from_millis(ms);
                while let Some(next) = self.governor.deadline().filter(|next| *next <= until) {
                    self.now = self.now.max(next);
                    self.governor.tick(self.now);
                    self.apply_effects();
                }
                self.now = until;
                self.governor.tick(self.now);
            }
            Op::Answer(side, which, keep) => {
                if let Some(given) = self.pick(side, which, keep) {
                    self.answer(side, given);
                }
            }
            Op::Fail(side, which, refused) => {
                if let Some(PendingMessage::Call(id)) = self.pick(side, which, false) {
                    let why = "because".to_owned();
                    let failure = if refused { Failure::Refused(why) } else { Failure::Unreachable(why) };
                    self.governor.on_failure(self.now, side, id, &failure);
                }
            }
            Op::LinkUp(resumed) => {
                if !resumed {
                    self.given[Responder::Cloud as usize].clear();
                }
                self.governor.link_up(self.now, resumed);
            }
            Op::LinkDown => self.governor.link_down(self.now),
            Op::Local(state) => {
                if state != LocalState::Ready {
                    self.given[Responder::Local as usize].clear();
                }
                self.governor.on_local_state(self.now, state);
            }
            Op::Crash => {
                self.given[Responder::Local as usize].clear();
                self.governor.on_local_crash(self.now, "signal 11");
            }
        }
        self.apply_effects();
    }

    /// Brings the link up and lets every side answer what it received.
    fn settle(&mut self) {
        // Requests that waited for the local original are failed.
        self.apply(Op::Local(LocalState::Missing));
        self.apply(Op::LinkDown);
        self.apply(Op::LinkUp(false));
        for side in [Responder::Cloud, Responder::Local] {
            while let Some(given) = self.pick(side, 0, false) {
                self.answer(side, given);
                self.apply_effects();
            }
        }
        self.apply(Op::Pass(200_000_000));
    }
}

fn run(world: &mut World, ops: Vec<Op>) -> Result<(), TestCaseError> {
    for op in ops {
        world.apply(op);
        for (answered, failed) in world.calls.values() {
            prop_assert!(answered + failed <= 1, "answered {answered} times, failed {failed} times");
        }
        for sides in world.inputs.values() {
            prop_assert!(sides.0 < 3, "both sides were heard");
        }
    }
    world.settle();
    for (answered, failed) in world.calls.values() {
        prop_assert_eq!(answered + failed, 1, "answered {} times, failed {} times", answered, failed);
    }
    let report = world.governor.report(world.now);
    let counts = report.counts;
    prop_assert_eq!(
        counts.desired + counts.accepted + counts.late + counts.left_out,
        counts.requests,
        "each request counts once"
    );
    prop_assert_eq!(
        counts.from_cloud + counts.from_local + counts.failed + counts.left_out + counts.late >= counts.requests,
        true,
        "{:?}",
        counts
    );
    let text = serde_json::to_string(&report).unwrap();
    prop_assert_eq!(serde_json::from_str::<qos::QosReport>(&text).unwrap().counts, counts);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(600) })]
    #[test]
    fn stateless_by_stamp(ops in ops(), local in prop_oneof![Just("cold"), Just("warm"), Just("none")]) {
        run(&mut World::new(local, "stateless", "stamp"), ops)?;
    }

    #[test]
    fn stateful_by_stamp(ops in ops(), local in prop_oneof![Just("cold"), Just("warm"), Just("none")]) {
        run(&mut World::new(local, "stateful", "stamp"), ops)?;
    }
}
