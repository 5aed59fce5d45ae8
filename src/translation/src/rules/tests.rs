//! Files of rules, and what ros1_bridge's users expect of them.

use ros_message::RosVersion::{One, Two};
use serde_json::json as value;

use super::*;
use crate::NoTwinReason;
use crate::tests::{carry, fields, twin_among, twin_by};

fn rules(yaml: &str) -> TranslationRules {
    TranslationRules::default().with_yaml("rules.yaml", yaml).unwrap()
}

#[test]
fn the_table_is_read() {
    let table = TranslationRules::default();
    assert!(table.fields("sensor_msgs/CameraInfo", "sensor_msgs/msg/CameraInfo").is_some());
    assert!(table.definition(One, "rosgraph_msgs/Log").is_some_and(|text| text.ends_with("string[] topics\n")));
}

#[test]
fn a_rule_of_packages_renames_all_in_them() {
    let rules = rules("- ros1_package_name: old\n  ros2_package_name: new\n");
    assert_eq!(rules.message_name("old/B", One), "new/msg/B");
    assert_eq!(rules.message_name("new/msg/B", Two), "old/B");
    assert_eq!(rules.service_name("old/B", One), "new/srv/B");
    assert_eq!(rules.action_name("new/action/B", Two), "old/B");
    assert_eq!(rules.message_name("other/B", One), "other/msg/B");
}

#[test]
fn a_rule_of_a_message_renames_it() {
    let yaml = "- ros1_package_name: old\n  ros1_message_name: B\n  ros2_package_name: new\n  ros2_message_name: C\n\
                - ros1_package_name: old\n  ros2_package_name: others\n";
    let pair = twin_by(rules(yaml), One, &[("old/B", "uint8 x\nD d"), ("old/D", "uint8 y")]).unwrap();
    assert_eq!(pair.twin.name(), "new/msg/C");
    assert_eq!(fields(&pair.twin), ["uint8 x", "others/msg/D d"]);
}

#[test]
fn a_rule_of_fields_lists_all_that_are_carried() {
    let head = "- ros1_package_name: a\n  ros1_message_name: B\n  ros2_package_name: a\n  ros2_message_name: B\n  \
        fields_1_to_2:\n";
    let one = [("a/B", "uint8 x\nuint8 y\nInner inner"), ("a/Inner", "float64 p\nstring q")];
    let two = [("a/msg/B", "string deep\nuint8 first\nuint8 y\nPart part"), ("a/msg/Part", "float64 p\nuint8 more")];
    let by = |fields: &str| twin_among(rules(&format!("{head}{fields}")), One, &one, &two);
    let given = r#"{"x": 1, "y": 2, "inner": {"p": 0.5, "q": "text"}}"#;
    // Without it there would be no pair; `y` is in both, and not listed.
    let pair = by("    x: first\n    inner.p: part.p\n    inner.q: deep\n").unwrap();
    let expected = value!({"deep": "text", "first": 1, "y": 0, "part": {"p": 0.5, "more": 0}});
    assert_eq!(carry(&pair, given), expected);
    // Back again: what is not listed has its default.
    let back =
        pair.from_twin.translate(&pair.to_twin.translate(&crate::tests::serialize(&pair.original, given)).unwrap());
    let back = crate::tests::json(&pair.original, &back.unwrap());
    assert_eq!(back, value!({"x": 1, "y": 0, "inner": {"p": 0.5, "q": "text"}}));
    // A message in a message, as a whole.
    let whole = by("    inner: part\n");
    assert!(matches!(*whole.unwrap_err().reason, NoTwinReason::Fields { .. }), "q and more");

    let error = by("    x: nothing\n").unwrap_err().to_string();
    assert!(error.contains("rules.yaml, rule 1 names field \"nothing\", which a/msg/B does not have"), "{error}");
    let error = by("    x.y: first\n").unwrap_err().to_string();
    assert!(error.contains("names field \"x.y\", which a/B does not have"), "{error}");
    let error = by("    inner: part\n    inner.p: part.p\n").unwrap_err().to_string();
    assert!(error.contains("names field \"inner.p\" of a/B twice"), "{error}");
    let error = by("    x: first\n    y: first\n").unwrap_err().to_string();
    assert!(error.contains("names field \"first\" of a/msg/B twice"), "{error}");
}

#[test]
fn a_rule_makes_definitions_in_its_order() {
    let yaml = "- ros1_package_name: a\n  ros1_message_name: B\n  ros2_package_name: a\n  ros2_message_name: B\n  \
                fields_1_to_2:\n    K: k_new\n    inner.q: text\n";
    let one = [("a/B", "uint8 x\nInner inner\nfloat64 K"), ("a/Inner", "float64 p\nstring q")];
    let pair = twin_by(rules(yaml), One, &one).unwrap();
    assert_eq!(fields(&pair.twin), ["float64 k_new", "string text"]);
    // The other way a part of a field does not tell what is around it.
    let error = twin_by(rules(yaml), Two, &[("a/msg/B", "float64 k_new\nstring text")]).unwrap_err().to_string();
    assert!(error.contains("rule 1 pairs field \"inner.q\" of a/B, whose definition is unknown"), "{error}");
    let given = format!("{yaml}  ros1_definition: |\n    float64 K\n    Inner inner\n");
    let inner = "- ros1_package_name: a\n  ros1_message_name: Inner\n  ros2_package_name: a\n  ros2_message_name: \
        Inner\n  \
                 ros1_definition: string q\n";
    let pair = twin_by(rules(&format!("{given}{inner}")), Two, &[("a/msg/B", "float64 k_new\nstring text")]).unwrap();
    assert_eq!(carry(&pair, r#"{"k_new": 0.5, "text": "x"}"#), value!({"K": 0.5, "inner": {"q": "x"}}));
}

#[test]
fn a_rule_of_a_service_names_it_and_its_fields() {
    let yaml = "- ros1_package_name: a\n  ros1_service_name: Old\n  ros2_package_name: b\n  ros2_service_name: New\n  \
                request_fields_1_to_2:\n    x: first\n  response_fields_1_to_2:\n    y: second\n  \
                enable_foreign_mappings: true\n";
    let service = crate::tests::registry(One, &[("a/srv/Old", "uint8 x\n---\nuint8 y\n")]).service("a/Old").unwrap();
    let pair = crate::TypeTranslations::new(rules(yaml)).service(&service).unwrap();
    assert_eq!(pair.twin.name, "b/srv/New");
    assert_eq!(
        (fields(&pair.twin.request), fields(&pair.twin.response)),
        (vec!["uint8 first".into()], vec!["uint8 second".into()])
    );
    assert_eq!(pair.request_to_twin.translate(&[7]).unwrap()[4..], [7]);
    assert_eq!(pair.response_from_twin.translate(&[0, 1, 0, 0, 9]).unwrap()[..], [9]);
}

#[test]
fn rules_of_a_lab_win_over_the_table() {
    let yaml = "- ros1_package_name: sensor_msgs\n  ros1_message_name: CameraInfo\n  ros2_package_name: lab_msgs\n  \
        ros2_message_name: Camera\n";
    assert_eq!(rules(yaml).message_name("sensor_msgs/CameraInfo", One), "lab_msgs/msg/Camera");
    let packages = rules("- ros1_package_name: sensor_msgs\n  ros2_package_name: lab_msgs\n");
    assert_eq!(packages.message_name("sensor_msgs/CompressedImage", One), "lab_msgs/msg/CompressedImage");
    assert_eq!(packages.message_name("lab_msgs/msg/Range", Two), "sensor_msgs/Range");
}

#[test]
fn rules_are_read_from_a_file() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("lab.yaml");
    let read = |text: &[u8]| {
        std::fs::write(&path, text).unwrap();
        TranslationRules::default().with_file(&path)
    };
    let rules = read(b"- ros1_package_name: old\n  ros2_package_name: new\n").unwrap();
    assert_eq!(rules.message_name("old/B", One), "new/msg/B");
    let long = " ".repeat(2 << 20);
    for (text, reason) in [
        (&b"- ros1_package_name: old\n"[..], "rule 1 lacks ros2_package_name"),
        (b"\xff\xfe", "cannot read the rules in"),
        (long.as_bytes(), "has 2097152 bytes"),
    ] {
        let error = read(text).unwrap_err().to_string();
        assert!(error.contains(reason) && error.contains("lab.yaml"), "{error}");
    }
    for (path, reason) in [(place.path().join("none.yaml"), "none.yaml"), (place.path().to_owned(), "it is no file")] {
        let error = TranslationRules::default().with_file(&path).unwrap_err().to_string();
        assert!(error.contains("cannot read the rules in") && error.contains(reason), "{error}");
    }
}

#[test]
fn files_that_are_no_rules_are_refused_with_their_place() {
    let refused = |yaml: &str| TranslationRules::default().with_yaml("rules.yaml", yaml).unwrap_err().to_string();
    for (yaml, reason) in [
        ("a: b", "rules.yaml: "),
        ("- ros1_package_name: a\n  ros2_packge_name: b\n", "unknown field `ros2_packge_name`"),
        ("- ros1_package_name: a\n  ros2_packge_name: b\n", "at line 2 column 3"),
        ("- ros1_package_name: [a]\n", "ros1_package_name: invalid type: sequence"),
        ("- ros1_package_name: 'a\n", "rules.yaml: "),
        (
            "- {ros1_package_name: a, ros2_package_name: b}\n- ros1_package_name: a\n",
            "rules.yaml, rule 2 lacks ros2_package_name",
        ),
        ("- {ros1_package_name: a, ros2_package_name: b, ros1_message_name: c}", "rule 1 lacks ros2_message_name"),
        ("- {ros1_package_name: a, ros2_package_name: b, fields_1_to_2: {x: y}}", "rule 1 lacks ros1_message_name"),
        ("- {ros1_package_name: a, ros2_package_name: b, response_fields_1_to_2: {x: y}}", "lacks ros1_service_name"),
        (
            "- {ros1_package_name: a, ros2_package_name: b, ros1_message_name: c, ros2_service_name: d}",
            "has both ros1_message_name and ros2_service_name",
        ),
    ] {
        let error = refused(yaml);
        assert!(error.contains(reason), "{yaml}: {error}");
    }
    assert!(refused(&" ".repeat(2 << 20)).contains("may have 1048576"));
    let many = "- {ros1_package_name: a, ros2_package_name: b}\n".repeat(5000);
    assert!(refused(&many).contains("has 5000 rules"));
    // Aliases may not multiply a file.
    let bomb = (0..30).fold("- &a0 [x]\n".to_owned(), |text, level| {
        let all = vec![format!("*a{level}"); 10].join(", ");
        format!("{text}- &a{} [{all}]\n", level + 1)
    });
    refused(&bomb);
    for empty in ["", "# nothing\n", "[]"] {
        assert!(TranslationRules::default().with_yaml("rules.yaml", empty).is_ok());
    }
}
