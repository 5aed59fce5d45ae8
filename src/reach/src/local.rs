//! Servants of this host's engine: reached in this process, by sockets in their network namespaces.

use std::sync::Arc;

use async_trait::async_trait;
use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use ros::JoinOptions;
use ros::bus::RosVersion;
use servant::engine::Servant;
use servant::local::{LocalEngine, LocalServant};

use crate::components::{Components, Wanted};
use crate::egress::{self, Relays};
use crate::endings::Endings;
use crate::in_process::{Behind, InProcess};
use crate::inside::Joined;
use crate::lifecycle::Lifecycles;
use crate::links::Nodes;
use crate::nodes::LinkedNodes;
use crate::sockets::ServantSockets;
use crate::succession::Participants;
use crate::{Error, Look, Observer, Opener, Reach, ReachOptions, Recorded, master};

/// The name of our node in every servant's graph.
const NODE: &str = "/cloudroid_bridge";

/// Reaches the servants of an engine of this host.
pub struct LocalOpener {
    engine: LocalEngine,
    /// `egress` of what the operator allows.
    egress: Vec<String>,
}

impl LocalOpener {
    /// For the servants of `engine`; their nodes get to those hosts that are granted to them and in `egress`.
    pub fn new(engine: LocalEngine, egress: Vec<String>) -> LocalOpener {
        LocalOpener { engine, egress }
    }

    fn local(&self, servant: &Arc<dyn Servant>) -> Result<Arc<LocalServant>, Error> {
        let id = servant.id();
        let found = self.engine.servant(id);
        found.ok_or_else(|| Error::Elsewhere(id.to_owned()))
    }

    async fn relays(&self, servant: &LocalServant, egress: &[String]) -> Relays {
        // Not allowed any more: then the servant would not have been started either.
        let routes = egress::routes(egress, &self.egress).unwrap_or_default();
        Relays::open(servant.network(), &routes).await
    }
}

#[async_trait]
impl Opener for LocalOpener {
    async fn open(
        &self,
        servant: &Arc<dyn Servant>,
        recorded: BoxFuture<'_, Recorded>,
        options: ReachOptions,
        observer: Arc<dyn Observer>,
    ) -> Result<Arc<dyn Reach>, Error> {
        let local = self.local(servant)?;
        let joining = JoinOptions {
            budget: options.budget.clone(),
            unfinished: options.unfinished,
            distribution: options.distribution.clone(),
            succession: Some(Arc::new(Participants::of(&local))),
            ..JoinOptions::new(master::ADDRESS, NODE)
        };
        let sockets = Arc::new(ServantSockets::new(local.network()));
        let looking = JoinOptions {
            node: bridge::INSIDE.to_owned(),
            ..joining.clone()
        };
        let (ros, beside) = (options.ros, Arc::clone(&sockets));
        let looked_at = Arc::clone(servant);
        let joined = ros::connect(options.ros, sockets, joining);
        let (bus, recorded) = tokio::join!(joined, recorded);
        let bus = bus?;
        let registry = Arc::clone(&recorded.registry);
        let relays = self.relays(&local, &recorded.egress).await;
        let wanted = Wanted::new(recorded.components.clone(), Arc::clone(&registry));
        let endings = Endings::follow(servant.events(), Arc::clone(&bus));
        let nodes = LinkedNodes::new(recorded, servant, Arc::clone(&observer));
        let nodes: Arc<dyn Nodes> = Arc::new(nodes);
        let lifecycles = Lifecycles::follow(&bus, &nodes, &observer);
        let components = Components::follow(&bus, &nodes, &observer, wanted);
        let behind = Behind {
            id: servant.id().to_owned(),
            linked: (Arc::clone(&bus), nodes),
            bus,
            inside: Box::new(move || {
                let events = looked_at.events();
                let joined = ros::connect(ros, Arc::clone(&beside) as _, looking.clone());
                let joined = async move {
                    let bus = joined.await?;
                    let endings = Some(Endings::follow(events, Arc::clone(&bus)));
                    Ok(Joined { bus, endings })
                };
                joined.boxed()
            }),
            registry,
            lifecycles,
            components,
            keeps: Box::new((relays, endings)),
        };
        Ok(Arc::new(InProcess::new(behind, options)))
    }

    async fn look(
        &self,
        servant: &Arc<dyn Servant>,
        ros: RosVersion,
        name: &str,
        egress: &[String],
    ) -> Result<Look, Error> {
        let local = self.local(servant)?;
        let relays = self.relays(&local, egress).await;
        let sockets = Arc::new(ServantSockets::new(local.network()));
        let joining = JoinOptions::new(master::ADDRESS, name);
        Ok(Look {
            bus: ros::connect(ros, sockets, joining).await?,
            _relays: relays,
        })
    }

    fn processes(&self, servant: &str) -> Vec<i32> {
        let servant = self.engine.servant(servant);
        servant
            .and_then(|servant| servant.processes().ok())
            .unwrap_or_default()
    }
}
