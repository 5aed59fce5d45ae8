//! Services that a viewer calls.

use std::sync::Arc;
use std::time::Duration;

use access::Operation;
use bytes::Bytes;
use foxglove::ws_protocol::server::{ServiceCallFailure, ServiceCallResponse};
use foxglove::ws_protocol::{BinaryMessage, JsonMessage, client};
use ros::codec;
use ros::schema::ServiceDef;

use super::{Ended, Session};
use crate::line::Frame;

/// Of one viewer, under way.
const CALLS: usize = 32;
/// For the answer to a call.
const ANSWER: Duration = Duration::from_secs(60);

impl Session {
    pub(super) async fn call(&mut self, call: client::ServiceCallRequest<'_>) {
        let (service_id, call_id) = (call.service_id, call.call_id);
        let (service, of) = match self.may_call(&call) {
            Ok(found) => found,
            Err(words) => {
                let failure = ServiceCallFailure::new(service_id, call_id, words);
                return self.tell(&failure);
            }
        };
        self.calls += 1;
        let (bus, out) = (Arc::clone(&self.bus), self.out.clone());
        let encoding = self.format.encoding;
        let request = Bytes::copy_from_slice(&call.payload);
        self.tasks.spawn(async move {
            let digest = of.md5.as_str().into();
            let answered = bus.call_typed(&service, &digest, request, ANSWER).await;
            let message = match answered {
                Ok(answer) => {
                    let response = ServiceCallResponse {
                        service_id,
                        call_id,
                        encoding: encoding.into(),
                        payload: (&answer[..]).into(),
                    };
                    Frame::Binary(response.to_bytes().into())
                }
                Err(error) => {
                    let words = format!("{service}: {error}");
                    let failure = ServiceCallFailure::new(service_id, call_id, words);
                    Frame::Text(failure.to_string())
                }
            };
            let _ = out.send(message).await;
            Ended::Call
        });
    }

    fn may_call(
        &self,
        call: &client::ServiceCallRequest<'_>,
    ) -> Result<(String, Arc<ServiceDef>), String> {
        let found = self.catalogue.service(call.service_id);
        let (service, of) =
            found.ok_or_else(|| format!("there is no service {}", call.service_id))?;
        let encoding = self.format.encoding;
        if call.encoding != encoding {
            return Err(format!(
                "{service}: requests are to be written as {encoding}, not {}",
                call.encoding
            ));
        }
        if self.calls >= CALLS {
            return Err(format!(
                "{service}: one viewer may have {CALLS} calls under way"
            ));
        }
        self.granted.check(Operation::Call, service)?;
        codec::validate(&of.request, &call.payload)
            .map_err(|error| format!("{service}: this is no request of {}: {error}", of.name))?;
        Ok((service.clone(), Arc::clone(of)))
    }
}
