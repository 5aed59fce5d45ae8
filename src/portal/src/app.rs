//! What requests are answered from.

use std::sync::Arc;
use std::time::Duration;

use api::Millis;
use catalogue::Catalogue;
use choreographer::Choreographer;
use push::Pusher;
use store::State;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::audit::Audit;
use crate::inside::Lookers;
use crate::observers::{BlackBoxOptions, Observers};
use crate::people::passwords::Passwords;
use crate::people::provider::IdentityProvider;
use crate::principals::Principals;
use crate::proxies::Proxies;
use crate::strangers::Strangers;
use crate::stream::Live;
use crate::tls::Tls;

/// What the operator decides of the portal.
#[derive(Debug, Clone)]
pub struct Options {
    /// Web origins besides this machine's own whose pages may use the portal without a token.
    pub origins: Vec<String>,
    /// Proxies in front of the portal that are believed for whom they ask.
    pub proxies: Proxies,
    /// Where a plain `ws://host:9090` goes.
    pub default_service: Option<String>,
    /// The robot that a plain `ws://host:9090` is taken for; one of its own each when not set.
    pub default_robot: Option<String>,
    /// How long a request's header may take, and the `auth` message where one is awaited.
    pub handshake: Duration,
    /// How long connections may take to end when the daemon ends.
    pub drain: Duration,
    /// What is done on a machine that cannot set limits, as the configuration names it.
    pub isolation: String,
    /// What of servants is kept for when something goes wrong.
    pub black_box: BlackBoxOptions,
}

/// What the daemon keeps of its first look at the machine.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Machine {
    /// Version of the usable cgroup controllers; 0: none.
    pub cgroup_version: u8,
    /// Limits that cannot be set.
    pub missing_limits: Vec<String>,
    /// What does not work as it should.
    pub warnings: Vec<String>,
}

/// What requests are answered from.
pub struct App {
    /// What the operator decides.
    pub options: Options,
    /// Who may do what.
    pub principals: Principals,
    /// Hashes of people's passwords.
    pub passwords: Passwords,
    /// Who else knows people.
    pub provider: Option<IdentityProvider>,
    /// What was done.
    pub audit: Audit,
    /// Connections on which nobody has shown yet who asks.
    pub strangers: Arc<Strangers>,
    /// Where the portal listens, as bound.
    pub listen: std::net::SocketAddr,
    /// TLS of the TCP listener; none: plain text.
    pub tls: Option<Arc<Tls>>,
    /// What signs robots' certificates, where TLS is spoken.
    pub robots: Option<crate::machines::Robots>,
    /// What stubs are signed by.
    pub signing: Arc<sign::SigningKey>,
    /// The state directory.
    pub home: std::path::PathBuf,
    /// The database.
    pub state: Arc<State>,
    /// What is published.
    pub catalogue: Arc<Catalogue>,
    /// Servants.
    pub choreographer: Choreographer,
    /// Pushes.
    pub pusher: Arc<Pusher>,
    /// The state of this machine, as checked at start.
    pub machine: Machine,
    /// Makes all checks of this machine anew; blocks.
    pub examine: Box<dyn Fn() -> api::Doctor + Send + Sync>,
    /// What pages are told as it changes.
    pub live: Live,
    /// Who looks into servants.
    pub inside: Lookers,
    /// Who hears servants beside their robots.
    pub observers: Observers,
    /// When the daemon started.
    pub started: Millis,
    /// Sessions under way.
    pub sessions: TaskTracker,
    /// Cancelled when the daemon ends.
    pub ending: CancellationToken,
}

impl App {
    /// Where robots reach a service.
    pub fn address(&self, service: &str) -> String {
        let scheme = if self.tls.is_some() { "wss" } else { "ws" };
        let mut address = self.listen;
        if address.ip().is_unspecified() {
            let local: std::net::IpAddr = match address.ip() {
                std::net::IpAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
                std::net::IpAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
            };
            let host = nix::unistd::gethostname()
                .ok()
                .and_then(|name| name.into_string().ok());
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
