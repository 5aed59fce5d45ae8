//! Service calls made by a viewer.

use std::sync::Arc;
use std::time::Duration;

use access::Operation;
use bytes::Bytes;
use foxglove::ws_protocol::server::{ServiceCallFailure, ServiceCallResponse};
use foxglove::ws_protocol::{BinaryMessage, JsonMessage, client};
use ros::codec;
use ros::schema::ServiceDef;

use super::{FinishedTask, Session};
use crate::line::ViewerFrame;

/// Limit on one viewer's calls in flight.
const CALLS: usize = 32;
/// Timeout of a call.
const ANSWER: Duration = Duration::from_secs(60);

/// Upper bound on the bytes of a response before its payload: ids and the encoding's name.
const HEAD: usize = 64;

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
        let found = self.check_call(&call).and_then(|(service, of)| {
            let request = self.charge(call.payload.to_vec());
            let request = request.map_err(|full| format!("{service}: {full}"))?;
            Ok(CheckedCall {
                service,
                of,
                request,
            })
        });
        let CheckedCall {
            service,
            of,
            request,
        } = match found {
            Ok(found) => found,
            Err(words) => {
                let failure = ServiceCallFailure::new(service_id, call_id, words);
                return self.send_json(&failure);
            }
        };
        self.calls += 1;
        let (bus, out) = (Arc::clone(&self.bus), self.out.clone());
        let (encoding, budget) = (self.format.encoding, self.budget.clone());
        self.tasks.spawn(async move {
            let digest = of.md5.as_str().into();
            let answered = bus.call_typed(&service, &digest, request, ANSWER).await;
            let answered = answered.map_err(|error| error.to_string());
            let response = answered.and_then(|answer| {
                // Charged before it is copied.
                let permit = budget.take(HEAD + answer.len());
                let permit = permit.map_err(|full| format!("the answer: {full}"))?;
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
                Err(words) => {
                    let words = format!("{service}: {words}");
                    let failure = ServiceCallFailure::new(service_id, call_id, words);
                    ViewerFrame::Text(failure.to_string().into())
                }
            };
            let _ = out.send(message).await;
            FinishedTask::Call
        });
    }

    fn check_call(
        &self,
        call: &client::ServiceCallRequest<'_>,
    ) -> Result<(String, Arc<ServiceDef>), String> {
        let found = self.catalogue.service(call.service_id);
        let (service, of) =
            found.ok_or_else(|| format!("there is no service {}", call.service_id))?;
        let encoding = self.format.encoding;
        if call.encoding != encoding {
            return Err(format!(
                "{service}: requests must be encoded as {encoding}, not {}",
                call.encoding
            ));
        }
        if self.calls >= CALLS {
            return Err(format!(
                "{service}: a viewer may have {CALLS} calls in progress"
            ));
        }
        self.granted.check(Operation::Call, service)?;
        codec::validate(&of.request, &call.payload)
            .map_err(|error| format!("{service}: not a request of {}: {error}", of.name))?;
        Ok((service.clone(), Arc::clone(of)))
    }
}
