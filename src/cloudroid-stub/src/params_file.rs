//! Parameters files of ROS 2, which are on the robot only. They are read as rcl and the client libraries do
//! (<https://docs.ros.org/en/jazzy/How-To-Guides/Node-arguments.html>).
//!
//! ```yaml
//! /**:                  # all nodes; also NODE, /NS/NODE, NS: {NODE: …}, /NS/*, /**/NODE
//!   ros__parameters:
//!     rate: 10
//!     gains: {p: 1.0}   # gains.p
//! ```

mod events;
pub mod value;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, anyhow};
use ros::bus::ParamValue;
use ros::ros2::arguments::is_token;
use saphyr_parser::Event;

use events::{Events, Problem};

/// The largest file that is read.
const MAX_BYTES: u64 = 8 << 20;
/// Groups within groups.
const MAX_DEPTH: usize = 32;
/// What parameters stand below.
const PARAMETERS: &str = "ros__parameters";

/// Parameters of the nodes that a pattern names.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Section {
    /// Such as `/front/see` or `/**`.
    pub nodes: String,
    /// By name; levels are parted by dots.
    pub parameters: BTreeMap<String, ParamValue>,
}

/// Parameters of nodes in the order in which rcl keeps them: that in which their patterns were first seen.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sections(Vec<Section>);

impl Sections {
    /// Sets a parameter of the nodes of a pattern.
    pub fn set(&mut self, nodes: &str, name: String, value: ParamValue) {
        let at = self.0.iter().position(|section| section.nodes == nodes);
        let at = at.unwrap_or_else(|| {
            self.0.push(Section {
                nodes: nodes.to_owned(),
                ..Section::default()
            });
            self.0.len() - 1
        });
        self.0[at].parameters.insert(name, value);
    }

    /// Adds those of a file.
    ///
    /// # Errors
    /// The file cannot be read, or is no parameters file: its path, the line and the reason.
    pub fn read(&mut self, path: &Path) -> anyhow::Result<()> {
        let text = text(path)?;
        self.parse(&text).map_err(|problem| {
            let Problem { line, reason } = problem;
            anyhow!("parameters file {}, line {line}: {reason}", path.display())
        })
    }

    fn parse(&mut self, text: &str) -> Result<(), Problem> {
        let mut file = File {
            events: Events::of(text),
            found: self,
        };
        file.read()
    }

    /// The parameters of the node of this absolute name. Of several sections the later one counts: that is how rclcpp and
    /// rclpy do it, whatever is the more precise.
    pub fn of(&self, node: &str) -> BTreeMap<String, ParamValue> {
        let sections = self.0.iter();
        let own = sections.filter(|section| matches(&section.nodes, node));
        own.flat_map(|section| section.parameters.clone()).collect()
    }
}

fn text(path: &Path) -> anyhow::Result<String> {
    let failed = || {
        format!(
            "cannot read the parameters file {}; --params-file names a file of this robot",
            path.display()
        )
    };
    let size = std::fs::metadata(path).with_context(failed)?.len();
    if size > MAX_BYTES {
        return Err(anyhow!("it has {size} bytes, and {MAX_BYTES} are read")).with_context(failed);
    }
    std::fs::read_to_string(path).with_context(failed)
}

/// Whether a node of this absolute name is meant: `*` is one part of a name, `**` any number of them.
fn matches(nodes: &str, node: &str) -> bool {
    fn parts(pattern: &[&str], node: &[&str]) -> bool {
        match (pattern.split_first(), node.split_first()) {
            (None, None) => true,
            (Some((&"**", rest)), _) => (0..=node.len()).any(|taken| parts(rest, &node[taken..])),
            (Some((&first, rest)), Some((&own, below))) => {
                (first == "*" || first == own) && parts(rest, below)
            }
            _ => false,
        }
    }
    let split = |name: &'_ str| -> Vec<String> {
        let parts = name.split('/').filter(|part| !part.is_empty());
        parts.map(str::to_owned).collect()
    };
    let (nodes, node) = (split(nodes), split(node));
    let nodes: Vec<&str> = nodes.iter().map(String::as_str).collect();
    let node: Vec<&str> = node.iter().map(String::as_str).collect();
    parts(&nodes, &node)
}

struct File<'a, 's> {
    events: Events<'a>,
    found: &'s mut Sections,
}

impl File<'_, '_> {
    fn read(&mut self) -> Result<(), Problem> {
        loop {
            let (event, line) = self.events.next()?;
            match event {
                Event::StreamStart | Event::DocumentStart(_) | Event::DocumentEnd => {}
                Event::StreamEnd => return Ok(()),
                Event::MappingStart(..) => self.nodes("", 0)?,
                _ => {
                    return Err(Problem::new(
                        line,
                        format!("this is no name of a node with {PARAMETERS} below it"),
                    ));
                }
            }
        }
    }

    /// Names of nodes, and of namespaces around them.
    fn nodes(&mut self, above: &str, depth: usize) -> Result<(), Problem> {
        while let Some((key, line)) = self.key(depth)? {
            let (event, at) = self.events.next()?;
            let is_group = matches!(event, Event::MappingStart(..));
            if key == PARAMETERS {
                if above.is_empty() {
                    return Err(Problem::new(
                        line,
                        format!("{PARAMETERS} stands below no name of a node; /** names all"),
                    ));
                }
                if !is_group {
                    return Err(Problem::new(
                        at,
                        format!("there is nothing below {PARAMETERS}"),
                    ));
                }
                self.parameters(above, "", depth + 1)?;
                continue;
            }
            let mut parts = key.split('/').filter(|part| !part.is_empty()).peekable();
            let named = parts.peek().is_some()
                && parts.all(|part| is_token(part) || part == "*" || part == "**");
            if !named {
                return Err(Problem::new(line, format!("{key:?} is no name of a node")));
            }
            if !is_group {
                return Err(Problem::new(
                    at,
                    format!(
                        "{key} has a value before {PARAMETERS}, which stands between a node and its parameters"
                    ),
                ));
            }
            self.nodes(&format!("{above}/{}", key.trim_matches('/')), depth + 1)?;
        }
        Ok(())
    }

    fn parameters(&mut self, nodes: &str, above: &str, depth: usize) -> Result<(), Problem> {
        while let Some((key, line)) = self.key(depth)? {
            let name = match above {
                "" => key,
                _ => format!("{above}.{key}"),
            };
            let (event, at) = self.events.next()?;
            if matches!(event, Event::MappingStart(..)) {
                self.parameters(nodes, &name, depth + 1)?;
                continue;
            }
            let value = value::of_event(event, at, &mut self.events).map_err(|problem| {
                // An empty value stands where the next thing does.
                let line = if problem.reason == value::NO_VALUE {
                    line
                } else {
                    problem.line
                };
                Problem::new(line, format!("{name}: {}", problem.reason))
            })?;
            self.found.set(nodes, name, value);
        }
        Ok(())
    }

    /// The next key of a group and its line; none at its end.
    fn key(&mut self, depth: usize) -> Result<Option<(String, usize)>, Problem> {
        let (event, line) = self.events.next()?;
        match event {
            Event::MappingEnd => Ok(None),
            _ if depth > MAX_DEPTH => Err(Problem::new(
                line,
                format!("more than {MAX_DEPTH} groups stand within each other"),
            )),
            Event::Scalar(text, ..) if !text.is_empty() => Ok(Some((text.into_owned(), line))),
            Event::Alias(_) => Err(Problem::new(
                line,
                "ROS 2 reads no aliases: write the name out",
            )),
            _ => Err(Problem::new(line, "a name stands before each colon")),
        }
    }
}

#[cfg(test)]
mod tests;
