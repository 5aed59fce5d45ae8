use super::*;

fn cbor_of(message: &MessageType, bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    to_cbor(message, bytes, &mut out, &CborOptions::default()).unwrap();
    assert_eq!(cbor_item_len(&out).unwrap(), out.len());
    out
}

fn ros_of(message: &MessageType, cbor: &[u8]) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    let result = from_cbor(message, cbor, &mut out, &FillOptions::default());
    result.map(|_| out).map_err(|error| error.to_string())
}

/// A map with one key, `data`.
fn data(value: &[u8]) -> Vec<u8> {
    [b"\xa1\x64data", value].concat()
}

#[test]
fn a_message_is_a_map_with_typed_arrays() {
    let arrays = message("t/Arrays");
    let expected: Vec<u8> = [
        &b"\xac"[..],
        b"\x65bools\x82\xf5\xf4",
        b"\x65bytes\xd8\x48\x43\xff\x00\x7f",
        b"\x64pair\xd8\x4d\x44\xfe\xff\x2c\x01",
        b"\x65words\xd8\x46\x48\0\0\0\0\xff\xff\xff\xff",
        b"\x65longs\xd8\x4f\x48\0\0\0\0\0\0\0\x80",
        b"\x67singles\xd8\x55\x48\xcd\xcc\xcc\x3d\0\0\x40\xc0",
        b"\x66triple\xd8\x56\x58\x18",
        &0.5f64.to_le_bytes(),
        &1e300f64.to_le_bytes(),
        &(-0.0f64).to_le_bytes(),
        b"\x65texts\x82\x61a\x60",
        b"\x65chars\x44\x01\x02\x03\xff",
        b"\x65times\x81\xa2\x64secs\x05\x65nsecs\x06",
        b"\x69durations\x81\xa2\x64secs\x20\x65nsecs\x21",
        b"\x64none\x82\xa0\xa0",
    ]
    .concat();
    assert_eq!(cbor_of(&arrays, &arrays_bytes()), expected);
    assert_eq!(ros_of(&arrays, &expected).unwrap(), arrays_bytes());
    let mut plain = Vec::new();
    let options = CborOptions { typed_arrays: false, ..CborOptions::default() };
    to_cbor(&arrays, &arrays_bytes(), &mut plain, &options).unwrap();
    assert!(plain.windows(9).any(|part| part == b"\x65words\x82\x00\x1a"));
    assert_eq!(ros_of(&arrays, &plain).unwrap(), arrays_bytes());
}

#[test]
fn numbers_are_written_shortest() {
    let long = message("std_msgs/Int64");
    for (value, cbor) in [
        (0, &b"\x00"[..]),
        (23, b"\x17"),
        (24, b"\x18\x18"),
        (256, b"\x19\x01\x00"),
        (65536, b"\x1a\x00\x01\x00\x00"),
        (1 << 32, b"\x1b\0\0\0\x01\0\0\0\0"),
        (-1, b"\x20"),
        (-256, b"\x38\xff"),
        (i64::MIN, b"\x3b\x7f\xff\xff\xff\xff\xff\xff\xff"),
    ] {
        assert_eq!(cbor_of(&long, &value.to_le_bytes()), data(cbor));
        assert_eq!(ros_of(&long, &data(cbor)).unwrap(), value.to_le_bytes());
    }
}

#[test]
fn strings_in_chunks_and_containers_without_length() {
    let string = message("std_msgs/String");
    let expected = Bytes::default().text("strea").0;
    assert_eq!(ros_of(&string, b"\xbf\x64data\x7f\x63str\x62ea\xff\xff").unwrap(), expected);
    assert_eq!(ros_of(&string, b"\xbf\x7f\x62da\x62ta\xff\x65strea\xff").unwrap(), expected);
    assert_eq!(ros_of(&string, b"\xd9\xd9\xf7\xa1\x64data\x65strea").unwrap(), expected);
    let arrays = message("t/Arrays");
    let listed = ros_of(&arrays, b"\xa1\x65words\x9f\x01\x18\x20\xff").unwrap();
    assert_eq!(listed, ros_of(&arrays, b"\xa1\x65words\x82\x01\x18\x20").unwrap());
    assert_eq!(listed, ros_of(&arrays, b"\xa1\x65words\xd8\x46\x5f\x44\x01\0\0\0\x44\x20\0\0\0\xff").unwrap());
    assert_eq!(
        ros_of(&string, b"\xa1\x64data\x62\xff\xff").unwrap_err(),
        "field data of std_msgs/String: the text is not UTF-8"
    );
}

#[test]
fn typed_arrays_of_every_width_and_order() {
    let arrays = message("t/Arrays");
    let list = |field: &str, value: &[u8]| {
        let key = [&[0xa1, 0x60 | field.len() as u8], field.as_bytes(), value].concat();
        ros_of(&arrays, &key)
    };
    for (tag, bytes) in [
        (64, &b"\x42\x01\x02"[..]),
        (65, b"\x44\0\x01\0\x02"),
        (66, b"\x48\0\0\0\x01\0\0\0\x02"),
        (67, b"\x50\0\0\0\0\0\0\0\x01\0\0\0\0\0\0\0\x02"),
        (68, b"\x42\x01\x02"),
        (69, b"\x44\x01\0\x02\0"),
        (71, b"\x50\x01\0\0\0\0\0\0\0\x02\0\0\0\0\0\0\0"),
        (72, b"\x42\x01\x02"),
        (73, b"\x44\0\x01\0\x02"),
        (77, b"\x44\x01\0\x02\0"),
        (80, b"\x44\x3c\x00\x40\x00"),
        (81, b"\x48\x3f\x80\0\0\x40\0\0\0"),
        (84, b"\x44\x00\x3c\x00\x40"),
        (86, b"\x50\0\0\0\0\0\0\xf0\x3f\0\0\0\0\0\0\0\x40"),
    ] {
        let value = [&[0xd8, tag], bytes].concat();
        assert_eq!(list("words", &value).unwrap(), list("words", b"\x82\x01\x02").unwrap(), "tag {tag}");
        assert_eq!(list("singles", &value).unwrap(), list("singles", b"\x82\x01\x02").unwrap(), "tag {tag}");
        assert_eq!(list("bytes", &value).unwrap(), list("bytes", b"\x82\x01\x02").unwrap(), "tag {tag}");
    }
    assert_eq!(
        list("bytes", b"\xd8\x4d\x44\x01\0\0\x01").unwrap_err(),
        "field bytes[1] of t/Arrays: 256 does not fit into int8"
    );
    assert_eq!(
        list("words", b"\xd8\x48\x41\xff").unwrap_err(),
        "field words[0] of t/Arrays: -1 does not fit into uint32"
    );
    assert_eq!(
        list("words", b"\xd8\x56\x48\0\0\0\0\0\0\xf8\x3f").unwrap_err(),
        "field words[0] of t/Arrays: takes uint32, got a number with a fraction"
    );
    assert_eq!(
        list("pair", b"\xd8\x4d\x42\x01\0").unwrap_err(),
        "field pair of t/Arrays: takes exactly 2 elements, got 1"
    );
    assert!(list("words", b"\xd8\x46\x43\x01\0\0").unwrap_err().contains("not a multiple of its element"));
    assert!(list("words", b"\xd8\x46\x82\x01\x02").unwrap_err().contains("not a byte string"));
    assert!(list("words", b"\xd8\x57\x50").unwrap_err().contains("takes a list of uint32"));
}

#[test]
fn floats_of_every_width() {
    let double = message("std_msgs/Float64");
    for (cbor, value) in [
        (&b"\xf9\x3c\x00"[..], 1.0),
        (b"\xf9\xc4\x00", -4.0),
        (b"\xf9\x00\x01", 5.960464477539063e-8),
        (b"\xf9\x04\x00", 0.00006103515625),
        (b"\xf9\x7b\xff", 65504.0),
        (b"\xf9\x7c\x00", f64::INFINITY),
        (b"\xf9\xfc\x00", f64::NEG_INFINITY),
        (b"\xfa\x47\xc3\x50\x00", 100000.0),
        (b"\xfb\x3f\xf1\x99\x99\x99\x99\x99\x9a", 1.1),
        (b"\x20", -1.0),
        (b"\x1b\xff\xff\xff\xff\xff\xff\xff\xff", u64::MAX as f64),
        (b"\x3b\xff\xff\xff\xff\xff\xff\xff\xff", -(2f64.powi(64))),
        (b"\xc1\x05", 5.0),
    ] {
        assert_eq!(ros_of(&double, &data(cbor)).unwrap(), value.to_le_bytes(), "{value}");
    }
    for cbor in [&b"\xf9\x7e\x00"[..], b"\xf6", b"\xf7"] {
        let bytes = ros_of(&double, &data(cbor)).unwrap();
        assert!(f64::from_le_bytes(bytes.try_into().unwrap()).is_nan());
    }
}

#[test]
fn order_defaults_and_stamps_are_as_in_json() {
    let pose = message("geometry_msgs/PoseStamped");
    let now = FillOptions { now: Some(Time { secs: 1, nsecs: 2 }), ..FillOptions::default() };
    let mut out = Vec::new();
    from_cbor(&pose, b"\xa2\x64pose\xa1\x68position\xa1\x61z\x03\x66header\xa1\x63seq\x07", &mut out, &now).unwrap();
    let expected = Bytes::default().u32(7).u32(1).u32(2).u32(0).f64(0.0).f64(0.0).f64(3.0).raw(&[0; 32]).0;
    assert_eq!(out, expected);
    out.clear();
    from_cbor(&message("std_msgs/Time"), &data(b"\x63now"), &mut out, &now).unwrap();
    assert_eq!(out, Bytes::default().u32(1).u32(2).0);
}

#[test]
fn bytes_may_come_as_text_or_numbers_too() {
    let image = message("sensor_msgs/Image");
    let expected = ros_of(&image, b"\xa1\x64data\x43\x01\x02\x03").unwrap();
    for form in [&b"\x64AQID"[..], b"\x83\x01\x02\x03", b"\x5f\x41\x01\x42\x02\x03\xff", b"\xd8\x40\x43\x01\x02\x03"] {
        assert_eq!(ros_of(&image, &data(form)).unwrap(), expected);
    }
}

#[test]
fn strings_that_are_not_utf8_are_replaced() {
    let string = message("std_msgs/String");
    let bytes = Bytes::default().u32(2).raw(b"a\xff").0;
    assert_eq!(cbor_of(&string, &bytes), data("\x64a\u{fffd}".as_bytes()));
    let options = CborOptions { invalid_utf8: InvalidUtf8::Refuse, ..CborOptions::default() };
    assert!(to_cbor(&string, &bytes, &mut Vec::new(), &options).is_err());
}
