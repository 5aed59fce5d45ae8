//! What a robot's stubs tell of their nodes, as events of its servant.

use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant, SystemTime};

use api::Level;
use link::control::Decision;
use parking_lot::Mutex;

use crate::{Observer, Tenant};

/// So many decisions of a robot become events within this time; more are left out, for a robot can tell any number.
const DECISIONS: (u32, Duration) = (60, Duration::from_secs(60));
/// Characters of what a robot says in an event.
const WORDS: usize = 400;

/// Kinds of a robot's decisions that are known.
const KINDS: [&str; 7] = [
    "local-takes-over",
    "local-hands-back",
    "local-answers-too",
    "cloud-answers-alone",
    "local-missing",
    "local-crashed",
    "state-lost",
];

/// What is told, of whom, and to whom.
pub(crate) struct Told {
    /// The servant's id.
    servant: String,
    observer: Arc<dyn Observer>,
    /// Decisions since then.
    decisions: Mutex<(Instant, u32)>,
    /// A container is made before anybody asks for it.
    tenant: OnceLock<Weak<dyn Tenant>>,
}

impl Told {
    pub(crate) fn new(servant: &str, observer: Arc<dyn Observer>) -> Told {
        Told {
            servant: servant.to_owned(),
            observer,
            decisions: Mutex::new((Instant::now(), 0)),
            tenant: OnceLock::new(),
        }
    }

    /// From now on the servant serves this one.
    pub(crate) fn bind(&self, tenant: Weak<dyn Tenant>) {
        let _ = self.tenant.set(tenant);
    }

    pub(crate) fn tenant(&self) -> Result<Arc<dyn Tenant>, String> {
        self.tenant
            .get()
            .and_then(Weak::upgrade)
            .ok_or_else(|| "the servant has ended".to_owned())
    }

    pub(crate) fn observer(&self) -> &dyn Observer {
        &*self.observer
    }

    /// The robot has decided something about the local original of a node.
    pub(crate) fn decided(&self, node: &str, decision: &Decision) {
        let Ok(tenant) = self.tenant() else { return };
        let count = {
            let mut decisions = self.decisions.lock();
            if decisions.0.elapsed() > DECISIONS.1 {
                *decisions = (Instant::now(), 0);
            }
            decisions.1 = decisions.1.saturating_add(1);
            decisions.1
        };
        if count > DECISIONS.0 {
            tracing::debug!(
                servant = self.servant,
                ?decision,
                "one of too many decisions"
            );
            return;
        }
        let known = KINDS.iter().find(|kind| **kind == decision.kind);
        let kind = known.copied().unwrap_or("local-other");
        let text: String = decision.text.chars().take(WORDS).collect();
        let ago = match decision.ago {
            ago if (2.0..1e9).contains(&ago) => format!(", {ago:.0} s ago"),
            _ => String::new(),
        };
        let robot = tenant.robot();
        let message = format!("robot {robot}: {node}: {text}{ago}");
        let level = if decision.warning {
            Level::Warning
        } else {
            Level::Info
        };
        self.observer.event(level, kind, &message, Some(robot));
        let why = match kind {
            "local-takes-over" | "local-answers-too" => Some(&*text),
            "local-hands-back" | "cloud-answers-alone" => None,
            _ => return,
        };
        let ago = Duration::try_from_secs_f64(decision.ago).unwrap_or_default();
        let at = SystemTime::now().checked_sub(ago);
        let at = at.unwrap_or_else(SystemTime::now);
        self.observer.served_locally(robot, node, at, why);
    }

    /// Something that whoever looks after the server should know of this robot.
    pub(crate) fn warn(&self, kind: &str, text: &str) {
        let tenant = self.tenant().ok();
        let robot = tenant.as_ref().map(|tenant| tenant.robot());
        self.observer.event(Level::Warning, kind, text, robot);
    }
}
