//! Service calls made by a viewer.

use std::sync::Arc;
use std::time::Duration;

use access::Operation;
use bridge::NotGrantedError;
use budget::Exceeded;
use bytes::Bytes;
use foxglove::ws_protocol::server::{ServiceCallFailure, ServiceCallResponse};
use foxglove::ws_protocol::{BinaryMessage, JsonMessage, client};
use ros::bus::BusError;
use ros::codec::{self, CodecError};
use ros::schema::ServiceDef;

use super::{FinishedTask, Session};
use crate::line::ViewerFrame;

/// Limit on one viewer's calls in flight.
const CALLS: usize = 32;
/// Timeout of a call.
const ANSWER: Duration = Duration::from_secs(60);

/// Upper bound on the bytes of a response before its payload: ids and the encoding's name.
const HEAD: usize = 64;

/// Reason why a viewer's call is not made.
#[derive(Debug, thiserror::Error)]
enum CallRefusal {
    /// No service has this id.
    #[error("there is no service {0}")]
    NoService(u32),
    /// The request is encoded in another way than the servant's messages.
    #[error("{service}: requests must be encoded as {expected}, not {given}")]
    Encoding {
        /// Name of the service.
        service: String,
        /// Encoding of the servant's messages.
        expected: &'static str,
        /// Encoding of the request.
        given: String,
    },
    /// As many calls of the viewer as allowed are in progress; contains the name of the service.
    #[error("{0}: a viewer may have {CALLS} calls in progress")]
    TooMany(String),
    /// The viewer may not call the service.
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    /// The request does not have the type of the service.
    #[error("{service}: not a request of {type_name}: {source}")]
    Malformed {
        /// Name of the service.
        service: String,
        /// Name of its type.
        type_name: String,
        /// Error of the request.
        source: Box<CodecError>,
    },
    /// The request does not fit into the viewer's budget.
    #[error("{service}: {source}")]
    NoMemory {
        /// Name of the service.
        service: String,
        /// The request for memory.
        source: Exceeded,
    },
}

/// Reason why a call has no response, or one that is not sent.
#[derive(Debug, thiserror::Error)]
enum CallFailure {
    /// The call failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The response does not fit into the viewer's budget.
    #[error("the answer: {0}")]
    NoMemory(#[from] Exceeded),
}

/// A service call that passed all checks.
struct CheckedCall {
    service: String,
    of: Arc<ServiceDef>,
    /// Charged to the viewer's budget.
    request: Bytes,
}

impl Session {
    pub(super) async fn call(&mut self, call: client::ServiceCallRequest<'_>) {
        let (service_id, call_id) = (call.service_id, call.call_id);
        let found = self.check_call(&call).and_then(|(service, of)| match self.charge(call.payload.to_vec()) {
            Ok(request) => Ok(CheckedCall { service, of, request }),
            Err(source) => Err(CallRefusal::NoMemory { service, source }),
        });
        let CheckedCall { service, of, request } = match found {
            Ok(found) => found,
            Err(refusal) => {
                let failure = ServiceCallFailure::new(service_id, call_id, refusal.to_string());
                return self.send_json(&failure);
            }
        };
        self.calls += 1;
        let (bus, out) = (Arc::clone(&self.bus), self.out.clone());
        let (encoding, budget) = (self.format.encoding, self.budget.clone());
        self.tasks.spawn(async move {
            let digest = of.md5.as_str().into();
            let answered = bus.call_typed(&service, &digest, request, ANSWER).await;
            let response = answered.map_err(CallFailure::from).and_then(|answer| {
                // Charged before it is copied.
                let permit = budget.take(HEAD + answer.len())?;
                let response = ServiceCallResponse {
                    service_id,
                    call_id,
                    encoding: encoding.into(),
                    payload: (&answer[..]).into(),
                };
                Ok(permit.wrap_bytes(response.to_bytes()))
            });
            let message = match response {
                Ok(response) => ViewerFrame::Binary(response),
                Err(error) => {
                    let words = format!("{service}: {error}");
                    let failure = ServiceCallFailure::new(service_id, call_id, words);
                    ViewerFrame::Text(failure.to_string().into())
                }
            };
            let _ = out.send(message).await;
            FinishedTask::Call
        });
    }

    fn check_call(&self, call: &client::ServiceCallRequest<'_>) -> Result<(String, Arc<ServiceDef>), CallRefusal> {
        let found = self.catalogue.service(call.service_id);
        let (service, of) = found.ok_or(CallRefusal::NoService(call.service_id))?;
        let encoding = self.format.encoding;
        if call.encoding != encoding {
            return Err(CallRefusal::Encoding {
                service: service.clone(),
                expected: encoding,
                given: call.encoding.clone().into_owned(),
            });
        }
        if self.calls >= CALLS {
            return Err(CallRefusal::TooMany(service.clone()));
        }
        self.granted.check(Operation::Call, service)?;
        codec::validate(&of.request, &call.payload).map_err(|error| CallRefusal::Malformed {
            service: service.clone(),
            type_name: of.name.clone(),
            source: Box::new(error),
        })?;
        Ok((service.clone(), Arc::clone(of)))
    }
}
