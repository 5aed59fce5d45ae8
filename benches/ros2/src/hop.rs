//! A process between a client and a datagram's echo that moves bytes and nothing else: what any server between a client and a node adds, if it
//! had nothing to do.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::Instant;

use anyhow::{Context as _, Result};
use serde_json::json;

use crate::portal::ADDRESS;
use crate::roles::{DATAGRAM, ECHO, PATIENCE, WARM, quantiles, say};

/// Serves one client, from its connection to the echo and back.
pub(crate) fn serve() -> Result<()> {
    let listener = TcpListener::bind(ADDRESS)?;
    let echo = UdpSocket::bind("127.0.0.1:0")?;
    echo.connect(ECHO)?;
    say(&json!({}));
    let (mut client, _) = listener.accept()?;
    client.set_nodelay(true)?;
    let mut bytes = [0; 2048];
    loop {
        let length = client.read(&mut bytes)?;
        if length == 0 {
            return Ok(());
        }
        echo.send(&bytes[..length])?;
        let length = echo.recv(&mut bytes)?;
        client.write_all(&bytes[..length])?;
    }
}

/// As many bytes as a String takes with what RTPS puts around it, through [`serve`] and back; one at a time.
pub(crate) fn trips(count: usize) -> Result<()> {
    let mut relay = TcpStream::connect(ADDRESS).context(ADDRESS)?;
    relay.set_nodelay(true)?;
    relay.set_read_timeout(Some(PATIENCE))?;
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        relay.write_all(&DATAGRAM)?;
        relay.read_exact(&mut [0; DATAGRAM.len()])?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    say(&quantiles(&times));
    Ok(())
}
