//! Whatever the order of events: each request is answered once or failed once, and Q keeps its bounds.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use qos::{
    Channel, Effect, Event, Failure, Governor, Limits, LocalState, RequestId, Side, Sla, Stamp,
    Verdict,
};

#[derive(Debug, Clone)]
enum Op {
    Call,
    Input,
    InputAgain,
    Pass(u64),
    /// The side answers one of what it was given; which one is taken modulo their number. Kept: it may answer again.
    Answer(Side, usize, bool),
    Fail(Side, usize, bool),
    LinkUp(bool),
    LinkDown,
    Local(LocalState),
    Crash,
}

fn side() -> impl Strategy<Value = Side> {
    prop_oneof![Just(Side::Cloud), Just(Side::Local)]
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

/// What one side was given and has not answered, or may answer again.
#[derive(Clone, Copy, PartialEq)]
enum Given {
    Call(RequestId),
    Input(Stamp),
}

struct World {
    governor: Governor<Option<Stamp>>,
    now: Instant,
    given: [Vec<Given>; 2],
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
        // Longer than any run: what comes after that is not recognised any more.
        let limits = Limits {
            patience: Duration::from_secs(100_000),
            ..Limits::default()
        };
        let mut world = Self {
            governor: Governor::new(
                Sla::parse(sla).unwrap(),
                vec![pair.parse().unwrap()],
                limits,
            ),
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

    fn obey(&mut self) {
        while let Some(effect) = self.governor.next_effect() {
            match effect {
                Effect::Give {
                    side,
                    request,
                    channel,
                    payload,
                } => {
                    let given = match channel {
                        Channel::Call(_) => Given::Call(request.expect("calls are requests")),
                        Channel::Topic(_) => {
                            Given::Input(payload.expect("inputs carry their stamp"))
                        }
                    };
                    self.given[side as usize].push(given);
                }
                Effect::Fail {
                    request,
                    channel,
                    reason,
                } => {
                    assert!(!reason.is_empty());
                    if matches!(channel, Channel::Call(_)) {
                        self.calls
                            .get_mut(&request)
                            .expect("only calls made fail")
                            .1 += 1;
                    }
                }
                Effect::Event(Event::Stop(_)) => self.given[Side::Local as usize].clear(),
                Effect::Event(_) | Effect::SafeStop | Effect::Outcome(_) => {}
            }
        }
        let q = self.governor.satisfaction().q();
        assert!((0.0..16.0).contains(&q), "Q is {q}");
    }

    fn answer(&mut self, side: Side, given: Given) {
        match given {
            Given::Call(id) => {
                if self.governor.answered(self.now, side, id) == Verdict::Deliver {
                    self.calls.get_mut(&id).expect("it was made").0 += 1;
                }
            }
            Given::Input(stamp) => {
                let verdict = self.governor.output(
                    self.now,
                    side,
                    "/found",
                    Some(stamp.into()),
                    Duration::ZERO,
                );
                if verdict == Verdict::Deliver {
                    let counts = self.inputs.get_mut(&stamp).expect("it was made");
                    // Each side may say several things to one input, but only one side is heard.
                    counts.0 |= 1 << side as u32;
                }
            }
        }
    }

    fn pick(&mut self, side: Side, which: usize, keep: bool) -> Option<Given> {
        let given = &mut self.given[side as usize];
        if given.is_empty() {
            return None;
        }
        let which = which % given.len();
        Some(if keep {
            given[which]
        } else {
            given.swap_remove(which)
        })
    }

    fn input(&mut self, stamp: Stamp) {
        self.inputs.entry(stamp).or_default();
        let name = self.input_name.clone();
        self.governor
            .input(self.now, &name, Some(stamp.into()), Some(stamp));
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
                self.input(Stamp {
                    secs: self.stamps,
                    nsecs: 0,
                });
            }
            Op::InputAgain if self.stamps > 0 => self.input(Stamp {
                secs: self.stamps,
                nsecs: 0,
            }),
            Op::InputAgain => {}
            Op::Pass(ms) => {
                let until = self.now + Duration::from_millis(ms);
                while let Some(next) = self.governor.deadline().filter(|next| *next <= until) {
                    self.now = self.now.max(next);
                    self.governor.tick(self.now);
                    self.obey();
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
                if let Some(Given::Call(id)) = self.pick(side, which, false) {
                    let why = "because".to_owned();
                    let failure = if refused {
                        Failure::Refused(why)
                    } else {
                        Failure::Unreachable(why)
                    };
                    self.governor.failed(self.now, side, id, &failure);
                }
            }
            Op::LinkUp(resumed) => {
                if !resumed {
                    self.given[Side::Cloud as usize].clear();
                }
                self.governor.link_up(self.now, resumed);
            }
            Op::LinkDown => self.governor.link_down(self.now),
            Op::Local(state) => {
                if state != LocalState::Ready {
                    self.given[Side::Local as usize].clear();
                }
                self.governor.local(self.now, state);
            }
            Op::Crash => {
                self.given[Side::Local as usize].clear();
                self.governor.local_crashed(self.now, "signal 11");
            }
        }
        self.obey();
    }

    /// The link comes up, and whoever was given something answers.
    fn settle(&mut self) {
        // Whoever waited for the local original to come up is told.
        self.apply(Op::Local(LocalState::Missing));
        self.apply(Op::LinkDown);
        self.apply(Op::LinkUp(false));
        for side in [Side::Cloud, Side::Local] {
            while let Some(given) = self.pick(side, 0, false) {
                self.answer(side, given);
                self.obey();
            }
        }
        self.apply(Op::Pass(200_000_000));
    }
}

fn run(world: &mut World, ops: Vec<Op>) -> Result<(), TestCaseError> {
    for op in ops {
        world.apply(op);
        for (answered, failed) in world.calls.values() {
            prop_assert!(
                answered + failed <= 1,
                "answered {answered} times, failed {failed} times"
            );
        }
        for sides in world.inputs.values() {
            prop_assert!(sides.0 < 3, "both sides were heard");
        }
    }
    world.settle();
    for (answered, failed) in world.calls.values() {
        prop_assert_eq!(
            answered + failed,
            1,
            "answered {} times, failed {} times",
            answered,
            failed
        );
    }
    let report = world.governor.report(world.now);
    let counts = report.counts;
    prop_assert_eq!(
        counts.desired + counts.accepted + counts.late + counts.left_out,
        counts.requests,
        "each request counts once"
    );
    prop_assert_eq!(
        counts.from_cloud + counts.from_local + counts.failed + counts.left_out + counts.late
            >= counts.requests,
        true,
        "{:?}",
        counts
    );
    let text = serde_json::to_string(&report).unwrap();
    prop_assert_eq!(
        serde_json::from_str::<qos::Report>(&text).unwrap().counts,
        counts
    );
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
