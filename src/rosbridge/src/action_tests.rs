use super::*;
use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

fn goal() -> SendActionGoal<'static> {
    SendActionGoal {
        id: Some("send_action_goal:/fibonacci:1".into()),
        action: "/fibonacci".into(),
        action_type: "actionlib_tutorials/Fibonacci".into(),
        args: Some(Payload::json(r#"{"order":5}"#)),
        feedback: true,
        fragment_size: None,
        compression: None,
    }
}

#[test]
fn send_action_goal_is_read_and_checked() {
    assert_parses(
        r#"{"op":"send_action_goal","id":"send_action_goal:/fibonacci:1","action":"/fibonacci","action_type":"actionlib_tutorials/Fibonacci","args":{"order":5},"feedback":true}"#,
        goal(),
    );
    assert_survives_cbor(SendActionGoal { args: None, compression: Some(Compression::CborRaw), ..goal() });
    assert_refused(
        r#"{"op":"send_action_goal","action":"/f"}"#,
        "send_action_goal: field \"action_type\" is missing, an action type such as \"actionlib_tutorials/Fibonacci\" \
         is expected",
    );
    assert_refused(
        r#"{"op":"send_action_goal","action":"/f","action_type":"a/B","feedback":"yes"}"#,
        "send_action_goal: field \"feedback\" is \"yes\", true or false is expected",
    );
}

#[test]
fn cancel_action_goal_is_read_and_checked() {
    let op = CancelActionGoal { id: "g1".into(), action: "/f".into() };
    assert_parses(r#"{"op":"cancel_action_goal","id":"g1","action":"/f"}"#, op.clone());
    assert_survives_cbor(op);
    assert_refused(
        r#"{"op":"cancel_action_goal","action":"/f"}"#,
        "cancel_action_goal: field \"id\" is missing, the id that the goal was sent with is expected",
    );
}

#[test]
fn action_feedback_is_read_and_checked() {
    assert_parses(
        r#"{"op":"action_feedback","id":"g1","action":"/f","values":{"sequence":[0,1]}}"#,
        ActionFeedback {
            id: "g1".into(),
            action: "/f".into(),
            values: Payload::json(r#"{"sequence":[0,1]}"#),
            compression: Compression::None,
        },
    );
    assert_refused(
        r#"{"op":"action_feedback","id":"g1","action":"/f"}"#,
        "action_feedback: field \"values\" is missing, an object with the message's fields is expected",
    );
}

#[test]
fn action_result_is_read_and_checked() {
    let done = ActionResult {
        id: Some("g1".into()),
        action: "/f".into(),
        values: Some(Payload::json(r#"{"sequence":[0,1]}"#)),
        status: Some(GoalStatus::Succeeded),
        result: true,
        compression: Compression::None,
    };
    assert_parses(
        r#"{"op":"action_result","id":"g1","action":"/f","values":{"sequence":[0,1]},"status":4,"result":true}"#,
        done.clone(),
    );
    let failed = ActionResult { values: None, status: None, result: false, ..done };
    assert_parses(r#"{"op":"action_result","id":"g1","action":"/f","result":false}"#, failed.clone());
    assert_survives_cbor(failed);
    assert_refused(
        r#"{"op":"action_result","action":"/f","status":77,"result":true}"#,
        "action_result: field \"status\" is 77, a number of action_msgs/GoalStatus (4 succeeded, 5 canceled, 6 \
         aborted) is expected",
    );
    assert_refused(
        r#"{"op":"action_result","action":"/f"}"#,
        "action_result: field \"result\" is missing, true or false is expected",
    );
}

#[test]
fn advertise_action_is_read_and_checked() {
    let op = AdvertiseAction {
        id: None,
        action: "/f".into(),
        type_name: "actionlib_tutorials/Fibonacci".into(),
        compression: Compression::None,
    };
    assert_parses(r#"{"op":"advertise_action","type":"actionlib_tutorials/Fibonacci","action":"/f"}"#, op.clone());
    assert_survives_cbor(op);
    assert_refused(
        r#"{"op":"advertise_action"}"#,
        "advertise_action: field \"action\" is missing, an action name is expected",
    );
    let op = UnadvertiseAction { id: None, action: "/f".into() };
    assert_parses(r#"{"op":"unadvertise_action","action":"/f"}"#, op.clone());
    assert_survives_cbor(op);
    assert_refused(
        r#"{"op":"unadvertise_action","action":{}}"#,
        "unadvertise_action: field \"action\" is {}, an action name is expected",
    );
}
