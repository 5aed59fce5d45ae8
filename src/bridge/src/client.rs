//! A client: its subscriptions, advertisements and calls, independent of the socket.

mod actions;
mod calls;
mod decoding;
mod dropped_seq;
mod inbox;
mod publishing;
mod serving;
mod subscribing;
mod under_way;
mod withdrawn;

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::RosVersion;
use ros::schema::MessageType;
use rosbridge::{
    Compression, Error, Format, GoalStatus, Id, Op, Payload, ProtocolFrame as Incoming, QosRequest, Status,
    StatusLevel, Writer,
};
use tokio_util::sync::CancellationToken;

pub(crate) use crate::client_state::{BridgeClient, ReplyTarget};
use crate::names::{self, ResolveNameError};
use crate::outbox::{CloseReason, ControlMessage, Outbox};
use crate::quality::ignored_policies;
use crate::sample::EncodedFrame;
use crate::shared::BridgeShared;
use crate::{ClientGrants, SessionOptions};
use actions::ClientActionError;
pub(crate) use inbox::Inbox;
use inbox::WrappedMessageError;
use publishing::PublishError;
use serving::ServingError;
use subscribing::SubscribeError;
use under_way::InFlightGuard;

/// Removes the entries whose names match.
fn remove_matching<T>(from: &mut HashMap<String, T>, chosen: impl Fn(&str) -> bool) -> Vec<(String, T)> {
    let names: Vec<String> = from.keys().filter(|name| chosen(name)).cloned().collect();
    let taken = names.iter().filter_map(|name| from.remove_entry(name));
    taken.collect()
}

/// Maximum length, in characters, of an unknown field's name in a status message.
const MAX_SHOWN_NAME: usize = 48;

/// Reasons why an operation is refused, of which the client is told.
#[derive(Debug, thiserror::Error)]
enum OperationError {
    #[error(transparent)]
    Name(#[from] ResolveNameError),
    #[error(transparent)]
    Publish(#[from] PublishError),
    #[error(transparent)]
    Subscribe(#[from] SubscribeError),
    #[error(transparent)]
    Serving(#[from] ServingError),
    #[error(transparent)]
    Action(#[from] ClientActionError),
    #[error(transparent)]
    Wrapped(#[from] WrappedMessageError),
}

impl BridgeClient {
    /// Returns the ROS version of its servant.
    fn version(&self) -> RosVersion {
        self.shared.bus.version()
    }

    /// Resolves a name written by the client to its absolute form.
    fn resolve<'n>(&self, name: &'n str) -> Result<Cow<'n, str>, ResolveNameError> {
        names::resolve(self.version(), name)
    }

    /// Returns its grants.
    pub(crate) fn client_grants(&self) -> ClientGrants {
        self.granted.lock().clone()
    }

    /// Replaces its grants by those of its new connection, when the client has come back.
    pub(crate) fn set_grants(&self, granted: ClientGrants) {
        *self.granted.lock() = granted;
    }

    pub(crate) fn new(shared: Arc<BridgeShared>, options: &SessionOptions) -> Arc<Self> {
        let budget = options.budget.clone();
        let outbox = Outbox::new(&shared.options, shared.metrics.clone(), &budget);
        let outbox = Arc::new(outbox);
        Arc::new(Self {
            shared,
            name: options.client.clone(),
            outbox,
            budget,
            granted: Mutex::new(options.granted.clone()),
            hears_clients: options.hears_clients,
            resumable: options.resume.is_some(),
            level: AtomicU8::new(options.level as u8),
            under_way: AtomicUsize::new(0),
            under_way_bytes: AtomicUsize::new(0),
            ended: CancellationToken::new(),
            subscriptions: Mutex::default(),
            topic_publishers: Mutex::default(),
            services: Mutex::default(),
            actions: Mutex::default(),
            seq_reported: Mutex::default(),
        })
    }

    /// Ends the client for good: releases everything it had.
    pub(crate) fn end(&self) {
        self.ended.cancel();
        // Dropped outside of the locks, since the values may take them in their drops.
        let subscriptions = std::mem::take(&mut *self.subscriptions.lock());
        drop(subscriptions);
        let topic_publishers = std::mem::take(&mut *self.topic_publishers.lock());
        drop(topic_publishers);
        let services = std::mem::take(&mut *self.services.lock());
        drop(services);
        let actions = std::mem::take(&mut *self.actions.lock());
        drop(actions);
    }

    /// Returns whether another socket may take over.
    pub(crate) fn is_resumable(&self) -> bool {
        self.resumable
    }

    pub(crate) async fn wait_ended(&self) {
        self.ended.cancelled().await;
    }

    /// Handles a text frame.
    pub(crate) fn on_text(self: &Arc<Self>, inbox: &mut Inbox, text: &str) {
        self.handle_frame(inbox, Incoming::Text(text), None, 0);
    }

    /// Handles a binary frame.
    pub(crate) fn on_binary(self: &Arc<Self>, inbox: &mut Inbox, bytes: &Bytes) {
        self.handle_frame(inbox, Incoming::from_binary(bytes), Some(bytes), 0);
    }

    fn handle_frame(self: &Arc<Self>, inbox: &mut Inbox, frame: Incoming<'_>, source: Option<&Bytes>, wrapping: usize) {
        let format = frame.format();
        let op = match Op::parse(frame) {
            Ok(op) => op,
            Err(error) => return self.report_invalid(frame, error),
        };
        if self.wants_level(StatusLevel::Warning) {
            for field in rosbridge::unknown_fields(frame) {
                let field: String = field.chars().take(MAX_SHOWN_NAME).collect();
                let text = format!("{}: field {field:?} is not known and was ignored", op.name());
                self.send_status(StatusLevel::Warning, op.id().cloned().map(Id::into_owned), format, &text);
            }
        }
        let name = op.name();
        let reply = ReplyTarget { id: op.id().cloned().map(Id::into_owned), format };
        if let Err(reason) = self.execute(inbox, op, &reply, source, wrapping) {
            let text = format!("{name}: {reason}");
            self.send_status(StatusLevel::Error, reply.id.clone(), format, &text);
            self.fail_lost_answer(name, reply.id.as_ref(), &text);
        }
    }

    fn execute(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        op: Op<'_>,
        reply: &ReplyTarget,
        source: Option<&Bytes>,
        wrapping: usize,
    ) -> Result<(), OperationError> {
        match op {
            Op::Publish(op) => self.publish(op, reply, source)?,
            Op::Fragment(op) => self.fragment(inbox, &op, wrapping)?,
            Op::Png(op) => self.png(inbox, &op, wrapping)?,
            Op::CallService(op) => self.call_service(op, reply),
            Op::ServiceResponse(op) => self.service_response(op, reply)?,
            Op::Subscribe(op) => self.subscribe(op, reply)?,
            Op::Unsubscribe(op) => self.unsubscribe(&op, reply),
            Op::Advertise(op) => self.advertise(&op, reply)?,
            Op::Unadvertise(op) => self.unadvertise(&op, reply)?,
            Op::AdvertiseService(op) => self.advertise_service(&op, reply)?,
            Op::UnadvertiseService(op) => self.unadvertise_service(&op, reply)?,
            Op::SendActionGoal(op) => self.send_action_goal(op, reply)?,
            Op::CancelActionGoal(op) => self.cancel_action_goal(&op)?,
            Op::ActionFeedback(op) => self.action_feedback(&op, reply)?,
            Op::ActionResult(op) => self.action_result(&op, reply)?,
            Op::AdvertiseAction(op) => self.advertise_action(&op, reply)?,
            Op::UnadvertiseAction(op) => self.unadvertise_action(&op, reply)?,
            Op::SetLevel(op) => self.level.store(op.level as u8, Ordering::Relaxed),
            Op::Status(op) => {
                tracing::debug!(client = %self.name, level = op.level.name(), "{}", op.msg);
            }
            Op::Auth(_) => {
                self.info(reply, "auth: ignored, this server knows its clients by the token of their connection")
            }
        }
        Ok(())
    }

    /// Reports a message that cannot be parsed; if the client waits for an answer to it, also reports the call as
    /// failed.
    fn report_invalid(&self, frame: Incoming<'_>, error: Error) {
        let (format, text) = (frame.format(), error.to_string());
        self.send_status(StatusLevel::Error, error.id.clone(), format, &text);
        let op = error.op.as_deref().unwrap_or_default();
        self.fail_lost_answer(op, error.id.as_ref(), &text);
        let answer = match op {
            "call_service" => "service_response",
            "send_action_goal" => "action_result",
            _ => return,
        };
        let field = if op == "call_service" { "service" } else { "action" };
        let name = rosbridge::text_field(frame, field);
        // Old clients wrote the id as a suffix.
        let suffix = name.as_deref().and_then(|name| name.split_once('#'));
        let id = error.id.or_else(|| suffix.map(|(_, id)| Id::from(id.to_owned())));
        let mut out = Vec::with_capacity(256);
        let mut writer = Writer::op(&mut out, format, answer, id.as_ref());
        if let Some(name) = &name {
            writer.text(field, name.split('#').next().unwrap_or_default());
        }
        writer.text("values", &text);
        if op == "send_action_goal" {
            writer.integer("status", GoalStatus::Unknown as i64);
        }
        writer.boolean("result", false);
        writer.end();
        self.send_frame(EncodedFrame::new(format, out), None, true);
    }

    /// Fails the call or goal to which the client has sent an unusable answer: no other answer will come.
    fn fail_lost_answer(&self, op: &str, id: Option<&Id<'_>>, reason: &str) {
        let Some(id) = id.map(Id::to_string) else {
            return;
        };
        match op {
            "service_response" => self.fail_lost_response(&id, reason),
            "action_result" => self.fail_lost_result(&id, reason),
            _ => {}
        }
    }

    pub(crate) fn wants_level(&self, level: StatusLevel) -> bool {
        level as u8 <= self.level.load(Ordering::Relaxed)
    }

    /// Sends a status message, if the client wants that level.
    pub(crate) fn send_status(&self, level: StatusLevel, id: Option<Id<'static>>, format: Format, text: &str) {
        if level == StatusLevel::Error {
            self.shared.metrics.errors.add(1);
            tracing::debug!(client = %self.name, "{text}");
        }
        if self.wants_level(level) {
            self.send(Status { id, level, msg: text.into() }.into(), format);
        }
    }

    pub(crate) fn info(&self, reply: &ReplyTarget, text: &str) {
        self.send_status(StatusLevel::Info, reply.id.clone(), reply.format, text);
    }

    pub(crate) fn warn(&self, reply: &ReplyTarget, text: &str) {
        self.send_status(StatusLevel::Warning, reply.id.clone(), reply.format, text);
    }

    pub(crate) fn error(&self, reply: &ReplyTarget, text: &str) {
        self.send_status(StatusLevel::Error, reply.id.clone(), reply.format, text);
    }

    /// Sends a message without payload, or with one in `format`.
    pub(crate) fn send(&self, op: Op<'_>, format: Format) {
        let mut out = Vec::with_capacity(128);
        op.print(&mut out, format);
        self.send_frame(EncodedFrame::new(format, out), None, false);
    }

    /// Sends a frame made for this client alone. It counts in the client's budget until it is written; if it does not
    /// fit, the connection is closed, since an answer must not be dropped.
    pub(crate) fn send_frame(&self, frame: EncodedFrame, fragment_size: Option<usize>, answer: bool) {
        let permit = if frame.is_big() {
            match self.budget.take(frame.bytes.len()) {
                Ok(permit) => Some(permit),
                Err(full) => {
                    return self.outbox.request_close(CloseReason {
                        code: 1013,
                        reason: format!("an answer cannot be kept: {full}"),
                    });
                }
            }
        } else {
            None
        };
        let frame = frame.with_permit(permit);
        self.outbox.push_control(ControlMessage { frame, fragment_size, answer });
        if answer {
            self.shared.metrics.answers.add(1);
        }
    }

    /// Sends a frame, printed in JSON or CBOR, in the client's encoding.
    pub(crate) fn send_as(&self, frame: EncodedFrame, compression: Compression, fragment_size: Option<usize>) {
        let wrapped = match compression {
            Compression::Png if frame.format == Format::Json => frame.clone().into_png(),
            _ => Ok(frame),
        };
        match wrapped {
            Ok(frame) => self.send_frame(frame, fragment_size, true),
            Err(error) => {
                self.send_status(StatusLevel::Error, None, Format::Json, &error.to_string());
            }
        }
    }

    /// Warns about policies in `qos` that have no effect here.
    fn warn_ignored_qos(&self, op: &str, qos: Option<QosRequest>, subscribes: bool, reply: &ReplyTarget) {
        let unheard = qos.and_then(|qos| ignored_policies(self.version(), &qos, subscribes));
        if let Some(unheard) = unheard {
            self.warn(reply, &format!("{op}: {unheard}"));
        }
    }

    /// Warns about more arguments than the type has fields.
    fn warn_surplus_args(&self, reply: &ReplyTarget, op: &str, message_type: &MessageType, args: Option<Payload<'_>>) {
        let fields = message_type.fields().len();
        if self.wants_level(StatusLevel::Warning)
            && let Some(found) = args.and_then(|args| args.list_len())
            && found > fields
        {
            let name = message_type.name();
            let text =
                format!("{op}: {name} has {fields} fields, the last {} of \"args\" were ignored", found - fields);
            self.warn(reply, &text);
        }
    }
}

/// Returns the format of payloads for this encoding; ROS bytes are in CBOR.
fn payload_format(compression: Compression) -> Format {
    match compression {
        Compression::None | Compression::Png => Format::Json,
        Compression::Preview | Compression::Cbor | Compression::CborRaw => Format::Cbor,
    }
}
