//! A process between client and node, in the place of the daemon: it either copies bytes, or converts messages through
//! `serde_json::Value`. It prints its address, serves one client and ends with it.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

use crate::node::{IMAGE, MeterSockets, PATIENCE, STRING};
use crate::raw::RawNode;
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
    /// True to convert through values, for a WebSocket.
    pub(crate) values: bool,
}

/// A relay in a child process, which ends on drop.
pub(crate) struct Relay {
    child: Child,
    /// Address for its client.
    pub(crate) address: String,
}

impl Relay {
    pub(crate) fn start(pid: i32, hops: RelayHops<'_>) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("relay").arg(pid.to_string());
        command.arg(if hops.values { "values" } else { "bytes" });
        command.arg(if hops.images { "images" } else { "strings" });
        for (flag, topic) in [("in", hops.inward), ("out", hops.outward), ("call", hops.service)] {
            command.args(topic.map(|topic| format!("{flag}={topic}")));
        }
        let mut child = command.stdout(Stdio::piped()).spawn()?;
        let mut address = String::new();
        BufReader::new(child.stdout.take().context("piped")?).read_line(&mut address)?;
        Ok(Self { child, address: address.trim().to_owned() })
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        // The process ends once its client has gone, after it has unregistered its topics.
        let patience = Instant::now() + PATIENCE;
        while matches!(self.child.try_wait(), Ok(None)) && Instant::now() < patience {
            std::thread::sleep(Duration::from_millis(2));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs the relay; called in the child process.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    let [pid, how, messages, connections @ ..] = words else {
        bail!("relay PID HOW MESSAGES [in=TOPIC] [out=TOPIC] [call=SERVICE]")
    };
    let kind = if *messages == "images" { IMAGE } else { STRING };
    let find = |flag: &str| {
        let mut found = connections.iter().filter_map(|word| word.split_once('='));
        found.find(|(name, _)| *name == flag).map(|(_, topic)| topic)
    };
    let (inward, outward, service) = (find("in"), find("out"), find("call"));
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let (inside, name) = (MeterSockets::for_process(pid.parse()?)?, format!("/relay_{}", std::process::id()));
    let raw = runtime.block_on(RawNode::start(inside, &name))?;
    let (mut there, mut back) = (None, None);
    if let Some(service) = service {
        let stream = runtime.block_on(raw.connect_service(service))?;
        there = Some(stream.try_clone()?);
        back = Some(stream);
    }
    if let Some(topic) = outward {
        back = Some(runtime.block_on(raw.subscribe(topic, kind))?);
    }
    if let Some(topic) = inward {
        there = Some(runtime.block_on(raw.publish(topic, kind))?);
    }
    let listener = TcpListener::bind("127.0.0.1:0")?;
    println!("{}", listener.local_addr()?);
    let (client, _) = listener.accept()?;
    client.set_nodelay(true)?;
    match *how {
        "values" => value::serve(client, (inward, there), (outward, back), kind)?,
        _ => relay_client(&client, there, back)?,
    }
    if let Some(topic) = inward {
        runtime.block_on(raw.unpublish(topic))?;
    }
    Ok(())
}

fn relay_client(client: &TcpStream, there: Option<TcpStream>, back: Option<TcpStream>) -> Result<()> {
    let (reader, writer) = (client.try_clone()?, client.try_clone()?);
    let answering = back.map(|back| {
        let kept = back.try_clone();
        (kept, std::thread::spawn(move || pump(back, writer)))
    });
    match there {
        Some(there) => pump(reader, there)?,
        // The client sends nothing; wait until it disconnects.
        None => drop({ reader }.read(&mut [0])?),
    }
    if let Some((kept, thread)) = answering {
        kept?.shutdown(Shutdown::Both)?;
        let _ = thread.join();
    }
    Ok(())
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
