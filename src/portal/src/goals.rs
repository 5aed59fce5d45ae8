//! `GET /api/v1/servants/ID/goals`: what became of the goals of a servant's actions.

use std::sync::Arc;
use std::time::Duration;

use access::{Grants, Operation};
use api::goals::{Goal, GoalState};
use axum::extract::{Path, State};
use axum::{Extension, Json};
use choreographer::Handle;
use observe::{Goals, Sender};
use ros::ros1::actions::messages::Status;
use store::NewEvent;

use crate::api_v1::Answer;
use crate::app::App;
use crate::guard::Caller;
use crate::inside::{self, Whose};

/// Event: a goal has ended.
const GOAL_ENDED: &str = "goal-ended";
/// In place of who sent it.
const UNHEARD: &str = "who sent it was not heard";
/// Between two such events of a servant on average; those that are too many are counted.
const PAUSE: Duration = Duration::from_secs(1);
/// So many that end at once are told each.
const FEW: usize = 5;
/// A goal and its result come over two connections: so long the goal may come after it.
const SETTLES: Duration = Duration::from_millis(200);

/// Goals that were sent to the servant and that the caller may hear of, the newest first.
pub async fn goals(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
) -> Answer<Vec<Goal>> {
    let handle = app.choreographer.servant(&id)?;
    let whose = Whose {
        service: handle.service(),
        robot: &handle.robot,
        object: format_args!("servant {id}"),
    };
    let grants = inside::grants(&app, &caller, whose)?;
    let goals = app.observers.goals(&id);
    let mut all = goals.map(|goals| goals.all()).unwrap_or_default();
    all.retain(|goal| may_hear(&grants, &goal.action));
    let told = all.into_iter().map(|goal| told(&handle, goal));
    Ok(Json(told.collect()))
}

/// Whether somebody may be told of the goals of an action: who may send some, and who may hear them and their results.
fn may_hear(grants: &Grants, action: &str) -> bool {
    let hears = |end: &str| grants.permits(Operation::Subscribe, &format!("{action}/{end}"));
    grants.permits(Operation::Call, action) || (hears("goal") && hears("result"))
}

/// Who sent a goal, in words; none where nobody has heard.
fn sender(handle: &Handle, sender: &Sender) -> Option<String> {
    let by_its_own = |node: &String| {
        let interface = &handle.revision.interface;
        let nodes = handle.revision.plan.nodes.iter();
        interface.actions.iter().any(|action| action.node == *node)
            || nodes.map(|planned| &planned.name).any(|name| name == node)
    };
    match sender {
        Sender::Inside => Some("somebody who looks inside".to_owned()),
        Sender::Node(node) if by_its_own(node) => Some(format!("the servant's node {node}")),
        Sender::Node(_) => Some(format!("robot {}", handle.robot)),
        Sender::Unheard => None,
    }
}

fn told(handle: &Handle, goal: observe::Goal) -> Goal {
    let by = sender(handle, &goal.sender);
    let millis = |nanoseconds: u64| nanoseconds / 1_000_000;
    let ended = goal.ended.as_ref();
    Goal {
        action: goal.action,
        id: goal.id,
        by: by.unwrap_or_else(|| UNHEARD.to_owned()),
        began: millis(goal.began),
        ended: ended.map(|(time, _)| millis(*time)),
        state: ended.map_or(GoalState::Underway, |(_, outcome)| state(outcome.status)),
        text: goal
            .ended
            .map(|(_, outcome)| outcome.text)
            .unwrap_or_default(),
    }
}

fn state(status: Status) -> GoalState {
    match status {
        Status::Preempted => GoalState::Preempted,
        Status::Succeeded => GoalState::Succeeded,
        Status::Aborted => GoalState::Aborted,
        Status::Rejected => GoalState::Rejected,
        Status::Recalled => GoalState::Recalled,
        _ => GoalState::Lost,
    }
}

/// Has the journal say what becomes of goals, as long as they are heard.
pub fn tell(app: &Arc<App>, handle: &Handle, goals: &Arc<Goals>) {
    let Ok(handle) = app.choreographer.servant(&handle.id) else {
        return;
    };
    let mut ended = goals.ended();
    let goals = Arc::downgrade(goals);
    let app = Arc::clone(app);
    // None of the sessions that the daemon waits for when it ends: it goes on until then.
    tokio::spawn(async move {
        let telling = async {
            let mut before = 0;
            while ended.changed().await.is_ok() {
                tokio::time::sleep(SETTLES).await;
                let Some(all) = goals.upgrade().map(|goals| goals.ended_after(before)) else {
                    return;
                };
                let count = *ended.borrow_and_update();
                let (more, few) = few(all, &mut before, count);
                let pause = PAUSE * u32::try_from(few.len()).unwrap_or(1);
                let last = few.len().saturating_sub(1);
                for (at, goal) in few.into_iter().enumerate() {
                    let more = if at == last { more } else { 0 };
                    journal(&app, &handle, goal, more);
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

/// Of those that have ended since so many had, the last few; and how many others have. `count`: so many had when it was looked, at least.
fn few(mut all: Vec<observe::Goal>, before: &mut u64, count: u64) -> (u64, Vec<observe::Goal>) {
    let last = all.last().and_then(|goal| goal.ended.as_ref());
    let count = last.map_or(count, |(_, outcome)| outcome.number.max(count));
    let few = all.split_off(all.len().saturating_sub(FEW));
    let more = (count - *before).saturating_sub(few.len() as u64);
    *before = count;
    (more, few)
}

fn journal(app: &App, handle: &Handle, goal: observe::Goal, more: u64) {
    let whose = match sender(handle, &goal.sender) {
        Some(sender) => format!("the goal of {sender}"),
        None => "a goal whose sender was not heard".to_owned(),
    };
    let goal = told(handle, goal);
    let took = goal.ended.unwrap_or(goal.began).saturating_sub(goal.began);
    let took = match took {
        // It was not heard when it began.
        0 => String::new(),
        took => format!(" after {:.1} s", took as f64 / 1e3),
    };
    let words = match goal.text.is_empty() {
        true => String::new(),
        false => format!(" ({})", goal.text),
    };
    let more = match more {
        0 => String::new(),
        more => format!("; {more} more have ended since the last that was told"),
    };
    let message = format!("{}: {whose} {}{took}{words}{more}", goal.action, goal.state);
    let about = NewEvent {
        service: Some(handle.service()),
        servant: Some(&handle.id),
        robot: Some(&handle.robot),
    };
    app.choreographer
        .journal()
        .info(GOAL_ENDED, &message, &about);
}

#[cfg(test)]
mod tests {
    use access::Grant;
    use observe::Outcome;

    use super::*;

    fn goal(number: u64) -> observe::Goal {
        let outcome = Outcome {
            status: Status::Succeeded,
            text: String::new(),
            number,
        };
        observe::Goal {
            action: "/dock".to_owned(),
            id: number.to_string(),
            sender: Sender::Unheard,
            began: 1,
            ended: Some((2, outcome)),
        }
    }

    #[test]
    fn each_goal_is_told_where_they_are_few() {
        let mut before = 2;
        let (more, told) = few(vec![goal(3), goal(4)], &mut before, 4);
        assert_eq!((more, told, before), (0, vec![goal(3), goal(4)], 4));
        // Of many the last; some of them are not even remembered.
        let many = 20;
        let (more, told) = few((10..=many).map(goal).collect(), &mut before, many);
        let last: Vec<_> = (16..=many).map(goal).collect();
        assert_eq!((more, told, before), (11, last, many));
        // One has ended while it was looked.
        let (more, told) = few(vec![goal(21)], &mut before, 20);
        assert_eq!((more, told, before), (0, vec![goal(21)], 21));
        assert_eq!(few(Vec::new(), &mut before, 21), (0, Vec::new()));
    }

    #[test]
    fn of_goals_hears_who_may_send_them_or_hear_both_ends() {
        let grants = |all: &[&str]| {
            let all = all.iter().map(|grant| grant.parse::<Grant>());
            Grants::new(all.map(|grant| grant.expect("a grant")))
        };
        assert!(may_hear(&grants(&["call:/dock"]), "/dock"));
        assert!(may_hear(&grants(&["subscribe:/dock/*"]), "/dock"));
        assert!(!may_hear(&grants(&["subscribe:/dock/result"]), "/dock"));
        assert!(!may_hear(
            &grants(&["subscribe:/map", "call:/other"]),
            "/dock"
        ));
    }
}
