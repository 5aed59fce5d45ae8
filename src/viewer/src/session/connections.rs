//! Connection graph: publishers, subscribers and service providers, for viewers that subscribed to it.

use std::sync::Arc;

use foxglove::ws_protocol::server::ConnectionGraphUpdate;
use foxglove::ws_protocol::server::connection_graph_update::{AdvertisedService, PublishedTopic, SubscribedTopic};
use ros::bus::Graph;

use super::Session;

impl Session {
    /// Sends the changes of the connection graph if the viewer subscribed to it.
    pub(super) fn send_graph_update(&mut self, now: &Arc<Graph>) {
        let Some(before) = self.shows_graph.replace(Arc::clone(now)) else {
            self.shows_graph = None;
            return;
        };
        let mut update = ConnectionGraphUpdate::default();
        for (name, topic) in &now.topics {
            let earlier = before.topics.get(name);
            if earlier.map(|earlier| &earlier.publishers) != Some(&topic.publishers) {
                let publishers = topic.publishers.iter();
                update.published_topics.push(PublishedTopic::new(name, publishers));
            }
            if earlier.map(|earlier| &earlier.subscribers) != Some(&topic.subscribers) {
                let subscribers = topic.subscribers.iter();
                update.subscribed_topics.push(SubscribedTopic::new(name, subscribers));
            }
        }
        for (name, node) in &now.services {
            if before.services.get(name) != Some(node) {
                update.advertised_services.push(AdvertisedService::new(name, [node]));
            }
        }
        let gone = before.topics.keys().filter(|name| !now.topics.contains_key(*name));
        update.removed_topics = gone.cloned().collect();
        let gone = before.services.keys().filter(|name| !now.services.contains_key(*name));
        update.removed_services = gone.cloned().collect();
        if update != ConnectionGraphUpdate::default() {
            self.send_json(&update);
        }
    }
}
