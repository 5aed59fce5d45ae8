//! The daemon and the user of a servant, as its reach sees them.

use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use ros::bus::FailureReason;

use crate::links::MeasuredRequest;

/// The daemon as seen from one servant's reach.
#[async_trait]
pub trait Observer: Send + Sync + 'static {
    /// Checks that a stub generated from this revision and image can use the servant; otherwise returns the reason.
    async fn check_stub(&self, made_of: Option<u64>, image: &str) -> Result<(), FailureReason>;
    /// Records an event about the servant and its robot for the operator.
    fn record_event(&self, level: api::Level, kind: &str, message: &str, robot: Option<&str>);
    /// Records that from `at` on a node of the robot is served by its local original, with the reason; `None`: by the
    /// cloud again.
    fn on_served_locally(&self, robot: &str, node: &str, at: SystemTime, why: Option<&str>);
    /// Records an update about a request of the robot; an answered one has its response time and phases.
    fn on_request_measured(&self, robot: Option<&str>, request: &MeasuredRequest<'_>);
    /// Records a request of a rosbridge client with the time from the bridge to the servant and back; `None` if it
    /// failed.
    fn on_rosbridge_request(&self, _took: Option<Duration>) {}
}

/// The user of a servant. A warm container has none.
#[async_trait]
pub trait Tenant: Send + Sync + 'static {
    /// Returns the name of the robot.
    fn robot(&self) -> &str;
    /// Hands the control of nodes to the robot's stubs; returns whether the revision's own nodes were running before.
    async fn take_over(&self) -> bool;
}
