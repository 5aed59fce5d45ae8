//! Events of a build on their way to its push. While the build waits for another push, they tell what that one does.

use std::time::Duration;

use api::{PushEvent, PushStatus};
use rootfs_builder::BuildEvent;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::reporter::Reporter;
use super::{Deployer, Pusher, deployer_text};

/// Interval at which the state of an awaited push is read.
const LOOK_EVERY: Duration = Duration::from_secs(1);

impl Pusher {
    /// Forwards the events of a build until it has ended.
    pub(super) async fn forward_events(
        &self,
        mut events: mpsc::Receiver<BuildEvent>,
        by: &Deployer,
        report: &Reporter,
    ) {
        let mut awaited: Option<AwaitedPush> = None;
        let mut step = "preparing the build".to_owned();
        let mut looks = tokio::time::interval(LOOK_EVERY);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let event = tokio::select! {
                event = events.recv() => event,
                _ = looks.tick(), if awaited.is_some() => {
                    if let Some(awaited) = &mut awaited {
                        let status = self.registry.find_build(&awaited.build).map(|push| push.status());
                        awaited.report(status.as_ref(), report).await;
                    }
                    continue;
                }
            };
            match event {
                None => return,
                Some(BuildEvent::Waits { id, push }) => {
                    let status = self.registry.find_build(&id).map(|push| push.status());
                    // Services of others are named only if the deployer may publish them.
                    let name = by.check_may_publish(&push).is_ok().then_some(push);
                    let mut new = AwaitedPush { build: id, name, said: None };
                    new.report(status.as_ref(), report).await;
                    awaited = Some(new);
                }
                // It goes on with what it did before.
                Some(BuildEvent::Continues) => {
                    if awaited.take().is_some() {
                        report.step(&step).await;
                    }
                }
                Some(event) => {
                    if let BuildEvent::Step { title } = &event {
                        awaited = None;
                        step.clone_from(title);
                    }
                    if let Some(event) = deployer_text::to_push_event(event) {
                        report.event(event).await;
                    }
                }
            }
        }
    }
}

/// A push for which another one waits.
struct AwaitedPush {
    /// Id of its build.
    build: String,
    /// Name of its service, if the waiting deployer may know it.
    name: Option<String>,
    /// Title that was reported last.
    said: Option<String>,
}

impl AwaitedPush {
    /// Reports what the push does, if that has changed. Of one that the deployer may not know, nothing is told.
    async fn report(&mut self, status: Option<&PushStatus>, report: &Reporter) {
        let status = status.filter(|_| self.name.is_some());
        let title = self.title(status.map_or("", |status| status.step.as_str()));
        if self.said.as_ref() != Some(&title) {
            report.step(&title).await;
            self.said = Some(title);
        }
        if let Some(count) = status.and_then(|status| status.progress.clone()) {
            report.event(PushEvent::Progress { unit: count.unit, done: count.done, total: count.total }).await;
        }
    }

    fn title(&self, step: &str) -> String {
        let whose = match &self.name {
            Some(name) => format!("the push of {name}"),
            None => "another push".to_owned(),
        };
        let told = format!("waiting: {whose} makes something that this one needs, too");
        if step.is_empty() { told } else { format!("{told}; it is at: {step}") }
    }
}

#[cfg(test)]
mod tests {
    use api::{PushCount, PushState};

    use super::*;

    fn status(step: &str, done: u64) -> PushStatus {
        PushStatus {
            number: 1,
            service: Some("lab_maps".into()),
            source: String::new(),
            by: "ada".into(),
            state: PushState::Running,
            began: 0,
            ended: None,
            step: step.into(),
            step_began: None,
            last_took: None,
            progress: Some(PushCount { unit: "packages".into(), done, total: Some(9) }),
            message: None,
            can_read: false,
            can_cancel: false,
        }
    }

    #[tokio::test]
    async fn whoever_waits_is_told_for_whom_and_what_that_one_does() {
        let (sender, mut told) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let mut awaited = AwaitedPush { build: "push-1".into(), name: Some("lab_maps".into()), said: None };
        let count = |done| PushEvent::Progress { unit: "packages".into(), done, total: Some(9) };
        let words = "waiting: the push of lab_maps makes something that this one needs, too; it is at: ";
        awaited.report(Some(&status("downloading", 1)), &report).await;
        assert_eq!(told.recv().await, Some(PushEvent::step(format!("{words}downloading"))));
        assert_eq!(told.recv().await, Some(count(1)));
        awaited.report(Some(&status("downloading", 2)), &report).await;
        assert_eq!(told.recv().await, Some(count(2)), "the step has not changed");
        awaited.report(Some(&status("installing", 0)), &report).await;
        assert_eq!(told.recv().await, Some(PushEvent::step(format!("{words}installing"))));
    }

    #[tokio::test]
    async fn a_push_of_others_is_not_described() {
        let (sender, mut told) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let mut awaited = AwaitedPush { build: "push-1".into(), name: None, said: None };
        awaited.report(Some(&status("compiling secret", 1)), &report).await;
        let expected = "waiting: another push makes something that this one needs, too";
        assert_eq!(told.recv().await, Some(PushEvent::step(expected)));
        assert!(told.try_recv().is_err());
    }
}
