//! rosapi: what clients ask about the ROS system they are connected to. In rosbridge_suite a node serves these
//! services; here the bridge answers them itself, from the servant's graph, parameters and definitions.

mod definitions;
mod graph;
mod node_params;
mod params;
mod typedefs;

use std::collections::BTreeSet;
use std::sync::Arc;

use async_trait::async_trait;
use budget::Budget;
use ros::bus::RosVersion;
use ros::codec::Time;
use ros::schema::{Registry, ServiceDef};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::clock;
use crate::own::{Caller, OwnService};
use crate::shared::Shared;
use typedefs::Definitions;

/// The node that seems to serve these services.
const NODE: &str = "/rosapi";

/// One of rosapi's services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Service {
    name: &'static str,
    srv: &'static str,
}

/// The fields of all requests together: each service reads its own.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Args {
    topic: String,
    #[serde(rename = "type")]
    type_name: String,
    service: String,
    action: String,
    node: String,
    name: String,
    value: String,
    default: String,
    /// ROS 2's name for it.
    default_value: String,
}

impl Service {
    /// The service of that (absolute) name.
    pub(crate) fn find(name: &str) -> Option<Service> {
        let name = name.strip_prefix("/rosapi/")?;
        definitions::SERVICES
            .iter()
            .find(|(known, _)| *known == name)
            .map(|(name, srv)| Service { name, srv })
    }

    /// Every service of rosapi.
    pub(crate) fn all() -> impl Iterator<Item = Service> {
        definitions::SERVICES
            .iter()
            .map(|(name, srv)| Service { name, srv })
    }

    /// `/rosapi/…`.
    pub(crate) fn full_name(self) -> String {
        format!("{NODE}/{}", self.name)
    }

    /// `rosapi/…`, in ROS 2 `rosapi_msgs/srv/…`.
    pub(crate) fn type_name(self, version: RosVersion) -> String {
        definitions::type_name(version, self.srv)
    }

    async fn values(
        self,
        shared: &Arc<Shared>,
        args: &Args,
        caller: &Caller<'_>,
    ) -> Result<Value, String> {
        let (version, grants) = (shared.bus.version(), caller.grants);
        let now = graph::with_own_topics(version, &shared.bus.graph().borrow());
        let now = graph::shown(now, grants);
        let definitions = Definitions {
            version,
            registry: &shared.registry,
        };
        Ok(match self.name {
            "topics" => graph::topics(&now),
            "topics_for_type" => graph::topics_for_type(&now, &args.type_name),
            "topics_and_raw_types" => graph::topics_and_raw_types(&now, version, &shared.registry),
            "topic_type" => graph::topic_type(&now, &args.topic),
            "publishers" => graph::publishers(&now, &args.topic),
            "subscribers" => graph::subscribers(&now, &args.topic),
            "nodes" => graph::nodes(&now),
            "node_details" => graph::node_details(&now, &args.node),
            "action_servers" => graph::action_servers(&now),
            "action_type" => graph::action_type(&now, &args.action),
            "services" => graph::services(&now),
            "service_node" => graph::service_node(&now, &args.service),
            "service_host" => graph::service_host(&now, version, &args.service),
            "service_type" => graph::service_type(shared, &args.service, grants).await,
            "services_for_type" => graph::services_for_type(shared, &now, &args.type_name).await,
            "service_providers" => graph::service_providers(shared, &now, &args.service).await,
            "interfaces" => interfaces(version, &shared.registry),
            "message_details" => definitions.message(&args.type_name)?,
            "service_request_details" => definitions.request(&args.type_name)?,
            "service_response_details" => definitions.response(&args.type_name)?,
            "action_goal_details" => definitions.of_action(&args.type_name, |of| &of.goal)?,
            "action_result_details" => definitions.of_action(&args.type_name, |of| &of.result)?,
            "action_feedback_details" => {
                definitions.of_action(&args.type_name, |of| &of.feedback)?
            }
            name if name.contains("param") => match version {
                RosVersion::One => self.shared_param(shared, args, caller.budget).await?,
                RosVersion::Two => self.node_param(shared, args, caller.budget).await?,
            },
            "get_time" => time(version, clock::now(shared).await),
            "get_ros_version" => json!({
                "version": version.number(),
                "distro": shared.bus.distribution().await,
            }),
            other => return Err(format!("rosapi has no service {other}")),
        })
    }

    /// About parameters that all nodes share.
    async fn shared_param(
        self,
        shared: &Arc<Shared>,
        args: &Args,
        budget: &Budget,
    ) -> Result<Value, String> {
        match self.name {
            "get_param" => params::get(shared, args).await,
            "set_param" => params::set(shared, args, budget).await,
            "has_param" => params::has(shared, args).await,
            "search_param" => params::search(shared, args).await,
            "delete_param" => params::delete(shared, args).await,
            _ => params::names(shared).await,
        }
    }

    /// About parameters that belong to nodes.
    async fn node_param(
        self,
        shared: &Arc<Shared>,
        args: &Args,
        budget: &Budget,
    ) -> Result<Value, String> {
        match self.name {
            "get_param" => node_params::get(shared, args).await,
            "set_param" => node_params::set(shared, args, budget).await,
            "has_param" => node_params::has(shared, args).await,
            // Nodes have nobody above them of whom to inherit one.
            "search_param" => params::search(shared, args).await,
            "delete_param" => node_params::delete(shared, args).await,
            _ => node_params::names(shared).await,
        }
    }
}

#[async_trait]
impl OwnService for Service {
    fn is_filtered(&self) -> bool {
        !self.name.contains("param")
    }

    fn shows_graph(&self) -> bool {
        !matches!(self.name, "get_time" | "get_ros_version" | "interfaces")
            && !self.name.contains("param")
            && !self.name.ends_with("_details")
            || self.name == "node_details"
    }

    fn definition(&self, shared: &Shared) -> Result<Arc<ServiceDef>, String> {
        let version = shared.bus.version();
        definitions::registry(version)
            .service(&self.type_name(version))
            .map_err(|error| error.to_string())
    }

    async fn answer(
        &self,
        shared: &Arc<Shared>,
        args: &[u8],
        caller: &Caller<'_>,
    ) -> Result<Vec<u8>, String> {
        let args: Args = serde_json::from_slice(args).map_err(|error| format!("args: {error}"))?;
        let values = self.values(shared, &args, caller).await?;
        Ok(values.to_string().into_bytes())
    }
}

/// A type's definition in the servant's registry, or among rosapi's own.
fn with_own<T, E>(
    version: RosVersion,
    registry: &Registry,
    find: impl Fn(&Registry) -> Result<T, E>,
) -> Result<T, E> {
    find(registry).or_else(|error| find(definitions::registry(version)).map_err(|_| error))
}

/// Every definition that is known.
fn interfaces(version: RosVersion, registry: &Registry) -> Value {
    let own = definitions::registry(version).keys();
    let all: BTreeSet<String> = registry.keys().into_iter().chain(own).collect();
    json!({ "interfaces": all })
}

/// A time as the ROS writes it. Of ROS 2's there are also the names that it has in ROS 1: roslibpy reads those alone.
fn time(version: RosVersion, Time { secs, nsecs }: Time) -> Value {
    let time = match version {
        RosVersion::One => json!({ "secs": secs, "nsecs": nsecs }),
        RosVersion::Two => json!({ "sec": secs, "nanosec": nsecs, "secs": secs, "nsecs": nsecs }),
    };
    json!({ "time": time })
}
