//! Records what a robot sends to its servant, beside the nodes that it is meant for: by a node of its own in the servant's
//! graph, which publishes nothing. The robot is answered as before, and by nobody else.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use api::Phase;
use api::calibration::TimeSpread;
use budget::{Budget, Permit};
use link::control::Request;
use package::interface::Direction;
use reach::Material;
use ros::bag::Recorded;
use ros::bus::{Bus, Qos, Subscription, WireType};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};

use super::calibration::Requests;
use crate::{Choreographer, Error, Handle};

/// The name of the recording node.
const NODE: &str = "/cloudroid_recorder";
const QUEUE: usize = 64;

/// When a recording is long enough.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// How long it records at most.
    pub time: Duration,
    /// Most bytes that it records.
    pub bytes: usize,
    /// Most messages that it records.
    pub messages: usize,
}

impl Choreographer {
    /// What `robot` sends to its servant of `service` now; the messages are held in `budget` for as long as they are there.
    pub async fn capture(
        &self,
        service: &str,
        robot: &str,
        bounds: Bounds,
        budget: &Budget,
    ) -> Result<Requests, Error> {
        let handle = self.serving(service, robot)?;
        let container = handle
            .container()
            .ok_or_else(|| not_served(service, robot))?;
        let revision = &handle.revision;
        let opener = &self.inner.opener;
        // It connects to no host outside.
        let look = opener
            .look(&container, revision.flavour.ros.bus(), NODE, &[])
            .await?;
        let mut recording = Recording::begin(&look.bus, &handle).await?;
        let mut permit = budget.permit();
        let messages = recording.until(bounds, &mut permit).await;
        if messages.is_empty() {
            let seconds = bounds.time.as_secs_f64();
            return Err(Error::Calibration(format!(
                "robot {robot} sent nothing to {service} within {seconds} s; begin when it sends, or take a recording (--bag)"
            )));
        }
        let links = handle
            .reach()
            .map(|reach| reach.links())
            .unwrap_or_default();
        Ok(Requests {
            material: Material::Bag(messages),
            network: between(links.iter().flat_map(|link| &link.requests)),
            permit,
        })
    }

    /// The servant that works for a robot.
    fn serving(&self, service: &str, robot: &str) -> Result<Arc<Handle>, Error> {
        self.inner.catalogue.current(service)?;
        let of_it = |handle: &Arc<Handle>| {
            handle.service() == service
                && handle.robot == robot
                && handle.life().phase == Phase::Ready
        };
        let found = self.servants().into_iter().find(of_it);
        found.ok_or_else(|| not_served(service, robot))
    }
}

fn not_served(service: &str, robot: &str) -> Error {
    Error::Calibration(format!(
        "robot {robot} does not use {service} now; see who does with: cloudroidctl servants"
    ))
}

/// Serialising and the network, as the robot's stubs have measured them; none where it has no stub or was not answered yet. Queues
/// are left out: how long they are depends on the limits.
fn between<'a>(requests: impl Iterator<Item = &'a Request>) -> Option<TimeSpread> {
    let answered = requests.filter(|request| request.total.is_some());
    TimeSpread::of(answered.map(|it| it.serialise + it.up + it.down).collect())
}

/// All inputs, each heard by a task.
struct Recording {
    heard: mpsc::Receiver<Recorded>,
    tasks: Vec<tokio::task::AbortHandle>,
}

impl Recording {
    async fn begin(bus: &Arc<dyn Bus>, handle: &Handle) -> Result<Recording, Error> {
        let (sender, heard) = mpsc::channel(1);
        let mut recording = Recording {
            heard,
            tasks: Vec::new(),
        };
        let topics = handle.revision.interface.topics.iter();
        for topic in topics.filter(|topic| topic.direction == Direction::Input) {
            let subscribed = bus
                .subscribe(&topic.name, WireType::any(), Qos::keep_last(QUEUE))
                .await;
            let subscription = subscribed.map_err(reach::Error::from)?;
            let name: Arc<str> = topic.name.as_str().into();
            let task = tokio::spawn(hear(name, subscription, sender.clone()));
            recording.tasks.push(task.abort_handle());
        }
        Ok(recording)
    }

    /// The messages from now on, until one of the bounds is reached or no more may be held.
    async fn until(&mut self, bounds: Bounds, permit: &mut Permit) -> Vec<Recorded> {
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

async fn hear(topic: Arc<str>, mut subscription: Subscription, heard: mpsc::Sender<Recorded>) {
    while let Some(message) = subscription.messages.recv().await {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let recorded = Recorded {
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
        let request = |up, total| Request {
            total,
            serialise: 1.0,
            up,
            queue: 500.0,
            compute: 900.0,
            down: 2.0,
            ..Request::default()
        };
        // One that the cloud never answered tells nothing of the way down.
        let requests = [
            request(4.0, Some(1407.0)),
            request(800.0, None),
            request(7.0, Some(1410.0)),
        ];
        let network = between(requests.iter()).expect("two were answered");
        assert_eq!((network.p50, network.p95), (7.0, 10.0));
        assert_eq!(between([].iter()), None);
    }
}
