//! Heuristics for stateful services, whose answers depend on earlier inputs: the deployer is asked, nothing is decided
//! here.

use package::interface::{Direction, Interface, Topic};

/// Message types that accumulate many inputs.
const MAPS: [&str; 5] = [
    "nav_msgs/OccupancyGrid",
    "map_msgs/ProjectedMap",
    "octomap_msgs/Octomap",
    "grid_map_msgs/GridMap",
    "nav_msgs/GetMapResult",
];

/// Words in names of services that change how a node works.
const SWITCHING: [&str; 12] =
    ["set", "enable", "disable", "switch", "select", "toggle", "reset", "clear", "start", "stop", "pause", "resume"];

/// Returns the signs of state, one phrase each; `growing` are outputs whose messages grew steadily.
pub(super) fn find_signs(interface: &Interface, growing: &[String]) -> Vec<String> {
    let of = |direction: Direction| {
        let topics = interface.topics.iter();
        topics.filter(move |topic| topic.direction == direction)
    };
    // A service without inputs cannot have state: a map server, for example.
    let is_given = of(Direction::Input).any(|topic| !is_transforms(topic));
    if !is_given {
        return Vec::new();
    }
    let sign = |topic: &Topic| {
        let name = &topic.name;
        if topic.latched && MAPS.contains(&topic.type_name.as_str()) {
            Some(format!("{name} is a map, and latched ({})", topic.type_name))
        } else if name == "/tf" {
            Some("it publishes transforms on /tf".to_owned())
        } else if growing.contains(name) {
            Some(format!("messages on {name} kept growing"))
        } else {
            None
        }
    };
    let mut signs: Vec<String> = of(Direction::Output).filter_map(sign).collect();
    signs.extend(find_switches(interface));
    signs
}

/// Returns the services and actions that may change how messages are answered: only the side that answers receives such
/// a call, and the other side does not know of it.
fn find_switches(interface: &Interface) -> Vec<String> {
    let requests = interface.requests.iter().flatten();
    let Some(answer) = requests.filter_map(|request| request.pair.outputs.first()).next() else {
        return Vec::new();
    };
    let may = |what: &str, name: &str| format!("its {what} {name} may change its answers on {answer}");
    let actions = interface.actions.iter().map(|action| may("action", &action.name));
    let services = interface.services.iter();
    let services = services.filter(|service| is_switch(&service.name, &service.type_name));
    actions.chain(services.map(|service| may("service", &service.name))).collect()
}

/// Returns whether a service is likely to change how its node works, judging by its type and name.
fn is_switch(name: &str, type_name: &str) -> bool {
    // Settings made by it are given to both sides.
    if type_name == "dynamic_reconfigure/Reconfigure" {
        return false;
    }
    let last = name.rsplit('/').next().unwrap_or(name).to_lowercase();
    let words: Vec<&str> = last.split('_').collect();
    type_name.replacen("/srv/", "/", 1) == "std_srvs/SetBool" || words.iter().any(|word| SWITCHING.contains(word))
}

/// Returns the question to the deployer; `None` without signs of state.
pub(super) fn question(signs: &[String]) -> Option<String> {
    if signs.is_empty() {
        return None;
    }
    Some(format!(
        "answers seem to depend on earlier inputs: {}. If they do, push again with --stateful: a robot's local \
            original then answers only while the link is down, and each hand-over reports what is lost. If not, push \
            with --stateful=false",
        signs.join("; ")
    ))
}

fn is_transforms(topic: &Topic) -> bool {
    matches!(topic.name.as_str(), "/tf" | "/tf_static")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use ros::bus::RosVersion;

    use super::*;

    fn topic(name: &str, type_name: &str, direction: Direction, latched: bool) -> Topic {
        Topic {
            name: name.into(),
            type_name: type_name.into(),
            md5: String::new(),
            direction,
            nodes: Vec::new(),
            latched,
            lazy: false,
            qos: None,
        }
    }

    fn signs_from_topics(topics: Vec<Topic>, growing: &[&str]) -> Vec<String> {
        let interface = Interface { topics, ..Interface::default() };
        let growing: Vec<String> = growing.iter().map(|name| (*name).to_owned()).collect();
        find_signs(&interface, &growing)
    }

    #[test]
    fn maps_transforms_and_what_grows_point_to_state() {
        use Direction::{Input, Output};
        let scan = || topic("/scan", "sensor_msgs/LaserScan", Input, false);
        let map = |latched| topic("/map", "nav_msgs/OccupancyGrid", Output, latched);
        let tf = |direction| topic("/tf", "tf2_msgs/TFMessage", direction, false);
        let path = || topic("/path", "nav_msgs/Path", Output, false);
        for (what, topics, growing, words) in [
            ("gmapping", vec![scan(), tf(Input), map(true), tf(Output)], vec![], vec!["/map is a map", "on /tf"]),
            ("a costmap, made anew each time", vec![scan(), map(false)], vec![], vec![]),
            ("a map server", vec![map(true)], vec![], vec![]),
            ("a publisher of fixed transforms", vec![tf(Output)], vec![], vec![]),
            ("who hears transforms alone", vec![tf(Input), map(true)], vec![], vec![]),
            ("a trajectory", vec![scan(), path()], vec!["/path"], vec!["messages on /path kept growing"]),
            ("a plan", vec![scan(), path()], vec![], vec![]),
        ] {
            let found = signs_from_topics(topics, &growing);
            assert_eq!(found.len(), words.len(), "{what}: {found:?}");
            for (found, words) in found.iter().zip(words) {
                assert!(found.contains(words), "{what}: {found}");
            }
        }
    }

    #[test]
    fn what_may_be_switched_points_to_state() {
        use package::interface::{Action, Service};
        let service = |name: &str, type_name: &str| Service {
            name: name.into(),
            type_name: type_name.into(),
            md5: String::new(),
            node: "/mux".into(),
        };
        let mut mux = Interface {
            topics: vec![
                topic("/nav_vel", "geometry_msgs/Twist", Direction::Input, false),
                topic("/cmd_vel", "geometry_msgs/Twist", Direction::Output, false),
            ],
            services: vec![
                service("/mux/select_input", "p/Select"),
                service("/mux/lock", "std_srvs/srv/SetBool"),
                service("/mux/settings", "p/Settings"),
            ],
            actions: vec![Action { name: "/priority".into(), type_name: "p/Priority".into(), node: "/mux".into() }],
            ..Interface::default()
        };
        assert!(find_signs(&mux, &[]).is_empty(), "nothing is answered, so nothing is switched");
        mux.requests = Some(package::requests::decide_requests(RosVersion::One, &mux, &BTreeSet::new()));
        let switched = |what: &str| format!("its {what} may change its answers on /cmd_vel");
        assert_eq!(
            find_signs(&mux, &[]),
            ["action /priority", "service /mux/select_input", "service /mux/lock"].map(switched)
        );
    }

    #[test]
    fn the_question_says_what_was_found_and_what_to_type() {
        assert_eq!(question(&[]), None);
        let asked = question(&["it publishes transforms on /tf".into()]).unwrap();
        for words in ["answers seem to depend on earlier inputs", "on /tf", "--stateful:", "--stateful=false"] {
            assert!(asked.contains(words), "{asked}");
        }
    }
}
