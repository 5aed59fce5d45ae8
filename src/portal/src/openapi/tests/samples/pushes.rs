//! Samples of pushes.

use api::{PushCount, PushState, PushStatus};
use serde_json::Value;

use super::{sample, some_text};

/// Returns samples of every type, with and without optional fields.
pub fn samples() -> Vec<(&'static str, Value)> {
    let running = PushStatus {
        number: 1,
        service: some_text("opencv_apps"),
        source: "--apt opencv_apps".into(),
        by: "ada".into(),
        state: PushState::Running,
        began: 1,
        ended: None,
        step: "receiving the package".into(),
        step_began: Some(2),
        last_took: Some(3),
        progress: Some(PushCount { unit: "bytes".into(), done: 1, total: Some(2) }),
        message: None,
        can_read: true,
        can_cancel: true,
    };
    let uncounted = PushCount { unit: "bytes".into(), done: 1, total: None };
    let failed = PushStatus {
        service: None,
        state: PushState::Failed,
        ended: Some(4),
        step_began: None,
        last_took: None,
        progress: None,
        message: some_text("it broke"),
        can_cancel: false,
        ..running.clone()
    };
    let published = PushStatus { state: PushState::Published, message: None, ..failed.clone() };
    let cancelled = PushStatus { state: PushState::Cancelled, ..published.clone() };
    let waiting = PushStatus { progress: Some(uncounted), ..running.clone() };
    [running, waiting, failed, published, cancelled].map(|one| sample("PushStatus", one)).into()
}
