//! The servant's time: wall time, or that of a simulation.

use std::sync::Arc;
use std::time::Duration;

use ros::bus::{ParamValue, RosVersion};
use ros::codec::{Stamps, Time};
use tokio::sync::mpsc;

use crate::fanout::Listener;
use crate::sample::TopicSample;
use crate::shared::BridgeShared;

/// Time without a tick of the simulation after which wall time is used.
const PATIENCE: Duration = Duration::from_secs(1);
/// Topic of simulated time.
const CLOCK: &str = "/clock";

struct ClockListener(mpsc::UnboundedSender<Time>);

impl Listener for ClockListener {
    fn on_sample(&self, sample: &Arc<TopicSample>, _replay: bool) {
        let Ok(schema) = sample.schema() else { return };
        if let Some(time) = Stamps::for_type(&schema).first(&sample.bytes) {
            // An error means that nobody waits any more.
            let _ = self.0.send(time);
        }
    }

    fn on_failed(&self, _reason: &str) {}
}

/// Returns whether time is simulated. In ROS 2 each node decides this itself: here it is when a node publishes the
/// clock.
async fn is_simulated(shared: &BridgeShared) -> bool {
    match shared.bus.version() {
        RosVersion::One => {
            let said = shared.bus.parameter("/use_sim_time").await;
            matches!(said, Ok(ParamValue::Bool(true)))
        }
        RosVersion::Two => {
            let graph = shared.bus.graph().borrow().clone();
            let nodes = graph.topics.get(CLOCK);
            nodes.is_some_and(|nodes| !nodes.publishers.is_empty())
        }
    }
}

/// Returns the current time.
pub(crate) async fn now(shared: &Arc<BridgeShared>) -> Time {
    if is_simulated(shared).await {
        let (ticks, mut heard) = mpsc::unbounded_channel();
        let listening = shared.fanout(CLOCK, None).listen(Arc::new(ClockListener(ticks)));
        let tick = tokio::time::timeout(PATIENCE, heard.recv()).await;
        drop(listening);
        if let Ok(Some(time)) = tick {
            return time;
        }
    }
    Time::now()
}
