//! Types that only a node itself can tell (ROS 1), asked for beside each other: one that hangs keeps nothing else waiting, and one that
//! could not tell is asked again.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{Bus, BusError, ServiceType, WireType};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::timeout;

use super::retry::Retry;

/// For one answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// For answers that come before the rest is told: nodes answer in a moment, and what they have is told at once then.
const PROMPT: Duration = Duration::from_millis(250);

/// Whose type is asked for.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Subject {
    Service(String),
    Topic(String),
}

enum Told {
    Service(ServiceType),
    Topic(WireType),
}

/// What was asked and told so far.
#[derive(Default)]
pub(super) struct Inquiries {
    asking: JoinSet<(Subject, Told)>,
    asked: BTreeMap<Subject, AbortHandle>,
    told: BTreeMap<Subject, Told>,
}

impl Inquiries {
    /// The type of a service, once that is known. It is asked for unless it was before.
    pub(super) fn service(&mut self, bus: &Arc<dyn Bus>, name: &str) -> Option<ServiceType> {
        match self.find(bus, Subject::Service(name.to_owned()))? {
            Told::Service(of) => Some(of.clone()),
            Told::Topic(_) => None,
        }
    }

    /// The type of a topic, in the same way.
    pub(super) fn topic(&mut self, bus: &Arc<dyn Bus>, name: &str) -> Option<WireType> {
        match self.find(bus, Subject::Topic(name.to_owned()))? {
            Told::Topic(of) => Some(of.clone()),
            Told::Service(_) => None,
        }
    }

    fn find(&mut self, bus: &Arc<dyn Bus>, subject: Subject) -> Option<&Told> {
        if !self.asked.contains_key(&subject) {
            let asked = ask(Arc::clone(bus), subject.clone());
            let task = self.asking.spawn(asked);
            self.asked.insert(subject.clone(), task);
        }
        self.told.get(&subject)
    }

    /// How many types are asked for, or were.
    pub(super) fn count(&self) -> usize {
        self.asked.len()
    }

    /// Forgets what is not about these services and topics, which are there no more.
    pub(super) fn retain(&mut self, services: &BTreeSet<&String>, topics: &BTreeSet<&String>) {
        let is_there = |subject: &Subject| match subject {
            Subject::Service(name) => services.contains(name),
            Subject::Topic(name) => topics.contains(name),
        };
        self.told.retain(|subject, _| is_there(subject));
        self.asked.retain(|subject, task| {
            let stays = is_there(subject);
            if !stays {
                task.abort();
            }
            stays
        });
    }

    /// Returns with the next answer that counts; while nothing is asked for there is none.
    pub(super) async fn next(&mut self) {
        loop {
            match self.asking.join_next().await {
                Some(Ok((subject, told))) => {
                    // One that is gone may have told before it was.
                    if self.asked.contains_key(&subject) {
                        self.told.insert(subject, told);
                        return;
                    }
                }
                Some(Err(_)) => {}
                None => std::future::pending().await,
            }
        }
    }

    /// Returns when all has been told that was asked for, or had a moment to be.
    pub(super) async fn settle(&mut self) {
        let all = async {
            while self.told.len() < self.asked.len() {
                self.next().await;
            }
        };
        let _ = timeout(PROMPT, all).await;
    }
}

/// Asks until there is an answer.
async fn ask(bus: Arc<dyn Bus>, subject: Subject) -> (Subject, Told) {
    let mut retry = Retry::default();
    loop {
        let told = async {
            Ok::<_, BusError>(match &subject {
                Subject::Service(name) => Told::Service(bus.service_type(name).await?),
                Subject::Topic(name) => Told::Topic(bus.topic_type(name).await?),
            })
        };
        match timeout(PATIENCE, told).await {
            Ok(Ok(told)) => return (subject, told),
            Ok(Err(error)) => tracing::debug!(?subject, %error, "its type is asked for again"),
            Err(_) => tracing::debug!(?subject, "nobody tells its type; it is asked for again"),
        }
        retry.pause().await;
    }
}
