//! Lending between a robot and a servant of different ROSes, in the terms of the robot's.

use std::sync::Arc;

use async_trait::async_trait;
use ros::bus::{BusError, Lender, Lending, LentService, ServiceProvider, ServiceType};

use super::services;
use super::state::{TranslatedBus, Translation, not_translated};

/// Returns a service of the robot as the servant's nodes see it.
pub(super) fn lend_to_servant(
    translation: &Arc<Translation>,
    service: &str,
    lent: LentService,
) -> Result<LentService, BusError> {
    let LentService { service_type, handler, gone } = lent;
    let made = services::handler_for_servant(translation, service, &service_type, handler);
    let (service_type, handler) = made.inspect_err(|error| translation.losses.record_untranslated(service, error))?;
    Ok(LentService { service_type, handler, gone })
}

#[async_trait]
impl Lending for TranslatedBus {
    async fn lend(&self, lender: Arc<dyn Lender>) -> Result<(), BusError> {
        let lender = Arc::new(TranslatingLender { lender, translation: Arc::clone(&self.translation) });
        self.translation.inner.lending()?.lend(lender).await
    }

    async fn provider(&self, service: &str) -> Result<ServiceProvider, BusError> {
        let translation = &self.translation;
        let ServiceProvider { node, service_type, label } = translation.inner.lending()?.provider(service).await?;
        let twin = translation.twins.service(&service_type);
        let twin = twin.map_err(|reason| not_translated(format!("service {service}"), reason))?;
        Ok(ServiceProvider { node, service_type: ServiceType::from_service(&twin.twin), label })
    }

    fn set_label(&self, label: &str) {
        if let Ok(lending) = self.translation.inner.lending() {
            lending.set_label(label);
        }
    }
}

/// A lender of the robot's ROS for nodes of the servant.
struct TranslatingLender {
    lender: Arc<dyn Lender>,
    translation: Arc<Translation>,
}

#[async_trait]
impl Lender for TranslatingLender {
    async fn find_service(&self, service: &str, node: &str) -> Option<LentService> {
        let lent = self.lender.find_service(service, node).await?;
        lend_to_servant(&self.translation, service, lent).ok()
    }
}
