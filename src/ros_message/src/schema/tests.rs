mod interface_files;
mod ros2;

use std::sync::Arc;

use super::*;

fn registry(definitions: &[(&str, &str)]) -> Registry {
    let registry = Registry::new();
    for (key, text) in definitions {
        registry.insert(key, text).unwrap();
    }
    registry
}

/// Well-known definitions in our own words: comments and layout do not count for the MD5.
fn common() -> Registry {
    registry(&[
        ("std_msgs/msg/String", "string data\n"),
        ("std_msgs/msg/Header", "uint32 seq\ntime stamp\nstring frame_id\n"),
        ("std_msgs/msg/Empty", ""),
        ("std_msgs/msg/Byte", "byte data"),
        ("std_msgs/msg/Char", "char data"),
        ("std_msgs/msg/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a"),
        (
            "sensor_msgs/msg/Image",
            "Header header # when\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n\
             uint8[] data",
        ),
        (
            "sensor_msgs/msg/RegionOfInterest",
            "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
        ),
        (
            "sensor_msgs/msg/CameraInfo",
            "Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] D\nfloat64[9]  K\n\
             float64[9]  R # rotation\nfloat64[12] P\n\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi\n",
        ),
        (
            "sensor_msgs/msg/NavSatStatus",
            "int8 STATUS_NO_FIX =  -1        # unable\nint8 STATUS_FIX =      0\nint8 STATUS_SBAS_FIX =  1\n\
             int8 STATUS_GBAS_FIX =  2\nint8 status\nuint16 SERVICE_GPS =     1\nuint16 SERVICE_GLONASS = 2\n\
             uint16 SERVICE_COMPASS = 4\nuint16 SERVICE_GALILEO = 8\nuint16 service\n",
        ),
        ("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
        ("geometry_msgs/msg/Twist", "Vector3  linear\nVector3  angular"),
        ("geometry_msgs/msg/Transform", "Vector3 translation\nQuaternion rotation"),
        ("geometry_msgs/msg/TransformStamped", "Header header\nstring child_frame_id\nTransform transform"),
        ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms"),
        ("std_srvs/srv/SetBool", "bool data # on\n---\nbool success # done\nstring message # why not\n"),
        ("std_srvs/srv/Empty", "---\n"),
        ("rospy_tutorials/srv/AddTwoInts", "int64 a\nint64 b\n---\nint64 sum"),
        ("actionlib_tutorials/action/Fibonacci", "#goal\nint32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"),
    ])
}

#[test]
fn md5_of_messages_agrees_with_genmsg() {
    let registry = common();
    for (name, md5) in [
        ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("std_msgs/Header", "2176decaecbce78abc3b96ef049fabed"),
        ("std_msgs/Empty", "d41d8cd98f00b204e9800998ecf8427e"),
        ("std_msgs/Byte", "ad736a2e8818154c487bb80fe42ce43b"),
        ("std_msgs/Char", "1bf77f25acecdedba0e224b162199717"),
        ("std_msgs/ColorRGBA", "a29a96539573343b1310c73607334b00"),
        ("sensor_msgs/Image", "060021388200f6f0f447d0fcd9c64743"),
        ("sensor_msgs/CameraInfo", "c9a58c1b0b154e0e6da7578cb991d214"),
        ("sensor_msgs/NavSatStatus", "331cdbddfa4bc96ffc3b9ad98900a54c"),
        ("geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a"),
        ("tf2_msgs/TFMessage", "94810edda583a504dfda3829e70d7eec"),
    ] {
        assert_eq!(registry.message(name).unwrap().md5(), md5, "{name}");
    }
}

#[test]
fn md5_of_services_covers_request_and_response() {
    let registry = common();
    for (name, md5) in [
        ("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16"),
        ("std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e"),
        ("rospy_tutorials/AddTwoInts", "6a2e34150c00229791cc89ff309fff21"),
    ] {
        assert_eq!(registry.service(name).unwrap().md5, md5, "{name}");
    }
    let service = registry.service("rospy_tutorials/srv/AddTwoInts").unwrap();
    assert_eq!(service.request.name(), "rospy_tutorials/AddTwoIntsRequest");
    assert_eq!(registry.message("rospy_tutorials/AddTwoIntsResponse").unwrap().md5(), service.response.md5());
}

#[test]
fn an_action_makes_seven_messages() {
    let registry = common();
    let action = registry.action("actionlib_tutorials/Fibonacci").unwrap();
    for (message, name, md5) in [
        (&action.action, "FibonacciAction", "f59df5767bf7634684781c92598b2406"),
        (&action.action_goal, "FibonacciActionGoal", "006871c7fa1d0e3d5fe2226bf17b2a94"),
        (&action.action_result, "FibonacciActionResult", "bee73a9fe29ae25e966e105f5553dd03"),
        (&action.action_feedback, "FibonacciActionFeedback", "73b8497a9f629a31c0020900e4148f07"),
        (&action.goal, "FibonacciGoal", "6889063349a00b249bd1661df429d822"),
        (&action.result, "FibonacciResult", "b81e37d2a31925a0e8ae261a8699cb79"),
        (&action.feedback, "FibonacciFeedback", "b81e37d2a31925a0e8ae261a8699cb79"),
    ] {
        assert_eq!(message.name(), format!("actionlib_tutorials/{name}"));
        assert_eq!(message.md5(), md5, "{name}");
        assert!(Arc::ptr_eq(message, &registry.message(message.name()).unwrap()));
    }
}

#[test]
fn actionlib_and_header_are_known_without_their_packages() {
    let registry = Registry::new();
    assert_eq!(registry.message("std_msgs/Header").unwrap().md5(), "2176decaecbce78abc3b96ef049fabed");
    assert_eq!(registry.message("actionlib_msgs/GoalID").unwrap().md5(), "302881f31927c1df708a2dbab0e80ee8");
    assert_eq!(registry.message("actionlib_msgs/GoalStatus").unwrap().md5(), "d388f9b87b3c471f784434d671988d4a");
    assert_eq!(registry.message("actionlib_msgs/GoalStatusArray").unwrap().md5(), "8b2b82f13216d0a8ea88bd3af735e619");
}

#[test]
fn string_constants_keep_their_number_sign() {
    let registry = registry(&[("a/msg/A", "string  HASH = a # b = c  \nint32 N=-5# five\nstring x # = y\nbyte B=1")]);
    let message = registry.message("a/A").unwrap();
    let constants: Vec<_> =
        message.constants().iter().map(|c| (c.type_name.as_str(), c.name.as_str(), c.value.as_str())).collect();
    assert_eq!(constants, [("string", "HASH", "a # b = c"), ("int32", "N", "-5"), ("byte", "B", "1")]);
    assert_eq!(message.fields().len(), 1);
}

#[test]
fn names_resolve_as_in_genmsg() {
    let registry = registry(&[
        ("a/msg/A", "Header h\nB b\nb/B[] c\nchar[4] d\nbyte e\r\n"),
        ("a/msg/B", ""),
        ("b/msg/B", "bool x"),
    ]);
    let message = registry.message("a/msg/A").unwrap();
    let fields: Vec<_> = message.fields().iter().map(|f| (f.type_name.as_str(), f.arity)).collect();
    let expected = [
        ("std_msgs/Header", Arity::One),
        ("a/B", Arity::One),
        ("b/B", Arity::Variable),
        ("char", Arity::Fixed(4)),
        ("byte", Arity::One),
    ];
    assert_eq!(fields, expected);
    assert!(message.has_header());
}

#[test]
fn full_text_has_each_dependency_once_in_order_of_mention() {
    let registry = common();
    let rule = "=".repeat(80);
    let text = registry.message("tf2_msgs/TFMessage").unwrap().full_text().to_owned();
    let sections: Vec<&str> = text.split(&format!("\n{rule}\nMSG: ")).collect();
    let heads: Vec<&str> = sections.iter().map(|section| section.lines().next().unwrap()).collect();
    assert_eq!(
        heads,
        [
            "geometry_msgs/TransformStamped[] transforms",
            "geometry_msgs/TransformStamped",
            "std_msgs/Header",
            "geometry_msgs/Transform",
            "geometry_msgs/Vector3",
            "geometry_msgs/Quaternion"
        ]
    );
    let again = MessageType::from_full_text("tf2_msgs/TFMessage", &text).unwrap();
    assert_eq!(again.md5(), "94810edda583a504dfda3829e70d7eec");
    assert_eq!(again.full_text(), text);
}

#[test]
fn a_newer_definition_replaces_what_was_resolved() {
    let registry = registry(&[("a/msg/A", "B b"), ("a/msg/B", "int8 x")]);
    let before = registry.message("a/A").unwrap();
    registry.insert("a/msg/B", "int16 x").unwrap();
    let after = registry.message("a/A").unwrap();
    assert_ne!(before.md5(), after.md5());
    assert!(Arc::ptr_eq(&after, &registry.message("a/A").unwrap()));
    assert_eq!(registry.keys(), ["a/msg/A", "a/msg/B"]);
}

#[test]
fn errors_name_the_definition_and_the_line() {
    for (text, error) in [
        ("int32", "a/A line 1: \"int32\" is not a field, write TYPE NAME"),
        ("\nint32 x y", "a/A line 2: \"int32 x y\" is not a field, write TYPE NAME"),
        ("int32 1x", "a/A line 1: \"1x\" is not a legal name"),
        ("int32 x\nbool x", "a/A line 2: field x is there twice"),
        ("int32[x] x", "a/A line 1: array length x is not a number up to 67108864"),
        ("int32[+1] x", "a/A line 1: array length +1 is not a number up to 67108864"),
        ("int32[99999999999] x", "a/A line 1: array length 99999999999 is not a number up to 67108864"),
        ("int32[3 x", "a/A line 1: [3 is not an array suffix"),
        ("int32[][] x", "a/A line 1: array length ][ is not a number up to 67108864"),
        ("uint8 X=256", "a/A line 1: \"256\" is no uint8"),
        ("bool X=yes", "a/A line 1: \"yes\" is no bool"),
        ("time X=1", "a/A line 1: a constant cannot be of type time"),
        ("int8 X=1=2", "a/A line 1: \"1=2\" is no int8"),
        ("../b x", "a/A line 1: \"..\" is not a legal name"),
        ("A a", "a/A > a/A contains itself"),
        ("B b", "a/A needs a/B, of which no definition is known; install the package that has it or supply its text"),
        ("time[10000000] x", "a/A is too large: its fixed arrays take more than 67108864 bytes"),
    ] {
        let found = registry(&[("a/msg/A", text)]).message("a/A").unwrap_err();
        assert_eq!(found.to_string(), error, "{text}");
    }
    let far = registry(&[("a/msg/A", "B b"), ("a/msg/B", "C c"), ("a/msg/C", "B[] b")]);
    assert_eq!(far.message("a/A").unwrap_err(), SchemaError::Cycle("a/B > a/C > a/B".into()));
    let sections = registry(&[("a/srv/A", "int8 x"), ("a/action/B", "---\n---\n---\n")]);
    assert_eq!(sections.service("a/A").unwrap_err().to_string(), "a/A has 0 --- lines instead of 1");
    assert_eq!(sections.action("a/B").unwrap_err().to_string(), "a/B has 3 --- lines instead of 2");
    for name in ["A", "a/", "/A", "a/b/A", "a/msg/A/B", "a/A\n", ""] {
        assert!(matches!(sections.message(name), Err(SchemaError::BadName(_))), "{name}");
    }
    assert_eq!(sections.message("a/C").unwrap_err(), SchemaError::Unknown("a/C".into()));
    assert_eq!(sections.service("a/C").unwrap_err(), SchemaError::Unknown("a/C".into()));
    assert_eq!(sections.action("a/C").unwrap_err(), SchemaError::Unknown("a/C".into()));
}

#[test]
fn definitions_cannot_ask_for_unbounded_work() {
    let doubling = Registry::new();
    for level in 0..40 {
        doubling.insert(&format!("a/msg/A{level}"), &format!("A{0} x\nA{0} y", level + 1)).unwrap();
    }
    doubling.insert("a/msg/A40", "").unwrap();
    assert!(matches!(doubling.message("a/A0"), Err(SchemaError::TooLarge { .. })));
    assert!(doubling.message("a/A25").is_ok());

    let deep = Registry::new();
    for level in 0..100 {
        deep.insert(&format!("a/msg/A{level}"), &format!("A{}[] x", level + 1)).unwrap();
    }
    deep.insert("a/msg/A100", "").unwrap();
    assert!(matches!(deep.message("a/A0"), Err(SchemaError::TooLarge { .. })));
    for level in (0..100).rev() {
        let found = deep.message(&format!("a/A{level}"));
        assert_eq!(found.is_ok(), 100 - level < MAX_DEPTH, "{level}: {found:?}");
    }

    let empties = registry(&[("a/msg/A", "E[60000000] x"), ("a/msg/E", "")]);
    assert!(matches!(empties.message("a/A"), Err(SchemaError::TooLarge { .. })));
    let many = "int8 A=1\n".repeat(MAX_FIELDS + 1);
    assert!(matches!(registry(&[("a/msg/A", &many)]).message("a/A"), Err(SchemaError::TooLarge { .. })));
    let long = "#".repeat(MAX_TEXT_BYTES + 1);
    assert!(matches!(Registry::new().insert("a/msg/A", &long), Err(SchemaError::TooLarge { .. })));
}
