//! The straightforward implementation: every message becomes a tree of `serde_json::Value` by walking the fields of its
//! type, then text; and back. WebSockets are tungstenite's.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use base64::prelude::{BASE64_STANDARD, Engine as _};
use ros::schema::{Arity, Base, Field, MessageType, Primitive};
use serde_json::{Map, Number, Value, json};
use tokio_tungstenite::tungstenite::protocol::Role;
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

use crate::node::TypeDescription;

/// Serves one WebSocket client: forwards its publications to `there` and sends it what arrives on `back`.
pub(crate) fn serve(
    client: TcpStream,
    there: (Option<&str>, Option<TcpStream>),
    back: (Option<&str>, Option<TcpStream>),
    kind: TypeDescription,
) -> Result<()> {
    let kind = MessageType::from_full_text(kind.name, kind.definition)?;
    let writer = client.try_clone()?;
    let mut reader = tungstenite::accept(client).context("the client's handshake")?;
    if let (Some(topic), Some(back)) = back {
        let (topic, kind) = (topic.to_owned(), kind.clone());
        let socket = WebSocket::from_raw_socket(writer, Role::Server, None);
        // The thread ends with the process.
        std::thread::spawn(move || forward_messages(back, socket, &topic, &kind));
    }
    let mut there = there.1;
    loop {
        let text = match reader.read() {
            Ok(Message::Text(text)) => text,
            Ok(_) => continue,
            Err(_) => return Ok(()),
        };
        let mut op: Value = serde_json::from_str(&text)?;
        if let Some(node) = there.as_mut().filter(|_| op["op"] == "publish") {
            let mut message = Vec::new();
            encode(&kind, op["msg"].take(), &mut message)?;
            node.write_all(&(message.len() as u32).to_le_bytes())?;
            node.write_all(&message)?;
        }
    }
}

fn forward_messages(
    mut node: TcpStream,
    mut socket: WebSocket<TcpStream>,
    topic: &str,
    kind: &Arc<MessageType>,
) -> Result<()> {
    let mut size = [0; 4];
    loop {
        node.read_exact(&mut size)?;
        let mut bytes = vec![0; u32::from_le_bytes(size) as usize];
        node.read_exact(&mut bytes)?;
        let message = decode(kind, &mut bytes.as_slice())?;
        let op = json!({ "op": "publish", "topic": topic, "msg": message });
        socket.send(Message::text(op.to_string()))?;
    }
}

fn decode(kind: &MessageType, bytes: &mut &[u8]) -> Result<Value> {
    let mut map = Map::new();
    for field in kind.fields() {
        map.insert(field.name.clone(), decode_field(field, bytes)?);
    }
    Ok(Value::Object(map))
}

fn decode_field(field: &Field, bytes: &mut &[u8]) -> Result<Value> {
    let count = match field.arity {
        Arity::One => return decode_one(&field.base, bytes),
        Arity::Fixed(count) => count as usize,
        Arity::Variable => u32::from_le_bytes(take(bytes)?) as usize,
    };
    if let Base::Primitive(Primitive::Uint8) = field.base {
        return Ok(BASE64_STANDARD.encode(take_slice(bytes, count)?).into());
    }
    (0..count).map(|_| decode_one(&field.base, bytes)).collect()
}

fn decode_one(base: &Base, bytes: &mut &[u8]) -> Result<Value> {
    Ok(match base {
        Base::Message(kind) => decode(kind, bytes)?,
        Base::Primitive(primitive) => match primitive {
            Primitive::String => {
                let length = u32::from_le_bytes(take(bytes)?) as usize;
                String::from_utf8_lossy(take_slice(bytes, length)?).into()
            }
            Primitive::Uint8 => take::<1>(bytes)?[0].into(),
            Primitive::Uint32 => u32::from_le_bytes(take(bytes)?).into(),
            Primitive::Time => json!({
                "secs": u32::from_le_bytes(take(bytes)?), "nsecs": u32::from_le_bytes(take(bytes)?),
            }),
            Primitive::Float64 => Number::from_f64(f64::from_le_bytes(take(bytes)?)).map_or(Value::Null, Value::Number),
            other => bail!("{other:?} is not in the messages measured here"),
        },
    })
}

fn encode(kind: &MessageType, value: Value, out: &mut Vec<u8>) -> Result<()> {
    let Value::Object(mut map) = value else { bail!("{} takes an object", kind.name()) };
    for field in kind.fields() {
        let value = map.remove(&field.name).unwrap_or_default();
        match (&field.arity, &field.base) {
            (Arity::One, base) => encode_one(base, value, out)?,
            (_, Base::Primitive(Primitive::Uint8)) => {
                let bytes = BASE64_STANDARD.decode(value.as_str().context("base64")?)?;
                out.extend_from_slice(&(bytes.len() as u32).to_le_bytes());
                out.extend_from_slice(&bytes);
            }
            _ => bail!("{} is not in the messages measured here", field.name),
        }
    }
    ensure!(map.is_empty(), "there is more in it");
    Ok(())
}

fn encode_one(base: &Base, value: Value, out: &mut Vec<u8>) -> Result<()> {
    let number = |value: &Value| value.as_u64().context("a number");
    match base {
        Base::Message(kind) => encode(kind, value, out)?,
        Base::Primitive(Primitive::String) => {
            let text = value.as_str().context("a text")?;
            out.extend_from_slice(&(text.len() as u32).to_le_bytes());
            out.extend_from_slice(text.as_bytes());
        }
        Base::Primitive(Primitive::Uint8) => out.push(number(&value)?.try_into()?),
        Base::Primitive(Primitive::Uint32) => out.extend_from_slice(&u32::try_from(number(&value)?)?.to_le_bytes()),
        Base::Primitive(Primitive::Time) => {
            for part in ["secs", "nsecs"] {
                out.extend_from_slice(&u32::try_from(number(&value[part])?)?.to_le_bytes());
            }
        }
        Base::Primitive(other) => bail!("{other:?} is not in the messages measured here"),
    }
    Ok(())
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Result<[u8; N]> {
    Ok(take_slice(bytes, N)?.try_into()?)
}

fn take_slice<'a>(bytes: &mut &'a [u8], count: usize) -> Result<&'a [u8]> {
    let (taken, rest) = bytes.split_at_checked(count).context("it ends too early")?;
    *bytes = rest;
    Ok(taken)
}
