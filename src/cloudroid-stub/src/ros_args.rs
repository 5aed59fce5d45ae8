//! What of a command line is for ROS 2, as rcl reads it
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).
//!
//! ```text
//! PROGRAM own… --ros-args -r FROM:=TO -p NAME:=VALUE --params-file FILE … -- own… --ros-args …
//! ```

use anyhow::{anyhow, bail};
use ros::bus::ParamValue;

use crate::params_file::value;

/// What follows is for ROS, up to the end or to [`END`].
pub const BEGIN: &str = "--ros-args";
/// What follows is the program's own again.
pub const END: &str = "--";

/// Arguments of ROS that have a value, beside those of rules and parameters.
const SETTINGS: [&str; 5] = [
    "--log-level",
    "--log-config-file",
    "--log-file-name",
    "-e",
    "--enclave",
];
/// What `--enable-…` and `--disable-…` are said of.
const SWITCHES: [&str; 3] = ["rosout-logs", "stdout-logs", "external-lib-logs"];

/// A part of a command line, with the words that it is written by.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// As given.
    pub words: Vec<String>,
    /// What it is.
    pub kind: Kind,
}

/// What a part of a command line is.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// The program's own.
    Own,
    /// [`BEGIN`] or [`END`].
    Mark,
    /// A name is another one.
    Rule(Rule),
    /// A parameter has a value.
    Parameter(Parameter),
    /// A parameters file: its path.
    File(String),
    /// Something else that rcl knows, such as a log level.
    Setting,
}

/// `-r NODE:FROM:=TO`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rule {
    /// The node that it holds for; all of the process where absent.
    pub node: Option<String>,
    /// What is renamed.
    pub of: Renamed,
    /// The new name.
    pub to: String,
}

/// What a rule renames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Renamed {
    /// The node itself.
    Node,
    /// The namespace that it is in.
    Namespace,
    /// Its topics and services.
    Name,
}

/// `-p NODE:NAME:=VALUE`.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// The node that it holds for; all of the process where absent.
    pub node: Option<String>,
    /// Its name; levels are parted by dots.
    pub name: String,
    /// Its value.
    pub value: ParamValue,
}

/// Takes a command line (without the program) apart.
///
/// # Errors
/// The argument that rcl would not take either, and why not.
pub fn parse(argv: &[String]) -> anyhow::Result<Vec<Part>> {
    let mut parts = Vec::new();
    let mut words = argv.iter();
    let mut for_ros = false;
    while let Some(word) = words.next() {
        let mut part = |words: Vec<&String>, kind| {
            let words = words.into_iter().cloned().collect();
            parts.push(Part { words, kind });
        };
        match &**word {
            BEGIN => {
                for_ros = true;
                part(vec![word], Kind::Mark);
            }
            END if for_ros => {
                for_ros = false;
                part(vec![word], Kind::Mark);
            }
            // As rcl did before there was --ros-args, and still does.
            text if !for_ros => match rule(text) {
                Ok(rule) => part(vec![word], Kind::Rule(rule)),
                Err(_) => part(vec![word], Kind::Own),
            },
            "-r" | "--remap" => {
                let given = value_of(word, words.next(), "FROM:=TO")?;
                let rule = rule(given)
                    .map_err(|reason| refused(word, given, &reason, "a rule is FROM:=TO"))?;
                part(vec![word, given], Kind::Rule(rule));
            }
            "-p" | "--param" => {
                let given = value_of(word, words.next(), "NAME:=VALUE")?;
                let parameter = parameter(given).map_err(|reason| {
                    refused(word, given, &reason, "a parameter is given as NAME:=VALUE")
                })?;
                part(vec![word, given], Kind::Parameter(parameter));
            }
            "--params-file" => {
                let given = value_of(word, words.next(), "FILE")?;
                part(vec![word, given], Kind::File(given.clone()));
            }
            text if SETTINGS.contains(&text) => {
                let given = value_of(word, words.next(), "VALUE")?;
                part(vec![word, given], Kind::Setting);
            }
            text if is_switch(text) => part(vec![word], Kind::Setting),
            text => bail!(
                "{text} stands after {BEGIN} and is no argument of ROS 2; the program's own stand before {BEGIN} or after {END}"
            ),
        }
    }
    Ok(parts)
}

fn value_of<'a>(flag: &str, next: Option<&'a String>, form: &str) -> anyhow::Result<&'a String> {
    next.ok_or_else(|| {
        anyhow!("nothing stands after {flag}, the last argument: give {flag} {form}")
    })
}

fn refused(flag: &str, given: &str, reason: &str, form: &str) -> anyhow::Error {
    anyhow!("{flag} {given}: {reason}; {form}")
}

fn is_switch(text: &str) -> bool {
    let of = text
        .strip_prefix("--enable-")
        .or_else(|| text.strip_prefix("--disable-"));
    of.is_some_and(|of| SWITCHES.contains(&of))
}

/// A name of ROS 2 without slashes.
pub fn is_token(text: &str) -> bool {
    text.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
        && text
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

/// Whether a parameter of this name can be given on a command line; a file can give others.
pub fn is_parameter(name: &str) -> bool {
    name.split(['.', '/']).all(is_token)
}

fn halves(text: &str) -> Result<(&str, &str), String> {
    text.split_once(":=")
        .ok_or_else(|| "it has no :=".to_owned())
}

/// `NODE:` before a name.
fn with_node(text: &str) -> Result<(Option<String>, &str), String> {
    match text.split_once(':') {
        Some((node, rest)) if is_token(node) => Ok((Some(node.to_owned()), rest)),
        Some((node, _)) => Err(format!("{node:?} is no name of a node")),
        None => Ok((None, text)),
    }
}

fn rule(text: &str) -> Result<Rule, String> {
    let (from, to) = halves(text)?;
    // Rules for topics or services alone.
    let kind = ["rostopic://", "rosservice://"];
    let schemeless = kind.iter().find_map(|scheme| from.strip_prefix(scheme));
    let (node, from) = match schemeless {
        Some(name) => (None, name),
        None => {
            let (node, name) = with_node(from)?;
            let below = kind.iter().find_map(|scheme| name.strip_prefix(scheme));
            (node, below.unwrap_or(name))
        }
    };
    let of = match from {
        "__node" | "__name" if schemeless.is_none() => Renamed::Node,
        "__ns" if schemeless.is_none() => Renamed::Namespace,
        _ => Renamed::Name,
    };
    match of {
        Renamed::Node if !is_token(to) => {
            return Err(format!(
                "{to:?} is no name of a node (letters, digits and _; __ns:= sets the namespace)"
            ));
        }
        Renamed::Namespace if to != "/" && !ros::ros2::names::is_global(to) => {
            return Err(format!(
                "{to:?} is no namespace, which begins with / and does not end with it"
            ));
        }
        Renamed::Name => {
            for (side, name) in [("before", from), ("behind", to)] {
                if !is_pattern(name) {
                    return Err(format!("{name:?} {side} := is no name"));
                }
            }
        }
        _ => {}
    }
    Ok(Rule {
        node,
        of,
        to: to.to_owned(),
    })
}

/// What rcl's rules are made of; whether they make sense the node in the cloud says.
fn is_pattern(name: &str) -> bool {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"_/~*\\.".contains(&byte);
    !name.is_empty() && name.bytes().all(allowed)
}

fn parameter(text: &str) -> Result<Parameter, String> {
    let (name, text) = halves(text)?;
    let (node, name) = with_node(name)?;
    if !is_parameter(name) {
        return Err(format!("{name:?} is no name of a parameter"));
    }
    Ok(Parameter {
        node,
        name: name.to_owned(),
        value: value::of_text(text)?,
    })
}

#[cfg(test)]
mod tests;
