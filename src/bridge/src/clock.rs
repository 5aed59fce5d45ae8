//! What time it is for the servant: the wall's, or a simulation's.

use std::sync::Arc;
use std::time::Duration;

use ros::bus::ParamValue;
use ros::codec::{Stamps, Time};
use tokio::sync::mpsc;

use crate::fanout::Listener;
use crate::sample::Sample;
use crate::shared::Shared;

/// How long a simulation may keep silent before the wall's time must do.
const PATIENCE: Duration = Duration::from_secs(1);

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

/// The time now.
pub(crate) async fn now(shared: &Arc<Shared>) -> Time {
    if let Ok(ParamValue::Bool(true)) = shared.bus.parameter("/use_sim_time").await {
        let (ticks, mut heard) = mpsc::unbounded_channel();
        let listening = shared.fanout("/clock", None).listen(Arc::new(Ticks(ticks)));
        let tick = tokio::time::timeout(PATIENCE, heard.recv()).await;
        drop(listening);
        if let Ok(Some(time)) = tick {
            return time;
        }
    }
    Time::now()
}
