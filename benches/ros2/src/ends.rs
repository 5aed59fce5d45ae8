//! Participants and their endpoints, for the roles.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use rtps::{
    Config, DataReader, DataWriter, EndpointMatches, EndpointQos, Participant, ReceivedSample, ReliabilityKind, Sink,
    TopicDescription,
};
use servant::netns::NetNs;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::sync::watch;

use crate::place::NamespaceSockets;

/// Maximum time for discovery.
const PATIENCE: Duration = Duration::from_secs(15);

/// Creates a participant in this process's network namespace.
pub(crate) async fn join() -> Result<Participant> {
    join_namespace(NetNs::current()?).await
}

/// Creates a participant in a network namespace.
pub(crate) async fn join_namespace(network: NetNs) -> Result<Participant> {
    let mut config = Config::new(0, "bench");
    config.user_data = "enclave=/;".into();
    Ok(Participant::join(Arc::new(NamespaceSockets(network)), config).await?)
}

/// Returns the quality of service that a ROS node requests with `QoSProfile(depth=5)`.
pub(crate) fn qos_profile(reliable: bool) -> EndpointQos {
    let reliability = if reliable { ReliabilityKind::Reliable } else { ReliabilityKind::BestEffort };
    EndpointQos { reliability, history: rtps::HistoryKind::KeepLast(5), ..EndpointQos::default() }
}

fn topic(name: &str, kind: &str) -> TopicDescription {
    TopicDescription { name: name.to_owned(), type_name: kind.to_owned(), ..TopicDescription::default() }
}

struct CallbackSink<F>(F);

impl<F: Fn(ReceivedSample) + Send + Sync + 'static> Sink for CallbackSink<F> {
    fn on_sample(&self, sample: ReceivedSample) {
        self.0(sample);
    }
}

/// Creates a reader that calls `take` with each sample.
pub(crate) fn create_listener(
    participant: &Participant,
    (name, kind): (&str, &str),
    qos: EndpointQos,
    take: impl Fn(ReceivedSample) + Send + Sync + 'static,
) -> DataReader {
    participant.reader(topic(name, kind), qos, Arc::new(CallbackSink(take)))
}

/// Creates a reader that queues its samples.
pub(crate) fn create_reader(
    participant: &Participant,
    topic: (&str, &str),
    qos: EndpointQos,
) -> (DataReader, UnboundedReceiver<ReceivedSample>) {
    let (sender, samples) = unbounded_channel();
    let take = move |sample| {
        // The receiver is gone once the role has ended.
        let _ = sender.send(sample);
    };
    (create_listener(participant, topic, qos, take), samples)
}

/// Creates a writer.
pub(crate) fn create_writer(participant: &Participant, (name, kind): (&str, &str), qos: EndpointQos) -> DataWriter {
    participant.writer(topic(name, kind), qos)
}

/// Waits until an endpoint is matched, so that samples pass.
pub(crate) async fn wait_until_matched(mut ends: watch::Receiver<Arc<EndpointMatches>>) -> Result<()> {
    let some = ends.wait_for(|ends| !ends.matched.is_empty());
    tokio::time::timeout(PATIENCE, some).await.context("nobody is at the other end")??;
    Ok(())
}
