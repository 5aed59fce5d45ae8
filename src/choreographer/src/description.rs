//! Descriptions of servants for the API.

use std::cmp::Reverse;

use api::Phase;
use bridge::MetricsSnapshot;
use reach::Reach;
use reach::links::LinkStatus;
use tokio::time::Instant;

use crate::{Choreographer, Handle};

/// Maximum number of topics with drops that are shown.
const SHOWN_DROPS: usize = 10;

impl Choreographer {
    /// Returns the description of a servant.
    pub async fn describe(&self, handle: &Handle) -> api::Servant {
        let inner = &self.inner;
        let life = handle.life();
        let reach = handle.reach();
        let metrics = reach.as_ref().map(|reach| reach.metrics()).unwrap_or_default();
        let links = reach.as_ref().map(|reach| reach.links()).unwrap_or_default();
        let running = is_running(life.phase);
        let container = handle.container().filter(|_| running);
        let enforced = container.as_ref().map(|container| container.enforced_limits());
        let pids = container.as_ref().map(|container| inner.opener.process_ids(container.id()));
        api::Servant {
            id: handle.id.clone(),
            service: handle.service().to_owned(),
            revision: handle.revision.number,
            robot: handle.robot.clone(),
            phase: life.phase,
            reason: life.reason().or_else(|| handle.watch_standing().borrow().as_ref().map(ToString::to_string)),
            created: handle.created,
            connections: handle.connections(),
            idle_until: handle.idle_until(),
            terms: Some(handle.terms()).filter(|terms| !terms.stated.is_empty() || terms.class.is_some()),
            limits: handle.limits(),
            cgroup_version: enforced.as_ref().map_or(0, |enforced| enforced.cgroup_version),
            enforced: enforced.map(|enforced| enforced.limits),
            usage: usage(handle).await,
            response: inner.recent.response_times(&handle.id, Instant::now().into_std()),
            pids: pids.unwrap_or_default(),
            dropped: metrics.dropped_count(),
            lifecycle: reach.as_deref().map(lifecycle).unwrap_or_default(),
            drops: drops(metrics, &links),
            down: handle.nodes_down(),
            hung: handle.hung_nodes(),
        }
    }
}

/// Returns the lifecycle nodes and their states.
fn lifecycle(reach: &dyn Reach) -> Vec<api::NodeStage> {
    let stages = reach.lifecycles().borrow().clone();
    let stages = stages.into_iter();
    stages.map(|(node, stage)| api::NodeStage { node, state: stage.state, refused: stage.refused }).collect()
}

/// Returns the topics with the most drops: of rosbridge clients, and of links at both ends.
fn drops(metrics: MetricsSnapshot, links: &[LinkStatus]) -> Vec<api::TopicDrops> {
    let mut topics = metrics.drops;
    for drop in links.iter().flat_map(|link| link.drops.iter().chain(&link.dropped)) {
        *topics.entry(drop.topic.clone()).or_default() += drop.count;
    }
    let topics = topics.into_iter().map(|(topic, count)| api::TopicDrops { topic, count });
    let mut topics: Vec<api::TopicDrops> = topics.collect();
    topics.sort_by_key(|drops| Reverse(drops.count));
    topics.truncate(SHOWN_DROPS);
    topics
}

/// Returns the resource usage of a running servant.
pub async fn usage(handle: &Handle) -> Option<api::Usage> {
    let container = handle.container().filter(|_| is_running(handle.life().phase))?;
    // A servant that has ended meanwhile uses nothing.
    let usage = container.usage().await.ok()?;
    Some(api::Usage {
        cpu_usec: usage.cpu_usec,
        memory: usage.memory,
        pids: usage.pids,
        oom_kills: usage.oom_kills,
        throttled_usec: usage.throttled_usec,
        pressure: usage.pressure,
    })
}

fn is_running(phase: Phase) -> bool {
    matches!(phase, Phase::Created | Phase::Starting | Phase::Ready)
}
