//! Looks at the machine, the services and the servants while somebody listens.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::explain::Served;
use api::stream::Machine;
use api::{BackOff, Event, ServiceSummary};

use crate::app::App;
use crate::errors::Error;
use crate::looks::{self, Looker};
use crate::views;

/// Between two looks while nothing happens.
const PERIOD: Duration = Duration::from_secs(1);
/// After an event: others follow it, and what it tells of is done.
const SOON: Duration = Duration::from_millis(100);
/// Events that are kept for who listens.
pub const EVENTS: usize = 500;

/// All that is so. What has not changed since the sample before is the same allocation.
#[derive(Default)]
pub struct Sample {
    pub machine: Option<Arc<Machine>>,
    pub services: Vec<Arc<ServiceSummary>>,
    pub servants: Vec<Arc<Served>>,
    pub back_offs: Arc<Vec<BackOff>>,
    /// The newest, oldest first.
    pub events: Arc<Vec<Arc<Event>>>,
}

/// Takes samples until nobody listens or the daemon ends.
pub async fn run(app: Arc<App>) {
    let mut happened = app.state.watch_events();
    let mut earlier = Arc::new(Sample::default());
    let mut looker = Looker::default();
    loop {
        happened.borrow_and_update();
        match take(&app, &earlier, &mut looker).await {
            Ok(sample) => {
                earlier = Arc::new(sample);
                app.live.newest.send_replace(Some(Arc::clone(&earlier)));
            }
            // The database cannot be read now; who listens sees that nothing comes.
            Err(error) => tracing::warn!("pages are not told what is so: {error}"),
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
        if app.live.rests() {
            return;
        }
    }
}

async fn take(app: &App, earlier: &Sample, looker: &mut Looker) -> Result<Sample, Error> {
    let servants = looker.servants(app).await;
    let machine = looks::machine(app, &servants).await?;
    let mut services = Vec::new();
    for name in app.state.service_names()? {
        if let Some(revision) = app.state.current(&name)? {
            services.push(views::summary(app, &revision));
        }
    }
    let back_offs = app.choreographer.back_offs();
    Ok(Sample {
        machine: Some(Arc::new(machine)),
        services: kept(services, &earlier.services, |service| &service.name),
        servants: kept(servants, &earlier.servants, |served| &served.servant.id),
        back_offs: match *earlier.back_offs == back_offs {
            true => Arc::clone(&earlier.back_offs),
            false => Arc::new(back_offs),
        },
        events: events(app, &earlier.events)?,
    })
}

/// What is new, as the earlier allocation where it is equal.
fn kept<T: PartialEq>(new: Vec<T>, earlier: &[Arc<T>], name: fn(&T) -> &String) -> Vec<Arc<T>> {
    let earlier: HashMap<&String, &Arc<T>> = earlier.iter().map(|one| (name(one), one)).collect();
    let keep = |one: T| match earlier.get(name(&one)) {
        Some(same) if ***same == one => Arc::clone(same),
        _ => Arc::new(one),
    };
    new.into_iter().map(keep).collect()
}

/// The newest events, with those that are new.
fn events(app: &App, earlier: &Arc<Vec<Arc<Event>>>) -> Result<Arc<Vec<Arc<Event>>>, Error> {
    let since = earlier.last().map_or(0, |event| event.id);
    if since > 0 && *app.state.watch_events().borrow() <= since {
        return Ok(Arc::clone(earlier));
    }
    let new = app.state.events(since, EVENTS as u32)?;
    let mut all: Vec<_> = earlier
        .iter()
        .cloned()
        .chain(new.into_iter().map(Arc::new))
        .collect();
    let beyond = all.len().saturating_sub(EVENTS);
    Ok(Arc::new(all.split_off(beyond)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::looks::tests::served;

    #[test]
    fn what_has_not_changed_is_the_same() {
        let earlier = kept(vec![served(1, 0)], &[], |one| &one.servant.id);
        let same = kept(vec![served(1, 0)], &earlier, |one| &one.servant.id);
        assert!(Arc::ptr_eq(&earlier[0], &same[0]));
        let other = kept(vec![served(2, 0)], &earlier, |one| &one.servant.id);
        assert!(!Arc::ptr_eq(&earlier[0], &other[0]));
    }
}
