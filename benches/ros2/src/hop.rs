//! A process between a client and a datagram echo that copies bytes and does nothing else: the minimum that any server
//! between a client and a node adds.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::Instant;

use anyhow::{Context as _, Result};
use serde_json::json;

use crate::measuring::{DATAGRAM, ECHO, PATIENCE, WARM, print_json, quantiles};
use crate::portal::ADDRESS;

/// Serves one client, copying between its connection and the echo.
pub(crate) fn run_relay() -> Result<()> {
    let listener = TcpListener::bind(ADDRESS)?;
    let echo = UdpSocket::bind("127.0.0.1:0")?;
    echo.connect(ECHO)?;
    print_json(&json!({}));
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

/// Measures round trips through [`run_relay`] of as many bytes as a String takes within RTPS, one at a time.
pub(crate) fn time_trips(count: usize) -> Result<()> {
    let mut relay = TcpStream::connect(ADDRESS).context(ADDRESS)?;
    relay.set_nodelay(true)?;
    relay.set_read_timeout(Some(PATIENCE))?;
    print_json(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        relay.write_all(&DATAGRAM)?;
        relay.read_exact(&mut [0; DATAGRAM.len()])?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    print_json(&quantiles(&times));
    Ok(())
}
