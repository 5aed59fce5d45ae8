//! rosapi: what clients ask about the ROS system they are connected to. In rosbridge_suite a node serves these
//! services; here the bridge answers them itself, from the servant's graph, parameters and definitions.

mod definitions;
mod graph;
mod params;
mod typedefs;

use std::sync::Arc;

use access::Grants;
use async_trait::async_trait;
use ros::codec::Time;
use ros::schema::{Registry, ServiceDef};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::clock;
use crate::own::OwnService;
use crate::shared::Shared;

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

    /// `rosapi/…`.
    pub(crate) fn type_name(self) -> String {
        format!("rosapi/{}", self.srv)
    }

    async fn values(
        self,
        shared: &Arc<Shared>,
        args: &Args,
        grants: &Grants,
    ) -> Result<Value, String> {
        let now = graph::shown(graph::with_own_topics(&shared.bus.graph().borrow()), grants);
        Ok(match self.name {
            "topics" => graph::topics(&now),
            "topics_for_type" => graph::topics_for_type(&now, &args.type_name),
            "topics_and_raw_types" => graph::topics_and_raw_types(&now, &shared.registry),
            "topic_type" => graph::topic_type(&now, &args.topic),
            "publishers" => graph::publishers(&now, &args.topic),
            "subscribers" => graph::subscribers(&now, &args.topic),
            "nodes" => graph::nodes(&now),
            "node_details" => graph::node_details(&now, &args.node),
            "action_servers" => graph::action_servers(&now),
            "services" => graph::services(&now),
            "service_node" => graph::service_node(&now, &args.service),
            "service_host" => graph::service_host(&now, &args.service),
            "service_type" => graph::service_type(shared, &args.service, grants).await,
            "services_for_type" => graph::services_for_type(shared, &now, &args.type_name).await,
            "service_providers" => graph::service_providers(shared, &now, &args.service).await,
            "message_details" => typedefs::message(&shared.registry, &args.type_name)?,
            "service_request_details" => typedefs::request(&shared.registry, &args.type_name)?,
            "service_response_details" => typedefs::response(&shared.registry, &args.type_name)?,
            "get_param" => params::get(shared, args).await?,
            "set_param" => params::set(shared, args).await?,
            "has_param" => params::has(shared, args).await?,
            "search_param" => params::search(shared, args).await?,
            "delete_param" => params::delete(shared, args).await?,
            "get_param_names" => params::names(shared).await?,
            "get_time" => {
                let Time { secs, nsecs } = clock::now(shared).await;
                json!({ "time": { "secs": secs, "nsecs": nsecs } })
            }
            "get_ros_version" => json!({
                "version": shared.bus.version().number(),
                "distro": shared.bus.distribution().await,
            }),
            other => return Err(format!("rosapi has no service {other}")),
        })
    }
}

#[async_trait]
impl OwnService for Service {
    fn is_filtered(&self) -> bool {
        !self.name.contains("param")
    }

    fn shows_graph(&self) -> bool {
        !matches!(self.name, "get_time" | "get_ros_version")
            && !self.name.contains("param")
            && !self.name.ends_with("_details")
            || self.name == "node_details"
    }

    fn definition(&self, _: &Registry) -> Result<Arc<ServiceDef>, String> {
        definitions::registry()
            .service(&self.type_name())
            .map_err(|error| error.to_string())
    }

    async fn answer(
        &self,
        shared: &Arc<Shared>,
        args: &[u8],
        grants: &Grants,
    ) -> Result<Vec<u8>, String> {
        let args: Args = serde_json::from_slice(args).map_err(|error| format!("args: {error}"))?;
        let values = self.values(shared, &args, grants).await?;
        Ok(values.to_string().into_bytes())
    }
}

/// A type's definition in the servant's registry, or among rosapi's own.
fn with_own<T, E>(registry: &Registry, find: impl Fn(&Registry) -> Result<T, E>) -> Result<T, E> {
    find(registry).or_else(|error| find(definitions::registry()).map_err(|_| error))
}
