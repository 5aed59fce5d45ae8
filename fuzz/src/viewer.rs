//! Foxglove's protocol, whose messages a crate of others reads.

use foxglove::ws_protocol::client::ClientMessage;

/// What a viewer says in JSON.
pub fn json(data: &[u8]) {
    if let Ok(text) = std::str::from_utf8(data) {
        let _ = ClientMessage::parse_json(text);
    }
}
