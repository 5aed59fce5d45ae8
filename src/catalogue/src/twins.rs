//! The interface of a revision for robots of either ROS.

use std::borrow::Cow;
use std::sync::Arc;

use package::interface::Interface;
use ros::bus::RosVersion;
use store::RevisionRecord;
use translation::{TranslationRules, TypeTranslations};

/// Returns the interface of a revision as robots of this ROS see it.
///
/// # Errors
/// [`package::Error::NoTwins`], with all types that have no counterpart and their fields.
pub(crate) fn interface_for_robots<'a>(
    revision: &'a RevisionRecord,
    robots: RosVersion,
    rules: &Arc<TranslationRules>,
) -> Result<Cow<'a, Interface>, package::Error> {
    let service_ros = revision.flavour.ros.ros_version();
    if robots == service_ros {
        return Ok(Cow::Borrowed(&revision.interface));
    }
    let translations = TypeTranslations::new(Arc::clone(rules));
    revision.interface.to_other_ros(service_ros, &revision.service, &translations).map(Cow::Owned)
}

#[cfg(test)]
mod tests {
    use package::interface::{Direction, Topic};
    use ros::flavour::Flavour;
    use store::Plan;

    use super::*;

    #[test]
    fn a_lab_s_rules_name_the_types_of_robots_of_the_other_ros() {
        let topic = Topic {
            name: "/see/found".into(),
            type_name: "old_msgs/Found".into(),
            md5: String::new(),
            direction: Direction::Output,
            nodes: Vec::new(),
            latched: false,
            lazy: false,
            qos: None,
        };
        let definition = ("old_msgs/msg/Found".to_owned(), "float32 score\nfloat32 Score\n".to_owned());
        let revision = RevisionRecord {
            service: "see".into(),
            number: 1,
            image: String::new(),
            published: 0,
            package: "p".into(),
            owner: None,
            source: String::new(),
            flavour: Flavour::default(),
            plan: Plan::default(),
            interface: Interface { topics: vec![topic], definitions: [definition].into(), ..Interface::default() },
        };
        let by = |rules| interface_for_robots(&revision, RosVersion::Two, &Arc::new(rules)).map(Cow::into_owned);
        let error = by(TranslationRules::default()).expect_err("fields of one name").to_string();
        assert!(error.contains("robots of ROS 2 cannot use see: /see/found: ") && error.contains("Score"), "{error}");
        let rule = "- ros1_package_name: old_msgs\n  ros1_message_name: Found\n  ros2_package_name: new_msgs\n  \
                    ros2_message_name: Found\n  fields_1_to_2:\n    score: score\n    Score: best_score\n";
        let rules = TranslationRules::default().with_yaml("lab.yaml", rule).expect("a rule");
        let interface = by(rules).expect("a counterpart");
        assert_eq!(interface.topics[0].type_name, "new_msgs/msg/Found");
        assert!(interface.definitions["new_msgs/msg/Found"].contains("best_score"), "{:?}", interface.definitions);
    }
}
