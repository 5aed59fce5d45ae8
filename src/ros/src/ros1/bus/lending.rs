//! Services of another ROS system, lent to the nodes of this one: the Master asks for them, callers connect here.

use std::collections::HashMap;
use std::sync::Arc;

use async_trait::async_trait;
use parking_lot::Mutex;

use super::services::Served;
use super::{Inner, Ros1Bus, calls};
use crate::bus::{BusError, Lender, Lending, Lent, ServiceProvider};
use crate::ros1::master::lending::LEND_SERVICES;
use crate::ros1::names;

/// The lender, and what it has lent, by name.
#[derive(Default)]
pub(super) struct Loans {
    lender: Mutex<Option<Arc<dyn Lender>>>,
    lent: Mutex<HashMap<String, Arc<Served>>>,
}

impl Loans {
    pub(super) fn begin(&self, lender: Arc<dyn Lender>) {
        *self.lender.lock() = Some(lender);
    }

    pub(super) fn end(&self) {
        *self.lender.lock() = None;
        self.lent.lock().clear();
    }

    /// A service that can be called now.
    pub(super) fn lent(&self, service: &str) -> Option<Arc<Served>> {
        let served = self.lent.lock().get(service).cloned();
        served.filter(|served| !served.is_over())
    }

    /// Whether the lender has this service; then it can be called here.
    pub(super) async fn find(&self, service: &str, node: &str) -> bool {
        let lender = self.lender.lock().clone();
        let found = match lender {
            Some(lender) if names::is_global(service) => lender.find(service, node).await,
            _ => None,
        };
        let mut lent = self.lent.lock();
        lent.retain(|_, served| !served.is_over());
        let Some(Lent {
            service_type,
            handler,
            gone,
        }) = found
        else {
            lent.remove(service);
            return false;
        };
        let served = Served {
            service_type,
            handler,
            ended: gone,
        };
        lent.insert(service.to_owned(), Arc::new(served));
        true
    }
}

#[async_trait]
impl Lending for Ros1Bus {
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError> {
        self.inner.check_open()?;
        self.inner.lending.begin(lender);
        self.inner.report_that_it_lends().await
    }

    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError> {
        self.inner.check_name(service)?;
        calls::probe(&self.inner, service).await
    }

    fn set_label(&self, label: &str) {
        let _ = self.inner.label.set(label.to_owned());
    }
}

impl Inner {
    /// Tells the Master whom to ask, if anybody lends.
    pub(super) async fn report_that_it_lends(&self) -> Result<(), BusError> {
        if self.lending.lender.lock().is_none() {
            return Ok(());
        }
        let args = vec![self.registrar.slave_uri().into()];
        self.master.call(LEND_SERVICES, args).await.map(drop)
    }

    /// Answers the Master: the address under which the service can be called.
    pub(super) async fn lend_service(&self, service: &str, node: &str) -> Option<String> {
        let found = self.lending.find(service, node).await;
        found.then(|| self.registrar.service_uri().to_owned())
    }
}
