//! ROS 2 messages generated from other definitions, as by rosidl: request, response and event of a service, the parts
//! of an action and those of its two services. Services and actions themselves are types too, composed of their parts,
//! so that one rule gives the hashes of all.

use crate::schema::SchemaError;
use crate::schema::text::sections;

/// Returns the text of a type generated from service `package/srv/Name`, by the suffix of its name; an empty suffix is
/// the service itself.
pub(crate) fn service_text(service: &str, text: &str, ending: &str) -> Result<Option<String>, SchemaError> {
    if !matches!(ending, "_Request" | "_Response") {
        return Ok(service_part(service, ending));
    }
    let [request, response] = sections::<2>(service, text)?;
    Ok(Some(match ending {
        "_Request" => request,
        _ => response,
    }))
}

/// Returns the text of the service as a type, or of its event.
fn service_part(service: &str, ending: &str) -> Option<String> {
    Some(match ending {
        "" => format!(
            "{service}_Request request_message\n{service}_Response response_message\n{service}_Event event_message\n"
        ),
        "_Event" => format!(
            "service_msgs/ServiceEventInfo info\n{service}_Request[<=1] request\n{service}_Response[<=1] response\n"
        ),
        _ => return None,
    })
}

/// Returns the text of a type generated from action `package/action/Name`, by the suffix of its name; an empty suffix
/// is the action itself.
pub(crate) fn action_text(action: &str, text: &str, ending: &str) -> Result<Option<String>, SchemaError> {
    const GOAL_ID: &str = "unique_identifier_msgs/UUID goal_id\n";
    if matches!(ending, "_Goal" | "_Result" | "_Feedback") {
        let [goal, result, feedback] = sections::<3>(action, text)?;
        return Ok(Some(match ending {
            "_Goal" => goal,
            "_Result" => result,
            _ => feedback,
        }));
    }
    for service in ["_SendGoal", "_GetResult"] {
        if let Some(part) = ending.strip_prefix(service) {
            if let Some(text) = service_part(&format!("{action}{service}"), part) {
                return Ok(Some(text));
            }
        }
    }
    Ok(Some(match ending {
        "" => format!(
            "{action}_Goal goal\n{action}_Result result\n{action}_Feedback feedback\n\
             {action}_SendGoal send_goal_service\n{action}_GetResult get_result_service\n\
             {action}_FeedbackMessage feedback_message\n"
        ),
        "_SendGoal_Request" => format!("{GOAL_ID}{action}_Goal goal\n"),
        "_SendGoal_Response" => "bool accepted\nbuiltin_interfaces/Time stamp\n".to_owned(),
        "_GetResult_Request" => GOAL_ID.to_owned(),
        "_GetResult_Response" => format!("int8 status\n{action}_Result result\n"),
        "_FeedbackMessage" => format!("{GOAL_ID}{action}_Feedback feedback\n"),
        _ => return Ok(None),
    }))
}

/// Returns definitions that every ROS 2 system has and that actions, services and stamps need.
pub(crate) fn well_known(name: &str) -> Option<&'static str> {
    Some(match name {
        "builtin_interfaces/msg/Time" | "builtin_interfaces/msg/Duration" => "int32 sec\nuint32 nanosec\n",
        "std_msgs/msg/Header" => "builtin_interfaces/Time stamp\nstring frame_id\n",
        "unique_identifier_msgs/msg/UUID" => "uint8[16] uuid\n",
        "service_msgs/msg/ServiceEventInfo" => {
            "uint8 REQUEST_SENT = 0\nuint8 REQUEST_RECEIVED = 1\nuint8 RESPONSE_SENT = 2\nuint8 RESPONSE_RECEIVED = 3\n\
             uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\nint64 sequence_number\n"
        }
        "action_msgs/msg/GoalInfo" => "unique_identifier_msgs/UUID goal_id\nbuiltin_interfaces/Time stamp\n",
        "action_msgs/msg/GoalStatus" => {
            "int8 STATUS_UNKNOWN = 0\nint8 STATUS_ACCEPTED = 1\nint8 STATUS_EXECUTING = 2\nint8 STATUS_CANCELING = 3\n\
             int8 STATUS_SUCCEEDED = 4\nint8 STATUS_CANCELED = 5\nint8 STATUS_ABORTED = 6\nGoalInfo goal_info\nint8 \
             status\n"
        }
        "action_msgs/msg/GoalStatusArray" => "GoalStatus[] status_list\n",
        _ => return None,
    })
}

/// Returns such definitions of services.
pub(crate) fn well_known_service(name: &str) -> Option<&'static str> {
    (name == "action_msgs/srv/CancelGoal").then_some(
        "GoalInfo goal_info\n---\nint8 ERROR_NONE=0\nint8 ERROR_REJECTED=1\nint8 ERROR_UNKNOWN_GOAL_ID=2\n\
         int8 ERROR_GOAL_TERMINATED=3\nint8 return_code\nGoalInfo[] goals_canceling\n",
    )
}
