//! Lower bound of any WebSocket request: an upgrade on a new connection, with nothing behind it.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use tokio_tungstenite::tungstenite;

/// Starts a server that accepts upgrades, and nothing else, until this program ends.
pub(crate) fn start_server() -> Result<SocketAddr> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let _ = stream.set_nodelay(true);
            if let Ok(mut socket) = tungstenite::accept(stream) {
                while socket.read().is_ok() {}
            }
        }
    });
    Ok(address)
}

/// Measures one upgrade.
pub(crate) fn time_upgrade(address: &SocketAddr) -> Result<Duration> {
    let begun = Instant::now();
    let stream = TcpStream::connect(address)?;
    stream.set_nodelay(true)?;
    let Ok((mut socket, _)) = tungstenite::client(format!("ws://{address}/"), stream) else {
        bail!("{address} took no upgrade");
    };
    let took = begun.elapsed();
    socket.close(None)?;
    while socket.read().is_ok() {}
    Ok(took)
}
