//! Parameters of nodes, by the services that every node of ROS 2 has
//! (<https://design.ros2.org/articles/ros_parameters.html>).

mod reading;
#[cfg(test)]
mod tests;
mod values;

use std::slice;
use std::time::Duration;

use async_trait::async_trait;
use tokio::time::timeout;

use self::reading::Reading;
use self::values::Typed;
use crate::bus::{
    Bus, BusError, CallFate, DoubleRange, IntegerRange, Matched, NodeParameters, ParamChange,
    ParamValue, ParameterDescription, ParameterEvent, ParameterEvents, ParameterKind,
    ParameterNames, Qos, Subscription, WireType,
};
use crate::codec::put::Put;
use crate::ros2::{Ros2Bus, interfaces};

/// For a node to answer, which does so between other things.
const PATIENCE: Duration = Duration::from_secs(10);
/// For nodes to know that their events are heard.
const SETTLING: Duration = Duration::from_secs(1);
/// By which nodes tell of changes.
const EVENTS: &str = "/parameter_events";
/// Events that are kept for a slow watcher; rmw keeps as many.
const MOST_EVENTS: usize = 1000;

#[async_trait]
impl NodeParameters for Ros2Bus {
    async fn get(&self, node: &str, names: &[String]) -> Result<Vec<Option<ParamValue>>, BusError> {
        let values = self.of_each(&GET, node, names, values::read).await?;
        Ok(values.into_iter().map(Option::flatten).collect())
    }

    async fn set(
        &self,
        node: &str,
        changes: Vec<ParamChange>,
    ) -> Result<Vec<Result<(), String>>, BusError> {
        let typed = self.typed(node, changes).await?;
        let sent = typed.iter().filter_map(|change| change.as_ref().ok());
        let sent: Vec<_> = sent.collect();
        let mut answers = Vec::new();
        if !sent.is_empty() {
            let mut put = Put::new();
            put_changes(&sent, &mut put);
            let service = (node, "set_parameters");
            let read = |reading: &mut Reading<'_>| reading.list(read_set);
            answers = self.ask(service, "SetParameters", put, read).await?;
            if answers.len() != sent.len() {
                return Err(broken(service, "it does not answer for each parameter"));
            }
        }
        let mut answers = answers.into_iter();
        let answer = |change: Result<(String, Typed), Refused>| match change {
            Ok(_) => answers.next().unwrap_or(Ok(())),
            Err(refused) => Err(refused.reason),
        };
        Ok(typed.into_iter().map(answer).collect())
    }

    async fn set_together(&self, node: &str, changes: Vec<ParamChange>) -> Result<(), BusError> {
        let mut sent = Vec::new();
        for change in self.typed(node, changes).await? {
            match change {
                Ok(change) => sent.push(change),
                Err(Refused { key, reason }) => return Err(BusError::BadParam { key, reason }),
            }
        }
        let mut put = Put::new();
        put_changes(&sent.iter().collect::<Vec<_>>(), &mut put);
        let service = (node, "set_parameters_atomically");
        let set = self.ask(service, "SetParametersAtomically", put, read_set);
        set.await?.map_err(|reason| BusError::CallFailed {
            service: format!("{}/{}", service.0, service.1),
            reason,
            fate: CallFate::Answered,
        })
    }

    async fn list(
        &self,
        node: &str,
        prefixes: &[String],
        depth: u64,
    ) -> Result<ParameterNames, BusError> {
        let mut put = Put::new();
        put_texts(prefixes, &mut put);
        put.number(depth.to_le_bytes());
        let read = |reading: &mut Reading<'_>| {
            Some(ParameterNames {
                names: reading.texts()?,
                prefixes: reading.texts()?,
            })
        };
        let service = (node, "list_parameters");
        self.ask(service, "ListParameters", put, read).await
    }

    async fn describe(
        &self,
        node: &str,
        names: &[String],
    ) -> Result<Vec<Option<ParameterDescription>>, BusError> {
        self.of_each(&DESCRIBE, node, names, read_description).await
    }

    async fn watch(&self, node: Option<&str>) -> Result<Box<dyn ParameterEvents>, BusError> {
        let of = interfaces::message("rcl_interfaces/msg/ParameterEvent")?;
        let (of, qos) = (WireType::of(&of), Qos::keep_last(MOST_EVENTS));
        let subscription = self.subscribe(EVENTS, of, qos).await?;
        self.heard(&subscription, node).await?;
        let node = node.map(str::to_owned);
        Ok(Box::new(Events { subscription, node }))
    }
}

/// A service that is asked for something of each of some parameters: its name below the node's, and its type's.
struct ByName {
    service: &'static str,
    type_name: &'static str,
}

const GET: ByName = ByName {
    service: "get_parameters",
    type_name: "GetParameters",
};
const TYPES: ByName = ByName {
    service: "get_parameter_types",
    type_name: "GetParameterTypes",
};
const DESCRIBE: ByName = ByName {
    service: "describe_parameters",
    type_name: "DescribeParameters",
};

/// A change that is not sent.
struct Refused {
    key: String,
    reason: String,
}

impl Ros2Bus {
    /// Asks for something of each of these parameters. A node that lacks one of them answers nothing at all (as rclpy and
    /// rclcpp do); then each is asked for alone.
    async fn of_each<T: Send>(
        &self,
        by_name: &ByName,
        node: &str,
        names: &[String],
        read: fn(&mut Reading<'_>) -> Option<T>,
    ) -> Result<Vec<Option<T>>, BusError> {
        let together = self.of_all(by_name, node, names, read).await?;
        if together.len() == names.len() {
            return Ok(together.into_iter().map(Some).collect());
        }
        if names.len() == 1 {
            return Ok(vec![None]);
        }
        let mut found = Vec::with_capacity(names.len());
        for name in names {
            let alone = self.of_all(by_name, node, slice::from_ref(name), read);
            found.push(alone.await?.into_iter().next());
        }
        Ok(found)
    }

    async fn of_all<T: Send>(
        &self,
        by_name: &ByName,
        node: &str,
        names: &[String],
        read: fn(&mut Reading<'_>) -> Option<T>,
    ) -> Result<Vec<T>, BusError> {
        let mut put = Put::new();
        put_texts(names, &mut put);
        let service = (node, by_name.service);
        let read = |reading: &mut Reading<'_>| reading.list(read);
        self.ask(service, by_name.type_name, put, read).await
    }

    /// Returns once this node's events are heard, or those of all that there are.
    async fn heard(&self, events: &Subscription, node: Option<&str>) -> Result<(), BusError> {
        let mut matched = events.matched.clone();
        if let Some(node) = node {
            let heard = matched.wait_for(|matched| matched.has_node(node));
            let heard = timeout(PATIENCE, heard).await.map(drop);
            return heard.map_err(|_| BusError::Timeout {
                what: format!("topic {EVENTS} of node {node}"),
                after: PATIENCE,
            });
        }
        let graph = self.graph().borrow().clone();
        let nodes = graph.topics.get(EVENTS).map(|ends| &ends.publishers);
        let all = |matched: &Matched| {
            let mut nodes = nodes.into_iter().flatten();
            nodes.all(|node| matched.has_node(node))
        };
        // One that does not say so does not keep the others from being heard.
        drop(timeout(SETTLING, matched.wait_for(all)).await);
        Ok(())
    }

    /// The changes with values of the kinds that the node's parameters have.
    async fn typed(
        &self,
        node: &str,
        changes: Vec<ParamChange>,
    ) -> Result<Vec<Result<(String, Typed), Refused>>, BusError> {
        let depends =
            |(_, value): &&ParamChange| value.as_ref().is_some_and(values::depends_on_kind);
        let names = changes.iter().filter(depends).map(|(key, _)| key.clone());
        let names: Vec<String> = names.collect();
        let mut kinds = Vec::new();
        if !names.is_empty() {
            let read = |reading: &mut Reading<'_>| reading.byte().map(ParameterKind::of);
            kinds = self.of_each(&TYPES, node, &names, read).await?;
        }
        let mut kinds = kinds.into_iter();
        let typed = changes.into_iter().map(|(key, value)| {
            let value = value.unwrap_or(ParamValue::Nil);
            let kind = match values::depends_on_kind(&value) {
                true => kinds.next().flatten().unwrap_or_default(),
                false => ParameterKind::NotSet,
            };
            match values::typed(value, kind) {
                Ok(value) => Ok((key, value)),
                Err(reason) => Err(Refused { key, reason }),
            }
        });
        Ok(typed.collect())
    }

    /// Calls a service of a node: its name below the node's, and that of its type in `rcl_interfaces`.
    async fn ask<T>(
        &self,
        service: (&str, &str),
        type_name: &str,
        request: Put,
        read: impl FnOnce(&mut Reading<'_>) -> Option<T>,
    ) -> Result<T, BusError> {
        let of = interfaces::service(&format!("rcl_interfaces/srv/{type_name}"))?;
        let name = format!("{}/{}", service.0, service.1);
        let answer = self.call_typed(&name, &of.digest, request.end(), PATIENCE);
        let answer = answer.await?;
        let read = Reading::of(&answer).and_then(|mut reading| read(&mut reading));
        read.ok_or_else(|| broken(service, "its answer is torn or too long"))
    }
}

fn broken((node, part): (&str, &str), reason: &str) -> BusError {
    BusError::Protocol {
        what: format!("service {node}/{part}"),
        reason: reason.to_owned(),
    }
}

fn put_texts(texts: &[String], put: &mut Put) {
    put.length(texts.len());
    texts.iter().for_each(|text| put.text(text));
}

fn put_changes(changes: &[&(String, Typed)], put: &mut Put) {
    put.length(changes.len());
    for (key, value) in changes {
        put.text(key);
        values::write(value, put);
    }
}

/// Whether a parameter was set, or why not.
fn read_set(reading: &mut Reading<'_>) -> Option<Result<(), String>> {
    let (done, reason) = (reading.bool()?, reading.text()?);
    Some(if done {
        Ok(())
    } else if reason.is_empty() {
        Err("the node does not say why".to_owned())
    } else {
        Err(reason)
    })
}

fn read_description(reading: &mut Reading<'_>) -> Option<ParameterDescription> {
    Some(ParameterDescription {
        name: reading.text()?,
        kind: ParameterKind::of(reading.byte()?),
        description: reading.text()?,
        constraints: reading.text()?,
        read_only: reading.bool()?,
        dynamic_typing: reading.bool()?,
        double_range: reading.list(read_double_range)?.pop(),
        integer_range: reading.list(read_integer_range)?.pop(),
    })
}

fn read_double_range(reading: &mut Reading<'_>) -> Option<DoubleRange> {
    Some(DoubleRange {
        from: reading.double()?,
        to: reading.double()?,
        step: reading.double()?,
    })
}

fn read_integer_range(reading: &mut Reading<'_>) -> Option<IntegerRange> {
    Some(IntegerRange {
        from: reading.integer()?,
        to: reading.integer()?,
        step: reading.unsigned()?,
    })
}

/// Changes as they come by the topic that all nodes share.
struct Events {
    subscription: Subscription,
    node: Option<String>,
}

#[async_trait]
impl ParameterEvents for Events {
    async fn next(&mut self) -> Option<ParameterEvent> {
        loop {
            let message = self.subscription.messages.recv().await?;
            let read = Reading::of(&message.bytes)
                .and_then(|mut reading| read_event(&mut reading, self.node.as_deref()));
            match read {
                Some(Some(event)) => return Some(event),
                Some(None) => {}
                None => {
                    let publisher = message.publisher.node();
                    tracing::debug!(publisher, "an event of parameters is torn or too long");
                }
            }
        }
    }

    fn dropped(&self) -> u64 {
        self.subscription.dropped.get()
    }
}

/// An event, if it is one of this node.
fn read_event(reading: &mut Reading<'_>, of: Option<&str>) -> Option<Option<ParameterEvent>> {
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
