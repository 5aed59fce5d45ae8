//! Clients that stay connected and send nothing.

use std::thread::JoinHandle;

use anyhow::{Context, Result, anyhow};
use futures_util::{SinkExt, StreamExt};
use serde_json::json;
use tokio::sync::watch;
use tokio_tungstenite::tungstenite::Message;

/// Clients that answer pings and send nothing else, on a thread of their own.
pub(crate) struct IdleCrowd {
    ask: watch::Sender<bool>,
    thread: JoinHandle<usize>,
}

impl IdleCrowd {
    /// Connects `count` clients, one after the other.
    pub(crate) fn connect(url: &str, count: usize) -> Result<Self> {
        let (ask, asked) = watch::channel(false);
        let (connected, are_connected) = std::sync::mpsc::channel();
        let url = url.to_owned();
        let thread = std::thread::spawn(move || {
            let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else {
                return 0;
            };
            runtime.block_on(async {
                let mut all = tokio::task::JoinSet::new();
                for number in 0..count {
                    match connect_client(&url).await {
                        Ok(socket) => drop(all.spawn(stay_connected(socket, asked.clone()))),
                        Err(error) => eprintln!("connection {number}: {error:#}"),
                    }
                }
                let _ = connected.send(());
                all.join_all().await.into_iter().filter(|is_answered| *is_answered).count()
            })
        });
        support::patience::receive(&are_connected)?;
        Ok(Self { ask, thread })
    }

    /// Has every client that is still connected call its servant and leave; returns how many were answered.
    pub(crate) fn ask_and_leave(self) -> Result<usize> {
        // Fails if all connections have ended.
        let _ = self.ask.send(true);
        self.thread.join().map_err(|_| anyhow!("the crowd panicked"))
    }
}

type Socket = tokio_tungstenite::WebSocketStream<tokio::net::TcpStream>;

async fn connect_client(url: &str) -> Result<Socket> {
    let address = url.strip_prefix("ws://").and_then(|rest| rest.split('/').next());
    let stream = tokio::net::TcpStream::connect(address.context("a ws:// address")?).await?;
    Ok(tokio_tungstenite::client_async(url, stream).await?.0)
}

/// Reads, and so answers pings, until the client is to make its call; returns whether it was answered.
async fn stay_connected(mut socket: Socket, mut asked: watch::Receiver<bool>) -> bool {
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
