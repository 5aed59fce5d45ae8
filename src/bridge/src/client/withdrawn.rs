//! Revocation of what a client uses but is no longer granted, after a change by its operator.

use access::{Grants, Operation};
use rosbridge::{Format, StatusLevel};

use super::BridgeClient;

impl BridgeClient {
    /// Revokes what is no longer granted, and reports it to the client. Calls that nodes already handle are still
    /// answered.
    pub(crate) fn revoke_ungranted(&self) {
        let grants = self.client_grants().grants();
        if grants.is_everything() {
            return;
        }
        for (operation, name) in self.remove_ungranted(&grants) {
            let operation = operation.name();
            let text = format!("{operation}:{name} is no longer granted to this client and was ended");
            self.send_status(StatusLevel::Error, None, Format::Json, &text);
        }
    }

    fn remove_ungranted(&self, grants: &Grants) -> Vec<(Operation, String)> {
        let mut told = Vec::new();
        let lacks = |operation, name: &str| !grants.permits(operation, name);
        // Dropped outside of the locks, since the values may take them in their drops.
        let mut subscriptions = self.subscriptions.lock();
        let written: Vec<_> = subscriptions
            .keys()
            .filter(|topic| {
                let name = self.resolve(topic);
                name.is_ok_and(|name| lacks(Operation::Subscribe, &name))
            })
            .cloned()
            .collect();
        let gone: Vec<_> = written.iter().filter_map(|topic| subscriptions.remove(topic)).collect();
        drop(subscriptions);
        for known in &gone {
            self.outbox.remove_topic(known.key());
        }
        drop(gone);
        told.extend(written.iter().map(|topic| (Operation::Subscribe, topic.to_string())));

        let mut publishers = self.topic_publishers.lock();
        let gone = publishers.take(|topic| lacks(Operation::Publish, topic));
        drop(publishers);
        told.extend(gone.iter().map(|(topic, _)| (Operation::Publish, topic.clone())));
        drop(gone);

        let mut services = self.services.lock();
        let gone = services.take(|service| lacks(Operation::Advertise, service));
        drop(services);
        told.extend(gone.iter().map(|(service, _)| (Operation::Advertise, service.clone())));
        drop(gone);

        let mut actions = self.actions.lock();
        let served = actions.take_served(|action| lacks(Operation::Advertise, action));
        let goals = actions.goals_of_actions(|action| lacks(Operation::Call, action));
        drop(actions);
        told.extend(served.iter().map(|(action, _)| (Operation::Advertise, action.clone())));
        drop(served);
        for (goal_id, action) in goals {
            // Fails if it has ended meanwhile.
            if self.cancel_goal(&goal_id) {
                told.push((Operation::Call, action));
            }
        }
        told
    }
}
