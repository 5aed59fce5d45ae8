//! The parameter server of ROS 1. Values are passed as JSON text, since the fields of a service have fixed types.

use std::sync::Arc;

use budget::{Budget, JsonWeight, Permit};
use ros::bus::{BusError, ParamValue, RosVersion};
use serde::de::IgnoredAny;
use serde_json::{Value, json};

use super::Args;
use super::param_error::{LONGEST_DEFAULT, ParamRequestError};
use crate::names::resolve;
use crate::shared::BridgeShared;

fn param_name(args: &Args) -> Result<String, ParamRequestError> {
    match args.name.as_str() {
        "" => Err(ParamRequestError::NoName),
        "/" => Ok("/".to_owned()),
        name => Ok(resolve(RosVersion::One, name)?.into_owned()),
    }
}

/// Returns the default given by the caller for a missing parameter, as JSON; `None` if there is none.
pub(super) fn parse_default(args: &Args) -> Result<Option<String>, ParamRequestError> {
    let (field, default) = match args.default.as_str() {
        "" => ("default_value", args.default_value.as_str()),
        default => ("default", default),
    };
    if default.is_empty() {
        return Ok(None);
    }
    if default.len() > LONGEST_DEFAULT {
        return Err(ParamRequestError::LongDefault { field, length: default.len() });
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
pub(super) fn to_json_text(value: &ParamValue) -> Result<String, ParamRequestError> {
    serde_json::to_string(value).map_err(ParamRequestError::Print)
}

pub(super) async fn get(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let value = match shared.bus.parameter(&param_name(args)?).await {
        Ok(value) => to_json_text(&value)?,
        Err(BusError::NoParam(_)) => parse_default(args)?.unwrap_or_else(|| "null".to_owned()),
        Err(error) => return Err(error.into()),
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
    pub(super) fn read(args: &Args, budget: &Budget) -> Result<Self, ParamRequestError> {
        let mut held = budget.permit();
        let weight = JsonWeight::estimate(args.value.as_bytes());
        held.count(TREES * weight.bytes)?;
        let value = serde_json::from_str(&args.value);
        let value = value.map_err(|error| value_error(&args.value, error))?;
        Ok(Self { value, _held: held })
    }
}

/// Returns the reason why a value is invalid, given the error of parsing it as a parameter's.
fn value_error(text: &str, source: serde_json::Error) -> ParamRequestError {
    let shown = text.chars().take(48).collect();
    let given = serde_json::from_str::<Value>(text);
    match given.map(|given| find_null(&given, String::new())) {
        Ok(Some(place)) if place.is_empty() => ParamRequestError::Null,
        Ok(Some(place)) => ParamRequestError::NullInside(place),
        Ok(None) => ParamRequestError::Unfit { shown, source },
        Err(_) => ParamRequestError::NotJson(shown),
    }
}

pub(super) async fn set(shared: &Arc<BridgeShared>, args: &Args, budget: &Budget) -> Result<Value, ParamRequestError> {
    let (key, given) = (param_name(args)?, GivenValue::read(args, budget)?);
    let parameters = shared.bus.parameters()?;
    parameters.set(&key, given.value).await?;
    Ok(json!({}))
}

/// Returns the path of the first null in a value: `/robot/arms/0`.
fn find_null(value: &Value, place: String) -> Option<String> {
    match value {
        Value::Null => Some(place),
        Value::Array(items) => items.iter().enumerate().find_map(|(at, item)| find_null(item, format!("{place}/{at}"))),
        Value::Object(members) => {
            members.iter().find_map(|(name, member)| find_null(member, format!("{place}/{name}")))
        }
        _ => None,
    }
}

pub(super) async fn has(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let parameters = shared.bus.parameters()?;
    Ok(json!({ "exists": parameters.has(&param_name(args)?).await? }))
}

pub(super) async fn search(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let parameters = shared.bus.parameters()?;
    let found = parameters.search("/", args.name.trim_start_matches('/'));
    Ok(json!({ "global_name": found.await?.unwrap_or_default() }))
}

pub(super) async fn delete(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let parameters = shared.bus.parameters()?;
    match parameters.delete(&param_name(args)?).await {
        Ok(()) | Err(BusError::NoParam(_)) => Ok(json!({})),
        Err(error) => Err(error.into()),
    }
}

pub(super) async fn names(shared: &Arc<BridgeShared>) -> Result<Value, ParamRequestError> {
    let parameters = shared.bus.parameters()?;
    Ok(json!({ "names": parameters.names().await? }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args_with_value(value: &str) -> Args {
        Args { value: value.to_owned(), ..Args::default() }
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
        let full = full.expect("it has no room").to_string();
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
            let refused = refused.expect(value).to_string();
            assert!(refused.contains(words), "{refused}");
        }
    }

    #[test]
    fn a_default_is_sent_as_it_was_given() {
        let of = |default: &str| super::parse_default(&Args { default: default.to_owned(), ..Args::default() });
        assert_eq!(of("").unwrap(), None);
        assert_eq!(of(" [1, 2]\n").unwrap(), Some("[1, 2]".to_owned()));
        assert_eq!(of("a \"b").unwrap(), Some(r#""a \"b""#.to_owned()));
        let longest = "1".repeat(LONGEST_DEFAULT);
        assert!(of(&longest).is_ok());
        let refused = of(&format!("{longest}1")).expect_err("it is longer");
        let refused = refused.to_string();
        assert!(refused.contains("at most 1048576"), "{refused}");
    }
}
