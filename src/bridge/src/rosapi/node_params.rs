//! Parameters of nodes, as in ROS 2: their names are `node:parameter`. Values are passed as JSON text, since the fields
//! of a service have fixed types.

use std::sync::Arc;

use budget::Budget;
use futures_util::StreamExt;
use futures_util::stream;
use ros::bus::{BusError, ParamValue};
use serde_json::{Value, json};

use super::Args;
use super::param_error::ParamRequestError;
use super::params::{GivenValue, parse_default, to_json_text};
use crate::names::resolve;
use crate::shared::BridgeShared;

/// Number of nodes queried for their parameters concurrently.
const ASKED_AT_ONCE: usize = 16;

/// A parameter of a node.
struct NodeParam {
    node: String,
    parameter: String,
}

/// Parses the name of the requested parameter.
fn parse_name(shared: &BridgeShared, args: &Args) -> Result<NodeParam, ParamRequestError> {
    match args.name.split_once(':') {
        Some((node, parameter)) if !parameter.is_empty() => {
            Ok(NodeParam { node: resolve(shared.bus.version(), node)?.into_owned(), parameter: parameter.to_owned() })
        }
        _ if args.name.is_empty() => Err(ParamRequestError::NoNodeName),
        _ => {
            let shown = args.name.chars().take(64).collect();
            Err(ParamRequestError::NotOfNode(shown))
        }
    }
}

/// Returns whether the queried node does not exist; then it has no such parameter either.
fn is_absence(error: &BusError) -> bool {
    matches!(error, BusError::NoService(_) | BusError::NoParam(_))
}

/// Reads a parameter; `None` if the node or the parameter does not exist.
async fn read_value(shared: &BridgeShared, of: &NodeParam) -> Result<Option<ParamValue>, BusError> {
    let parameters = shared.bus.node_parameters()?;
    let names = [of.parameter.clone()];
    match parameters.get(&of.node, &names).await {
        Ok(values) => Ok(values.into_iter().next().flatten()),
        Err(error) if is_absence(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Explains why a parameter has no value.
fn absence_reason(shared: &BridgeShared, NodeParam { node, parameter }: &NodeParam) -> String {
    let graph = shared.bus.graph().borrow().clone();
    if graph.nodes.contains_key(node) {
        format!("node {node} has no parameter {parameter}")
    } else {
        format!("there is no node {node}; /rosapi/nodes lists the existing ones")
    }
}

pub(super) async fn get(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let of = parse_name(shared, args)?;
    let value = match read_value(shared, &of).await? {
        Some(value) => Some(to_json_text(&value)?),
        None => parse_default(args)?,
    };
    // Later versions of rosapi return whether it exists; clients of earlier ones read a null.
    Ok(match value {
        Some(value) => json!({ "value": value, "successful": true, "reason": "" }),
        None => {
            json!({ "value": "null", "successful": false, "reason": absence_reason(shared, &of) })
        }
    })
}

/// Changes a parameter, or removes it if `value` is `None`.
async fn change(shared: &BridgeShared, of: NodeParam, value: Option<ParamValue>) -> Result<Value, ParamRequestError> {
    let parameters = shared.bus.node_parameters()?;
    let NodeParam { node, parameter } = of;
    let changes = vec![(parameter.clone(), value)];
    let done = parameters.set(&node, changes).await?;
    match done.into_iter().next() {
        Some(Ok(())) => Ok(json!({ "successful": true, "reason": "" })),
        Some(Err(reason)) => Err(ParamRequestError::Refused { node, parameter, reason }),
        None => Err(ParamRequestError::Unanswered { node, parameter }),
    }
}

pub(super) async fn set(shared: &Arc<BridgeShared>, args: &Args, budget: &Budget) -> Result<Value, ParamRequestError> {
    let of = parse_name(shared, args)?;
    let given = GivenValue::read(args, budget)?;
    change(shared, of, Some(given.value)).await
}

pub(super) async fn has(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let of = parse_name(shared, args)?;
    Ok(json!({ "exists": read_value(shared, &of).await?.is_some() }))
}

pub(super) async fn delete(shared: &Arc<BridgeShared>, args: &Args) -> Result<Value, ParamRequestError> {
    let of = parse_name(shared, args)?;
    match read_value(shared, &of).await? {
        Some(_) => change(shared, of, None).await,
        // As in rosapi: the parameter does not exist afterwards.
        None => Ok(json!({ "successful": true, "reason": "" })),
    }
}

/// Returns the parameters of all nodes that offer them; nodes that do not answer are left out.
pub(super) async fn names(shared: &Arc<BridgeShared>) -> Result<Value, ParamRequestError> {
    // Fails here where no node has parameters of its own.
    shared.bus.node_parameters()?;
    let graph = shared.bus.graph().borrow().clone();
    let own = shared.bus.node();
    let nodes = graph.nodes.keys().filter(|node| *node != own);
    let asked = nodes.filter(|node| {
        let service = format!("{node}/list_parameters");
        graph.services.contains_key(&service)
    });
    let asked = asked.cloned().map(|node| {
        let shared = shared.clone();
        async move {
            let parameters = shared.bus.node_parameters().ok()?;
            let listed = parameters.list(&node, &[], 0).await.ok()?;
            let names = listed.names.into_iter();
            Some(names.map(|name| format!("{node}:{name}")).collect::<Vec<_>>())
        }
    });
    let asked: Vec<_> = asked.collect();
    let told: Vec<Option<Vec<String>>> = stream::iter(asked).buffered(ASKED_AT_ONCE).collect().await;
    let names: Vec<String> = told.into_iter().flatten().flatten().collect();
    Ok(json!({ "names": names }))
}
