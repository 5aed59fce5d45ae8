//! ROS 2 arguments in a command line, as rcl parses them
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).
//!
//! ```text
//! PROGRAM own… --ros-args -r FROM:=TO -p NAME:=VALUE --params-file FILE … -- own… --ros-args …
//! ```

use ros_bus::Naming;

use super::names;

/// Begins arguments for ROS, which extend to the end or to [`END`].
pub const BEGIN: &str = "--ros-args";
/// Ends arguments for ROS; the program's own follow.
pub const END: &str = "--";

/// ROS arguments that take a value, besides those for rules and parameters.
const SETTINGS: [&str; 5] = ["--log-level", "--log-config-file", "--log-file-name", "-e", "--enclave"];
/// Names that `--enable-…` and `--disable-…` may be followed by.
const SWITCHES: [&str; 3] = ["rosout-logs", "stdout-logs", "external-lib-logs"];

/// A part of a command line, with the words it consists of.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandLinePart {
    /// The words, as given.
    pub words: Vec<String>,
    /// Meaning of the part.
    pub kind: Kind,
}

/// Meaning of a part of a command line.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// An argument of the program.
    Own,
    /// [`BEGIN`] or [`END`].
    Mark,
    /// A remapping rule.
    Rule(RemapRule),
    /// A parameter assignment.
    Parameter(Parameter),
    /// A parameters file: its path.
    File(String),
    /// Another setting known to rcl, such as a log level.
    Setting,
}

/// A remapping rule `-r NODE:FROM:=TO`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemapRule {
    /// Node to which it applies; `None` for all nodes of the process.
    pub node: Option<String>,
    /// Kind of name that is remapped.
    pub of: RemapTarget,
    /// Old name, as written.
    pub from: String,
    /// New name.
    pub to: String,
}

impl RemapRule {
    /// Returns true if the rule applies to the node of this name, without namespace.
    pub fn applies_to(&self, node: &str) -> bool {
        self.node.as_deref().is_none_or(|of| of == node)
    }
}

/// Kind of name that a rule remaps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RemapTarget {
    /// The node's name.
    Node,
    /// The node's namespace.
    Namespace,
    /// Topics and services.
    Name,
    /// Topics only.
    Topic,
    /// Services only.
    Service,
}

impl RemapTarget {
    /// Returns true for names of topics or services, as opposed to the node's own.
    pub fn is_name(self) -> bool {
        !matches!(self, Self::Node | Self::Namespace)
    }
}

/// A parameter assignment `-p NODE:NAME:=VALUE`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    /// Node to which it applies; `None` for all nodes of the process.
    pub node: Option<String>,
    /// Name; levels are separated by dots.
    pub name: String,
    /// Value, as written in YAML.
    pub value: String,
}

impl Parameter {
    /// Returns true if the parameter is for another node than that of this absolute name. A command line can name only
    /// nodes without a namespace.
    pub fn is_for_other_node(&self, node: &str) -> bool {
        let of = self.node.as_deref();
        of.is_some_and(|of| node.strip_prefix('/') != Some(of))
    }
}

/// Error for an argument that rcl would not accept either.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ArgumentError {
    /// A value is missing.
    #[error("nothing follows {flag}, the last argument: give {flag} {form}")]
    NoValue {
        /// The argument.
        flag: String,
        /// Form of the missing value.
        form: &'static str,
    },
    /// The value has the wrong form.
    #[error("{flag} {given}: {reason}; {form}")]
    Refused {
        /// The argument.
        flag: String,
        /// The value given.
        given: String,
        /// The problem.
        reason: ValueProblem,
        /// The right form.
        form: &'static str,
    },
    /// The argument is not one of ROS 2.
    #[error(
        "{0} follows {BEGIN} but is not a ROS 2 argument; put the program's own arguments before {BEGIN} or after {END}"
    )]
    Unknown(String),
}

/// Problem with the value of an argument. The texts quote the part of it that is wrong.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ValueProblem {
    /// Nothing separates the two sides.
    #[error("it has no :=")]
    NoSeparator,
    /// The name of a node is malformed.
    #[error("{0:?} is not a node name")]
    NotANode(String),
    /// The new name of a node is malformed.
    #[error("{0:?} is not a node name (letters, digits and _; __ns:= sets the namespace)")]
    NotANewNode(String),
    /// The new namespace is malformed.
    #[error("{0:?} is not a namespace, which begins with / and does not end with it")]
    NotANamespace(String),
    /// The name that a rule replaces is malformed.
    #[error("{0:?} before := is not a name")]
    NotANameBefore(String),
    /// The name that a rule gives is malformed.
    #[error("{0:?} behind := is not a name")]
    NotANameBehind(String),
    /// The name of a parameter is malformed.
    #[error("{0:?} is not a parameter name")]
    NotAParameter(String),
    /// The value of a parameter cannot be read; the reason is that of its reader.
    #[error("{0}")]
    Unreadable(String),
}

/// Descriptions of the right form of a rule and of a parameter.
const RULES: &str = "a rule is FROM:=TO";
const PARAMETERS: &str = "a parameter is given as NAME:=VALUE";

/// Returns the error for a parameter with an invalid value; `words` are the words by which it was given.
pub fn invalid_value(words: &[String], reason: &str) -> ArgumentError {
    let reason = ValueProblem::Unreadable(reason.to_owned());
    match words {
        [flag, given, ..] => refused_error(flag, given, reason, PARAMETERS),
        _ => refused_error("-p", "", reason, PARAMETERS),
    }
}

/// Parses a command line (without the program).
///
/// # Errors
/// Returns the argument that rcl would not accept either, with the reason.
pub fn parse(argv: &[String]) -> Result<Vec<CommandLinePart>, ArgumentError> {
    let mut parts = Vec::new();
    let mut words = argv.iter();
    let mut for_ros = false;
    while let Some(word) = words.next() {
        let mut part = |words: Vec<&String>, kind| {
            let words = words.into_iter().cloned().collect();
            parts.push(CommandLinePart { words, kind });
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
            text if !for_ros => match parse_rule(text) {
                Ok(rule) => part(vec![word], Kind::Rule(rule)),
                Err(_) => part(vec![word], Kind::Own),
            },
            "-r" | "--remap" => {
                let given = take_value(word, words.next(), "FROM:=TO")?;
                let rule = parse_rule(given).map_err(|reason| refused_error(word, given, reason, RULES))?;
                part(vec![word, given], Kind::Rule(rule));
            }
            "-p" | "--param" => {
                let given = take_value(word, words.next(), "NAME:=VALUE")?;
                let parameter =
                    parse_parameter(given).map_err(|reason| refused_error(word, given, reason, PARAMETERS))?;
                part(vec![word, given], Kind::Parameter(parameter));
            }
            "--params-file" => {
                let given = take_value(word, words.next(), "FILE")?;
                part(vec![word, given], Kind::File(given.clone()));
            }
            text if SETTINGS.contains(&text) => {
                let given = take_value(word, words.next(), "VALUE")?;
                part(vec![word, given], Kind::Setting);
            }
            text if is_switch(text) => part(vec![word], Kind::Setting),
            text => return Err(ArgumentError::Unknown(text.to_owned())),
        }
    }
    Ok(parts)
}

/// Returns true if a command line sets the namespace of nodes; otherwise the program may.
pub fn sets_namespace(argv: &[String]) -> bool {
    has_rule(argv, |rule| rule.of == RemapTarget::Namespace)
}

/// Returns true if a command line sets the name of a node; otherwise the program does.
pub fn sets_name(argv: &[String]) -> bool {
    has_rule(argv, |rule| rule.of == RemapTarget::Node)
}

fn has_rule(argv: &[String], is_meant: impl Fn(&RemapRule) -> bool) -> bool {
    let parts = parse(argv).unwrap_or_default();
    let mut kinds = parts.iter().map(|part| &part.kind);
    kinds.any(|kind| matches!(kind, Kind::Rule(rule) if is_meant(rule)))
}

/// Returns, among the nodes that run one program, the one that a stub of the program stands for: the only one, or the
/// only one whose command line sets no name.
pub fn node_for_stub<T>(mut nodes: Vec<T>, argv: impl Fn(&T) -> &[String]) -> Option<T> {
    if nodes.len() > 1 {
        nodes.retain(|node| !sets_name(argv(node)));
    }
    nodes.pop().filter(|_| nodes.is_empty())
}

/// Returns the parts of the node name that a command line sets for all nodes, by rules that are not for a single node.
pub fn global_naming(argv: &[String]) -> Naming {
    let says = |renamed: RemapTarget| has_rule(argv, |rule| rule.of == renamed && rule.node.is_none());
    Naming { name: says(RemapTarget::Node), namespace: says(RemapTarget::Namespace) }
}

fn take_value<'a>(flag: &str, next: Option<&'a String>, form: &'static str) -> Result<&'a String, ArgumentError> {
    next.ok_or_else(|| ArgumentError::NoValue { flag: flag.to_owned(), form })
}

fn refused_error(flag: &str, given: &str, reason: ValueProblem, form: &'static str) -> ArgumentError {
    ArgumentError::Refused { flag: flag.to_owned(), given: given.to_owned(), reason, form }
}

fn is_switch(text: &str) -> bool {
    let of = text.strip_prefix("--enable-").or_else(|| text.strip_prefix("--disable-"));
    of.is_some_and(|of| SWITCHES.contains(&of))
}

/// Returns true for a ROS 2 name without slashes.
pub fn is_token(text: &str) -> bool {
    text.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

/// Returns true if a parameter of this name can be given on a command line; a file can contain others.
pub fn is_parameter_name(name: &str) -> bool {
    name.split(['.', '/']).all(is_token)
}

fn split_rule(text: &str) -> Result<(&str, &str), ValueProblem> {
    text.split_once(":=").ok_or(ValueProblem::NoSeparator)
}

/// Splits off a `NODE:` prefix.
fn split_node(text: &str) -> Result<(Option<String>, &str), ValueProblem> {
    match text.split_once(':') {
        Some((node, rest)) if is_token(node) => Ok((Some(node.to_owned()), rest)),
        Some((node, _)) => Err(ValueProblem::NotANode(node.to_owned())),
        None => Ok((None, text)),
    }
}

fn parse_rule(text: &str) -> Result<RemapRule, ValueProblem> {
    let (from, to) = split_rule(text)?;
    // Rules for topics or services only.
    let kinds = [("rostopic://", RemapTarget::Topic), ("rosservice://", RemapTarget::Service)];
    let below = |name| {
        let mut kinds = kinds.iter();
        kinds.find_map(|(scheme, of)| Some((str::strip_prefix(name, scheme)?, *of)))
    };
    let (node, from, kind) = match below(from) {
        Some((name, of)) => (None, name, Some(of)),
        None => {
            let (node, name) = split_node(from)?;
            let (name, of) = below(name).map_or((name, None), |(name, of)| (name, Some(of)));
            (node, name, of)
        }
    };
    let of = match (kind, from) {
        (None, "__node" | "__name") => RemapTarget::Node,
        (None, "__ns") => RemapTarget::Namespace,
        (None, _) => RemapTarget::Name,
        (Some(of), _) => of,
    };
    match of {
        RemapTarget::Node if !is_token(to) => {
            return Err(ValueProblem::NotANewNode(to.to_owned()));
        }
        RemapTarget::Namespace if to != "/" && !names::is_global(to) => {
            return Err(ValueProblem::NotANamespace(to.to_owned()));
        }
        of if of.is_name() && !is_pattern(from) => {
            return Err(ValueProblem::NotANameBefore(from.to_owned()));
        }
        of if of.is_name() && !is_pattern(to) => {
            return Err(ValueProblem::NotANameBehind(to.to_owned()));
        }
        _ => {}
    }
    Ok(RemapRule { node, of, from: from.to_owned(), to: to.to_owned() })
}

/// Checks the characters that rcl allows in rules; whether the rule makes sense is left to the node in the cloud.
fn is_pattern(name: &str) -> bool {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"_/~*\\.".contains(&byte);
    !name.is_empty() && name.bytes().all(allowed)
}

fn parse_parameter(text: &str) -> Result<Parameter, ValueProblem> {
    let (name, text) = split_rule(text)?;
    let (node, name) = split_node(name)?;
    if !is_parameter_name(name) {
        return Err(ValueProblem::NotAParameter(name.to_owned()));
    }
    Ok(Parameter { node, name: name.to_owned(), value: text.to_owned() })
}

#[cfg(test)]
mod tests;
