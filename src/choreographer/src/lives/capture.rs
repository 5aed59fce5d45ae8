//! Records what a robot sends to its servant, by an additional node in the servant's graph, which publishes nothing.
//! The robot is answered as before.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use api::Phase;
use api::calibration::TimeSpread;
use budget::{Budget, Permit};
use link::control::RequestTiming;
use package::interface::Direction;
use reach::Material;
use ros::bag::BagMessage;
use ros::bus::{Bus, QosProfile, Subscription, WireType};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};

use super::calibration::CalibrationRequests;
use crate::{Choreographer, Error, Handle};

/// Name of the recording node.
const NODE: &str = "/cloudroid_recorder";
const QUEUE: usize = 64;

/// Bounds of a recording.
#[derive(Debug, Clone, Copy)]
pub struct CaptureBounds {
    /// Maximum duration.
    pub time: Duration,
    /// Maximum number of bytes.
    pub bytes: usize,
    /// Maximum number of messages.
    pub messages: usize,
}

impl Choreographer {
    /// Records what `robot` sends to its servant of `service`; the messages count in `budget` as long as they exist.
    pub async fn capture(
        &self,
        service: &str,
        robot: &str,
        bounds: CaptureBounds,
        budget: &Budget,
    ) -> Result<CalibrationRequests, Error> {
        let handle = self.find_serving(service, robot)?;
        let container = handle.container().ok_or_else(|| not_served(service, robot))?;
        let revision = &handle.revision;
        let opener = &self.inner.opener;
        // It connects to no external host.
        let look = opener.observe(&container, revision.flavour.ros.ros_version(), NODE, &[]).await?;
        let mut recording = Recording::begin(&look.bus, &handle).await?;
        let mut permit = budget.permit();
        let messages = recording.record_until(bounds, &mut permit).await;
        if messages.is_empty() {
            let seconds = bounds.time.as_secs_f64();
            return Err(Error::Calibration(format!(
                "robot {robot} sent nothing to {service} within {seconds} s; start while it sends, or use a recording \
                    (--bag)"
            )));
        }
        let links = handle.reach().map(|reach| reach.links()).unwrap_or_default();
        Ok(CalibrationRequests {
            material: Material::Bag(messages),
            network: network_times(links.iter().flat_map(|link| &link.requests)),
            permit,
        })
    }

    /// Returns the ready servant of a robot.
    fn find_serving(&self, service: &str, robot: &str) -> Result<Arc<Handle>, Error> {
        self.inner.catalogue.current_revision(service)?;
        let of_it = |handle: &Arc<Handle>| {
            handle.service() == service && handle.robot == robot && handle.life().phase == Phase::Ready
        };
        let found = self.servants().into_iter().find(of_it);
        found.ok_or_else(|| not_served(service, robot))
    }
}

fn not_served(service: &str, robot: &str) -> Error {
    Error::Calibration(format!(
        "robot {robot} does not use {service} now; see which robots do with: cloudroidctl servants"
    ))
}

/// Returns the time for serialising and the network, as measured by the robot's stubs; `None` without a stub or an
/// answer. Queueing is excluded: it depends on the limits.
fn network_times<'a>(requests: impl Iterator<Item = &'a RequestTiming>) -> Option<TimeSpread> {
    let answered = requests.filter(|request| request.total.is_some());
    TimeSpread::from_samples(answered.map(|it| it.serialise + it.up + it.down).collect())
}

/// Subscriptions to all inputs, one task each.
struct Recording {
    heard: mpsc::Receiver<BagMessage>,
    tasks: Vec<tokio::task::AbortHandle>,
}

impl Recording {
    async fn begin(bus: &Arc<dyn Bus>, handle: &Handle) -> Result<Recording, Error> {
        let (sender, heard) = mpsc::channel(1);
        let mut recording = Recording { heard, tasks: Vec::new() };
        let topics = handle.revision.interface.topics.iter();
        for topic in topics.filter(|topic| topic.direction == Direction::Input) {
            let subscribed = bus.subscribe(&topic.name, WireType::any(), QosProfile::keep_last(QUEUE)).await;
            let subscription = subscribed.map_err(reach::Error::from)?;
            let name: Arc<str> = topic.name.as_str().into();
            let task = tokio::spawn(record_topic(name, subscription, sender.clone()));
            recording.tasks.push(task.abort_handle());
        }
        Ok(recording)
    }

    /// Records messages until one of the bounds is reached or the memory budget is exhausted.
    async fn record_until(&mut self, bounds: CaptureBounds, permit: &mut Permit) -> Vec<BagMessage> {
        let ends = Instant::now() + bounds.time;
        let (mut messages, mut bytes) = (Vec::new(), 0);
        while messages.len() < bounds.messages {
            let Ok(Some(message)) = timeout_at(ends, self.heard.recv()).await else {
                break;
            };
            bytes += message.bytes.len();
            if bytes > bounds.bytes || permit.grow_to(bytes).is_err() {
                break;
            }
            messages.push(message);
        }
        messages
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        self.tasks.iter().for_each(|task| task.abort());
    }
}

async fn record_topic(topic: Arc<str>, mut subscription: Subscription, heard: mpsc::Sender<BagMessage>) {
    while let Some(message) = subscription.messages.recv().await {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let recorded = BagMessage {
            topic: Arc::clone(&topic),
            wire_type: message.wire_type,
            time: now.map_or(0, |since| since.as_nanos() as u64),
            bytes: message.bytes,
        };
        if heard.send(recorded).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robots_network_is_what_is_neither_queue_nor_node() {
        let request = |up, total| RequestTiming {
            total,
            serialise: 1.0,
            up,
            queue: 500.0,
            compute: 900.0,
            down: 2.0,
            ..RequestTiming::default()
        };
        // An unanswered request says nothing about the way down.
        let requests = [request(4.0, Some(1407.0)), request(800.0, None), request(7.0, Some(1410.0))];
        let network = network_times(requests.iter()).expect("two were answered");
        assert_eq!((network.p50, network.p95), (7.0, 10.0));
        assert_eq!(network_times([].iter()), None);
    }
}
