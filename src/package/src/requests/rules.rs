//! Pairs the inputs and outputs of one node: by what was seen, and where nothing was, by types and names.

use std::collections::BTreeSet;

use qos::{Correlation, Pair};

use super::{Reason, Watched};

/// One end of a topic, as the rules need it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct End {
    pub(super) name: String,
    /// `package/Type`, of whichever ROS.
    pub(super) type_name: String,
    /// The type begins with a `std_msgs/Header`.
    pub(super) is_stamped: bool,
    pub(super) is_latched: bool,
    /// The type is defined; that of a relay's ends is not.
    pub(super) is_known: bool,
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
/// Types that switch something on or off: an input of another type is the one that triggers.
const SWITCHES: [&str; 2] = ["std_msgs/Bool", "std_msgs/Empty"];
/// Words in names of pictures that accompany other pictures.
const ACCOMPANYING: [&str; 4] = ["depth", "disparity", "mask", "confidence"];

/// The pairs of one node, each with the reason.
///
/// An input whose stamp was seen on outputs is answered by those. Of the rest one input is the trigger: sensor data
/// before other types, with a stamp before without, switches last, then by name. With a stamp on both ends its answers
/// are all stamped outputs, and that whose type is neither the input's nor a picture (those are views for people) is
/// the one whose time counts. Without, it is whatever output comes next.
pub(super) fn pairs(
    inputs: &[End],
    outputs: &[End],
    watched: &BTreeSet<Watched>,
) -> Vec<(Pair, Reason)> {
    let mut triggers: Vec<&End> = inputs.iter().filter(|end| !is_housekeeping(end)).collect();
    triggers.sort_by_key(|end| (rank(end), is_accompanying(end), end.name.as_str()));
    let mut answers: Vec<&End> = outputs.iter().filter(|end| !is_housekeeping(end)).collect();
    let inputs = triggers.len();
    let mut pairs = Vec::new();
    let mut best_watched = u8::MAX;
    let mut unanswered = Vec::new();
    for trigger in triggers {
        let carried = |output: &&End| {
            let answer = Watched {
                input: trigger.name.clone(),
                output: output.name.clone(),
            };
            trigger.is_stamped && output.is_stamped && watched.contains(&answer)
        };
        let (seen, rest) = answers.into_iter().partition(carried);
        answers = rest;
        match pair(trigger, seen, Correlation::Stamp) {
            Some(pair) => {
                best_watched = best_watched.min(rank(trigger));
                pairs.push((pair, Reason::Watched));
            }
            None => unanswered.push(trigger),
        }
    }
    // A likelier input than those that were seen to be answered, or nothing was seen.
    let likelier = unanswered
        .first()
        .filter(|trigger| rank(trigger) < best_watched);
    match likelier {
        Some(trigger) => pairs.extend(guess(trigger, inputs, answers)),
        None => {
            // Views that were not published for what the push gave.
            if let [(pair, _)] = &mut pairs[..] {
                let views = answers.into_iter().filter(|end| end.is_stamped);
                pair.outputs.extend(views.map(|end| end.name.clone()));
            }
        }
    }
    pairs
}

/// The likeliest answers to the likeliest of so many inputs.
fn guess(trigger: &End, inputs: usize, answers: Vec<&End>) -> Option<(Pair, Reason)> {
    let stamped: Vec<&End> = answers
        .iter()
        .copied()
        .filter(|end| end.is_stamped)
        .collect();
    let (answers, by) = if trigger.is_stamped && !stamped.is_empty() {
        (stamped, Correlation::Stamp)
    } else {
        // A latched output tells a state; it is the answer where there is no other.
        let passing: Vec<&End> = answers
            .iter()
            .copied()
            .filter(|end| !end.is_latched)
            .collect();
        let all = if passing.is_empty() { answers } else { passing };
        (all, Correlation::Arrival)
    };
    let reason = if inputs == 1 && answers.len() == 1 {
        Reason::Alone
    } else {
        Reason::Guessed
    };
    Some((pair(trigger, answers, by)?, reason))
}

/// The pair of these topics; none without an output.
fn pair(trigger: &End, mut answers: Vec<&End>, by: Correlation) -> Option<Pair> {
    answers.sort_by_key(|end| (is_view(end, trigger), end.is_latched, end.name.as_str()));
    if by == Correlation::Arrival {
        // Any output would do, and one of them has to be the answer.
        answers.truncate(1);
    }
    let is_known = trigger.is_known && answers.iter().all(|end| end.is_known);
    let outputs: Vec<String> = answers.iter().map(|end| end.name.clone()).collect();
    (!outputs.is_empty()).then(|| Pair {
        input: trigger.name.clone(),
        outputs,
        // Else the robot sees which types they have there.
        by: is_known.then_some(by),
    })
}

/// Whether a topic is no request and no answer, whatever else there is. Nodes may call topics as no ROS allows; what is decided could not be
/// read again with such a name.
fn is_housekeeping(end: &End) -> bool {
    !Pair::can_name(&end.name)
        || HOUSEKEEPING.contains(&end.name.as_str())
        || HOUSEKEEPING_ENDINGS
            .iter()
            .any(|ending| end.name.ends_with(ending))
        || COMPANIONS.contains(&end.type_name.as_str())
}

/// The less, the likelier a message is a request.
fn rank(end: &End) -> u8 {
    let is_data = DATA.contains(&end.type_name.as_str());
    match (is_data, end.is_stamped) {
        (true, true) => 0,
        (true, false) => 1,
        (false, true) => 2,
        (false, false) if SWITCHES.contains(&end.type_name.as_str()) => 4,
        (false, false) => 3,
    }
}

fn is_accompanying(end: &End) -> bool {
    let name = end.name.to_lowercase();
    ACCOMPANYING.iter().any(|word| name.contains(word))
}

fn is_view(output: &End, input: &End) -> u8 {
    let is_picture =
        output.type_name.ends_with("/Image") || output.type_name.ends_with("/CompressedImage");
    // A picture for a picture may be the result (rectified, say), but never where there is another result.
    u8::from(output.type_name == input.type_name) + u8::from(is_picture)
}
