//! The definitions of what is measured with, as a daemon has them of an image.

use anyhow::Result;
use ros::bus::RosVersion;
use ros::schema::Registry;

/// Types as clients of rosbridge name them.
pub(crate) const STRING: &str = "std_msgs/msg/String";
pub(crate) const IMAGE: &str = "sensor_msgs/msg/Image";
pub(crate) const CALL: &str = "std_srvs/srv/SetBool";
pub(crate) const GOAL: &str = "test_msgs/action/Fibonacci";

/// Word for word what the packages of ROS say, without comments: types are told apart by a hash of it.
const DEFINITIONS: [(&str, &str); 6] = [
    (STRING, "string data\n"),
    ("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec\n"),
    (
        "std_msgs/msg/Header",
        "builtin_interfaces/Time stamp\nstring frame_id\n",
    ),
    (
        IMAGE,
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
    ),
    (CALL, "bool data\n---\nbool success\nstring message\n"),
    (
        GOAL,
        "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n",
    ),
];

/// All of them.
pub(crate) fn registry() -> Result<Registry> {
    let known = Registry::of(RosVersion::Two);
    for (name, text) in DEFINITIONS {
        known.insert(name, text)?;
    }
    Ok(known)
}
