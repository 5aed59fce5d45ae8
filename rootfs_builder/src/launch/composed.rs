//! Tests of plans with components.

use serde_json::{Value, json};

use super::ros2_tests::{Ros2Fixture, argv, evaluate};
use super::*;

/// Recorded output of the scripts for a launch file with two containers, with launch_ros 0.26. Of the components of the
/// first container one is loaded by a separate action before it, and one has a condition that is false; the second
/// container is in a group.
const RECORDED_CONTAINERS: &[u8] = include_bytes!("composed.json");

fn parse_plan(text: &[u8]) -> LaunchAnswer {
    let answer = parse_reply(text, Version::Ros2).expect("a plan");
    plan::check_plan(&answer).expect("a plan that the script could have written");
    answer
}

fn value(component: &Component, name: &str) -> Value {
    let mut all = component.parameters.iter();
    let found = all.find(|parameter| parameter["name"] == name);
    found.map(|it| it["value"].clone()).unwrap_or_default()
}

#[test]
fn a_plan_says_what_is_loaded_into_which_container() {
    let answer = parse_plan(RECORDED_CONTAINERS);
    let nodes: Vec<&str> = answer.nodes.iter().map(|node| &*node.name).collect();
    assert_eq!(nodes, ["/box", "/deep/two"]);
    let [listener, talker] = &answer.components["/box"][..] else { panic!("two nodes: {:?}", answer.components) };
    assert_eq!((&*listener.plugin, listener.full_name()), ("composition::Listener", None), "it names itself");
    assert_eq!(talker.package, "composition");
    assert_eq!(talker.full_name().as_deref(), Some("/inner/talker"));
    assert_eq!(talker.remap_rules, ["chatter:=/said"]);
    for (name, expected) in [
        ("rate", json!({"type": 3, "double_value": 2.0})),
        ("gains.p", json!({"type": 2, "integer_value": 3})),
        ("everybody", json!({"type": 7, "integer_array_value": [1, 2]})),
        ("blob", json!({"type": 8, "double_array_value": [0.5, "Infinity"]})),
        ("own", json!({"type": 4, "string_value": "text"})),
        ("other", Value::Null),
    ] {
        assert_eq!(value(talker, name), expected, "{name}");
    }
    let expected = json!({"name": "use_intra_process_comms", "value": {"type": 1, "bool_value": true}});
    assert_eq!(talker.extra_arguments, [expected]);
    let server = &answer.components["/deep/two"][0];
    assert_eq!(server.full_name().as_deref(), Some("/deep/server"));
    assert_eq!(server.remap_rules, ["a:=b"]);
}

#[test]
fn what_is_loaded_must_be_defined_in_the_image() {
    let answer = parse_plan(RECORDED_CONTAINERS);
    let mut definitions = Definitions::new();
    let refused = check_composition(&answer.components, &definitions).expect_err("no definition");
    let words = refused.to_string();
    assert!(
        words.contains("into /box with composition_interfaces/srv/LoadNode")
            && words.contains("--with composition_interfaces"),
        "{words}"
    );
    for service in composition::SERVICES {
        definitions.insert(service.to_owned(), "---\n".to_owned());
    }
    check_composition(&answer.components, &definitions).expect("defined");
    check_composition(&BTreeMap::new(), &Definitions::new()).expect("nothing is loaded");
}

/// Creates a package that has registered these classes.
fn register_classes(lab: &Ros2Fixture, classes: &[&str]) {
    let lines = classes.iter().map(|class| format!("{class};lib/libtalk.so\n"));
    let index = "space/share/ament_index/resource_index/rclcpp_components/talk";
    lab.write(index, &lines.collect::<String>(), 0o644);
}

#[test]
fn a_class_that_is_named_gets_a_container_of_its_own() {
    let lab = Ros2Fixture::new();
    lab.package("base", "rclcpp_components", &["component_container"]);
    lab.package("space", "talk", &[]);
    register_classes(&lab, &["talk::Talker", "talk::Listener"]);
    let asked = [
        "talk::Talker chatter:=said -p rate:=2.5 -p 'names:=[a, b]' __node:=one __ns:=/below",
        "talk/talk::Listener",
        "talk::Talker --ros-args -r __node:=two --",
    ];
    let mut ask = lab.query("space", &asked);
    ask.remaps = [("in".to_owned(), "out".to_owned())].into();
    ask.params = [
        ("rate", json!(7)),
        ("/loud", json!(true)),
        ("/below/one/gains/p", json!(1)),
        ("/two/gains", json!({"p": 2})),
        ("/three/gains/p", json!(3)),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into();
    let answer = lab.ask(&ask).expect("a plan");
    let names: Vec<&str> = answer.nodes.iter().map(|node| &*node.name).collect();
    assert_eq!(names, ["/Talker_container", "/Listener_container", "/Talker_container_2"]);
    assert!(answer.nodes.iter().all(|node| node.named));
    assert_eq!(
        answer.nodes[0].argv[0],
        lab.path("base/lib/rclcpp_components/component_container").display().to_string()
    );
    assert_eq!(argv(&answer, 0)[..3], ["--ros-args", "-r", "__node:=Talker_container"]);
    let of = |container: &str| &answer.components[container][0];
    let one = of("/Talker_container");
    assert_eq!((&*one.package, &*one.plugin, one.full_name().as_deref()), ("talk", "talk::Talker", Some("/below/one")));
    assert_eq!(one.remap_rules, ["chatter:=said", "in:=out"]);
    let integer = |value: i64| json!({"type": 2, "integer_value": value});
    // Settings of the push for all nodes take precedence over those after the class.
    assert_eq!(value(one, "rate"), integer(7));
    assert_eq!(value(one, "names"), json!({"type": 9, "string_array_value": ["a", "b"]}));
    assert_eq!(value(one, "loud"), json!({"type": 1, "bool_value": true}));
    assert_eq!(value(one, "gains.p"), integer(1));
    assert_eq!(value(of("/Talker_container_2"), "gains.p"), integer(2));
    let listener = of("/Listener_container");
    assert_eq!(listener.full_name(), None);
    assert_eq!(value(listener, "gains.p"), Value::Null);

    // The only class is used if there is no executable.
    register_classes(&lab, &["talk::Talker"]);
    let answer = lab.ask(&lab.query("space", &[])).expect("a plan");
    assert_eq!(answer.components["/Talker_container"][0].plugin, "talk::Talker");
}

#[test]
fn a_class_that_cannot_be_loaded_is_refused_with_what_can() {
    let lab = Ros2Fixture::new();
    lab.package("space", "talk", &["talker"]);
    register_classes(&lab, &["talk::Talker", "talk::Listener"]);
    let refused = |node: &str| {
        let error = lab.ask(&lab.query("space", &[node])).expect_err("refused");
        error.to_string()
    };
    let text = refused("talk::Talker");
    assert!(text.contains("talk::Talker is loaded into") && text.contains("--with rclcpp_components"), "{text}");
    lab.package("base", "rclcpp_components", &["component_container"]);
    let text = refused("talk::Walker");
    assert!(
        text.contains("no executable \"talk::Walker\"") && text.contains("talker, talk::Talker, talk::Listener"),
        "{text}"
    );
    let text = refused("talk::Talker --loud");
    assert!(text.contains("no argument '--loud'"), "{text}");
    let text = refused("talk::Talker -p list:=[]");
    assert!(text.contains("parameter list of a component"), "{text}");
}

#[test]
fn values_of_requests_become_json() {
    let lab = Ros2Fixture::new();
    for (value, expected) in [
        ("float('inf')", "Infinity"),
        ("[1.5, float('nan')]", "[1.5, 'NaN']"),
        ("[b'\\x01', b'\\xff']", "[1, 255]"),
        ("True", "True"),
    ] {
        assert_eq!(evaluate(&lab, &format!("components.plain({value})")), expected);
    }
    for (value, expected) in [
        ("True", "1"),
        ("7", "2"),
        ("[1, 2.5]", "8"),
        ("['a']", "9"),
        ("[True]", "6"),
        ("[1, 'a']", "None"),
        ("[]", "None"),
        ("{}", "None"),
    ] {
        assert_eq!(evaluate(&lab, &format!("components.kind_of({value})")), expected, "{value}");
    }
}
