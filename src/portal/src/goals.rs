//! `GET /api/v1/servants/ID/goals`: the goals of a servant's actions and their outcomes.

use std::sync::Arc;
use std::time::Duration;

use access::{Grants, Operation};
use api::goals::{Goal, GoalState};
use axum::extract::{Path, State};
use axum::{Extension, Json};
use choreographer::Handle;
use observe::{GoalMonitor, GoalSender};
use ros::ros1::actions::messages::ActionlibStatus;
use store::NewEvent;

use crate::app::App;
use crate::caller::Caller;
use crate::inside::{self, InsideTarget};
use crate::json::JsonResult;

/// Event kind: a goal has ended.
const GOAL_ENDED: &str = "goal-ended";
/// Text used if the sender is unknown.
const UNHEARD: &str = "unknown sender";
/// Average interval between such events of a servant; those in excess are only counted.
const PAUSE: Duration = Duration::from_secs(1);
/// Number of goals ending at once that are reported individually.
const MAX_SINGLE_REPORTS: usize = 5;
/// Time by which a goal may arrive after its result, because they come over two connections.
const SETTLES: Duration = Duration::from_millis(200);

/// Lists the servant's goals that the caller may see, newest first.
pub async fn goals(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
) -> JsonResult<Vec<Goal>> {
    let handle = app.choreographer.servant(&id)?;
    let whose = InsideTarget { service: handle.service(), robot: &handle.robot, object: format_args!("servant {id}") };
    let grants = inside::inside_grants(&app, &caller, whose)?;
    let goals = app.observers.goals(&id);
    let mut all = goals.map(|goals| goals.recent()).unwrap_or_default();
    all.retain(|goal| can_see_goals(&grants, &goal.action));
    let told = all.into_iter().map(|goal| to_api_goal(&handle, goal));
    Ok(Json(told.collect()))
}

/// Returns true if the grants reveal the goals of an action: to those who may send goals, and to those who may
/// subscribe to both goals and results.
fn can_see_goals(grants: &Grants, action: &str) -> bool {
    let hears = |end: &str| grants.permits(Operation::Subscribe, &format!("{action}/{end}"));
    grants.permits(Operation::Call, action) || (hears("goal") && hears("result"))
}

/// Describes the sender of a goal; `None` if it is unknown.
fn describe_sender(handle: &Handle, sender: &GoalSender) -> Option<String> {
    let by_its_own = |node: &String| {
        let interface = &handle.revision.interface;
        let nodes = handle.revision.plan.nodes.iter();
        interface.actions.iter().any(|action| action.node == *node)
            || nodes.map(|planned| &planned.name).any(|name| name == node)
    };
    match sender {
        GoalSender::Inside => Some("somebody who looks inside".to_owned()),
        GoalSender::Node(node) if by_its_own(node) => Some(format!("the servant's node {node}")),
        GoalSender::Node(_) => Some(format!("robot {}", handle.robot)),
        GoalSender::Unheard => None,
    }
}

fn to_api_goal(handle: &Handle, goal: observe::ObservedGoal) -> Goal {
    let by = describe_sender(handle, &goal.sender);
    let millis = |nanoseconds: u64| nanoseconds / 1_000_000;
    let ended = goal.ended.as_ref();
    Goal {
        action: goal.action,
        id: goal.id,
        by: by.unwrap_or_else(|| UNHEARD.to_owned()),
        began: millis(goal.began),
        ended: ended.map(|(time, _)| millis(*time)),
        state: ended.map_or(GoalState::Underway, |(_, outcome)| to_goal_state(outcome.status)),
        text: goal.ended.map(|(_, outcome)| outcome.text).unwrap_or_default(),
    }
}

fn to_goal_state(status: ActionlibStatus) -> GoalState {
    match status {
        ActionlibStatus::Preempted => GoalState::Preempted,
        ActionlibStatus::Succeeded => GoalState::Succeeded,
        ActionlibStatus::Aborted => GoalState::Aborted,
        ActionlibStatus::Rejected => GoalState::Rejected,
        ActionlibStatus::Recalled => GoalState::Recalled,
        _ => GoalState::Lost,
    }
}

/// Writes the outcomes of goals to the journal for as long as they are observed.
pub fn report_ended_goals(app: &Arc<App>, handle: &Handle, goals: &Arc<GoalMonitor>) {
    let Ok(handle) = app.choreographer.servant(&handle.id) else {
        return;
    };
    let mut ended = goals.subscribe_ended();
    let goals = Arc::downgrade(goals);
    let app = Arc::clone(app);
    // Not one of the sessions that the daemon waits for when it stops: it runs until then.
    tokio::spawn(async move {
        let telling = async {
            let mut before = 0;
            while ended.changed().await.is_ok() {
                tokio::time::sleep(SETTLES).await;
                let Some(all) = goals.upgrade().map(|goals| goals.ended_after(before)) else {
                    return;
                };
                let count = *ended.borrow_and_update();
                let (more, few) = take_latest(all, &mut before, count);
                let pause = PAUSE * u32::try_from(few.len()).unwrap_or(1);
                let last = few.len().saturating_sub(1);
                for (at, goal) in few.into_iter().enumerate() {
                    let more = if at == last { more } else { 0 };
                    journal_goal(&app, &handle, goal, more);
                }
                tokio::time::sleep(pause).await;
            }
        };
        tokio::select! {
            () = telling => {}
            () = app.ending.cancelled() => {}
        }
    });
}

/// Returns the last few of the goals that ended since number `before`, and the number of the others. `count` is the
/// number of ended goals, at least.
fn take_latest(mut all: Vec<observe::ObservedGoal>, before: &mut u64, count: u64) -> (u64, Vec<observe::ObservedGoal>) {
    let last = all.last().and_then(|goal| goal.ended.as_ref());
    let count = last.map_or(count, |(_, outcome)| outcome.number.max(count));
    let few = all.split_off(all.len().saturating_sub(MAX_SINGLE_REPORTS));
    let more = (count - *before).saturating_sub(few.len() as u64);
    *before = count;
    (more, few)
}

fn journal_goal(app: &App, handle: &Handle, goal: observe::ObservedGoal, more: u64) {
    let whose = match describe_sender(handle, &goal.sender) {
        Some(sender) => format!("the goal of {sender}"),
        None => "a goal of an unknown sender".to_owned(),
    };
    let goal = to_api_goal(handle, goal);
    let took = goal.ended.unwrap_or(goal.began).saturating_sub(goal.began);
    let took = match took {
        // Its start was not observed.
        0 => String::new(),
        took => format!(" after {:.1} s", took as f64 / 1e3),
    };
    let words = if goal.text.is_empty() { String::new() } else { format!(" ({})", goal.text) };
    let more = match more {
        0 => String::new(),
        more => format!("; {more} more have ended since the last report"),
    };
    let message = format!("{}: {whose} {}{took}{words}{more}", goal.action, goal.state);
    let about = NewEvent { service: Some(handle.service()), servant: Some(&handle.id), robot: Some(&handle.robot) };
    app.choreographer.journal().info(GOAL_ENDED, &message, &about);
}

#[cfg(test)]
mod tests {
    use access::Grant;
    use observe::ObservedOutcome;

    use super::*;

    fn goal(number: u64) -> observe::ObservedGoal {
        let outcome = ObservedOutcome { status: ActionlibStatus::Succeeded, text: String::new(), number };
        observe::ObservedGoal {
            action: "/dock".to_owned(),
            id: number.to_string(),
            sender: GoalSender::Unheard,
            began: 1,
            ended: Some((2, outcome)),
        }
    }

    #[test]
    fn each_goal_is_told_where_they_are_few() {
        let mut before = 2;
        let (more, told) = take_latest(vec![goal(3), goal(4)], &mut before, 4);
        assert_eq!((more, told, before), (0, vec![goal(3), goal(4)], 4));
        // Of many goals, the last few; some are not even remembered any more.
        let many = 20;
        let (more, told) = take_latest((10..=many).map(goal).collect(), &mut before, many);
        let last: Vec<_> = (16..=many).map(goal).collect();
        assert_eq!((more, told, before), (11, last, many));
        // One ended during the call.
        let (more, told) = take_latest(vec![goal(21)], &mut before, 20);
        assert_eq!((more, told, before), (0, vec![goal(21)], 21));
        assert_eq!(take_latest(Vec::new(), &mut before, 21), (0, Vec::new()));
    }

    #[test]
    fn goals_are_visible_to_senders_and_to_subscribers_of_both_ends() {
        let grants = |all: &[&str]| {
            let all = all.iter().map(|grant| grant.parse::<Grant>());
            Grants::new(all.map(|grant| grant.expect("a grant")))
        };
        assert!(can_see_goals(&grants(&["call:/dock"]), "/dock"));
        assert!(can_see_goals(&grants(&["subscribe:/dock/*"]), "/dock"));
        assert!(!can_see_goals(&grants(&["subscribe:/dock/result"]), "/dock"));
        assert!(!can_see_goals(&grants(&["subscribe:/map", "call:/other"]), "/dock"));
    }
}
