use std::sync::Arc;

use crate::schema::{MessageType, Registry};

use super::Stamps;

fn registry(definitions: &[(&str, &str)]) -> Registry {
    let registry = Registry::new();
    for (key, text) in definitions {
        registry.insert(key, text).unwrap();
    }
    registry
}

/// tf2_msgs/TFMessage and its dependencies.
fn tf() -> Arc<MessageType> {
    registry(&[
        ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms"),
        ("geometry_msgs/TransformStamped", "Header header\nstring child_frame_id\nTransform transform"),
        ("geometry_msgs/Transform", "Vector3 translation\nQuaternion rotation"),
        ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
    ])
    .message("tf2_msgs/TFMessage")
    .unwrap()
}

struct Message(Vec<u8>, Vec<usize>);

impl Message {
    fn word(&mut self, word: usize) -> &mut Self {
        self.0.extend(u32::try_from(word).unwrap().to_le_bytes());
        self
    }

    fn text(&mut self, text: &str) -> &mut Self {
        self.word(text.len()).0.extend(text.as_bytes());
        self
    }

    fn time(&mut self) -> &mut Self {
        self.1.push(self.0.len());
        self.word(1_700_000_000).word(5)
    }

    fn zeros(&mut self, bytes: usize) -> &mut Self {
        self.0.resize(self.0.len() + bytes, 0);
        self
    }
}

#[test]
fn stamps_of_nested_messages_in_arrays_are_found() {
    let stamps = Stamps::for_type(&tf());
    let mut message = Message(Vec::new(), Vec::new());
    message.word(3);
    for child in ["a", "", "a longer name"] {
        message.word(7).time().text("map").text(child).zeros(56);
    }
    assert_eq!(stamps.find(&message.0).unwrap(), message.1);
}

#[test]
fn what_follows_the_last_stamp_is_not_looked_at() {
    let image = registry(&[(
        "sensor_msgs/Image",
        "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
    )])
    .message("sensor_msgs/Image")
    .unwrap();
    let stamps = Stamps::for_type(&image);
    let mut message = Message(Vec::new(), Vec::new());
    message.word(1).time().text("camera");
    assert_eq!(stamps.find(&message.0).unwrap(), [4]);
    assert_eq!(stamps.steps.len(), 1, "{stamps:?}");
}

#[test]
fn every_shape_of_field_is_passed() {
    let shapes = registry(&[
        (
            "a/Shapes",
            "int8 before\nstring[] names\nfloat64[2] pair\nEmpty[] nothings\nInner[2] inner\nNameless[] nameless\n\
             time[] times\ntime[2] both\nduration not_a_stamp\nint32[] numbers\ntime last\nstring after",
        ),
        ("a/Empty", ""),
        ("a/Inner", "string[2] names\ntime stamp"),
        ("a/Nameless", "string name\nuint8[] bytes"),
    ])
    .message("a/Shapes")
    .unwrap();
    let stamps = Stamps::for_type(&shapes);
    let mut message = Message(Vec::new(), Vec::new());
    message.zeros(1).word(2).text("x").text("yz").zeros(16);
    message.word(usize::try_from(u32::MAX).unwrap());
    for _ in 0..2 {
        message.text("1").text("").time();
    }
    message.word(2).text("n").text("12345").text("").text("1");
    message.word(3).time().time().time().time().time();
    message.zeros(8).word(3).zeros(12).time().text("end");
    assert_eq!(stamps.find(&message.0).unwrap(), message.1);
    for length in 0..message.0.len() - 7 {
        assert_eq!(stamps.find(&message.0[..length]), None, "{length}");
    }
}

#[test]
fn a_type_without_a_stamp_costs_nothing() {
    let text = registry(&[("std_msgs/String", "string data")]).message("std_msgs/String").unwrap();
    assert!(Stamps::for_type(&text).is_empty());
    assert!(Stamps::default().find(b"anything").unwrap().is_empty());
}

#[test]
fn a_definition_that_doubles_with_each_level_is_no_trouble() {
    let names: Vec<String> = (0..24).map(|level| format!("a/L{level}")).collect();
    let texts: Vec<String> = (1..=24)
        .map(|level| if level == 24 { "string s".to_owned() } else { format!("L{level} x\nL{level} y") })
        .collect();
    let definitions: Vec<(&str, &str)> =
        names.iter().zip(&texts).map(|(name, text)| (name.as_str(), text.as_str())).collect();
    // Either refused earlier, or cheap.
    if let Ok(message) = registry(&definitions).message("a/L0") {
        assert!(Stamps::for_type(&message).is_empty());
    }
}
