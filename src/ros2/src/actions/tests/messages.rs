//! Hand-written messages compared with the codec's output for the definitions.

use ros_bus::RosVersion;
use ros_message::codec::{JsonOptions, Time, to_json};
use ros_message::schema::{MessageType, Registry};

use super::super::GoalId;
use super::super::messages::*;
use super::{action, cdr, fibonacci};

const ID: GoalId = GoalId([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16]);
const ID_JSON: &str = r#""goal_id":{"uuid":"AQIDBAUGBwgJCgsMDQ4PEA=="}"#;
const INFO: GoalInfo = GoalInfo { id: ID, stamp: Time { secs: 7, nsecs: 8 } };

fn info_json() -> String {
    format!(r#"{{{ID_JSON},"stamp":{{"sec":7,"nanosec":8}}}}"#)
}

#[track_caller]
fn assert_encoded(of: &MessageType, bytes: &[u8], json: &str) {
    let mut found = Vec::new();
    to_json(of, bytes, &mut found, &JsonOptions::default()).unwrap();
    assert_eq!(String::from_utf8(found).unwrap(), json);
}

#[test]
fn goals_and_feedback_stand_behind_their_id() {
    let of = fibonacci();
    let services = of.services.as_ref().unwrap();
    let goal = cdr(&of.goal, r#"{"order":5}"#);
    let sent = write_with_id(ID, &of.goal, &goal).unwrap();
    let json = format!(r#"{{{ID_JSON},"goal":{{"order":5}}}}"#);
    assert_encoded(&services.send_goal.request, &sent, &json);
    assert_eq!(sent, cdr(&services.send_goal.request, &json));
    assert_eq!(read_id(&sent), Some(ID));
    assert_eq!(read_after_id(&of.goal, &sent).unwrap(), goal);
    let feedback = cdr(&of.feedback, r#"{"sequence":[0,1]}"#);
    let told = write_with_id(ID, &of.feedback, &feedback).unwrap();
    let json = format!(r#"{{{ID_JSON},"feedback":{{"sequence":[0,1]}}}}"#);
    assert_encoded(&of.action_feedback, &told, &json);
    assert_eq!(read_after_id(&of.feedback, &told).unwrap(), feedback);
    for end in 0..sent.len() {
        assert_eq!(read_after_id(&of.goal, &sent[..end]), None, "{end}");
    }
    assert_eq!(write_with_id(ID, &of.goal, &[0; 4]), None, "ROS 1's zeros");
    assert_eq!(read_id(&sent[..19]), None);
}

#[test]
fn results_stand_behind_a_status_however_they_are_aligned() {
    for (text, json) in [
        ("float64 wide\nbool b", r#"{"wide":0.5,"b":true}"#),
        ("int32 order\nfloat64 wide\nstring name\nint64[] all", r#"{"order":5,"wide":0.5,"name":"abc","all":[1,2]}"#),
        (
            "bool b\nint16 c\nfloat64[2] d\nbuiltin_interfaces/Time[] times\nint64 last",
            r#"{"b":true,"c":3,"d":[1.0,2.0],"times":[{"sec":1,"nanosec":2}],"last":-1}"#,
        ),
        ("", "{}"),
        ("int32[] sequence", r#"{"sequence":[1,2]}"#),
        ("string a\nwstring b", r#"{"a":"xyz","b":"äb"}"#),
    ] {
        let of = action(&format!("---\n{text}\n---\n"));
        let answer = &of.services.as_ref().unwrap().get_result.response;
        let result = cdr(&of.result, json);
        let written = write_result(ActionGoalStatus::Succeeded, &of.result, &result).unwrap();
        let expected = format!(r#"{{"status":4,"result":{json}}}"#);
        assert_encoded(answer, &written, &expected);
        assert_eq!(written, cdr(answer, &expected), "{text}");
        let read = read_result(&of.result, &written).unwrap();
        assert_eq!(read, (Some(ActionGoalStatus::Succeeded), result), "{text}");
        for end in 0..5 {
            assert_eq!(read_result(&of.result, &written[..end]), None, "{end}");
        }
    }
}

#[test]
fn big_endian_peers_are_understood_and_their_results_stay_so() {
    let of = action("---\nint32 order\nfloat64 wide\n---\n");
    let mut answer = vec![0, 0, 0, 0, 6, 9, 9, 9];
    answer.extend(5i32.to_be_bytes());
    answer.extend(0.5f64.to_be_bytes());
    let (status, result) = read_result(&of.result, &answer).unwrap();
    assert_eq!(status, Some(ActionGoalStatus::Aborted));
    assert_encoded(&of.result, &result, r#"{"order":5,"wide":0.5}"#);
    assert_eq!(result[..2], [0, 0]);
    let mut cancel = vec![0, 0, 0, 0];
    cancel.extend(ID.0);
    cancel.extend([0, 0, 0, 7, 0, 0, 0, 8]);
    assert_eq!(read_cancel(&cancel), Some(INFO));
}

#[test]
fn answers_to_goals_and_to_who_cancels_are_read_as_they_are_written() {
    let of = fibonacci();
    let services = of.services.as_ref().unwrap();
    let accepted = write_accepted(true, Time { secs: 7, nsecs: 8 });
    let json = r#"{"accepted":true,"stamp":{"sec":7,"nanosec":8}}"#;
    assert_encoded(&services.send_goal.response, &accepted, json);
    assert_eq!(read_accepted(&accepted), Some(true));
    let refused = write_accepted(false, Time::default());
    assert_eq!(read_accepted(&refused), Some(false));
    assert_eq!(read_accepted(&refused[..4]), None);
    assert_encoded(&services.get_result.request, &write_id(ID), &format!("{{{ID_JSON}}}"));

    let known = Registry::for_version(RosVersion::Two);
    let cancel = known.service("action_msgs/CancelGoal").unwrap();
    let asked = write_cancel(INFO);
    assert_encoded(&cancel.request, &asked, &format!(r#"{{"goal_info":{}}}"#, info_json()));
    assert_eq!(read_cancel(&asked), Some(INFO));
    assert_eq!(read_cancel(&asked[..27]), None);
    let other = GoalInfo { id: GoalId([3; 16]), ..INFO };
    let answer = write_cancelled(CancelCode::None, &[other, INFO]);
    let other = info_json().replace("AQIDBAUGBwgJCgsMDQ4PEA==", "AwMDAwMDAwMDAwMDAwMDAw==");
    let json = format!(r#"{{"return_code":0,"goals_canceling":[{other},{}]}}"#, info_json());
    assert_encoded(&cancel.response, &answer, &json);
    assert_eq!(read_cancelled(&answer, ID), Some(Ok(())));
    assert_eq!(read_cancelled(&answer, GoalId([4; 16])), Some(Err(0)));
    let refused = write_cancelled(CancelCode::Terminated, &[]);
    assert_eq!(read_cancelled(&refused, ID), Some(Err(3)));
    // A false length.
    let liar = [0, 1, 0, 0, 0, 0, 0, 0, 255, 255, 255, 255, 1];
    assert_eq!(read_cancelled(&liar, ID), None);
}

#[test]
fn statuses_of_all_goals_are_listed() {
    let known = Registry::for_version(RosVersion::Two);
    let list = known.message("action_msgs/GoalStatusArray").unwrap();
    let one = (INFO, ActionGoalStatus::Executing);
    let two = (INFO, ActionGoalStatus::Canceling);
    let json = |status| format!(r#"{{"goal_info":{},"status":{status}}}"#, info_json());
    let expected = format!(r#"{{"status_list":[{},{}]}}"#, json(2), json(3));
    assert_encoded(&list, &write_statuses(&[one, two]), &expected);
    assert_encoded(&list, &write_statuses(&[]), r#"{"status_list":[]}"#);
}
