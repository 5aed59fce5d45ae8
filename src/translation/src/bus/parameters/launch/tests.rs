use super::*;

fn words(line: &str) -> Vec<String> {
    line.split_whitespace().map(str::to_owned).collect()
}

fn tree(json: &str) -> Tree {
    serde_json::from_str(json).expect(json)
}

/// Returns what a node of ROS 2 is started with, without knowledge of its parameters.
fn ros2(line: &str, private: &str, simulated: Option<bool>) -> TranslatedLaunch {
    for_ros2(&words(line), &tree(private), simulated, &BTreeMap::new())
}

#[test]
fn private_parameters_of_the_master_come_before_those_of_the_command_line() {
    let launch = ros2(
        "3 --ros-args -r scan:=/front -p gain:=2.5 --",
        r#"{"gain": 1, "frame": "map", "gains": {"p": 0.5, "names": ["a", "b"]}, "use_sim_time": false}"#,
        Some(true),
    );
    let expected = "--ros-args -p frame:=\"map\" -p gain:=1 -p gains.names:=[\"a\", \"b\"] -p gains.p:=0.5 \
                    -p use_sim_time:=true -- 3 --ros-args -r scan:=/front -p gain:=2.5 --";
    assert_eq!(launch.argv.join(" "), expected);
    assert_eq!((launch.parameters.len(), launch.left_out.describe("/see")), (0, None));
    // What is understood by rcl, too.
    assert!(arguments::parse(&launch.argv).is_ok());
    assert_eq!(ros2("3 --fast", "{}", None).argv, ["3", "--fast"]);
}

#[test]
fn values_get_the_type_of_the_nodes_parameter_where_it_is_known() {
    let kinds = [
        ("gain", ParameterKind::Double),
        ("count", ParameterKind::Integer),
        ("name", ParameterKind::String),
        ("many", ParameterKind::Doubles),
        ("half", ParameterKind::Integer),
        ("gains.p", ParameterKind::Double),
    ];
    let kinds = kinds.map(|(name, kind)| (name.to_owned(), kind)).into();
    let private = tree(r#"{"gain": 1, "count": 2.0, "many": [1, 2], "half": 0.5, "other": 1}"#);
    let argv = words("--ros-args -p name:=5 -p gain:=2 --param gains.p:=3 -p other:=1 -p see:count:=4.0 -p name:=x --");
    let launch = for_ros2(&argv, &private, None, &kinds);
    assert_eq!(
        launch.argv.join(" "),
        "--ros-args -p count:=2 -p gain:=1.0 -p half:=0.5 -p many:=[1.0, 2.0] -p other:=1 -- --ros-args \
         -p name:=\"5\" -p gain:=2.0 --param gains.p:=3.0 -p other:=1 -p see:count:=4 -p name:=x --"
    );
}

#[test]
fn what_ros_2_cannot_be_told_is_left_out_in_words() {
    let long = format!(r#"{{"long": "{}"}}"#, "x".repeat(MAX_ARGUMENT));
    for (private, said) in [
        (r#"{"a": [[1]]}"#, "a: a list of lists cannot be a ROS 2 parameter"),
        (r#"{"a": [{"x": 1}]}"#, "a: a list of dictionaries"),
        (r#"{"none": []}"#, "none: an empty list does not say"),
        (r#"{"0": 1}"#, "0: \"0\" cannot be the name"),
        (&*long, "long: it takes 102408 bytes"),
    ] {
        let launch = ros2("", private, None);
        assert!(launch.argv.is_empty(), "{:?}", launch.argv);
        let text = launch.left_out.describe("/see").expect("something");
        assert!(text.starts_with("/see is not given these parameters in the cloud: ") && text.contains(said), "{text}");
        assert!(text.len() < 600, "{text}");
    }
    let bytes = Tree::from([("bytes".to_owned(), ParamValue::Binary(vec![1]))]);
    let launch = for_ros2(&[], &bytes, None, &BTreeMap::new());
    assert!(launch.left_out.describe("/see").expect("something").contains("bytes cannot be given"));
}

#[test]
fn a_robot_with_endless_parameters_does_not_fill_the_command_line() {
    let many: Tree = (0..3000).map(|number| (format!("p{number}"), ParamValue::Int(number))).collect();
    let launch = for_ros2(&[], &many, None, &BTreeMap::new());
    assert_eq!(launch.argv.len(), 2 + 2 * MAX_PARAMETERS.1);
    let text = launch.left_out.describe("/see").expect("something");
    assert!(text.ends_with(&format!("; and {} more", 1000 - MAX_OMISSIONS)), "{text}");
    let wide: Tree = (0..100).map(|number| (format!("p{number}"), ParamValue::String("x".repeat(50_000)))).collect();
    let launch = for_ros2(&[], &wide, None, &BTreeMap::new());
    let bytes: usize = launch.argv.iter().map(String::len).sum();
    assert!(bytes < MAX_PARAMETERS.0 + 1000 && bytes > MAX_PARAMETERS.0 / 2, "{bytes}");
}

#[test]
fn parameters_of_the_command_line_stand_at_the_master_in_ros_1() {
    let argv: Vec<String> = ["3", "scan:=/front", "_gain:=1", "_gains/p:=0.5", "_gain:=2.0", "_flag:=on", "__log:=/x"]
        .into_iter()
        .chain(["_names:=[a, b]", "_text:=\"5\"", "_none:=", "_wide:=3000000000", "_gains/i:={x: 1}", "_odd", "-v"])
        .map(str::to_owned)
        .collect();
    let launch = for_ros1("/camera/see", &argv);
    assert_eq!(launch.argv, ["3", "scan:=/front", "__log:=/x", "_odd", "-v"]);
    let text = |text: &str| ParamValue::String(text.to_owned());
    let expected = [
        ("/camera/see/flag", ParamValue::Bool(true)),
        ("/camera/see/gain", ParamValue::Double(2.0)),
        ("/camera/see/gains/i", text("{x: 1}")),
        ("/camera/see/gains/p", ParamValue::Double(0.5)),
        ("/camera/see/names", ParamValue::List(vec![text("a"), text("b")])),
        ("/camera/see/none", text("")),
        ("/camera/see/text", text("5")),
    ];
    assert_eq!(launch.parameters, expected.map(|(key, value)| (key.to_owned(), value)));
    let said = launch.left_out.describe("/camera/see").expect("something");
    assert!(said.contains("wide: 3000000000 does not fit into the 32 bits"), "{said}");
}
