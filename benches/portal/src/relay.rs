//! A process between client and node, in the place of the daemon: it either copies bytes, or converts messages through
//! `serde_json::Value`. Its connections are its standard streams: output to the client, input from the node, and errors
//! to the node. It ends with its client.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::{AsFd, OwnedFd};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

use crate::node::PATIENCE;
use crate::value;

/// Number of bytes that are copied at a time.
const CHUNK: usize = 256 << 10;

/// The topics or the service between which a relay sits.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RelayHops<'a> {
    /// Topic that the client publishes.
    pub(crate) inward: Option<&'a str>,
    /// Topic that the client subscribes to.
    pub(crate) outward: Option<&'a str>,
    /// Service that the client calls, instead of topics.
    pub(crate) service: Option<&'a str>,
    /// True if the topics have the large type rather than the small one.
    pub(crate) images: bool,
}

/// A relay in a child process, which ends on drop.
pub(crate) struct Relay(Child);

impl Relay {
    /// Starts a relay between these connections, and returns the client's end.
    pub(crate) fn start(
        values: bool,
        hops: RelayHops<'_>,
        from: Option<TcpStream>,
        to: Option<TcpStream>,
    ) -> Result<(Self, TcpStream)> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let client = TcpStream::connect(listener.local_addr()?)?;
        let (served, _) = listener.accept()?;
        served.set_nodelay(true)?;
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["relay", if values { "values" } else { "bytes" }]);
        command.args([if hops.images { "images" } else { "strings" }, hops.outward.unwrap_or_default()]);
        command.args([from.is_some(), to.is_some()].map(|is_there| if is_there { "connected" } else { "none" }));
        let stream = |stream: Option<TcpStream>| stream.map_or_else(Stdio::null, |stream| OwnedFd::from(stream).into());
        let child = command.stdin(stream(from)).stdout(stream(Some(served))).stderr(stream(to)).spawn()?;
        Ok((Self(child), client))
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        let patience = Instant::now() + PATIENCE;
        while matches!(self.0.try_wait(), Ok(None)) && Instant::now() < patience {
            std::thread::sleep(Duration::from_millis(2));
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Runs the relay; called in the child process.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    let [how, messages, topic, from, to] = words else {
        bail!("relay HOW MESSAGES TOPIC FROM TO");
    };
    let clone = |stream: &dyn AsFd| anyhow::Ok(TcpStream::from(stream.as_fd().try_clone_to_owned()?));
    let client = clone(&std::io::stdout())?;
    let from = (*from == "connected").then(|| clone(&std::io::stdin())).transpose()?;
    let to = (*to == "connected").then(|| clone(&std::io::stderr())).transpose()?;
    if *how == "values" {
        return value::serve(client, to, from.map(|from| (*topic, from)), *messages == "images");
    }
    let mut reader = client.try_clone()?;
    if let Some(from) = from {
        // The thread ends with the process.
        std::thread::spawn(move || pump(from, client));
    }
    match to {
        Some(to) => pump(reader, to).context("the client or the node is gone"),
        // The client sends nothing; wait until it disconnects.
        None => Ok(reader.read(&mut [0]).map(|_| ())?),
    }
}

fn pump(mut from: TcpStream, mut to: TcpStream) -> std::io::Result<()> {
    let mut buffer = vec![0; CHUNK];
    loop {
        match from.read(&mut buffer)? {
            0 => return Ok(()),
            read => to.write_all(&buffer[..read])?,
        }
    }
}
