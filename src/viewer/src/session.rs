//! One viewer's connection.

mod calling;
mod connections;
mod publishing;
mod subscribing;

use std::collections::HashMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use access::Operation;
use bridge::Granted;
use budget::{Budget, Exceeded, JsonWeight};
use bytes::Bytes;
use foxglove::ws_protocol::JsonMessage;
use foxglove::ws_protocol::client::{self, ClientMessage};
use foxglove::ws_protocol::schema::Schema;
use foxglove::ws_protocol::server::advertise::Channel;
use foxglove::ws_protocol::server::advertise_services::Service;
use foxglove::ws_protocol::server::server_info::Capability;
use foxglove::ws_protocol::server::{
    Advertise, AdvertiseServices, ParameterValues, ServerInfo, Status, Unadvertise,
    UnadvertiseServices,
};
use ros::bus::{Bus, Graph, WireType};
use ros::schema::{Registry, ServiceDef};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinError, JoinSet};
use tokio::time::timeout;
use ws::WebSocket;

use crate::catalogue::Catalogue;
use crate::format::Format;
use crate::line::{Frame, Line, Read};
use crate::parameters;
use publishing::Published;
use subscribing::Subscribed;

/// Subprotocols that viewers ask for, the newest first. They are of one version: the older name is of the time before the protocol was
/// part of the SDK.
pub const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Bytes of a message in JSON: many small things, of which each may have an answer. Publications are binary.
const LARGEST_TEXT: usize = 1 << 20;
/// What waits to be sent, in messages; a viewer that reads slowly misses what comes meanwhile.
const OUTGOING: usize = 16;
/// Messages of a topic that may wait behind these, as the viewer asks; the newest win.
pub const DEPTH: RangeInclusive<usize> = 2..=1000;
/// For the connections of a topic's subscribers.
const CONNECTS: Duration = Duration::from_secs(2);
/// Bytes of a message from a viewer.
const LARGEST: usize = 16 << 20;
/// Close codes (RFC 6455): of a servant that ends, and of what is not allowed any more.
const ENDED: u16 = 1012;
const NOT_ALLOWED: u16 = 1008;

/// How a viewer is served.
pub struct ViewerOptions {
    /// What it sees: a name for people.
    pub name: String,
    /// What it may.
    pub granted: Granted,
    /// What of its messages may be held at once, in bytes.
    pub budget: Budget,
    /// Time from the first byte of a message of the viewer's to its last.
    pub unfinished: Duration,
    /// How many messages of a topic wait for it.
    pub depth: usize,
}

/// What is looked into.
pub struct Servant {
    /// Its ROS.
    pub bus: Arc<dyn Bus>,
    /// Its definitions.
    pub registry: Arc<Registry>,
    /// Why it has ended, once it has.
    pub ended: watch::Receiver<Option<String>>,
    /// Dropped when the viewer has gone.
    pub held: Box<dyn Send + Sync>,
}

/// Serves a viewer behind its upgrade, until it leaves or the servant ends, which is there once `servant` completes, or else refuses
/// with a code (RFC 6455) and words; `read_ahead` was read from it already.
pub async fn serve<S>(
    io: S,
    read_ahead: Bytes,
    servant: impl Future<Output = Result<Servant, (u16, String)>>,
    options: ViewerOptions,
) where
    S: AsyncRead + AsyncWrite + Send + Unpin,
{
    let socket = WebSocket::new(io, &read_ahead, LARGEST, LARGEST);
    let mut line = Line::new(socket.within(&options.budget, options.unfinished));
    let Servant {
        bus,
        registry,
        mut ended,
        held,
    } = match servant.await {
        Ok(servant) => servant,
        Err((code, reason)) => return line.close(code, &reason, true).await,
    };
    let (out, mut outgoing) = mpsc::channel(OUTGOING);
    let (found, mut types) = mpsc::channel(OUTGOING);
    let mut graph = bus.graph();
    graph.mark_changed();
    let mut session = Session {
        format: Format::of(bus.version()),
        bus,
        registry,
        granted: options.granted,
        catalogue: Catalogue::default(),
        subscriptions: HashMap::new(),
        publishers: HashMap::new(),
        tasks: JoinSet::new(),
        calls: 0,
        publishing: 0,
        shows_graph: None,
        budget: options.budget,
        depth: options.depth,
        told: Vec::new(),
        out,
        found,
    };
    session.greet(&options.name);
    let end = loop {
        session.told.drain(..).for_each(|frame| line.answer(frame));
        // Who does not read is given nothing more; and asked nothing more, once that makes more answers.
        let (is_read, is_given) = (line.is_read(), line.is_given());
        tokio::select! {
            read = line.next(is_read) => match read {
                None => {}
                Some(Read::Message(is_text, message)) => session.take(is_text, &message).await,
                Some(Read::Left) => break End::Left,
                Some(Read::Lost) => break End::Lost,
                Some(Read::Refused(code, reason, readable)) => {
                    break End::Close(code, reason, readable);
                }
            },
            Some(frame) = outgoing.recv(), if is_given => line.send(frame),
            reason = end(&mut ended) => break End::Close(ENDED, reason, true),
            changed = graph.changed() => {
                if changed.is_err() {
                    break End::Close(ENDED, "the servant has ended".to_owned(), true);
                }
                let now = Arc::clone(&graph.borrow_and_update());
                session.look(&now);
            }
            Some(found) = types.recv() => session.add(found),
            Some(ended) = session.tasks.join_next() => session.note(&ended),
            () = session.granted.changed() => {
                if let Some(reason) = session.granted.ended() {
                    break End::Close(NOT_ALLOWED, reason, true);
                }
                let now = Arc::clone(&graph.borrow_and_update());
                session.withdraw();
                session.look(&now);
            }
        }
    };
    // What it has sent is published, even if it has left by then.
    session.subscriptions.clear();
    session.publishers.clear();
    let published = async {
        while session.publishing > 0
            && let Some(ended) = session.tasks.join_next().await
        {
            session.note(&ended);
        }
    };
    let _ = timeout(CONNECTS, published).await;
    session.told.drain(..).for_each(|frame| line.send(frame));
    drop((session, held));
    match end {
        End::Close(code, reason, readable) => line.close(code, &reason, readable).await,
        // Who waits for the answer knows by it that all is published.
        End::Left => line.answer_goodbye().await,
        End::Lost => {}
    }
}

/// How a connection ends.
enum End {
    /// The viewer has said goodbye.
    Left,
    /// It is gone.
    Lost,
    /// With a code and a reason; whether the viewer's bytes can still be told apart.
    Close(u16, String, bool),
}

/// Returns once the servant has ended, why.
async fn end(ended: &mut watch::Receiver<Option<String>>) -> String {
    let reason = ended.wait_for(Option::is_some).await;
    let reason = reason.ok().and_then(|reason| reason.clone());
    reason.unwrap_or_else(|| "the servant has ended".to_owned())
}

/// A type that was asked for.
enum Found {
    Topic(String, Arc<WireType>),
    Service(String, Arc<ServiceDef>),
}

/// What a task of a session has done.
enum Ended {
    Call,
    Published,
    Other,
}

struct Session {
    bus: Arc<dyn Bus>,
    /// How messages are written, and how their definitions are.
    format: Format,
    registry: Arc<Registry>,
    granted: Granted,
    catalogue: Catalogue,
    subscriptions: HashMap<u32, Subscribed>,
    publishers: HashMap<u32, Published>,
    tasks: JoinSet<Ended>,
    calls: usize,
    publishing: usize,
    /// The graph that it was shown last, where it wants to see it.
    shows_graph: Option<Arc<Graph>>,
    budget: Budget,
    depth: usize,
    /// What it is to be told as soon as it can be.
    told: Vec<Frame>,
    /// What tasks tell.
    out: mpsc::Sender<Frame>,
    found: mpsc::Sender<Found>,
}

impl Session {
    fn greet(&mut self, name: &str) {
        let info = ServerInfo::new(name)
            .with_capabilities([
                Capability::ClientPublish,
                Capability::Parameters,
                Capability::Services,
                Capability::ConnectionGraph,
            ])
            .with_supported_encodings([self.format.encoding]);
        self.tell(&info);
    }

    fn tell(&mut self, message: &impl JsonMessage) {
        self.told.push(Frame::Text(message.to_string().into()));
    }

    /// What is to be sent, which counts as the viewer's until it is.
    fn counted(&self, bytes: impl Into<Bytes>) -> Result<Bytes, Exceeded> {
        let bytes = bytes.into();
        Ok(self.budget.take(bytes.len())?.around(bytes))
    }

    fn complain(&mut self, words: impl Into<String>) {
        self.tell(&Status::error(words));
    }

    /// Tells what has come and gone.
    fn look(&mut self, graph: &Arc<Graph>) {
        let grants = self.granted.grants();
        let may = |topic: &str| grants.permits(Operation::Subscribe, topic);
        let changes = self.catalogue.changes(graph, self.bus.node(), may);
        if !changes.channels_gone.is_empty() {
            let gone = &changes.channels_gone;
            self.subscriptions
                .retain(|_, one| !gone.contains(&one.channel));
            self.tell(&Unadvertise::new(gone.iter().copied()));
        }
        if !changes.services_gone.is_empty() {
            self.tell(&UnadvertiseServices::new(changes.services_gone));
        }
        for (topic, named) in changes.topics {
            match self.registry.message(&named) {
                Ok(message) => {
                    let of = Arc::new(WireType::of(&message));
                    self.add(Found::Topic(topic, of));
                }
                // What is not in the image is told by who publishes it.
                Err(_) => self.ask_topic(topic),
            }
        }
        for service in changes.services {
            self.ask_service(service);
        }
        self.show_graph(graph);
    }

    fn ask_topic(&mut self, topic: String) {
        let (bus, found) = (Arc::clone(&self.bus), self.found.clone());
        self.tasks.spawn(async move {
            if let Ok(of) = bus.topic_type(&topic).await
                && !of.definition.is_empty()
            {
                let _ = found.send(Found::Topic(topic, Arc::new(of))).await;
            }
            Ended::Other
        });
    }

    fn ask_service(&mut self, service: String) {
        let (bus, found) = (Arc::clone(&self.bus), self.found.clone());
        let registry = Arc::clone(&self.registry);
        self.tasks.spawn(async move {
            if let Ok(of) = bus.service_type(&service).await
                && let Ok(of) = registry.service(&of.name)
            {
                let _ = found.send(Found::Service(service, of)).await;
            }
            Ended::Other
        });
    }

    /// Tells of a topic or service whose type is known now.
    fn add(&mut self, found: Found) {
        match found {
            Found::Topic(topic, of) => {
                let Some(id) = self.catalogue.add_topic(&topic, Arc::clone(&of)) else {
                    return;
                };
                let (encoding, kind) = (self.format.encoding, self.format.schema);
                let schema = Schema::new(&of.name, kind, of.definition.as_bytes());
                let channel = Channel::builder(id, &topic, encoding).with_schema(schema);
                if let Ok(channel) = channel.build() {
                    self.tell(&Advertise::new([channel]));
                }
            }
            Found::Service(service, of) => {
                let Some(id) = self.catalogue.add_service(&service, Arc::clone(&of)) else {
                    return;
                };
                let (encoding, kind) = (self.format.encoding, self.format.schema);
                let schema = |name: &str, text: &str| {
                    Schema::new(name.to_owned(), kind, text.as_bytes().to_vec())
                };
                let (request, response) = (&of.request, &of.response);
                let told = Service::new(id, &service, &of.name)
                    .with_request(encoding, schema(request.name(), request.full_text()))
                    .and_then(|told| {
                        told.with_response(encoding, schema(response.name(), response.full_text()))
                    });
                if let Ok(told) = told {
                    self.tell(&AdvertiseServices::new([told]));
                }
            }
        }
    }

    fn note(&mut self, ended: &Result<Ended, JoinError>) {
        match ended {
            Ok(Ended::Call) => self.calls -= 1,
            Ok(Ended::Published) => self.publishing -= 1,
            _ => {}
        }
    }

    /// Ends what is not granted any more.
    fn withdraw(&mut self) {
        let grants = self.granted.grants();
        let may = |operation, name: &str| grants.permits(operation, name);
        self.subscriptions
            .retain(|_, one| may(Operation::Subscribe, &one.topic));
        self.publishers
            .retain(|_, one| may(Operation::Publish, &one.topic));
    }

    async fn take(&mut self, is_text: bool, message: &[u8]) {
        if is_text && message.len() > LARGEST_TEXT {
            return self.complain(format!(
                "this message has {} bytes of JSON, and {LARGEST_TEXT} are read at most",
                message.len()
            ));
        }
        let mut held = self.budget.permit();
        if is_text {
            // Values of parameters are read by what serde derives for a type of the protocol's crate.
            let weight = JsonWeight::of(message).bytes_if_copied();
            if let Err(full) = held.count(weight) {
                return self.complain(format!("this message is not read: {full}"));
            }
        }
        let message = if is_text {
            std::str::from_utf8(message)
                .map_err(|error| error.to_string())
                .and_then(|text| ClientMessage::parse_json(text).map_err(|error| error.to_string()))
        } else {
            ClientMessage::parse_binary(message).map_err(|error| error.to_string())
        };
        let message = match message {
            Ok(message) => message,
            Err(error) => return self.complain(format!("this is no message: {error}")),
        };
        match message {
            ClientMessage::Subscribe(wanted) => {
                for one in wanted.subscriptions {
                    self.subscribe(one.id, one.channel_id);
                }
            }
            ClientMessage::Unsubscribe(wanted) => {
                for id in wanted.subscription_ids {
                    self.subscriptions.remove(&id);
                }
            }
            ClientMessage::Advertise(wanted) => {
                for channel in wanted.channels {
                    self.advertise(channel).await;
                }
            }
            ClientMessage::Unadvertise(wanted) => {
                for id in wanted.channel_ids {
                    self.publishers.remove(&id);
                }
            }
            ClientMessage::MessageData(message) => {
                self.publish(message.channel_id, &message.data).await
            }
            ClientMessage::ServiceCallRequest(call) => self.call(call).await,
            ClientMessage::GetParameters(wanted) => {
                // As it is for clients of rosbridge.
                if let Err(refused) = self.granted.check(Operation::Call, "/rosapi/get_param") {
                    return self.complain(refused);
                }
                self.tell_parameters(wanted.parameter_names, wanted.id)
                    .await;
            }
            ClientMessage::SetParameters(wanted) => self.set_parameters(wanted).await,
            ClientMessage::SubscribeConnectionGraph => {
                self.shows_graph = Some(Arc::default());
                let now = Arc::clone(&self.bus.graph().borrow());
                self.show_graph(&now);
            }
            ClientMessage::UnsubscribeConnectionGraph => self.shows_graph = None,
            _ => {
                let words = "this server does not do that: see its capabilities";
                self.complain(words);
            }
        }
    }

    /// All of them where none is named.
    async fn tell_parameters(&mut self, names: Vec<String>, id: Option<String>) {
        match parameters::all(&*self.bus, names).await {
            Ok(values) => {
                let told = ParameterValues::new(values);
                let told = match id {
                    Some(id) => told.with_id(id),
                    None => told,
                };
                match self.counted(told.to_string()) {
                    Ok(told) => self.told.push(Frame::Text(told)),
                    Err(full) => self.complain(format!("parameters: {full}")),
                }
            }
            Err(error) => self.complain(format!("parameters cannot be read: {error}")),
        }
    }

    async fn set_parameters(&mut self, wanted: client::SetParameters) {
        if let Err(refused) = self.granted.check(Operation::Call, "/rosapi/set_param") {
            return self.complain(refused);
        }
        let mut names = Vec::new();
        for one in wanted.parameters {
            if let Err(error) = parameters::set(&*self.bus, &one.name, one.value).await {
                self.complain(format!("{} cannot be set: {error}", one.name));
            }
            names.push(one.name);
        }
        if wanted.id.is_some() && !names.is_empty() {
            self.tell_parameters(names, wanted.id).await;
        }
    }
}
