//! Events of a servant that are reported by its robot's stubs.

use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant, SystemTime};

use api::Level;
use link::control::Decision;
use parking_lot::Mutex;

use crate::links::MeasuredRequest;
use crate::{Observer, Tenant};

/// Maximum number of a robot's decisions recorded as events in this time; further ones are ignored, because a robot can
/// report any number.
const DECISIONS: (u32, Duration) = (60, Duration::from_secs(60));
/// Maximum number of characters of a robot's text in an event.
const MAX_TEXT_LENGTH: usize = 400;

/// Known kinds of a robot's decisions.
const KINDS: [&str; 7] = [
    "local-takes-over",
    "local-hands-back",
    "local-answers-too",
    "cloud-answers-alone",
    "local-missing",
    "local-crashed",
    "state-lost",
];

/// Reporter of a robot's events.
pub(crate) struct RobotEvents {
    /// Servant id.
    servant: String,
    observer: Arc<dyn Observer>,
    /// Start of the current interval, and number of decisions in it.
    decisions: Mutex<(Instant, u32)>,
    /// Set late, because a container may be created before anybody uses it.
    tenant: OnceLock<Weak<dyn Tenant>>,
}

impl RobotEvents {
    pub(crate) fn new(servant: &str, observer: Arc<dyn Observer>) -> RobotEvents {
        RobotEvents {
            servant: servant.to_owned(),
            observer,
            decisions: Mutex::new((Instant::now(), 0)),
            tenant: OnceLock::new(),
        }
    }

    /// Assigns the servant to a tenant.
    pub(crate) fn bind_tenant(&self, tenant: Weak<dyn Tenant>) {
        let _ = self.tenant.set(tenant);
    }

    /// Returns the tenant; `None` if the servant has none yet, or has ended.
    pub(crate) fn tenant(&self) -> Option<Arc<dyn Tenant>> {
        self.tenant.get().and_then(Weak::upgrade)
    }

    pub(crate) fn observer(&self) -> &dyn Observer {
        &*self.observer
    }

    /// Records a decision of the robot about the local original of a node.
    pub(crate) fn record_decision(&self, node: &str, decision: &Decision) {
        let Some(tenant) = self.tenant() else {
            return;
        };
        let count = {
            let mut decisions = self.decisions.lock();
            if decisions.0.elapsed() > DECISIONS.1 {
                *decisions = (Instant::now(), 0);
            }
            decisions.1 = decisions.1.saturating_add(1);
            decisions.1
        };
        if count > DECISIONS.0 {
            tracing::debug!(servant = self.servant, ?decision, "one of too many decisions");
            return;
        }
        let known = KINDS.iter().find(|kind| **kind == decision.kind);
        let kind = known.copied().unwrap_or("local-other");
        let text: String = decision.text.chars().take(MAX_TEXT_LENGTH).collect();
        let ago = match decision.ago {
            ago if (2.0..1e9).contains(&ago) => format!(", {ago:.0} s ago"),
            _ => String::new(),
        };
        let robot = tenant.robot();
        let message = format!("robot {robot}: {node}: {text}{ago}");
        let level = if decision.warning { Level::Warning } else { Level::Info };
        self.observer.record_event(level, kind, &message, Some(robot));
        let why = match kind {
            "local-takes-over" | "local-answers-too" => Some(&*text),
            "local-hands-back" | "cloud-answers-alone" => None,
            _ => return,
        };
        let ago = Duration::try_from_secs_f64(decision.ago).unwrap_or_default();
        let at = SystemTime::now().checked_sub(ago);
        let at = at.unwrap_or_else(SystemTime::now);
        self.observer.on_served_locally(robot, node, at, why);
    }

    /// Records an update about a request of the robot.
    pub(crate) fn record_request(&self, request: &MeasuredRequest<'_>) {
        let tenant = self.tenant();
        let robot = tenant.as_ref().map(|tenant| tenant.robot());
        self.observer.on_request_measured(robot, request);
    }

    /// Reports a problem of this robot to the operator.
    pub(crate) fn warn(&self, kind: &str, text: &str) {
        let tenant = self.tenant();
        let robot = tenant.as_ref().map(|tenant| tenant.robot());
        self.observer.record_event(Level::Warning, kind, text, robot);
    }
}
