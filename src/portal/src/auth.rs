//! rosbridge's `auth` operation, for clients that cannot put a token into the address. It must be the first message.
//!
//! It is parsed as a frame here, not as a message of a `WebSocket`: the bridge takes over the connection at the next
//! byte, with what was read ahead.

use std::io;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::{Buf, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt};
use ws::WsError;
use ws::frame::{Header, TEXT, unmask};

use crate::principals::refusals::AuthMessageError;
use crate::tokens::AuthMessage;

/// Maximum size of an auth message in bytes; it has a few short fields.
const LONGEST: usize = 16 << 10;

/// Reason why the first message of a connection does not authenticate its sender.
#[derive(Debug, thiserror::Error)]
pub enum FirstMessageError {
    /// Nothing can be read from the connection.
    #[error(transparent)]
    Connection(#[from] io::Error),
    /// The connection ended.
    #[error("the connection ended before its auth message")]
    Ended,
    /// The message is not a WebSocket frame.
    #[error(transparent)]
    Frame(#[from] WsError),
    /// The message is not one text frame.
    #[error("the first message must be one text frame, an auth operation")]
    NotText,
    /// The message is too long.
    #[error("an auth message has at most {LONGEST} bytes")]
    TooLong,
    /// The message is no rosbridge operation.
    #[error("the first message must be an auth operation, because no token was given")]
    NotAnOperation,
    /// The message is this other operation.
    #[error("{0} before auth: no token was given, so the first message must be auth")]
    AnotherOperation(String),
    /// The fields of the operation are invalid.
    #[error("the auth message cannot be read: {0}")]
    Unreadable(serde_json::Error),
    /// The message is not accepted.
    #[error(transparent)]
    Refused(#[from] AuthMessageError),
}

/// Reads the auth message. Returns what `recognise` makes of it and of the time (seconds since 1970), and the bytes
/// read beyond it.
pub async fn read_auth_message<S: AsyncRead + Unpin, T>(
    io: &mut S,
    read_ahead: Bytes,
    recognise: impl Fn(&AuthMessage, f64) -> Result<T, AuthMessageError>,
) -> Result<(T, Bytes), FirstMessageError> {
    let mut buffer = BytesMut::from(read_ahead);
    let payload = loop {
        match take_frame(&mut buffer)? {
            Some(payload) => break payload,
            None => {
                if io.read_buf(&mut buffer).await? == 0 {
                    return Err(FirstMessageError::Ended);
                }
            }
        }
    };
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
    let who = recognise(&parse_auth_message(&payload)?, now)?;
    Ok((who, buffer.freeze()))
}

fn parse_auth_message(payload: &[u8]) -> Result<AuthMessage, FirstMessageError> {
    #[derive(serde::Deserialize)]
    struct Operation {
        op: String,
    }
    let operation: Operation = serde_json::from_slice(payload).map_err(|_| FirstMessageError::NotAnOperation)?;
    if operation.op != "auth" {
        return Err(FirstMessageError::AnotherOperation(operation.op));
    }
    serde_json::from_slice(payload).map_err(FirstMessageError::Unreadable)
}

/// Takes the payload of one complete text frame out of `buffer`; `None` if it is incomplete.
fn take_frame(buffer: &mut BytesMut) -> Result<Option<BytesMut>, FirstMessageError> {
    let Some((header, size)) = Header::parse(buffer)? else {
        return Ok(None);
    };
    let Some(mask) = header.mask.filter(|_| header.last && header.opcode == TEXT) else {
        return Err(FirstMessageError::NotText);
    };
    if header.length > LONGEST as u64 {
        return Err(FirstMessageError::TooLong);
    }
    let length = header.length as usize;
    if buffer.len() < size + length {
        return Ok(None);
    }
    buffer.advance(size);
    let mut payload = buffer.split_to(length);
    unmask(&mut payload, mask);
    Ok(Some(payload))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::{TokenHash, Tokens};

    fn frame(text: &str) -> Vec<u8> {
        let mask = [1, 2, 3, 4];
        let mut frame = vec![0x81];
        if text.len() < 126 {
            frame.push(0x80 | text.len() as u8);
        } else {
            frame.push(0x80 | 126);
            frame.extend_from_slice(&(text.len() as u16).to_be_bytes());
        }
        frame.extend_from_slice(&mask);
        frame.extend(text.bytes().zip(mask.iter().cycle()).map(|(byte, mask)| byte ^ mask));
        frame
    }

    async fn first(sent: &[u8]) -> Result<(TokenHash, Bytes), FirstMessageError> {
        let tokens = Tokens::new(&["open sesame".to_owned()]).expect("a token");
        let (ahead, rest) = sent.split_at(sent.len().min(3));
        let mut rest = rest;
        let recognise = |message: &AuthMessage, now| {
            let known = tokens.recognise_auth(message, now);
            known.map_err(AuthMessageError::from)
        };
        read_auth_message(&mut rest, Bytes::copy_from_slice(ahead), recognise).await
    }

    #[tokio::test]
    async fn a_token_is_taken_and_what_follows_is_left() {
        let padding = "x".repeat(200);
        let mut sent = frame(&format!(r#"{{"op":"auth","mac":"open sesame","rand":"{padding}"}}"#));
        sent.extend_from_slice(b"next frame");
        let (token, rest) = first(&sent).await.expect("a known token");
        assert_eq!(token, crate::tokens::hash("open sesame"));
        assert!(b"next frame".starts_with(&rest[..]), "{rest:?}");
    }

    #[tokio::test]
    async fn anything_else_is_refused_with_words() {
        let cases: [(Vec<u8>, &str); 6] = [
            (frame(r#"{"op":"auth","mac":"guess"}"#), "neither contains a known token"),
            (frame(r#"{"op":"subscribe","topic":"/x"}"#), "subscribe before auth"),
            (frame("hello"), "must be an auth operation"),
            (vec![0x82, 0x80, 0, 0, 0, 0], "one text frame"),
            ([&[0x81, 0xff, 0, 0, 0, 0, 0, 1, 0, 0], &[0; 4][..]].concat(), "at most"),
            (frame(r#"{"op":"auth","mac":"open sesame"}"#)[..10].to_vec(), "ended before"),
        ];
        for (sent, words) in cases {
            let refused = first(&sent).await.expect_err(words).to_string();
            assert!(refused.contains(words), "{refused}");
        }
    }
}
