//! Reaching what runs in a container: what is recorded of its revision, and what it tells of itself.

use std::sync::Arc;
use std::time::SystemTime;

use api::Level;
use bridge::{BridgeOptions, Called};
use catalogue::{Catalogue, Known};
use link::control::Request;
use reach::links::RequestNews;
use reach::{Observer, Reach, ReachOptions, Recorded, RequestTimes};
use servant::engine::Servant;
use store::{Journal, NewEvent, RevisionRecord};
use tokio::time::Instant;

use super::Inner;
use super::recent::Recent;
use super::rollouts::Rollouts;
use crate::decide::requests::asked_by_topic;

/// Connects to the ROS of a container that was started from `revision`.
pub(crate) async fn open(
    inner: &Inner,
    revision: &Arc<RevisionRecord>,
    container: &Arc<dyn Servant>,
) -> Result<Arc<dyn Reach>, reach::Error> {
    let (options, observer) = habits(inner, revision, container.id());
    let recorded = Box::pin(async {
        let known = inner.catalogue.known(revision).await;
        // What runs is to be reached all the same.
        let known = known.unwrap_or_else(|error| {
            tracing::warn!(
                "what the image of {} holds is not known: {error}",
                revision.service
            );
            Known::default()
        });
        recorded(revision, known)
    });
    let opener = &inner.opener;
    opener.open(container, recorded, options, observer).await
}

/// How a servant, or a robot's place in a group, is reached, and who hears of what it and its robot tell.
pub(crate) fn habits(
    inner: &Inner,
    revision: &Arc<RevisionRecord>,
    id: &str,
) -> (ReachOptions, Arc<dyn Observer>) {
    let memory = &inner.memory;
    let measures = Measures::of(inner, revision, id);
    let options = ReachOptions {
        ros: revision.flavour.ros.bus(),
        distribution: revision.flavour.distribution.clone(),
        bridge: BridgeOptions {
            called: measures.called(),
            pair: asked_by_topic(revision.flavour.ros.bus(), &revision.interface),
            ..inner.options.bridge.clone()
        },
        grace: inner.options.grace,
        budget: memory.servant(id),
        unfinished: memory.unfinished,
    };
    let reports = Reports {
        id: id.to_owned(),
        revision: Arc::clone(revision),
        catalogue: Arc::clone(&inner.catalogue),
        journal: inner.journal.clone(),
        measures,
    };
    (options, Arc::new(reports))
}

/// Where the times of requests to one servant are noted: for the controller, rollouts, and whoever looks.
pub(crate) struct Measures {
    servant: String,
    revision: Arc<RevisionRecord>,
    request_times: Arc<RequestTimes>,
    recent: Arc<Recent>,
    rollouts: Arc<Rollouts>,
}

impl Measures {
    pub(crate) fn of(inner: &Inner, revision: &Arc<RevisionRecord>, servant: &str) -> Arc<Self> {
        Arc::new(Measures {
            servant: servant.to_owned(),
            revision: Arc::clone(revision),
            request_times: Arc::clone(&inner.request_times),
            recent: Arc::clone(&inner.recent),
            rollouts: Arc::clone(&inner.rollouts),
        })
    }

    /// This has become known of a request, which took so many milliseconds in the cloud.
    fn note(&self, request: &Request, cloud: f64, news: RequestNews) {
        let service = &self.revision.service;
        self.request_times.note(service, request);
        if let Some(total) = request.total {
            let now = Instant::now().into_std();
            self.recent.note(&self.servant, total, cloud, now);
        }
        let (rollouts, revision) = (&self.rollouts, self.revision.number);
        match (news, request.total) {
            (RequestNews::Late, _) | (_, None) => rollouts.note_request(service, revision, None),
            (RequestNews::Answered, total) => rollouts.note_request(service, revision, total),
            (RequestNews::AnsweredLate, Some(total)) => {
                rollouts.note_late_answer(service, revision, total);
            }
        }
    }

    /// Hears of the requests of rosbridge's clients. The time between them and the bridge is not known: what is measured is a
    /// little less than what robots see, and all of it is the cloud's.
    pub(crate) fn called(self: &Arc<Self>) -> Called {
        let measures = Arc::clone(self);
        Called::by(move |took| {
            let total = took.map(|took| took.as_secs_f64() * 1e3);
            let request = Request {
                total,
                ..Request::default()
            };
            let cloud = total.unwrap_or_default();
            measures.note(&request, cloud, RequestNews::Answered);
        })
    }
}

/// What is recorded of a revision, and found in its image.
pub(crate) fn recorded(revision: &RevisionRecord, known: Known) -> Recorded {
    let Known {
        inventory,
        registry,
    } = known;
    let plan = &revision.plan;
    Recorded {
        service: revision.service.clone(),
        package: revision.package.clone(),
        flavour: revision.flavour.clone(),
        environment: plan.environment.clone(),
        nodes: plan.nodes.clone(),
        parameters: plan.parameters.clone(),
        components: plan.components.clone(),
        inventory,
        registry,
        egress: plan.grants.egress.clone(),
    }
}

/// Who hears of what a servant and its robot tell.
struct Reports {
    id: String,
    revision: Arc<RevisionRecord>,
    catalogue: Arc<Catalogue>,
    journal: Journal,
    measures: Arc<Measures>,
}

impl Observer for Reports {
    fn fits(&self, made_of: Option<u64>, image: &str) -> Result<(), String> {
        self.catalogue.fits(&self.revision, made_of, image)
    }

    fn event(&self, level: Level, kind: &str, message: &str, robot: Option<&str>) {
        let about = NewEvent {
            service: Some(&self.revision.service),
            servant: Some(&self.id),
            robot,
        };
        match level {
            Level::Info => self.journal.info(kind, message, &about),
            Level::Warning => self.journal.warning(kind, message, &about),
            Level::Error => self.journal.error(kind, message, &about),
        }
    }

    fn served_locally(&self, robot: &str, node: &str, at: SystemTime, why: Option<&str>) {
        let service = &self.revision.service;
        self.journal.local((service, robot, node), at, why);
    }

    fn measured(&self, request: &Request, news: RequestNews) {
        let cloud = request.queue + request.compute;
        self.measures.note(request, cloud, news);
    }
}
