//! Finds which input triggers which outputs, from names and types alone.

use crate::pair::{Correlation, Pair};

/// One end of a topic, as the finder needs it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Absolute name.
    pub name: String,
    /// `package/Type`, of whichever ROS.
    pub type_name: String,
    /// The type begins with a `std_msgs/Header`.
    pub stamped: bool,
}

/// What was found.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Found {
    /// The pairs, with the way the answer is recognised.
    pub pairs: Vec<Pair>,
    /// For whoever wonders: what was chosen among several, what is fed but not measured.
    pub notes: Vec<String>,
}

/// Topics that every node or many nodes have and that are nobody's request or answer.
const HOUSEKEEPING: [&str; 9] = [
    "/clock",
    "/tf",
    "/tf_static",
    "/rosout",
    "/rosout_agg",
    "/parameter_events",
    "/diagnostics",
    "/statistics",
    "/initialpose",
];
const HOUSEKEEPING_ENDINGS: [&str; 7] = [
    "/parameter_updates",
    "/parameter_descriptions",
    "/bond",
    "/camera_info",
    "/transition_event",
    // Of ROS 2's actions, whose goals and results are calls.
    "/_action/feedback",
    "/_action/status",
];
/// Types that accompany data, configure or trigger nothing.
const COMPANIONS: [&str; 7] = [
    "sensor_msgs/CameraInfo",
    "tf2_msgs/TFMessage",
    "tf/tfMessage",
    "dynamic_reconfigure/Config",
    "dynamic_reconfigure/ConfigDescription",
    "bond/Status",
    "rosgraph_msgs/Clock",
];
/// Sensor data: where there is such an input, it is the one that triggers.
const DATA: [&str; 9] = [
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
    "stereo_msgs/DisparityImage",
    "sensor_msgs/PointCloud2",
    "sensor_msgs/PointCloud",
    "sensor_msgs/LaserScan",
    "sensor_msgs/MultiEchoLaserScan",
    "sensor_msgs/Range",
    "audio_common_msgs/AudioData",
];

/// Pairs the inputs and outputs of one node.
///
/// One input is the trigger: sensor data before other types, with a stamp before without, then by name. With a
/// stamp on both ends the answers are all stamped outputs, and that whose type is neither the input's nor a picture
/// (those are views for people) is the one whose time counts. Without, it is whatever output comes next. `overrides`
/// replaces all that; a pair there that names no correlation gets the one its types allow.
///
/// # Errors
/// An override that names a topic which the interface does not have, or a stamp where there is none.
pub fn find(
    inputs: &[Topic],
    outputs: &[Topic],
    overrides: Option<&[Pair]>,
) -> Result<Found, String> {
    match overrides {
        Some(pairs) => written(inputs, outputs, pairs),
        None => Ok(guessed(inputs, outputs)),
    }
}

fn written(inputs: &[Topic], outputs: &[Topic], pairs: &[Pair]) -> Result<Found, String> {
    let mut found = Found::default();
    for pair in pairs {
        let end = |side: &[Topic], name: &str, what: &str| {
            let names: Vec<&str> = side.iter().map(|topic| topic.name.as_str()).collect();
            side.iter()
                .find(|topic| topic.name == name)
                .cloned()
                .ok_or_else(|| {
                    format!(
                        "answers: {name} is no {what} of this node; it has {}",
                        if names.is_empty() {
                            "none".to_owned()
                        } else {
                            names.join(", ")
                        }
                    )
                })
        };
        let input = end(inputs, &pair.input, "input")?;
        let outputs = pair
            .outputs
            .iter()
            .map(|name| end(outputs, name, "output"))
            .collect::<Result<Vec<_>, _>>()?;
        let unstamped = std::iter::once(&input)
            .chain(&outputs)
            .find(|topic| !topic.stamped);
        let by = match (pair.by, unstamped) {
            (Some(Correlation::Stamp), Some(topic)) => {
                return Err(format!(
                    "answers: {} is a {}, which has no header.stamp; write \"by arrival\"",
                    topic.name, topic.type_name
                ));
            }
            (Some(by), _) => by,
            (None, None) => Correlation::Stamp,
            (None, Some(_)) => Correlation::Arrival,
        };
        if found.pairs.iter().any(|other| other.input == pair.input) {
            return Err(format!(
                "answers: {} appears twice; name all its outputs in one line",
                pair.input
            ));
        }
        found.pairs.push(Pair {
            by: Some(by),
            ..pair.clone()
        });
    }
    Ok(found)
}

/// What an action server's topics are called (actionlib), below the action's name.
const OF_ACTIONS: [&str; 5] = ["/goal", "/cancel", "/status", "/result", "/feedback"];

/// Each action is a pair: its goal, and the result and feedback that carry the goal's id.
fn actions(inputs: &[Topic], outputs: &[Topic]) -> Vec<Pair> {
    let goals = inputs.iter().filter_map(|input| {
        let action = input.name.strip_suffix("/goal")?;
        input.type_name.strip_suffix("ActionGoal")?;
        let has = |name: &String| outputs.iter().any(|output| output.name == *name);
        let answers = ["result", "feedback"].map(|end| format!("{action}/{end}"));
        has(&answers[0]).then(|| Pair {
            input: input.name.clone(),
            outputs: answers.into_iter().filter(has).collect(),
            by: Some(Correlation::Goal),
        })
    });
    goals.collect()
}

fn guessed(inputs: &[Topic], outputs: &[Topic]) -> Found {
    let actions = actions(inputs, outputs);
    let of_action = |topic: &Topic| {
        actions.iter().any(|pair| {
            let action = pair.input.strip_suffix("goal").unwrap_or_default();
            let end = topic.name.strip_prefix(action.trim_end_matches('/'));
            end.is_some_and(|end| OF_ACTIONS.contains(&end))
        })
    };
    let others = |topics: &[Topic]| -> Vec<Topic> {
        topics
            .iter()
            .filter(|topic| !of_action(topic))
            .cloned()
            .collect()
    };
    let mut found = triggered(&others(inputs), &others(outputs));
    found.pairs.extend(actions);
    found
}

/// The trigger among what belongs to no action, and what answers it.
fn triggered(inputs: &[Topic], outputs: &[Topic]) -> Found {
    let mut found = Found::default();
    let mut triggers: Vec<&Topic> = inputs
        .iter()
        .filter(|topic| !is_housekeeping(topic))
        .collect();
    triggers.sort_by_key(|topic| (rank(topic), topic.name.as_str()));
    let answers: Vec<&Topic> = outputs
        .iter()
        .filter(|topic| !is_housekeeping(topic))
        .collect();
    let Some((trigger, others)) = triggers.split_first() else {
        return found;
    };
    if answers.is_empty() {
        return found;
    }
    let stamped: Vec<&Topic> = answers
        .iter()
        .copied()
        .filter(|topic| topic.stamped)
        .collect();
    let (mut answers, by) = if trigger.stamped && !stamped.is_empty() {
        (stamped, Correlation::Stamp)
    } else {
        (answers, Correlation::Arrival)
    };
    answers.sort_by_key(|topic| (is_view(topic, trigger), topic.name.as_str()));
    if by == Correlation::Arrival {
        // Any output would do, and one of them has to be the answer.
        answers.truncate(1);
    }
    let pair = Pair {
        input: trigger.name.clone(),
        outputs: answers.iter().map(|topic| topic.name.clone()).collect(),
        by: Some(by),
    };
    for other in others {
        found.notes.push(format!(
            "{} is fed but not measured; {} is taken for the trigger",
            other.name, trigger.name
        ));
    }
    if others.len() + answers.len() > 1 {
        found.notes.push(format!(
            "to choose otherwise write answers = [\"{pair}\"] with other names"
        ));
    }
    found.pairs.push(pair);
    found
}

fn is_housekeeping(topic: &Topic) -> bool {
    HOUSEKEEPING.contains(&topic.name.as_str())
        || HOUSEKEEPING_ENDINGS
            .iter()
            .any(|ending| topic.name.ends_with(ending))
        || COMPANIONS.contains(&topic.type_name.as_str())
}

fn rank(topic: &Topic) -> u8 {
    match (DATA.contains(&topic.type_name.as_str()), topic.stamped) {
        (true, true) => 0,
        (true, false) => 1,
        (false, true) => 2,
        (false, false) => 3,
    }
}

fn is_view(output: &Topic, input: &Topic) -> u8 {
    let picture =
        output.type_name.ends_with("/Image") || output.type_name.ends_with("/CompressedImage");
    // A picture for a picture may be the result (rectified, say), but never where there is another result.
    u8::from(output.type_name == input.type_name) + u8::from(picture)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topics(list: &[(&str, &str, bool)]) -> Vec<Topic> {
        let topic = |(name, type_name, stamped): &(&str, &str, bool)| Topic {
            name: (*name).into(),
            type_name: (*type_name).into(),
            stamped: *stamped,
        };
        list.iter().map(topic).collect()
    }

    fn pairs(inputs: &[(&str, &str, bool)], outputs: &[(&str, &str, bool)]) -> Vec<String> {
        let found = find(&topics(inputs), &topics(outputs), None).unwrap();
        found.pairs.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn people_detect_answers_with_found() {
        let inputs = [("/image", "sensor_msgs/Image", true)];
        let outputs = [
            ("/people_detect/image", "sensor_msgs/Image", true),
            (
                "/people_detect/parameter_updates",
                "dynamic_reconfigure/Config",
                false,
            ),
            ("/people_detect/found", "opencv_apps/RectArrayStamped", true),
            ("/rosout", "rosgraph_msgs/Log", true),
        ];
        assert_eq!(
            pairs(&inputs, &outputs),
            ["/image -> /people_detect/found, /people_detect/image by stamp"]
        );
    }

    #[test]
    fn a_rectifier_answers_its_picture_not_its_calibration() {
        let inputs = [
            ("/camera/camera_info", "sensor_msgs/CameraInfo", true),
            ("/camera/image_raw", "sensor_msgs/Image", true),
        ];
        let outputs = [("/camera/image_rect", "sensor_msgs/Image", true)];
        assert_eq!(
            pairs(&inputs, &outputs),
            ["/camera/image_raw -> /camera/image_rect by stamp"]
        );
    }

    #[test]
    fn gmapping_is_triggered_by_scans() {
        let inputs = [
            ("/tf", "tf2_msgs/TFMessage", false),
            ("/scan", "sensor_msgs/LaserScan", true),
        ];
        let outputs = [
            ("/map", "nav_msgs/OccupancyGrid", true),
            ("/map_metadata", "nav_msgs/MapMetaData", false),
            ("/tf", "tf2_msgs/TFMessage", false),
        ];
        assert_eq!(pairs(&inputs, &outputs), ["/scan -> /map by stamp"]);
    }

    #[test]
    fn the_goal_of_an_action_is_answered_by_its_result() {
        let inputs = [
            ("/walk/goal", "p/WalkActionGoal", true),
            ("/walk/cancel", "actionlib_msgs/GoalID", false),
            ("/scan", "sensor_msgs/LaserScan", true),
        ];
        let outputs = [
            ("/walk/status", "actionlib_msgs/GoalStatusArray", true),
            ("/walk/result", "p/WalkActionResult", true),
            ("/walk/feedback", "p/WalkActionFeedback", true),
        ];
        assert_eq!(
            pairs(&inputs, &outputs),
            ["/walk/goal -> /walk/result, /walk/feedback by goal"]
        );
    }

    #[test]
    fn what_every_node_of_ros_2_has_answers_nothing() {
        let inputs = [("/in", "std_msgs/String", false)];
        let outputs = [
            ("/a/_action/feedback", "p/Walk_FeedbackMessage", false),
            ("/a/_action/status", "action_msgs/GoalStatusArray", false),
            (
                "/a/transition_event",
                "lifecycle_msgs/TransitionEvent",
                false,
            ),
            ("/out", "std_msgs/String", false),
            ("/parameter_events", "rcl_interfaces/ParameterEvent", false),
            ("/rosout", "rcl_interfaces/Log", false),
        ];
        assert_eq!(pairs(&inputs, &outputs), ["/in -> /out by arrival"]);
    }

    #[test]
    fn without_stamps_the_next_output_answers() {
        let inputs = [("/in", "std_msgs/String", false)];
        let outputs = [("/out", "std_msgs/String", false)];
        assert_eq!(pairs(&inputs, &outputs), ["/in -> /out by arrival"]);
    }

    #[test]
    fn a_source_and_a_sink_have_no_requests() {
        assert!(pairs(&[], &[("/out", "std_msgs/String", false)]).is_empty());
        assert!(pairs(&[("/in", "std_msgs/String", false)], &[]).is_empty());
    }

    #[test]
    fn one_line_overrides_and_is_checked() {
        let inputs = topics(&[
            ("/a", "std_msgs/String", false),
            ("/b", "sensor_msgs/Image", true),
        ]);
        let outputs = topics(&[("/x", "sensor_msgs/Image", true)]);
        let with = |text: &str| find(&inputs, &outputs, Some(&[text.parse().unwrap()]));
        assert_eq!(
            with("/a -> /x").unwrap().pairs[0].by,
            Some(Correlation::Arrival)
        );
        assert_eq!(
            with("/b -> /x").unwrap().pairs[0].by,
            Some(Correlation::Stamp)
        );
        assert_eq!(
            with("/b -> /x by arrival").unwrap().pairs[0].by,
            Some(Correlation::Arrival)
        );
        assert!(
            with("/a -> /x by stamp")
                .unwrap_err()
                .contains("/a is a std_msgs/String")
        );
        assert!(with("/c -> /x").unwrap_err().contains("it has /a, /b"));
        assert_eq!(find(&inputs, &outputs, Some(&[])).unwrap().pairs, []);
    }
}
