//! Messages through translators.

use ros_message::RosVersion::{One, Two};
use ros_message::codec::{CodecErrorKind, default_message};
use serde_json::json as value;

use super::*;

#[test]
fn every_kind_of_field_is_carried_both_ways() {
    let text = "bool a\nint8 b\nuint8 c\nbyte d\nchar e\nint16 f\nuint16 g\nint32 h\nuint32 i\nint64 j\nuint64 k\n\
                float32 l\nfloat64 m\nstring n\ntime o\nduration p\nuint8[] q\nfloat64[3] r\nbool[] s\nstring[] t\n\
                Point[] u\nPoint[2] v\nint16[] w\nNamed[] x\nstd_msgs/Header y\ntime[] z\nstd_msgs/Empty none\n";
    let definitions = [
        ("a/All", text),
        ("a/Point", "float64 x\nfloat64 y"),
        ("a/Named", "uint8 n\nstring s\nPoint p"),
        ("std_msgs/Empty", ""),
    ];
    let pair = twin(One, &definitions);
    let given = r#"{"a": true, "b": -1, "c": 255, "d": -1, "e": 65, "f": -300, "g": 65535, "h": -70000, "i": 4000000000,
        "j": -5000000000, "k": 18000000000000000000, "l": 0.5, "m": 0.1, "n": "äb", "o": {"secs": 7, "nsecs": 8},
        "p": {"secs": -7, "nsecs": 8}, "q": "AQID", "r": [1, 2, 3], "s": [true, false, true], "t": ["", "x", "yz"],
        "u": [{"x": 1, "y": 2}, {"x": 3, "y": 4}], "v": [{"x": 5, "y": 6}, {"x": 7, "y": 8}], "w": [1, -2, 3],
        "x": [{"n": 1, "s": "a", "p": {"x": 9}}, {"n": 2, "s": "bcd", "p": {"y": 9}}],
        "y": {"seq": 0, "stamp": {"secs": 3, "nsecs": 4}, "frame_id": "map"}, "z": [{"secs": 1, "nsecs": 0}]}"#;
    let bytes = serialize(&pair.original, given);
    let carried = pair.to_twin.translate(&bytes).unwrap();
    let shown = json(&pair.twin, &carried);
    // The same value means the same, apart from what times are called and from the sign of a byte.
    let mut expected = json(&pair.original, &bytes);
    let stamp = |secs: i64, nsecs: u32| value!({"sec": secs, "nanosec": nsecs});
    expected["d"] = value!(255);
    expected["o"] = stamp(7, 8);
    expected["p"] = stamp(-7, 8);
    expected["y"] = value!({"stamp": stamp(3, 4), "frame_id": "map"});
    expected["z"] = value!([stamp(1, 0)]);
    assert_eq!(shown, expected);
    assert_eq!(pair.from_twin.translate(&carried).unwrap(), bytes, "there and back");
    assert_eq!(pair.to_twin.saturated_count() + pair.from_twin.saturated_count(), 0);
}

#[test]
fn messages_of_either_byte_order_are_read() {
    let pair =
        twin(Two, &[("a/msg/B", "uint8 a\nuint32 b\nfloat64[] c\nwstring d\nstring e\nbuiltin_interfaces/Time f")]);
    let mut big = vec![0, 0, 0, 0, 7, 0xaa, 0xaa, 0xaa];
    big.extend_from_slice(&1000u32.to_be_bytes());
    big.extend_from_slice(&2u32.to_be_bytes());
    big.extend_from_slice(&[0xaa; 4]);
    for number in [0.5f64, -1.0] {
        big.extend_from_slice(&number.to_be_bytes());
    }
    for word in [1u32, u32::from(b'x'), 2] {
        big.extend_from_slice(&word.to_be_bytes());
    }
    big.extend_from_slice(b"y\0\0\0");
    big.extend_from_slice(&5u32.to_be_bytes());
    big.extend_from_slice(&6u32.to_be_bytes());
    let carried = pair.to_twin.translate(&big).unwrap();
    let expected = value!({"a": 7, "b": 1000, "c": [0.5, -1.0], "d": "x", "e": "y", "f": {"secs": 5, "nsecs": 6}});
    assert_eq!(json(&pair.twin, &carried), expected);
}

#[test]
fn fields_in_another_order_are_found() {
    let one = [("a/B", "string first\nuint32 second\nInner third\nuint8 last"), ("a/Inner", "string[] x\nuint8 y")];
    let two = [
        ("a/msg/B", "uint8 more 9\nInner third\nuint32 second\nstring first\nuint8 last"),
        ("a/msg/Inner", "uint8 y\nstring[] x"),
    ];
    let pair = twin_among(TranslationRules::default(), One, &one, &two).unwrap();
    let given = r#"{"first": "abc", "second": 5, "third": {"x": ["p", "qr"], "y": 3}, "last": 7}"#;
    let expected = value!({"more": 9, "third": {"y": 3, "x": ["p", "qr"]}, "second": 5, "first": "abc", "last": 7});
    assert_eq!(carry(&pair, given), expected);
    let bytes = serialize(&pair.original, given);
    let carried = pair.to_twin.translate(&bytes).unwrap();
    assert_eq!(pair.from_twin.translate(&carried).unwrap(), bytes);
}

#[test]
fn fields_on_one_side_alone_are_left_out_or_have_their_default() {
    let one = [("a/B", "uint8 a\nfloat64 b")];
    let two = [("a/msg/B", "uint8 a\nstring more 'text'\nfloat64 b\nint32[] list [1, 2]\nbuiltin_interfaces/Time at")];
    let pair = twin_among(TranslationRules::default(), One, &one, &two).unwrap();
    let expected = value!({"a": 1, "more": "text", "b": 0.5, "list": [1, 2], "at": {"sec": 0, "nanosec": 0}});
    assert_eq!(carry(&pair, r#"{"a": 1, "b": 0.5}"#), expected);
    let back = twin_among(TranslationRules::default(), Two, &two, &one).unwrap();
    let given = r#"{"a": 1, "more": "lost", "b": 0.5, "list": [7], "at": {"sec": 1, "nanosec": 1}}"#;
    assert_eq!(carry(&back, given), value!({"a": 1, "b": 0.5}));
}

#[test]
fn what_the_other_ros_cannot_hold_becomes_the_nearest_and_is_counted() {
    let one = [("a/B", "time a\nint32 b\nstring c\nfloat64 d\nbool e")];
    let two = [("a/msg/B", "builtin_interfaces/Time a\nuint8 b\nwstring c\nfloat32 d\nbool e")];
    let pair = twin_among(TranslationRules::default(), One, &one, &two).unwrap();
    let mut bytes = Vec::new();
    bytes.extend_from_slice(&4_000_000_000u32.to_le_bytes());
    bytes.extend_from_slice(&5u32.to_le_bytes());
    bytes.extend_from_slice(&(-3i32).to_le_bytes());
    bytes.extend_from_slice(&2u32.to_le_bytes());
    bytes.extend_from_slice(b"a\xff");
    bytes.extend_from_slice(&1e300f64.to_le_bytes());
    bytes.push(2);
    let carried = pair.to_twin.translate(&bytes).unwrap();
    let shown = json(&pair.twin, &carried);
    assert_eq!(shown["a"], value!({"sec": i32::MAX, "nanosec": 999_999_999}), "after 2038");
    assert_eq!((&shown["b"], &shown["c"], &shown["e"]), (&value!(0), &value!("a\u{fffd}"), &value!(true)));
    assert_eq!(pair.to_twin.saturated_count(), 4);
    assert_eq!(carried.last(), Some(&1), "nodes of ROS 2 refuse other bools than 0 and 1");

    let before = serialize(&pair.twin, r#"{"a": {"sec": -1, "nanosec": 5}, "b": 200, "c": "ok"}"#);
    let carried = pair.from_twin.translate(&before).unwrap();
    let shown = json(&pair.original, &carried);
    assert_eq!((&shown["a"], &shown["b"]), (&value!({"secs": 0, "nsecs": 0}), &value!(200)), "before 1970");
    assert_eq!(pair.from_twin.saturated_count(), 1);
}

#[test]
fn what_exceeds_a_bound_is_refused() {
    let one = [("a/B", "string a\nint16[] b\nint16[] c\nstring[] d")];
    let two = [("a/msg/B", "string<=3 a\nint16[<=2] b\nint16[2] c\nstring<=1[<=2] d")];
    let pair = twin_among(TranslationRules::default(), One, &one, &two).unwrap();
    let refused = |given: &str| pair.to_twin.translate(&serialize(&pair.original, given)).unwrap_err();
    assert!(pair.to_twin.translate(&serialize(&pair.original, r#"{"a": "äöü", "b": [1, 2], "c": [1, 2]}"#)).is_ok());
    let long = refused(r#"{"a": "abcd", "c": [1, 2]}"#);
    assert_eq!((&*long.path, &long.kind), ("a", &CodecErrorKind::TooMany { most: 3, of: "characters", found: 4 }));
    let many = refused(r#"{"b": [1, 2, 3], "c": [1, 2]}"#);
    assert_eq!((&*many.path, &many.kind), ("b", &CodecErrorKind::TooMany { most: 2, of: "elements", found: 3 }));
    let few = refused(r#"{"c": [1]}"#);
    assert_eq!((&*few.path, &few.kind), ("c", &CodecErrorKind::WrongLength { expected: 2, found: 1 }));
    let inner = refused(r#"{"c": [1, 2], "d": ["a", "bc"]}"#);
    assert_eq!((&*inner.path, &*inner.type_name), ("d[1]", "a/B"));
}

#[test]
fn bytes_that_are_no_message_are_refused_with_their_field() {
    let definitions =
        [("a/B", "std_msgs/Header header\nPoint[] points\nstring name"), ("a/Point", "uint8 n\nstring s")];
    let pair = twin(One, &definitions);
    let given = r#"{"header": {"frame_id": "map"}, "points": [{"n": 1, "s": "a"}, {"n": 2, "s": "b"}], "name": "x"}"#;
    let bytes = serialize(&pair.original, given);
    let refused = |bytes: &[u8]| pair.to_twin.translate(bytes).unwrap_err();
    let cut = refused(&bytes[..bytes.len() - 6]);
    assert_eq!((&*cut.path, &cut.kind), ("points[1].s", &CodecErrorKind::LengthBeyondEnd { count: 1, left: 0 }));
    assert_eq!(refused(&bytes[..2]).kind, CodecErrorKind::Truncated { missing: 2 });
    assert_eq!(refused(&[&bytes[..], b"ab"].concat()).kind, CodecErrorKind::Trailing(2));
    let mut long = bytes.clone();
    let at = 12 + 4 + 3;
    long[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(matches!(refused(&long).kind, CodecErrorKind::LengthBeyondEnd { .. }));
    for end in 0..bytes.len() {
        assert!(pair.to_twin.translate(&bytes[..end]).is_err(), "{end}");
    }

    let carried = pair.to_twin.translate(&bytes).unwrap();
    let refused = |bytes: &[u8]| pair.from_twin.translate(bytes).unwrap_err().kind;
    assert_eq!(refused(&[]), CodecErrorKind::Truncated { missing: 4 });
    assert_eq!(refused(&[0, 7, 0, 0, 1]), CodecErrorKind::Representation(7));
    // Some senders serialize into a buffer of estimated size.
    assert_eq!(pair.from_twin.translate(&[&carried[..], b"ab"].concat()).unwrap(), bytes);
}

#[test]
fn a_few_bytes_do_not_become_a_large_message() {
    // Elements that take no bytes in ROS 1 take one in ROS 2, and fields of the twin alone any number.
    let empty = [("a/B", "std_msgs/Empty[] a\nstd_msgs/Empty[] b"), ("std_msgs/Empty", "")];
    let pair = twin(One, &empty);
    let lengths = |a: u32, b: u32| [a.to_le_bytes(), b.to_le_bytes()].concat();
    let refused = pair.to_twin.translate(&lengths(60_000, 60_000)).unwrap_err();
    assert!(matches!(refused.kind, CodecErrorKind::TooLarge(limit) if limit < 70 << 10), "{refused}");
    assert!(pair.to_twin.translate(&lengths(70_000, 0)).is_err());
    assert_eq!(pair.to_twin.translate(&lengths(9, 0)).unwrap().len(), 4 + 4 + 9 + 3 + 4);

    let one = [("a/B", "E[] all"), ("a/E", "uint8 a")];
    let two = [("a/msg/B", "E[] all"), ("a/msg/E", "uint8 a\nfloat64[1000] b")];
    let pair = twin_among(TranslationRules::default(), One, &one, &two).unwrap();
    let elements = |count: u32| [&count.to_le_bytes()[..], &vec![1; count as usize]].concat();
    let refused = pair.to_twin.translate(&elements(1000)).unwrap_err();
    assert!(matches!(refused.kind, CodecErrorKind::TooLarge(limit) if limit < 100 << 10), "{refused}");
    assert_eq!(pair.to_twin.translate(&elements(2)).unwrap().len(), 4 + 2 * (8 + 8000));

    // A definition may ask for more.
    let one = [("a/B", "E one"), ("a/E", "uint8 a")];
    let two = [("a/msg/B", "E one"), ("a/msg/E", "uint8 a\nfloat64[100000] b")];
    let pair = twin_among(TranslationRules::default(), One, &one, &two).unwrap();
    assert_eq!(pair.to_twin.translate(&[1]).unwrap().len(), 4 + 8 + 800_000);
}

#[test]
fn definitions_that_mention_one_message_ever_again_stay_small() {
    // Each level doubles the number of mentions.
    let names: Vec<String> = (0..40).map(|level| format!("a/T{level}")).collect();
    let texts: Vec<String> = (0..40)
        .map(|level| match level {
            39 => "uint8 a\nstring b".to_owned(),
            _ => format!("T{next}[] a\nT{next}[] b", next = level + 1),
        })
        .collect();
    let definitions: Vec<(&str, &str)> =
        names.iter().map(|name| &**name).zip(texts.iter().map(|text| &**text)).collect();
    let pair = twin(One, &definitions);
    let bytes = default_message(&pair.original);
    let carried = pair.to_twin.translate(&bytes).unwrap();
    assert_eq!(pair.from_twin.translate(&carried).unwrap(), bytes);
}
