//! Address of the portal in `stub.toml`: `ws://host:9090`, or `wss://host` with TLS.

/// A parsed address of a portal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// Set for TLS.
    pub secure: bool,
    /// Name or IP address, without brackets.
    pub host: String,
    /// The port (default: WebSocket's own, RFC 6455, section 3).
    pub port: u16,
    /// Host and port as written, for the HTTP header `Host`.
    pub authority: String,
}

/// Error of a text that is not the address of a portal.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("server is {server:?}: {fault}, such as ws://host:9090 or wss://host")]
pub struct ParseAddressError {
    server: String,
    fault: AddressFault,
}

/// The part of an address that is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
enum AddressFault {
    #[error("expected a URL")]
    NoUrl,
    #[error("expected ws:// or wss:// at its start")]
    Scheme,
    #[error("expected only a host and a port")]
    Authority,
    #[error("its port is not a number")]
    Port,
}

impl Address {
    /// Returns the name under which its certificate is stored: host and port.
    pub fn known_server_name(&self) -> String {
        if self.host.contains(':') {
            format!("[{}]:{}", self.host, self.port)
        } else {
            format!("{}:{}", self.host, self.port)
        }
    }

    /// Parses an address; the error describes the mistake.
    pub fn parse(server: &str) -> Result<Self, ParseAddressError> {
        let wrong = |fault| ParseAddressError { server: server.to_owned(), fault };
        let (scheme, authority) = server.split_once("://").ok_or_else(|| wrong(AddressFault::NoUrl))?;
        let secure = match scheme {
            "ws" => false,
            "wss" => true,
            _ => return Err(wrong(AddressFault::Scheme)),
        };
        let authority = authority.trim_end_matches('/');
        if authority.is_empty() || authority.contains(['/', '?', '#', '@']) || authority.contains(char::is_whitespace) {
            return Err(wrong(AddressFault::Authority));
        }
        let (host, port) = match authority.rsplit_once(':') {
            Some((host, port)) if !port.contains(']') => {
                let port = port.parse().map_err(|_| wrong(AddressFault::Port))?;
                (host, port)
            }
            _ => (authority, if secure { 443 } else { 80 }),
        };
        Ok(Self { secure, host: host.trim_matches(['[', ']']).to_owned(), port, authority: authority.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_taken_apart() {
        let parts = |server| {
            let address = Address::parse(server).unwrap();
            (address.secure, address.host, address.port)
        };
        assert_eq!(parts("ws://robots.local:9090/"), (false, "robots.local".into(), 9090));
        assert_eq!(parts("ws://server"), (false, "server".into(), 80));
        assert_eq!(parts("wss://server"), (true, "server".into(), 443));
        assert_eq!(parts("ws://[::1]:81"), (false, "::1".into(), 81));
        assert_eq!(parts("ws://[::1]"), (false, "::1".into(), 80));
    }

    #[test]
    fn others_are_named_with_what_is_right() {
        for server in ["cloud:9090", "http://cloud", "ws://", "ws://a/b", "ws://a:b", "ws://me@a"] {
            let words = Address::parse(server).unwrap_err().to_string();
            assert!(words.contains(server) && words.contains("ws://host:9090"), "{words}");
        }
    }
}
