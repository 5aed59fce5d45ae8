//! The failures that robots' pauses follow from.

use std::collections::HashMap;

use parking_lot::Mutex;

use crate::decide::back_off::FailureStreak;

/// Failures by service and robot.
#[derive(Default)]
pub(crate) struct BackOffs {
    pub(super) failing: Mutex<HashMap<(String, String), FailureStreak>>,
}
