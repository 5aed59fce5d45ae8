//! What the API shows of a servant.

use api::Phase;
use reach::Reach;
use tokio::time::Instant;

use crate::{Choreographer, Handle, limits};

/// Topics whose drops are shown.
const SHOWN_DROPS: usize = 10;

impl Choreographer {
    /// A servant as the API shows it.
    pub async fn describe(&self, handle: &Handle) -> api::Servant {
        let inner = &self.inner;
        let life = handle.life();
        let reach = handle.reach();
        let running = runs(life.phase);
        let container = handle.container().filter(|_| running);
        let enforced = container.as_ref().map(|container| container.enforced());
        let pids = container
            .as_ref()
            .map(|container| inner.opener.processes(container.id()));
        api::Servant {
            id: handle.id.clone(),
            service: handle.service().to_owned(),
            revision: handle.revision.number,
            robot: handle.robot.clone(),
            phase: life.phase,
            reason: life.reason().or_else(|| {
                handle
                    .watch_standing()
                    .borrow()
                    .as_ref()
                    .map(ToString::to_string)
            }),
            created: handle.created,
            connections: handle.connections(),
            idle_until: handle.idle_until(),
            terms: Some(handle.terms())
                .filter(|terms| !terms.stated.is_empty() || terms.class.is_some()),
            limits: handle.limits(),
            cgroup_version: enforced
                .as_ref()
                .map_or(0, |enforced| enforced.cgroup_version),
            enforced: enforced.map(|enforced| limits::limits_of(&enforced.limits)),
            usage: usage(handle).await,
            response: inner.recent.shown(&handle.id, Instant::now().into_std()),
            pids: pids.unwrap_or_default(),
            dropped: reach.as_ref().map_or(0, |reach| reach.dropped()),
            lifecycle: reach.as_deref().map(lifecycle).unwrap_or_default(),
            drops: reach.map(|reach| drops(&*reach)).unwrap_or_default(),
            down: handle.down(),
            hung: handle.hung(),
        }
    }
}

/// Nodes that have a lifecycle, and where they are in it.
fn lifecycle(reach: &dyn Reach) -> Vec<api::NodeStage> {
    let stages = reach.lifecycles();
    let stages = stages.map(|stages| stages.borrow().clone());
    let stages = stages.unwrap_or_default().into_iter();
    stages
        .map(|(node, stage)| api::NodeStage {
            node,
            state: stage.state,
            refused: stage.refused,
        })
        .collect()
}

/// Topics that lost most.
fn drops(reach: &dyn Reach) -> Vec<api::TopicDrops> {
    let topics = reach.drops().into_iter().take(SHOWN_DROPS);
    let told = topics.map(|(topic, count)| api::TopicDrops { topic, count });
    told.collect()
}

/// What a servant uses, while it runs.
pub async fn usage(handle: &Handle) -> Option<api::Usage> {
    let container = handle.container().filter(|_| runs(handle.life().phase))?;
    // One that has ended meanwhile uses nothing.
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

fn runs(phase: Phase) -> bool {
    matches!(phase, Phase::Created | Phase::Starting | Phase::Ready)
}
