//! Calls in either direction.
//!
//! A service of ROS 1 can fail, and its caller learns so. In ROS 2 a server that does not answer leaves its caller
//! waiting. So where a caller of ROS 2 uses a service of ROS 1 that fails, the failure is logged and the caller gets
//! the default response of the type: numbers are zero, texts empty, `success` is false.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{BusError, CallFate, Digest, FailureReason, RosVersion, ServiceHandler, ServiceType};
use ros::codec::default_message;
use ros::schema::MessageType;

use super::state::{Translation, not_translated};
use crate::ServiceTwin;

/// Maximum number of services whose types are remembered.
const MAX_TYPES: usize = 1000;

/// Calls a service of the servant with a request of the robot's ROS.
pub(super) async fn call(
    translation: &Arc<Translation>,
    service: &str,
    digest: &Digest,
    request: Bytes,
    timeout: Duration,
) -> Result<Bytes, BusError> {
    let twin = find_called(translation, service).await?;
    let ours = ServiceType::from_service(&twin.twin);
    if !ours.digest.is_compatible_with(digest) {
        let theirs = format!("{} {}", ours.name, ours.digest);
        return Err(BusError::TypeMismatch { what: format!("service {service}"), theirs, ours: digest.to_string() });
    }
    let losses = &translation.losses;
    let request = losses.translate(service, &twin.request_from_twin, &request);
    let request = request.map_err(|error| not_translated(format!("a request to {service}"), error))?;
    // In ROS 1 the connection tells whether the type is still the same; in ROS 2 the server is matched by its type.
    let original = match translation.servant_version() {
        RosVersion::One => Digest::from(&*twin.original.md5),
        RosVersion::Two => Digest::any(),
    };
    match translation.inner.call_typed(service, &original, request, timeout).await {
        Ok(response) => {
            let response = losses.translate(service, &twin.response_to_twin, &response);
            response.map_err(|error| not_translated(format!("a response of {service}"), error))
        }
        Err(BusError::CallFailed { reason, fate: CallFate::Answered, .. })
            if translation.version == RosVersion::Two =>
        {
            Ok(default_response(translation, service, &twin.twin.response, &reason))
        }
        Err(error) => {
            // Another server may have another type.
            if matches!(error, BusError::TypeMismatch { .. } | BusError::NoService(_)) {
                translation.called.lock().remove(service);
            }
            Err(error)
        }
    }
}

/// Returns the type of a service of the servant. It is remembered where finding it takes a connection.
async fn find_called(translation: &Arc<Translation>, service: &str) -> Result<Arc<ServiceTwin>, BusError> {
    if let Some(known) = translation.called.lock().get(service).cloned() {
        return Ok(known);
    }
    let of = translation.inner.service_type(service).await?;
    let twin = translation.twins.service(&of);
    let twin = twin.map_err(|reason| not_translated(format!("service {service}"), reason))?;
    if translation.servant_version() == RosVersion::One {
        let mut called = translation.called.lock();
        if called.len() >= MAX_TYPES {
            called.clear();
        }
        called.insert(service.to_owned(), Arc::clone(&twin));
    }
    Ok(twin)
}

/// Reports a failure that a caller of ROS 2 cannot be told, and returns what it gets instead.
fn default_response(translation: &Translation, service: &str, of: &MessageType, reason: &str) -> Bytes {
    translation.losses.report_failed_call(service, reason);
    default_message(of).into()
}

/// Serves a service of the robot's ROS to the servant's nodes.
pub(super) async fn serve(
    translation: &Arc<Translation>,
    service: &str,
    of: &ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let (original, handler) = handler_for_servant(translation, service, of, handler)?;
    translation.inner.serve(service, original, handler).await
}

/// Returns a service with a type of the robot's ROS as the servant's nodes see it.
pub(super) fn handler_for_servant(
    translation: &Arc<Translation>,
    service: &str,
    of: &ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<(ServiceType, Arc<dyn ServiceHandler>), BusError> {
    let twin = translation.twins.service_with_twin(of).ok_or_else(|| {
        let reason = format!(
            "the service's image has no service type that corresponds to {} of ROS {}: push the package with the \
             package that defines it",
            of.name,
            translation.version.number()
        );
        not_translated(format!("service {service}"), reason)
    })?;
    let original = ServiceType::from_service(&twin.original);
    let translating =
        TranslatingHandler { translation: Arc::clone(translation), service: service.to_owned(), twin, handler };
    Ok((original, Arc::new(translating)))
}

/// Answers the servant's nodes with the answers of a handler of the robot's ROS.
struct TranslatingHandler {
    translation: Arc<Translation>,
    service: String,
    twin: Arc<ServiceTwin>,
    handler: Arc<dyn ServiceHandler>,
}

#[async_trait]
impl ServiceHandler for TranslatingHandler {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        match self.forward(&request, caller).await {
            Err(reason) if self.translation.servant_version() == RosVersion::Two => {
                Ok(default_response(&self.translation, &self.service, &self.twin.original.response, reason.as_str()))
            }
            answer => answer,
        }
    }
}

impl TranslatingHandler {
    async fn forward(&self, request: &[u8], caller: &str) -> Result<Bytes, FailureReason> {
        let losses = &self.translation.losses;
        let request = losses.translate(&self.service, &self.twin.request_to_twin, request);
        let request =
            request.map_err(|error| FailureReason::new(format!("the request is not carried to the robot: {error}")))?;
        let response = self.handler.call(request, caller).await?;
        let response = losses.translate(&self.service, &self.twin.response_from_twin, &response);
        response.map_err(|error| FailureReason::new(format!("the robot's response is not carried back: {error}")))
    }
}
