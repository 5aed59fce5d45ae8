//! Bytes sent to a daemon as they are: requests that no client library would write.

use std::io::{Read, Write};

use anyhow::ensure;

use crate::patience::{connect, is_slow};

/// All that comes back for `sent` until the other side ends the connection. What is sent must ask for that.
///
/// # Errors
/// Where nobody listens, and where the connection does not end within the time that a story waits.
pub fn answers(address: &str, sent: &[u8]) -> anyhow::Result<String> {
    exchange(connect(address)?, sent)
}

/// The same over a connection that is there.
///
/// # Errors
/// Where the connection does not end in time.
pub fn exchange(mut stream: impl Read + Write, sent: &[u8]) -> anyhow::Result<String> {
    // Who is refused at the first line may be let go before the last one is written.
    let _ = stream.write_all(sent);
    let mut heard = Vec::new();
    let mut buffer = [0; 16 << 10];
    loop {
        match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(length) => heard.extend_from_slice(&buffer[..length]),
            Err(error) => {
                ensure!(
                    !is_slow(&error),
                    "the connection is still open after {:?}",
                    String::from_utf8_lossy(&heard)
                );
                break;
            }
        }
    }
    Ok(String::from_utf8_lossy(&heard).into_owned())
}

/// The statuses of all answers in what was heard.
pub fn statuses(heard: &str) -> Vec<u16> {
    let lines = heard
        .split("HTTP/1.1 ")
        .skip(1)
        .chain(heard.split("HTTP/1.0 ").skip(1));
    lines
        .filter_map(|rest| rest.get(..3)?.parse().ok())
        .collect()
}
