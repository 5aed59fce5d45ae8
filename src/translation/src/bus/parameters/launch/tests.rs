use super::*;

fn words(line: &str) -> Vec<String> {
    line.split_whitespace().map(str::to_owned).collect()
}

fn tree(json: &str) -> Tree {
    serde_json::from_str(json).expect(json)
}

/// Returns the command line in ROS 2.
fn ros2(line: &str, private: &str, simulated: Option<bool>) -> TranslatedLaunch {
    for_ros2(&words(line), &tree(private), simulated, &BTreeMap::new())
}

/// Returns the command line in ROS 1, and the parameters at the Master.
fn ros1(line: &str) -> (String, Vec<(String, ParamValue)>, LeftOutArguments) {
    let launch = for_ros1("/camera/see", &words(line)).expect(line);
    (launch.argv.join(" "), launch.parameters, launch.left_out)
}

#[test]
fn arguments_of_ros_1_are_said_as_ros_2_says_them() {
    let launch = ros2(
        "3 _gain:=2.5 scan:=/front ~out:=boxes --fast _names:=[a,b] _on:=on _text:= scan:=/rear __log:=/tmp/x",
        r#"{"gain": 1, "frame": "map", "gains": {"p": 0.5}}"#,
        Some(true),
    );
    let expected = "3 --fast --ros-args -r scan:=/rear -r ~/out:=boxes -r scan:=/front -p frame:=\"map\" \
         -p gain:=2.5 -p gains.p:=0.5 -p names:=[\"a\", \"b\"] -p on:=\"on\" -p text:=\"\" -p use_sim_time:=true";
    assert_eq!(launch.argv.join(" "), expected);
    assert_eq!((launch.parameters.len(), launch.left_out.describe("/see")), (0, None));
    // What is understood by rcl, too.
    assert!(arguments::parse(&launch.argv).is_ok());
    assert_eq!(ros2("3 --fast", "{}", None).argv, ["3", "--fast"]);
}

#[test]
fn private_parameters_of_the_command_line_override_those_of_the_master() {
    let launch = ros2("_gains/p:=2", r#"{"gains": {"p": 1, "i": 3}, "use_sim_time": true}"#, Some(false));
    assert_eq!(launch.argv.join(" "), "--ros-args -p gains.i:=3 -p gains.p:=2 -p use_sim_time:=false");
}

#[test]
fn values_get_the_type_of_the_nodes_parameter_where_it_is_known() {
    let kinds = [
        ("gain", ParameterKind::Double),
        ("count", ParameterKind::Integer),
        ("name", ParameterKind::String),
        ("many", ParameterKind::Doubles),
        ("half", ParameterKind::Integer),
    ];
    let kinds = kinds.map(|(name, kind)| (name.to_owned(), kind)).into();
    let private = tree(r#"{"gain": 1, "count": 2.0, "many": [1, 2], "half": 0.5}"#);
    let launch = for_ros2(&words("_name:=5"), &private, None, &kinds);
    assert_eq!(
        launch.argv.join(" "),
        "--ros-args -p count:=2 -p gain:=1.0 -p half:=0.5 -p many:=[1.0, 2.0] -p name:=\"5\""
    );
}

#[test]
fn what_ros_2_cannot_be_told_is_left_out_in_words() {
    let long = format!(r#"{{"long": "{}"}}"#, "x".repeat(MAX_ARGUMENT));
    for (line, private, said) in [
        ("", r#"{"a": [[1]]}"#, "parameter a: a list of lists cannot be a ROS 2 parameter"),
        (r#"_a:=[{"x":1}]"#, "{}", "parameter a: a list of dictionaries"),
        ("", r#"{"none": []}"#, "parameter none: an empty list does not say"),
        ("", r#"{"0": 1}"#, "parameter 0: \"0\" cannot be the name"),
        ("", &*long, "parameter long: it takes 102408 bytes"),
        ("a%b:=c", "{}", "a%b:=c: it is not a rule"),
        ("a:=", "{}", "a:=: it is not a rule"),
    ] {
        let launch = ros2(line, private, None);
        assert!(launch.argv.is_empty(), "{:?}", launch.argv);
        let text = launch.left_out.describe("/see").expect("something");
        assert!(text.starts_with("/see runs in the other ROS and is not given ") && text.contains(said), "{text}");
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
    assert_eq!(launch.argv.len(), 1 + 2 * MAX_PARAMETERS.1);
    let text = launch.left_out.describe("/see").expect("something");
    assert!(text.ends_with(&format!("; and {} more", 1000 - MAX_LEFT_OUT)), "{text}");
    let wide: Tree = (0..100).map(|number| (format!("p{number}"), ParamValue::String("x".repeat(50_000)))).collect();
    let launch = for_ros2(&[], &wide, None, &BTreeMap::new());
    let bytes: usize = launch.argv.iter().map(String::len).sum();
    assert!(bytes < MAX_PARAMETERS.0 + 1000 && bytes > MAX_PARAMETERS.0 / 2, "{bytes}");
}

#[test]
fn parameters_of_ros_2_stand_at_the_master_before_the_node_starts() {
    let (argv, parameters, left_out) = ros1(
        "3 --ros-args -r __node:=see -r __ns:=/camera -r scan:=/front -r ~/out:=boxes -r scan:=/rear -p gain:=1 \
         -p gains.p:=0.5 -p gain:=2.0 -p see:name:=x -p flag:=on -p names:=[a,b] -p use_sim_time:=true -- --fast",
    );
    assert_eq!(argv, "3 --fast scan:=/front ~out:=boxes");
    let text = |text: &str| ParamValue::String(text.to_owned());
    let expected = [
        ("/camera/see/flag", ParamValue::Bool(true)),
        ("/camera/see/gain", ParamValue::Double(2.0)),
        ("/camera/see/gains/p", ParamValue::Double(0.5)),
        ("/camera/see/names", ParamValue::List(vec![text("a"), text("b")])),
        ("/use_sim_time", ParamValue::Bool(true)),
    ];
    assert_eq!(parameters, expected.map(|(key, value)| (key.to_owned(), value)));
    // A command line names only nodes without a namespace.
    let said = left_out.describe("/camera/see").expect("something");
    assert!(said.contains("-p see:name:=x: it is for another node"), "{said}");
}

#[test]
fn what_ros_1_cannot_be_told_is_left_out_in_words() {
    for (line, said) in [
        ("--ros-args -p wide:=3000000000", "3000000000 does not fit into the 32 bits"),
        ("--ros-args -r /x/*:=/y/\\1", "ROS 1 has no patterns"),
        ("--ros-args -r other:scan:=/front", "it is for another node"),
        ("--ros-args --params-file /tmp/p.yaml", "the file is on the robot"),
        ("--ros-args --log-level debug", "ROS 1 has no such argument"),
    ] {
        let (argv, parameters, left_out) = ros1(line);
        assert_eq!((&*argv, parameters.len()), ("", 0), "{line}");
        let text = left_out.describe("/camera/see").expect(line);
        assert!(text.contains(said), "{text}");
    }
    let refused = for_ros1("/see", &words("--ros-args -p gain")).expect_err("rcl refuses it");
    assert!(refused.to_string().contains("it has no :="), "{refused}");
}
