//! What of a command line is for ROS 2, as rcl reads it
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).
//!
//! ```text
//! PROGRAM own… --ros-args -r FROM:=TO -p NAME:=VALUE --params-file FILE … -- own… --ros-args …
//! ```

use super::names;
use crate::identity::Naming;

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
    /// The old name, as written.
    pub from: String,
    /// The new name.
    pub to: String,
}

impl Rule {
    /// Whether it holds for the node of this name, without namespace.
    pub fn concerns(&self, node: &str) -> bool {
        self.node.as_deref().is_none_or(|of| of == node)
    }
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
    /// Its topics alone.
    Topic,
    /// Its services alone.
    Service,
}

impl Renamed {
    /// Whether it is a name of what the node has, and not its own.
    pub fn is_name(self) -> bool {
        !matches!(self, Self::Node | Self::Namespace)
    }
}

/// `-p NODE:NAME:=VALUE`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    /// The node that it holds for; all of the process where absent.
    pub node: Option<String>,
    /// Its name; levels are parted by dots.
    pub name: String,
    /// Its value, as written: YAML.
    pub value: String,
}

impl Parameter {
    /// Whether it holds for another node than that of this absolute name. A command line names nodes without a namespace alone.
    pub fn is_of_another(&self, node: &str) -> bool {
        let of = self.node.as_deref();
        of.is_some_and(|of| node.strip_prefix('/') != Some(of))
    }
}

/// An argument that rcl would not take either.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ArgumentError {
    /// Something should follow.
    #[error("nothing stands after {flag}, the last argument: give {flag} {form}")]
    NoValue {
        /// The argument.
        flag: String,
        /// What should follow.
        form: &'static str,
    },
    /// What follows is not of the right form.
    #[error("{flag} {given}: {reason}; {form}")]
    Refused {
        /// The argument.
        flag: String,
        /// What follows.
        given: String,
        /// What is wrong.
        reason: String,
        /// What is right.
        form: &'static str,
    },
    /// It is none of ROS 2's.
    #[error(
        "{0} stands after {BEGIN} and is no argument of ROS 2; the program's own stand before {BEGIN} or after {END}"
    )]
    Unknown(String),
}

/// What is right of a rule, and of a parameter.
const RULES: &str = "a rule is FROM:=TO";
const PARAMETERS: &str = "a parameter is given as NAME:=VALUE";

/// The error of a parameter whose value is none, for this reason; `words` are those by which it was given.
pub fn no_value(words: &[String], reason: &str) -> ArgumentError {
    match words {
        [flag, given, ..] => refused(flag, given, reason, PARAMETERS),
        _ => refused("-p", "", reason, PARAMETERS),
    }
}

/// Takes a command line (without the program) apart.
///
/// # Errors
/// The argument that rcl would not take either, and why not.
pub fn parse(argv: &[String]) -> Result<Vec<Part>, ArgumentError> {
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
                let rule = rule(given).map_err(|reason| refused(word, given, &reason, RULES))?;
                part(vec![word, given], Kind::Rule(rule));
            }
            "-p" | "--param" => {
                let given = value_of(word, words.next(), "NAME:=VALUE")?;
                let parameter =
                    parameter(given).map_err(|reason| refused(word, given, &reason, PARAMETERS))?;
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
            text => return Err(ArgumentError::Unknown(text.to_owned())),
        }
    }
    Ok(parts)
}

/// Whether a command line says in which namespace its nodes are; else their program may.
pub fn gives_namespace(argv: &[String]) -> bool {
    renames(argv, |rule| rule.of == Renamed::Namespace)
}

/// Whether a command line says what some of its nodes are called; else their program does.
pub fn gives_name(argv: &[String]) -> bool {
    renames(argv, |rule| rule.of == Renamed::Node)
}

fn renames(argv: &[String], is_meant: impl Fn(&Rule) -> bool) -> bool {
    let parts = parse(argv).unwrap_or_default();
    let mut kinds = parts.iter().map(|part| &part.kind);
    kinds.any(|kind| matches!(kind, Kind::Rule(rule) if is_meant(rule)))
}

/// Of the nodes that run one program the one that a stub of it is called by: the only one, or the only one that is told no name.
pub fn named_by_program<T>(mut nodes: Vec<T>, argv: impl Fn(&T) -> &[String]) -> Option<T> {
    if nodes.len() > 1 {
        nodes.retain(|node| !gives_name(argv(node)));
    }
    nodes.pop().filter(|_| nodes.is_empty())
}

/// What of its nodes' names a command line says to all of them, by rules that are not for one alone.
pub fn says_to_all(argv: &[String]) -> Naming {
    let says = |renamed: Renamed| renames(argv, |rule| rule.of == renamed && rule.node.is_none());
    Naming {
        name: says(Renamed::Node),
        namespace: says(Renamed::Namespace),
    }
}

fn value_of<'a>(
    flag: &str,
    next: Option<&'a String>,
    form: &'static str,
) -> Result<&'a String, ArgumentError> {
    next.ok_or_else(|| ArgumentError::NoValue {
        flag: flag.to_owned(),
        form,
    })
}

fn refused(flag: &str, given: &str, reason: &str, form: &'static str) -> ArgumentError {
    ArgumentError::Refused {
        flag: flag.to_owned(),
        given: given.to_owned(),
        reason: reason.to_owned(),
        form,
    }
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
    let kinds = [
        ("rostopic://", Renamed::Topic),
        ("rosservice://", Renamed::Service),
    ];
    let below = |name| {
        let mut kinds = kinds.iter();
        kinds.find_map(|(scheme, of)| Some((str::strip_prefix(name, scheme)?, *of)))
    };
    let (node, from, kind) = match below(from) {
        Some((name, of)) => (None, name, Some(of)),
        None => {
            let (node, name) = with_node(from)?;
            let (name, of) = below(name).map_or((name, None), |(name, of)| (name, Some(of)));
            (node, name, of)
        }
    };
    let of = match (kind, from) {
        (None, "__node" | "__name") => Renamed::Node,
        (None, "__ns") => Renamed::Namespace,
        (None, _) => Renamed::Name,
        (Some(of), _) => of,
    };
    match of {
        Renamed::Node if !is_token(to) => {
            return Err(format!(
                "{to:?} is no name of a node (letters, digits and _; __ns:= sets the namespace)"
            ));
        }
        Renamed::Namespace if to != "/" && !names::is_global(to) => {
            return Err(format!(
                "{to:?} is no namespace, which begins with / and does not end with it"
            ));
        }
        of if of.is_name() => {
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
        from: from.to_owned(),
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
        value: text.to_owned(),
    })
}

#[cfg(test)]
mod tests;
