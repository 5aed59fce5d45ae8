//! What manages a node is no request of its application: it is not measured, and answered by who speaks for the node.

use std::sync::atomic::Ordering;

use bytes::Bytes;
use qos::{Failure, Side};
use tokio::time::timeout;

use super::Keeper;
use crate::local::remembered::PATIENCE;
use crate::local::service_use::ServiceUse;

impl Keeper {
    /// Asks the cloud where the link is up, else the local original.
    pub async fn pass(&self, service: &str, request: Bytes) -> Result<Bytes, String> {
        let passed = self.passed(service, request).await;
        passed.map(|(_, answer)| answer)
    }

    async fn passed(&self, service: &str, request: Bytes) -> Result<(Side, Bytes), String> {
        let is_up = self.state.lock().governor.sides().cloud;
        let cloud = match is_up {
            true => self.ask(Side::Cloud, service, request.clone()).await,
            false => Err(Failure::Unreachable("the link is down".to_owned())),
        };
        let reason = match cloud {
            Ok(answer) => return Ok((Side::Cloud, answer)),
            Err(Failure::Refused(reason)) => return Err(reason),
            Err(Failure::Unreachable(reason)) => reason,
        };
        let local = self.ask(Side::Local, service, request).await;
        let local = local.map(|answer| (Side::Local, answer));
        local.map_err(|failure| format!("cloud: {reason}; local: {}", failure.text()))
    }

    /// Tells the node to be otherwise: whoever answers, and the other side, too, now or when it begins.
    pub async fn manage(
        &self,
        service: &str,
        what: &ServiceUse,
        request: Bytes,
    ) -> Result<Bytes, String> {
        // Who is told anew meanwhile is told this, or told before.
        let turn = self.remembered.turn(service).await;
        let (side, answer) = self.passed(service, request.clone()).await?;
        self.remembered.note(service, what, &request);
        match side {
            Side::Local => self.cloud_missed.store(true, Ordering::Relaxed),
            Side::Cloud => {
                if self.state.lock().context.runs() {
                    let told = self.ask(Side::Local, service, request);
                    let service = service.to_owned();
                    tokio::spawn(async move {
                        let _turn = turn;
                        let told = timeout(PATIENCE, told).await;
                        if let Ok(Err(failure)) = told {
                            let reason = failure.text();
                            tracing::debug!(service, reason, "the local original was not told");
                        }
                    });
                }
            }
        }
        Ok(answer)
    }

    /// The link is up: the cloud is told what only the local original was, and another servant all.
    pub(super) fn tell_cloud(&self, resumed: bool) {
        let missed = self.cloud_missed.swap(false, Ordering::Relaxed);
        if resumed && !missed {
            return;
        }
        let (cloud, remembered) = (self.cloud.clone(), self.remembered.clone());
        tokio::spawn(async move {
            let ask = |service: &str, request| cloud.ask(service, request);
            remembered.tell(ask).await;
        });
    }
}
