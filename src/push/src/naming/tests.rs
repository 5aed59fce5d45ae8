use super::*;
use package::interface::Parameter;

fn plan(names: &[&str]) -> Plan {
    let node = |name: &&str| NodeSpec {
        name: (*name).to_owned(),
        argv: vec!["/x".to_owned()],
        environment: Default::default(),
        directory: "/root".to_owned(),
        respawn: false,
        respawn_delay: 0.0,
        required: false,
    };
    Plan { nodes: names.iter().map(node).collect(), ..Plan::default() }
}

fn options_with_params(params: &[&str]) -> PushOptions {
    PushOptions {
        params: params.iter().map(|key| ((*key).to_owned(), serde_json::json!(1))).collect(),
        ..PushOptions::default()
    }
}

fn found_names(said: &[(usize, &[&str])]) -> FoundNames {
    let said = said.iter().map(|(index, names)| {
        let names = names.iter().map(|&name| classify_name(name, ""));
        (*index, names.collect())
    });
    said.collect()
}

#[test]
fn a_node_has_the_name_and_the_parameters_that_its_program_gives_it() {
    let mut plan = plan(&["/costmap_2d_node", "/other", "/third"]);
    let options = options_with_params(&["~rate", "/costmap_2d_node/stays"]);
    for key in ["/costmap_2d_node/rate", "/costmap_2d_node/stays"] {
        plan.parameters.insert(key.to_owned(), ParamValue::Int(1));
    }
    let found = found_names(&[(0, &["costmap_2d"]), (2, &["other"])]);
    apply_names(&mut plan, &Flavour::default(), &[0, 2], &found, &options);
    let names: Vec<&str> = plan.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["/costmap_2d", "/other", "/other_2"]);
    assert_eq!(plan.nodes[0].argv, ["/x", "__name:=costmap_2d"]);
    let keys: Vec<&String> = plan.parameters.keys().collect();
    assert_eq!(keys, ["/costmap_2d/rate", "/costmap_2d_node/stays"]);
    let words = unused_parameters(&plan, &Interface::default(), &options, RosVersion::Two).join("\n");
    assert!(words.starts_with("parameter /costmap_2d_node/stays") && words.contains("/costmap_2d,"), "{words}");
    // Somebody may still read it.
    let interface = Interface {
        parameters: vec![Parameter {
            name: "/costmap_2d_node/stays".to_owned(),
            read_by: vec!["/other".to_owned()],
            ..Parameter::default()
        }],
        ..Interface::default()
    };
    assert!(unused_parameters(&plan, &interface, &options, RosVersion::Two).is_empty());
}

#[test]
fn nodes_of_ros_2_keep_their_namespaces_and_are_renamed_alone() {
    let flavour = Flavour { ros: ros::flavour::Version::Ros2, ..Flavour::default() };
    let mut plan = plan(&["/front/talk", "/back/talk", "/two", "/own"]);
    for (node, namespace) in plan.nodes.iter_mut().zip(["/front", "/back"]) {
        let words = ["--ros-args", "-r", &*format!("__ns:={namespace}")];
        node.argv.extend(words.map(str::to_owned));
    }
    let said = found_names(&[(0, &["/front/talker"]), (1, &["/back/talker"]), (2, &["/own"]), (3, &["/chosen/own"])]);
    let given = PushOptions::default();
    apply_names(&mut plan, &flavour, &[0, 1, 2, 3], &said, &given);
    let told = |index: usize| {
        let node: &NodeSpec = &plan.nodes[index];
        (node.name.as_str(), node.argv.join(" "))
    };
    let kept = |namespace: &str| format!("/x --ros-args -r __ns:={namespace}");
    assert_eq!(told(0), ("/front/talker", kept("/front")));
    assert_eq!(told(1), ("/back/talker", kept("/back")));
    assert_eq!(told(2), ("/own", "/x".to_owned()));
    assert_eq!(told(3), ("/chosen/own", "/x".to_owned()));
}

#[test]
fn each_node_of_a_second_program_of_several_nodes_has_a_name_of_its_own() {
    let flavour = Flavour { ros: ros::flavour::Version::Ros2, ..Flavour::default() };
    let mut twice = plan(&["/duet", "/duet_2", "/soloist"]);
    let key = |name: &str| format!("{name}/rate");
    for name in ["/duet", "/duet_2", "/soloist"] {
        twice.parameters.insert(key(name), ParamValue::Int(1));
    }
    let said = found_names(&[(0, &["/alto", "/tenor"]), (1, &["/alto", "/tenor"]), (2, &["/solo", "/tenor"])]);
    apply_names(&mut twice, &flavour, &[0, 1, 2], &said, &options_with_params(&["rate"]));
    let rate = ["--ros-args", "-p", "rate:=1", "--"];
    let told = |index: usize| {
        let argv = &twice.nodes[index].argv;
        let rules = argv.len() - rate.len();
        assert_eq!(argv[rules..], rate);
        (&*twice.nodes[index].name, argv[..rules].join(" "))
    };
    assert_eq!(told(0), ("/alto", "/x".to_owned()));
    let rules = "/x --ros-args -r alto:__node:=alto_2 -r tenor:__node:=tenor_2";
    assert_eq!(told(1), ("/alto_2", rules.to_owned()));
    let rules = "/x --ros-args -r tenor:__node:=tenor_3";
    assert_eq!(told(2), ("/solo", rules.to_owned()));
    let keys: Vec<&String> = twice.parameters.keys().collect();
    assert_eq!(keys, ["/alto/rate", "/alto_2/rate", "/solo/rate"]);
}

#[test]
fn nodes_of_one_name_in_one_program_have_the_same_number() {
    let flavour = Flavour { ros: ros::flavour::Version::Ros2, ..Flavour::default() };
    let mut plan = plan(&["/left/detector", "/detectors", "/detectors_2", "/odd"]);
    let said = found_names(&[
        (1, &["/left/detector", "/right/detector"]),
        (2, &["/left/detector", "/right/detector"]),
        (3, &["/odd_4711_1700000000123"]),
    ]);
    apply_names(&mut plan, &flavour, &[1, 2, 3], &said, &options_with_params(&[]));
    let told = |index: usize| {
        let node: &NodeSpec = &plan.nodes[index];
        (node.name.as_str(), node.argv.join(" "))
    };
    let rule = |number: usize| format!("/x --ros-args -r detector:__node:=detector_{number}");
    assert_eq!(told(1), ("/left/detector_2", rule(2)));
    assert_eq!(told(2), ("/left/detector_3", rule(3)));
    let rules = "/x --ros-args -r __node:=odd -r __ns:=/";
    assert_eq!(told(3), ("/odd", rules.to_owned()));
}

#[test]
fn nodes_that_are_told_no_namespace_are_where_their_programs_put_them() {
    let mut flavour = Flavour { ros: ros::flavour::Version::Ros2, ..Flavour::default() };
    let mut plan = plan(&["/see", "/front/hear", "/seen"]);
    let words = ["--ros-args", "-r", "__ns:=/front"];
    plan.nodes[1].argv.extend(words.map(str::to_owned));
    for key in ["/see/rate", "/seen/rate"] {
        plan.parameters.insert(key.to_owned(), ParamValue::Int(1));
    }
    let marks = mark_nodes_without_namespace(&mut plan.clone(), &flavour);
    let expected = [("/see", "/cloudroid_name_0"), ("/seen", "/cloudroid_name_2")];
    let expected = expected.map(|(node, mark)| (node.to_owned(), mark.to_owned()));
    assert_eq!(marks, expected.into());
    let moved = [("/see".to_owned(), "/camera/see".to_owned())];
    move_nodes(&mut plan, &moved.into());
    let names: Vec<&str> = plan.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["/camera/see", "/front/hear", "/seen"]);
    let keys: Vec<&String> = plan.parameters.keys().collect();
    assert_eq!(keys, ["/camera/see/rate", "/seen/rate"]);
    flavour.ros = ros::flavour::Version::Ros1;
    assert!(mark_nodes_without_namespace(&mut plan, &flavour).is_empty());
}

#[test]
fn parameters_that_no_node_of_ros_2_has_declared_are_told() {
    let own = |name: &str| Parameter { name: format!("/see/{name}"), node: "/see".to_owned(), ..Parameter::default() };
    let interface = Interface { parameters: vec![own("rate"), own("camera.width")], ..Interface::default() };
    for known in ["rate", "~rate", "/rate", "/see/rate", "/see/camera/width", "camera/width", "camera", "use_sim_time"]
    {
        assert_eq!(describe_undeclared(&interface, known), None, "{known}");
    }
    for unknown in ["rat", "/see/rat", "/other/rate/x", "width"] {
        let words = describe_undeclared(&interface, unknown).expect(unknown);
        assert_eq!(words, "declared: /see/rate, /see/camera.width");
    }
    // ROS 1 nodes declare no parameters.
    assert_eq!(describe_undeclared(&Interface::default(), "rat"), None);
}

#[test]
fn parameters_that_no_node_of_ros_1_has_read_are_told() {
    let read =
        |name: &str| Parameter { name: name.to_owned(), read_by: vec!["/see".to_owned()], ..Parameter::default() };
    let written =
        Parameter { name: "/see/made".to_owned(), written_by: vec!["/see".to_owned()], ..Parameter::default() };
    let parameters = vec![read("/see/rate"), read("/see/camera"), read("/lab"), written];
    let interface = Interface { parameters, ..Interface::default() };
    let plan = plan(&["/see"]);
    let warnings = |key: &str, version| unused_parameters(&plan, &interface, &options_with_params(&[key]), version);
    for known in ["rate", "~rate", "_rate", "/see/rate", "camera/width", "/lab", "/lab/size", "use_sim_time"] {
        assert_eq!(warnings(known, RosVersion::One), [""; 0], "{known}");
    }
    for unknown in ["rat", "/see/rat", "/rates", "made"] {
        let words = warnings(unknown, RosVersion::One).join("; ");
        let expected = format!("no node has read a parameter {unknown} since it was started");
        assert!(words.starts_with(&expected) && words.ends_with("read were /see/rate, /see/camera, /lab"), "{words}");
    }
    // Of another node that is said otherwise.
    assert!(warnings("/other/rate", RosVersion::One).join("; ").contains("matches no node"));
}

#[test]
fn nodes_of_ros_1_are_told_apart_by_their_namespaces() {
    let graph = Graph {
        nodes: [
            "/cloudroid_name_0/costmap_2d",
            "/cloudroid_name_0/below/planner",
            "/cloudroid_name_3/talker_71_1700000000123",
            "/cloudroid_name_4/x'$(cmd)'",
            "/cloudroid_name_5/cpu_monitor_push_1_names",
            NODE,
        ]
        .map(|name| (name.to_owned(), String::new()))
        .into(),
        ..Graph::default()
    };
    let one = |name: &str, own: Option<&str>| NodeRename { own: own.map(str::to_owned), node: name.to_owned() };
    let planner = "below/planner";
    let expected = [
        (0, vec![one(planner, Some(planner)), one("costmap_2d", Some("costmap_2d"))]),
        (3, vec![one("talker", None)]),
        (5, vec![one("cpu_monitor", None)]),
    ];
    let host = "push-1-names";
    assert_eq!(names_in_graph(RosVersion::One, &graph, &[0, 3, 4, 5], host), expected.into());
}

#[test]
fn nodes_of_ros_2_are_told_apart_by_their_enclaves() {
    let names_of = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    let shown = ["/camera/detector", "/talker", "/deaf", NODE];
    let graph = Graph {
        nodes: shown.map(|name| (name.to_owned(), String::new())).into(),
        enclaves: [
            ("/cloudroid_name_0", names_of(&["/camera/detector", "/talker"])),
            ("/cloudroid_name_1", names_of(&["/_worker", "/talker"])),
            ("/cloudroid_name_2", names_of(&["/push_1_names/ntp"])),
            ("/cloudroid_name_3", names_of(&["/a", "/b_4711_1700000000123"])),
            ("/other", names_of(&["/deaf"])),
        ]
        .map(|(enclave, nodes)| (enclave.to_owned(), nodes))
        .into(),
        ..Graph::default()
    };
    let host = "push-1-names";
    let told = |index: usize, all: &[usize]| {
        let mut names = names_in_graph(RosVersion::Two, &graph, all, host);
        let called = names.remove(&index).unwrap_or_default().into_iter();
        called.map(|called| (called.node, called.own.is_some())).collect::<Vec<_>>()
    };
    let all = [0, 1, 2, 3, 4];
    let own = |name: &str| (name.to_owned(), true);
    assert_eq!(told(0, &all), [own("/camera/detector"), own("/talker")]);
    assert_eq!(told(1, &all), [own("/talker")]);
    assert_eq!(told(2, &all), [("/ntp".to_owned(), false)]);
    assert_eq!(told(3, &all), [own("/a")]);
    assert_eq!(told(4, &all), []);
    // It ignored its mark.
    assert_eq!(told(4, &[4]), [own("/camera/detector"), own("/deaf"), own("/talker")]);
}

#[test]
fn the_machine_is_no_part_of_a_name() {
    for (name, plain) in [
        ("cpu_monitor_push_1_names", "cpu_monitor"),
        ("push_1_names_ntp", "ntp"),
        ("a_push_1_names_b", "a_b"),
        ("push_1_names", ""),
        ("push_1", "push_1"),
        ("/push_1_names", ""),
        ("/push_1_names/ntp", "/ntp"),
        ("/lab/ntp_push_1_names", "/lab/ntp"),
    ] {
        assert_eq!(without_host(name, "push-1-names"), plain);
    }
}

#[test]
fn random_ends_are_cut_off() {
    for (name, plain) in [
        ("talker_4711_1700000000123", "talker"),
        ("people_detect_1700000000123456789", "people_detect"),
        ("node_1_1700000000123456789", "node_1"),
        ("costmap_2d", "costmap_2d"),
        ("camera_2", "camera_2"),
    ] {
        assert_eq!(without_random_end(name), plain);
    }
}
