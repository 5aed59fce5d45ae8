//! What is to run: nodes and parameters, as the image's own roslaunch, or launch of ROS 2, understands the launch file.

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

use crate::error::{Error, IoAt};
use crate::install::{lay_out, set_mode};
use crate::sandbox::Run;
use crate::workshop::Workshop;
use crate::{blocking, plan};

/// What to run. Independent of how it was asked for.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LaunchPlan {
    /// Nodes in the order in which roslaunch starts them.
    pub nodes: Vec<LaunchNode>,
    /// Parameters by absolute name, set before any node starts.
    pub parameters: BTreeMap<String, ParamValue>,
    /// What is loaded into nodes that are component containers, by their names.
    #[serde(default)]
    pub components: BTreeMap<String, Vec<Component>>,
}

/// One node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LaunchNode {
    /// Absolute name, such as `/camera/people_detect`.
    pub name: String,
    /// Its ROS package.
    pub package: String,
    /// Its type: the executable's name in the package.
    pub executable: String,
    /// Launch prefix, path of the program, arguments, remaps, `__name:=`.
    pub argv: Vec<String>,
    /// Remaps alone, from → to.
    pub remaps: BTreeMap<String, String>,
    /// Added to the image's environment (`<env>`, `ROS_NAMESPACE`).
    pub environment: BTreeMap<String, String>,
    /// Where it runs; none for ROS's own default, `ROS_HOME`.
    pub directory: Option<String>,
    /// Started again whenever it ends.
    pub respawn: bool,
    /// Seconds before that.
    pub respawn_delay: f64,
    /// When it ends, all do.
    pub required: bool,
    /// The program is told its name (`__name:=`). Otherwise it has the one that its author gave it, and `name` is a
    /// guess by the executable's.
    #[serde(default = "yes")]
    pub named: bool,
}

fn yes() -> bool {
    true
}

impl LaunchNode {
    /// As an engine starts it; `ros_home` is where nodes run by default.
    pub fn spec(&self, ros_home: &str) -> NodeSpec {
        NodeSpec {
            name: self.name.clone(),
            argv: self.argv.clone(),
            environment: self.environment.clone(),
            directory: self
                .directory
                .clone()
                .unwrap_or_else(|| ros_home.to_owned()),
            respawn: self.respawn,
            respawn_delay: self.respawn_delay,
            required: self.required,
        }
    }
}

/// What is asked of the script inside.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct Ask {
    /// Pushed ROS packages; the one meant is the first that has what is asked for.
    pub(crate) packages: Vec<String>,
    /// The install space whose setup.sh makes the environment; empty for none.
    pub(crate) prefix: String,
    /// Launch file, or empty.
    pub(crate) launch: String,
    /// Executables.
    pub(crate) nodes: Vec<String>,
    /// Arguments of the launch file.
    pub(crate) args: BTreeMap<String, String>,
    /// Remaps for every node.
    pub(crate) remaps: BTreeMap<String, String>,
    /// Parameters: absolute ones, and private ones for every node.
    pub(crate) params: BTreeMap<String, serde_json::Value>,
}

/// What the script answers.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Answer {
    pub(crate) nodes: Vec<LaunchNode>,
    #[serde(default)]
    pub(crate) components: BTreeMap<String, Vec<Component>>,
    pub(crate) parameters: BTreeMap<String, ParamValue>,
    pub(crate) environment: BTreeMap<String, String>,
    pub(crate) warnings: Vec<String>,
}

#[derive(Debug, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum Refusal {
    Launch {
        file: String,
        words: String,
    },
    NotFound {
        what: String,
        name: String,
        known: Vec<String>,
    },
    Nothing {
        executables: Vec<String>,
        launch_files: Vec<String>,
    },
    Setup {
        file: String,
        status: i32,
    },
    NoLaunch {
        module: String,
    },
    Python {
        made_for: String,
        there: String,
    },
    NoContainer {
        plugin: String,
    },
    Component {
        words: String,
    },
}

#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Reply {
    Refused { error: Refusal },
    Planned(Answer),
}

/// What resolves launch files, by the image's own tools: the script that is started first.
fn scripts(ros: Version) -> Vec<(&'static str, &'static str)> {
    match ros {
        Version::Ros1 => vec![("launch_plan.py", include_str!("inside/launch_plan.py"))],
        Version::Ros2 => vec![
            ("ros2_plan.py", include_str!("inside/ros2_plan.py")),
            (
                "ros2_launch_plan.py",
                include_str!("inside/ros2_launch_plan.py"),
            ),
            (
                "ros2_components.py",
                include_str!("inside/ros2_components.py"),
            ),
        ],
    }
}

/// What reads launch files, for people.
fn launcher(ros: Version) -> &'static str {
    match ros {
        Version::Ros1 => "roslaunch",
        Version::Ros2 => "ros2 launch",
    }
}

/// Asks, in a container of these trees.
pub(crate) async fn ask(
    shop: &Workshop,
    ros: Version,
    mut layers: Vec<PathBuf>,
    mut environment: BTreeMap<String, String>,
    ask: &Ask,
) -> Result<Answer, Error> {
    let directory = shop.site.fresh("plan")?;
    let (tools, out) = (directory.join("tools"), directory.join("out"));
    let question = serde_json::to_vec(ask).unwrap_or_default();
    let scripts = scripts(ros);
    let mut files = BTreeMap::from([
        (PathBuf::from("cloudroid/ask.json"), question),
        (PathBuf::from("cloudroid/out/.keep"), Vec::new()),
    ]);
    let place = |name: &str| format!("cloudroid/{name}");
    for (name, text) in &scripts {
        files.insert(place(name).into(), text.as_bytes().to_vec());
    }
    lay_out(&tools, &files)?;
    let first = scripts.first().map_or("", |(name, _)| *name);
    fs::create_dir(&out).at("making", &out)?;
    // The container's root is nobody in particular out here; the directories above let nobody else in.
    set_mode(&out, 0o777)?;
    layers.push(tools);
    for (name, value) in [
        ("HOME", "/tmp"),
        ("ROS_LOG_DIR", "/tmp"),
        ("PYTHONDONTWRITEBYTECODE", "1"),
    ] {
        environment.insert(name.to_owned(), value.to_owned());
    }
    let finished = shop
        .site
        .run(
            Run {
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
    let text = match finished.success() {
        true => blocking::spawn(move || plan::read(&out)).await??,
        false => None,
    };
    let Some(text) = text else {
        return Err(Error::Inside {
            what: "resolving what to run",
            last_lines: finished.last_words(),
        });
    };
    let answer = privilege::reading(|| understand(&text, ros))?;
    plan::check(&answer)?;
    Ok(answer)
}

/// Whoever loads nodes needs the definitions by which they are asked for, as the image has them.
pub(crate) fn check_composition(
    components: &BTreeMap<String, Vec<Component>>,
    definitions: &Definitions,
) -> Result<(), Error> {
    let Some(container) = components.keys().next() else {
        return Ok(());
    };
    let missing = composition::SERVICES
        .into_iter()
        .find(|name| !definitions.contains_key(*name));
    match missing {
        None => Ok(()),
        Some(what) => Err(Error::NoComposition {
            container: container.clone(),
            what: what.to_owned(),
        }),
    }
}

/// Names for people.
pub(crate) fn list(names: &[String]) -> String {
    if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(", ")
    }
}

fn understand(text: &[u8], ros: Version) -> Result<Answer, Error> {
    match serde_json::from_slice::<Reply>(text) {
        Ok(Reply::Planned(answer)) => Ok(answer),
        Ok(Reply::Refused { error }) => Err(match error {
            Refusal::Launch { file, words } => Error::Launch {
                program: launcher(ros),
                file,
                words,
            },
            Refusal::NoLaunch { module } => Error::NoLaunch { module, with: None },
            Refusal::Python { made_for, there } => Error::OtherPython { made_for, there },
            Refusal::NoContainer { plugin } => Error::NoContainer { plugin },
            Refusal::Component { words } => Error::BadComponent { words },
            Refusal::NotFound { what, name, known } => Error::NotInPackage {
                what: if what == "executable" {
                    "executable"
                } else {
                    "launch file"
                },
                name,
                known: list(&known),
                elsewhere: String::new(),
            },
            Refusal::Nothing {
                executables,
                launch_files,
            } => Error::NothingToRun {
                executables: list(&executables),
                launch_files: list(&launch_files),
                more: "",
            },
            Refusal::Setup { file, status } => Error::Inside {
                what: "sourcing the install space's setup script",
                last_lines: format!("{file} ended with status {status}"),
            },
        }),
        Err(error) => Err(Error::Inside {
            what: "resolving what to run",
            last_lines: error.to_string(),
        }),
    }
}

#[cfg(test)]
mod composed;
#[cfg(test)]
mod of_one;
#[cfg(test)]
mod of_two;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_is_understood() {
        let text = br#"{"nodes":[{"name":"/a","package":"p","executable":"x","argv":["/x","__name:=a"],"remaps":{},
            "environment":{},"directory":null,"respawn":true,"respawn_delay":1.5,"required":false}],
            "parameters":{"/a/k":[1,2.5,"x",true]},"environment":{},"warnings":[],"executables":[],"launch_files":[]}"#;
        let answer = understand(text, Version::Ros1).expect("a plan");
        let spec = answer.nodes[0].spec("/root/.ros");
        assert_eq!(
            (spec.directory.as_str(), spec.respawn, spec.respawn_delay),
            ("/root/.ros", true, 1.5)
        );
        let ParamValue::List(values) = &answer.parameters["/a/k"] else {
            panic!("a list")
        };
        assert_eq!(values[1], ParamValue::Double(2.5));
    }

    #[test]
    fn refusals_keep_roslaunchs_words_and_name_what_there_is() {
        let launch = br#"{"error":{"kind":"launch","file":"/x.launch","words":"requires the 'manager' arg to be set"}}"#;
        let text = understand(launch, Version::Ros1)
            .expect_err("refused")
            .to_string();
        assert_eq!(
            text,
            "roslaunch cannot load /x.launch: requires the 'manager' arg to be set"
        );
        let node =
            br#"{"error":{"kind":"not_found","what":"executable","name":"y","known":["a","b"]}}"#;
        let text = understand(node, Version::Ros1)
            .expect_err("refused")
            .to_string();
        assert_eq!(
            text,
            "there is no executable \"y\" in the package; there are: a, b"
        );
        let nothing = br#"{"error":{"kind":"nothing","executables":["a","b"],"launch_files":[]}}"#;
        let text = understand(nothing, Version::Ros1)
            .expect_err("refused")
            .to_string();
        assert!(
            text.contains("executables: a, b; launch files: none"),
            "{text}"
        );
    }

    #[test]
    fn what_ros_2_cannot_resolve_names_the_reason_and_the_next_step() {
        let refused = |text: &[u8]| {
            let error = understand(text, Version::Ros2).expect_err("refused");
            error.to_string()
        };
        let text = refused(br#"{"error":{"kind":"no_launch","module":"launch"}}"#);
        assert!(
            text.contains("no Python package launch") && text.contains("--node"),
            "{text}"
        );
        let text =
            refused(br#"{"error":{"kind":"python","made_for":"python3.12","there":"python3.11"}}"#);
        assert!(
            text.contains("made for python3.12, and the base has python3.11"),
            "{text}"
        );
        let launch =
            br#"{"error":{"kind":"launch","file":"/x.launch.py","words":"no such argument"}}"#;
        assert_eq!(
            refused(launch),
            "ros2 launch cannot load /x.launch.py: no such argument"
        );
    }
}
