//! Services that manage a node are no requests of its application: they are not measured, and answered by the side that
//! speaks for the node.

use std::sync::atomic::Ordering;

use bytes::Bytes;
use qos::{Failure, Responder};
use ros::bus::FailureReason;
use tokio::time::timeout;

use super::Keeper;
use crate::local::remembered::PATIENCE;
use crate::local::service_use::ServiceUse;

impl Keeper {
    /// Calls the cloud if the link is up, otherwise the local original.
    pub async fn forward(&self, service: &str, request: Bytes) -> Result<Bytes, FailureReason> {
        let passed = self.call_active_side(service, request).await;
        passed.map(|(_, answer)| answer)
    }

    async fn call_active_side(&self, service: &str, request: Bytes) -> Result<(Responder, Bytes), FailureReason> {
        let is_up = self.state.lock().governor.sides().cloud;
        let cloud = if is_up {
            self.call_side(Responder::Cloud, service, request.clone()).await
        } else {
            Err(Failure::Unreachable("the link is down".to_owned()))
        };
        let reason = match cloud {
            Ok(answer) => return Ok((Responder::Cloud, answer)),
            Err(Failure::Refused(reason)) => return Err(FailureReason::new(reason)),
            Err(Failure::Unreachable(reason)) => reason,
        };
        let local = self.call_side(Responder::Local, service, request).await;
        let local = local.map(|answer| (Responder::Local, answer));
        local.map_err(|failure| FailureReason::new(format!("cloud: {reason}; local: {}", failure.text())))
    }

    /// Changes a setting of the node: on the side that answers, and on the other side, now or when it starts.
    pub async fn manage(&self, service: &str, what: &ServiceUse, request: Bytes) -> Result<Bytes, FailureReason> {
        // Serializes changes by the same service: a replay to a new node sees this one or an earlier one.
        let turn = self.remembered.acquire_turn(service).await;
        let (side, answer) = self.call_active_side(service, request.clone()).await?;
        self.remembered.record(service, what, &request);
        match side {
            Responder::Local => self.cloud_missed.store(true, Ordering::Relaxed),
            Responder::Cloud => {
                if self.state.lock().context.is_running() {
                    let told = self.call_side(Responder::Local, service, request);
                    let service = service.to_owned();
                    tokio::spawn(async move {
                        let _turn = turn;
                        let told = timeout(PATIENCE, told).await;
                        if let Ok(Err(failure)) = told {
                            let reason = failure.text();
                            tracing::debug!(service, reason, "cannot forward the request to the local original");
                        }
                    });
                }
            }
        }
        Ok(answer)
    }

    /// Replays settings to the cloud when the link is up: those that only the local original received, or all to a new
    /// servant.
    pub(super) fn replay_to_cloud(&self, resumed: bool) {
        let missed = self.cloud_missed.swap(false, Ordering::Relaxed);
        if resumed && !missed {
            return;
        }
        let (cloud, remembered) = (self.cloud.clone(), self.remembered.clone());
        tokio::spawn(async move {
            let ask = |service: &str, request| cloud.call_unmeasured(service, request);
            remembered.replay(ask).await;
        });
    }
}
