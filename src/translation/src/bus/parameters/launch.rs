//! Parameters that a node is started with in the other ROS. Its arguments are in the servant's spelling already
//! ([`ros::spelling`]); what is added here depends on what stands at the robot's Master and on the types of the node's
//! parameters.
//!
//! ```text
//!  robot ROS 1                              servant ROS 2
//!  /see/gains/p at the Master               -p gains.p:=1, before the arguments, which override it
//!  /use_sim_time at the Master              -p use_sim_time:=true
//!  _rate:=2 of a double                     -p rate:=2.0
//!
//!  robot ROS 2                              servant ROS 1
//!  -p gains.p:=[1, 2], as _gains/p:=[1, 2]  /see/gains/p at the Master before the node starts
//! ```
//! roscpp reads `_p:=v` as a number, a bool or a text, so lists must stand at the Master. What cannot be said in the
//! other ROS is left out, in words.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::fmt::Display;

use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{ParamValue, ParameterKind};
use ros::ros2::arguments::{self, BEGIN, END, Kind};
use ros::ros2::parameters::yaml::parse_any;
use ros::ros2::process::yaml;

use super::names::SIM_TIME;
use super::values::{NodeValues, ParameterRefusal, Tree, check_for_ros1};

/// Maximum size of one argument in bytes; Linux takes no longer ones than 128 KiB.
const MAX_ARGUMENT: usize = 100 << 10;
/// Maximum size in bytes, and number, of all parameters on a command line.
const MAX_PARAMETERS: (usize, usize) = (1 << 20, 2000);
/// Maximum number of things left out that are named.
const MAX_OMISSIONS: usize = 20;
/// Maximum number of characters shown of something left out, and of the reason.
const MAX_SHOWN_LENGTH: usize = 200;

/// Arguments and parameters with which a node of the other ROS is started.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TranslatedLaunch {
    /// Arguments of the node.
    pub argv: Vec<String>,
    /// Parameters that are to stand at the Master before it starts, by key. None in ROS 2.
    pub parameters: Vec<(String, ParamValue)>,
    /// Parameters that are not passed on, with the reasons.
    pub left_out: LeftOutParameters,
}

/// Parameters that a node is not given. Only the first ones are named.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LeftOutParameters {
    named: Vec<String>,
    others: usize,
}

impl LeftOutParameters {
    /// Adds a parameter.
    pub fn add(&mut self, name: &str, reason: &dyn Display) {
        if self.named.len() < MAX_OMISSIONS {
            let name: String = name.chars().take(MAX_SHOWN_LENGTH).collect();
            let reason: String = reason.to_string().chars().take(MAX_SHOWN_LENGTH).collect();
            self.named.push(format!("{name}: {reason}"));
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
        Some(format!("{node} is not given these parameters in the cloud: {}{more}", self.named.join("; ")))
    }
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

/// Returns what a node of ROS 2 is started with: `argv`, which is in the spelling of ROS 2, and before it the
/// parameters that stand below the node's name at the robot's Master and, if it is known, whether time is simulated.
/// `kinds`: types of the node's parameters as far as they are known; ROS 1 says `1` where a double is meant.
pub(super) fn for_ros2(
    argv: &[String],
    private: &Tree,
    simulated: Option<bool>,
    kinds: &BTreeMap<String, ParameterKind>,
) -> TranslatedLaunch {
    let mut left_out = LeftOutParameters::default();
    let mut private_values = NodeValues::default();
    for (name, value) in private {
        private_values.add(spell_in_ros2(name), value.clone());
    }
    for (name, refusal) in private_values.refused {
        left_out.add(&name, &refusal);
    }
    let mut given: BTreeMap<String, ParamValue> = private_values.values.into_iter().collect();
    if let Some(simulated) = simulated {
        given.insert(SIM_TIME.to_owned(), ParamValue::Bool(simulated));
    }
    let (mut words, mut bytes, mut count) = (Vec::new(), 0, 0);
    for (name, value) in given {
        let value = fit(value, kinds.get(&name));
        match parameter_argument(&name, &value, bytes, count) {
            Ok(argument) => {
                bytes += argument.len();
                count += 1;
                words.extend(["-p".to_owned(), argument]);
            }
            Err(reason) => left_out.add(&name, &reason),
        }
    }
    if !words.is_empty() {
        words.insert(0, BEGIN.to_owned());
        words.push(END.to_owned());
    }
    words.extend(fit_arguments(argv, kinds));
    TranslatedLaunch { argv: words, parameters: Vec::new(), left_out }
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
    let argument = format!("{name}:={}", yaml(value));
    if argument.len() > MAX_ARGUMENT {
        return Err(LeftOutReason::TooLong(argument.len()));
    }
    if count >= MAX_PARAMETERS.1 || bytes + argument.len() > MAX_PARAMETERS.0 {
        return Err(LeftOutReason::TooMany);
    }
    Ok(argument)
}

/// Returns the arguments with values of the types that the node's parameters have, where they are known.
fn fit_arguments(argv: &[String], kinds: &BTreeMap<String, ParameterKind>) -> Vec<String> {
    let Ok(parts) = arguments::parse(argv) else {
        return argv.to_vec();
    };
    let mut words = Vec::with_capacity(argv.len());
    for part in parts {
        match (&part.kind, &part.words[..]) {
            (Kind::Parameter(parameter), [flag, word]) => {
                let fitted =
                    kinds.get(&spell_in_ros2(&parameter.name)).and_then(|kind| fit_text(&parameter.value, kind));
                let (name, _) = word.split_once(":=").unwrap_or((word.as_str(), ""));
                let word = fitted.map_or_else(|| word.clone(), |value| format!("{name}:={value}"));
                words.extend([flag.clone(), word]);
            }
            _ => words.extend(part.words),
        }
    }
    words
}

/// Returns a value of `-p` in the type of the parameter; `None` if it need not, or cannot, be changed.
fn fit_text(text: &str, kind: &ParameterKind) -> Option<String> {
    let value = parse_any(text);
    let is_text = matches!(value, ParamValue::String(_));
    let fitted = match kind {
        // `_name:=5` of ROS 1 is what the node reads as a text.
        ParameterKind::String if !is_text => ParamValue::String(text.to_owned()),
        _ => fit(value.clone(), Some(kind)),
    };
    (fitted != value).then(|| yaml(&fitted))
}

/// Converts a value to the type of the node's parameter where that is lossless.
fn fit(value: ParamValue, kind: Option<&ParameterKind>) -> ParamValue {
    const EXACT: u64 = 1 << 53;
    match (value, kind) {
        (ParamValue::Int(number), Some(ParameterKind::Double)) if number.unsigned_abs() <= EXACT => {
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

/// Returns what the node of ROS 1 of this absolute name is started with: `argv`, which is in the spelling of ROS 1,
/// without the parameters in it, and these parameters.
pub(super) fn for_ros1(node: &str, argv: &[String]) -> TranslatedLaunch {
    let mut launch = TranslatedLaunch::default();
    let mut parameters: BTreeMap<String, ParamValue> = BTreeMap::new();
    for word in argv {
        let parameter = word.strip_prefix('_').filter(|rest| !rest.starts_with('_'));
        let Some((name, text)) = parameter.and_then(|parameter| parameter.split_once(":=")) else {
            launch.argv.push(word.clone());
            continue;
        };
        let value = parse_any(text);
        match check_for_ros1(&value) {
            Ok(()) => drop(parameters.insert(format!("{node}/{name}"), value)),
            Err(refusal) => launch.left_out.add(name, &refusal),
        }
    }
    launch.parameters = parameters.into_iter().collect();
    launch
}
