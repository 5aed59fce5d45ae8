use super::*;

fn definitions_of(registry: &Registry, version: RosVersion) -> Definitions<'_> {
    Definitions { version, registry }
}

fn types(answer: &Value) -> Vec<&str> {
    let defs = answer["typedefs"].as_array().unwrap();
    defs.iter().map(|def| def["type"].as_str().unwrap()).collect()
}

#[test]
fn a_type_is_described_with_all_it_contains() {
    let registry = Registry::new();
    registry.insert("x/msg/Pair", "uint8 ONE=1\nHeader header\nfloat64[2] both\nInner[] more\nbool ok\n").unwrap();
    registry.insert("x/msg/Inner", "duration wait\nstring name\n").unwrap();
    let one = definitions_of(&registry, RosVersion::One);
    let answer = one.message("x/msg/Pair").unwrap();
    assert_eq!(types(&answer), ["x/Pair", "std_msgs/Header", "time", "x/Inner", "duration"]);
    assert_eq!(
        answer["typedefs"][0],
        json!({
            "type": "x/Pair",
            "fieldnames": ["header", "both", "more", "ok"],
            "fieldtypes": ["std_msgs/Header", "float64", "x/Inner", "bool"],
            "fieldarraylen": [-1, 2, 0, -1],
            "examples": ["{}", "[]", "[]", "False"],
            "constnames": ["ONE"],
            "constvalues": ["1"],
        })
    );
    let unknown = one.message("x/Nothing").unwrap_err().to_string();
    assert!(unknown.contains("no definition of x/Nothing is known"));
    assert_eq!(one.message("time").unwrap()["typedefs"][0]["fieldnames"], json!(["secs", "nsecs"]));
}

#[test]
fn in_ros_2_types_have_the_names_of_idl_and_their_defaults() {
    let registry = Registry::for_version(RosVersion::Two);
    registry
        .insert(
            "x/msg/Pair",
            "uint8 ONE=1\nstd_msgs/Header header\nfloat64[2] both\nInner[] more\nbool ok true\nbyte b 7\n\
             float32 half 0.5\nstring name \"it\"\nint32 n\n",
        )
        .unwrap();
    registry.insert("x/msg/Inner", "builtin_interfaces/Duration wait\n").unwrap();
    let two = definitions_of(&registry, RosVersion::Two);
    for name in ["x/msg/Pair", "x/Pair"] {
        let answer = two.message(name).unwrap();
        assert_eq!(
            types(&answer),
            ["x/Pair", "std_msgs/Header", "builtin_interfaces/Time", "x/Inner", "builtin_interfaces/Duration"]
        );
        assert_eq!(
            answer["typedefs"][0],
            json!({
                "type": "x/Pair",
                "fieldnames": ["header", "both", "more", "ok", "b", "half", "name", "n"],
                "fieldtypes": ["std_msgs/Header", "double", "x/Inner", "boolean", "octet", "float", "string", "int32"],
                "fieldarraylen": [-1, 2, 0, -1, -1, -1, -1, -1],
                "examples": ["{}", "[]", "[]", "True", "7", "0.5", "it", "0"],
                "constnames": ["ONE"],
                "constvalues": ["1"],
            })
        );
        assert_eq!(answer["typedefs"][2]["fieldnames"], json!(["sec", "nanosec"]));
    }
    assert_eq!(two.message("double").unwrap(), json!({"typedefs": []}));
    let time = two.message("time").unwrap_err().to_string();
    assert!(time.contains("\"time\""), "{time}");
}

#[test]
fn services_are_described_by_halves() {
    for version in [RosVersion::One, RosVersion::Two] {
        let registry = Registry::for_version(version);
        registry.insert("x/srv/Add", "int64 a\nint64 b\n---\nint64 sum\n").unwrap();
        let definitions = definitions_of(&registry, version);
        for name in ["x/Add", "x/srv/Add"] {
            let asked = definitions.request(name).unwrap();
            let expected = match version {
                RosVersion::One => "x/AddRequest",
                RosVersion::Two => "x/Add_Request",
            };
            assert_eq!(asked["typedefs"][0]["type"], expected);
            assert_eq!(asked["typedefs"][0]["fieldnames"], json!(["a", "b"]));
            // It can be queried by that name, too.
            assert_eq!(definitions.message(expected).unwrap(), asked);
            assert_eq!(definitions.response(name).unwrap()["typedefs"][0]["fieldnames"], json!(["sum"]));
        }
    }
    let registry = Registry::new();
    let own = definitions_of(&registry, RosVersion::One).response("rosapi/Topics");
    assert_eq!(own.unwrap()["typedefs"][0]["fieldnames"], json!(["topics", "types"]));
    let registry = Registry::for_version(RosVersion::Two);
    let own = definitions_of(&registry, RosVersion::Two).response("rosapi_msgs/srv/Topics");
    assert_eq!(own.unwrap()["typedefs"][0]["fieldnames"], json!(["topics", "types"]));
}

#[test]
fn actions_are_described_by_their_parts() {
    for version in [RosVersion::One, RosVersion::Two] {
        let registry = Registry::for_version(version);
        registry.insert("x/action/Count", "int32 to\n---\nint32[] all\n---\nint32 at\n").unwrap();
        let definitions = definitions_of(&registry, version);
        let parts: [(ActionPart, &str); 3] =
            [(|action| &action.goal, "to"), (|action| &action.result, "all"), (|action| &action.feedback, "at")];
        for (part, field) in parts {
            for name in ["x/Count", "x/action/Count"] {
                let told = definitions.action_part(name, part).unwrap();
                assert_eq!(told["typedefs"][0]["fieldnames"], json!([field]));
            }
        }
        let unknown = definitions.action_part("x/Lost", parts[0].0);
        let unknown = unknown.unwrap_err().to_string();
        assert!(unknown.contains("Lost is known here"), "{unknown}");
    }
}
