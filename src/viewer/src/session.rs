//! Session of one viewer.

mod calling;
mod connections;
mod publishing;
mod subscribing;

use std::collections::HashMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use access::Operation;
use bridge::ClientGrants;
use budget::{Budget, Exceeded, JsonWeight};
use bytes::Bytes;
use foxglove::ws_protocol::client::{self, ClientMessage};
use foxglove::ws_protocol::schema::Schema;
use foxglove::ws_protocol::server::advertise::Channel;
use foxglove::ws_protocol::server::advertise_services::Service;
use foxglove::ws_protocol::server::server_info::Capability;
use foxglove::ws_protocol::server::{
    Advertise, AdvertiseServices, ParameterValues, ServerInfo, Status, Unadvertise, UnadvertiseServices,
};
use foxglove::ws_protocol::{JsonMessage, ParseError};
use ros::bus::{Bus, Graph, WireType};
use ros::schema::{Registry, ServiceDef};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinError, JoinSet};
use tokio::time::timeout;
use ws::WebSocket;

use crate::catalogue::Catalogue;
use crate::format::ViewerFormat;
use crate::line::{ViewerFrame, ViewerInput, ViewerSocket};
use crate::parameters;
use publishing::ViewerPublication;
use subscribing::ViewerSubscription;

/// Supported subprotocols, newest first. Both denote the same version; the older name predates the SDK.
pub const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Maximum size of a JSON message in bytes: it may hold many small requests, each with a response. Publications are
/// binary.
const LARGEST_TEXT: usize = 1 << 20;
/// Number of outgoing messages queued; a slow viewer misses what is published meanwhile.
const OUTGOING: usize = 16;
/// Range of the per-topic queue size behind these, as requested by the viewer; the newest messages are kept.
pub const DEPTH: RangeInclusive<usize> = 2..=1000;
/// Time to wait for the connections of a topic's subscribers.
const CONNECTS: Duration = Duration::from_secs(2);
/// Maximum size of a message from a viewer in bytes.
const LARGEST: usize = 16 << 20;
/// Close codes (RFC 6455): the servant has ended; the permission was revoked.
const CLOSE_ENDED: u16 = 1012;
const CLOSE_NOT_ALLOWED: u16 = 1008;

/// Options of a viewer's session.
pub struct ViewerOptions {
    /// Display name of the server.
    pub name: String,
    /// Operations granted to the viewer.
    pub granted: ClientGrants,
    /// Budget for the bytes of its messages.
    pub budget: Budget,
    /// Timeout from the first byte of a viewer's message to its last.
    pub unfinished: Duration,
    /// Queue size per topic.
    pub depth: usize,
}

/// The servant that a viewer is connected to.
pub struct ViewedServant {
    /// The servant's ROS bus.
    pub bus: Arc<dyn Bus>,
    /// Message definitions of its image.
    pub registry: Arc<Registry>,
    /// Reason why the servant has ended, once it has.
    pub ended: watch::Receiver<Option<String>>,
    /// Guard, dropped when the viewer has disconnected.
    pub held: Box<dyn Send + Sync>,
}

/// Serves a viewer after its WebSocket upgrade until it disconnects or the servant ends. `servant` resolves to the
/// servant, or to a close code (RFC 6455) and a reason. `read_ahead` holds bytes already read from the connection.
pub async fn serve<S>(
    io: S,
    read_ahead: Bytes,
    servant: impl Future<Output = Result<ViewedServant, (u16, String)>>,
    options: ViewerOptions,
) where
    S: AsyncRead + AsyncWrite + Send + Unpin,
{
    let socket = WebSocket::new(io, &read_ahead, LARGEST, LARGEST);
    let mut line = ViewerSocket::new(socket.with_budget(&options.budget, options.unfinished));
    let ViewedServant { bus, registry, mut ended, held } = match servant.await {
        Ok(servant) => servant,
        Err((code, reason)) => return line.close(code, &reason, true).await,
    };
    let (out, mut outgoing) = mpsc::channel(OUTGOING);
    let (found, mut types) = mpsc::channel(OUTGOING);
    let mut graph = bus.graph();
    graph.mark_changed();
    let mut session = Session {
        format: ViewerFormat::for_version(bus.version()),
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
    session.send_server_info(&options.name);
    let end = loop {
        session.told.drain(..).for_each(|frame| line.send_reply(frame));
        // A viewer that does not read is sent no more messages; requests are read until their responses pile up.
        let (is_read, is_given) = (line.should_read(), line.can_send());
        tokio::select! {
            read = line.next(is_read) => match read {
                None => {}
                Some(ViewerInput::Message(is_text, message)) => session.handle_message(is_text, &message).await,
                Some(ViewerInput::Left) => break ViewerSessionEnd::Left,
                Some(ViewerInput::Lost) => break ViewerSessionEnd::Lost,
                Some(ViewerInput::Refused(code, reason, readable)) => {
                    break ViewerSessionEnd::Close(code, reason, readable);
                }
            },
            Some(frame) = outgoing.recv(), if is_given => line.send(frame),
            reason = wait_for_end(&mut ended) => break ViewerSessionEnd::Close(CLOSE_ENDED, reason, true),
            changed = graph.changed() => {
                if changed.is_err() {
                    break ViewerSessionEnd::Close(CLOSE_ENDED, "the servant has ended".to_owned(), true);
                }
                let now = Arc::clone(&graph.borrow_and_update());
                session.update_catalogue(&now);
            }
            Some(found) = types.recv() => session.advertise_resolved(found),
            Some(ended) = session.tasks.join_next() => session.on_task_finished(&ended),
            () = session.granted.wait_changed() => {
                if let Some(reason) = session.granted.end_reason() {
                    break ViewerSessionEnd::Close(CLOSE_NOT_ALLOWED, reason, true);
                }
                let now = Arc::clone(&graph.borrow_and_update());
                session.drop_revoked();
                session.update_catalogue(&now);
            }
        }
    };
    // What it has sent is published, even if it has disconnected by then.
    session.subscriptions.clear();
    session.publishers.clear();
    let published = async {
        while session.publishing > 0
            && let Some(ended) = session.tasks.join_next().await
        {
            session.on_task_finished(&ended);
        }
    };
    let _ = timeout(CONNECTS, published).await;
    session.told.drain(..).for_each(|frame| line.send(frame));
    drop((session, held));
    match end {
        ViewerSessionEnd::Close(code, reason, readable) => line.close(code, &reason, readable).await,
        // The answer to its close frame tells the viewer that everything is published.
        ViewerSessionEnd::Left => line.reply_close().await,
        ViewerSessionEnd::Lost => {}
    }
}

/// End of a session.
enum ViewerSessionEnd {
    /// The viewer sent a close frame.
    Left,
    /// The connection was lost.
    Lost,
    /// Close with a code and a reason; the flag tells whether incoming frames can still be parsed.
    Close(u16, String, bool),
}

/// Waits until the servant has ended and returns the reason.
async fn wait_for_end(ended: &mut watch::Receiver<Option<String>>) -> String {
    let reason = ended.wait_for(Option::is_some).await;
    let reason = reason.ok().and_then(|reason| reason.clone());
    reason.unwrap_or_else(|| "the servant has ended".to_owned())
}

/// A topic or service whose type was resolved.
enum ResolvedType {
    Topic(String, Arc<WireType>),
    Service(String, Arc<ServiceDef>),
}

/// A finished task of the session.
enum FinishedTask {
    Call,
    Published,
    Other,
}

struct Session {
    bus: Arc<dyn Bus>,
    /// Encodings of messages and their definitions.
    format: ViewerFormat,
    registry: Arc<Registry>,
    granted: ClientGrants,
    catalogue: Catalogue,
    subscriptions: HashMap<u32, ViewerSubscription>,
    publishers: HashMap<u32, ViewerPublication>,
    tasks: JoinSet<FinishedTask>,
    calls: usize,
    publishing: usize,
    /// Connection graph last sent, if the viewer subscribed to it.
    shows_graph: Option<Arc<Graph>>,
    budget: Budget,
    depth: usize,
    /// Replies to send as soon as possible.
    told: Vec<ViewerFrame>,
    /// Queue for the frames sent by tasks.
    out: mpsc::Sender<ViewerFrame>,
    found: mpsc::Sender<ResolvedType>,
}

impl Session {
    fn send_server_info(&mut self, name: &str) {
        let info = ServerInfo::new(name)
            .with_capabilities([
                Capability::ClientPublish,
                Capability::Parameters,
                Capability::Services,
                Capability::ConnectionGraph,
            ])
            .with_supported_encodings([self.format.encoding]);
        self.send_json(&info);
    }

    fn send_json(&mut self, message: &impl JsonMessage) {
        self.told.push(ViewerFrame::Text(message.to_string().into()));
    }

    /// Charges outgoing bytes to the viewer's budget until they are sent.
    fn charge(&self, bytes: impl Into<Bytes>) -> Result<Bytes, Exceeded> {
        let bytes = bytes.into();
        Ok(self.budget.take(bytes.len())?.wrap_bytes(bytes))
    }

    fn send_error(&mut self, words: impl Into<String>) {
        self.send_json(&Status::error(words));
    }

    /// Advertises new topics and services and withdraws those that have disappeared.
    fn update_catalogue(&mut self, graph: &Arc<Graph>) {
        let grants = self.granted.grants();
        let may = |topic: &str| grants.permits(Operation::Subscribe, topic);
        let changes = self.catalogue.update(graph, self.bus.node(), may);
        if !changes.channels_gone.is_empty() {
            let gone = &changes.channels_gone;
            self.subscriptions.retain(|_, one| !gone.contains(&one.channel));
            self.send_json(&Unadvertise::new(gone.iter().copied()));
        }
        if !changes.services_gone.is_empty() {
            self.send_json(&UnadvertiseServices::new(changes.services_gone));
        }
        for (topic, named) in changes.topics {
            match self.registry.message(&named) {
                Ok(message) => {
                    let of = Arc::new(WireType::from_message(&message));
                    self.advertise_resolved(ResolvedType::Topic(topic, of));
                }
                // The publisher tells the definitions of types that are not in the image.
                Err(_) => self.resolve_topic_type(topic),
            }
        }
        for service in changes.services {
            self.resolve_service_type(service);
        }
        self.send_graph_update(graph);
    }

    fn resolve_topic_type(&mut self, topic: String) {
        let (bus, found) = (Arc::clone(&self.bus), self.found.clone());
        self.tasks.spawn(async move {
            if let Ok(of) = bus.topic_type(&topic).await
                && !of.definition.is_empty()
            {
                let _ = found.send(ResolvedType::Topic(topic, Arc::new(of))).await;
            }
            FinishedTask::Other
        });
    }

    fn resolve_service_type(&mut self, service: String) {
        let (bus, found) = (Arc::clone(&self.bus), self.found.clone());
        let registry = Arc::clone(&self.registry);
        self.tasks.spawn(async move {
            if let Ok(of) = bus.service_type(&service).await
                && let Ok(of) = registry.service(&of.name)
            {
                let _ = found.send(ResolvedType::Service(service, of)).await;
            }
            FinishedTask::Other
        });
    }

    /// Advertises a topic or service whose type was resolved.
    fn advertise_resolved(&mut self, found: ResolvedType) {
        match found {
            ResolvedType::Topic(topic, of) => {
                let Some(id) = self.catalogue.add_topic(&topic, Arc::clone(&of)) else {
                    return;
                };
                let (encoding, kind) = (self.format.encoding, self.format.schema);
                let schema = Schema::new(&of.name, kind, of.definition.as_bytes());
                let channel = Channel::builder(id, &topic, encoding).with_schema(schema);
                if let Ok(channel) = channel.build() {
                    self.send_json(&Advertise::new([channel]));
                }
            }
            ResolvedType::Service(service, of) => {
                let Some(id) = self.catalogue.add_service(&service, Arc::clone(&of)) else {
                    return;
                };
                let (encoding, kind) = (self.format.encoding, self.format.schema);
                let schema = |name: &str, text: &str| Schema::new(name.to_owned(), kind, text.as_bytes().to_vec());
                let (request, response) = (&of.request, &of.response);
                let told = Service::new(id, &service, &of.name)
                    .with_request(encoding, schema(request.name(), request.full_text()))
                    .and_then(|told| told.with_response(encoding, schema(response.name(), response.full_text())));
                if let Ok(told) = told {
                    self.send_json(&AdvertiseServices::new([told]));
                }
            }
        }
    }

    fn on_task_finished(&mut self, ended: &Result<FinishedTask, JoinError>) {
        match ended {
            Ok(FinishedTask::Call) => self.calls -= 1,
            Ok(FinishedTask::Published) => self.publishing -= 1,
            _ => {}
        }
    }

    /// Ends subscriptions and publications whose permission was revoked.
    fn drop_revoked(&mut self) {
        let grants = self.granted.grants();
        let may = |operation, name: &str| grants.permits(operation, name);
        self.subscriptions.retain(|_, one| may(Operation::Subscribe, &one.topic));
        self.publishers.retain(|_, one| may(Operation::Publish, &one.topic));
    }

    async fn handle_message(&mut self, is_text: bool, message: &[u8]) {
        if is_text && message.len() > LARGEST_TEXT {
            return self.send_error(format!(
                "this message has {} bytes of JSON, but at most {LARGEST_TEXT} are allowed",
                message.len()
            ));
        }
        let mut held = self.budget.permit();
        if is_text {
            // Parameter values are parsed by the serde derive of the protocol crate's type.
            let weight = JsonWeight::estimate(message).bytes_if_copied();
            if let Err(full) = held.count(weight) {
                return self.send_error(format!("this message is not read: {full}"));
            }
        }
        let message = if is_text {
            std::str::from_utf8(message).map_err(ParseError::from).and_then(ClientMessage::parse_json)
        } else {
            ClientMessage::parse_binary(message)
        };
        let message = match message {
            Ok(message) => message,
            Err(error) => return self.send_error(format!("not a valid message: {error}")),
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
            ClientMessage::MessageData(message) => self.publish(message.channel_id, &message.data).await,
            ClientMessage::ServiceCallRequest(call) => self.call(call).await,
            ClientMessage::GetParameters(wanted) => {
                // The same permission as for rosbridge clients.
                if let Err(refused) = self.granted.check(Operation::Call, "/rosapi/get_param") {
                    return self.send_error(refused.to_string());
                }
                self.send_parameters(wanted.parameter_names, wanted.id).await;
            }
            ClientMessage::SetParameters(wanted) => self.set_parameters(wanted).await,
            ClientMessage::SubscribeConnectionGraph => {
                self.shows_graph = Some(Arc::default());
                let now = Arc::clone(&self.bus.graph().borrow());
                self.send_graph_update(&now);
            }
            ClientMessage::UnsubscribeConnectionGraph => self.shows_graph = None,
            _ => {
                let words = "this server does not support that: see its capabilities";
                self.send_error(words);
            }
        }
    }

    /// Sends the named parameters, or all if none is named.
    async fn send_parameters(&mut self, names: Vec<String>, id: Option<String>) {
        match parameters::get_parameters(&*self.bus, names).await {
            Ok(values) => {
                let told = ParameterValues::new(values);
                let told = match id {
                    Some(id) => told.with_id(id),
                    None => told,
                };
                match self.charge(told.to_string()) {
                    Ok(told) => self.told.push(ViewerFrame::Text(told)),
                    Err(full) => self.send_error(format!("parameters: {full}")),
                }
            }
            Err(error) => self.send_error(format!("parameters cannot be read: {error}")),
        }
    }

    async fn set_parameters(&mut self, wanted: client::SetParameters) {
        if let Err(refused) = self.granted.check(Operation::Call, "/rosapi/set_param") {
            return self.send_error(refused.to_string());
        }
        let mut names = Vec::new();
        for one in wanted.parameters {
            if let Err(error) = parameters::set_parameter(&*self.bus, &one.name, one.value).await {
                self.send_error(format!("{} cannot be set: {error}", one.name));
            }
            names.push(one.name);
        }
        if wanted.id.is_some() && !names.is_empty() {
            self.send_parameters(names, wanted.id).await;
        }
    }
}
