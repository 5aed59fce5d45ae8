//! Concurrent queries for what only a node itself knows (ROS 1): one that hangs does not delay the others, and failed
//! ones are retried.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use tokio::task::{AbortHandle, JoinSet};
use tokio::time::timeout;

use crate::{Bus, BusError, Offer, Retry, ServiceType};

/// Timeout of one query.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time to wait for answers before the rest is announced: nodes usually answer immediately, and then everything is
/// announced at once.
const PROMPT: Duration = Duration::from_millis(250);

/// Subject of a query.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Subject {
    Service(String),
    Topic(String),
}

enum TypeAnswer {
    Service(ServiceType),
    Topic(Offer),
}

/// Pending and answered queries for types of topics and services.
#[derive(Default)]
pub struct TypeInquiries {
    asking: JoinSet<(Subject, TypeAnswer)>,
    asked: BTreeMap<Subject, AbortHandle>,
    told: BTreeMap<Subject, TypeAnswer>,
}

impl TypeInquiries {
    /// Returns the type of a service if it is known; otherwise it is queried.
    pub fn service(&mut self, bus: &Arc<dyn Bus>, name: &str) -> Option<ServiceType> {
        match self.find(bus, Subject::Service(name.to_owned()))? {
            TypeAnswer::Service(of) => Some(of.clone()),
            TypeAnswer::Topic(_) => None,
        }
    }

    /// Returns what the publisher of a topic offers if it is known; otherwise it is queried.
    pub fn topic(&mut self, bus: &Arc<dyn Bus>, name: &str) -> Option<Offer> {
        match self.find(bus, Subject::Topic(name.to_owned()))? {
            TypeAnswer::Topic(of) => Some(of.clone()),
            TypeAnswer::Service(_) => None,
        }
    }

    fn find(&mut self, bus: &Arc<dyn Bus>, subject: Subject) -> Option<&TypeAnswer> {
        if !self.asked.contains_key(&subject) {
            let asked = inquire(Arc::clone(bus), subject.clone());
            let task = self.asking.spawn(asked);
            self.asked.insert(subject.clone(), task);
        }
        self.told.get(&subject)
    }

    /// Returns the number of pending and answered queries.
    pub fn count(&self) -> usize {
        self.asked.len()
    }

    /// Forgets queries about services and topics that are gone.
    pub fn retain(&mut self, services: &BTreeSet<&String>, topics: &BTreeSet<&String>) {
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

    /// Waits for the next relevant answer; forever if nothing is pending.
    pub async fn next(&mut self) {
        loop {
            match self.asking.join_next().await {
                Some(Ok((subject, told))) => {
                    // A subject that is gone may have answered before.
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

    /// Waits for all pending answers, but only for a moment.
    pub async fn settle(&mut self) {
        let all = async {
            while self.told.len() < self.asked.len() {
                self.next().await;
            }
        };
        let _ = timeout(PROMPT, all).await;
    }
}

/// Queries until there is an answer.
async fn inquire(bus: Arc<dyn Bus>, subject: Subject) -> (Subject, TypeAnswer) {
    let mut retry = Retry::default();
    loop {
        let told = async {
            Ok::<_, BusError>(match &subject {
                Subject::Service(name) => TypeAnswer::Service(bus.service_type(name).await?),
                Subject::Topic(name) => TypeAnswer::Topic(bus.topic_offer(name).await?),
            })
        };
        match timeout(PATIENCE, told).await {
            Ok(Ok(told)) => return (subject, told),
            Ok(Err(error)) => tracing::debug!(?subject, %error, "asking for its type again"),
            Err(_) => tracing::debug!(?subject, "no node reports its type; asking again"),
        }
        retry.pause().await;
    }
}
