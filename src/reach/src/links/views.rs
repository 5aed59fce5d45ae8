//! Views of a servant: robots of its own ROS see its bus, robots of the other one see it translated. The links of both
//! belong to one hub, so that they agree on which nodes run.

use std::sync::{Arc, Weak};

use link::control::FromCloud;
use ros::bus::{Bus, RosVersion};
use ros::schema::Registry;
use tokio::sync::watch;
use translation::TypeTranslations;
use translation::bus::{LeftOut, TranslatedBus, TranslationObserver};

use super::lent_services::PartLender;
use super::state::{Hub, ParameterMirror, ServantView};
use super::types::TypeDefinitions;

impl ServantView {
    /// Creates the view of robots with the servant's ROS.
    pub(super) fn own(bus: &Arc<dyn Bus>, registry: &Arc<Registry>) -> Arc<Self> {
        let types = TypeDefinitions::Image(Arc::clone(registry));
        Self::new(Arc::clone(bus), types)
    }

    fn new(bus: Arc<dyn Bus>, types: TypeDefinitions) -> Arc<Self> {
        let parameters = Arc::new(ParameterMirror::new(Arc::clone(&bus)));
        Arc::new(Self { bus, types, parameters })
    }

    /// Returns what this view lacks because the robot's ROS cannot express it; `None` for robots of the same ROS.
    pub(super) fn left_out(&self) -> Option<watch::Receiver<Arc<LeftOut>>> {
        self.translated_bus().map(TranslatedBus::left_out)
    }

    /// Returns the translated bus of robots with the other ROS.
    pub(super) fn translated_bus(&self) -> Option<&TranslatedBus> {
        match &self.types {
            TypeDefinitions::Image(_) => None,
            TypeDefinitions::Twins(bus) => Some(bus),
        }
    }
}

impl Hub {
    /// Returns the view of robots with this ROS version.
    pub(super) fn view_for(self: &Arc<Self>, version: RosVersion) -> Arc<ServantView> {
        if version == self.bus.version() {
            return Arc::clone(&self.own_view);
        }
        let view = self.other_view.get_or_init(|| {
            let registry = || Arc::clone(&self.registry);
            let types = TypeTranslations::new(Arc::clone(&self.options.rules));
            let types = Arc::new(types.with_known(registry(), self.bus.version()));
            let observer = Arc::new(LossNotifier { hub: Arc::downgrade(self), version });
            let _span = self.log_span.enter();
            let budget = &self.options.budget;
            let bus = TranslatedBus::new(Arc::clone(&self.bus), types, registry(), observer, budget);
            if version == RosVersion::Two {
                bus.lend_actions(Arc::new(PartLender { hub: Arc::downgrade(self), version }));
            }
            ServantView::new(Arc::clone(&bus) as _, TypeDefinitions::Twins(bus))
        });
        Arc::clone(view)
    }
}

/// Tells the robot what is lost between the two ROSes.
struct LossNotifier {
    hub: Weak<Hub>,
    /// ROS version of the robot.
    version: RosVersion,
}

impl TranslationObserver for LossNotifier {
    fn on_loss(&self, name: &str, text: &str) {
        let Some(hub) = self.hub.upgrade() else {
            return;
        };
        tracing::warn!(parent: &hub.log_span, what = name, "{text}");
        let links: Vec<_> = hub.links.lock().values().cloned().collect();
        // All links of these robots lead to one of them, and it is told once.
        let mut links = links.iter().filter(|link| link.view.bus.version() == self.version);
        let concerned = links.clone().find(|link| link.has(name)).or_else(|| links.next());
        if let Some(link) = concerned {
            let notice = FromCloud::Notice { warning: true, text: text.to_owned() };
            link.session.send_control(&notice);
        }
    }
}
