//! Explains why a robot is slow or on its local original: gathers what its stubs report and what the kernel counts;
//! `causes` draws the conclusions.

mod causes;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use api::Event;
use api::explain::{Explanation, Link, Part, Served, dominant};
use link::control::{IncompatibleEndpoint, RequestTiming};
use reach::links::LinkStatus;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::events::visible_services;
use choreographer::{Choreographer, Handle, RequestTracer};
use store::{EventFilter, EventVisibility};

/// Interval between two samples of a servant's resource usage.
const MOMENT: Duration = Duration::from_millis(400);
/// Number of events included.
const EVENTS: u32 = 8;

/// Explains one robot.
pub async fn explain_robot(app: &App, caller: &Caller, name: &str) -> Result<Explanation, Error> {
    let choreographer = &app.choreographer;
    let mut all = choreographer.servants();
    all.retain(|handle| caller.can_see_servant(app, handle));
    let mine: Vec<&Arc<Handle>> = all.iter().filter(|handle| handle.robot == name).collect();
    let events = recent_events(app, caller, name)?;
    if mine.is_empty() && events.is_empty() {
        let mut exists: Vec<String> = all.iter().map(|handle| handle.robot.clone()).collect();
        exists.sort();
        exists.dedup();
        return Err(Error::UnknownRobot { name: name.to_owned(), exists });
    }
    let servants =
        futures_util::future::join_all(mine.iter().map(|handle| sample_servant(choreographer, handle))).await;
    Ok(Explanation {
        robot: name.to_owned(),
        causes: causes::find_causes(
            &servants,
            &events,
            &robot_back_offs(choreographer, name),
            &waiting_rollouts(choreographer, &servants),
        ),
        servants,
        events,
    })
}

fn recent_events(app: &App, caller: &Caller, robot: &str) -> Result<Vec<Event>, Error> {
    let services = visible_services(app, caller)?;
    let of_it = EventFilter {
        robot: Some(robot),
        told: services.as_deref().map(|services| EventVisibility { services, own_robot: Some(robot) }),
        ..EventFilter::default()
    };
    Ok(app.state.filtered_events(of_it, 0, EVENTS)?)
}

async fn sample_servant(choreographer: &Choreographer, handle: &Handle) -> Served {
    let before = choreographer.describe(handle).await;
    tokio::time::sleep(MOMENT).await;
    let servant = choreographer.describe(handle).await;
    let spent = |of: fn(&api::Usage) -> u64| {
        let (Some(before), Some(after)) = (&before.usage, &servant.usage) else {
            return 0.0;
        };
        of(after).saturating_sub(of(before)) as f64 / MOMENT.as_micros() as f64
    };
    Served {
        throttled: spent(|usage| usage.throttled_usec).min(1.0),
        cores: spent(|usage| usage.cpu_usec),
        links: links(choreographer, handle),
        servant,
    }
}

/// Returns the links to a servant, if it has any yet.
pub fn links(choreographer: &Choreographer, handle: &Handle) -> Vec<Link> {
    let status = handle.reach().map(|reach| reach.links());
    status.unwrap_or_default().into_iter().map(|status| to_link(status, choreographer.tracer())).collect()
}

fn to_link(status: LinkStatus, tracer: Option<&dyn RequestTracer>) -> Link {
    let millis = |seconds: f64| seconds * 1000.0;
    let max = status.sla.max.map(millis);
    let unpromised = status.sla.fallback_after.is_some();
    let is_late = |request: &&RequestTiming| match (request.total, max) {
        _ if unpromised => false,
        (Some(total), Some(max)) => total > max,
        (answered, _) => answered.is_none(),
    };
    let requests = &status.requests;
    let late: Vec<&RequestTiming> = requests.iter().filter(is_late).collect();
    // Requests that were not answered while the link was down have no trace.
    let trace = late
        .iter()
        .copied()
        .rev()
        .chain(requests.iter().rev())
        .filter(|request| request.total.is_some())
        .find_map(|request| tracer?.trace_id(&status.session, request.id));
    let dropped = status.drops.iter().chain(&status.dropped);
    let here = status.drops.iter().map(|drop| format!("in the cloud {drop}"));
    let there = status.dropped.iter();
    let drops = here.chain(there.map(|drop| format!("on the robot {drop}"))).collect();
    let refused = status.refused.iter().map(|one| {
        let IncompatibleEndpoint { topic, node, why } = one;
        format!("no messages on {topic} pass between {node} and {}: {why}", status.node)
    });
    let refused = refused.collect();
    Link {
        up: status.up,
        round_trip: status.round_trip,
        clock: status.clock,
        throughput: status.throughput,
        dropped: dropped.map(|drop| drop.count).sum(),
        drops,
        desire: status.sla.desire.map(millis),
        max,
        threshold: status.sla.threshold,
        frames_per_second: status.sla.frames_per_second,
        desired_frames_per_second: status.sla.desired_frames_per_second,
        age: status.sla.age.map(millis),
        desired_age: status.sla.desired_age.map(millis),
        fallback_after: status.sla.fallback_after.map(millis),
        satisfaction: requests.last().filter(|_| !unpromised).map(|request| request.satisfaction),
        requests: requests.len(),
        late: late.len(),
        local: requests.iter().filter(|request| request.local).count(),
        phases: phase_times(requests),
        late_in: dominant(&phase_times(late)).cloned(),
        trace,
        unsent: status.unsent,
        given: status.given,
        left_out: status.left_out,
        unfed: status.unfed,
        unserved: status.unserved,
        refused,
        duplicates: status.duplicates,
        node: status.node,
    }
}

/// Returns how the time of the answered requests is divided into phases.
fn phase_times<'a>(requests: impl IntoIterator<Item = &'a RequestTiming>) -> Vec<Part> {
    let answered: Vec<&RequestTiming> = requests.into_iter().filter(|request| request.total.is_some()).collect();
    let times = |of: fn(&RequestTiming) -> f64| answered.iter().map(|request| of(request)).collect();
    let parts = [
        Part::from_samples("serialise", times(|request| request.serialise)),
        Part::from_samples("up", times(|request| request.up)),
        Part::from_samples("queue", times(|request| request.queue)),
        Part::from_samples("compute", times(|request| request.compute)),
        Part::from_samples("down", times(|request| request.down)),
        Part::from_samples("total", times(|request| request.total.unwrap_or(f64::NAN))),
    ];
    parts.into_iter().flatten().collect()
}

/// Returns the robot's failed servants that are not restarted yet.
fn robot_back_offs(choreographer: &Choreographer, robot: &str) -> Vec<api::BackOff> {
    let mut all = choreographer.back_offs();
    all.retain(|one| one.robot == robot);
    all
}

/// Returns rollouts of the robot's services whose canaries are due but not promoted.
fn waiting_rollouts(choreographer: &Choreographer, servants: &[Served]) -> Vec<api::Rollout> {
    let services = servants.iter().map(|served| served.servant.service.as_str());
    let services: BTreeSet<&str> = services.collect();
    let rollouts = services.into_iter().filter_map(|service| choreographer.rollout(service).ok());
    rollouts.filter(|rollout| rollout.waits.is_some()).collect()
}
