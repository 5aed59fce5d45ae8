//! Support for the TF clients of roslibjs and roslibpy: the interface of tf2_web_republisher, which sends only the
//! requested transforms, and only when they have changed enough. In a plain ROS system a node does this; here the
//! bridge does, unless the servant has such a node.
//!
//! * the service `/republish_tfs`, which returns a topic of `tf2_web_republisher/TFArray` created for the caller;
//! * the action `/tf2_web_republisher`, whose feedback carries the transforms for as long as the goal is active: by
//!   topics in ROS 1, by operations in either ROS.
//!
//! In ROS 2 its types are in the package `tf2_web_republisher_interfaces`.

mod action;
mod buffer;
mod republish;
mod sending;
mod transform;

use ros::bus::RosVersion;
use ros::codec::{self, CodecError, FillOptions, Time};
use ros::schema::{MessageType, Registry};
use serde_json::json;

pub(crate) use action::own_action_client;
pub(crate) use republish::{ACTION, GOAL_TOPIC, RepublishTfs, SERVICE, STATUS_TOPIC, TOPICS};
pub(crate) use sending::TransformRequestError;
pub(crate) use transform::Transform;

/// Definitions of transforms, which mean the same in both versions of ROS.
const DEFINITIONS: &[(&str, &str)] = &[
    ("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"),
    ("geometry_msgs/msg/Transform", "Vector3 translation\nQuaternion rotation\n"),
    ("geometry_msgs/msg/TransformStamped", "std_msgs/Header header\nstring child_frame_id\nTransform transform\n"),
];

/// Fields of requests by callers and goals.
const REQUEST_FIELDS: &str = "string[] source_frames\nstring target_frame\nfloat32 angular_thres\nfloat32 trans_thres\n\
                      float32 rate\n";
const TRANSFORMS: &str = "geometry_msgs/TransformStamped[] transforms\n";

/// Returns the package of the republisher's own types.
fn package(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "tf2_web_republisher",
        RosVersion::Two => "tf2_web_republisher_interfaces",
    }
}

/// Returns the name of the type of topics created for callers.
fn array_name(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "tf2_web_republisher/TFArray",
        RosVersion::Two => "tf2_web_republisher_interfaces/msg/TFArray",
    }
}

/// Returns the name of the action's type.
pub(crate) fn action_name(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "tf2_web_republisher/TFSubscription",
        RosVersion::Two => "tf2_web_republisher_interfaces/action/TFSubscription",
    }
}

/// Returns the republisher's own types.
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
            format!("{REQUEST_FIELDS}{duration} timeout\n---\nstring topic_name\n"),
        ),
        (format!("{package}/action/TFSubscription"), format!("{REQUEST_FIELDS}---\n---\n{TRANSFORMS}")),
    ]
}

/// Adds the required types that the servant does not have.
pub(crate) fn define_types(version: RosVersion, registry: &Registry) {
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

/// Encodes a message whose field `transforms` contains these: parent, child, transform, time.
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
