//! `call_service`: a client calls a service of the servant, or one of rosapi's, which the bridge answers.

use std::borrow::Cow;
use std::future::Future;
use std::sync::Arc;
use std::task::{Context, Waker};
use std::time::{Duration, Instant};

use access::Operation;
use budget::JsonWeight;
use bytes::Bytes;
use ros::bus::{BusError, CallFate, Digest, ServiceType};
use ros::codec::{self, CborOptions, JsonOptions};
use ros::schema::{MessageType, ServiceDef};
use rosbridge::{CallService, Compression, Format, Id, Payload, Writer};

use super::decoding::decode_args;
use super::{Client, Reply, print_format};
use crate::lacking::explain;
use crate::names::{digest_word, is_same_type, other_type, spelled};
use crate::own::{self, OwnService};
use crate::sample::Frame;

/// A service of the bridge's own has what its arguments hold so often, at most, beside what is read of them: in its answer, and on the
/// way of that.
const COPIES: usize = 3;

/// A call, free of the frame it came in.
struct Call {
    service: String,
    /// As the client wrote it: that is what it looks for in the answer.
    written: String,
    /// The type that the client says.
    said: Option<String>,
    id: Option<Id<'static>>,
    args: Option<(Format, Bytes)>,
    timeout: Duration,
    compression: Compression,
    fragment_size: Option<usize>,
}

impl Call {
    fn reply(&self) -> Reply {
        Reply {
            id: self.id.clone(),
            format: print_format(self.compression),
        }
    }

    fn args(&self) -> Option<Payload<'_>> {
        self.args.as_ref().map(|(format, bytes)| Payload {
            format: *format,
            bytes,
        })
    }
}

impl Client {
    pub(super) fn call_service(
        self: &Arc<Self>,
        op: CallService<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        self.shared.metrics.calls.add(1);
        let compression = op.compression.unwrap_or(match reply.format {
            Format::Json => Compression::None,
            Format::Cbor => Compression::Cbor,
        });
        let args = op.args;
        let call = Call {
            service: String::new(),
            written: op.service.clone().into_owned(),
            said: op.type_name.map(Cow::into_owned),
            id: reply.id.clone(),
            args: op
                .args
                .map(|args| (args.format, Bytes::copy_from_slice(args.bytes))),
            timeout: op
                .timeout
                .filter(|timeout| !timeout.is_zero())
                .unwrap_or(self.shared.options.call_timeout),
            compression,
            fragment_size: op.fragment_size,
        };
        let (service, guard) = match self
            .resolve(&op.service)
            .and_then(|service| Ok((service, self.begin(args)?)))
        {
            Ok(found) => found,
            Err(reason) => {
                self.call_failed(&call, &reason);
                return Ok(());
            }
        };
        let call = Call {
            service: service.into_owned(),
            ..call
        };
        let client = self.clone();
        let mut call = Box::pin(async move {
            let _guard = guard;
            let answered = tokio::select! {
                () = client.ended() => return,
                answered = client.answer(&call) => answered,
            };
            match answered {
                Ok(frame) => client.send_as(frame, call.compression, call.fragment_size),
                Err(reason) => client.call_failed(&call, &reason),
            }
        });
        // The request goes out at once; a task that waits for the answer is made while the node works on it.
        if call
            .as_mut()
            .poll(&mut Context::from_waker(Waker::noop()))
            .is_pending()
        {
            tokio::spawn(call);
        }
        Ok(())
    }

    async fn answer(&self, call: &Call) -> Result<Frame, String> {
        self.serves_itself(&call.service).await;
        let bus = &self.shared.bus;
        let server = bus.graph().borrow().services.get(&call.service).cloned();
        let own = server.is_none().then(|| own::find(&call.service)).flatten();
        if !own.as_ref().is_some_and(|own| own.is_filtered()) {
            self.granted().check(Operation::Call, &call.service)?;
        }
        if let Some(own) = own {
            return self.answer_ourselves(call, &*own).await;
        }
        let service_type = self
            .shared
            .service_types
            .find(self.shared.bus.as_ref(), &call.service)
            .await
            .map_err(|error| error.to_string())?;
        let def = self
            .shared
            .registry
            .service(&service_type.name)
            .map_err(|error| explain(self.version(), error));
        let def = def.and_then(|def| match differing(&service_type, &def) {
            None => Ok(def),
            Some((theirs, ours)) => Err(format!(
                "service {} has type {} with {} {theirs} there and {ours} here",
                call.service,
                def.name,
                digest_word(self.version()),
            )),
        });
        if let Ok(def) = &def {
            self.report_surplus(&call.reply(), "call_service", &def.request, call.args());
        }
        let other = self.other_type(call, &service_type.name);
        let request = match (&def, call.compression, call.args()) {
            // Its bytes might be read as anything.
            (_, Compression::CborRaw, _) if other.is_some() => {
                return Err(other.unwrap_or_default());
            }
            (Ok(def), compression, args) => {
                let request = decode_args(&def.request, args, compression);
                let request = request.map_err(|problem| other.clone().unwrap_or(problem))?;
                if let Some(other) = other {
                    self.warn(&call.reply(), &format!("call_service: {other}"));
                }
                request
            }
            // ROS bytes both ways need no definition.
            (Err(_), Compression::CborRaw, Some(args)) => Bytes::from(
                args.raw()
                    .map_err(|error| error.to_string())?
                    .bytes
                    .into_owned(),
            ),
            (Err(reason), ..) => return Err(reason.clone()),
        };
        let of = def.as_ref().ok().map(|def| &*def.request);
        self.shared.inputs.of(&call.service, of).note(&request);
        let asked = Instant::now();
        let response = self
            .shared
            .bus
            .call(&call.service, request, call.timeout)
            .await;
        // What the robot's own clients serve says nothing of the servant.
        if server.is_none_or(|server| server != bus.node()) {
            let took = response.is_ok().then(|| asked.elapsed());
            self.shared.options.called.tell(took);
        }
        let response = response.map_err(|error| {
            if matches!(
                error,
                BusError::CallFailed {
                    fate: CallFate::Answered,
                    ..
                }
            ) {
                self.shared.metrics.calls_denied.add(1);
            }
            error.to_string()
        })?;
        self.response_frame(call, def.as_deref().ok(), &response)
    }

    /// That the client says another type than the service has. As rosbridge_suite does, a call whose arguments fit is made.
    fn other_type(&self, call: &Call, theirs: &str) -> Option<String> {
        let said = call
            .said
            .as_deref()
            .filter(|said| !is_same_type(said, theirs))?;
        let service = format!("service {}", call.service);
        Some(other_type(
            &service,
            theirs,
            &spelled(self.version(), said, "srv"),
        ))
    }

    /// Waits for the registration of a service that this client has advertised and calls itself.
    async fn serves_itself(&self, service: &str) {
        let registered = self.services.lock().registered(service);
        if let Some(mut registered) = registered {
            let known = registered.wait_for(|registered| *registered);
            let _ = tokio::time::timeout(self.shared.options.warm_up, known).await;
        }
    }

    /// Waits until what this client advertised before is known to ROS: its own operations are carried out in order, as it
    /// sees them. Not for long; what cannot be registered is told by a status.
    async fn is_registered(&self) {
        let topics: Vec<String> = self
            .topic_publishers
            .lock()
            .topics()
            .map(str::to_owned)
            .collect();
        let services: Vec<String> = self.services.lock().names().map(str::to_owned).collect();
        let mut graph = self.shared.bus.graph();
        let known = graph.wait_for(|graph| {
            let published = |topic: &String| {
                let nodes = graph.topics.get(topic);
                nodes.is_some_and(|nodes| !nodes.publishers.is_empty())
            };
            topics.iter().all(published)
                && services
                    .iter()
                    .all(|name| graph.services.contains_key(name))
        });
        let _ = tokio::time::timeout(self.shared.options.warm_up, known).await;
    }

    /// Answers a call of a service of the bridge's own.
    async fn answer_ourselves(&self, call: &Call, own: &dyn OwnService) -> Result<Frame, String> {
        if own.shows_graph() {
            self.is_registered().await;
        }
        let def = own.definition(&self.shared)?;
        let args = self.own_args(call, &def)?;
        let mut held = self.budget.permit();
        let counted = held.count(JsonWeight::of(&args).bytes + COPIES * args.len());
        counted.map_err(|full| format!("field \"args\": {full}"))?;
        let grants = self.granted().grants();
        let caller = own::Caller {
            grants: &grants,
            budget: &self.budget,
        };
        let values = own.answer(&self.shared, &args, &caller).await?;
        self.own_frame(call, &def, &values)
    }

    /// The arguments of a call that the bridge answers, as a JSON object.
    fn own_args(&self, call: &Call, def: &ServiceDef) -> Result<Bytes, String> {
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
                self.print_payload(&def.request, &request, Format::Json, &mut json)?;
                Ok(Bytes::from(json))
            }
        }
    }

    /// The answer to such a call, from JSON.
    fn own_frame(&self, call: &Call, def: &ServiceDef, values: &[u8]) -> Result<Frame, String> {
        if matches!(call.compression, Compression::None | Compression::Png) {
            return answer_frame(call, Format::Json, |out| {
                out.extend_from_slice(values);
                Ok(())
            });
        }
        let values = Payload {
            format: Format::Json,
            bytes: values,
        };
        let response = decode_args(&def.response, Some(values), Compression::None)?;
        self.response_frame(call, Some(def), &response)
    }

    fn response_frame(
        &self,
        call: &Call,
        def: Option<&ServiceDef>,
        response: &Bytes,
    ) -> Result<Frame, String> {
        let format = print_format(call.compression);
        let Some(def) = def.filter(|_| call.compression != Compression::CborRaw) else {
            let mut out = Vec::with_capacity(response.len() + 128);
            let mut writer = Writer::op(&mut out, format, "service_response", call.id.as_ref());
            writer.text("service", &call.written);
            writer.text("compression", Compression::CborRaw.name());
            writer.raw("values", None, response);
            writer.boolean("result", true);
            writer.end();
            return Ok(Frame::new(format, out));
        };
        answer_frame(call, format, |out| {
            self.print_payload(&def.response, response, format, out)
        })
    }

    /// Appends a serialized message as a payload of the format.
    pub(super) fn print_payload(
        &self,
        message_type: &MessageType,
        bytes: &[u8],
        format: Format,
        out: &mut Vec<u8>,
    ) -> Result<(), String> {
        let json = JsonOptions {
            non_finite: self.shared.options.non_finite,
            max_bytes: self.shared.options.max_encoded,
            ..JsonOptions::default()
        };
        let cbor = CborOptions {
            max_bytes: self.shared.options.max_encoded,
            ..CborOptions::default()
        };
        let printed = match format {
            Format::Json => codec::to_json(message_type, bytes, out, &json),
            Format::Cbor => codec::to_cbor(message_type, bytes, out, &cbor),
        };
        printed.map_err(|error| error.to_string())
    }

    fn call_failed(&self, call: &Call, reason: &str) {
        self.shared.metrics.calls_failed.add(1);
        tracing::debug!(client = %self.name, service = %call.written, "call failed: {reason}");
        let format = print_format(call.compression);
        let mut out = Vec::with_capacity(256);
        let mut writer = Writer::op(&mut out, format, "service_response", call.id.as_ref());
        writer.text("service", &call.written);
        writer.text("values", reason);
        writer.boolean("result", false);
        writer.end();
        self.send_frame(Frame::new(format, out), call.fragment_size, true);
    }
}

/// The digests, there and here, by which a server's type is another than the one that is known: of the service, or of its
/// requests or responses, whichever the server tells.
fn differing(theirs: &ServiceType, def: &ServiceDef) -> Option<(Digest, Digest)> {
    let ours = ServiceType::of(def);
    let told = [&theirs.digest, &theirs.request, &theirs.response];
    let known = [ours.digest, ours.request, ours.response];
    let mut pairs = told.into_iter().cloned().zip(known);
    pairs.find(|(theirs, ours)| !theirs.agrees(ours))
}

fn answer_frame<E>(
    call: &Call,
    format: Format,
    values: impl FnOnce(&mut Vec<u8>) -> Result<(), E>,
) -> Result<Frame, E> {
    let mut out = Vec::with_capacity(256);
    let mut writer = Writer::op(&mut out, format, "service_response", call.id.as_ref());
    writer.text("service", &call.written);
    writer.value("values", values)?;
    writer.boolean("result", true);
    writer.end();
    Ok(Frame::new(format, out))
}
