//! The Master's methods, as rosmaster answers them.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;

use super::graph::{self, WAIT_GRAPH, wire_generation};
use super::notify::Notice;
use super::registry::{Kind, Refused};
use super::{Inner, params};
use crate::ros1::names;
use crate::ros1::reply::{Args, Reply};
use crate::ros1::xmlrpc::{Fault, Handler, Value, fault_value};

/// Calls in one `system.multicall`, at most.
const MAX_MULTICALL: usize = 10_000;
/// A long poll lasts no longer.
const MAX_WAIT: Duration = Duration::from_secs(300);

const METHODS: &[&str] = &[
    WAIT_GRAPH,
    "deleteParam",
    "getParam",
    "getParamNames",
    "getPid",
    "getPublishedTopics",
    "getSystemState",
    "getTopicTypes",
    "getUri",
    "hasParam",
    "lookupNode",
    "lookupService",
    "registerPublisher",
    "registerService",
    "registerSubscriber",
    "searchParam",
    "setParam",
    "shutdown",
    "subscribeParam",
    "system.listMethods",
    "system.multicall",
    "unregisterPublisher",
    "unregisterService",
    "unregisterSubscriber",
    "unsubscribeParam",
];

pub(super) struct Api {
    pub(super) master: Arc<Inner>,
}

#[async_trait]
impl Handler for Api {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        match method {
            WAIT_GRAPH => {
                let answer = self.wait_graph(Args::new(params)).await;
                Ok(answer.unwrap_or_else(|mistake| mistake).into_value())
            }
            "system.listMethods" => Ok(Value::strings(METHODS.iter().copied())),
            "system.multicall" => self.multicall(params),
            _ => self.simple(method, params),
        }
    }
}

impl Api {
    /// All that is answered at once.
    fn simple(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        let mut args = Args::new(params);
        let answer = match self.registration(method, &mut args) {
            Some(answer) => answer,
            None => match self.lookup(method, &mut args) {
                Some(answer) => answer,
                None => self
                    .parameter(method, &mut args)
                    .ok_or_else(|| Fault::new(format!("method {method} is not known here")))?,
            },
        };
        Ok(answer.unwrap_or_else(|mistake| mistake).into_value())
    }

    fn multicall(&self, params: Vec<Value>) -> Result<Value, Fault> {
        let Some(Value::Array(calls)) = params.into_iter().next() else {
            return Err(Fault::new("system.multicall takes an array of calls"));
        };
        if calls.len() > MAX_MULTICALL {
            return Err(Fault::new(format!(
                "more than {MAX_MULTICALL} calls in one"
            )));
        }
        let answers = calls.into_iter().map(|call| {
            let answer = match call {
                Value::Struct(mut members) => {
                    match (members.remove("methodName"), members.remove("params")) {
                        (Some(Value::String(method)), Some(Value::Array(params))) => {
                            self.simple(&method, params)
                        }
                        _ => Err(Fault::new("a call needs methodName and params")),
                    }
                }
                _ => Err(Fault::new("a call is a struct of methodName and params")),
            };
            match answer {
                Ok(value) => Value::Array(vec![value]),
                Err(fault) => fault_value(&fault),
            }
        });
        Ok(Value::Array(answers.collect()))
    }

    async fn wait_graph(&self, mut args: Args) -> Result<Reply, Reply> {
        args.text("caller_id")?;
        let known = args.any("known_generation")?.as_int().unwrap_or(-1);
        let seconds = match args.any("timeout_s")? {
            Value::Int(seconds) => f64::from(seconds),
            Value::Double(seconds) => seconds,
            _ => 0.0,
        };
        let time = Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or(MAX_WAIT);
        let mut generation = self.master.generation.subscribe();
        let news = generation.wait_for(|now| wire_generation(*now) != known);
        // Whether or not there is news: the answer always holds the whole state.
        let _ = tokio::time::timeout(time.min(MAX_WAIT), news).await;
        let graph = self.master.graph();
        Ok(Reply::done(
            "",
            graph::to_value(&graph, &self.master.run_id),
        ))
    }

    fn registration(&self, method: &str, args: &mut Args) -> Option<Result<Reply, Reply>> {
        Some(match method {
            "registerPublisher" => self.register_topic(Kind::Publisher, args),
            "registerSubscriber" => self.register_topic(Kind::Subscriber, args),
            "registerService" => self.register_service(args),
            "unregisterPublisher" => self.unregister(Kind::Publisher, args),
            "unregisterSubscriber" => self.unregister(Kind::Subscriber, args),
            "unregisterService" => self.unregister(Kind::Service, args),
            _ => return None,
        })
    }

    fn register_topic(&self, kind: Kind, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let topic = name(args, "topic", &node)?;
        let type_name = args.text("topic_type")?;
        let api = args.uri("caller_api", "http")?;
        args.end()?;
        let others = self.master.change(|state, notices| {
            let registry = &mut state.registry;
            registry.register(kind, &topic, &type_name, (&node, &api), "", notices)?;
            Ok(match kind {
                Kind::Publisher => registry.subscriber_apis(&topic),
                _ => registry.publisher_apis(&topic),
            })
        });
        let message = match kind {
            Kind::Publisher => format!("Registered [{node}] as publisher of [{topic}]"),
            _ => format!("Subscribed to [{topic}]"),
        };
        Ok(Reply::done(
            message,
            Value::strings(others.map_err(refusal)?),
        ))
    }

    fn register_service(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let service = name(args, "service", &node)?;
        let service_api = args.uri("service_api", "rosrpc")?;
        let api = args.uri("caller_api", "http")?;
        args.end()?;
        let registered = self.master.change(|state, notices| {
            let by = (node.as_str(), api.as_str());
            let registry = &mut state.registry;
            registry.register(Kind::Service, &service, "", by, &service_api, notices)
        });
        registered.map_err(refusal)?;
        Ok(Reply::done(
            format!("Registered [{node}] as provider of [{service}]"),
            1,
        ))
    }

    fn unregister(&self, kind: Kind, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let what = name(args, "name", &node)?;
        let api = args.text("api")?;
        args.end()?;
        let held = self.master.change(|state, notices| {
            let registry = &mut state.registry;
            registry.unregister(kind, &what, &node, &api, notices)
        });
        Ok(if held {
            Reply::done(format!("Unregistered [{node}] from [{what}]"), 1)
        } else {
            Reply::done(format!("[{node}] is not registered for [{what}]"), 0)
        })
    }

    fn lookup(&self, method: &str, args: &mut Args) -> Option<Result<Reply, Reply>> {
        Some(match method {
            "lookupNode" => self.lookup_node(args),
            "lookupService" => self.lookup_service(args),
            "getPublishedTopics" => self.published_topics(args),
            "getTopicTypes" => args.text("caller_id").map(|_| {
                let state = self.master.state.lock();
                let types = state.registry.types().map(pair);
                Reply::done("current system state", Value::Array(types.collect()))
            }),
            "getSystemState" => args.text("caller_id").map(|_| self.system_state()),
            "getUri" => Ok(Reply::done("", self.master.uri.as_str())),
            "getPid" => Ok(Reply::done("", pid())),
            "shutdown" => Ok(Reply::mistake(
                "this Master lives as long as its servant; no node can end it",
                0,
            )),
            _ => return None,
        })
    }

    fn lookup_node(&self, args: &mut Args) -> Result<Reply, Reply> {
        let caller = args.text("caller_id")?;
        let node = name(args, "node_name", &caller)?;
        let state = self.master.state.lock();
        Ok(match state.registry.node_api(&node) {
            Some(api) => Reply::done("node api", api),
            None => Reply::mistake(format!("unknown node [{node}]"), ""),
        })
    }

    fn lookup_service(&self, args: &mut Args) -> Result<Reply, Reply> {
        let caller = args.text("caller_id")?;
        let service = name(args, "service", &caller)?;
        let state = self.master.state.lock();
        Ok(match state.registry.service_api(&service) {
            Some(api) => Reply::done(format!("rosrpc URI: [{api}]"), api),
            None => Reply::mistake("no provider", ""),
        })
    }

    fn published_topics(&self, args: &mut Args) -> Result<Reply, Reply> {
        let caller = args.text("caller_id")?;
        let below = match args.any("subgraph")? {
            Value::String(text) if !text.is_empty() => {
                let below = names::resolve(&text, &caller);
                format!("{}/", below.trim_end_matches('/'))
            }
            _ => String::new(),
        };
        let state = self.master.state.lock();
        let published = state.registry.topics().filter(|(name, topic)| {
            !topic.publishers.is_empty() && name.starts_with(below.as_str())
        });
        let list = published.map(|(name, topic)| pair((name, &topic.type_name)));
        Ok(Reply::done("current topics", Value::Array(list.collect())))
    }

    fn system_state(&self) -> Reply {
        let state = self.master.state.lock();
        let mut publishers = Vec::new();
        let mut subscribers = Vec::new();
        for (name, topic) in state.registry.topics() {
            for (nodes, list) in [
                (topic.publishers, &mut publishers),
                (topic.subscribers, &mut subscribers),
            ] {
                if !nodes.is_empty() {
                    list.push(Value::Array(vec![name.into(), Value::strings(nodes)]));
                }
            }
        }
        let services = state.registry.services();
        let services =
            services.map(|(name, node)| Value::Array(vec![name.into(), Value::strings([node])]));
        let lists = [publishers, subscribers, services.collect()].map(Value::Array);
        Reply::done("current system state", Value::Array(lists.into()))
    }

    fn parameter(&self, method: &str, args: &mut Args) -> Option<Result<Reply, Reply>> {
        Some(match method {
            "setParam" => self.set_param(args),
            "getParam" => self.get_param(args),
            "deleteParam" => self.delete_param(args),
            "hasParam" => self.has_param(args),
            "searchParam" => self.search_param(args),
            "subscribeParam" => self.subscribe_param(args),
            "unsubscribeParam" => self.unsubscribe_param(args),
            "getParamNames" => args.text("caller_id").map(|_| {
                let names = self.master.state.lock().params.names();
                Reply::done("Parameter names", Value::strings(names))
            }),
            _ => return None,
        })
    }

    fn set_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let key = name(args, "key", &node)?;
        let value = args.any("value")?;
        args.end()?;
        let master = &self.master;
        let set = master.change(|state, notices| {
            let watchers = state.registry.parameter_watchers();
            if !watchers.is_empty() {
                tell(params::updates(&watchers, &key, &value), notices);
            }
            let set = state.params.set(&key, value);
            match set {
                Ok(()) => master.note_use(state, &key, &node, true),
                Err(_) => notices.clear(),
            }
            set
        });
        match set {
            Ok(()) => Ok(Reply::done(format!("parameter {key} set"), 0)),
            Err(refused) => Err(Reply::mistake(format!("parameter {key}: {refused}"), 0)),
        }
    }

    fn delete_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let key = name(args, "key", &node)?;
        let deleted = self.master.change(|state, notices| {
            let deleted = state.params.delete(&key);
            if deleted {
                let nothing = Value::Struct(Default::default());
                let watchers = state.registry.parameter_watchers();
                tell(params::updates(&watchers, &key, &nothing), notices);
            }
            deleted
        });
        Ok(if deleted {
            Reply::done(format!("parameter {key} deleted"), 0)
        } else {
            Reply::mistake(format!("parameter [{key}] is not set"), 0)
        })
    }

    fn get_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let (state, key) = &mut self.reads(args)?;
        Ok(match state.params.get(key) {
            Some(value) => Reply::done(format!("Parameter [{key}]"), value.clone()),
            None => Reply::mistake(format!("Parameter [{key}] is not set"), 0),
        })
    }

    fn has_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let (state, key) = &mut self.reads(args)?;
        let there = state.params.get(key).is_some();
        Ok(Reply::done(key.as_str(), there))
    }

    /// The state, after noting that the caller reads the key it names next.
    fn reads(&self, args: &mut Args) -> Result<(Locked<'_>, String), Reply> {
        let node = args.text("caller_id")?;
        let key = name(args, "key", &node)?;
        let mut state = self.master.state.lock();
        self.master.note_use(&mut state, &key, &node, false);
        Ok((state, key))
    }

    fn search_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let key = args.text("key")?;
        if key.starts_with('~') || !node.starts_with('/') {
            let message = format!("cannot search for {key} from {node}");
            return Err(Reply::mistake(message, ""));
        }
        let mut state = self.master.state.lock();
        let found = state.params.search(&node, &key);
        let used = found.clone().unwrap_or_else(|| names::resolve(&key, &node));
        self.master.note_use(&mut state, &used, &node, false);
        Ok(match found {
            Some(found) => Reply::done(format!("Found [{found}]"), found),
            None => Reply::mistake(
                format!("Cannot find parameter [{key}] in an upwards search"),
                "",
            ),
        })
    }

    fn subscribe_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let api = args.uri("caller_api", "http")?;
        let key = name(args, "key", &node)?;
        let master = &self.master;
        let value = master.change(|state, notices| {
            let by = (node.as_str(), api.as_str());
            state
                .registry
                .register(Kind::Parameter, &key, "", by, "", notices)?;
            master.note_use(state, &key, &node, false);
            Ok(state.params.get(&key).cloned())
        });
        let nothing = || Value::Struct(Default::default());
        Ok(Reply::done(
            format!("Subscribed to parameter [{key}]"),
            value.map_err(refusal)?.unwrap_or_else(nothing),
        ))
    }

    fn unsubscribe_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let api = args.text("caller_api")?;
        let key = name(args, "key", &node)?;
        let held = self.master.change(|state, notices| {
            let registry = &mut state.registry;
            registry.unregister(Kind::Parameter, &key, &node, &api, notices)
        });
        Ok(Reply::done(
            format!("Unsubscribe to parameter [{key}]"),
            i32::from(held),
        ))
    }
}

type Locked<'a> = parking_lot::MutexGuard<'a, super::State>;

/// The next argument, a name, made absolute as seen from `node`.
fn name(args: &mut Args, what: &str, node: &str) -> Result<String, Reply> {
    let text = args.text(what)?;
    if text.len() > 1024 || text.chars().any(char::is_control) {
        let message = format!("ERROR: {what} is no ROS name");
        return Err(Reply::mistake(message, 0));
    }
    Ok(names::resolve(&text, node))
}

fn refusal(reason: Refused) -> Reply {
    Reply::mistake(reason.to_string(), 0)
}

fn pair((name, text): (&str, &str)) -> Value {
    Value::strings([name, text])
}

fn pid() -> i32 {
    i32::try_from(std::process::id()).unwrap_or(i32::MAX)
}

fn tell(updates: Vec<(String, String, Value)>, notices: &mut Vec<Notice>) {
    notices.extend(
        updates
            .into_iter()
            .map(|(api, key, value)| Notice::parameter(api, key, value)),
    );
}
