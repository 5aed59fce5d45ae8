//! Scenarios for the governor.

use std::sync::Arc;
use std::time::{Duration, Instant};

use qos::{
    CorrelationKey, DecisionReason, DeliveryVerdict, Effect, Failure, Governor, LocalState, OutputAge, Phases,
    QosEvent, QosSla, RequestChannel, RequestId, RequestOutcome, Responder, RetentionLimits, Stamp,
};

const MS: Duration = Duration::from_millis(1);

struct Robot {
    governor: Governor<&'static str>,
    now: Instant,
    outcomes: Vec<RequestOutcome>,
}

impl Robot {
    fn new(more: serde_json::Value) -> Self {
        let mut sla = serde_json::json!({"t_desire": 0.1, "t_max": 0.3});
        let given = more.as_object().unwrap().clone();
        if given.contains_key("measure") {
            sla = serde_json::json!({});
        }
        sla.as_object_mut().unwrap().extend(given);
        let pairs = vec![
            "/image -> /found by stamp".parse().unwrap(),
            "/in -> /out by arrival".parse().unwrap(),
            "/walk/goal -> /walk/result, /walk/feedback by goal".parse().unwrap(),
        ];
        let mut governor = Governor::new(QosSla::parse(sla).unwrap(), pairs, RetentionLimits::default());
        let now = Instant::now();
        governor.link_up(now, false);
        governor.begin(now);
        Self { governor, now, outcomes: Vec::new() }
    }

    /// Advances the time, meets the deadlines, and returns the effects since the last call, in words.
    fn advance(&mut self, ms: u32) -> Vec<String> {
        let until = self.now + ms * MS;
        while let Some(next) = self.governor.deadline().filter(|next| *next <= until) {
            self.now = self.now.max(next);
            self.governor.tick(self.now);
        }
        self.now = until;
        self.effects()
    }

    fn effects(&mut self) -> Vec<String> {
        let mut words = vec![];
        while let Some(effect) = self.governor.next_effect() {
            words.push(match effect {
                Effect::Give { side, payload, .. } => format!("{payload} to {side:?}"),
                Effect::Fail { reason, .. } => format!("fail: {reason}"),
                Effect::SafeStop => "safe stop".into(),
                Effect::Event(QosEvent::Start(_)) => "start".into(),
                Effect::Event(QosEvent::Feed(_)) => "feed".into(),
                Effect::Event(QosEvent::StopFeeding(_)) => "stop feeding".into(),
                Effect::Event(QosEvent::Stop(_)) => "stop".into(),
                Effect::Event(event) => format!("{event:?}"),
                Effect::Outcome(outcome) => {
                    self.outcomes.push(outcome);
                    continue;
                }
            });
        }
        words
    }

    fn call(&mut self, payload: &'static str) -> RequestId {
        let name: Arc<str> = "/add".into();
        self.governor.call(self.now, &name, payload)
    }

    fn goal(&mut self, payload: &'static str) -> RequestId {
        let action: Arc<str> = "/walk".into();
        let id = CorrelationKey::Goal(payload.into());
        self.governor.goal(self.now, &action, id, payload)
    }

    fn image(&mut self, secs: u32, payload: &'static str) {
        let name: Arc<str> = "/image".into();
        self.governor.input(self.now, &name, Some(Stamp { secs, nsecs: 0 }.into()), payload);
    }

    fn input(&mut self, payload: &'static str) {
        let name: Arc<str> = "/in".into();
        self.governor.input(self.now, &name, None, payload);
    }

    fn output_found(&mut self, side: Responder, secs: u32) -> DeliveryVerdict {
        let stamp = Some(Stamp { secs, nsecs: 0 }.into());
        self.governor.output(self.now, side, "/found", stamp, Duration::ZERO)
    }

    fn output_plain(&mut self, side: Responder) -> DeliveryVerdict {
        self.governor.output(self.now, side, "/out", None, Duration::ZERO)
    }

    fn q(&self) -> f64 {
        self.governor.satisfaction().q()
    }
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap()
}

#[test]
fn pictures_under_way_go_to_a_warm_original_as_soon_as_it_is_fed() {
    // Nothing is hedged, because T_desire is T_max.
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 15, "t_desire": 0.3}"#));
    assert_eq!(robot.effects(), ["start"]);
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    // Five pictures per second; the network has just become slow.
    robot.image(1, "first");
    assert_eq!(robot.advance(200), ["first to Cloud"]);
    robot.image(2, "second");
    assert_eq!(robot.advance(200), ["second to Cloud"]);
    robot.image(3, "third");
    // At 500 ms the second one is late, too: Q is below the threshold, and the third is still fresh.
    assert_eq!(robot.advance(101), ["third to Cloud", "feed", "third to Local"]);
    robot.advance(60);
    assert_eq!(robot.output_found(Responder::Local, 3), DeliveryVerdict::Deliver);
    robot.image(4, "fourth");
    // It has time for the first one between two fresh ones.
    assert_eq!(robot.effects(), ["first to Local", "fourth to Cloud", "fourth to Local"]);
    // A late answer of the cloud is delivered if no side has answered, and dropped otherwise.
    assert_eq!(robot.output_found(Responder::Cloud, 1), DeliveryVerdict::Deliver);
    assert_eq!(robot.output_found(Responder::Cloud, 3), DeliveryVerdict::Drop);
}

#[test]
fn each_request_s_outcome_is_told_and_told_again_when_more_is_known() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 3}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.image(1, "picture");
    robot.advance(100);
    assert_eq!(robot.output_found(Responder::Local, 1), DeliveryVerdict::Deliver);
    robot.effects();
    assert!(robot.outcomes.is_empty(), "the cloud's time has not counted");
    robot.advance(201);
    let local = Some((Responder::Local, 100 * MS));
    let told = robot.outcomes.pop().unwrap();
    assert_eq!((told.cloud, told.answer, told.q), (None, local, 1.5));
    robot.advance(99);
    let phases = |up: u32| Phases { up: up * MS, compute: 100 * MS, ..Phases::default() };
    assert_eq!(robot.output_found(Responder::Cloud, 1), DeliveryVerdict::Drop);
    // Phases of another request add up to something else.
    robot.governor.record_phases(&phases(50));
    robot.governor.record_phases(&phases(300));
    robot.effects();
    let again = robot.outcomes.pop().unwrap();
    assert_eq!(again.request, told.request);
    assert_eq!((again.cloud, again.answer), (Some(400 * MS), local));
    assert_eq!(again.phases, Some(phases(300)));
    assert!(robot.outcomes.is_empty());
    let median = &robot.governor.report(robot.now).phases[1];
    assert_eq!((&*median.phase, median.p50), ("up", 300.0));
}

#[test]
fn a_goal_is_answered_by_the_first_result_that_carries_its_id() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 3}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.effects();
    let goal: Arc<str> = "/walk/goal".into();
    let id = |id: &str| Some(CorrelationKey::Goal(id.into()));
    for (name, payload) in [("one", "first"), ("two", "second")] {
        robot.governor.input(robot.now, &goal, id(name), payload);
    }
    assert_eq!(robot.effects(), ["first to Cloud", "first to Local", "second to Cloud", "second to Local"]);
    let mut output = |side, end: &str, name| {
        let topic = format!("/walk/{end}");
        robot.governor.output(robot.now, side, &topic, id(name), Duration::ZERO)
    };
    // Feedback comes from the side that was first; results likewise, in any order.
    assert_eq!(output(Responder::Cloud, "feedback", "two"), DeliveryVerdict::Deliver);
    assert_eq!(output(Responder::Local, "feedback", "two"), DeliveryVerdict::Drop);
    assert_eq!(output(Responder::Local, "result", "two"), DeliveryVerdict::Deliver);
    assert_eq!(output(Responder::Cloud, "result", "two"), DeliveryVerdict::Drop);
    assert_eq!(output(Responder::Cloud, "result", "one"), DeliveryVerdict::Deliver);
    let counts = robot.governor.report(robot.now).counts;
    assert_eq!((counts.from_cloud, counts.from_local), (1, 1));
    // The cloud was fast twice: the original is no longer fed.
    assert_eq!(robot.effects(), ["stop feeding"]);
    // Without an id the server assigns one: the goal is forwarded and is no request.
    robot.governor.input(robot.now, &goal, id(""), "third");
    assert_eq!(robot.effects(), ["third to Cloud"]);
    assert_eq!(robot.governor.report(robot.now).counts.requests, 2);
}

#[test]
fn a_late_answer_does_not_count_again() {
    let mut robot = Robot::new(json(r#"{"local": "none", "initial": 8}"#));
    let id = robot.call("sum");
    robot.advance(301);
    assert_eq!(robot.q(), 4.0);
    robot.advance(700);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, id), DeliveryVerdict::Deliver);
    assert_eq!(robot.q(), 4.0);
    assert_eq!(robot.governor.report(robot.now).counts.late, 1);
}

#[test]
fn the_clouds_time_counts_though_the_local_answer_won() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 3}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    assert_eq!(robot.effects(), ["start", "feed"]);
    let id = robot.call("sum");
    assert_eq!(robot.advance(10), ["sum to Cloud", "sum to Local"]);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Local, id), DeliveryVerdict::Deliver);
    assert_eq!(robot.q(), 3.0, "the local answer says nothing about the cloud");
    robot.advance(80);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, id), DeliveryVerdict::Drop);
    assert_eq!(robot.q(), 5.0);
    assert_eq!(robot.effects(), ["stop feeding"]);
}

#[test]
fn the_link_is_lost_while_the_local_original_runs() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 5}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    let id = robot.call("sum");
    robot.advance(10);
    robot.governor.link_down(robot.now);
    assert_eq!(robot.advance(290), ["sum to Local"], "the cloud may still answer in time");
    assert_eq!(robot.advance(1), ["feed"]);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Local, id), DeliveryVerdict::Deliver);
    robot.governor.link_up(robot.now, true);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, id), DeliveryVerdict::Drop);
    assert_eq!(robot.q(), 2.5, "late once, whatever comes");
}

#[test]
fn a_warm_original_is_asked_shortly_before_a_request_would_be_late() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 15}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.effects();
    // How long the original takes is not known yet: it is asked at T_desire.
    let id = robot.call("first");
    assert_eq!(robot.advance(99), ["first to Cloud"]);
    assert_eq!(robot.advance(1), ["first to Local"]);
    robot.advance(60);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Local, id), DeliveryVerdict::Deliver);
    robot.advance(20);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, id), DeliveryVerdict::Drop);
    // It took 60 ms, so twice that before T_max is early enough.
    let id = robot.call("second");
    assert_eq!(robot.advance(179), ["second to Cloud"]);
    assert_eq!(robot.advance(1), ["second to Local"]);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, id), DeliveryVerdict::Deliver);
    // A goal is carried out once.
    robot.goal("walk");
    assert_eq!(robot.advance(300), ["walk to Cloud"]);
    let counts = robot.governor.report(robot.now).counts;
    assert_eq!((counts.accepted, counts.late), (2, 0), "{counts:?}");
}

#[test]
fn what_one_side_has_answered_the_other_does_not_answer_again_without_stamps() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 15}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    let output = |robot: &mut Robot, side: Responder, since_input: u32| {
        let since_input = (side == Responder::Cloud).then_some(since_input * MS);
        let age = OutputAge { since_stamp: Duration::ZERO, since_input };
        robot.governor.output(robot.now, side, "/out", None, age)
    };
    for _ in 0..40 {
        robot.input("in time");
        robot.advance(20);
        assert_eq!(output(&mut robot, Responder::Cloud, 20), DeliveryVerdict::Deliver);
        robot.advance(13);
    }
    robot.effects();
    robot.input("late");
    assert_eq!(robot.advance(100), ["late to Cloud", "late to Local"]);
    robot.advance(60);
    assert_eq!(output(&mut robot, Responder::Local, 0), DeliveryVerdict::Deliver);
    robot.input("next");
    robot.advance(20);
    assert_eq!(output(&mut robot, Responder::Cloud, 180), DeliveryVerdict::Drop, "of the late one");
    assert_eq!(output(&mut robot, Responder::Cloud, 20), DeliveryVerdict::Deliver, "of the next");
    // Without the link the original takes over; when the link is back, both are asked.
    robot.governor.link_down(robot.now);
    for _ in 0..8 {
        robot.input("in an outage");
        robot.advance(400);
        let _ = output(&mut robot, Responder::Local, 0);
    }
    robot.governor.link_up(robot.now, true);
    robot.input("of both");
    robot.advance(20);
    assert_eq!(output(&mut robot, Responder::Cloud, 20), DeliveryVerdict::Deliver);
    assert_eq!(output(&mut robot, Responder::Local, 0), DeliveryVerdict::Drop, "of the same");
    // Without a further input this is no answer: the side that speaks publishes it.
    assert_eq!(output(&mut robot, Responder::Local, 0), DeliveryVerdict::Deliver);
}

#[test]
fn a_stateful_service_is_not_hedged() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 15, "mode": "stateful"}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.effects();
    robot.call("sum");
    assert_eq!(robot.advance(300), ["sum to Cloud"]);
}

#[test]
fn a_blip_of_the_link_counts_for_nothing_where_the_answers_come_in_time() {
    let mut robot = Robot::new(json(r#"{"local": "cold", "initial": 5}"#));
    robot.image(1, "first");
    robot.image(2, "second");
    let sum = robot.call("sum");
    robot.advance(10);
    robot.governor.link_down(robot.now);
    robot.image(3, "third");
    let late = robot.call("later sum");
    // The path to the cloud keeps inputs in order; a call is not made before it can be.
    assert_eq!(robot.advance(50), ["third to Cloud"]);
    assert_eq!(robot.q(), 5.0);
    robot.governor.link_up(robot.now, true);
    assert_eq!(robot.advance(20), ["later sum to Cloud"]);
    for number in 1..=3 {
        assert_eq!(robot.output_found(Responder::Cloud, number), DeliveryVerdict::Deliver);
    }
    for id in [sum, late] {
        let verdict = robot.governor.on_result(robot.now, Responder::Cloud, id);
        assert_eq!(verdict, DeliveryVerdict::Deliver);
    }
    assert!(robot.advance(10_000).is_empty(), "the original is not started");
    assert_eq!(robot.q(), 15.0);
    let counts = robot.governor.report(robot.now).counts;
    assert_eq!((counts.requests, counts.desired, counts.late), (5, 5, 0));
}

#[test]
fn what_a_blip_delays_beyond_t_max_counts_once_each() {
    let mut robot = Robot::new(json(r#"{"local": "cold", "initial": 15}"#));
    robot.image(1, "first");
    robot.governor.link_down(robot.now);
    robot.advance(200);
    robot.image(2, "second");
    robot.advance(101);
    assert_eq!(robot.q(), 7.5, "the first is late, the second is not");
    robot.governor.link_up(robot.now, true);
    assert_eq!(robot.output_found(Responder::Cloud, 1), DeliveryVerdict::Deliver);
    assert_eq!(robot.output_found(Responder::Cloud, 2), DeliveryVerdict::Deliver);
    assert_eq!(robot.q(), 8.5);
    robot.advance(10_000);
    assert_eq!(robot.q(), 8.5);
}

#[test]
fn without_stamps_a_blip_keeps_the_order_and_awaits_one_answer() {
    let mut robot = Robot::new(json(r#"{"local": "cold", "initial": 5}"#));
    robot.governor.link_down(robot.now);
    robot.input("a");
    robot.advance(20);
    robot.input("b");
    robot.advance(20);
    robot.governor.link_up(robot.now, true);
    assert!(robot.advance(20).is_empty(), "the link has kept them");
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Deliver);
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Deliver);
    robot.advance(10_000);
    let counts = robot.governor.report(robot.now).counts;
    assert_eq!((counts.requests, counts.late), (1, 0));
    // A new servant receives what it can still answer in time.
    robot.governor.link_down(robot.now);
    robot.input("c");
    assert_eq!(robot.effects(), ["c to Cloud"]);
    robot.governor.link_up(robot.now, false);
    assert_eq!(robot.effects(), ["c to Cloud"]);
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Deliver);
    assert_eq!(robot.governor.report(robot.now).counts.late, 0);
}

#[test]
fn the_link_is_lost_and_there_is_no_local_original() {
    let mut robot = Robot::new(json(r#"{"local": "cold", "initial": 3}"#));
    assert_eq!(robot.effects(), ["start"]);
    robot.governor.on_local_state(robot.now, LocalState::Missing);
    robot.governor.on_local_state(robot.now, LocalState::Missing);
    assert_eq!(robot.effects(), ["SaidOnceMissing"]);
    let (answered, lost) = (robot.call("first"), robot.call("second"));
    robot.advance(10);
    robot.governor.link_down(robot.now);
    assert!(robot.effects().is_empty(), "the link may come back in time");
    robot.governor.link_up(robot.now, true);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, answered), DeliveryVerdict::Deliver);
    robot.governor.link_down(robot.now);
    let words = robot.advance(301);
    assert_eq!(words.len(), 1, "{words:?}");
    assert!(words[0].contains("the link is down"), "{words:?}");
    assert!(words[0].contains("there is no local original"), "{words:?}");
    robot.governor.link_up(robot.now, true);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, lost), DeliveryVerdict::Drop);
}

#[test]
fn a_call_fails_only_when_both_sides_failed() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 1}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.effects();
    let id = robot.call("sum");
    robot.effects();
    let no = Failure::Unreachable("servant ended".into());
    robot.governor.on_failure(robot.now, Responder::Cloud, id, &no);
    assert!(robot.effects().is_empty());
    let no = Failure::Refused("division by zero".into());
    robot.governor.on_failure(robot.now, Responder::Local, id, &no);
    assert_eq!(robot.effects(), ["fail: cloud: servant ended; local: division by zero"]);
    robot.governor.on_failure(robot.now, Responder::Local, id, &no);
    assert!(robot.effects().is_empty());
}

#[test]
fn stateful_asks_one_side_at_a_time_and_hands_back() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "mode": "stateful", "initial": 1}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.input("a");
    assert_eq!(robot.effects(), ["start", "a to Cloud"]);
    robot.governor.link_down(robot.now);
    robot.input("b");
    assert_eq!(robot.effects()[0], "feed");
    assert!(!robot.governor.sides().cloud);
    robot.governor.link_up(robot.now, true);
    let report = robot.governor.report(robot.now);
    assert_eq!(report.events.last().unwrap().event, QosEvent::StopFeeding(DecisionReason::LinkUp));
    robot.effects();
    robot.input("c");
    assert!(robot.effects().iter().all(|word| !word.contains("Local")));
}

#[test]
fn without_stamps_one_request_is_outstanding_and_forgotten_at_t_max() {
    let mut robot = Robot::new(json(r#"{"local": "none", "initial": 8}"#));
    robot.input("a");
    robot.advance(50);
    robot.input("b");
    assert_eq!(robot.governor.report(robot.now).counts.requests, 1, "b is fed, but a is outstanding");
    robot.advance(40);
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Deliver);
    assert_eq!(robot.q(), 10.0);
    assert_eq!(
        robot.output_plain(Responder::Cloud),
        DeliveryVerdict::Deliver,
        "more than one output is none of our business"
    );
    robot.input("c");
    robot.advance(301);
    assert_eq!(robot.q(), 5.0);
    robot.input("d");
    robot.advance(100);
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Deliver);
    assert_eq!(robot.q(), 7.0);
    assert_eq!(robot.governor.report(robot.now).counts.requests, 3);
}

#[test]
fn without_stamps_both_answer_and_one_is_heard() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 1}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.input("a");
    assert_eq!(robot.output_plain(Responder::Local), DeliveryVerdict::Deliver);
    robot.advance(301);
    robot.input("b");
    assert_eq!(robot.output_plain(Responder::Local), DeliveryVerdict::Deliver);
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Drop, "late to a");
    assert_eq!(robot.output_plain(Responder::Cloud), DeliveryVerdict::Drop, "late to b");
}

#[test]
fn a_node_that_does_not_copy_stamps_is_noticed() {
    let mut robot = Robot::new(json(r#"{"local": "none"}"#));
    for secs in 1..=12 {
        robot.image(secs, "scan");
        robot.advance(20);
        assert_eq!(robot.output_found(Responder::Cloud, 1000 + secs), DeliveryVerdict::Deliver);
        robot.advance(20);
    }
    let words = robot.effects();
    let report = robot.governor.report(robot.now);
    assert!(report.events.iter().any(|event| event.event == QosEvent::Uncorrelated("/image".into())), "{words:?}");
    assert_eq!(report.pairs[0], "/image -> /found by arrival");
    assert_eq!(report.counts.desired, 4);
}

#[test]
fn the_safe_stop_comes_when_nobody_answers_in_time() {
    let stop = r#"{"local": "none", "safe_stop": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist"}}"#;
    let mut robot = Robot::new(json(stop));
    robot.image(1, "picture");
    robot.effects();
    assert!(robot.advance(300).is_empty());
    assert_eq!(robot.advance(1), ["safe stop"]);
    robot.image(2, "picture");
    robot.advance(100);
    assert_eq!(robot.output_found(Responder::Cloud, 2), DeliveryVerdict::Deliver);
    assert!(robot.advance(1000).is_empty());
}

#[test]
fn frames_per_second_start_the_local_original_and_stop_the_robot() {
    let mut robot = Robot::new(json(
        r#"{"measure": {"frames_per_second": {"output": "/found", "desire": 10, "min": 4, "over": 2}},
            "local": "cold", "initial": 5, "safe_stop": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist"}}"#,
    ));
    robot.governor.set_listened(robot.now, "/found", true);
    for _ in 0..3 {
        robot.advance(100);
        assert_eq!(robot.output_found(Responder::Cloud, 1), DeliveryVerdict::Deliver);
    }
    assert_eq!(robot.q(), 9.0);
    // Q 9, 4.5, 2.25
    assert!(robot.advance(400).is_empty(), "a frame now would be in time");
    assert_eq!(robot.advance(1), ["safe stop"]);
    assert_eq!(robot.advance(250), ["safe stop", "start"]);
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    assert_eq!(robot.effects(), ["feed"]);
    robot.advance(50);
    assert_eq!(robot.output_found(Responder::Local, 1), DeliveryVerdict::Deliver);
    assert!(robot.advance(200).iter().all(|word| word != "safe stop"), "the local original's frames count for that");
}

#[test]
fn a_frame_that_was_on_its_way_when_nobody_listened_any_more_awaits_no_other() {
    for measure in [
        r#"{"frames_per_second": {"output": "/found", "desire": 10, "min": 4}}"#,
        r#"{"age": {"output": "/found", "desire": 0.1, "max": 0.25}}"#,
    ] {
        let mut robot = Robot::new(json(&format!(
            r#"{{"measure": {measure}, "local": "cold", "initial": 5,
                "safe_stop": {{"topic": "/cmd_vel", "type": "geometry_msgs/Twist"}}}}"#
        )));
        robot.governor.set_listened(robot.now, "/found", true);
        robot.advance(100);
        assert_eq!(robot.output_found(Responder::Cloud, 1), DeliveryVerdict::Deliver);
        robot.governor.set_listened(robot.now, "/found", false);
        robot.advance(10);
        let q = robot.q();
        let _ = robot.output_found(Responder::Cloud, 2);
        let done = robot.advance(60_000);
        assert!(done.is_empty(), "{measure}: {done:?}");
        assert_eq!(robot.q(), q, "{measure}");
        // A new subscriber is promised frames again.
        robot.governor.set_listened(robot.now, "/found", true);
        let done = robot.advance(300);
        assert_eq!(done[0], "safe stop", "{measure}: {done:?}");
    }
}

#[test]
fn without_a_promise_no_call_is_remembered_that_is_over() {
    let mut robot = Robot::new(json(r#"{"measure": {"link": {"after": 1}}}"#));
    // Calls that the cloud answered …
    for _ in 0..100 {
        let id = robot.call("sum");
        let verdict = robot.governor.on_result(robot.now, Responder::Cloud, id);
        assert_eq!(verdict, DeliveryVerdict::Deliver);
    }
    assert_eq!(robot.governor.deadline(), None);
    // … calls that the local original answered, for which the cloud is never asked …
    robot.governor.link_down(robot.now);
    robot.advance(1000);
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    let told = robot.outcomes.len();
    for _ in 0..10_000 {
        let id = robot.call("sum");
        let verdict = robot.governor.on_result(robot.now, Responder::Local, id);
        assert_eq!(verdict, DeliveryVerdict::Deliver);
    }
    assert_eq!(robot.governor.deadline(), None);
    robot.effects();
    let outcomes = &robot.outcomes[told..];
    assert_eq!(outcomes.len(), 10_000, "they are told of");
    assert!(outcomes.iter().all(|outcome| outcome.cloud.is_none()));
    // … and calls that nobody waits for any more.
    let id = robot.call("sum");
    robot.governor.cancel(robot.now, id);
    assert_eq!(robot.governor.deadline(), None);
}

#[test]
fn a_crash_of_the_local_original_brings_calls_back_to_the_cloud() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 1}"#));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.governor.link_down(robot.now);
    let id = robot.call("sum");
    robot.effects();
    robot.governor.link_up(robot.now, false);
    assert_eq!(robot.effects(), ["sum to Cloud"]);
    robot.governor.on_local_crash(robot.now, "signal 11");
    let words = robot.effects();
    assert_eq!(words, ["Crashed(\"signal 11\")", "stop feeding"]);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, id), DeliveryVerdict::Deliver);
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    assert_eq!(robot.effects(), ["feed"]);
}

#[test]
fn what_is_no_request_goes_where_requests_go() {
    let mut robot = Robot::new(json(r#"{"local": "warm", "initial": 1}"#));
    let info: Arc<str> = "/camera_info".into();
    robot.governor.input(robot.now, &info, None, "info");
    assert_eq!(robot.effects(), ["start", "info to Cloud"]);
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    robot.effects();
    robot.governor.input(robot.now, &info, None, "info");
    assert_eq!(robot.effects(), ["info to Cloud", "info to Local"]);
    assert_eq!(robot.governor.report(robot.now).counts.requests, 0);
    // Only one side is delivered on topics that answer nothing.
    let status = |robot: &mut Robot, side| robot.governor.output(robot.now, side, "/status", None, Duration::ZERO);
    assert_eq!(status(&mut robot, Responder::Local), DeliveryVerdict::Deliver);
    assert_eq!(status(&mut robot, Responder::Cloud), DeliveryVerdict::Drop);
    assert_eq!(RequestChannel::Topic(info.clone()), RequestChannel::Topic(info));
}

#[test]
fn without_a_promise_the_local_original_stands_in_while_the_link_is_away() {
    let mut robot = Robot::new(json(r#"{"measure": {"link": {"after": 3}}}"#));
    let map: Arc<str> = "/map".into();
    // However slow the cloud is, it answers alone.
    let slow = robot.call("slow");
    assert_eq!(robot.effects(), ["slow to Cloud"]);
    assert!(robot.advance(60_000).is_empty());
    assert_eq!(robot.governor.on_result(robot.now, Responder::Cloud, slow), DeliveryVerdict::Deliver);
    // A link that comes back soon changes nothing, and messages sent meanwhile wait for it.
    robot.governor.link_down(robot.now);
    robot.governor.input(robot.now, &map, None, "map");
    assert_eq!(robot.advance(2999), ["map to Cloud"]);
    let early = robot.call("early");
    assert!(robot.effects().is_empty());
    robot.governor.link_up(robot.now, true);
    assert_eq!(robot.advance(10_000), ["early to Cloud"]);
    // One that stays down does.
    robot.governor.link_down(robot.now);
    assert!(robot.advance(2999).is_empty());
    assert_eq!(robot.advance(1), ["start"]);
    let said = |robot: &mut Robot, side| {
        let now = robot.now;
        let governor = &mut robot.governor;
        governor.output(now, side, "/status", None, Duration::ZERO)
    };
    assert_eq!(said(&mut robot, Responder::Local), DeliveryVerdict::Deliver);
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    assert_eq!(robot.effects(), ["feed", "early to Local"]);
    robot.governor.input(robot.now, &map, None, "map");
    assert_eq!(robot.effects(), ["map to Local"]);
    assert_eq!(robot.governor.on_result(robot.now, Responder::Local, early), DeliveryVerdict::Deliver);
    let report = robot.governor.report(robot.now);
    assert_eq!(report.fallback_after, Some(3.0));
    assert!(
        report.summary.contains("the local original answers")
            && report.summary.contains("takes over 3 s after the link is lost"),
        "{}",
        report.summary
    );
    robot.governor.link_up(robot.now, false);
    assert_eq!(robot.effects(), ["stop feeding", "stop"]);
    assert!(robot.advance(86_400_000).is_empty());
}

#[test]
fn without_a_promise_a_cloud_that_is_never_reached_is_stood_in_for() {
    let sla = json(r#"{"measure": {"link": {"after": "500ms"}}}"#);
    let mut governor = Governor::<&str>::new(QosSla::parse(sla).unwrap(), Vec::new(), RetentionLimits::default());
    let now = Instant::now();
    governor.begin(now);
    assert!(governor.next_effect().is_none());
    assert_eq!(governor.deadline(), Some(now + 500 * MS));
    governor.tick(now + 500 * MS);
    let started = governor.next_effect();
    assert!(matches!(started, Some(Effect::Event(QosEvent::Start(DecisionReason::LinkDown)))), "{started:?}");
    assert_eq!(governor.deadline(), None, "said once");
}

#[test]
fn with_a_promise_a_cloud_that_is_never_reached_is_stood_in_for_too() {
    let sla = json(r#"{"t_desire": 0.1, "t_max": 0.3, "unreached": "500ms"}"#);
    let mut governor = Governor::<&str>::new(QosSla::parse(sla).unwrap(), Vec::new(), RetentionLimits::default());
    let now = Instant::now();
    let said = |governor: &mut Governor<&str>| {
        let effects = std::iter::from_fn(|| governor.next_effect());
        let events = effects.filter_map(|effect| match effect {
            Effect::Event(event) => Some(event),
            _ => None,
        });
        events.collect::<Vec<_>>()
    };
    governor.begin(now);
    governor.tick(now + 499 * MS);
    assert!(said(&mut governor).is_empty());
    governor.tick(now + 500 * MS);
    assert_eq!(said(&mut governor), [QosEvent::Start(DecisionReason::LinkDown)]);
    governor.on_local_state(now + 600 * MS, LocalState::Ready);
    assert_eq!(said(&mut governor), [QosEvent::Feed(DecisionReason::LinkDown)]);
    governor.link_up(now + 700 * MS, false);
    let back = [QosEvent::StopFeeding(DecisionReason::LinkUp), QosEvent::Stop(DecisionReason::LinkUp)];
    assert_eq!(said(&mut governor), back);
    // From now on Q decides.
    governor.link_down(now + 800 * MS);
    governor.tick(now + 80_000 * MS);
    assert!(said(&mut governor).is_empty());
}

#[test]
fn without_a_promise_warm_and_first_sign_are_ready_before_they_are_needed() {
    for (local, begun) in [(r#""warm""#, true), (r#""warm", "warm": "first-sign""#, false)] {
        let mut robot = Robot::new(json(&format!(r#"{{"measure": {{"link": {{"after": 3}}}}, "local": {local}}}"#)));
        assert_eq!(robot.effects() == ["start"], begun, "{local}");
        robot.governor.link_down(robot.now);
        assert_eq!(robot.effects() == ["start"], !begun, "{local}");
        robot.governor.on_local_state(robot.now, LocalState::Ready);
        assert!(robot.advance(2999).is_empty(), "{local}");
        assert_eq!(robot.advance(1), ["feed"], "{local}");
        robot.governor.link_up(robot.now, true);
        let given_up = robot.effects();
        assert_eq!(given_up[0], "stop feeding", "{local}");
        assert_eq!(given_up.len() == 1, begun, "{local}: {given_up:?}");
    }
}

#[test]
fn a_goal_is_carried_out_while_the_link_is_away() {
    let mut robot = Robot::new(json(r#"{"local": "none"}"#));
    robot.effects();
    let (goal, call) = (robot.goal("walk"), robot.call("add"));
    assert_eq!(robot.effects(), ["walk to Cloud", "add to Cloud"]);
    robot.governor.link_down(robot.now);
    let said = robot.advance(60_000);
    assert_eq!(said.len(), 1, "the call alone is given up: {said:?}");
    assert!(said[0].contains("the link is down"), "{said:?}");
    robot.governor.link_up(robot.now, true);
    let verdict = robot.governor.on_result(robot.now, Responder::Cloud, call);
    assert_eq!(verdict, DeliveryVerdict::Drop);
    let verdict = robot.governor.on_result(robot.now, Responder::Cloud, goal);
    assert_eq!(verdict, DeliveryVerdict::Deliver);
    // Another servant does not know the goal.
    robot.goal("run");
    robot.governor.link_down(robot.now);
    robot.effects();
    robot.governor.link_up(robot.now, false);
    assert_eq!(robot.effects(), ["run to Cloud"]);
    // No side has accepted this one.
    robot.governor.link_down(robot.now);
    robot.goal("jump");
    let said = robot.advance(1000);
    assert!(said.iter().any(|said| said.starts_with("fail: cloud: the link is down")), "{said:?}");
}

#[test]
fn a_goal_that_the_cloud_was_at_goes_on_at_the_local_original() {
    let sla = r#"{"measure": {"link": {"after": 3}}, "local": "warm"}"#;
    let mut robot = Robot::new(json(sla));
    robot.governor.on_local_state(robot.now, LocalState::Ready);
    let goal = robot.goal("walk");
    assert!(!robot.advance(60_000).contains(&"walk to Local".to_owned()));
    robot.governor.link_down(robot.now);
    let said = robot.advance(60_000);
    assert!(said.contains(&"walk to Local".to_owned()), "{said:?}");
    let verdict = robot.governor.on_result(robot.now, Responder::Local, goal);
    assert_eq!(verdict, DeliveryVerdict::Deliver);
}

#[test]
fn a_goal_that_nobody_answers_for_minutes_stops_the_robot_once_and_one_that_is_accepted_never() {
    let stop = r#"{"local": "none", "safe_stop": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist"}}"#;
    let mut robot = Robot::new(json(stop));
    robot.goal("walk");
    robot.effects();
    assert_eq!(robot.advance(300_000), ["safe stop"]);
    let accepted = robot.goal("run");
    robot.governor.on_goal_accepted(robot.now, accepted);
    robot.effects();
    assert!(robot.advance(300_000).is_empty());
    let counts = robot.governor.report(robot.now).counts;
    assert_eq!((counts.unanswered_in_time, counts.late), (1, 2));
    let verdict = robot.governor.on_result(robot.now, Responder::Cloud, accepted);
    assert_eq!(verdict, DeliveryVerdict::Deliver);
}
