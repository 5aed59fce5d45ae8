//! Foxglove's protocol, whose messages an external crate parses.

use foxglove::ws_protocol::client::ClientMessage;

/// JSON messages of a viewer.
pub fn json(data: &[u8]) {
    if let Ok(text) = std::str::from_utf8(data) {
        let _ = ClientMessage::parse_json(text);
    }
}
