use super::*;

fn sections(text: &str) -> Sections {
    let mut sections = Sections::default();
    sections.parse(text).expect(text);
    sections
}

/// Returns the parameters of the node, as JSON.
fn node_parameters(text: &str, node: &str) -> String {
    serde_json::to_string(&sections(text).for_node(node)).expect("JSON")
}

#[test]
fn a_file_of_several_nodes_is_read_for_one() {
    let text = "\
/**:
  ros__parameters:
    use_sim_time: true
    gains: {p: 1.0, i: 2}
see:
  ros__parameters:
    names: [left, \"1\"]
    quoted: \"yes\"
    gains.i: 3
    text: |
      two
      lines
front:
  see:
    ros__parameters:
      rate: 10
other:
  ros__parameters:
    rate: 11
";
    assert_eq!(
        node_parameters(text, "/see"),
        r#"{"gains.i":3,"gains.p":1.0,"names":["left","1"],"quoted":"yes","text":"two\nlines\n","use_sim_time":true}"#
    );
    assert_eq!(node_parameters(text, "/front/see"), r#"{"gains.i":2,"gains.p":1.0,"rate":10,"use_sim_time":true}"#);
}

#[test]
fn a_file_that_launch_wrote_is_read() {
    let text = "\
/front/people:
  ros__parameters:
    cloudroid.max: 0.3
    n: '1'
    s: 'on'
    x.y: !!python/tuple
    - 1.0
    - 2.0
";
    assert_eq!(node_parameters(text, "/front/people"), r#"{"cloudroid.max":0.3,"n":"1","s":"on","x.y":[1.0,2.0]}"#);
}

/// Verified against rclpy 7.1.
#[test]
fn patterns_name_nodes() {
    for (nodes, node, named) in [
        ("/**", "/a/b/c", true),
        ("/**", "/c", true),
        ("/*", "/c", true),
        ("/*", "/a/c", false),
        ("/**/c", "/a/b/c", true),
        ("/**/c", "/c", true),
        ("/**/*", "/a/b/c", true),
        ("/a/*", "/a/c", true),
        ("/a/**", "/a/b/c", true),
        ("/*/c", "/a/c", true),
        ("/*/c", "/a/b/c", false),
        ("c", "/c", true),
        ("c", "/a/c", false),
        ("a/c", "/a/c", true),
    ] {
        assert_eq!(matches_node(nodes, node), named, "{nodes} {node}");
    }
}

#[test]
fn the_later_section_counts_and_a_pattern_stays_where_it_was_first_seen() {
    let of = |text: &str| node_parameters(text, "/see");
    let value = |nodes: &str, value: u8| format!("{nodes}:\n  ros__parameters:\n    a: {value}\n");
    assert_eq!(of(&(value("see", 1) + &value("/**", 2))), r#"{"a":2}"#);
    assert_eq!(of(&(value("/**", 1) + &value("see", 2))), r#"{"a":2}"#);
    let mut sections = sections(&(value("/**", 1) + &value("see", 2)));
    // Equivalent to `-p a:=3` after the file: it belongs to /**, which comes before the node's own section.
    sections.set("/**", "a".into(), ParamValue::Int(3));
    assert_eq!(sections.for_node("/see")["a"], ParamValue::Int(2));
    assert_eq!(of(&(value("see", 1) + "---\n" + &value("see", 4))), r#"{"a":4}"#);
    for nothing in ["", "# nothing\n", "see:\n  ros__parameters: {}\n"] {
        assert_eq!(of(nothing), "{}", "{nothing:?}");
    }
}

/// Each of these makes a node of rclpy 7.1 fail, too, except for the nested list.
#[test]
fn what_is_no_parameters_file_is_named_with_its_line() {
    let deep = "a: {".repeat(200);
    for (text, line, said) in [
        ("see:\n  a: 1\n", 2, "a has a value without ros__parameters"),
        ("see: 1\n", 1, "see has a value without"),
        ("ros__parameters:\n  a: 1\n", 1, "not below a node name"),
        ("see:\n  ros__parameters:\n    a:\n    b: 1\n", 3, "a: the value is missing"),
        ("see:\n  ros__parameters:\n    a: [1, 2.0]\n", 3, "a: the values of a list must have one type"),
        ("see:\n  ros__parameters:\n    a: [[1]]\n", 3, "a: a list cannot contain lists"),
        ("see:\n  ros__parameters:\n    a: &x 1\n    b: *x\n", 4, "b: ROS 2 does not support aliases"),
        ("see:\n  ros__parameters:\n", 2, "ros__parameters is empty"),
        ("see:\n  ros__parameters:\n\ta: 1\n", 3, ""),
        ("- 1\n", 1, "expected a node name"),
        ("text\n", 1, "expected a node name"),
        ("s ee:\n  ros__parameters:\n    a: 1\n", 1, "\"s ee\" is not a valid node name"),
        ("see:\n  ros__parameters: {[a]: 1}\n", 2, "expected a name before each colon"),
        ("see:\n  ros__parameters:\n    a: \"1\n", 0, ""),
        (&deep, 1, "nested groups"),
    ] {
        let problem = Sections::default().parse(text).expect_err(text);
        assert!(problem.reason.contains(said), "{text}: {problem:?}");
        assert!(line == 0 || problem.line == line, "{text}: {problem:?}");
    }
}

#[test]
fn a_file_that_cannot_be_read_is_named() {
    let place = tempfile::tempdir().expect("a directory");
    let path = place.path().join("p.yaml");
    let read = || format!("{:#}", Sections::default().read(&path).expect_err("refused"));
    assert!(read().starts_with(&format!("cannot read the parameters file {}", path.display())));
    std::fs::write(&path, "see:\n  a: 1\n").expect("written");
    let said = read();
    assert!(said.contains(&format!("{}, line 2: a has", path.display())), "{said}");
    std::fs::write(&path, [0xff, 0xfe]).expect("written");
    assert!(read().contains("UTF-8"), "{}", read());
    std::fs::File::create(&path).and_then(|file| file.set_len(MAX_BYTES + 1)).expect("made");
    assert!(read().contains("bytes"), "{}", read());
}
