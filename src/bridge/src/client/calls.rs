//! `call_service`: a client calls a service of the servant, or one of rosapi's, which the bridge answers.

use std::borrow::Cow;
use std::future::Future;
use std::sync::Arc;
use std::task::{Context, Waker};
use std::time::{Duration, Instant};

use access::Operation;
use budget::{Exceeded, JsonWeight};
use bytes::Bytes;
use ros::bus::{BusError, CallFate, Digest, ServiceType};
use ros::codec::{self, CborOptions, CodecError, JsonOptions};
use ros::schema::{MessageType, SchemaError, ServiceDef};
use rosbridge::{CallService, Compression, Format, Id, Payload, Writer};

use super::decoding::{PayloadError, decode_args, read_raw};
use super::under_way::BeginCallError;
use super::{BridgeClient, ReplyTarget, payload_format};
use crate::NotGrantedError;
use crate::lacking::DefinitionError;
use crate::names::{DeclaredTypeError, ResolveNameError, digest_word, is_same_type, ros_type_name};
use crate::own;
use crate::own_service::{Caller, OwnService, OwnServiceError};
use crate::sample::EncodedFrame;

/// Maximum number of copies of the arguments of a call that the bridge answers itself, beside the parsed form: in its
/// answer, and while that is sent.
const COPIES: usize = 3;

/// Reasons why a client's call fails.
#[derive(Debug, thiserror::Error)]
enum ServiceCallError {
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error(transparent)]
    Begin(#[from] BeginCallError),
    #[error(transparent)]
    NotGranted(#[from] NotGrantedError),
    /// The service answers that it failed, or cannot be called.
    #[error(transparent)]
    Bus(BusError),
    /// The text is rosbridge_suite's: clients compare it.
    #[error("Timeout exceeded while waiting for service response")]
    Timeout(#[source] BusError),
    #[error(transparent)]
    Definition(#[from] DefinitionError),
    #[error(transparent)]
    OtherDefinition(#[from] Box<ServiceDigestError>),
    #[error(transparent)]
    OtherType(#[from] DeclaredTypeError),
    /// The arguments, or the values of an own service, are not those of the type.
    #[error(transparent)]
    Payload(#[from] PayloadError),
    /// The response cannot be encoded.
    #[error(transparent)]
    Print(#[from] Box<CodecError>),
    /// The definition of an own service is not available.
    #[error(transparent)]
    OwnDefinition(#[from] SchemaError),
    #[error("field \"args\": {0}")]
    NoRoom(#[from] Exceeded),
    #[error(transparent)]
    Own(#[from] OwnServiceError),
}

impl From<BusError> for ServiceCallError {
    fn from(error: BusError) -> Self {
        match error {
            BusError::Timeout { .. } => Self::Timeout(error),
            other => Self::Bus(other),
        }
    }
}

/// A service whose server has another definition of its type.
#[derive(Debug, thiserror::Error)]
#[error("service {service} has type {name} with {word} {theirs} there and {ours} here")]
struct ServiceDigestError {
    service: String,
    name: String,
    /// Term for the digests.
    word: &'static str,
    theirs: Digest,
    ours: Digest,
}

/// A call, independent of its frame.
struct ServiceCall {
    service: String,
    /// Name as the client wrote it, which it expects in the answer.
    written: String,
    /// Type given by the client.
    said: Option<String>,
    id: Option<Id<'static>>,
    args: Option<(Format, Bytes)>,
    timeout: Duration,
    compression: Compression,
    fragment_size: Option<usize>,
}

impl ServiceCall {
    fn reply(&self) -> ReplyTarget {
        ReplyTarget { id: self.id.clone(), format: payload_format(self.compression) }
    }

    fn args(&self) -> Option<Payload<'_>> {
        self.args.as_ref().map(|(format, bytes)| Payload { format: *format, bytes })
    }
}

impl BridgeClient {
    pub(super) fn call_service(self: &Arc<Self>, op: CallService<'_>, reply: &ReplyTarget) {
        self.shared.metrics.calls.add(1);
        let compression = op.compression.unwrap_or(match reply.format {
            Format::Json => Compression::None,
            Format::Cbor => Compression::Cbor,
        });
        let args = op.args;
        let call = ServiceCall {
            service: String::new(),
            written: op.service.clone().into_owned(),
            said: op.type_name.map(Cow::into_owned),
            id: reply.id.clone(),
            args: op.args.map(|args| (args.format, Bytes::copy_from_slice(args.bytes))),
            timeout: op.timeout.filter(|timeout| !timeout.is_zero()).unwrap_or(self.shared.options.call_timeout),
            compression,
            fragment_size: op.fragment_size,
        };
        let (service, guard) = match self
            .resolve(&op.service)
            .map_err(ServiceCallError::from)
            .and_then(|service| Ok((service, self.begin_call(args)?)))
        {
            Ok(found) => found,
            Err(error) => return self.answer_call_failed(&call, &error),
        };
        let call = ServiceCall { service: service.into_owned(), ..call };
        let client = self.clone();
        let mut call = Box::pin(async move {
            let _guard = guard;
            let answered = tokio::select! {
                () = client.wait_ended() => return,
                answered = client.answer(&call) => answered,
            };
            match answered {
                Ok(frame) => client.send_as(frame, call.compression, call.fragment_size),
                Err(error) => client.answer_call_failed(&call, &error),
            }
        });
        // The request is sent at once; the task that waits for the answer is spawned while the node handles it.
        if call.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending() {
            tokio::spawn(call);
        }
    }

    async fn answer(&self, call: &ServiceCall) -> Result<EncodedFrame, ServiceCallError> {
        self.wait_own_service(&call.service).await;
        let bus = &self.shared.bus;
        let server = bus.graph().borrow().services.get(&call.service).cloned();
        let own = server.is_none().then(|| own::find_own_service(&call.service)).flatten();
        if !own.as_ref().is_some_and(|own| own.is_filtered()) {
            self.client_grants().check(Operation::Call, &call.service)?;
        }
        if let Some(own) = own {
            return self.call_own_service(call, &*own).await;
        }
        let service_type = self.shared.service_types.find(self.shared.bus.as_ref(), &call.service).await?;
        let def = self.find_definition(call, &service_type);
        if let Ok(def) = &def {
            self.warn_surplus_args(&call.reply(), "call_service", &def.request, call.args());
        }
        let other = match self.declared_type_mismatch(call, &service_type.name) {
            // Its bytes could be misinterpreted.
            Some(other) if call.compression == Compression::CborRaw => return Err(other.into()),
            other => other,
        };
        let (def, request) = match (def, call.args()) {
            (Ok(def), args) => {
                let request = decode_args(&def.request, args, call.compression);
                let request = match (request, other) {
                    (Ok(request), None) => request,
                    (Ok(request), Some(other)) => {
                        self.warn(&call.reply(), &format!("call_service: {other}"));
                        request
                    }
                    (Err(_), Some(other)) => return Err(other.into()),
                    (Err(error), None) => return Err(error.into()),
                };
                let service = ("service", call.service.as_str());
                (Some(def), self.take_decoded(request, "call_service", service, &call.reply()))
            }
            // ROS bytes in both directions need no definition.
            (Err(_), Some(args)) if call.compression == Compression::CborRaw => {
                (None, Bytes::from(read_raw(args)?.into_owned()))
            }
            (Err(error), _) => return Err(error),
        };
        let of = def.as_ref().map(|def| &*def.request);
        self.shared.inputs.for_input(&call.service, of).record(&request);
        let asked = Instant::now();
        let response = self.shared.bus.call(&call.service, request, call.timeout).await;
        // Services of the robot's own clients say nothing about the servant.
        if server.is_none_or(|server| server != bus.node()) {
            let took = response.is_ok().then(|| asked.elapsed());
            self.shared.options.called.record(took);
        }
        let response = response.inspect_err(|error| {
            if matches!(error, BusError::CallFailed { fate: CallFate::Answered, .. }) {
                self.shared.metrics.calls_denied.add(1);
            }
        })?;
        Ok(self.response_frame(call, def.as_deref(), &response)?)
    }

    /// Returns the definition of a service's type; fails if the server has another one.
    fn find_definition(
        &self,
        call: &ServiceCall,
        service_type: &ServiceType,
    ) -> Result<Arc<ServiceDef>, ServiceCallError> {
        let def = self.shared.registry.service(&service_type.name);
        let def = def.map_err(|error| DefinitionError::new(self.version(), error))?;
        match differing_digests(service_type, &def) {
            None => Ok(def),
            Some((theirs, ours)) => Err(Box::new(ServiceDigestError {
                service: call.service.clone(),
                name: def.name.clone(),
                word: digest_word(self.version()),
                theirs,
                ours,
            })
            .into()),
        }
    }

    /// Returns the mismatch if the client gives another type than the service has. As in rosbridge_suite, a call whose
    /// arguments fit is made anyway.
    fn declared_type_mismatch(&self, call: &ServiceCall, theirs: &str) -> Option<DeclaredTypeError> {
        let said = call.said.as_deref().filter(|said| !is_same_type(said, theirs))?;
        Some(DeclaredTypeError::new(
            format!("service {}", call.service),
            theirs,
            &ros_type_name(self.version(), said, "srv"),
        ))
    }

    /// Waits for the registration of a service that this client has advertised and calls itself.
    async fn wait_own_service(&self, service: &str) {
        let registered = self.services.lock().registration(service);
        if let Some(mut registered) = registered {
            let known = registered.wait_for(|registered| *registered);
            let _ = tokio::time::timeout(self.shared.options.warm_up, known).await;
        }
    }

    /// Waits until everything this client has advertised is registered in ROS, so that its own operations appear to it
    /// in order. Waits only briefly; a failed registration is reported by a status message.
    async fn wait_registered(&self) {
        let topics: Vec<String> = self.topic_publishers.lock().topics().map(str::to_owned).collect();
        let services: Vec<String> = self.services.lock().names().map(str::to_owned).collect();
        let mut graph = self.shared.bus.graph();
        let known = graph.wait_for(|graph| {
            let published = |topic: &String| {
                let nodes = graph.topics.get(topic);
                nodes.is_some_and(|nodes| !nodes.publishers.is_empty())
            };
            topics.iter().all(published) && services.iter().all(|name| graph.services.contains_key(name))
        });
        let _ = tokio::time::timeout(self.shared.options.warm_up, known).await;
    }

    /// Answers a call of one of the bridge's own services.
    async fn call_own_service(
        &self,
        call: &ServiceCall,
        own: &dyn OwnService,
    ) -> Result<EncodedFrame, ServiceCallError> {
        if own.reads_graph() {
            self.wait_registered().await;
        }
        let def = own.definition(&self.shared)?;
        let args = self.own_service_args(call, &def)?;
        let mut held = self.budget.permit();
        held.count(JsonWeight::estimate(&args).bytes + COPIES * args.len())?;
        let grants = self.client_grants().grants();
        let caller = Caller { grants: &grants, budget: &self.budget };
        let values = own.answer(&self.shared, &args, &caller).await?;
        self.own_service_frame(call, &def, &values)
    }

    /// Returns the arguments of a call that the bridge answers, as a JSON object.
    fn own_service_args(&self, call: &ServiceCall, def: &ServiceDef) -> Result<Bytes, ServiceCallError> {
        match (call.args(), &call.args) {
            (None, _) => Ok(Bytes::from_static(b"{}")),
            (Some(args), Some((Format::Json, bytes)))
                if args.is_object() && call.compression != Compression::CborRaw =>
            {
                Ok(bytes.clone())
            }
            (args, _) => {
                let request = decode_args(&def.request, args, call.compression)?;
                let mut json = Vec::new();
                self.print_payload(&def.request, &request.bytes, Format::Json, &mut json)?;
                Ok(Bytes::from(json))
            }
        }
    }

    /// Builds the answer to such a call from JSON.
    fn own_service_frame(
        &self,
        call: &ServiceCall,
        def: &ServiceDef,
        values: &[u8],
    ) -> Result<EncodedFrame, ServiceCallError> {
        if matches!(call.compression, Compression::None | Compression::Png) {
            return answer_frame(call, Format::Json, |out| {
                out.extend_from_slice(values);
                Ok(())
            });
        }
        let values = Payload { format: Format::Json, bytes: values };
        let response = decode_args(&def.response, Some(values), Compression::None)?;
        Ok(self.response_frame(call, Some(def), &response.bytes)?)
    }

    fn response_frame(
        &self,
        call: &ServiceCall,
        def: Option<&ServiceDef>,
        response: &Bytes,
    ) -> Result<EncodedFrame, Box<CodecError>> {
        let format = payload_format(call.compression);
        let Some(def) = def.filter(|_| call.compression != Compression::CborRaw) else {
            let mut out = Vec::with_capacity(response.len() + 128);
            let mut writer = Writer::op(&mut out, format, "service_response", call.id.as_ref());
            writer.text("service", &call.written);
            writer.text("compression", Compression::CborRaw.name());
            writer.raw("values", None, response);
            writer.boolean("result", true);
            writer.end();
            return Ok(EncodedFrame::new(format, out));
        };
        answer_frame(call, format, |out| self.print_payload(&def.response, response, format, out))
    }

    /// Appends a serialized message as a payload of the format.
    pub(super) fn print_payload(
        &self,
        message_type: &MessageType,
        bytes: &[u8],
        format: Format,
        out: &mut Vec<u8>,
    ) -> Result<(), Box<CodecError>> {
        let json = JsonOptions {
            non_finite: self.shared.options.non_finite,
            max_bytes: self.shared.options.max_encoded,
            ..JsonOptions::default()
        };
        let cbor = CborOptions { max_bytes: self.shared.options.max_encoded, ..CborOptions::default() };
        let printed = match format {
            Format::Json => codec::to_json(message_type, bytes, out, &json),
            Format::Cbor => codec::to_cbor(message_type, bytes, out, &cbor),
        };
        printed.map_err(Box::new)
    }

    fn answer_call_failed(&self, call: &ServiceCall, error: &ServiceCallError) {
        self.shared.metrics.calls_failed.add(1);
        tracing::debug!(client = %self.name, service = %call.written, "call failed: {error}");
        let format = payload_format(call.compression);
        let mut out = Vec::with_capacity(256);
        let mut writer = Writer::op(&mut out, format, "service_response", call.id.as_ref());
        writer.text("service", &call.written);
        writer.text("values", &error.to_string());
        writer.boolean("result", false);
        writer.end();
        self.send_frame(EncodedFrame::new(format, out), call.fragment_size, true);
    }
}

/// Returns the digests, there and here, that differ between a server's type and the known one: of the service, or of
/// its request or response, whichever the server announces.
fn differing_digests(theirs: &ServiceType, def: &ServiceDef) -> Option<(Digest, Digest)> {
    let ours = ServiceType::from_service(def);
    let told = [&theirs.digest, &theirs.request, &theirs.response];
    let known = [ours.digest, ours.request, ours.response];
    let mut pairs = told.into_iter().cloned().zip(known);
    pairs.find(|(theirs, ours)| !theirs.is_compatible_with(ours))
}

fn answer_frame<E>(
    call: &ServiceCall,
    format: Format,
    values: impl FnOnce(&mut Vec<u8>) -> Result<(), E>,
) -> Result<EncodedFrame, E> {
    let mut out = Vec::with_capacity(256);
    let mut writer = Writer::op(&mut out, format, "service_response", call.id.as_ref());
    writer.text("service", &call.written);
    writer.value("values", values)?;
    writer.boolean("result", true);
    writer.end();
    Ok(EncodedFrame::new(format, out))
}
