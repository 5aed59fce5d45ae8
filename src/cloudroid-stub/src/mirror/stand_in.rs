//! Registers on the robot the interface that the local original registers in its private ROS system, as long as the
//! cloud was never reached and has not sent the interface of the node.

use std::sync::{Arc, Weak};

use link::control::{self, Graph, OutputChannel, RequestedInput, ServiceChannel};
use ros::bus::{QosProfile, ServiceType, WireType};

use super::outputs::NOWHERE;
use super::state::{KnownType, Mirror};
use crate::local::{Keeper, Original, RegisteredInterface};

/// Registers the interface of the local original on the robot until the cloud has sent the node's interface.
pub async fn run_stand_in(mirror: Weak<Mirror>, keeper: Weak<Keeper>) {
    // Not held while nothing changes, because the original ends with its keeper.
    let original = || keeper.upgrade()?.original().cloned();
    let Some(mut changes) = original().map(|original| original.registration_changes()) else {
        return;
    };
    while changes.next().await {
        let Some(original) = original() else { return };
        let registered = original.registered_interface().await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        if !mirror.stand_in(&original, registered).await {
            return;
        }
    }
}

impl Mirror {
    /// Registers this in place of the cloud's interface; returns false once the cloud has sent its own. Nothing is
    /// unregistered: the original may have ended because the cloud was reached, and its interface follows.
    async fn stand_in(self: &Arc<Self>, original: &Original, registered: RegisteredInterface) -> bool {
        let mut applied = self.applied.lock().await;
        if applied.graph.is_some() {
            return false;
        }
        applied.stood_in = true;
        let types = registered.outputs.iter().chain(&registered.inputs);
        for (_, wire_type, _) in types.filter(|(_, of, _)| !of.definition.is_empty()) {
            let key = (wire_type.name.clone(), wire_type.digest.to_string());
            let (of, _held) = (wire_type.clone(), None);
            self.types.lock().insert(key, KnownType { of, _held });
        }
        let told = |qos: Option<QosProfile>| qos.as_ref().map(control::WireQos::from_bus);
        let output = |(topic, of, qos): (String, WireType, Option<QosProfile>)| OutputChannel {
            channel: NOWHERE,
            topic,
            type_name: of.name,
            md5: of.digest.to_string(),
            qos: told(qos),
        };
        let input = |(topic, of, qos): (String, WireType, Option<QosProfile>)| RequestedInput {
            topic,
            type_name: of.name,
            md5: of.digest.to_string(),
            feed: true,
            qos: told(qos),
        };
        let serves = |(name, of): (String, ServiceType)| ServiceChannel::new(NOWHERE, &name, &of);
        let graph = Graph {
            outputs: registered.outputs.into_iter().map(output).collect(),
            inputs: registered.inputs.into_iter().map(input).collect(),
            services: registered.services.into_iter().map(serves).collect(),
            nodes: registered.nodes.clone(),
            ..Graph::default()
        };
        applied.nodes = registered.nodes;
        self.bus.set_represented_nodes(applied.nodes.clone());
        // Outputs first, so that messages of the original can be published, and inputs once it has subscribed.
        self.outputs.apply(self, &graph.outputs, true).await;
        self.learn(&graph, false).await;
        original.wait_connected().await;
        self.inputs.apply(self, &graph.inputs, true);
        self.calls.apply(self, &graph.services, (false, true)).await;
        true
    }
}
