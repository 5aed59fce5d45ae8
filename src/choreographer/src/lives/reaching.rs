//! Connects to the ROS in containers, and records what servants and robots report.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use api::Level;
use async_trait::async_trait;
use bridge::BridgeOptions;
use catalogue::{Catalogue, RevisionContents};
use link::control::RequestTiming;
use reach::links::{MeasuredRequest, RequestUpdate};
use reach::{Observer, Reach, ReachOptions, RecordedRevision, RequestTimes};
use ros::bus::FailureReason;
use servant::engine::ServantHandle;
use store::{Journal, NewEvent, RevisionRecord};
use tokio::time::Instant;

use super::ChoreographerInner;
use super::recent::RecentRequests;
use super::rollouts::Rollouts;
use crate::decide::requests::find_topic_request;
use crate::tracer::{RequestTracer, TracedServant};

/// Connects to the ROS of a container that was started from `revision`.
pub(crate) async fn open(
    inner: &ChoreographerInner,
    revision: &Arc<RevisionRecord>,
    container: &Arc<dyn ServantHandle>,
) -> Result<Arc<dyn Reach>, reach::Error> {
    let (options, observer) = reach_options(inner, revision, container.id());
    let recorded = Box::pin(async {
        let known = inner.catalogue.revision_contents(revision).await;
        // A running container is to be reached nevertheless.
        let known = known.unwrap_or_else(|error| {
            tracing::warn!("the contents of the image of {} are unknown: {error}", revision.service);
            RevisionContents::default()
        });
        recorded_revision(revision, known)
    });
    let opener = &inner.opener;
    opener.open(container, recorded, options, observer).await
}

/// Returns the options for reaching a servant, or a robot's place in a group, and the observer of its reports.
pub(crate) fn reach_options(
    inner: &ChoreographerInner,
    revision: &Arc<RevisionRecord>,
    id: &str,
) -> (ReachOptions, Arc<dyn Observer>) {
    let memory = &inner.memory;
    let measures = RequestRecorder::new(inner, revision, id);
    let options = ReachOptions {
        ros: revision.flavour.ros.ros_version(),
        distribution: revision.flavour.distribution.clone(),
        bridge: BridgeOptions {
            pair: find_topic_request(revision.flavour.ros.ros_version(), &revision.interface),
            ..inner.options.bridge.clone()
        },
        grace: inner.options.grace,
        budget: memory.servant(id),
        unfinished: memory.unfinished,
        rules: Arc::clone(inner.catalogue.translation_rules()),
    };
    let reports = ServantObserver {
        id: id.to_owned(),
        revision: Arc::clone(revision),
        catalogue: Arc::clone(&inner.catalogue),
        journal: inner.journal.clone(),
        measures,
        tracer: inner.options.tracer.clone(),
    };
    (options, Arc::new(reports))
}

/// Records the times of requests to one servant: for the controller, rollouts, and subscribers.
pub(crate) struct RequestRecorder {
    servant: String,
    revision: Arc<RevisionRecord>,
    request_times: Arc<RequestTimes>,
    recent: Arc<RecentRequests>,
    rollouts: Arc<Rollouts>,
}

impl RequestRecorder {
    pub(crate) fn new(inner: &ChoreographerInner, revision: &Arc<RevisionRecord>, servant: &str) -> Self {
        RequestRecorder {
            servant: servant.to_owned(),
            revision: Arc::clone(revision),
            request_times: Arc::clone(&inner.request_times),
            recent: Arc::clone(&inner.recent),
            rollouts: Arc::clone(&inner.rollouts),
        }
    }

    /// Records news about a request, which took `cloud` milliseconds in the cloud.
    fn record(&self, request: &RequestTiming, cloud: f64, news: RequestUpdate) {
        let service = &self.revision.service;
        self.request_times.record(service, request);
        if let Some(total) = request.total {
            let now = Instant::now().into_std();
            self.recent.record(&self.servant, total, cloud, now);
        }
        let (rollouts, revision) = (&self.rollouts, self.revision.number);
        match (news, request.total) {
            (RequestUpdate::Late, _) | (_, None) => rollouts.note_request(service, revision, None),
            (RequestUpdate::Answered, total) => rollouts.note_request(service, revision, total),
            (RequestUpdate::AnsweredLate, Some(total)) => {
                rollouts.note_late_answer(service, revision, total);
            }
        }
    }

    /// Records a request of a rosbridge client. The time between client and bridge is unknown: the measured time is
    /// slightly less than what robots see, and all of it counts as the cloud's.
    pub(crate) fn record_rosbridge(&self, took: Option<Duration>) {
        let total = took.map(|took| took.as_secs_f64() * 1e3);
        let request = RequestTiming { total, ..RequestTiming::default() };
        self.record(&request, total.unwrap_or_default(), RequestUpdate::Answered);
    }
}

/// Combines what is recorded of a revision with what was found in its image.
pub(crate) fn recorded_revision(revision: &RevisionRecord, known: RevisionContents) -> RecordedRevision {
    let RevisionContents { inventory, registry } = known;
    let plan = &revision.plan;
    RecordedRevision {
        service: revision.service.clone(),
        package: revision.package.clone(),
        flavour: revision.flavour.clone(),
        environment: plan.environment.clone(),
        nodes: plan.nodes.clone(),
        parameters: plan.parameters.clone(),
        components: plan.components.clone(),
        interface: Arc::new(revision.interface.clone()),
        inventory,
        registry,
        egress: plan.grants.egress.clone(),
    }
}

/// Observer of the reports of a servant and its robot.
struct ServantObserver {
    id: String,
    revision: Arc<RevisionRecord>,
    catalogue: Arc<Catalogue>,
    journal: Journal,
    measures: RequestRecorder,
    tracer: Option<Arc<dyn RequestTracer>>,
}

#[async_trait]
impl Observer for ServantObserver {
    async fn check_stub(&self, made_of: Option<u64>, image: &str) -> Result<(), FailureReason> {
        self.catalogue
            .check_stub_compatibility(&self.revision, made_of, image)
            .map_err(|error| FailureReason::new(error.to_string()))
    }

    fn record_event(&self, level: Level, kind: &str, message: &str, robot: Option<&str>) {
        let about = NewEvent { service: Some(&self.revision.service), servant: Some(&self.id), robot };
        match level {
            Level::Info => self.journal.info(kind, message, &about),
            Level::Warning => self.journal.warning(kind, message, &about),
            Level::Error => self.journal.error(kind, message, &about),
        }
    }

    fn on_served_locally(&self, robot: &str, node: &str, at: SystemTime, why: Option<&str>) {
        let service = &self.revision.service;
        self.journal.record_local_period((service, robot, node), at, why);
    }

    fn on_request_measured(&self, robot: Option<&str>, request: &MeasuredRequest<'_>) {
        let timing = request.timing;
        let cloud = timing.queue + timing.compute;
        self.measures.record(timing, cloud, request.update);
        if let Some(tracer) = &self.tracer {
            let servant = TracedServant { service: &self.revision.service, servant: &self.id, robot };
            tracer.record(servant, request);
        }
    }

    fn on_rosbridge_request(&self, took: Option<Duration>) {
        self.measures.record_rosbridge(took);
    }
}
