//! The link and the connections that carry it.
//!
//! ```text
//!  hello ─▶ Linked ──lost──▶ Away ──pause──▶ hello (resume)
//!             └──silent──▶ tries another connection beside it ──it stands──▶ hello (resume)
//!                  └─anything came─▶ Linked
//! ```
//! TCP waits ever longer before it sends again what was lost: after some seconds without a network a connection stays
//! silent for as many more once the network is back. So a silent one is not waited for until it is given up; a new one
//! takes its place as soon as there can be one.

use std::sync::Arc;
use std::time::Duration;

use link::control::{Hello, Resume, Welcome};
use link::session::{receive_open, send_open};
use link::{Lost, RobotSession};
use tokio::time::{Instant, sleep, sleep_until, timeout};
use ws::WebSocket;

use crate::config::{self, Config};
use crate::connect;
use crate::mirror::Mirror;
use crate::run;
use crate::stream::Stream;
use crate::terms;

/// For the portal to accept a connection.
const CONNECT: Duration = Duration::from_secs(10);
/// For the first welcome, which comes when the servant runs.
const SERVANT: Duration = Duration::from_secs(120);
/// For the welcome of a link that is taken up again, at first: a network may be lost here, too.
const WELCOME: Duration = Duration::from_secs(5);
/// Between the beginnings of two attempts, at first.
const PAUSE: Duration = Duration::from_millis(50);
/// The longest pauses between the beginnings of two attempts.
const PAUSES: Pauses = Pauses {
    away: Duration::from_secs(1),
    busy: Duration::from_secs(3),
    refused: Duration::from_secs(60),
    stood: Duration::from_secs(10),
};
/// After a link has fallen silent, until another connection is tried beside it.
const STANDBY: Duration = Duration::from_secs(1);

/// How long the pauses between attempts become.
struct Pauses {
    /// While no server is reached.
    away: Duration,
    /// While the server says that it has no capacity.
    busy: Duration,
    /// While the server refuses a stub whose link it had accepted before: from the first such pause on.
    refused: Duration,
    /// A link that stood for so long is tried again at once when it is lost. One that did not may be accepted and lost again and again.
    stood: Duration,
}

/// How a connection ended that had carried the link.
enum End {
    Lost(Lost),
    /// It was silent, and this one is not.
    Replaced(Box<WebSocket<Stream>>),
}

/// Keeps a link until the cloud refuses its first connection, or this side ends it; says why. What was accepted once may be refused for a
/// while, by a proxy before the server or while an operator works there, and the robot's nodes go on meanwhile.
pub async fn keep(config: &Config, mirror: &Arc<Mirror>, hello: &mut Hello) -> String {
    keep_with(config, mirror, hello, &PAUSES).await
}

async fn keep_with(
    config: &Config,
    mirror: &Arc<Mirror>,
    hello: &mut Hello,
    pauses: &Pauses,
) -> String {
    let mut link = Link {
        config,
        mirror,
        hello,
        session: None,
        since: None,
        welcome: WELCOME,
        unmet: None,
    };
    let mut pace = Pace::default();
    let mut told = String::new();
    let mut standby: Option<Box<WebSocket<Stream>>> = None;
    loop {
        pace.begin();
        let outcome = match standby.take() {
            Some(socket) => link.carry(*socket).await,
            None => link.once().await,
        };
        let reason = match outcome {
            Ok(End::Lost(lost @ Lost::Ended)) => return lost.to_string(),
            Ok(End::Lost(lost)) => {
                tracing::warn!("the link to {} was lost: {lost}", config.server);
                told.clear();
                pace.lost(link.since, pauses);
                None
            }
            Ok(End::Replaced(socket)) => {
                tracing::warn!(
                    "the connection to {} is silent, another takes its place",
                    config.server
                );
                told.clear();
                standby = Some(socket);
                continue;
            }
            Err(connect::Error::Refused(reason)) if link.session.is_none() => return reason,
            Err(connect::Error::Refused(reason)) => {
                pace.pause = pauses.refused;
                let again = format!(
                    "the server has accepted this node before: it is asked again about every {:?}",
                    pauses.refused
                );
                Some((format!("{reason}; {again}"), pauses.refused))
            }
            Err(connect::Error::Unreachable(reason)) => {
                Some((format!("{reason}; trying again"), pauses.away))
            }
            Err(connect::Error::Busy(reason)) => {
                Some((format!("{reason}; trying again"), pauses.busy))
            }
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

/// Attempts begin ever more seldom; the time that one took counts.
struct Pace {
    began: Instant,
    pause: Duration,
}

impl Default for Pace {
    fn default() -> Self {
        Self {
            began: Instant::now(),
            pause: PAUSE,
        }
    }
}

impl Pace {
    fn begin(&mut self) {
        self.began = Instant::now();
    }

    /// A link that was accepted then is lost.
    fn lost(&mut self, since: Option<Instant>, pauses: &Pauses) {
        if since.is_some_and(|since| since.elapsed() >= pauses.stood) {
            *self = Self::default();
        }
    }

    /// Until the next attempt: with jitter, or all robots of a server come at once when it is back.
    async fn wait(&mut self, longest: Duration) {
        let pause = self.pause.min(longest);
        let jitter = rand::random_range(0.5..1.0);
        // An attempt may have taken longer than its pause.
        let least = Instant::now() + PAUSE.mul_f64(jitter);
        sleep_until(least.max(self.began + pause.mul_f64(jitter))).await;
        self.pause = (pause * 2).min(longest);
    }
}

struct Link<'a> {
    config: &'a Config,
    mirror: &'a Arc<Mirror>,
    hello: &'a mut Hello,
    /// As the last welcome named it.
    session: Option<String>,
    /// When that came.
    since: Option<Instant>,
    /// How long a welcome may take when the link is taken up again.
    welcome: Duration,
    /// What was said of the codec that the configuration asks for.
    unmet: Option<String>,
}

impl Link<'_> {
    /// One connection, from its handshake to its loss.
    async fn once(&mut self) -> Result<End, connect::Error> {
        let socket = open(self.config, &self.hello.node.name).await?;
        self.carry(socket).await
    }

    /// Says hello on a connection, and has it carry the link until it is lost or another one is better.
    async fn carry(&mut self, mut socket: WebSocket<Stream>) -> Result<End, connect::Error> {
        self.greet(&mut socket).await?;
        let session = self.mirror.session();
        let running = session.run(&mut socket, &**self.mirror);
        tokio::select! {
            lost = running => Ok(End::Lost(lost)),
            fresh = standby(self.config, &self.hello.node.name, &session) => Ok(End::Replaced(Box::new(fresh))),
        }
    }

    /// Hello and welcome: the session goes on, or another one begins.
    async fn greet(&mut self, socket: &mut WebSocket<Stream>) -> Result<(), connect::Error> {
        let hello = &mut *self.hello;
        if self.session.is_none() && hello.parameters.is_empty() {
            hello.parameters = self.mirror.parameters().await;
        }
        let (received, ahead, next) = self.mirror.session().position();
        hello.attempt += 1;
        hello.next = next;
        hello.resume = self.session.clone().map(|session| Resume {
            session,
            received,
            ahead,
        });
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
            Welcome::Refused {
                reason,
                again: true,
            } => Err(connect::Error::Busy(reason)),
            Welcome::Refused { reason, .. } => Err(connect::Error::Refused(reason)),
            Welcome::Accepted {
                session,
                resumed,
                received,
                ahead,
                next,
                codecs,
                limits,
                servant,
            } => {
                if !resumed && self.session.is_some() {
                    let fresh = run::session(self.config);
                    fresh.begin_at(self.hello.next);
                    self.mirror.renew(fresh);
                }
                self.session = Some(session);
                self.since = Some(Instant::now());
                tracing::info!(servant, resumed, "linked to {}", self.config.server);
                let session = self.mirror.session();
                if self.config.codec != config::Codec::None {
                    session.set_quality(self.config.quality());
                    session.peer_decodes(&codecs);
                }
                let unmet = self.config.codec.unmet(&codecs);
                if let Some(unmet) = unmet.as_ref().filter(|_| unmet != self.unmet) {
                    tracing::warn!("{unmet}");
                }
                self.unmet = unmet;
                session.peer_takes(limits);
                session.reconnect(received, &ahead, next);
                Ok(())
            }
        }
    }
}

async fn open(config: &Config, node: &str) -> Result<WebSocket<Stream>, connect::Error> {
    let stated = terms::query(config, node);
    let path = format!("/{}?robot={}{stated}", config.service, config.robot());
    let refused = |error: anyhow::Error| connect::Error::Refused(format!("{error:#}"));
    // Who is paired shows its certificate, and an older token says nothing that counts.
    let token = match config.trust().map_err(refused)?.identity {
        Some(_) => None,
        None => config.token().map_err(refused)?,
    };
    connect::open(config, &path, token.as_deref(), CONNECT).await
}

/// A connection beside the one that carries the session, once that has been silent and still is.
async fn standby(config: &Config, node: &str, session: &RobotSession) -> WebSocket<Stream> {
    let mut up = session.up();
    loop {
        // The session lives as long as this.
        let _ = up.wait_for(|up| !up).await;
        let mut back = session.up();
        let opening = async {
            loop {
                sleep(STANDBY).await;
                if let Ok(socket) = open(config, node).await {
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
