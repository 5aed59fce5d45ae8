//! Access for people who look inside a servant: a node in the servant's graph with a bridge, both existing only while
//! somebody looks. Subscriptions, publications and calls made there bypass the robot's bridge and its tap, so they
//! count neither as requests nor as sessions of the robot nor in its statistics; what the robot publishes is received
//! there as by any node.

use std::sync::{Arc, Weak};

use bridge::{Bridge, BridgeOptions, RequestObserver, SessionEnd, SessionOptions, WaitingConnection};
use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use ros::bus::{Bus, BusError};
use ros::schema::Registry;
use tokio::sync::watch;

use crate::UpgradedStream;
use crate::endings::ExitNotifier;

/// WebSocket close code for an internal error.
const CLOSE_FAILED: u16 = 1011;
/// WebSocket close code for a servant that ends.
const ENDS: u16 = 1012;

/// Joins the servant's ROS graph, once for all viewers.
pub(crate) type JoinFn = Box<dyn Fn() -> BoxFuture<'static, Result<JoinedBus, BusError>> + Send + Sync>;

/// A node of ours in the servant's ROS graph.
pub(crate) struct JoinedBus {
    pub(crate) bus: Arc<dyn Bus>,
    /// Notifies the bus of exited processes, if the servant has any.
    pub(crate) endings: Option<ExitNotifier>,
}

/// Access to the inside of one servant.
pub(crate) struct InsideHost {
    join: JoinFn,
    registry: Arc<Registry>,
    options: BridgeOptions,
    /// Held while joining: two nodes with the same name would end each other.
    turn: tokio::sync::Mutex<()>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Present while somebody looks.
    looking: Weak<InsideNode>,
    /// Reason why access is closed.
    closed: watch::Sender<Option<String>>,
}

/// The node for viewers, and a bridge on it for those that use rosbridge.
struct InsideNode {
    bus: Arc<dyn Bus>,
    bridge: Arc<Bridge>,
    _endings: Option<ExitNotifier>,
}

/// The ROS graph of a servant for a viewer.
pub struct InsideView {
    /// Bus of the servant.
    pub bus: Arc<dyn Bus>,
    /// Type definitions.
    pub registry: Arc<Registry>,
    /// Reason why it ended, once it has.
    pub ended: watch::Receiver<Option<String>>,
    /// Guard, to be dropped when the viewer has left.
    pub held: Box<dyn Send + Sync>,
}

impl InsideHost {
    /// Creates the access; `options` are those of the robot's bridge.
    pub(crate) fn new(join: JoinFn, registry: Arc<Registry>, options: &BridgeOptions) -> InsideHost {
        let options = BridgeOptions {
            // A web page shows the newest data and requests little at once.
            topic_messages: 64,
            session_bytes: 8 << 20,
            bus_queue: 32,
            max_subscriptions: 64,
            max_advertisements: 32,
            max_calls: 32,
            max_call_bytes: 8 << 20,
            called: RequestObserver::default(),
            pair: None,
            ..options.clone()
        };
        InsideHost { join, registry, options, turn: tokio::sync::Mutex::default(), state: Mutex::default() }
    }

    /// Serves a rosbridge client of a viewer until it ends.
    pub(crate) async fn serve(
        &self,
        mut client: WaitingConnection<UpgradedStream>,
        options: SessionOptions,
    ) -> SessionEnd {
        let (code, reason) = match client.wait_for(self.get_or_join()).await {
            Ok(Ok(looking)) => return looking.bridge.serve_waiting(client, options).await,
            Ok(Err(refused)) => refused,
            Err(left) => return left,
        };
        client.refuse(code, &reason).await;
        SessionEnd::Closed { code, reason }
    }

    /// Returns the servant's ROS graph for a viewer, or the code and reason to close with.
    pub(crate) async fn open_view(&self) -> Result<InsideView, (u16, String)> {
        let looking = self.get_or_join().await?;
        Ok(InsideView {
            bus: Arc::clone(&looking.bus),
            registry: Arc::clone(&self.registry),
            ended: self.state.lock().closed.subscribe(),
            held: Box::new(looking),
        })
    }

    /// Ends all viewers and refuses new ones with this reason.
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

    /// Returns the existing node or a new one, or the code and reason to close with.
    async fn get_or_join(&self) -> Result<Arc<InsideNode>, (u16, String)> {
        let _turn = self.turn.lock().await;
        if let Some(looking) = self.current_session()? {
            return Ok(looking);
        }
        let joined = (self.join)().await;
        let JoinedBus { bus, endings } =
            joined.map_err(|error| (CLOSE_FAILED, format!("cannot look inside: {error}")))?;
        let registry = Arc::clone(&self.registry);
        let bridge = Bridge::new(Arc::clone(&bus), registry, self.options.clone());
        let looking = Arc::new(InsideNode { bus, bridge, _endings: endings });
        let mut state = self.state.lock();
        // It may have been closed meanwhile.
        state.check_open()?;
        state.looking = Arc::downgrade(&looking);
        Ok(looking)
    }

    fn current_session(&self) -> Result<Option<Arc<InsideNode>>, (u16, String)> {
        let state = self.state.lock();
        state.check_open()?;
        Ok(state.looking.upgrade())
    }
}

impl State {
    fn check_open(&self) -> Result<(), (u16, String)> {
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
                let endings = Some(ExitNotifier::start(events, Arc::clone(&bus)));
                Ok(JoinedBus { bus, endings })
            })
        };
        let registry = Arc::new(Registry::for_version(RosVersion::Two));
        let inside = InsideHost::new(Box::new(join), registry, &BridgeOptions::default());
        let first = inside.open_view().await.expect("looked");
        let second = inside.open_view().await.expect("looked");
        drop(first);
        tokio::task::yield_now().await;
        assert_eq!(events.receiver_count(), 1, "one node, which is told");
        drop(second);
        while events.receiver_count() > 0 {
            tokio::task::yield_now().await;
        }
    }
}
