use crate::codec::default_json;
use crate::schema::{InterfaceFile, SchemaError};

/// An excerpt of a description by rosidl.
const IMAGE: &str = r#"{"type_description_msg": {
    "type_description": {"type_name": "a/msg/A", "fields": [
        {"name": "header", "type": {"type_id": 1, "capacity": 0, "string_capacity": 0, "nested_type_name": "std_msgs/msg/Header"}, "default_value": ""},
        {"name": "data", "type": {"type_id": 147, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}, "default_value": "(1, 2)"},
        {"name": "text", "type": {"type_id": 21, "capacity": 0, "string_capacity": 9, "nested_type_name": ""}, "default_value": "it's \"so\""},
        {"name": "raw", "type": {"type_id": 64, "capacity": 2, "string_capacity": 0, "nested_type_name": ""}, "default_value": ""},
        {"name": "few", "type": {"type_id": 113, "capacity": 3, "string_capacity": 0, "nested_type_name": ""}, "default_value": "('a', 'b, c')"}
    ]},
    "referenced_type_descriptions": [
        {"type_name": "std_msgs/msg/Header", "fields": [
            {"name": "stamp", "type": {"type_id": 1, "capacity": 0, "string_capacity": 0, "nested_type_name": "builtin_interfaces/msg/Time"}},
            {"name": "frame_id", "type": {"type_id": 17, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}
        ]},
        {"type_name": "b/msg/Nothing", "fields": [
            {"name": "structure_needs_at_least_one_member", "type": {"type_id": 3, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}
        ]}
    ]},
    "type_hashes": [{"type_name": "a/msg/A", "hash_string": "RIHS01_00"}]
}"#;

#[test]
fn a_description_is_read_as_definitions() {
    let file = InterfaceFile::read_description("a/msg/A", IMAGE).unwrap();
    let expected = [
        (
            "a/msg/A",
            "std_msgs/msg/Header header\nuint8[] data [1, 2]\nstring<=9 text \"it's \\\"so\\\"\"\nbyte[2] raw\n\
             string[<=3] few ['a', 'b, c']\n",
        ),
        ("b/msg/Nothing", ""),
        ("std_msgs/msg/Header", "builtin_interfaces/msg/Time stamp\nstring frame_id\n"),
    ];
    let expected = expected.map(|(key, text)| (key.to_owned(), text.to_owned()));
    assert_eq!(file.definitions, expected.into());
    assert_eq!(file.hashes["a/msg/A"], "RIHS01_00");
    let message = file.registry().unwrap().message("a/A").unwrap();
    assert!(message.has_header());
    assert_eq!(
        default_json(&message),
        r#"{"header":{"stamp":{"sec":0,"nanosec":0},"frame_id":""},"data":"AQI=","text":"it's \"so\"","raw":"AAA=","few":["a","b, c"]}"#
    );
}

const MESSAGE: &str = r#"// a comment
#include "b/msg/B.idl"
/* another
   one */
module a {
  module msg {
    typedef double double__3[3];
    typedef b::msg::B B__2[2];
    module A_Constants {
      @verbatim (language="comment", text="with" "\n" "lines")
      const int8 LOW = -2;
      const string<3> NAME = "a\"b";
      const double HALF = 5.0e-1;
    };
    @verbatim (language="comment", text="what it is")
    struct A {
      @key @default (value=TRUE)
      boolean on;
      double__3 three;
      B__2 two;
      @default (value="(1, 2)")
      sequence<unsigned long long, 4> some;
      @default (value="say \"ah\"")
      @unit (value="m")
      string<20> word;
      wstring wide;
      sequence<string<5>> texts;
      long plain[2];
      Other other;
      octet raw;
    };
  };
};
"#;

#[test]
fn idl_is_read_as_definitions() {
    let file = InterfaceFile::read_idl("a/msg/A", MESSAGE).unwrap();
    assert_eq!(
        file.definitions["a/msg/A"],
        "int8 LOW = -2\nstring NAME = \"a\\\"b\"\nfloat64 HALF = 5.0e-1\nbool on TRUE\nfloat64[3] three\nb/msg/B[2] \
         two\n\
         uint64[<=4] some [1, 2]\nstring<=20 word \"say \\\"ah\\\"\"\nwstring wide\nstring<=5[] texts\nint32[2] plain\n\
         a/msg/Other other\nbyte raw\n"
    );
    let registry = file.registry().unwrap();
    registry.insert("a/msg/Other", "int8 x 1").unwrap();
    registry.insert("b/msg/B", "").unwrap();
    let message = registry.message("a/A").unwrap();
    let constants = message.constants().iter().map(|it| &*it.value);
    assert_eq!(constants.collect::<Vec<_>>(), ["-2", "a\"b", "5.0e-1"]);
    assert_eq!(
        default_json(&message),
        r#"{"on":true,"three":[0.0,0.0,0.0],"two":[{},{}],"some":[1,2],"word":"say \"ah\"","wide":"","texts":[],"plain":[0,0],"other":{"x":1},"raw":0}"#
    );
}

#[test]
fn services_and_actions_are_put_together_of_their_parts() {
    let service = "module a { module srv {\n struct S_Request { uint8 structure_needs_at_least_one_member; };\n\
                   struct S_Response { boolean done; }; }; };";
    let file = InterfaceFile::read_idl("a/srv/S", service).unwrap();
    assert_eq!(file.definitions["a/srv/S"], "---\nbool done\n");
    let action = "module a { module action { struct F_Goal { long order; }; struct F_Result { }; struct F_Feedback { \
                  sequence<long> so_far; }; }; };";
    let file = InterfaceFile::read_idl("a/action/F", action).unwrap();
    assert_eq!(file.definitions["a/action/F"], "int32 order\n---\n---\nint32[] so_far\n");
    file.registry().unwrap().action("a/F").unwrap();
    let missing = InterfaceFile::read_idl("a/action/G", action).unwrap_err();
    assert!(matches!(missing, SchemaError::Missing { name, .. } if name == "a/action/G_Goal"));
}

#[test]
fn files_that_are_no_interfaces_are_refused_with_the_line() {
    let inside = |members: &str| format!("module a {{ module msg {{\nstruct A {{\n{members} }}; }}; }};");
    for (idl, error) in [
        (inside("long double x;"), "line 3: messages have no long double"),
        (inside("char x;"), "line 3: messages have no char"),
        (inside("sequence<sequence<long>> x;"), "line 3: messages have no sequences of sequences"),
        (inside("long x"), "line 3: expected ;, got }"),
        (inside("long 😀;"), "line 3: expected a name, got 😀"),
        (inside("@default (value=\"a\nb"), "line 3: a text without a closing quote"),
        (inside("@default (value=\"a\\nb\") string x;"), "line 3: the value of x goes over a line"),
        ("module a {".to_owned(), "line 1: the text ends inside a module"),
        ("/* a".to_owned(), "line 1: a comment without an end"),
        ("interface a {".to_owned(), "line 1: interface does not begin a definition that messages can have"),
        ("module a { ".repeat(9), "line 1: modules nest deeper than 3"),
    ] {
        let found = InterfaceFile::read_idl("a/msg/A", &idl).unwrap_err();
        assert_eq!(found.to_string(), format!("a/msg/A {error}"), "{idl}");
    }
    // A short alias for a long name, used very often.
    let long = "x".repeat(200);
    let many = "T a;".repeat(9000);
    let idl = format!("module a {{ module msg {{ typedef b::{long}::{long} T;\nstruct A {{ {many} }}; }}; }};");
    let found = InterfaceFile::read_idl("a/msg/A", &idl).unwrap_err();
    assert_eq!(found.to_string(), "a/msg/A line 2: it defines more than 1048576 bytes");
    for (json, error) in [
        ("{}", "a/msg/A line 1: not a description of a type: missing field `type_description_msg` at line 1 column 2"),
        (
            &IMAGE.replace("\"type_id\": 21", "\"type_id\": 13"),
            "a/msg/A line 1: a/msg/A: field text is of type 13, which messages do not have",
        ),
        (
            &IMAGE.replace("\"name\": \"raw\"", "\"name\": \"raw\\nint8 x\""),
            "a/msg/A line 1: a/msg/A: \"raw\\nint8 x\" is not a legal name",
        ),
    ] {
        let found = InterfaceFile::read_description("a/msg/A", json).unwrap_err();
        assert_eq!(found.to_string(), error);
    }
}
