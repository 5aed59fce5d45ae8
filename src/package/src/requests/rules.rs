//! Rules that pair the inputs and outputs of a node: by observed answers, otherwise by types and names.

use std::collections::BTreeSet;

use qos::{Correlation, TopicPair};

use super::ObservedAnswer;
use crate::request::Reason;

/// Properties of a topic used by the rules.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TopicEnd {
    pub(super) name: String,
    /// Type as `package/Type`, for both ROS versions.
    pub(super) type_name: String,
    /// True if the type begins with a `std_msgs/Header`.
    pub(super) is_stamped: bool,
    pub(super) is_latched: bool,
    /// True if the type is defined; false for the topics of a relay.
    pub(super) is_known: bool,
}

/// Common topics that are neither requests nor answers.
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
    // Topics of ROS 2 actions, whose goals and results are calls.
    "/_action/feedback",
    "/_action/status",
];
/// Types that accompany data or configure nodes, and trigger nothing.
const COMPANIONS: [&str; 7] = [
    "sensor_msgs/CameraInfo",
    "tf2_msgs/TFMessage",
    "tf/tfMessage",
    "dynamic_reconfigure/Config",
    "dynamic_reconfigure/ConfigDescription",
    "bond/Status",
    "rosgraph_msgs/Clock",
];
/// Types of sensor data: such an input is the trigger if there is one.
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
/// Types of switches: an input of another type takes precedence as the trigger.
const SWITCHES: [&str; 2] = ["std_msgs/Bool", "std_msgs/Empty"];
/// Words in the names of images that accompany other images.
const ACCOMPANYING: [&str; 4] = ["depth", "disparity", "mask", "confidence"];

/// Returns the pairs of a node and how they were determined.
///
/// An input whose stamp was observed on outputs is answered by those. Of the remaining inputs one is the trigger:
/// sensor data before other types, with a stamp before without, switches last, then by name. If trigger and outputs
/// have stamps, its answers are all stamped outputs; the response time is that of the output whose type is neither the
/// input's nor an image (images are visualizations). Otherwise the next output of any kind is the answer.
pub(super) fn pair_topics(
    inputs: &[TopicEnd],
    outputs: &[TopicEnd],
    watched: &BTreeSet<ObservedAnswer>,
) -> Vec<(TopicPair, Reason)> {
    let mut triggers: Vec<&TopicEnd> = inputs.iter().filter(|end| !is_housekeeping(end)).collect();
    triggers.sort_by_key(|end| (trigger_rank(end), is_accompanying(end), end.name.as_str()));
    let mut answers: Vec<&TopicEnd> = outputs.iter().filter(|end| !is_housekeeping(end)).collect();
    let inputs = triggers.len();
    let mut pairs = Vec::new();
    let mut best_watched = u8::MAX;
    let mut unanswered = Vec::new();
    for trigger in triggers {
        let carried = |output: &&TopicEnd| {
            let answer = ObservedAnswer { input: trigger.name.clone(), output: output.name.clone() };
            trigger.is_stamped && output.is_stamped && watched.contains(&answer)
        };
        let (seen, rest) = answers.into_iter().partition(carried);
        answers = rest;
        match make_pair(trigger, seen, Correlation::Stamp) {
            Some(pair) => {
                best_watched = best_watched.min(trigger_rank(trigger));
                pairs.push((pair, Reason::Watched));
            }
            None => unanswered.push(trigger),
        }
    }
    // The trigger is likelier than the inputs with observed answers, or nothing was observed.
    let likelier = unanswered.first().filter(|trigger| trigger_rank(trigger) < best_watched);
    match likelier {
        Some(trigger) => pairs.extend(guess(trigger, inputs, answers)),
        None => {
            // Visualizations that were not published for the messages sent by the push.
            if let [(pair, _)] = &mut pairs[..] {
                let views = answers.into_iter().filter(|end| end.is_stamped);
                pair.outputs.extend(views.map(|end| end.name.clone()));
            }
        }
    }
    pairs
}

/// Guesses the answers to the most likely of `inputs` inputs.
fn guess(trigger: &TopicEnd, inputs: usize, answers: Vec<&TopicEnd>) -> Option<(TopicPair, Reason)> {
    let stamped: Vec<&TopicEnd> = answers.iter().copied().filter(|end| end.is_stamped).collect();
    let (answers, by) = if trigger.is_stamped && !stamped.is_empty() {
        (stamped, Correlation::Stamp)
    } else {
        // A latched output represents a state; it is the answer only if there is no other.
        let passing: Vec<&TopicEnd> = answers.iter().copied().filter(|end| !end.is_latched).collect();
        let all = if passing.is_empty() { answers } else { passing };
        (all, Correlation::Arrival)
    };
    let reason = if inputs == 1 && answers.len() == 1 { Reason::Alone } else { Reason::Guessed };
    Some((make_pair(trigger, answers, by)?, reason))
}

/// Creates the pair of these topics; `None` without an output.
fn make_pair(trigger: &TopicEnd, mut answers: Vec<&TopicEnd>, by: Correlation) -> Option<TopicPair> {
    answers.sort_by_key(|end| (view_rank(end, trigger), end.is_latched, end.name.as_str()));
    if by == Correlation::Arrival {
        // Any output would be an answer, so a single one must be chosen.
        answers.truncate(1);
    }
    let is_known = trigger.is_known && answers.iter().all(|end| end.is_known);
    let outputs: Vec<String> = answers.iter().map(|end| end.name.clone()).collect();
    (!outputs.is_empty()).then(|| TopicPair {
        input: trigger.name.clone(),
        outputs,
        // Otherwise the robot determines it from the types that the topics have there.
        by: is_known.then_some(by),
    })
}

/// Returns whether a topic is never a request or an answer. Nodes may use topic names that ROS does not allow; a pair
/// with such a name could not be parsed again.
fn is_housekeeping(end: &TopicEnd) -> bool {
    !TopicPair::is_valid_topic(&end.name)
        || HOUSEKEEPING.contains(&end.name.as_str())
        || HOUSEKEEPING_ENDINGS.iter().any(|ending| end.name.ends_with(ending))
        || COMPANIONS.contains(&end.type_name.as_str())
}

/// Returns the rank of an input as a request; lower is likelier.
fn trigger_rank(end: &TopicEnd) -> u8 {
    let is_data = DATA.contains(&end.type_name.as_str());
    match (is_data, end.is_stamped) {
        (true, true) => 0,
        (true, false) => 1,
        (false, true) => 2,
        (false, false) if SWITCHES.contains(&end.type_name.as_str()) => 4,
        (false, false) => 3,
    }
}

fn is_accompanying(end: &TopicEnd) -> bool {
    let name = end.name.to_lowercase();
    ACCOMPANYING.iter().any(|word| name.contains(word))
}

fn view_rank(output: &TopicEnd, input: &TopicEnd) -> u8 {
    let is_picture = output.type_name.ends_with("/Image") || output.type_name.ends_with("/CompressedImage");
    // An image for an image may be the result (a rectified one, for example), but not if there is another result.
    u8::from(output.type_name == input.type_name) + u8::from(is_picture)
}
