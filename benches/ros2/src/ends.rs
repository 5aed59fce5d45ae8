//! Participants and their ends, as the roles use them.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use rtps::{
    Config, EndpointQos, Ends, Participant, Reader, Reliability, Sample, Sink, Topic, Writer,
};
use servant::netns::NetNs;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::sync::watch;

use crate::place::Within;

/// The longest that discovery may take.
const PATIENCE: Duration = Duration::from_secs(15);

/// A participant in the namespace that this process is in.
pub(crate) async fn join() -> Result<Participant> {
    join_in(NetNs::current()?).await
}

/// A participant in this namespace.
pub(crate) async fn join_in(network: NetNs) -> Result<Participant> {
    let mut config = Config::new(0, "bench");
    config.user_data = "enclave=/;".into();
    Ok(Participant::join(Arc::new(Within(network)), config).await?)
}

/// The quality of service that a ROS node asks for by `QoSProfile(depth=5)`.
pub(crate) fn quality(reliable: bool) -> EndpointQos {
    let reliability = if reliable {
        Reliability::Reliable
    } else {
        Reliability::BestEffort
    };
    EndpointQos {
        reliability,
        history: rtps::History::KeepLast(5),
        ..EndpointQos::default()
    }
}

fn topic(name: &str, kind: &str) -> Topic {
    Topic {
        name: name.to_owned(),
        type_name: kind.to_owned(),
        ..Topic::default()
    }
}

struct Call<F>(F);

impl<F: Fn(Sample) + Send + Sync + 'static> Sink for Call<F> {
    fn sample(&self, sample: Sample) {
        self.0(sample);
    }
}

/// A reader that calls `take` with each sample.
pub(crate) fn hears(
    participant: &Participant,
    (name, kind): (&str, &str),
    qos: EndpointQos,
    take: impl Fn(Sample) + Send + Sync + 'static,
) -> Reader {
    participant.reader(topic(name, kind), qos, Arc::new(Call(take)))
}

/// A reader whose samples wait.
pub(crate) fn reads(
    participant: &Participant,
    topic: (&str, &str),
    qos: EndpointQos,
) -> (Reader, UnboundedReceiver<Sample>) {
    let (sender, samples) = unbounded_channel();
    let take = move |sample| {
        // Nobody waits any more where the role has ended.
        let _ = sender.send(sample);
    };
    (hears(participant, topic, qos, take), samples)
}

/// A writer.
pub(crate) fn writes(
    participant: &Participant,
    (name, kind): (&str, &str),
    qos: EndpointQos,
) -> Writer {
    participant.writer(topic(name, kind), qos)
}

/// Waits until samples pass.
pub(crate) async fn matched(mut ends: watch::Receiver<Arc<Ends>>) -> Result<()> {
    let some = ends.wait_for(|ends| !ends.matched.is_empty());
    tokio::time::timeout(PATIENCE, some)
        .await
        .context("nobody is at the other end")??;
    Ok(())
}
