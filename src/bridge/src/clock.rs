//! What time it is for the servant: the wall's, or a simulation's.

use std::sync::Arc;
use std::time::Duration;

use ros::bus::{ParamValue, RosVersion};
use ros::codec::{Stamps, Time};
use tokio::sync::mpsc;

use crate::fanout::Listener;
use crate::sample::Sample;
use crate::shared::Shared;

/// How long a simulation may keep silent before the wall's time must do.
const PATIENCE: Duration = Duration::from_secs(1);
/// Where a simulation tells the time.
const CLOCK: &str = "/clock";

struct Ticks(mpsc::UnboundedSender<Time>);

impl Listener for Ticks {
    fn sample(&self, sample: &Arc<Sample>, _replay: bool) {
        let Ok(schema) = sample.schema() else { return };
        if let Some(time) = Stamps::of(&schema).first(&sample.bytes) {
            // Nobody waits any more.
            let _ = self.0.send(time);
        }
    }

    fn failed(&self, _reason: &str) {}
}

/// Whether time is simulated. In ROS 2 each node decides that for itself: it is as soon as one of them publishes the time.
async fn is_simulated(shared: &Shared) -> bool {
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

/// The time now.
pub(crate) async fn now(shared: &Arc<Shared>) -> Time {
    if is_simulated(shared).await {
        let (ticks, mut heard) = mpsc::unbounded_channel();
        let listening = shared.fanout(CLOCK, None).listen(Arc::new(Ticks(ticks)));
        let tick = tokio::time::timeout(PATIENCE, heard.recv()).await;
        drop(listening);
        if let Ok(Some(time)) = tick {
            return time;
        }
    }
    Time::now()
}
