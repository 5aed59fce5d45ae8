//! Arguments of a node in the other ROS.
//!
//! ```text
//!  ROS 1                                        ROS 2
//!  _gains/p:=1                                  -p gains.p:=1
//!  /see/gains/p at the Master                   -p gains.p:=1, before those of the command line
//!  /use_sim_time at the Master                  -p use_sim_time:=true
//!  scan:=/front ~out:=boxes                     -r scan:=/front -r ~/out:=boxes
//!  3 --fast                                     3 --fast
//! ```
//! In the other direction parameters of the command line stand at the Master before the node starts. A node's name and
//! namespace are given to it separately, so rules for these are left out. What cannot be said in the other ROS is left
//! out, in words.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use ros::bus::{ParamValue, ParameterKind};
use ros::ros2::arguments::{self, ArgumentError, Kind, RemapRule};
use ros::ros2::process::yaml;

use super::names::{SIM_TIME, SIM_TIME_KEY, shown_key, to_key, to_name};
use super::values::{NodeValues, ParameterRefusal, Tree, check_for_ros1};

/// Maximum size of one argument in bytes; Linux takes no longer ones than 128 KiB.
const MAX_ARGUMENT: usize = 100 << 10;
/// Maximum size in bytes, and number, of all parameters on a command line.
const MAX_PARAMETERS: (usize, usize) = (1 << 20, 2000);
/// Maximum number of things left out that are named.
const MAX_LEFT_OUT: usize = 20;
/// Maximum number of characters shown of something left out.
const SHOWN: usize = 200;

/// What a node of the other ROS is started with.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TranslatedLaunch {
    /// Its arguments.
    pub argv: Vec<String>,
    /// Parameters that stand at the Master before it starts, by key. None in ROS 2.
    pub parameters: Vec<(String, ParamValue)>,
    /// What it is not given, with the reasons.
    pub left_out: LeftOutArguments,
}

/// Arguments and parameters that a node is not given. Only the first ones are named.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LeftOutArguments {
    named: Vec<String>,
    others: usize,
}

impl LeftOutArguments {
    /// Adds something left out.
    pub(super) fn add(&mut self, what: &str, reason: &dyn std::fmt::Display) {
        if self.named.len() < MAX_LEFT_OUT {
            let what: String = what.chars().take(SHOWN).collect();
            let reason: String = reason.to_string().chars().take(SHOWN).collect();
            self.named.push(format!("{what}: {reason}"));
        } else {
            self.others += 1;
        }
    }

    /// Returns a text about what the node is not given; `None` if it is given everything.
    pub fn describe(&self, node: &str) -> Option<String> {
        if self.named.is_empty() {
            return None;
        }
        let more = if self.others > 0 { format!("; and {} more", self.others) } else { String::new() };
        Some(format!("{node} runs in the other ROS and is not given {}{more}", self.named.join("; ")))
    }
}

/// Returns what a node of ROS 2 is started with in place of one of ROS 1: from the arguments of that one, the parameters
/// below its name at the Master and, if it is known, whether time is simulated. `kinds`: types of the node's parameters
/// as far as they are known; ROS 1 says `1` where a double is meant.
pub(super) fn for_ros2(
    argv: &[String],
    private: &Tree,
    simulated: Option<bool>,
    kinds: &BTreeMap<String, ParameterKind>,
) -> TranslatedLaunch {
    let mut launch = TranslatedLaunch::default();
    let mut parameters = NodeValues::default();
    for (name, value) in private {
        parameters.add(to_name(name), value.clone());
    }
    let (mut rules, mut given) = (Vec::new(), BTreeMap::new());
    for word in argv {
        let Some((from, to)) = word.split_once(":=") else {
            launch.argv.push(word.clone());
            continue;
        };
        match from.strip_prefix('_') {
            // Settings of the process, such as its log file.
            Some(setting) if setting.starts_with('_') => {}
            Some(name) => parameters.add(to_name(name), parse_argument(to, kinds.get(&to_name(name)))),
            None => match (remap_for_ros2(from), remap_for_ros2(to)) {
                (Some(from), Some(to)) => rules.push(format!("{from}:={to}")),
                _ => launch.left_out.add(word, &"it is not a rule between two names"),
            },
        }
    }
    for (name, refusal) in parameters.refused {
        launch.left_out.add(&format!("parameter {name}"), &refusal);
    }
    // Later values override earlier ones.
    given.extend(parameters.values);
    if let Some(simulated) = simulated {
        given.insert(SIM_TIME.to_owned(), ParamValue::Bool(simulated));
    }
    let mut arguments = Vec::new();
    let mut bytes = 0;
    for (name, value) in given {
        let value = fit(value, kinds.get(&name));
        match parameter_argument(&name, &value, bytes, arguments.len()) {
            Ok(argument) => {
                bytes += argument.len();
                arguments.push(argument);
            }
            Err(reason) => launch.left_out.add(&format!("parameter {name}"), &reason),
        }
    }
    if rules.is_empty() && arguments.is_empty() {
        return launch;
    }
    launch.argv.push(arguments::BEGIN.to_owned());
    // In ROS 1 the last rule for a name applies, in ROS 2 the first.
    for (flag, words) in [("-r", rules.into_iter().rev().collect()), ("-p", arguments)] {
        let words: Vec<String> = words;
        launch.argv.extend(words.into_iter().flat_map(|word| [flag.to_owned(), word]));
    }
    launch
}

/// Reasons why a parameter is not given on a command line of ROS 2.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
enum LeftOutReason {
    #[error(transparent)]
    Refused(#[from] ParameterRefusal),
    #[error("an empty list does not say what it is a list of; leave it out, or set it once the node runs")]
    EmptyList,
    #[error("bytes cannot be given on a command line; set them once the node runs")]
    Bytes,
    #[error("it takes {0} bytes, more than the {MAX_ARGUMENT} of an argument; put it into a file of the package")]
    TooLong(usize),
    #[error("its node has more than {} parameters or {} bytes of them", MAX_PARAMETERS.1, MAX_PARAMETERS.0)]
    TooMany,
}

/// Returns `NAME:=VALUE`. `bytes` and `count`: of the parameters before it.
fn parameter_argument(name: &str, value: &ParamValue, bytes: usize, count: usize) -> Result<String, LeftOutReason> {
    if !arguments::is_parameter_name(name) {
        return Err(ParameterRefusal::Name(name.to_owned()).into());
    }
    match value {
        ParamValue::List(items) if items.is_empty() => return Err(LeftOutReason::EmptyList),
        ParamValue::Binary(_) => return Err(LeftOutReason::Bytes),
        _ => {}
    }
    if count >= MAX_PARAMETERS.1 {
        return Err(LeftOutReason::TooMany);
    }
    let argument = format!("{name}:={}", yaml(value));
    if argument.len() > MAX_ARGUMENT {
        return Err(LeftOutReason::TooLong(argument.len()));
    }
    if bytes + argument.len() > MAX_PARAMETERS.0 {
        return Err(LeftOutReason::TooMany);
    }
    Ok(argument)
}

/// Converts a name of a rule of ROS 1; `None` if it is none.
fn remap_for_ros2(name: &str) -> Option<String> {
    let (private, rest) = match name.strip_prefix('~') {
        Some(rest) => ("~/", rest.trim_start_matches('/')),
        None => ("", name),
    };
    let is_name = rest.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_/".contains(&byte));
    (is_name && !rest.is_empty()).then(|| format!("{private}{rest}"))
}

/// Parses a value of `_p:=value` as rospy and roscpp do. Of a text parameter it is the text.
fn parse_argument(text: &str, kind: Option<&ParameterKind>) -> ParamValue {
    match kind {
        Some(ParameterKind::String) => ParamValue::String(text.to_owned()),
        _ => parse_yaml(text),
    }
}

/// Parses YAML; what is none is a text, and so is nothing.
fn parse_yaml(text: &str) -> ParamValue {
    serde_norway::from_str(text).unwrap_or_else(|_| ParamValue::String(text.to_owned()))
}

/// Parses a value of `-p`. In rcl these words are bools, too, unless they are quoted.
fn parse_ros2_yaml(text: &str) -> ParamValue {
    let word = text.trim();
    let is_any_of = |words: [&str; 3]| {
        let spelled = |of: &str| [of.to_owned(), of.to_uppercase(), format!("{}{}", of[..1].to_uppercase(), &of[1..])];
        words.iter().any(|of| spelled(of).iter().any(|spelled| spelled == word))
    };
    if is_any_of(["y", "yes", "on"]) {
        ParamValue::Bool(true)
    } else if is_any_of(["n", "no", "off"]) {
        ParamValue::Bool(false)
    } else {
        parse_yaml(text)
    }
}

/// Converts a value to the type of the node's parameter where that is lossless.
fn fit(value: ParamValue, kind: Option<&ParameterKind>) -> ParamValue {
    const EXACT: i64 = 1 << 53;
    match (value, kind) {
        (ParamValue::Int(number), Some(ParameterKind::Double)) if number.abs() <= EXACT => {
            ParamValue::Double(number as f64)
        }
        (ParamValue::Double(number), Some(ParameterKind::Integer))
            if number.fract() == 0.0 && number.abs() <= EXACT as f64 =>
        {
            ParamValue::Int(number as i64)
        }
        (ParamValue::List(items), Some(ParameterKind::Doubles)) => {
            ParamValue::List(items.into_iter().map(|item| fit(item, Some(&ParameterKind::Double))).collect())
        }
        (value, _) => value,
    }
}

/// Returns what a node of ROS 1 is started with in place of the node of ROS 2 of this absolute name, from the arguments
/// of that one.
///
/// # Errors
/// rcl would refuse an argument.
pub(super) fn for_ros1(node: &str, argv: &[String]) -> Result<TranslatedLaunch, ArgumentError> {
    let mut launch = TranslatedLaunch::default();
    let own = node.rsplit('/').next().unwrap_or(node);
    let mut rules: Vec<(String, String)> = Vec::new();
    let mut parameters: BTreeMap<String, ParamValue> = BTreeMap::new();
    for part in arguments::parse(argv)? {
        let words = part.words.join(" ");
        match part.kind {
            Kind::Own => launch.argv.extend(part.words),
            Kind::Mark => {}
            Kind::Rule(rule) if !rule.of.is_name() => {}
            Kind::Rule(rule) if !rule.applies_to(own) => {
                launch.left_out.add(&words, &"it is for another node, and the program of ROS 1 is one node");
            }
            Kind::Rule(RemapRule { from, to, .. }) => match (remap_for_ros1(&from), remap_for_ros1(&to)) {
                // Of several rules for a name the first one applies in ROS 2.
                (Some(from), Some(_)) if rules.iter().any(|(known, _)| *known == from) => {}
                (Some(from), Some(to)) => rules.push((from, to)),
                _ => launch.left_out.add(&words, &"ROS 1 has no patterns in rules"),
            },
            Kind::Parameter(parameter) if parameter.is_for_other_node(node) => {
                launch.left_out.add(&words, &"it is for another node, and the program of ROS 1 is one node");
            }
            Kind::Parameter(parameter) => {
                let name = to_name(&parameter.name);
                let key = match &*name {
                    SIM_TIME => Some(SIM_TIME_KEY.to_owned()),
                    _ => to_key(node, &name),
                };
                let value = parse_ros2_yaml(&parameter.value);
                match (key, check_for_ros1(&value)) {
                    (Some(key), Ok(())) => {
                        parameters.insert(key, value);
                    }
                    (None, _) => launch.left_out.add(&words, &ParameterRefusal::Key(shown_key("~", &name))),
                    (_, Err(refusal)) => launch.left_out.add(&words, &refusal),
                }
            }
            Kind::File(_) => launch.left_out.add(&words, &"the file is on the robot; give its parameters by -p"),
            Kind::Setting => launch.left_out.add(&words, &"ROS 1 has no such argument"),
        }
    }
    launch.argv.extend(rules.into_iter().map(|(from, to)| format!("{from}:={to}")));
    launch.parameters = parameters.into_iter().collect();
    Ok(launch)
}

/// Converts a name of a rule of ROS 2; `None` for a pattern.
fn remap_for_ros1(name: &str) -> Option<String> {
    let (private, rest) = match name.strip_prefix("~/") {
        Some(rest) => ("~", rest),
        None => ("", name),
    };
    let is_name = rest.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_/".contains(&byte));
    (is_name && !rest.is_empty()).then(|| format!("{private}{rest}"))
}
