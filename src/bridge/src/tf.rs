//! What roslibjs's and roslibpy's TF clients need: the interface of tf2_web_republisher, which sends only the
//! transforms asked for, only when they have changed enough. In a plain ROS a node does this; here the bridge does,
//! unless the servant has such a node.
//!
//! * the service `/republish_tfs`, which names a topic of `tf2_web_republisher/TFArray` made for the caller;
//! * the action `/tf2_web_republisher`, whose feedback carries the transforms for as long as the goal is active: by
//!   topics in ROS 1, by operations in either ROS.
//!
//! In ROS 2 its types are of the package `tf2_web_republisher_interfaces`.

mod action;
mod buffer;
mod republish;
mod sending;
mod transform;

use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use ros::bus::RosVersion;
use ros::codec::{self, CodecError, FillOptions, Time};
use ros::schema::{MessageType, Registry};
use serde_json::json;

pub(crate) use action::own_action;
use buffer::Buffer;
pub(crate) use republish::{
    ACTION, GOAL_TOPIC, RepublishTfs, Republisher, SERVICE, STATUS_TOPIC, TOPICS,
};
use transform::Transform;

/// Transforms, in words that mean the same to both ROSes.
const DEFINITIONS: &[(&str, &str)] = &[
    (
        "geometry_msgs/msg/Vector3",
        "float64 x\nfloat64 y\nfloat64 z\n",
    ),
    (
        "geometry_msgs/msg/Quaternion",
        "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    ),
    (
        "geometry_msgs/msg/Transform",
        "Vector3 translation\nQuaternion rotation\n",
    ),
    (
        "geometry_msgs/msg/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\nTransform transform\n",
    ),
];

/// What callers and goals ask for.
const WANTED: &str = "string[] source_frames\nstring target_frame\nfloat32 angular_thres\nfloat32 trans_thres\nfloat32 rate\n";
const TRANSFORMS: &str = "geometry_msgs/TransformStamped[] transforms\n";

/// Where the republisher's own types are.
fn package(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "tf2_web_republisher",
        RosVersion::Two => "tf2_web_republisher_interfaces",
    }
}

/// Name of the type of topics that are made for callers.
fn array_name(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "tf2_web_republisher/TFArray",
        RosVersion::Two => "tf2_web_republisher_interfaces/msg/TFArray",
    }
}

/// Name of the action's type.
pub(crate) fn action_name(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "tf2_web_republisher/TFSubscription",
        RosVersion::Two => "tf2_web_republisher_interfaces/action/TFSubscription",
    }
}

/// The republisher's own types.
fn own_definitions(version: RosVersion) -> [(String, String); 3] {
    let package = package(version);
    let duration = match version {
        RosVersion::One => "duration",
        RosVersion::Two => "builtin_interfaces/Duration",
    };
    [
        (format!("{package}/msg/TFArray"), TRANSFORMS.to_owned()),
        (
            format!("{package}/srv/RepublishTFs"),
            format!("{WANTED}{duration} timeout\n---\nstring topic_name\n"),
        ),
        (
            format!("{package}/action/TFSubscription"),
            format!("{WANTED}---\n---\n{TRANSFORMS}"),
        ),
    ]
}

/// Adds the types that are needed and that the servant does not have.
pub(crate) fn define(version: RosVersion, registry: &Registry) {
    let known = registry.keys();
    let own = own_definitions(version);
    let own = own.iter().map(|(key, text)| (key.as_str(), text.as_str()));
    for (key, text) in DEFINITIONS.iter().copied().chain(own) {
        if known.iter().all(|other| other != key)
            && let Err(error) = registry.insert(key, text)
        {
            tracing::warn!(%error, "{key} cannot be defined");
        }
    }
}

/// The one buffer of a bridge, for as long as anybody needs it.
#[derive(Default)]
struct SharedBuffer(Mutex<Weak<Buffer>>);

impl SharedBuffer {
    fn get(&self, make: impl FnOnce() -> Buffer) -> Arc<Buffer> {
        let mut buffer = self.0.lock();
        buffer.upgrade().unwrap_or_else(|| {
            let made = Arc::new(make());
            *buffer = Arc::downgrade(&made);
            made
        })
    }
}

/// A message whose field `transforms` holds these: parent, child, transform, when it was so.
fn write_transforms<'t>(
    of: &MessageType,
    transforms: impl IntoIterator<Item = (&'t str, &'t str, Transform, Time)>,
) -> Result<Vec<u8>, CodecError> {
    let stamped = transforms.into_iter().map(|(parent, child, transform, time)| {
        let [x, y, z] = transform.translation;
        let [rx, ry, rz, rw] = transform.rotation;
        json!({
            "header": { "stamp": { "secs": time.secs, "nsecs": time.nsecs }, "frame_id": parent },
            "child_frame_id": child,
            "transform": {
                "translation": { "x": x, "y": y, "z": z },
                "rotation": { "x": rx, "y": ry, "z": rz, "w": rw },
            },
        })
    });
    let said = json!({ "transforms": stamped.collect::<Vec<_>>() });
    let mut bytes = Vec::new();
    let options = FillOptions::default();
    codec::from_json(of, said.to_string().as_bytes(), &mut bytes, &options)?;
    Ok(bytes)
}
