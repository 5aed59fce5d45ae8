//! Sampler of machine, services and servants, running while somebody listens.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Event;

use super::live::StateSample;
use crate::app::App;
use crate::errors::Error;
use crate::looks::{self, ServantSampler};
use crate::views;

/// Interval between samples if nothing happens.
const PERIOD: Duration = Duration::from_secs(1);
/// Delay after an event, because others may follow it and what it reports should be complete.
const SOON: Duration = Duration::from_millis(100);
/// Number of events kept for listeners.
pub const EVENTS: usize = 500;

/// Takes samples until nobody listens or the daemon stops.
pub async fn run(app: Arc<App>) {
    let mut happened = app.state.watch_events();
    let mut earlier = Arc::new(StateSample::default());
    let mut looker = ServantSampler::default();
    loop {
        happened.borrow_and_update();
        match take_sample(&app, &earlier, &mut looker).await {
            Ok(sample) => {
                earlier = Arc::new(sample);
                app.live.newest.send_replace(Some(Arc::clone(&earlier)));
            }
            // The database cannot be read; listeners notice that nothing comes.
            Err(error) => tracing::warn!("pages get no updates: {error}"),
        }
        let news = async {
            let _ = happened.changed().await;
            tokio::time::sleep(SOON).await;
        };
        tokio::select! {
            () = news => {}
            () = tokio::time::sleep(PERIOD) => {}
            () = app.live.newest.closed() => {}
            () = app.ending.cancelled() => return,
        }
        if app.live.try_stop() {
            return;
        }
    }
}

async fn take_sample(app: &App, earlier: &StateSample, looker: &mut ServantSampler) -> Result<StateSample, Error> {
    let servants = looker.sample(app).await;
    let machine = looks::sample_machine(app, &servants).await?;
    let mut services = Vec::new();
    for name in app.state.service_names()? {
        if let Some(revision) = app.state.current_revision(&name)? {
            services.push(views::summary(app, &revision));
        }
    }
    let back_offs = app.choreographer.back_offs();
    Ok(StateSample {
        machine: Some(Arc::new(machine)),
        services: reuse_unchanged(services, &earlier.services, |service| &service.name),
        servants: reuse_unchanged(servants, &earlier.servants, |served| &served.servant.id),
        back_offs: if *earlier.back_offs == back_offs { Arc::clone(&earlier.back_offs) } else { Arc::new(back_offs) },
        events: newest_events(app, &earlier.events)?,
    })
}

/// Wraps the items in `Arc`, reusing the earlier allocation of those that are equal.
fn reuse_unchanged<T: PartialEq>(new: Vec<T>, earlier: &[Arc<T>], name: fn(&T) -> &String) -> Vec<Arc<T>> {
    let earlier: HashMap<&String, &Arc<T>> = earlier.iter().map(|one| (name(one), one)).collect();
    let keep = |one: T| match earlier.get(name(&one)) {
        Some(same) if ***same == one => Arc::clone(same),
        _ => Arc::new(one),
    };
    new.into_iter().map(keep).collect()
}

/// Returns the newest events, including those that are new.
fn newest_events(app: &App, earlier: &Arc<Vec<Arc<Event>>>) -> Result<Arc<Vec<Arc<Event>>>, Error> {
    let since = earlier.last().map_or(0, |event| event.id);
    if since > 0 && *app.state.watch_events().borrow() <= since {
        return Ok(Arc::clone(earlier));
    }
    let new = app.state.events(since, EVENTS as u32)?;
    let mut all: Vec<_> = earlier.iter().cloned().chain(new.into_iter().map(Arc::new)).collect();
    let beyond = all.len().saturating_sub(EVENTS);
    Ok(Arc::new(all.split_off(beyond)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::looks::tests::served_servant;

    #[test]
    fn what_has_not_changed_is_the_same() {
        let earlier = reuse_unchanged(vec![served_servant(1, 0)], &[], |one| &one.servant.id);
        let same = reuse_unchanged(vec![served_servant(1, 0)], &earlier, |one| &one.servant.id);
        assert!(Arc::ptr_eq(&earlier[0], &same[0]));
        let other = reuse_unchanged(vec![served_servant(2, 0)], &earlier, |one| &one.servant.id);
        assert!(!Arc::ptr_eq(&earlier[0], &other[0]));
    }
}
