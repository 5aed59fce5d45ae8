//! ROS 2 parameters files, which exist on the robot only. They are interpreted as rcl and the client libraries do
//! (<https://docs.ros.org/en/jazzy/How-To-Guides/Node-arguments.html>).
//!
//! ```yaml
//! /**:                  # all nodes; also NODE, /NS/NODE, NS: {NODE: …}, /NS/*, /**/NODE
//!   ros__parameters:
//!     rate: 10
//!     gains: {p: 1.0}   # gains.p
//! ```

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, anyhow};
use ros::bus::ParamValue;
use ros::ros2::arguments::is_token;
use ros::ros2::parameters::yaml::{Event, NO_VALUE, Problem, YamlEvents, parse_event};

/// Maximum file size in bytes.
const MAX_BYTES: u64 = 8 << 20;
/// Maximum nesting depth of groups.
const MAX_DEPTH: usize = 32;
/// Key between a node and its parameters.
const PARAMETERS: &str = "ros__parameters";

/// Parameters of the nodes that match a pattern.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Section {
    /// Pattern of the node names, such as `/front/see` or `/**`.
    pub nodes: String,
    /// Values by parameter name, with levels separated by dots.
    pub parameters: BTreeMap<String, ParamValue>,
}

/// Parameters of nodes in the order in which rcl keeps them: that of the first occurrence of their patterns.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sections(Vec<Section>);

impl Sections {
    /// Sets a parameter for the nodes that match a pattern.
    pub fn set(&mut self, nodes: &str, name: String, value: ParamValue) {
        let at = self.0.iter().position(|section| section.nodes == nodes);
        let at = at.unwrap_or_else(|| {
            self.0.push(Section { nodes: nodes.to_owned(), ..Section::default() });
            self.0.len() - 1
        });
        self.0[at].parameters.insert(name, value);
    }

    /// Adds the parameters of a file.
    ///
    /// # Errors
    /// The file cannot be read or is not a parameters file; the error states its path, the line and the reason.
    pub fn read(&mut self, path: &Path) -> anyhow::Result<()> {
        let text = read_text(path)?;
        self.parse(&text).map_err(|problem| {
            let Problem { line, reason } = problem;
            anyhow!("parameters file {}, line {line}: {reason}", path.display())
        })
    }

    fn parse(&mut self, text: &str) -> Result<(), Problem> {
        let mut file = ParametersFileReader { events: YamlEvents::new(text), found: self };
        file.read()
    }

    /// Returns the parameters of the node of this absolute name. A later section overrides an earlier one, even if that
    /// is more specific, as in rclcpp and rclpy.
    pub fn for_node(&self, node: &str) -> BTreeMap<String, ParamValue> {
        let sections = self.0.iter();
        let own = sections.filter(|section| matches_node(&section.nodes, node));
        own.flat_map(|section| section.parameters.clone()).collect()
    }
}

fn read_text(path: &Path) -> anyhow::Result<String> {
    let failed =
        || format!("cannot read the parameters file {}; --params-file names a file of this robot", path.display());
    let size = std::fs::metadata(path).with_context(failed)?.len();
    if size > MAX_BYTES {
        return Err(anyhow!("it has {size} bytes; the limit is {MAX_BYTES}")).with_context(failed);
    }
    std::fs::read_to_string(path).with_context(failed)
}

/// Returns whether the pattern matches a node of this absolute name: `*` is one segment of a name, `**` any number of
/// them.
fn matches_node(nodes: &str, node: &str) -> bool {
    fn parts(pattern: &[&str], node: &[&str]) -> bool {
        match (pattern.split_first(), node.split_first()) {
            (None, None) => true,
            (Some((&"**", rest)), _) => (0..=node.len()).any(|taken| parts(rest, &node[taken..])),
            (Some((&first, rest)), Some((&own, below))) => (first == "*" || first == own) && parts(rest, below),
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

struct ParametersFileReader<'a, 's> {
    events: YamlEvents<'a>,
    found: &'s mut Sections,
}

impl ParametersFileReader<'_, '_> {
    fn read(&mut self) -> Result<(), Problem> {
        loop {
            let (event, line) = self.events.next_event()?;
            match event {
                Event::StreamStart | Event::DocumentStart(_) | Event::DocumentEnd => {}
                Event::StreamEnd => return Ok(()),
                Event::MappingStart(..) => self.nodes("", 0)?,
                _ => {
                    return Err(Problem::new(line, format!("expected a node name with {PARAMETERS} below it")));
                }
            }
        }
    }

    /// Reads names of nodes, and of namespaces around them.
    fn nodes(&mut self, above: &str, depth: usize) -> Result<(), Problem> {
        while let Some((key, line)) = self.key(depth)? {
            let (event, at) = self.events.next_event()?;
            let is_group = matches!(event, Event::MappingStart(..));
            if key == PARAMETERS {
                if above.is_empty() {
                    return Err(Problem::new(
                        line,
                        format!("{PARAMETERS} is not below a node name; use /** for all nodes"),
                    ));
                }
                if !is_group {
                    return Err(Problem::new(at, format!("{PARAMETERS} is empty")));
                }
                self.parameters(above, "", depth + 1)?;
                continue;
            }
            let mut parts = key.split('/').filter(|part| !part.is_empty()).peekable();
            let named = parts.peek().is_some() && parts.all(|part| is_token(part) || part == "*" || part == "**");
            if !named {
                return Err(Problem::new(line, format!("{key:?} is not a valid node name")));
            }
            if !is_group {
                return Err(Problem::new(
                    at,
                    format!(
                        "{key} has a value without {PARAMETERS}, which must be between a node name and its parameters"
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
            let (event, at) = self.events.next_event()?;
            if matches!(event, Event::MappingStart(..)) {
                self.parameters(nodes, &name, depth + 1)?;
                continue;
            }
            let value = parse_event(event, at, &mut self.events).map_err(|problem| {
                // An empty value has the position of the next token.
                let line = if problem.reason == NO_VALUE { line } else { problem.line };
                Problem::new(line, format!("{name}: {}", problem.reason))
            })?;
            self.found.set(nodes, name, value);
        }
        Ok(())
    }

    /// Returns the next key of a group and its line, or `None` at its end.
    fn key(&mut self, depth: usize) -> Result<Option<(String, usize)>, Problem> {
        let (event, line) = self.events.next_event()?;
        match event {
            Event::MappingEnd => Ok(None),
            _ if depth > MAX_DEPTH => Err(Problem::new(line, format!("more than {MAX_DEPTH} nested groups"))),
            Event::Scalar(text, ..) if !text.is_empty() => Ok(Some((text.into_owned(), line))),
            Event::Alias(_) => Err(Problem::new(line, "ROS 2 does not support aliases: write the name")),
            _ => Err(Problem::new(line, "expected a name before each colon")),
        }
    }
}

#[cfg(test)]
mod tests;
