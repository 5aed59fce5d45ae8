mod bad_input;
mod cbor;
mod cdr;
mod items;
mod json;
mod property;

use std::sync::Arc;

use super::*;
use crate::schema::Registry;

/// Definitions shared by the tests.
fn message(name: &str) -> Arc<MessageType> {
    let registry = Registry::new();
    for (key, text) in [
        ("std_msgs/msg/String", "string data"),
        ("std_msgs/msg/Empty", ""),
        ("std_msgs/msg/Bool", "bool data"),
        ("std_msgs/msg/Int8", "int8 data"),
        ("std_msgs/msg/Int64", "int64 data"),
        ("std_msgs/msg/UInt8", "uint8 data"),
        ("std_msgs/msg/UInt64", "uint64 data"),
        ("std_msgs/msg/Float32", "float32 data"),
        ("std_msgs/msg/Float64", "float64 data"),
        ("std_msgs/msg/Time", "time data"),
        ("std_msgs/msg/Duration", "duration data"),
        ("std_msgs/msg/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a"),
        ("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
        ("geometry_msgs/msg/Pose", "Point position\nQuaternion orientation"),
        ("geometry_msgs/msg/PoseStamped", "Header header\nPose pose"),
        ("nav_msgs/msg/Path", "Header header\ngeometry_msgs/PoseStamped[] poses"),
        (
            "sensor_msgs/msg/Image",
            "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] \
             data",
        ),
        (
            "t/msg/Arrays",
            "bool[] bools\nint8[] bytes\nint16[2] pair\nuint32[] words\nint64[] longs\nfloat32[] singles\n\
             float64[3] triple\nstring[] texts\nchar[4] chars\ntime[] times\nduration[1] durations\nstd_msgs/Empty[] \
             none",
        ),
    ] {
        registry.insert(key, text).unwrap();
    }
    registry.message(name).unwrap()
}

/// Serialized values in sequence.
#[derive(Default)]
struct Bytes(Vec<u8>);

impl Bytes {
    fn raw(mut self, bytes: &[u8]) -> Bytes {
        self.0.extend_from_slice(bytes);
        self
    }

    fn u32(self, value: u32) -> Bytes {
        self.raw(&value.to_le_bytes())
    }

    fn f64(self, value: f64) -> Bytes {
        self.raw(&value.to_le_bytes())
    }

    fn f32(self, value: f32) -> Bytes {
        self.raw(&value.to_le_bytes())
    }

    fn text(self, text: &str) -> Bytes {
        self.u32(text.len() as u32).raw(text.as_bytes())
    }
}

/// seq 7, stamp 12.34, frame map.
fn header() -> Bytes {
    Bytes::default().u32(7).u32(12).u32(34).text("map")
}

fn json_of(message: &MessageType, bytes: &[u8]) -> String {
    let mut out = Vec::new();
    to_json(message, bytes, &mut out, &JsonOptions::default()).unwrap();
    String::from_utf8(out).unwrap()
}

fn ros_of(message: &MessageType, json: &str) -> Result<Vec<u8>, String> {
    ros_at(message, json, None)
}

fn ros_at(message: &MessageType, json: &str, now: Option<Time>) -> Result<Vec<u8>, String> {
    let mut out = b"kept".to_vec();
    let result = from_json(message, json.as_bytes(), &mut out, &FillOptions { now, ..FillOptions::default() });
    assert_eq!(&out[..4], b"kept");
    match result {
        Ok(_) => {
            let bytes = out.split_off(4);
            validate(message, &bytes).unwrap();
            Ok(bytes)
        }
        Err(error) => {
            assert_eq!(out.len(), 4, "output left behind");
            Err(error.to_string())
        }
    }
}

fn arrays_bytes() -> Vec<u8> {
    Bytes::default()
        .u32(2)
        .raw(&[1, 0])
        .u32(3)
        .raw(&[0xff, 0, 127])
        .raw(&(-2i16).to_le_bytes())
        .raw(&300i16.to_le_bytes())
        .u32(2)
        .u32(0)
        .u32(u32::MAX)
        .u32(1)
        .raw(&i64::MIN.to_le_bytes())
        .u32(2)
        .f32(0.1)
        .f32(-3.0)
        .f64(0.5)
        .f64(1e300)
        .f64(-0.0)
        .u32(2)
        .text("a")
        .text("")
        .raw(&[1, 2, 3, 255])
        .u32(1)
        .u32(5)
        .u32(6)
        .raw(&(-1i32).to_le_bytes())
        .raw(&(-2i32).to_le_bytes())
        .u32(2)
        .0
}
