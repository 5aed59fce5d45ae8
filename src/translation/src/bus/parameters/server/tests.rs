use futures_util::FutureExt;
use ros::bus::NodeParameters;

use super::*;
use crate::bus::memory_bus::{MemoryBus, MemorySystem};

const SEE: &str = "/camera/see";

/// A servant of ROS 2 and its parameters as a robot of ROS 1 sees them.
struct Servant {
    system: Arc<MemorySystem>,
    view: ParameterServerView,
}

impl Servant {
    fn new() -> Self {
        Self::with_budget(Budget::without_limit())
    }

    fn with_budget(budget: Budget) -> Self {
        let system = Arc::<MemorySystem>::default();
        let view = ParameterServerView::new(system.join("/cloudroid"), budget);
        Self { system, view }
    }

    /// Starts a node that declares parameters.
    async fn start(&self, node: &str, json: &str) -> Arc<MemoryBus> {
        let bus = self.system.join(node);
        let mut declared = NodeValues::default();
        for (name, value) in tree(json) {
            declared.add(name, value);
        }
        let declared = declared.values.into_iter().map(|(name, value)| (name, Some(value))).collect();
        NodeParameters::set(&*bus, node, declared).await.expect("a node");
        bus
    }

    async fn value(&self, key: &str) -> Option<ParamValue> {
        match self.view.get(key).await {
            Ok(value) => Some(value),
            Err(BusError::NoParam(_)) => None,
            Err(error) => panic!("{error}"),
        }
    }

    async fn refusal(&self, key: &str, json: &str) -> String {
        self.view.set(key, value(json)).await.expect_err("refused").to_string()
    }
}

fn value(json: &str) -> ParamValue {
    serde_json::from_str(json).expect(json)
}

fn tree(json: &str) -> Tree {
    serde_json::from_str(json).expect(json)
}

#[tokio::test]
async fn a_parameter_is_no_deeper_than_at_a_master_whoever_names_it() {
    let servant = Servant::new();
    let deep = "/d".repeat(100_000);
    let refused = servant.refusal(&deep, "1").await;
    assert!(refused.contains("more than 100 parts"), "{}", &refused[refused.len() - 100..]);
    assert_eq!(servant.value("/").await, Some(ParamValue::Map(Tree::new())));
    // Nor does a node make a tree that cannot be walked.
    let node = servant.start(SEE, r#"{"rate": 2}"#).await;
    let changes = vec![(spell_in_ros2(&deep[1..]), Some(value("1")))];
    NodeParameters::set(&*node, SEE, changes).await.expect("a node");
    assert_eq!(servant.value(SEE).await, Some(value(r#"{"rate": 2}"#)));
}

#[tokio::test]
async fn parameters_of_a_node_stand_below_its_name() {
    let servant = Servant::new();
    let _see = servant.start(SEE, r#"{"gains": {"p": 1, "i": 2}, "rate": 0.5, "qos_overrides./x.depth": 1}"#).await;
    let _seen = servant.start("/camera", r#"{"name": "front", "wide": 1099511627776}"#).await;
    servant.view.set("/map_frame", value(r#""map""#)).await.expect("kept");
    assert_eq!(servant.value("/camera/see/gains/p").await, Some(value("1")));
    assert_eq!(servant.value("camera/see/gains/").await, Some(value(r#"{"p": 1, "i": 2}"#)));
    let see = r#"{"gains": {"p": 1, "i": 2}, "rate": 0.5}"#;
    assert_eq!(servant.value(SEE).await, Some(value(see)));
    let camera = format!(r#"{{"name": "front", "see": {see}}}"#);
    assert_eq!(servant.value("/camera").await, Some(value(&camera)), "an integer of 41 bits is left out");
    let all = format!(r#"{{"map_frame": "map", "camera": {camera}}}"#);
    assert_eq!(servant.value("/").await, Some(value(&all)));
    for missing in ["/camera/see/gain", "/camera/see/gains/p/x", "/camera/wide", "/cam", "/other"] {
        assert_eq!(servant.value(missing).await, None, "{missing}");
        assert!(!servant.view.has(missing).await.expect("an answer"));
    }
    let names = ["/camera/name", "/camera/see/gains/i", "/camera/see/gains/p", "/camera/see/rate", "/map_frame"];
    assert_eq!(servant.view.names().await.expect("names"), names);
    assert_eq!(Servant::new().value("/").await, Some(ParamValue::Map(Tree::new())), "it is always there");
}

#[tokio::test]
async fn a_name_is_searched_upwards_by_its_first_part() {
    let servant = Servant::new();
    let _see = servant.start(SEE, r#"{"gains": {"p": 1}}"#).await;
    servant.view.set("/gains/d", value("1")).await.expect("kept");
    for (namespace, key, found) in [
        ("/camera/see", "gains/p", Some("/camera/see/gains/p")),
        ("/camera/see", "gains/d", Some("/camera/see/gains/d")),
        ("/camera", "gains/d", Some("/gains/d")),
        ("/camera/see", "see", Some("/camera/see")),
        ("/camera/see", "rate", None),
        ("/camera/see", "/gains/d", Some("/gains/d")),
        ("/camera/see", "/gains/p", None),
        ("/camera/see", "", None),
    ] {
        let searched = servant.view.search(namespace, key).await.expect("an answer");
        assert_eq!(searched.as_deref(), found, "{namespace} {key}");
    }
}

#[tokio::test]
async fn what_is_set_goes_to_the_node_and_what_it_refuses_is_said() {
    let servant = Servant::new();
    let _see = servant.start(SEE, r#"{"rate": 0.5, "name": "x", "gains": {"p": 1}}"#).await;
    servant.view.set("/camera/see/rate", value("3")).await.expect("set");
    assert_eq!(servant.value("/camera/see/rate").await, Some(value("3.0")), "the node has a double");
    let refusal = servant.refusal("/camera/see/name", "5").await;
    assert_eq!(refusal, "parameter /camera/see/name cannot be sent: it is of another kind");
    let refusal = servant.refusal("/camera/see/boxes", "[[1]]").await;
    assert!(refusal.contains("/camera/see/boxes cannot be sent: a list of lists cannot be"), "{refusal}");
    let refusal = servant.refusal("/camera/see", "7").await;
    assert!(refusal.contains("it is the name of a node"), "{refusal}");
    // What is not refused of a dictionary is set, and the other parameters stay.
    let refusal = servant.refusal("/camera", r#"{"see": {"rate": 4, "name": 5, "gains": {"i": 2}}, "x": 1}"#).await;
    assert!(refusal.starts_with("parameter /camera/see/name cannot be sent: it is of another kind"), "{refusal}");
    assert!(refusal.ends_with("(the others of /camera are set)"), "{refusal}");
    let expected = r#"{"see": {"rate": 4.0, "name": "x", "gains": {"p": 1, "i": 2}}, "x": 1}"#;
    assert_eq!(servant.value("/camera").await, Some(value(expected)));
}

#[tokio::test]
async fn parameters_of_a_node_that_does_not_run_are_kept_for_its_start() {
    let servant = Servant::new();
    let robots = value(r#"{"see": {"rate": 1, "gains": {"p": 2}}, "other": {"x": 3}}"#);
    servant.view.set("/camera", robots.clone()).await.expect("kept");
    assert_eq!(servant.value("/camera").await, Some(robots));
    let (private, simulated) = servant.view.launch_parameters(SEE);
    assert_eq!((private, simulated), (tree(r#"{"rate": 1, "gains": {"p": 2}}"#), None));
    assert_eq!(servant.view.launch_parameters("/rear/see").0, Tree::new());
    // Once it runs, its values count; they are what it gets when it is started again.
    let see = servant.start(SEE, r#"{"rate": 1.0, "gains": {"p": 2}, "own": true}"#).await;
    servant.view.set("/camera/see/rate", value("5")).await.expect("set");
    let expected = r#"{"rate": 5.0, "gains": {"p": 2}, "own": true}"#;
    assert_eq!(servant.value(SEE).await, Some(value(expected)));
    drop(see);
    assert_eq!(servant.view.launch_parameters(SEE).0, tree(r#"{"rate": 5, "gains": {"p": 2}}"#));
}

#[tokio::test]
async fn simulated_time_is_set_at_every_node_and_given_to_later_ones() {
    let servant = Servant::new();
    let _one = servant.start("/one", r#"{"use_sim_time": false}"#).await;
    let _odd = servant.start("/odd", r#"{"use_sim_time": "never"}"#).await;
    let refusal = servant.refusal("/use_sim_time", "1").await;
    assert!(refusal.contains("it is true or false"), "{refusal}");
    // A node that refuses it does not keep the others from it.
    servant.view.set("/use_sim_time", value("true")).await.expect("kept");
    assert_eq!(servant.value("/one/use_sim_time").await, Some(value("true")));
    assert_eq!(servant.value("/use_sim_time").await, Some(value("true")));
    assert_eq!(servant.view.launch_parameters("/two").1, Some(true));
}

#[tokio::test]
async fn changes_are_reported_as_a_master_reports_them() {
    let servant = Servant::new();
    let mut replaced = servant.view.watch().await.expect("a watch");
    let mut changes = servant.view.watch().await.expect("a watch");
    assert_eq!(replaced.recv().await, None, "there is one watcher");
    let see = servant.start(SEE, r#"{"gains": {"p": 1}, "use_sim_time": false}"#).await;
    let change = |key: &str, json: &str| Some((key.to_owned(), Some(value(json))));
    assert_eq!(changes.recv().await, change("/camera/see/gains/p", "1"));
    // What is kept is reported as it was set, and what a node changes as it has it.
    servant.view.set("/rear", value(r#"{"a": {"b": 1}}"#)).await.expect("kept");
    assert_eq!(changes.recv().await, change("/rear", r#"{"a": {"b": 1}}"#));
    servant.view.set("/camera/see/gains", value(r#"{"p": 2}"#)).await.expect("set");
    assert_eq!(changes.recv().await, change("/camera/see/gains/p", "2"));
    NodeParameters::set(&*see, SEE, vec![("gains.p".to_owned(), None)]).await.expect("a node");
    assert_eq!(changes.recv().await, Some(("/camera/see/gains/p".to_owned(), None)));
    assert_eq!(servant.view.launch_parameters(SEE).0, Tree::new(), "a deleted parameter is not kept");
    servant.view.delete("/rear").await.expect("it was kept");
    assert_eq!(changes.recv().await, Some(("/rear".to_owned(), None)));
    assert!(changes.recv().now_or_never().is_none());
}

#[tokio::test]
async fn only_what_exists_and_belongs_to_no_running_node_as_a_whole_is_deleted() {
    let servant = Servant::new();
    let _see = servant.start(SEE, r#"{"gains": {"p": 1, "i": 2}, "rate": 0.5}"#).await;
    servant.view.delete("/camera/see/gains").await.expect("it was set");
    assert_eq!(servant.value(SEE).await, Some(value(r#"{"rate": 0.5}"#)));
    for (key, said) in [
        ("/camera/see/gains", "parameter /camera/see/gains is not set"),
        ("/other", "parameter /other is not set"),
        (SEE, "the parameters of /camera/see are declared by it, and stay while it runs"),
        ("/camera", "the parameters of /camera/see are declared by it"),
    ] {
        let refused = servant.view.delete(key).await.expect_err(key).to_string();
        assert!(refused.contains(said), "{refused}");
    }
}

#[tokio::test]
async fn what_a_robot_sets_for_no_node_is_paid_for() {
    let budget = Budget::new("the robot", 10_000);
    let servant = Servant::with_budget(budget.clone());
    servant.view.set("/small", value("1")).await.expect("kept");
    let long = format!(r#"{{"a": "{}"}}"#, "x".repeat(20_000));
    let refusal = servant.refusal("/large", &long).await;
    assert!(refusal.contains("do not fit into the memory for the robot"), "{refusal}");
    assert_eq!(servant.value("/").await, Some(value(r#"{"small": 1}"#)));
    servant.view.delete("/small").await.expect("kept");
    assert_eq!(budget.used_bytes(), 0);
}
