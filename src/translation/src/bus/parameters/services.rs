//! The services about parameters that every node of ROS 2 has, for nodes of ROS 1: `ros2 param` on the robot uses them.
//!
//! ```text
//!  /see/list_parameters  /see/get_parameters  /see/get_parameter_types  /see/describe_parameters
//!  /see/set_parameters  /see/set_parameters_atomically        each: rcl_interfaces/srv/…
//! ```

mod messages;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use bytes::Bytes;
use ros::bus::{BusError, FailureReason, Graph, NodeParameters, ServiceType};
use ros::ros2::interfaces;

/// One of the services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ParameterService {
    List,
    Get,
    GetTypes,
    Describe,
    Set,
    SetAtomically,
}

/// The services, with the ends of their names and of those of their types.
const SERVICES: [(ParameterService, &str, &str); 6] = [
    (ParameterService::List, "list_parameters", "ListParameters"),
    (ParameterService::Get, "get_parameters", "GetParameters"),
    (ParameterService::GetTypes, "get_parameter_types", "GetParameterTypes"),
    (ParameterService::Describe, "describe_parameters", "DescribeParameters"),
    (ParameterService::Set, "set_parameters", "SetParameters"),
    (ParameterService::SetAtomically, "set_parameters_atomically", "SetParametersAtomically"),
];

/// Splits the name of a service into the node, the service and the end of its type's name.
fn split_name(name: &str) -> Option<(&str, ParameterService, &'static str)> {
    let (node, end) = name.rsplit_once('/').filter(|(node, _)| !node.is_empty())?;
    let (service, _, of) = SERVICES.iter().find(|(_, name, _)| *name == end)?;
    Some((node, *service, *of))
}

/// The services about the parameters of nodes of ROS 1. They stand in for services that the nodes themselves have under
/// the same names: dynamic_reconfigure's `set_parameters`, which they use.
pub struct ParameterServices;

impl ParameterServices {
    /// Returns the services of a node, with their types.
    pub fn of_node(node: &str) -> Result<BTreeMap<String, ServiceType>, BusError> {
        SERVICES.iter().map(|(_, name, of)| Ok((format!("{node}/{name}"), service_type(of)?))).collect()
    }

    /// Returns the type of such a service of a node in the graph of the servant of ROS 1; `None` for other services.
    pub fn find_type(graph: &Graph, service: &str) -> Option<Result<ServiceType, BusError>> {
        let (node, _, of) = split_name(service)?;
        graph.nodes.contains_key(node).then(|| service_type(of))
    }

    /// Answers a call of such a service: returns the serialized response. It takes as long as the node of ROS 1 takes
    /// to change its parameters; the caller ends it by dropping the future.
    pub async fn call(parameters: &dyn NodeParameters, service: &str, request: &[u8]) -> Result<Bytes, BusError> {
        let Some((node, kind, _)) = split_name(service) else {
            return Err(BusError::NoService(service.to_owned()));
        };
        let malformed = || BusError::Protocol {
            what: format!("a request to {service}"),
            reason: "it is truncated or too long".to_owned(),
        };
        let names = || messages::read_names(request).ok_or_else(malformed);
        let changes = || messages::read_changes(request).ok_or_else(malformed);
        Ok(match kind {
            ParameterService::List => {
                let (prefixes, depth) = messages::read_list_request(request).ok_or_else(malformed)?;
                messages::write_names(&parameters.list(node, &prefixes, depth).await?)
            }
            ParameterService::Get => messages::write_values(parameters.get(node, &names()?).await?),
            ParameterService::GetTypes => messages::write_kinds(&parameters.describe(node, &names()?).await?),
            ParameterService::Describe => {
                let names = names()?;
                messages::write_descriptions(&names, parameters.describe(node, &names).await?)
            }
            ParameterService::Set => messages::write_results(&parameters.set(node, changes()?).await?),
            ParameterService::SetAtomically => {
                let result = match parameters.set_atomically(node, changes()?).await {
                    Ok(()) => Ok(()),
                    Err(BusError::BadParam { key, reason }) => Err(FailureReason::new(format!("{key}: {reason}"))),
                    Err(error) => return Err(error),
                };
                messages::write_result(&result)
            }
        })
    }
}

fn service_type(of: &str) -> Result<ServiceType, BusError> {
    interfaces::service(&format!("rcl_interfaces/srv/{of}"))
}
