//! One robot's place in a group as a [`Reach`], with its own bridge and link hub: resources are shared among the
//! clients of one robot but not between robots.

use std::sync::{Arc, Weak};

use futures_util::FutureExt;
use ros::bus::Bus;
use tokio::sync::mpsc;

use super::ServantGroup;
use super::nodes::SharedNodes;
use crate::in_process::{InProcess, InProcessParts};
use crate::inside::JoinedBus;
use crate::{Observer, Reach, ReachOptions, RecordedRevision};

/// Opens a place for a robot; `place` is its id.
pub fn open_seat(
    group: &Arc<ServantGroup>,
    place: &str,
    recorded: RecordedRevision,
    options: ReachOptions,
    observer: Arc<dyn Observer>,
) -> Arc<dyn Reach> {
    let registry = Arc::clone(&recorded.registry);
    let (notices, noticed) = mpsc::unbounded_channel();
    let (bus, linked) = group.create_buses(&registry, &options.budget, &notices);
    let nodes = SharedNodes::new(Arc::clone(&linked), recorded, place, Arc::clone(&observer));
    let shown: Arc<dyn Bus> = bus.clone();
    let behind = InProcessParts {
        id: place.to_owned(),
        bus,
        linked: (linked, Arc::new(nodes)),
        inside: Box::new(move || {
            let bus = Arc::clone(&shown);
            let endings = None;
            async move { Ok(JoinedBus { bus, endings }) }.boxed()
        }),
        registry,
        observer,
        // Lifecycles and components are managed by the servants.
        lifecycles: None,
        components: None,
        keeps: Box::new(()),
    };
    let reach = Arc::new(InProcess::new(behind, options));
    tokio::spawn(forward_notices(noticed, Arc::downgrade(&reach)));
    reach
}

/// Forwards notices to the robot as long as it has this place.
async fn forward_notices(mut noticed: mpsc::UnboundedReceiver<(String, String)>, reach: Weak<InProcess>) {
    while let Some((node, what)) = noticed.recv().await {
        let Some(reach) = reach.upgrade() else {
            return;
        };
        if !node.is_empty() {
            reach.warn_flow(&node, &what);
        }
    }
}
