//! `advertise_service`, `unadvertise_service`, `service_response`: a client serves a service.

use std::sync::{Arc, Weak};

use access::Operation;
use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{FailureReason, ServiceHandler, ServiceType};
use ros::codec::CodecError;
use ros::schema::ServiceDef;
use rosbridge::{AdvertiseService, Compression, Id, ServiceResponse, UnadvertiseService, Writer};
use tokio::sync::{oneshot, watch};
use tokio_util::sync::CancellationToken;

use super::decoding::{PayloadError, decode_args};
use super::{BridgeClient, ReplyTarget, payload_format, remove_matching};
use crate::NotGrantedError;
use crate::client_state::{ClientServices, PendingCall, ServedService};
use crate::lacking::DefinitionError;
use crate::names::{ResolveNameError, lookup_name};
use crate::sample::EncodedFrame;

/// Reasons why a client may not serve a service, or why its answer to a call is not used.
#[derive(Debug, thiserror::Error)]
pub(super) enum ServingError {
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    #[error("service {service}: {source}")]
    Definition { service: String, source: DefinitionError },
    #[error("this client serves {0} services already; unadvertise one")]
    TooMany(usize),
    #[error("field \"id\" is missing, the id of the call is expected")]
    NoId,
    #[error("service {0} is not advertised by this client; advertise_service it first")]
    NotAdvertised(String),
    #[error("no call of {service} with id {id:?} waits for an answer")]
    NoCall { service: String, id: String },
    /// The call with this id is one of another service.
    #[error("the call with id {id:?} is one of {called}, not of {service}")]
    OtherService { id: String, called: String, service: String },
    /// The values are not those of the type.
    #[error(transparent)]
    Payload(#[from] PayloadError),
}

impl ClientServices {
    pub(super) fn len(&self) -> usize {
        self.served.len()
    }

    /// Removes the services whose names match; their unanswered calls fail.
    pub(super) fn take(&mut self, chosen: impl Fn(&str) -> bool) -> Vec<(String, ServedService)> {
        self.requests.retain(|_, request| !chosen(&request.service));
        remove_matching(&mut self.served, chosen)
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.served.keys().map(String::as_str)
    }

    /// Returns an id for the client's next call, in rosbridge_suite's form: its numbers begin at 1 for each client.
    fn next_request_id(&mut self, service: &str) -> String {
        self.requested += 1;
        format!("service_request:{service}:{}", self.requested)
    }

    /// Returns a receiver that tells whether a service of this client is registered.
    pub(super) fn registration(&self, service: &str) -> Option<watch::Receiver<bool>> {
        Some(self.served.get(service)?.registered.clone())
    }
}

/// Forwards calls to the client.
struct CallHandler {
    client: Weak<BridgeClient>,
    service: String,
    /// Name as the client wrote it.
    written: String,
    def: Arc<ServiceDef>,
    compression: Compression,
}

#[async_trait]
impl ServiceHandler for CallHandler {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let gone = || FailureReason::new(format!("the client that serves {} is gone", self.service));
        let client = self.client.upgrade().ok_or_else(gone)?;
        client.shared.metrics.calls_served.add(1);
        let id = client.services.lock().next_request_id(&self.service);
        let frame = self.frame(&client, &id, &request);
        let frame = frame.map_err(|error| FailureReason::new(error.to_string()))?;
        let (answer, answered) = oneshot::channel();
        let request = PendingCall { service: self.service.clone(), def: self.def.clone(), answer };
        client.services.lock().requests.insert(id.clone(), request);
        let _forget = ForgetOnDrop { client: self.client.clone(), id };
        let timeout = client.shared.options.call_timeout;
        client.send_as(frame, self.compression, None);
        drop(client);
        match tokio::time::timeout(timeout, answered).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) => Err(gone()),
            Err(_) => Err(FailureReason::new(format!(
                "the client that serves {} did not answer within {timeout:?}",
                self.service
            ))),
        }
    }
}

impl CallHandler {
    fn frame(&self, client: &BridgeClient, id: &str, request: &Bytes) -> Result<EncodedFrame, Box<CodecError>> {
        let format = payload_format(self.compression);
        let mut out = Vec::with_capacity(256 + request.len());
        let mut writer = Writer::op(&mut out, format, "call_service", Some(&Id::from(id)));
        writer.text("service", &self.written);
        if self.compression == Compression::CborRaw {
            writer.text("compression", self.compression.name());
            writer.raw("args", None, request);
        } else {
            writer.value("args", |out| client.print_payload(&self.def.request, request, format, out))?;
        }
        writer.end();
        Ok(EncodedFrame::new(format, out))
    }
}

/// Removes a call when its caller no longer waits.
struct ForgetOnDrop {
    client: Weak<BridgeClient>,
    id: String,
}

impl Drop for ForgetOnDrop {
    fn drop(&mut self) {
        if let Some(client) = self.client.upgrade() {
            client.services.lock().requests.remove(&self.id);
        }
    }
}

impl BridgeClient {
    pub(super) fn advertise_service(
        self: &Arc<Self>,
        op: &AdvertiseService<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ServingError> {
        let service = self.resolve(&op.service)?.into_owned();
        self.client_grants().check(Operation::Advertise, &service)?;
        let def = self.shared.registry.service(&lookup_name(self.version(), &op.type_name)).map_err(|error| {
            ServingError::Definition { service: service.clone(), source: DefinitionError::new(self.version(), error) }
        })?;
        let limit = self.shared.options.max_advertisements;
        let number = self.shared.next_number();
        let stop = CancellationToken::new();
        let mut services = self.services.lock();
        if services.len() >= limit && !services.served.contains_key(&service) {
            return Err(ServingError::TooMany(limit));
        }
        let (now_registered, registered) = watch::channel(false);
        let served = ServedService { number, registered, _stop: stop.clone().drop_guard() };
        let earlier = services.served.insert(service.clone(), served);
        drop(services);
        if earlier.is_some() {
            self.warn(reply, &format!("advertise_service: {service} was advertised before, the new one replaces it"));
        }
        drop(earlier);
        self.warn_of_takeover(&service, reply);
        let handler = Arc::new(CallHandler {
            client: Arc::downgrade(self),
            service: service.clone(),
            written: op.service.clone().into_owned(),
            def: def.clone(),
            compression: op.compression,
        });
        let (client, reply) = (Arc::downgrade(self), reply.clone());
        let shared = self.shared.clone();
        tokio::spawn(async move {
            let service_type = ServiceType::from_service(&def);
            // An earlier handler of this client is released at once; another client's is not.
            let patience = std::time::Duration::from_secs(1);
            let entered = tokio::time::timeout(patience, shared.registrations.acquire(&service)).await;
            let Ok(registration) = entered else {
                if let Some(client) = client.upgrade() {
                    client.services.lock().served.retain(|_, other| other.number != number);
                    client.error(&reply, &format!("advertise_service: another client serves {service} already"));
                }
                return;
            };
            if stop.is_cancelled() {
                return;
            }
            match shared.bus.serve(&service, service_type, handler).await {
                Ok(registered) => {
                    now_registered.send_replace(true);
                    if let Some(client) = client.upgrade() {
                        client.info(&reply, &format!("advertise_service: advertised {service}"));
                    }
                    stop.cancelled().await;
                    drop(registered);
                }
                Err(error) => {
                    if let Some(client) = client.upgrade() {
                        client.services.lock().served.retain(|_, other| other.number != number);
                        client.error(&reply, &format!("advertise_service: {error}"));
                    }
                }
            }
            drop(registration);
        });
        Ok(())
    }

    /// Warns that the client takes over a service: the last registration wins, so the node that served it is no longer
    /// called.
    fn warn_of_takeover(&self, service: &str, reply: &ReplyTarget) {
        let bus = &self.shared.bus;
        let graph = bus.graph().borrow().clone();
        if let Some(node) = graph.services.get(service)
            && node != bus.node()
        {
            self.warn(reply, &format!("advertise_service: {service} was served by {node}, this client replaces it"));
        }
    }

    pub(super) fn unadvertise_service(
        &self,
        op: &UnadvertiseService<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ResolveNameError> {
        let service = self.resolve(&op.service)?;
        let mut services = self.services.lock();
        let gone = services.served.remove(&*service);
        let unanswered: Vec<_> = services
            .requests
            .iter()
            .filter(|(_, request)| *request.service == *service)
            .map(|(id, _)| id.clone())
            .collect();
        let unanswered: Vec<_> = unanswered.iter().filter_map(|id| services.requests.remove(id)).collect();
        drop(services);
        for request in unanswered {
            let reason = format!("{service} was unadvertised before it answered");
            // An error means that the caller has given up.
            let _ = request.answer.send(Err(FailureReason::new(reason)));
        }
        match gone {
            Some(_) => self.info(reply, &format!("unadvertise_service: {service} is no longer advertised")),
            None => self.warn(reply, &format!("unadvertise_service: this client does not advertise {service}")),
        }
        Ok(())
    }

    /// Fails the call whose answer from the client is unusable, so that its caller does not wait forever.
    pub(super) fn fail_lost_response(&self, id: &str, reason: &str) {
        let request = self.services.lock().requests.remove(id);
        if let Some(PendingCall { answer, .. }) = request {
            let reason = format!("the client's answer cannot be used: {reason}");
            // An error means that the caller has given up.
            let _ = answer.send(Err(FailureReason::new(reason)));
        }
    }

    pub(super) fn service_response(&self, op: ServiceResponse<'_>, reply: &ReplyTarget) -> Result<(), ServingError> {
        let service = self.resolve(&op.service)?;
        let id = op.id.as_ref().ok_or(ServingError::NoId)?.to_string();
        let mut services = self.services.lock();
        match services.requests.get(&id) {
            None if !services.served.contains_key(&*service) => {
                return Err(ServingError::NotAdvertised(service.into_owned()));
            }
            None => {
                let service = service.into_owned();
                return Err(ServingError::NoCall { service, id });
            }
            Some(request) if *request.service != *service => {
                return Err(ServingError::OtherService {
                    id,
                    called: request.service.clone(),
                    service: service.into_owned(),
                });
            }
            Some(_) => {}
        }
        let Some(PendingCall { def, answer, .. }) = services.requests.remove(&id) else {
            return Ok(());
        };
        drop(services);
        // A failure has a reason as text. Clients of the first rosbridge return failure with values: then the caller
        // gets the values.
        let has_values = op.values.is_some_and(|values| values.is_object() || values.is_list());
        if !op.result && !has_values {
            let reason = op.values.and_then(|values| values.text()).unwrap_or_default();
            let reason = if reason.is_empty() {
                format!("service {service} failed without a reason")
            } else {
                reason.into_owned()
            };
            // An error means that the caller has given up.
            let _ = answer.send(Err(FailureReason::new(reason)));
            return Ok(());
        }
        match decode_args(&def.response, op.values, op.compression) {
            Ok(response) => {
                let response = self.take_decoded(response, "service_response", ("service", &service), reply);
                let _ = answer.send(Ok(response));
                Ok(())
            }
            Err(error) => {
                let reason = format!("the client's answer does not fit: {error}");
                let _ = answer.send(Err(FailureReason::new(reason)));
                Err(error.into())
            }
        }
    }
}
