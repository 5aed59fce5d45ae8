//! Messages that were dropped on the robot's side: in its log, and told to the cloud for whoever explains.

use std::sync::{Arc, Weak};
use std::time::Duration;

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

/// Until the mirror is gone.
pub async fn report(mirror: Weak<Mirror>) {
    let mut reporter = Reporter::default();
    let mut told = (Weak::new(), Vec::new());
    loop {
        tokio::time::sleep(PERIOD).await;
        let Some(mirror) = mirror.upgrade() else {
            return;
        };
        let all = mirror.dropped();
        for drop in reporter.news(&all) {
            if drop.cause.is_meant() {
                tracing::info!("{drop}");
            } else {
                tracing::warn!("{drop}");
            }
        }
        let session = mirror.session();
        // Another session's cloud was told nothing yet.
        let other = !std::ptr::eq(Weak::as_ptr(&told.0), Arc::as_ptr(&session));
        if !all.is_empty() && (other || told.1 != all) {
            session.report(&FromRobot::Dropped(all.clone()));
            told = (Arc::downgrade(&session), all);
        }
    }
}
