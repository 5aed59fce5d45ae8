//! rosapi: services on the ROS system that a client is connected to. In rosbridge_suite a node serves them; here the
//! bridge answers them itself, from the servant's graph, parameters and definitions.

mod definitions;
mod graph;
mod node_params;
mod param_error;
mod params;
mod typedefs;

use std::collections::BTreeSet;
use std::sync::Arc;

use async_trait::async_trait;
use budget::Budget;
use ros::bus::RosVersion;
use ros::codec::Time;
use ros::schema::{Registry, SchemaError, ServiceDef};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::clock;
use crate::own_service::{Caller, OwnService, OwnServiceError};
use crate::shared::BridgeShared;
pub(crate) use param_error::ParamRequestError;
use typedefs::Definitions;

/// Node that appears to serve these services.
const NODE: &str = "/rosapi";

/// One of rosapi's services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RosapiService {
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
    /// Name of the field `default` in ROS 2.
    default_value: String,
}

impl RosapiService {
    /// Finds the service with this absolute name.
    pub(crate) fn find(name: &str) -> Option<RosapiService> {
        let name = name.strip_prefix("/rosapi/")?;
        definitions::SERVICES.iter().find(|(known, _)| *known == name).map(|(name, srv)| RosapiService { name, srv })
    }

    /// Iterates over all services of rosapi.
    pub(crate) fn all() -> impl Iterator<Item = RosapiService> {
        definitions::SERVICES.iter().map(|(name, srv)| RosapiService { name, srv })
    }

    /// Returns the absolute name, `/rosapi/…`.
    pub(crate) fn full_name(self) -> String {
        format!("{NODE}/{}", self.name)
    }

    /// Returns the type, `rosapi/…`, in ROS 2 `rosapi_msgs/srv/…`.
    pub(crate) fn type_name(self, version: RosVersion) -> String {
        definitions::type_name(version, self.srv)
    }

    async fn call(
        self,
        shared: &Arc<BridgeShared>,
        args: &Args,
        caller: &Caller<'_>,
    ) -> Result<Value, OwnServiceError> {
        let (version, grants) = (shared.bus.version(), caller.grants);
        let now = graph::with_own_topics(version, &shared.bus.graph().borrow());
        let now = graph::filter_by_grants(now, grants);
        let definitions = Definitions { version, registry: &shared.registry };
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
            "action_goal_details" => definitions.action_part(&args.type_name, |of| &of.goal)?,
            "action_result_details" => definitions.action_part(&args.type_name, |of| &of.result)?,
            "action_feedback_details" => definitions.action_part(&args.type_name, |of| &of.feedback)?,
            name if name.contains("param") => match version {
                RosVersion::One => self.shared_param(shared, args, caller.budget).await?,
                RosVersion::Two => self.node_param(shared, args, caller.budget).await?,
            },
            "get_time" => time_json(version, clock::now(shared).await),
            "get_ros_version" => json!({
                "version": version.number(),
                "distro": shared.bus.distribution().await,
            }),
            other => return Err(OwnServiceError::Unknown(other)),
        })
    }

    /// Answers services on parameters shared by all nodes.
    async fn shared_param(
        self,
        shared: &Arc<BridgeShared>,
        args: &Args,
        budget: &Budget,
    ) -> Result<Value, ParamRequestError> {
        match self.name {
            "get_param" => params::get(shared, args).await,
            "set_param" => params::set(shared, args, budget).await,
            "has_param" => params::has(shared, args).await,
            "search_param" => params::search(shared, args).await,
            "delete_param" => params::delete(shared, args).await,
            _ => params::names(shared).await,
        }
    }

    /// Answers services on parameters of individual nodes.
    async fn node_param(
        self,
        shared: &Arc<BridgeShared>,
        args: &Args,
        budget: &Budget,
    ) -> Result<Value, ParamRequestError> {
        match self.name {
            "get_param" => node_params::get(shared, args).await,
            "set_param" => node_params::set(shared, args, budget).await,
            "has_param" => node_params::has(shared, args).await,
            // Nodes have no parents to inherit a parameter from.
            "search_param" => params::search(shared, args).await,
            "delete_param" => node_params::delete(shared, args).await,
            _ => node_params::names(shared).await,
        }
    }
}

#[async_trait]
impl OwnService for RosapiService {
    fn is_filtered(&self) -> bool {
        !self.name.contains("param")
    }

    fn reads_graph(&self) -> bool {
        !matches!(self.name, "get_time" | "get_ros_version" | "interfaces")
            && !self.name.contains("param")
            && !self.name.ends_with("_details")
            || self.name == "node_details"
    }

    fn definition(&self, shared: &BridgeShared) -> Result<Arc<ServiceDef>, SchemaError> {
        let version = shared.bus.version();
        definitions::registry(version).service(&self.type_name(version))
    }

    async fn answer(
        &self,
        shared: &Arc<BridgeShared>,
        args: &[u8],
        caller: &Caller<'_>,
    ) -> Result<Vec<u8>, OwnServiceError> {
        let args: Args = serde_json::from_slice(args).map_err(OwnServiceError::Args)?;
        let values = self.call(shared, &args, caller).await?;
        Ok(values.to_string().into_bytes())
    }
}

/// Finds a type in the servant's registry, or among rosapi's own.
fn find_with_own<T, E>(
    version: RosVersion,
    registry: &Registry,
    find: impl Fn(&Registry) -> Result<T, E>,
) -> Result<T, E> {
    find(registry).or_else(|error| find(definitions::registry(version)).map_err(|_| error))
}

/// Returns the names of all known definitions.
fn interfaces(version: RosVersion, registry: &Registry) -> Value {
    let own = definitions::registry(version).keys();
    let all: BTreeSet<String> = registry.keys().into_iter().chain(own).collect();
    json!({ "interfaces": all })
}

/// Formats a time as in ROS. For ROS 2 the names of ROS 1 are included, since roslibpy only reads those.
fn time_json(version: RosVersion, Time { secs, nsecs }: Time) -> Value {
    let time = match version {
        RosVersion::One => json!({ "secs": secs, "nsecs": nsecs }),
        RosVersion::Two => json!({ "sec": secs, "nanosec": nsecs, "secs": secs, "nsecs": nsecs }),
    };
    json!({ "time": time })
}
