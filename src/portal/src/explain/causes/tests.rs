use api::explain::Part;
use choreographer::{RequestTracer, TracedServant};
use link::control::RequestTiming;
use reach::links::{LinkStatus, MeasuredRequest};

use super::*;

fn served_with(link: Link) -> Served {
    Served {
        servant: api::Servant {
            id: "s1".into(),
            service: "people".into(),
            revision: 1,
            robot: "rover".into(),
            phase: Phase::Ready,
            reason: None,
            created: 0,
            connections: 1,
            idle_until: None,
            terms: None,
            limits: api::Limits { cpus: Some(0.5), ..api::Limits::default() },
            enforced: None,
            cgroup_version: 2,
            usage: Some(api::Usage::default()),
            response: None,
            pids: Vec::new(),
            dropped: 0,
            drops: Vec::new(),
            down: Vec::new(),
            hung: Vec::new(),
            lifecycle: Vec::new(),
        },
        throttled: 0.0,
        cores: 0.0,
        links: vec![link],
    }
}

fn link() -> Link {
    Link {
        node: "/detect".into(),
        up: true,
        clock: Some(3.0),
        max: Some(300.0),
        requests: 100,
        phases: vec![
            Part::from_samples("up", vec![20.0; 3]).expect("times"),
            Part::from_samples("compute", vec![90.0; 3]).expect("times"),
        ],
        ..Link::default()
    }
}

fn texts(served: Served) -> Vec<(Weight, String)> {
    find_causes(&[served], &[], &[], &[])
        .into_iter()
        .map(|cause| (cause.weight, format!("{}; {}", cause.what, cause.next)))
        .collect()
}

#[test]
fn when_all_is_well_nothing_is_said() {
    assert_eq!(texts(served_with(link())), []);
}

#[test]
fn late_requests_are_blamed_on_the_part_that_takes_longest() {
    let late_in = Part::from_samples("compute", vec![90.0]);
    let late = Link { late: 20, ..link() };
    let unanswered = texts(served_with(late.clone()));
    assert!(unanswered[0].1.contains("; none of these was answered; see"), "{unanswered:?}");
    let upward = Link { late_in: Part::from_samples("up", vec![400.0]), ..late.clone() };
    let network = texts(served_with(upward));
    assert!(network[0].1.contains("is spent in up (400 ms); check the robot's network"), "{network:?}");
    let causes = texts(served_with(Link { late_in, ..late }));
    assert_eq!(causes.len(), 1);
    assert!(
        causes[0].1.starts_with(
            "20 of the last 100 requests of /detect exceeded T_max (300 ms); most of the time is spent in compute (90 \
                ms)"
        ),
        "{causes:?}"
    );
}

#[test]
fn each_thing_that_can_be_wrong_is_named() {
    let mut all = served_with(Link {
        up: false,
        clock: Some(-2000.0),
        unfed: vec!["/image".into()],
        unserved: vec!["/static_map".into()],
        refused: vec!["no messages on /seen pass between /view and /detect: why".into()],
        unsent: 12,
        given: 128,
        left_out: 40,
        phases: vec![
            Part::from_samples("queue", vec![60.0; 3]).expect("times"),
            Part::from_samples("compute", vec![30.0; 3]).expect("times"),
            Part::from_samples("total", vec![100.0; 3]).expect("times"),
        ],
        duplicates: vec!["rover2".into()],
        drops: vec!["on the robot 9 messages of /scan were dropped: why".into()],
        local: 7,
        satisfaction: Some(2.5),
        ..link()
    });
    all.throttled = 0.4;
    all.servant.dropped = 3;
    all.servant.hung = vec!["/detect answered none of 9 inputs in 3.0 s".into()];
    all.servant.usage = Some(api::Usage {
        oom_kills: 1,
        pressure: Some(api::Pressure { cpu: 80.0, memory: 30.0, io: 0.0 }),
        ..api::Usage::default()
    });
    let causes = texts(all);
    let words = [
        "the link of /detect is down",
        "another machine (rover2) is connected as this robot, besides the one that runs /detect; give one",
        "subscribes to /image, which no node on the robot publishes; remap it",
        "looked for the service /static_map, which no node serves; start",
        "throttled by its CPU limit of 0.5 for 40 % of the time; give people more cores",
        "s1 hangs: /detect answered none of 9 inputs in 3.0 s; cloudroidctl logs s1",
        "waits for memory 30 %",
        "1 processes of s1 were killed",
        "3 messages of s1 were dropped",
        "no messages on /seen pass between /view and /detect: why; let the subscriber request no more",
        "2000 ms behind the server's",
        "requests wait 60 ms of 100 ms in the queue of /detect, which needs 30 ms for one; lower the rate of its \
            inputs, or give it more cores: cloudroidctl set s1 --cpus N",
        "12 inputs of /detect were not sent in the last minute",
        "/detect skipped 40 of its last 128 inputs",
        "on the robot 9 messages of /scan were dropped: why; send less",
        "answered 7 of the last 100 requests of /detect, Q is 2.5",
    ];
    for words in words {
        assert!(causes.iter().any(|(_, text)| text.contains(words)), "{words}: {causes:?}");
    }
    assert_eq!(causes.len(), words.len(), "{causes:?}");
    assert!(causes.is_sorted_by_key(|(weight, _)| *weight));
}

#[test]
fn a_robot_without_a_servant_is_told_what_happened_last() {
    let event = Event {
        id: 1,
        time: 0,
        level: api::Level::Error,
        kind: "servant-failed".into(),
        service: None,
        servant: None,
        robot: Some("rover".into()),
        message: "the servant ran out of memory".into(),
    };
    let causes = find_causes(&[], &[event], &[], &[]);
    assert_eq!(causes[0].weight, Weight::Blocks);
    assert!(causes[0].what.ends_with("the servant ran out of memory"));
}

#[test]
fn what_a_hand_over_has_lost_is_named() {
    let event = |kind: &str, message: &str| Event {
        id: 1,
        time: 0,
        level: api::Level::Warning,
        kind: kind.into(),
        service: None,
        servant: None,
        robot: Some("rover".into()),
        message: message.into(),
    };
    let events = [
        event("state-lost", "the first"),
        event("state-lost", "the cloud goes on without 3 of /scan"),
        event("local-hands-back", "the link is up again"),
    ];
    let causes = find_causes(&[], &events, &[], &[]);
    let lost: Vec<_> = causes.iter().filter(|cause| cause.weight == Weight::Hint).collect();
    assert_eq!(lost.len(), 1);
    assert_eq!(lost[0].what, "the cloud goes on without 3 of /scan");
    assert!(lost[0].next.contains("local = \"none\""), "{}", lost[0].next);
}

/// Names traces by session and request; those of odd requests are not sampled.
#[derive(Debug)]
struct EvenTracer;

impl RequestTracer for EvenTracer {
    fn record(&self, _: TracedServant<'_>, _: &MeasuredRequest<'_>) {}
    fn trace_id(&self, session: &str, request: u64) -> Option<String> {
        (request % 2 == 0).then(|| format!("{session}:{request}"))
    }
    fn dropped_spans(&self) -> u64 {
        0
    }
}

#[test]
fn the_trace_of_a_late_request_is_named_first() {
    let trace = |max: f64, totals: [Option<f64>; 4]| {
        let requests =
            totals.iter().zip(2..).map(|(total, id)| RequestTiming { id, total: *total, ..RequestTiming::default() });
        let status = LinkStatus { requests: requests.collect(), ..link_status(Some(max)) };
        crate::explain::to_link(status, Some(&EvenTracer)).trace
    };
    let all = [Some(50.0), Some(150.0), Some(20.0), Some(20.0)];
    assert_eq!(trace(0.01, all).as_deref(), Some("run-1:4"));
    assert_eq!(trace(0.04, all).as_deref(), Some("run-1:2"));
    assert_eq!(trace(1.0, all).as_deref(), Some("run-1:4"));
    // What was never answered may have no trace.
    let none = [None, Some(150.0), None, Some(20.0)];
    assert_eq!(trace(0.1, none), None);
    let status = link_status(Some(0.1));
    assert_eq!(crate::explain::to_link(status, None).trace, None);
}

/// Returns the status of a link that is up and has no requests; `max` is T_max in seconds.
fn link_status(max: Option<f64>) -> LinkStatus {
    LinkStatus {
        session: "run-1".into(),
        node: "/detect".into(),
        up: true,
        round_trip: Some(2.0),
        clock: None,
        throughput: None,
        drops: vec![],
        dropped: vec![],
        sla: link::control::SlaTargets { desire: max.map(|max| max / 2.0), max, ..Default::default() },
        requests: vec![],
        unsent: 0,
        given: 3,
        left_out: 1,
        unfed: vec![],
        unserved: vec![],
        refused: vec![],
        duplicates: vec![],
    }
}

#[test]
fn a_links_requests_are_summed_up() {
    use link::drops::{Cause, TopicDropCount};
    let request = |total: Option<f64>, local| RequestTiming {
        total,
        compute: 40.0,
        local,
        satisfaction: 6.0,
        ..RequestTiming::default()
    };
    let dropped = |cause, count| TopicDropCount { topic: "/image".into(), cause, count };
    let status = LinkStatus {
        drops: vec![dropped(Cause::Slow, 2)],
        dropped: vec![dropped(Cause::Replaced, 30)],
        requests: vec![
            request(Some(50.0), false),
            RequestTiming { up: 90.0, ..request(Some(150.0), true) },
            request(None, true),
        ],
        refused: vec![link::control::IncompatibleEndpoint {
            topic: "/seen".into(),
            node: "/view".into(),
            why: "durability".into(),
        }],
        ..link_status(Some(0.1))
    };
    let seen = crate::explain::to_link(status, None);
    assert_eq!((seen.requests, seen.late, seen.local), (3, 2, 2));
    assert_eq!(seen.dropped, 32);
    assert!(seen.drops[0].starts_with("in the cloud 2 messages of /image were dropped: "));
    assert!(seen.drops[1].starts_with("on the robot 30 messages of /image were dropped: "));
    assert_eq!(seen.refused, ["no messages on /seen pass between /view and /detect: durability"]);
    assert_eq!((seen.max, seen.satisfaction), (Some(100.0), Some(6.0)));
    let total = seen.phases.last().expect("parts");
    assert_eq!((total.name.as_str(), total.p50, total.max), ("total", 50.0, 150.0));
    let name = |part: Option<&Part>| part.map(|part| part.name.clone());
    assert_eq!(name(seen.dominant()).as_deref(), Some("compute"));
    let late_in = name(seen.late_in.as_ref());
    assert_eq!(late_in.as_deref(), Some("up"), "of those that were late");
}

#[test]
fn what_was_never_promised_is_not_late() {
    let request = |total: Option<f64>| RequestTiming {
        total,
        local: total.is_none(),
        satisfaction: 8.0,
        ..RequestTiming::default()
    };
    let status = LinkStatus {
        up: false,
        round_trip: None,
        sla: link::control::SlaTargets { fallback_after: Some(3.0), ..Default::default() },
        requests: vec![request(Some(9000.0)), request(None)],
        given: 0,
        left_out: 0,
        ..link_status(None)
    };
    let seen = crate::explain::to_link(status, None);
    assert_eq!((seen.late, seen.local, seen.satisfaction), (0, 1, None));
    let causes = texts(served_with(seen));
    for words in [
        "the link of /detect is down; if the original is installed on the robot, it takes over after 3.0 s",
        "answered 1 of the last 2 requests of /detect; it takes over while the link is down",
    ] {
        assert!(causes.iter().any(|(_, text)| text.contains(words)), "{words}: {causes:?}");
    }
    assert_eq!(causes.len(), 2, "{causes:?}");
}

#[test]
fn a_canary_that_waits_is_told_with_what_to_do() {
    let arm = api::rollout::Arm::default();
    let rollout = api::Rollout {
        service: "people".into(),
        stable: 1,
        candidate: 2,
        state: api::rollout::RolloutState::Canary,
        reason: "the first robot".into(),
        waits: Some("it has had 3 requests of the 20 required".into()),
        started: 0,
        changed: 0,
        terms: api::rollout::RolloutTerms::default(),
        of_stable: arm,
        of_candidate: arm,
    };
    let causes = super::find_causes(&[served_with(link())], &[], &[], &[rollout]);
    let found = causes.iter().find(|cause| cause.what.contains("canary"));
    let found = found.expect("it is told");
    assert_eq!(found.weight, Weight::Hint);
    assert_eq!(
        found.what,
        "revision 2 of people, a canary, is not promoted yet: it has had 3 requests of the 20 required"
    );
    assert!(found.next.contains("rollout people promote"), "{}", found.next);
}
