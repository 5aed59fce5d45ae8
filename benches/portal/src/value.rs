//! The straightforward implementation: a tree of `serde_json::Value` for every message of the two measured types.

use std::io::{Read, Write};
use std::net::TcpStream;

use anyhow::{Context, Result};
use base64::prelude::{BASE64_STANDARD, Engine as _};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::protocol::Role;
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

/// Serves a WebSocket client between a connection `there` and a topic's connection `back`.
pub(crate) fn serve(
    client: TcpStream,
    there: Option<TcpStream>,
    back: Option<(&str, TcpStream)>,
    images: bool,
) -> Result<()> {
    let writer = client.try_clone()?;
    let mut reader = tungstenite::accept(client).context("the client's handshake")?;
    if let Some((topic, back)) = back {
        let topic = topic.to_owned();
        let socket = WebSocket::from_raw_socket(writer, Role::Server, None);
        // The thread ends with the process.
        std::thread::spawn(move || forward_messages(back, socket, &topic, images));
    }
    let mut there = there;
    loop {
        let text = match reader.read() {
            Ok(Message::Text(text)) => text,
            Ok(_) => continue,
            Err(_) => return Ok(()),
        };
        let op: Value = serde_json::from_str(&text)?;
        if let Some(node) = there.as_mut().filter(|_| op["op"] == "publish") {
            let message = encode(&op["msg"], images)?;
            node.write_all(&(message.len() as u32).to_le_bytes())?;
            node.write_all(&message)?;
        }
    }
}

fn forward_messages(mut node: TcpStream, mut socket: WebSocket<TcpStream>, topic: &str, images: bool) -> Result<()> {
    let mut size = [0; 4];
    loop {
        node.read_exact(&mut size)?;
        let mut bytes = vec![0; u32::from_le_bytes(size) as usize];
        node.read_exact(&mut bytes)?;
        let message = decode(&mut bytes.as_slice(), images)?;
        let op = json!({ "op": "publish", "topic": topic, "msg": message });
        socket.send(Message::text(op.to_string()))?;
    }
}

/// Decodes a sensor_msgs/Image or a std_msgs/String.
fn decode(bytes: &mut &[u8], images: bool) -> Result<Value> {
    if !images {
        return Ok(json!({ "data": decode_text(bytes)? }));
    }
    let stamp = |bytes: &mut &[u8]| anyhow::Ok(json!({ "secs": decode_u32(bytes)?, "nsecs": decode_u32(bytes)? }));
    let header = json!({ "seq": decode_u32(bytes)?, "stamp": stamp(bytes)?, "frame_id": decode_text(bytes)? });
    Ok(json!({
        "header": header,
        "height": decode_u32(bytes)?,
        "width": decode_u32(bytes)?,
        "encoding": decode_text(bytes)?,
        "is_bigendian": take(bytes, 1)?[0],
        "step": decode_u32(bytes)?,
        "data": BASE64_STANDARD.encode(decode_bytes(bytes)?),
    }))
}

fn encode(message: &Value, images: bool) -> Result<Vec<u8>> {
    let number = |value: &Value| anyhow::Ok(u32::try_from(value.as_u64().context("a number")?)?.to_le_bytes());
    let text = |value: &Value| value.as_str().map(str::to_owned).context("a text");
    let mut out = Vec::new();
    let put = |out: &mut Vec<u8>, bytes: &[u8]| {
        out.extend_from_slice(&(bytes.len() as u32).to_le_bytes());
        out.extend_from_slice(bytes);
    };
    if !images {
        put(&mut out, text(&message["data"])?.as_bytes());
        return Ok(out);
    }
    let header = &message["header"];
    for value in [&header["seq"], &header["stamp"]["secs"], &header["stamp"]["nsecs"]] {
        out.extend_from_slice(&number(value)?);
    }
    put(&mut out, text(&header["frame_id"])?.as_bytes());
    out.extend_from_slice(&number(&message["height"])?);
    out.extend_from_slice(&number(&message["width"])?);
    put(&mut out, text(&message["encoding"])?.as_bytes());
    out.push(u8::try_from(message["is_bigendian"].as_u64().context("a number")?)?);
    out.extend_from_slice(&number(&message["step"])?);
    put(&mut out, &BASE64_STANDARD.decode(message["data"].as_str().context("base64")?)?);
    Ok(out)
}

fn take<'a>(bytes: &mut &'a [u8], count: usize) -> Result<&'a [u8]> {
    let (taken, rest) = bytes.split_at_checked(count).context("it ends too early")?;
    *bytes = rest;
    Ok(taken)
}

fn decode_u32(bytes: &mut &[u8]) -> Result<u32> {
    Ok(u32::from_le_bytes(take(bytes, 4)?.try_into()?))
}

fn decode_bytes<'a>(bytes: &mut &'a [u8]) -> Result<&'a [u8]> {
    let length = decode_u32(bytes)? as usize;
    take(bytes, length)
}

fn decode_text<'a>(bytes: &mut &'a [u8]) -> Result<&'a str> {
    Ok(std::str::from_utf8(decode_bytes(bytes)?)?)
}
