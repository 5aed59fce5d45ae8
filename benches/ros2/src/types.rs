//! Definitions of the types in use, as a daemon gets them from an image.

use anyhow::Result;
use ros::bus::RosVersion;
use ros::schema::Registry;

/// Type names in the form that rosbridge clients use.
pub(crate) const STRING: &str = "std_msgs/msg/String";
pub(crate) const IMAGE: &str = "sensor_msgs/msg/Image";
pub(crate) const CALL: &str = "std_srvs/srv/SetBool";
pub(crate) const GOAL: &str = "test_msgs/action/Fibonacci";

/// Definitions exactly as in the ROS packages, without comments: types are identified by a hash of them.
const DEFINITIONS: [(&str, &str); 6] = [
    (STRING, "string data\n"),
    ("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    (
        IMAGE,
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 \
         step\nuint8[] data\n",
    ),
    (CALL, "bool data\n---\nbool success\nstring message\n"),
    (GOAL, "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"),
];

/// Returns a registry of all definitions.
pub(crate) fn registry() -> Result<Registry> {
    let known = Registry::for_version(RosVersion::Two);
    for (name, text) in DEFINITIONS {
        known.insert(name, text)?;
    }
    Ok(known)
}
