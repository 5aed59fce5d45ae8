//! Messages that were dropped on the robot's side: in its log, and told to the cloud for whoever explains.

use std::sync::{Arc, Weak};
use std::time::Duration;

use link::RobotSession;
use link::control::FromRobot;
use link::drops::{Drop, Reporter};

use super::Mirror;

/// Between two looks.
const PERIOD: Duration = Duration::from_secs(2);

impl Mirror {
    fn dropped(&self) -> Vec<Drop> {
        let mut all = self.drops.all();
        for drop in self.session().drops() {
            let same = |known: &&mut Drop| known.topic == drop.topic && known.cause == drop.cause;
            match all.iter_mut().find(same) {
                Some(known) => known.count += drop.count,
                None => all.push(drop),
            }
        }
        all
    }
}

/// What was told so far, and to whom.
#[derive(Default)]
pub(super) struct Told {
    reporter: Reporter,
    session: Weak<RobotSession>,
    all: Vec<Drop>,
}

impl Told {
    /// Tells what has changed. The cloud is told the sums, and while the link is away nothing: each look would put a record down for it.
    pub(super) fn report(&mut self, mirror: &Mirror) {
        let all = mirror.dropped();
        for drop in self.reporter.news(&all) {
            if drop.cause.is_meant() {
                tracing::info!("{drop}");
            } else {
                tracing::warn!("{drop}");
            }
        }
        let session = mirror.session();
        // Another session's cloud was told nothing yet.
        let other = !std::ptr::eq(self.session.as_ptr(), Arc::as_ptr(&session));
        if session.is_up() && !all.is_empty() && (other || self.all != all) {
            session.report(&FromRobot::Dropped(all.clone()));
            self.session = Arc::downgrade(&session);
            self.all = all;
        }
    }
}

/// Until the mirror is gone.
pub async fn report(mirror: Weak<Mirror>) {
    let mut told = Told::default();
    loop {
        tokio::time::sleep(PERIOD).await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        told.report(&mirror);
    }
}
