//! Definitions of rosapi's services, so that they can be called in CBOR and ROS bytes as well, and be queried like
//! those of any other service. They are the union of rosapi in ROS 1 and in ROS 2 (Jazzy).

use std::sync::OnceLock;

use ros::bus::RosVersion;
use ros::schema::Registry;

/// Name below `/rosapi/`, and name of the type in its package.
pub(super) const SERVICES: &[(&str, &str)] = &[
    ("action_feedback_details", "ActionFeedbackDetails"),
    ("action_goal_details", "ActionGoalDetails"),
    ("action_result_details", "ActionResultDetails"),
    ("action_servers", "GetActionServers"),
    ("action_type", "ActionType"),
    ("delete_param", "DeleteParam"),
    ("get_param", "GetParam"),
    ("get_param_names", "GetParamNames"),
    ("get_ros_version", "GetROSVersion"),
    ("get_time", "GetTime"),
    ("has_param", "HasParam"),
    ("interfaces", "Interfaces"),
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

const TYPE_DEF: &str = "string type\nstring[] fieldnames\nstring[] fieldtypes\nint32[] fieldarraylen\n\
                        string[] examples\nstring[] constnames\nstring[] constvalues\n";

const DETAILS: &str = "string type\n---\nTypeDef[] typedefs\n";

/// Services that are the same in both versions of ROS, by the names of their types.
const TEXTS: &[(&str, &str)] = &[
    ("ActionFeedbackDetails", DETAILS),
    ("ActionGoalDetails", DETAILS),
    ("ActionResultDetails", DETAILS),
    ("ActionType", "string action\n---\nstring type\n"),
    ("GetActionServers", "---\nstring[] action_servers\n"),
    ("GetParamNames", "---\nstring[] names\n"),
    ("GetROSVersion", "---\nuint8 version\nstring distro\n"),
    ("HasParam", "string name\n---\nbool exists\n"),
    ("Interfaces", "---\nstring[] interfaces\n"),
    ("MessageDetails", DETAILS),
    ("NodeDetails", "string node\n---\nstring[] subscribing\nstring[] publishing\nstring[] services\n"),
    ("Nodes", "---\nstring[] nodes\n"),
    ("Publishers", "string topic\n---\nstring[] publishers\n"),
    ("SearchParam", "string name\n---\nstring global_name\n"),
    ("ServiceHost", "string service\n---\nstring host\n"),
    ("ServiceNode", "string service\n---\nstring node\n"),
    ("ServiceProviders", "string service\n---\nstring[] providers\n"),
    ("ServiceRequestDetails", DETAILS),
    ("ServiceResponseDetails", DETAILS),
    ("ServiceType", "string service\n---\nstring type\n"),
    ("Services", "---\nstring[] services\n"),
    ("ServicesForType", "string type\n---\nstring[] services\n"),
    ("Subscribers", "string topic\n---\nstring[] subscribers\n"),
    ("TopicType", "string topic\n---\nstring type\n"),
    ("Topics", "---\nstring[] topics\nstring[] types\n"),
    ("TopicsAndRawTypes", "---\nstring[] topics\nstring[] types\nstring[] typedefs_full_text\n"),
    ("TopicsForType", "string type\n---\nstring[] topics\n"),
];

/// Services of ROS 1 only.
const ROS1_SERVICES: &[(&str, &str)] = &[
    ("DeleteParam", "string name\n---\n"),
    ("GetParam", "string name\nstring default\n---\nstring value\n"),
    ("GetTime", "---\ntime time\n"),
    ("SetParam", "string name\nstring value\n---\n"),
];

/// Services of ROS 2 only. Later versions of rosapi have dropped the default of a parameter, and return instead whether
/// it exists.
const OF_TWO: &[(&str, &str)] = &[
    ("DeleteParam", "string name\n---\nbool successful\nstring reason\n"),
    ("GetParam", "string name\nstring default_value\n---\nstring value\nbool successful\nstring reason\n"),
    ("GetTime", "---\nbuiltin_interfaces/Time time\n"),
    ("SetParam", "string name\nstring value\n---\nbool successful\nstring reason\n"),
];

/// Returns the package of rosapi's types.
fn package(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "rosapi",
        RosVersion::Two => "rosapi_msgs",
    }
}

/// Returns the full name of a service's type, as spelled by its ROS.
pub(super) fn type_name(version: RosVersion, srv: &str) -> String {
    let package = package(version);
    match version {
        RosVersion::One => format!("{package}/{srv}"),
        RosVersion::Two => format!("{package}/srv/{srv}"),
    }
}

/// Returns rosapi's own definitions.
pub(super) fn registry(version: RosVersion) -> &'static Registry {
    static ROS1_REGISTRY: OnceLock<Registry> = OnceLock::new();
    static TWO: OnceLock<Registry> = OnceLock::new();
    let (registry, own) = match version {
        RosVersion::One => (&ROS1_REGISTRY, ROS1_SERVICES),
        RosVersion::Two => (&TWO, OF_TWO),
    };
    registry.get_or_init(|| {
        let package = package(version);
        let registry = Registry::for_version(version);
        let services = TEXTS.iter().chain(own);
        let services = services.map(|(srv, text)| (format!("{package}/srv/{srv}"), *text));
        let type_def = (format!("{package}/msg/TypeDef"), TYPE_DEF);
        for (key, text) in services.chain([type_def]) {
            if let Err(error) = registry.insert(&key, text) {
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
        for (version, own) in [(RosVersion::One, ROS1_SERVICES), (RosVersion::Two, OF_TWO)] {
            assert_eq!(SERVICES.len(), TEXTS.len() + own.len());
            for (_, srv) in SERVICES {
                let name = type_name(version, srv);
                let found = registry(version).service(&name).unwrap();
                assert_eq!(found.name, name);
            }
        }
        // As in rosbridge_suite's generated code.
        assert_eq!(registry(RosVersion::One).service("rosapi/Topics").unwrap().md5, "d966d98fc333fa1f3135af765eac1ba8");
        let two = registry(RosVersion::Two).service("rosapi_msgs/GetTime");
        let response = two.unwrap().response.clone();
        assert_eq!(response.fields()[0].type_name, "builtin_interfaces/msg/Time");
    }
}
