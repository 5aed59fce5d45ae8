//! ROS 2's serialization, compared with that of rclpy.

use super::super::*;
use super::message as message_of_one;
use crate::schema::Registry;
use std::sync::Arc;

fn registry() -> Registry {
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in [
        ("a/msg/Nothing", ""),
        ("a/msg/Text", "string data"),
        ("a/msg/Wide", "wstring data\nuint8 last"),
        ("a/msg/Steps", "uint8 a\nfloat64 b\nint16 c\nuint32 d\nbool e\nint64 f"),
        (
            "a/msg/Lists",
            "float64[] none\nuint8 after\nint64[] longs\nuint16[2] pair\nNothing[] nothings\nbyte[] bytes\n\
             builtin_interfaces/Time[] times\nstring[] texts",
        ),
        ("a/msg/Bounds", "string<=3 text\nint32[<=2] some\nwstring<=2 wide\nuint8[<=2] bytes"),
        ("a/msg/Place", "std_msgs/Header header\nfloat64 x\nstring name 'here'\nuint8 n 7"),
        ("a/msg/Way", "Place[] places\nPlace one\nNothing nothing\nbuiltin_interfaces/Duration took"),
    ] {
        registry.insert(key, text).unwrap();
    }
    registry
}

fn message(name: &str) -> Arc<MessageType> {
    registry().message(name).unwrap()
}

fn json_of(message: &MessageType, bytes: &[u8]) -> Result<String, String> {
    let mut out = Vec::new();
    to_json(message, bytes, &mut out, &JsonOptions::default()).map_err(|it| it.to_string())?;
    Ok(String::from_utf8(out).unwrap())
}

fn cdr_of(message: &MessageType, json: &str) -> Result<Vec<u8>, String> {
    let mut out = b"kept".to_vec();
    let options = FillOptions { now: Some(Time { secs: 9, nsecs: 8 }), ..FillOptions::default() };
    let result = from_json(message, json.as_bytes(), &mut out, &options);
    let bytes = out.split_off(4);
    assert_eq!(out, b"kept");
    result.map_err(|error| {
        assert!(bytes.is_empty(), "output left behind");
        error.to_string()
    })?;
    validate(message, &bytes).unwrap();
    Ok(bytes)
}

/// Parses hex digits, ignoring spaces.
fn hex(digits: &str) -> Vec<u8> {
    let digits: String = digits.split_whitespace().collect();
    hex::decode(digits).unwrap()
}

#[track_caller]
fn both_ways(message: &MessageType, bytes: &str, json: &str) {
    assert_eq!(json_of(message, &hex(bytes)).unwrap(), json);
    assert_eq!(hex::encode(cdr_of(message, json).unwrap()), hex::encode(hex(bytes)));
}

#[test]
fn texts_count_their_nul_and_wide_ones_have_four_bytes_per_unit() {
    both_ways(&message("a/Text"), "00010000 04000000 61626300", r#"{"data":"abc"}"#);
    both_ways(&message("a/Text"), "00010000 01000000 00", r#"{"data":""}"#);
    both_ways(
        &message("a/Wide"),
        "00010000 04000000 61000000 e9000000 3dd80000 00de0000 05",
        r#"{"data":"aé😀","last":5}"#,
    );
    let text = message("a/Text");
    for (bytes, json) in [
        ("00010000 00000000", r#"{"data":""}"#),
        ("00010000 03000000 616263", r#"{"data":"abc"}"#),
        ("00010000 05000000 6100626300", r#"{"data":"a\u0000bc"}"#),
        ("00010000 04000000 61626300 99999999 99", r#"{"data":"abc"}"#),
        ("00000000 00000004 61626300", r#"{"data":"abc"}"#),
    ] {
        assert_eq!(json_of(&text, &hex(bytes)).unwrap(), json, "{bytes}");
    }
    // Half a surrogate is replaced or refused, like invalid UTF-8.
    let half = hex("00010000 02000000 3dd80000 61000000 05");
    let wide = message("a/Wide");
    assert_eq!(json_of(&wide, &half).unwrap(), "{\"data\":\"\u{fffd}a\",\"last\":5}");
    let refuse = JsonOptions { invalid_utf8: InvalidUtf8::Refuse, ..JsonOptions::default() };
    let refused = to_json(&wide, &half, &mut Vec::new(), &refuse).unwrap_err();
    assert_eq!(refused.to_string(), "field data of a/msg/Wide: the text is not UTF-8");
}

#[test]
fn numbers_are_aligned_from_the_body_on_in_both_orders_of_bytes() {
    let steps = message("a/Steps");
    let json = r#"{"a":1,"b":0.5,"c":-2,"d":3,"e":true,"f":-1}"#;
    both_ways(
        &steps,
        "00010000 0100000000000000 000000000000e03f feff0000 03000000 0100000000000000 ffffffffffffffff",
        json,
    );
    // Padding may have any value.
    let big = hex("00000000 01aaaaaaaaaaaaaa 3fe0000000000000 fffebbbb 00000003 01cccccccccccccc ffffffffffffffff");
    assert_eq!(json_of(&steps, &big).unwrap(), json);
}

#[test]
fn empty_lists_of_wide_numbers_have_no_padding() {
    both_ways(
        &message("a/Lists"),
        "00010000 00000000 05 000000 01000000 00000000 0700000000000000 01000200 02000000 0000 0000 02000000 fffe \
         0000 01000000 feffffff 03000000 02000000 02000000 6100 0000 01000000 00",
        r#"{"none":[],"after":5,"longs":[7],"pair":[1,2],"nothings":[{},{}],"bytes":"//4=","times":[{"sec":-2,"nanosec":3}],"texts":["a",""]}"#,
    );
}

#[test]
fn left_out_fields_have_the_definitions_values_and_stamps_the_clock() {
    let way = message("a/Way");
    let bytes = cdr_of(&way, r#"{"places":[{"x":1}, {"header":{"frame_id":"f"}}]}"#).unwrap();
    assert_eq!(
        json_of(&way, &bytes).unwrap(),
        concat!(
            r#"{"places":["#,
            r#"{"header":{"stamp":{"sec":9,"nanosec":8},"frame_id":""},"x":1.0,"name":"here","n":7},"#,
            r#"{"header":{"stamp":{"sec":9,"nanosec":8},"frame_id":"f"},"x":0.0,"name":"here","n":7}],"#,
            r#""one":{"header":{"stamp":{"sec":0,"nanosec":0},"frame_id":""},"x":0.0,"name":"here","n":7},"#,
            r#""nothing":{},"took":{"sec":0,"nanosec":0}}"#
        )
    );
    let place = message("a/Place");
    for stamp in [r#""now""#, r#"{"secs":9,"nsecs":8}"#, r#"{"nanosec":8,"sec":9}"#] {
        let bytes = cdr_of(&place, &format!(r#"{{"header":{{"stamp":{stamp}}}}}"#)).unwrap();
        assert_eq!(header_stamp(&place, &bytes), Some(Time { secs: 9, nsecs: 8 }));
        assert_eq!(Stamps::for_type(&place).find(&bytes), Some(vec![4]));
        let value = Value::read(&place, &bytes).unwrap();
        assert_eq!(value.field("name").unwrap().text().unwrap(), "here");
        let stamp = value.field("header").unwrap().field("stamp").unwrap();
        assert_eq!(stamp.time(), Some(Time { secs: 9, nsecs: 8 }));
    }
    let bytes = default_message(&way);
    assert_eq!(Stamps::for_type(&way).find(&bytes), Some(vec![8]));
    assert!(Stamps::for_type(&message("a/Steps")).is_empty());
}

#[test]
fn fields_out_of_order_are_aligned_where_they_belong() {
    for (name, straight, turned) in [
        (
            "a/Steps",
            r#"{"a":1,"b":0.5,"c":-2,"d":3,"e":true,"f":-1}"#,
            r#"{"f":-1,"e":true,"d":3,"c":-2,"b":0.5,"a":1}"#,
        ),
        (
            "a/Way",
            r#"{"places":[{"header":{"stamp":{"sec":1,"nanosec":2},"frame_id":"ab"},"x":2,"name":"n","n":1}],"nothing":{}}"#,
            r#"{"nothing":{},"places":[{"n":5,"name":"n","x":2,"n":1,"header":{"frame_id":"ab","stamp":{"nanosec":2,"sec":1}}}]}"#,
        ),
        (
            "a/Lists",
            r#"{"none":[1.5],"after":1,"longs":[2,3],"pair":[4,5],"nothings":[{}],"bytes":"AQI=","texts":["a","bcd"]}"#,
            r#"{"texts":["a","bcd"],"bytes":[1,2],"nothings":[{}],"pair":[4,5],"longs":[2,3],"after":1,"none":[1.5]}"#,
        ),
    ] {
        let message = message(name);
        let (straight, turned) = (cdr_of(&message, straight), cdr_of(&message, turned));
        assert_eq!(straight.unwrap(), turned.unwrap(), "{name}");
    }
}

#[test]
fn writers_keep_to_bounds_and_readers_do_not_ask() {
    let bounds = message("a/Bounds");
    cdr_of(&bounds, r#"{"text":"äöü","some":[1,2],"wide":"机😀","bytes":"AQI="}"#).unwrap();
    for (json, error) in [
        (r#"{"text":"äöüa"}"#, "field text of a/msg/Bounds: takes at most 3 characters, got 4"),
        (r#"{"some":[1,2,3,4]}"#, "field some of a/msg/Bounds: takes at most 2 elements, got 3"),
        (r#"{"wide":"abc"}"#, "field wide of a/msg/Bounds: takes at most 2 characters, got 3"),
        (r#"{"bytes":"AQID"}"#, "field bytes of a/msg/Bounds: takes at most 2 elements, got 3"),
        (r#"{"bytes":[1,2,3]}"#, "field bytes of a/msg/Bounds: takes at most 2 elements, got 3"),
    ] {
        assert_eq!(cdr_of(&bounds, json).unwrap_err(), error);
    }
    let beyond = hex("00010000 05000000 6162636400 000000 03000000 010000000200000003000000 00000000 00000000");
    assert_eq!(json_of(&bounds, &beyond).unwrap(), r#"{"text":"abcd","some":[1,2,3],"wide":"","bytes":""}"#);
}

#[test]
fn bytes_that_are_no_message_are_refused_with_their_place() {
    let text = message("a/Text");
    for (bytes, error) in [
        ("0001", "a/msg/Text: the serialized message ends here, 2 bytes too early"),
        (
            "00030000 00000000",
            "a/msg/Text: serialized as representation 0x0003, of which only plain CDR is read (0x0000 and 0x0001)",
        ),
        ("00010000 0400", "field data of a/msg/Text: the serialized message ends here, 2 bytes too early"),
        (
            "00010000 ffffffff 61",
            "field data of a/msg/Text: a length of 4294967295 cannot be true with 1 bytes to follow",
        ),
    ] {
        assert_eq!(json_of(&text, &hex(bytes)).unwrap_err(), error);
        assert_eq!(validate(&text, &hex(bytes)).unwrap_err().to_string(), error);
    }
    let way = message("a/Way");
    let bytes = cdr_of(&way, r#"{"places":[{},{"name":"there"}]}"#).unwrap();
    for end in 0..bytes.len() {
        assert!(validate(&way, &bytes[..end]).is_err(), "{end}");
        assert_eq!(Value::read(&way, &bytes[..end]), None, "{end}");
    }
    let broken = json_of(&way, &bytes[..60]).unwrap_err();
    assert!(broken.starts_with("field places[1].header.frame_id of a/msg/Way: "), "{broken}");
    let wrong = cdr_of(&way, r#"{"places":[{},{"header":{"stamp":{"nanosec":-1}}}]}"#);
    assert_eq!(wrong.unwrap_err(), "field places[1].header.stamp.nanosec of a/msg/Way: -1 does not fit into uint32");
}

#[test]
fn what_may_be_written_is_limited() {
    let way = message("a/Way");
    let options = FillOptions { now: None, max_bytes: 100 };
    let json = format!(r#"{{"places":[{}]}}"#, ["{}"; 40].join(","));
    let mut out = Vec::new();
    let refused = from_json(&way, json.as_bytes(), &mut out, &options).unwrap_err();
    assert_eq!(refused.kind, CodecErrorKind::TooLarge(100));
    assert!(out.capacity() < 1000);
    // The same error as in ROS 1.
    let path = message_of_one("nav_msgs/Path");
    let json = format!(r#"{{"poses":[{}]}}"#, ["{}"; 40].join(","));
    let of_one = from_json(&path, json.as_bytes(), &mut out, &options).unwrap_err();
    assert_eq!(of_one.kind, refused.kind);
}

#[test]
fn the_seq_of_a_ros_1_header_is_dropped_wherever_the_header_stands() {
    let way = message("a/Way");
    let filled = |json: &str| {
        let mut bytes = Vec::new();
        let report = from_json(&way, json.as_bytes(), &mut bytes, &FillOptions::default());
        report.map(|report| (bytes, report)).map_err(|error| error.to_string())
    };
    let (dropped, plain) = (FillReport { dropped_seq: true }, FillReport::default());
    let (expected, report) = filled(
        r#"{"places":[{"header":{"stamp":{"sec":1,"nanosec":2},"frame_id":"ab"},"x":2}],
            "one":{"header":{"frame_id":"c"}}}"#,
    )
    .unwrap();
    assert_eq!(report, plain);
    for json in [
        r#"{"places":[{"header":{"seq":7,"stamp":{"secs":1,"nsecs":2},"frame_id":"ab"},"x":2}],
            "one":{"header":{"frame_id":"c"}}}"#,
        r#"{"one":{"header":{"frame_id":"c","s\u0065q":4294967295}},
            "places":[{"x":2,"header":{"frame_id":"ab","seq":0,"stamp":{"sec":1,"nsecs":2},"seq":1}}]}"#,
    ] {
        assert_eq!(filled(json), Ok((expected.clone(), dropped)), "{json}");
    }
    // Only a number is dropped, and only from a header.
    for (json, error) in [
        (r#"{"one":{"header":{"seq":-1}}}"#, "field one.header.seq of a/msg/Way: -1 does not fit into uint32"),
        (r#"{"one":{"header":{"seq":"1"}}}"#, "field one.header.seq of a/msg/Way: takes uint32, got a string"),
        (r#"{"one":{"seq":1}}"#, "field one.seq of a/msg/Way: there is no such field"),
        (r#"{"one":{"header":{"sequence":1}}}"#, "field one.header.sequence of a/msg/Way: there is no such field"),
    ] {
        assert_eq!(filled(json).unwrap_err(), error);
    }

    // In CBOR, and as the message itself.
    let mut bytes = Vec::new();
    let header = message("std_msgs/Header");
    for cbor in [&b"\xa1\x63seq\x07"[..], b"\xa2\x68frame_id\x60\x63seq\x1a\xff\xff\xff\xff"] {
        bytes.clear();
        assert_eq!(from_cbor(&header, cbor, &mut bytes, &FillOptions::default()), Ok(dropped));
        assert_eq!(bytes, default_message(&header));
    }
    let refused = from_cbor(&header, b"\xa1\x63seq\x20", &mut bytes, &FillOptions::default()).unwrap_err();
    assert_eq!(refused.to_string(), "field seq of std_msgs/msg/Header: -1 does not fit into uint32");

    // ROS 1 keeps it.
    bytes.clear();
    let path = message_of_one("nav_msgs/Path");
    let report = from_json(&path, br#"{"header":{"seq":7}}"#, &mut bytes, &FillOptions::default());
    assert_eq!((report, &bytes[..4]), (Ok(plain), &[7, 0, 0, 0][..]));
}
