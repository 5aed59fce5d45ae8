//! What a client has and may not have any more, because its operator has changed what it is granted.

use access::{Grants, Operation};
use rosbridge::{Format, Level};

use super::Client;

impl Client {
    /// Takes back what is not granted any more, and tells the client what. Calls that nodes work on already are answered.
    pub(crate) fn withdraw(&self) {
        let grants = self.granted().grants();
        if grants.is_everything() {
            return;
        }
        for (operation, name) in self.take_back(&grants) {
            let operation = operation.name();
            let text =
                format!("{operation}:{name} is not granted to this client any more and was ended");
            self.status(Level::Error, None, Format::Json, &text);
        }
    }

    fn take_back(&self, grants: &Grants) -> Vec<(Operation, String)> {
        let mut told = Vec::new();
        let lacks = |operation, name: &str| !grants.permits(operation, name);
        // Dropped outside of the locks: what is dropped may want them.
        let mut subscriptions = self.subscriptions.lock();
        let written: Vec<_> = subscriptions
            .keys()
            .filter(|topic| {
                let name = self.resolve(topic);
                name.is_ok_and(|name| lacks(Operation::Subscribe, &name))
            })
            .cloned()
            .collect();
        let gone: Vec<_> = written
            .iter()
            .filter_map(|topic| subscriptions.remove(topic))
            .collect();
        drop(subscriptions);
        for known in &gone {
            self.outbox.remove_topic(known.key());
        }
        drop(gone);
        told.extend(
            written
                .iter()
                .map(|topic| (Operation::Subscribe, topic.to_string())),
        );

        let mut publishers = self.topic_publishers.lock();
        let gone = publishers.take(|topic| lacks(Operation::Publish, topic));
        drop(publishers);
        told.extend(
            gone.iter()
                .map(|(topic, _)| (Operation::Publish, topic.clone())),
        );
        drop(gone);

        let mut services = self.services.lock();
        let gone = services.take(|service| lacks(Operation::Advertise, service));
        drop(services);
        told.extend(
            gone.iter()
                .map(|(service, _)| (Operation::Advertise, service.clone())),
        );
        drop(gone);

        let mut actions = self.actions.lock();
        let served = actions.take_served(|action| lacks(Operation::Advertise, action));
        let goals = actions.goals_at(|action| lacks(Operation::Call, action));
        drop(actions);
        told.extend(
            served
                .iter()
                .map(|(action, _)| (Operation::Advertise, action.clone())),
        );
        drop(served);
        for (goal_id, action) in goals {
            // One that has ended meanwhile need not be cancelled.
            if self.cancel_goal(&goal_id) {
                told.push((Operation::Call, action));
            }
        }
        told
    }
}
