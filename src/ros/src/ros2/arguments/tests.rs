use super::*;

fn words(line: &str) -> Vec<String> {
    line.split_whitespace().map(str::to_owned).collect()
}

fn kinds(line: &str) -> Vec<Kind> {
    let parts = parse(&words(line)).expect(line);
    parts.into_iter().map(|part| part.kind).collect()
}

fn renamed(node: Option<&str>, of: Renamed, [from, to]: [&str; 2]) -> Kind {
    Kind::Rule(Rule {
        node: node.map(str::to_owned),
        of,
        from: from.to_owned(),
        to: to.to_owned(),
    })
}

fn set(node: Option<&str>, name: &str, value: &str) -> Kind {
    Kind::Parameter(Parameter {
        node: node.map(str::to_owned),
        name: name.to_owned(),
        value: value.to_owned(),
    })
}

#[test]
fn what_launch_gives_is_understood() {
    let line = "--fast --ros-args -r __node:=see -r __ns:=/front -r image:=/camera/image --params-file /tmp/p.yaml \
                -p rate:=2.0 --log-level see:=debug -- own --ros-args --param see:gains.p:=3 --remap ~/a:=b";
    assert_eq!(
        kinds(line),
        [
            Kind::Own,
            Kind::Mark,
            renamed(None, Renamed::Node, ["__node", "see"]),
            renamed(None, Renamed::Namespace, ["__ns", "/front"]),
            renamed(None, Renamed::Name, ["image", "/camera/image"]),
            Kind::File("/tmp/p.yaml".into()),
            set(None, "rate", "2.0"),
            Kind::Setting,
            Kind::Mark,
            Kind::Own,
            Kind::Mark,
            set(Some("see"), "gains.p", "3"),
            renamed(None, Renamed::Name, ["~/a", "b"]),
        ]
    );
    let parts = parse(&words(line)).expect("a command line");
    let given: Vec<String> = parts.into_iter().flat_map(|part| part.words).collect();
    assert_eq!(given, words(line), "nothing is lost");
}

#[test]
fn rules_may_be_of_one_node_or_of_one_kind_and_need_no_flag() {
    assert_eq!(
        kinds("__node:=bar chatter:=foo key=value -- -x"),
        [
            renamed(None, Renamed::Node, ["__node", "bar"]),
            renamed(None, Renamed::Name, ["chatter", "foo"]),
            Kind::Own,
            // Where nothing is for ROS, these are the program's.
            Kind::Own,
            Kind::Own,
        ]
    );
    assert_eq!(
        kinds(
            "--ros-args -r usual:__name:=bar -r rostopic://a:=b -r x:rosservice://a:=b -r /x/*:=/y/\\1 --ros-args"
        ),
        [
            Kind::Mark,
            renamed(Some("usual"), Renamed::Node, ["__name", "bar"]),
            renamed(None, Renamed::Topic, ["a", "b"]),
            renamed(Some("x"), Renamed::Service, ["a", "b"]),
            renamed(None, Renamed::Name, ["/x/*", "/y/\\1"]),
            Kind::Mark,
        ]
    );
    assert_eq!(
        kinds("--ros-args -e /lab --disable-stdout-logs --enable-rosout-logs"),
        [Kind::Mark, Kind::Setting, Kind::Setting, Kind::Setting]
    );
}

/// Each of these ends a node of rclpy 7.1 with an error, too.
#[test]
fn what_rcl_refuses_is_refused_by_name() {
    for (line, said) in [
        ("--ros-args -r", "nothing stands after -r"),
        ("--ros-args -p", "give -p NAME:=VALUE"),
        ("--ros-args --params-file", "give --params-file FILE"),
        ("--ros-args --log-level", "nothing stands after --log-level"),
        ("--ros-args -r foo", "-r foo: it has no :="),
        ("--ros-args -r foo:=", "-r foo:=: \"\" behind := is no name"),
        ("--ros-args -r __ns:=q", "\"q\" is no namespace"),
        ("--ros-args -r __ns:=/q/", "\"/q/\" is no namespace"),
        ("--ros-args -r __node:=q/r", "\"q/r\" is no name of a node"),
        ("--ros-args -r __node:=", "\"\" is no name of a node"),
        ("--ros-args -r a%b:=c", "\"a%b\" before := is no name"),
        ("--ros-args -p a", "-p a: it has no :="),
        (
            "--ros-args -p /usual:b:=2",
            "\"/usual\" is no name of a node",
        ),
        ("--ros-args -p a-b:=1", "\"a-b\" is no name of a parameter"),
        ("--ros-args -p 0:=1", "\"0\" is no name of a parameter"),
        ("--ros-args -p a..b:=1", "\"a..b\" is no name"),
        ("--ros-args --frob", "--frob stands after --ros-args"),
        (
            "--ros-args __node:=bar",
            "__node:=bar stands after --ros-args",
        ),
        ("--ros-args -rchatter:=foo", "-rchatter:=foo stands after"),
    ] {
        let error = parse(&words(line)).expect_err(line).to_string();
        assert!(error.contains(said), "{line}: {error}");
    }
}

#[test]
fn rules_for_one_node_say_nothing_to_the_others() {
    for (line, name, namespace) in [
        ("x --ros-args -r a:=b", false, false),
        (
            "--ros-args -r ears:__node:=x -r ears:__ns:=/y",
            false,
            false,
        ),
        ("--ros-args -r ears:__node:=x -r __ns:=/y", false, true),
        ("__node:=x", true, false),
    ] {
        let argv: Vec<String> = line.split(' ').map(str::to_owned).collect();
        assert_eq!(says_to_all(&argv), Naming { name, namespace }, "{line}");
    }
}

#[test]
fn a_stub_is_called_by_the_only_node_of_its_program_that_is_told_no_name() {
    let (plain, named) = ("see", "see --ros-args -r __node:=look");
    for (lines, called_by) in [
        (vec![plain], Some(plain)),
        (vec![named], Some(named)),
        (vec![named, plain], Some(plain)),
        (vec![plain, named, named], Some(plain)),
        // Which of them it is nobody can tell.
        (vec![plain, plain], None),
        (vec![named, named], None),
        (vec![], None),
    ] {
        let nodes: Vec<_> = lines.iter().map(|line| words(line)).collect();
        let found = named_by_program(nodes, |node| node).map(|node| node.join(" "));
        assert_eq!(found.as_deref(), called_by, "{lines:?}");
    }
}
