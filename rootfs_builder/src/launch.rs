//! Resolution of what to run: nodes and parameters, as the image's own roslaunch (or launch of ROS 2) interprets the
//! launch file.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use package::definitions::Definitions;
use ros::bus::ParamValue;
use ros::flavour::Version;
use ros::ros2::composition::{self, Component};
use serde::{Deserialize, Serialize};
use servant::container::{Mount, Profile};
use servant::spec::NodeSpec;

use crate::error::{Error, IoContext};
use crate::install::write_tree;
use crate::modes::set_mode;
use crate::sandbox::SandboxRun;
use crate::workshop::BuildContext;
use crate::{blocking, plan};

/// Launch plan of a service, regardless of how it was requested.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LaunchPlan {
    /// Nodes in the order in which roslaunch starts them.
    pub nodes: Vec<LaunchNode>,
    /// Parameters by absolute name, set before any node starts.
    pub parameters: BTreeMap<String, ParamValue>,
    /// Components to load into nodes that are component containers, by node name.
    #[serde(default)]
    pub components: BTreeMap<String, Vec<Component>>,
}

/// A node to run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LaunchNode {
    /// Absolute name, such as `/camera/people_detect`.
    pub name: String,
    /// ROS package.
    pub package: String,
    /// Name of the executable in the package.
    pub executable: String,
    /// Launch prefix, path of the program, arguments, remappings, `__name:=`.
    pub argv: Vec<String>,
    /// Remappings only, from → to.
    pub remaps: BTreeMap<String, String>,
    /// Additional environment (`<env>`, `ROS_NAMESPACE`).
    pub environment: BTreeMap<String, String>,
    /// Working directory; `None` for ROS's default, `ROS_HOME`.
    pub directory: Option<String>,
    /// True if it is restarted whenever it exits.
    pub respawn: bool,
    /// Delay of a restart in seconds.
    pub respawn_delay: f64,
    /// True if all nodes are stopped when it exits.
    pub required: bool,
    /// True if the name is passed to the program (`__name:=`). Otherwise the program chooses the name, and `name` is a
    /// guess from the executable's.
    #[serde(default = "yes")]
    pub named: bool,
}

fn yes() -> bool {
    true
}

impl LaunchNode {
    /// Converts to the specification for the engine; `ros_home` is the default working directory.
    pub fn to_node_spec(&self, ros_home: &str) -> NodeSpec {
        NodeSpec {
            name: self.name.clone(),
            argv: self.argv.clone(),
            environment: self.environment.clone(),
            directory: self.directory.clone().unwrap_or_else(|| ros_home.to_owned()),
            respawn: self.respawn,
            respawn_delay: self.respawn_delay,
            required: self.required,
        }
    }
}

/// Query to the launch script in the container.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct LaunchQuery {
    /// Pushed ROS packages; the first one that contains what is requested is used.
    pub(crate) packages: Vec<String>,
    /// Install space whose setup.sh provides the environment; empty for none.
    pub(crate) prefix: String,
    /// Launch file, or empty.
    pub(crate) launch: String,
    /// Executables.
    pub(crate) nodes: Vec<String>,
    /// Arguments of the launch file.
    pub(crate) args: BTreeMap<String, String>,
    /// Remappings for every node.
    pub(crate) remaps: BTreeMap<String, String>,
    /// Parameters: absolute ones, and private ones for every node.
    pub(crate) params: BTreeMap<String, serde_json::Value>,
}

/// Answer of the launch script.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct LaunchAnswer {
    pub(crate) nodes: Vec<LaunchNode>,
    #[serde(default)]
    pub(crate) components: BTreeMap<String, Vec<Component>>,
    pub(crate) parameters: BTreeMap<String, ParamValue>,
    pub(crate) environment: BTreeMap<String, String>,
    pub(crate) warnings: Vec<String>,
}

#[derive(Debug, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum PlanRefusal {
    Launch { file: String, words: String },
    NotFound { what: String, name: String, known: Vec<String> },
    Nothing { executables: Vec<String>, launch_files: Vec<String> },
    Setup { file: String, status: i32 },
    NoLaunch { module: String },
    Python { made_for: String, there: String },
    NoContainer { plugin: String },
    Component { words: String },
}

#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum PlanReply {
    Refused { error: PlanRefusal },
    Planned(LaunchAnswer),
}

/// Returns the scripts that resolve launch files with the image's own tools; the first one is the entry point.
fn plan_scripts(ros: Version) -> Vec<(&'static str, &'static str)> {
    match ros {
        Version::Ros1 => vec![("launch_plan.py", include_str!("inside/launch_plan.py"))],
        Version::Ros2 => vec![
            ("ros2_plan.py", include_str!("inside/ros2_plan.py")),
            ("ros2_launch_plan.py", include_str!("inside/ros2_launch_plan.py")),
            ("ros2_components.py", include_str!("inside/ros2_components.py")),
        ],
    }
}

/// Returns the name of the program that reads launch files.
fn launch_program(ros: Version) -> &'static str {
    match ros {
        Version::Ros1 => "roslaunch",
        Version::Ros2 => "ros2 launch",
    }
}

/// Runs the query in a container of these trees.
pub(crate) async fn query_plan(
    shop: &BuildContext,
    ros: Version,
    mut layers: Vec<PathBuf>,
    mut environment: BTreeMap<String, String>,
    ask: &LaunchQuery,
) -> Result<LaunchAnswer, Error> {
    let directory = shop.site.fresh_directory("plan")?;
    let (tools, out) = (directory.join("tools"), directory.join("out"));
    let question = serde_json::to_vec(ask).unwrap_or_default();
    let scripts = plan_scripts(ros);
    let mut files = BTreeMap::from([
        (PathBuf::from("cloudroid/ask.json"), question),
        (PathBuf::from("cloudroid/out/.keep"), Vec::new()),
    ]);
    let place = |name: &str| format!("cloudroid/{name}");
    for (name, text) in &scripts {
        files.insert(place(name).into(), text.as_bytes().to_vec());
    }
    write_tree(&tools, &files)?;
    let first = scripts.first().map_or("", |(name, _)| *name);
    fs::create_dir(&out).io_context("making", &out)?;
    // The container's root is an unprivileged user on the host; nobody else can access the parent directories.
    set_mode(&out, 0o777)?;
    layers.push(tools);
    for (name, value) in [("HOME", "/tmp"), ("ROS_LOG_DIR", "/tmp"), ("PYTHONDONTWRITEBYTECODE", "1")] {
        environment.insert(name.to_owned(), value.to_owned());
    }
    let finished = shop
        .site
        .run(
            SandboxRun {
                name: "plan",
                profile: Profile::Servant,
                layers,
                writable: None,
                owned: Vec::new(),
                mounts: vec![Mount {
                    source: out.clone(),
                    target: "/cloudroid/out".into(),
                    writable: true,
                    device: false,
                    opened: None,
                }],
                environment,
                argv: vec!["/usr/bin/python3".to_owned(), format!("/{}", place(first))],
            },
            |_| {},
        )
        .await?;
    let text = if finished.success() { blocking::spawn(move || plan::read_plan(&out)).await?? } else { None };
    let Some(text) = text else {
        return Err(Error::Inside { what: "resolving what to run", last_lines: finished.last_output() });
    };
    let answer = blocking::spawn_reader(move || parse_reply(&text, ros)).await??;
    plan::check_plan(&answer)?;
    Ok(answer)
}

/// Checks that the image defines the services by which components are loaded.
pub(crate) fn check_composition(
    components: &BTreeMap<String, Vec<Component>>,
    definitions: &Definitions,
) -> Result<(), Error> {
    let Some(container) = components.keys().next() else {
        return Ok(());
    };
    let missing = composition::SERVICES.into_iter().find(|name| !definitions.contains_key(*name));
    match missing {
        None => Ok(()),
        Some(what) => Err(Error::NoComposition { container: container.clone(), what: what.to_owned() }),
    }
}

/// Formats names for a message.
pub(crate) fn join_names(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

fn parse_reply(text: &[u8], ros: Version) -> Result<LaunchAnswer, Error> {
    match serde_json::from_slice::<PlanReply>(text) {
        Ok(PlanReply::Planned(answer)) => Ok(answer),
        Ok(PlanReply::Refused { error }) => Err(match error {
            PlanRefusal::Launch { file, words } => Error::Launch { program: launch_program(ros), file, words },
            PlanRefusal::NoLaunch { module } => Error::NoLaunch { module, with: None },
            PlanRefusal::Python { made_for, there } => Error::OtherPython { made_for, there },
            PlanRefusal::NoContainer { plugin } => Error::NoContainer { plugin },
            PlanRefusal::Component { words } => Error::BadComponent { words },
            PlanRefusal::NotFound { what, name, known } => Error::NotInPackage {
                what: if what == "executable" { "executable" } else { "launch file" },
                name,
                known: join_names(&known),
                elsewhere: String::new(),
            },
            PlanRefusal::Nothing { executables, launch_files } => Error::NothingToRun {
                executables: join_names(&executables),
                launch_files: join_names(&launch_files),
                more: "",
            },
            PlanRefusal::Setup { file, status } => Error::Inside {
                what: "sourcing the install space's setup script",
                last_lines: format!("{file} ended with status {status}"),
            },
        }),
        Err(error) => Err(Error::Inside { what: "resolving what to run", last_lines: error.to_string() }),
    }
}

#[cfg(test)]
mod composed;
#[cfg(test)]
mod ros1_tests;
#[cfg(test)]
mod ros2_tests;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_is_understood() {
        let text = br#"{"nodes":[{"name":"/a","package":"p","executable":"x","argv":["/x","__name:=a"],"remaps":{},
            "environment":{},"directory":null,"respawn":true,"respawn_delay":1.5,"required":false}],
            "parameters":{"/a/k":[1,2.5,"x",true]},"environment":{},"warnings":[],"executables":[],"launch_files":[]}"#;
        let answer = parse_reply(text, Version::Ros1).expect("a plan");
        let spec = answer.nodes[0].to_node_spec("/root/.ros");
        assert_eq!((spec.directory.as_str(), spec.respawn, spec.respawn_delay), ("/root/.ros", true, 1.5));
        let ParamValue::List(values) = &answer.parameters["/a/k"] else { panic!("a list") };
        assert_eq!(values[1], ParamValue::Double(2.5));
    }

    #[test]
    fn refusals_keep_roslaunchs_words_and_name_what_there_is() {
        let launch =
            br#"{"error":{"kind":"launch","file":"/x.launch","words":"requires the 'manager' arg to be set"}}"#;
        let text = parse_reply(launch, Version::Ros1).expect_err("refused").to_string();
        assert_eq!(text, "roslaunch cannot load /x.launch: requires the 'manager' arg to be set");
        let node = br#"{"error":{"kind":"not_found","what":"executable","name":"y","known":["a","b"]}}"#;
        let text = parse_reply(node, Version::Ros1).expect_err("refused").to_string();
        assert_eq!(text, "no executable \"y\" in the package; available: a, b");
        let nothing = br#"{"error":{"kind":"nothing","executables":["a","b"],"launch_files":[]}}"#;
        let text = parse_reply(nothing, Version::Ros1).expect_err("refused").to_string();
        assert!(text.contains("executables: a, b; launch files: none"), "{text}");
    }

    #[test]
    fn what_ros_2_cannot_resolve_names_the_reason_and_the_next_step() {
        let refused = |text: &[u8]| {
            let error = parse_reply(text, Version::Ros2).expect_err("refused");
            error.to_string()
        };
        let text = refused(br#"{"error":{"kind":"no_launch","module":"launch"}}"#);
        assert!(text.contains("no Python package launch") && text.contains("--node"), "{text}");
        let text = refused(br#"{"error":{"kind":"python","made_for":"python3.12","there":"python3.11"}}"#);
        assert!(text.contains("built for python3.12, but the base has python3.11"), "{text}");
        let launch = br#"{"error":{"kind":"launch","file":"/x.launch.py","words":"no such argument"}}"#;
        assert_eq!(refused(launch), "ros2 launch cannot load /x.launch.py: no such argument");
    }
}
