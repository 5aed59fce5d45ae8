//! Twins of types: their names, definitions and digests, and types that have none.

use ros_message::RosVersion::{One, Two};
use ros_message::schema::Base;

use super::*;
use crate::NoTwinReason;

#[test]
fn names_follow_the_version_or_the_table() {
    let translations = TypeTranslations::new(TranslationRules::default());
    for (one, two) in [
        ("sensor_msgs/Image", "sensor_msgs/msg/Image"),
        ("std_msgs/Time", "builtin_interfaces/msg/Time"),
        ("rosgraph_msgs/Log", "rcl_interfaces/msg/Log"),
    ] {
        assert_eq!(translations.message_name(one, One), two);
        assert_eq!(translations.message_name(two, Two), one);
    }
    assert_eq!(translations.message_name("a/srv/B_Request", Two), "a/BRequest");
    assert_eq!(translations.message_name("a/action/B_Goal", Two), "a/BGoal");
    assert_eq!(translations.service_name("std_srvs/SetBool", One), "std_srvs/srv/SetBool");
    assert_eq!(translations.service_name("std_srvs/srv/SetBool", Two), "std_srvs/SetBool");
    assert_eq!(translations.action_name("a/action/B", Two), "a/B");
    assert_eq!(translations.action_name("a/B", One), "a/action/B");
}

#[test]
fn packages_of_interfaces_are_found_without_a_rule() {
    let known = registry(Two, &[("a_interfaces/msg/B", "uint8 x"), ("a_interfaces/srv/C", "---\nuint8 x")]);
    let translations = TypeTranslations::new(TranslationRules::default()).with_known(known, Two);
    assert_eq!(translations.message_name("a_msgs/B", One), "a_interfaces/msg/B");
    assert_eq!(translations.service_name("a_msgs/C", One), "a_interfaces/srv/C");
    assert_eq!(translations.message_name("a_msgs/Other", One), "a_msgs/msg/Other");
    // In a message too.
    let outer = message(One, &[("c/D", "a_msgs/B b"), ("a_msgs/B", "uint8 x")]);
    let found = translations.message(&outer).unwrap();
    assert_eq!(fields(&found.twin), ["a_interfaces/msg/B b"]);
}

#[test]
fn definitions_are_derived_from_ros_1() {
    let text = "uint8 LOW=1\nstring Mode=a 'b' # c\nbool on=2\ntime stamp\nduration[] waits\nbyte raw\nchar[2] \
        letters\n\
                string frameId\nfloat64[] D\nstd_msgs/Header header\nInner[3] inner\n";
    let pair = twin(One, &[("a/B", text), ("a/Inner", "std_msgs/Empty none"), ("std_msgs/Empty", "")]);
    assert_eq!(pair.twin.name(), "a/msg/B");
    let expected = [
        "builtin_interfaces/msg/Time stamp",
        "builtin_interfaces/msg/Duration[] waits",
        "byte raw",
        "char[2] letters",
        "string frame_id",
        "float64[] d",
        "std_msgs/msg/Header header",
        "a/msg/Inner[3] inner",
    ];
    assert_eq!(fields(&pair.twin), expected);
    let constants: Vec<String> =
        pair.twin.constants().iter().map(|constant| format!("{} {}", constant.name, constant.value)).collect();
    assert_eq!(constants, ["LOW 1", "MODE a 'b' # c", "ON true"]);
}

#[test]
fn definitions_are_derived_from_ros_2() {
    let text = "uint8 LOW=0x1\nwstring WIDE=\"ü\"\nbuiltin_interfaces/Time stamp\nstring<=5 name 'x'\nwstring[<=3] \
        wide\n\
                int32[<=4] few [1, 2]\nbyte raw\nstd_msgs/Header header\nInner inner\n";
    let pair = twin(Two, &[("a/msg/B", text), ("a/msg/Inner", "builtin_interfaces/Duration[2] waits")]);
    assert_eq!(pair.twin.name(), "a/B");
    let expected = [
        "time stamp",
        "string name",
        "string[] wide",
        "int32[] few",
        "byte raw",
        "std_msgs/Header header",
        "a/Inner inner",
    ];
    assert_eq!(fields(&pair.twin), expected);
    let Base::Message(inner) = &pair.twin.fields()[6].base else { panic!("a message") };
    assert_eq!(fields(inner), ["duration[2] waits"]);
    assert_eq!(pair.twin.full_text().matches("MSG:").count(), 2, "as a publisher sends it");
}

#[test]
fn derived_digests_are_those_of_the_packages() {
    let service = registry(Two, &[("std_srvs/srv/SetBool", "bool data\n---\nbool success\nstring message")]);
    let translations = TypeTranslations::new(TranslationRules::default());
    let pair = translations.service(&service.service("std_srvs/SetBool").unwrap()).unwrap();
    assert_eq!((&*pair.twin.name, &*pair.twin.md5), ("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16"));
    let bytes = serialize(&pair.twin.request, r#"{"data": true}"#);
    let carried = pair.request_from_twin.translate(&bytes).unwrap();
    assert_eq!(json(&pair.original.request, &carried)["data"], true);
    let response = serialize(&pair.original.response, r#"{"success": true, "message": "done"}"#);
    let carried = pair.response_to_twin.translate(&response).unwrap();
    assert_eq!(json(&pair.twin.response, &carried)["message"], "done");
    assert_eq!(pair.response_from_twin.translate(&carried).unwrap(), response);
    assert_eq!(pair.request_to_twin.translate(&pair.request_from_twin.translate(&bytes).unwrap()).unwrap(), bytes);

    let text = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence";
    for (from, name) in [(One, "a/Fibonacci"), (Two, "a/action/Fibonacci")] {
        let action = registry(from, &[("a/action/Fibonacci", text)]).action(name).unwrap();
        let pair = translations.action(&action).unwrap();
        let other = registry(from.other(), &[("a/action/Fibonacci", text)]);
        let expected = other.action("a/Fibonacci").unwrap();
        assert_eq!(pair.twin.action.digest(), expected.action.digest());
        assert_eq!(pair.twin.name, expected.name);
        let goal = serialize(&pair.goal.original, r#"{"order": 7}"#);
        assert_eq!(json(&pair.goal.twin, &pair.goal.to_twin.translate(&goal).unwrap())["order"], 7);
        assert_eq!(pair.feedback.twin.name(), expected.feedback.name());
    }
}

#[test]
fn known_definitions_win_over_derived_ones() {
    let one = [("a/B", "Inner inner"), ("a/Inner", "uint8 x")];
    // In the message, and in messages in it.
    let pair = twin_among(
        TranslationRules::default(),
        One,
        &one,
        &[("a/msg/B", "uint8 more\nInner inner"), ("a/msg/Inner", "uint8 x")],
    )
    .unwrap();
    assert_eq!(fields(&pair.twin), ["uint8 more", "a/msg/Inner inner"]);
    let pair = twin_among(TranslationRules::default(), One, &one, &[("a/msg/Inner", "uint8 x\nuint8 y")]).unwrap();
    let Base::Message(inner) = &pair.twin.fields()[0].base else { panic!("a message") };
    assert_eq!(fields(inner), ["uint8 x", "uint8 y"]);
    // Services and actions.
    let service = registry(One, &[("a/srv/S", "uint8 x\n---\n")]).service("a/S").unwrap();
    let known = registry(Two, &[("a/srv/S", "uint8 x\n---\nbool more")]);
    let translations = TypeTranslations::new(TranslationRules::default()).with_known(known.clone(), Two);
    assert!(Arc::ptr_eq(&translations.service(&service).unwrap().twin, &known.service("a/S").unwrap()));
    // A known definition that does not fit is the robot's own all the same.
    let refused = twin_among(TranslationRules::default(), One, &one, &[("a/msg/B", "uint8 other")]).unwrap_err();
    assert!(matches!(*refused.reason, NoTwinReason::Fields { .. }), "{refused}");
}

#[test]
fn types_without_a_twin_say_why() {
    let refused = |one: &str, two: &str| {
        twin_among(TranslationRules::default(), One, &[("a/B", one)], &[("a/msg/B", two)]).unwrap_err().to_string()
    };
    assert_eq!(
        refused("uint8 a\nuint8 b\nuint8 c", "uint8 a\nuint8 d"),
        "a/B of ROS 1 has no counterpart in ROS 2: a/B of ROS 1 alone has b, c, a/msg/B of ROS 2 alone has d; pair \
         their fields by a rule (fields_1_to_2)"
    );
    for (one, two) in [
        ("uint8 a", "float32 a"),
        ("uint8 a", "uint8[] a"),
        ("uint8[2] a", "uint8[3] a"),
        ("bool a", "uint8 a"),
        ("string a", "uint8[] a"),
        ("time a", "builtin_interfaces/Duration a"),
        ("time a", "std_msgs/Header a"),
        ("std_msgs/Header a", "uint8 a"),
    ] {
        let error = refused(one, two);
        let types = one.replace(" a", "");
        assert!(error.contains(&format!("a of a/B is {types} in ROS 1, a of a/msg/B is ")), "{error}");
    }
    let same = twin_by(TranslationRules::default(), One, &[("a/B", "uint8 k\nuint8 K")]).unwrap_err();
    assert!(same.to_string().contains("fields k and K of a/B would have one name in ROS 2"), "{same}");
    let none = twin_by(TranslationRules::default(), One, &[("a/B", "uint8[0] k")]).unwrap_err();
    assert!(matches!(*none.reason, NoTwinReason::Definition(_)), "{none}");
    // Who sends nothing would have millions of bytes written.
    for version in [One, Two] {
        let names = if version == One { ["a/B", "a/Nothing"] } else { ["a/msg/B", "a/msg/Nothing"] };
        let of_length = |length: usize| {
            let text = format!("Nothing[{length}] k\nuint8 more");
            twin_by(TranslationRules::default(), version, &[(names[0], &text), (names[1], "")])
        };
        assert!(of_length(1 << 20).is_ok(), "{version:?}");
        let refused = of_length((1 << 20) + 1).unwrap_err();
        assert!(matches!(*refused.reason, NoTwinReason::EmptySize { one_bytes: 1, .. }), "{refused}");
        assert!(refused.to_string().contains("shorten the arrays of fixed length"), "{refused}");
    }
    // Both ways, and kept.
    let translations =
        TypeTranslations::new(TranslationRules::default()).with_known(registry(One, &[("a/B", "uint8 d")]), One);
    let two = message(Two, &[("a/msg/B", "uint8 e")]);
    let error = translations.message(&two).unwrap_err();
    assert_eq!(translations.message(&two).unwrap_err(), error);
    assert!(
        error.to_string().starts_with("a/msg/B of ROS 2 has no counterpart in ROS 1: a/B of ROS 1 alone has d"),
        "{error}"
    );
}

#[test]
fn twins_are_kept() {
    let translations = TypeTranslations::new(TranslationRules::default());
    let one = message(One, &[("a/B", "uint8 x")]);
    let found = translations.message(&one).unwrap();
    assert!(Arc::ptr_eq(&found, &translations.message(&message(One, &[("a/B", "uint8 x")])).unwrap()));
    assert!(!Arc::ptr_eq(&found, &translations.message(&message(One, &[("a/B", "uint8 y")])).unwrap()));
    for index in 0..3000 {
        let text = format!("uint8 x{index}");
        translations.message(&message(One, &[("a/B", &text)])).unwrap();
    }
    assert!(translations.kept_messages().0 <= 1024);
}

#[test]
fn definitions_of_any_size_and_number_take_no_more_memory_than_is_theirs() {
    let translations = TypeTranslations::new(TranslationRules::default());
    // 64 steps each time that it is mentioned, of a few bytes of text.
    let many: String = (0..32).map(|field| format!("string s{field}\nfloat32 f{field}\n")).collect();
    for index in 0..400 {
        let mentions: String = (0..16).map(|field| format!("Many m{index}_{field}\n")).collect();
        translations.message(&message(One, &[("a/B", &mentions), ("a/Many", &many)])).unwrap();
        assert!(translations.kept_messages().1 <= crate::twins::MAX_KEPT_BYTES);
    }
    assert!(translations.kept_messages().0 < 400, "{:?}", translations.kept_messages());
    // Names grow with the depth of a definition, but paths do so only in errors.
    let long = "n".repeat(250);
    let nested: Vec<(String, String)> = (0..60)
        .map(|level| (format!("a/L{level}"), format!("L{} {long}\n", level + 1)))
        .chain([("a/L60".to_owned(), "string s\nfloat32 f\n".to_owned())])
        .collect();
    let nested: Vec<(&str, &str)> = nested.iter().map(|(name, text)| (&**name, &**text)).collect();
    let pair = translations.message(&message(One, &nested)).unwrap();
    assert!(pair.to_twin.bytes_held() < 1 << 20, "{}", pair.to_twin.bytes_held());
}
