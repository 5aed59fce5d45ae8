//! Derives causes from what is known of a robot, and what to do about each.

use api::explain::{Cause, Link, Served, Weight};
use api::{Event, Phase, count};

/// Thresholds above which a share or difference is reported.
const THROTTLED_SHARE: f64 = 0.05;
const WAITS: f64 = 10.0;
const CLOCK_APART: f64 = 100.0;
const LATE: f64 = 0.05;
const QUEUE_SHARE: f64 = 0.25;
/// Waiting time in milliseconds below which there is no queue.
const QUEUE: f64 = 5.0;
const LEFT_OUT_SHARE: f64 = 0.1;
/// Kind of the event of a stateful hand-over.
const STATE_LOST: &str = "state-lost";

/// Derives all causes, the most serious first.
pub(super) fn find_causes(
    servants: &[Served],
    events: &[Event],
    failing: &[api::BackOff],
    waiting: &[api::Rollout],
) -> Vec<Cause> {
    let mut causes = Vec::new();
    let mut say = |weight, what: String, next: String| causes.push(Cause { weight, what, next });
    for one in failing {
        let left = one.again.saturating_sub(store::now()).div_ceil(1000);
        let what = format!(
            "its servants of {} failed {} in a row (the last one {}); the next start is in {left} s at the earliest",
            one.service,
            count(one.failures, "time"),
            one.reason
        );
        let next = format!("cloudroidctl events; push {} again when it is fixed", one.service);
        say(Weight::Blocks, what, next);
    }
    if servants.is_empty() {
        let last = events.last().map(|event| event.message.as_str());
        let what = match last {
            Some(last) => format!("it has no servant; last event: {last}"),
            None => "it has no servant".to_owned(),
        };
        let next = "run on the robot: rosrun PACKAGE cloudroid-stub doctor".to_owned();
        say(Weight::Blocks, what, next);
    }
    for served in servants {
        add_servant_causes(served, &mut say);
        for link in &served.links {
            add_link_causes(served, link, &mut say);
        }
    }
    for rollout in waiting {
        let (service, revision) = (&rollout.service, rollout.candidate);
        let why = rollout.waits.as_deref().unwrap_or_default();
        say(
            Weight::Hint,
            format!("revision {revision} of {service}, a canary, is not promoted yet: {why}"),
            format!(
                "cloudroidctl rollout {service}; to decide by hand: cloudroidctl rollout {service} promote, or abort"
            ),
        );
    }
    // Only the last event: earlier losses concern an earlier state.
    let lost = events.iter().rev().find(|event| event.kind == STATE_LOST);
    if let Some(lost) = lost {
        say(
            Weight::Hint,
            lost.message.clone(),
            "if that matters, restart its nodes, or set local = \"none\" so that only the cloud answers".to_owned(),
        );
    }
    causes.sort_by_key(|cause| cause.weight);
    causes
}

fn add_servant_causes(served: &Served, say: &mut impl FnMut(Weight, String, String)) {
    let servant = &served.servant;
    let id = &servant.id;
    if servant.phase != Phase::Ready {
        let reason = servant.reason.as_deref().unwrap_or("unknown reason");
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
            format!("{} of {id} failed {} in a row and restarts in {left} s", down.node, count(down.failures, "time")),
            format!("cloudroidctl logs {id}"),
        );
    }
    for hangs in &servant.hung {
        say(
            Weight::Blocks,
            format!("{id} hangs: {hangs}"),
            format!("cloudroidctl logs {id}; to restart such nodes automatically: hung = \"restart\" in [servant]"),
        );
    }
    if servant.connections == 0 {
        say(
            Weight::Blocks,
            format!("the robot is not connected to {id}"),
            "run on the robot: rosrun PACKAGE cloudroid-stub doctor".to_owned(),
        );
    }
    if served.throttled > THROTTLED_SHARE {
        let cpus = servant.enforced.and_then(|limits| limits.cpus).or(servant.limits.cpus);
        let limit = cpus.map_or_else(String::new, |cpus| format!(" of {cpus}"));
        say(
            Weight::Slows,
            format!("{id} is throttled by its CPU limit{limit} for {:.0} % of the time", served.throttled * 100.0),
            format!("give {} more cores: push it with --cpus N", servant.service),
        );
    }
    let pressure = servant.usage.and_then(|usage| usage.pressure);
    let waits =
        pressure.map(|pressure| [("a core", pressure.cpu), ("memory", pressure.memory), ("a disk", pressure.io)]);
    for (what, share) in waits.into_iter().flatten() {
        // Throttling by the servant's own limit also counts as waiting for a core.
        let by_itself = what == "a core" && served.throttled > THROTTLED_SHARE;
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
            format!("{killed} processes of {id} were killed because they ran out of memory"),
            format!("give {} more memory: push it with --memory SIZE", servant.service),
        );
    }
    if servant.dropped > 0 {
        say(
            Weight::Hint,
            format!(
                "{} of {id} {} dropped because a subscriber was slow",
                count(servant.dropped, "message"),
                if servant.dropped == 1 { "was" } else { "were" }
            ),
            "lower the rate of the subscribed topics, or compress them".to_owned(),
        );
    }
}

fn add_link_causes(served: &Served, link: &Link, say: &mut impl FnMut(Weight, String, String)) {
    let node = &link.node;
    if !link.up {
        say(
            Weight::Blocks,
            match link.fallback_after {
                Some(after) => format!(
                    "the link of {node} is down; if the original is installed on the robot, it takes over after {:.1} \
                        s",
                    after / 1000.0
                ),
                None => format!("the link of {node} is down"),
            },
            "run on the robot: rosrun PACKAGE cloudroid-stub doctor --only server".to_owned(),
        );
    }
    if !link.duplicates.is_empty() {
        say(
            Weight::Blocks,
            format!(
                "another machine ({}) is connected as this robot, besides the one that runs {node}",
                link.duplicates.join(", ")
            ),
            "give one of them another id: `robot` in stub.toml, or CLOUDROID_ROBOT".to_owned(),
        );
    }
    for topic in &link.unfed {
        say(
            Weight::Blocks,
            format!("{node} subscribes to {topic}, which no node on the robot publishes"),
            format!("remap it to the intended topic: {topic}:=/THE/TOPIC"),
        );
    }
    for service in &link.unserved {
        say(
            Weight::Hint,
            format!("{node} looked for the service {service}, which no node serves"),
            format!("start a node that serves it on the robot, or remap it: {service}:=/THE/SERVICE"),
        );
    }
    for refused in &link.refused {
        say(
            Weight::Hint,
            refused.clone(),
            "let the subscriber request no more than the publisher offers (ros2 topic info -v shows both)".to_owned(),
        );
    }
    if let Some(clock) = link.clock.filter(|clock| clock.abs() > CLOCK_APART) {
        let side = if clock > 0.0 { "ahead of" } else { "behind" };
        say(
            Weight::Hint,
            format!("the robot's clock is {:.0} ms {side} the server's", clock.abs()),
            "sudo apt install chrony, on both sides".to_owned(),
        );
    }
    add_queue_causes(served, link, say);
    for drop in &link.drops {
        say(
            Weight::Hint,
            drop.clone(),
            "send less (a lower rate, codec = \"jpeg\"), or give the topic's subscriber a longer queue".to_owned(),
        );
    }
    if link.requests == 0 {
        return;
    }
    let late = link.late as f64 / link.requests as f64;
    if late > LATE {
        let max = link.max.map_or_else(String::new, |max| format!(" ({max:.0} ms)"));
        let (part, next) = blame(served, link);
        say(
            Weight::Slows,
            format!(
                "{} of the last {} of {node} exceeded T_max{max}{part}",
                link.late,
                count(link.requests, "request")
            ),
            next,
        );
    }
    if link.local > 0 {
        let q = link.satisfaction.map_or_else(String::new, |q| format!(", Q is {q:.1}"));
        say(
            Weight::Hint,
            format!(
                "the local original answered {} of the last {} of {node}{q}",
                link.local,
                count(link.requests, "request")
            ),
            match link.fallback_after {
                Some(_) => "it takes over while the link is down, and stops automatically when it is back".to_owned(),
                None => "it stops automatically when the cloud meets T_max again".to_owned(),
            },
        );
    }
}

/// Reports inputs that arrive faster than the node processes them.
fn add_queue_causes(served: &Served, link: &Link, say: &mut impl FnMut(Weight, String, String)) {
    let node = &link.node;
    let next = || {
        format!("lower the rate of its inputs, or give it more cores: cloudroidctl set {} --cpus N", served.servant.id)
    };
    let median = |name: &str| link.part(name).map_or(0.0, |part| part.p50);
    let (queue, compute, total) = (median("queue"), median("compute"), median("total"));
    if queue > QUEUE && queue > QUEUE_SHARE * total {
        say(
            Weight::Slows,
            format!(
                "requests wait {queue:.0} ms of {total:.0} ms in the queue of {node}, which needs {compute:.0} ms for \
                    one"
            ),
            next(),
        );
    }
    if link.unsent > 0 {
        say(
            Weight::Slows,
            format!(
                "{} inputs of {node} were not sent in the last minute: the link was busy until newer ones arrived",
                link.unsent
            ),
            "lower their rate, or check the robot's network; codec = \"jpeg\" in stub.toml \
                makes pictures smaller"
                .to_owned(),
        );
    }
    if link.left_out as f64 > LEFT_OUT_SHARE * link.given as f64 {
        say(
            Weight::Slows,
            format!(
                "{node} skipped {} of its last {} inputs: newer ones arrived before it was done",
                link.left_out, link.given
            ),
            next(),
        );
    }
}

/// Returns the phase that takes most of the time, and what helps against it.
fn blame(served: &Served, link: &Link) -> (String, String) {
    let Some(part) = &link.late_in else {
        return (
            "; none of these was answered".to_owned(),
            "see the robot's log and the other causes listed here".to_owned(),
        );
    };
    let text = format!("; most of the time is spent in {} ({:.0} ms)", part.name, part.p50);
    let next = match part.name.as_str() {
        "up" | "down" => "check the robot's network; codec = \"jpeg\" in stub.toml makes \
            pictures smaller"
            .to_owned(),
        "queue" => "requests arrive faster than they are answered: lower their rate, or give more \
                    cores with --cpus"
            .to_owned(),
        "compute" => {
            format!("the node itself is slow: push {} with more --cpus, or raise T_max", served.servant.service)
        }
        _ => "the robot itself is busy: run top there".to_owned(),
    };
    (text, next)
}

#[cfg(test)]
mod tests;
