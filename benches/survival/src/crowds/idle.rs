//! Connections that say nothing.

use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use bench_report::{Report, Target};
use futures_util::{SinkExt, StreamExt};
use serde_json::json;
use support::daemon::Daemon;
use tokio::sync::watch;
use tokio_tungstenite::tungstenite::Message;

use crate::greeters::{self, SILENCE};
use crate::milliseconds::part;
use crate::resources::Resources;

/// So many.
const IDLE: usize = 1000;
/// Between another robot's calls.
const PACE: Duration = Duration::from_millis(50);

/// A thousand that say nothing.
#[derive(Debug)]
pub(super) struct Idle {
    answered: usize,
    /// Kilobytes of the daemon's memory for each.
    kilobytes: f64,
    /// Times of another robot's calls without them and beside them.
    alone: Vec<Duration>,
    beside: Vec<Duration>,
}

pub(super) fn measure(daemon: &Daemon) -> Result<Idle> {
    let alone = call_for(daemon, SILENCE / 2)?;
    let before = Resources::of(daemon.pid())?;
    let crowd = Crowd::connect(&daemon.url(&greeters::path("crowd")), IDLE)?;
    // Longer than who answers no pings is let stay.
    let beside = call_for(daemon, SILENCE * 3 / 2)?;
    let grown = Resources::of(daemon.pid())?.proportional - before.proportional;
    Ok(Idle {
        answered: crowd.ask()?,
        kilobytes: grown * 1e3 / IDLE as f64,
        alone,
        beside,
    })
}

impl Idle {
    pub(super) fn tell(&self, report: &mut Report) {
        report
            .figure(
                format!("idle WebSockets of {IDLE} that are answered"),
                "",
                self.answered as f64,
            )
            .reach(Target::AtLeast(IDLE as f64))
            .note(format!(
                "after {:?}; {:.0} kB of the daemon's memory for each",
                SILENCE * 3 / 2,
                self.kilobytes
            ));
        report
            .figure(
                format!("a call beside {IDLE} idle WebSockets, p99"),
                "ms",
                part(&self.beside, 0.99),
            )
            .beside("without them", part(&self.alone, 0.99))
            .reach(Target::RatioAtMost(2.0))
            .note(format!(
                "p50 {:.2} ms beside {:.2} ms",
                part(&self.beside, 0.5),
                part(&self.alone, 0.5)
            ));
    }
}

/// Clients that answer pings and say nothing else, in a thread of their own.
struct Crowd {
    ask: watch::Sender<bool>,
    thread: JoinHandle<usize>,
}

impl Crowd {
    fn connect(url: &str, count: usize) -> Result<Self> {
        let (ask, asked) = watch::channel(false);
        let (connected, are_connected) = std::sync::mpsc::channel();
        let url = url.to_owned();
        let thread = std::thread::spawn(move || {
            let Ok(runtime) = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()
            else {
                return 0;
            };
            runtime.block_on(async {
                let mut all = tokio::task::JoinSet::new();
                for number in 0..count {
                    match client(&url).await {
                        Ok(socket) => drop(all.spawn(stay(socket, asked.clone()))),
                        Err(error) => eprintln!("connection {number}: {error:#}"),
                    }
                }
                let _ = connected.send(());
                all.join_all()
                    .await
                    .into_iter()
                    .filter(|is_answered| *is_answered)
                    .count()
            })
        });
        support::patience::receive(&are_connected)?;
        Ok(Self { ask, thread })
    }

    /// Has each ask its servant something, and leave; returns how many were answered.
    fn ask(self) -> Result<usize> {
        self.ask.send(true).context("all connections have ended")?;
        self.thread
            .join()
            .map_err(|_| anyhow!("the crowd panicked"))
    }
}

type Socket = tokio_tungstenite::WebSocketStream<tokio::net::TcpStream>;

async fn client(url: &str) -> Result<Socket> {
    let address = url
        .strip_prefix("ws://")
        .and_then(|rest| rest.split('/').next());
    let stream = tokio::net::TcpStream::connect(address.context("a ws:// address")?).await?;
    Ok(tokio_tungstenite::client_async(url, stream).await?.0)
}

/// Reads, and so answers pings, until it is to ask; says whether it was answered.
async fn stay(mut socket: Socket, mut asked: watch::Receiver<bool>) -> bool {
    let call = json!({"op": "call_service", "id": "idle", "service": "/greeter/count", "args": {"reset": false}});
    let mut is_asked = false;
    loop {
        tokio::select! {
            _ = asked.changed(), if !is_asked => {
                is_asked = true;
                if socket.send(Message::text(call.to_string())).await.is_err() {
                    return false;
                }
            }
            message = socket.next() => match message {
                Some(Ok(Message::Text(text))) if text.contains("\"idle\"") => {
                    let _ = socket.close(None).await;
                    return text.contains("\"result\":true");
                }
                Some(Ok(_)) => {}
                _ => return false,
            },
        }
    }
}

/// Calls as another robot again and again for a while; returns how long each took.
fn call_for(daemon: &Daemon, time: Duration) -> Result<Vec<Duration>> {
    let mut robot = daemon.robot(&greeters::path("polite"))?;
    greeters::count(&mut robot)?;
    let (began, mut times) = (Instant::now(), Vec::new());
    while began.elapsed() < time {
        let asked = Instant::now();
        greeters::count(&mut robot)?;
        times.push(asked.elapsed());
        std::thread::sleep(PACE);
    }
    Ok(times)
}
