//! Environment variables that launch files of ROS 2 set by literal, unconditional statements.

use std::io::Read;
use std::path::Path;

use foreign::{Visit, WalkEntry};
use ros::bus::RosVersion;
use roxmltree::Node;
use rustix::fs::FileType;

use super::scan_sources;
use crate::workspace::Workspace;
use crate::xml;

/// Maximum size of a launch file in bytes: for each statement all of it is searched.
const MAX_BYTES: u64 = 64 << 10;
/// Maximum number of launch files of one name that are read.
const MAX_FILES: usize = 20;
/// Words of a Python launch file because of which a statement may not be executed.
const CONDITIONAL: [&str; 4] = ["if ", "else", "Condition", "OpaqueFunction"];

/// Launch file that sets a variable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SetVariable {
    /// Launch file, relative to its package.
    pub file: String,
    /// Value.
    pub value: String,
}

/// Finds the value that the launch file of a push sets a variable to, whatever its arguments are. `launch`: name of the
/// launch file; `None` for the only one, if it is run. Of several files of that name all must set it. Blocking.
pub fn find_set_variable(workspace: &Workspace, launch: Option<&str>, variable: &str) -> Option<SetVariable> {
    let only = || {
        let mut found = scan_sources(workspace, RosVersion::Two);
        let is_run = found.programs == 0 && found.launch_files.len() == 1 && !found.may_launch_more;
        if is_run { found.launch_files.pop() } else { None }
    };
    // An absolute path is one in the image.
    let launch = launch.map(str::to_owned).or_else(only).filter(|launch| !launch.starts_with('/'))?;
    let name = Path::new(&launch).file_name()?;
    let mut files = Vec::new();
    for package in &workspace.packages {
        let directory = workspace.root.join(&package.path).canonicalize().ok()?;
        let walked = foreign::walk(&directory, |entry| {
            if entry.kind() == FileType::RegularFile && entry.name() == name && files.len() <= MAX_FILES {
                // One beyond the limit may do anything.
                let text = if files.len() < MAX_FILES { read_launch_file(entry) } else { None };
                let value = text.and_then(|text| find_value(&text, variable));
                files.push(value.map(|value| SetVariable { file: entry.path.display().to_string(), value }));
            }
            Ok::<_, foreign::Error>(Visit::Into)
        });
        walked.ok()?;
    }
    let all: Option<Vec<SetVariable>> = files.into_iter().collect();
    all?.into_iter().next()
}

fn read_launch_file(entry: &WalkEntry<'_>) -> Option<String> {
    if entry.stat.st_size as u64 > MAX_BYTES {
        return None;
    }
    let mut text = String::new();
    entry.open().ok()?.take(MAX_BYTES).read_to_string(&mut text).ok()?;
    Some(text)
}

fn find_value(text: &str, variable: &str) -> Option<String> {
    if text.trim_start().starts_with('<') { find_in_xml(text, variable) } else { find_in_python(text, variable) }
}

/// Finds `<set_env name="VARIABLE" value="…"/>`, or `<env …>` of a node.
fn find_in_xml(text: &str, variable: &str) -> Option<String> {
    let document = xml::parse(text).ok()?;
    let is_certain = |node: &Node<'_, '_>| {
        node.ancestors().all(|above| !above.has_attribute("if") && !above.has_attribute("unless"))
    };
    let mut statements = document.descendants().filter(|node| {
        let is_set = node.has_tag_name("set_env") || node.has_tag_name("env");
        is_set && node.attribute("name") == Some(variable) && is_certain(node)
    });
    let value = statements.find_map(|node| node.attribute("value").filter(|value| !value.contains("$(")))?;
    Some(value.to_owned())
}

/// Finds `SetEnvironmentVariable('VARIABLE', '…')`.
fn find_in_python(text: &str, variable: &str) -> Option<String> {
    const CALL: &str = "SetEnvironmentVariable(";
    if CONDITIONAL.iter().any(|word| text.contains(word)) {
        return None;
    }
    text.match_indices(CALL).find_map(|(at, _)| {
        let (name, rest) = parse_argument(&text[at + CALL.len()..], "name")?;
        let (value, rest) = parse_argument(rest.trim_start().strip_prefix(',')?, "value")?;
        let rest = rest.trim_start();
        let is_last = rest.strip_prefix(',').unwrap_or(rest).trim_start().starts_with(')');
        (name == variable && is_last && is_code(&text[..at])).then(|| value.to_owned())
    })
}

/// Returns whether what follows `before` is neither a comment nor in a long string.
fn is_code(before: &str) -> bool {
    let line = before.rsplit('\n').next().unwrap_or_default();
    let is_open = |quotes: &str| before.matches(quotes).count() % 2 == 1;
    !line.contains('#') && !is_open("\"\"\"") && !is_open("'''")
}

/// Parses `'TEXT'` or `KEYWORD='TEXT'`; returns the text and what follows.
fn parse_argument<'a>(text: &'a str, keyword: &str) -> Option<(&'a str, &'a str)> {
    let text = text.trim_start();
    let text = match text.strip_prefix(keyword) {
        Some(rest) => rest.trim_start().strip_prefix('=')?.trim_start(),
        None => text,
    };
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    let (value, rest) = text[1..].split_once(quote)?;
    (!value.contains(['\\', '\n'])).then_some((value, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAME: &str = "RMW_IMPLEMENTATION";

    #[test]
    fn literal_statements_count() {
        for text in [
            "<launch><set_env name='RMW_IMPLEMENTATION' value='rmw_x'/></launch>",
            "<launch><node pkg='p' exec='e'><env name='RMW_IMPLEMENTATION' value='rmw_x'/></node></launch>",
            "def generate_launch_description():\n    return LaunchDescription([\n        \
             SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_x'),\n    ])\n",
            "'''Starts it.'''\na = SetEnvironmentVariable(\n  name=\"RMW_IMPLEMENTATION\",\n  value=\"rmw_x\",\n)\n",
        ] {
            assert_eq!(find_value(text, NAME).as_deref(), Some("rmw_x"), "{text}");
        }
    }

    #[test]
    fn what_may_not_be_executed_or_is_no_literal_does_not_count() {
        for text in [
            "<launch><set_env name='RMW_IMPLEMENTATION' value='$(var rmw)'/></launch>",
            "<launch><group if='$(var z)'><set_env name='RMW_IMPLEMENTATION' value='rmw_x'/></group></launch>",
            "<launch><!-- <set_env name='RMW_IMPLEMENTATION' value='rmw_x'/> --></launch>",
            "<launch><set_env name='OTHER' value='rmw_x'/></launch>",
            "<launch>",
            "SetEnvironmentVariable('RMW_IMPLEMENTATION', LaunchConfiguration('rmw'))",
            "SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_x', condition=IfCondition(z))",
            "if z:\n    SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_x')",
            "# SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_x')",
            "\"\"\"As SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_x') does.\"\"\"",
            "SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_x'",
            "SetEnvironmentVariable('OTHER', 'rmw_x')",
            "- set_env: {name: RMW_IMPLEMENTATION, value: rmw_x}",
            "",
        ] {
            assert_eq!(find_value(text, NAME), None, "{text}");
        }
    }
}
