//! Parameters of nodes, as ROS 2 has them: their names are `node:parameter`. Values travel as JSON text, since a service's
//! fields have fixed types.

use std::sync::Arc;

use budget::Budget;
use futures_util::StreamExt;
use futures_util::stream;
use ros::bus::{BusError, NodeParameters, ParamValue};
use serde_json::{Value, json};

use super::Args;
use super::params::{Given, default, failed, written};
use crate::names::resolve;
use crate::shared::Shared;

/// Nodes asked for their parameters at once.
const ASKED_AT_ONCE: usize = 16;

/// A parameter of a node.
struct Named {
    node: String,
    parameter: String,
}

/// The parameter that is meant.
fn named(shared: &Shared, args: &Args) -> Result<Named, String> {
    const EXPECTED: &str = "a node and its parameter such as \"/camera:exposure\" is expected";
    match args.name.split_once(':') {
        Some((node, parameter)) if !parameter.is_empty() => Ok(Named {
            node: resolve(shared.bus.version(), node)?.into_owned(),
            parameter: parameter.to_owned(),
        }),
        _ if args.name.is_empty() => Err(format!("field \"name\" is missing, {EXPECTED}")),
        _ => {
            let shown: String = args.name.chars().take(64).collect();
            Err(format!("field \"name\" is {shown:?}, {EXPECTED}"))
        }
    }
}

/// The parameters of nodes.
fn of_nodes(shared: &Shared) -> Result<&dyn NodeParameters, String> {
    shared.bus.node_parameters().map_err(failed)
}

/// Whether the node that was asked is not there: it has no such parameter either.
fn is_absence(error: &BusError) -> bool {
    matches!(error, BusError::NoService(_) | BusError::NoParam(_))
}

/// The value of a parameter; nothing where the node, or the parameter, is not there.
async fn value_of(shared: &Shared, of: &Named) -> Result<Option<ParamValue>, String> {
    let parameters = of_nodes(shared)?;
    let names = [of.parameter.clone()];
    match parameters.get(&of.node, &names).await {
        Ok(values) => Ok(values.into_iter().next().flatten()),
        Err(error) if is_absence(&error) => Ok(None),
        Err(error) => Err(failed(error)),
    }
}

/// Why a parameter has no value.
fn absent(shared: &Shared, Named { node, parameter }: &Named) -> String {
    let graph = shared.bus.graph().borrow().clone();
    match graph.nodes.contains_key(node) {
        true => format!("node {node} has no parameter {parameter}"),
        false => format!("there is no node {node}; /rosapi/nodes lists those that are"),
    }
}

pub(super) async fn get(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let of = named(shared, args)?;
    let value = match value_of(shared, &of).await? {
        Some(value) => Some(written(&value)?),
        None => default(args)?,
    };
    // Whether it is there is said by later versions of rosapi; clients of earlier ones read a null.
    Ok(match value {
        Some(value) => json!({ "value": value, "successful": true, "reason": "" }),
        None => json!({ "value": "null", "successful": false, "reason": absent(shared, &of) }),
    })
}

/// Changes a parameter; without a value it is removed.
async fn change(shared: &Shared, of: Named, value: Option<ParamValue>) -> Result<Value, String> {
    let parameters = of_nodes(shared)?;
    let Named { node, parameter } = of;
    let changes = vec![(parameter.clone(), value)];
    let done = parameters.set(&node, changes).await.map_err(failed)?;
    match done.into_iter().next() {
        Some(Ok(())) => Ok(json!({ "successful": true, "reason": "" })),
        Some(Err(reason)) => Err(format!("node {node} refuses {parameter}: {reason}")),
        None => Err(format!("node {node} did not answer for {parameter}")),
    }
}

pub(super) async fn set(
    shared: &Arc<Shared>,
    args: &Args,
    budget: &Budget,
) -> Result<Value, String> {
    let of = named(shared, args)?;
    let given = Given::read(args, budget)?;
    change(shared, of, Some(given.value)).await
}

pub(super) async fn has(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let of = named(shared, args)?;
    Ok(json!({ "exists": value_of(shared, &of).await?.is_some() }))
}

pub(super) async fn delete(shared: &Arc<Shared>, args: &Args) -> Result<Value, String> {
    let of = named(shared, args)?;
    match value_of(shared, &of).await? {
        Some(_) => change(shared, of, None).await,
        // As rosapi has it: it is not there afterwards.
        None => Ok(json!({ "successful": true, "reason": "" })),
    }
}

/// Those of all nodes that can be asked for them; who does not answer is left out.
pub(super) async fn names(shared: &Arc<Shared>) -> Result<Value, String> {
    of_nodes(shared)?;
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
            Some(
                names
                    .map(|name| format!("{node}:{name}"))
                    .collect::<Vec<_>>(),
            )
        }
    });
    let asked: Vec<_> = asked.collect();
    let told: Vec<Option<Vec<String>>> =
        stream::iter(asked).buffered(ASKED_AT_ONCE).collect().await;
    let names: Vec<String> = told.into_iter().flatten().flatten().collect();
    Ok(json!({ "names": names }))
}
