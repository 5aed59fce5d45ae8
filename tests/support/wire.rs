//! Raw bytes sent to a daemon: requests that no client library would write.

use std::io::{Read, Write};

use anyhow::ensure;

use crate::patience::{connect, is_slow};

/// Sends `sent` and returns everything received until the other side closes the connection, which `sent` must request.
///
/// # Errors
/// If nobody listens, or if the connection is not closed within the time limit of a story.
pub fn exchange_with(address: &str, sent: &[u8]) -> anyhow::Result<String> {
    exchange(connect(address)?, sent)
}

/// Does the same on an established connection.
///
/// # Errors
/// If the connection is not closed in time.
pub fn exchange(mut stream: impl Read + Write, sent: &[u8]) -> anyhow::Result<String> {
    // A request that is refused at its first line may be cut off before the last line is written.
    let _ = stream.write_all(sent);
    let mut heard = Vec::new();
    let mut buffer = [0; 16 << 10];
    loop {
        match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(length) => heard.extend_from_slice(&buffer[..length]),
            Err(error) => {
                ensure!(!is_slow(&error), "the connection is still open after {:?}", String::from_utf8_lossy(&heard));
                break;
            }
        }
    }
    Ok(String::from_utf8_lossy(&heard).into_owned())
}

/// Returns the statuses of all responses.
pub fn statuses(heard: &str) -> Vec<u16> {
    let lines = heard.split("HTTP/1.1 ").skip(1).chain(heard.split("HTTP/1.0 ").skip(1));
    lines.filter_map(|rest| rest.get(..3)?.parse().ok()).collect()
}
