//! Reports changes that nodes of ROS 2 make to their parameters as changes at a Master.

use std::collections::BTreeSet;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::{ParamChangeSender, ParamValue, ParameterEvent, ParameterEvents};
use tokio_util::task::AbortOnDropHandle;

use super::super::kept::KeptParameters;
use super::super::names::{SIM_TIME, to_key};
use super::super::values::check_for_ros1;

/// Maximum number of parameters whose values are reported once as impossible in ROS 1.
const MAX_REPORTED: usize = 256;

/// The watcher of all changes.
pub(super) struct Watcher {
    teller: Arc<ParamChangeSender>,
    _forwarding: AbortOnDropHandle<()>,
}

impl Watcher {
    /// Starts to watch in place of an earlier watcher, until the events end.
    pub(super) fn start(
        place: &Arc<Mutex<Option<Watcher>>>,
        teller: ParamChangeSender,
        events: Box<dyn ParameterEvents>,
        kept: Arc<KeptParameters>,
    ) {
        let teller = Arc::new(teller);
        let forwarding = tokio::spawn(forward(events, Arc::downgrade(&teller), kept, Arc::downgrade(place)));
        let watcher = Watcher { teller, _forwarding: AbortOnDropHandle::new(forwarding) };
        let replaced = place.lock().replace(watcher);
        drop(replaced);
    }

    /// Tells a change.
    pub(super) fn tell(&self, key: String, value: Option<ParamValue>) {
        tell(&self.teller, key, value);
    }
}

fn tell(teller: &ParamChangeSender, key: String, value: Option<ParamValue>) {
    let told = key.clone();
    if let Err(error) = teller.send(key, value) {
        tracing::warn!(key = told, %error, "a change of a parameter does not reach the robot");
    }
}

async fn forward(
    mut events: Box<dyn ParameterEvents>,
    teller: Weak<ParamChangeSender>,
    kept: Arc<KeptParameters>,
    place: Weak<Mutex<Option<Watcher>>>,
) {
    let mut reported = BTreeSet::new();
    let mut dropped = 0;
    while let Some(event) = events.next().await {
        let Some(teller) = teller.upgrade() else { return };
        for (key, value) in to_changes(event, &mut reported) {
            match &value {
                Some(value) => kept.update(&key, value),
                None => drop(kept.remove(&key)),
            }
            tell(&teller, key, value);
        }
        let now = events.dropped_count();
        if now > dropped {
            tracing::warn!("{} events about parameters came too fast, and do not reach the robot", now - dropped);
            dropped = now;
        }
    }
    // The watcher sees the end.
    let (Some(place), Some(teller)) = (place.upgrade(), teller.upgrade()) else { return };
    let mut place = place.lock();
    if place.as_ref().is_some_and(|watcher| Arc::ptr_eq(&watcher.teller, &teller)) {
        let ended = place.take();
        drop(place);
        // Dropped last: it aborts this task.
        drop(teller);
        drop(ended);
    }
}

/// Returns the changes at a Master. That a node takes its time from `/clock` is left out: in ROS 1 this is said once,
/// for all nodes.
fn to_changes(event: ParameterEvent, reported: &mut BTreeSet<String>) -> Vec<(String, Option<ParamValue>)> {
    let ParameterEvent { node, new, changed, deleted } = event;
    let set = new.into_iter().chain(changed).map(|(name, value)| (name, Some(value)));
    let all = set.chain(deleted.into_iter().map(|name| (name, None)));
    let mut changes = Vec::new();
    for (name, value) in all.filter(|(name, _)| name != SIM_TIME) {
        let Some(key) = to_key(&node, &name) else { continue };
        if let Some(Err(reason)) = value.as_ref().map(check_for_ros1) {
            if reported.len() < MAX_REPORTED && reported.insert(key.clone()) {
                tracing::warn!(key, %reason, "a parameter of a node does not reach the robot");
            }
            continue;
        }
        changes.push((key, value));
    }
    changes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_is_a_change_for_each_parameter_that_a_master_can_hold() {
        let event = ParameterEvent {
            node: "/camera/see".to_owned(),
            new: vec![
                ("use_sim_time".to_owned(), ParamValue::Bool(false)),
                ("qos_overrides./scan.publisher.depth".to_owned(), ParamValue::Int(1)),
                ("gains.p".to_owned(), ParamValue::Int(1)),
            ],
            changed: vec![("wide".to_owned(), ParamValue::Int(1 << 40)), ("rate".to_owned(), ParamValue::Double(2.0))],
            deleted: vec!["old.one".to_owned()],
        };
        let mut reported = BTreeSet::new();
        let expected = [
            ("/camera/see/gains/p".to_owned(), Some(ParamValue::Int(1))),
            ("/camera/see/rate".to_owned(), Some(ParamValue::Double(2.0))),
            ("/camera/see/old/one".to_owned(), None),
        ];
        assert_eq!(to_changes(event.clone(), &mut reported), expected);
        assert_eq!(to_changes(event, &mut reported), expected);
        assert_eq!(reported, BTreeSet::from(["/camera/see/wide".to_owned()]), "it is said once");
    }
}
