//! Reports messages dropped on the robot's side, in its log and to the cloud, for `cloudroidctl explain`.

use std::sync::{Arc, Weak};
use std::time::Duration;

use link::RobotSession;
use link::control::FromRobot;
use link::drops::{DropReporter, TopicDropCount};

use super::state::Mirror;

/// Interval between reports.
const PERIOD: Duration = Duration::from_secs(2);

impl Mirror {
    fn collect_drops(&self) -> Vec<TopicDropCount> {
        let mut all = self.drops.snapshot();
        for drop in self.session().drops() {
            let same = |known: &&mut TopicDropCount| known.topic == drop.topic && known.cause == drop.cause;
            match all.iter_mut().find(same) {
                Some(known) => known.count += drop.count,
                None => all.push(drop),
            }
        }
        all
    }
}

/// The last report, and the session that it was sent on.
#[derive(Default)]
pub(super) struct DropReports {
    reporter: DropReporter,
    session: Weak<RobotSession>,
    all: Vec<TopicDropCount>,
}

impl DropReports {
    /// Reports changes. The cloud receives the sums. While the link is down nothing is sent, because each report would
    /// be queued.
    pub(super) fn report(&mut self, mirror: &Mirror) {
        let all = mirror.collect_drops();
        for drop in self.reporter.take_new(&all) {
            if drop.cause.is_intended() {
                tracing::info!("{drop}");
            } else {
                tracing::warn!("{drop}");
            }
        }
        let session = mirror.session();
        // The cloud of another session has received no report yet.
        let other = !std::ptr::eq(self.session.as_ptr(), Arc::as_ptr(&session));
        if session.is_up() && !all.is_empty() && (other || self.all != all) {
            session.send_control(&FromRobot::Dropped(all.clone()));
            self.session = Arc::downgrade(&session);
            self.all = all;
        }
    }
}

/// Reports dropped messages until the mirror is gone.
pub async fn report_loop(mirror: Weak<Mirror>) {
    let mut told = DropReports::default();
    loop {
        tokio::time::sleep(PERIOD).await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        told.report(&mirror);
    }
}
