//! A servant that people look into: a node of its own in the servant's graph and a bridge on it, both there only while somebody
//! looks. What people hear, publish and call there passes neither the robot's bridge nor its tap, so that it is no request of the
//! robot, no session of it and none of its figures; and what the robot publishes is heard there as any node hears it.

use std::sync::{Arc, Weak};

use bridge::{Bridge, BridgeOptions, Called, SessionEnd, SessionOptions, Waiting};
use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use ros::bus::{Bus, BusError};
use ros::schema::Registry;
use tokio::sync::watch;

use crate::Stream;
use crate::endings::Endings;

/// WebSocket close code for something that failed here.
const FAILED: u16 = 1011;
/// WebSocket close code for a servant that ends.
const ENDS: u16 = 1012;

/// Joins the servant's ROS, once for all who look.
pub(crate) type Joining =
    Box<dyn Fn() -> BoxFuture<'static, Result<Joined, BusError>> + Send + Sync>;

/// A node of ours in the servant's ROS.
pub(crate) struct Joined {
    pub(crate) bus: Arc<dyn Bus>,
    /// Tells it of processes that have ended, where the servant has some.
    pub(crate) endings: Option<Endings>,
}

/// Where people look into one servant.
pub(crate) struct Inside {
    join: Joining,
    registry: Arc<Registry>,
    options: BridgeOptions,
    /// Held while the ROS is joined: two nodes of one name would end each other.
    turn: tokio::sync::Mutex<()>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// There while somebody looks.
    looking: Weak<Looking>,
    /// Why nobody looks any more.
    closed: watch::Sender<Option<String>>,
}

/// The node of those who look, and a bridge on it for those who speak rosbridge.
struct Looking {
    bus: Arc<dyn Bus>,
    bridge: Arc<Bridge>,
    _endings: Option<Endings>,
}

/// The servant's ROS as those see it who look, for as long as this lives.
pub struct Looked {
    /// Its ROS.
    pub bus: Arc<dyn Bus>,
    /// Its definitions.
    pub registry: Arc<Registry>,
    /// Why it has ended, once it has.
    pub ended: watch::Receiver<Option<String>>,
    _looking: Arc<Looking>,
}

impl Inside {
    /// `options` are those of the robot's bridge.
    pub(crate) fn new(join: Joining, registry: Arc<Registry>, options: &BridgeOptions) -> Inside {
        let options = BridgeOptions {
            // A page is shown what is newest, and asks for little at once.
            topic_messages: 64,
            session_bytes: 8 << 20,
            bus_queue: 32,
            max_subscriptions: 64,
            max_advertisements: 32,
            max_calls: 32,
            max_call_bytes: 8 << 20,
            called: Called::default(),
            pair: None,
            ..options.clone()
        };
        Inside {
            join,
            registry,
            options,
            turn: tokio::sync::Mutex::default(),
            state: Mutex::default(),
        }
    }

    /// Speaks rosbridge with somebody who looks, until it ends.
    pub(crate) async fn serve(
        &self,
        mut client: Waiting<Stream>,
        options: SessionOptions,
    ) -> SessionEnd {
        let (code, reason) = match client.until(self.looking()).await {
            Ok(Ok(looking)) => return looking.bridge.serve_waiting(client, options).await,
            Ok(Err(refused)) => refused,
            Err(left) => return left,
        };
        client.refuse(code, &reason).await;
        SessionEnd::Closed { code, reason }
    }

    /// The servant's ROS for somebody who looks; else code and reason to close with.
    pub(crate) async fn look(&self) -> Result<Looked, (u16, String)> {
        let looking = self.looking().await?;
        Ok(Looked {
            bus: Arc::clone(&looking.bus),
            registry: Arc::clone(&self.registry),
            ended: self.state.lock().closed.subscribe(),
            _looking: looking,
        })
    }

    /// Ends all who look, and refuses others, with these words.
    pub(crate) fn close(&self, reason: &str) {
        let looking = {
            let state = self.state.lock();
            state.closed.send_if_modified(|closed| {
                let is_first = closed.is_none();
                closed.get_or_insert_with(|| reason.to_owned());
                is_first
            });
            state.looking.upgrade()
        };
        if let Some(looking) = looking {
            looking.bridge.close(reason);
        }
    }

    /// The node that is there, or a new one; else code and reason to close with.
    async fn looking(&self) -> Result<Arc<Looking>, (u16, String)> {
        let _turn = self.turn.lock().await;
        if let Some(looking) = self.there()? {
            return Ok(looking);
        }
        let joined = (self.join)().await;
        let Joined { bus, endings } =
            joined.map_err(|error| (FAILED, format!("cannot look inside: {error}")))?;
        let registry = Arc::clone(&self.registry);
        let bridge = Bridge::new(Arc::clone(&bus), registry, self.options.clone());
        let looking = Arc::new(Looking {
            bus,
            bridge,
            _endings: endings,
        });
        let mut state = self.state.lock();
        // It may have been closed meanwhile.
        state.check()?;
        state.looking = Arc::downgrade(&looking);
        Ok(looking)
    }

    fn there(&self) -> Result<Option<Arc<Looking>>, (u16, String)> {
        let state = self.state.lock();
        state.check()?;
        Ok(state.looking.upgrade())
    }
}

impl State {
    fn check(&self) -> Result<(), (u16, String)> {
        match &*self.closed.borrow() {
            Some(reason) => Err((ENDS, reason.clone())),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use ros::JoinOptions;
    use ros::bus::RosVersion;
    use ros::net::HostSockets;
    use tokio::sync::broadcast;

    use super::*;

    #[tokio::test]
    async fn processes_that_end_are_told_to_those_who_look_as_long_as_they_do() {
        let (events, _) = broadcast::channel(4);
        let told = events.clone();
        let join = move || -> BoxFuture<'static, _> {
            let events = told.subscribe();
            Box::pin(async move {
                let mut options = JoinOptions::in_domain(0, "/looks");
                options.network.alone = true;
                let bus = ros::connect(RosVersion::Two, Arc::new(HostSockets), options).await?;
                let endings = Some(Endings::follow(events, Arc::clone(&bus)));
                Ok(Joined { bus, endings })
            })
        };
        let registry = Arc::new(Registry::of(RosVersion::Two));
        let inside = Inside::new(Box::new(join), registry, &BridgeOptions::default());
        let first = inside.look().await.expect("looked");
        let second = inside.look().await.expect("looked");
        drop(first);
        tokio::task::yield_now().await;
        assert_eq!(events.receiver_count(), 1, "one node, which is told");
        drop(second);
        while events.receiver_count() > 0 {
            tokio::task::yield_now().await;
        }
    }
}
