//! Parameters of nodes, through the services that every ROS 2 node has
//! (<https://design.ros2.org/articles/ros_parameters.html>).

pub mod reading;
#[cfg(test)]
mod tests;
pub mod values;
pub mod yaml;

use std::slice;
use std::time::Duration;

use async_trait::async_trait;
use ros_bus::{
    Bus, BusError, CallFate, DoubleRange, FailureReason, IntegerRange, MatchedPeers, NodeParameters, ParamChange,
    ParamValue, ParameterDescription, ParameterEvent, ParameterEvents, ParameterKind, ParameterNames, QosProfile,
    Subscription, WireType,
};
use ros_message::codec::put::CdrWriter;
use tokio::time::timeout;

use self::reading::ParameterReader;
use self::values::{CoerceError, TypedValue};
use crate::{Ros2Bus, interfaces};

/// Time limit for a node to answer; it does so between other work.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time for nodes to match our subscription to their events.
const SETTLING: Duration = Duration::from_secs(1);
/// Topic on which nodes publish changes.
const EVENTS: &str = "/parameter_events";
/// Queue depth for a slow watcher; the same as in rmw.
const MOST_EVENTS: usize = 1000;

#[async_trait]
impl NodeParameters for Ros2Bus {
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError> {
        let values = self.query_each(&GET, node, names, values::read).await?;
        Ok(values.into_iter().map(Option::flatten).collect())
    }

    async fn set(&self, node: &str, changes: Vec<ParamChange>) -> Result<Vec<Result<(), FailureReason>>, BusError> {
        let typed = self.coerce_changes(node, changes).await?;
        let sent = typed.iter().filter_map(|change| change.as_ref().ok());
        let sent: Vec<_> = sent.collect();
        let mut answers = Vec::new();
        if !sent.is_empty() {
            let mut put = CdrWriter::new();
            put_changes(&sent, &mut put);
            let service = (node, "set_parameters");
            let read = |reading: &mut ParameterReader<'_>| reading.list(read_set);
            answers = self.call_service(service, "SetParameters", put, read).await?;
            if answers.len() != sent.len() {
                return Err(protocol_error(service, "it does not answer for each parameter"));
            }
        }
        let mut answers = answers.into_iter();
        let answer = |change: Result<(String, TypedValue), RefusedChange>| match change {
            Ok(_) => answers.next().unwrap_or(Ok(())),
            Err(refused) => Err(FailureReason::new(refused.reason.to_string())),
        };
        Ok(typed.into_iter().map(answer).collect())
    }

    async fn set_atomically(&self, node: &str, changes: Vec<ParamChange>) -> Result<(), BusError> {
        let mut sent = Vec::new();
        for change in self.coerce_changes(node, changes).await? {
            match change {
                Ok(change) => sent.push(change),
                Err(RefusedChange { key, reason }) => {
                    let reason = reason.to_string();
                    return Err(BusError::BadParam { key, reason });
                }
            }
        }
        let mut put = CdrWriter::new();
        put_changes(&sent.iter().collect::<Vec<_>>(), &mut put);
        let service = (node, "set_parameters_atomically");
        let set = self.call_service(service, "SetParametersAtomically", put, read_set);
        set.await?.map_err(|reason| BusError::CallFailed {
            service: format!("{}/{}", service.0, service.1),
            reason: reason.into_string(),
            fate: CallFate::Answered,
        })
    }

    async fn list(&self, node: &str, prefixes: &[String], depth: u64) -> Result<ParameterNames, BusError> {
        let mut put = CdrWriter::new();
        put_texts(prefixes, &mut put);
        put.number(depth.to_le_bytes());
        let read = |reading: &mut ParameterReader<'_>| {
            Some(ParameterNames { names: reading.texts()?, prefixes: reading.texts()? })
        };
        let service = (node, "list_parameters");
        self.call_service(service, "ListParameters", put, read).await
    }

    async fn describe(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParameterDescription>>, BusError> {
        self.query_each(&DESCRIBE, node, names, read_description).await
    }

    async fn watch(&self, node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError> {
        let of = interfaces::message("rcl_interfaces/msg/ParameterEvent")?;
        let (of, qos) = (WireType::from_message(&of), QosProfile::keep_last(MOST_EVENTS));
        let subscription = self.subscribe(EVENTS, of, qos).await?;
        self.wait_for_publishers(&subscription, node).await?;
        let node = node.map(str::to_owned);
        Ok(Box::new(ParameterEventStream { subscription, node }))
    }
}

/// A service that queries something of each of several parameters: its name below the node's, and the name of its type.
struct ParameterQuery {
    service: &'static str,
    type_name: &'static str,
}

const GET: ParameterQuery = ParameterQuery { service: "get_parameters", type_name: "GetParameters" };
const TYPES: ParameterQuery = ParameterQuery { service: "get_parameter_types", type_name: "GetParameterTypes" };
const DESCRIBE: ParameterQuery = ParameterQuery { service: "describe_parameters", type_name: "DescribeParameters" };

/// A change that is not sent.
struct RefusedChange {
    key: String,
    reason: CoerceError,
}

impl Ros2Bus {
    /// Queries something of each of these parameters. If a node lacks one of them it returns nothing at all (as rclpy
    /// and rclcpp do); then each is queried individually.
    async fn query_each<T: Send>(
        &self,
        by_name: &ParameterQuery,
        node: &str,
        names: &[String],
        read: fn(&mut ParameterReader<'_>) -> Option<T>,
    ) -> Result<Vec<Option<T>>, BusError> {
        let together = self.query_all(by_name, node, names, read).await?;
        if together.len() == names.len() {
            return Ok(together.into_iter().map(Some).collect());
        }
        if names.len() == 1 {
            return Ok(vec![None]);
        }
        let mut found = Vec::with_capacity(names.len());
        for name in names {
            let alone = self.query_all(by_name, node, slice::from_ref(name), read);
            found.push(alone.await?.into_iter().next());
        }
        Ok(found)
    }

    async fn query_all<T: Send>(
        &self,
        by_name: &ParameterQuery,
        node: &str,
        names: &[String],
        read: fn(&mut ParameterReader<'_>) -> Option<T>,
    ) -> Result<Vec<T>, BusError> {
        let mut put = CdrWriter::new();
        put_texts(names, &mut put);
        let service = (node, by_name.service);
        let read = |reading: &mut ParameterReader<'_>| reading.list(read);
        self.call_service(service, by_name.type_name, put, read).await
    }

    /// Waits until the events of this node, or of all existing nodes, are received.
    async fn wait_for_publishers(&self, events: &Subscription, node: Option<&str>) -> Result<(), BusError> {
        let mut matched = events.matched.clone();
        if let Some(node) = node {
            let heard = matched.wait_for(|matched| matched.has_node(node));
            let heard = timeout(PATIENCE, heard).await.map(drop);
            return heard
                .map_err(|_| BusError::Timeout { what: format!("topic {EVENTS} of node {node}"), after: PATIENCE });
        }
        let graph = self.graph().borrow().clone();
        let nodes = graph.topics.get(EVENTS).map(|ends| &ends.publishers);
        let all = |matched: &MatchedPeers| {
            let mut nodes = nodes.into_iter().flatten();
            nodes.all(|node| matched.has_node(node))
        };
        // A node that does not confirm the match must not block the others.
        drop(timeout(SETTLING, matched.wait_for(all)).await);
        Ok(())
    }

    /// Converts the values to the types of the node's parameters.
    async fn coerce_changes(
        &self,
        node: &str,
        changes: Vec<ParamChange>,
    ) -> Result<Vec<Result<(String, TypedValue), RefusedChange>>, BusError> {
        let depends = |(_, value): &&ParamChange| value.as_ref().is_some_and(values::depends_on_kind);
        let names = changes.iter().filter(depends).map(|(key, _)| key.clone());
        let names: Vec<String> = names.collect();
        let mut kinds = Vec::new();
        if !names.is_empty() {
            let read = |reading: &mut ParameterReader<'_>| reading.byte().map(values::kind_from_number);
            kinds = self.query_each(&TYPES, node, &names, read).await?;
        }
        let mut kinds = kinds.into_iter();
        let typed = changes.into_iter().map(|(key, value)| {
            let value = value.unwrap_or(ParamValue::Nil);
            let kind = if values::depends_on_kind(&value) {
                kinds.next().flatten().unwrap_or_default()
            } else {
                ParameterKind::NotSet
            };
            match values::coerce(value, kind) {
                Ok(value) => Ok((key, value)),
                Err(reason) => Err(RefusedChange { key, reason }),
            }
        });
        Ok(typed.collect())
    }

    /// Calls a service of a node, given by its name below the node's and the name of its type in `rcl_interfaces`.
    async fn call_service<T>(
        &self,
        service: (&str, &str),
        type_name: &str,
        request: CdrWriter,
        read: impl FnOnce(&mut ParameterReader<'_>) -> Option<T>,
    ) -> Result<T, BusError> {
        let of = interfaces::service(&format!("rcl_interfaces/srv/{type_name}"))?;
        let name = format!("{}/{}", service.0, service.1);
        let answer = self.call_typed(&name, &of.digest, request.finish(), PATIENCE);
        let answer = answer.await?;
        let read = ParameterReader::new(&answer).and_then(|mut reading| read(&mut reading));
        read.ok_or_else(|| protocol_error(service, "its answer is truncated or too long"))
    }
}

fn protocol_error((node, part): (&str, &str), reason: &str) -> BusError {
    BusError::Protocol { what: format!("service {node}/{part}"), reason: reason.to_owned() }
}

fn put_texts(texts: &[String], put: &mut CdrWriter) {
    put.length(texts.len());
    texts.iter().for_each(|text| put.text(text));
}

fn put_changes(changes: &[&(String, TypedValue)], put: &mut CdrWriter) {
    put.length(changes.len());
    for (key, value) in changes {
        put.text(key);
        values::write(value, put);
    }
}

/// Reads whether a parameter was set, or the reason why not.
fn read_set(reading: &mut ParameterReader<'_>) -> Option<Result<(), FailureReason>> {
    let (done, reason) = (reading.bool()?, reading.text()?);
    Some(if done {
        Ok(())
    } else if reason.is_empty() {
        Err(FailureReason::new("the node does not say why"))
    } else {
        Err(FailureReason::new(reason))
    })
}

fn read_description(reading: &mut ParameterReader<'_>) -> Option<ParameterDescription> {
    Some(ParameterDescription {
        name: reading.text()?,
        kind: values::kind_from_number(reading.byte()?),
        description: reading.text()?,
        constraints: reading.text()?,
        read_only: reading.bool()?,
        dynamic_typing: reading.bool()?,
        double_range: reading.list(read_double_range)?.pop(),
        integer_range: reading.list(read_integer_range)?.pop(),
    })
}

fn read_double_range(reading: &mut ParameterReader<'_>) -> Option<DoubleRange> {
    Some(DoubleRange { from: reading.double()?, to: reading.double()?, step: reading.double()? })
}

fn read_integer_range(reading: &mut ParameterReader<'_>) -> Option<IntegerRange> {
    Some(IntegerRange { from: reading.integer()?, to: reading.integer()?, step: reading.unsigned_integer()? })
}

/// Parameter events received on the topic that all nodes share.
struct ParameterEventStream {
    subscription: Subscription,
    node: Option<String>,
}

#[async_trait]
impl ParameterEvents for ParameterEventStream {
    async fn next(&mut self) -> Option<ParameterEvent> {
        loop {
            let message = self.subscription.messages.recv().await?;
            let read = ParameterReader::new(&message.bytes)
                .and_then(|mut reading| read_event(&mut reading, self.node.as_deref()));
            match read {
                Some(Some(event)) => return Some(event),
                Some(None) => {}
                None => {
                    let publisher = message.publisher.node();
                    tracing::debug!(publisher, "a parameter event is truncated or too long");
                }
            }
        }
    }

    fn dropped_count(&self) -> u64 {
        self.subscription.dropped.get()
    }
}

/// Reads an event; the inner `None` means that it is of another node.
fn read_event(reading: &mut ParameterReader<'_>, of: Option<&str>) -> Option<Option<ParameterEvent>> {
    reading.skip_time()?;
    let node = reading.text()?;
    if of.is_some_and(|of| of != node) {
        return Some(None);
    }
    let mut changes = || {
        let all = reading.list(|reading| Some((reading.text()?, values::read(reading)?)));
        Some(all?.into_iter())
    };
    let (new, changed, deleted) = (changes()?, changes()?, changes()?);
    let with_value = |(name, value): (String, Option<ParamValue>)| Some((name, value?));
    Some(Some(ParameterEvent {
        node,
        new: new.filter_map(with_value).collect(),
        changed: changed.filter_map(with_value).collect(),
        deleted: deleted.map(|(name, _)| name).collect(),
    }))
}
