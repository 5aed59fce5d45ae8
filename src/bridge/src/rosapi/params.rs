//! The parameter server of ROS 1. Values travel as JSON text, since a service's fields have fixed types.

use std::sync::Arc;

use ros::bus::{BusError, ParamValue, RosVersion};
use serde_json::{Value, json};

use super::Args;
use crate::names::resolve;
use crate::shared::Shared;

fn key(args: &Args) -> Result<String, String> {
    match args.name.as_str() {
        "" => Err("field \"name\" is missing, a parameter's name is expected".to_owned()),
        "/" => Ok("/".to_owned()),
        name => resolve(RosVersion::One, name).map(|name| name.into_owned()),
    }
}

pub(super) fn failed(error: BusError) -> String {
    error.to_string()
}

/// What a caller wants in place of a parameter that is not there, as JSON; none where it does not say.
pub(super) fn default(args: &Args) -> Option<String> {
    let default = match args.default.as_str() {
        "" => args.default_value.as_str(),
        default => default,
    };
    match serde_json::from_str::<Value>(default) {
        Ok(value) => Some(value.to_string()),
        Err(_) if default.is_empty() => None,
        // A default that is no JSON is a text.
        Err(_) => Some(Value::from(default).to_string()),
    }
}

/// A value as JSON text.
pub(super) fn written(value: &ParamValue) -> Result<String, String> {
    serde_json::to_string(value).map_err(|error| error.to_string())
}

pub(super) async fn get(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let value = match shared.bus.parameter(&key(args)?).await {
        Ok(value) => written(&value)?,
        Err(BusError::NoParam(_)) => default(args).unwrap_or_else(|| "null".to_owned()),
        Err(error) => return Err(failed(error)),
    };
    Ok(json!({ "value": value }))
}

/// The value that a caller gives.
pub(super) fn given(args: &Args) -> Result<ParamValue, String> {
    serde_json::from_str(&args.value).map_err(|_| {
        let shown: String = args.value.chars().take(48).collect();
        let given = serde_json::from_str::<Value>(&args.value);
        match given.ok().and_then(|given| null_in(&given, String::new())) {
            Some(place) if place.is_empty() => {
                "field \"value\" is null, which no ROS parameter can be; call delete_param to remove one".to_owned()
            }
            Some(place) => {
                format!("field \"value\" holds null at {place}, which no ROS parameter can; leave it out")
            }
            None => format!(
                "field \"value\" is {shown:?}, JSON text (a boolean, number, string, list or object) is expected"
            ),
        }
    })
}

pub(super) async fn set(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let value = given(args)?;
    let parameters = shared.bus.parameters().map_err(failed)?;
    parameters.set(&key(args)?, value).await.map_err(failed)?;
    Ok(json!({}))
}

/// The place of the first null in a value, from its top: `/robot/arms/0`.
fn null_in(value: &Value, place: String) -> Option<String> {
    match value {
        Value::Null => Some(place),
        Value::Array(items) => items
            .iter()
            .enumerate()
            .find_map(|(at, item)| null_in(item, format!("{place}/{at}"))),
        Value::Object(members) => members
            .iter()
            .find_map(|(name, member)| null_in(member, format!("{place}/{name}"))),
        _ => None,
    }
}

pub(super) async fn has(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(failed)?;
    Ok(json!({ "exists": parameters.has(&key(args)?).await.map_err(failed)? }))
}

pub(super) async fn search(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(failed)?;
    let found = parameters.search("/", args.name.trim_start_matches('/'));
    let found = found.await.map_err(failed)?;
    Ok(json!({ "global_name": found.unwrap_or_default() }))
}

pub(super) async fn delete(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(failed)?;
    match parameters.delete(&key(args)?).await {
        Ok(()) | Err(BusError::NoParam(_)) => Ok(json!({})),
        Err(error) => Err(failed(error)),
    }
}

pub(super) async fn names(shared: &Arc<Shared>) -> Result<Value, String> {
    let parameters = shared.bus.parameters().map_err(failed)?;
    Ok(json!({ "names": parameters.names().await.map_err(failed)? }))
}
