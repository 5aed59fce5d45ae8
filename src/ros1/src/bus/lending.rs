//! Services of another ROS system, lent to the nodes of this one: the Master queries this node, and callers connect
//! here.

use std::sync::Arc;

use async_trait::async_trait;
use ros_bus::{BusError, Lender, Lending, LentService, ServiceProvider};

use super::state::{Loans, Ros1BusState, ServiceEntry};
use super::{Ros1Bus, calls};
use crate::master::lending::LEND_SERVICES;
use crate::names;

impl Loans {
    pub(super) fn set_lender(&self, lender: Arc<dyn Lender>) {
        *self.lender.lock() = Some(lender);
    }

    pub(super) fn clear(&self) {
        *self.lender.lock() = None;
        self.lent.lock().clear();
    }

    /// Returns a lent service if it is available.
    pub(super) fn active_service(&self, service: &str) -> Option<Arc<ServiceEntry>> {
        let served = self.lent.lock().get(service).cloned();
        served.filter(|served| !served.has_ended())
    }

    /// Asks the lender for the service; returns true if it has it, and it can then be called here.
    pub(super) async fn query_lender(&self, service: &str, node: &str) -> bool {
        let lender = self.lender.lock().clone();
        let found = match lender {
            Some(lender) if names::is_global(service) => lender.find_service(service, node).await,
            _ => None,
        };
        let mut lent = self.lent.lock();
        lent.retain(|_, served| !served.has_ended());
        let Some(LentService { service_type, handler, gone }) = found else {
            lent.remove(service);
            return false;
        };
        let served = ServiceEntry { service_type, handler, ended: gone };
        lent.insert(service.to_owned(), Arc::new(served));
        true
    }
}

#[async_trait]
impl Lending for Ros1Bus {
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError> {
        self.inner.check_open()?;
        self.inner.lending.set_lender(lender);
        self.inner.announce_lender().await
    }

    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError> {
        self.inner.check_name(service)?;
        calls::probe(&self.inner, service).await
    }

    fn set_label(&self, label: &str) {
        let _ = self.inner.label.set(label.to_owned());
    }
}

impl Ros1BusState {
    /// Announces this node to the Master as lender, if there is one.
    pub(super) async fn announce_lender(&self) -> Result<(), BusError> {
        if self.lending.lender.lock().is_none() {
            return Ok(());
        }
        let args = vec![self.registrar.slave_uri().into()];
        self.master.call(LEND_SERVICES, args).await.map(drop)
    }

    /// Answers the Master: returns the address at which the service can be called.
    pub(super) async fn lend_service(&self, service: &str, node: &str) -> Option<String> {
        let found = self.lending.query_lender(service, node).await;
        found.then(|| self.registrar.service_uri().to_owned())
    }
}
