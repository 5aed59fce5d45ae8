//! Which input is answered by which output: decided when the service was pushed, or stated by the robot's owner.
//! Nothing is guessed here; a decided request counts once its topics exist under the names that they have on this
//! robot.

use qos::{Correlation, Pair};
use ros::remaps::Remaps;

use super::known::Known;
use crate::local;
use crate::revision::Answered;
use crate::robot::Robot;

/// A request, each of its topics by the names that it may have on this robot, the likeliest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    input: Vec<String>,
    outputs: Vec<Vec<String>>,
    by: Option<Correlation>,
}

impl Request {
    /// Of topics as they are called on this robot.
    pub fn stated(pair: &Pair) -> Self {
        Self {
            input: vec![pair.input.clone()],
            outputs: pair.outputs.iter().map(|name| vec![name.clone()]).collect(),
            by: pair.by,
        }
    }

    /// Those that the push has decided of this executable, as they are on this robot.
    pub fn decided(all: &[Answered], executable: &str, robot: &Robot) -> Vec<Self> {
        let remaps = Remaps::of(robot.ros, &robot.argv, &robot.node);
        let is_of_it = |of: &&Answered| of.program.as_deref().is_none_or(|of| of == executable);
        let request = |of: &Answered| {
            let pair = of.request.parse::<Pair>();
            let pair = pair.inspect_err(|error| {
                tracing::warn!("revision.toml: {error}; this request is not judged");
            });
            let pair = pair.ok()?;
            let names = |name: &String| names(name, &of.node, &robot.node, &remaps);
            Some(Self {
                input: names(&pair.input),
                outputs: pair.outputs.iter().map(names).collect(),
                by: pair.by,
            })
        };
        all.iter().filter(is_of_it).filter_map(request).collect()
    }

    /// The pair that it is, once its input and its answer exist; further outputs join it when they do.
    pub(super) fn pair(&self, known: &Known) -> Option<Pair> {
        let input = self
            .input
            .iter()
            .find_map(|name| known.inputs.get_key_value(name))?;
        let output = |names: &Vec<String>| {
            names
                .iter()
                .find_map(|name| known.outputs.get_key_value(name))
        };
        output(self.outputs.first()?)?;
        let outputs: Vec<_> = self.outputs.iter().filter_map(output).collect();
        let is_stamped = std::iter::once(&input)
            .chain(&outputs)
            .all(|(_, of)| local::is_stamped(of));
        let by = match (self.by, is_stamped) {
            // What has no stamp here cannot be recognised by it.
            (None, true) => Correlation::Stamp,
            (None | Some(Correlation::Stamp), false) => Correlation::Arrival,
            (Some(by), _) => by,
        };
        Some(Pair {
            input: input.0.clone(),
            outputs: outputs.into_iter().map(|(name, _)| name.clone()).collect(),
            by: Some(by),
        })
    }
}

/// What a topic of the node `then` (at the push) may be called by the node `now`: a program's own word for it is not
/// known, so it may lie below its node, in its namespace, or anywhere.
fn names(name: &str, then: &str, now: &str, remaps: &Remaps) -> Vec<String> {
    let namespace = |node: &str| {
        node.rsplit_once('/')
            .map_or("", |(above, _)| above)
            .to_owned()
    };
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

/// Each action of ROS 1 is a pair by its protocol: its goal, and the result and feedback that carry the goal's id.
pub(super) fn actions(known: &Known) -> impl Iterator<Item = Pair> {
    known.inputs.iter().filter_map(|(goal, of)| {
        let action = goal.strip_suffix("/goal")?;
        of.name.strip_suffix("ActionGoal")?;
        let mut outputs = ["result", "feedback"]
            .map(|end| format!("{action}/{end}"))
            .to_vec();
        outputs.retain(|output| known.outputs.contains_key(output));
        let has_result = outputs
            .first()
            .is_some_and(|output| output.ends_with("/result"));
        has_result.then(|| Pair {
            input: goal.clone(),
            outputs,
            by: Some(Correlation::Goal),
        })
    })
}

#[cfg(test)]
mod tests {
    use ros::bus::{RosVersion, WireType};

    use super::*;

    fn known(inputs: &[&str], outputs: &[&str]) -> Known {
        let topic = |text: &&str| {
            let (name, of) = text.split_once(' ').unwrap_or((text, "std_msgs/String"));
            (name.to_owned(), WireType::named(of))
        };
        Known {
            inputs: inputs.iter().map(topic).collect(),
            outputs: outputs.iter().map(topic).collect(),
            ..Known::default()
        }
    }

    fn shown(requests: &[Request], known: &Known) -> Vec<String> {
        let pairs = known.pairs(requests).into_iter();
        pairs.map(|pair| pair.to_string()).collect()
    }

    #[test]
    fn decided_requests_count_as_soon_as_their_topics_exist_in_whatever_order() {
        let stated = ["/image -> /boxes, /view", "/word -> /said"];
        let stated = stated.map(|pair| Request::stated(&pair.parse().unwrap()));
        let image = "/image sensor_msgs/Image";
        let boxes = "/boxes geometry_msgs/PoseStamped";
        let all = [
            (true, "/depth_enable std_msgs/Bool"),
            (true, image),
            (false, boxes),
        ];
        for order in [
            [0, 1, 2],
            [0, 2, 1],
            [1, 0, 2],
            [1, 2, 0],
            [2, 0, 1],
            [2, 1, 0],
        ] {
            let mut seen: [Vec<&str>; 2] = Default::default();
            for at in order {
                let (is_input, topic) = all[at];
                seen[usize::from(!is_input)].push(topic);
                let has = |topic| seen.iter().flatten().any(|one| *one == topic);
                let expected: &[&str] = if has(image) && has(boxes) {
                    &["/image -> /boxes by stamp"]
                } else {
                    &[]
                };
                let found = shown(&stated, &known(&seen[0], &seen[1]));
                assert_eq!(found, expected, "{order:?} {seen:?}");
            }
        }
        let view = "/view sensor_msgs/Image";
        let grown = known(&[image, "/word"], &[boxes, view, "/said"]);
        assert_eq!(
            shown(&stated, &grown),
            [
                "/image -> /boxes, /view by stamp",
                "/word -> /said by arrival"
            ]
        );
        // A view alone is no answer.
        assert!(shown(&stated, &known(&[image], &[view])).is_empty());
    }

    #[test]
    fn a_stamp_counts_where_both_ends_have_one() {
        let stated = |text: &str| [Request::stated(&text.parse().unwrap())];
        let words = known(&["/in"], &["/out"]);
        for text in [
            "/in -> /out by stamp",
            "/in -> /out by arrival",
            "/in -> /out",
        ] {
            assert_eq!(shown(&stated(text), &words), ["/in -> /out by arrival"]);
        }
        let image = known(&["/in sensor_msgs/Image"], &["/out sensor_msgs/Image"]);
        assert_eq!(
            shown(&stated("/in -> /out by arrival"), &image),
            ["/in -> /out by arrival"]
        );
    }

    #[test]
    fn actions_are_pairs_by_their_protocol() {
        let walk = known(
            &["/walk/goal p/WalkActionGoal", "/walk/cancel", "/scan"],
            &["/walk/status", "/walk/result", "/walk/feedback"],
        );
        assert_eq!(
            shown(&[], &walk),
            ["/walk/goal -> /walk/result, /walk/feedback by goal"]
        );
        let own = Request::stated(&"/walk/goal -> /walk/result by goal".parse().unwrap());
        assert_eq!(shown(&[own], &walk), ["/walk/goal -> /walk/result by goal"]);
        assert!(
            shown(
                &[],
                &known(&["/walk/goal p/WalkActionGoal"], &["/walk/feedback"])
            )
            .is_empty()
        );
    }

    #[test]
    fn topics_are_found_under_the_names_of_this_robot() {
        let find = |ros,
                    then: &str,
                    request: &str,
                    now: &str,
                    line: &str,
                    inputs: &[&str],
                    outputs: &[&str]| {
            let robot = Robot {
                ros,
                place: crate::robot::Place::Master {
                    host: String::new(),
                    port: 0,
                    own: None,
                },
                node: now.to_owned(),
                argv: line.split_whitespace().map(str::to_owned).collect(),
                original_argv: Vec::new(),
                parameters: Default::default(),
                sim_time: false,
            };
            let of = |program: Option<&str>| Answered {
                node: then.to_owned(),
                program: program.map(str::to_owned),
                request: request.to_owned(),
            };
            let none = Request::decided(&[of(Some("other"))], "find", &robot);
            assert!(none.is_empty(), "of another program");
            let unreadable = Answered {
                request: "/a by magic".to_owned(),
                ..of(None)
            };
            let all = [unreadable, of(Some("find"))];
            shown(
                &Request::decided(&all, "find", &robot),
                &known(inputs, outputs),
            )
            .join("; ")
        };
        let one = RosVersion::One;
        // As at the push; in a namespace, by a name of its own, remapped; and a name that is absolute in the program.
        let request = "/image -> /finder/found by arrival";
        let there = |now, line, input, output: &str| {
            find(one, "/finder", request, now, line, &[input], &[output])
        };
        assert_eq!(
            there("/finder", "", "/image", "/finder/found"),
            "/image -> /finder/found by arrival"
        );
        assert_eq!(
            there("/front/eye", "", "/front/image", "/front/eye/found"),
            "/front/image -> /front/eye/found by arrival"
        );
        assert_eq!(
            there(
                "/front/eye",
                "image:=/camera ~found:=/boxes",
                "/camera",
                "/boxes"
            ),
            "/camera -> /boxes by arrival"
        );
        assert_eq!(
            there("/front/eye", "", "/image", "/front/finder/found"),
            "/image -> /front/finder/found by arrival"
        );
        assert_eq!(there("/finder", "", "/other", "/finder/found"), "");
        // The push had it in a namespace.
        assert_eq!(
            find(
                one,
                "/lab/finder",
                "/lab/image -> /lab/finder/found",
                "/finder",
                "",
                &["/image"],
                &["/finder/found"]
            ),
            "/image -> /finder/found by arrival"
        );
        let line = "--ros-args -r image:=/camera -r eye:~/found:=/boxes";
        assert_eq!(
            find(
                RosVersion::Two,
                "/finder",
                request,
                "/front/eye",
                line,
                &["/camera"],
                &["/boxes"]
            ),
            "/camera -> /boxes by arrival"
        );
        // Nobody knows whose it was.
        assert_eq!(
            find(
                one,
                "",
                "/image -> /found",
                "/front/eye",
                "",
                &["/front/image"],
                &["/found"]
            ),
            "/front/image -> /found by arrival"
        );
    }
}
