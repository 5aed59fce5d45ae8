//! Requests by callers and goals, and the sending of transforms.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use ros::codec::{CodecError, Time};
use ros::schema::{MessageType, SchemaError};
use serde::Deserialize;
use tokio_util::sync::CancellationToken;

use super::buffer::FramePose;
use super::transform::Transform;
use super::{buffer, write_transforms};
use crate::clock;
use crate::republisher::TransformBuffer;
use crate::shared::BridgeShared;

/// Maximum number of requests served at once.
const MAX_REQUESTS: usize = 1000;
const MAX_SOURCES: usize = 1000;

/// A request of a caller or goal.
#[derive(Debug, Clone, Deserialize)]
#[serde(default)]
pub(super) struct TransformRequest {
    source_frames: Vec<String>,
    target_frame: String,
    angular_thres: f64,
    trans_thres: f64,
    rate: f64,
    timeout: Timeout,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(default)]
struct Timeout {
    #[serde(alias = "sec")]
    secs: i32,
    #[serde(alias = "nanosec")]
    nsecs: i64,
}

impl Default for TransformRequest {
    fn default() -> Self {
        Self {
            source_frames: Vec::new(),
            target_frame: String::new(),
            angular_thres: 0.0,
            trans_thres: 0.0,
            rate: 10.0,
            timeout: Timeout::default(),
        }
    }
}

impl TransformRequest {
    /// Returns how long a topic without listeners is kept.
    pub(super) fn topic_timeout(&self) -> Duration {
        let Timeout { secs, nsecs } = self.timeout;
        let patience = Duration::new(u64::try_from(secs).unwrap_or(0), nsecs.clamp(0, 999_999_999) as u32);
        patience.clamp(Duration::from_secs(1), Duration::from_secs(3600))
    }
}

/// Reasons why a request for transforms is refused.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TransformRequestError {
    #[error("source_frames has {0} entries, at most {limit} are allowed", limit = MAX_SOURCES)]
    TooManySources(usize),
    #[error("{limit} requests for transforms are served already; cancel some", limit = MAX_REQUESTS)]
    TooManyRequests,
    #[error("the bridge has ended")]
    BridgeEnded,
    /// The action is not defined here.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// The goal is not a message of the action.
    #[error(transparent)]
    Goal(#[from] Box<CodecError>),
    /// The fields of the goal are not those of a request.
    #[error(transparent)]
    Fields(#[from] serde_json::Error),
}

/// Refuses requests above the limits.
pub(super) fn check_limits(wanted: &TransformRequest, requests: usize) -> Result<(), TransformRequestError> {
    let sources = wanted.source_frames.len();
    if sources > MAX_SOURCES {
        return Err(TransformRequestError::TooManySources(sources));
    }
    if requests >= MAX_REQUESTS {
        return Err(TransformRequestError::TooManyRequests);
    }
    Ok(())
}

/// Returns a function that finds the newest listener of this topic.
pub(super) fn newest_listener_on(topic: &str) -> impl Fn(&BridgeShared) -> Option<u64> + Send + use<> {
    let topic = topic.to_owned();
    move |shared| {
        let live = shared.live_fanouts(&topic);
        live.iter().filter_map(|fanout| fanout.newest_listener()).max()
    }
}

/// Sends changed transforms to `deliver` at the requested rate, until it returns false or `stop` is cancelled.
/// `heard_by` returns the newest of its listeners, if there is any.
pub(super) async fn send_transforms(
    shared: Weak<BridgeShared>,
    buffer: Arc<TransformBuffer>,
    wanted: TransformRequest,
    (heard_by, of): (impl Fn(&BridgeShared) -> Option<u64>, Arc<MessageType>),
    stop: CancellationToken,
    mut deliver: impl FnMut(&Arc<BridgeShared>, Option<Vec<u8>>) -> bool,
) {
    let rate = if wanted.rate > 0.0 { wanted.rate.clamp(0.01, 1000.0) } else { 10.0 };
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / rate));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let target = buffer::strip_slash(&wanted.target_frame);
    let mut sent: HashMap<&str, Transform> = HashMap::new();
    let mut known = None;
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = ticks.tick() => {}
        }
        let Some(shared) = shared.upgrade() else {
            return;
        };
        // Callers learn the topic's name from the answer and listen only then; a new listener needs all transforms.
        let newest = heard_by(&shared);
        if newest != known {
            known = newest;
            sent.clear();
        }
        if known.is_none() {
            if !deliver(&shared, None) {
                return;
            }
            continue;
        }
        let mut changed: Vec<(&str, &str, Transform, Option<Time>)> = Vec::new();
        for source in wanted.source_frames.iter().map(|source| buffer::strip_slash(source)) {
            let Some(FramePose { transform: now, time }) = buffer.find(target, source) else {
                continue;
            };
            let moved = sent.get(source).is_none_or(|before| {
                let (metres, radians) = now.distance(before);
                metres > wanted.trans_thres || radians > wanted.angular_thres
            });
            if moved {
                sent.insert(source, now);
                changed.push((target, source, now, time));
            }
        }
        // Static transforms have the current time.
        let now =
            if changed.iter().any(|(.., time)| time.is_none()) { clock::now(&shared).await } else { Time::default() };
        let changed: Vec<_> = changed
            .into_iter()
            .map(|(target, source, transform, time)| (target, source, transform, time.unwrap_or(now)))
            .collect();
        let transforms = if changed.is_empty() { None } else { write_transforms(&of, changed).ok() };
        if !deliver(&shared, transforms) {
            return;
        }
    }
}
