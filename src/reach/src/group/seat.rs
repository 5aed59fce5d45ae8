//! A group as one robot's [`Reach`]: a bridge and a hub of links of its own, so that its clients share what there is for clients
//! of one robot, and nothing with another's.

use std::sync::{Arc, Weak};

use futures_util::FutureExt;
use ros::bus::Bus;
use tokio::sync::mpsc;

use super::Group;
use super::nodes::SharedNodes;
use crate::in_process::{Behind, InProcess};
use crate::inside::Joined;
use crate::{Observer, Reach, ReachOptions, Recorded};

/// A place for one robot; `place` is its id.
pub fn seat(
    group: &Arc<Group>,
    place: &str,
    recorded: Recorded,
    options: ReachOptions,
    observer: Arc<dyn Observer>,
) -> Arc<dyn Reach> {
    let registry = Arc::clone(&recorded.registry);
    let (notices, noticed) = mpsc::unbounded_channel();
    let (bus, linked) = group.buses(&registry, &options.budget, &notices);
    let nodes = SharedNodes::new(Arc::clone(&linked), recorded, place, observer);
    let shown: Arc<dyn Bus> = bus.clone();
    let behind = Behind {
        id: place.to_owned(),
        bus,
        linked: (linked, Arc::new(nodes)),
        inside: Box::new(move || {
            let bus = Arc::clone(&shown);
            let endings = None;
            async move { Ok(Joined { bus, endings }) }.boxed()
        }),
        registry,
        // Those of its servants are looked after there.
        lifecycles: None,
        components: None,
        keeps: Box::new(()),
    };
    let reach = Arc::new(InProcess::new(behind, options));
    tokio::spawn(pass_on(noticed, Arc::downgrade(&reach)));
    reach
}

/// Tells robots what they should know of, as long as they have this place.
async fn pass_on(mut noticed: mpsc::UnboundedReceiver<(String, String)>, reach: Weak<InProcess>) {
    while let Some((node, what)) = noticed.recv().await {
        let Some(reach) = reach.upgrade() else {
            return;
        };
        if !node.is_empty() {
            reach.report(&node, &what);
        }
    }
}
