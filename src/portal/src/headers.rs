//! Headers that several parts of the portal read.

use axum::http::{HeaderMap, header};

/// Returns true if the request asks for a WebSocket.
pub fn is_upgrade(headers: &HeaderMap) -> bool {
    header_text(headers, header::UPGRADE).is_some_and(|upgrade| upgrade.eq_ignore_ascii_case("websocket"))
}

/// Prefix of a WebSocket subprotocol that is a token, for clients that can set no other header.
pub const BEARER: &str = "bearer.";
/// Subprotocol chosen if the client offers it.
pub const ROSBRIDGE: &str = "rosbridge";

/// Returns the WebSocket subprotocols offered.
pub fn protocols(headers: &HeaderMap) -> impl Iterator<Item = &str> {
    let offered = headers.get_all(header::SEC_WEBSOCKET_PROTOCOL).iter();
    offered.filter_map(|value| value.to_str().ok()).flat_map(|value| value.split(',')).map(str::trim)
}

/// Returns a header as text; `None` if it is absent or not ASCII.
pub fn header_text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}
