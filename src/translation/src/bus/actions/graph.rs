//! Actions in the graph that a robot sees.

use std::collections::BTreeSet;

use ros::bus::{ActionNodes, Graph, RosVersion, ServiceType, TopicNodes, WireType, action_endpoints};
use ros::ros2::actions::ActionInterfaces;
use ros::ros2::names;

use crate::ActionTwin;
use crate::bus::state::TranslatedGraph;
use crate::bus::twins::{KnownTwins, Untranslatable};

/// Adds the actions that nodes of the servant serve or look for, as a robot of this version sees them. `own` is the
/// bus's own node, which is a client of those in use, and serves those of the robot.
pub(crate) fn add_actions(
    version: RosVersion,
    inner: &Graph,
    own: &str,
    twins: &KnownTwins,
    out: &mut TranslatedGraph,
) {
    for (action, nodes) in &inner.actions {
        let owners = |nodes: &[String]| {
            let nodes = nodes.iter().filter(|node| *node != own);
            let owners: BTreeSet<String> = nodes.map(|node| inner.process_owner(node).to_owned()).collect();
            owners.into_iter().collect::<Vec<_>>()
        };
        let (mut servers, clients) = (owners(&nodes.servers), owners(&nodes.clients));
        if servers.is_empty() && clients.is_empty() {
            continue;
        }
        if servers.is_empty() {
            // In place of the robot's server, if there is one.
            servers.extend(nodes.servers.first().cloned());
        }
        let shown = ActionNodes { type_name: String::new(), servers, clients, topics: Vec::new() };
        if let Err(reason) = add_action((version, own), action, nodes, shown.clone(), twins, out) {
            let has = shown.servers.iter().chain(&shown.clients).map(String::as_str);
            out.leave_out(format!("action {action}"), has, &reason);
        }
    }
}

fn add_action(
    (version, own): (RosVersion, &str),
    action: &str,
    nodes: &ActionNodes,
    shown: ActionNodes,
    twins: &KnownTwins,
    out: &mut TranslatedGraph,
) -> Result<(), Untranslatable> {
    if version == RosVersion::Two && !names::is_global(action) {
        return Err(Untranslatable::Name);
    }
    let twin = twins.action(&nodes.type_name)?;
    match version {
        RosVersion::One => add_to_ros1(action, &twin, shown, out),
        RosVersion::Two => add_to_ros2((action, own), &twin, shown, out)?,
    }
    Ok(())
}

/// Shows the five topics of an action.
fn add_to_ros1(action: &str, twin: &ActionTwin, shown: ActionNodes, out: &mut TranslatedGraph) {
    let type_name = twin.twin.name.clone();
    let ends = action_endpoints(RosVersion::One, action);
    for (end, topic) in &ends {
        let (servers, clients) = (shown.servers.clone(), shown.clients.clone());
        let (publishers, subscribers) =
            if end.is_published_by_clients() { (clients, servers) } else { (servers, clients) };
        let nodes = TopicNodes { type_name: end.type_name(&type_name), publishers, subscribers };
        out.graph.topics.insert(topic.clone(), nodes);
    }
    let topics = ends.into_iter().map(|(_, topic)| topic).collect();
    out.graph.actions.insert(action.to_owned(), ActionNodes { type_name, topics, ..shown });
}

/// Shows an action, whose parts are endpoints of its servers. Where there is none beside `own`, the topics that its
/// clients subscribe to are shown, so that a server of the robot reaches them.
fn add_to_ros2(
    (action, own): (&str, &str),
    twin: &ActionTwin,
    shown: ActionNodes,
    out: &mut TranslatedGraph,
) -> Result<(), Untranslatable> {
    let parts = ActionInterfaces::for_action(action, &twin.twin).map_err(Untranslatable::Parts)?;
    let topics = [(&parts.feedback, ActionInterfaces::feedback_qos()), (&parts.status, ActionInterfaces::status_qos())];
    let topics = topics.map(|((topic, of), qos)| {
        let of = WireType { definition: String::new(), ..of.clone() };
        (topic.clone(), (of, qos))
    });
    let servers = || shown.servers.iter().filter(move |server| *server != own);
    for server in servers() {
        let has = out.graph.ends.entry(server.clone()).or_default();
        for (service, of) in [&parts.send_goal, &parts.get_result, &parts.cancel_goal] {
            has.services.insert(service.clone(), ServiceType::clone(of));
        }
        has.publishers.extend(topics.clone());
    }
    if servers().next().is_none() {
        for client in &shown.clients {
            out.graph.ends.entry(client.clone()).or_default().subscribers.extend(topics.clone());
        }
    }
    let type_name = twin.twin.name.clone();
    out.graph.actions.insert(action.to_owned(), ActionNodes { type_name, ..shown });
    Ok(())
}
