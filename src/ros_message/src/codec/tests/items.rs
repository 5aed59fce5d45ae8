use super::*;

#[test]
fn the_end_of_a_json_value_is_found() {
    for (text, value) in [
        ("1,", "1"),
        (" -1.5e3}", " -1.5e3"),
        ("null", "null"),
        ("true ]", "true"),
        (r#""a\"b\\",x"#, r#""a\"b\\""#),
        (r#"{"a":[1,{"b":"]}"}],"c":"\\"}, "more""#, r#"{"a":[1,{"b":"]}"}],"c":"\\"}"#),
        ("\n[ ]]", "\n[ ]"),
        ("{}{}", "{}"),
    ] {
        assert_eq!(json_value_len(text.as_bytes()).map(|length| &text[..length]), Ok(value));
    }
    for text in ["", "  ", "[", "{\"a\"", "\"a", "\"a\\", "]", ",", ":1", "\"\\\""] {
        assert!(json_value_len(text.as_bytes()).is_err(), "{text}");
    }
    let deep = "[".repeat(1_000_000);
    assert_eq!(json_value_len(deep.as_bytes()).unwrap_err().to_string(), "nested deeper than 128 levels");
    let allowed = "[".repeat(128) + &"]".repeat(128);
    assert_eq!(json_value_len(allowed.as_bytes()), Ok(256));
}

#[test]
fn the_end_of_a_cbor_item_is_found() {
    for item in [
        &b"\x00"[..],
        b"\x18\x20",
        b"\x3b\0\0\0\0\0\0\0\0",
        b"\x42ab",
        b"\x5f\x41a\x40\xff",
        b"\x7f\xff",
        b"\x80",
        b"\xa0",
        b"\x83\x01\x82\x02\x03\x04",
        b"\xa1\x61a\xa1\x61b\x80",
        b"\x9f\x01\x9f\xff\xff",
        b"\xbf\x61a\x01\x61b\xbf\xff\xff",
        b"\xc1\xc2\x01",
        b"\xd8\x40\x42ab",
        b"\xf4",
        b"\xf8\xff",
        b"\xf9\0\0",
        b"\xfb\0\0\0\0\0\0\0\0",
    ] {
        let followed = [item, b"\x01\x02"].concat();
        assert_eq!(cbor_item_len(&followed), Ok(item.len()), "{item:x?}");
        for end in 0..item.len() {
            assert!(cbor_item_len(&item[..end]).is_err(), "{item:x?} up to {end}");
        }
    }
    for item in [
        &b"\xff"[..],
        b"\x1c",
        b"\x1f",
        b"\xdf\x01",
        b"\x5f\x61a\xff",
        b"\x5f\x5f\xff\xff",
        b"\x81\xff",
        b"\xbf\x61a\xff",
        b"\xc1\xff",
        b"\x9b\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\xbb\xff\xff\xff\xff\xff\xff\xff\xff\x01",
        b"\x5b\xff\xff\xff\xff\xff\xff\xff\xff",
    ] {
        assert!(cbor_item_len(item).is_err(), "{item:x?}");
    }
    for nesting in [b"\x81", b"\x9f", b"\xc1", b"\xbf"] {
        let error = cbor_item_len(&nesting.repeat(100_000)).unwrap_err();
        let expected = if nesting == b"\xbf" { "invalid" } else { "nested deeper than 128 levels" };
        assert!(error.to_string().starts_with(expected) || nesting == b"\xbf", "{error}");
    }
}
