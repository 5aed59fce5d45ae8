//! The link and the connections that carry it.
//!
//! ```text
//!  hello ─▶ Linked ──lost──▶ Away ──pause──▶ hello (resume)
//!             └──silent──▶ tries another connection beside it ──it stands──▶ hello (resume)
//!                  └─anything came─▶ Linked
//! ```
//!
//! TCP retransmits at increasing intervals: after some seconds without a network, a connection stays silent for as many
//! more seconds when the network is back. So the stub does not wait until a silent connection is given up, but replaces
//! it with a new one as soon as that can be established.

use std::sync::Arc;
use std::time::Duration;

use link::control::{Hello, Resume, Welcome};
use link::session::{receive_open, send_open};
use link::{DisconnectReason, RobotSession};
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tracing::Instrument;
use ws::WebSocket;

use crate::config::{self, Config};
use crate::connect;
use crate::mirror::Mirror;
use crate::run;
use crate::stream::PortalStream;
use crate::terms;

/// Time allowed for the portal to accept a connection.
const CONNECT: Duration = Duration::from_secs(10);
/// Time allowed for the first welcome, which arrives when the servant runs.
const SERVANT: Duration = Duration::from_secs(120);
/// Initial time allowed for the welcome of a link that is resumed: the network may be lost here, too.
const WELCOME: Duration = Duration::from_secs(5);
/// Initial interval between the starts of two attempts.
const PAUSE: Duration = Duration::from_millis(50);
/// Upper limits of the interval between the starts of two attempts.
const PAUSES: RetryPauses = RetryPauses {
    away: Duration::from_secs(1),
    busy: Duration::from_secs(3),
    refused: Duration::from_secs(60),
    stood: Duration::from_secs(10),
};
/// Time that a link is silent before another connection is tried besides it.
const STANDBY: Duration = Duration::from_secs(1);

/// Upper limits of the interval between attempts.
struct RetryPauses {
    /// Limit while no server is reachable.
    away: Duration,
    /// Limit while the server reports that it has no capacity.
    busy: Duration,
    /// Limit while the server refuses a stub whose link it had accepted before; the first interval is at least `busy`.
    refused: Duration,
    /// Age of a link after which it is retried at once when it is lost. A younger one may be accepted and lost
    /// repeatedly.
    stood: Duration,
}

/// End of a connection that carried the link.
enum LinkEnd {
    Lost(DisconnectReason),
    /// The connection was silent, and this one is not.
    Replaced(Box<WebSocket<PortalStream>>),
}

/// Keeps a link until the cloud refuses its first connection, or this side ends it; returns the reason. A link that was
/// accepted once may be refused for a while, by a proxy before the server or during maintenance, and the robot's nodes
/// go on meanwhile.
pub async fn run_link(config: &Config, mirror: &Arc<Mirror>, hello: &mut Hello) -> String {
    let (robot, node) = (config.robot_id(), hello.node.name.clone());
    let span = tracing::error_span!("link", robot, node);
    run_link_with(config, mirror, hello, &PAUSES).instrument(span).await
}

async fn run_link_with(config: &Config, mirror: &Arc<Mirror>, hello: &mut Hello, pauses: &RetryPauses) -> String {
    let mut link = RobotLink { config, mirror, hello, session: None, since: None, welcome: WELCOME, unmet: None };
    let mut pace = RetryPace::default();
    let mut told = String::new();
    let mut standby: Option<Box<WebSocket<PortalStream>>> = None;
    loop {
        pace.start_attempt();
        let outcome = match standby.take() {
            Some(socket) => link.carry(*socket).await,
            None => link.connect_once().await,
        };
        let reason = match outcome {
            Ok(LinkEnd::Lost(lost @ DisconnectReason::Ended)) => return lost.to_string(),
            Ok(LinkEnd::Lost(lost)) => {
                tracing::warn!("the link to {} was lost: {lost}", config.server);
                told.clear();
                pace.on_link_lost(link.since, pauses);
                None
            }
            Ok(LinkEnd::Replaced(socket)) => {
                tracing::warn!("the connection to {} is silent, a new one replaces it", config.server);
                told.clear();
                standby = Some(socket);
                continue;
            }
            Err(connect::Error::Refused(reason)) if link.session.is_none() => return reason,
            Err(connect::Error::Refused(reason)) => {
                pace.on_refused(pauses);
                let limit = pauses.refused;
                let again = format!("the server accepted this node before, so the stub retries within {limit:?}");
                Some((format!("{reason}; {again}"), pauses.refused))
            }
            Err(connect::Error::Unreachable(reason)) => Some((format!("{reason}; trying again"), pauses.away)),
            Err(connect::Error::Busy(reason)) => Some((format!("{reason}; trying again"), pauses.busy)),
        };
        let longest = reason.as_ref().map_or(pauses.away, |(_, longest)| *longest);
        if let Some((reason, _)) = reason {
            if reason != told {
                tracing::warn!("no link: {reason}");
                told = reason;
            }
        }
        pace.wait(longest).await;
    }
}

/// Exponential backoff between attempts; the duration of an attempt counts as part of the interval.
struct RetryPace {
    began: Instant,
    pause: Duration,
}

impl Default for RetryPace {
    fn default() -> Self {
        Self { began: Instant::now(), pause: PAUSE }
    }
}

impl RetryPace {
    fn start_attempt(&mut self) {
        self.began = Instant::now();
    }

    /// Resets the backoff if the lost link had been up for long enough.
    fn on_link_lost(&mut self, since: Option<Instant>, pauses: &RetryPauses) {
        if since.is_some_and(|since| since.elapsed() >= pauses.stood) {
            *self = Self::default();
        }
    }

    fn on_refused(&mut self, pauses: &RetryPauses) {
        self.pause = self.pause.max(pauses.busy);
    }

    /// Waits until the next attempt, with jitter: otherwise all robots would connect at once when the server is back.
    async fn wait(&mut self, longest: Duration) {
        let pause = self.pause.min(longest);
        let jitter = rand::random_range(0.5..1.0);
        // An attempt may have taken longer than the interval.
        let least = Instant::now() + PAUSE.mul_f64(jitter);
        sleep_until(least.max(self.began + pause.mul_f64(jitter))).await;
        self.pause = (pause * 2).min(longest);
    }
}

struct RobotLink<'a> {
    config: &'a Config,
    mirror: &'a Arc<Mirror>,
    hello: &'a mut Hello,
    /// Session id of the last welcome.
    session: Option<String>,
    /// Time of the last welcome.
    since: Option<Instant>,
    /// Time allowed for the welcome when the link is resumed.
    welcome: Duration,
    /// Last warning about the configured codec.
    unmet: Option<String>,
}

impl RobotLink<'_> {
    /// Makes one connection and runs it from its handshake to its loss.
    async fn connect_once(&mut self) -> Result<LinkEnd, connect::Error> {
        let socket = open_link(self.config, &self.hello.node.name).await?;
        self.carry(socket).await
    }

    /// Exchanges hello and welcome on a connection, and lets it carry the link until it is lost or replaced.
    async fn carry(&mut self, mut socket: WebSocket<PortalStream>) -> Result<LinkEnd, connect::Error> {
        self.exchange_hello(&mut socket).await?;
        let session = self.mirror.session();
        let running = session.run(&mut socket, &**self.mirror);
        tokio::select! {
            lost = running => Ok(LinkEnd::Lost(lost)),
            fresh = connect_standby(self.config, &self.hello.node.name,
                &session) => Ok(LinkEnd::Replaced(Box::new(fresh))),
        }
    }

    /// Sends hello and receives welcome; the session is resumed, or another one begins.
    async fn exchange_hello(&mut self, socket: &mut WebSocket<PortalStream>) -> Result<(), connect::Error> {
        let hello = &mut *self.hello;
        if self.session.is_none() && hello.parameters.is_empty() {
            hello.parameters = self.mirror.parameters().await;
        }
        let (received, ahead, next) = self.mirror.session().position();
        hello.attempt += 1;
        hello.next = next;
        hello.resume = self.session.clone().map(|session| Resume { session, received, ahead });
        let patience = match &self.session {
            Some(_) => self.welcome,
            None => SERVANT,
        };
        let mut held = run::FROM_SERVER.permit();
        let opening = async {
            send_open(socket, hello).await?;
            receive_open(socket, "welcome", &mut held).await
        };
        let welcome: Welcome = match timeout(patience, opening).await {
            Ok(Ok(welcome)) => welcome,
            Ok(Err(lost)) => return Err(connect::Error::Unreachable(lost.to_string())),
            Err(_) => {
                self.welcome = (self.welcome * 2).min(SERVANT);
                let reason = format!("no servant after {patience:?}");
                return Err(connect::Error::Unreachable(reason));
            }
        };
        self.welcome = WELCOME;
        match welcome {
            Welcome::Refused { reason, again: true } => Err(connect::Error::Busy(reason)),
            Welcome::Refused { reason, .. } => Err(connect::Error::Refused(reason)),
            Welcome::Accepted { session, resumed, received, ahead, next, codecs, limits, servant } => {
                if !resumed && self.session.is_some() {
                    let fresh = run::new_session(self.config);
                    fresh.begin_at(self.hello.next);
                    self.mirror.replace_session(fresh);
                }
                self.session = Some(session);
                self.since = Some(Instant::now());
                tracing::info!(servant, resumed, "linked to {}", self.config.server);
                let session = self.mirror.session();
                if self.config.codec != config::CodecSetting::None {
                    session.set_peer_codecs(&codecs, self.config.quality());
                }
                let unmet = self.config.codec.unsupported_reason(&codecs);
                if let Some(unmet) = unmet.as_ref().filter(|_| unmet != self.unmet) {
                    tracing::warn!("{unmet}");
                }
                self.unmet = unmet;
                session.set_peer_limits(limits);
                session.reconnect(received, &ahead, next);
                Ok(())
            }
        }
    }
}

async fn open_link(config: &Config, node: &str) -> Result<WebSocket<PortalStream>, connect::Error> {
    let stated = terms::to_query(config, node);
    let path = format!("/{}?robot={}{stated}", config.service, config.robot_id());
    let refused = |error: anyhow::Error| connect::Error::Refused(format!("{error:#}"));
    // A paired robot presents its certificate, and an old token has no effect.
    let token = match config.trust().map_err(refused)?.identity {
        Some(_) => None,
        None => config.token().map_err(refused)?,
    };
    connect::open(config, &path, token.as_deref(), CONNECT).await
}

/// Opens a connection besides the one that carries the session, after that has been silent for a while and still is.
async fn connect_standby(config: &Config, node: &str, session: &RobotSession) -> WebSocket<PortalStream> {
    let mut up = session.watch_up();
    loop {
        // The session outlives this function.
        let _ = up.wait_for(|up| !up).await;
        let mut back = session.watch_up();
        let opening = async {
            loop {
                sleep(STANDBY).await;
                if let Ok(socket) = open_link(config, node).await {
                    return socket;
                }
            }
        };
        tokio::select! {
            biased;
            _ = back.wait_for(|up| *up) => {}
            fresh = opening => return fresh,
        }
    }
}

#[cfg(test)]
mod tests;
