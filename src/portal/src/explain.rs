//! Why is this robot slow, or on its local original? From what its stubs tell, and what the kernel counts.

use std::sync::Arc;
use std::time::Duration;

use api::explain::{Cause, Explanation, Link, Part, Served, Weight, dominant};
use api::{Event, Phase};
use link::control::Request;
use reach::links::LinkStatus;

use crate::errors::Error;
use choreographer::{Choreographer, Handle};
use store::State;

/// Between two looks at what a servant uses.
const MOMENT: Duration = Duration::from_millis(400);
/// Events that are told.
const EVENTS: usize = 8;
/// Of these many the robot's are looked for.
const EVENTS_SEARCHED: u32 = 2000;
/// Shares and differences from which on something is worth saying.
const THROTTLED: f64 = 0.05;
const WAITS: f64 = 10.0;
const CLOCK_APART: f64 = 100.0;
const LATE: f64 = 0.05;
const QUEUED: f64 = 0.25;
/// Milliseconds: less is no queue.
const QUEUE: f64 = 5.0;
const LEFT_OUT: f64 = 0.1;
/// The event of a node that hangs; a cause for so many milliseconds.
const NODE_HUNG: &str = "node-hung";
const HANGS_FOR: u64 = 60_000;
/// The event of a stateful hand-over.
const STATE_LOST: &str = "state-lost";

/// Explains one robot.
pub async fn robot(
    choreographer: &Choreographer,
    state: &State,
    name: &str,
) -> Result<Explanation, Error> {
    let all = choreographer.servants();
    let mine: Vec<&Arc<Handle>> = all.iter().filter(|handle| handle.robot == name).collect();
    let events = events(state, name)?;
    if mine.is_empty() && events.is_empty() {
        let mut exists: Vec<String> = all.iter().map(|handle| handle.robot.clone()).collect();
        exists.sort();
        exists.dedup();
        return Err(Error::UnknownRobot {
            name: name.to_owned(),
            exists,
        });
    }
    let servants =
        futures_util::future::join_all(mine.iter().map(|handle| served(choreographer, handle)))
            .await;
    Ok(Explanation {
        robot: name.to_owned(),
        causes: causes(&servants, &events, &failing(choreographer, name)),
        servants,
        events,
    })
}

fn events(state: &State, robot: &str) -> Result<Vec<Event>, Error> {
    let mut events = state.events(0, EVENTS_SEARCHED)?;
    events.retain(|event| event.robot.as_deref() == Some(robot));
    let skipped = events.len().saturating_sub(EVENTS);
    Ok(events.split_off(skipped))
}

async fn served(choreographer: &Choreographer, handle: &Handle) -> Served {
    let before = choreographer.describe(handle).await;
    tokio::time::sleep(MOMENT).await;
    let servant = choreographer.describe(handle).await;
    let spent = |of: fn(&api::Usage) -> u64| {
        let (Some(before), Some(after)) = (&before.usage, &servant.usage) else {
            return 0.0;
        };
        of(after).saturating_sub(of(before)) as f64 / MOMENT.as_micros() as f64
    };
    Served {
        throttled: spent(|usage| usage.throttled_usec).min(1.0),
        cores: spent(|usage| usage.cpu_usec),
        links: links(handle),
        servant,
    }
}

/// The links to a servant, if it has got that far.
fn links(handle: &Handle) -> Vec<Link> {
    let status = handle.reach().map(|reach| reach.links());
    status.unwrap_or_default().into_iter().map(link).collect()
}

fn link(status: LinkStatus) -> Link {
    let millis = |seconds: f64| seconds * 1000.0;
    let max = status.sla.max.map(millis);
    let unpromised = status.sla.fallback_after.is_some();
    let is_late = |request: &&Request| match (request.total, max) {
        _ if unpromised => false,
        (Some(total), Some(max)) => total > max,
        (answered, _) => answered.is_none(),
    };
    let requests = &status.requests;
    let late: Vec<&Request> = requests.iter().filter(is_late).collect();
    let dropped = status.drops.iter().chain(&status.dropped);
    let here = status
        .drops
        .iter()
        .map(|drop| format!("in the cloud {drop}"));
    let there = status.dropped.iter();
    let drops = here
        .chain(there.map(|drop| format!("on the robot {drop}")))
        .collect();
    Link {
        up: status.up,
        round_trip: status.round_trip,
        clock: status.clock,
        throughput: status.throughput,
        dropped: dropped.map(|drop| drop.count).sum(),
        drops,
        desire: status.sla.desire.map(millis),
        max,
        threshold: status.sla.threshold,
        frames_per_second: status.sla.frames_per_second,
        desired_frames_per_second: status.sla.desired_frames_per_second,
        age: status.sla.age.map(millis),
        desired_age: status.sla.desired_age.map(millis),
        fallback_after: status.sla.fallback_after.map(millis),
        satisfaction: requests
            .last()
            .filter(|_| !unpromised)
            .map(|request| request.satisfaction),
        requests: requests.len(),
        late: late.len(),
        local: requests.iter().filter(|request| request.local).count(),
        phases: parts(requests),
        late_in: dominant(&parts(late)).cloned(),
        unsent: status.unsent,
        given: status.given,
        left_out: status.left_out,
        unfed: status.unfed,
        unserved: status.unserved,
        duplicates: status.duplicates,
        node: status.node,
    }
}

/// Where the time of those went that were answered.
fn parts<'a>(requests: impl IntoIterator<Item = &'a Request>) -> Vec<Part> {
    let answered: Vec<&Request> = requests
        .into_iter()
        .filter(|request| request.total.is_some())
        .collect();
    let times = |of: fn(&Request) -> f64| answered.iter().map(|request| of(request)).collect();
    let parts = [
        part("serialise", times(|request| request.serialise)),
        part("up", times(|request| request.up)),
        part("queue", times(|request| request.queue)),
        part("compute", times(|request| request.compute)),
        part("down", times(|request| request.down)),
        part("total", times(|request| request.total.unwrap_or(f64::NAN))),
    ];
    parts.into_iter().flatten().collect()
}

/// The robot's servants that are not started again yet, each with when they will be.
fn failing(choreographer: &Choreographer, robot: &str) -> Vec<api::BackOff> {
    let mut all = choreographer.back_offs();
    all.retain(|one| one.robot == robot);
    all
}

/// What follows from all that, the weightiest first.
fn causes(servants: &[Served], events: &[Event], failing: &[api::BackOff]) -> Vec<Cause> {
    let mut causes = Vec::new();
    let mut say = |weight, what: String, next: String| causes.push(Cause { weight, what, next });
    for one in failing {
        let left = one.again.saturating_sub(store::now()).div_ceil(1000);
        let what = format!(
            "its servants of {} have failed {} times in a row (the last one {}); the next is started in {left} s at the earliest",
            one.service, one.failures, one.reason
        );
        let next = format!(
            "cloudroidctl events; push {} again when it is fixed",
            one.service
        );
        say(Weight::Blocks, what, next);
    }
    if servants.is_empty() {
        let last = events.last().map(|event| event.message.as_str());
        let what = match last {
            Some(last) => format!("it has no servant; the last that happened: {last}"),
            None => "it has no servant".to_owned(),
        };
        let next = "look on the robot: rosrun PACKAGE cloudroid-stub doctor".to_owned();
        say(Weight::Blocks, what, next);
    }
    for served in servants {
        of_servant(served, &mut say);
        for link in &served.links {
            of_link(served, link, &mut say);
        }
    }
    let hangs = events.iter().rev().find(|event| {
        let is_there = |served: &Served| Some(&served.servant.id) == event.servant.as_ref();
        event.kind == NODE_HUNG
            && store::now().saturating_sub(event.time) < HANGS_FOR
            && servants.iter().any(is_there)
    });
    if let Some(hangs) = hangs {
        let next =
            "look at its log, or start it again: rosnode kill, or hung = \"restart\" in [servant]";
        say(Weight::Blocks, hangs.message.clone(), next.to_owned());
    }
    // Only the last one: what was lost before that is of an earlier state.
    let lost = events.iter().rev().find(|event| event.kind == STATE_LOST);
    if let Some(lost) = lost {
        say(
            Weight::Hint,
            lost.message.clone(),
            "where that matters begin anew: start its nodes again, or set local = \"none\" so that the cloud alone answers"
                .to_owned(),
        );
    }
    causes.sort_by_key(|cause| cause.weight);
    causes
}

fn of_servant(served: &Served, say: &mut impl FnMut(Weight, String, String)) {
    let servant = &served.servant;
    let id = &servant.id;
    if servant.phase != Phase::Ready {
        let reason = servant.reason.as_deref().unwrap_or("no reason is known");
        let weight = match servant.phase {
            Phase::Failed | Phase::Stopped => Weight::Blocks,
            _ => Weight::Slows,
        };
        let next = match servant.phase {
            Phase::Requested => format!("cloudroidctl fit {}", servant.service),
            _ => format!("cloudroidctl logs {id}"),
        };
        say(weight, format!("{id} is {}: {reason}", servant.phase), next);
    }
    for down in &servant.down {
        let left = down.again.saturating_sub(store::now()).div_ceil(1000);
        say(
            Weight::Blocks,
            format!(
                "{} of {id} failed {} times in a row and is started again in {left} s",
                down.node, down.failures
            ),
            format!("cloudroidctl logs {id}"),
        );
    }
    if servant.connections == 0 {
        say(
            Weight::Blocks,
            format!("nothing of the robot is connected to {id}"),
            "look on the robot: rosrun PACKAGE cloudroid-stub doctor".to_owned(),
        );
    }
    if served.throttled > THROTTLED {
        let cpus = servant
            .enforced
            .and_then(|limits| limits.cpus)
            .or(servant.limits.cpus);
        let limit = cpus.map_or_else(String::new, |cpus| format!(" of {cpus}"));
        say(
            Weight::Slows,
            format!(
                "{id} is held back by its CPU limit{limit} for {:.0} % of the time",
                served.throttled * 100.0
            ),
            format!("give {} more cores: push it with --cpus N", servant.service),
        );
    }
    let pressure = servant.usage.and_then(|usage| usage.pressure);
    let waits = pressure.map(|pressure| {
        [
            ("a core", pressure.cpu),
            ("memory", pressure.memory),
            ("a disk", pressure.io),
        ]
    });
    for (what, share) in waits.into_iter().flatten() {
        // Being held back by one's own limit counts as waiting for a core, too.
        let by_itself = what == "a core" && served.throttled > THROTTLED;
        if share > WAITS && !by_itself {
            say(
                Weight::Slows,
                format!("{id} waits for {what} {share:.0} % of the time"),
                "see what else runs on the server: cloudroidctl servants".to_owned(),
            );
        }
    }
    let killed = servant.usage.map_or(0, |usage| usage.oom_kills);
    if killed > 0 {
        say(
            Weight::Slows,
            format!("{killed} processes of {id} were killed for want of memory"),
            format!(
                "give {} more memory: push it with --memory SIZE",
                servant.service
            ),
        );
    }
    if servant.dropped > 0 {
        say(
            Weight::Hint,
            format!(
                "{} messages of {id} were dropped because a reader was slow",
                servant.dropped
            ),
            "lower the rate of what is subscribed to, or compress it".to_owned(),
        );
    }
}

fn of_link(served: &Served, link: &Link, say: &mut impl FnMut(Weight, String, String)) {
    let node = &link.node;
    if !link.up {
        say(
            Weight::Blocks,
            match link.fallback_after {
                Some(after) => format!(
                    "the link of {node} is down; where the original is installed on the robot, it stands in after {:.1} s",
                    after / 1000.0
                ),
                None => format!("the link of {node} is down"),
            },
            "look on the robot: rosrun PACKAGE cloudroid-stub doctor --only server".to_owned(),
        );
    }
    if !link.duplicates.is_empty() {
        say(
            Weight::Blocks,
            format!(
                "another machine ({}) is connected as this robot, beside that of {node}",
                link.duplicates.join(", ")
            ),
            "give one of them another id: `robot` in stub.toml, or CLOUDROID_ROBOT".to_owned(),
        );
    }
    for topic in &link.unfed {
        say(
            Weight::Blocks,
            format!("{node} listens to {topic}, which nobody on the robot publishes"),
            format!("remap it to the topic that is meant: {topic}:=/THE/TOPIC"),
        );
    }
    for service in &link.unserved {
        say(
            Weight::Hint,
            format!("{node} looked for the service {service}, which nobody served"),
            format!("start what serves it on the robot, or remap it: {service}:=/THE/SERVICE"),
        );
    }
    if let Some(clock) = link.clock.filter(|clock| clock.abs() > CLOCK_APART) {
        let side = if clock > 0.0 { "ahead of" } else { "behind" };
        say(
            Weight::Hint,
            format!(
                "the robot's clock is {:.0} ms {side} the server's",
                clock.abs()
            ),
            "sudo apt install chrony, on both sides".to_owned(),
        );
    }
    of_queue(served, link, say);
    for drop in &link.drops {
        say(
            Weight::Hint,
            drop.clone(),
            "send less (a lower rate, codec = \"jpeg\"), or give the topic's reader a longer queue"
                .to_owned(),
        );
    }
    if link.requests == 0 {
        return;
    }
    let late = link.late as f64 / link.requests as f64;
    if late > LATE {
        let max = link
            .max
            .map_or_else(String::new, |max| format!(" ({max:.0} ms)"));
        let (part, next) = blame(served, link);
        say(
            Weight::Slows,
            format!(
                "{} of the last {} requests of {node} passed T_max{max}{part}",
                link.late, link.requests
            ),
            next,
        );
    }
    if link.local > 0 {
        let q = link
            .satisfaction
            .map_or_else(String::new, |q| format!(", Q is {q:.1}"));
        say(
            Weight::Hint,
            format!(
                "the local original answered {} of the last {} requests of {node}{q}",
                link.local, link.requests
            ),
            match link.fallback_after {
                Some(_) => {
                    "it stands in while the link is away, and hands back by itself".to_owned()
                }
                None => "it stops by itself when the cloud keeps T_max again".to_owned(),
            },
        );
    }
}

/// Inputs come faster than the node takes them.
fn of_queue(served: &Served, link: &Link, say: &mut impl FnMut(Weight, String, String)) {
    let node = &link.node;
    let next = || {
        format!(
            "lower the rate of its inputs, or give it more cores: cloudroidctl set {} --cpus N",
            served.servant.id
        )
    };
    let median = |name: &str| link.part(name).map_or(0.0, |part| part.p50);
    let (queue, compute, total) = (median("queue"), median("compute"), median("total"));
    if queue > QUEUE && queue > QUEUED * total {
        say(
            Weight::Slows,
            format!(
                "requests queue before {node}: {queue:.0} ms of {total:.0} ms, while it needs {compute:.0} ms for one"
            ),
            next(),
        );
    }
    if link.unsent > 0 {
        say(
            Weight::Slows,
            format!(
                "{} inputs of {node} were not sent in the last minute: the link was busy until newer ones came",
                link.unsent
            ),
            "lower their rate, or look at the robot's network; codec = \"jpeg\" in stub.toml sends pictures in less".to_owned(),
        );
    }
    if link.left_out as f64 > LEFT_OUT * link.given as f64 {
        say(
            Weight::Slows,
            format!(
                "{node} has left out {} of its last {} inputs: newer ones came before it was done",
                link.left_out, link.given
            ),
            next(),
        );
    }
}

/// Where the time goes, and what helps there.
fn blame(served: &Served, link: &Link) -> (String, String) {
    let Some(part) = &link.late_in else {
        return (
            "; of these none was answered".to_owned(),
            "see the robot's log, and what else is named here".to_owned(),
        );
    };
    let text = format!(
        "; most of the time goes into {} ({:.0} ms)",
        part.name, part.p50
    );
    let next = match part.name.as_str() {
        "up" | "down" => "look at the robot's network; codec = \"jpeg\" in stub.toml sends pictures in less".to_owned(),
        "queue" => "requests come faster than they are answered: lower their rate, or give more cores with --cpus".to_owned(),
        "compute" => format!(
            "the node itself is slow: push {} with more --cpus, or raise T_max",
            served.servant.service
        ),
        _ => "the robot itself is busy: see top there".to_owned(),
    };
    (text, next)
}

/// Quantiles (nearest rank) of one part of the last requests; nothing when there were none.
fn part(name: &str, mut times: Vec<f64>) -> Option<Part> {
    times.retain(|time| time.is_finite());
    times.sort_by(f64::total_cmp);
    let rank = |percent: usize| {
        times
            .get((times.len() * percent).div_ceil(100).max(1) - 1)
            .copied()
    };
    Some(Part {
        name: name.to_owned(),
        p50: rank(50)?,
        p90: rank(90)?,
        max: rank(100)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn served(link: Link) -> Served {
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
                limits: api::Limits {
                    cpus: Some(0.5),
                    ..api::Limits::default()
                },
                enforced: None,
                cgroup_version: 2,
                usage: Some(api::Usage::default()),
                response: None,
                pids: Vec::new(),
                dropped: 0,
                down: Vec::new(),
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
                part("up", vec![20.0; 3]).expect("times"),
                part("compute", vec![90.0; 3]).expect("times"),
            ],
            ..Link::default()
        }
    }

    fn texts(served: Served) -> Vec<(Weight, String)> {
        causes(&[served], &[], &[])
            .into_iter()
            .map(|cause| (cause.weight, format!("{}; {}", cause.what, cause.next)))
            .collect()
    }

    #[test]
    fn when_all_is_well_nothing_is_said() {
        assert_eq!(texts(served(link())), []);
    }

    #[test]
    fn late_requests_are_blamed_on_the_part_that_takes_longest() {
        let late_in = part("compute", vec![90.0]);
        let late = Link { late: 20, ..link() };
        let unanswered = texts(served(late.clone()));
        assert!(
            unanswered[0]
                .1
                .contains("; of these none was answered; see"),
            "{unanswered:?}"
        );
        let upward = Link {
            late_in: part("up", vec![400.0]),
            ..late.clone()
        };
        let network = texts(served(upward));
        assert!(
            network[0]
                .1
                .contains("goes into up (400 ms); look at the robot's network"),
            "{network:?}"
        );
        let causes = texts(served(Link { late_in, ..late }));
        assert_eq!(causes.len(), 1);
        assert!(
            causes[0].1.starts_with(
                "20 of the last 100 requests of /detect passed T_max (300 ms); most of the time goes into compute (90 ms)"
            ),
            "{causes:?}"
        );
    }

    #[test]
    fn each_thing_that_can_be_wrong_is_named() {
        let mut all = served(Link {
            up: false,
            clock: Some(-2000.0),
            unfed: vec!["/image".into()],
            unserved: vec!["/static_map".into()],
            unsent: 12,
            given: 128,
            left_out: 40,
            phases: vec![
                part("queue", vec![60.0; 3]).expect("times"),
                part("compute", vec![30.0; 3]).expect("times"),
                part("total", vec![100.0; 3]).expect("times"),
            ],
            duplicates: vec!["rover2".into()],
            drops: vec!["on the robot 9 messages of /scan were dropped: why".into()],
            local: 7,
            satisfaction: Some(2.5),
            ..link()
        });
        all.throttled = 0.4;
        all.servant.dropped = 3;
        all.servant.usage = Some(api::Usage {
            oom_kills: 1,
            pressure: Some(api::Pressure {
                cpu: 80.0,
                memory: 30.0,
                io: 0.0,
            }),
            ..api::Usage::default()
        });
        let causes = texts(all);
        let words = [
            "the link of /detect is down",
            "another machine (rover2) is connected as this robot, beside that of /detect; give one",
            "listens to /image, which nobody on the robot publishes; remap it",
            "looked for the service /static_map, which nobody served; start",
            "held back by its CPU limit of 0.5 for 40 % of the time; give people more cores",
            "waits for memory 30 %",
            "1 processes of s1 were killed",
            "3 messages of s1 were dropped",
            "2000 ms behind the server's",
            "requests queue before /detect: 60 ms of 100 ms, while it needs 30 ms for one; lower the rate of its inputs, or give it more cores: cloudroidctl set s1 --cpus N",
            "12 inputs of /detect were not sent in the last minute",
            "/detect has left out 40 of its last 128 inputs",
            "on the robot 9 messages of /scan were dropped: why; send less",
            "answered 7 of the last 100 requests of /detect, Q is 2.5",
        ];
        for words in words {
            assert!(
                causes.iter().any(|(_, text)| text.contains(words)),
                "{words}: {causes:?}"
            );
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
        let causes = causes(&[], &[event], &[]);
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
        let causes = causes(&[], &events, &[]);
        let lost: Vec<_> = causes
            .iter()
            .filter(|cause| cause.weight == Weight::Hint)
            .collect();
        assert_eq!(lost.len(), 1);
        assert_eq!(lost[0].what, "the cloud goes on without 3 of /scan");
        assert!(
            lost[0].next.contains("local = \"none\""),
            "{}",
            lost[0].next
        );
    }

    #[test]
    fn a_links_requests_are_summed_up() {
        use link::drops::{Cause, Drop};
        let request = |total: Option<f64>, local| Request {
            total,
            compute: 40.0,
            local,
            satisfaction: 6.0,
            ..Request::default()
        };
        let dropped = |cause, count| Drop {
            topic: "/image".into(),
            cause,
            count,
        };
        let seen = super::link(LinkStatus {
            node: "/detect".into(),
            up: true,
            round_trip: Some(2.0),
            clock: None,
            throughput: None,
            drops: vec![dropped(Cause::Slow, 2)],
            dropped: vec![dropped(Cause::Replaced, 30)],
            sla: link::control::Sla {
                desire: Some(0.05),
                max: Some(0.1),
                ..Default::default()
            },
            requests: vec![
                request(Some(50.0), false),
                Request {
                    up: 90.0,
                    ..request(Some(150.0), true)
                },
                request(None, true),
            ],
            unsent: 0,
            given: 3,
            left_out: 1,
            unfed: vec![],
            unserved: vec![],
            duplicates: vec![],
        });
        assert_eq!((seen.requests, seen.late, seen.local), (3, 2, 2));
        assert_eq!(seen.dropped, 32);
        assert!(seen.drops[0].starts_with("in the cloud 2 messages of /image were dropped: "));
        assert!(seen.drops[1].starts_with("on the robot 30 messages of /image were dropped: "));
        assert_eq!((seen.max, seen.satisfaction), (Some(100.0), Some(6.0)));
        let total = seen.phases.last().expect("parts");
        assert_eq!(
            (total.name.as_str(), total.p50, total.max),
            ("total", 50.0, 150.0)
        );
        let name = |part: Option<&Part>| part.map(|part| part.name.clone());
        assert_eq!(name(seen.dominant()).as_deref(), Some("compute"));
        let late_in = name(seen.late_in.as_ref());
        assert_eq!(late_in.as_deref(), Some("up"), "of those that were late");
    }

    #[test]
    fn what_was_never_promised_is_not_late() {
        let request = |total: Option<f64>| Request {
            total,
            local: total.is_none(),
            satisfaction: 8.0,
            ..Request::default()
        };
        let seen = super::link(LinkStatus {
            node: "/detect".into(),
            up: false,
            round_trip: None,
            clock: None,
            throughput: None,
            drops: vec![],
            dropped: vec![],
            sla: link::control::Sla {
                fallback_after: Some(3.0),
                ..Default::default()
            },
            requests: vec![request(Some(9000.0)), request(None)],
            unsent: 0,
            given: 0,
            left_out: 0,
            unfed: vec![],
            unserved: vec![],
            duplicates: vec![],
        });
        assert_eq!((seen.late, seen.local, seen.satisfaction), (0, 1, None));
        let causes = texts(served(seen));
        for words in [
            "the link of /detect is down; where the original is installed on the robot, it stands in after 3.0 s",
            "answered 1 of the last 2 requests of /detect; it stands in while the link is away",
        ] {
            assert!(
                causes.iter().any(|(_, text)| text.contains(words)),
                "{words}: {causes:?}"
            );
        }
        assert_eq!(causes.len(), 2, "{causes:?}");
    }

    #[test]
    fn quantiles_are_nearest_ranks() {
        let times: Vec<f64> = (1..=10).map(f64::from).collect();
        let part = part("up", times).expect("times");
        assert_eq!((part.p50, part.p90, part.max), (5.0, 9.0, 10.0));
        assert_eq!(super::part("up", vec![f64::NAN]), None);
    }
}
