//! Servants of this host's engine, reached in this process through sockets in their network namespaces.

use std::sync::Arc;

use async_trait::async_trait;
use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use ros::JoinOptions;
use ros::bus::RosVersion;
use servant::engine::ServantHandle;
use servant::local::{LocalEngine, LocalServant};
use tracing::{Instrument, Span};

use crate::components::{ComponentLoader, ComponentPlan};
use crate::egress::{self, Relays};
use crate::endings::ExitNotifier;
use crate::in_process::{InProcess, InProcessParts};
use crate::inside::JoinedBus;
use crate::lifecycle::LifecycleDriver;
use crate::links::NodeController;
use crate::nodes::LinkedNodes;
use crate::sockets::ServantSockets;
use crate::succession::DaemonParticipants;
use crate::{Error, ObservedBus, Observer, Opener, Reach, ReachOptions, RecordedRevision, master};

/// Name of our node in every servant's graph.
const NODE: &str = "/cloudroid_bridge";

/// Opens the reach of servants of this host's engine.
pub struct LocalOpener {
    engine: LocalEngine,
    /// Rules of `egress` that the operator allows.
    egress: Vec<String>,
}

impl LocalOpener {
    /// Creates an opener for the servants of `engine`. Their nodes reach hosts that are granted to them and allowed by
    /// `egress`.
    pub fn new(engine: LocalEngine, egress: Vec<String>) -> LocalOpener {
        LocalOpener { engine, egress }
    }

    fn find_servant(&self, servant: &Arc<dyn ServantHandle>) -> Result<Arc<LocalServant>, Error> {
        let id = servant.id();
        let found = self.engine.servant(id);
        found.ok_or_else(|| Error::Elsewhere(id.to_owned()))
    }

    async fn open_relays(&self, servant: &LocalServant, egress: &[String]) -> Relays {
        // If it is no longer allowed, the servant would not have been started either.
        let routes = egress::routes(egress, &self.egress).unwrap_or_default();
        Relays::open(servant.network(), &routes).await
    }
}

#[async_trait]
impl Opener for LocalOpener {
    async fn open(
        &self,
        servant: &Arc<dyn ServantHandle>,
        recorded: BoxFuture<'_, RecordedRevision>,
        options: ReachOptions,
        observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error> {
        let local = self.find_servant(servant)?;
        let joining = JoinOptions {
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            distribution: options.distribution.clone(),
            succession: Some(Arc::new(DaemonParticipants::new(&local))),
            ..JoinOptions::new(master::ADDRESS, NODE)
        };
        let sockets = Arc::new(ServantSockets::new(local.network()));
        let looking = JoinOptions { node: bridge::INSIDE_NODE.to_owned(), ..joining.clone() };
        let (ros, beside) = (options.ros, Arc::clone(&sockets));
        // Whoever looks inside first, this bus is not of that connection.
        let (looked_at, span) = (Arc::clone(servant), Span::current());
        let joined = ros::connect(options.ros, sockets, joining);
        // Nodes may look for a host as the first thing they do.
        let relayed = async {
            let recorded = recorded.await;
            let relays = self.open_relays(&local, &recorded.egress).await;
            (recorded, relays)
        };
        let (bus, (recorded, relays)) = tokio::join!(joined, relayed);
        let bus = bus?;
        let registry = Arc::clone(&recorded.registry);
        let wanted = ComponentPlan::new(recorded.components.clone(), Arc::clone(&registry));
        let endings = ExitNotifier::start(servant.events(), Arc::clone(&bus));
        let nodes = LinkedNodes::new(recorded, servant, Arc::clone(&observer));
        let nodes: Arc<dyn NodeController> = Arc::new(nodes);
        let lifecycles = LifecycleDriver::start(&bus, &nodes, &observer, &options.budget);
        let components = ComponentLoader::start(&bus, &nodes, &observer, wanted, &options.budget);
        let behind = InProcessParts {
            id: servant.id().to_owned(),
            linked: (Arc::clone(&bus), nodes),
            bus,
            inside: Box::new(move || {
                let events = looked_at.events();
                let joined = ros::connect(ros, Arc::clone(&beside) as _, looking.clone());
                let joined = async move {
                    let bus = joined.await?;
                    let endings = Some(ExitNotifier::start(events, Arc::clone(&bus)));
                    Ok(JoinedBus { bus, endings })
                };
                joined.instrument(span.clone()).boxed()
            }),
            registry,
            observer,
            lifecycles,
            components,
            keeps: Box::new((relays, endings)),
        };
        Ok(Arc::new(InProcess::new(behind, options)))
    }

    async fn observe(
        &self,
        servant: &Arc<dyn ServantHandle>,
        ros: RosVersion,
        name: &str,
        egress: &[String],
    ) -> Result<ObservedBus, Error> {
        let local = self.find_servant(servant)?;
        let relays = self.open_relays(&local, egress).await;
        let sockets = Arc::new(ServantSockets::new(local.network()));
        let joining = JoinOptions::new(master::ADDRESS, name);
        Ok(ObservedBus { bus: ros::connect(ros, sockets, joining).await?, held: Box::new(relays) })
    }

    fn process_ids(&self, servant: &str) -> Vec<i32> {
        let servant = self.engine.servant(servant);
        servant.and_then(|servant| servant.processes().ok()).unwrap_or_default()
    }
}
