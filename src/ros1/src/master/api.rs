//! The Master's methods, compatible with rosmaster.

mod parameters;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;

use super::MasterCore;
use super::graph::{GraphPart, WAIT_GRAPH, wire_generation};
use super::lending::LEND_SERVICES;
use super::record_sought;
use super::registry::{Kind, RegistrationError};
use crate::names;
use crate::reply::{ApiReply, Args};
use crate::xmlrpc::{Fault, Value, XmlRpcHandler, fault_value};

/// Maximum number of calls in one `system.multicall`.
const MAX_MULTICALL: usize = 10_000;
/// Maximum duration of a long poll.
const MAX_WAIT: Duration = Duration::from_secs(300);

const METHODS: &[&str] = &[
    LEND_SERVICES,
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
    pub(super) master: Arc<MasterCore>,
}

#[async_trait]
impl XmlRpcHandler for Api {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        match method {
            WAIT_GRAPH => {
                let answer = self.wait_graph(Args::new(params)).await;
                Ok(answer.unwrap_or_else(|mistake| mistake).into_value())
            }
            "lookupService" => {
                let answer = self.find_service(Args::new(params)).await;
                Ok(answer.unwrap_or_else(|mistake| mistake).into_value())
            }
            "system.listMethods" => Ok(Value::strings(METHODS.iter().copied())),
            "system.multicall" => self.multicall(params),
            _ => self.dispatch(method, params),
        }
    }

    fn weight(&self, method: &str, params: &[Value]) -> usize {
        match (method, params) {
            ("getParam" | "subscribeParam", [caller, rest @ ..]) => {
                let key = rest.last().and_then(Value::as_str).unwrap_or_default();
                let key = names::resolve(key, caller.as_str().unwrap_or_default());
                let state = self.master.state.lock();
                state.params.get(&key).map_or(0, Value::size)
            }
            ("system.multicall", [Value::Array(calls), ..]) => {
                let each = calls.iter().map(|call| {
                    let method = call.get("methodName").and_then(Value::as_str);
                    let params = call.get("params").and_then(Value::as_array);
                    match (method, params) {
                        // Not answered inside itself.
                        (Some("system.multicall"), _) | (None, _) | (_, None) => 0,
                        (Some(method), Some(params)) => self.weight(method, params),
                    }
                });
                each.fold(0, usize::saturating_add)
            }
            (WAIT_GRAPH, _) => self.master.graph_weight(),
            ("getParamNames", _) => self.master.state.lock().params.size(),
            _ => 0,
        }
    }
}

impl Api {
    /// Handles the methods that are answered at once.
    fn dispatch(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
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
            return Err(Fault::new(format!("more than {MAX_MULTICALL} calls in one")));
        }
        let answers = calls.into_iter().map(|call| {
            let answer = match call {
                Value::Struct(mut members) => match (members.remove("methodName"), members.remove("params")) {
                    (Some(Value::String(method)), Some(Value::Array(params))) => self.dispatch(&method, params),
                    _ => Err(Fault::new("a call needs methodName and params")),
                },
                _ => Err(Fault::new("a call is a struct of methodName and params")),
            };
            match answer {
                Ok(value) => Value::Array(vec![value]),
                Err(fault) => fault_value(&fault),
            }
        });
        Ok(Value::Array(answers.collect()))
    }

    async fn wait_graph(&self, mut args: Args) -> Result<ApiReply, ApiReply> {
        args.text("caller_id")?;
        let known = args.value("known_generation")?.as_int().unwrap_or(-1);
        let seconds = match args.value("timeout_s")? {
            Value::Int(seconds) => f64::from(seconds),
            Value::Double(seconds) => seconds,
            _ => 0.0,
        };
        // Callers of an earlier version do not give it.
        let run_id = args.value("run_id").ok();
        let time = Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or(MAX_WAIT);
        let mut generation = self.master.generation.subscribe();
        let news = generation.wait_for(|now| wire_generation(*now) != known);
        // In either case: the answer says how the state is now.
        let _ = tokio::time::timeout(time.min(MAX_WAIT), news).await;
        let is_ours = run_id.as_ref().and_then(Value::as_str) == Some(self.master.run_id.as_str());
        let answer = self.master.graph_answer(Some(known).filter(|known| is_ours && *known >= 0));
        Ok(ApiReply::success("", answer.to_value()))
    }

    fn registration(&self, method: &str, args: &mut Args) -> Option<Result<ApiReply, ApiReply>> {
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

    fn register_topic(&self, kind: Kind, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let topic = name_argument(args, "topic", &node)?;
        let type_name = args.text("topic_type")?;
        let api = args.uri("caller_api", "http")?;
        args.finish()?;
        let others = self.master.update(|state, notices| {
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
        Ok(ApiReply::success(message, Value::strings(others.map_err(refusal_reply)?)))
    }

    fn register_service(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let service = name_argument(args, "service", &node)?;
        let service_api = args.uri("service_api", "rosrpc")?;
        let api = args.uri("caller_api", "http")?;
        args.finish()?;
        let registered = self.master.update(|state, notices| {
            let by = (node.as_str(), api.as_str());
            let registry = &mut state.registry;
            registry.register(Kind::Service, &service, "", by, &service_api, notices)
        });
        registered.map_err(refusal_reply)?;
        Ok(ApiReply::success(format!("Registered [{node}] as provider of [{service}]"), 1))
    }

    fn unregister(&self, kind: Kind, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let what = name_argument(args, "name", &node)?;
        let api = args.text("api")?;
        args.finish()?;
        let held = self.master.update(|state, notices| {
            let registry = &mut state.registry;
            registry.unregister(kind, &what, &node, &api, notices)
        });
        Ok(if held {
            ApiReply::success(format!("Unregistered [{node}] from [{what}]"), 1)
        } else {
            ApiReply::success(format!("[{node}] is not registered for [{what}]"), 0)
        })
    }

    fn lookup(&self, method: &str, args: &mut Args) -> Option<Result<ApiReply, ApiReply>> {
        Some(match method {
            "lookupNode" => self.lookup_node(args),
            "lookupService" => self.lookup_service(args),
            LEND_SERVICES => self.lend_services(args),
            "getPublishedTopics" => self.published_topics(args),
            "getTopicTypes" => args.text("caller_id").map(|_| {
                let state = self.master.state.lock();
                let types = state.registry.types().map(pair);
                ApiReply::success("current system state", Value::Array(types.collect()))
            }),
            "getSystemState" => args.text("caller_id").map(|_| self.system_state()),
            "getUri" => Ok(ApiReply::success("", self.master.uri.as_str())),
            "getPid" => Ok(ApiReply::success("", pid())),
            "shutdown" => Ok(ApiReply::error("this Master runs as long as its servant; nodes cannot shut it down", 0)),
            _ => return None,
        })
    }

    fn lookup_node(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let caller = args.text("caller_id")?;
        let node = name_argument(args, "node_name", &caller)?;
        let state = self.master.state.lock();
        Ok(match state.registry.node_api(&node) {
            Some(api) => ApiReply::success("node api", api),
            None => ApiReply::error(format!("unknown node [{node}]"), ""),
        })
    }

    /// Looks up a registered service only, as in a `system.multicall`.
    fn lookup_service(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let caller = args.text("caller_id")?;
        let service = name_argument(args, "service", &caller)?;
        self.registered_service(&service).ok_or_else(no_provider)
    }

    /// Looks up a service among those registered, then asks the lender.
    async fn find_service(&self, mut args: Args) -> Result<ApiReply, ApiReply> {
        let caller = args.text("caller_id")?;
        let service = name_argument(&mut args, "service", &caller)?;
        if let Some(reply) = self.registered_service(&service) {
            return Ok(reply);
        }
        let lent = self.master.lending.find_service(&service, &caller).await;
        // A registration made meanwhile has precedence.
        if let Some(reply) = self.registered_service(&service) {
            return Ok(reply);
        }
        if let Some(api) = lent {
            return Ok(service_reply(&api));
        }
        let mut state = self.master.state.lock();
        if record_sought(&mut state.sought, &service, &caller) {
            self.master.record_changes(&mut state, [GraphPart::Sought(service)]);
            self.master.bump_generation();
        }
        Err(no_provider())
    }

    fn registered_service(&self, service: &str) -> Option<ApiReply> {
        let state = self.master.state.lock();
        state.registry.service_api(service).map(service_reply)
    }

    fn lend_services(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let api = args.uri("caller_api", "http")?;
        args.finish()?;
        let lent = self.master.lending.set_lender(&node, &api, self.master.sockets(), &self.master.limits.budget);
        lent.map_err(|error| ApiReply::error(error.to_string(), 0))?;
        Ok(ApiReply::success(format!("[{node}] lends services"), 1))
    }

    fn published_topics(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let caller = args.text("caller_id")?;
        let below = match args.value("subgraph")? {
            Value::String(text) if !text.is_empty() => {
                let below = names::resolve(&text, &caller);
                format!("{}/", below.trim_end_matches('/'))
            }
            _ => String::new(),
        };
        let state = self.master.state.lock();
        let published = state
            .registry
            .topics()
            .filter(|(name, topic)| !topic.publishers.is_empty() && name.starts_with(below.as_str()));
        let list = published.map(|(name, topic)| pair((name, &topic.type_name)));
        Ok(ApiReply::success("current topics", Value::Array(list.collect())))
    }

    fn system_state(&self) -> ApiReply {
        let state = self.master.state.lock();
        let mut publishers = Vec::new();
        let mut subscribers = Vec::new();
        for (name, topic) in state.registry.topics() {
            for (nodes, list) in [(topic.publishers, &mut publishers), (topic.subscribers, &mut subscribers)] {
                if !nodes.is_empty() {
                    list.push(Value::Array(vec![name.into(), Value::strings(nodes)]));
                }
            }
        }
        let services = state.registry.services();
        let services = services.map(|(name, node)| Value::Array(vec![name.into(), Value::strings([node])]));
        let lists = [publishers, subscribers, services.collect()].map(Value::Array);
        ApiReply::success("current system state", Value::Array(lists.into()))
    }
}

/// Takes the next argument, a name, and resolves it relative to `node`.
fn name_argument(args: &mut Args, what: &str, node: &str) -> Result<String, ApiReply> {
    let text = args.text(what)?;
    if text.len() > 1024 || text.chars().any(char::is_control) {
        let message = format!("ERROR: {what} is not a ROS name");
        return Err(ApiReply::error(message, 0));
    }
    Ok(names::resolve(&text, node))
}

fn service_reply(api: &str) -> ApiReply {
    ApiReply::success(format!("rosrpc URI: [{api}]"), api)
}

fn no_provider() -> ApiReply {
    ApiReply::error("no provider", "")
}

fn refusal_reply(reason: RegistrationError) -> ApiReply {
    ApiReply::error(reason.to_string(), 0)
}

fn pair((name, text): (&str, &str)) -> Value {
    Value::strings([name, text])
}

fn pid() -> i32 {
    i32::try_from(std::process::id()).unwrap_or(i32::MAX)
}
