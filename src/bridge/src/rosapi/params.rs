//! The parameter server of ROS 1. Values are passed as JSON text, since the fields of a service have fixed types.

use std::sync::Arc;

use budget::{Budget, JsonWeight, Permit};
use ros::bus::{BusError, ParamValue, RosVersion};
use serde::de::IgnoredAny;
use serde_json::{Value, json};

use super::Args;
use crate::names::resolve;
use crate::shared::BridgeShared;

fn param_name(args: &Args) -> Result<String, String> {
    match args.name.as_str() {
        "" => Err("field \"name\" is missing, a parameter's name is expected".to_owned()),
        "/" => Ok("/".to_owned()),
        name => resolve(RosVersion::One, name).map(|name| name.into_owned()),
    }
}

pub(super) fn bus_error_text(error: BusError) -> String {
    error.to_string()
}

/// Maximum bytes of a default. A caller need not have a longer one sent back to itself.
const LONGEST_DEFAULT: usize = 1 << 20;

/// Returns the default given by the caller for a missing parameter, as JSON; `None` if there is none.
pub(super) fn parse_default(args: &Args) -> Result<Option<String>, String> {
    let (field, default) = match args.default.as_str() {
        "" => ("default_value", args.default_value.as_str()),
        default => ("default", default),
    };
    if default.is_empty() {
        return Ok(None);
    }
    if default.len() > LONGEST_DEFAULT {
        return Err(format!(
            "field {field:?} has {} bytes, at most {LONGEST_DEFAULT} are taken",
            default.len()
        ));
    }
    // Only validated: a parsed tree would take many times its bytes.
    let json = serde_json::from_str::<IgnoredAny>(default);
    Ok(Some(match json {
        Ok(_) => default.trim().to_owned(),
        // A default that is not JSON is a string.
        Err(_) => Value::from(default).to_string(),
    }))
}

/// Formats a value as JSON text.
pub(super) fn to_json_text(value: &ParamValue) -> Result<String, String> {
    serde_json::to_string(value).map_err(|error| error.to_string())
}

pub(super) async fn get(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, String> {
    let value = match shared.bus.parameter(&param_name(args)?).await {
        Ok(value) => to_json_text(&value)?,
        Err(BusError::NoParam(_)) => parse_default(args)?.unwrap_or_else(|| "null".to_owned()),
        Err(error) => return Err(bus_error_text(error)),
    };
    Ok(json!({ "value": value }))
}

/// A value given by a caller, which counts in the caller's budget while this exists.
pub(super) struct GivenValue {
    pub(super) value: ParamValue,
    _held: Permit,
}

/// Number of trees per value: it is parsed into one, and a document is built from that for the Master or the node.
const TREES: usize = 2;

impl GivenValue {
    /// Parses the value.
    ///
    /// # Errors
    /// Fails if it is not JSON, contains null, is larger or deeper than allowed, or has no room in `budget`.
    pub(super) fn read(args: &Args, budget: &Budget) -> Result<Self, String> {
        let mut held = budget.permit();
        let weight = JsonWeight::estimate(args.value.as_bytes());
        let counted = held.count(TREES * weight.bytes);
        counted.map_err(|full| format!("field \"value\": {full}"))?;
        let value = serde_json::from_str(&args.value);
        let value = value.map_err(|error| value_error(&args.value, &error))?;
        Ok(Self { value, _held: held })
    }
}

/// Explains why a value is invalid.
fn value_error(text: &str, error: &serde_json::Error) -> String {
    let shown: String = text.chars().take(48).collect();
    let given = serde_json::from_str::<Value>(text);
    match given.as_ref().map(|given| find_null(given, String::new())) {
        Ok(Some(place)) if place.is_empty() => {
            "field \"value\" is null, which no ROS parameter can be; call delete_param to remove one".to_owned()
        }
        Ok(Some(place)) => {
            format!("field \"value\" holds null at {place}, which no ROS parameter can; leave it out")
        }
        Ok(None) => format!("field \"value\" is {shown:?}, which no ROS parameter can be: {error}"),
        Err(_) => format!(
            "field \"value\" is {shown:?}, JSON text (a boolean, number, string, list or object) is expected"
        ),
    }
}

pub(super) async fn set(
    shared: &Arc<BridgeShared>,
    args: &Args,
    budget: &Budget,
) -> Result<Value, String> {
    let (key, given) = (param_name(args)?, GivenValue::read(args, budget)?);
    let parameters = shared.bus.parameters().map_err(bus_error_text)?;
    let set = parameters.set(&key, given.value);
    set.await.map_err(bus_error_text)?;
    Ok(json!({}))
}

/// Returns the path of the first null in a value: `/robot/arms/0`.
fn find_null(value: &Value, place: String) -> Option<String> {
    match value {
        Value::Null => Some(place),
        Value::Array(items) => items
            .iter()
            .enumerate()
            .find_map(|(at, item)| find_null(item, format!("{place}/{at}"))),
        Value::Object(members) => members
            .iter()
            .find_map(|(name, member)| find_null(member, format!("{place}/{name}"))),
        _ => None,
    }
}

pub(super) async fn has(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(bus_error_text)?;
    Ok(json!({ "exists": parameters.has(&param_name(args)?).await.map_err(bus_error_text)? }))
}

pub(super) async fn search(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(bus_error_text)?;
    let found = parameters.search("/", args.name.trim_start_matches('/'));
    let found = found.await.map_err(bus_error_text)?;
    Ok(json!({ "global_name": found.unwrap_or_default() }))
}

pub(super) async fn delete(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(bus_error_text)?;
    match parameters.delete(&param_name(args)?).await {
        Ok(()) | Err(BusError::NoParam(_)) => Ok(json!({})),
        Err(error) => Err(bus_error_text(error)),
    }
}

pub(super) async fn names(shared: &Arc<BridgeShared>) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(bus_error_text)?;
    Ok(json!({ "names": parameters.names().await.map_err(bus_error_text)? }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args_with_value(value: &str) -> Args {
        Args {
            value: value.to_owned(),
            ..Args::default()
        }
    }

    #[test]
    fn a_value_that_is_given_counts_while_it_exists() {
        let budget = Budget::new("client x", 64 << 20);
        let list = format!("[{}1]", "1,".repeat(10_000));
        let given = GivenValue::read(&args_with_value(&list), &budget).expect("there is room");
        assert!(budget.used_bytes() > 10_000 * size_of::<ParamValue>());
        drop(given);
        assert_eq!(budget.used_bytes(), 0);
        // Less than a megabyte.
        let maps = format!("[{}1]", r#"{"":1},"#.repeat(100_000));
        let full = GivenValue::read(&args_with_value(&maps), &budget).err();
        let full = full.expect("it has no room");
        assert!(full.contains("the memory for client x"), "{full}");
        assert_eq!(budget.used_bytes(), 0);
    }

    #[test]
    fn a_value_that_ros_cannot_have_is_refused_with_its_reason() {
        let budget = Budget::without_limit();
        let deep = format!("{}1{}", "[".repeat(101), "]".repeat(101));
        for (value, words) in [
            ("null", "call delete_param"),
            (r#"{"a":[1,null]}"#, "null at /a/1"),
            ("nonsense", "JSON text (a boolean"),
            ("", "JSON text (a boolean"),
            (deep.as_str(), "more than 100 deep"),
        ] {
            let refused = GivenValue::read(&args_with_value(value), &budget).err();
            let refused = refused.expect(value);
            assert!(refused.contains(words), "{refused}");
        }
    }

    #[test]
    fn a_default_is_sent_as_it_was_given() {
        let of = |default: &str| {
            super::parse_default(&Args {
                default: default.to_owned(),
                ..Args::default()
            })
        };
        assert_eq!(of(""), Ok(None));
        assert_eq!(of(" [1, 2]\n"), Ok(Some("[1, 2]".to_owned())));
        assert_eq!(of("a \"b"), Ok(Some(r#""a \"b""#.to_owned())));
        let longest = "1".repeat(LONGEST_DEFAULT);
        assert!(of(&longest).is_ok());
        let refused = of(&format!("{longest}1")).expect_err("it is longer");
        assert!(refused.contains("at most 1048576"), "{refused}");
    }
}
