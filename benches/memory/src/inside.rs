//! Attacks that a servant's nodes can make, from the servant's network namespace.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde_json::json;
use servant::netns::NetNs;
use support::robot::Robot;

/// Address of the Master in every servant.
const MASTER: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 11311);
/// Timeout of everything that is not an attack.
const PATIENCE: Duration = Duration::from_secs(60);
const PARAMETERS: usize = 60;
const READERS: usize = 30;
const FRAMES: usize = 8;
const FRAME: u32 = 250 << 20;

fn connect(to: SocketAddr) -> Result<TcpStream> {
    let stream = TcpStream::connect(to)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    Ok(stream)
}

/// Builds an XML-RPC call to the Master with string arguments.
fn xml_rpc_request(method: &str, arguments: &[&str]) -> String {
    let mut body = format!("<?xml version=\"1.0\"?><methodCall><methodName>{method}</methodName><params>");
    for argument in arguments {
        body += &format!("<param><value><string>{argument}</string></value></param>");
    }
    body += "</params></methodCall>";
    let length = body.len();
    format!("POST / HTTP/1.1\r\nHost: master\r\nContent-Length: {length}\r\n\r\n{body}")
}

/// Reads one response of a kept-alive connection.
fn read_answer(stream: &mut TcpStream) -> Result<String> {
    let mut bytes = Vec::new();
    let mut some = [0; 4096];
    loop {
        let read = stream.read(&mut some)?;
        ensure!(read > 0, "the Master hung up");
        bytes.extend_from_slice(&some[..read]);
        let text = String::from_utf8_lossy(&bytes);
        let Some((head, body)) = text.split_once("\r\n\r\n") else {
            continue;
        };
        let length = head.lines().find_map(|line| {
            let (name, value) = line.split_once(':')?;
            let is_length = name.eq_ignore_ascii_case("content-length");
            is_length.then(|| value.trim().parse::<usize>().ok())?
        });
        if body.len() >= length.context("a length")? {
            return Ok(body.to_owned());
        }
    }
}

fn call_master(method: &str, arguments: &[&str]) -> Result<String> {
    let mut stream = connect(MASTER)?;
    stream.write_all(xml_rpc_request(method, arguments).as_bytes())?;
    read_answer(&mut stream)
}

/// Sets parameters and requests all of them repeatedly without reading the responses.
pub(crate) fn flood_parameters(network: &NetNs) -> Result<String> {
    network.run(|| {
        let value = "x".repeat(1_000_000);
        let mut refused = 0;
        for number in 0..PARAMETERS {
            let name = format!("/attack/p{number}");
            let told = call_master("setParam", &["/attacker", &name, &value]);
            refused += usize::from(told.is_err() || told.is_ok_and(|told| !told.contains(">1<")));
        }
        let mut unread = Vec::new();
        for _ in 0..READERS {
            let mut stream = connect(MASTER)?;
            stream.write_all(xml_rpc_request("getParam", &["/attacker", "/"]).as_bytes())?;
            unread.push(stream);
        }
        // Waits until one of the requests is being answered, and a little longer.
        let until = Instant::now() + PATIENCE;
        let answered = |stream: &TcpStream| stream.peek(&mut [0]).is_ok_and(|read| read > 0);
        for stream in &unread {
            stream.set_nonblocking(true)?;
        }
        while Instant::now() < until && !unread.iter().any(answered) {
            std::thread::sleep(Duration::from_millis(50));
        }
        std::thread::sleep(Duration::from_secs(3));
        let count = unread.iter().filter(|stream| answered(stream)).count();
        Ok(format!("{refused} of {PARAMETERS} parameters were refused, {count} of {READERS} answers begun"))
    })?
}

/// Calls a service of the robot with requests that never end.
pub(crate) fn send_unfinished_requests(network: &NetNs, robot: &mut Robot) -> Result<String> {
    let service_type = robot.call("/rosapi/service_type", json!({"service": "/add_two"}))?;
    robot.send(json!({
        "op": "advertise_service", "service": "/attacked", "type": service_type["values"]["type"],
    }))?;
    // The service is registered by the time this call is answered.
    robot.call("/rosapi/services", json!({}))?;
    network.run(|| {
        let told = call_master("lookupService", &["/attacker", "/attacked"])?;
        // The response contains the URI twice, the first time within a sentence.
        let (_, rest) = told.rsplit_once("rosrpc://").with_context(|| told.clone())?;
        let address = rest.split(['/', '<']).next().unwrap_or_default();
        let (_, port) = address.rsplit_once(':').context("a port")?;
        let to = SocketAddr::from((Ipv4Addr::LOCALHOST, port.parse()?));
        let results: Vec<_> = std::thread::scope(|scope| {
            let frames = (0..FRAMES).map(|_| scope.spawn(move || send_unfinished_request(to)));
            let frames: Vec<_> = frames.collect();
            frames.into_iter().map(|frame| frame.join()).collect()
        });
        let mut sent = Vec::new();
        for result in results {
            sent.push(result.map_err(|_| anyhow::anyhow!("an attacker panicked"))??);
        }
        let whole = sent.iter().filter(|(sent, _)| *sent == FRAME - 1).count();
        Ok(format!("{} of {FRAMES} connections were closed", FRAMES - whole))
    })?
}

/// Sends all bytes of a request except the last; returns how many were accepted, and the connection.
fn send_unfinished_request(to: SocketAddr) -> Result<(u32, TcpStream)> {
    let mut stream = connect(to)?;
    let mut header = Vec::new();
    for field in ["callerid=/attacker", "service=/attacked", "md5sum=*"] {
        header.extend_from_slice(&u32::try_from(field.len())?.to_le_bytes());
        header.extend_from_slice(field.as_bytes());
    }
    stream.write_all(&u32::try_from(header.len())?.to_le_bytes())?;
    stream.write_all(&header)?;
    let mut length = [0; 4];
    stream.read_exact(&mut length)?;
    stream.read_exact(&mut vec![0; u32::from_le_bytes(length) as usize])?;
    stream.write_all(&FRAME.to_le_bytes())?;
    let chunk = vec![7; 1 << 20];
    let mut sent = 0;
    while sent < FRAME - 1 {
        let next = chunk.len().min((FRAME - 1 - sent) as usize);
        match stream.write(&chunk[..next]) {
            Ok(written) => sent += u32::try_from(written)?,
            Err(_) => break,
        }
    }
    Ok((sent, stream))
}

/// Sends small requests to the Master for `time` from four connections.
pub(crate) fn drive_master(network: &NetNs, time: Duration) -> Result<()> {
    network.run(|| {
        let until = Instant::now() + time;
        let asks = || -> Result<()> {
            let mut stream = connect(MASTER)?;
            while Instant::now() < until {
                stream.write_all(xml_rpc_request("getPid", &["/attacker"]).as_bytes())?;
                read_answer(&mut stream)?;
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            let all: Vec<_> = (0..4).map(|_| scope.spawn(asks)).collect();
            for one in all {
                one.join().map_err(|_| anyhow::anyhow!("an attacker panicked"))??;
            }
            Ok(())
        })
    })?
}
