//! Services of the real node, served on the robot under this node's name.

use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bytes::Bytes;
use link::clock::now;
use link::control::ServiceChannel;
use qos::{Failure, RequestId};
use ros::bus::{FailureReason, ServiceHandler};
use tokio::sync::{oneshot, watch};

use super::reports;
use super::state::{Calls, Mirror, MirroredService};
use crate::local::{Keeper, PendingAnswer, ServiceUse};

impl Calls {
    /// Handles an answer of the cloud.
    pub fn on_answer(
        &self,
        mirror: &Mirror,
        id: u32,
        (taken, given, arrived): (i64, i64, i64),
        response: Result<Bytes, FailureReason>,
    ) {
        let response = response.map_err(|reason| Failure::Refused(reason.into_string()));
        let kept = self.kept.lock().remove(&id);
        if let (Some(keeper), Some((request, asked))) = (mirror.keeper(), kept) {
            let clock = mirror.session().clock();
            let phases = clock.map(|clock| reports::call_phases([asked, taken, given, arrived], clock.offset));
            keeper.on_cloud_answer(request, response, phases);
            return;
        }
        if let Some(caller) = self.waiting.lock().remove(&id) {
            let _ = caller.send(response);
        }
    }

    /// Resets the channels at the start of another session, in which the numbers may mean other services.
    pub fn reset_channels(&self) {
        for service in self.services.lock().values() {
            service.channel.send_replace(None);
        }
    }

    /// Fails all pending calls.
    pub fn fail_all(&self, keeper: Option<&Arc<Keeper>>, reason: &str) {
        let kept = std::mem::take(&mut *self.kept.lock());
        let early = std::mem::take(&mut *self.early.lock());
        if let Some(keeper) = keeper {
            let kept = kept.into_values().map(|(request, _)| request);
            for request in kept.chain(early.into_iter().map(|(request, ..)| request)) {
                let failure = Failure::Unreachable(reason.to_owned());
                keeper.on_cloud_answer(request, Err(failure), None);
            }
        }
        for (_, caller) in self.waiting.lock().drain() {
            let _ = caller.send(Err(Failure::Unreachable(reason.to_owned())));
        }
    }

    /// Makes a call on behalf of the keeper.
    pub fn call_for_keeper(&self, mirror: &Mirror, request: RequestId, service: &str, bytes: Bytes) {
        let services = self.services.lock();
        let Some(known) = services.get(service) else {
            drop(services);
            if let Some(keeper) = mirror.keeper() {
                let gone = format!("the node does not serve {service} any more");
                keeper.on_cloud_answer(request, Err(Failure::Unreachable(gone)), None);
            }
            return;
        };
        let Some(channel) = *known.channel.borrow() else {
            let early = (request, service.to_owned(), bytes);
            self.early.lock().push(early);
            return;
        };
        let mut kept = self.kept.lock();
        let id = mirror.session().call(channel, bytes);
        kept.insert(id, (request, now()));
    }

    /// Makes a call that is not measured and returns the answer. Waits until the cloud has reported the service.
    pub fn call_unmeasured(&self, mirror: &Mirror, service: &str, request: Bytes) -> PendingAnswer {
        let known = self.services.lock();
        match known.get(service) {
            Some(known) => {
                let channel = known.channel.subscribe();
                Box::pin(call_on_channel(mirror.this.clone(), channel, request))
            }
            None => {
                let gone = format!("the node does not serve {service} any more");
                Box::pin(async move { Err(Failure::Unreachable(gone)) })
            }
        }
    }

    /// Serves new services and stops serving those that are not listed, unless `keeps` is set. `told` is set if the
    /// channels are the cloud's; otherwise the cloud knows of none yet.
    pub async fn apply(&self, mirror: &Arc<Mirror>, services: &[ServiceChannel], (told, keeps): (bool, bool)) {
        let version = mirror.bus.version();
        self.services.lock().retain(|name, service| {
            let listed = services.iter().find(|served| served.name == *name);
            // More of a type may have become known.
            let same = |served: &ServiceChannel| {
                let of = |served: &ServiceChannel| served.service_type(version);
                served.type_name == service.told.type_name && of(served).is_compatible_with(&of(&service.told))
            };
            listed.map_or(keeps, same)
        });
        for served in services {
            if let Some(known) = self.services.lock().get(&served.name) {
                known.channel.send_replace(told.then_some(served.channel));
                continue;
            }
            let channel = Arc::new(watch::Sender::new(told.then_some(served.channel)));
            let handler = Arc::new(ForwardingHandler {
                mirror: Arc::downgrade(mirror),
                name: served.name.as_str().into(),
                what: ServiceUse::classify(served, version),
                channel: channel.clone(),
            });
            let service_type = served.service_type(version);
            match mirror.bus.serve(&served.name, service_type, handler).await {
                Ok(serving) => {
                    let service = MirroredService { told: served.clone(), channel, _serving: serving };
                    self.services.lock().insert(served.name.clone(), service);
                }
                Err(error) => {
                    tracing::warn!(service = served.name, %error, "cannot be served");
                }
            }
        }
        for (request, service, bytes) in std::mem::take(&mut *self.early.lock()) {
            self.call_for_keeper(mirror, request, &service, bytes);
        }
    }
}

/// Calls the cloud on a channel that may not have been reported yet.
async fn call_on_channel(
    mirror: Weak<Mirror>,
    mut channels: watch::Receiver<Option<u32>>,
    request: Bytes,
) -> Result<Bytes, Failure> {
    let ended = || Failure::Unreachable("the node is ending".to_owned());
    let (sender, answer) = oneshot::channel();
    let id = loop {
        let known = channels.wait_for(Option::is_some).await;
        drop(known.map_err(|_| ended())?);
        let mirror = mirror.upgrade().ok_or_else(ended)?;
        // The answer may come at once, so the caller is entered before. A session that begins now fails all pending
        // calls.
        let mut waiting = mirror.calls.waiting.lock();
        let Some(channel) = *channels.borrow() else {
            continue;
        };
        let id = mirror.session().call(channel, request);
        waiting.insert(id, sender);
        break id;
    };
    let abandoned = AbandonedCall { mirror, id };
    let answer = answer.await.unwrap_or_else(|_| Err(ended()));
    drop(abandoned);
    answer
}

/// Forwards calls to the cloud, or to the keeper of the promise.
struct ForwardingHandler {
    mirror: Weak<Mirror>,
    name: Arc<str>,
    what: ServiceUse,
    channel: Arc<watch::Sender<Option<u32>>>,
}

#[async_trait]
impl ServiceHandler for ForwardingHandler {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let keeper = {
            let mirror = self.mirror.upgrade();
            let mirror = mirror.ok_or_else(|| FailureReason::new("the node is ending"))?;
            mirror.keeper().cloned()
        };
        let Some(keeper) = keeper else {
            let channels = self.channel.subscribe();
            let answer = call_on_channel(self.mirror.clone(), channels, request).await;
            return answer.map_err(|failure| FailureReason::new(failure.text()));
        };
        match &self.what {
            ServiceUse::Request => keeper.call(&self.name, request).await,
            ServiceUse::Look => keeper.forward(&self.name, request).await,
            ServiceUse::Set | ServiceUse::Transition => keeper.manage(&self.name, &self.what, request).await,
            ServiceUse::SendGoal(action) => keeper.send_goal(action, request).await,
            ServiceUse::GetResult(action) => keeper.get_result(action, request).await,
            ServiceUse::CancelGoal(action) => keeper.cancel_goal(action, request).await,
        }
    }
}

/// Removes a call whose caller is gone.
struct AbandonedCall {
    mirror: Weak<Mirror>,
    id: u32,
}

impl Drop for AbandonedCall {
    fn drop(&mut self) {
        if let Some(mirror) = self.mirror.upgrade() {
            mirror.calls.waiting.lock().remove(&self.id);
        }
    }
}
