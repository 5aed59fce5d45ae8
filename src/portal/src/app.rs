//! Shared state of all request handlers.

use std::sync::Arc;
use std::time::Duration;

use api::Millis;
use authority::Authority;
use catalogue::Catalogue;
use choreographer::Choreographer;
use push::Pusher;
use store::State;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::audit::Audit;
use crate::inside::connections::InsideConnections;
use crate::observers::servants::{BlackBoxOptions, Observers};
use crate::people::identity_provider::IdentityProvider;
use crate::people::passwords::Passwords;
use crate::principals::Principals;
use crate::proxies::Proxies;
use crate::slots::Slots;
use crate::strangers::Strangers;
use crate::stream::live::LiveSamples;
use crate::tls::Tls;

/// Operator's settings of the portal.
#[derive(Debug, Clone)]
pub struct Options {
    /// Web origins, besides this machine's own, whose pages may use the portal without a token.
    pub origins: Vec<String>,
    /// Trusted proxies in front of the portal.
    pub proxies: Proxies,
    /// Service reached by a plain `ws://host:9090`.
    pub default_service: Option<String>,
    /// Robot assumed for a plain `ws://host:9090`; if not set, each connection is a robot of its own.
    pub default_robot: Option<String>,
    /// True if robots on this machine connect without a token even where tokens exist.
    pub loopback_robots: bool,
    /// Timeout of a request's header and of an awaited `auth` message.
    pub handshake: Duration,
    /// Time that connections get to finish when the daemon stops.
    pub drain: Duration,
    /// Isolation mode of the configuration: what to do on a machine that cannot set limits.
    pub isolation: String,
    /// Settings of the servants' black boxes.
    pub black_box: BlackBoxOptions,
    /// True if programs may be run in servants.
    pub exec: bool,
}

/// Results of the checks of the machine at startup.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MachineChecks {
    /// Version of the usable cgroup controllers; 0 if there are none.
    pub cgroup_version: u8,
    /// Limits that cannot be set.
    pub missing_limits: Vec<String>,
    /// Problems found.
    pub warnings: Vec<String>,
}

/// Authority for robots' certificates and their lifetime.
pub struct RobotAuthority {
    /// The daemon's own authority.
    pub authority: Authority,
    /// Lifetime of a certificate.
    pub lifetime: Duration,
}

/// Shared state of all request handlers.
pub struct App {
    /// Operator's settings.
    pub options: Options,
    /// Principals and the policy.
    pub principals: Principals,
    /// Hashing of people's passwords.
    pub passwords: Passwords,
    /// Identity provider, if configured.
    pub provider: Option<IdentityProvider>,
    /// Audit log.
    pub audit: Audit,
    /// Connections that have not authenticated yet.
    pub strangers: Arc<Strangers>,
    /// Address to which the portal is bound.
    pub listen: std::net::SocketAddr,
    /// TLS of the TCP listener; `None` for plain text.
    pub tls: Option<Arc<Tls>>,
    /// Authority that signs robots' certificates, if TLS is used.
    pub robots: Option<RobotAuthority>,
    /// Key that signs stubs.
    pub signing: Arc<sign::SigningKey>,
    /// State directory.
    pub home: std::path::PathBuf,
    /// Database.
    pub state: Arc<State>,
    /// Published services.
    pub catalogue: Arc<Catalogue>,
    /// Servants.
    pub choreographer: Choreographer,
    /// Pushes.
    pub pusher: Arc<Pusher>,
    /// Results of the checks at startup.
    pub machine: MachineChecks,
    /// Runs all checks of the machine anew. Blocks.
    pub examine: Box<dyn Fn() -> api::Doctor + Send + Sync>,
    /// Live updates for pages.
    pub live: LiveSamples,
    /// Connections that look into servants.
    pub inside: InsideConnections,
    /// Exec sessions, by the name of their principal.
    pub execs: Slots<String>,
    /// Observers of servants: black boxes and goal monitors.
    pub observers: Observers,
    /// Start time of the daemon.
    pub started: Millis,
    /// Sessions in progress.
    pub sessions: TaskTracker,
    /// Cancelled when the daemon stops.
    pub ending: CancellationToken,
}

impl App {
    /// Returns the address at which robots reach a service.
    pub fn address(&self, service: &str) -> String {
        let scheme = if self.tls.is_some() { "wss" } else { "ws" };
        let mut address = self.listen;
        if address.ip().is_unspecified() {
            let local: std::net::IpAddr = match address.ip() {
                std::net::IpAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
                std::net::IpAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
            };
            let host = nix::unistd::gethostname().ok().and_then(|name| name.into_string().ok());
            return match host {
                Some(host) => format!("{scheme}://{host}:{}/{service}", address.port()),
                None => {
                    address.set_ip(local);
                    format!("{scheme}://{address}/{service}")
                }
            };
        }
        format!("{scheme}://{address}/{service}")
    }
}
