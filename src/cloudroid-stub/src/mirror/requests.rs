//! Pairs of inputs and the outputs that answer them, decided when the service was pushed, or stated by the robot's
//! owner. Nothing is guessed here; a decided request applies as soon as its topics exist under their names on this
//! robot.

use qos::{Correlation, TopicPair};
use ros::remaps::Remaps;

use super::known_interface::KnownInterface;
use crate::local;
use crate::revision::DecidedRequest;
use crate::robot::LaunchedNode;

/// A request, with the possible names of each of its topics on this robot, the most likely first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RequestPattern {
    input: Vec<String>,
    outputs: Vec<Vec<String>>,
    by: Option<Correlation>,
}

impl RequestPattern {
    /// Returns the pattern of a pair whose topics have their names on this robot.
    pub fn from_pair(pair: &TopicPair) -> Self {
        Self {
            input: vec![pair.input.clone()],
            outputs: pair.outputs.iter().map(|name| vec![name.clone()]).collect(),
            by: pair.by,
        }
    }

    /// Returns the patterns of the requests that the push has decided for this executable, with the names on this
    /// robot.
    pub fn from_revision(all: &[DecidedRequest], executable: &str, robot: &LaunchedNode) -> Vec<Self> {
        let remaps = Remaps::parse(robot.ros, &robot.argv, &robot.node);
        let is_of_it = |of: &&DecidedRequest| of.program.as_deref().is_none_or(|of| of == executable);
        let request = |of: &DecidedRequest| {
            let pair = of.request.parse::<TopicPair>();
            let pair = pair.inspect_err(|error| {
                tracing::warn!("revision.toml: {error}; response times of this request are not measured");
            });
            let pair = pair.ok()?;
            let names = |name: &String| candidate_names(name, &of.node, &robot.node, &remaps);
            Some(Self { input: names(&pair.input), outputs: pair.outputs.iter().map(names).collect(), by: pair.by })
        };
        all.iter().filter(is_of_it).filter_map(request).collect()
    }

    /// Returns the pair as soon as its input and its answer exist; further outputs are added when they exist.
    pub(super) fn resolve(&self, known: &KnownInterface) -> Option<TopicPair> {
        let input = self.input.iter().find_map(|name| known.inputs.get_key_value(name))?;
        let output = |names: &Vec<String>| names.iter().find_map(|name| known.outputs.get_key_value(name));
        output(self.outputs.first()?)?;
        let outputs: Vec<_> = self.outputs.iter().filter_map(output).collect();
        let is_stamped = std::iter::once(&input).chain(&outputs).all(|(_, of)| local::is_stamped(of));
        let by = match (self.by, is_stamped) {
            // Messages without a stamp cannot be matched by it.
            (None, true) => Correlation::Stamp,
            (None | Some(Correlation::Stamp), false) => Correlation::Arrival,
            (Some(by), _) => by,
        };
        Some(TopicPair {
            input: input.0.clone(),
            outputs: outputs.into_iter().map(|(name, _)| name.clone()).collect(),
            by: Some(by),
        })
    }
}

/// Returns the possible names, for the node `now`, of a topic of the node `then` (at the push). The name within the
/// program is unknown, so it may be private, relative to the namespace, or absolute.
fn candidate_names(name: &str, then: &str, now: &str, remaps: &Remaps) -> Vec<String> {
    let namespace = |node: &str| node.rsplit_once('/').map_or("", |(above, _)| above).to_owned();
    let moved = |from: &str, to: &str| {
        let rest = name.strip_prefix(from).filter(|rest| rest.starts_with('/'));
        rest.map(|rest| format!("{to}{rest}"))
    };
    let below = moved(then, now).filter(|_| !then.is_empty());
    let beside = moved(&namespace(then), &namespace(now));
    let mut names: Vec<String> = Vec::new();
    for name in below.into_iter().chain(beside).chain([name.to_owned()]) {
        let name = remaps.apply(&name).to_owned();
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// Returns a pair for each ROS 1 action, defined by its protocol: the goal is answered by the result and the feedback
/// that carry its id.
pub(super) fn action_pairs(known: &KnownInterface) -> impl Iterator<Item = TopicPair> {
    known.inputs.iter().filter_map(|(goal, of)| {
        let action = goal.strip_suffix("/goal")?;
        of.name.strip_suffix("ActionGoal")?;
        let mut outputs = ["result", "feedback"].map(|end| format!("{action}/{end}")).to_vec();
        outputs.retain(|output| known.outputs.contains_key(output));
        let has_result = outputs.first().is_some_and(|output| output.ends_with("/result"));
        has_result.then(|| TopicPair { input: goal.clone(), outputs, by: Some(Correlation::Goal) })
    })
}

#[cfg(test)]
mod tests {
    use ros::bus::{RosVersion, WireType};

    use super::*;

    fn known_interface(inputs: &[&str], outputs: &[&str]) -> KnownInterface {
        let topic = |text: &&str| {
            let (name, of) = text.split_once(' ').unwrap_or((text, "std_msgs/String"));
            (name.to_owned(), WireType::with_name(of))
        };
        KnownInterface {
            inputs: inputs.iter().map(topic).collect(),
            outputs: outputs.iter().map(topic).collect(),
            ..KnownInterface::default()
        }
    }

    fn pair_texts(requests: &[RequestPattern], known: &KnownInterface) -> Vec<String> {
        let pairs = known.pairs(requests).into_iter();
        pairs.map(|pair| pair.to_string()).collect()
    }

    #[test]
    fn decided_requests_count_as_soon_as_their_topics_exist_in_whatever_order() {
        let stated = ["/image -> /boxes, /view", "/word -> /said"];
        let stated = stated.map(|pair| RequestPattern::from_pair(&pair.parse().unwrap()));
        let image = "/image sensor_msgs/Image";
        let boxes = "/boxes geometry_msgs/PoseStamped";
        let all = [(true, "/depth_enable std_msgs/Bool"), (true, image), (false, boxes)];
        for order in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
            let mut seen: [Vec<&str>; 2] = Default::default();
            for at in order {
                let (is_input, topic) = all[at];
                seen[usize::from(!is_input)].push(topic);
                let has = |topic| seen.iter().flatten().any(|one| *one == topic);
                let expected: &[&str] = if has(image) && has(boxes) { &["/image -> /boxes by stamp"] } else { &[] };
                let found = pair_texts(&stated, &known_interface(&seen[0], &seen[1]));
                assert_eq!(found, expected, "{order:?} {seen:?}");
            }
        }
        let view = "/view sensor_msgs/Image";
        let grown = known_interface(&[image, "/word"], &[boxes, view, "/said"]);
        assert_eq!(pair_texts(&stated, &grown), ["/image -> /boxes, /view by stamp", "/word -> /said by arrival"]);
        // A view alone is no answer.
        assert!(pair_texts(&stated, &known_interface(&[image], &[view])).is_empty());
    }

    #[test]
    fn a_stamp_counts_where_both_ends_have_one() {
        let stated = |text: &str| [RequestPattern::from_pair(&text.parse().unwrap())];
        let words = known_interface(&["/in"], &["/out"]);
        for text in ["/in -> /out by stamp", "/in -> /out by arrival", "/in -> /out"] {
            assert_eq!(pair_texts(&stated(text), &words), ["/in -> /out by arrival"]);
        }
        let image = known_interface(&["/in sensor_msgs/Image"], &["/out sensor_msgs/Image"]);
        assert_eq!(pair_texts(&stated("/in -> /out by arrival"), &image), ["/in -> /out by arrival"]);
    }

    #[test]
    fn actions_are_pairs_by_their_protocol() {
        let walk = known_interface(
            &["/walk/goal p/WalkActionGoal", "/walk/cancel", "/scan"],
            &["/walk/status", "/walk/result", "/walk/feedback"],
        );
        assert_eq!(pair_texts(&[], &walk), ["/walk/goal -> /walk/result, /walk/feedback by goal"]);
        let own = RequestPattern::from_pair(&"/walk/goal -> /walk/result by goal".parse().unwrap());
        assert_eq!(pair_texts(&[own], &walk), ["/walk/goal -> /walk/result by goal"]);
        assert!(pair_texts(&[], &known_interface(&["/walk/goal p/WalkActionGoal"], &["/walk/feedback"])).is_empty());
    }

    #[test]
    fn topics_are_found_under_the_names_of_this_robot() {
        let find = |ros, then: &str, request: &str, now: &str, line: &str, inputs: &[&str], outputs: &[&str]| {
            let robot = LaunchedNode {
                ros,
                place: crate::robot::RosLocation::Master { host: String::new(), port: 0, own: None },
                node: now.to_owned(),
                name_by_program: None,
                argv: line.split_whitespace().map(str::to_owned).collect(),
                original_argv: Vec::new(),
                parameters: Default::default(),
                sim_time: false,
            };
            let of = |program: Option<&str>| DecidedRequest {
                node: then.to_owned(),
                program: program.map(str::to_owned),
                request: request.to_owned(),
            };
            let none = RequestPattern::from_revision(&[of(Some("other"))], "find", &robot);
            assert!(none.is_empty(), "of another program");
            let unreadable = DecidedRequest { request: "/a by magic".to_owned(), ..of(None) };
            let all = [unreadable, of(Some("find"))];
            pair_texts(&RequestPattern::from_revision(&all, "find", &robot), &known_interface(inputs, outputs))
                .join("; ")
        };
        let one = RosVersion::One;
        // Same name as at the push; in a namespace; with its own name; remapped; and a name that is absolute in the
        // program.
        let request = "/image -> /finder/found by arrival";
        let there = |now, line, input, output: &str| find(one, "/finder", request, now, line, &[input], &[output]);
        assert_eq!(there("/finder", "", "/image", "/finder/found"), "/image -> /finder/found by arrival");
        assert_eq!(
            there("/front/eye", "", "/front/image", "/front/eye/found"),
            "/front/image -> /front/eye/found by arrival"
        );
        assert_eq!(
            there("/front/eye", "image:=/camera ~found:=/boxes", "/camera", "/boxes"),
            "/camera -> /boxes by arrival"
        );
        assert_eq!(
            there("/front/eye", "", "/image", "/front/finder/found"),
            "/image -> /front/finder/found by arrival"
        );
        assert_eq!(there("/finder", "", "/other", "/finder/found"), "");
        // The push had it in a namespace.
        assert_eq!(
            find(one, "/lab/finder", "/lab/image -> /lab/finder/found", "/finder", "", &["/image"], &["/finder/found"]),
            "/image -> /finder/found by arrival"
        );
        let line = "--ros-args -r image:=/camera -r eye:~/found:=/boxes";
        assert_eq!(
            find(RosVersion::Two, "/finder", request, "/front/eye", line, &["/camera"], &["/boxes"]),
            "/camera -> /boxes by arrival"
        );
        // The node that had the topic is unknown.
        assert_eq!(
            find(one, "", "/image -> /found", "/front/eye", "", &["/front/image"], &["/found"]),
            "/front/image -> /found by arrival"
        );
    }
}
