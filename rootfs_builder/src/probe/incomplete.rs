//! Marks and warnings for interfaces that may be incomplete.

use std::collections::BTreeSet;

use package::interface::{Direction, Interface};

use super::feed::InputFeed;
use super::{ProbeOptions, ProbeResult};

const ACTION_ENDS: [&str; 5] = ["/goal", "/cancel", "/status", "/feedback", "/result"];
const STATE: &str = "add what is missing with --interface FILE";

/// Marks what is not in `bare`, the interface before any input was given: a servant has it only once its robot provides
/// what the nodes wait for.
pub(super) fn mark_late(interface: &mut Interface, bare: &Interface) {
    for topic in &mut interface.topics {
        let same = |other: &&package::interface::Topic| other.name == topic.name && other.direction == topic.direction;
        match bare.topics.iter().find(same) {
            Some(before) => topic.lazy |= before.lazy,
            None => topic.lazy = true,
        }
    }
    let services = interface.services.iter().map(|service| &service.name);
    let new_services = services.filter(|name| !bare.services.iter().any(|before| before.name == **name));
    let actions = interface.actions.iter().map(|action| &action.name);
    let new_actions = actions.filter(|name| !bare.actions.iter().any(|before| before.name == **name));
    let late: BTreeSet<&String> = new_services.chain(new_actions).collect();
    let late = late.into_iter().cloned().collect();
    interface.late = late;
}

/// Keeps inputs that have disappeared: a node that waits for a single message unsubscribes once it has arrived, and
/// waits for it again in every servant.
pub(super) fn keep_inputs(interface: &mut Interface, before: Interface) {
    let gone = before.topics.into_iter().filter(|topic| {
        let same = |other: &package::interface::Topic| other.name == topic.name && other.direction == topic.direction;
        let of_an_action = interface.actions.iter().any(|action| {
            let end = topic.name.strip_prefix(action.name.as_str());
            end.is_some_and(|end| ACTION_ENDS.contains(&end))
        });
        topic.direction == Direction::Input && !of_an_action && !interface.topics.iter().any(same)
    });
    let gone: Vec<_> = gone.map(|topic| package::interface::Topic { lazy: true, ..topic }).collect();
    interface.topics.extend(gone);
    for (key, text) in before.definitions {
        interface.definitions.entry(key).or_insert(text);
    }
    interface.sort();
}

/// Adds a warning to the interface of a package of which a node exited because of the messages it was given.
pub(super) fn with_exit_warning(mut found: ProbeResult, words: &str) -> ProbeResult {
    found.warnings.push(format!(
        "{words} when it got default messages to find the rest of its interface; the interface found until then is \
            published; if it is incomplete, {STATE}"
    ));
    found
}

/// Adds warnings about what may be missing.
pub(super) fn add_warnings(found: &mut ProbeResult, options: &ProbeOptions, feed: &mut InputFeed<'_>) {
    let interface = &found.interface;
    let outputs = |interface: &Interface| {
        let topics = interface.topics.iter();
        topics.filter(|topic| topic.direction == Direction::Output).count()
            + interface.services.len()
            + interface.actions.len()
    };
    let nodes = options.nodes.join(", ");
    let said = feed.wait_messages();
    let words = said.iter().map(|(node, text)| format!("; {node} says: {text}"));
    let words: String = words.collect();
    if interface.topics.is_empty() && interface.services.is_empty() && interface.actions.is_empty() {
        found.warnings.push(format!(
            "no topic, service or action of {nodes} was found: it may wait for input that the push cannot give; \
             {STATE}{words}"
        ));
    } else if outputs(interface) == 0 {
        found.warnings.push(format!(
            "no output, service or action of {nodes} was found, only inputs; if there are others, {STATE}{words}"
        ));
    } else if !words.is_empty() {
        found.warnings.push(format!("the interface may be incomplete; {STATE}{words}"));
    }
    let any: Vec<&str> =
        interface.topics.iter().filter(|topic| topic.type_name == "*").map(|topic| topic.name.as_str()).collect();
    if !any.is_empty() {
        found.warnings.push(format!(
            "inputs and outputs of any type: {}; give the type that is used in a file for --interface",
            any.join(", ")
        ));
    }
    for (topic, reason) in feed.failed_inputs() {
        found.warnings.push(format!("no test message could be sent to {topic}: {reason}; {STATE}"));
    }
}
