use super::*;

fn words(line: &str) -> Vec<String> {
    line.split_whitespace().map(str::to_owned).collect()
}

fn kinds(line: &str) -> Vec<Kind> {
    let parts = parse(&words(line)).expect(line);
    parts.into_iter().map(|part| part.kind).collect()
}

fn remap_rule(node: Option<&str>, of: RemapTarget, [from, to]: [&str; 2]) -> Kind {
    Kind::Rule(RemapRule { node: node.map(str::to_owned), of, from: from.to_owned(), to: to.to_owned() })
}

fn set(node: Option<&str>, name: &str, value: &str) -> Kind {
    Kind::Parameter(Parameter { node: node.map(str::to_owned), name: name.to_owned(), value: value.to_owned() })
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
            remap_rule(None, RemapTarget::Node, ["__node", "see"]),
            remap_rule(None, RemapTarget::Namespace, ["__ns", "/front"]),
            remap_rule(None, RemapTarget::Name, ["image", "/camera/image"]),
            Kind::File("/tmp/p.yaml".into()),
            set(None, "rate", "2.0"),
            Kind::Setting,
            Kind::Mark,
            Kind::Own,
            Kind::Mark,
            set(Some("see"), "gains.p", "3"),
            remap_rule(None, RemapTarget::Name, ["~/a", "b"]),
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
            remap_rule(None, RemapTarget::Node, ["__node", "bar"]),
            remap_rule(None, RemapTarget::Name, ["chatter", "foo"]),
            Kind::Own,
            // Without arguments for ROS, these belong to the program.
            Kind::Own,
            Kind::Own,
        ]
    );
    assert_eq!(
        kinds("--ros-args -r usual:__name:=bar -r rostopic://a:=b -r x:rosservice://a:=b -r /x/*:=/y/\\1 --ros-args"),
        [
            Kind::Mark,
            remap_rule(Some("usual"), RemapTarget::Node, ["__name", "bar"]),
            remap_rule(None, RemapTarget::Topic, ["a", "b"]),
            remap_rule(Some("x"), RemapTarget::Service, ["a", "b"]),
            remap_rule(None, RemapTarget::Name, ["/x/*", "/y/\\1"]),
            Kind::Mark,
        ]
    );
    assert_eq!(
        kinds("--ros-args -e /lab --disable-stdout-logs --enable-rosout-logs"),
        [Kind::Mark, Kind::Setting, Kind::Setting, Kind::Setting]
    );
}

/// Each of these makes a node of rclpy 7.1 exit with an error, too.
#[test]
fn what_rcl_refuses_is_refused_by_name() {
    for (line, said) in [
        ("--ros-args -r", "nothing follows -r"),
        ("--ros-args -p", "give -p NAME:=VALUE"),
        ("--ros-args --params-file", "give --params-file FILE"),
        ("--ros-args --log-level", "nothing follows --log-level"),
        ("--ros-args -r foo", "-r foo: it has no :="),
        ("--ros-args -r foo:=", "-r foo:=: \"\" behind := is not a name"),
        ("--ros-args -r __ns:=q", "\"q\" is not a namespace"),
        ("--ros-args -r __ns:=/q/", "\"/q/\" is not a namespace"),
        ("--ros-args -r __node:=q/r", "\"q/r\" is not a node name"),
        ("--ros-args -r __node:=", "\"\" is not a node name"),
        ("--ros-args -r a%b:=c", "\"a%b\" before := is not a name"),
        ("--ros-args -p a", "-p a: it has no :="),
        ("--ros-args -p /usual:b:=2", "\"/usual\" is not a node name"),
        ("--ros-args -p a-b:=1", "\"a-b\" is not a parameter name"),
        ("--ros-args -p 0:=1", "\"0\" is not a parameter name"),
        ("--ros-args -p a..b:=1", "\"a..b\" is not a"),
        ("--ros-args --frob", "--frob follows --ros-args"),
        ("--ros-args __node:=bar", "__node:=bar follows --ros-args"),
        ("--ros-args -rchatter:=foo", "-rchatter:=foo follows"),
    ] {
        let error = parse(&words(line)).expect_err(line).to_string();
        assert!(error.contains(said), "{line}: {error}");
    }
}

#[test]
fn rules_for_one_node_say_nothing_to_the_others() {
    for (line, name, namespace) in [
        ("x --ros-args -r a:=b", false, false),
        ("--ros-args -r ears:__node:=x -r ears:__ns:=/y", false, false),
        ("--ros-args -r ears:__node:=x -r __ns:=/y", false, true),
        ("__node:=x", true, false),
    ] {
        let argv: Vec<String> = line.split(' ').map(str::to_owned).collect();
        assert_eq!(global_naming(&argv), Naming { name, namespace }, "{line}");
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
        // It is unknown which of them.
        (vec![plain, plain], None),
        (vec![named, named], None),
        (vec![], None),
    ] {
        let nodes: Vec<_> = lines.iter().map(|line| words(line)).collect();
        let found = node_for_stub(nodes, |node| node).map(|node| node.join(" "));
        assert_eq!(found.as_deref(), called_by, "{lines:?}");
    }
}
