//! The roles of this program inside a [`BenchNetwork`](crate::world::BenchNetwork): `bench-ros2 inside ROLE …`. Each
//! role prints `{}` when it is ready, then lines of JSON; a line on its standard input asks for one.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::Instant;

use anyhow::{Context, Result};

use crate::exchanges::{PATIENCE, print_ready, time_blocking};
use crate::portal::{self, ADDRESS};
use crate::{bus, client, crowd};

/// Address of the plain datagram echo.
const ECHO: &str = "127.0.0.1:20000";
/// A datagram of the length of a String within RTPS.
const DATAGRAM: [u8; 128] = [7; 128];

/// Runs the role that `words` names.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    match words {
        ["datagrams"] => echo_datagrams(),
        ["datagram-trips", count] => time_datagrams(count.parse()?),
        ["hop"] => relay_bytes(),
        ["hop-trips", count] => time_hops(count.parse()?),
        ["crowd", count, seconds] => crowd::run(count.parse()?, seconds.parse()?),
        ["portal", rest @ ..] => portal::run(rest),
        ["client", rest @ ..] => client::run(rest),
        _ => tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(bus::run(words)),
    }
}

/// Runs the role `datagrams`: returns every datagram.
fn echo_datagrams() -> Result<()> {
    let socket = UdpSocket::bind(ECHO)?;
    print_ready();
    let mut datagram = [0; 2048];
    loop {
        let (length, from) = socket.recv_from(&mut datagram)?;
        socket.send_to(&datagram[..length], from)?;
    }
}

fn connect_echo() -> Result<UdpSocket> {
    let socket = UdpSocket::bind("127.0.0.1:0")?;
    socket.connect(ECHO)?;
    socket.set_read_timeout(Some(PATIENCE))?;
    Ok(socket)
}

/// Measures round trips of [`DATAGRAM`].
fn time_datagrams(count: usize) -> Result<()> {
    let socket = connect_echo()?;
    time_blocking(count, |_| {
        let begun = Instant::now();
        socket.send(&DATAGRAM)?;
        socket.recv(&mut [0; 2048])?;
        Ok(begun.elapsed())
    })
}

/// Runs the role `hop`: copies bytes between one client and the echo, the least that any server adds.
fn relay_bytes() -> Result<()> {
    let (listener, echo) = (TcpListener::bind(ADDRESS)?, connect_echo()?);
    print_ready();
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

/// Measures round trips of [`DATAGRAM`] through [`relay_bytes`].
fn time_hops(count: usize) -> Result<()> {
    let mut relay = TcpStream::connect(ADDRESS).context(ADDRESS)?;
    relay.set_nodelay(true)?;
    relay.set_read_timeout(Some(PATIENCE))?;
    time_blocking(count, |_| {
        let begun = Instant::now();
        relay.write_all(&DATAGRAM)?;
        relay.read_exact(&mut [0; DATAGRAM.len()])?;
        Ok(begun.elapsed())
    })
}
