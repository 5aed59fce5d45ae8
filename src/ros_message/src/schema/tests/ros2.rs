use std::sync::Arc;

use super::super::*;
use crate::RosVersion;
use crate::codec::{JsonOptions, default_json, default_message, to_json};

fn registry(definitions: &[(&str, &str)]) -> Registry {
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in definitions {
        registry.insert(key, text).unwrap();
    }
    registry
}

/// Jazzy interfaces in our own words: what a description omits does not count for the hash.
fn common() -> Registry {
    registry(&[
        ("std_msgs/msg/String", "string data\n"),
        ("std_msgs/msg/Empty", "# nothing\n"),
        ("std_msgs/msg/MultiArrayDimension", "string label\nuint32 size\nuint32 stride"),
        ("std_msgs/msg/MultiArrayLayout", "MultiArrayDimension[] dim\nuint32 data_offset"),
        ("std_msgs/msg/ByteMultiArray", "MultiArrayLayout  layout\nbyte[]            data"),
        (
            "sensor_msgs/msg/Image",
            "std_msgs/Header header # when\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
             uint32 step\nuint8[] data",
        ),
        (
            "sensor_msgs/msg/NavSatStatus",
            "int8 STATUS_UNKNOWN = -2 # yet\nint8 STATUS_FIX =   0\nint8 status -2 # UNKNOWN\nuint16 SERVICE_GPS = 1\n\
             uint16 service",
        ),
        ("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/msg/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1"),
        ("geometry_msgs/msg/Transform", "Vector3 translation\nQuaternion rotation"),
        ("geometry_msgs/msg/TransformStamped", "std_msgs/Header header\nstring child_frame_id\nTransform transform"),
        (
            "test_msgs/msg/WStrings",
            "wstring wstring_value\nwstring wstring_value_default1 \"Hello world!\"\n\
             wstring wstring_value_default2 \"Hellö wörld!\"\nwstring wstring_value_default3 \"ハローワールド\"\n\
             #wstring WSTRING_CONST=\"Hello world!\"\nwstring[3] array_of_wstrings\n\
             wstring[<=3] bounded_sequence_of_wstrings\nwstring[] unbounded_sequence_of_wstrings\n",
        ),
        (
            "test_msgs/msg/Strings",
            "string string_value\nstring string_value_default1 \"Hello world!\"\n\
             string string_value_default2 \"Hello'world!\"\nstring string_value_default3 'Hello\"world!'\n\
             string string_value_default4 'Hello\\'world!'\nstring string_value_default5 \"Hello\\\"world!\"\n\
             string STRING_CONST=\"Hello world!\"\nstring<=22 bounded_string_value\n\
             string<=22 bounded_string_value_default1 \"Hello world!\"\n\
             string<=22 bounded_string_value_default2 \"Hello'world!\"\n\
             string<=22 bounded_string_value_default3 'Hello\"world!'\n\
             string<=22 bounded_string_value_default4 'Hello\\'world!'\n\
             string<=22 bounded_string_value_default5 \"Hello\\\"world!\"\n",
        ),
        ("std_srvs/srv/SetBool", "bool data # on\n---\nbool success # done\nstring message # why not\n"),
        ("std_srvs/srv/Empty", "---\n"),
        ("test_msgs/action/Fibonacci", "#goal\nint32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"),
    ])
}

#[test]
fn hashes_of_messages_agree_with_rosidl() {
    let registry = common();
    for (name, hash) in [
        ("std_msgs/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        ("std_msgs/msg/Empty", "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312"),
        ("std_msgs/ByteMultiArray", "972fec7f50ab3c1d06783c228e79e8a9a509021708c511c059926261ada901d4"),
        ("sensor_msgs/Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"),
        ("sensor_msgs/NavSatStatus", "d1ed3befa628e09571bd273b888ba1c1fd187c9a5e0006b385d7e5e9095a3204"),
        ("geometry_msgs/TransformStamped", "0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206"),
        ("test_msgs/WStrings", "5a2c8ddb2054600023b9a180652f2ba895373217cad4b1f0fc1258c9e4424a79"),
        ("test_msgs/Strings", "eee55533636293ac7c94c62432eedb5777eb849847d2a17b4dcead8c4a20ab32"),
    ] {
        let digest = registry.message(name).unwrap().digest().to_owned();
        assert_eq!(digest, format!("RIHS01_{hash}"), "{name}");
    }
}

#[test]
fn hashes_of_services_cover_request_response_and_event() {
    let registry = common();
    for (name, hash) in [
        ("std_srvs/SetBool", "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a"),
        ("std_srvs/srv/Empty", "5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19"),
        ("action_msgs/srv/CancelGoal", "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a"),
    ] {
        let service = registry.service(name).unwrap();
        assert_eq!(service.md5, format!("RIHS01_{hash}"), "{name}");
    }
    let service = registry.service("std_srvs/SetBool").unwrap();
    assert_eq!(service.name, "std_srvs/srv/SetBool");
    assert_eq!(service.request.name(), "std_srvs/srv/SetBool_Request");
    for name in ["std_srvs/srv/SetBool_Response", "std_srvs/SetBool_Response"] {
        let found = registry.message(name).unwrap();
        assert!(Arc::ptr_eq(&found, &service.response), "{name}");
    }
    assert_eq!(
        registry.message("std_srvs/SetBool_Event").unwrap().digest(),
        "RIHS01_3c4c20015afb4303eafd347b1d6a786f171a89c814726961a9593ef10df878cf"
    );
}

#[test]
fn an_action_is_its_parts_and_two_services() {
    let registry = common();
    let action = registry.action("test_msgs/Fibonacci").unwrap();
    assert_eq!(action.name, "test_msgs/action/Fibonacci");
    let services = action.services.as_ref().unwrap();
    let digests = [
        (action.action.name(), action.action.digest()),
        (action.goal.name(), action.goal.digest()),
        (action.result.name(), action.result.digest()),
        (action.feedback.name(), action.feedback.digest()),
        (action.action_goal.name(), action.action_goal.digest()),
        (action.action_result.name(), action.action_result.digest()),
        (action.action_feedback.name(), action.action_feedback.digest()),
        (&services.send_goal.name, &services.send_goal.md5),
        (&services.get_result.name, &services.get_result.md5),
    ];
    let expected = [
        ("", "be9273e3557225044b4a040811112491f7079326e3a573f83258b0b4c30bd069"),
        ("_Goal", "e58ef5a8f4f039ab522a740823547c460b1d5aed8031c8b7825d33d345d90df8"),
        ("_Result", "0774b095467813c6904d475498b5486b7ebd4cda6a4569f97e8de8c862689049"),
        ("_Feedback", "7d1110f2efa019ad5ad8ad2244db98d862f39dc9fae8c976814b0065fa2f32d5"),
        ("_SendGoal_Request", "dfe75c73dc2c090cbc8fd8c45039bfa279d16aa6aadd348f812c6adad26e669e"),
        ("_GetResult_Response", "ef88159d47a3d21d9bf4bec690cf668939d9542db28a9cfd77dbcd97eaf1add2"),
        ("_FeedbackMessage", "37487bae8cea358366b97003c1ef1ca7ce7c08df36f9e8cca496624226aee64e"),
        ("_SendGoal", "d807633803e38e164276573cd97e9fbd71e109c290bbf4cc312a0a1c9da7bbd9"),
        ("_GetResult", "5d30fdeb21d20e117aa5f36c7b4f0b6874f1a8cf7a9c038d58f1156c5737b209"),
    ];
    for ((name, digest), (ending, hash)) in digests.into_iter().zip(expected) {
        assert_eq!(name, format!("test_msgs/action/Fibonacci{ending}"));
        assert_eq!(digest, format!("RIHS01_{hash}"), "{name}");
    }
    assert!(registry.action("test_msgs/Nothing").is_err());
}

#[test]
fn what_actions_and_stamps_are_made_of_is_known_without_packages() {
    let registry = Registry::for_version(RosVersion::Two);
    for (name, hash) in [
        ("builtin_interfaces/Time", "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197"),
        ("std_msgs/Header", "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01"),
        ("unique_identifier_msgs/UUID", "1b8e8aca958cbea28fe6ef60bf6c19b683c97a9ef60bb34752067d0f2f7ab437"),
        ("action_msgs/GoalStatusArray", "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"),
    ] {
        let message = registry.message(name).unwrap();
        assert_eq!(message.digest(), format!("RIHS01_{hash}"), "{name}");
    }
    assert!(registry.message("std_msgs/String").is_err());
}

#[test]
fn bounds_defaults_and_constants_are_read() {
    let registry = registry(&[
        (
            "a/msg/A",
            "  string<=5 short 'it\\'s'   # a comment with 'quotes'\n\
         wstring[<=2] wide [\"a # b\", 'c']# more\n\tint32[<=3]\tsome\t[1,-2]\nint8[2] pair [0x7f, -0b1]\n\
         string<=3[<=2] both\nbyte raw 255\nstring HASH=\"a # b\"\nstring BARE = a b # c\nfloat32 X=-1.5\n\
         uint8 N =0x10\nB b\nother/C[] c\nbool on True\nstring free no quotes # comment",
        ),
        ("a/msg/B", ""),
        ("other/msg/C", "bool x"),
    ]);
    let message = registry.message("a/A").unwrap();
    let fields: Vec<_> = message
        .fields()
        .iter()
        .map(|field| {
            let bounds = (field.bounds.text, field.bounds.elements);
            (&*field.type_name, &*field.name, field.arity, bounds)
        })
        .collect();
    assert_eq!(
        fields,
        [
            ("string", "short", Arity::One, (Some(5), None)),
            ("wstring", "wide", Arity::Variable, (None, Some(2))),
            ("int32", "some", Arity::Variable, (None, Some(3))),
            ("int8", "pair", Arity::Fixed(2), (None, None)),
            ("string", "both", Arity::Variable, (Some(3), Some(2))),
            ("byte", "raw", Arity::One, (None, None)),
            ("a/msg/B", "b", Arity::One, (None, None)),
            ("other/msg/C", "c", Arity::Variable, (None, None)),
            ("bool", "on", Arity::One, (None, None)),
            ("string", "free", Arity::One, (None, None)),
        ]
    );
    let constants: Vec<_> = message.constants().iter().map(|it| (&*it.type_name, &*it.name, &*it.value)).collect();
    assert_eq!(
        constants,
        [("string", "HASH", "a # b"), ("string", "BARE", "a b"), ("float32", "X", "-1.5"), ("uint8", "N", "0x10"),]
    );
    assert_eq!(
        default_json(&message),
        r#"{"short":"it's","wide":["a # b","c"],"some":[1,-2],"pair":[127,-1],"both":[],"raw":255,"b":{},"c":[],"on":true,"free":"no quotes"}"#
    );
}

#[test]
fn full_texts_are_read_by_either_name() {
    let registry = common();
    let transform = registry.message("geometry_msgs/TransformStamped").unwrap();
    let text = transform.full_text();
    assert!(text.contains("\nMSG: builtin_interfaces/Time\n"), "{text}");
    let long = text.replace("MSG: builtin_interfaces/", "MSG: builtin_interfaces/msg/");
    for text in [text.to_owned(), long] {
        let name = "geometry_msgs/TransformStamped";
        let again = MessageType::parse_full_text(RosVersion::Two, name, &text).unwrap();
        assert_eq!(again.digest(), transform.digest());
    }
    assert_eq!(registry.keys()[..2], ["geometry_msgs/msg/Quaternion", "geometry_msgs/msg/Transform"]);
}

#[test]
fn the_versions_of_ros_keep_apart() {
    let two = registry(&[("a/msg/A", "std_msgs/Header header\nbyte b")]);
    let message = two.message("a/A").unwrap();
    assert!(message.has_header());
    assert_eq!(message.version(), RosVersion::Two);
    let field = &message.fields()[1];
    assert!(matches!(field.base, Base::Primitive(Primitive::Uint8)));
    assert_eq!(Primitive::from_versioned_name(RosVersion::One, "byte"), Some(Primitive::Int8));
    assert_eq!(Primitive::from_versioned_name(RosVersion::One, "wstring"), None);
    let of_one = registry(&[("a/msg/A", "Header header")]).message("a/A");
    assert_eq!(
        of_one.unwrap_err().to_string(),
        "a/msg/A needs a/msg/Header, of which no definition is known; install the package that has it or supply its \
         text"
    );
    // With other fields it is a message like any other.
    let odd = registry(&[
        ("builtin_interfaces/msg/Time", "int64 sec\nuint32 nanosec"),
        ("std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id"),
        ("a/msg/A", "std_msgs/Header header"),
    ]);
    let message = odd.message("a/A").unwrap();
    assert!(!message.has_header());
    let mut json = Vec::new();
    let bytes = default_message(&message);
    to_json(&message, &bytes, &mut json, &JsonOptions::default()).unwrap();
    assert_eq!(String::from_utf8(json).unwrap(), r#"{"header":{"stamp":{"sec":0,"nanosec":0},"frame_id":""}}"#);
    // The header, 8 + 4 bytes of time, a length, a NUL.
    assert_eq!(bytes.len(), 4 + 12 + 4 + 1);
}

#[test]
fn errors_name_the_definition_and_the_line() {
    for (text, error) in [
        ("int32", "\"int32\" is not a field, write TYPE NAME"),
        ("int32 1x", "\"1x\" is not a legal name"),
        ("int32 x-y", "\"-y\" is no int32"),
        ("int32 x\nbool x", "field x is there twice"),
        ("int32[0] x", "a size of 0 is not a number from 1 to 67108864"),
        ("int32[<=] x", "a size of  is not a number from 1 to 67108864"),
        ("string<=x x", "a size of x is not a number from 1 to 67108864"),
        ("int32<=4 x", "int32 cannot be bounded"),
        ("int32[3 x", "[3 is not an array suffix"),
        ("uint8 X=256", "\"256\" is no uint8"),
        ("uint8[] X=[1]", "a constant cannot be of type uint8[]"),
        ("string x \"a\" b", "\"b\" follows the closing quote"),
        ("int32[2] x [1]", "takes exactly 2 values, got 1"),
        ("int32[<=2] x [1, 2, 3]", "takes at most 2 values, got 3"),
        ("string<=2 x abc", "takes at most 2 characters, got 3"),
        ("B x 1", "a field of type B takes no value, got \"1\""),
        ("time x", "ROS 2 has no time, write builtin_interfaces/Time"),
        ("duration[] x", "ROS 2 has no duration, write builtin_interfaces/Duration"),
        ("a/b/C x", "\"a/b/C\" is not a type name, write package/Type"),
        ("../b x", "\"..\" is not a legal name"),
    ] {
        let found = registry(&[("a/msg/A", text)]).message("a/A").unwrap_err();
        let line = text.lines().count();
        assert_eq!(found.to_string(), format!("a/msg/A line {line}: {error}"), "{text}");
    }
    let sections = registry(&[("a/srv/A", "int8 x"), ("a/action/B", "---\n")]);
    assert_eq!(sections.service("a/A").unwrap_err().to_string(), "a/srv/A has 0 --- lines instead of 1");
    assert_eq!(sections.action("a/B").unwrap_err().to_string(), "a/action/B has 1 --- lines instead of 2");
    for name in ["A", "a/", "/A", "a/b/A", "a/msg/A/B", "a/A\n", ""] {
        assert!(matches!(sections.message(name), Err(SchemaError::BadName(_))), "{name}");
    }
    let cycle = registry(&[("a/msg/A", "A a")]).message("a/A").unwrap_err();
    assert_eq!(cycle, SchemaError::Cycle("a/msg/A > a/msg/A".into()));
}
