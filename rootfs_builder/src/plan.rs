//! Validation of the launch plan that comes out of the package's own container.
//!
//! The script that resolves launch files runs together with the package's code, which can replace its answer. So the
//! answer is read below a directory descriptor and up to a size limit, every value is validated, and an answer that the
//! script could not have written is rejected as a whole.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use package::names;
use ros::ros2::composition::Component;

use crate::error::Error;
use crate::launch::{LaunchAnswer, LaunchNode};

/// File with the answer, in the directory that the container can write to.
pub(crate) const FILE: &str = "plan.json";
/// Maximum size of the answer. Launch files with robot descriptions in their parameters give some megabytes.
const MAX_BYTES: u64 = 32 << 20;
const MAX_NODES: usize = 256;
const MAX_PARAMETERS: usize = 20_000;
const MAX_WARNINGS: usize = 1000;
/// Maximum size of arguments or environment in bytes; `execve` accepts 2 MiB of both together.
const MAX_WORDS: usize = 1 << 20;
/// Maximum respawn_delay of a node in seconds: a day.
const MAX_DELAY: f64 = 86_400.0;

/// Reads the answer in `out`; `None` if there is none.
pub(crate) fn read_plan(out: &Path) -> Result<Option<Vec<u8>>, Error> {
    let file = foreign::Tree::open(out)?.read_file(FILE, MAX_BYTES)?;
    Ok(file.map(|file| file.bytes))
}

/// Rejects an answer that the script could not have written.
pub(crate) fn check_plan(answer: &LaunchAnswer) -> Result<(), Error> {
    let refused = |problem: String| Err(Error::BadPlan { problem });
    for (what, count, limit) in [
        ("nodes", answer.nodes.len(), MAX_NODES),
        ("parameters", answer.parameters.len(), MAX_PARAMETERS),
        ("warnings", answer.warnings.len(), MAX_WARNINGS),
    ] {
        if count > limit {
            return refused(format!("it has {count} {what}; the limit is {limit}"));
        }
    }
    let mut seen = BTreeSet::new();
    for node in &answer.nodes {
        if let Some(problem) = find_node_problem(node) {
            return refused(format!("node {:?} {problem}", node.name));
        }
        if !seen.insert(&node.name) {
            return refused(format!("two nodes are named {}", node.name));
        }
    }
    if let Some(problem) = find_components_problem(&answer.components, &|name| seen.contains(name)) {
        return refused(problem);
    }
    if let Some(problem) = find_environment_problem(&answer.environment) {
        return refused(problem);
    }
    let bad = |name: &&String| !names::is_graph_name(name) && !is_parameter(name);
    if let Some(name) = answer.parameters.keys().find(bad) {
        return refused(format!("{name:?} is not an absolute parameter name"));
    }
    Ok(())
}

/// Returns whether a text is the name of a parameter, which unlike a topic may be, for example, `/camera/1st`.
fn is_parameter(name: &str) -> bool {
    name.len() <= 1024 && name.starts_with('/') && name.chars().all(|c| !c.is_control())
}

fn find_node_problem(node: &LaunchNode) -> Option<String> {
    if !names::is_graph_name(&node.name) {
        return Some("does not have a valid ROS node name".into());
    }
    if !names::is_package(&node.package) {
        return Some(format!("has the package {:?}, which is not a valid package name", node.package));
    }
    if !node.executable.split('/').all(names::is_executable) {
        return Some(format!(
            "runs {:?}, a name that is not allowed; rename the program, without quotes, $, \\ and control characters",
            node.executable
        ));
    }
    if node.argv.first().is_none_or(String::is_empty) {
        return Some("runs nothing".into());
    }
    let words = node.argv.iter().map(String::len).sum::<usize>();
    if words > MAX_WORDS {
        return Some(format!("has {words} bytes of arguments; the limit is {MAX_WORDS}"));
    }
    if node.argv.iter().any(|word| word.contains('\0')) {
        return Some("has an argument with a NUL byte".into());
    }
    if let Some(directory) = &node.directory
        && (!directory.starts_with('/') || directory.contains('\0') || directory.len() > 4095)
    {
        return Some(format!("runs in {directory:?}, which is not an absolute path"));
    }
    if !(0.0..=MAX_DELAY).contains(&node.respawn_delay) {
        return Some(format!("has a respawn_delay of {} s; the range is 0 to {MAX_DELAY}", node.respawn_delay));
    }
    find_environment_problem(&node.environment).map(|problem| format!("has an environment where {problem}"))
}

/// Returns the first problem of the components; `is_node` tells whether a name is that of a node.
pub fn find_components_problem(
    all: &BTreeMap<String, Vec<Component>>,
    is_node: &dyn Fn(&String) -> bool,
) -> Option<String> {
    let loaded = all.values().map(Vec::len).sum::<usize>();
    if loaded > MAX_NODES {
        return Some(format!("it loads {loaded} nodes into others; the limit is {MAX_NODES}"));
    }
    all.iter().find_map(|(container, components)| {
        if !is_node(container) {
            return Some(format!("it loads nodes into {container:?}, which it does not start"));
        }
        let problem = components.iter().find_map(find_component_problem)?;
        Some(format!("a component of {container} {problem}"))
    })
}

fn find_component_problem(component: &Component) -> Option<String> {
    if !names::is_package(&component.package) {
        return Some(format!("is of package {:?}, which is not a valid package name", component.package));
    }
    if !names::is_class(&component.plugin) {
        return Some(format!("is {:?}, which is not a valid class name", component.plugin));
    }
    let name = component.full_name();
    if name.is_some_and(|name| !names::is_graph_name(&name)) {
        return Some(format!(
            "is named {:?} in {:?}, which is not a valid ROS node name",
            component.name, component.namespace
        ));
    }
    None
}

fn find_environment_problem(environment: &BTreeMap<String, String>) -> Option<String> {
    let size: usize = environment.iter().map(|(name, value)| name.len() + value.len() + 2).sum();
    if size > MAX_WORDS {
        return Some(format!("the environment has {size} bytes; the limit is {MAX_WORDS}"));
    }
    environment.iter().find_map(|(name, value)| {
        if name.is_empty() || name.contains(['=', '\0']) {
            Some(format!("{name:?} is not a valid variable name"))
        } else if value.contains('\0') {
            Some(format!("{name} contains a NUL byte"))
        } else {
            None
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node() -> LaunchNode {
        LaunchNode {
            name: "/a".into(),
            named: true,
            package: "p".into(),
            executable: "x".into(),
            argv: vec!["/usr/lib/p/x".into(), "__name:=a".into()],
            remaps: BTreeMap::new(),
            environment: BTreeMap::from([("A".into(), "b c".into())]),
            directory: Some("/usr/lib/p".into()),
            respawn: false,
            respawn_delay: 0.5,
            required: false,
        }
    }

    fn answer(nodes: Vec<LaunchNode>) -> LaunchAnswer {
        LaunchAnswer { nodes, ..LaunchAnswer::default() }
    }

    #[test]
    fn what_the_script_makes_is_accepted() {
        let mut good = answer(vec![node()]);
        good.parameters.insert("/camera/1st".into(), ros::bus::ParamValue::Bool(true));
        good.environment.insert("CMAKE_PREFIX_PATH".into(), "/opt/x:/usr".into());
        check_plan(&good).expect("a plan");
    }

    #[test]
    fn what_no_launch_file_says_is_refused_as_a_whole() {
        type Change = fn(&mut LaunchNode);
        let changes: [(&str, Change); 8] = [
            ("name", |node| node.name = "/a'$(cmd)'".into()),
            ("package", |node| node.package = "../p".into()),
            ("x'$(cmd)'y", |node| node.executable = "x'$(cmd)'y".into()),
            ("nothing", |node| node.argv.clear()),
            ("NUL", |node| node.argv.push("a\0b".into())),
            ("arguments", |node| node.argv.push("a".repeat(MAX_WORDS))),
            ("absolute", |node| node.directory = Some("../../etc".into())),
            ("respawn_delay", |node| node.respawn_delay = f64::NAN),
        ];
        for (words, change) in changes {
            let mut bad = node();
            change(&mut bad);
            let text = check_plan(&answer(vec![node(), bad])).expect_err(words).to_string();
            assert!(text.contains(words), "{text}");
        }
        let twice = check_plan(&answer(vec![node(), node()])).expect_err("twice");
        assert!(twice.to_string().contains("two nodes"), "{twice}");
        let mut many = answer(Vec::new());
        for number in 0..=MAX_NODES {
            many.nodes.push(LaunchNode { name: format!("/n{number}"), ..node() });
        }
        assert!(check_plan(&many).is_err());
        let mut environment = answer(vec![node()]);
        environment.environment.insert("A=B".into(), String::new());
        assert!(check_plan(&environment).is_err());
        let mut parameter = answer(vec![node()]);
        parameter.parameters.insert("relative".into(), ros::bus::ParamValue::Bool(true));
        assert!(check_plan(&parameter).is_err());
    }

    #[test]
    fn what_is_loaded_has_a_container_a_package_a_class_and_a_name() {
        let component = Component {
            package: "talk".into(),
            plugin: "talk::Talker".into(),
            name: "see".into(),
            namespace: "/front".into(),
            ..Component::default()
        };
        let loading = |container: &str, components: Vec<Component>| LaunchAnswer {
            components: [(container.to_owned(), components)].into(),
            ..answer(vec![node()])
        };
        check_plan(&loading("/a", vec![component.clone()])).expect("a plan");
        type Change = fn(&mut Component);
        let changes: [(&str, Change); 4] = [
            ("package", |it| it.package = "../talk".into()),
            ("class", |it| it.plugin = "talk::Talker;x".into()),
            ("ROS node", |it| it.name = "see/$(x)".into()),
            ("ROS node", |it| it.namespace = "/front rear".into()),
        ];
        for (words, change) in changes {
            let mut bad = component.clone();
            change(&mut bad);
            let text = check_plan(&loading("/a", vec![bad])).expect_err(words).to_string();
            assert!(text.contains(words), "{text}");
        }
        let nowhere = check_plan(&loading("/b", vec![component.clone()])).expect_err("nowhere");
        assert!(nowhere.to_string().contains("does not start"), "{nowhere}");
        let many = vec![component; MAX_NODES + 1];
        assert!(check_plan(&loading("/a", many)).is_err());
    }

    #[test]
    fn an_answer_that_is_a_link_to_a_host_file_is_not_read() {
        let place = tempfile::tempdir().expect("a directory");
        let out = place.path().join("out");
        std::fs::create_dir(&out).expect("made");
        assert_eq!(read_plan(&out).expect("looked"), None);
        std::fs::write(place.path().join("secret"), "{\"nodes\":[]}").expect("written");
        std::os::unix::fs::symlink("../secret", out.join(FILE)).expect("linked");
        let refused = read_plan(&out).expect_err("a link").to_string();
        assert!(refused.contains("is not a regular file"), "{refused}");
    }

    #[test]
    fn an_answer_larger_than_memory_is_not_read() {
        let out = tempfile::tempdir().expect("a directory");
        let file = std::fs::File::create(out.path().join(FILE)).expect("made");
        file.set_len(1 << 40).expect("set");
        let refused = read_plan(out.path()).expect_err("large").to_string();
        assert!(refused.contains("larger than"), "{refused}");
    }
}
