//! One viewer's connection.

use std::collections::HashMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use access::Operation;
use bridge::Granted;
use budget::Budget;
use bytes::{BufMut, Bytes, BytesMut};
use foxglove::ws_protocol::client::{self, ClientMessage};
use foxglove::ws_protocol::schema::Schema;
use foxglove::ws_protocol::server::advertise::Channel;
use foxglove::ws_protocol::server::advertise_services::Service;
use foxglove::ws_protocol::server::connection_graph_update::{
    AdvertisedService, PublishedTopic, SubscribedTopic,
};
use foxglove::ws_protocol::server::server_info::Capability;
use foxglove::ws_protocol::server::{
    Advertise, AdvertiseServices, ConnectionGraphUpdate, ParameterValues, ServerInfo,
    ServiceCallFailure, ServiceCallResponse, Status, Unadvertise, UnadvertiseServices,
};
use foxglove::ws_protocol::{BinaryMessage, JsonMessage};
use ros::bus::{Bus, Graph, Publisher, Qos, Subscription, WireType, reaches};
use ros::codec;
use ros::schema::{MessageType, Registry, ServiceDef};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinError, JoinSet};
use tokio::time::timeout;
use ws::WebSocket;

use crate::catalogue::Catalogue;
use crate::format::Format;
use crate::line::{Frame, Line, Read};
use crate::parameters;

/// Subprotocols that viewers ask for, the newest first. They are of one version: the older name is of the time before the protocol was
/// part of the SDK.
pub const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Bytes of a message in JSON: many small things, of which each may have an answer. Publications are binary.
const LARGEST_TEXT: usize = 1 << 20;
/// What waits to be sent, in messages; a viewer that reads slowly misses what comes meanwhile.
const OUTGOING: usize = 16;
/// Messages of a topic that may wait behind these, as the viewer asks; the newest win.
pub const DEPTH: RangeInclusive<usize> = 2..=1000;
/// Messages of a viewer's topic that wait for a slow node, at least.
const PUBLISHED: usize = 10;
/// For the connections of a topic's subscribers.
const CONNECTS: Duration = Duration::from_secs(2);
/// Between two words about messages that a topic's reader missed.
const MISSED: Duration = Duration::from_secs(5);
/// Of one viewer.
const SUBSCRIPTIONS: usize = 512;
const ADVERTISEMENTS: usize = 512;
const CALLS: usize = 32;
/// Bytes of a message from a viewer.
const LARGEST: usize = 16 << 20;
/// Close codes (RFC 6455): of a servant that ends, and of what is not allowed any more.
const ENDED: u16 = 1012;
const NOT_ALLOWED: u16 = 1008;
/// For the answer to a call.
const ANSWER: Duration = Duration::from_secs(60);

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

/// A topic that the viewer publishes.
struct Published {
    topic: String,
    /// None where it was refused, which was told.
    publishing: Option<Publishing>,
}

/// Where its messages go, and what they are.
struct Publishing {
    of: Arc<MessageType>,
    messages: mpsc::Sender<Bytes>,
}

/// A subscription of the viewer's, until dropped.
struct Subscribed {
    channel: u64,
    topic: String,
    task: tokio::task::AbortHandle,
}

impl Drop for Subscribed {
    fn drop(&mut self) {
        self.task.abort();
    }
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
        self.told.push(Frame::Text(message.to_string()));
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
        let message = match is_text {
            true => std::str::from_utf8(message)
                .map_err(|error| error.to_string())
                .and_then(|text| {
                    ClientMessage::parse_json(text).map_err(|error| error.to_string())
                }),
            false => ClientMessage::parse_binary(message).map_err(|error| error.to_string()),
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

    fn subscribe(&mut self, id: u32, channel: u64) {
        let Some((topic, of)) = self.catalogue.channel(channel).cloned() else {
            return self.complain(format!("there is no channel {channel}"));
        };
        if self.subscriptions.contains_key(&id) {
            return self.complain(format!("subscription {id} is there already"));
        }
        if self.subscriptions.len() >= SUBSCRIPTIONS {
            let words = format!("{topic}: one viewer may have {SUBSCRIPTIONS} subscriptions");
            return self.complain(words);
        }
        if let Err(refused) = self.granted.check(Operation::Subscribe, &topic) {
            return self.complain(refused);
        }
        let (bus, out) = (Arc::clone(&self.bus), self.out.clone());
        let (listened, budget) = (topic.clone(), self.budget.clone());
        let qos = Qos::keep_last(self.depth).latching(true);
        let task = self.tasks.spawn(async move {
            match bus.subscribe(&listened, WireType::clone(&of), qos).await {
                Ok(subscription) => {
                    let mut reader = Reader {
                        id,
                        topic: listened,
                        budget,
                        out,
                        missed: 0,
                        told: (0, Instant::now()),
                    };
                    reader.passes(subscription).await;
                }
                Err(error) => {
                    let words = format!("{listened} cannot be subscribed to: {error}");
                    let _ = out
                        .send(Frame::Text(Status::error(words).to_string()))
                        .await;
                }
            }
            Ended::Other
        });
        let subscribed = Subscribed {
            channel,
            topic,
            task,
        };
        self.subscriptions.insert(id, subscribed);
    }

    async fn publish(&mut self, id: u32, message: &[u8]) {
        let Some(published) = self.publishers.get(&id) else {
            let words = format!("channel {id} is not advertised by this viewer");
            return self.complain(words);
        };
        let Some(Publishing { of, messages }) = &published.publishing else {
            return;
        };
        if let Err(error) = codec::validate(of, message) {
            let words = format!("{}: this is no {}: {error}", published.topic, of.name());
            return self.complain(words);
        }
        match self.budget.take(message.len()) {
            // It is taken for as long as the sender is there.
            Ok(permit) => drop(messages.send(permit.around(message.to_vec())).await),
            Err(exceeded) => {
                self.complain(format!("{}: {exceeded}", published.topic));
            }
        }
    }

    async fn advertise(&mut self, channel: client::advertise::Channel<'_>) {
        let id = channel.id;
        if self.publishers.contains_key(&id) {
            return self.complain(format!("channel {id} is there already"));
        }
        let topic = channel.topic.clone().into_owned();
        if self.publishers.len() >= ADVERTISEMENTS {
            let words = format!("{topic}: one viewer may advertise {ADVERTISEMENTS} topics");
            return self.complain(words);
        }
        let publishing = match self.publisher(&topic, &channel).await {
            Ok((of, publisher)) => Some(Publishing {
                of,
                messages: self.publishing(&topic, publisher),
            }),
            Err(words) => {
                self.complain(words);
                None
            }
        };
        self.publishers.insert(id, Published { topic, publishing });
    }

    async fn publisher(
        &self,
        topic: &str,
        channel: &client::advertise::Channel<'_>,
    ) -> Result<(Arc<MessageType>, Box<dyn Publisher>), String> {
        let encoding = self.format.encoding;
        if channel.encoding != encoding {
            return Err(format!(
                "{topic}: messages are to be written as {encoding}, not {}",
                channel.encoding
            ));
        }
        self.granted.check(Operation::Publish, topic)?;
        let message = self.registry.message(&channel.schema_name);
        let message = message.map_err(|error| format!("{topic}: {error}"))?;
        let qos = Qos::keep_last(self.depth.max(PUBLISHED));
        let publisher = self.bus.advertise(topic, WireType::of(&message), qos).await;
        let publisher =
            publisher.map_err(|error| format!("{topic} cannot be advertised: {error}"))?;
        Ok((message, publisher))
    }

    /// Publishes what is sent, once all are connected who are there.
    fn publishing(&mut self, topic: &str, publisher: Box<dyn Publisher>) -> mpsc::Sender<Bytes> {
        let (messages, mut waiting) = mpsc::channel::<Bytes>(OUTGOING);
        let graph = self.bus.graph();
        let listening = graph.borrow().topics.get(topic).map_or(0, |ends| {
            let others = ends.subscribers.iter();
            others.filter(|node| **node != self.bus.node()).count()
        });
        self.tasks.spawn(async move {
            // Viewers publish right behind what they advertise.
            let _ = timeout(CONNECTS, reaches(publisher.matched(), listening)).await;
            while let Some(message) = waiting.recv().await {
                publisher.publish(message);
            }
            Ended::Published
        });
        self.publishing += 1;
        messages
    }

    async fn call(&mut self, call: client::ServiceCallRequest<'_>) {
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

    /// All of them where none is named.
    async fn tell_parameters(&mut self, names: Vec<String>, id: Option<String>) {
        match parameters::all(&*self.bus, names).await {
            Ok(values) => {
                let told = ParameterValues::new(values);
                let told = match id {
                    Some(id) => told.with_id(id),
                    None => told,
                };
                self.tell(&told);
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

    /// Tells what of the graph's connections has changed, where the viewer wants to know.
    fn show_graph(&mut self, now: &Arc<Graph>) {
        let Some(before) = self.shows_graph.replace(Arc::clone(now)) else {
            self.shows_graph = None;
            return;
        };
        let mut update = ConnectionGraphUpdate::default();
        for (name, topic) in &now.topics {
            let earlier = before.topics.get(name);
            if earlier.map(|earlier| &earlier.publishers) != Some(&topic.publishers) {
                let publishers = topic.publishers.iter();
                update
                    .published_topics
                    .push(PublishedTopic::new(name, publishers));
            }
            if earlier.map(|earlier| &earlier.subscribers) != Some(&topic.subscribers) {
                let subscribers = topic.subscribers.iter();
                update
                    .subscribed_topics
                    .push(SubscribedTopic::new(name, subscribers));
            }
        }
        for (name, node) in &now.services {
            if before.services.get(name) != Some(node) {
                update
                    .advertised_services
                    .push(AdvertisedService::new(name, [node]));
            }
        }
        let gone = before
            .topics
            .keys()
            .filter(|name| !now.topics.contains_key(*name));
        update.removed_topics = gone.cloned().collect();
        let gone = before
            .services
            .keys()
            .filter(|name| !now.services.contains_key(*name));
        update.removed_services = gone.cloned().collect();
        if update != ConnectionGraphUpdate::default() {
            self.tell(&update);
        }
    }
}

/// One topic on its way to the viewer.
struct Reader {
    id: u32,
    topic: String,
    budget: Budget,
    out: mpsc::Sender<Frame>,
    /// Messages for which there was no room in the budget.
    missed: u64,
    /// How many it was told to have missed, and when.
    told: (u64, Instant),
}

impl Reader {
    /// Passes messages on, each when the viewer has taken those before.
    async fn passes(&mut self, mut subscription: Subscription) {
        while let Some(message) = subscription.messages.recv().await {
            let now = SystemTime::now().duration_since(UNIX_EPOCH);
            let now = now.map_or(0, |since| since.as_nanos() as u64);
            let Ok(permit) = self.budget.take(message.bytes.len()) else {
                self.missed += 1;
                continue;
            };
            let frame = permit.around(framed(self.id, now, &message.bytes));
            if self.out.send(Frame::Binary(frame)).await.is_err() {
                return;
            }
            let missed = self.missed + subscription.dropped.get();
            let (told, at) = self.told;
            if missed > told && (told == 0 || at.elapsed() >= MISSED) {
                self.told = (missed, Instant::now());
                let words = format!(
                    "{}: {missed} messages were left out, since they come faster than they are read",
                    self.topic
                );
                let status = Frame::Text(Status::warning(words).to_string());
                let _ = self.out.send(status).await;
            }
        }
    }
}

fn framed(id: u32, time: u64, message: &[u8]) -> BytesMut {
    // The operation's code in the protocol.
    const MESSAGE_DATA: u8 = 1;
    let mut frame = BytesMut::with_capacity(13 + message.len());
    frame.put_u8(MESSAGE_DATA);
    frame.put_u32_le(id);
    frame.put_u64_le(time);
    frame.extend_from_slice(message);
    frame
}
