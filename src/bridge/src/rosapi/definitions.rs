//! The definitions of rosapi's services, so that they can be called in CBOR and ROS bytes as well, and be asked for
//! like any other service's.

use std::sync::OnceLock;

use ros::schema::Registry;

/// Name below `/rosapi/` and type below `rosapi/`.
pub(super) const SERVICES: &[(&str, &str)] = &[
    ("action_servers", "GetActionServers"),
    ("delete_param", "DeleteParam"),
    ("get_param", "GetParam"),
    ("get_param_names", "GetParamNames"),
    ("get_ros_version", "GetROSVersion"),
    ("get_time", "GetTime"),
    ("has_param", "HasParam"),
    ("message_details", "MessageDetails"),
    ("node_details", "NodeDetails"),
    ("nodes", "Nodes"),
    ("publishers", "Publishers"),
    ("search_param", "SearchParam"),
    ("service_host", "ServiceHost"),
    ("service_node", "ServiceNode"),
    ("service_providers", "ServiceProviders"),
    ("service_request_details", "ServiceRequestDetails"),
    ("service_response_details", "ServiceResponseDetails"),
    ("service_type", "ServiceType"),
    ("services", "Services"),
    ("services_for_type", "ServicesForType"),
    ("set_param", "SetParam"),
    ("subscribers", "Subscribers"),
    ("topic_type", "TopicType"),
    ("topics", "Topics"),
    ("topics_and_raw_types", "TopicsAndRawTypes"),
    ("topics_for_type", "TopicsForType"),
];

const TEXTS: &[(&str, &str)] = &[
    (
        "rosapi/msg/TypeDef",
        "string type\nstring[] fieldnames\nstring[] fieldtypes\nint32[] fieldarraylen\nstring[] examples\n\
         string[] constnames\nstring[] constvalues\n",
    ),
    (
        "rosapi/srv/GetActionServers",
        "---\nstring[] action_servers\n",
    ),
    ("rosapi/srv/DeleteParam", "string name\n---\n"),
    (
        "rosapi/srv/GetParam",
        "string name\nstring default\n---\nstring value\n",
    ),
    ("rosapi/srv/GetParamNames", "---\nstring[] names\n"),
    (
        "rosapi/srv/GetROSVersion",
        "---\nuint8 version\nstring distro\n",
    ),
    ("rosapi/srv/GetTime", "---\ntime time\n"),
    ("rosapi/srv/HasParam", "string name\n---\nbool exists\n"),
    (
        "rosapi/srv/MessageDetails",
        "string type\n---\nTypeDef[] typedefs\n",
    ),
    (
        "rosapi/srv/NodeDetails",
        "string node\n---\nstring[] subscribing\nstring[] publishing\nstring[] services\n",
    ),
    ("rosapi/srv/Nodes", "---\nstring[] nodes\n"),
    (
        "rosapi/srv/Publishers",
        "string topic\n---\nstring[] publishers\n",
    ),
    (
        "rosapi/srv/SearchParam",
        "string name\n---\nstring global_name\n",
    ),
    (
        "rosapi/srv/ServiceHost",
        "string service\n---\nstring host\n",
    ),
    (
        "rosapi/srv/ServiceNode",
        "string service\n---\nstring node\n",
    ),
    (
        "rosapi/srv/ServiceProviders",
        "string service\n---\nstring[] providers\n",
    ),
    (
        "rosapi/srv/ServiceRequestDetails",
        "string type\n---\nTypeDef[] typedefs\n",
    ),
    (
        "rosapi/srv/ServiceResponseDetails",
        "string type\n---\nTypeDef[] typedefs\n",
    ),
    (
        "rosapi/srv/ServiceType",
        "string service\n---\nstring type\n",
    ),
    ("rosapi/srv/Services", "---\nstring[] services\n"),
    (
        "rosapi/srv/ServicesForType",
        "string type\n---\nstring[] services\n",
    ),
    ("rosapi/srv/SetParam", "string name\nstring value\n---\n"),
    (
        "rosapi/srv/Subscribers",
        "string topic\n---\nstring[] subscribers\n",
    ),
    ("rosapi/srv/TopicType", "string topic\n---\nstring type\n"),
    (
        "rosapi/srv/Topics",
        "---\nstring[] topics\nstring[] types\n",
    ),
    (
        "rosapi/srv/TopicsAndRawTypes",
        "---\nstring[] topics\nstring[] types\nstring[] typedefs_full_text\n",
    ),
    (
        "rosapi/srv/TopicsForType",
        "string type\n---\nstring[] topics\n",
    ),
];

/// rosapi's own definitions.
pub(super) fn registry() -> &'static Registry {
    static REGISTRY: OnceLock<Registry> = OnceLock::new();
    REGISTRY.get_or_init(|| {
        let registry = Registry::new();
        for (key, text) in TEXTS {
            if let Err(error) = registry.insert(key, text) {
                unreachable!("{key} is well formed: {error}");
            }
        }
        registry
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_service_has_its_definition() {
        assert_eq!(SERVICES.len() + 1, TEXTS.len());
        for (_, srv) in SERVICES {
            registry().service(&format!("rosapi/{srv}")).unwrap();
        }
        // As rosbridge_suite's generated code has it.
        assert_eq!(
            registry().service("rosapi/Topics").unwrap().md5,
            "d966d98fc333fa1f3135af765eac1ba8"
        );
    }
}
