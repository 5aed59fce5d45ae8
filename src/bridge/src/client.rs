//! One client: what it asked for, kept apart from the socket it asked through.

mod actions;
mod calls;
mod decoding;
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

use budget::Budget;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::RosVersion;
use ros::schema::MessageType;
use rosbridge::{
    Compression, Error, Format, Frame as Incoming, GoalStatus, Id, Level, Op, Payload, Qos, Status,
    Writer,
};
use tokio_util::sync::CancellationToken;

use crate::names;
use crate::outbox::{Control, Goodbye, Outbox};
use crate::quality::unheard;
use crate::sample::Frame;
use crate::shared::Shared;
use crate::{Granted, SessionOptions};
pub(crate) use inbox::Inbox;
use under_way::UnderWay;

/// Removes the entries of the names that are chosen.
fn take_chosen<T>(
    from: &mut HashMap<String, T>,
    chosen: impl Fn(&str) -> bool,
) -> Vec<(String, T)> {
    let names: Vec<String> = from.keys().filter(|name| chosen(name)).cloned().collect();
    let taken = names.iter().filter_map(|name| from.remove_entry(name));
    taken.collect()
}

/// Characters of a strange field's name that its sender is told.
const SHOWN: usize = 48;

/// The client.
pub(crate) struct Client {
    pub(crate) shared: Arc<Shared>,
    pub(crate) name: String,
    pub(crate) outbox: Arc<Outbox>,
    /// Counts what waits for it.
    pub(crate) budget: Budget,
    /// What it may do.
    granted: Mutex<Granted>,
    hears_clients: bool,
    resumable: bool,
    level: AtomicU8,
    /// Calls and goals under way.
    under_way: AtomicUsize,
    /// Bytes of their arguments.
    under_way_bytes: AtomicUsize,
    ended: CancellationToken,
    subscriptions: Mutex<subscribing::Subscribed>,
    topic_publishers: Mutex<publishing::TopicPublishers>,
    services: Mutex<serving::Services>,
    actions: Mutex<actions::Actions>,
}

/// Where an answer goes: to which interaction, in which format.
#[derive(Debug, Clone)]
pub(crate) struct Reply {
    pub(crate) id: Option<Id<'static>>,
    pub(crate) format: Format,
}

impl Client {
    /// Which ROS its servant speaks.
    fn version(&self) -> RosVersion {
        self.shared.bus.version()
    }

    /// The absolute form of a name that it has written.
    fn resolve<'n>(&self, name: &'n str) -> Result<Cow<'n, str>, String> {
        names::resolve(self.version(), name)
    }

    /// What it may do.
    pub(crate) fn granted(&self) -> Granted {
        self.granted.lock().clone()
    }

    /// It has come back: what it may do is told by its new connection from now on.
    pub(crate) fn grant(&self, granted: Granted) {
        *self.granted.lock() = granted;
    }

    pub(crate) fn new(shared: Arc<Shared>, options: &SessionOptions) -> Arc<Self> {
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
        })
    }

    /// It will not come back: gives up all it had.
    pub(crate) fn end(&self) {
        self.ended.cancel();
        // Dropped outside of the locks: what is dropped may want them.
        let subscriptions = std::mem::take(&mut *self.subscriptions.lock());
        drop(subscriptions);
        let topic_publishers = std::mem::take(&mut *self.topic_publishers.lock());
        drop(topic_publishers);
        let services = std::mem::take(&mut *self.services.lock());
        drop(services);
        let actions = std::mem::take(&mut *self.actions.lock());
        drop(actions);
    }

    /// Whether another socket may take over.
    pub(crate) fn is_resumable(&self) -> bool {
        self.resumable
    }

    pub(crate) async fn ended(&self) {
        self.ended.cancelled().await;
    }

    /// Takes a text frame.
    pub(crate) fn text(self: &Arc<Self>, inbox: &mut Inbox, text: &str) {
        self.frame(inbox, Incoming::Text(text), None, 0);
    }

    /// Takes a binary frame.
    pub(crate) fn binary(self: &Arc<Self>, inbox: &mut Inbox, bytes: &Bytes) {
        self.frame(inbox, Incoming::Binary(bytes), Some(bytes), 0);
    }

    fn frame(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        frame: Incoming<'_>,
        source: Option<&Bytes>,
        wrapping: usize,
    ) {
        let format = frame.format();
        let op = match Op::parse(frame) {
            Ok(op) => op,
            Err(error) => return self.refuse(frame, error),
        };
        if self.hears(Level::Warning) {
            for field in rosbridge::unknown_fields(frame) {
                let field: String = field.chars().take(SHOWN).collect();
                let text = format!(
                    "{}: field {field:?} is not known and was ignored",
                    op.name()
                );
                self.status(
                    Level::Warning,
                    op.id().cloned().map(Id::into_owned),
                    format,
                    &text,
                );
            }
        }
        let name = op.name();
        let reply = Reply {
            id: op.id().cloned().map(Id::into_owned),
            format,
        };
        if let Err(reason) = self.perform(inbox, op, &reply, source, wrapping) {
            let text = format!("{name}: {reason}");
            self.status(Level::Error, reply.id.clone(), format, &text);
            self.answer_is_lost(name, reply.id.as_ref(), &text);
        }
    }

    fn perform(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        op: Op<'_>,
        reply: &Reply,
        source: Option<&Bytes>,
        wrapping: usize,
    ) -> Result<(), String> {
        match op {
            Op::Publish(op) => self.publish(op, reply, source),
            Op::Fragment(op) => self.fragment(inbox, &op, wrapping),
            Op::Png(op) => self.png(inbox, &op, wrapping),
            Op::CallService(op) => self.call_service(op, reply),
            Op::ServiceResponse(op) => self.service_response(op),
            Op::Subscribe(op) => self.subscribe(op, reply),
            Op::Unsubscribe(op) => self.unsubscribe(&op, reply),
            Op::Advertise(op) => self.advertise(&op, reply),
            Op::Unadvertise(op) => self.unadvertise(&op, reply),
            Op::AdvertiseService(op) => self.advertise_service(&op, reply),
            Op::UnadvertiseService(op) => self.unadvertise_service(&op, reply),
            Op::SendActionGoal(op) => self.send_action_goal(op, reply),
            Op::CancelActionGoal(op) => self.cancel_action_goal(&op),
            Op::ActionFeedback(op) => self.action_feedback(&op),
            Op::ActionResult(op) => self.action_result(&op),
            Op::AdvertiseAction(op) => self.advertise_action(&op, reply),
            Op::UnadvertiseAction(op) => self.unadvertise_action(&op, reply),
            Op::SetLevel(op) => {
                self.level.store(op.level as u8, Ordering::Relaxed);
                Ok(())
            }
            Op::Status(op) => {
                tracing::debug!(client = %self.name, level = op.level.name(), "{}", op.msg);
                Ok(())
            }
            Op::Auth(_) => {
                self.info(
                    reply,
                    "auth: ignored, this server knows its clients by the token of their connection",
                );
                Ok(())
            }
        }
    }

    /// Tells that a message cannot be read; where somebody would wait for ever because of it, that its call has failed.
    fn refuse(&self, frame: Incoming<'_>, error: Error) {
        let (format, text) = (frame.format(), error.to_string());
        self.status(Level::Error, error.id.clone(), format, &text);
        let op = error.op.as_deref().unwrap_or_default();
        self.answer_is_lost(op, error.id.as_ref(), &text);
        let answer = match op {
            "call_service" => "service_response",
            "send_action_goal" => "action_result",
            _ => return,
        };
        let field = if op == "call_service" {
            "service"
        } else {
            "action"
        };
        let name = rosbridge::text_field(frame, field);
        // As old clients wrote the id.
        let suffix = name.as_deref().and_then(|name| name.split_once('#'));
        let id = error
            .id
            .or_else(|| suffix.map(|(_, id)| Id::from(id.to_owned())));
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
        self.send_frame(Frame::new(format, out), None, true);
    }

    /// Fails the call or goal to which the client has sent an answer that cannot be used: no other answer will come.
    fn answer_is_lost(&self, op: &str, id: Option<&Id<'_>>, reason: &str) {
        let Some(id) = id.map(Id::to_string) else {
            return;
        };
        match op {
            "service_response" => self.response_is_lost(&id, reason),
            "action_result" => self.result_is_lost(&id, reason),
            _ => {}
        }
    }

    pub(crate) fn hears(&self, level: Level) -> bool {
        level as u8 <= self.level.load(Ordering::Relaxed)
    }

    /// Sends a status message, if the client wants to hear at that level.
    pub(crate) fn status(&self, level: Level, id: Option<Id<'static>>, format: Format, text: &str) {
        if level == Level::Error {
            self.shared.metrics.errors.add(1);
            tracing::debug!(client = %self.name, "{text}");
        }
        if self.hears(level) {
            self.send(
                Status {
                    id,
                    level,
                    msg: text.into(),
                }
                .into(),
                format,
            );
        }
    }

    pub(crate) fn info(&self, reply: &Reply, text: &str) {
        self.status(Level::Info, reply.id.clone(), reply.format, text);
    }

    pub(crate) fn warn(&self, reply: &Reply, text: &str) {
        self.status(Level::Warning, reply.id.clone(), reply.format, text);
    }

    pub(crate) fn error(&self, reply: &Reply, text: &str) {
        self.status(Level::Error, reply.id.clone(), reply.format, text);
    }

    /// Sends a message that holds no payload, or one in `format`.
    pub(crate) fn send(&self, op: Op<'_>, format: Format) {
        let mut out = Vec::with_capacity(128);
        op.print(&mut out, format);
        self.send_frame(Frame::new(format, out), None, false);
    }

    /// Sends a frame made for this client alone. It counts in the client's budget until it is written; one that does not fit
    /// costs the client its connection, since an answer cannot be left out.
    pub(crate) fn send_frame(&self, frame: Frame, fragment_size: Option<usize>, answer: bool) {
        let permit = match frame.is_big() {
            true => match self.budget.take(frame.bytes.len()) {
                Ok(permit) => Some(permit),
                Err(full) => {
                    return self.outbox.say_goodbye(Goodbye {
                        code: 1013,
                        reason: format!("an answer cannot be kept: {full}"),
                    });
                }
            },
            false => None,
        };
        let frame = frame.holding(permit);
        self.outbox.control(Control {
            frame,
            fragment_size,
            answer,
        });
        if answer {
            self.shared.metrics.answers.add(1);
        }
    }

    /// Sends a frame printed in JSON or CBOR as the client wants it.
    pub(crate) fn send_as(
        &self,
        frame: Frame,
        compression: Compression,
        fragment_size: Option<usize>,
    ) {
        let wrapped = match compression {
            Compression::Png if frame.format == Format::Json => frame.clone().into_png(),
            _ => Ok(frame),
        };
        match wrapped {
            Ok(frame) => self.send_frame(frame, fragment_size, true),
            Err(reason) => self.status(Level::Error, None, Format::Json, &reason),
        }
    }

    /// Warns of policies in `qos` that mean nothing here.
    fn report_unheard(&self, op: &str, qos: Option<Qos>, subscribes: bool, reply: &Reply) {
        let unheard = qos.and_then(|qos| unheard(self.version(), &qos, subscribes));
        if let Some(unheard) = unheard {
            self.warn(reply, &format!("{op}: {unheard}"));
        }
    }

    /// Warns of arguments that the type has no fields for.
    fn report_surplus(
        &self,
        reply: &Reply,
        op: &str,
        message_type: &MessageType,
        args: Option<Payload<'_>>,
    ) {
        let fields = message_type.fields().len();
        if self.hears(Level::Warning)
            && let Some(found) = args.and_then(|args| args.list_len())
            && found > fields
        {
            let name = message_type.name();
            let text = format!(
                "{op}: {name} has {fields} fields, the last {} of \"args\" were left out",
                found - fields
            );
            self.warn(reply, &text);
        }
    }
}

/// How payloads for this compression are printed: in which format, and whether as ROS bytes.
fn print_format(compression: Compression) -> Format {
    match compression {
        Compression::None | Compression::Png => Format::Json,
        Compression::Cbor | Compression::CborRaw => Format::Cbor,
    }
}
