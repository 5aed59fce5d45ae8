//! The latest transform of every frame, received on `/tf` and `/tf_static`.

use std::collections::HashMap;
use std::sync::Arc;

use ros::codec::{Time, Value};
use ros::schema::MessageType;

use super::transform::Transform;
use crate::fanout::Listener;
use crate::republisher::{FrameLink, Frames, TransformBuffer};
use crate::sample::TopicSample;
use crate::shared::BridgeShared;

/// Maximum number of frames.
const MAX_FRAMES: usize = 10_000;
/// Maximum number of links between a frame and the root.
const MAX_DEPTH: usize = 1000;

/// Pose of one frame relative to another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FramePose {
    pub(super) transform: Transform,
    /// The latest time at which all links between them are known; `None` if all are static.
    pub(super) time: Option<Time>,
}

/// Listener of one of the topics.
struct TfListener {
    frames: Arc<Frames>,
    /// True for `/tf_static`, whose transforms are valid forever.
    fixed: bool,
}

impl Listener for TfListener {
    fn on_sample(&self, sample: &Arc<TopicSample>, _replay: bool) {
        if let Ok(schema) = sample.schema() {
            self.frames.apply(&schema, &sample.bytes, self.fixed);
        }
    }

    fn on_failed(&self, reason: &str) {
        tracing::warn!("cannot subscribe to transforms: {reason}");
    }
}

impl TransformBuffer {
    pub(super) fn new(shared: &Arc<BridgeShared>) -> Self {
        let frames = Arc::new(Frames::default());
        let listening = [("/tf", false), ("/tf_static", true)].map(|(topic, fixed)| {
            let frames = frames.clone();
            let ear = Arc::new(TfListener { frames, fixed });
            shared.fanout(topic, None).listen(ear)
        });
        Self { frames, _listening: listening }
    }

    /// Returns the pose of `source` relative to `target`.
    pub(super) fn find(&self, target: &str, source: &str) -> Option<FramePose> {
        self.frames.find(target, source)
    }
}

impl Frames {
    /// Applies a `tf2_msgs/TFMessage` (or the identical `tf/tfMessage`).
    fn apply(&self, schema: &MessageType, bytes: &[u8], fixed: bool) {
        let said = Value::read(schema, bytes);
        let transforms = said.as_ref().and_then(|said| said.field("transforms"));
        let mut links = self.links.lock();
        for stamped in transforms.map(Value::items).unwrap_or_default() {
            let Some((child, mut link)) = parse_stamped(stamped) else {
                continue;
            };
            let Some(transform) = link.transform.normalize() else {
                continue;
            };
            link.transform = transform;
            link.time = link.time.filter(|_| !fixed);
            if links.len() < MAX_FRAMES || links.contains_key(&child) {
                links.insert(child, link);
            }
        }
    }

    fn find(&self, target: &str, source: &str) -> Option<FramePose> {
        let links = self.links.lock();
        // Pose of the source in each of its ancestors.
        let mut above = HashMap::new();
        let mut at = source;
        let mut path = FramePose { transform: Transform::IDENTITY, time: None };
        loop {
            // A cycle: a publisher sends nonsense.
            if above.len() > MAX_DEPTH || above.insert(at, path).is_some() {
                return None;
            }
            let Some(link) = links.get(at) else { break };
            path = link.to_parent(path);
            at = &link.parent;
        }
        // From the target up to the first common ancestor: what is above it does not matter.
        at = target;
        let mut to = FramePose { transform: Transform::IDENTITY, time: None };
        for _ in 0..MAX_DEPTH {
            if let Some(from) = above.get(at) {
                return Some(FramePose {
                    transform: to.transform.inverse().compose(&from.transform),
                    time: earlier(to.time, from.time),
                });
            }
            let link = links.get(at)?;
            to = link.to_parent(to);
            at = &link.parent;
        }
        None
    }
}

impl FrameLink {
    /// Converts a pose in the child to one in the parent.
    fn to_parent(&self, found: FramePose) -> FramePose {
        FramePose { transform: self.transform.compose(&found.transform), time: earlier(self.time, found.time) }
    }
}

/// Returns the earlier of two times; static transforms (`None`) are valid at any time.
fn earlier(one: Option<Time>, other: Option<Time>) -> Option<Time> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}

/// Removes leading slashes, which tf had and tf2 does not have.
pub(super) fn strip_slash(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

/// Parses the child frame and the link of a `geometry_msgs/TransformStamped`.
fn parse_stamped(stamped: &Value<'_>) -> Option<(String, FrameLink)> {
    let header = stamped.field("header")?;
    let moved = stamped.field("transform")?;
    let number = |of: &str, axis: &str| moved.field(of)?.field(axis)?.number();
    let frame = |name: &Value<'_>| Some(strip_slash(&name.text()?).to_owned());
    let transform = Transform {
        translation: [number("translation", "x")?, number("translation", "y")?, number("translation", "z")?],
        rotation: [
            number("rotation", "x")?,
            number("rotation", "y")?,
            number("rotation", "z")?,
            number("rotation", "w")?,
        ],
    };
    let link = FrameLink { parent: frame(header.field("frame_id")?)?, transform, time: header.field("stamp")?.time() };
    Some((frame(stamped.field("child_frame_id")?)?, link))
}

#[cfg(test)]
mod tests {
    use ros::bus::RosVersion;
    use ros::schema::Registry;

    use super::*;
    use crate::tf::write_transforms;

    fn step(x: f64) -> Transform {
        Transform { translation: [x, 0.0, 0.0], ..Transform::IDENTITY }
    }

    fn seconds(secs: u32) -> Time {
        Time { secs, nsecs: 0 }
    }

    /// A type equivalent to `tf2_msgs/TFMessage`.
    fn schema() -> Arc<MessageType> {
        let registry = Registry::new();
        crate::tf::define_types(RosVersion::One, &registry);
        registry.message("tf2_web_republisher/TFArray").unwrap()
    }

    fn tf_message(links: &[(&str, &str, f64, u32)]) -> Vec<u8> {
        let links = links.iter();
        let links = links.map(|(parent, child, x, secs)| (*parent, *child, step(*x), seconds(*secs)));
        write_transforms(&schema(), links).unwrap()
    }

    impl Frames {
        fn apply_bytes(&self, bytes: &[u8], fixed: bool) {
            self.apply(&schema(), bytes, fixed);
        }
    }

    #[test]
    fn frames_are_found_through_their_common_ancestor() {
        let frames = Frames::default();
        let message = tf_message(&[("/map", "base", 1.0, 1), ("base", "arm", 2.0, 1), ("map", "dock", 10.0, 1)]);
        frames.apply_bytes(&message, false);
        let x = |target, source| Some(frames.find(target, source)?.transform.translation[0]);
        assert_eq!(x("dock", "arm"), Some(-7.0));
        assert_eq!(x("arm", "map"), Some(-3.0));
        assert_eq!(x("map", "map"), Some(0.0));
        assert_eq!(x("map", "nowhere"), None);
        frames.apply_bytes(&tf_message(&[("base", "arm", 5.0, 2)]), false);
        assert_eq!(x("base", "arm"), Some(5.0));
    }

    #[test]
    fn a_transform_is_as_old_as_the_oldest_that_it_is_made_of() {
        let frames = Frames::default();
        frames.apply_bytes(
            &tf_message(&[("earth", "map", 1.0, 3), ("map", "base", 1.0, 7), ("base", "arm", 1.0, 9)]),
            false,
        );
        frames.apply_bytes(&tf_message(&[("base", "laser", 1.0, 1), ("laser", "dot", 1.0, 1)]), true);
        let time = |target, source| frames.find(target, source).unwrap().time;
        assert_eq!(time("base", "arm"), Some(seconds(9)));
        assert_eq!(time("map", "arm"), Some(seconds(7)));
        assert_eq!(time("earth", "arm"), Some(seconds(3)));
        // Static links do not make the result older, and links above both frames do not matter.
        assert_eq!(time("laser", "arm"), Some(seconds(9)));
        assert_eq!(time("base", "dot"), None);
        assert_eq!(time("map", "dot"), Some(seconds(7)));
    }

    #[test]
    fn nonsense_does_no_harm() {
        let frames = Frames::default();
        frames.apply_bytes(&tf_message(&[("a", "b", 1.0, 1), ("b", "a", 1.0, 1)]), false);
        assert_eq!(frames.find("a", "b"), None);
        let whole = tf_message(&[("map", "base", 1.0, 1)]);
        for end in 0..whole.len() {
            frames.apply_bytes(&whole[..end], false);
        }
        assert_eq!(frames.find("map", "base"), None);
        frames.apply_bytes(&[0xff; 64], false);
    }
}
