use super::*;

#[test]
fn a_publish_that_does_not_fit_names_the_field_and_the_reason() {
    for (name, json, error) in [
        ("std_msgs/String", r#"{"data":5}"#, "field data of std_msgs/String: takes a string, got a number"),
        ("std_msgs/String", r#"{"data":null}"#, "field data of std_msgs/String: takes a string, got null"),
        ("std_msgs/String", r#"{"dta":"x"}"#, "field dta of std_msgs/String: there is no such field"),
        ("std_msgs/String", r#"{"data":"x","more":1}"#, "field more of std_msgs/String: there is no such field"),
        ("std_msgs/Empty", r#"{"x":1}"#, "field x of std_msgs/Empty: there is no such field"),
        ("std_msgs/String", r#"[]"#, "std_msgs/String: takes an object, got a list"),
        ("std_msgs/Bool", r#"{"data":1}"#, "field data of std_msgs/Bool: takes bool, got a number"),
        ("std_msgs/Bool", r#"{"data":"true"}"#, "field data of std_msgs/Bool: takes bool, got a string"),
        ("std_msgs/UInt8", r#"{"data":true}"#, "field data of std_msgs/UInt8: takes uint8, got a bool"),
        ("std_msgs/UInt8", r#"{"data":"5"}"#, "field data of std_msgs/UInt8: takes uint8, got a string"),
        ("std_msgs/UInt8", r#"{"data":{}}"#, "field data of std_msgs/UInt8: takes uint8, got an object"),
        ("std_msgs/UInt8", r#"{"data":null}"#, "field data of std_msgs/UInt8: takes uint8, got null"),
        (
            "std_msgs/UInt8",
            r#"{"data":NaN}"#,
            "field data of std_msgs/UInt8: takes uint8, got a number that is not finite",
        ),
        ("std_msgs/UInt8", r#"{"data":256}"#, "field data of std_msgs/UInt8: 256 does not fit into uint8"),
        ("std_msgs/UInt8", r#"{"data":-1}"#, "field data of std_msgs/UInt8: -1 does not fit into uint8"),
        (
            "std_msgs/UInt8",
            r#"{"data":1.5}"#,
            "field data of std_msgs/UInt8: takes uint8, got a number with a fraction",
        ),
        ("std_msgs/UInt8", r#"{"data":1e9}"#, "field data of std_msgs/UInt8: 1e9 does not fit into uint8"),
        ("std_msgs/UInt8", r#"{"data":1e999}"#, "field data of std_msgs/UInt8: 1e999 does not fit into uint8"),
        ("std_msgs/UInt8", r#"{"data":256.0}"#, "field data of std_msgs/UInt8: 256.0 does not fit into uint8"),
        ("std_msgs/Int8", r#"{"data":-129.0}"#, "field data of std_msgs/Int8: -129.0 does not fit into int8"),
        (
            "std_msgs/Int64",
            r#"{"data":9223372036854775808.0}"#,
            "field data of std_msgs/Int64: 9223372036854775808.0 does not fit into int64",
        ),
        (
            "std_msgs/UInt64",
            r#"{"data":1.8446744073709551616e19}"#,
            "field data of std_msgs/UInt64: 1.8446744073709551616e19 does not fit into uint64",
        ),
        ("std_msgs/Int8", r#"{"data":-129}"#, "field data of std_msgs/Int8: -129 does not fit into int8"),
        (
            "std_msgs/Int64",
            r#"{"data":9223372036854775808}"#,
            "field data of std_msgs/Int64: 9223372036854775808 does not fit into int64",
        ),
        (
            "std_msgs/UInt64",
            r#"{"data":18446744073709551616}"#,
            "field data of std_msgs/UInt64: 18446744073709551616 does not fit into uint64",
        ),
        ("std_msgs/Float32", r#"{"data":1e39}"#, "field data of std_msgs/Float32: 1e39 does not fit into float32"),
        ("std_msgs/Float64", r#"{"data":-1e309}"#, "field data of std_msgs/Float64: -1e309 does not fit into float64"),
        ("std_msgs/Float64", r#"{"data":"x"}"#, "field data of std_msgs/Float64: takes float64, got a string"),
        ("std_msgs/Time", r#"{"data":{"secs":-1}}"#, "field data.secs of std_msgs/Time: -1 does not fit into uint32"),
        ("std_msgs/Time", r#"{"data":{"seconds":1}}"#, "field data.seconds of std_msgs/Time: there is no such field"),
        ("std_msgs/Time", r#"{"data":"later"}"#, "field data of std_msgs/Time: takes an object, got a string"),
        ("std_msgs/Duration", r#"{"data":"now"}"#, "field data of std_msgs/Duration: takes an object, got a string"),
        (
            "nav_msgs/Path",
            r#"{"poses":[{},{"pose":{"position":{"x":1,"q":2}}}]}"#,
            "field poses[1].pose.position.q of nav_msgs/Path: there is no such field",
        ),
        (
            "nav_msgs/Path",
            r#"{"poses":[{},{"pose":{"position":{"x":[1]}}}]}"#,
            "field poses[1].pose.position.x of nav_msgs/Path: takes float64, got a list",
        ),
        ("nav_msgs/Path", r#"{"poses":{}}"#, "field poses of nav_msgs/Path: takes a list, got an object"),
        ("t/Arrays", r#"{"pair":[1]}"#, "field pair of t/Arrays: takes exactly 2 elements, got 1"),
        ("t/Arrays", r#"{"pair":[1,2,3]}"#, "field pair of t/Arrays: takes exactly 2 elements, got 3"),
        ("t/Arrays", r#"{"words":[1,null]}"#, "field words[1] of t/Arrays: takes uint32, got null"),
        ("t/Arrays", r#"{"texts":["a",1]}"#, "field texts[1] of t/Arrays: takes a string, got a number"),
        ("t/Arrays", r#"{"durations":[]}"#, "field durations of t/Arrays: takes exactly 1 elements, got 0"),
    ] {
        assert_eq!(ros_of(&message(name), json).unwrap_err(), error, "{json}");
    }
}

#[test]
fn a_long_number_or_name_makes_no_long_error() {
    let digits = "9".repeat(1_000_000);
    let error = ros_of(&message("std_msgs/UInt8"), &format!("{{\"data\":{digits}}}")).unwrap_err();
    assert!(error.len() < 200, "{error}");
    let error = ros_of(&message("std_msgs/UInt8"), &format!("{{\"{digits}\":1}}")).unwrap_err();
    assert!(error.len() < 200, "{error}");
    let value = ros_of(&message("std_msgs/Float64"), &format!("{{\"data\":0.{digits}e1}}")).unwrap();
    assert_eq!(value, 10f64.to_le_bytes());
}

#[test]
fn what_is_not_json_says_where() {
    for (json, error) in [
        ("", "invalid JSON at byte 0: the input ends inside a value"),
        ("{", "invalid JSON at byte 1: expected a key"),
        ("{\"data\"", "invalid JSON at byte 7: expected a colon"),
        ("{\"data\":}", "invalid JSON at byte 8: expected a value"),
        ("{\"data\":1", "invalid JSON at byte 9: expected a comma or a closing bracket"),
        ("{\"data\":1,}", "invalid JSON at byte 10: expected a key"),
        ("{\"data\":1 \"data\":1}", "invalid JSON at byte 10: expected a comma or a closing bracket"),
        ("{\"data\":01}", "invalid JSON at byte 10: a number that begins with 0"),
        ("{\"data\":1.}", "invalid JSON at byte 10: expected a digit"),
        ("{\"data\":.5}", "invalid JSON at byte 8: expected a value"),
        ("{\"data\":-}", "invalid JSON at byte 9: expected a digit"),
        ("{\"data\":1e}", "invalid JSON at byte 10: expected a digit"),
        ("{\"data\":+1}", "invalid JSON at byte 8: expected a value"),
        ("{\"data\":1}x", "invalid JSON at byte 10: more follows the message"),
        ("{,}", "invalid JSON at byte 1: expected a key"),
        ("{data:1}", "invalid JSON at byte 1: expected a key"),
        ("{\"\\x\":1}", "invalid JSON at byte 3: an unknown escape"),
        ("{\"\\u12\":1}", "invalid JSON at byte 3: an escape without four hex digits"),
        ("{\"\\u+123\":1}", "invalid JSON at byte 3: an escape without four hex digits"),
        ("{\"a\u{1}\":1}", "invalid JSON at byte 3: a control character in a string"),
        ("{\"data", "invalid JSON at byte 6: a string without an end"),
    ] {
        let found = ros_of(&message("std_msgs/Float64"), json).unwrap_err();
        assert!(found.ends_with(error), "{json}: {found}");
    }
    let mut out = Vec::new();
    let string = message("std_msgs/String");
    let error = from_json(&string, b"{\"data\":\"\xff\"}", &mut out, &FillOptions::default()).unwrap_err();
    assert_eq!(error.kind, CodecErrorKind::InvalidUtf8);
}

#[test]
fn deep_nesting_is_refused_where_it_begins() {
    for name in ["std_msgs/String", "nav_msgs/Path", "t/Arrays", "sensor_msgs/Image"] {
        let message = message(name);
        for open in ["[", "{\"header\":", "{\"poses\":[", "{\"data\":"] {
            let json = open.repeat(200_000);
            assert!(ros_of(&message, &json).is_err());
        }
        for open in [&b"\x81"[..], b"\xa1\x64data", b"\xa1\x66header", b"\x9f", b"\xc1", b"\xbf\x65poses\x9f"] {
            let cbor = open.repeat(200_000);
            assert!(from_cbor(&message, &cbor, &mut Vec::new(), &FillOptions::default()).is_err());
        }
    }
}

#[test]
fn lengths_beyond_the_end_are_refused_before_anything_is_reserved() {
    let huge = Bytes::default().u32(u32::MAX).raw(&[0; 100]).0;
    let string = message("std_msgs/String");
    let expected = "field data of std_msgs/String: a length of 4294967295 cannot be true with 100 bytes to follow";
    let mut out = Vec::new();
    assert_eq!(to_json(&string, &huge, &mut out, &JsonOptions::default()).unwrap_err().to_string(), expected);
    assert_eq!(to_cbor(&string, &huge, &mut out, &CborOptions::default()).unwrap_err().to_string(), expected);
    assert_eq!(validate(&string, &huge).unwrap_err().to_string(), expected);
    assert!(out.capacity() < 1000);

    let mut empties = arrays_bytes();
    let at = empties.len() - 4;
    empties[at..].copy_from_slice(&u32::MAX.to_le_bytes());
    let error = to_json(&message("t/Arrays"), &empties, &mut out, &JsonOptions::default()).unwrap_err();
    assert_eq!(error.path, "none");
    assert!(matches!(error.kind, CodecErrorKind::LengthBeyondEnd { .. }));

    let cbor = b"\xa1\x64data\x7b\xff\xff\xff\xff\xff\xff\xff\xff";
    let error = from_cbor(&string, cbor, &mut out, &FillOptions::default()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "field data of std_msgs/String: invalid CBOR at byte 15: a string longer than the input"
    );
    let cbor = b"\xa1\x65words\x9b\xff\xff\xff\xff\xff\xff\xff\xff\x01";
    assert!(from_cbor(&message("t/Arrays"), cbor, &mut out, &FillOptions::default()).is_err());
    assert!(out.capacity() < 1000);
}

#[test]
fn every_truncation_and_every_surplus_is_noticed() {
    let path = message("nav_msgs/Path");
    let bytes = ros_of(&path, r#"{"header":{"frame_id":"map"},"poses":[{"header":{"frame_id":"x"}},{}]}"#).unwrap();
    for end in 0..bytes.len() {
        assert!(validate(&path, &bytes[..end]).is_err(), "{end}");
        assert!(to_json(&path, &bytes[..end], &mut Vec::new(), &JsonOptions::default()).is_err(), "{end}");
    }
    let surplus = [&bytes[..], b"xy"].concat();
    assert_eq!(
        validate(&path, &surplus).unwrap_err().to_string(),
        "nav_msgs/Path: 2 bytes follow the end of the message"
    );
    let error = validate(&path, &bytes[..bytes.len() - 1]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "field poses[1].pose.orientation.w of nav_msgs/Path: the serialized message ends here, 1 bytes too early"
    );
}

#[test]
fn output_beyond_the_limit_is_refused() {
    let string = message("std_msgs/String");
    let bytes = Bytes::default().text(&"x".repeat(1000)).0;
    let json = json_of(&string, &bytes);
    let too_large = |result: Result<(), CodecError>| {
        assert_eq!(
            result.unwrap_err().to_string().rsplit(": ").next().unwrap(),
            "the converted message is larger than the limit of 500 bytes"
        );
    };
    let options = JsonOptions { max_bytes: 500, ..JsonOptions::default() };
    too_large(to_json(&string, &bytes, &mut Vec::new(), &options));
    let options = CborOptions { max_bytes: 500, ..CborOptions::default() };
    too_large(to_cbor(&string, &bytes, &mut Vec::new(), &options));
    let options = FillOptions { max_bytes: 500, ..FillOptions::default() };
    too_large(from_json(&string, json.as_bytes(), &mut Vec::new(), &options).map(drop));

    // A few bytes of JSON must not become gigabytes of defaults.
    let registry = Registry::new();
    registry.insert("a/msg/A", "B[] x").unwrap();
    registry.insert("a/msg/B", "uint8[10000000] y").unwrap();
    let amplifier = registry.message("a/A").unwrap();
    let json = format!("{{\"x\":[{}{{}}]}}", "{},".repeat(1000));
    let error = from_json(&amplifier, json.as_bytes(), &mut Vec::new(), &FillOptions::default()).unwrap_err();
    assert_eq!(error.kind, CodecErrorKind::TooLarge(DEFAULT_MAX_BYTES));
    let mut out = Vec::new();
    let options = FillOptions { max_bytes: 500, ..FillOptions::default() };
    assert!(from_json(&amplifier, b"{\"x\":[{}]}", &mut out, &options).is_err());
    assert!(out.capacity() < 1000, "reserved before it was refused");
}
