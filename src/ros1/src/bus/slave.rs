//! The slave API (<http://wiki.ros.org/ROS/Slave_API>): calls of the Master and other nodes to this one.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use async_trait::async_trait;
use budget::Exceeded;
use ros_bus::ParamValue;

use super::Ros1BusState;
use crate::master::lending::LEND_SERVICE;
use crate::names;
use crate::reply::{ApiReply, Args};
use crate::xmlrpc::{Fault, Value, XmlRpcHandler};

pub(super) struct Slave {
    pub(super) bus: Arc<Ros1BusState>,
}

#[async_trait]
impl XmlRpcHandler for Slave {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        let mut args = Args::new(params);
        let answer = match method {
            "publisherUpdate" => self.publisher_update(&mut args),
            "requestTopic" => self.request_topic(&mut args),
            "paramUpdate" => self.param_update(&mut args),
            "getPid" => Ok(ApiReply::success("", pid())),
            "getMasterUri" => Ok(ApiReply::success("", self.bus.master.uri())),
            "getSubscriptions" => Ok(self.subscriptions()),
            "getPublications" => Ok(self.publications()),
            "getBusStats" => Ok(self.stats()),
            "getBusInfo" => Ok(self.info()),
            "shutdown" => self.shutdown(&mut args),
            LEND_SERVICE => self.lend_service(&mut args).await,
            _ => return Err(Fault::new(format!("method {method} is not known here"))),
        };
        Ok(answer.unwrap_or_else(|mistake| mistake).into_value())
    }
}

impl Slave {
    fn publisher_update(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        args.text("caller_id")?;
        let name = args.text("topic")?;
        let publishers = args.value("publishers")?.to_strings();
        let topic = self.bus.subscriptions.lock().get(&name).cloned();
        if let Some(topic) = topic {
            topic.update(&self.bus, &publishers);
        }
        Ok(ApiReply::success("", 0))
    }

    fn param_update(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        args.text("caller_id")?;
        let key = names::canonical(&args.text("key")?);
        // A deletion is announced as an empty dictionary.
        let value: Option<ParamValue> = match args.value("value")? {
            Value::Struct(members) if members.is_empty() => None,
            value => Some(value.into()),
        };
        match self.report_change(&key, value.as_ref()) {
            Ok(()) => Ok(ApiReply::success("", 0)),
            Err(error) => {
                // Reading the parameter returns the new value.
                tracing::warn!("a change of the parameter {key} was not reported: {error}");
                Ok(ApiReply::failure(error.to_string(), 0))
            }
        }
    }

    /// Reports a change to each watcher. One that has no room does not keep it from the others.
    fn report_change(&self, key: &str, value: Option<&ParamValue>) -> Result<(), Exceeded> {
        let mut watchers = self.bus.param_watchers.lock();
        watchers.retain(|watcher| !watcher.is_closed());
        let mut reported = Ok(());
        for watcher in watchers.iter() {
            reported = reported.and(watcher.send(key.to_owned(), value.cloned()));
        }
        reported
    }

    fn request_topic(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        args.text("caller_id")?;
        let name = args.text("topic")?;
        let protocols = args.value("protocols")?;
        let bus = &self.bus;
        let open = bus.publications.lock().get(&name).is_some_and(|t| t.is_open());
        if !open {
            let message = format!("{} does not publish {name}", bus.node);
            return Ok(ApiReply::failure(message, Value::Array(Vec::new())));
        }
        let tcpros = |protocol: &Value| {
            let name = protocol.as_array().and_then(<[Value]>::first);
            name.and_then(Value::as_str) == Some("TCPROS")
        };
        if !protocols.as_array().unwrap_or_default().iter().any(tcpros) {
            let message = "only TCPROS is spoken here";
            return Ok(ApiReply::failure(message, Value::Array(Vec::new())));
        }
        let place = vec!["TCPROS".into(), bus.host.as_str().into(), i32::from(bus.port).into()];
        let message = format!("ready on {}:{}", bus.host, bus.port);
        Ok(ApiReply::success(message, Value::Array(place)))
    }

    fn shutdown(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        args.text("caller_id")?;
        let reason = args.text("reason").unwrap_or_default();
        tracing::info!(node = self.bus.node, reason, "asked to shut down");
        self.bus.shutdown.send_replace(Some(reason));
        Ok(ApiReply::success("", 0))
    }

    async fn lend_service(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        args.text("caller_id")?;
        let service = args.text("service")?;
        let node = args.text("node")?;
        Ok(match self.bus.lend_service(&service, &node).await {
            Some(api) => ApiReply::success("", api),
            None => ApiReply::failure(format!("{service} is not lent"), ""),
        })
    }

    fn subscriptions(&self) -> ApiReply {
        let topics = self.bus.subscriptions.lock();
        let list = topics.values().map(|topic| {
            let type_name = topic.type_name();
            Value::strings([topic.name.clone(), type_name])
        });
        ApiReply::success("subscriptions", Value::Array(list.collect()))
    }

    fn publications(&self) -> ApiReply {
        let topics = self.bus.publications.lock();
        let list = topics.iter().filter_map(|(name, topic)| {
            let (advert, _) = topic.advert()?;
            Some(Value::strings([name.clone(), advert.name]))
        });
        ApiReply::success("publications", Value::Array(list.collect()))
    }

    fn stats(&self) -> ApiReply {
        let published = self.bus.publications.lock();
        let published = published.iter().map(|(name, topic)| {
            let connections = topic.subscribers().into_iter().map(|subscriber| {
                let bytes = number(subscriber.bytes.load(Ordering::Relaxed));
                let messages = number(subscriber.messages.load(Ordering::Relaxed));
                let fields = vec![subscriber.id.into(), bytes, messages, true.into()];
                Value::Array(fields)
            });
            let connections = Value::Array(connections.collect());
            Value::Array(vec![name.as_str().into(), 0.into(), connections])
        });
        let published = Value::Array(published.collect());
        let subscribed = self.bus.subscriptions.lock();
        let subscribed = subscribed.values().map(|topic| {
            let connections = topic.links().into_iter().map(|link| {
                let bytes = number(link.bytes.load(Ordering::Relaxed));
                let connected = link.connected.load(Ordering::Relaxed);
                let fields = vec![link.id.into(), bytes, (-1).into(), connected.into()];
                Value::Array(fields)
            });
            let connections = Value::Array(connections.collect());
            Value::Array(vec![topic.name.as_str().into(), connections])
        });
        let subscribed = Value::Array(subscribed.collect());
        let services = Value::Array(vec![0.into(), 0.into(), 0.into()]);
        ApiReply::success("stats", Value::Array(vec![published, subscribed, services]))
    }

    fn info(&self) -> ApiReply {
        let row = |id: i32, peer: &str, direction: &str, topic: &str, connected: bool| {
            Value::Array(vec![
                id.into(),
                peer.into(),
                direction.into(),
                "TCPROS".into(),
                topic.into(),
                connected.into(),
                format!("TCPROS connection of {topic} with {peer}").into(),
            ])
        };
        let mut rows = Vec::new();
        for (name, topic) in self.bus.publications.lock().iter() {
            for subscriber in topic.subscribers() {
                rows.push(row(subscriber.id, subscriber.peer.node(), "o", name, true));
            }
        }
        for topic in self.bus.subscriptions.lock().values() {
            for link in topic.links() {
                let connected = link.connected.load(Ordering::Relaxed);
                rows.push(row(link.id, link.uri(), "i", &topic.name, connected));
            }
        }
        ApiReply::success("bus info", Value::Array(rows))
    }
}

fn pid() -> i32 {
    i32::try_from(std::process::id()).unwrap_or(i32::MAX)
}

/// Converts a count to XML-RPC's 32 bits.
fn number(count: u64) -> Value {
    Value::Int(i32::try_from(count).unwrap_or(i32::MAX))
}
