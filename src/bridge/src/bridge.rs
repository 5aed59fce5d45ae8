//! What all sockets of one servant share.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::Bus;
use ros::schema::{MessageType, Registry};
use rosbridge::{Format, Level, Op, Status};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::client::Client;
use crate::hub::Hub;
use crate::outbox::Goodbye;
use crate::outlet::Outlet;
use crate::presence::{self, Presence};
use crate::registrations::Registrations;
use crate::service_types::ServiceTypes;
use crate::session::Session;
use crate::ws::{WebSocket, frame};
use crate::{BridgeOptions, Metrics, SessionOptions};

/// One servant's bridge.
pub struct Bridge {
    shared: Arc<Shared>,
}

/// How many sessions a bridge has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SessionCount {
    /// Connected now.
    pub connected: usize,
    /// Away, and still within their grace time.
    pub away: usize,
}

/// How a connection ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SessionEnd {
    /// The client closed it.
    Client {
        /// WebSocket close code; 1005 where it gave none.
        code: u16,
        /// The client's words.
        reason: String,
    },
    /// The bridge closed it.
    Closed {
        /// WebSocket close code.
        code: u16,
        /// The words sent to the client.
        reason: String,
    },
    /// The socket failed or ended without goodbye.
    Lost(String),
}

/// What the bridge's parts need of it.
pub(crate) struct Shared {
    pub(crate) bus: Arc<dyn Bus>,
    pub(crate) registry: Arc<Registry>,
    pub(crate) options: BridgeOptions,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) service_types: ServiceTypes,
    pub(crate) registrations: Registrations,
    presence: Presence,
    hubs: Mutex<HashMap<String, Weak<Hub>>>,
    /// What clients publish on, by topic.
    outlets: Mutex<HashMap<String, Vec<Weak<Outlet>>>>,
    clients: Mutex<Clients>,
    sessions: watch::Sender<SessionCount>,
    numbers: AtomicU64,
}

#[derive(Default)]
struct Clients {
    all: Vec<Weak<Client>>,
    /// Clients that can be resumed, by token.
    resumable: HashMap<String, Arc<Client>>,
    closed: Option<String>,
}

impl Bridge {
    /// A bridge between `bus` and the sockets that [`serve`](Self::serve) will be given. `registry` holds the
    /// definitions of the servant's types; types that publishers announce are added.
    pub fn new(bus: Arc<dyn Bus>, registry: Arc<Registry>, options: BridgeOptions) -> Arc<Self> {
        presence::define(&registry);
        let shared = Shared {
            bus,
            registry,
            options,
            metrics: Arc::default(),
            service_types: ServiceTypes::default(),
            registrations: Registrations::default(),
            presence: Presence::default(),
            hubs: Mutex::default(),
            outlets: Mutex::default(),
            clients: Mutex::default(),
            sessions: watch::Sender::default(),
            numbers: AtomicU64::new(1),
        };
        Arc::new(Self {
            shared: Arc::new(shared),
        })
    }

    /// Speaks rosbridge on `io`, a connection behind its WebSocket upgrade, until it ends.
    pub async fn serve<S>(self: &Arc<Self>, io: S, options: SessionOptions) -> SessionEnd
    where
        S: AsyncRead + AsyncWrite + Unpin + Send,
    {
        let shared = &self.shared;
        let client = match shared.client_for(&options) {
            Ok(client) => client,
            Err(reason) => {
                refuse(io, 1012, &reason).await;
                return SessionEnd::Closed { code: 1012, reason };
            }
        };
        shared.metrics.sessions.add(1);
        let limits = &shared.options;
        let socket = WebSocket::new(
            io,
            &options.read_ahead,
            limits.max_frame,
            limits.max_message,
        );
        let number = client.outbox.attach();
        shared.sessions.send_modify(|count| count.connected += 1);
        let present = shared.next_number();
        shared.presence.enter(present, &client.name);
        shared.tell_presence();
        tracing::debug!(client = %client.name, "session begins");
        let end = Session::new(socket, client.clone(), number).run().await;
        tracing::debug!(client = %client.name, ?end, "session ends");
        shared.sessions.send_modify(|count| count.connected -= 1);
        shared.presence.leave(present);
        shared.tell_presence();
        shared.leave(client, number, options.resume, &end);
        end
    }

    /// Tells every session, connected or away, why it ends (a status message and a close frame with code 1012) and
    /// ends it; later connections are refused the same way. For when the servant dies or is replaced.
    pub fn close(&self, reason: &str) {
        let clients: Vec<_> = {
            let mut clients = self.shared.clients.lock();
            clients.closed.get_or_insert_with(|| reason.to_owned());
            clients.resumable.clear();
            clients
                .all
                .drain(..)
                .filter_map(|client| client.upgrade())
                .collect()
        };
        for client in clients {
            client.status(Level::Error, None, Format::Json, reason);
            client.outbox.say_goodbye(Goodbye {
                code: 1012,
                reason: reason.to_owned(),
            });
            client.end();
        }
    }

    /// How many sessions there are, now and later.
    pub fn sessions(&self) -> watch::Receiver<SessionCount> {
        self.shared.sessions.subscribe()
    }

    /// What was counted so far.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.shared.metrics
    }
}

impl Shared {
    /// The client that a connection belongs to: the one it was before, or a new one.
    fn client_for(self: &Arc<Self>, options: &SessionOptions) -> Result<Arc<Client>, String> {
        let mut clients = self.clients.lock();
        if let Some(reason) = &clients.closed {
            return Err(reason.clone());
        }
        if let Some(token) = &options.resume
            && let Some(client) = clients.resumable.get(token)
        {
            self.metrics.resumed.add(1);
            return Ok(client.clone());
        }
        let client = Client::new(self.clone(), options);
        clients.all.retain(|other| other.strong_count() > 0);
        clients.all.push(Arc::downgrade(&client));
        if let Some(token) = &options.resume {
            clients.resumable.insert(token.clone(), client.clone());
        }
        Ok(client)
    }

    /// A connection has ended: its client goes too, or waits for the next connection.
    fn leave(
        self: &Arc<Self>,
        client: Arc<Client>,
        number: u64,
        token: Option<String>,
        end: &SessionEnd,
    ) {
        let Some(token) = token else {
            return client.end();
        };
        if !client.outbox.is_attached(number) {
            // A newer connection has taken over.
            return;
        }
        let over = matches!(end, SessionEnd::Closed { code, .. } if *code != 1001);
        if over || self.options.resume_grace.is_zero() {
            return self.forget_client(&client, &token);
        }
        self.sessions.send_modify(|count| count.away += 1);
        let shared = self.clone();
        tokio::spawn(async move {
            tokio::select! {
                () = tokio::time::sleep(shared.options.resume_grace) => {}
                () = client.outbox.taken_over(number) => {}
                () = client.ended() => {}
            }
            shared.sessions.send_modify(|count| count.away -= 1);
            if client.outbox.is_attached(number) {
                shared.forget_client(&client, &token);
            }
        });
    }

    fn forget_client(&self, client: &Arc<Client>, token: &str) {
        let mut clients = self.clients.lock();
        if clients
            .resumable
            .get(token)
            .is_some_and(|known| Arc::ptr_eq(known, client))
        {
            clients.resumable.remove(token);
        }
        drop(clients);
        client.end();
    }

    /// The topic's hub; begun if it is not there.
    pub(crate) fn hub(
        self: &Arc<Self>,
        topic: &str,
        message_type: Option<&MessageType>,
    ) -> Arc<Hub> {
        let mut hubs = self.hubs.lock();
        if let Some(hub) = hubs.get(topic).and_then(Weak::upgrade) {
            return hub;
        }
        let own = presence::type_name(topic)
            .filter(|_| !self.bus.graph().borrow().topics.contains_key(topic));
        let own = own.and_then(|name| self.registry.message(name).ok());
        let hub = match &own {
            Some(own) => {
                let hub = Hub::internal(self, topic);
                hub.deliver(self.presence.message(topic, own), true);
                hub
            }
            None => Hub::start(self, topic, message_type),
        };
        let outlets = self.outlets_of(topic);
        for message in outlets.iter().filter_map(|outlet| outlet.latched()) {
            hub.deliver(message, true);
        }
        hubs.insert(topic.to_owned(), Arc::downgrade(&hub));
        // The last owner of an outlet must not drop it under the lock.
        drop(hubs);
        hub
    }

    /// Tells who listens that somebody has come or gone.
    fn tell_presence(&self) {
        for topic in presence::TOPICS {
            let hub = self.live_hub(topic).filter(|hub| hub.is_internal());
            let own = presence::type_name(topic).and_then(|name| self.registry.message(name).ok());
            if let (Some(hub), Some(own)) = (hub, own) {
                hub.deliver(self.presence.message(topic, &own), true);
            }
        }
    }

    fn outlets_of(&self, topic: &str) -> Vec<Arc<Outlet>> {
        self.outlets
            .lock()
            .get(topic)
            .into_iter()
            .flatten()
            .filter_map(Weak::upgrade)
            .collect()
    }

    pub(crate) fn add_outlet(&self, outlet: &Arc<Outlet>) {
        self.outlets
            .lock()
            .entry(outlet.topic.clone())
            .or_default()
            .push(Arc::downgrade(outlet));
    }

    /// Forgets an outlet that is being dropped, and what it latched.
    pub(crate) fn forget_outlet(&self, outlet: &Outlet) {
        let mut outlets = self.outlets.lock();
        if let Some(others) = outlets.get_mut(&outlet.topic) {
            others.retain(|other| other.strong_count() > 0);
            if others.is_empty() {
                outlets.remove(&outlet.topic);
            }
        }
        drop(outlets);
        if outlet.latch
            && let Some(hub) = self.live_hub(&outlet.topic)
        {
            hub.forget(&outlet.name);
        }
    }

    /// What clients of this bridge publish on a topic, known before the graph shows it.
    pub(crate) fn local_type(&self, topic: &str) -> Option<String> {
        let outlets = self.outlets_of(topic);
        let known = outlets.first().map(|outlet| outlet.message_type.name());
        known.or(presence::type_name(topic)).map(str::to_owned)
    }

    /// The topic's hub, if anybody listens.
    pub(crate) fn live_hub(&self, topic: &str) -> Option<Arc<Hub>> {
        self.hubs.lock().get(topic).and_then(Weak::upgrade)
    }

    /// Forgets a hub that is gone, or that will never carry anything.
    pub(crate) fn forget_hub(&self, hub: &Hub) {
        let mut hubs = self.hubs.lock();
        if hubs
            .get(&hub.topic)
            .is_some_and(|known| std::ptr::eq(known.as_ptr(), hub))
        {
            hubs.remove(&hub.topic);
        }
    }

    /// A number that nothing else of this bridge has.
    pub(crate) fn next_number(&self) -> u64 {
        self.numbers.fetch_add(1, Ordering::Relaxed)
    }
}

/// Refuses a connection behind its WebSocket upgrade: a status message at level error, then a close frame. For when
/// there is no bridge to serve it, because the servant could not be started (1013, "try again later").
pub async fn refuse<S>(io: S, code: u16, reason: &str)
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    let mut out = Vec::new();
    Op::from(Status {
        id: None,
        level: Level::Error,
        msg: reason.into(),
    })
    .print(&mut out, Format::Json);
    let mut socket = WebSocket::new(io, b"", 4096, 4096);
    socket.queue(frame::TEXT, Bytes::from(out));
    socket.queue_close(code, reason);
    // A client that does not take its leave in time, or is gone already, is left alone.
    let _ = tokio::time::timeout(BridgeOptions::default().close_timeout, socket.leave(true)).await;
}
