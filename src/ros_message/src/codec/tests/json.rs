use super::*;

#[test]
fn an_image_has_its_data_as_base64() {
    let image = message("sensor_msgs/Image");
    let bytes = header().u32(1).u32(2).text("rgb8").raw(&[0]).u32(6).u32(6).raw(&[1, 2, 3, 250, 251, 252]).0;
    let json = r#"{"header":{"seq":7,"stamp":{"secs":12,"nsecs":34},"frame_id":"map"},"height":1,"width":2,"encoding":"rgb8","is_bigendian":0,"step":6,"data":"AQID+vv8"}"#;
    assert_eq!(json_of(&image, &bytes), json);
    assert_eq!(ros_of(&image, json).unwrap(), bytes);
    assert_eq!(header_stamp(&image, &bytes), Some(Time { secs: 12, nsecs: 34 }));
    assert_eq!(header_stamp(&image, &bytes[..11]), None);
    assert_eq!(header_stamp(&message("std_msgs/Time"), &bytes), None);
}

#[test]
fn arrays_of_every_kind() {
    let arrays = message("t/Arrays");
    let json = r#"{"bools":[true,false],"bytes":[-1,0,127],"pair":[-2,300],"words":[0,4294967295],"longs":[-9223372036854775808],"singles":[0.1,-3.0],"triple":[0.5,1e+300,-0.0],"texts":["a",""],"chars":"AQID/w==","times":[{"secs":5,"nsecs":6}],"durations":[{"secs":-1,"nsecs":-2}],"none":[{},{}]}"#;
    assert_eq!(json_of(&arrays, &arrays_bytes()), json);
    assert_eq!(ros_of(&arrays, json).unwrap(), arrays_bytes());
}

#[test]
fn fields_may_come_in_any_order_with_any_space_and_twice() {
    let image = message("sensor_msgs/Image");
    let bytes = header().u32(1).u32(2).text("rgb8").raw(&[9]).u32(6).u32(2).raw(&[1, 2]).0;
    let json = "\n{ \"data\" :\t[ 1 , 2 ] , \"step\": 6, \"width\":3,\r\n \"header\": {\"frame_id\":\"map\",\
                \"stamp\":{\"nsecs\":34,\"secs\":12},\"seq\":7}, \"h\\u0065ight\":1, \"is_bigendian\":9,\
                \"encoding\":\"rgb8\", \"width\":2 } ";
    assert_eq!(ros_of(&image, json).unwrap(), bytes);
    let path = message("nav_msgs/Path");
    let ordered = r#"{"poses":[{"header":{"seq":1},"pose":{"position":{"x":1.0,"y":2}}},{}]}"#;
    let shuffled = r#"{"poses":[{"pose":{"position":{"y":2,"x":1}},"header":{"seq":1}},{}]}"#;
    assert_eq!(ros_of(&path, ordered).unwrap(), ros_of(&path, shuffled).unwrap());
}

#[test]
fn what_is_missing_gets_its_default() {
    let image = message("sensor_msgs/Image");
    let default = vec![0; image.min_size()];
    assert_eq!(ros_of(&image, "{}").unwrap(), default);
    assert_eq!(
        default_json(&image),
        r#"{"header":{"seq":0,"stamp":{"secs":0,"nsecs":0},"frame_id":""},"height":0,"width":0,"encoding":"","is_bigendian":0,"step":0,"data":""}"#
    );
    assert_eq!(default_json(&message("std_msgs/Empty")), "{}");
}

#[test]
fn stamps_are_filled_where_the_client_left_them_out() {
    let now = Some(Time { secs: 100, nsecs: 200 });
    let pose = message("geometry_msgs/PoseStamped");
    let stamp = |json: &str| header_stamp(&pose, &ros_at(&pose, json, now).unwrap()).unwrap();
    let (filled, zero) = (Time { secs: 100, nsecs: 200 }, Time::default());
    assert_eq!(stamp("{}"), filled);
    assert_eq!(stamp(r#"{"header":{}}"#), filled);
    assert_eq!(stamp(r#"{"header":{"frame_id":"a"}}"#), filled);
    assert_eq!(stamp(r#"{"header":{"frame_id":"a","seq":1}}"#), filled);
    assert_eq!(stamp(r#"{"header":{"stamp":{}}}"#), filled);
    assert_eq!(stamp(r#"{"header":{"stamp":"now"}}"#), filled);
    assert_eq!(stamp(r#"{"header":{"stamp":{"secs":1}}}"#), Time { secs: 1, nsecs: 200 });
    assert_eq!(stamp(r#"{"header":{"stamp":{"secs":0,"nsecs":0}}}"#), zero);
    assert_eq!(stamp(r#"{"header":{"stamp":{"secs":3,"nsecs":4},"seq":1}}"#), Time { secs: 3, nsecs: 4 });
    assert_eq!(header_stamp(&pose, &ros_of(&pose, r#"{"header":{"stamp":"now"}}"#).unwrap()), Some(zero));
    // Other times are left unchanged.
    assert_eq!(ros_at(&message("std_msgs/Time"), "{}", now).unwrap(), [0; 8]);
    assert_eq!(ros_at(&message("std_msgs/Time"), r#"{"data":{}}"#, now).unwrap(), [0; 8]);
    assert!(Time::now() > Time { secs: 1_600_000_000, nsecs: 0 });
}

#[test]
fn strings_keep_what_they_hold() {
    let string = message("std_msgs/String");
    for text in ["", "plain", "quote \" slash \\ / end", "tab\tnewline\nbell\u{7}", "grüß 机器人 🤖", "12345678\"", "ü"]
    {
        let bytes = Bytes::default().text(text).0;
        let json = json_of(&string, &bytes);
        assert_eq!(serde_json::from_str::<serde_json::Value>(&json).unwrap()["data"], text);
        assert_eq!(ros_of(&string, &json).unwrap(), bytes);
    }
    let unescaped = |json: &str| ros_of(&string, json).map(|bytes| String::from_utf8(bytes[4..].to_vec()).unwrap());
    assert_eq!(unescaped(r#"{"data":"\u00fc\ud83e\udd16\/\b\f\n\r\t\u0000"}"#).unwrap(), "ü🤖/\u{8}\u{c}\n\r\t\0");
    assert_eq!(unescaped(r#"{"data":"\ud83e"}"#).unwrap(), "\u{fffd}");
    assert_eq!(unescaped(r#"{"data":"\udd16x\ud83e\u0041"}"#).unwrap(), "\u{fffd}x\u{fffd}A");
}

#[test]
fn strings_that_are_not_utf8_are_replaced_or_refused() {
    let string = message("std_msgs/String");
    let bytes = Bytes::default().u32(6).raw(b"a\"\xffb\xe2\x82").0;
    assert_eq!(json_of(&string, &bytes), "{\"data\":\"a\\\"\u{fffd}b\u{fffd}\"}");
    let options = JsonOptions { invalid_utf8: InvalidUtf8::Refuse, ..JsonOptions::default() };
    let error = to_json(&string, &bytes, &mut Vec::new(), &options).unwrap_err();
    assert_eq!(error.to_string(), "field data of std_msgs/String: the text is not UTF-8");
}

#[test]
fn numbers_that_are_not_finite() {
    let color = message("std_msgs/ColorRGBA");
    let bytes = Bytes::default().f32(f32::NAN).f32(f32::INFINITY).f32(f32::NEG_INFINITY).f32(1.5).0;
    let written = |non_finite| {
        let mut out = Vec::new();
        to_json(&color, &bytes, &mut out, &JsonOptions { non_finite, ..JsonOptions::default() }).unwrap();
        String::from_utf8(out).unwrap()
    };
    assert_eq!(written(NonFinite::Null), r#"{"r":null,"g":null,"b":null,"a":1.5}"#);
    let (quoted, bare) = (written(NonFinite::String), written(NonFinite::Bare));
    assert_eq!(quoted, r#"{"r":"NaN","g":"Infinity","b":"-Infinity","a":1.5}"#);
    assert_eq!(bare, r#"{"r":NaN,"g":Infinity,"b":-Infinity,"a":1.5}"#);
    assert_eq!(ros_of(&color, &quoted).unwrap(), bytes);
    assert_eq!(ros_of(&color, &bare).unwrap(), bytes);
    assert!(ros_of(&color, r#"{"r":null}"#).unwrap().starts_with(&f32::NAN.to_le_bytes()));
}

#[test]
fn numbers_are_taken_in_every_form() {
    let long = message("std_msgs/Int64");
    for (text, value) in [
        ("0", 0),
        ("-0", 0),
        ("1.0", 1),
        ("1e3", 1000),
        ("-2.50E1", -25),
        ("9223372036854775807", i64::MAX),
        ("-9223372036854775808", i64::MIN),
    ] {
        assert_eq!(ros_of(&long, &format!("{{\"data\":{text}}}")).unwrap(), value.to_le_bytes(), "{text}");
    }
    let unsigned = message("std_msgs/UInt64");
    assert_eq!(ros_of(&unsigned, r#"{"data":18446744073709551615}"#).unwrap(), u64::MAX.to_le_bytes());
    let double = message("std_msgs/Float64");
    for text in
        ["0", "-0.0", "1", "123456789012345678901234567890", "1e-400", "5e-324", "0.1", "1.7976931348623157e308"]
    {
        let value: f64 = text.parse().unwrap();
        assert_eq!(ros_of(&double, &format!("{{\"data\":{text}}}")).unwrap(), value.to_le_bytes(), "{text}");
    }
    let single = message("std_msgs/Float32");
    for text in ["0.1", "16777217", "0.10000000149011612", "1e-45", "3.4028235e38", "1.00000017881393432617187499"] {
        let value: f32 = text.parse().unwrap();
        assert_eq!(ros_of(&single, &format!("{{\"data\":{text}}}")).unwrap(), value.to_le_bytes(), "{text}");
    }
}

#[test]
fn bytes_come_as_base64_or_as_a_list() {
    let arrays = message("t/Arrays");
    let chars = |json: &str| {
        let bytes = ros_of(&arrays, &format!("{{\"chars\":{json}}}"))?;
        let at = bytes.len() - 4 - 8 - 4 - 4;
        Ok::<_, String>(bytes[at..at + 4].to_vec())
    };
    for form in ["[1,2,3,255]", "\"AQID/w==\"", "\"AQID/w\"", r#""AQID\/w==""#, r#""AQ\nID/w==""#, "[1.0,2,3,255]"] {
        assert_eq!(chars(form).unwrap(), [1, 2, 3, 255], "{form}");
    }
    let wrong = "field chars of t/Arrays: ";
    assert_eq!(chars("\"AQID\"").unwrap_err(), format!("{wrong}takes exactly 4 elements, got 3"));
    assert_eq!(chars("[1,2,3]").unwrap_err(), format!("{wrong}takes exactly 4 elements, got 3"));
    assert_eq!(chars("[1,2,3,4,5]").unwrap_err(), format!("{wrong}takes exactly 4 elements, got 5"));
    assert_eq!(chars("\"A*\"").unwrap_err(), format!("{wrong}the text is not base64"));
    assert_eq!(chars("7").unwrap_err(), format!("{wrong}takes base64 or a list of uint8, got a number"));
    assert_eq!(chars("[1,2,3,256]").unwrap_err(), "field chars[3] of t/Arrays: 256 does not fit into uint8");
}
