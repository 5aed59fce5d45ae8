//! Definitions of ROS 2, serialized messages and their JSON and CBOR.

use std::sync::{Arc, LazyLock};

use ::ros::bus::RosVersion;
use ::ros::schema::{InterfaceFile, MessageType, Registry};

use crate::ros::{bytes_of, cbor_of, definition_of, json_of};

/// Types from which the first byte of the input selects one.
static TYPES: LazyLock<Vec<Arc<MessageType>>> = LazyLock::new(|| {
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in [
        ("a/msg/Text", "string data\nwstring wide\nuint8 last\n"),
        (
            "a/msg/Numbers",
            "bool a\nint8 b\nuint8 c\nint16 d\nuint16 e\nint32 f\nuint32 g\nint64 h\nuint64 i\nfloat32 j\n\
             float64 k\nbuiltin_interfaces/Time l\nbyte m\nbuiltin_interfaces/Duration n\n",
        ),
        (
            "a/msg/Lists",
            "bool[] a\nint8[] b\nuint8[] c\nchar[3] d\nint16[2] e\nuint32[] f\nint64[] g\nfloat32[] h\n\
             float64[2] i\nstring[] j\nbuiltin_interfaces/Time[] k\nwstring[2] l\na/Nothing[] m\na/Text[2] n\n",
        ),
        ("a/msg/Nothing", ""),
        ("a/msg/Picture", "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8[] data\n"),
        (
            "a/msg/Bounds",
            "string<=4 a 'abc'\nint64[<=2] b [1, 2]\nwstring<=2[<=2] c\nfloat64 d 0.5\na/Nothing e\nbyte[<=3] f\n",
        ),
        ("a/msg/Place", "uint8 n 7\nstd_msgs/Header header\nfloat64 x\nstring name\n"),
        ("a/msg/Way", "std_msgs/Header header\nPlace[] places\nint32[] indices\n"),
    ] {
        registry.insert(key, text).expect("these are definitions");
    }
    let names = ["a/Text", "a/Numbers", "a/Lists", "a/Picture", "a/Bounds", "a/Way"];
    let find = |name| registry.message(name).expect("these were inserted");
    names.into_iter().map(find).collect()
});

/// JSON of a message.
pub fn json(data: &[u8]) {
    json_of(&TYPES, data);
}

/// CBOR of a message.
pub fn cbor(data: &[u8]) {
    cbor_of(&TYPES, data);
}

/// A serialized message.
pub fn bytes(data: &[u8]) {
    bytes_of(&TYPES, data);
}

/// A definition, then a zero byte and a message of it; or a file of another interface format.
pub fn definition(data: &[u8]) {
    if let Ok(text) = std::str::from_utf8(data) {
        for key in ["b/msg/X", "b/srv/X", "b/action/X"] {
            let files = [InterfaceFile::read_idl(key, text), InterfaceFile::read_description(key, text)];
            for file in files.into_iter().flatten() {
                let registry = file.registry().expect("its keys are names");
                let _ = (registry.message(key), registry.service(key));
            }
        }
    }
    definition_of(RosVersion::Two, data);
}
