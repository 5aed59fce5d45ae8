//! Interfaces for querying parameters and states of ROS 2 nodes. They are the same everywhere, so they need not be
//! looked up in an image; `action_msgs` is built into every registry.

#[cfg(test)]
mod tests;

use std::sync::{Arc, LazyLock};

use ros_bus::{BusError, RosVersion, ServiceType};
use ros_message::schema::{MessageType, Registry, SchemaError};

static KNOWN: LazyLock<Result<Registry, SchemaError>> = LazyLock::new(|| {
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in DEFINITIONS {
        registry.insert(key, text)?;
    }
    Ok(registry)
});

/// Returns a message by its full name.
pub fn message(name: &str) -> Result<Arc<MessageType>, BusError> {
    lookup(name, |registry| registry.message(name))
}

/// Returns a service type by its full name.
pub fn service(name: &str) -> Result<ServiceType, BusError> {
    lookup(name, |registry| Ok(ServiceType::from_service(&*registry.service(name)?)))
}

fn lookup<T>(name: &str, find: impl FnOnce(&Registry) -> Result<T, SchemaError>) -> Result<T, BusError> {
    let found = match &*KNOWN {
        Ok(registry) => find(registry),
        Err(error) => Err(error.clone()),
    };
    found.map_err(|error| BusError::Protocol { what: name.to_owned(), reason: error.to_string() })
}

/// Definitions; constants that are not used here are left out, because no hash depends on them.
const DEFINITIONS: [(&str, &str); 21] = [
    (
        "rcl_interfaces/msg/ParameterValue",
        "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\n\
         byte[] byte_array_value\nbool[] bool_array_value\nint64[] integer_array_value\n\
         float64[] double_array_value\nstring[] string_array_value\n",
    ),
    ("rcl_interfaces/msg/Parameter", "string name\nParameterValue value\n"),
    (
        "rcl_interfaces/msg/ParameterEvent",
        "builtin_interfaces/Time stamp\nstring node\nParameter[] new_parameters\nParameter[] changed_parameters\n\
         Parameter[] deleted_parameters\n",
    ),
    ("rcl_interfaces/msg/FloatingPointRange", "float64 from_value\nfloat64 to_value\nfloat64 step\n"),
    ("rcl_interfaces/msg/IntegerRange", "int64 from_value\nint64 to_value\nuint64 step\n"),
    (
        "rcl_interfaces/msg/ParameterDescriptor",
        "string name\nuint8 type\nstring description\nstring additional_constraints\nbool read_only false\n\
         bool dynamic_typing false\nFloatingPointRange[<=1] floating_point_range\nIntegerRange[<=1] integer_range\n",
    ),
    ("rcl_interfaces/msg/ListParametersResult", "string[] names\nstring[] prefixes\n"),
    ("rcl_interfaces/msg/SetParametersResult", "bool successful\nstring reason\n"),
    ("rcl_interfaces/srv/GetParameters", "string[] names\n---\nParameterValue[] values\n"),
    ("rcl_interfaces/srv/GetParameterTypes", "string[] names\n---\nuint8[] types\n"),
    ("rcl_interfaces/srv/SetParameters", "Parameter[] parameters\n---\nSetParametersResult[] results\n"),
    ("rcl_interfaces/srv/SetParametersAtomically", "Parameter[] parameters\n---\nSetParametersResult result\n"),
    ("rcl_interfaces/srv/ListParameters", "string[] prefixes\nuint64 depth\n---\nListParametersResult result\n"),
    ("rcl_interfaces/srv/DescribeParameters", "string[] names\n---\nParameterDescriptor[] descriptors\n"),
    ("lifecycle_msgs/msg/State", "uint8 id\nstring label\n"),
    ("lifecycle_msgs/msg/Transition", "uint8 id\nstring label\n"),
    ("lifecycle_msgs/msg/TransitionDescription", "Transition transition\nState start_state\nState goal_state\n"),
    (
        "lifecycle_msgs/msg/TransitionEvent",
        "uint64 timestamp\nTransition transition\nState start_state\nState goal_state\n",
    ),
    ("lifecycle_msgs/srv/ChangeState", "Transition transition\n---\nbool success\n"),
    ("lifecycle_msgs/srv/GetState", "---\nState current_state\n"),
    ("lifecycle_msgs/srv/GetAvailableTransitions", "---\nTransitionDescription[] available_transitions\n"),
];
