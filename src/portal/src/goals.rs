//! `GET /api/v1/servants/ID/goals`: what became of the goals of a servant's actions.

use std::sync::Arc;
use std::time::Duration;

use api::goals::{Goal, GoalState};
use axum::Json;
use axum::extract::{Path, State};
use choreographer::Handle;
use observe::Goals;
use ros::ros1::actions::messages::Status;
use store::NewEvent;

use crate::api_v1::Answer;
use crate::app::App;

/// Event: a goal has ended.
const GOAL_ENDED: &str = "goal-ended";
/// Between two such events of a servant; those in between are counted.
const PAUSE: Duration = Duration::from_secs(1);

/// Goals that were sent to the servant, the newest first.
pub async fn goals(State(app): State<Arc<App>>, Path(id): Path<String>) -> Answer<Vec<Goal>> {
    let handle = app.choreographer.servant(&id)?;
    let goals = app.observers.goals(&id);
    let all = goals.map(|goals| goals.all()).unwrap_or_default();
    let told = all.into_iter().map(|goal| told(&handle, goal));
    Ok(Json(told.collect()))
}

fn told(handle: &Handle, goal: observe::Goal) -> Goal {
    let by_its_own = |node: &String| {
        let interface = &handle.revision.interface;
        let nodes = handle.revision.plan.nodes.iter();
        interface.actions.iter().any(|action| action.node == *node)
            || nodes.map(|planned| &planned.name).any(|name| name == node)
    };
    let by = match &goal.client {
        None => "somebody who looks inside".to_owned(),
        Some(node) if by_its_own(node) => format!("the servant's node {node}"),
        Some(_) => format!("robot {}", handle.robot),
    };
    let millis = |nanoseconds: u64| nanoseconds / 1_000_000;
    let ended = goal.ended.as_ref();
    Goal {
        action: goal.action,
        id: goal.id,
        by,
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
    app.sessions.clone().spawn(async move {
        let mut before = 0;
        while tokio::select! {
            changed = ended.changed() => changed.is_ok(),
            () = app.ending.cancelled() => false,
        } {
            let Some(goals) = goals.upgrade() else { return };
            let count = *ended.borrow_and_update();
            let all = goals.all();
            drop(goals);
            let last = all
                .into_iter()
                .filter(|goal| goal.ended.is_some())
                .max_by_key(|goal| goal.ended.as_ref().map(|(time, _)| *time));
            if let Some(last) = last {
                let more = (count - before).saturating_sub(1);
                journal(&app, &handle, &told(&handle, last), more);
            }
            before = count;
            tokio::time::sleep(PAUSE).await;
        }
    });
}

fn journal(app: &App, handle: &Handle, goal: &Goal, more: u64) {
    let took = goal.ended.unwrap_or(goal.began).saturating_sub(goal.began);
    let words = match goal.text.is_empty() {
        true => String::new(),
        false => format!(" ({})", goal.text),
    };
    let more = match more {
        0 => String::new(),
        more => format!("; {more} more have ended since the last that was told"),
    };
    let message = format!(
        "{}: the goal of {} {} after {:.1} s{words}{more}",
        goal.action,
        goal.by,
        goal.state,
        took as f64 / 1e3
    );
    let about = NewEvent {
        service: Some(handle.service()),
        servant: Some(&handle.id),
        robot: Some(&handle.robot),
    };
    app.choreographer
        .journal()
        .info(GOAL_ENDED, &message, &about);
}
