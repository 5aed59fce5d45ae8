//! Registers on the robot what the local original registers in its private ROS system, while the cloud was never reached
//! and so has not said what the node registers.

use std::sync::{Arc, Weak};

use link::control::{self, Graph, Output, Served, Wanted};
use ros::bus::{Qos, ServiceType, WireType};

use super::outputs::NOWHERE;
use super::{KnownType, Mirror};
use crate::local::{Keeper, Original, Registered};

/// Registers on the robot what the local original registers, until the cloud has said what the node registers.
pub async fn follow(mirror: Weak<Mirror>, keeper: Weak<Keeper>) {
    // Not held while nothing changes: the original ends with its keeper.
    let original = || keeper.upgrade()?.original().cloned();
    let Some(mut changes) = original().map(|original| original.registrations()) else {
        return;
    };
    while changes.next().await {
        let Some(original) = original() else { return };
        let registered = original.registered().await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        if !mirror.stand_in(&original, registered).await {
            return;
        }
    }
}

impl Mirror {
    /// Registers this in place of the cloud's interface; false once the cloud has sent its own. Nothing is unregistered: the
    /// original may have ended because the cloud is there, and the cloud's interface follows.
    async fn stand_in(self: &Arc<Self>, original: &Original, registered: Registered) -> bool {
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
        let told = |qos: Option<Qos>| qos.as_ref().map(control::Qos::of);
        let output = |(topic, of, qos): (String, WireType, Option<Qos>)| Output {
            channel: NOWHERE,
            topic,
            type_name: of.name,
            md5: of.digest.to_string(),
            qos: told(qos),
        };
        let input = |(topic, of, qos): (String, WireType, Option<Qos>)| Wanted {
            topic,
            type_name: of.name,
            md5: of.digest.to_string(),
            feed: true,
            qos: told(qos),
        };
        let serves = |(name, of): (String, ServiceType)| Served::of(NOWHERE, &name, &of);
        let graph = Graph {
            outputs: registered.outputs.into_iter().map(output).collect(),
            inputs: registered.inputs.into_iter().map(input).collect(),
            services: registered.services.into_iter().map(serves).collect(),
            nodes: (registered.nodes.iter())
                .map(|(node, names)| (node.clone(), names.clone().into()))
                .collect(),
            ..Graph::default()
        };
        applied.nodes = registered.nodes;
        self.bus.stands_for(applied.nodes.clone());
        // What it says has somewhere to go before it is heard, and what it is given comes once it listens.
        self.outputs.apply(self, &graph.outputs, true).await;
        self.learn(&graph, false).await;
        original.connected().await;
        self.inputs.apply(self, &graph.inputs, true);
        self.calls.apply(self, &graph.services, (false, true)).await;
        true
    }
}
