//! Plausible default messages: zeros, except where zeros make no sense (a rotation of length zero, a map with cells of
//! size zero). The exceptions are data: `plausible.json`, by message type.

use std::sync::LazyLock;

use bytes::Bytes;
use ros::codec::{self, CodecError, FillOptions, Time};
use ros::schema::{Arity, Base, MessageType};
use serde_json::{Map, Value};

/// Type → its nonzero fields. `{"repeat": value, "times": n}` represents an array.
static VALUES: LazyLock<Map<String, Value>> =
    LazyLock::new(|| serde_json::from_str(include_str!("plausible.json")).unwrap_or_default());

/// Returns the serialized default message of a type; headers are stamped with `now`.
pub(super) fn default_message(message: &MessageType, now: Time) -> Result<Bytes, CodecError> {
    let json = Value::Object(nonzero_fields(message)).to_string();
    let mut bytes = Vec::new();
    let options = FillOptions { now: Some(now), ..FillOptions::default() };
    codec::from_json(message, json.as_bytes(), &mut bytes, &options)?;
    Ok(bytes.into())
}

/// Returns the nonzero fields.
fn nonzero_fields(message: &MessageType) -> Map<String, Value> {
    let mut object = Map::new();
    for field in message.fields() {
        if let (Arity::One, Base::Message(inner)) = (field.arity, &field.base) {
            let inner = nonzero_fields(inner);
            if !inner.is_empty() {
                object.insert(field.name.to_string(), Value::Object(inner));
            }
        }
    }
    // ROS 2 type names contain a kind, and its field names contain no capitals.
    let name = message.name().replacen("/msg/", "/", 1);
    if let Some(Value::Object(values)) = VALUES.get(&name) {
        let known = values.iter().filter_map(|(key, value)| {
            let mut fields = message.fields().iter();
            let field = fields.find(|field| field.name.eq_ignore_ascii_case(key))?;
            Some((field.name.to_string(), value.clone()))
        });
        merge_values(&mut object, &known.collect());
    }
    object
}

fn merge_values(into: &mut Map<String, Value>, values: &Map<String, Value>) {
    for (name, value) in values {
        match (into.get_mut(name), value) {
            (Some(Value::Object(below)), Value::Object(value)) => merge_values(below, value),
            _ => {
                into.insert(name.clone(), expand_repeats(value));
            }
        }
    }
}

fn expand_repeats(value: &Value) -> Value {
    match (value.get("repeat"), value.get("times").and_then(Value::as_u64)) {
        (Some(repeated), Some(times)) => Value::Array(vec![repeated.clone(); usize::try_from(times).unwrap_or(0)]),
        _ => value.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros::schema::Registry;

    #[test]
    fn zeros_that_make_no_sense_are_replaced_at_any_depth() {
        let registry = Registry::from_definitions(
            &[
                ("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 w\n"),
                ("lab/msg/Turned", "int8 times\ngeometry_msgs/Quaternion by\n"),
                ("lab/msg/Log", "Header header\nTurned[] all\nTurned last\n"),
            ]
            .map(|(key, text)| (key.to_owned(), text.to_owned()))
            .into(),
        )
        .expect("valid");
        let log = registry.message("lab/Log").expect("defined");
        let now = Time { secs: 7, nsecs: 8 };
        let bytes = default_message(&log, now).expect("a message");
        let mut json = Vec::new();
        codec::to_json(&log, &bytes, &mut json, &codec::JsonOptions::default()).expect("valid");
        let seen: Value = serde_json::from_slice(&json).expect("JSON");
        let expected = serde_json::json!({
            "header": {"seq": 0, "stamp": {"secs": 7, "nsecs": 8}, "frame_id": "base_link"},
            "all": [], "last": {"times": 0, "by": {"x": 0.0, "w": 1.0}}
        });
        assert_eq!(seen, expected);
    }

    #[test]
    fn types_of_ros_2_have_the_same_values() {
        let definitions =
            [("sensor_msgs/msg/CameraInfo".to_owned(), "uint32 height\nfloat64[] d\nfloat64[9] k\n".to_owned())];
        let registry = Registry::with_definitions(ros::bus::RosVersion::Two, &definitions.into()).expect("valid");
        let info = registry.message("sensor_msgs/msg/CameraInfo").expect("defined");
        let bytes = default_message(&info, Time::default()).expect("a message");
        let mut json = Vec::new();
        codec::to_json(&info, &bytes, &mut json, &codec::JsonOptions::default()).expect("valid");
        let seen: Value = serde_json::from_slice(&json).expect("JSON");
        assert_eq!((&seen["height"], &seen["k"][0]), (&48.into(), &60.0.into()));
        assert_eq!(seen["d"].as_array().map(Vec::len), Some(5));
    }

    #[test]
    fn arrays_are_written_out() {
        let three = serde_json::json!({"repeat": 1.5, "times": 3});
        assert_eq!(expand_repeats(&three), serde_json::json!([1.5, 1.5, 1.5]));
        assert!(!VALUES.is_empty(), "plausible.json is JSON");
    }
}
